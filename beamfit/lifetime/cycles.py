"""Preparation of the cycles of a record with many refills, such as top-up, for one law, and the
course of their loss rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import logsumexp, ndtr, stdtr

from beamfit.lifetime.expansion import (
    LOSS,
    POWER,
    Expansion,
    Parts,
    Physical,
    Pieces,
    fit_law,
    least_squares_step,
)
from beamfit.lifetime.free_law import EXPONENT_SD_BELOW
from beamfit.lifetime.pieces import MIN_CYCLE_READINGS, MIN_CYCLES
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.statistics import CLEAR_ODDS, log_evidence_of_change

# Cycles whose settings and pressure agree to this share have one a and one b.
SETTING_TOLERANCE = 0.02
# Noise levels of a sawtooth, over its height, that are compared.
SAWTOOTH_NOISES = (0.01, 0.03, 0.1, 0.2)
# Priors of the period of refills and of the lifetime: median, s, standard deviation of the
# logarithm, and range of the logarithm of the flat part. Top-up refills come every 3 min within a
# factor 3, fills hours apart; usual lifetimes are 15 h within a factor 3, others seconds to years.
PERIOD, LIFETIME = (180.0, 1.2, 12.0), (15 * 3600.0, 1.2, 17.0)
# Share of the normal part of these priors; the rest is flat.
USUAL = 0.8
# Prior probability that a record without a decay has refills hidden by the noise.
HIDDEN_REFILLS_PRIOR = 0.1


def is_sawtooth(residuals: np.ndarray) -> bool:
    """Tell if residuals are spread evenly between two currents, by likelihood under normal noise.

    So are the readings of an archive that is too slow to resolve the refills. The rival is a normal
    distribution about one current.

    Examples
    --------
    >>> random = np.random.default_rng(1)
    >>> is_sawtooth(random.uniform(size=200)), is_sawtooth(random.normal(size=200))
    (True, False)
    """
    off = residuals - residuals.mean()
    normal = -off.size * (math.log(max(off.std(), 1e-300)) + 0.5 * math.log(2 * math.pi * math.e))
    best = -math.inf
    for share in SAWTOOTH_NOISES:
        width = math.sqrt(12) * off.std() / math.sqrt(1 + 12 * share**2)
        bounds = ((off + sign * width / 2) / (share * width) for sign in (1, -1))
        density = np.subtract(*map(ndtr, bounds)) / width
        best = max(best, float(np.sum(np.log(np.maximum(density, 1e-300)))))
    return best - normal > CLEAR_ODDS


def unresolved(usual: float, interval: float, lifetime: float) -> float:
    """Probability that refills faster than the sampling look like slower ones.

    Parameters
    ----------
    usual : float
        Readings from one visible refill to the next.
    interval : float
        Time between readings, s.
    lifetime : float
        Apparent lifetime of the cycles, s.

    Notes
    -----
    A sawtooth sampled at an interval looks the same for all periods that differ by whole phases: of
    the periods below two intervals one in usual² looks like this many readings a cycle. Both kinds
    are weighted by priors of the period of refills and of the lifetime.

    Examples
    --------
    >>> found = [unresolved(18, 10.0, 36000.0), unresolved(10, 600.0, 4e6)]
    >>> f"{found[0]:.3f}, {found[1]:.2f}"
    '0.002, 0.98'
    """
    loss = usual * interval / lifetime

    def chance(period: np.ndarray) -> np.ndarray:
        return _prior(period, *PERIOD) * _prior(period / loss, *LIFETIME)

    fast = np.geomspace(1e-3 * interval, 2 * interval, 200)
    others = float(np.trapezoid(chance(fast), np.log(fast))) / usual**2
    visible = float(chance(np.array(usual * interval))) / usual
    return others / max(others + visible, 1e-300)


def lives_longer(lifetime: float) -> float:
    """Prior probability of a lifetime longer than this one, s.

    Examples
    --------
    >>> f"{lives_longer(15 * 3600.0):.2f}, {lives_longer(1000 * 3600.0):.2f}"
    '0.50, 0.05'
    """
    middle, width, flat_range = LIFETIME
    log_ratio = math.log(lifetime / middle)
    normal, flat = float(ndtr(-log_ratio / width)), max(0.5 - log_ratio / flat_range, 0.0)
    return USUAL * normal + (1 - USUAL) * flat


def _prior(value: np.ndarray, middle: float, width: float, flat_range: float) -> np.ndarray:
    """Density in the logarithm: normal about the middle, with a part that is flat over a wide
    range.
    """
    normal = np.exp(-0.5 * (np.log(value / middle) / width) ** 2) / math.sqrt(2 * math.pi) / width
    return USUAL * normal + (1 - USUAL) / flat_range


def usual_cycle(cycles: Sequence[DecayRecord]) -> tuple[float, float]:
    """Median number of readings in a cycle, and time between them, s."""
    count = float(np.median([len(cycle) for cycle in cycles]))
    return count, float(np.median([cycle.span / (len(cycle) - 1) for cycle in cycles]))


def group_by_settings(cycles: Sequence[DecayRecord]) -> list[list[DecayRecord]]:
    """Group cycles with the same settings and pressure."""
    groups: list[tuple[np.ndarray, list[DecayRecord]]] = []
    for cycle in cycles:
        settings = np.array([0.0 if v is None else np.median(v) for v in cycle.conditions])
        for other, group in groups:
            if np.all(np.abs(settings - other) <= SETTING_TOLERANCE * np.maximum(settings, other)):
                group.append(cycle)
                break
        else:
            groups.append((settings, [cycle]))
    return [group for _, group in groups]


def join_cycles(cycles: Sequence[DecayRecord], name: str) -> DecayRecord:
    """Join the readings of many cycles to one record."""

    def concatenated(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
        if parts[0] is None:
            return None
        values = np.concatenate(parts)
        values.flags.writeable = False  # so that the record need not copy it
        return values

    begin, time = cycles[0].start, np.concatenate([cycle.time for cycle in cycles])
    ends = np.cumsum([len(cycle) for cycle in cycles[:-1]])
    for part, cycle in zip(np.split(time, ends), cycles, strict=True):
        part += cycle.start - begin
    time.flags.writeable = False
    mean = cycles[0].mean and float(np.mean([cycle.mean_current for cycle in cycles]))
    return DecayRecord(
        time, concatenated([cycle.current for cycle in cycles]),
        concatenated([cycle.error for cycle in cycles]), name, begin,
        Conditions(*map(concatenated, zip(*(c.conditions for c in cycles), strict=True))),
        notes=cycles[0].notes, mean=mean,
    )  # fmt: skip


# Above this many readings neighbours are averaged, in blocks within a cycle.
MAX_READINGS = 16384
# Readings or cycles this many robust standard deviations off are left out, if they hold at most
# this share of all readings.
OUTLIER, MAX_OUTLIER_SHARE = 7.0, 0.2
# Edge readings of cycles are left out if their mean over cycles is this many standard errors off
# the law; smaller shifts are in the errors (`beamfit.lifetime.expansion.SHIFTS`).
EDGE_THRESHOLD = 2.5
# Reasons for readings off the law at the edges of cycles.
WITHIN = "they lie within injections"
FRESH, SETTLES = "fresh beam decays faster", f"{WITHIN}, or the monitor settles"
# Neighbours with which a cycle, or a reading at the edge of one, is compared.
REFERENCE_NEIGHBOURS = 9
# Number of time constants of fresh beam that are tried; readings are left out until its excess has
# fallen to this share of its error.
TIME_CONSTANTS, FADED = 12, 0.1


def collect_cycles(cycles: Sequence[DecayRecord]) -> Pieces:
    """Collect the readings of cycles in time, averaged over neighbours within a cycle if there are
    very many.
    """
    size = -(-sum(map(len, cycles)) // MAX_READINGS)
    begin, row, parts = 0.0, 0, []
    starts_known = all(cycle.start is not None for cycle in cycles)
    for cycle in cycles:
        begin = cycle.start if starts_known else begin
        blocks = max(-(-len(cycle) // size), MIN_CYCLE_READINGS)  # few readings are left over
        time, current, error = cycle.means(len(cycle) // blocks)
        parts.append((begin + time, time - time[0], current, error, row))
        row += time.size
        begin += 2 * cycle.span  # unknown start: as if one cycle were missing in between
    time, since, current, errors, first = zip(*parts, strict=True)
    errors_given = all(error is not None for error in errors)
    return Pieces(
        *map(np.concatenate, (time, since, current)),
        np.concatenate(errors) if errors_given else None, np.array(first), None, cycles[0].monitor,
    )  # fmt: skip


def _outliers(values: np.ndarray, readings: np.ndarray | None = None) -> np.ndarray:
    """Flag outliers, unless they are too many, or hold too many of the readings."""
    off = np.abs(values - np.median(values))
    spread = 1.4826 * np.median(off)
    outliers = off > OUTLIER * spread
    if spread > 0 and np.average(outliers, weights=readings) <= MAX_OUTLIER_SHARE:
        return outliers
    return np.zeros(values.size, bool)


def _odd_cycles(expansion: Expansion) -> np.ndarray:
    """Flag cycles whose loss rate is far off that of the cycles near them, unless a neighbour has
    the same.

    Two cycles with the same rate may be a part of a course.
    """
    first, reduced = expansion.pieces.first, expansion.reduced
    slope, residual = reduced[:, LOSS], reduced[:, -1]
    squares = np.add.reduceat(slope**2, first)
    rate = -np.add.reduceat(slope * residual, first) / squares
    windows = sliding_window_view(
        np.pad(rate, REFERENCE_NEIGHBOURS // 2, mode="reflect"), REFERENCE_NEIGHBOURS
    )
    others = np.delete(windows, REFERENCE_NEIGHBOURS // 2, axis=1)
    off = rate - np.median(others, axis=1)
    differences = np.pad(np.abs(np.diff(rate)), 1, constant_values=np.inf)
    isolated = np.minimum(differences[:-1], differences[1:]) > 0.5 * np.abs(off)
    return _outliers(off * np.sqrt(squares), expansion.pieces.lengths) & isolated


def _uneven_cycles(expansion: Expansion) -> np.ndarray:
    """Flag cycles in which the loss rate changes suddenly: about a parabola of their own,
    neighbouring residuals are far more alike than in the others.

    Readings at the edges, which may be within injections, do not count.
    """
    lengths, index = expansion.pieces.lengths, expansion.pieces.index_in_piece
    edge = lengths // REFERENCE_NEIGHBOURS
    left, right = (np.repeat(values, lengths) for values in (edge, lengths - edge))
    inner, count = (index >= left) & (index < right), lengths - 2 * edge
    first = np.cumsum(count) - count

    def without(column: np.ndarray, other: np.ndarray) -> np.ndarray:
        sums = np.add.reduceat(np.column_stack([column * other, other**2]), first)
        return column - other * np.repeat(sums[:, 0] / np.maximum(sums[:, 1], 1e-300), count)

    columns = [*(index[inner, None] ** np.arange(3.0)).T, expansion.reduced[inner, -1]]
    while len(columns) > 1:
        columns = [without(column, columns[0]) for column in columns[1:]]
    residual = columns[0]
    most = OUTLIER * 1.4826 * float(np.median(np.abs(residual)))
    residual = np.clip(residual, -most, most)
    product = np.append(residual[1:] * residual[:-1], 0.0)
    product[first[1:] - 1] = 0.0
    alike = np.add.reduceat(product, first) / np.sqrt(count)
    return _outliers(alike, lengths) & (alike > 0) & (count > REFERENCE_NEIGHBOURS)


def _edge_excess(expansion: Expansion) -> np.ndarray:
    """Mean excess of the first and of the last readings of all cycles over their neighbours in the
    cycle, in standard errors.

    Fresh beam decays faster: the first reading lies above. Within an injection the first reading
    lies below, the last above.
    """
    first, lengths = expansion.pieces.first, expansion.pieces.lengths
    is_long = lengths > REFERENCE_NEIGHBOURS
    edges = np.array([first[is_long], (first + lengths - 1)[is_long]])
    if edges.shape[1] < MIN_CYCLES:
        return np.zeros(2)
    excess = -expansion.reduced[:, -1]
    scatter = max(1.4826 * float(np.median(np.abs(excess))), 1e-300)
    inward = np.array([[1], [-1]])[..., None] * np.arange(1, REFERENCE_NEIGHBOURS)
    differences = excess[edges] - excess[edges[..., None] + inward].mean(axis=2)
    differences = np.clip(differences / scatter, -OUTLIER, OUTLIER)
    return differences.mean(axis=1) * math.sqrt(
        edges.shape[1] / (1 + 1 / (REFERENCE_NEIGHBOURS - 1))
    )


def _settling_readings(expansion: Expansion, most: int) -> tuple[int, bool]:
    """Number of readings at the start of a cycle, at most `most`, until fresh beam or the monitor
    has settled, and whether they are high.

    Exponential tails are fitted; the error of their size is taken from its scatter between cycles,
    because the noise may have a memory.
    """
    pieces, first = expansion.pieces, expansion.pieces.first
    times = np.geomspace(1.0, max(most / math.log(EDGE_THRESHOLD / FADED), 1.0), TIME_CONSTANTS)
    tails = np.exp(-pieces.index_in_piece[:, None] / times)
    columns = expansion.without_levels(tails * pieces.weight[:, None])
    law = np.linalg.qr(expansion.reduced[:, expansion.columns(POWER)])[0]
    columns -= law @ (law.T @ columns)
    sums = np.add.reduceat(-expansion.reduced[:, [-1]] * columns, first)
    squares = np.add.reduceat(columns**2, first)
    off = sums - sums.sum(axis=0) / squares.sum(axis=0) * squares
    cycles = first.size
    error = np.sqrt(np.sum(off**2, axis=0) * cycles / (cycles - 1))
    excess = sums.sum(axis=0) / np.maximum(error, 1e-300)
    best = int(np.argmax(np.abs(excess)))
    size, high = abs(excess[best]), bool(excess[best] > 0)
    if not 2 * stdtr(cycles - 1, -size) * times.size < ndtr(-EDGE_THRESHOLD):
        return 0, high
    return min(math.ceil(math.log(size / FADED) * times[best]), most), high


def _trim_edges(expansion: Expansion) -> tuple[Expansion, list[str]]:
    """Fit without readings at the edges of cycles that do not belong to the decay; sentences say
    which.
    """
    cut, high = np.zeros(2, int), 0
    most = int(np.median(expansion.pieces.lengths)) // 3
    while cut.max() < most:
        first_off, last_off = _edge_excess(expansion)
        settling, settles_high = _settling_readings(expansion, most - cut[0])
        head = max(abs(first_off) > EDGE_THRESHOLD, settling)
        cut_now = np.array([head, last_off > EDGE_THRESHOLD], int)
        if not cut_now.any():
            break
        high += max(int(first_off > EDGE_THRESHOLD), settling * settles_high)
        index, lengths = expansion.pieces.index_in_piece, expansion.pieces.lengths
        length = np.repeat(lengths, lengths)
        keep = (index >= cut_now[0]) & (index < length - cut_now[1]) | (
            length <= REFERENCE_NEIGHBOURS
        )
        expansion = with_course(fit_law(expansion.pieces.select(keep, MIN_CYCLE_READINGS)))
        cut = cut + cut_now
    sentences = []
    for side, reason in enumerate((FRESH if 2 * high >= cut[0] else SETTLES, WITHIN)):
        if cut[side]:
            which = f"{('first', 'last')[side]} {cut[side]}"
            of_each = (
                "reading of each cycle was" if cut[side] == 1 else "readings of each cycle were"
            )
            sentences.append(f"the {which} {of_each} left out: {reason}")
    return expansion, sentences


def _omission(flags: np.ndarray, which: str) -> list[str]:
    """Sentence on the cycles that are left out."""
    count = int(flags.sum())
    return [f"{count} {'cycle was' if count == 1 else 'cycles were'} left out, {which}"]


def clean_cycles(cycles: Pieces) -> tuple[Expansion, tuple[str, ...]]:
    """Fit without readings, edges of cycles and cycles that do not belong to the decay; sentences
    say which.
    """
    plain, sentences = fit_law(cycles), []
    expansion = with_course(plain)
    if (uneven := _uneven_cycles(expansion)).any():
        cycles = cycles.select(~np.repeat(uneven, cycles.lengths), MIN_CYCLE_READINGS)
        plain = fit_law(cycles)
        expansion = with_course(plain)
        sentences += _omission(uneven, "in which the loss rate changes")
    expansion, edges = _trim_edges(expansion)
    sentences += edges
    before = expansion.pieces
    plain = plain if before is cycles else fit_law(before)
    if (odd := _odd_cycles(plain)).any():
        cut = np.repeat(odd, before.lengths)
        expansion = with_course(fit_law(before.select(~cut, MIN_CYCLE_READINGS)))
        sentences += _omission(odd, "whose loss rate lies far off the others'")
    if (outliers := _outliers(expansion.reduced[:, -1])).any():
        sentences.append(f"{int(outliers.sum())} readings were left out as outliers")
        expansion = with_course(fit_law(expansion.pieces.select(~outliers, MIN_CYCLE_READINGS)))
    return expansion, tuple(sentences)


# Prior probability that the loss rate changes within a part, as in a machine left alone.
CHANGE_PRIOR = 0.05
# Smallest number of cycles in a part, and largest number of parts, enough for any course.
MIN_PART_CYCLES, MAX_PARTS = 2, 64
# Gauss-Newton steps for the departures of the parts; they converge quadratically.
COURSE_STEPS = 3


def with_course(expansion: Expansion) -> Expansion:
    """Divide cycles into parts with different loss rates, as far as the readings support it.

    Parameters
    ----------
    expansion : Expansion
        Fit of many cycles with one a and one b.

    Returns
    -------
    Expansion
        The same if one loss rate suffices; else the expansion about the mean rate and the
        departures of the parts.

    Notes
    -----
    A part is divided if that is more probable than not, given the rates of its cycles with one mean
    and with two. Place and size of the change are averaged over, and the noise level follows from
    the differences of neighbouring cycles.

    Examples
    --------
    >>> t, noise = np.arange(0.0, 180.0, 10.0), np.random.default_rng(1).normal(size=(40, 18))
    >>> lives = np.where(np.arange(40) < 20, 36000.0, 30000.0)
    >>> pairs = zip(lives, noise, strict=True)
    >>> beam = [DecayRecord(t, 500 * np.exp(-t / life) + 1e-3 * row) for life, row in pairs]
    >>> with_course(fit_law(collect_cycles(beam))).parts.first.size
    2
    """
    if not expansion.converged or expansion.level.size < 2 * MIN_PART_CYCLES:
        return expansion
    rate, error = _cycle_rates(expansion)
    differences = np.abs(np.diff(rate)) / np.hypot(error[1:], error[:-1])
    error = error * max(1.4826 * float(np.median(differences)), 1e-12)
    begins = _part_begins(rate, error, abs(float(expansion.numbers[0])))
    return _with_parts(expansion, np.array([0, *begins])) if begins else expansion


def _cycle_rates(expansion: Expansion) -> tuple[np.ndarray, np.ndarray]:
    """Departure of the loss of each cycle from the mean, in units of the search, and its error for
    unit noise.

    The effect of a power of a, within its prior, on cycles at different currents is subtracted.
    """
    first, slope = expansion.pieces.first, expansion.reduced[:, LOSS]
    squares = np.add.reduceat(slope**2, first)
    columns = expansion.reduced[:, [POWER, -1]]
    power, rate = np.add.reduceat(slope[:, None] * columns, first).T / squares
    power, rate = (part - np.average(part, weights=squares) for part in (power, -rate))
    variance = max(float(squares @ rate**2) / rate.size, 1e-300)
    exponent = float(squares @ (power * rate)) / (
        squares @ power**2 + variance / EXPONENT_SD_BELOW**2
    )
    return rate - exponent * power, 1 / np.sqrt(squares)


def _part_begins(rate: np.ndarray, error: np.ndarray, mean: float) -> list[int]:
    """First cycles of all parts but the first; the most probable changes are taken first."""

    def with_change(begin: int, end: int) -> tuple[float, int, int, int]:
        odds, cut = _change(rate[begin:end], error[begin:end], mean)
        return odds, begin, begin + cut, end

    parts = [with_change(0, rate.size)]
    while len(parts) < MAX_PARTS and max(parts)[0] > 0:
        _, begin, cut, end = parts.pop(parts.index(max(parts)))
        parts += [with_change(begin, cut), with_change(cut, end)]
    return sorted(begin for _, begin, *_ in parts if begin)


def _change(rate: np.ndarray, error: np.ndarray, mean: float) -> tuple[float, int]:
    """Log odds that the rate changes among some cycles, and the most probable cycle after it."""
    if rate.size < 2 * MIN_PART_CYCLES:
        return -np.inf, 0
    weight = 1 / error**2
    before, sums = np.cumsum(weight)[:-1], np.cumsum(weight * rate)[:-1]
    after = weight.sum() - before
    change = (weight @ rate - sums) / after - sums / before
    variance = 1 / before + 1 / after
    inner = slice(MIN_PART_CYCLES - 1, rate.size - MIN_PART_CYCLES)
    change, variance = change[inner], variance[inner]
    dof = rate.size - 1  # of the noise, from the differences of neighbours
    log = log_evidence_of_change(change**2 / variance, mean**2 / variance, dof)
    odds = logsumexp(log) - np.log(log.size) + np.log(CHANGE_PRIOR / (1 - CHANGE_PRIOR))
    return float(odds), int(np.argmax(log)) + MIN_PART_CYCLES


def _with_parts(expansion: Expansion, begins: np.ndarray) -> Expansion:
    """Expand the law about the mean loss rate and the departures of parts that begin with these
    cycles.

    Departures weighted by time add up to zero, so that the last one follows from the others. A
    cycle counts for the time until the next one, including an omitted cycle of the usual length but
    not a gap; the time between two parts is shared equally. Departures may be large, so that the
    expansion is repeated `COURSE_STEPS` times.
    """
    first, time = expansion.pieces.first[begins], expansion.pieces.time
    count = np.diff(first, append=time.size)
    durations = np.diff(time[expansion.pieces.first], append=time[-1])
    spans = time[expansion.pieces.first + expansion.pieces.lengths - 1]
    spans = spans - time[expansion.pieces.first]
    durations = np.minimum(durations, spans + float(np.median(durations)))
    shared = 0.5 * (durations - spans)[begins[1:] - 1]
    part_time = np.add.reduceat(durations, begins) + np.append(0.0, shared) - np.append(shared, 0.0)
    shares = np.vstack([np.eye(begins.size - 1), -part_time[:-1] / part_time[-1]])
    numbers, departure = expansion.numbers, np.zeros(begins.size)
    for _ in range(COURSE_STEPS):
        found = Expansion.of(
            expansion.pieces, numbers, expansion.level, departure=np.repeat(departure, count)
        )
        rows = np.column_stack([found.rows, found.rows[:, [LOSS]] * np.repeat(shares, count, 0)])
        slopes = np.pad(found.slopes, ((0, 0), (0, begins.size - 1)))
        parts = Parts(first, shares, departure)
        found = replace(found, rows=rows, slopes=slopes, parts=parts, prior=expansion.prior)
        if not found.converged:  # the law has no value for such a course
            return expansion
        columns = found.columns()
        step = least_squares_step(found.reduced[:, [*columns, -1]], np.zeros((0, len(columns) + 1)))
        numbers, departure = numbers + np.append(step[:2], 0.0), departure + shares @ step[2:]
    return replace(
        found, numbers=numbers, residuals=found.reduced[:, -1] + found.reduced[:, columns] @ step,
        values=Physical(*(np.array(found.values) + slopes[:, columns] @ step)),
        parts=Parts(first, shares, departure),
    )  # fmt: skip
