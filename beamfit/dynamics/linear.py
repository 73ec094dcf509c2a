"""Linear state spaces, and ones with a network, of an order that the runs tell."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.answer import GAIN, PURE, TIME, WIDE, derived, quantity
from beamfit.dynamics.fit import MAPS
from beamfit.dynamics.model import WEIGHT
from beamfit.dynamics.order import (
    LINEAR,
    NETWORK,
    Tried,
    count_of,
    criterion,
    free_of,
    largest_order,
    orders,
    stripped,
)
from beamfit.dynamics.record import Run, check_inputs, checked
from beamfit.dynamics.search import Case, Settled
from beamfit.dynamics.state_fit import (
    Course,
    StatesFit,
    case_of,
    remembering,
    states_answer,
    trained,
)
from beamfit.dynamics.states import linear_outputs
from beamfit.errors import InputError, nearest
from beamfit.greybox import tree
from beamfit.greybox.problem import Free, Prior
from beamfit.quantity import Quantity


def identify_states(
    runs: Run | Sequence[Run],
    order: int | None = None,
    map: str = "constant",
    *,
    delay: int = 0,
    offset: bool = True,
    hidden: int = 5,
    starts: int = 2,
    seed: int = 0,
    held: Sequence[Run] = (),
) -> StatesFit:
    """Identify a state space of all outputs, x+ = A x + B u + e, y = C x + D u + f.

    Parameters
    ----------
    runs : Run or sequence of Run
        Records with the same inputs and outputs at equal steps; readings may be missing.
    order : int, optional
        States. Found by the Bayesian information criterion if None: 1, 2, … until two further
        ones are no better, 10 at most.
    map : {"constant", "network"}
        With ``"network"`` the next state has a network of state and inputs added.
    delay : int
        Samples by which the outputs follow late.
    offset : bool
        Whether the outputs at rest are free numbers; else they are 0 where the inputs are.
    hidden, starts, seed : int
        Hidden nodes of the network, starts of its training, seed of their weights.
    held : sequence of Run
        Runs that are only predicted.

    Returns
    -------
    StatesFit
        Time constants (tau, or T and zeta of a pair that oscillates), gains at rest K and
        the outputs at the mean inputs; with a network those about the rest there. In
        ``to_json()`` ``matrices`` (e, f: offsets) are for inputs less ``input_mean``.

    Raises
    ------
    InputError
        If runs do not fit together, steps are unequal, an input never changes, or there are too
        few readings for the order.

    Notes
    -----
    Output error in a stable and minimal parametrisation (`beamfit.dynamics.states.contraction`),
    from the best realisation of an order (`beamfit.dynamics.order`). The criterion
    takes the noise, with its memory, of the largest order tried: a drift is no reason for a
    further state. L. Ljung, System Identification (1999), chapters 4 and 16.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> u, y = np.sign(rng.normal(size=200)), np.zeros(200)
    >>> for k in range(199):
    ...     y[k + 1] = 0.8 * y[k] + 0.4 * u[k]
    >>> level = y + 0.05 * rng.normal(size=200)
    >>> fit = identify_states(Run(np.arange(200.0), {"valve": u}, {"level": level}), 1)
    >>> fit.status.value, bool(abs(fit.quantities["tau1"].value + 1 / np.log(0.8)) < 0.2)
    ('converged', True)
    """
    if map not in MAPS:
        raise InputError(f"map '{map}'", nearest(map, list(MAPS)))
    runs, held = checked(runs, held, True)
    check_inputs(runs)
    case = case_of(runs, LINEAR, (), (), delay)
    _check_order(case, runs, order or 1)
    best, tried = orders(case, order, offset)
    n, found, gain = best.order, best.found, None
    if map == "network":
        nets = _networks(best, hidden, range(seed, seed + starts))
        free = [f for f in free_of(case, n, n, offset, best.direct) if f.path != "start"]
        free += [Free("start", nuisance=True), Free("p.net", nuisance=True)]
        case = case_of(runs, NETWORK, free, [Prior("p.net", 0.0, WEIGHT)], delay)
        found = trained(case, nets)
        gain = criterion(best.case, [best.found])[0] - criterion(case, [found])[0]
    case = best.case if map == "constant" else case
    found = remembering(case, found)
    said, gains = _quantities(case, found, n, runs, offset)
    more = {"delay_samples": delay, "tried": tried, "matrices": _matrices(case, found, n)}
    judged = {"held": held, "map": map, "gain": gain, "delay": delay, "order": n}
    return states_answer(case, found, runs, said, by_input=gains, more=more, **judged)


def _check_order(case: Case, runs: Sequence[Run], order: int) -> None:
    """Refuse orders with more numbers than readings allow."""
    most = largest_order(case)
    if not 1 <= order <= most:
        expected = f"1 to {most}" if most >= 1 else "a longer run, or another --model"
        raise runs[0].unusable(f"order {order} with {count_of(case)} readings", expected)


def _networks(best: Tried, hidden: int, seeds: range) -> list[dict[str, Any]]:
    """Models with networks of small random weights beside the linear part."""
    model = stripped(best.found.fit.model, best.order)
    p, (n, m) = model["p"], model["p"]["z"].shape
    moved = LINEAR.linear(p)._replace(c=jnp.eye(n), d=jnp.zeros((n, m)), offset=jnp.zeros(n))
    run = jax.jit(lambda u, x0: linear_outputs(moved, u, x0)[0])
    x = [np.asarray(run(LINEAR.scaled(p, c.u), model["start"][i]))
         for i, c in enumerate(best.case.courses)]  # fmt: skip
    sizes = {"sizes": np.concatenate(x).std(0)}
    sizes["steps"] = np.concatenate([np.diff(each, axis=0) for each in x]).std(0)
    found = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        net = {
            "inside": random.normal(0, 1 / np.sqrt(n + m), (hidden, n + m)),
            "out": random.normal(0, 0.1 / np.sqrt(hidden), (n, hidden)),
        }
        found.append(model | {"p": p | sizes | {"net": net}})
    return found


@tree.node("order")
class UsedStates:
    """The states that a model uses, and a run."""

    order: int
    course: Course


def _quoted(model: Any, asked: UsedStates) -> jax.Array:
    """Tau, T, zeta, value and frequency of each pole; static gains; outputs at the mean inputs."""
    p, n, course = model["p"], asked.order, asked.course
    a, b, c, d, _ = course.system.matrices(p)
    a, b, c, units = a[:n, :n], b[:n], c[:, :n], p["units"]
    m, size = units["u"].shape[1], units["y"][1]
    poles = jnp.linalg.eigvals(a)
    s = jnp.log(poles) / course.dt[0]
    gains = size[:, None] * (d + c @ jnp.linalg.solve(jnp.eye(n) - a, b))
    parts = [-1.0 / s.real, 1.0 / jnp.abs(s), -s.real / jnp.abs(s), poles.real, s.imag]
    levels = (units["y"][0][:, None] + gains[:, m:]).ravel()
    return jnp.concatenate([*parts, (gains[:, :m] / units["u"][1]).ravel(), levels])


def _quantities(
    case: Case, found: Settled, n: int, runs: Sequence[Run], offset: bool
) -> tuple[dict[str, Quantity], dict[str, list[str]]]:
    """Time constants from the slowest, gains and levels; and the names of each input's gains."""
    numbers = derived(found.fit, found.errors, _quoted, UsedStates(n, case.courses[0]))
    step, said = float(case.courses[0].dt[0]), {}
    inputs, outputs = list(runs[0].inputs), list(runs[0].outputs)
    tau, time, zeta, pole, turn = np.arange(5 * n).reshape(5, n)
    slow = [i for i in np.argsort(-numbers.value[time]) if numbers.value[turn[i]] >= 0.0]
    for number, i in enumerate(slow, start=1):
        around = numbers.value[turn[i]] * step
        if around < 1e-9:
            said[f"tau{number}"] = quantity(numbers, tau[i], TIME)
        elif around > np.pi - 1e-9:  # on the negative axis: a sign from sample to sample
            said[f"pole{number}"] = quantity(numbers, pole[i], PURE)
        else:
            said[f"T{number}"] = quantity(numbers, time[i], TIME)
            said[f"zeta{number}"] = quantity(numbers, zeta[i], PURE)
    said = {name: q.open() if q.unit == TIME and q.error is not None
            and q.error > WIDE * abs(q.value) else q for name, q in said.items()}  # fmt: skip
    gains: dict[str, list[str]] = {name: [] for name in inputs}
    for i, (output, name) in enumerate(product(outputs, inputs), start=5 * n):
        words = [output] * (len(outputs) > 1) + [name] * (len(inputs) > 1)
        gains[name].append("_".join(["K", *words]))
        said[gains[name][-1]] = quantity(numbers, i, GAIN)
    for i, output in enumerate(outputs if offset else (), start=5 * n + len(inputs) * len(outputs)):
        label = "level" if len(outputs) == 1 else f"level_{output}"
        said[label] = quantity(numbers, i, "output")
    return said, gains


def _taylor(model: Any, asked: UsedStates) -> jax.Array:
    """A and B of states that are the outputs without noise, in the units of the record."""
    p, n = model["p"], asked.order
    a, b, c, _, _ = asked.course.system.matrices(p)
    (_, size_u), (_, size_y) = (p["units"][kind] for kind in "uy")
    to = size_y[:, None] * c[:, :n]
    return jnp.column_stack([to @ a[:n, :n] @ jnp.linalg.inv(to),
                             to @ b[:n, : len(size_u)] / size_u])  # fmt: skip


def _matrices(case: Case, found: Settled, n: int) -> dict[str, Any]:
    """A, B, C, D in the units of the record, for inputs less their mean.

    Of as many states as outputs, all of which are read, also the first terms of report eq 2 with
    errors: the states are the outputs, so that no change of basis is open.
    """
    more = {}
    if n == len(case.seen):
        read = derived(found.fit, found.errors, _taylor, UsedStates(n, case.courses[0]))
        ends = {"A": slice(n), "B": slice(n, None)}
        more["outputs_as_states"] = {
            name + said: part[:, ends[name]] for name in ends
            for said, part in (("", read.value), ("_error", read.error))
        }  # fmt: skip
    p = found.fit.model["p"]
    a, b, c, d, _ = map(np.asarray, case.courses[0].system.matrices(p))
    (mean_u, size_u), (mean_y, size_y) = (np.asarray(p["units"][kind]) for kind in "uy")
    by, m = size_y[:, None], len(mean_u)
    return {
        "step_s": float(case.courses[0].dt[0]), "input_mean": mean_u, "A": a[:n, :n],
        "B": b[:n, :m] / size_u, "C": by * c[:, :n], "D": by * d[:, :m] / size_u,
        "state_offset": b[:n, m:].sum(1), "output_offset": mean_y + size_y * d[:, m:].sum(1),
    } | more  # fmt: skip
