"""Readings of a current monitor and of its clock: noise, errors, repeats, digits, means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import uniform_filter1d

from beamfit.lifetime.record import Conditions, DecayRecord, Monitor
from beamfit.quantity import HOUR
from beamfit.statistics import POOR_FIT

# Robust z-score at which a step or spike is an event: one false alarm in 1e20 Gaussian readings.
THRESHOLD = 10.0
# Readings whose median is that of a level, and fewest readings of a decay.
WINDOW, FEWEST = 9, 8
# Readings that tell the noise near one.
NEIGHBOURS = 21
# Readings that are looked through at once, and how many of their neighbours.
STRETCH, OVERLAP = 1 << 18, 64


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


def rounding_of(
    digit: float | None, residuals: np.ndarray, span: float, monitor: Monitor | None
) -> tuple[float, Monitor | None] | None:
    """Error of rounding, and the monitor with a drift beside its own, where readings scatter about
    a law by less: a beam that loses a digit at each reading lies on a line, whose slope is not
    known the better.

    What residuals lack of the variance of rounding, beyond two standard deviations of a mean
    square, moves both ends of the record, or of all its cycles alike, of this span in s, each end
    by itself.

    Examples
    --------
    >>> print(rounding_of(1.0, np.ones(9), 3600.0, None))
    None
    >>> error, moved = rounding_of(1.0, np.zeros(900), 3600.0, None)
    >>> print(f"{error:.3f} mA, {moved.drift:.3f} mA/h")
    0.289 mA, 0.394 mA/h
    """
    least, squared = (digit or 0.0) / 12**0.5, float(np.mean(residuals**2))
    if squared >= least**2:
        return None
    lacks = least**2 * (1 - 2 / len(residuals) ** 0.5) - squared
    if lacks > 0:
        monitor = Monitor(drift=(2 * lacks) ** 0.5 * HOUR / span).beside(monitor)
    return least, monitor


def with_rounding(record: DecayRecord, residuals: np.ndarray) -> DecayRecord:
    """State the error of rounding where it is needed."""
    found = rounding_of(record.resolution, residuals, record.span, record.monitor)
    if record.error is not None or found is None:
        return record
    least, monitor = found
    note = "Readings scatter by less than the rounding of their digits: errors contain that."
    notes = (*record.notes, note)
    return replace(record, error=np.full(len(record), least), monitor=monitor, notes=notes)


# An hour is skipped to such a share of the usual interval.
SAME = 0.1
# A gap is this many usual sampling intervals.
GAP = 10.0
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
    step = abs(lines[1][1] - lines[0][1])
    noise = max(noise_of(record.time, record.current), (record.resolution or 0.0) / 2)
    refilled = np.max(record.current - np.minimum.accumulate(record.current)) > THRESHOLD * noise
    if refilled or min(-slope * HOUR for slope, _ in lines) < THRESHOLD * max(step, noise):
        return record
    note = (
        f"The clock skips an hour after {at:.0f} s while the current goes on as before, as local "
        "times do in spring: the hour was taken out. Give times with their zone."
    )
    return replace(record, time=since, notes=(*record.notes, note))


def on_edges(record: DecayRecord, fewest: int = FEWEST, lasting: int = STAIR) -> DecayRecord:
    """Take the edges between the digits of a monitor that has less noise than a digit.

    Parameters
    ----------
    record : DecayRecord
        One decay. One that is no staircase of single digits, or has errors, is given back.
    fewest, lasting : int
        Steps that it has at least, and readings that one lasts.

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
    if (digit := record.resolution) is None or record.error is not None:
        return record
    falling = np.sort(record.current)[::-1]
    edge = np.flatnonzero(np.diff(falling))
    if edge.size < fewest:
        return record
    # Readings that go to and fro at an edge are as many above it as if they did not.
    apart = np.abs(np.concatenate([np.diff(record.current), record.current - falling]))
    single = np.abs(np.diff(falling)[edge] + digit) < ROUNDING * digit
    steady = apart.max() <= (1 + ROUNDING) * digit and single.all()
    lasts = np.diff(edge)
    if not steady or np.median(lasts) < lasting:
        return record
    note = f"Steps of {digit:.3g} mA with little noise: the edges between them were fitted."
    at = record.select(edge)
    middle = (record.time[edge] + record.time[edge + 1]) / 2
    return replace(
        at, time=middle, current=(falling[edge] + falling[edge + 1]) / 2,
        start=None if record.start is None else record.start + float(middle[0]),
        notes=(*record.notes, note), mean=record.mean_current, digit=digit / np.median(lasts),
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
        independent readings. Single readings far off, as of spikes and dropouts, and blocks across
        a gap do not enter. `notes` says how many were averaged.

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
    spans = record.time[first + count - 1] - record.time[first]
    even = spans <= GAP * np.median(spans)  # means across a gap are on no curve
    count = np.maximum(np.add.reduceat(kept.astype(int), first), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return (np.add.reduceat(values * kept, first) / count)[even]

    error = record.error
    conditions = {name: mean(values) for name, values in record.conditions.given.items()}
    note = f"The means of {size} readings each were fitted, of {len(record)} in all."
    time = mean(record.time)
    return replace(
        record, time=time, current=mean(record.current), digit=None,
        error=None if error is None else np.sqrt(mean(error**2) / count[even]),
        start=None if record.start is None else record.start + float(time[0]),
        conditions=Conditions(**conditions), notes=(*record.notes, note),
    )  # fmt: skip
