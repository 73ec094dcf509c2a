"""A table of lifetimes against current: a, b and the same verdicts as of a decay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import least_squares
from scipy.special import chdtrc, expit, fdtrc, gammaln, logsumexp, ndtri, stdtr, stdtrit

from beamfit.answer import Table, answer, json_of, labelled, plain_name
from beamfit.errors import expect
from beamfit.lifetime.alternatives import CURRENTS, ConstantA, LifetimeLaw, constant_a
from beamfit.lifetime.answer import TableEvidence, finding_of_table
from beamfit.lifetime.evidence import EXACT, UNITS
from beamfit.lifetime.fit import bare, headline_of, loss_json
from beamfit.lifetime.free_law import (
    DRIFT,
    MAX_EXPONENT,
    MIN_EXPONENT,
    MIN_NOISE,
    NEGLIGIBLE_LOG,
    UNPHYSICAL_ODDS,
    UNPHYSICAL_SHARES,
    FreeLaw,
    Law,
    at_bounds,
    log_exponent_prior,
    partial_loss,
    weighted_quantity,
)
from beamfit.lifetime.record import LifetimeTable
from beamfit.noise.memory import STATED_READINGS
from beamfit.quantity import HOUR, Quantity, Status
from beamfit.statistics import POOR_FIT, chi2_probability, reach_of

# Prior probability that a point of a table is bad; it is then off by 1 to MAX_BAD_ERRORS errors,
# flat in the logarithm.
P_BAD, MAX_BAD_ERRORS = 0.03, 1000.0
# Largest share of the points that is left out.
MAX_LEFT_OUT = 0.2
# Points closer to the law of the others than this many errors are good without a comparison.
MIN_BAD_ERRORS = 3.0
# Exponents of a with which that law is looked for.
TRIAL_EXPONENTS = np.linspace(MIN_EXPONENT, MAX_EXPONENT, 30)
# Points of the running median that replaces a slip of the unit or a digit in the weights.
MEDIAN_POINTS = 5
# Prior probability that stated errors are wrong by a common factor (chosen: one table in five),
# which then has the inverse χ² prior about 1 of one reading.
P_WRONG, WRONG_READINGS = 0.2, 1.0
# Smallest loss rate of a trial law, over that of the median lifetime.
MIN_RATE = 1e-6
# Ratio of singular values below which points do not determine a combination of a and b.
RANK_TOLERANCE = 1e-10
# Nodes of the integral over the share of a, the exponent and the change of b.
SHARE_NODES, EXPONENT_NODES, CHANGE_NODES = 9, 33, 24
# Refinements of the range of exponents, iterations for the most probable share, and standard
# deviations about it that the nodes reach to.
REFINEMENTS, ITERATIONS, SHARE_REACH = 4, 12, 5.0


@answer
@dataclass(frozen=True, eq=False)
class LifetimeFit:
    """The result of `fit_lifetimes`.

    Parameters
    ----------
    record : str
        Name of the table.
    status, message
        As of `DecayFit`.
    a, b, lifetime_start, lifetime_mean, lifetime_end : Quantity
        As of `DecayFit`, the lifetimes at the highest, mean and lowest current.
    mean_current, chi2, dof
        As of `DecayFit`.
    constant_a, lifetimes
        As of `DecayFit`.
    share : Quantity
        Of a in the loss at the mean current.
    outliers : tuple of int
        Points that were left out, counted from 0.
    readings : LifetimeTable
        What was fitted.
    free_law : FreeLaw or None
        Posterior with an exponent of a and a change of b, which the errors contain; None where the
        law is known.
    """

    record: str
    status: Status
    message: str
    a: Quantity
    b: Quantity
    lifetime_start: Quantity
    lifetime_mean: Quantity
    lifetime_end: Quantity
    mean_current: float
    chi2: float
    dof: int
    constant_a: ConstantA
    lifetimes: LifetimeLaw | None
    share: Quantity
    outliers: tuple[int, ...]
    readings: LifetimeTable
    free_law: FreeLaw | None = None

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Quoted quantities, by name."""
        return {name: getattr(self, name) for name in UNITS if name != "i0"}

    @property
    def headline(self) -> str:
        """The answer in a line."""
        return headline_of(self)

    @property
    def noise_inferred(self) -> bool:
        """True if the table came without errors."""
        return self.readings.error is None

    @property
    def identifiability(self) -> dict[str, Any]:
        """Separability of a and b by the table, and the share of a in the loss."""
        share, error = self.share.value, self.share.error
        return {"separable": self.a.error is not None, "share": share, "share_error": error}

    def tables(self) -> tuple[Table, ...]:
        """Quoted quantities, to be shown."""
        rows = [(plain_name(name), [value]) for name, value in self.quantities.items()]
        rows.append(("share of a in the loss", [self.share]))
        tested = f"{self.chi2:.4g}/{self.dof}"
        chi2 = f"not testable ({self.dof} dof)" if self.noise_inferred else tested
        rows = [("status", [self.status]), *rows, ("chi2/dof", [chi2])]
        return (labelled("", [self.record], rows),)

    def to_json(self) -> dict[str, Any]:
        """Return the result as one JSON object, with what was left out."""
        more = {"i0": bare(None, "mA"), "outliers": self.outliers, "notes": self.readings.notes}
        more |= {} if self.free_law is None else {"free_law": self.free_law}
        return loss_json(self) | json_of(more)


def _log_norm(known: float) -> float:
    """Log normalisation of the prior of the errors' common factor: inverse χ² about 1."""
    return known / 2 * math.log(known) - float(gammaln(known / 2))


class _Points(NamedTuple):
    """Points of a table in units of the mean current and the median lifetime, with an error model.

    The errors have a common factor with an inverse χ² prior about 1, worth `known` readings, or
    flat in its logarithm (0). `log_prior` is that of the model, with this prior's normalisation.
    """

    current: np.ndarray
    lifetime: np.ndarray
    error: np.ndarray
    known: float
    log_prior: float

    @classmethod
    def of(cls, table: LifetimeTable, kept: np.ndarray) -> tuple[_Points, ...]:
        """Points of a table that are kept, with each error model.

        Stated errors are nearly right, or wrong by a common factor. Those that are not stated are
        equal, or the same share of each lifetime; the more probable model comes first.
        """
        unit = float(np.median(table.lifetime))
        x, lifetime = table.current[kept] / table.current.mean(), table.lifetime[kept] / unit
        if table.error is not None:
            error = np.maximum(table.error[kept] / unit, MIN_NOISE * lifetime)
            worth = zip((STATED_READINGS, WRONG_READINGS), (1 - P_WRONG, P_WRONG), strict=True)
            return tuple(
                cls(x, lifetime, error, known, _log_norm(known) + math.log(chance))
                for known, chance in worth
            )
        equal = cls(x, lifetime, np.ones(x.size), 0.0, 0.0)
        curve = np.maximum(lifetime + _least_squares(equal).residuals, MIN_RATE)
        models = equal, equal._replace(error=curve)
        return tuple(sorted(models, key=lambda one: -_posterior([one], Law.constant).log))


class _LeastSquares(NamedTuple):
    """Least squares of the lifetimes: loss rates to a and b at the mean current and the exponent,
    the residuals and their slopes, over the errors.
    """

    numbers: np.ndarray
    residuals: np.ndarray
    slopes: np.ndarray
    stated: bool

    @property
    def dof(self) -> int:
        """Points less numbers."""
        return self.residuals.size - self.numbers.size

    @property
    def chi2(self) -> float:
        """Sum of squares of the residuals."""
        return float(self.residuals @ self.residuals)

    @property
    def scale(self) -> float:
        """Factor on the errors: the scatter where none are stated, else at least 1."""
        return max(math.sqrt(self.chi2 / max(self.dof, 1)), float(self.stated))

    def quantity(self, value: float, slopes: Sequence[float], unit: str, size: float) -> Quantity:
        """A value in a unit of this size; `slopes` are its derivatives by the numbers."""
        _, scales, axes = np.linalg.svd(self.slopes, full_matrices=False)
        along, lost = axes @ slopes[: self.numbers.size], scales <= RANK_TOLERANCE * scales[0]
        raw = max(float(np.linalg.norm(along[~lost] / scales[~lost])), EXACT * abs(value)) * size
        raw = math.inf if np.any(np.abs(along[lost]) > RANK_TOLERANCE) else raw
        error, reach = self.scale * raw, reach_of(math.inf if self.stated else self.dof)
        return Quantity.reaching(float(value) * size, error, unit, raw, reach * error)


def _least_squares(points: _Points, exponent: bool = False) -> _LeastSquares:
    """Fit loss rates to a and b, and an exponent of a, to lifetimes."""
    x, lifetime, error = points[:3]

    def rates(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        power = x ** (1 + (numbers[2] if exponent else 0.0))
        slopes = [power, np.ones_like(x), numbers[0] * power * np.log(x)]
        rate = np.maximum(numbers[0] * power + numbers[1], MIN_RATE)
        return rate, np.column_stack(slopes[: 2 + exponent])

    def residuals(numbers: np.ndarray) -> np.ndarray:
        return (1 / rates(numbers)[0] - lifetime) / error

    def slopes(numbers: np.ndarray) -> np.ndarray:
        rate, columns = rates(numbers)
        return -columns / (rate**2 * error)[:, None]

    weight = (lifetime**2 / error)[:, None]
    columns = np.column_stack([x, np.ones_like(x)])
    start = np.linalg.lstsq(weight * columns, lifetime / error, rcond=RANK_TOLERANCE)[0]
    ends = np.array([np.inf, np.inf, 3.0])[: 2 + exponent]
    found = least_squares(
        residuals, np.append(start, [0.0] * exponent), slopes, (-ends, ends),
        x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14,
    )  # fmt: skip
    return _LeastSquares(found.x, found.fun, found.jac, points.known > 0)


class _TablePosterior(NamedTuple):
    """Nodes of a posterior, flat arrays: share of a, exponent, change of b, and the lifetime at the
    mean current over the median one; weights of sum 1; and the log evidence.
    """

    share: np.ndarray
    power: np.ndarray
    change: np.ndarray
    lifetime: np.ndarray
    weight: np.ndarray
    log: float

    def rate(self, x: float, width: float) -> np.ndarray:
        """Loss rate at a current x over the mean; `width` is the range of these currents."""
        gas = (1 - self.share) * (1 + self.change * (x - 1) / width)
        return (self.share * x ** (1 + self.power) + gas) / self.lifetime


def _shifted_midpoints(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """Midpoints of equal parts of ranges, (m, count), shifted in each range by another part of a
    step: those of all ranges together fill it evenly.
    """
    shift = np.modf(math.sqrt(2.0) * np.arange(1, low.size + 1))[0]
    parts = (shift[:, None] + np.arange(count)) / count
    return low[:, None] + parts * (high - low)[:, None]


def _share_nodes(
    points: _Points, power: np.ndarray, change: np.ndarray, bounds: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of the share of a at exponents and changes of b, (m,), the most probable lifetime at
    the mean current with its standard deviation, and log weights, each of shape (m, SHARE_NODES).

    The lifetime at the mean current is a factor on all lifetimes: at each share the integral over
    it has a closed form, as has that over the noise level.
    """
    x, lifetime, error, known = points[:4]
    gas = (1 + change[:, None] * (x - 1) / (np.ptp(x) or 1.0))[:, None]
    bend = x ** (1 + power[:, None, None]) - gas
    read, dof = lifetime / error, x.size + known - 1

    def profile(share: np.ndarray) -> tuple[np.ndarray, ...]:
        """Lifetimes over that at the mean current and over their errors, the sum of their squares,
        the most probable factor and the residual sum of squares.
        """
        shape = 1 / np.maximum(gas + share[..., None] * bend, MIN_RATE) / error
        norm = np.sum(shape**2, axis=-1)
        best = shape @ read / norm
        squares = np.sum((read - best[..., None] * shape) ** 2, axis=-1)
        return shape, norm, best, known + np.maximum(squares, x.size * EXACT**2)

    share = np.full((power.size, 1), 0.5)
    for _ in range(ITERATIONS):
        shape, norm, best, squares = profile(share)
        slope = -best[..., None] * shape**2 * error * bend
        slope -= shape * (np.sum(shape * slope, axis=-1) / norm)[..., None]
        curvature = np.maximum(np.sum(slope**2, axis=-1), EXACT**2)
        step = np.sum(slope * (read - best[..., None] * shape), axis=-1) / curvature
        share = np.clip(share + step, *UNPHYSICAL_SHARES)
    far, near = SHARE_REACH * np.sqrt(squares / dof / curvature), np.clip(share, *bounds)
    low, high = np.maximum(near - far, bounds[0]), np.minimum(near + far, bounds[1])
    nodes = _shifted_midpoints(low[:, 0], high[:, 0], SHARE_NODES)
    _, norm, best, squares = profile(nodes)
    density = 1 / np.sqrt(norm) / best / (bounds[1] - bounds[0])
    log = np.log(density * (high - low) / SHARE_NODES) - dof / 2 * np.log(squares)
    return nodes, best, np.sqrt(squares / dof / norm), log


def _exponent_nodes(points: _Points, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exponents for each change of b in the range that the points allow, and the log prior
    probability of each, (m, EXPONENT_NODES).
    """
    low, high = np.full(change.size, MIN_EXPONENT), np.full(change.size, MAX_EXPONENT)
    for _ in range(REFINEMENTS):
        power = np.linspace(low, high, EXPONENT_NODES, axis=1)
        every = np.repeat(change, EXPONENT_NODES)
        log = logsumexp(_share_nodes(points, power.ravel(), every, (0.0, 1.0))[-1], axis=1)
        log = log.reshape(power.shape) + log_exponent_prior(power)[0]
        held = log > log.max(axis=1, keepdims=True) - NEGLIGIBLE_LOG
        first, last = held.argmax(axis=1), held.shape[1] - 1 - held[:, ::-1].argmax(axis=1)
        ends = np.maximum(first - 1, 0), np.minimum(last + 1, EXPONENT_NODES - 1)
        low, high = (np.take_along_axis(power, end[:, None], axis=1)[:, 0] for end in ends)
    power = _shifted_midpoints(low, high, EXPONENT_NODES)
    return power, log_exponent_prior(power)[0] + np.log((high - low) / EXPONENT_NODES)[:, None]


def _posterior(
    every: Sequence[_Points], law: Law, bounds: tuple[float, float] = (0.0, 1.0)
) -> _TablePosterior:
    """Posterior of the free or of the constant law, averaged over the error models."""
    found = [_error_model_posterior(points, law, bounds) for points in every]
    whole = float(logsumexp([one.log for one in found]))
    weight = np.concatenate([one.weight * math.exp(one.log - whole) for one in found])
    numbers = (np.concatenate(part) for part in zip(*(one[:4] for one in found), strict=True))
    return _TablePosterior(*numbers, weight, whole)


def _error_model_posterior(
    points: _Points, law: Law, bounds: tuple[float, float]
) -> _TablePosterior:
    """Posterior of the free or of the constant law with one error model."""
    change, power, prior = np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1))
    if law is Law.free:
        change = DRIFT * ndtri((np.arange(CHANGE_NODES) + 0.5) / CHANGE_NODES)
        power, prior = _exponent_nodes(points, change)
    every = np.repeat(change, power.shape[1])
    share, best, spread, log = _share_nodes(points, power.ravel(), every, bounds)
    log = log + (prior - math.log(change.size)).ravel()[:, None]
    # Student's distribution of the lifetime at each node: one draw, evenly over all nodes.
    even = np.modf(math.sqrt(3.0) * np.arange(1, log.size + 1))[0].reshape(log.shape)
    drawn = best + spread * stdtrit(points.current.size + points.known - 1, even)
    half = (points.current.size + points.known - 1) / 2
    whole = float(logsumexp(log) - np.sum(np.log(points.error)) + gammaln(half)) + points.log_prior
    whole -= (points.current.size - 1) / 2 * math.log(math.pi)
    numbers = (share, power.ravel()[:, None], every[:, None], np.maximum(drawn, MIN_RATE))
    flat = (np.broadcast_to(number, log.shape).ravel() for number in numbers)
    return _TablePosterior(*flat, np.exp(log - logsumexp(log)).ravel(), whole)


def _log_evidence(models: Sequence[_Points]) -> float:
    """Log evidence of the constant and the free law, which are equally probable."""
    return float(np.logaddexp(*(_posterior(models, law).log for law in Law)))


class _Departure(NamedTuple):
    """The point without which a law fits the others best, how far it lies off that, h, and by how
    many errors; and the residual sum of squares and degrees of freedom of the others.
    """

    point: int
    distance: float
    errors: float
    rest: float
    dof: int


def _most_deviant_point(
    table: LifetimeTable, kept: np.ndarray, exponents: np.ndarray
) -> _Departure:
    """Leave out each point in turn (R. D. Cook and S. Weisberg, Residuals and influence in
    regression, 1982, eq. 2.2.8), in the loss rates, which are linear in those to a and b.
    """
    rows = np.flatnonzero(kept)
    current, lifetime, given = table.current[rows], table.lifetime[rows], table.error is not None
    order = np.argsort(current)
    near = median_filter(lifetime[order], min(MEDIAN_POINTS, rows.size))[np.argsort(order)]
    usual = np.clip(lifetime, near / 2, 2 * near)  # a slip has the weight of its neighbours
    error = table.error[rows] if given else usual
    power, weight = (current / current.mean()) ** (1 + exponents[:, None]), usual**2 / error
    columns = np.stack([power, np.ones_like(power)], axis=-1) * weight[:, None]
    basis, rates = np.linalg.qr(columns)[0], weight / lifetime
    left = rates - (basis @ (np.swapaxes(basis, 1, 2) @ rates)[..., None])[..., 0]
    free = np.maximum(1 - np.sum(basis**2, axis=2), RANK_TOLERANCE)
    whole = np.sum(left**2, axis=1)
    without = np.maximum(whole[:, None] - left**2 / free, 0.0)
    law, worst = np.unravel_index(np.argmin(without), without.shape)
    distance = abs(float(left[law, worst] / free[law, worst] * error[worst]))
    rest, dof = float(without[law, worst]), rows.size - 3 - (exponents.size > 1)
    known = STATED_READINGS if given else 0.0
    variance = max(known + rest, rows.size * MIN_NOISE**2) / max(known + dof, 1.0)
    errors = math.sqrt(max(whole.min() - rest, 0.0) / variance)
    return _Departure(int(rows[worst]), distance, errors, rest, dof)


def _outliers(table: LifetimeTable) -> np.ndarray:
    """Points that are more probably bad than good, one at a time."""
    kept, good = np.ones(len(table), bool), None
    for _ in range(int(MAX_LEFT_OUT * len(table))):
        worst = _most_deviant_point(table, kept, TRIAL_EXPONENTS)
        if worst.errors < MIN_BAD_ERRORS:
            break
        others = kept & (np.arange(len(table)) != worst.point)
        good = _log_evidence(_Points.of(table, kept)) if good is None else good
        rest = _log_evidence(_Points.of(table, others))
        off = worst.distance / float(np.median(table.lifetime))
        bad = rest + math.log(P_BAD) - math.log(2 * math.log(MAX_BAD_ERRORS) * off)
        if good + math.log1p(-P_BAD) > bad:
            break
        kept, good = others, rest
    return ~kept


def _test_constant_a(points: _Points, plain: _LeastSquares, power: _LeastSquares) -> ConstantA:
    """Test a constant a by the fall of chi², which knows no curvature."""
    fall, dof = max(plain.chi2 - power.chi2, 0.0), max(power.dof, 1)
    if points.known:
        chance = chdtrc(1, fall / max(1.0, power.chi2 / dof))
    else:
        chance = fdtrc(1.0, dof, fall * dof / max(power.chi2, points.current.size * EXACT**2))
    exponent = power.quantity(power.numbers[2], [0.0, 0.0, 1.0], "1", 1.0)
    return constant_a(exponent.value, exponent.error, exponent.error_raw, float(chance))


def _units(table: LifetimeTable) -> tuple[float, float, dict[str, float]]:
    """Mean current, mA, median lifetime, h, and currents over the mean of the quoted lifetimes."""
    mean, current = float(table.current.mean()), table.current
    ends = {"start": current.max() / mean, "mean": 1.0, "end": current.min() / mean}
    named = {f"lifetime_{name}": float(x) for name, x in ends.items()}
    return mean, float(np.median(table.lifetime)), named


def _lifetime(found: _LeastSquares, x: float, unit: float) -> Quantity:
    """Lifetime at a current over the mean, h."""
    a, b, *power = found.numbers
    part = x ** (1 + sum(power))
    rate = max(a * part + b, MIN_RATE)
    slopes = np.array([part, 1.0, a * part * math.log(x)]) / -(rate**2)
    return found.quantity(1 / rate, slopes, "h", unit)


def _by_least_squares(table: LifetimeTable, found: _LeastSquares) -> dict[str, Quantity]:
    """Quantities of a law by least squares."""
    (a, b), (mean, unit, ends) = found.numbers[:2], _units(table)
    whole, rate = a + b, 1 / (unit * HOUR)
    quoted = {
        "a": found.quantity(a, [1.0, 0.0, 0.0], UNITS["a"], rate / mean),
        "b": found.quantity(b, [0.0, 1.0, 0.0], UNITS["b"], rate),
        "share": found.quantity(a / whole, [b / whole**2, -a / whole**2, 0.0], "1", 1.0),
    }
    return quoted | {name: _lifetime(found, x, unit) for name, x in ends.items()}


def _by_current(table: LifetimeTable, power: _LeastSquares) -> LifetimeLaw:
    """Lifetimes of the law with a as a power of the current."""
    mean, unit, _ = _units(table)
    current = np.geomspace(table.current.min(), table.current.max(), CURRENTS).tolist()
    exponent = power.quantity(power.numbers[2], [0.0, 0.0, 1.0], "1", 1.0)
    return LifetimeLaw(
        tuple(current), tuple(_lifetime(power, i / mean, unit) for i in current), exponent
    )


def _free_law(
    table: LifetimeTable, every: Sequence[_Points], plain: _LeastSquares
) -> FreeLaw | None:
    """Posterior with an exponent of a and a change of b; None where a negative a or b is more
    probable.
    """
    found, constant = (_posterior(every, law) for law in (Law.free, Law.constant))
    if not np.all(plain.numbers[:2] >= 0):
        rival = _posterior(every, Law.constant, UNPHYSICAL_SHARES)
        if rival.log + math.log(UNPHYSICAL_ODDS) > found.log:
            return None
    (mean, unit, ends), weight = _units(table), found.weight
    width = float(np.ptp(every[0].current)) or 1.0
    b, bounds = 1 / (found.lifetime * unit * HOUR), at_bounds(found.share, weight)
    quoted = {
        "a": partial_loss(found.share * b / mean, weight, UNITS["a"], *bounds, b / mean),
        "b": partial_loss((1 - found.share) * b, weight, UNITS["b"], *bounds[::-1], b),
        "share": weighted_quantity(found.share, weight, "1"),
    }
    for name, x in ends.items():
        quoted[name] = weighted_quantity(unit / found.rate(x, width), weight, "h")
    usual, odd = log_exponent_prior(found.power)
    chances = float(expit(constant.log - found.log)), float(weight @ np.exp(odd - usual))
    exponent = weighted_quantity(found.power, weight, "1")
    return FreeLaw(quoted, quoted["share"], exponent, None, *chances)


def _with_free_law(exact: Quantity, free: Quantity, freed: bool) -> Quantity:
    """A quantity with what the free law leaves open: at its median, or at the value of the constant
    law.
    """
    value = free.value if freed else float(np.clip(exact.value, *free.interval_95))
    return Quantity(value, free.error, free.unit, exact.error_raw, free.interval_95)


def _single_departure(table: LifetimeTable, kept: np.ndarray) -> str | None:
    """Sentence on one point that contradicts the constant law, which the others follow."""
    off = _most_deviant_point(table, kept, np.zeros(1))
    given = table.error is not None
    dof = off.dof + (STATED_READINGS if given else 0.0)
    chance = 2 * int(kept.sum()) * float(stdtr(dof, -off.errors))
    if chance >= POOR_FIT or (given and chi2_probability(off.rest, off.dof) < POOR_FIT):
        return None
    [named] = _point_names(table, np.arange(len(table)) == off.point)
    return (
        f"{named[0].upper()}{named[1:]} lies {off.errors:.2g} errors off the constant law of the "
        "others: measure it again"
    )


def fit_lifetimes(table: LifetimeTable, law: Law | str = Law.free) -> LifetimeFit:
    """Fit 1/tau = a I + b to lifetimes at several currents.

    Parameters
    ----------
    table : LifetimeTable
        Four points or more.
    law : {"free", "constant"}
        Errors contain an exponent of a and a change of b along the current, with the priors of
        `beamfit.lifetime.free_law`; or both are constant.

    Returns
    -------
    LifetimeFit
        With the verdicts of a decay. Where a constant a is refuted and the law is constant, the
        lifetimes are those of a law with a power of the current.

    Notes
    -----
    Least squares on the lifetimes themselves: their errors, and not those of 1/tau, are what is
    stated. The posterior of the free law is integrated on a grid over the share of a, the exponent
    and the change of b. Stated errors have the noise prior of a decay, or are wrong by a common
    factor. Points that are more probably bad than good, by the evidence of the laws without each,
    are left out and named.

    Examples
    --------
    >>> from beamfit.lifetime.record import LifetimeTable
    >>> current = np.linspace(100, 500, 9)
    >>> table = LifetimeTable(current, 1 / (1e-4 * current + 0.01), np.full(9, 0.1))
    >>> fit = fit_lifetimes(table, law="constant")
    >>> fit.status.value, f"{fit.a.value * 3600:.4e}"
    ('converged', '1.0000e-04')
    """
    expect(table, LifetimeTable, "read_lifetimes(path)")
    left_out = _outliers(table)
    every = _Points.of(table, ~left_out)
    points = every[0]
    plain, power = (_least_squares(points, exponent) for exponent in (False, True))
    test, exact = _test_constant_a(points, plain, power), _by_least_squares(table, plain)
    quiet = table.error is None and plain.scale < MIN_NOISE
    known = quiet or Law(law) is Law.constant
    free = None if known else _free_law(table, every, plain)
    refuted, freed = test.status is Status.poor_fit, free is not None and free.is_preferred
    best = power if freed else plain
    given, unit = table.error is not None, float(np.median(table.lifetime))
    evidence = TableEvidence(
        exact, best.chi2, best.dof, test, _by_current(table, power) if refuted else None,
        _point_names(table, left_out), None if given else best.scale * unit, free,
        not known and free is None,
    )  # fmt: skip
    finding = finding_of_table(evidence)
    if not quiet and (single := _single_departure(table, ~left_out)) is not None:
        finding = finding._replace(cause=f"{finding.message} {single}.")
    quoted = dict(exact)
    if free is not None:
        open_ = finding.status is Status.unidentified
        found = free.quantities
        quoted = {
            name: _with_free_law(one, found[name], freed or open_) for name, one in exact.items()
        }
    elif refuted:  # a and b stay those of the constant law
        quoted |= {name: _lifetime(power, x, unit) for name, x in _units(table)[-1].items()}
    if finding.status is Status.unidentified:
        quoted |= {name: replace(quoted[name], error=None) for name in "ab"}
    shown = {name: quoted[name] for name in UNITS if name != "i0"}
    return LifetimeFit(
        table.name, finding.status, finding.message, **shown,
        mean_current=float(table.current.mean()), chi2=best.chi2 if given else float(best.dof),
        dof=best.dof, constant_a=test, lifetimes=evidence.lifetimes, share=quoted["share"],
        outliers=tuple(map(int, np.flatnonzero(left_out))), readings=table, free_law=free,
    )  # fmt: skip


def _point_names(table: LifetimeTable, which: np.ndarray) -> tuple[str, ...]:
    return tuple(
        f"point {k + 1} ({table.lifetime[k]:.4g} h at {table.current[k]:.4g} mA)"
        for k in np.flatnonzero(which)
    )
