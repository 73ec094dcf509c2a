"""Clean decays of a record: cut at refills, losses and gaps, without dropouts and spikes."""

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
    FEWEST,
    GAP,
    NEIGHBOURS,
    THRESHOLD,
    WINDOW,
    by_stretches,
    noise_of,
)
from beamfit.lifetime.record import DecayRecord
from beamfit.statistics import POOR_FIT

# Readings below this share of the largest one near them are dropouts of the monitor.
DROPOUT = 0.02
# A record shows the beam in a hundredth of its readings at least.
SEEN = 0.99
# Error of the median of `WINDOW` over the noise of what it is of.
OF_MEDIAN = 0.42
# Share of changes that equal the usual one near them to the numbers' own accuracy, beyond which
# digits are larger than the noise; the usual one is one of nine, and the median of these.
REPEATS, EXACT, TINY = 1 / 3, 1e-11, 1e-300
# Readings of a spike at most.
LONE = 3
# Readings whose means are looked at for a ramp at the head, the share of its rise by which a fall
# ends it, and by how much it exceeds any later rise.
SMOOTH, FALL, RISE = 5, 0.1, 3.0
# Readings that are looked through for one at first.
BLOCK = 4096
# Means of neighbours in which steps of many readings are sought, at least; at the end of a record,
# where what comes after is not known, they change so many times as much as usual.
COARSE, FASTER = 24, 4.0
# Standard deviations by which two levels must differ to be two: a false step costs no more than an
# own current for the rest.
LIKELY = 5.0
# Places that tell the scatter, at least.
PLACES = 20
# Least step in units of the last digit of the readings.
DIGITS = 1.5
# Readings that have one law, and how many beside them are looked at; readings beyond which the
# scatter of their mean is followed no farther.
ONE_LAW, BESIDE, LONG = 1 << 16, 1 << 11, 4096
# Degree of the smooth curve by which a piece may depart from a law: an exponent of a, gas that
# changes.
CURVED = 6
# Levels whose steps are weighed together, groups of them at most, means of readings by which, and
# correlation times of the noise that are looked at.
LEVELS, GROUPS, ROWS, NOISES = 20, 8, 512, 7
# A step is placed to the reading within so many of where it was seen, by so many on either side.
NEAR, WIDEST = 8, 64
# How often steps are sought with the law that those found leave.
ROUNDS = 20
# Share of the usual length below which a piece is the head of a cycle, as of fresh beam.
SHORT = 0.25
# Refills by the clock are so far apart to this share of it.
REGULAR = 0.1
# Share of what cycles lose that refills give back at least, and of steps that are to be refills.
RETURNED = 0.5
# Cycles that tell a law together, and readings of each.
FEWEST_CYCLES, FEWEST_READINGS = 3, 3


class Event(NamedTuple):
    """Something in a record other than a smooth decay.

    Attributes
    ----------
    kind : str
        `refill`, `loss`, `dropout`, `spike`, `saturated`, `stuck` (a monitor that repeats one
        reading), `gap`, `ramp` (a refill of many readings,
        or the end of one at the head of a decay), `short` (a piece too short to keep), `loss rate
        changes` or `gas is pumped away` (until then).
    time : float
        When it begins, s from the record's start.
    duration : float
        How long it lasts, s.
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
    """A record's clean decays, and what lies between them.

    Attributes
    ----------
    segments : tuple of DecayRecord
        Decays without steps; named after the record, with #1, #2, ... if there is more than one.
    events : tuple of Event
        What was cut away or noted, in order of time.
    """

    segments: tuple[DecayRecord, ...]
    events: tuple[Event, ...]


def _dropouts(current: np.ndarray) -> tuple[np.ndarray, int]:
    """Readings near zero although the beam comes back, and where it is gone for good."""
    flagged = np.zeros(current.size, bool)
    # Readings before the beam is seen have no reading before them to compare with.
    beam = np.quantile(current[current > 0], SEEN) if np.any(current > 0) else 0.0
    flagged[: int(np.argmax(current > DROPOUT * beam))] = True
    # A beam may be dumped over some readings.
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
    """The first reading from one on that is as large as this; their number if none is."""
    width = BLOCK
    while start < current.size:
        above = np.flatnonzero(current[start : start + width] >= least)
        if above.size:
            return int(start + above[0])
        start, width = start + width, 2 * width
    return current.size


def _saturated(current: np.ndarray) -> np.ndarray:
    """A run of identical largest readings, far longer than any other run of equal ones."""
    starts = np.flatnonzero(np.diff(current, prepend=np.nan) != 0)
    lengths = np.diff(starts, append=current.size)
    top = current[starts] == current.max()
    usual = current.size if top.all() else lengths[~top].max()
    return np.repeat(top & (lengths >= 5) & (lengths > 5 * usual), lengths)


def _stuck(current: np.ndarray) -> np.ndarray:
    """Readings that repeat the one before, of runs so long that by the readings on either side
    (Laplace's rule of succession) they are no chance.
    """
    repeats = np.append(False, np.diff(current) == 0)
    first, end = np.array(_runs(repeats), int).reshape(-1, 2).T
    before, after = np.maximum(first - NEIGHBOURS, 0), np.minimum(end + NEIGHBOURS, current.size)
    total = np.append(0, np.cumsum(repeats))
    sides = [(total[b] - total[a] + 1) / (b - a + 2) for a, b in ((before, first), (end, after))]
    found = np.zeros(current.size, bool)
    for k in np.flatnonzero(current.size * np.max(sides, axis=0) ** (end - first) < POOR_FIT):
        found[first[k] : end[k]] = True
    return found


def _noise_near(off: np.ndarray) -> np.ndarray:
    """Noise about each of some departures; where it changes the greater one counts."""
    return maximum_filter1d(1.4826 * median_filter(off, NEIGHBOURS, mode="mirror"), NEIGHBOURS)


def _usual_rate(time: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Rate of change near each reading, which a step does not move."""
    return median_filter(np.diff(current) / np.diff(time), WINDOW, mode="mirror")


def _spikes(time: np.ndarray, current: np.ndarray, noise: float) -> np.ndarray:
    """Up to three readings off the running median of what is level but for noise and steps; more
    than a decay whose rate changes there, as at a refill.
    """
    lost = _usual_rate(time, current) * np.diff(time)
    changes = maximum_filter1d(lost, WINDOW) - minimum_filter1d(lost, WINDOW)
    level = current - np.append(0.0, np.cumsum(lost))
    # The first reading by those after it; what falls at the end is a loss.
    beside = np.concatenate([level[LONE:0:-1], level, np.repeat(level[-1:], LONE)])
    off = np.abs(level - median_filter(beside, 2 * LONE + 1)[LONE:-LONE])
    off -= LONE * np.append(changes[0], changes)
    digits = _digits_near(current, np.diff(current) - lost)
    noise = np.maximum(noise, np.append(digits[0], digits) / 2)
    return off > THRESHOLD * np.maximum(noise, _noise_near(off))


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and past-the-last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def event_of(record: DecayRecord, kind: str, first: int, last: int, sudden: bool = False) -> Event:
    """An event from reading `first` to `last`; the change of a sudden one is that at its begin."""
    begin, end = (first - 1, first) if sudden and first else (first, last)
    lasts, change = (
        record.time[last] - record.time[first],
        record.current[end] - record.current[begin],
    )
    return Event(kind, float(record.time[first]), float(lasts), float(change))


def beam_readings(record: DecayRecord) -> tuple[np.ndarray, list[Event]]:
    """Indices of the readings that show the beam, and what the others are."""
    dropped, end_of_beam = _dropouts(record.current)
    found = {"dropout": dropped, "saturated": _saturated(record.current)}
    kept = np.flatnonzero(~dropped & ~found["saturated"] & (np.arange(len(record)) < end_of_beam))
    if kept.size >= FEWEST:
        for kind in ("stuck", "spike"):
            found[kind] = np.zeros(len(record), bool)
        time, current = record.time[kept], record.current[kept]
        digit = record.resolution or 0.0
        if np.median(np.abs(np.diff(current))) > digit:  # else equal readings are of one digit
            repeats = _stuck(current)
            found["stuck"][kept[repeats]] = True
            kept = kept[~repeats]
            time, current = record.time[kept], record.current[kept]
        noise = max(noise_of(time, current), digit / 2)
        lone = by_stretches(lambda t, i: _spikes(t, i, noise), time, current)
        found["spike"][kept[lone]] = True
        kept = kept[~lone]
    events = [
        event_of(record, kind, first, end - 1, sudden=True)
        for kind, flags in found.items()
        for first, end in _runs(flags)
    ]
    if end_of_beam < len(record):
        events.append(event_of(record, "loss", end_of_beam, len(record) - 1, sudden=True))
    return kept, events


def _digits_near(current: np.ndarray, excess: np.ndarray) -> np.ndarray:
    """The last digit near each change; 0 where few departures are zero. It is the usual size of
    those that are not, or of changes if that is less, as of a beam that loses one digit at each
    reading: only its refills depart. A record may be of several detectors.
    """
    least = EXACT * np.max(current)
    still = uniform_filter1d((np.abs(excess) <= least).astype(float), NEIGHBOURS) > REPEATS
    if not still.any():
        return np.zeros(excess.size)

    def usual(size: np.ndarray) -> np.ndarray:
        place = np.flatnonzero(size > least)
        if not place.size:
            return np.zeros(size.size)
        near = median_filter(size[place], NEIGHBOURS, mode="mirror")
        return near[np.minimum(np.searchsorted(place, np.arange(size.size)), place.size - 1)]

    near = np.minimum(usual(np.abs(excess)), usual(np.abs(np.diff(current))))
    return maximum_filter1d(np.where(still, near, 0.0), NEIGHBOURS)


def _departures(time: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Change from each reading to the next less what the decay around it explains; by how many
    standard deviations of such changes near it that exceeds half of what is lost; and the digit
    near it, shape (n - 1, 3).
    """

    def near(time: np.ndarray, current: np.ndarray) -> np.ndarray:
        interval, change, usual = np.diff(time), np.diff(current), _usual_rate(time, current)
        error = OF_MEDIAN * interval * _noise_near(np.abs(change / interval - usual))
        lost = usual * interval
        excess = change - lost
        least = max(_scatter(excess), EXACT * np.max(current))
        scatter = np.maximum(least, _noise_near(np.abs(excess)))
        score = (np.abs(excess) - 0.5 * np.abs(lost)) / (np.hypot(scatter, error) + TINY)
        found = np.column_stack([excess, score, _digits_near(current, excess)])
        return np.vstack([np.zeros(3), found]).astype(np.float32)  # of 1e7 readings 120 MB

    return by_stretches(near, time, current)[1:]


def _highest(smooth: np.ndarray, low: float, noise: float) -> int:
    """End of a rise from a low current: it falls again by more than noise and a tenth of it."""
    top = np.maximum.accumulate(smooth)
    falls = np.flatnonzero(top - smooth > np.maximum(5 * noise, FALL * (top - low)))
    return int(np.argmax(smooth[: falls[0] if falls.size else None]))


def _ramp(current: np.ndarray, noise: float) -> int:
    """Count the readings of injection at the head of a piece: the current still rises, by more
    than noise and three times more than anywhere later. Half as many again are cut, where a ramp
    that ends smoothly still counts.
    """
    if current.size < 3 * FEWEST or np.max(current) - np.min(current[:SMOOTH]) <= 6 * noise:
        return 0
    smooth = np.convolve(current, np.full(SMOOTH, 1 / SMOOTH), "valid")
    highest = _highest(smooth, smooth[0], noise)
    after = smooth[highest:]
    later = float(np.max(after - np.minimum.accumulate(after)))
    if smooth[highest] - smooth[0] <= max(6 * noise, RISE * later):
        return 0
    cut = int(1.5 * (highest + SMOOTH // 2)) + 1
    return cut if current.size - cut >= FEWEST else 0


def _is_slow_step(beyond: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Which changes from mean to mean are more than the law: not at the head, where what rises is a
    ramp; at the end, where nothing comes after, much more.
    """
    seen, ends = (beyond < 0) | (beyond > 0) & (change > 0), WINDOW // 2
    seen[:ends] = False
    seen[-ends:] &= np.abs(change[-ends:]) > FASTER * np.median(np.abs(change))
    return seen


class Step(NamedTuple):
    """A fall or a rise: the first reading of it, the first one after it, which is the same where it
    is sudden, and if it is a rise.
    """

    first: int
    end: int
    rises: bool


def _bounds(first: int, last: int, size: int, cuts: np.ndarray) -> tuple[int, int]:
    """Readings of a step from one mean of so many to another, up to one that was found before if
    that is near: beside it none was sought. Half as many again are left out, where a step that ends
    smoothly still counts.
    """
    begin, end = first * size, (last + 1) * size + (last + 1 - first) * size // 2
    place = np.searchsorted(cuts, begin, "right")
    before, after = int(cuts[place - 1]), int(cuts[place])
    return before if begin - before < 2 * size else begin, after if after - end < 2 * size else end


def _search(
    time: np.ndarray, current: np.ndarray, digit_of_all: float
) -> tuple[list[Step], np.ndarray, np.ndarray]:
    """Clear steps of readings and of the means of 2, 4, 8, ... neighbours, in order; readings about
    which there may be others; and the last digit near each reading, at least that of all.
    """
    size, steps, level = 1, [], current.copy()
    known, likely = np.zeros(level.size, bool), np.zeros(level.size, bool)
    while level.size // size >= (COARSE if size > 1 else 2):
        for late in range(0, size, max(size // 2, 1)):
            count = (level.size - late) // size
            columns = (v[late : late + count * size] for v in (time, level, known, likely))
            t, x, old, seen = (v.reshape(count, size) for v in columns)
            t, x, old, seen = t.mean(axis=1), x.mean(axis=1), old.any(axis=1), seen.any(axis=1)
            excess, score, digit = _departures(t, x).T
            if size == 1:
                digits = np.maximum(np.append(np.float32(0), digit), np.float32(digit_of_all))
                least = THRESHOLD * np.maximum(_scatter(excess), digits * 2**-0.5)
            coarse = digits[late + size :: size][: count - 1]
            clear = (score > THRESHOLD) & (np.abs(excess) > least[late + size :: size][: count - 1])
            beyond = np.where(clear & ~old[1:] & ~old[:-1], excess, np.float32(0))
            if size == 1:
                steps += [Step(k + 1, k + 1, beyond[k] > 0) for k in np.flatnonzero(beyond)]
                known[1:] = clear
                level[1:] -= np.cumsum(beyond, dtype=float)
            elif not late:
                steps += (more := _slow_steps(steps, beyond, level, size, least))
                for step in more:
                    known[step.first : max(step.end, step.first + 1)] = True
            free = ~seen[1:] & ~seen[:-1]
            peaks = _peaks(np.abs(excess), free, DIGITS * coarse)
            likely[late + (peaks + 1) * size] = True
        size *= 2
    return _joined(steps), likely, digits


def _scatter(values: np.ndarray) -> float:
    """Robust standard deviation about zero."""
    return float(1.4826 * np.median(np.abs(values)))


def _peaks(size: np.ndarray, free: np.ndarray, grain: np.ndarray) -> np.ndarray:
    """Changes that stand out among those that are free of what was found before, and of these."""
    found = np.zeros(size.size, bool)
    for _ in range(2):
        if free.sum() < PLACES:
            break
        high = np.where(free, size, 0.0)
        found |= high > np.maximum(LIKELY * _scatter(high[free]), grain)
        found &= high >= maximum_filter1d(high, 3)
        free = free & ~maximum_filter1d(found, 3)
    return np.flatnonzero(found)


def _slow_steps(
    before: Sequence[Step], beyond: np.ndarray, level: np.ndarray, size: int, least: np.ndarray
) -> list[Step]:
    """Steps from mean to mean of so many readings besides others, those sudden that a single change
    makes. Fresh beam, as after a rise, may fall fast by itself.
    """
    fresh = np.sort([0, *(step.end for step in before if step.rises)])
    ends = (end for step in before for end in step[:2])
    cuts, found = np.sort([-level.size, *ends, 2 * level.size]), []
    change = np.diff(level[: level.size // size * size].reshape(-1, size).mean(axis=1))
    for first, last in _runs(_is_slow_step(beyond, change)):
        since = first * size - fresh[np.searchsorted(fresh, first * size, "right") - 1]
        if beyond[first] < 0 and since < WINDOW // 2 * size:
            continue
        begin, end = _bounds(first, last, size, cuts)
        single = np.diff(level[max(begin - 1, 0) : end])
        largest = int(np.argmax(np.abs(single)))
        if abs(beyond[first:last].sum() - single[largest]) < 0.5 * least[begin]:
            begin = end = max(begin, 1) + largest
        found.append(Step(begin, min(end, level.size), bool(beyond[first] > 0)))
    return found


def _joined(steps: list[Step]) -> list[Step]:
    """Steps in order, those that overlap as one."""
    apart: list[Step] = []
    for step in sorted(steps):
        if apart and step.first < apart[-1].end:
            before = apart.pop()
            step = before._replace(end=max(step.end, before.end))
        apart.append(step)
    return apart


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
    A step must exceed ten robust standard deviations of the changes near it, and of what is lost
    meanwhile, as in a gap. Losses and refills of many readings, up to a twentieth of the record,
    are steps of the means of 2, 4, 8, ... neighbours; slower changes stay in. A gap alone does not
    end a decay; a step across it does.

    Where refills hold the beam smaller ones are sought, too. One law -a I² - b I for all pieces
    puts the loss back, and two levels are tested against one by their likelihood ratio, in noise
    whose memory the differences of neighbours show; what is found improves the law, and so on.
    Steps of three standard deviations of the noise are found in cycles of 60 readings and more, of
    ten always. Most of them must raise the current, as refills do: what a wrong law or the noise
    makes of a decay goes both ways.

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
    if kept.size < FEWEST:
        return Split((), tuple(events))
    interval = np.diff(record.time)
    for before in np.flatnonzero(interval > GAP * np.median(interval)):
        events.append(event_of(record, "gap", before, before + 1))
    del interval  # of 1e7 readings 80 MB
    clear = _clear_steps(record, kept)
    pieces, steps, fewest = clear.pieces, [], FEWEST
    if (finer := _cycles(record, clear)) is not None:
        (pieces, steps), fewest = finer, FEWEST_READINGS
    events += [*clear.steps, *steps]
    short = [piece for piece in pieces if piece.size < fewest]
    events += [event_of(record, "short", piece[0], piece[-1]) for piece in short]
    long = [piece for piece in pieces if piece.size >= fewest]
    names = [record.name if len(long) == 1 else f"{record.name}#{k + 1}" for k in range(len(long))]
    segments = tuple(record.select(rows, name) for rows, name in zip(long, names, strict=True))
    return Split(segments, tuple(sorted(events, key=lambda event: event.time)))


class ClearSteps(NamedTuple):
    """Readings between clear steps, as their places in the record, and these steps; of each reading
    whether it may be the first after another step, and the last digit near it.
    """

    pieces: list[np.ndarray]
    steps: list[Event]
    likely: np.ndarray
    digits: np.ndarray


def _clear_steps(record: DecayRecord, kept: np.ndarray) -> ClearSteps:
    columns = record.time[kept], record.current[kept]
    steps, likely, digits = _search(*columns, record.resolution or 0.0)
    ends, within, events = [], set(), []
    for first, end, rises in steps:
        if end > first:
            kind = "ramp" if rises else "loss"
            events.append(event_of(record, kind, kept[first], kept[end - 1]))
            within.add(kept[first])
        else:
            change = float(np.subtract(*record.current[kept[[first, first - 1]]]))
            kind = "refill" if rises else "loss"
            events.append(Event(kind, float(record.time[kept[first]]), 0.0, change))
        ends += [first, end]
    pieces = [p for p in np.split(kept, ends) if p.size and p[0] not in within]
    columns = np.zeros(len(record), bool), np.zeros(len(record), np.float32)
    for column, values in zip(columns, (likely, digits), strict=True):
        column[kept] = values
    noise = noise_of(record.time[kept], record.current[kept])
    for k, piece in enumerate(pieces):
        if cut := _ramp(record.current[piece], max(noise, columns[1][piece].max() / 2)):
            events.append(event_of(record, "ramp", piece[0], piece[cut - 1]))
            pieces[k] = piece[cut:]
    return ClearSteps(pieces, events, *columns)


def _cycles(record: DecayRecord, clear: ClearSteps) -> tuple[list[np.ndarray], list[Event]] | None:
    """Pieces divided at refills that are too small to be clear, and these; None if refills do not
    hold the beam, or there are no more of them.

    Parts of less than three readings or a quarter of the usual length, as of spikes, injection
    ramps and fresh beam, are left out, and the rest is looked at anew.
    """
    whole = clear.pieces
    rows, number = np.concatenate(whole), np.repeat(np.arange(len(whole)), [*map(len, whole)])
    guess = clear.likely[rows]
    for _ in range(2):
        if rows.size < PLACES:
            return None
        begins, level = _steps_by_law(record, rows, number, guess, clear.digits[rows])
        lengths = np.diff(begins, append=rows.size)
        short = _is_short(number, begins, lengths)
        keep, lengths = np.repeat(~short, lengths), lengths[~short]
        rows, number, level = rows[keep], number[keep], level[keep]
        if not short.any():
            break
        guess = np.zeros(rows.size, bool)
        guess[np.cumsum(lengths) - lengths] = True
    parts, owner = _restored(record, whole, rows, number, lengths)
    count = _by_the_clock(np.array([*map(len, parts)]))
    pieces = [p for part, n in zip(parts, count, strict=True) for p in np.array_split(part, n)]
    owner, events, levels = np.repeat(owner, count), [], np.full(len(record), np.nan)
    levels[rows] = level
    for k in np.flatnonzero(np.diff(owner) == 0) + 1:
        beside = levels[pieces[k][:NEAR]], levels[pieces[k - 1][-NEAR:]]
        known = [side[~np.isnan(side)] for side in beside]
        change = float(np.subtract(*map(np.median, known))) if all(map(len, known)) else 0.0
        kind = "refill" if change > 0 else "loss"
        events.append(Event(kind, float(record.time[pieces[k][0]]), 0.0, change))
    cycles = sum(piece.size >= FEWEST_READINGS for piece in pieces)
    if cycles <= sum(piece.size >= FEWEST for piece in whole):
        return None
    found = np.array([event.change for event in events])
    raised = found.sum() >= RETURNED * np.abs(found).sum()
    held = _hold([record.current[piece] for piece in pieces], [*clear.steps, *events])
    return (pieces, [*events, *_left_out(record, whole, pieces)]) if raised and held else None


def _left_out(
    record: DecayRecord, clear: Sequence[np.ndarray], pieces: Sequence[np.ndarray]
) -> list[Event]:
    """Readings of the clear pieces that are in none of others."""
    left = np.zeros(len(record), bool)
    left[np.concatenate(clear)] = True
    left[np.concatenate(pieces)] = False
    return [event_of(record, "short", first, end - 1) for first, end in _runs(left)]


def _restored(
    record: DecayRecord,
    clear: Sequence[np.ndarray],
    rows: np.ndarray,
    number: np.ndarray,
    lengths: np.ndarray,
) -> tuple[list[np.ndarray], list[int]]:
    """Parts, and of which clear piece each is; one whose steps explain no more than their sizes and
    places cost, beside a law of its own and a smooth curve, is whole again but for gaps.
    """
    begins = np.cumsum(lengths) - lengths
    pieces = np.flatnonzero(np.diff(number, prepend=-1)).tolist()
    found, owner, missing = [], [], GAP * np.median(np.diff(record.time))
    for low, high in itertools.pairwise([*pieces, rows.size]):
        piece, kept = number[low], rows[low:high]
        first = begins[slice(*np.searchsorted(begins, (low, high)))] - low
        parts, every = np.split(kept, first[1:]), clear[piece]
        if len(parts) > 1:
            after = every[1:][np.diff(record.time[every]) > missing]
            gap = np.diff(np.searchsorted(after, kept, "right"), prepend=0)[first] > 0
            if _log_odds_of_steps(record.time[kept], record.current[kept], first, gap) < 0:
                parts = np.split(every, np.searchsorted(every, kept[first[gap]]))
        found += parts
        owner += [piece] * len(parts)
    return found, owner


def _without_means(columns: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Columns less their means in parts that begin with these rows."""
    lengths = np.diff(first, append=len(columns))
    means = np.add.reduceat(columns, first) / lengths[:, None]
    return columns - np.repeat(means, lengths, axis=0)


def _log_odds_of_steps(
    time: np.ndarray, current: np.ndarray, first: np.ndarray, gap: np.ndarray
) -> float:
    """Log odds of levels that begin at these readings against those that begin after a gap, each
    beside a law and a smooth curve, averaged over the noise: a slow one makes levels by itself. Of
    many levels some tell it.
    """
    from beamfit.noise.memory import Products  # JAX, for steps alone

    level = _levelled(time, current, np.zeros(1, int))
    ends, odds, told = np.append(first, time.size), 0.0, 0
    groups = np.array_split(np.arange(first.size), -(-first.size // LEVELS))
    for k in np.unique(np.linspace(0, len(groups) - 1, GROUPS).astype(int)):
        some = ends[groups[k][0] : groups[k][-1] + 2]
        size = -(-(some[-1] - some[0]) // ROWS)
        begin = np.concatenate([np.arange(*pair, size) for pair in itertools.pairwise(some)])
        lengths = np.diff(begin, append=some[-1])
        at, of = (np.add.reduceat(v[: some[-1]], begin) / lengths for v in (time, level))
        sure = gap[groups[k][1:]]
        steps = np.greater_equal.outer(begin, some[1:-1][np.argsort(~sure, kind="stable")])
        # By number: the readings on both sides of a gap have a slope.
        curve = chebvander(np.interp(begin, begin[[0, -1]], [-1.0, 1.0]), CURVED)
        products = Products.of(np.column_stack([of, curve, steps]), at, False, NOISES)
        free = max(at.size - CURVED - some.size + 1, 1)
        for sign, columns in ((1, None), (-1, CURVED + 2 + sure.sum())):
            left = np.log(products.left(columns) + TINY)
            odds += sign * logsumexp(products.log_prior - 0.5 * free * left)
        told += np.sum(~sure)
    return odds - told / (first.size - 1) * _log_cost(np.diff(ends))


def _log_cost(lengths: np.ndarray) -> float:
    """Log evidence that the steps between levels of so many readings cost: for a place log n, or
    what the lengths differ by from the usual one; for a size half the log of the readings that
    tell it (G. Schwarz, Ann. Stat. 6 (1978) 461).
    """
    steps, count = lengths.size - 1, lengths.sum()
    differ = np.mean(np.abs(lengths - np.median(lengths)))
    by_the_clock = np.log(count) + steps * (1.0 + np.log1p(2 * differ))
    size = 0.5 * np.log(count / lengths.size)
    return float(min(steps * np.log(count), by_the_clock) + steps * size)


def _is_short(number: np.ndarray, begins: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Which parts are too short, of the clear pieces with these numbers: not one of eight readings,
    and not all parts of one.
    """
    piece, sizes = number[begins], np.bincount(number)
    usual = np.median(np.repeat(lengths, lengths))  # of most readings
    short = lengths < max(FEWEST_READINGS, SHORT * usual)
    lost = np.bincount(piece, weights=~short) == 0
    return short & ~(lost & (sizes >= FEWEST))[piece]


def _by_the_clock(lengths: np.ndarray) -> np.ndarray:
    """Count the cycles in each piece, where most readings are in those of one usual length: a
    refill may be too small to be found. One that is missed bends a long piece, which tells most.
    """
    usual = np.median(np.repeat(lengths, lengths))
    regular = np.abs(lengths - usual) <= max(REGULAR * usual, 1.0)
    if lengths @ regular < 0.5 * lengths.sum():
        return np.ones(lengths.size, int)
    return np.maximum(np.round(lengths / usual).astype(int), 1)


def is_refilled(split: Split) -> bool:
    """Tell three or more cycles held by refills from a decay with odd steps.

    Refills give back at least half of what the cycles lose.
    """
    return _hold([cycle.current for cycle in split.segments], split.events)


def _hold(pieces: Sequence[np.ndarray], steps: Sequence[Event]) -> bool:
    refills = [event.change for event in steps if event.kind in ("refill", "ramp")]
    lost = sum(float(current[0] - current[-1]) for current in pieces)
    many = min(len(pieces), len(refills) + 1) >= FEWEST_CYCLES
    return many and sum(refills) > RETURNED * lost > 0


def _steps_by_law(
    record: DecayRecord, rows: np.ndarray, number: np.ndarray, guess: np.ndarray,
    digits: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Places at which the level steps, with 0, and the level: the current with the loss put back.
    Some of them are known, where the number of the piece changes.
    """

    def near(*columns: np.ndarray) -> np.ndarray:
        time, current, edge, maybe, grain = columns
        clear, found = np.flatnonzero(edge[1:]) + 1, np.zeros(time.size, bool)
        both = np.flatnonzero((edge | maybe)[1:]) + 1
        steps, level, firm = _settled(time, current, clear, both, grain)
        found[steps[firm]] = True
        lost = np.diff(level - current, prepend=0.0)
        return np.column_stack([found, lost]).astype(np.float32)

    edge, current = np.diff(number, prepend=number[0]) != 0, record.current[rows]
    columns = record.time[rows], current, edge, guess, digits
    found, lost = by_stretches(near, *columns, stretch=ONE_LAW, overlap=BESIDE).T
    return np.append(0, np.flatnonzero(found)), current + np.cumsum(lost, dtype=float)


def _settled(
    time: np.ndarray, current: np.ndarray, clear: np.ndarray, guess: np.ndarray, grain: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps besides some, when the law that they leave shows no others; the level, and which of
    the steps are clear or what two levels differ by beside them.
    """
    interval, steps = np.diff(time), guess
    gaps = np.flatnonzero(interval > GAP * np.median(interval)) + 1
    for _ in range(ROUNDS):
        # A refill in a gap would be a part of the law.
        level = _levelled(time, current, np.union1d(np.append(0, steps), gaps))
        total = np.append(0.0, np.cumsum(level))
        change = np.delete(np.diff(level), steps - 1)
        change = change if change.size >= PLACES else np.diff(level)
        variance = _mean_variance(change, min(level.size, LONG))
        more = _divided(total, clear, variance, grain)
        more = _placed(total, more, clear)
        if np.array_equal(more, steps):
            break
        steps = more
    ends = np.concatenate([[0], steps, [level.size]])
    lengths = np.diff(ends)
    scatter = np.sqrt(variance(lengths[1:]) + variance(lengths[:-1]))
    firm = np.abs(np.diff(np.diff(total[ends]) / lengths)) > LIKELY * scatter
    return steps, level, firm | np.isin(steps, clear)


def _levelled(time: np.ndarray, current: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Currents with the loss put back, by one a and one b for all pieces; by one number where two
    are not likelier.
    """
    columns = np.array([current, current**2])
    parts = 0.5 * np.diff(time) * (columns[:, :-1] + columns[:, 1:])
    columns = np.vstack([np.zeros(2), np.cumsum(parts, axis=1).T])
    both = _without_means(np.column_stack([columns, current]), first)
    scale = np.linalg.norm(both[:, :2], axis=0) + TINY
    left, known = both[:, 2], both[:, :2] / scale
    squares, ways = np.linalg.eigh(known.T @ known)
    # Readings that are equal but for rounding make both columns one.
    numbers = ways.T @ (known.T @ left) / np.maximum(squares, EXACT)
    explained = squares * numbers**2
    rest = max(left @ left - explained[1], 0.0) + TINY
    fewer = max(rest - explained[0], EXACT * rest)
    if time.size * np.log(rest / fewer) < 2 * np.log(time.size):
        numbers[0] = 0.0
    return current - columns @ (ways @ numbers / scale)


def _divided(
    total: np.ndarray, steps: np.ndarray, variance: Callable[[np.ndarray], np.ndarray],
    grain: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Divide pieces in two as long as two levels explain them better than one."""
    ends = [0, *steps.tolist(), total.size - 1]
    waiting, found = list(itertools.pairwise(ends)), steps.tolist()
    count = np.arange(1, total.size)
    each = variance(count)
    while waiting:
        low, high = waiting.pop()
        if high - low < 2:
            continue
        at, before, own = total[low + 1 : high], count[: high - low - 1], each[: high - low - 1]
        step = (total[high] - at) / before[::-1] - (at - total[low]) / before
        scatter = np.sqrt(own + own[::-1])
        best = int((np.abs(step) / scatter).argmax())
        if abs(step[best]) > max(LIKELY * scatter[best], DIGITS * grain[low:high].max()):
            found.append(low + 1 + best)
            waiting += [(low, found[-1]), (found[-1], high)]
    return np.sort(np.array(found, int))


def _mean_variance(change: np.ndarray, longest: int) -> Callable[[np.ndarray], np.ndarray]:
    """Variance of the mean of so many readings in autoregressive noise, by its differences.

    Those over two intervals have 1 + c times the variance of those over one, c being the
    correlation of neighbours; medians, for the steps among them.
    """
    change = change - np.median(change)  # what the law does not put back
    one, two = (np.median(np.abs(values)) for values in (change, change[1:] + change[:-1]))
    kept = float(np.clip((two / max(one, EXACT * two, TINY)) ** 2 - 1, 0.0, 0.99))
    many = np.arange(1, longest + 1)
    # The sum of many readings: n + 2 sum (n - k) c^k.
    sums = many + 2 * (kept * many / (1 - kept) - kept * (1 - kept**many) / (1 - kept) ** 2)
    table = (1.4826 * one) ** 2 / 2 / (1 - kept) * sums / many**2 + TINY
    return lambda count: table[np.minimum(count, longest) - 1]


def _placed(total: np.ndarray, steps: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """Each step that is not clear where two levels between its neighbours explain most."""
    ends, count = [0, *steps.tolist(), total.size - 1], np.arange(2 * WIDEST)
    for k in (np.flatnonzero(~np.isin(steps, clear)) + 1).tolist():
        low, high = max(ends[k - 1], ends[k] - WIDEST), min(ends[k + 1], ends[k] + WIDEST)
        first, last = max(low + 1, ends[k] - NEAR), min(high, ends[k] + NEAR + 1)
        at = total[first:last]
        before, after = count[first - low : last - low], count[high - last + 1 : high - first + 1]
        after = after[::-1]
        step = (at - total[low]) / before - (total[high] - at) / after
        ends[k] = first + int((step**2 * before * after).argmax())
    return np.unique(np.array(ends[1:-1], int))
