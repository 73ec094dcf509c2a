"""Clean decays of a record: cut at refills, steps and gaps, without repeats; means and edges."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d, uniform_filter1d

from beamfit.answer import shown
from beamfit.errors import expect
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.quantity import HOUR
from beamfit.statistics import POOR_FIT

# Robust z-score at which a step or spike is an event: one false alarm in 1e20 Gaussian readings.
THRESHOLD = 10.0
# Readings below this share of the largest one near them are dropouts of the monitor.
DROPOUT = 0.02
WINDOW = 9
# A record shows the beam in a hundredth of its readings at least.
SEEN = 0.99
FEWEST = 8
# Readings that tell the noise near one, and the error of the median of `WINDOW` over theirs.
NEIGHBOURS, OF_MEDIAN = 21, 0.42
# Readings of a spike at most.
LONE = 3
# Readings that are looked through at once, and how many of their neighbours.
STRETCH, OVERLAP = 1 << 18, 64
# Readings whose means are looked at for a ramp at the head, the share of its rise by which a fall
# ends it, and by how much it exceeds any later rise.
SMOOTH, FALL, RISE = 5, 0.1, 3.0
# Readings that are looked through for one at first.
BLOCK = 4096
# Means of neighbours in which steps of many readings are sought, at least; at the end of a record,
# where what comes after is not known, they change so many times as much as usual.
COARSE, FASTER = 24, 4.0
# A gap is this many usual sampling intervals.
GAP = 10.0


class Event(NamedTuple):
    """Something in a record other than a smooth decay.

    Attributes
    ----------
    kind : str
        `refill`, `loss`, `dropout`, `spike`, `saturated`, `gap`, `ramp` (a refill of many readings,
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


def noise_of(time: np.ndarray, current: np.ndarray) -> float:
    """Noise of single readings, from how far each lies off the line through its neighbours.

    Parameters
    ----------
    time, current : array, shape (n,)
        Readings; n at least 3.

    Returns
    -------
    float
        Robust standard deviation, in the unit of the current.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(1000.0)
    >>> noise = 0.01 * np.random.default_rng(1).normal(size=1000)
    >>> f"{noise_of(t, 100 - t / 100 + noise):.3f}"
    '0.010'
    """
    share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    off = current[1:-1] - (1 - share) * current[:-2] - share * current[2:]
    off /= np.sqrt(1 + share**2 + (1 - share) ** 2)
    return float(1.4826 * np.median(np.abs(off, out=off), overwrite_input=True))


def with_common_errors(record: DecayRecord, residuals: np.ndarray) -> DecayRecord:
    """Take the rms of the errors near each reading for its error where they differ by chance.

    An error of three readings is known to a half, and the root of a number of counts goes with
    that number: as weights both prefer readings by their own noise. Errors that differ for a reason
    make how far residuals lie off those beside them much likelier, and stay.

    Examples
    --------
    >>> random, t = np.random.default_rng(1), np.linspace(0.0, 3600.0, 60)
    >>> shots = random.normal(size=(60, 3))
    >>> errors = shots.std(axis=1, ddof=1) / np.sqrt(3)
    >>> record = DecayRecord(t, 100 - t / 100 + shots.mean(axis=1), errors)
    >>> found = with_common_errors(record, shots.mean(axis=1)).error
    >>> f"{errors.min():.2f} to {errors.max():.2f}, {found.min():.2f} to {found.max():.2f}"
    '0.06 to 1.20, 0.43 to 0.61'
    """
    error = record.error
    if error is None or len(record) < FEWEST or not np.ptp(error):
        return record
    near = np.sqrt(uniform_filter1d(error**2, min(NEIGHBOURS, len(record)), mode="mirror"))
    times, off = (sliding_window_view(v, 5) for v in (record.time, residuals))
    since, off = np.delete(times - times[:, 2:3], 2, 1), np.delete(off - off[:, 2:3], 2, 1)

    def misfit(error: np.ndarray) -> float:
        """-2 ln of their probability, whatever factor all errors are wrong by."""
        weight = np.delete(1 / sliding_window_view(error, 5) ** 2, 2, 1)
        sums = (np.sum(weight * part, axis=1) for part in (1, since, since**2, off, off * since))
        count, first, second, level, slope = sums
        spread = count * second - first**2
        line = (second * level - first * slope) / spread
        variance = error[2:-2] ** 2 + second / spread
        return float(np.sum(np.log(variance)) + line.size * np.log(np.mean(line**2 / variance)))

    with np.errstate(divide="ignore", invalid="ignore"):
        if misfit(near) - misfit(error) > -2 * np.log(POOR_FIT):
            return record
    note = "Errors of neighbouring readings differ by chance: each is the rms of those near it."
    return replace(record, error=near, notes=(*record.notes, note))


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


def _noise_near(off: np.ndarray) -> np.ndarray:
    """Noise about each of some departures; where it changes the greater one counts."""
    return maximum_filter1d(1.4826 * median_filter(off, NEIGHBOURS, mode="mirror"), NEIGHBOURS)


def by_stretches(
    function: Callable[..., np.ndarray],
    *columns: np.ndarray,
    stretch: int = STRETCH,
    overlap: int = OVERLAP,
) -> np.ndarray:
    """Values of a function of near neighbours for each reading: of a long record by stretches,
    since all at once takes gigabytes.

    Examples
    --------
    >>> by_stretches(lambda x: np.gradient(x), np.arange(6.0) ** 2, stretch=3, overlap=1).tolist()
    [1.0, 2.0, 4.0, 6.0, 8.0, 9.0]
    """
    found, size = [], columns[0].size
    for start in range(0, size, stretch):
        low, stop = max(start - overlap, 0), min(start + stretch, size)
        some = function(*(column[low : stop + overlap] for column in columns))
        found.append(some[start - low : stop - low])
    return np.concatenate(found)


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


def _noise(record: DecayRecord, time: np.ndarray, current: np.ndarray) -> float:
    return max(noise_of(time, current), (record.resolution or 0.0) / 2)


def beam_readings(record: DecayRecord, spikes: bool = True) -> tuple[np.ndarray, list[Event]]:
    """Indices of the readings that show the beam, and what the others are; of short cycles the
    first readings look like spikes.
    """
    dropped, end_of_beam = _dropouts(record.current)
    found = {"dropout": dropped, "saturated": _saturated(record.current)}
    kept = np.flatnonzero(~dropped & ~found["saturated"] & (np.arange(len(record)) < end_of_beam))
    if spikes and kept.size >= FEWEST:
        found["spike"] = np.zeros(len(record), bool)
        time, current = record.time[kept], record.current[kept]
        noise = _noise(record, time, current)
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


def _steps(time: np.ndarray, current: np.ndarray, noise: float) -> np.ndarray:
    """Change from each reading to the next, less what the decay around it explains, where that is
    more than noise; or zero.
    """

    def beyond(time: np.ndarray, current: np.ndarray) -> np.ndarray:
        interval, change, usual = np.diff(time), np.diff(current), _usual_rate(time, current)
        error = OF_MEDIAN * interval * _noise_near(np.abs(change / interval - usual))
        lost = usual * interval
        excess = change - lost
        near = np.maximum(np.sqrt(2) * noise, _noise_near(np.abs(excess)))
        allowed = 0.5 * np.abs(lost) + THRESHOLD * np.hypot(near, error)
        return np.append(0.0, np.where(np.abs(excess) > allowed, excess, 0.0))

    return by_stretches(beyond, time, current)[1:]


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
    if current.size < 3 * FEWEST:
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


class SlowStep(NamedTuple):
    """A fall or a rise of many readings: the first, the one past the last, and if it is a rise."""

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


def _slow_steps(
    time: np.ndarray, level: np.ndarray, steps: Mapping[int, float], noise: float
) -> list[SlowStep]:
    """Falls and rises of many readings: steps of means of 2, 4, 8, ... neighbours, besides those
    of single readings. Fresh beam, as after a rise, may fall fast by itself.
    """
    known, size, found = np.zeros(level.size, bool), 2, []
    known[list(steps)] = True
    refills = [first for first, change in steps.items() if change > 0]
    while (count := level.size // size) >= COARSE:
        t, x, old = (v[: count * size].reshape(count, size).mean(1) for v in (time, level, known))
        beyond = _steps(t, x, noise)
        apart = (old[1:] == 0) & (old[:-1] == 0)
        fresh = np.sort([0, *refills, *(step.end for step in found if step.rises)])
        ends = [end for step in found for end in (step.first, step.end)]
        cuts = np.sort([-level.size, *steps, *ends, 2 * level.size])
        for first, last in _runs(_is_slow_step(beyond, np.diff(x)) & apart):
            since = first * size - fresh[np.searchsorted(fresh, first * size, "right") - 1]
            if beyond[first] > 0 or since >= WINDOW // 2 * size:
                begin, end = _bounds(first, last, size, cuts)
                found.append(SlowStep(begin, min(end, level.size), bool(beyond[first] > 0)))
                known[begin:end] = True
        size *= 2
    return _joined(found)


def _joined(steps: list[SlowStep]) -> list[SlowStep]:
    """Steps in order, those that overlap as one."""
    apart: list[SlowStep] = []
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
        Decays of at least 8 readings, and the events between and in them.

    Notes
    -----
    A step must exceed ten robust standard deviations of the changes near it, and of what is lost
    meanwhile, as in a gap. Losses and refills of many readings, up to a twentieth of the record,
    are steps of the means of 2, 4, 8, ... neighbours; slower changes stay in. A gap alone does not
    end a decay; a step across it does.

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
    time, current = record.time[kept], record.current[kept]
    noise = _noise(record, time, current)
    beyond = _steps(time, current, noise)
    steps = {int(k) + 1: float(beyond[k]) for k in np.flatnonzero(beyond)}
    for first, size in steps.items():
        change = float(current[first] - current[first - 1])
        events.append(Event("refill" if size > 0 else "loss", float(time[first]), 0.0, change))
    current[1:] -= np.cumsum(beyond)
    del beyond  # of 1e7 readings 80 MB
    slow = _slow_steps(time, current, steps, noise)
    del time, current
    interval = np.diff(record.time)
    for before in np.flatnonzero(interval > GAP * np.median(interval)):
        events.append(event_of(record, "gap", before, before + 1))
    ends = [*steps]
    for first, last, rises in slow:
        kind = "ramp" if rises else "loss"
        events.append(event_of(record, kind, kept[first], kept[last - 1]))
        ends += [first, last]
    between, long = np.split(kept, np.sort(ends)), []
    within = {kept[first] for first, *_ in slow}
    for piece in between:
        if not piece.size or piece[0] in within:
            continue
        if cut := _ramp(record.current[piece], noise):
            events.append(event_of(record, "ramp", piece[0], piece[cut - 1]))
        if piece.size < FEWEST:
            events.append(event_of(record, "short", piece[0], piece[-1]))
        else:
            long.append(piece[cut:])
    names = [record.name if len(long) == 1 else f"{record.name}#{k + 1}" for k in range(len(long))]
    segments = tuple(record.select(rows, name) for rows, name in zip(long, names, strict=True))
    return Split(segments, tuple(sorted(events, key=lambda event: event.time)))


# An hour is skipped to such a share of the usual interval.
SAME = 0.1
# Readings beyond which neighbours are averaged.
MOST_READINGS = 1 << 16
# Repeats are of a monitor slower than its archive if half of the readings are, and nearly all come
# by equal numbers, or what changes, changes by more than so many digits. Runs so much longer than
# usual are of a monitor that stands.
EQUAL, DIGITS, STANDS = 0.95, 3.0, 5
# Readings that a step of a staircase lasts at least, and by how much of a digit steps may differ.
STAIR, ROUNDING = 3, 1e-6


def without_repeats(record: DecayRecord) -> DecayRecord:
    """Leave out readings that repeat the one before where the monitor is slower than its archive:
    they are late, and a curve through them lies half a step too high.
    """
    fresh = np.diff(record.current, prepend=np.nan) != 0
    first = np.flatnonzero(fresh)
    runs = np.diff(first, append=fresh.size)
    usual = int(np.median(runs))
    if not FEWEST <= first.size <= len(record) / 2 or usual < 2:
        return record
    change = float(np.median(np.abs(np.diff(record.current[first]))))
    kept = fresh | np.repeat(runs > STANDS * usual, runs)
    period = int(np.bincount(runs).argmax())
    if period > 1 and np.mean(runs % period == 0) > EQUAL:
        # Two values in a row may be equal by themselves.
        kept |= (np.arange(fresh.size) - np.repeat(first, runs)) % period == 0
    elif record.resolution is not None and change <= DIGITS * record.resolution:
        return record
    note = (
        f"{np.sum(~kept)} of {len(record)} readings repeat the one before to the last digit, as of "
        "a monitor slower than its archive: left out."
    )
    return replace(record.select(kept), notes=(*record.notes, note))


def without_summer_time(record: DecayRecord) -> DecayRecord:
    """Take out the hour that a local clock skips in spring: between two readings an hour passes
    besides the usual interval, and the current goes on as if it had not. Refills may hold a beam
    over an hour that was not recorded: with them nothing is taken out.

    Examples
    --------
    >>> t = np.arange(0.0, 7200.0, 60.0)
    >>> beam = 100 * np.exp(-t / 36000)
    >>> print(without_summer_time(DecayRecord(t + np.where(t > 3600, 3600.0, 0.0), beam)))
    record: 120 readings over 1.98 h, 100 to 82.0096 mA
    """
    interval = np.diff(record.time)
    usual = float(np.median(interval))
    found = np.flatnonzero(np.abs(interval - usual - HOUR) < SAME * usual) + 1
    if found.size != 1 or not WINDOW <= found[0] <= len(record) - WINDOW:
        return record
    after, at = int(found[0]), float(record.time[found[0] - 1])
    since = np.where(record.time > at, record.time - HOUR, record.time)
    sides = slice(after - WINDOW, after), slice(after, after + WINDOW)
    lines = [np.polyfit(since[side] - at, record.current[side], 1) for side in sides]
    step, noise = abs(lines[1][1] - lines[0][1]), _noise(record, record.time, record.current)
    refilled = np.max(record.current - np.minimum.accumulate(record.current)) > THRESHOLD * noise
    if refilled or min(-slope * HOUR for slope, _ in lines) < THRESHOLD * max(step, noise):
        return record
    note = (
        f"The clock skips an hour after {at:.0f} s while the current goes on as before, as local "
        "times do in spring: the hour was taken out. Give times with their zone."
    )
    return replace(record, time=since, notes=(*record.notes, note))


def on_edges(record: DecayRecord) -> DecayRecord:
    """Take the edges between the digits of a monitor that has less noise than a digit.

    Parameters
    ----------
    record : DecayRecord
        One decay. One that is no staircase of single digits, or has errors, is given back.

    Returns
    -------
    DecayRecord
        Half a digit between both readings of each step. The readings themselves are off by up to
        half a digit for as long as a step lasts, as of noise with a memory; the edges are off by
        what the beam loses between two readings.

    Examples
    --------
    >>> t = np.arange(0.0, 3600.0, 10.0)
    >>> print(on_edges(DecayRecord(t, np.round(100 * np.exp(-t / 36000), 1))))
    record: 95 readings over 0.989 h, 99.95 to 90.55 mA
    """
    digit, change = record.resolution, np.diff(record.current)
    edge = np.flatnonzero(change)
    if digit is None or record.error is not None or edge.size < FEWEST:
        return record
    single = np.abs(change[edge] + digit) < ROUNDING * digit
    if not single.all() or np.median(np.diff(edge)) < STAIR:
        return record
    note = f"Steps of {digit:.3g} mA without noise: the {edge.size} edges between them were fitted."
    at = record.select(edge)
    middle = (record.time[edge] + record.time[edge + 1]) / 2
    return replace(
        at, time=middle, current=(record.current[edge] + record.current[edge + 1]) / 2,
        start=None if record.start is None else record.start + float(middle[0]),
        notes=(*record.notes, note), mean=record.mean_current,
    )  # fmt: skip


def thinned(record: DecayRecord) -> DecayRecord:
    """Average neighbours of a long decay in equal blocks, up to 65536.

    Parameters
    ----------
    record : DecayRecord
        One decay: means across a refill are of neither side. A short one is given back.

    Returns
    -------
    DecayRecord
        Means of time, current and conditions of each block; errors are those of a mean of
        independent readings. Single readings far off, as of spikes and dropouts, do not enter.
        `notes` says how many were averaged.

    Notes
    -----
    Over a block of length d a decay of lifetime T bends by (d/T)²/24 of the current, 1e-9 for the
    8 s of a week's blocks at 15 h. Noise of a memory shorter than a block is white in the means.

    Examples
    --------
    >>> t = np.arange(200_000.0)
    >>> thinned(DecayRecord(t, 500 - t / 1e4)).notes
    ('The means of 4 readings each were fitted, of 200000 in all.',)
    """
    size = -(-len(record) // MOST_READINGS)
    if size == 1:
        return record
    first = np.arange(0, len(record), size)
    count = np.diff(first, append=len(record))
    whole = len(record) // size * size
    # In parts: all at once takes gigabytes.
    blocks = np.array_split(record.current[:whole].reshape(-1, size), -(-whole // STRETCH))
    off = [np.abs(part - np.median(part, axis=1, keepdims=True)) for part in blocks]
    spread = [1.4826 * np.median(part, axis=1) for part in off]
    kept = np.ones(len(record), bool)
    limit = THRESHOLD * max(float(np.median(np.concatenate(spread))), record.resolution or 0.0)
    pairs = zip(off, spread, strict=True)
    within = [part <= np.maximum(THRESHOLD * own, limit)[:, None] for part, own in pairs]
    kept[:whole] = np.concatenate(within).ravel()
    count = np.maximum(np.add.reduceat(kept.astype(int), first), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values * kept, first) / count

    error = record.error
    conditions = {name: mean(values) for name, values in record.conditions.given.items()}
    note = f"The means of {size} readings each were fitted, of {len(record)} in all."
    time = mean(record.time)
    return replace(
        record, time=time, current=mean(record.current),
        error=None if error is None else np.sqrt(mean(error**2) / count),
        start=None if record.start is None else record.start + float(time[0]),
        conditions=Conditions(**conditions), notes=(*record.notes, note),
    )  # fmt: skip
