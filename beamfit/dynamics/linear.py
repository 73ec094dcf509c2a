"""Linear state spaces, and ones with a network, of an order found from the runs.

States are the directions of past inputs and outputs that predict the future best. Fits of rising
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

from beamfit.dynamics.answer import GAIN, PURE, TIME, derive_quantities, quantity_at, widen_errors
from beamfit.dynamics.bad_readings import answer_without_bad_readings
from beamfit.dynamics.checks import digit_covariance
from beamfit.dynamics.fit import MAPS
from beamfit.dynamics.limits import ONE_SIDED
from beamfit.dynamics.model import WEIGHT_PRIOR
from beamfit.dynamics.paths import Path, Paths
from beamfit.dynamics.record import (
    Run,
    Way,
    band_limited,
    check_inputs,
    check_runs,
    gain_error_share,
)
from beamfit.dynamics.search import (
    MAX_DRIFT_DEGREE,
    MAX_NOISE_READINGS,
    MIN_DELAY_GAIN,
    TINY,
    Case,
    RunsFit,
    bic_of,
    drift_polynomials,
    effective_parameters,
    fit_correlated_noise,
    fit_in_rounds,
    noise_posterior,
)
from beamfit.dynamics.state_fit import (
    MAX_SQUARES_RATIO,
    Course,
    StatesFit,
    fit_with_drift,
    start_model,
    states_answer,
    states_case,
)
from beamfit.dynamics.states import Matrices, contraction, linear_outputs
from beamfit.errors import InputError, nearest
from beamfit.greybox.fit import Derived
from beamfit.greybox.problem import Free, Prior
from beamfit.noise.correlated import CENTRAL, reach_of_probability
from beamfit.noise.memory import CorrelatedNoise, remembers
from beamfit.quantity import NORMAL_REACH, Quantity

# Regression of the future on the past: largest number of samples of each, and of rows. Chosen.
MAX_HORIZON = 20
MAX_ROWS = 20_000
# Strides through the samples, for slow responses, and smallest number of rows with a stride.
# Chosen.
STRIDES = (1, 5, 25, 125)
MIN_ROWS = 100


class Linear:
    """x+ = a x + b u, y = c x + d u in scaled units, stable for all values of its numbers.

    The model's p has ``z`` and ``around`` (`beamfit.dynamics.states.contraction`), ``c``, ``d``,
    and ``units``, the means and sizes of inputs and outputs. A last input of 1 gives the offsets:
    an offset of the outputs alone would be unbounded where the process integrates.
    """

    def run(self, p: Any, u: Any, dt: Any, x0: Any) -> tuple[jax.Array, jax.Array]:
        """Give the outputs at the samples and the state after the last."""
        y, last = linear_outputs(self.linear(p), self.scaled(p, u), x0)
        return y * p["units"]["y"][1] + p["units"]["y"][0], last

    def scaled(self, p: Any, u: Any) -> jax.Array:
        """Scale the inputs, and add the input 1 if there are offsets."""
        u = (u - p["units"]["u"][0]) / p["units"]["u"][1]
        return jnp.pad(u, ((0, 0), (0, p["z"].shape[1] - u.shape[1])), constant_values=1.0)

    def linear(self, p: Any) -> Matrices:
        """Matrices of the linear part."""
        return Matrices(*contraction(p["z"], p["around"]), p["c"], p["d"], jnp.zeros(len(p["c"])))

    matrices = linear


class LinearWithNetwork(Linear):
    """The linear system with steps * out @ tanh(inside @ (x/sizes, u)) added to the next state."""

    def run(self, p: Any, u: Any, dt: Any, x0: Any) -> tuple[jax.Array, jax.Array]:
        """Give the outputs at the samples and the state after the last."""
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
        """Linearise about the state at rest under the mean inputs."""
        linear, (n, m), net = self.linear(p), p["z"].shape, p["net"]

        def after(x, u):
            inside = net["inside"] @ jnp.concatenate([x / p["sizes"], u])
            return linear.a @ x + linear.b @ u + p["steps"] * (net["out"] @ jnp.tanh(inside))

        x, mean = jnp.zeros(n), jnp.zeros(m).at[p["units"]["u"].shape[1] :].set(1.0)
        for _ in range(20):  # Newton steps
            slope = jnp.eye(n) - jax.jacfwd(after)(x, mean)
            x = x + jnp.linalg.solve(slope, after(x, mean) - x)
        a, b = jax.jacfwd(after, (0, 1))(x, mean)
        shift = (x - a @ x - b @ mean)[:, None] * mean  # so that this state is at rest
        return linear._replace(a=a, b=b + shift)


LINEAR, NETWORK = Linear(), LinearWithNetwork()


def realisations(
    u: list[np.ndarray], y: list[np.ndarray], order: int
) -> Iterator[tuple[np.ndarray, ...]]:
    """Find linear systems of an order from runs, one for each stride the runs are long enough for.

    Parameters
    ----------
    u, y : list of array, shape (samples, m) and (samples, k)
        Inputs and outputs of each run, in units of their scatter, without gaps.
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
        if stride > 1 and longest < stride * MIN_ROWS:
            return
        # An input that changes within a stride enters with its mean.
        mean = [each[: len(each) // stride * stride].reshape(-1, stride, each.shape[1]).mean(1)
                for each in u]  # fmt: skip
        read = [each[::stride][: len(v)] for each, v in zip(y, mean, strict=True)]
        for degree in (0, MAX_DRIFT_DEGREE):
            found = _regress(mean, read, order, degree)
            if found is not None and (a := _sample_matrix(found[0], stride, longest)) is not None:
                held = sum(np.linalg.matrix_power(a, i) for i in range(stride))
                yield a, np.linalg.lstsq(held, found[1], rcond=1e-10)[0], *found[2:]


def first_lag(u: list[np.ndarray], y: list[np.ndarray]) -> int:
    """Number of samples before each output at which inputs first act, by the information criterion.

    Outputs are regressed on earlier outputs, earlier inputs, and a drift. 1 if no lag acts or the
    runs are too short.
    """
    (m, k), count = (u[0].shape[1], y[0].shape[1]), sum(map(len, y))
    horizon = min(count // (8 * (m + k)), MAX_HORIZON)
    rows = _regression_rows(u, y, horizon, MAX_DRIFT_DEGREE) if horizon > 1 else []
    if not rows:
        return 1
    past, *_, now = rows
    lags = past.reshape(len(past), horizon, k + m)  # from the longest to 1
    outputs, inputs = lags[..., :k].reshape(len(past), -1), lags[..., k:].reshape(len(past), -1)
    triangle = np.linalg.qr(np.hstack([outputs, inputs, now]), mode="r")
    # With lags of the inputs from 1, 2, … on, and without.
    used = outputs.shape[1] + m * np.arange(horizon, -1, -1)
    squares = np.array([np.sum(triangle[n:, -k:] ** 2, axis=0) for n in used])
    cost = len(now) * np.log(np.maximum(squares, TINY)).sum(axis=1)
    return 1 + int(np.argmin(cost + np.log(len(now)) * k * used)) % horizon


def _sample_matrix(a: np.ndarray, stride: int, longest: int) -> np.ndarray | None:
    """Take the root of a stride's matrix, for one sample, with its poles inside the unit circle.

    None if there is no real root.
    """
    values, vectors = np.linalg.eig(a)
    limit = np.exp(-stride / (1000.0 * longest))
    values = values * np.minimum(1.0, limit / np.maximum(np.abs(values), 1e-12))
    if stride > 1 and np.any((np.abs(values.imag) < 1e-9) & (values.real <= 0)):
        return None
    root = ((vectors * values ** (1.0 / stride)) @ np.linalg.pinv(vectors)).real
    return root if np.isfinite(root).all() else None


def _regress(
    u: list[np.ndarray], y: list[np.ndarray], order: int, degree: int
) -> tuple[np.ndarray, ...] | None:
    """Find a system by regression, together with drifts of a degree."""
    m, k = u[0].shape[1], y[0].shape[1]
    count = sum(map(len, y))
    horizon = int(np.clip(count // (4 * (m + k) + 4 * m), order // k + 2, MAX_HORIZON))
    rows = _regression_rows(u, y, horizon, degree)
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


def _regression_rows(
    u: list[np.ndarray], y: list[np.ndarray], horizon: int, degree: int
) -> list[np.ndarray]:
    """Rows of past, past one sample later, future, future inputs, present inputs, present outputs.

    A drift of the degree is removed in each run; runs that are too short give no rows.
    """
    found = []
    for inputs, outputs in zip(u, y, strict=True):
        both, count = np.hstack([outputs, inputs]), len(outputs) - 2 * horizon
        if count < 2:
            continue
        at = np.arange(horizon, horizon + count, max(1, count // MAX_ROWS))
        polynomials = np.column_stack([np.ones(len(at)), drift_polynomials(at / len(outputs))])
        drift = np.linalg.qr(polynomials[:, : degree + 1 if degree else 0])[0]
        parts = ((both, -horizon, 0), (both, 1 - horizon, 1), (outputs, 0, horizon),
                 (inputs, 0, horizon), (inputs, 0, 1), (outputs, 0, 1))  # fmt: skip
        windows = [np.concatenate([of[at + k] for k in range(begin, end)], axis=1)
                  for of, begin, end in parts]  # fmt: skip
        found.append([each - drift @ (drift.T @ each) for each in windows])
    return [np.concatenate(each) for each in zip(*found, strict=True)]


def normal_form(
    a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change the states of a stable system so that a aᵀ + b bᵀ = 1.

    Returns
    -------
    tuple of array
        `around` of `beamfit.dynamics.states.contraction`, shape (n + m, n + m), c, and the matrix
        from the old states to the new ones.
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
    around[:n] = left @ right[:n]  # nearest orthonormal rows
    return around, c @ back, to


# Largest order that is searched, order of the fit that bad readings are judged against, and number
# of orders without improvement that ends the search. Chosen.
MAX_ORDER = 10
SCREENING_ORDER = 4
MAX_WORSE_ORDERS = 2
# Starts that are searched for each order, the best predictors; readings needed for each free
# number. Chosen.
STARTS_PER_ORDER = 2
MIN_READINGS_PER_NUMBER = 3
# Pole of a state added to an order, and its weight in the output. Chosen.
NEW_POLE = 0.6
NEW_WEIGHT = 1e-3


class TriedOrder(NamedTuple):
    """Fit of an order, with or without a direct path from inputs to outputs."""

    order: int
    direct: bool
    runs_fit: RunsFit
    bic: float = np.nan


def reading_count(case: Case) -> int:
    """Number of readings."""
    return sum(len(m) for s in case.prepared for m in s.measured)


def largest_order(case: Case) -> int:
    """Largest order that leaves `MIN_READINGS_PER_NUMBER` readings for each free number."""
    k, m = len(case.prepared), len(case.prepared[0].inputs)
    return int(
        (reading_count(case) / MIN_READINGS_PER_NUMBER - k * (m + 1)) / (m + k + len(case.courses))
    )


class _OrderFits(NamedTuple):
    """Orders that were tried, the best first, and the probable fits."""

    tried: tuple[TriedOrder, ...]
    fits: list[RunsFit]


class StatesSearch(NamedTuple):
    """Settings of an identification.

    `order` is the given number of states or None, `offset` True if the outputs at rest are free,
    `hidden` and `seeds` the nodes and seeds of a network, `held` the held-out runs.
    """

    order: int | None
    paths: Paths
    offset: bool
    map: str
    hidden: int
    seeds: range
    held: tuple[Run, ...]

    @property
    def default_delay(self) -> float:
        """Given delay, or 0, in samples."""
        return min(self.paths.delays, key=abs)

    def delay(self, runs: tuple[Run, ...]) -> float:
        """Delay in samples from the first lag of the inputs; 0 for smooth inputs."""
        if self.paths.given or band_limited(runs):
            return self.default_delay
        case = states_case(runs, LINEAR, (), (), Path(None, self.paths.ways[-1], 0.0))
        first = first_lag(*_scaled(case, _units(case, True), False)) - 1
        return min(float(first), self.paths.delays[-1])

    def identify(self, runs: tuple[Run, ...]) -> _OrderFits:
        """Fit orders with the delay of the first lag, unless no delay is nearly as good.

        Inputs are taken at their levels where the best order is better with these.
        """
        delay, way = self.delay(runs), self.paths.ways[-1]
        tried = self.orders(runs, Path(None, Way(), delay))
        if delay != self.default_delay:
            direct = Path(None, Way(), self.default_delay)
            tried = self.try_path(runs, tried, direct, 2.0 * MIN_DELAY_GAIN)
        if way.standing:
            tried = self.try_path(runs, tried, tried[0].runs_fit.path._replace(way=way), 0.0)
        constant = self.map == "constant"
        best = tried[0]
        return _OrderFits(tried, [best.runs_fit] if constant else self.fit_networks(runs, best))

    def screen(self, runs: tuple[Run, ...]) -> _OrderFits:
        """Fit the given order, or a few states, with the delay of the first lag.

        More states could fit bad readings, and the noise would look small.
        """
        path = Path(None, Way(), self.delay(runs))
        case = states_case(runs, LINEAR, (), (), path)
        n = self.order or min(SCREENING_ORDER, largest_order(case))
        return _OrderFits((), [_try_order(case, n, self.offset, True, None).runs_fit])

    def try_path(
        self, runs: tuple[Run, ...], tried: tuple[TriedOrder, ...], path: Path, margin: float
    ) -> tuple[TriedOrder, ...]:
        """Fit orders by another path, unless the best tried one is better by `margin`."""
        best, case = tried[0], states_case(runs, LINEAR, (), (), path)
        rival = _try_order(case, best.order, self.offset, best.direct, None)
        best_bic, other_bic = criterion([best.runs_fit, rival.runs_fit], best.runs_fit)
        return self.orders(runs, path) if other_bic < best_bic + margin else tried

    def orders(self, runs: tuple[Run, ...], path: Path) -> tuple[TriedOrder, ...]:
        """Fit 1, 2, … states, or the given number, best first.

        The best order is also fitted without a direct path from inputs to outputs.
        """
        case = states_case(runs, LINEAR, (), (), path)
        tried: list[TriedOrder] = []
        largest = min(MAX_ORDER, largest_order(case))
        for n in [self.order] if self.order else range(1, largest + 1):
            before = tried[-1] if tried else None
            tried.append(_try_order(case, n, self.offset, True, before))
            bics = criterion([each.runs_fit for each in tried])
            if n - tried[int(np.argmin(bics))].order >= MAX_WORSE_ORDERS:
                break
        best, last = tried[int(np.argmin(bics))], tried[-1]
        model = best.runs_fit.fit.model
        p = model["p"] | {"d": model["p"]["d"].at[:, : len(case.prepared[0].inputs)].set(0.0)}
        free = free_of(case, best.order, self.offset, False)
        bounded = best.runs_fit.case._replace(free=free)
        indirect = fit_in_rounds(bounded, [model | {"p": p}])
        tried.append(TriedOrder(best.order, False, indirect))
        bics = criterion([each.runs_fit for each in tried], last.runs_fit)
        return tuple(tried[k]._replace(bic=bics[k]) for k in np.argsort(bics, kind="stable"))

    def fit_networks(self, runs: tuple[Run, ...], best: TriedOrder) -> list[RunsFit]:
        """Fit networks added to a linear system; give the probable fits."""
        n, path = best.order, best.runs_fit.path
        free = [f for f in free_of(best.runs_fit.case, n, self.offset, best.direct)
                if f.path != "start"]  # fmt: skip
        free += [Free("start", nuisance=True), Free("p.net", nuisance=True)]
        case = states_case(runs, NETWORK, free, [Prior("p.net", 0.0, WEIGHT_PRIOR)], path)
        case = case._replace(degree=best.runs_fit.case.degree)
        nets = _networks(best, self.hidden, self.seeds)
        return probable_fits([fit_in_rounds(case, [net]) for net in nets])

    def answer(self, runs: tuple[Run, ...], found: _OrderFits, left_out: Any) -> StatesFit:
        """Judge runs whose orders were tried, best first."""
        (tried, fits), gain = found, None
        if self.map == "network":
            linear, network = criterion([tried[0].runs_fit, fits[0]], tried[0].runs_fit)
            gain = linear - network
        n, path = tried[0].order, fits[0].path
        fits = [fit_correlated_noise(fit, MAX_SQUARES_RATIO) for fit in fits]
        quantities, gains = _quantities(fits, n, runs, self.offset)
        rows = [{"order": t.order, "direct": t.direct, "bic": t.bic}
                for t in sorted(tried, key=lambda t: (not t.direct, t.order))]  # fmt: skip
        more = {"delay_samples": int(path.delay), "tried": rows, "matrices": _matrices(fits, n)}
        options = {"map": self.map, "gain": gain, "order": n, "given": self.paths.given}
        options |= {"held": self.held, "left_out": left_out, "by_input": gains, "more": more}
        return states_answer(fits[0], runs, quantities, **options)


def criterion(tried: Sequence[RunsFit], last: RunsFit | None = None) -> list[float]:
    """Bayesian information criterion of fits under the noise of the last, with its correlation.

    Readings that all fits have count: with a longer delay they begin later.
    """
    noise = _residual_noise(last or tried[-1])
    lengths = [[len(r) for row in each.residuals for r in row] for each in tried]
    return [bic_of(each, noise, np.min(lengths, axis=0)) for each in tried]


def _residual_noise(found: RunsFit) -> CorrelatedNoise | None:
    """Correlated noise of residuals, None for white ones. Slopes are left out for speed."""
    rows = found.case.residual_rows(found.residuals, found.noise)
    used = effective_parameters(found.fit)
    if not any(remembers(r / error, used) for r, error, *_ in rows):
        return None
    scaled = [(r / error)[:MAX_NOISE_READINGS, None] for r, error, *_ in rows]
    times = [time[:MAX_NOISE_READINGS] for _, _, time, _ in rows]
    return noise_posterior(scaled, times, np.zeros((0, 1)))[1]


def free_of(case: Case, order: int, offset: bool, direct: bool) -> tuple[Free, ...]:
    """Free numbers of a model; those of a direct path are held at 0 if there is none."""
    m, start = len(case.prepared[0].inputs), np.ones((len(case.courses), order), bool)
    path_on = np.full((len(case.prepared), m + offset), direct)
    path_on[:, m:] = True
    start[0] = not offset  # the offsets give the start of the first run
    bounded = [Free(name, np.where(on, -np.inf, 0.0), np.where(on, np.inf, 0.0), nuisance=True)
            for name, on in (("p.d", path_on), ("start", start))]  # fmt: skip
    return Free("p.z", nuisance=True), Free("p.c", nuisance=True), *bounded


def _try_order(
    case: Case, n: int, offset: bool, direct: bool, before: TriedOrder | None
) -> TriedOrder:
    """Fit an order from its best realisations and from the order before with one more state."""
    bounded = case._replace(free=free_of(case, n, offset, direct))
    units, k = _units(case, offset), len(case.prepared)
    u, y = _scaled(case, units, offset)
    m, zero = u[0].shape[1], np.zeros((len(y), n))

    def model(a, b, c, d, start=zero):
        around, c, to = normal_form(a, b, c)
        d = np.where(direct | (np.arange(m) >= m - offset), d, 0.0)
        p = {"z": np.zeros((n, m)), "around": around, "c": c, "d": d, "units": units}
        return {"p": p, **start_model(start @ to.T, k)}

    drifting = case._replace(degree=MAX_DRIFT_DEGREE)

    def best(models):
        squares = [_residual_squares(drifting, each) for each in models]
        return [models[i] for i in np.argsort(squares, kind="stable") if np.isfinite(squares[i])]

    models = best([model(*found) for found in realisations(u, y, n)])[:STARTS_PER_ORDER]
    if before is not None:
        last = before.runs_fit.fit.model
        a, b, c, d, _ = map(np.asarray, LINEAR.matrices(last["p"]))
        a = np.diag([*np.zeros(len(a)), NEW_POLE]) + np.pad(a, ((0, 1), (0, 1)))
        b, c = np.vstack([b, np.ones(m)]), np.hstack([c, np.full((k, 1), NEW_WEIGHT)])
        start = np.pad(np.asarray(last["start"]), ((0, 0), (0, 1)))
        models = best([*models, model(a, b, c, d, start)])
    if not models:  # runs too short for a regression
        a = np.diag(NEW_POLE ** np.arange(1.0, n + 1))
        models = [model(a, np.ones((n, m)), np.full((k, n), NEW_WEIGHT), np.zeros((k, m)))]
    return TriedOrder(n, direct, fit_with_drift(bounded, models))


def _residual_squares(case: Case, model: Any) -> float:
    """Sum of squared residuals of a model after the best drifts and levels of the runs."""
    residuals = case.residuals(case.with_best_drift(model))
    return case.normalised_squares([[r - r.mean() for r in row] for row in residuals])


def _units(case: Case, offset: bool) -> dict[str, np.ndarray]:
    """Mean and size of inputs and outputs; without an offset the means are 0."""
    prepared = case.prepared[0]
    y = np.array([np.mean(np.concatenate(s.measured)) for s in case.prepared])
    return {
        "u": np.stack([offset * prepared.mean_u, prepared.input_scale]),
        "y": np.stack([offset * y, [s.output_scale for s in case.prepared]]),
    }


def _scaled(
    case: Case, units: dict[str, np.ndarray], offset: bool
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Scaled inputs (with a 1) and outputs of the runs, missing readings interpolated."""
    u, y = [], []
    for i, run in enumerate(case.prepared[0].runs):
        count = int(np.count_nonzero(np.asarray(run.dt))) + 1
        each = (np.asarray(run.u)[:count] - units["u"][0]) / units["u"][1]
        u.append(np.pad(each, ((0, 0), (0, int(offset))), constant_values=1.0))
        read = [np.interp(np.arange(count), s.runs[i].read, s.measured[i])
                for s in case.prepared]  # fmt: skip
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
        Number of states. Found by the Bayesian information criterion if None: 1, 2, … until two
        further ones are no better, 10 at most.
    map : {"constant", "network"}
        With ``"network"`` the next state has a network of state and inputs added.
    delay : int, optional
        Samples by which the outputs follow the inputs; found together with the order if None.
        Negative where the clocks of inputs and outputs differ.
    offset : bool
        True if the outputs at rest are free numbers; else they are 0 for inputs of 0.
    hidden, starts, seed : int
        Hidden nodes of the network, starts of its training, seed of their weights. Errors contain
        how far apart the starts end.
    held : sequence of Run
        Held-out runs, which are only predicted.

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
    uses the correlated noise of the largest order tried: a drift is no reason for a further
    state. L. Ljung, System Identification (1999), chapters 4 and 16.

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
    runs, held = check_runs(runs, held, True)
    check_inputs(runs)
    given = None if delay is None else float(delay)
    case = states_case(runs, LINEAR, (), ())
    most = largest_order(case)
    if not 1 <= (order or 1) <= most:
        expected = f"1 to {most}" if most >= 1 else "a longer run, or another --model"
        raise runs[0].unusable(f"order {order or 1} with {reading_count(case)} readings", expected)
    seeds = range(seed, seed + starts)
    search = StatesSearch(order, Paths.of(runs, given, True), offset, map, hidden, seeds, held)
    searches = search.screen, search.identify
    return answer_without_bad_readings(runs, searches, lambda found: found.fits[0], search.answer)


def probable_fits(found: Sequence[RunsFit]) -> list[RunsFit]:
    """The best of several ends of a search, and those that are as probable as draws about it.

    Draws from the posterior about an optimum of p numbers exceed its -2 ln L by a chi-square of p
    degrees of freedom, p in the mean. An end within this distance is another part of the posterior.
    """
    bics = np.array(criterion(found, min(found, key=lambda each: each.cost)))
    best, *others = np.argsort(np.where(np.isfinite(bics), bics, np.inf))
    limit = bics[best] + effective_parameters(found[best].fit)
    return [found[best], *(found[i] for i in others if bics[i] <= limit)]


def _derive_jointly(fits: Sequence[RunsFit], function: Any) -> Derived:
    """Derive numbers from the best fit, with errors that hold 68 % of the posterior of all fits.

    All fits count equally: the posterior of a network is curved, and each shows a part of it.
    """
    course = fits[0].case.courses[0]
    each = [derive_quantities(f.fit, f.errors, function, course) for f in fits]
    if len(each) == 1:
        return each[0]
    values, errors = (np.stack([getattr(one, name) for one in each]) for name in ("value", "error"))
    return each[0]._replace(error=joint_error(values, errors))


def joint_error(values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Distance from the first value within which 68 % of several equally weighted normals lie.

    Parameters
    ----------
    values, errors : array, shape (fits, ...)
        Values and errors of a quantity, one fit along the first axis; NaN if not determined.

    Returns
    -------
    array, shape (...)
        NaN where the first error is NaN, or more than 32 % of them.

    Examples
    --------
    >>> joint_error(np.array([3.0, 3.0]), np.array([0.5, 0.5])).round(6).item()
    0.5
    >>> joint_error(np.array([0.0, 1.0]), np.array([0.1, 0.1])).round(2).item()
    0.97
    """
    finite, deviation = np.isfinite(errors), values - values[0]
    spread = np.where(finite, np.maximum(errors, np.finfo(float).tiny), np.inf)

    def within(reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        above, below = (reach - deviation) / spread, (-reach - deviation) / spread
        slope = (np.exp(-0.5 * above**2) + np.exp(-0.5 * below**2)) / (np.sqrt(2 * np.pi) * spread)
        return np.mean(ndtr(above) - ndtr(below), axis=0), np.mean(slope, axis=0)

    widest = np.max(np.where(finite, np.abs(deviation) + errors, 0.0), axis=0)
    reach = reach_of_probability(within, widest, CENTRAL)
    return np.where(finite[0] & (finite.mean(axis=0) > CENTRAL), reach, np.nan)


def _networks(best: TriedOrder, hidden: int, seeds: range) -> list[dict[str, Any]]:
    """Models with networks of small random weights added to the linear part."""
    model = best.runs_fit.fit.model
    p, (n, m) = model["p"], model["p"]["z"].shape
    states_out = LINEAR.linear(p)._replace(c=jnp.eye(n), d=jnp.zeros((n, m)), offset=jnp.zeros(n))
    run = jax.jit(lambda u, x0: linear_outputs(states_out, u, x0)[0])
    x = [np.asarray(run(LINEAR.scaled(p, c.u), model["start"][i]))
         for i, c in enumerate(best.runs_fit.case.courses)]  # fmt: skip
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


def _quoted_values(model: Any, course: Course) -> jax.Array:
    """Tau, T, zeta, value and frequency of each pole; static gains; outputs at the mean inputs."""
    p, units = model["p"], model["p"]["units"]
    a, b, c, d, _ = course.system.matrices(p)
    m, size = units["u"].shape[1], units["y"][1]
    poles = jnp.linalg.eigvals(a)
    poles = poles[jnp.lexsort((poles.imag, -jnp.abs(poles)))]  # the same order for all fits
    s = jnp.log(poles) / course.dt[0]
    gains = size[:, None] * (d + c @ jnp.linalg.solve(jnp.eye(len(a)) - a, b))
    parts = [-1.0 / s.real, 1.0 / jnp.abs(s), -s.real / jnp.abs(s), poles.real, s.imag]
    levels = (units["y"][0][:, None] + gains[:, m:]).ravel()
    return jnp.concatenate([*parts, (gains[:, :m] / units["u"][1]).ravel(), levels])


def _quantities(
    fits: Sequence[RunsFit], n: int, runs: Sequence[Run], offset: bool
) -> tuple[dict[str, Quantity], dict[str, list[str]]]:
    """Time constants from the slowest, gains and levels; and the names of each input's gains."""
    course, path = fits[0].case.courses[0], fits[0].path
    step, quantities = float(course.dt[0]), {}
    inputs, outputs = list(runs[0].inputs), list(runs[0].outputs)
    numbers = _derive_jointly(fits, _quoted_values)
    shares = [gain_error_share(runs, path.way, name) for name in inputs]
    input_errors = [0.0] * (5 * n) + shares * len(outputs)
    input_errors += [0.0] * (len(numbers.value) - len(input_errors))
    numbers = widen_errors(numbers, digit_covariance(fits[0]), np.array(input_errors))
    tau, modulus, zeta, pole, frequency = np.arange(5 * n).reshape(5, n)
    order = [i for i in np.argsort(-numbers.value[modulus]) if numbers.value[frequency[i]] >= 0.0]
    infinite = False  # a pole may be 1, so that gains may be infinite
    for number, i in enumerate(order, start=1):
        angle = numbers.value[frequency[i]] * step
        if angle < 1e-9:
            quantities[f"tau{number}"] = lag = _lag_quantity(numbers, tau[i], pole[i], step)
            infinite |= lag.interval_95 is not None and np.isinf(lag.interval_95[1])
        elif angle > np.pi - 1e-9:  # on the negative axis: a sign from sample to sample
            quantities[f"pole{number}"] = quantity_at(numbers, pole[i], PURE)
        else:
            quantities[f"T{number}"] = period = _period_quantity(
                quantity_at(numbers, modulus[i], TIME)
            )
            infinite |= not period.determined
            quantities[f"zeta{number}"] = quantity_at(numbers, zeta[i], PURE)
    gains: dict[str, list[str]] = {name: [] for name in inputs}
    for i, (output, name) in enumerate(product(outputs, inputs), start=5 * n):
        parts = [output] * (len(outputs) > 1) + [name] * (len(inputs) > 1)
        gains[name].append("_".join(["K", *parts]))
        quantities[gains[name][-1]] = quantity_at(numbers, i, GAIN)
    for i, output in enumerate(outputs if offset else (), start=5 * n + len(inputs) * len(outputs)):
        label = "level" if len(outputs) == 1 else f"level_{output}"
        quantities[label] = quantity_at(numbers, i, "output")
    if infinite:
        quantities = {
            n: q.open() if q.unit in (GAIN, "output") else q for n, q in quantities.items()
        }
    return quantities, gains


def _period_quantity(found: Quantity) -> Quantity:
    """T of a pair of poles; a limit where 1/T², which gains are divided by, may be 0."""
    if not found.determined or found.value > 2.0 * NORMAL_REACH * found.error:
        return found
    most = 1.0 + 2.0 * ndtri(ONE_SIDED) * found.error / found.value  # of 1/T²
    return replace(found.open(), interval_95=(found.value / np.sqrt(most), np.inf))


def _lag_quantity(numbers: Derived, i: int, pole: int, step: float) -> Quantity:
    """Time constant of a real pole; a limit where the pole may be 1 or 0 by 95 %.

    The output is nearly linear in the pole but not in the time constant, so the limits come from
    the pole.
    """
    found, at, error = quantity_at(numbers, i, TIME), numbers.value[pole], numbers.error[pole]
    low, high = at + NORMAL_REACH * error * np.array([-1.0, 1.0])
    if low > 0.0 and high < 1.0:
        return found
    zero, infinite = low <= 0.0, high >= 1.0
    end = at + ndtri(ONE_SIDED) * error * (1.0 if zero else -1.0)
    if (zero and infinite) or not 0.0 < end < 1.0:
        return found.open()
    lag = -step / np.log(end)
    return replace(found.open(), interval_95=(0.0, lag) if zero else (lag, np.inf))


def _output_state_matrices(model: Any, course: Course) -> jax.Array:
    """A and B for states that are the noise-free outputs, in the units of the record."""
    p = model["p"]
    a, b, c, _, _ = course.system.matrices(p)
    (_, size_u), (_, size_y) = (p["units"][kind] for kind in "uy")
    to = size_y[:, None] * c
    return jnp.column_stack([to @ a @ jnp.linalg.inv(to), to @ b[:, : len(size_u)] / size_u])


def _matrices(fits: Sequence[RunsFit], n: int) -> dict[str, Any]:
    """A, B, C, D in the units of the record, for inputs less their mean.

    With as many states as outputs, also the first terms of report eq 2 with errors: the states are
    then the outputs, so that no change of basis is free.
    """
    case, more = fits[0].case, {}
    if n == len(case.prepared):
        read = _derive_jointly(fits, _output_state_matrices)
        ends = {"A": slice(n), "B": slice(n, None)}
        more["outputs_as_states"] = {
            name + suffix: part[:, ends[name]] for name in ends
            for suffix, part in (("", read.value), ("_error", read.error))
        }  # fmt: skip
    p = fits[0].fit.model["p"]
    a, b, c, d, _ = map(np.asarray, case.courses[0].system.matrices(p))
    (mean_u, size_u), (mean_y, size_y) = (np.asarray(p["units"][kind]) for kind in "uy")
    by, m = size_y[:, None], len(mean_u)
    return {
        "step_s": float(case.courses[0].dt[0]), "input_mean": mean_u, "A": a,
        "B": b[:, :m] / size_u, "C": by * c, "D": by * d[:, :m] / size_u,
        "state_offset": b[:, m:].sum(1), "output_offset": mean_y + size_y * d[:, m:].sum(1),
    } | more  # fmt: skip
