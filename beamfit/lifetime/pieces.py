"""Cut a record into clean decays at refills, losses and gaps, without dropouts and spikes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d, uniform_filter1d
from scipy.special import logsumexp

from beamfit.answer import shown
from beamfit.errors import expect
from beamfit.lifetime.readings import (
    GAP,
    MIN_READINGS,
    NEIGHBOURS,
    THRESHOLD,
    WINDOW,
    by_chunks,
    noise_of,
)
from beamfit.lifetime.record import DecayRecord
from beamfit.statistics import POOR_FIT

# Readings below this share of the largest one near them are dropouts of the monitor.
DROPOUT = 0.02
# Quantile of the positive readings that is taken for the beam current: at least a hundredth of the
# readings must show the beam.
BEAM_QUANTILE = 0.99
# Standard error of the median of `WINDOW` values, over their standard deviation.
MEDIAN_ERROR = 0.42
# Share of changes that equal the local median change exactly above which digits are coarser than
# the noise. One of the nine values of the median always equals it.
MAX_EQUAL_SHARE = 1 / 3
# Relative rounding error of readings; a number against division by zero.
EXACT, TINY = 1e-11, 1e-300
# Largest number of readings in a spike.
MAX_SPIKE = 3
# A ramp at the head of a piece: length of the moving average, share of the rise by which a fall
# ends it, and factor by which it exceeds any later rise.
RAMP_WINDOW, RAMP_FALL, RAMP_RISE = 5, 0.1, 3.0
# Readings of the first block in a search for the return of the beam; each further block doubles.
FIRST_BLOCK = 4096
# Slow steps are sought in means of neighbours as long as there are at least this many means.
MIN_MEANS = 24
# At the end of a record, where the readings after it are unknown, a slow step must exceed the
# median change of the means by this factor.
END_FACTOR = 4.0
# Standard deviations by which two levels must differ. Lower than `THRESHOLD`: a false step only
# costs one more starting current.
LEVEL_THRESHOLD = 5.0
# Smallest number of changes that determines their scatter.
MIN_CHANGES = 20
# Smallest step, in units of the last digit.
MIN_STEP_DIGITS = 1.5
# Readings over which one law is assumed, and overlap of such chunks.
LAW_CHUNK, LAW_OVERLAP = 1 << 16, 1 << 11
# Longest mean for which the variance is computed; longer ones keep that of this length.
MAX_MEAN_LENGTH = 4096
# Degree of the smooth curve that stands for departures of a piece from the law: an exponent of a,
# gas that changes.
CURVE_DEGREE = 6
# Odds of steps are computed for groups of levels: levels in a group, largest numbers of groups and
# of means of readings in each, and number of correlation times of the noise.
GROUP_LEVELS, MAX_GROUPS, MAX_MEANS, CORRELATION_TIMES = 20, 8, 512, 7
# The position of a step is refined within this many readings of the first guess, by means over at
# most this many readings on either side.
POSITION_RANGE, POSITION_WINDOW = 8, 64
# Largest number of iterations between the steps and the law that they leave.
MAX_ITERATIONS = 20
# Pieces shorter than this share of the usual length are omitted, as the head of a cycle.
SHORT = 0.25
# Cycles are regular if their lengths agree to this share.
PERIOD_TOLERANCE = 0.1
# Smallest share of the lost current that refills must give back, and smallest share of the steps
# that must be refills.
MIN_RETURNED = 0.5
# Smallest number of cycles that are fitted together, and of readings in each.
MIN_CYCLES, MIN_CYCLE_READINGS = 3, 3


class Event(NamedTuple):
    """Something in a record other than a smooth decay.

    Attributes
    ----------
    kind : str
        `refill`, `loss`, `dropout`, `spike`, `saturated`, `stuck` (a monitor that repeats one
        reading), `gap`, `ramp` (a refill of many readings, or the end of one at the head of a
        decay), `short` (a piece too short to keep), `loss rate changes` or `gas is pumped away`
        (until then).
    time : float
        Begin, s from the record's start.
    duration : float
        Duration, s.
    change : float
        Change of the current, mA.
    """

    kind: str
    time: float
    duration: float
    change: float

    def __str__(self) -> str:
        change = f" ({self.change:+.4g} mA)" if self.change else ""
        return f"{self.kind} at {self.time:.0f} s{change}"


@shown
class Split(NamedTuple):
    """Clean decays of a record, and the events between them.

    Attributes
    ----------
    segments : tuple of DecayRecord
        Decays without steps; named after the record, with #1, #2, ... if there is more than one.
    events : tuple of Event
        Parts that were cut away or noted, in order of time.
    """

    segments: tuple[DecayRecord, ...]
    events: tuple[Event, ...]


def _dropouts(current: np.ndarray) -> tuple[np.ndarray, int]:
    """Flag readings near zero before the beam comes back, and find the reading at which it is lost
    for good (their number if it is not).
    """
    flagged = np.zeros(current.size, bool)
    # Readings before the first beam have nothing before them to compare with.
    beam = np.quantile(current[current > 0], BEAM_QUANTILE) if np.any(current > 0) else 0.0
    flagged[: int(np.argmax(current > DROPOUT * beam))] = True
    # A dump may take a few readings.
    before = maximum_filter1d(current, WINDOW, origin=WINDOW // 2)[:-1]
    for start in np.flatnonzero(current[1:] < DROPOUT * before) + 1:
        if flagged[start]:
            continue
        back = _first_above(current, start, DROPOUT * before[start - 1])
        if back == current.size:
            return flagged, int(start)
        flagged[start:back] = True
    return flagged, current.size


def _first_above(current: np.ndarray, start: int, least: float) -> int:
    """Index of the first reading from `start` on of at least `least`; their number if none is."""
    block = FIRST_BLOCK
    while start < current.size:
        above = np.flatnonzero(current[start : start + block] >= least)
        if above.size:
            return int(start + above[0])
        start, block = start + block, 2 * block
    return current.size


def _saturated(current: np.ndarray) -> np.ndarray:
    """Flag a run of identical largest readings far longer than any other run of equal ones."""
    starts = np.flatnonzero(np.diff(current, prepend=np.nan) != 0)
    lengths = np.diff(starts, append=current.size)
    highest = current[starts] == current.max()
    other = current.size if highest.all() else lengths[~highest].max()
    return np.repeat(highest & (lengths >= 5) & (lengths > 5 * other), lengths)


def _stuck(current: np.ndarray) -> np.ndarray:
    """Flag readings that repeat the one before in runs too long for chance.

    The chance of a repeat is that among the neighbouring readings (Laplace's rule of succession).
    """
    repeats = np.append(False, np.diff(current) == 0)
    first, end = np.array(_runs(repeats), int).reshape(-1, 2).T
    before, after = np.maximum(first - NEIGHBOURS, 0), np.minimum(end + NEIGHBOURS, current.size)
    total = np.append(0, np.cumsum(repeats))
    chances = [(total[b] - total[a] + 1) / (b - a + 2) for a, b in ((before, first), (end, after))]
    found = np.zeros(current.size, bool)
    for k in np.flatnonzero(current.size * np.max(chances, axis=0) ** (end - first) < POOR_FIT):
        found[first[k] : end[k]] = True
    return found


def _local_noise(departures: np.ndarray) -> np.ndarray:
    """Robust noise near each departure; where it changes the larger value counts."""
    noise = 1.4826 * median_filter(departures, NEIGHBOURS, mode="mirror")
    return maximum_filter1d(noise, NEIGHBOURS)


def _local_rate(time: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Median rate of change near each reading, which a single step does not move."""
    return median_filter(np.diff(current) / np.diff(time), WINDOW, mode="mirror")


def _spikes(time: np.ndarray, current: np.ndarray, noise: float) -> np.ndarray:
    """Flag up to three readings off the running median of the current, corrected for the local loss
    rate.

    They must exceed the change that a varying loss rate makes there, as at a refill.
    """
    loss = _local_rate(time, current) * np.diff(time)
    rate_range = maximum_filter1d(loss, WINDOW) - minimum_filter1d(loss, WINDOW)
    level = current - np.append(0.0, np.cumsum(loss))
    # The head is mirrored; the end is repeated, since a fall there is a loss, not a spike.
    padded = np.concatenate([level[MAX_SPIKE:0:-1], level, np.repeat(level[-1:], MAX_SPIKE)])
    median = median_filter(padded, 2 * MAX_SPIKE + 1)[MAX_SPIKE:-MAX_SPIKE]
    departure = np.abs(level - median)
    departure -= MAX_SPIKE * np.append(rate_range[0], rate_range)
    digits = _local_digits(current, np.diff(current) - loss)
    noise = np.maximum(noise, np.append(digits[0], digits) / 2)
    return departure > THRESHOLD * np.maximum(noise, _local_noise(departure))


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and past-the-last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def event_of(record: DecayRecord, kind: str, first: int, last: int, sudden: bool = False) -> Event:
    """Make the event from reading `first` to `last`; the change of a sudden one is that at its
    begin.
    """
    begin, end = (first - 1, first) if sudden and first else (first, last)
    duration = record.time[last] - record.time[first]
    change = record.current[end] - record.current[begin]
    return Event(kind, float(record.time[first]), float(duration), float(change))


def beam_readings(record: DecayRecord) -> tuple[np.ndarray, list[Event]]:
    """Find the readings that show the beam (indices), and the events that explain the others."""
    dropouts, end_of_beam = _dropouts(record.current)
    found = {"dropout": dropouts, "saturated": _saturated(record.current)}
    kept = np.flatnonzero(~dropouts & ~found["saturated"] & (np.arange(len(record)) < end_of_beam))
    if kept.size >= MIN_READINGS:
        for kind in ("stuck", "spike"):
            found[kind] = np.zeros(len(record), bool)
        time, current = record.time[kept], record.current[kept]
        digit = record.resolution or 0.0
        if np.median(np.abs(np.diff(current))) > digit:  # else equal readings are usual
            repeats = _stuck(current)
            found["stuck"][kept[repeats]] = True
            kept = kept[~repeats]
            time, current = record.time[kept], record.current[kept]
        noise = max(noise_of(time, current), digit / 2)
        spikes = by_chunks(lambda t, i: _spikes(t, i, noise), time, current)
        found["spike"][kept[spikes]] = True
        kept = kept[~spikes]
    events = [
        event_of(record, kind, first, end - 1, sudden=True)
        for kind, flags in found.items()
        for first, end in _runs(flags)
    ]
    if end_of_beam < len(record):
        events.append(event_of(record, "loss", end_of_beam, len(record) - 1, sudden=True))
    return kept, events


def _local_digits(current: np.ndarray, excess: np.ndarray) -> np.ndarray:
    """Last digit near each change; 0 where the noise is larger than the digits.

    It is the median nonzero departure or, if that is smaller, the median nonzero change: in a beam
    that loses one digit at each reading only refills depart. A record may come from several
    detectors.
    """
    rounding = EXACT * np.max(current)
    equal = (np.abs(excess) <= rounding).astype(float)
    quantised = uniform_filter1d(equal, NEIGHBOURS) > MAX_EQUAL_SHARE
    if not quantised.any():
        return np.zeros(excess.size)

    def running_median(size: np.ndarray) -> np.ndarray:
        nonzero = np.flatnonzero(size > rounding)
        if not nonzero.size:
            return np.zeros(size.size)
        near = median_filter(size[nonzero], NEIGHBOURS, mode="mirror")
        return near[np.minimum(np.searchsorted(nonzero, np.arange(size.size)), nonzero.size - 1)]

    near = np.minimum(running_median(np.abs(excess)), running_median(np.abs(np.diff(current))))
    return maximum_filter1d(np.where(quantised, near, 0.0), NEIGHBOURS)


def _step_scores(time: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Steps between neighbouring readings, shape (n - 1, 3).

    Columns are the change less that of the decay around it, its size beyond half of the usual loss
    in local standard deviations, and the last digit near it.
    """

    def scores_of_chunk(time: np.ndarray, current: np.ndarray) -> np.ndarray:
        interval, change, local_rate = np.diff(time), np.diff(current), _local_rate(time, current)
        error = MEDIAN_ERROR * interval * _local_noise(np.abs(change / interval - local_rate))
        loss = local_rate * interval
        excess = change - loss
        min_scatter = max(_scatter(excess), EXACT * np.max(current))
        scatter = np.maximum(min_scatter, _local_noise(np.abs(excess)))
        score = (np.abs(excess) - 0.5 * np.abs(loss)) / (np.hypot(scatter, error) + TINY)
        found = np.column_stack([excess, score, _local_digits(current, excess)])
        return np.vstack([np.zeros(3), found]).astype(np.float32)  # 120 MB for 1e7 readings

    return by_chunks(scores_of_chunk, time, current)[1:]


def _ramp_end(smooth: np.ndarray, low: float, noise: float) -> int:
    """Index of the end of a rise: the current falls again by more than noise and a tenth of the
    rise.
    """
    top = np.maximum.accumulate(smooth)
    falls = np.flatnonzero(top - smooth > np.maximum(5 * noise, RAMP_FALL * (top - low)))
    return int(np.argmax(smooth[: falls[0] if falls.size else None]))


def _ramp_length(current: np.ndarray, noise: float) -> int:
    """Count the readings of injection at the head of a piece.

    The current rises by more than the noise and three times more than anywhere later. Half as many
    readings again are cut, since the last part of a smooth ramp is below that, but at most half of
    those that follow.
    """
    rise = np.max(current) - np.min(current[:RAMP_WINDOW])
    if current.size < 3 * MIN_READINGS or rise <= 6 * noise:
        return 0
    smooth = np.convolve(current, np.full(RAMP_WINDOW, 1 / RAMP_WINDOW), "valid")
    highest = _ramp_end(smooth, smooth[0], noise)
    rest = smooth[highest:]
    later = float(np.max(rest - np.minimum.accumulate(rest)))
    if smooth[highest] - smooth[0] <= max(6 * noise, RAMP_RISE * later):
        return 0
    end = highest + RAMP_WINDOW // 2
    cut = end + min(end, current.size - end) // 2 + 1
    return cut if current.size - cut >= MIN_READINGS else 0


def _flag_slow_steps(significant: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Flag changes between means that exceed the law.

    At the head rises are left to `_ramp_length`; at the end, where the readings after it are
    unknown, a change must be much larger.
    """
    slow, edge = (significant < 0) | (significant > 0) & (change > 0), WINDOW // 2
    slow[:edge] = False
    slow[-edge:] &= np.abs(change[-edge:]) > END_FACTOR * np.median(np.abs(change))
    return slow


class Step(NamedTuple):
    """A fall or a rise of the current.

    Attributes
    ----------
    first : int
        Index of its first reading.
    end : int
        Index of the first reading after it; the same if the step is sudden.
    rises : bool
        True if it is a rise.
    """

    first: int
    end: int
    rises: bool


def _slow_step_bounds(first: int, last: int, size: int, cuts: np.ndarray) -> tuple[int, int]:
    """First reading of a step between means of `size` readings, and the first one after it.

    They extend to a neighbouring step of `cuts` if that is near. Half as many readings again are
    left out, since the last part of a smooth step is below the threshold.
    """
    begin, end = first * size, (last + 1) * size + (last + 1 - first) * size // 2
    place = np.searchsorted(cuts, begin, "right")
    before, after = int(cuts[place - 1]), int(cuts[place])
    return before if begin - before < 2 * size else begin, after if after - end < 2 * size else end


def _find_clear_steps(
    time: np.ndarray, current: np.ndarray, digit_of_all: float
) -> tuple[list[Step], np.ndarray, np.ndarray]:
    """Find clear steps of single readings and of the means of 2, 4, 8, ... neighbours.

    Returns
    -------
    steps : list of Step
        In order of time.
    candidates : array of bool, shape (n,)
        Readings near which there may be further steps.
    digits : array, shape (n,)
        Last digit near each reading, at least `digit_of_all`.
    """
    size, steps, level = 1, [], current.copy()
    flagged, candidates = np.zeros(level.size, bool), np.zeros(level.size, bool)
    while level.size // size >= (MIN_MEANS if size > 1 else 2):
        for shift in range(0, size, max(size // 2, 1)):
            count = (level.size - shift) // size
            columns = (v[shift : shift + count * size] for v in (time, level, flagged, candidates))
            t, x, in_step, tried = (v.reshape(count, size) for v in columns)
            t, x = t.mean(axis=1), x.mean(axis=1)
            in_step, tried = in_step.any(axis=1), tried.any(axis=1)
            excess, score, digit = _step_scores(t, x).T
            del t, x  # 160 MB for 1e7 readings
            if size == 1:
                digits = np.maximum(np.append(np.float32(0), digit), np.float32(digit_of_all))
                min_step = THRESHOLD * np.maximum(_scatter(excess), digits * 2**-0.5)
            mean_digits = digits[shift + size :: size][: count - 1]
            limit = min_step[shift + size :: size][: count - 1]
            clear = (score > THRESHOLD) & (np.abs(excess) > limit)
            significant = np.where(clear & ~in_step[1:] & ~in_step[:-1], excess, np.float32(0))
            if size == 1:
                found = np.flatnonzero(significant)
                steps += [Step(k + 1, k + 1, significant[k] > 0) for k in found]
                flagged[1:] = clear
                level[1:] -= np.cumsum(significant, dtype=float)
            elif not shift:
                steps += (slow_steps := _slow_steps(steps, significant, level, size, min_step))
                for step in slow_steps:
                    flagged[step.first : max(step.end, step.first + 1)] = True
            free = ~tried[1:] & ~tried[:-1]
            peak_rows = _peaks(np.abs(excess), free, MIN_STEP_DIGITS * mean_digits)
            candidates[shift + (peak_rows + 1) * size] = True
        size *= 2
    return _merge_overlapping(steps), candidates, digits


def _scatter(values: np.ndarray) -> float:
    """Robust standard deviation about zero."""
    return float(1.4826 * np.median(np.abs(values), overwrite_input=True))


def _peaks(size: np.ndarray, free: np.ndarray, min_size: np.ndarray) -> np.ndarray:
    """Find changes that stand out among the free ones, and then among the rest of these."""
    found = np.zeros(size.size, bool)
    for _ in range(2):
        if free.sum() < MIN_CHANGES:
            break
        high = np.where(free, size, 0.0)
        found |= high > np.maximum(LEVEL_THRESHOLD * _scatter(high[free]), min_size)
        found &= high >= maximum_filter1d(high, 3)
        free = free & ~maximum_filter1d(found, 3)
    return np.flatnonzero(found)


def _slow_steps(
    before: Sequence[Step],
    significant: np.ndarray,
    level: np.ndarray,
    size: int,
    min_step: np.ndarray,
) -> list[Step]:
    """Find steps between means of `size` readings that are not in `before`.

    A step that one single change explains is sudden. Falls soon after a rise are left out: fresh
    beam may decay fast.
    """
    fresh = np.sort([0, *(step.end for step in before if step.rises)])
    ends = (end for step in before for end in step[:2])
    cuts, found = np.sort([-level.size, *ends, 2 * level.size]), []
    change = np.diff(level[: level.size // size * size].reshape(-1, size).mean(axis=1))
    for first, last in _runs(_flag_slow_steps(significant, change)):
        age = first * size - fresh[np.searchsorted(fresh, first * size, "right") - 1]
        if significant[first] < 0 and age < WINDOW // 2 * size:
            continue
        begin, end = _slow_step_bounds(first, last, size, cuts)
        single = np.diff(level[max(begin - 1, 0) : end])
        largest = int(np.argmax(np.abs(single)))
        if abs(significant[first:last].sum() - single[largest]) < 0.5 * min_step[begin]:
            begin = end = max(begin, 1) + largest
        found.append(Step(begin, min(end, level.size), bool(significant[first] > 0)))
    return found


def _merge_overlapping(steps: list[Step]) -> list[Step]:
    """Sort steps and merge those that overlap."""
    merged: list[Step] = []
    for step in sorted(steps):
        if merged and step.first < merged[-1].end:
            before = merged.pop()
            step = before._replace(end=max(step.end, before.end))
        merged.append(step)
    return merged


def split_record(record: DecayRecord) -> Split:
    """Cut a record at refills and loss steps, and drop readings that are not of the beam.

    Parameters
    ----------
    record : DecayRecord
        Any record: one decay, fills with refills between them, or top-up.

    Returns
    -------
    Split
        Decays of at least 8 readings, or cycles of at least 3, and the events between and in them.

    Notes
    -----
    A step must exceed ten robust standard deviations of the changes near it, and half of the usual
    loss meanwhile, as in a gap. Losses and refills of many readings, up to a twentieth of the
    record, are steps of the means of 2, 4, 8, ... neighbours; slower changes stay in the decay. A
    gap alone does not end a decay; a step across it does.

    Where refills hold the beam, smaller refills are sought, too. The loss is added back by one law
    -a I² - b I for all pieces. Two levels are then tested against one by their likelihood ratio,
    in noise whose correlation follows from the differences of neighbours. The law is fitted again
    with the steps found, until both agree. Steps of three standard deviations of the noise are
    found in cycles of 60 readings and more, steps of ten always. Most steps must raise the current,
    as refills do: those that a wrong law or the noise imitates go both ways.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(0.0, 4000.0, 10.0)
    >>> saw = 100 * np.exp(-(t % 2000) / 36000)
    >>> split = split_record(DecayRecord(t, saw))
    >>> len(split.segments), str(split.events[0])
    (2, 'refill at 2000 s (+5.378 mA)')
    """
    expect(record, DecayRecord, "beamfit.read_decay_record(path)")
    kept, events = beam_readings(record)
    if kept.size < MIN_READINGS:
        return Split((), tuple(events))
    interval = np.diff(record.time)
    for before in np.flatnonzero(interval > GAP * np.median(interval)):
        events.append(event_of(record, "gap", before, before + 1))
    del interval  # 80 MB for 1e7 readings
    clear = _divide_at_clear_steps(record, kept)
    pieces, steps, fewest = clear.pieces, [], MIN_READINGS
    if (finer := _divide_at_small_refills(record, clear)) is not None:
        (pieces, steps), fewest = finer, MIN_CYCLE_READINGS
    events += [*clear.steps, *steps]
    short = [piece for piece in pieces if piece.size < fewest]
    events += [event_of(record, "short", piece[0], piece[-1]) for piece in short]
    long = [piece for piece in pieces if piece.size >= fewest]
    names = [record.name if len(long) == 1 else f"{record.name}#{k + 1}" for k in range(len(long))]
    segments = tuple(record.select(rows, name) for rows, name in zip(long, names, strict=True))
    return Split(segments, tuple(sorted(events, key=lambda event: event.time)))


class ClearSteps(NamedTuple):
    """A record divided at clear steps.

    Attributes
    ----------
    pieces : list of array of int
        Indices of the readings between the steps.
    steps : list of Event
        The steps.
    candidates : array of bool, shape (n,)
        Readings that may be the first after a further step.
    digits : array, shape (n,)
        Last digit near each reading.
    """

    pieces: list[np.ndarray]
    steps: list[Event]
    candidates: np.ndarray
    digits: np.ndarray


def _divide_at_clear_steps(record: DecayRecord, kept: np.ndarray) -> ClearSteps:
    """Divide the readings at clear steps and cut ramps at the head of the pieces."""
    columns = record.time[kept], record.current[kept]
    steps, candidates, digits = _find_clear_steps(*columns, record.resolution or 0.0)
    ends, slow_starts, events = [], set(), []
    for first, end, rises in steps:
        if end > first:
            kind = "ramp" if rises else "loss"
            events.append(event_of(record, kind, kept[first], kept[end - 1]))
            slow_starts.add(kept[first])
        else:
            change = float(np.subtract(*record.current[kept[[first, first - 1]]]))
            kind = "refill" if rises else "loss"
            events.append(Event(kind, float(record.time[kept[first]]), 0.0, change))
        ends += [first, end]
    pieces = [p for p in np.split(kept, ends) if p.size and p[0] not in slow_starts]
    columns = np.zeros(len(record), bool), np.zeros(len(record), np.float32)
    for column, values in zip(columns, (candidates, digits), strict=True):
        column[kept] = values
    noise = noise_of(record.time[kept], record.current[kept])
    for k, piece in enumerate(pieces):
        if cut := _ramp_length(record.current[piece], max(noise, columns[1][piece].max() / 2)):
            events.append(event_of(record, "ramp", piece[0], piece[cut - 1]))
            pieces[k] = piece[cut:]
    return ClearSteps(pieces, events, *columns)


def _divide_at_small_refills(
    record: DecayRecord, clear: ClearSteps
) -> tuple[list[np.ndarray], list[Event]] | None:
    """Divide pieces further, at refills too small to be clear, and list these as events; None if
    refills do not hold the beam, or if no cycle is gained.

    Parts of less than three readings or a quarter of the usual length, such as spikes, injection
    ramps and fresh beam, are left out, and the search is repeated on the rest.
    """
    rows = np.concatenate(clear.pieces)
    number = np.repeat(np.arange(len(clear.pieces)), [*map(len, clear.pieces)])
    candidates = clear.candidates[rows]
    for _ in range(2):
        if rows.size < MIN_CHANGES:
            return None
        begins, level = _steps_by_law(record, rows, number, candidates, clear.digits[rows])
        lengths = np.diff(begins, append=rows.size)
        short = _flag_short_parts(number, begins, lengths)
        keep, lengths = np.repeat(~short, lengths), lengths[~short]
        rows, number, level = rows[keep], number[keep], level[keep]
        if not short.any():
            break
        candidates = np.zeros(rows.size, bool)
        candidates[np.cumsum(lengths) - lengths] = True
    parts, owner = _undo_divisions(record, clear.pieces, rows, number, lengths)
    count = _count_regular_cycles(np.array([*map(len, parts)]))
    pieces = [p for part, n in zip(parts, count, strict=True) for p in np.array_split(part, n)]
    owner, events, levels = np.repeat(owner, count), [], np.full(len(record), np.nan)
    levels[rows] = level
    for k in np.flatnonzero(np.diff(owner) == 0) + 1:
        sides = levels[pieces[k][:POSITION_RANGE]], levels[pieces[k - 1][-POSITION_RANGE:]]
        near = [side[~np.isnan(side)] for side in sides]
        change = float(np.subtract(*map(np.median, near))) if all(map(len, near)) else 0.0
        kind = "refill" if change > 0 else "loss"
        events.append(Event(kind, float(record.time[pieces[k][0]]), 0.0, change))
    cycles = sum(piece.size >= MIN_CYCLE_READINGS for piece in pieces)
    if cycles <= sum(piece.size >= MIN_READINGS for piece in clear.pieces):
        return None
    found = np.array([event.change for event in events])
    rises = found.sum() >= MIN_RETURNED * np.abs(found).sum()
    currents = [record.current[piece] for piece in pieces]
    if not (rises and _is_held_by_refills(currents, [*clear.steps, *events])):
        return None
    return pieces, [*events, *_omitted_events(record, clear.pieces, pieces)]


def _omitted_events(
    record: DecayRecord, clear: Sequence[np.ndarray], pieces: Sequence[np.ndarray]
) -> list[Event]:
    """List the readings of clear pieces that are in none of the new pieces."""
    omitted = np.zeros(len(record), bool)
    omitted[np.concatenate(clear)] = True
    omitted[np.concatenate(pieces)] = False
    return [event_of(record, "short", first, end - 1) for first, end in _runs(omitted)]


def _undo_divisions(
    record: DecayRecord,
    clear: Sequence[np.ndarray],
    rows: np.ndarray,
    number: np.ndarray,
    lengths: np.ndarray,
) -> tuple[list[np.ndarray], list[int]]:
    """Undo divisions that the record does not support; return the parts and the clear piece of
    each.

    A piece whose steps explain less than their sizes and positions cost, given a law of its own, a
    smooth curve and correlated noise, is made whole again, except at gaps.
    """
    begins = np.cumsum(lengths) - lengths
    pieces = np.flatnonzero(np.diff(number, prepend=-1)).tolist()
    parts_found, owner, gap_time = [], [], GAP * np.median(np.diff(record.time))
    for low, high in itertools.pairwise([*pieces, rows.size]):
        piece, kept = number[low], rows[low:high]
        first = begins[slice(*np.searchsorted(begins, (low, high)))] - low
        parts, all_rows = np.split(kept, first[1:]), clear[piece]
        if len(parts) > 1:
            after_gap = all_rows[1:][np.diff(record.time[all_rows]) > gap_time]
            gap = np.diff(np.searchsorted(after_gap, kept, "right"), prepend=0)[first] > 0
            if _log_odds_of_steps(record.time[kept], record.current[kept], first, gap) < 0:
                parts = np.split(all_rows, np.searchsorted(all_rows, kept[first[gap]]))
        parts_found += parts
        owner += [piece] * len(parts)
    return parts_found, owner


def _demeaned(columns: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Columns less their mean in each part; `first` are the first rows of the parts."""
    lengths = np.diff(first, append=len(columns))
    means = np.add.reduceat(columns, first) / lengths[:, None]
    return columns - np.repeat(means, lengths, axis=0)


def _log_odds_of_steps(
    time: np.ndarray, current: np.ndarray, first: np.ndarray, gap: np.ndarray
) -> float:
    """Log odds of all levels, which begin at `first`, against those alone that begin after a gap.

    Both have one law and a smooth curve in addition, and are averaged over the noise, because slow
    noise imitates levels. Of many levels only some groups are used.
    """
    from beamfit.noise.memory import Products  # JAX, for steps alone

    level = _add_back_loss(time, current, np.zeros(1, int))
    ends, odds, tested = np.append(first, time.size), 0.0, 0
    groups = np.array_split(np.arange(first.size), -(-first.size // GROUP_LEVELS))
    for k in np.unique(np.linspace(0, len(groups) - 1, MAX_GROUPS).astype(int)):
        edges = ends[groups[k][0] : groups[k][-1] + 2]
        size = -(-(edges[-1] - edges[0]) // MAX_MEANS)
        begin = np.concatenate([np.arange(*pair, size) for pair in itertools.pairwise(edges)])
        lengths = np.diff(begin, append=edges[-1])
        t, x = (np.add.reduceat(v[: edges[-1]], begin) / lengths for v in (time, level))
        at_gap = gap[groups[k][1:]]
        steps = np.greater_equal.outer(begin, edges[1:-1][np.argsort(~at_gap, kind="stable")])
        # In the index, not in time: across a gap the curve goes on smoothly.
        curve = chebvander(np.interp(begin, begin[[0, -1]], [-1.0, 1.0]), CURVE_DEGREE)
        columns = np.column_stack([x, curve, steps])
        products = Products.of(columns, t, False, CORRELATION_TIMES)
        dof = max(t.size - CURVE_DEGREE - edges.size + 1, 1)
        for sign, count in ((1, None), (-1, CURVE_DEGREE + 2 + at_gap.sum())):
            log_squares = np.log(products.left(count) + TINY)
            odds += sign * logsumexp(products.log_prior - 0.5 * dof * log_squares)
        tested += np.sum(~at_gap)
    return odds - tested / (first.size - 1) * _log_step_cost(np.diff(ends))


def _log_step_cost(lengths: np.ndarray) -> float:
    """Log evidence that the steps between levels of these lengths cost.

    A position costs log n, or, for regular cycles, the scatter of the lengths about the usual one.
    A size costs half the logarithm of the readings that determine it (G. Schwarz, Ann. Stat. 6
    (1978) 461).
    """
    steps, count = lengths.size - 1, lengths.sum()
    deviation = np.mean(np.abs(lengths - np.median(lengths)))
    regular = np.log(count) + steps * (1.0 + np.log1p(2 * deviation))
    size = 0.5 * np.log(count / lengths.size)
    return float(min(steps * np.log(count), regular) + steps * size)


def usual_length(lengths: np.ndarray) -> float:
    """Length of the part in which a typical reading lies.

    Examples
    --------
    >>> usual_length(np.array([1, 1, 1, 10]))
    10.0
    """
    return float(np.median(np.repeat(lengths, lengths)))


def _flag_short_parts(number: np.ndarray, begins: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Flag parts that are too short.

    A clear piece of eight readings or more is not left out altogether.
    """
    piece, sizes = number[begins], np.bincount(number)
    short = lengths < max(MIN_CYCLE_READINGS, SHORT * usual_length(lengths))
    emptied = np.bincount(piece, weights=~short) == 0
    return short & ~(emptied & (sizes >= MIN_READINGS))[piece]


def _count_regular_cycles(lengths: np.ndarray) -> np.ndarray:
    """Count the cycles in each piece, if most readings are in cycles of one usual length.

    A missed refill, too small to be found, would bend the long piece, which has most weight.
    """
    usual = usual_length(lengths)
    regular = np.abs(lengths - usual) <= max(PERIOD_TOLERANCE * usual, 1.0)
    if lengths @ regular < 0.5 * lengths.sum():
        return np.ones(lengths.size, int)
    return np.maximum(np.round(lengths / usual).astype(int), 1)


def is_refilled(split: Split) -> bool:
    """Tell three or more cycles held by refills from a decay with occasional steps.

    Refills give back at least half of what the cycles lose.
    """
    return _is_held_by_refills([cycle.current for cycle in split.segments], split.events)


def _is_held_by_refills(pieces: Sequence[np.ndarray], steps: Sequence[Event]) -> bool:
    """Tell if there are enough cycles and refills give back at least half of what these lose."""
    refills = [event.change for event in steps if event.kind in ("refill", "ramp")]
    lost = sum(float(current[0] - current[-1]) for current in pieces)
    enough = min(len(pieces), len(refills) + 1) >= MIN_CYCLES
    return enough and sum(refills) > MIN_RETURNED * lost > 0


def _steps_by_law(
    record: DecayRecord, rows: np.ndarray, number: np.ndarray, candidates: np.ndarray,
    digits: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Find the first readings of all levels, beginning with 0, and the current with the loss added
    back.

    Steps between the given pieces (`number`) are certain.
    """

    def steps_of_chunk(*columns: np.ndarray) -> np.ndarray:
        time, current, edge, candidate, digit = columns
        clear, found = np.flatnonzero(edge[1:]) + 1, np.zeros(time.size, bool)
        first_rows = np.flatnonzero((edge | candidate)[1:]) + 1
        steps, level, certain = _iterate_steps(time, current, clear, first_rows, digit)
        found[steps[certain]] = True
        loss = np.diff(level - current, prepend=0.0)
        return np.column_stack([found, loss]).astype(np.float32)

    edge, current = np.diff(number, prepend=number[0]) != 0, record.current[rows]
    columns = record.time[rows], current, edge, candidates, digits
    found, loss = by_chunks(steps_of_chunk, *columns, chunk=LAW_CHUNK, overlap=LAW_OVERLAP).T
    return np.append(0, np.flatnonzero(found)), current + np.cumsum(loss, dtype=float)


def _iterate_steps(
    time: np.ndarray,
    current: np.ndarray,
    clear: np.ndarray,
    candidates: np.ndarray,
    digits: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Iterate between steps and the law that they leave, until both agree.

    Returns the steps, the current with the loss added back, and which steps are certain: clear
    ones, and those between levels that differ significantly.
    """
    interval, steps = np.diff(time), candidates
    gaps = np.flatnonzero(interval > GAP * np.median(interval)) + 1
    for _ in range(MAX_ITERATIONS):
        # Each gap begins a level: a refill within it would be taken for the law.
        level = _add_back_loss(time, current, np.union1d(np.append(0, steps), gaps))
        total = np.append(0.0, np.cumsum(level))
        change = np.delete(np.diff(level), steps - 1)
        change = change if change.size >= MIN_CHANGES else np.diff(level)
        variance = _mean_variance(change, min(level.size, MAX_MEAN_LENGTH))
        found = _divide(total, clear, variance, digits)
        found = _refine_positions(total, found, clear)
        if np.array_equal(found, steps):
            break
        steps = found
    ends = np.concatenate([[0], steps, [level.size]])
    lengths = np.diff(ends)
    scatter = np.sqrt(variance(lengths[1:]) + variance(lengths[:-1]))
    significant = np.abs(np.diff(np.diff(total[ends]) / lengths)) > LEVEL_THRESHOLD * scatter
    return steps, level, significant | np.isin(steps, clear)


def _add_back_loss(time: np.ndarray, current: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Currents with the loss added back, by one a and one b for all pieces.

    One coefficient is left out unless it improves the fit by more than its cost (Schwarz
    criterion).
    """
    columns = np.array([current, current**2])
    parts = 0.5 * np.diff(time) * (columns[:, :-1] + columns[:, 1:])
    columns = np.vstack([np.zeros(2), np.cumsum(parts, axis=1).T])
    demeaned = _demeaned(np.column_stack([columns, current]), first)
    scale = np.linalg.norm(demeaned[:, :2], axis=0) + TINY
    residual, design = demeaned[:, 2], demeaned[:, :2] / scale
    eigenvalues, eigenvectors = np.linalg.eigh(design.T @ design)
    # The two columns are nearly parallel for a short decay: diagonalise.
    coefficients = eigenvectors.T @ (design.T @ residual) / np.maximum(eigenvalues, EXACT)
    explained = eigenvalues * coefficients**2
    reduced = max(residual @ residual - explained[1], 0.0) + TINY
    full = max(reduced - explained[0], EXACT * reduced)
    if time.size * np.log(reduced / full) < 2 * np.log(time.size):
        coefficients[0] = 0.0
    return current - columns @ (eigenvectors @ coefficients / scale)


def _divide(
    total: np.ndarray, steps: np.ndarray, variance: Callable[[np.ndarray], np.ndarray],
    digits: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Divide pieces in two as long as two levels explain them significantly better than one."""
    ends = [0, *steps.tolist(), total.size - 1]
    waiting, found = list(itertools.pairwise(ends)), steps.tolist()
    count = np.arange(1, total.size)
    variances = variance(count)
    while waiting:
        low, high = waiting.pop()
        if high - low < 2:
            continue
        size, sums = high - low - 1, total[low + 1 : high]
        left, own = count[:size], variances[:size]
        step = (total[high] - sums) / left[::-1] - (sums - total[low]) / left
        scatter = np.sqrt(own + own[::-1])
        best = int((np.abs(step) / scatter).argmax())
        least = MIN_STEP_DIGITS * digits[low:high].max()
        if abs(step[best]) > max(LEVEL_THRESHOLD * scatter[best], least):
            found.append(low + 1 + best)
            waiting += [(low, found[-1]), (found[-1], high)]
    return np.sort(np.array(found, int))


def _mean_variance(change: np.ndarray, longest: int) -> Callable[[np.ndarray], np.ndarray]:
    """Variance of the mean of a number of readings in autoregressive noise, from the readings'
    changes.

    Changes over two intervals have 1 + c times the variance of those over one, where c is the
    correlation of neighbours. Medians are used because of the steps.
    """
    change = change - np.median(change)  # loss that the law left over
    one, two = (np.median(np.abs(values)) for values in (change, change[1:] + change[:-1]))
    c = float(np.clip((two / max(one, EXACT * two, TINY)) ** 2 - 1, 0.0, 0.99))
    n = np.arange(1, longest + 1)
    # The sum of many readings: n + 2 sum (n - k) c^k.
    sums = n + 2 * (c * n / (1 - c) - c * (1 - c**n) / (1 - c) ** 2)
    table = (1.4826 * one) ** 2 / 2 / (1 - c) * sums / n**2 + TINY
    return lambda count: table[np.minimum(count, longest) - 1]


def _refine_positions(total: np.ndarray, steps: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """Move each step that is not clear to where two levels between its neighbours explain most."""
    ends, count = [0, *steps.tolist(), total.size - 1], np.arange(2 * POSITION_WINDOW)
    for k in (np.flatnonzero(~np.isin(steps, clear)) + 1).tolist():
        low = max(ends[k - 1], ends[k] - POSITION_WINDOW)
        high = min(ends[k + 1], ends[k] + POSITION_WINDOW)
        first = max(low + 1, ends[k] - POSITION_RANGE)
        last = min(high, ends[k] + POSITION_RANGE + 1)
        at = total[first:last]
        before, after = count[first - low : last - low], count[high - last + 1 : high - first + 1]
        after = after[::-1]
        step = (at - total[low]) / before - (total[high] - at) / after
        ends[k] = first + int((step**2 * before * after).argmax())
    return np.unique(np.array(ends[1:-1], int))
