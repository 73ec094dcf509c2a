"""Preparation of the readings of a current monitor and its clock: noise, errors, repeats, digits,
means.
"""

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
# Readings in a running median of level or rate; smallest number of readings of a decay.
WINDOW, MIN_READINGS = 9, 8
# Readings in a running median of the noise.
NEIGHBOURS = 21
# Readings processed at a time, and their overlap: a long record at once would take gigabytes.
CHUNK, OVERLAP = 1 << 18, 64


def noise_of(time: np.ndarray, current: np.ndarray) -> float:
    """Estimate the noise of single readings from their distance to the line through both
    neighbours.

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
    residual = current[1:-1] - (1 - share) * current[:-2] - share * current[2:]
    residual /= np.sqrt(1 + share**2 + (1 - share) ** 2)
    return float(1.4826 * np.median(np.abs(residual, out=residual), overwrite_input=True))


def by_chunks(
    function: Callable[..., np.ndarray],
    *columns: np.ndarray,
    chunk: int = CHUNK,
    overlap: int = OVERLAP,
) -> np.ndarray:
    """Apply a function of near neighbours to a record in overlapping chunks.

    All at once would take gigabytes for a long record.

    Examples
    --------
    >>> by_chunks(lambda x: np.gradient(x), np.arange(6.0) ** 2, chunk=3, overlap=1).tolist()
    [1.0, 2.0, 4.0, 6.0, 8.0, 9.0]
    """
    found, size = [], columns[0].size
    for start in range(0, size, chunk):
        low, stop = max(start - overlap, 0), min(start + chunk, size)
        values = function(*(column[low : stop + overlap] for column in columns))
        found.append(values[start - low : stop - low])
    return np.concatenate(found)


def with_common_errors(record: DecayRecord, residuals: np.ndarray) -> DecayRecord:
    """Replace errors that differ only by chance by the rms of the errors near each reading.

    An error estimated from three readings is uncertain by a half, and the square root of a number
    of counts depends on that number: as weights both prefer readings by their own noise. Errors
    that differ for a reason make the scatter of the residuals about their neighbours much more
    probable; these stay.

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
    if error is None or len(record) < MIN_READINGS or not np.ptp(error):
        return record
    near = np.sqrt(uniform_filter1d(error**2, min(NEIGHBOURS, len(record)), mode="mirror"))
    window_times, offsets = (sliding_window_view(v, 5) for v in (record.time, residuals))
    since, offsets = (
        np.delete(window_times - window_times[:, 2:3], 2, 1),
        np.delete(offsets - offsets[:, 2:3], 2, 1),
    )

    def misfit(error: np.ndarray) -> float:
        """-2 ln likelihood of the residuals about lines through four neighbours, with these errors
        times the best common factor.
        """
        weight = np.delete(1 / sliding_window_view(error, 5) ** 2, 2, 1)
        sums = (
            np.sum(weight * part, axis=1) for part in (1, since, since**2, offsets, offsets * since)
        )
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
    """Return the error of rounding, and the monitor with a drift added, if readings scatter by less
    than their digits allow.

    Readings of a beam that loses a digit at each reading lie on a line, but its slope is no better
    known for that. The missing variance (that of rounding less that of the residuals, beyond two
    standard deviations of a mean square) is taken as independent shifts of both ends of the record,
    or of all cycles alike. `span` is its length, s.

    Examples
    --------
    >>> print(rounding_of(1.0, np.ones(9), 3600.0, None))
    None
    >>> error, moved = rounding_of(1.0, np.zeros(900), 3600.0, None)
    >>> print(f"{error:.3f} mA, {moved.drift:.3f} mA/h")
    0.289 mA, 0.394 mA/h
    """
    rounding, mean_square = (digit or 0.0) / 12**0.5, float(np.mean(residuals**2))
    if mean_square >= rounding**2:
        return None
    missing_variance = rounding**2 * (1 - 2 / len(residuals) ** 0.5) - mean_square
    if missing_variance > 0:
        monitor = Monitor(drift=(2 * missing_variance) ** 0.5 * HOUR / span).beside(monitor)
    return rounding, monitor


def with_rounding(record: DecayRecord, residuals: np.ndarray) -> DecayRecord:
    """State the error of rounding if readings scatter by less."""
    found = rounding_of(record.resolution, residuals, record.span, record.monitor)
    if record.error is not None or found is None:
        return record
    rounding, monitor = found
    note = "Readings scatter by less than the rounding of their digits: errors contain that."
    notes = (*record.notes, note)
    return replace(record, error=np.full(len(record), rounding), monitor=monitor, notes=notes)


# Tolerance, in usual intervals, to which a skipped hour must be an hour.
HOUR_TOLERANCE = 0.1
# Shortest gap, in usual sampling intervals.
GAP = 10.0
# Above this many readings neighbours are averaged.
MAX_READINGS = 1 << 16
# Repeats come from a monitor that is slower than its archive if they are half of the readings and
# this share of the runs are multiples of one length, or if the usual change exceeds this many
# digits.
MIN_EQUAL_RUNS, MAX_CHANGE_DIGITS = 0.95, 3.0
# Runs longer than usual by this factor are kept: there the monitor is stuck.
LONG_RUN_FACTOR = 5
# Shortest step of a staircase, in readings; tolerance, in digits, to which steps are equal.
MIN_STAIR_READINGS, DIGIT_TOLERANCE = 3, 1e-6


def without_repeats(record: DecayRecord) -> DecayRecord:
    """Leave out readings that repeat the one before if the monitor is slower than its archive.

    Repeats are late: a curve through them lies half a step too high.
    """
    fresh = np.diff(record.current, prepend=np.nan) != 0
    first = np.flatnonzero(fresh)
    runs = np.diff(first, append=fresh.size)
    usual_run = int(np.median(runs))
    if not MIN_READINGS <= first.size <= len(record) / 2 or usual_run < 2:
        return record
    change = float(np.median(np.abs(np.diff(record.current[first]))))
    kept = fresh | np.repeat(runs > LONG_RUN_FACTOR * usual_run, runs)
    period = int(np.bincount(runs).argmax())
    if period > 1 and np.mean(runs % period == 0) > MIN_EQUAL_RUNS:
        # Two fresh values in a row may be equal: keep one reading in each period.
        kept |= (np.arange(fresh.size) - np.repeat(first, runs)) % period == 0
    elif record.resolution is not None and change <= MAX_CHANGE_DIGITS * record.resolution:
        return record
    note = (
        f"{np.sum(~kept)} of {len(record)} readings repeat the one before to the last digit, as of "
        "a monitor slower than its archive: left out."
    )
    return replace(record.select(kept), notes=(*record.notes, note))


def without_summer_time(record: DecayRecord) -> DecayRecord:
    """Take out the hour that a local clock skips in spring.

    It is the one interval longer than usual by an hour, while the current goes on as if it had not
    passed. A record with refills is left as it is: a refill in an hour without readings looks the
    same.

    Examples
    --------
    >>> t = np.arange(0.0, 7200.0, 60.0)
    >>> beam = 100 * np.exp(-t / 36000)
    >>> print(without_summer_time(DecayRecord(t + np.where(t > 3600, 3600.0, 0.0), beam)))
    record: 120 readings over 1.98 h, 100 to 82.0096 mA
    """
    interval = np.diff(record.time)
    usual = float(np.median(interval))
    skips = np.flatnonzero(np.abs(interval - usual - HOUR) < HOUR_TOLERANCE * usual) + 1
    if skips.size != 1 or not WINDOW <= skips[0] <= len(record) - WINDOW:
        return record
    after, at = int(skips[0]), float(record.time[skips[0] - 1])
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


def on_edges(
    record: DecayRecord, fewest: int = MIN_READINGS, lasting: int = MIN_STAIR_READINGS
) -> DecayRecord:
    """Reduce the staircase of a monitor with coarse digits and low noise to the edges of its steps.

    Parameters
    ----------
    record : DecayRecord
        One decay. It is returned unchanged if it is no staircase of single digits, or has errors.
    fewest, lasting : int
        Smallest number of steps, and smallest median length of a step in readings.

    Returns
    -------
    DecayRecord
        One reading for each step: in time between its two readings, in current between the two
        digits. The readings themselves are wrong by up to half a digit for as long as a step lasts,
        like correlated noise; the edges are wrong by the loss between two readings.

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
    # Sorting undoes readings that go to and fro at an edge: their number above it is the same.
    departures = np.abs(np.concatenate([np.diff(record.current), record.current - falling]))
    single = np.abs(np.diff(falling)[edge] + digit) < DIGIT_TOLERANCE * digit
    steady = departures.max() <= (1 + DIGIT_TOLERANCE) * digit and single.all()
    lengths = np.diff(edge)
    if not steady or np.median(lengths) < lasting:
        return record
    note = f"Steps of {digit:.3g} mA with little noise: the edges between them were fitted."
    edges = record.select(edge)
    middle = (record.time[edge] + record.time[edge + 1]) / 2
    return replace(
        edges, time=middle, current=(falling[edge] + falling[edge + 1]) / 2,
        start=None if record.start is None else record.start + float(middle[0]),
        notes=(*record.notes, note), mean=record.mean_current, digit=digit / np.median(lengths),
    )  # fmt: skip


def thinned(record: DecayRecord) -> DecayRecord:
    """Average neighbours of a long decay in equal blocks, at most 65536 of them.

    Parameters
    ----------
    record : DecayRecord
        One decay without refills. A short one is returned unchanged.

    Returns
    -------
    DecayRecord
        Means of time, current and conditions of each block; errors are those of a mean of
        independent readings. Single outliers, such as spikes and dropouts, and blocks across a gap
        are left out. `notes` says how many readings were averaged.

    Notes
    -----
    Over a block of length d a decay of lifetime T bends by (d/T)²/24 of the current, 1e-9 for the 8
    s of a week's blocks at 15 h. Noise with a correlation time below the block length is white in
    the means.

    Examples
    --------
    >>> t = np.arange(200_000.0)
    >>> thinned(DecayRecord(t, 500 - t / 1e4)).notes
    ('The means of 4 readings each were fitted, of 200000 in all.',)
    """
    size = -(-len(record) // MAX_READINGS)
    if size == 1:
        return record
    first = np.arange(0, len(record), size)
    count = np.diff(first, append=len(record))
    whole = len(record) // size * size
    # In chunks: all at once would take gigabytes.
    blocks = np.array_split(record.current[:whole].reshape(-1, size), -(-whole // CHUNK))
    departures = [np.abs(part - np.median(part, axis=1, keepdims=True)) for part in blocks]
    spread = [1.4826 * np.median(part, axis=1) for part in departures]
    kept = np.ones(len(record), bool)
    limit = THRESHOLD * max(float(np.median(np.concatenate(spread))), record.resolution or 0.0)
    pairs = zip(departures, spread, strict=True)
    near = [part <= np.maximum(THRESHOLD * own, limit)[:, None] for part, own in pairs]
    kept[:whole] = np.concatenate(near).ravel()
    spans = record.time[first + count - 1] - record.time[first]
    compact = spans <= GAP * np.median(spans)  # means across a gap lie on no curve
    count = np.maximum(np.add.reduceat(kept.astype(int), first), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return (np.add.reduceat(values * kept, first) / count)[compact]

    error = record.error
    conditions = {name: mean(values) for name, values in record.conditions.given.items()}
    note = f"The means of {size} readings each were fitted, of {len(record)} in all."
    time = mean(record.time)
    return replace(
        record, time=time, current=mean(record.current), digit=None,
        error=None if error is None else np.sqrt(mean(error**2) / count[compact]),
        start=None if record.start is None else record.start + float(time[0]),
        conditions=Conditions(**conditions), notes=(*record.notes, note),
    )  # fmt: skip
