"""Alternatives to constant a and b of a decay, compared by evidence.

A bunch that lengthens, gas that is pumped away after a fill, a loss rate that changes once or
twice, current lost at once: each is the same law with further parameters, under the same noises,
with stated priors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.special import logsumexp, ndtri

from beamfit.answer import json_of, shown
from beamfit.errors import Status
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.expansion import (
    FURTHER,
    LEVEL,
    MAX_RELATIVE_ERROR,
    PLAIN,
    POWER,
    WHEN,
    Expansion,
    Pieces,
    fit_law,
    further_columns,
    lifetime_of,
)
from beamfit.lifetime.free_law import (
    DRIFT,
    ENDS,
    EXPONENT_SD_ABOVE,
    EXPONENT_SD_BELOW,
    LOG_LIKELIHOOD_RANGE,
    MAX_ROWS,
    OUTGASSING_PRIOR,
    OUTGASSING_RATES,
    OUTGASSING_TIMES,
    SMOOTH_PRIOR,
    disturbances,
    from_nodes,
    smooth_curves,
)
from beamfit.lifetime.record import DecayRecord
from beamfit.noise.memory import Products
from beamfit.quantity import HOUR, Quantity
from beamfit.statistics import POOR_FIT

# Departure, in standard errors, that is found with a probability of 90 % at a false alarm rate of
# `POOR_FIT`.
DETECTABLE = float(ndtri(1 - POOR_FIT / 2) + ndtri(0.9))
# First grid of the times of further losses, over the span.
TIME_GRID = np.linspace(0.05, 0.95, 40)
# Number of grids on which times are sought, each finer and about the best time of the last.
GRIDS = 3
# The times are sought again about the law found, until its residual sum of squares falls by less
# than this share.
MAX_ITERATIONS, SQUARES_TOLERANCE = 5, 1e-3
# Changes closer than this many readings, to each other or to an end, are a step of the current.
MIN_CHANGE_READINGS = 3.0
# An alternative is fitted only if its log evidence in linear approximation, which is good to about
# 1, exceeds that of constant a and b less 1. It is computed with this many correlation times.
SCREENING_TIMES, SCREENING_MARGIN = 7, -1.0
# Step of a time, over the span, for the slope by it.
TIME_STEP = 1e-3
# Number of currents in a table of the lifetime.
CURRENTS = 5


class Alternative(NamedTuple):
    """A law of a decay.

    Attributes
    ----------
    chance : float
        Prior probability.
    kind : str or None
        Kind of the further losses, as for `beamfit.lifetime.decay_law.course`.
    count : int
        Number of further losses.
    power : bool
        True if a is proportional to a power of the current.
    """

    chance: float
    kind: str | None = None
    count: int = 0
    power: bool = False


# The smooth laws: constant a and b, a power of the current in a, and that with a drift of b.
CONSTANT, POWERED = Alternative(SMOOTH_PRIOR - 0.4), Alternative(0.2, power=True)
DRIFTING = Alternative(0.2, "drift", power=True)
# Their alternatives: one or two changes of b (gas, scraper) or of a (RF voltage), gas that is
# pumped away after a fill, and current lost at once, once or twice.
OTHERS = (Alternative(0.04, "step", 1), Alternative(0.02, "step", 2),
          Alternative(0.04, "step of a", 1), Alternative(0.02, "step of a", 2),
          Alternative(OUTGASSING_PRIOR, "relaxing", 1),
          Alternative(0.04, "sudden", 1), Alternative(0.02, "sudden", 2))  # fmt: skip
# Kinds that are not considered if a gauge gives the pressure.
WITHOUT_GAUGE = ("relaxing", "step of a")


@shown
@dataclass(frozen=True)
class ConstantA:
    """Verdict on a constant a by one record.

    Parameters
    ----------
    status : Status
        `converged` if a constant a describes the record, `poor_fit` if it is rejected,
        `unidentified` if the record does not test it.
    message : str
        The verdict in a sentence.
    exponent : Quantity
        s in a(I) proportional to I^s: 0 for constant a, -1/3 for a strongly lengthening bunch,
        above 0 where the loss rate falls otherwise, as in a vacuum that recovers; NaN if the
        record does not test it.
    p_value : float
        Probability of a worse contradiction if a is constant; NaN if the record does not test it.
    """

    status: Status
    message: str
    exponent: Quantity
    p_value: float

    def widened(self, error: float) -> ConstantA:
        """Return the verdict with a further, independent error of the exponent."""
        exponent = self.exponent
        if not math.isfinite(exponent.value):
            return self
        error_total = math.hypot(exponent.error, error)
        chance = math.erfc(abs(exponent.value) / error_total / math.sqrt(2))
        return constant_a(exponent.value, error_total, exponent.error_raw, chance)

    def __str__(self) -> str:
        return f"{self.status}. {self.message}"


def constant_a(exponent: float, error: float, raw: float, chance: float) -> ConstantA:
    """Judge an exponent by its error and the probability of a larger one if a is constant."""
    if not error < MAX_RELATIVE_ERROR:  # a third: the exponent of a long bunch
        message = "The record cannot tell a constant a from one that depends on the current"
        unknown = Quantity(math.nan, None, "1")
        return ConstantA(Status.unidentified, f"{message}: record longer.", unknown, math.nan)
    value, chance = Quantity(float(exponent), float(error), "1", float(raw)), float(chance)
    if chance >= POOR_FIT:
        message = (
            f"A constant a describes the record (p = {chance:.2g}, exponent {value}; one of "
            f"{DETECTABLE * error:.2g} would be seen)."
        )
        return ConstantA(Status.converged, message, value, chance)
    cause = (
        "so b of the constant-a fit is not a gas loss; fit with the shape of a"
        if exponent < 0
        else "which no bunch length does: look for a vacuum that changes, as after a fill"
    )
    message = (
        f"A constant a is rejected (p = {max(chance, 1e-300):.2g}): a goes as "
        f"I^{value.value:.3f}, {cause}."
    )
    return ConstantA(Status.poor_fit, message, value, chance)


@shown
@dataclass(frozen=True)
class LifetimeLaw:
    """Lifetime as a function of the current, where constant a and b do not describe it.

    Parameters
    ----------
    current : tuple of float
        Currents, mA, from the last to the first of the record.
    lifetime : tuple of Quantity
        Lifetime at each, h, with a proportional to a power of the current.
    exponent : Quantity
        The power.
    """

    current: tuple[float, ...]
    lifetime: tuple[Quantity, ...]
    exponent: Quantity

    def __str__(self) -> str:
        pairs = zip(self.current, self.lifetime, strict=True)
        return ", ".join(f"{lifetime} at {current:.4g} mA" for current, lifetime in pairs)


def lifetime_law(expansion: Expansion, independent: bool, free: bool) -> LifetimeLaw | None:
    """Compute lifetimes by current from a law with a power of the current in a, fitted (`free`) or
    as it is in `expansion`.

    None if the fit of the power does not converge.
    """
    if free:
        expansion = fit_law(_average_neighbours(expansion), (*PLAIN, POWER))
        if not expansion.converged:
            return None
    (span, mean), current = expansion.pieces.units, expansion.pieces.current
    x = np.geomspace(current.min(), current.max(), CURRENTS) / mean

    def rates(level, loss, quadratic, power):
        rates_found = (quadratic * x ** (1 + power) + loss - quadratic) / span
        return np.append(rates_found, power)

    columns = expansion.columns(*[POWER] * free)
    (*rates_found, power), errors = expansion.propagate(rates, columns, independent)
    exponent = Quantity(float(power), float(errors[-1]) if free else None, "1")
    lifetimes = (
        lifetime_of(*pair, clear=True) for pair in zip(rates_found, errors[:-1], strict=True)
    )
    return LifetimeLaw(tuple(map(float, x * mean)), tuple(lifetimes), exponent)


@shown
class Change(NamedTuple):
    """A change of the loss rate in a record.

    Attributes
    ----------
    time, error : float
        Time of the change, s from the first reading, and its error.
    before, after : Quantity
        Lifetime at that moment's current before and after it, h.
    then : Change or None
        A second change, as where a scraper was moved in and out again.
    """

    time: float
    error: float
    before: Quantity
    after: Quantity
    then: Change | None = None

    @property
    def size(self) -> float:
        """Change of the loss rate, 1/h, of either sign."""
        return abs(1 / self.after.value - 1 / self.before.value)

    def to_json(self) -> dict[str, Any]:
        """Return the time and the two lifetimes as JSON's types, and of a second change too."""
        document = {"time": self.time, "before": self.before, "after": self.after}
        return json_of(document if self.then is None else document | {"then": self.then})

    def __str__(self) -> str:
        changes = [self] if self.then is None else [self, self.then]
        sentences = (
            f"near t = {one.time:.4g} s, where the lifetime went from {one.before} to {one.after}"
            for one in changes
        )
        return f"the loss rate changed {', and '.join(sentences)}"


@shown
class Outgassing(NamedTuple):
    """A gas loss b0 + b1 exp(-t/T), as of gas that a fill sets free and the pumps remove.

    Attributes
    ----------
    time_constant : Quantity
        T, h.
    a, b : Quantity
        The law's a, 1/(mA s), and b0, 1/s, that is left in the end.
    before, after : Quantity
        Lifetime at the first current, h: with the loss there was at first, and with b0 alone.
    current : float
        That current, mA.
    """

    time_constant: Quantity
    a: Quantity
    b: Quantity
    before: Quantity
    after: Quantity
    current: float

    def __str__(self) -> str:
        return (
            f"the gas loss falls with a time constant of {self.time_constant}, as in a vacuum that "
            f"recovers after a fill (outgassing): at {self.current:.4g} mA the lifetime goes from "
            f"{self.before} to {self.after}, with a = {self.a}, b = {self.b}"
        )


@shown
class SuddenLoss(NamedTuple):
    """Current lost, or gained, between two readings: a decay ends there and another begins.

    Attributes
    ----------
    time : float
        Time of the loss, s from the first reading.
    current : Quantity
        Lost current, mA; negative for a refill.

    Examples
    --------
    >>> from beamfit.lifetime.fit import fit_decay
    >>> time = np.linspace(0.0, 7200.0, 400)
    >>> beam = 100 * np.exp(-time / 36000) * np.where(time > 3000, 0.98, 1.0)
    >>> noise = 0.1 * np.random.default_rng(1).normal(size=400)
    >>> print(fit_decay(DecayRecord(time, beam + noise)).loss)
    1.847 ± 0.019 mA were lost at once near t = 3005 s
    """

    time: float
    current: Quantity

    def __str__(self) -> str:
        kind = "lost" if self.current.value > 0 else "gained"
        current = replace(self.current, value=abs(self.current.value))
        return f"{current} were {kind} at once near t = {self.time:.4g} s"


class BestAlternative(NamedTuple):
    """The most probable alternative, where it explains a decay better than a smooth law.

    Attributes
    ----------
    explanation : Change, Outgassing or SuddenLoss
        The event, with its numbers.
    odds : float
        Logarithm of its probability over that of a loss rate that drifts or wanders.
    scatter : float
        Root mean square of the residuals, mA.
    law : Expansion
        Its law, with further losses.
    kind : str
        Their kind.
    """

    explanation: Change | Outgassing | SuddenLoss
    odds: float
    scatter: float
    law: Expansion
    kind: str

    @property
    def quantities(self) -> dict[str, Quantity]:
        """I0 and lifetimes at the first and last reading and the mean current."""
        (span, mean), pieces = self.law.pieces.units, self.law.pieces
        x = pieces.relative_current + self.law.residuals / pieces.weight
        when = np.array([0.0, 1.0, np.interp(-1.0, -x, pieces.time / span)])

        def rates_and_current(level, loss, quadratic, power, *further):
            currents = np.array([level, x[-1], 1.0])
            rates = loss + quadratic * (currents - 1)
            for size, time in zip(further[::2], further[1::2], strict=True):
                if self.kind == "relaxing":
                    rates = rates + size * np.exp(-when / time)
                elif self.kind != "sudden":
                    factor = currents if self.kind == "step of a" else 1.0
                    rates = rates + size * factor * (when > np.real(time))
            return np.append(rates / span, level * mean)

        columns = [LEVEL, *PLAIN, *range(FURTHER, self.law.rows.shape[1])]
        *rates, first = zip(*self.law.propagate(rates_and_current, columns), strict=True)
        lifetimes = (lifetime_of(*rate, clear=True) for rate in rates)
        quantities = {f"lifetime_{at}": one for at, one in zip(ENDS, lifetimes, strict=True)}
        return {"i0": Quantity(*map(float, first), "mA")} | quantities

    def __str__(self) -> str:
        size = self.odds / math.log(10.0)
        times = f"{10**size:.2g}" if size < 6 else f"1e{size:.0f}"
        return (
            f"{self.explanation} ({times} times likelier than a loss rate that drifts or wanders)"
        )


def best_alternative(plain: Expansion) -> BestAlternative | None:
    """Find the most probable alternative: changes, gas that is pumped away, or sudden losses.

    Parameters
    ----------
    plain : Expansion
        Fit of a single decay with constant a and b.

    Returns
    -------
    BestAlternative or None
        None if a smooth law is more probable, or the readings are too few for further parameters.

    Notes
    -----
    Probabilities are computed by Laplace's approximation about the best parameters of each law,
    averaged over the level and the memory of the noise as in `beamfit.lifetime.free_law`. Priors of
    further losses are flat in the logarithm of their size and in their time; that of the time
    constant of gas is flat in its logarithm, up to the length of the record.
    """
    pieces = _average_neighbours(plain)
    if pieces.time.size <= WHEN + 2:
        return None
    plain = fit_law(pieces) if pieces is not plain.pieces else plain
    fits = ((one, _fit_alternative(plain, one)) for one in _probable_alternatives(plain))
    laws = [(one, law) for one, law in fits if law is not None]
    if not laws:
        return None
    logs = _log_evidences(plain, [*laws, *_fit_smooth_laws(plain)])
    log, smooth = max(logs[: len(laws)]), float(logsumexp(logs[len(laws) :]))
    if not log > smooth:
        return None
    alternative, best = laws[logs.index(log)]
    explain = {"relaxing": _outgassing, "sudden": _sudden_loss}
    explain |= {"step": _change, "step of a": partial(_change, of_a=True)}
    scatter = float(np.sqrt(np.mean(best.current_residuals**2)))
    kind = alternative.kind
    return BestAlternative(explain[kind](best), log - smooth, scatter, best, kind)


def _average_neighbours(expansion: Expansion) -> Pieces:
    """Average neighbouring readings of a long decay, corrected for the bend of the law."""
    pieces, (i0, a, b, *_) = expansion.pieces, expansion.values
    if pieces.time.size <= MAX_ROWS or pieces.first.size > 1 or pieces.gauge is not None:
        return pieces
    record = DecayRecord(pieces.time, pieces.current, pieces.error)
    size = -(-len(record) // MAX_ROWS)
    time, *means = record.means(size, lambda time: current(time, i0, a, b))
    return Pieces(time, time, *means, pieces.first, None, pieces.monitor)


def _probable_alternatives(plain: Expansion) -> list[Alternative]:
    """Select alternatives that are not much less probable than constant a and b.

    Their evidence is computed in linear approximation about constant a and b, at their best times,
    also with disturbances.
    """
    gauged = plain.pieces.gauge is not None
    others = [one for one in OTHERS if not (gauged and one.kind in WITHOUT_GAUGE)]
    columns = [plain.residuals, *plain.rows[:, [LEVEL, *PLAIN]].T]
    indices, widths = {CONSTANT: range(0)}, {CONSTANT: np.zeros(0)}
    for one in others:
        sizes, times = _best_times(plain, one)
        new = list(further_columns(plain, one.kind, times).T)
        width, time_width = _prior_widths(one.kind, sizes, times, plain.numbers[0])
        if one.kind != "sudden":
            ends = (further_columns(plain, one.kind, times + d) for d in (TIME_STEP, -TIME_STEP))
            new += list(sizes[:, None] * np.subtract(*ends).T / (2 * TIME_STEP))
            width = np.append(width, time_width)
        indices[one], widths[one] = range(len(columns), len(columns) + len(new)), width
        columns += new
    rows = np.column_stack([*columns, _node_columns(plain)])
    products = Products.of(rows, plain.pieces.time, bool(plain.min_factor), SCREENING_TIMES)
    identity, nodes = np.split(np.eye(rows.shape[1]), [len(columns)], axis=1)

    def log_evidence(one: Alternative) -> float:
        own, width = identity[:, [0, 1, 2, 3, *indices[one]]], np.append([np.inf] * 3, widths[one])
        return _log_evidence(one, plain, products, nodes, own, width, np.zeros(width.size))

    constant = log_evidence(CONSTANT) + SCREENING_MARGIN
    return [one for one in others if log_evidence(one) > constant]


def _log_prior(alternative: Alternative, law: Expansion) -> float:
    """Log prior probability; the time of a sudden loss is one of the intervals between readings."""
    intervals = law.pieces.time.size - 1 if alternative.kind == "sudden" else 1
    return math.log(alternative.chance) - alternative.count * math.log(intervals)


def _prior_widths(kind: str, sizes: np.ndarray, times: np.ndarray, loss: float) -> np.ndarray:
    """Widths of normal priors on sizes and times of further losses whose density at their centre is
    that of the flat priors.
    """
    sizes = np.maximum(np.abs(sizes), OUTGASSING_RATES[0] * abs(loss))
    (low, high), (shortest, longest) = OUTGASSING_RATES, OUTGASSING_TIMES
    gas = kind == "relaxing"
    times = times * math.log(longest / shortest) if gas else np.ones(times.size)
    return np.array([2 * sizes * math.log(high / low), times]) / math.sqrt(2 * math.pi)


def _fit_smooth_laws(plain: Expansion) -> list[tuple[Alternative, Expansion]]:
    """Fit the smooth laws: constant a and b, a power of the current, and that with a drift of b."""
    start = np.append(plain.numbers, [0.0, 0.0])
    power = {POWER: (EXPONENT_SD_BELOW + EXPONENT_SD_ABOVE) / 2}
    laws = [plain, fit_law(plain.pieces, (*PLAIN, POWER), start=plain.numbers, widths=power)]
    if plain.pieces.gauge is None:
        gas = abs(plain.numbers[0] - plain.numbers[1])
        laws.append(fit_law(plain.pieces, (*PLAIN, POWER, FURTHER), "drift", start=start,
                           widths=power | {FURTHER: DRIFT * gas}))  # fmt: skip
    each = zip((CONSTANT, POWERED, DRIFTING), laws, strict=False)
    return [(one, law) for one, law in each if law.converged]


def _first_times(pieces: Pieces, kind: str) -> np.ndarray:
    """First grid of times, over the span; for sudden losses between readings."""
    if kind != "sudden":
        return TIME_GRID
    between = (pieces.time[1:] + pieces.time[:-1]) / 2 / pieces.units[0]
    few = np.linspace(0, between.size - 1, min(TIME_GRID.size, between.size))
    return between[few.astype(int)]


def _best_times(expansion: Expansion, one: Alternative) -> tuple[np.ndarray, np.ndarray]:
    """Find sizes and times of further losses that explain most, in linear approximation about a
    law.

    They replace the further losses that the law has.
    """
    basis = np.linalg.qr(expansion.reduced[:, [LEVEL, *PLAIN]])[0]

    def orthogonal(columns: np.ndarray) -> np.ndarray:
        return columns - basis @ (basis.T @ columns)

    further = expansion.rows[:, FURTHER::2] @ expansion.numbers[FURTHER - 1 :: 2]
    grid = _first_times(expansion.pieces, one.kind)
    residual, windows = orthogonal(expansion.residuals - further), [grid] * one.count
    for _ in range(GRIDS):
        times_tried = np.concatenate(windows)
        slopes = orthogonal(further_columns(expansion, one.kind, times_tried))
        size = np.linalg.norm(slopes, axis=0) + 1e-300
        projections, products = slopes.T @ residual / size, slopes.T @ slopes / size / size[:, None]
        groups = np.split(np.arange(times_tried.size), one.count)
        sets = np.array(list(itertools.product(*groups)))
        matrix = products[sets[:, :, None], sets[:, None, :]] + 1e-6 * np.eye(one.count)
        sizes = np.linalg.solve(matrix, projections[sets][..., None])[..., 0]
        best = int(np.argmax(np.sum(sizes * projections[sets], axis=1)))
        times, steps = times_tried[sets[best]], [window[1] - window[0] for window in windows]
        windows = [np.linspace(max(t - d, grid[0]), min(t + d, grid[-1]), TIME_GRID.size)
                   for t, d in zip(times, steps, strict=True)]  # fmt: skip
    return -sizes[best] / size[sets[best]], times


def _fit_alternative(plain: Expansion, one: Alternative) -> Expansion | None:
    """Fit the law with an alternative's further losses; None if they are not determined.

    Times of changes and sudden losses are sought again about the law found, while it improves: a
    large change bends the decay in another way than a small one. The time constant of gas is
    fitted.
    """
    is_gas, law, found = one.kind == "relaxing", plain, None
    for _ in range(MAX_ITERATIONS):
        further = np.column_stack(_best_times(law, one))
        further = further[np.argsort(further[:, 1])].ravel()
        free = (*PLAIN, *range(FURTHER, FURTHER + further.size, 1 if is_gas else 2))
        start = np.append(law.numbers[: plain.numbers.size], further)
        law = fit_law(plain.pieces, free, one.kind, start=start)
        if found is not None and not _squares(law) < (1 - SQUARES_TOLERANCE) * _squares(found):
            break
        found = law
        if is_gas or not law.converged:
            break
    shortest = float(np.median(np.diff(plain.pieces.time))) / plain.pieces.units[0]
    if is_gas:
        separate = found.numbers[3] > 0 and shortest < found.numbers[4] < OUTGASSING_TIMES[1]
    elif one.kind == "sudden":
        separate = np.all(np.diff(found.numbers[4::2]) > shortest)
    else:
        lengths = np.diff([0.0, *found.numbers[4::2], 1.0])
        separate = np.all(lengths > MIN_CHANGE_READINGS * shortest)
    visible = found.rows[:, FURTHER::2].any(axis=0).all()  # not after the beam is lost
    return found if found.converged and separate and visible else None


def _squares(law: Expansion) -> float:
    """Residual sum of squares."""
    return float(law.residuals @ law.residuals)


def _log_evidences(plain: Expansion, laws: Sequence[tuple[Alternative, Expansion]]) -> list[float]:
    """Log evidence of each law, averaged over the noise, up to a common constant.

    Disturbances of the currents of the plain law are included, in linear approximation.
    """
    pieces, priors = plain.pieces, [_priors(law, one) for one, law in laws]
    parts = [_node_columns(plain)]
    parts += [np.column_stack([law.residuals, law.rows[:, columns]])
              for (_, law), (columns, *_) in zip(laws, priors, strict=True)]  # fmt: skip
    products = Products.of(np.hstack(parts), pieces.time, pieces.error is not None)
    identity = np.eye(products.matrix.shape[1])
    ends = np.cumsum([part.shape[1] for part in parts[:-1]])
    nodes, *columns = np.split(identity, ends, axis=1)
    each = zip(laws, columns, priors, strict=True)
    return [_log_evidence(*pair, products, nodes, own, *prior) for pair, own, (_, *prior) in each]


def _node_columns(plain: Expansion) -> np.ndarray:
    """Change of the readings by relative changes of the current at each node."""
    pieces = plain.pieces
    model = pieces.current / pieces.divisor + plain.residuals
    return model[:, None] * from_nodes(pieces.time / pieces.units[0])


def _log_evidence(
    alternative: Alternative, law: Expansion, products: Products, nodes: np.ndarray,
    columns: np.ndarray, width: np.ndarray, centre: np.ndarray,
) -> float:  # fmt: skip
    """Log evidence of one law, given the columns of the nodes and its own columns as combinations
    of `products`.
    """
    logs = [_laplace(products.combined(columns), width, centre)]
    # A smooth curve with at most half as many parameters as readings shows which noises to use.
    curves = smooth_curves(max(products.count // 2 - width.size, 0))
    smooth = products.combined(np.hstack([columns, nodes @ curves]))
    log = smooth.log_prior + smooth.log_size(smooth.left())
    probable = products.some(log > log.max() - LOG_LIKELIHOOD_RANGE)
    for kind in disturbances(law.numbers[0]):
        if kind.of_loss and law.pieces.gauge is not None:
            continue
        shapes = nodes @ kind.reading_shapes(law.numbers[0])
        own = np.broadcast_to(columns, (len(shapes), *columns.shape))
        sets = np.concatenate([own, shapes], axis=2)
        numbers = shapes.shape[2]
        priors = np.append(width, np.ones(numbers)), np.append(centre, np.zeros(numbers))
        logs.append(_laplace(probable.by_each(sets, kind.chance / SMOOTH_PRIOR), *priors))
    return float(logsumexp(logs)) + _log_prior(alternative, law)


def _priors(law: Expansion, alternative: Alternative) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Columns of the parameters of an alternative, widths of their priors, and distance of the
    parameters from the centres of these.
    """
    loss, quadratic, power, *further = law.numbers
    priors: dict[int, tuple[float, float]] = {}
    if alternative.power:
        priors[POWER] = (EXPONENT_SD_BELOW if power < 0 else EXPONENT_SD_ABOVE), power
    if alternative.kind == "drift":
        priors[FURTHER] = DRIFT * max(abs(loss - quadratic), 1e-300), further[0]
    if alternative.count:
        sizes, times = _prior_widths(
            alternative.kind, np.array(further[::2]), np.array(further[1::2]), loss
        )
        priors |= {FURTHER + 2 * k: (size, 0.0) for k, size in enumerate(sizes)}
        if alternative.kind != "sudden":
            priors |= {WHEN + 2 * k: (time, 0.0) for k, time in enumerate(times)}
    width, centre = np.array([(np.inf, 0.0)] * 3 + list(priors.values())).T
    return [LEVEL, *PLAIN, *priors], width, centre


def _laplace(products: Products, width: np.ndarray, centre: np.ndarray) -> float:
    """Log evidence of the residuals (first column) by Laplace's approximation, averaged over the
    noise.

    Parameters of the other columns have normal priors of given widths; they begin at a distance
    `centre` from the middle of these.
    """
    gradient, matrix = products.matrix[:, 1:, 0], products.matrix[:, 1:, 1:]
    squares_left, squares = products.matrix[:, 0, 0], products.matrix[:, 0, 0]
    for _ in range(3):
        variance = products.variance(squares_left, width.size)[:, None]
        precision = matrix / variance[..., None] + np.diag(1 / width**2)
        scale = np.sqrt(np.einsum("kpp->kp", precision)) + 1e-300
        scaled = precision / scale[:, :, None] / scale[:, None, :] + 1e-12 * np.eye(width.size)
        scaled_gradient = (gradient / variance + centre / width**2) / scale
        step = -np.linalg.solve(scaled, scaled_gradient[..., None])[..., 0] / scale
        squares_left = squares + 2 * np.sum(gradient * step, 1)
        squares_left += np.einsum("kp,kpq,kq->k", step, matrix, step)
        squares_left = np.maximum(squares_left, 1e-30)
    log = products.log_prior + products.log_size(squares_left)
    log = log - 0.5 * np.linalg.slogdet(scaled)[1] - np.log(scale).sum(1)
    finite = np.isfinite(width)
    log = log - 0.5 * np.sum(((centre + step) / width)[:, finite] ** 2, 1)
    return float(logsumexp(log)) - float(np.log(width[finite]).sum())


def _change(law: Expansion, of_a: bool = False) -> Change:
    """Compute the lifetimes before and after each change from the law with changes."""
    (span, mean), count = law.pieces.units, law.numbers.size // 2 - 1
    times = law.numbers[4::2]
    x = np.interp(times * span, law.pieces.time, law.pieces.current) / mean

    def rates(level, loss, quadratic, power, *further):
        more = np.array(further[::2])
        mean_rate = loss + quadratic * (x - 1)
        factor = x if of_a else 1.0
        sides = (mean_rate + factor * (np.cumsum(more) - part) for part in (more, 0.0))
        return np.concatenate([*sides, further[1::2]]) / span

    values, errors = law.propagate(rates, [LEVEL, *PLAIN, *range(FURTHER, law.rows.shape[1])])
    lifetimes = [lifetime_of(*one) for one in zip(values, errors, strict=True)]
    found = None
    for k in reversed(range(count)):
        time, error = (float(span**2 * part[2 * count + k]) for part in (values, errors))
        found = Change(time, error, lifetimes[k], lifetimes[count + k], found)
    return found


def _sudden_loss(law: Expansion) -> SuddenLoss:
    """Compute the larger of two sudden losses from the law with them."""
    (span, _), sizes, times = law.pieces.units, law.numbers[3::2], law.numbers[4::2]
    largest = int(np.argmax(np.abs(sizes)))
    # The time within the interval between two readings is unknown: take its middle.
    after = int(np.searchsorted(law.pieces.time, times[largest] * span))
    when = float(law.pieces.time[after - 1 : after + 1].mean())
    model = law.pieces.current + law.current_residuals

    def lost(level, loss, quadratic, power, *further):
        return np.array([-model[after - 1] * np.expm1(-further[2 * largest])])

    columns = [LEVEL, *PLAIN, *range(FURTHER, law.rows.shape[1], 2)]
    [value], [error] = law.propagate(lost, columns)
    return SuddenLoss(when, Quantity(float(value), float(error), "mA"))


def _outgassing(law: Expansion) -> Outgassing:
    span, mean = law.pieces.units

    def numbers(level, loss, quadratic, power, further, when):
        b = loss - quadratic
        rate = quadratic * level + b
        return np.array([when * span / HOUR, quadratic / mean / span, b / span,
                         (rate + further) / span, rate / span])  # fmt: skip

    units = ("h", "1/(mA s)", "1/s", "1/s", "1/s")
    found = zip(*law.propagate(numbers, [LEVEL, *PLAIN, FURTHER, WHEN]), units, strict=True)
    constant, a, b, *rates = (Quantity(float(v), float(e), u) for v, e, u in found)
    before, after = (lifetime_of(rate.value, rate.error, clear=True) for rate in rates)
    return Outgassing(constant, a, b, before, after, float(law.level[0]) * mean)
