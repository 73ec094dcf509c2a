"""Receding-horizon control: limits that hold, targets that are met, and what is said of it."""

import json
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from beamfit.dynamics.control import (
    Controller,
    ControlLimits,
    Response,
    closed_loop,
    controller,
    outputs,
    simulate_loop,
    start,
)
from beamfit.dynamics.fit import identify
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER, simulate
from beamfit.errors import InputError, Status
from tests.simulations import simulations

INF = np.inf


def response(physics, p, m=1, delay=0, margin=0.05, of=None, name="y"):
    raw = physics.raw(jnp.array(p)) if of is None else of
    return Response(name, physics, raw, 0.5, delay, 1.0, 0.2, margin)


def made(*responses, horizon=10, rate=0.3, above=INF, step=0.5, m=1, smooth=0.1):
    many = len(responses)
    limits = ControlLimits(np.zeros(m), np.full(m, 2.0), np.full(m, rate), np.full(many, -INF),
                    np.broadcast_to(above, many))  # fmt: skip
    names = tuple(f"u{i}" for i in range(m))
    return Controller(names, responses, step, np.ones(m), limits, horizon, smooth)


LAG = response(FIRST_ORDER, [2.0, 1.5], delay=2)


@simulations(300, 1000)
def test_perturbed_loops_break_no_limit_of_an_input_or_of_its_rate(count):
    """Noise, gain and time constant 20 % off, steps of disturbances, and an upper limit."""
    control = made(LAG, above=3.0, horizon=8)
    random, runs, steps = np.random.default_rng(0), count, 25
    noise = 0.05 * random.normal(size=(runs, steps, 1))
    at = random.integers(5, 20, (runs, 1, 1))
    load = random.uniform(-1.0, 1.0, (runs, 1, 1)) * (np.arange(runs)[:, None, None] % 2)
    load = load * (np.arange(steps)[:, None] >= at)
    factors = 1.0 + random.uniform(-0.2, 0.2, (runs, 2))
    target = np.broadcast_to(random.uniform(0.5, 4.0, (runs, 1, 1)), (runs, steps, 1))
    first = random.uniform(0.0, 2.0, (runs, 1))

    def one(u, target, noise, load, factor):
        return closed_loop(control, u, target, noise, load, [factor])

    trace = jax.jit(jax.vmap(one))(first, target, noise, load, factors)
    u = np.concatenate([first[:, None], trace.inputs], axis=1)
    assert np.isfinite(trace.outputs).all()
    assert u.min() >= 0.0
    assert u.max() <= 2.0
    assert np.abs(np.diff(u, axis=1)).max() <= 0.3 + 1e-15
    # The limits were in the way, and the plans said where the output's could not be kept.
    assert np.mean(u >= 2.0 - 1e-6) > 0.02
    assert np.mean(np.abs(np.diff(u, axis=1)) > 0.3 - 1e-6) > 0.02
    # Undisturbed, a gain 20 % off passes the output's limit by less than 20 % of the way to it,
    # and not for long; where more happens the plans have said so.
    outputs = np.asarray(trace.outputs)[..., 0]
    quiet = (np.arange(runs) % 2 == 0) & (outputs[:, 0] < 3.0)
    assert outputs[quiet].max() < 3.0 + 0.2 * 2.5
    assert np.mean(outputs[quiet, -3:] > 3.0 + LAG.margin) < 0.02
    told = (np.asarray(trace.beyond) > 0).any(axis=(1, 2))
    assert told[outputs.max(axis=1) > 3.3].mean() > 0.95


@pytest.mark.parametrize(
    "one",
    [
        response(SECOND_ORDER, [1.5, 0.4, 1.5]),
        response(ARX, [-1.2, 0.4, 0.2, 0.1], delay=1),
    ],
    ids=lambda r: r.physics.name,
)
def test_a_disturbance_and_a_wrong_gain_leave_no_offset(one):
    control = made(one, horizon=8)
    steps = 120
    load = np.where(np.arange(steps) < 60, 0.0, -0.4)[:, None]
    factor = np.ones(len(one.physics.parameters(("u",))))
    factor[-1] = 1.2
    run = jax.jit(lambda: closed_loop(control, [0.5], np.full((steps, 1), 2.0),
                                      np.zeros((steps, 1)), load, [factor]))  # fmt: skip
    y = np.asarray(run().outputs)[:, 0]
    assert abs(y[59] - 2.0) < 1e-3
    assert abs(y[60] - 1.6) < 2e-3
    assert abs(y[-1] - 2.0) < 1e-3


def test_the_plan_is_that_of_another_solver():
    """The whole horizon written out for SLSQP, on the simulation of the package's own record."""
    control = made(LAG, horizon=12, above=2.0)
    state = start(control, jnp.array([0.4]))
    _, u, said = control(state, [float(state.x[0][0]) + 0.5], [2.4])
    p = jnp.tile(jnp.array([2.0, 1.5]), (13, 1))

    def ahead(plan):
        felt = jnp.concatenate([jnp.full(2, 0.4), plan[:-1]])[:, None]
        return 0.5 + simulate(FIRST_ORDER, p, felt, jnp.full(13, 0.5), state.x[0])[1:]

    ahead, slope = jax.jit(ahead), jax.jit(jax.jacfwd(ahead))

    def cost(plan):
        moves = jnp.diff(plan, prepend=0.4)
        return jnp.sum((ahead(plan) - 2.4) ** 2) + 0.1 * jnp.sum(moves**2)

    rates = {"type": "ineq", "fun": lambda v: 0.3 - np.abs(np.diff(v, prepend=0.4))}
    tight = {"type": "ineq", "fun": lambda v: np.asarray(1.95 - ahead(v)),
             "jac": lambda v: -np.asarray(slope(v))}  # fmt: skip
    found = minimize(jax.jit(cost), np.full(12, 0.4), jac=jax.jit(jax.grad(cost)),
                     method="SLSQP", bounds=[(0, 2)] * 12, constraints=[rates, tight],
                     options={"ftol": 1e-12, "maxiter": 300})  # fmt: skip
    assert found.success
    assert float(said.beyond[0]) < 1e-6
    assert float(cost(said.inputs[:, 0])) == pytest.approx(found.fun, rel=1e-6)
    assert float(u[0]) == pytest.approx(found.x[0], abs=1e-4)


def changing_lag(u):
    """Raw numbers, log tau and K, of a lag and a gain that change with the input."""
    inner = jnp.tanh(jnp.array([1.3, -0.6]) * u[0] + jnp.array([-0.9, 1.1]))
    return jnp.array([[0.5, -0.3], [0.3, -0.4]]) @ inner + jnp.array([0.7, 1.3])


@pytest.mark.parametrize(
    "above", [1.8, *(pytest.param(above, marks=pytest.mark.calibrate) for above in (1.2, 2.1))]
)
def test_plans_of_a_process_that_changes_are_the_best_where_a_limit_binds(above):
    """Each plan of a loop beside SLSQP's of the whole horizon, from that plan and from the last."""
    n, process = 10, response(FIRST_ORDER, None, of=changing_lag, margin=0.0)
    control = made(process, horizon=n, above=above + 0.5)
    state = control.begin([0.4])

    def ahead(plan, x):
        p = jax.vmap(lambda u: FIRST_ORDER.physical(changing_lag(u)))(plan[:, None])
        felt = jnp.concatenate([plan, plan[-1:]])[:, None]
        p = jnp.concatenate([p, p[-1:]])
        return simulate(FIRST_ORDER, p, felt, jnp.full(n + 1, 0.5), x)[1:]

    def cost(plan, x, last):
        return jnp.sum((ahead(plan, x) - above - 0.3) ** 2) + 0.1 * jnp.sum(
            jnp.diff(plan, prepend=last) ** 2
        )

    values = jax.jit(ahead), jax.jit(jax.jacfwd(ahead)), jax.jit(jax.value_and_grad(cost))
    last = 0.4
    for _ in range(8):
        x = state.x[0]
        begin, rest = np.asarray(state.plan[:, 0]), (x, last)
        state, u, said = control(state, [float(x[0]) + 0.5], [above + 0.8])
        plan = np.asarray(said.inputs[:, 0])
        rates = {"type": "ineq", "fun": lambda v, w=last: 0.3 - np.abs(np.diff(v, prepend=w))}
        tight = {"type": "ineq", "fun": lambda v, x=x: above - np.asarray(values[0](v, x)),
                 "jac": lambda v, x=x: -np.asarray(values[1](v, x))}  # fmt: skip
        ends = [
            minimize(values[2], at, rest, jac=True, method="SLSQP", bounds=[(0, 2)] * n,
                     constraints=[rates, tight], options={"ftol": 1e-12, "maxiter": 300})
            for at in (begin, plan)
        ]  # fmt: skip
        best = min(float(end.fun) for end in ends if end.success)
        assert float(values[0](plan, x).max()) < above + 1e-6
        assert float(values[2](plan, *rest)[0]) < best * 1.001
        last = float(u[0])


def test_two_outputs_meet_their_targets_by_two_inputs_and_parameters_that_change():
    def changing(u):
        return jnp.array([jnp.log(1.0 + 0.5 * jnp.tanh(u[0])), 1.0 + 0.3 * u[0], 0.3])

    other = response(FIRST_ORDER, [1.0, -0.4, 0.8], m=2, delay=1, name="z")
    control = made(response(FIRST_ORDER, None, m=2, of=changing), other, m=2)
    state = control.begin([0.2, 0.2])
    for _ in range(60):
        y = np.array([float(x[0]) + 0.5 for x in state.x])
        state, _, said = control(state, y, [2.0, 1.0])
    np.testing.assert_allclose(y, [2.0, 1.0], atol=5e-3)
    assert float(said.beyond.max()) == 0.0
    after, _, _ = control(state, [np.nan, 1.0], [2.0, 1.0])  # a reading that is missing
    assert np.isfinite(after.level).all()
    with pytest.raises(InputError, match="u1 at 3"):
        control.begin([0.2, 3.0])


@pytest.fixture(scope="module")
def fit():
    time = np.arange(80.0)
    u = np.random.default_rng(0).uniform(0.0, 2.0, 10).repeat(8)
    y = simulate(FIRST_ORDER, jnp.tile(jnp.array([4.0, 1.5]), (80, 1)), jnp.array(u)[:, None],
                 jnp.ones(80), jnp.zeros(1))  # fmt: skip
    noise = 0.02 * np.random.default_rng(1).normal(size=80)
    return identify(Run(time, {"valve": u}, {"level": np.asarray(y) + 0.3 + noise}), delay=0)


def test_a_loop_on_a_fit_settles_and_says_so(fit):
    control = controller(fit, rates={"valve": 0.5}, outputs={"level": (-INF, 2.7)})
    # 5 % of a transient with a lag of 4 s are left after 12 s; the inputs' range is the runs'.
    assert control.horizon == 12
    assert control.limits.high[0] == pytest.approx(max(fit.runs[0].inputs["valve"]))
    assert 2 * fit.noise[0] < control.responses[0].margin < 3 * fit.noise[0]
    loop = simulate_loop(fit, control, [("level", 2.0, 0.0)], disturbances=[("level", -0.3, 30.0)])
    assert loop.status is Status.converged
    assert [c.disturbed for c in loop.changes] == [0.0, -0.3]
    assert all(0 < c.settling < 20 for c in loop.changes)
    found = json.loads(json.dumps(loop.to_json()))
    assert found["status"] == "converged"
    assert found["limits"]["below"] == [None]


def test_what_cannot_be_kept_or_reached_is_named(fit):
    control = controller(fit, inputs={"valve": (0.0, 1.0)}, outputs={"level": (-INF, 2.7)})
    loop = simulate_loop(fit, control, [("level", 2.5, 0.0)])
    assert (loop.status, "valve at its limit" in loop.message) == (Status.at_limit, True)
    control = controller(fit, outputs={"level": (-INF, 2.2)})
    loop = simulate_loop(fit, control, [("level", 2.0, 0.0)], disturbances=[("level", 0.9, 20.0)])
    assert loop.status is Status.infeasible
    assert "passes its limit by up to 0." in loop.message
    control = controller(fit, rates={"valve": 1e-4})
    loop = simulate_loop(fit, control, [("level", 2.5, 0.0)])
    assert loop.status is Status.not_converged
    assert "valve moves at its largest rate" in loop.message


def test_where_a_loop_rests_at_first_is_no_fault_of_it_and_a_step_within_the_noise_has_no_overshoot(
    fit,
):
    control = controller(fit)
    [rest] = simulate_loop(fit, control, [("level", 2.0, 0.0)]).trace.outputs[0]
    control = controller(fit, outputs={"level": (-INF, rest - 0.1)})
    loop = simulate_loop(fit, control, [("level", rest - 0.4, 0.0)])
    assert (loop.status, loop.message.endswith("once within them.")) == (Status.converged, True)
    near = rest + 0.5 * fit.noise[0]
    [change] = simulate_loop(fit, controller(fit), [("level", near, 0.0)]).changes
    assert change.overshoot is None


def test_a_model_that_is_no_base_or_explains_no_runs_is_said(fit):
    unknown = replace(fit, status=Status.unidentified, message="Too few.")
    loop = simulate_loop(unknown, controller(fit), [("level", 2.0, 0.0)])
    assert (loop.status, loop.tables()) == (Status.unidentified, ())
    poor = replace(fit, status=Status.poor_fit)
    for far in (1.0, 9.0):
        loop = simulate_loop(poor, controller(fit), [("level", far, 0.0)])
        assert loop.status in (Status.poor_fit, Status.at_limit)
        assert "the model of level does not explain its runs" in loop.message


def test_a_delay_of_parts_of_a_step_is_felt_in_parts():
    """Against ten times finer steps, in which it is whole."""
    coarse = response(FIRST_ORDER, [2.0, 1.5], delay=1.3)
    fine = coarse._replace(delay=13)
    given = jnp.array(np.random.default_rng(0).uniform(0.0, 2.0, (12, 1)))
    found = []
    for one, step, plan in ((coarse, 0.5, given), (fine, 0.05, jnp.repeat(given, 10, axis=0))):
        control = made(one, horizon=len(plan), step=step)
        found.append(np.asarray(outputs(control, start(control, jnp.ones(1)), plan)).ravel())
    np.testing.assert_allclose(found[0], found[1][9::10], atol=0.02 * np.ptp(found[1]))


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"inputs": {"vavle": (0, 1)}}, "did you mean valve"),
        ({"inputs": {"valve": (1, 1)}}, "limits 1 to 1 of valve"),
        ({"outputs": {"valve": (0, 1)}}, "level"),
        ({"rates": {"valve": 0.0}}, "rate 0 of valve"),
        ({"horizon": 0}, "horizon of 0 steps"),
        ({"smooth": 0.0}, "smooth 0"),
        ({"horizon": 100_000}, "at most 1000 steps"),
    ],
)
def test_a_controller_refuses_in_a_line(fit, said, words):
    with pytest.raises(InputError, match=words):
        controller(fit, **said)


@pytest.mark.parametrize("wish", [("lvl", 1.0, 0.0), ("level", 9.0, 0.0), ("level", 1.0, 1e9)])
def test_a_wish_outside_the_loop_is_refused(fit, wish):
    control = controller(fit, outputs={"level": (0.0, 2.7)})
    with pytest.raises(InputError):
        simulate_loop(fit, control, [wish], duration=20.0)


def test_the_page_s_example_says_what_it_says(root, capsys):
    (block,) = re.findall(r"```python\n(.*?)```", (root / "docs/control.md").read_text(), re.DOTALL)
    exec(block, {})
    assert capsys.readouterr().out.strip() == block.rstrip().rpartition("# ")[2]
