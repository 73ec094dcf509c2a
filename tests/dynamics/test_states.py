"""State spaces identified from SIMULATED runs: values within their errors, orders, verdicts."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim, lfilter

from beamfit.dynamics.linear import criterion, identify_states, joint_error
from beamfit.dynamics.record import Run
from beamfit.dynamics.search import Case, ReadingErrors
from beamfit.dynamics.state_fit import fit_states
from beamfit.dynamics.states import StateSpace
from beamfit.errors import InputError, Status


def steps(n, rng, every):
    return np.repeat(rng.normal(size=n // every + 1), every)[:n]


def near(fit, **truths):
    for name, truth in truths.items():
        q = fit.quantities[name]
        assert abs(q.value - truth) < 4 * q.error, (name, q, truth)


def test_a_user_s_equations_at_uneven_samples_with_readings_missing_in_two_runs():
    rng = np.random.default_rng(1)

    def flow(x, u, p):
        lag, follow = p["tau"]
        return jnp.stack([u[0] - x[0] / lag, (x[0] - x[1]) / follow + p["k"] * u[1]])

    plant = StateSpace(flow, lambda x, u, p: x + p["o"])
    truth = {"tau": np.array([3.0, 8.0]), "k": 0.7, "o": np.array([1.0, -2.0])}

    def run_of(n, name, x0):
        dt = rng.uniform(0.3, 1.5, n)
        u = np.stack([steps(n, rng, 10), steps(n, rng, 7)], axis=1)
        y = np.array(jax.jit(plant.run)(truth, jnp.asarray(u), jnp.asarray(dt), jnp.array(x0))[0])
        y += rng.normal(size=y.shape) * [0.1, 0.3]
        y[rng.random((n, 2)) < [0.2, 0.5]] = np.nan
        time = np.concatenate([[0.0], np.cumsum(dt)[:-1]])
        return Run(time, dict(zip("ab", u.T, strict=True)), dict(zip("lm", y.T, strict=True)), name)

    runs = [run_of(120, "one", [0.0, 1.0]), run_of(70, "two", [2.0, -1.0])]
    begin = {"tau": np.array([1.0, 1.0]), "k": 1.0, "o": np.zeros(2)}
    fit = fit_states(runs, plant, begin, [0.0, 0.0], held=[run_of(60, "held", [1.0, 1.0])])
    assert fit.status is Status.converged, fit.message
    near(fit, **{"tau[0]": 3.0, "tau[1]": 8.0, "k": 0.7, "o[0]": 1.0, "o[1]": -2.0})
    assert [len(y) for y in fit.fitted["l"]] == [np.isfinite(r.outputs["l"]).sum() for r in runs]
    assert fit.held["m"][0].rms < 0.5


def test_segments_find_a_chaotic_plant_from_where_the_free_run_goes_astray():
    """E. Lorenz (1963), of which two states are read."""

    def flow(x, u, p):
        x, y, z = x
        return jnp.stack([p["s"] * (y - x), x * (p["r"] - z) - y + u[0], x * y - p["b"] * z])

    plant = StateSpace(flow, lambda x, u, p: x[jnp.array([0, 2])], parts=2)
    rng, dt = np.random.default_rng(0), np.full(64, 0.06)
    u, truth = rng.normal(size=(64, 1)), {"s": 10.0, "r": 28.0, "b": 8 / 3}
    y = jax.jit(plant.run)(truth, jnp.asarray(u), jnp.asarray(dt), jnp.array([1.0, 1.0, 20.0]))[0]
    y = y + 0.3 * rng.normal(size=y.shape)
    run = Run(0.06 * np.arange(64), {"u": u[:, 0]}, {"x": y[:, 0], "z": y[:, 1]})
    begin = {"s": 6.0, "r": 20.0, "b": 1.5}, [1.0, 1.0, 20.0]
    alone = fit_states(run, plant, *begin, segments=1)
    assert min(part.checks.free_run_percent for part in alone.parts) < 50.0
    fit = fit_states(run, plant, *begin, segments=16)
    assert fit.status is Status.converged, fit.message
    near(fit, **truth)


def test_poles_gains_and_the_order_of_two_inputs_and_outputs_are_found():
    rng = np.random.default_rng(0)
    b, c, d = rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), np.zeros((2, 2))
    a, b, c, d, _ = cont2discrete((np.array([[-0.1, 1.0], [-1.0, -0.1]]), b, c, d), 0.5)
    u = np.stack([3.0 * steps(240, rng, 10) + 5.0, steps(240, rng, 7)], axis=1)
    y = dlsim((a, b, c, d, 1.0), u)[1] * [1.0, 100.0] + [10.0, -300.0]
    y += 0.05 * y.std(0) * rng.normal(size=y.shape)
    y[rng.random(240) < 0.2, 1] = np.nan
    run = Run(0.5 * np.arange(240), dict(zip("ab", u.T, strict=True)),
              dict(zip("lm", y.T, strict=True)))  # fmt: skip
    fit = identify_states(run)
    assert (fit.status, fit.order) == (Status.converged, 2), fit.message
    gains = c @ np.linalg.solve(np.eye(2) - a, b) * [[1.0], [100.0]]
    read = fit.to_json()["matrices"]["outputs_as_states"]  # report eq 2 of these states
    to = np.diag([1.0, 100.0]) @ c
    for name, true in (("A", to @ a @ np.linalg.inv(to)), ("B", to @ b)):
        off = (np.array(read[name]) - true) / np.array(read[f"{name}_error"])
        assert np.abs(off).max() < 4.0, (name, off)
    near(fit, T1=1 / np.hypot(0.1, 1.0), zeta1=0.1 / np.hypot(0.1, 1.0))
    near(fit, K_l_a=gains[0, 0], K_l_b=gains[0, 1], K_m_a=gains[1, 0], K_m_b=gains[1, 1])
    found = fit.to_json()["matrices"]  # which stand for themselves
    a, b, c, d = (np.array(found[k]) for k in "ABCD")
    drive = np.column_stack([u - found["input_mean"], np.ones(240)])
    b, d = np.column_stack([b, found["state_offset"]]), np.column_stack([d, found["output_offset"]])
    again = dlsim((a, b, c, d, 1.0), drive)[1]
    assert np.all(np.nanstd(y - again, 0) < 0.06 * np.nanstd(y, 0))
    with pytest.raises(InputError, match=r"order 60 with .* readings; expected 1 to"):
        identify_states(run, 60)


def tank(rng, n, u, late=0):
    """A SIMULATED plant that rings beside a slow lag: T = 3, zeta = 0.3; tau = 12; K = 2.5."""
    a = np.array([[-0.1, 0.318, 0.0], [-0.318, -0.1, 0.0], [0.0, 0.0, -1 / 12]])
    b, c = np.array([[0.0], [0.349], [1 / 12]]), np.array([[1.0, 0.0, 1.5]])
    system = cont2discrete((a, b, c, np.zeros((1, 1))), 1.0)
    return dlsim(system, u[np.maximum(np.arange(n) - late, 0)])[1][:, 0]


TANK = {"tau1": 12.0, "T2": 3.0, "zeta2": 0.3, "K": 1.5 + 0.349 / 0.318 / (1 + (0.1 / 0.318) ** 2)}


def test_a_drift_is_no_state_and_bad_readings_are_left_out():
    """A ramp of twice the scatter was a pole at 1 without gains: "sample faster" was the advice."""
    rng = np.random.default_rng(4)
    u = steps(300, rng, 12)
    y = tank(rng, 300, u)
    level = y + 0.02 * y.std() * rng.normal(size=300) + 2.0 * y.std() * np.arange(300) / 300
    level[[50, 141, 222]] += np.array([8.0, -5.0, 12.0]) * y.std()
    fit = identify_states(Run(np.arange(300.0), {"valve": u}, {"level": level}))
    assert (fit.status, fit.order) == (Status.converged, 3), fit.message
    near(fit, **TANK)
    assert "The output drifts as well (degree 1 in time)" in fit.message
    assert "Left out: 3 readings far off their neighbours (run, the first at 50 s)" in fit.message
    assert fit.to_json()["left_out"][0]["count"] == 3


def test_a_delay_of_a_state_space_is_found_and_levels_of_a_readback_are_followed():
    """Four samples late; three states as said, since a search of all orders takes a minute."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.choice([-1.0, 1.0], 100), 3)
    y = tank(rng, 300, u, late=4)
    level = y + 0.02 * y.std() * rng.normal(size=300)
    read = u + 0.05 * rng.normal(size=300)
    fit = identify_states(Run(np.arange(300.0), {"valve": read}, {"level": level}), 3)
    assert fit.status is Status.converged, fit.message
    assert fit.to_json()["matrices"]
    assert fit.to_json()["delay_samples"] == 4
    assert fit.parts[0].checks.way.standing == ("valve",)
    near(fit, **TANK)


def test_digits_of_an_output_are_in_the_errors():
    """Readings at a level are rounded alike: many are worth no more than one."""
    rng = np.random.default_rng(2)
    u, off = np.repeat([0.0, 1.0, 0.0, 1.0], 40), []
    for level in rng.uniform(0.0, 0.3, 6):
        y = level + 2.0 * lfilter([0.0, 0.2], [1.0, -0.8], u)
        read = 0.3 * np.round(y / 0.3)
        fit = identify_states(Run(np.arange(160.0), {"valve": u}, {"level": read}), 1, delay=0)
        off.append(abs(fit.quantities["K"].value - 2.0) / fit.quantities["K"].error)
    assert max(off) < 3.0


def test_a_pole_that_is_as_good_as_one_leaves_a_limit_and_no_gain():
    """A lag of 4000 samples in a record of 200."""
    rng = np.random.default_rng(0)
    u, y = np.repeat(rng.uniform(-1, 1, 14), 15)[:200], np.zeros(200)
    for k in range(199):
        y[k + 1] = 2 * u[k] + (y[k] - 2 * u[k]) * np.exp(-1 / 4000)
    run = Run(np.arange(200.0), {"u": u}, {"y": y + 0.1 * y.std() * rng.normal(size=200)})
    q = identify_states(run, 1).quantities
    assert [q[name].error for name in ("tau1", "K", "level")] == [None] * 3
    low, high = q["tau1"].interval_95
    assert 10 < low < 4000
    assert np.isinf(high)


def test_a_network_follows_what_no_linear_state_space_does():
    """A state that saturates; the rest at the mean input and its slope there are iterated here."""

    def after(x, u):
        return 0.8 * x + 0.4 * np.tanh(u + x / 2)

    def rest(u, x=0.0):
        for _ in range(500):
            x = after(x, u)
        return x

    rng = np.random.default_rng(4)
    u, x = 2.0 * steps(160, rng, 6), np.zeros(160)
    for k in range(159):
        x[k + 1] = after(x[k], u[k])
    level = x + 0.03 * rng.normal(size=160)
    run = Run(np.arange(160.0), {"valve": u}, {"level": level})
    fit = identify_states(run, 1, "network", hidden=2, starts=1)
    assert fit.status is Status.converged, fit.message
    assert fit.parts[0].checks.against_constant > 100.0
    assert np.std(fit.fitted["level"][0] - x) < 0.015
    mean = u.mean()
    read = fit.to_json()["matrices"]["outputs_as_states"]
    slope = 1.0 / np.cosh(mean + rest(mean) / 2) ** 2
    for name, true in (("A", 0.8 + 0.2 * slope), ("B", 0.4 * slope)):
        assert abs(read[name][0][0] - true) < 4 * read[f"{name}_error"][0][0], name
    near(fit, level=rest(mean), K=(rest(mean + 1e-4) - rest(mean - 1e-4)) / 2e-4)


def test_an_order_is_worth_what_it_adds_to_what_readings_before_foretell():
    """Three orders miss by as much; misses of the second are told from those before, mostly."""
    n = 400
    time = np.arange(n, dtype=float)
    case = Case((SimpleNamespace(time=(time,), floor=2e-4, measured=(time,)),), (), (), ())

    def missed(share, used):
        rest = lfilter([1.0], [1.0, -share], np.random.default_rng(1).normal(size=n))
        fit = SimpleNamespace(groups=[SimpleNamespace(count=n, dof=n - used)])
        noise = ((ReadingErrors(np.full(n, 0.3)),),)
        return SimpleNamespace(
            case=case, residuals=((0.3 * rest / rest.std(),),), noise=noise, fit=fit
        )

    tried = [missed(0.9, 3), missed(0.99, 6), missed(0.99, 7)]
    rough, smooth, more = criterion(tried)
    assert smooth < rough - 100.0
    assert more - smooth == pytest.approx(np.log(n))


def test_the_scale_of_a_state_is_told_as_a_freedom_of_the_model():
    """Only b c and b s0 act: further runs would not tell them apart."""
    u, y = (np.arange(80) // 10) % 2, [0.5]
    for value in u[:-1]:
        y.append(0.8 * y[-1] + 0.4 * value)
    level = y + 0.01 * np.random.default_rng(0).normal(size=80)
    lag = StateSpace(
        lambda x, u, p: p["k"] * x + p["b"] * u, lambda x, u, p: p["c"] * x, discrete=True
    )
    run = Run(np.arange(80.0), {"valve": u}, {"level": level})
    fit = fit_states(run, lag, {"k": 0.5, "b": 1.0, "c": 1.0}, [0.0])
    assert fit.status is Status.unidentified
    assert "p.b, p.c, start[0,0] move together" in fit.message
    assert "fix one of them" in fit.message
    assert fit.quantities["b"].error is None
    assert fit.quantities["k"].value == pytest.approx(0.8, abs=4 * fit.quantities["k"].error)


def test_an_error_of_several_fits_holds_68_percent_of_what_all_of_them_allow():
    """Beside draws; where a third of the fits know nothing, or the first, there is no error."""
    random = np.random.default_rng(0)
    values, errors = np.array([0.0, 1.0, -0.3, 2.0]), np.array([0.2, 0.5, 0.1, 0.7])
    drawn = random.normal(values, errors, (200_000, 4))
    wanted = np.quantile(np.abs(drawn - values[0]), 0.6827)
    assert joint_error(values, errors) == pytest.approx(wanted, rel=0.01)
    holes = np.array([[0.2, np.nan, 0.2], [0.2, 0.2, 0.2], [0.2, 0.2, np.nan]])
    found = joint_error(np.zeros((3, 3)), holes)
    np.testing.assert_allclose(found, [0.2, np.nan, np.nan], rtol=1e-6)
