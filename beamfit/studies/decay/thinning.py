"""Records of far more readings than their decays need: repeats left out, means of neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamfit.studies.decay.conditions import Conditions
from beamfit.studies.decay.record import DecayRecord

# Readings beyond which neighbours are averaged.
MOST_READINGS = 1 << 16
# Robust standard deviations off the median of its block that a reading may lie.
OUTLIER = 10.0
# Repeats are of a monitor slower than its archive if half of the readings are, and nearly all come
# by equal numbers, or what changes, changes by more than so many digits. Runs so much longer than
# usual are of a monitor that stands.
EQUAL, DIGITS, STANDS, FEWEST = 0.95, 3.0, 5, 8
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
        notes=(*record.notes, note),
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
    blocks = record.current[:whole].reshape(-1, size)
    off = np.abs(blocks - np.median(blocks, axis=1, keepdims=True))
    spread = 1.4826 * np.median(off, axis=1)
    kept = np.ones(len(record), bool)
    limit = OUTLIER * max(float(np.median(spread)), record.resolution or 0.0)
    kept[:whole] = (off <= np.maximum(OUTLIER * spread, limit)[:, None]).ravel()
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
