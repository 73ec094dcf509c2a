"""Alternatives to constant a and b of a decay, compared by evidence.

A bunch that lengthens, a gas that is pumped away after a fill, a loss rate that changes once or
twice, current lost at once: each is the one law with further numbers, under the same noises, with
stated priors.
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
    DETERMINED,
    FURTHER,
    LEVEL,
    PLAIN,
    POWER,
    WHEN,
    Expansion,
    Pieces,
    further_columns,
    lifetime_of,
    solved,
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

# A departure of so many errors is found with 90 % at a false alarm rate of `POOR_FIT`.
FOUND = float(ndtri(1 - POOR_FIT / 2) + ndtri(0.9))
# Times, over the span, that are looked at first.
GRID = np.linspace(0.05, 0.95, 40)
# Changes are placed on ever finer grids about the best of the last, so often.
FINER = 3
# They are placed anew about the law with them while its squares fall by such a share, so often at
# most.
AGAIN, NEARER = 5, 1e-3
# Two changes within so many readings are a step.
STEP = 3.0
# An alternative is fitted if in linear approximation its evidence, by noises of so many correlation
# times, is not below that of constant a and b by more than this: it is good to about 1.
COARSE, HOPELESS = 7, -1.0
# Step of a time for the slope by it, over the span.
MOVED = 1e-3
# Currents at which a lifetime is offered.
CURRENTS = 5


class Alternative(NamedTuple):
    """A law of a decay by its prior probability, what is lost besides, and how often.

    `power` is whether a goes as a power of the current.
    """

    chance: float
    kind: str | None = None
    count: int = 0
    power: bool = False


# Constant a and b, a power of a, and a drift of b beside; one change of the loss rate, two, each of
# b, as of gas or a scraper, or of a, as of the RF voltage; gas that relaxes; current lost at once
# between two readings, each as likely, once or twice.
CONSTANT, POWERED = Alternative(SMOOTH_PRIOR - 0.4), Alternative(0.2, power=True)
DRIFTING = Alternative(0.2, "drift", power=True)
OTHERS = (Alternative(0.04, "step", 1), Alternative(0.02, "step", 2),
          Alternative(0.04, "step of a", 1), Alternative(0.02, "step of a", 2),
          Alternative(OUTGASSING_PRIOR, "relaxing", 1),
          Alternative(0.04, "sudden", 1), Alternative(0.02, "sudden", 2))  # fmt: skip
# What is not looked for where a gauge says how the gas goes.
UNGAUGED = ("relaxing", "step of a")


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
        """The verdict with a further, independent error of the exponent."""
        exponent = self.exponent
        if not math.isfinite(exponent.value):
            return self
        whole = math.hypot(exponent.error, error)
        chance = math.erfc(abs(exponent.value) / whole / math.sqrt(2))
        return constant_a(exponent.value, whole, exponent.error_raw, chance)

    def __str__(self) -> str:
        return f"{self.status}. {self.message}"


def constant_a(exponent: float, error: float, raw: float, chance: float) -> ConstantA:
    """Judge an exponent by its error and the chance of so large a one where a is constant."""
    if not error < DETERMINED:  # a third: the exponent of a long bunch
        message = "The record cannot tell a constant a from one that depends on the current"
        unknown = Quantity(math.nan, None, "1")
        return ConstantA(Status.unidentified, f"{message}: record longer.", unknown, math.nan)
    found, chance = Quantity(float(exponent), float(error), "1", float(raw)), float(chance)
    if chance >= POOR_FIT:
        message = (
            f"A constant a describes the record (p = {chance:.2g}, exponent {found}; one of "
            f"{FOUND * error:.2g} would be seen)."
        )
        return ConstantA(Status.converged, message, found, chance)
    cause = (
        "so b of the constant-a fit is not a gas loss; fit with the shape of a"
        if exponent < 0
        else "which no bunch length does: look for a vacuum that changes, as after a fill"
    )
    message = (
        f"A constant a is rejected (p = {max(chance, 1e-300):.2g}): a goes as "
        f"I^{found.value:.3f}, {cause}."
    )
    return ConstantA(Status.poor_fit, message, found, chance)


@shown
@dataclass(frozen=True)
class LifetimeLaw:
    """The lifetime as a function of the current, where constant a and b do not describe it.

    Parameters
    ----------
    current : tuple of float
        Currents, mA, from the last to the first of the record.
    lifetime : tuple of Quantity
        Lifetime at each, h, of a law with a going as a power of the current.
    exponent : Quantity
        The power.
    """

    current: tuple[float, ...]
    lifetime: tuple[Quantity, ...]
    exponent: Quantity

    def __str__(self) -> str:
        pairs = zip(self.current, self.lifetime, strict=True)
        return ", ".join(f"{lifetime} at {current:.4g} mA" for current, lifetime in pairs)


def lifetime_law(about: Expansion, independent: bool, free: bool) -> LifetimeLaw | None:
    """Lifetimes by current of a law with a power of a that is free, or as it is.

    None where the search for the power does not come to rest.
    """
    if free:
        about = solved(_averaged(about), (*PLAIN, POWER))
        if not about.rested:
            return None
    (span, mean), current = about.pieces.units, about.pieces.current
    x = np.geomspace(current.min(), current.max(), CURRENTS) / mean

    def rates(level, loss, quadratic, power):
        found = (quadratic * x ** (1 + power) + loss - quadratic) / span
        return np.append(found, power)

    columns = about.columns(*[POWER] * free)
    (*found, power), errors = about.quoted(rates, columns, independent)
    exponent = Quantity(float(power), float(errors[-1]) if free else None, "1")
    lifetimes = (lifetime_of(*pair, clear=True) for pair in zip(found, errors[:-1], strict=True))
    return LifetimeLaw(tuple(map(float, x * mean)), tuple(lifetimes), exponent)


@shown
class Change(NamedTuple):
    """A change of the loss rate in a record.

    Attributes
    ----------
    time, error : float
        When, s from the first reading, and the error of that.
    before, after : Quantity
        Lifetime at that moment's current before and after it, h.
    then : Change or None
        A second one, as where a scraper was moved in and out again.
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
        told = {"time": self.time, "before": self.before, "after": self.after}
        return json_of(told if self.then is None else told | {"then": self.then})

    def __str__(self) -> str:
        changes = [self] if self.then is None else [self, self.then]
        told = (
            f"near t = {one.time:.4g} s, where the lifetime went from {one.before} to {one.after}"
            for one in changes
        )
        return f"the loss rate changed {', and '.join(told)}"


@shown
class Outgassing(NamedTuple):
    """A gas loss b0 + b1 exp(-t/T): what a fill sets free is pumped away.

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
        When, s from the first reading.
    current : Quantity
        What was lost, mA; below zero of a refill.

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
        gone = replace(self.current, value=abs(self.current.value))
        return f"{gone} were {kind} at once near t = {self.time:.4g} s"


class Rival(NamedTuple):
    """The explanation that is better than a smooth law, and by how much.

    `odds` is the logarithm of its probability over that of a loss rate that drifts or wanders,
    `scatter` what it leaves of the readings, mA rms, and `law` its law, with further losses of a
    kind.
    """

    found: Change | Outgassing | SuddenLoss
    odds: float
    scatter: float
    law: Expansion
    kind: str

    @property
    def quantities(self) -> dict[str, Quantity]:
        """I0 and lifetimes at the first and last reading and the mean current."""
        (span, mean), pieces = self.law.pieces.units, self.law.pieces
        x = pieces.share + self.law.residuals / pieces.weight
        when = np.array([0.0, 1.0, np.interp(-1.0, -x, pieces.time / span)])

        def numbers(level, loss, quadratic, power, *further):
            rates = loss + quadratic * (np.array([level, x[-1], 1.0]) - 1)
            for size, time in zip(further[::2], further[1::2], strict=True):
                if self.kind == "relaxing":
                    rates = rates + size * np.exp(-when / time)
                elif self.kind != "sudden":
                    by = np.array([level, x[-1], 1.0]) if self.kind == "step of a" else 1.0
                    rates = rates + size * by * (when > np.real(time))
            return np.append(rates / span, level * mean)

        columns = [LEVEL, *PLAIN, *range(FURTHER, self.law.rows.shape[1])]
        *rates, first = zip(*self.law.quoted(numbers, columns), strict=True)
        lifetimes = (lifetime_of(*rate, clear=True) for rate in rates)
        found = {f"lifetime_{at}": one for at, one in zip(ENDS, lifetimes, strict=True)}
        return {"i0": Quantity(*map(float, first), "mA")} | found

    def __str__(self) -> str:
        size = self.odds / math.log(10.0)
        times = f"{10**size:.2g}" if size < 6 else f"1e{size:.0f}"
        return f"{self.found} ({times} times likelier than a loss rate that drifts or wanders)"


def rival_of(plain: Expansion) -> Rival | None:
    """The likeliest of changes, gas that relaxes and a sudden loss, if it beats a smooth law.

    Parameters
    ----------
    plain : Expansion
        Of a single decay, with constant a and b.

    Returns
    -------
    Rival or None
        None also where so few readings tell nothing of further numbers.

    Notes
    -----
    Probabilities by Laplace's approximation about the best numbers of each, the size and the memory
    of the noise averaged over as in `beamfit.lifetime.free_law`. Further losses are flat in
    their logarithm, times in the record, those of gas in their logarithm up to its length.
    """
    pieces = _averaged(plain)
    if pieces.time.size <= WHEN + 2:
        return None
    plain = solved(pieces) if pieces is not plain.pieces else plain
    each = ((one, _with_further(plain, one.kind, one.count)) for one in _likely(plain))
    laws = [(one, law) for one, law in each if law is not None]
    if not laws:
        return None
    logs = _log_evidences(plain, [*laws, *_smooth(plain)])
    log, smooth = max(logs[: len(laws)]), float(logsumexp(logs[len(laws) :]))
    if not log > smooth:
        return None
    one, best = laws[logs.index(log)]
    told = {"relaxing": _outgassing, "sudden": _sudden_loss}
    told |= {"step": _change, "step of a": partial(_change, of_a=True)}
    scatter = float(np.sqrt(np.mean(best.off**2)))
    return Rival(told[one.kind](best), log - smooth, scatter, best, one.kind)


def _averaged(about: Expansion) -> Pieces:
    """A long decay as the means of neighbouring readings, which go on as the law does."""
    pieces, (i0, a, b, *_) = about.pieces, about.values
    if pieces.time.size <= MAX_ROWS or pieces.first.size > 1 or pieces.gauge is not None:
        return pieces
    record = DecayRecord(pieces.time, pieces.current, pieces.error)
    size = -(-len(record) // MAX_ROWS)
    time, *means = record.means(size, lambda time: current(time, i0, a, b))
    return Pieces(time, time, *means, pieces.first, None, pieces.monitor)


def _likely(plain: Expansion) -> list[Alternative]:
    """Alternatives that are not much less likely than constant a and b: by their evidence in linear
    approximation about the law without, at their best times, also beside disturbances.
    """
    gauged = plain.pieces.gauge is not None
    others = [one for one in OTHERS if not (gauged and one.kind in UNGAUGED)]
    columns = [plain.residuals, *plain.rows[:, [LEVEL, *PLAIN]].T]
    places, widths = {CONSTANT: range(0)}, {CONSTANT: np.zeros(0)}
    for one in others:
        sizes, times = _at_best(plain, one.kind, one.count)
        own = list(further_columns(plain, one.kind, times).T)
        size, time = _widths(one.kind, sizes, times, plain.numbers[0])
        if one.kind != "sudden":
            ends = (further_columns(plain, one.kind, times + d) for d in (MOVED, -MOVED))
            own += list(sizes[:, None] * np.subtract(*ends).T / (2 * MOVED))
            size = np.append(size, time)
        places[one], widths[one] = range(len(columns), len(columns) + len(own)), size
        columns += own
    rows = np.column_stack([*columns, _by_nodes(plain)])
    products = Products.of(rows, plain.pieces.time, bool(plain.given), COARSE)
    every, nodes = np.split(np.eye(rows.shape[1]), [len(columns)], axis=1)

    def log_evidence(one: Alternative) -> float:
        own, width = every[:, [0, 1, 2, 3, *places[one]]], np.append([np.inf] * 3, widths[one])
        return _log_evidence(one, plain, products, nodes, own, width, np.zeros(width.size))

    constant = log_evidence(CONSTANT) + HOPELESS
    return [one for one in others if log_evidence(one) > constant]


def _log_chance(one: Alternative, law: Expansion) -> float:
    """Log prior probability; the time of a sudden loss is any interval between readings."""
    intervals = law.pieces.time.size - 1 if one.kind == "sudden" else 1
    return math.log(one.chance) - one.count * math.log(intervals)


def _widths(kind: str, sizes: np.ndarray, times: np.ndarray, loss: float) -> np.ndarray:
    """Widths of normal priors on sizes and times of further losses that have the density of flat
    ones there: what is not determined costs nothing.
    """
    sizes = np.maximum(np.abs(sizes), OUTGASSING_RATES[0] * abs(loss))
    gas = kind == "relaxing"
    times = (
        times * math.log(OUTGASSING_TIMES[1] / OUTGASSING_TIMES[0]) if gas else np.ones(times.size)
    )
    return np.array(
        [2 * sizes * math.log(OUTGASSING_RATES[1] / OUTGASSING_RATES[0]), times]
    ) / math.sqrt(2 * math.pi)


def _smooth(plain: Expansion) -> list[tuple[Alternative, Expansion]]:
    """Constant a and b, a power of the current, and one with a drift of b."""
    start, power = (
        np.append(plain.numbers, [0.0, 0.0]),
        {POWER: (EXPONENT_SD_BELOW + EXPONENT_SD_ABOVE) / 2},
    )
    laws = [plain, solved(plain.pieces, (*PLAIN, POWER), start=plain.numbers, widths=power)]
    if plain.pieces.gauge is None:
        gas = abs(plain.numbers[0] - plain.numbers[1])
        laws.append(solved(plain.pieces, (*PLAIN, POWER, FURTHER), "drift", start=start,
                           widths=power | {FURTHER: DRIFT * gas}))  # fmt: skip
    each = zip((CONSTANT, POWERED, DRIFTING), laws, strict=False)
    return [(one, law) for one, law in each if law.rested]


def _looked_at(pieces: Pieces, kind: str) -> np.ndarray:
    """Times that are looked at first, over the span: current is lost between any two readings."""
    if kind != "sudden":
        return GRID
    between = (pieces.time[1:] + pieces.time[:-1]) / 2 / pieces.units[0]
    few = np.linspace(0, between.size - 1, min(GRID.size, between.size))
    return between[few.astype(int)]


def _at_best(about: Expansion, kind: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sizes and times of further losses that explain most, in place of those of a law and in linear
    approximation about it.
    """
    basis = np.linalg.qr(about.left[:, [LEVEL, *PLAIN]])[0]

    def beside(columns: np.ndarray) -> np.ndarray:
        return columns - basis @ (basis.T @ columns)

    without = about.residuals - about.rows[:, FURTHER::2] @ about.numbers[FURTHER - 1 :: 2]
    grid = _looked_at(about.pieces, kind)
    residual, windows = beside(without), [grid] * count
    for _ in range(FINER):
        every = np.concatenate(windows)
        kinks = beside(further_columns(about, kind, every))
        size = np.linalg.norm(kinks, axis=0) + 1e-300
        along, products = kinks.T @ residual / size, kinks.T @ kinks / size / size[:, None]
        place = np.array(list(itertools.product(*np.split(np.arange(every.size), count))))
        pairs = products[place[:, :, None], place[:, None, :]] + 1e-6 * np.eye(count)
        sizes = np.linalg.solve(pairs, along[place][..., None])[..., 0]
        best = int(np.argmax(np.sum(sizes * along[place], axis=1)))
        times, steps = every[place[best]], [window[1] - window[0] for window in windows]
        windows = [np.linspace(max(t - d, grid[0]), min(t + d, grid[-1]), GRID.size)
                   for t, d in zip(times, steps, strict=True)]  # fmt: skip
    return -sizes[best] / size[place[best]], times


def _with_further(plain: Expansion, kind: str, count: int) -> Expansion | None:
    """The law with changes of the loss rate, or sudden losses, or with gas that relaxes, whose
    time is found. Those of the others are looked for again about the law with them, while it is
    better: a large change bends the decay otherwise than a small one.
    """
    gas, law, found = kind == "relaxing", plain, None
    for _ in range(AGAIN):
        further = np.column_stack(_at_best(law, kind, count))
        further = further[np.argsort(further[:, 1])].ravel()
        free = (*PLAIN, *range(FURTHER, FURTHER + further.size, 1 if gas else 2))
        start = np.append(law.numbers[: plain.numbers.size], further)
        law = solved(plain.pieces, free, kind, start=start)
        if found is not None and not _squares(law) < (1 - NEARER) * _squares(found):
            break
        found = law
        if gas or not law.rested:
            break
    shortest = float(np.median(np.diff(plain.pieces.time))) / plain.pieces.units[0]
    if gas:
        known = found.numbers[3] > 0 and shortest < found.numbers[4] < OUTGASSING_TIMES[1]
    elif kind == "sudden":
        known = np.all(np.diff(found.numbers[4::2]) > shortest)
    else:
        known = np.all(np.diff([0.0, *found.numbers[4::2], 1.0]) > STEP * shortest)
    told = found.rows[:, FURTHER::2].any(axis=0).all()  # not where all current is gone
    return found if found.rested and known and told else None


def _squares(law: Expansion) -> float:
    """Sum of squares of the residuals."""
    return float(law.residuals @ law.residuals)


def _log_evidences(plain: Expansion, laws: Sequence[tuple[Alternative, Expansion]]) -> list[float]:
    """Logarithms of the probability of the readings by each law, the noise averaged over, up to a
    constant: also beside a disturbance of the plain law's currents, in linear approximation.
    """
    pieces, given = plain.pieces, [_given(law, one) for one, law in laws]
    parts = [_by_nodes(plain)]
    parts += [np.column_stack([law.residuals, law.rows[:, columns]])
              for (_, law), (columns, *_) in zip(laws, given, strict=True)]  # fmt: skip
    products = Products.of(np.hstack(parts), pieces.time, pieces.error is not None)
    every = np.eye(products.matrix.shape[1])
    nodes, *owns = np.split(every, np.cumsum([part.shape[1] for part in parts[:-1]]), axis=1)
    each = zip(laws, owns, given, strict=True)
    return [_log_evidence(*pair, products, nodes, own, *known) for pair, own, (_, *known) in each]


def _by_nodes(plain: Expansion) -> np.ndarray:
    """Change of the readings by that of a share of the law's currents at each node."""
    pieces = plain.pieces
    model = pieces.current / pieces.over + plain.residuals
    return model[:, None] * from_nodes(pieces.time / pieces.units[0])


def _log_evidence(
    one: Alternative, law: Expansion, products: Products, nodes: np.ndarray, own: np.ndarray,
    width: np.ndarray, centre: np.ndarray,
) -> float:  # fmt: skip
    """Logarithm of the probability by one law, from products of the nodes' columns and its own."""
    found = [_laplace(products.combined(own), width, centre)]
    # Few readings tell no noise beside as many numbers.
    curves = smooth_curves(max(products.count // 2 - width.size, 0))
    smooth = products.combined(np.hstack([own, nodes @ curves]))
    log = smooth.log_prior + smooth.log_size(smooth.left())
    near = products.some(log > log.max() - LOG_LIKELIHOOD_RANGE)
    for kind in disturbances(law.numbers[0]):
        if kind.of_loss and law.pieces.gauge is not None:
            continue
        shown = nodes @ kind.reading_shapes(law.numbers[0])
        each = np.concatenate([np.broadcast_to(own, (len(shown), *own.shape)), shown], axis=2)
        numbers = shown.shape[2]
        known = np.append(width, np.ones(numbers)), np.append(centre, np.zeros(numbers))
        found.append(_laplace(near.by_each(each, kind.chance / SMOOTH_PRIOR), *known))
    return float(logsumexp(found)) + _log_chance(one, law)


def _given(law: Expansion, one: Alternative) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Columns of the numbers of an alternative, widths of their priors, and how far the numbers
    are from the middle of these.
    """
    loss, quadratic, power, *further = law.numbers
    extra: dict[int, tuple[float, float]] = {}
    if one.power:
        extra[POWER] = (EXPONENT_SD_BELOW if power < 0 else EXPONENT_SD_ABOVE), power
    if one.kind == "drift":
        extra[FURTHER] = DRIFT * max(abs(loss - quadratic), 1e-300), further[0]
    if one.count:
        sizes, times = _widths(one.kind, np.array(further[::2]), np.array(further[1::2]), loss)
        extra |= {FURTHER + 2 * k: (size, 0.0) for k, size in enumerate(sizes)}
        if one.kind != "sudden":
            extra |= {WHEN + 2 * k: (time, 0.0) for k, time in enumerate(times)}
    width, centre = np.array([(np.inf, 0.0)] * 3 + list(extra.values())).T
    return [LEVEL, *PLAIN, *extra], width, centre


def _laplace(products: Products, width: np.ndarray, centre: np.ndarray) -> float:
    """Log evidence of the first column by Laplace's approximation, the noise averaged over.

    Numbers of the other columns begin `centre` away from the middle of normal priors.
    """
    along, matrix = products.matrix[:, 1:, 0], products.matrix[:, 1:, 1:]
    after, first = products.matrix[:, 0, 0], products.matrix[:, 0, 0]
    for _ in range(3):
        unit = products.variance(after, width.size)[:, None]
        precision = matrix / unit[..., None] + np.diag(1 / width**2)
        scale = np.sqrt(np.einsum("kpp->kp", precision)) + 1e-300
        scaled = precision / scale[:, :, None] / scale[:, None, :] + 1e-12 * np.eye(width.size)
        pull = (along / unit + centre / width**2) / scale
        step = -np.linalg.solve(scaled, pull[..., None])[..., 0] / scale
        after = first + 2 * np.sum(along * step, 1) + np.einsum("kp,kpq,kq->k", step, matrix, step)
        after = np.maximum(after, 1e-30)
    log = products.log_prior + products.log_size(after)
    log = log - 0.5 * np.linalg.slogdet(scaled)[1] - np.log(scale).sum(1)
    finite = np.isfinite(width)
    log = log - 0.5 * np.sum(((centre + step) / width)[:, finite] ** 2, 1)
    return float(logsumexp(log)) - float(np.log(width[finite]).sum())


def _change(law: Expansion, of_a: bool = False) -> Change:
    """The lifetimes before and after each time, from the law with changes there."""
    (span, mean), count = law.pieces.units, law.numbers.size // 2 - 1
    times = law.numbers[4::2]
    x = np.interp(times * span, law.pieces.time, law.pieces.current) / mean

    def rates(level, loss, quadratic, power, *further):
        more = np.array(further[::2])
        own = loss + quadratic * (x - 1)
        sides = (own + (x if of_a else 1.0) * (np.cumsum(more) - part) for part in (more, 0.0))
        return np.concatenate([*sides, further[1::2]]) / span

    values, errors = law.quoted(rates, [LEVEL, *PLAIN, *range(FURTHER, law.rows.shape[1])])
    lifetimes = [lifetime_of(*one) for one in zip(values, errors, strict=True)]
    found = None
    for k in reversed(range(count)):
        time, error = (float(span**2 * part[2 * count + k]) for part in (values, errors))
        found = Change(time, error, lifetimes[k], lifetimes[count + k], found)
    return found


def _sudden_loss(law: Expansion) -> SuddenLoss:
    """The larger of two sudden losses, from the law with them."""
    (span, _), sizes, times = law.pieces.units, law.numbers[3::2], law.numbers[4::2]
    largest = int(np.argmax(np.abs(sizes)))
    # All times between two readings are one: the middle stands for them.
    after = int(np.searchsorted(law.pieces.time, times[largest] * span))
    when = float(law.pieces.time[after - 1 : after + 1].mean())
    model = law.pieces.current + law.off

    def lost(level, loss, quadratic, power, *further):
        return np.array([-model[after - 1] * np.expm1(-further[2 * largest])])

    columns = [LEVEL, *PLAIN, *range(FURTHER, law.rows.shape[1], 2)]
    [value], [error] = law.quoted(lost, columns)
    return SuddenLoss(when, Quantity(float(value), float(error), "mA"))


def _outgassing(law: Expansion) -> Outgassing:
    span, mean = law.pieces.units

    def numbers(level, loss, quadratic, power, further, when):
        b = loss - quadratic
        rate = quadratic * level + b
        return np.array([when * span / HOUR, quadratic / mean / span, b / span,
                         (rate + further) / span, rate / span])  # fmt: skip

    units = ("h", "1/(mA s)", "1/s", "1/s", "1/s")
    found = zip(*law.quoted(numbers, [LEVEL, *PLAIN, FURTHER, WHEN]), units, strict=True)
    constant, a, b, *rates = (Quantity(float(v), float(e), u) for v, e, u in found)
    before, after = (lifetime_of(rate.value, rate.error, clear=True) for rate in rates)
    return Outgassing(constant, a, b, before, after, float(law.level[0]) * mean)
