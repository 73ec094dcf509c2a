"""Linear state spaces, and ones with a network, of an order that the runs tell.

States are those directions of past inputs and outputs that foretell the future best. Fits of rising
order are compared by their information criterion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.special import ndtr, ndtri

from beamfit.dynamics.answer import GAIN, PURE, TIME, derived, quantity, widened
from beamfit.dynamics.bad_readings import judged_without
from beamfit.dynamics.checks import digits_of
from beamfit.dynamics.fit import MAPS
from beamfit.dynamics.limits import SINGLE_END
from beamfit.dynamics.model import WEIGHT
from beamfit.dynamics.paths import Path, Paths
from beamfit.dynamics.record import Run, Way, band_limited, check_inputs, checked, unsure_gain
from beamfit.dynamics.search import (
    BETTER,
    DRIFT,
    LONGEST,
    TINY,
    Begun,
    Case,
    Settled,
    drift_waves,
    information,
    noise_of,
    settled,
    used_by,
    with_memory,
)
from beamfit.dynamics.state_fit import (
    PLAIN,
    WORSE,
    Course,
    StatesFit,
    at_start,
    begun,
    case_of,
    states_answer,
)
from beamfit.dynamics.states import Matrices, contraction, linear_outputs
from beamfit.errors import InputError, nearest
from beamfit.greybox.fit import Derived
from beamfit.greybox.problem import Free, Prior
from beamfit.noise.correlated import CENTRAL, reach_of_probability
from beamfit.noise.memory import CorrelatedNoise, remembers
from beamfit.quantity import NORMAL_REACH, Quantity

# Most samples of past and future, and most rows, of the regression.
HORIZON, ROWS = 20, 20_000
# Strides through the samples, for slow responses; fewest rows that must remain.
STRIDES, FEWEST = (1, 5, 25, 125), 100


class Linear:
    """x+ = a x + b u, y = c x + d u in units of the scatter, stable whatever its numbers.

    Of p: ``z`` and ``around`` (`beamfit.dynamics.states.contraction`), ``c``, ``d``, and ``units``,
    pairs of mean and size of the inputs and the outputs. A last input that is 1 stands for offsets:
    of the outputs alone they would have no end where the process integrates.
    """

    def run(self, p: Any, u: Any, dt: Any, x0: Any) -> tuple[jax.Array, jax.Array]:
        """Outputs at the samples and the state after the last."""
        y, last = linear_outputs(self.linear(p), self.scaled(p, u), x0)
        return y * p["units"]["y"][1] + p["units"]["y"][0], last

    def scaled(self, p: Any, u: Any) -> jax.Array:
        """Inputs in their units, and 1 if there are offsets."""
        u = (u - p["units"]["u"][0]) / p["units"]["u"][1]
        return jnp.pad(u, ((0, 0), (0, p["z"].shape[1] - u.shape[1])), constant_values=1.0)

    def linear(self, p: Any) -> Matrices:
        """Matrices of the linear part."""
        return Matrices(*contraction(p["z"], p["around"]), p["c"], p["d"], jnp.zeros(len(p["c"])))

    matrices = linear


class LinearWithNetwork(Linear):
    """The same with x+ = a x + b u + steps * out @ tanh(inside @ (x/sizes, u) + bias)."""

    def run(self, p: Any, u: Any, dt: Any, x0: Any) -> tuple[jax.Array, jax.Array]:
        """Outputs at the samples and the state after the last."""
        linear, u = self.linear(p), self.scaled(p, u)
        n, net = len(x0), p["net"]
        drive, inside = u @ linear.b.T, u @ net["inside"][:, n:].T
        by_state, out = net["inside"][:, :n] / p["sizes"], p["steps"][:, None] * net["out"]

        def step(x, now):
            return linear.a @ x + now[0] + out @ jnp.tanh(by_state @ x + now[1]), x

        last, x = jax.lax.scan(step, x0, (drive, inside))
        y = x @ linear.c.T + u @ linear.d.T
        return y * p["units"]["y"][1] + p["units"]["y"][0], last

    def matrices(self, p: Any) -> Matrices:
        """Matrices linearised about the rest at the mean input."""
        linear, (n, m), net = self.linear(p), p["z"].shape, p["net"]

        def after(x, u):
            inside = net["inside"] @ jnp.concatenate([x / p["sizes"], u])
            return linear.a @ x + linear.b @ u + p["steps"] * (net["out"] @ jnp.tanh(inside))

        x, mean = jnp.zeros(n), jnp.zeros(m).at[p["units"]["u"].shape[1] :].set(1.0)
        for _ in range(20):  # Newton steps
            slope = jnp.eye(n) - jax.jacfwd(after)(x, mean)
            x = x + jnp.linalg.solve(slope, after(x, mean) - x)
        a, b = jax.jacfwd(after, (0, 1))(x, mean)
        shift = (x - a @ x - b @ mean)[:, None] * mean  # so that it rests there
        return linear._replace(a=a, b=b + shift)


LINEAR, NETWORK = Linear(), LinearWithNetwork()


def realisations(
    u: list[np.ndarray], y: list[np.ndarray], order: int
) -> Iterator[tuple[np.ndarray, ...]]:
    """Find linear systems of an order from runs, one for each stride that the runs are long for.

    Parameters
    ----------
    u, y : list of array, shape (samples, m) and (samples, k)
        Inputs and outputs of each run, in units of their scatter, nothing missing.
    order : int
        States.

    Yields
    ------
    tuple of array
        a, b, c, d; the poles of a inside the unit circle.

    Notes
    -----
    Canonical variates (W. Larimore 1990; L. Ljung, System Identification (1999), section 10.6): the
    future is regressed on the past and on future inputs, the singular vectors of the past's part
    are the states, and the matrices a regression of states and outputs on states and inputs.
    """
    longest = max(map(len, y))
    for stride in STRIDES:
        if stride > 1 and longest < stride * FEWEST:
            return
        # An input that changes within a stride counts by its mean.
        mean = [each[: len(each) // stride * stride].reshape(-1, stride, each.shape[1]).mean(1)
                for each in u]  # fmt: skip
        read = [each[::stride][: len(v)] for each, v in zip(y, mean, strict=True)]
        for degree in (0, DRIFT):
            found = _regressed(mean, read, order, degree)
            if found is not None and (a := _each_sample(found[0], stride, longest)) is not None:
                many = sum(np.linalg.matrix_power(a, i) for i in range(stride))
                yield a, np.linalg.lstsq(many, found[1], rcond=1e-10)[0], *found[2:]


def first_lag(u: list[np.ndarray], y: list[np.ndarray]) -> int:
    """The first sample before each output at which inputs act, by the information criterion.

    Outputs are regressed on themselves and on inputs before, and on a drift. 1 where no lag acts,
    and of short runs.
    """
    (m, k), count = (u[0].shape[1], y[0].shape[1]), sum(map(len, y))
    horizon = min(count // (8 * (m + k)), HORIZON)
    rows = _rows(u, y, horizon, DRIFT) if horizon > 1 else []
    if not rows:
        return 1
    past, *_, now = rows
    lags = past.reshape(len(past), horizon, k + m)  # from the longest to 1
    own, others = lags[..., :k].reshape(len(past), -1), lags[..., k:].reshape(len(past), -1)
    triangle = np.linalg.qr(np.hstack([own, others, now]), mode="r")
    used = own.shape[1] + m * np.arange(horizon, -1, -1)  # with lags from 1, 2, … on, and without
    missed = np.array([np.sum(triangle[n:, -k:] ** 2, axis=0) for n in used])
    cost = len(now) * np.log(np.maximum(missed, TINY)).sum(axis=1)
    return 1 + int(np.argmin(cost + np.log(len(now)) * k * used)) % horizon


def _each_sample(a: np.ndarray, stride: int, longest: int) -> np.ndarray | None:
    """The matrix of a sample by that of a stride, its poles inside the unit circle; None where
    there is no real one.
    """
    values, vectors = np.linalg.eig(a)
    most = np.exp(-stride / (1000.0 * longest))
    values = values * np.minimum(1.0, most / np.maximum(np.abs(values), 1e-12))
    if stride > 1 and np.any((np.abs(values.imag) < 1e-9) & (values.real <= 0)):
        return None
    once = ((vectors * values ** (1.0 / stride)) @ np.linalg.pinv(vectors)).real
    return once if np.isfinite(once).all() else None


def _regressed(
    u: list[np.ndarray], y: list[np.ndarray], order: int, degree: int
) -> tuple[np.ndarray, ...] | None:
    """The system beside drifts of a degree: polynomials that come later are of the same degree."""
    m, k = u[0].shape[1], y[0].shape[1]
    count = sum(map(len, y))
    horizon = int(np.clip(count // (4 * (m + k) + 4 * m), order // k + 2, HORIZON))
    rows = _rows(u, y, horizon, degree)
    if not rows or len(rows[0]) < horizon * (2 * m + k):
        return None
    past, later, future, inputs, now_u, now_y = rows
    by = np.linalg.lstsq(np.hstack([past, inputs]), future, rcond=1e-10)[0][: past.shape[1]]
    triangle = np.linalg.qr(past, mode="r")
    _, _, right = np.linalg.svd(triangle @ by, full_matrices=False)
    if len(right) < order:
        return None
    to_state = by @ right[:order].T
    x, after = past @ to_state, later @ to_state
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-12) / np.sqrt(len(x))
    x, after = x / size, after / size
    ab = np.linalg.lstsq(np.hstack([x, now_u]), after, rcond=1e-10)[0].T
    cd = np.linalg.lstsq(np.hstack([x, now_u]), now_y, rcond=1e-10)[0].T
    return ab[:, :order], ab[:, order:], cd[:, :order], cd[:, order:]


def _rows(u: list[np.ndarray], y: list[np.ndarray], horizon: int, degree: int) -> list[np.ndarray]:
    """Past, past a sample later, future, future inputs, and inputs and outputs now, by row of all
    runs; less a drift of the degree in each. Nothing of runs that are too short.
    """
    found = []
    for v, w in zip(u, y, strict=True):
        both, count = np.hstack([w, v]), len(w) - 2 * horizon
        if count < 2:
            continue
        at = np.arange(horizon, horizon + count, max(1, count // ROWS))
        waves = np.column_stack([np.ones(len(at)), drift_waves(at / len(w))])
        slow = np.linalg.qr(waves[:, : degree + 1 if degree else 0])[0]
        parts = ((both, -horizon, 0), (both, 1 - horizon, 1), (w, 0, horizon), (v, 0, horizon),
                 (v, 0, 1), (w, 0, 1))  # fmt: skip
        around = [np.concatenate([of[at + k] for k in range(begin, end)], axis=1)
                  for of, begin, end in parts]  # fmt: skip
        found.append([each - slow @ (slow.T @ each) for each in around])
    return [np.concatenate(each) for each in zip(*found, strict=True)]


def normal_form(
    a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Write a stable system with a aᵀ + b bᵀ = 1.

    Returns
    -------
    tuple of array
        `around` of `beamfit.dynamics.states.contraction`, shape (n + m, n + m), c, and the matrix
        that takes states to the new ones.
    """
    n = len(a)
    reach = solve_discrete_lyapunov(a, b @ b.T)
    reach = 0.5 * (reach + reach.T) + 1e-10 * max(np.trace(reach), 1e-12) * np.eye(n)
    values, vectors = np.linalg.eigh(reach)
    size = np.sqrt(np.maximum(values, 1e-14 * values.max()))
    to, back = (vectors / size) @ vectors.T, (vectors * size) @ vectors.T
    both = np.hstack([to @ a @ back, to @ b])
    left, _, right = np.linalg.svd(both)
    around = right.copy()
    around[:n] = left @ right[:n]  # the rows that are nearest, orthonormal
    return around, c @ back, to


# Most states that are searched, those that bad readings are judged beside, and number of orders
# without improvement that ends the search.
HIGHEST, GLANCED, BEYOND = 10, 4, 2
# Starts searched for each order, the best predictors; readings needed for each free number.
BEGINS, EACH = 2, 3
# Pole, and weight in the output, of a state that is added to an order.
NEW, FAINT = 0.6, 1e-3


class TriedOrder(NamedTuple):
    """A fit of an order, with a direct path from inputs to outputs or without."""

    order: int
    direct: bool
    begun: Begun
    bic: float = np.nan


def count_of(case: Case) -> int:
    """Number of readings."""
    return sum(len(m) for s in case.seen for m in s.measured)


def largest_order(case: Case) -> int:
    """The largest order that leaves a few readings to each free number."""
    k, m = len(case.seen), len(case.seen[0].inputs)
    return int((count_of(case) / EACH - k * (m + 1)) / (m + k + len(case.courses)))


class _Fits(NamedTuple):
    """Orders that were tried, the likeliest first, and likely fits."""

    tried: tuple[TriedOrder, ...]
    each: list[Begun]


class StatesSearch(NamedTuple):
    """Settings of an identification: states of the system if said, its paths, if outputs at rest
    are free numbers, constants or a network of so many nodes from so many seeds.
    """

    order: int | None
    paths: Paths
    offset: bool
    map: str
    hidden: int
    seeds: range
    held: tuple[Run, ...]

    @property
    def on_time(self) -> float:
        """The delay that is said, or none, samples."""
        return min(self.paths.delays, key=abs)

    def delay(self, runs: tuple[Run, ...]) -> float:
        """Samples of delay that lags of the inputs tell; 0 of smooth ones, whose lags are alike."""
        if self.paths.given or band_limited(runs):
            return self.on_time
        case = case_of(runs, LINEAR, (), (), Path(None, self.paths.ways[-1], 0.0))
        found = first_lag(*_scaled(case, _units(case, True), False)) - 1
        return min(float(found), self.paths.delays[-1])

    def begun(self, runs: tuple[Run, ...]) -> _Fits:
        """Orders by the delay that lags tell, on time unless that is clearly likelier, and by
        inputs at their levels where the best order is likelier with these.
        """
        late, way = self.delay(runs), self.paths.ways[-1]
        tried = self.orders(runs, Path(None, Way(), late))
        if late != self.on_time:
            tried = self.unless(runs, tried, Path(None, Way(), self.on_time), 2.0 * BETTER)
        if way.standing:
            tried = self.unless(runs, tried, tried[0].begun.path._replace(way=way), 0.0)
        constant = self.map == "constant"
        return _Fits(tried, [tried[0].begun] if constant else self.trained(runs, tried[0]))

    def glanced(self, runs: tuple[Run, ...]) -> _Fits:
        """The fit of the order that is said, or of a few states, by the delay that lags tell: bad
        readings would take many for the noise to be small.
        """
        path = Path(None, Way(), self.delay(runs))
        case = case_of(runs, LINEAR, (), (), path)
        n = self.order or min(GLANCED, largest_order(case))
        return _Fits((), [_tried(case, path, n, self.offset, True, None).begun])

    def unless(
        self, runs: tuple[Run, ...], tried: tuple[TriedOrder, ...], path: Path, better: float
    ) -> tuple[TriedOrder, ...]:
        """Orders by another path, unless the best that were tried is better by so much."""
        best, case = tried[0], case_of(runs, LINEAR, (), (), path)
        other = _tried(case, path, best.order, self.offset, best.direct, None)
        before, then = criterion([best.begun, other.begun], best.begun)
        return self.orders(runs, path) if then < before + better else tried

    def orders(self, runs: tuple[Run, ...], path: Path) -> tuple[TriedOrder, ...]:
        """Fits of 1, 2, … states, or as many as said, the likeliest first; that also without a
        direct path from inputs to outputs.
        """
        case = case_of(runs, LINEAR, (), (), path)
        tried: list[TriedOrder] = []
        most = min(HIGHEST, largest_order(case))
        for n in [self.order] if self.order else range(1, most + 1):
            before = tried[-1] if tried else None
            tried.append(_tried(case, path, n, self.offset, True, before))
            told = criterion([each.begun for each in tried])
            if n - tried[int(np.argmin(told))].order >= BEYOND:
                break
        full, last = tried[int(np.argmin(told))], tried[-1]
        model = full.begun.settled.fit.model
        p = model["p"] | {"d": model["p"]["d"].at[:, : len(case.seen[0].inputs)].set(0.0)}
        free = free_of(case, full.order, self.offset, False)
        bounded = full.begun.case._replace(free=free)
        plain = Begun(bounded, path, settled(bounded, [model | {"p": p}]))
        tried.append(TriedOrder(full.order, False, plain))
        told = criterion([each.begun for each in tried], last.begun)
        return tuple(tried[k]._replace(bic=told[k]) for k in np.argsort(told, kind="stable"))

    def trained(self, runs: tuple[Run, ...], best: TriedOrder) -> list[Begun]:
        """Networks beside a linear system, those that are likely."""
        n, path = best.order, best.begun.path
        free = [f for f in free_of(best.begun.case, n, self.offset, best.direct)
                if f.path != "start"]  # fmt: skip
        free += [Free("start", nuisance=True), Free("p.net", nuisance=True)]
        case = case_of(runs, NETWORK, free, [Prior("p.net", 0.0, WEIGHT)], path)
        case = case._replace(degree=best.begun.case.degree)
        nets = _networks(best, self.hidden, self.seeds)
        fits = likely(case, [settled(case, [net]) for net in nets])
        return [Begun(case, path, each) for each in fits]

    def answer(self, runs: tuple[Run, ...], found: _Fits, left_out: Any) -> StatesFit:
        """Judge runs whose orders were tried, the likeliest first."""
        (tried, fits), gain = found, None
        if self.map == "network":
            linear, bent = criterion([tried[0].begun, fits[0]], tried[0].begun)
            gain = linear - bent
        n, path = tried[0].order, fits[0].path
        fits = [fit._replace(settled=with_memory(fit.case, fit.settled, WORSE)) for fit in fits]
        said, gains = _quantities(fits, n, runs, self.offset)
        rows = [{"order": t.order, "direct": t.direct, "bic": t.bic}
                for t in sorted(tried, key=lambda t: (not t.direct, t.order))]  # fmt: skip
        more = {"delay_samples": int(path.delay), "tried": rows, "matrices": _matrices(fits, n)}
        judged = {"map": self.map, "gain": gain, "order": n, "given": self.paths.given}
        judged |= {"held": self.held, "left_out": left_out, "by_input": gains, "more": more}
        return states_answer(fits[0], runs, said, **judged)


def criterion(tried: Sequence[Begun], last: Begun | None = None) -> list[float]:
    """The Bayesian information criterion of fits under the noise, with its memory, of the last.

    By the readings that all of them have: those of a longer delay begin later.
    """
    noise = _noise_of((last or tried[-1]).case, (last or tried[-1]).settled)
    lengths = [[len(rest) for row in each.settled.rest for rest in row] for each in tried]
    return [information(each.case, each.settled, noise, np.min(lengths, axis=0)) for each in tried]


def _noise_of(case: Case, found: Settled) -> CorrelatedNoise | None:
    """The noise with a memory of residuals that have one; slopes are left out for speed."""
    rows = case.rows(found.rest, found.noise)
    if not any(remembers(rest / error, used_by(found.fit)) for rest, error, *_ in rows):
        return None
    scaled = [(rest / error)[:LONGEST, None] for rest, error, *_ in rows]
    return noise_of(scaled, [time[:LONGEST] for _, _, time, _ in rows], np.zeros((0, 1)))[1]


def free_of(case: Case, order: int, offset: bool, direct: bool) -> tuple[Free, ...]:
    """Free numbers of a model; those of a direct path that there is not are held at 0."""
    m, start = len(case.seen[0].inputs), np.ones((len(case.courses), order), bool)
    straight = np.full((len(case.seen), m + offset), direct)
    straight[:, m:] = True
    start[0] = not offset  # where the first run begins, the offsets of a linear system say
    held = [Free(name, np.where(on, -np.inf, 0.0), np.where(on, np.inf, 0.0), nuisance=True)
            for name, on in (("p.d", straight), ("start", start))]  # fmt: skip
    return Free("p.z", nuisance=True), Free("p.c", nuisance=True), *held


def _tried(
    case: Case, path: Path, n: int, offset: bool, direct: bool, before: TriedOrder | None
) -> TriedOrder:
    """The fit of an order from its best realisations, and from the order before and one more."""
    bounded = case._replace(free=free_of(case, n, offset, direct))
    units, k = _units(case, offset), len(case.seen)
    u, y = _scaled(case, units, offset)
    m, rest = u[0].shape[1], np.zeros((len(y), n))

    def model(a, b, c, d, start=rest):
        around, c, to = normal_form(a, b, c)
        d = np.where(direct | (np.arange(m) >= m - offset), d, 0.0)
        p = {"z": np.zeros((n, m)), "around": around, "c": c, "d": d, "units": units}
        return {"p": p, **at_start(start @ to.T, k)}

    slow = case._replace(degree=DRIFT)

    def best(models):
        missed = [_missed(slow, each) for each in models]
        return [models[i] for i in np.argsort(missed, kind="stable") if np.isfinite(missed[i])]

    models = best([model(*found) for found in realisations(u, y, n)])[:BEGINS]
    if before is not None:
        last = before.begun.settled.fit.model
        a, b, c, d, _ = map(np.asarray, LINEAR.matrices(last["p"]))
        a = np.diag([*np.zeros(len(a)), NEW]) + np.pad(a, ((0, 1), (0, 1)))
        b, c = np.vstack([b, np.ones(m)]), np.hstack([c, np.full((k, 1), FAINT)])
        start = np.pad(np.asarray(last["start"]), ((0, 0), (0, 1)))
        models = best([*models, model(a, b, c, d, start)])
    if not models:  # runs too short for a regression
        a = np.diag(NEW ** np.arange(1.0, n + 1))
        models = [model(a, np.ones((n, m)), np.full((k, n), FAINT), np.zeros((k, m)))]
    return TriedOrder(n, direct, begun(bounded, models, path))


def _missed(case: Case, model: Any) -> float:
    """Sum of squared residuals of a model beside drifts and levels of the runs."""
    rest = case.rest(case.beside_drift(model))
    return case.squares([[r - r.mean() for r in row] for row in rest])


def _units(case: Case, offset: bool) -> dict[str, np.ndarray]:
    """Mean and size of inputs and outputs; without an offset all is about 0."""
    seen = case.seen[0]
    y = np.array([np.mean(np.concatenate(s.measured)) for s in case.seen])
    return {
        "u": np.stack([offset * seen.mean_u, seen.wide]),
        "y": np.stack([offset * y, [s.size_y for s in case.seen]]),
    }


def _scaled(
    case: Case, units: dict[str, np.ndarray], offset: bool
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Inputs (with a 1) and outputs of the runs in units, unpadded; missing readings bridged."""
    u, y = [], []
    for i, run in enumerate(case.seen[0].runs):
        count = int(np.count_nonzero(np.asarray(run.dt))) + 1
        each = (np.asarray(run.u)[:count] - units["u"][0]) / units["u"][1]
        u.append(np.pad(each, ((0, 0), (0, int(offset))), constant_values=1.0))
        read = [np.interp(np.arange(count), s.runs[i].read, s.measured[i])
                for s in case.seen]  # fmt: skip
        y.append((np.stack(read, axis=1) - units["y"][0]) / units["y"][1])
    return u, y


def identify_states(
    runs: Run | Sequence[Run],
    order: int | None = None,
    map: str = "constant",
    *,
    delay: int | None = None,
    offset: bool = True,
    hidden: int = 5,
    starts: int = 5,
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
    delay : int, optional
        Samples by which the outputs follow late; found beside the order if None. Below zero where
        the clocks of inputs and outputs differ.
    offset : bool
        Whether the outputs at rest are free numbers; else they are 0 where the inputs are.
    hidden, starts, seed : int
        Hidden nodes of the network, starts of its training, seed of their weights. Errors contain
        how far apart the starts end.
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
    from the best realisation of an order (`beamfit.dynamics.linear`). The criterion
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
    given = None if delay is None else float(delay)
    case = case_of(runs, LINEAR, (), ())
    most = largest_order(case)
    if not 1 <= (order or 1) <= most:
        expected = f"1 to {most}" if most >= 1 else "a longer run, or another --model"
        raise runs[0].unusable(f"order {order or 1} with {count_of(case)} readings", expected)
    seeds = range(seed, seed + starts)
    search = StatesSearch(order, Paths.of(runs, given, True), offset, map, hidden, seeds, held)
    searches = search.glanced, search.begun
    return judged_without(runs, searches, lambda found: found.each[0], search.answer)


def likely(case: Case, found: Sequence[Settled]) -> list[Settled]:
    """The best of several ends of a search, and those that are as likely as draws about it.

    Draws from the posterior about an optimum of p numbers lie above its -2 ln L by chi-square of p
    degrees of freedom, by p in the mean: an end that is nearer is another part of the posterior.
    """
    each = [Begun(case, PLAIN, fit) for fit in found]
    told = np.array(criterion(each, min(each, key=lambda one: one.settled.likelihood)))
    best, *others = np.argsort(np.where(np.isfinite(told), told, np.inf))
    most = told[best] + used_by(found[best].fit)
    return [found[best], *(found[i] for i in others if told[i] <= most)]


def _derived(fits: Sequence[Begun], function: Any) -> Derived:
    """Numbers of the best fit; within their errors 68 % of all fits' posterior lies, each of which
    counts as much: the posterior of a network is bent, and each tells a part of it.
    """
    course = fits[0].case.courses[0]
    each = [derived(f.settled.fit, f.settled.errors, function, course) for f in fits]
    if len(each) == 1:
        return each[0]
    values, errors = (np.stack([getattr(one, name) for one in each]) for name in ("value", "error"))
    return each[0]._replace(error=joint_error(values, errors))


def joint_error(values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Distance from the first of some values within which 68 % of all lie, each normal.

    Parameters
    ----------
    values, errors : array, shape (fits, ...)
        Of one quantity each along the first axis; an error is NaN where nothing is known.

    Returns
    -------
    array, shape (...)
        NaN where the first is, or where more than 32 % are.

    Examples
    --------
    >>> joint_error(np.array([3.0, 3.0]), np.array([0.5, 0.5])).round(6).item()
    0.5
    >>> joint_error(np.array([0.0, 1.0]), np.array([0.1, 0.1])).round(2).item()
    0.97
    """
    seen, away = np.isfinite(errors), values - values[0]
    spread = np.where(seen, np.maximum(errors, np.finfo(float).tiny), np.inf)

    def within(reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        above, below = (reach - away) / spread, (-reach - away) / spread
        slope = (np.exp(-0.5 * above**2) + np.exp(-0.5 * below**2)) / (np.sqrt(2 * np.pi) * spread)
        return np.mean(ndtr(above) - ndtr(below), axis=0), np.mean(slope, axis=0)

    widest = np.max(np.where(seen, np.abs(away) + errors, 0.0), axis=0)
    reach = reach_of_probability(within, widest, CENTRAL)
    return np.where(seen[0] & (seen.mean(axis=0) > CENTRAL), reach, np.nan)


def _networks(best: TriedOrder, hidden: int, seeds: range) -> list[dict[str, Any]]:
    """Models with networks of small random weights beside the linear part."""
    model = best.begun.settled.fit.model
    p, (n, m) = model["p"], model["p"]["z"].shape
    moved = LINEAR.linear(p)._replace(c=jnp.eye(n), d=jnp.zeros((n, m)), offset=jnp.zeros(n))
    run = jax.jit(lambda u, x0: linear_outputs(moved, u, x0)[0])
    x = [np.asarray(run(LINEAR.scaled(p, c.u), model["start"][i]))
         for i, c in enumerate(best.begun.case.courses)]  # fmt: skip
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


def _quoted(model: Any, course: Course) -> jax.Array:
    """Tau, T, zeta, value and frequency of each pole; static gains; outputs at the mean inputs."""
    p, units = model["p"], model["p"]["units"]
    a, b, c, d, _ = course.system.matrices(p)
    m, size = units["u"].shape[1], units["y"][1]
    poles = jnp.linalg.eigvals(a)
    poles = poles[jnp.lexsort((poles.imag, -jnp.abs(poles)))]  # the same of several fits
    s = jnp.log(poles) / course.dt[0]
    gains = size[:, None] * (d + c @ jnp.linalg.solve(jnp.eye(len(a)) - a, b))
    parts = [-1.0 / s.real, 1.0 / jnp.abs(s), -s.real / jnp.abs(s), poles.real, s.imag]
    levels = (units["y"][0][:, None] + gains[:, m:]).ravel()
    return jnp.concatenate([*parts, (gains[:, :m] / units["u"][1]).ravel(), levels])


def _quantities(
    fits: Sequence[Begun], n: int, runs: Sequence[Run], offset: bool
) -> tuple[dict[str, Quantity], dict[str, list[str]]]:
    """Time constants from the slowest, gains and levels; and the names of each input's gains."""
    course, path = fits[0].case.courses[0], fits[0].path
    step, said = float(course.dt[0]), {}
    inputs, outputs = list(runs[0].inputs), list(runs[0].outputs)
    numbers = _derived(fits, _quoted)
    unsure = [0.0] * (5 * n) + [unsure_gain(runs, path.way, name) for name in inputs] * len(outputs)
    unsure += [0.0] * (len(numbers.value) - len(unsure))
    numbers = widened(numbers, digits_of(fits[0]), np.array(unsure))
    tau, time, zeta, pole, turn = np.arange(5 * n).reshape(5, n)
    slow = [i for i in np.argsort(-numbers.value[time]) if numbers.value[turn[i]] >= 0.0]
    endless = False  # a pole is compatible with 1, so that gains are with infinity
    for number, i in enumerate(slow, start=1):
        around = numbers.value[turn[i]] * step
        if around < 1e-9:
            said[f"tau{number}"] = lag = _lag(numbers, tau[i], pole[i], step)
            endless |= lag.interval_95 is not None and np.isinf(lag.interval_95[1])
        elif around > np.pi - 1e-9:  # on the negative axis: a sign from sample to sample
            said[f"pole{number}"] = quantity(numbers, pole[i], PURE)
        else:
            said[f"T{number}"] = period = _period(quantity(numbers, time[i], TIME))
            endless |= not period.determined
            said[f"zeta{number}"] = quantity(numbers, zeta[i], PURE)
    gains: dict[str, list[str]] = {name: [] for name in inputs}
    for i, (output, name) in enumerate(product(outputs, inputs), start=5 * n):
        words = [output] * (len(outputs) > 1) + [name] * (len(inputs) > 1)
        gains[name].append("_".join(["K", *words]))
        said[gains[name][-1]] = quantity(numbers, i, GAIN)
    for i, output in enumerate(outputs if offset else (), start=5 * n + len(inputs) * len(outputs)):
        label = "level" if len(outputs) == 1 else f"level_{output}"
        said[label] = quantity(numbers, i, "output")
    if endless:
        said = {n: q.open() if q.unit in (GAIN, "output") else q for n, q in said.items()}
    return said, gains


def _period(found: Quantity) -> Quantity:
    """T of a pair of poles; a limit where 1/T², by which gains at rest divide, may be 0 by 95 %."""
    if not found.determined or found.value > 2.0 * NORMAL_REACH * found.error:
        return found
    most = 1.0 + 2.0 * ndtri(SINGLE_END) * found.error / found.value  # of 1/T²
    return replace(found.open(), interval_95=(found.value / np.sqrt(most), np.inf))


def _lag(numbers: Derived, i: int, pole: int, step: float) -> Quantity:
    """A time constant; a limit where its pole is compatible with 1 or with 0, by 95 %.

    What readings see hangs on the pole, which tells both limits from a lag; on the lag itself it
    bends.
    """
    found, at, error = quantity(numbers, i, TIME), numbers.value[pole], numbers.error[pole]
    low, high = at + NORMAL_REACH * error * np.array([-1.0, 1.0])
    if low > 0.0 and high < 1.0:
        return found
    zero, endless = low <= 0.0, high >= 1.0
    end = at + ndtri(SINGLE_END) * error * (1.0 if zero else -1.0)
    if (zero and endless) or not 0.0 < end < 1.0:
        return found.open()
    lag = -step / np.log(end)
    return replace(found.open(), interval_95=(0.0, lag) if zero else (lag, np.inf))


def _taylor(model: Any, course: Course) -> jax.Array:
    """A and B of states that are the outputs without noise, in the units of the record."""
    p = model["p"]
    a, b, c, _, _ = course.system.matrices(p)
    (_, size_u), (_, size_y) = (p["units"][kind] for kind in "uy")
    to = size_y[:, None] * c
    return jnp.column_stack([to @ a @ jnp.linalg.inv(to), to @ b[:, : len(size_u)] / size_u])


def _matrices(fits: Sequence[Begun], n: int) -> dict[str, Any]:
    """A, B, C, D in the units of the record, for inputs less their mean.

    Of as many states as outputs, all of which are read, also the first terms of report eq 2 with
    errors: the states are the outputs, so that no change of basis is open.
    """
    case, more = fits[0].case, {}
    if n == len(case.seen):
        read = _derived(fits, _taylor)
        ends = {"A": slice(n), "B": slice(n, None)}
        more["outputs_as_states"] = {
            name + said: part[:, ends[name]] for name in ends
            for said, part in (("", read.value), ("_error", read.error))
        }  # fmt: skip
    p = fits[0].settled.fit.model["p"]
    a, b, c, d, _ = map(np.asarray, case.courses[0].system.matrices(p))
    (mean_u, size_u), (mean_y, size_y) = (np.asarray(p["units"][kind]) for kind in "uy")
    by, m = size_y[:, None], len(mean_u)
    return {
        "step_s": float(case.courses[0].dt[0]), "input_mean": mean_u, "A": a,
        "B": b[:, :m] / size_u, "C": by * c, "D": by * d[:, :m] / size_u,
        "state_offset": b[:, m:].sum(1), "output_offset": mean_y + size_y * d[:, m:].sum(1),
    } | more  # fmt: skip
