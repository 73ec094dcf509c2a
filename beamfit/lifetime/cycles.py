"""The cycles of a record with many refills, as of top-up: found, cleaned for one law, and how their
loss rate changes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d
from scipy.special import logsumexp, ndtr

from beamfit.lifetime.expansion import (
    LOSS,
    POWER,
    Expansion,
    Parts,
    Physical,
    Pieces,
    least_squares_step,
    solved,
)
from beamfit.lifetime.free_law import BELOW
from beamfit.lifetime.pieces import (
    Event,
    Split,
    beam_readings,
    by_stretches,
    event_of,
    split_record,
)
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.statistics import CLEAR_ODDS, log_evidence_of_change

# Standard deviations by which two levels must differ to be two: a false step costs no more than an
# own current for the rest.
THRESHOLD = 5.0
# Least step in units of the last digit of the readings.
DIGITS = 1.5
# Readings in which steps are sought at once, and how many beside them are looked at.
STRETCH, OVERLAP = 1 << 16, 1 << 11
# Readings on either side whose means are compared, and the fewest places that tell their scatter.
WINDOWS, PLACES = (1, 2, 4, 8, 16, 32, 64), 20
# In so many windows the usual difference, which the decay makes, is taken off.
BLOCK = 16
# A step is placed to the reading within so many of where it was seen.
NEAR = 8
# How often steps are sought with the law that those found leave.
ROUNDS = 20
# Share of the usual length below which a piece is the head of a cycle, as of fresh beam.
SHORT = 0.25
# Refills by the clock are so far apart to this share of it.
REGULAR = 0.1
# Least step as a share of what is lost in the piece that it divides.
LEAST = 0.2
# Share of what cycles lose that refills give back at least, and of steps that are to be refills.
RETURNED = 0.5
# A step that both searches find is seen within so many readings.
BESIDE = 2.0
# Cycles whose settings and pressure agree to this share have one a and one b.
SAME = 0.02
# Currents so alike that a and b do as one number.
NARROW = 0.02
# Noise over the height of a sawtooth that is looked at.
NOISES = (0.01, 0.03, 0.1, 0.2)
# Refills of top-up come every 3 min, within a factor 3, those of fills hours apart; lifetimes are
# 15 h within a factor 3, the rest within seconds to years:
# middle, s, width of the logarithm, and its whole range about that.
PERIOD, LIFETIME = (180.0, 1.2, 12.0), (15 * 3600.0, 1.2, 17.0)
# Of these so many are usual; and records without a decay so often have refills that none shows.
USUAL, HELD = 0.8, 0.1
# Readings beyond which the scatter of their mean is followed no farther.
LONG = 4096


def find_cycles(record: DecayRecord) -> Split:
    """Cut a record at every refill, also where it exceeds the noise but little.

    Parameters
    ----------
    record : DecayRecord
        Top-up, or fills with refills between them.

    Returns
    -------
    Split
        Cycles, and the refills, losses and pieces left out.

    Notes
    -----
    Steps that stand out in the means of 1, 2, 4, ... 64 readings before and after, by the scatter
    of most places, come first. Between them one law -a I² - b I for all pieces puts the loss back,
    and two levels are tested against one by their likelihood ratio, in noise whose memory the
    differences of neighbours show; what is found improves the law, and so on. Steps of three
    standard deviations of the noise are found in cycles of 60 readings and more, of ten always.
    Pieces of less than three readings or a quarter of the usual length, as of spikes, injection
    ramps and fresh beam, are left out, and the rest is looked at anew.

    Examples
    --------
    >>> t = np.arange(0.0, 3600.0, 10.0)
    >>> noise = np.random.default_rng(1).normal(size=t.size)
    >>> split = find_cycles(DecayRecord(t, 500 - (t % 180) / 180 + 0.2 * noise))
    >>> len(split.segments), str(split.events[0])
    (20, 'refill at 180 s (+0.9698 mA)')
    """
    kept, events = beam_readings(record, spikes=False)
    grain = record.resolution or 0.0
    for _ in range(2):
        pieces = np.split(kept, _steps(record.time[kept], record.current[kept], grain))
        lengths = [piece.size for piece in pieces]
        usual = np.median(np.repeat(lengths, lengths)) if kept.size else 0  # of most readings
        fewest = max(FEWEST_READINGS, usual * SHORT)
        long = [piece for piece in pieces if piece.size >= fewest]
        short = [piece for piece in pieces if 0 < piece.size < fewest]
        events += [event_of(record, "short", piece[0], piece[-1]) for piece in short]
        kept = np.concatenate(long or [kept[:0]])
    long = _by_the_clock(long)
    for after, change in zip(long[1:], _changes_between(record, long), strict=True):
        kind, at = "refill" if change > 0 else "loss", float(record.time[after[0]])
        events.append(Event(kind, at, 0.0, change))
    cycles = (record.select(piece, f"{record.name}#{k}") for k, piece in enumerate(long, 1))
    return Split(tuple(cycles), tuple(sorted(events, key=lambda event: event.time)))


def _by_the_clock(pieces: list[np.ndarray]) -> list[np.ndarray]:
    """Divide pieces of several usual lengths, where most readings are in those of one: a refill may
    be too small to be found. One that is missed bends a long piece, which tells most.
    """
    lengths = np.array([piece.size for piece in pieces])
    usual = np.median(np.repeat(lengths, lengths)) if pieces else 1.0
    regular = np.abs(lengths - usual) <= max(REGULAR * usual, 1.0)
    if lengths @ regular < 0.5 * lengths.sum():
        return pieces
    return [
        part
        for piece in pieces
        for part in np.array_split(piece, max(round(piece.size / usual), 1))
    ]


def cut_at_refills(record: DecayRecord) -> Split:
    """As `split_record`, but as `find_cycles` where that finds more cycles: the former cuts
    nothing but clear steps between pieces of eight readings, whatever the law of the decay.

    The finer one is right where it finds what is clear, and most of what it finds besides raises
    the current, as refills do: what a wrong law or the noise makes of a decay goes both ways.
    """
    clear, fine = split_record(record), find_cycles(record)
    if len(fine.segments) <= len(clear.segments) or not is_refilled(fine):
        return clear
    usual, kinds = float(np.median(np.diff(record.time))), ("refill", "loss")
    seen, found = ([e for e in split.events if e.kind in kinds] for split in (clear, fine))
    both = [np.array([event.time for event in events]) for events in (seen, found)]
    agreed, old = (_nearest(*pair) < BESIDE * usual for pair in (both, both[::-1]))
    new = np.array([event.change for event in found])[~old]
    agree = agreed.sum() >= RETURNED * agreed.size
    return fine if agree and new.sum() >= RETURNED * np.abs(new).sum() else clear


def _nearest(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distance of each time from the nearest of others, both in order."""
    ends = np.concatenate([[-np.inf], others, [np.inf]])
    after = np.searchsorted(ends, times)
    return np.minimum(times - ends[after - 1], ends[after] - times)


def is_refilled(split: Split) -> bool:
    """Tell three or more cycles held by refills from a decay with odd steps.

    Refills give back at least half of what the cycles lose.
    """
    cycles = split.segments
    if len(cycles) < FEWEST_CYCLES:
        return False
    refills = [event.change for event in split.events if event.kind in ("refill", "ramp")]
    lost = sum(float(cycle.current[0] - cycle.current[-1]) for cycle in cycles)
    return len(refills) + 1 >= FEWEST_CYCLES and sum(refills) > RETURNED * lost > 0


def is_sawtooth(residuals: np.ndarray) -> bool:
    """Compare an even distribution between two currents, as of refills that an archive is too slow
    to resolve, with one about a single value, by likelihood under normal noise.

    Examples
    --------
    >>> random = np.random.default_rng(1)
    >>> is_sawtooth(random.uniform(size=200)), is_sawtooth(random.normal(size=200))
    (True, False)
    """
    off = residuals - residuals.mean()
    normal = -off.size * (math.log(max(off.std(), 1e-300)) + 0.5 * math.log(2 * math.pi * math.e))
    best = -math.inf
    for share in NOISES:
        width = math.sqrt(12) * off.std() / math.sqrt(1 + 12 * share**2)
        ends = ((off + sign * width / 2) / (share * width) for sign in (1, -1))
        inside = np.subtract(*map(ndtr, ends)) / width
        best = max(best, float(np.sum(np.log(np.maximum(inside, 1e-300)))))
    return best - normal > CLEAR_ODDS


def unresolved(usual: float, interval: float, lifetime: float) -> float:
    """Probability that refills faster than a record is read look like slower ones.

    Parameters
    ----------
    usual : float
        Readings from one refill that is seen to the next.
    interval : float
        Time between readings, s.
    lifetime : float
        Of the cycles as they look, s.

    Notes
    -----
    A sawtooth that is read every interval looks the same for all its periods that differ by whole
    phases: of those shorter than two intervals one in usual² has so many readings a cycle. Both
    kinds are weighed by priors of the period of refills and of the lifetime.

    Examples
    --------
    >>> found = [unresolved(18, 10.0, 36000.0), unresolved(10, 600.0, 4e6)]
    >>> f"{found[0]:.3f}, {found[1]:.2f}"
    '0.002, 0.98'
    """
    lost = usual * interval / lifetime

    def chance(period: np.ndarray) -> np.ndarray:
        return _prior(period, *PERIOD) * _prior(period / lost, *LIFETIME)

    fast = np.geomspace(1e-3 * interval, 2 * interval, 200)
    others = float(np.trapezoid(chance(fast), np.log(fast))) / usual**2
    same = float(chance(np.array(usual * interval))) / usual
    return others / max(others + same, 1e-300)


def lives_longer(lifetime: float) -> float:
    """Prior probability of lifetimes beyond one, s.

    Examples
    --------
    >>> f"{lives_longer(15 * 3600.0):.2f}, {lives_longer(1000 * 3600.0):.2f}"
    '0.50, 0.05'
    """
    middle, width, wide = LIFETIME
    far = math.log(lifetime / middle)
    return USUAL * float(ndtr(-far / width)) + (1 - USUAL) * max(0.5 - far / wide, 0.0)


def _prior(value: np.ndarray, middle: float, width: float, wide: float) -> np.ndarray:
    """Density in the logarithm: normal about the middle, a part of it flat over a wide range."""
    normal = np.exp(-0.5 * (np.log(value / middle) / width) ** 2) / math.sqrt(2 * math.pi) / width
    return USUAL * normal + (1 - USUAL) / wide


def _levelled(time: np.ndarray, current: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Currents with the loss put back, by one a and one b for all pieces."""
    if not first.size:
        return current
    parts = np.diff(time) * np.array([current[:-1], current[:-1] ** 2])
    columns = np.vstack([np.zeros(2), np.cumsum(parts, axis=1).T])
    lengths = np.diff(first, append=time.size)
    both = np.column_stack([columns, current])
    both -= np.repeat(np.add.reduceat(both, first) / lengths[:, None], lengths, axis=0)
    scale = np.linalg.norm(both[:, :2], axis=0) + 1e-300
    loss = np.linalg.lstsq(both[:, :2] / scale, both[:, 2], rcond=NARROW)[0] / scale
    return current - columns @ loss


def _changes_between(record: DecayRecord, pieces: Sequence[np.ndarray]) -> list[float]:
    """Changes of the current from each piece to the next, mA, the loss put back; by one
    law for some pieces together.
    """
    if not pieces:
        return []
    ends, found = np.cumsum([piece.size for piece in pieces]) // STRETCH, []
    for batch in np.split(np.arange(len(pieces)), np.flatnonzero(np.diff(ends)) + 1):
        some = [pieces[k] for k in batch] + list(pieces[batch[-1] + 1 : batch[-1] + 2])
        rows, first = np.concatenate(some), np.cumsum([0] + [piece.size for piece in some[:-1]])
        level = _levelled(record.time[rows], record.current[rows], first)
        for begin, middle, end in zip(first, first[1:], [*first[2:], rows.size], strict=False):
            before = level[max(begin, middle - NEAR) : middle]
            after = level[middle : min(end, middle + NEAR)]
            found.append(float(np.median(after) - np.median(before)))
    return found


def _steps(time: np.ndarray, current: np.ndarray, grain: float) -> np.ndarray:
    """Indices of the first readings after a step, in order."""

    def begins(time: np.ndarray, current: np.ndarray) -> np.ndarray:
        found = np.zeros(time.size, bool)
        found[_steps_of(time, current, grain)] = True
        return found

    found = by_stretches(begins, time, current, stretch=STRETCH, overlap=OVERLAP)
    return np.flatnonzero(found)


def _steps_of(time: np.ndarray, current: np.ndarray, grain: float) -> np.ndarray:
    if current.size < PLACES:
        return np.zeros(0, int)
    found = np.zeros(current.size, bool)
    for window in WINDOWS:
        level = _levelled(time, current, np.append(0, np.flatnonzero(found)))
        total = np.append(0.0, np.cumsum(level))
        for _ in range(2):
            free, change = _changes(total, found, window)
            if free.sum() < PLACES:
                break
            usually = 1.4826 * np.median(np.abs(change[0, free]))
            # Beside it the loss is another one only if it differs by more than that.
            change = np.where(np.abs(change - change[0]) > usually, change, change[0])
            size = np.where(free, np.abs(change).min(axis=0), 0.0)
            least = max(THRESHOLD * usually, DIGITS * grain)
            peak = size >= maximum_filter1d(size, 2 * window - 1)
            found[window : current.size - window + 1] |= peak & (size > least)
    clear = steps = np.flatnonzero(found)
    for _ in range(ROUNDS):
        level = _levelled(time, current, np.append(0, steps))
        total = np.append(0.0, np.cumsum(level))
        more = _placed(total, _divided(level, total, level - current, clear, grain))
        if np.array_equal(more, steps):
            break
        steps = more
    return steps


def _divided(
    level: np.ndarray, total: np.ndarray, lost: np.ndarray, clear: np.ndarray, grain: float
) -> np.ndarray:
    """Divide pieces in two as long as two levels explain them better than one, and give back some
    of what a piece loses: a law that is not quite right makes smaller steps.
    """
    variance = _mean_variance(np.delete(np.diff(level), clear - 1), min(level.size, LONG))
    ends = [0, *clear.tolist(), level.size]
    waiting, found = list(itertools.pairwise(ends)), clear.tolist()
    while waiting:
        low, high = waiting.pop()
        if high - low < 2:
            continue
        at = np.arange(low + 1, high)
        step = (total[high] - total[at]) / (high - at) - (total[at] - total[low]) / (at - low)
        scatter = np.sqrt(variance(at - low) + variance(high - at))
        best = int(np.argmax(np.abs(step) / scatter))
        least = max(DIGITS * grain, LEAST * (lost[high - 1] - lost[low]))
        if abs(step[best]) > max(THRESHOLD * scatter[best], least):
            found.append(int(at[best]))
            waiting += [(low, int(at[best])), (int(at[best]), high)]
    return np.sort(found)


def _mean_variance(change: np.ndarray, longest: int) -> Callable[[np.ndarray], np.ndarray]:
    """Variance of the mean of so many readings in autoregressive noise, by its differences.

    Those over two intervals have 1 + c times the variance of those over one, c being the
    correlation of neighbours; medians, for the steps among them.
    """
    one, two = (np.median(np.abs(values)) for values in (change, change[1:] + change[:-1]))
    kept = float(np.clip((two / max(one, 1e-300)) ** 2 - 1, 0.0, 0.99))
    many = np.arange(1, longest + 1)
    # The sum of many readings: n + 2 sum (n - k) c^k.
    sums = many + 2 * (kept * many / (1 - kept) - kept * (1 - kept**many) / (1 - kept) ** 2)
    table = (1.4826 * one) ** 2 / 2 / (1 - kept) * sums / many**2 + 1e-300
    return lambda count: table[np.minimum(count, longest) - 1]


def _changes(total: np.ndarray, found: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """At every place, whether no step is found within a window, and by how much the means of so
    many readings before and after differ beside their usual difference there, earlier and later,
    shape (3, places): where a loss rate changes one of these is right. From sums of readings.
    """
    place = np.arange(window, found.size - window + 1)
    steps = np.append(0, np.cumsum(found))
    free = steps[place + window] == steps[place - window + 1]
    change = (total[place + window] - 2 * total[place] + total[place - window]) / window
    return free, change - _usual(np.where(free, change, np.nan), BLOCK * window)


def _usual(values: np.ndarray, size: int) -> np.ndarray:
    """The median of the block of about this size about each value, of the block before and of that
    after it; 0 where none is finite.
    """
    if not values.size:
        return np.zeros((3, 0))
    blocks = max(1, values.size // size)
    size = -(-values.size // blocks)
    padded = np.append(values, np.full(blocks * size - values.size, np.nan)).reshape(blocks, size)
    ordered = np.sort(padded, axis=1)  # what is not finite comes last
    count = np.isfinite(ordered).sum(axis=1)[:, None]
    middle = np.concatenate([np.maximum(count - 1, 0) // 2, count // 2], axis=1)
    found = np.take_along_axis(ordered, np.minimum(middle, size - 1), axis=1).mean(axis=1)
    found = np.pad(np.where(count[:, 0] > 0, found, 0.0), 1, mode="edge")
    every = np.stack([found[1:-1], found[:-2], found[2:]])
    return np.repeat(every, size, axis=1)[:, : values.size]


def _placed(total: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Each step where two levels between its neighbours explain most."""
    ends = np.concatenate([[0], steps, [total.size - 1]])
    widest = WINDOWS[-1]
    for k in range(1, ends.size - 1):
        low, high = max(ends[k - 1], ends[k] - widest), min(ends[k + 1], ends[k] + widest)
        at = np.arange(max(low + 1, ends[k] - NEAR), min(high, ends[k] + NEAR + 1))
        before = (total[at] - total[low]) / (at - low)
        after = (total[high] - total[at]) / (high - at)
        ends[k] = at[np.argmax((before - after) ** 2 * (at - low) * (high - at))]
    return np.unique(ends[1:-1])


def usual_cycle(cycles: Sequence[DecayRecord]) -> tuple[float, float]:
    """Median number of readings of cycles, and time between them, s."""
    count = float(np.median([len(cycle) for cycle in cycles]))
    return count, float(np.median([cycle.span / (len(cycle) - 1) for cycle in cycles]))


def alike(cycles: Sequence[DecayRecord]) -> list[list[DecayRecord]]:
    """Cycles by their settings and their pressure."""
    groups: list[tuple[np.ndarray, list[DecayRecord]]] = []
    for cycle in cycles:
        at = np.array([0.0 if v is None else np.median(v) for v in cycle.conditions])
        for other, group in groups:
            if np.all(np.abs(at - other) <= SAME * np.maximum(at, other)):
                group.append(cycle)
                break
        else:
            groups.append((at, [cycle]))
    return [group for _, group in groups]


def joined(cycles: Sequence[DecayRecord], name: str) -> DecayRecord:
    """The readings of many cycles as one record."""

    def all_of(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
        if parts[0] is None:
            return None
        whole = np.concatenate(parts)
        whole.flags.writeable = False  # so that the record need not copy it
        return whole

    begin, time = cycles[0].start, np.concatenate([cycle.time for cycle in cycles])
    ends = np.cumsum([len(cycle) for cycle in cycles[:-1]])
    for part, cycle in zip(np.split(time, ends), cycles, strict=True):
        part += cycle.start - begin
    time.flags.writeable = False
    return DecayRecord(
        time, all_of([cycle.current for cycle in cycles]),
        all_of([cycle.error for cycle in cycles]), name, begin,
        Conditions(*map(all_of, zip(*(c.conditions for c in cycles), strict=True))),
        notes=cycles[0].notes,
    )  # fmt: skip


FEWEST_CYCLES, FEWEST_READINGS = 3, 3
# Readings beyond which neighbours are averaged, in blocks within a cycle.
MOST = 16384
# Robust standard deviations off which a reading or a cycle is left out; at most this share of them.
OUTLIER, SHARE = 7.0, 0.2
# Errors of the mean by which readings at the edges of cycles lie off the law where they are of an
# injection: what stays below is in the errors (`beamfit.lifetime.expansion.SHIFTS`).
EDGE, WITHIN = 2.5, "they lie within injections"
# Neighbours that tell where a cycle, or a reading at the edge of one, should lie.
NEXT = 9


def averaged(cycles: Sequence[DecayRecord]) -> Pieces:
    """All readings, in time; of very many the means of neighbours within a cycle."""
    size = -(-sum(map(len, cycles)) // MOST)
    begin, place, parts = 0.0, 0, []
    known = all(cycle.start is not None for cycle in cycles)
    for cycle in cycles:
        begin = cycle.start if known else begin
        time, current, error = cycle.means(min(size, len(cycle) // FEWEST_READINGS))
        parts.append((begin + time, time - time[0], current, error, place))
        place += time.size
        begin += 2 * cycle.span  # nobody said when: as if a cycle were missing in between
    time, since, current, errors, first = zip(*parts, strict=True)
    given = all(error is not None for error in errors)
    return Pieces(
        *map(np.concatenate, (time, since, current)),
        np.concatenate(errors) if given else None, np.array(first), None, cycles[0].monitor,
    )  # fmt: skip


def _far(values: np.ndarray) -> np.ndarray:
    """Which values lie off the others, unless these are too many to be outliers."""
    off = np.abs(values - np.median(values))
    spread = 1.4826 * np.median(off)
    far = off > OUTLIER * spread
    return far if spread > 0 and far.mean() <= SHARE else np.zeros(values.size, bool)


def _odd_cycles(about: Expansion) -> np.ndarray:
    """Which cycles have a loss rate far off what is usual near them, and none beside them that is
    alike: two cycles may be a part of a course.
    """
    first, slope, residual = about.pieces.first, about.left[:, LOSS], about.left[:, -1]
    squares = np.add.reduceat(slope**2, first)
    rate = -np.add.reduceat(slope * residual, first) / squares
    near = sliding_window_view(np.pad(rate, NEXT // 2, mode="reflect"), NEXT)
    off = rate - np.median(np.delete(near, NEXT // 2, axis=1), axis=1)  # not of itself
    apart = np.pad(np.abs(np.diff(rate)), 1, constant_values=np.inf)
    alone = np.minimum(apart[:-1], apart[1:]) > 0.5 * np.abs(off)
    return _far(off * np.sqrt(squares)) & alone


def _edges(about: Expansion) -> np.ndarray:
    """Excess of the first and the last readings of all cycles over the law, beside those next to
    them, in errors: fresh beam decays faster, and of readings within an injection the first lies
    below, the last above.
    """
    first, lengths = about.pieces.first, about.pieces.lengths
    long = lengths > NEXT
    ends = np.array([first[long], (first + lengths - 1)[long]])
    if ends.shape[1] < FEWEST_CYCLES:
        return np.zeros(2)
    off = -about.left[:, -1]
    scatter = max(1.4826 * float(np.median(np.abs(off))), 1e-300)
    inward = np.array([[1], [-1]])[..., None] * np.arange(1, NEXT)
    beside = off[ends] - off[ends[..., None] + inward].mean(axis=2)
    beside = np.clip(beside / scatter, -OUTLIER, OUTLIER)
    return beside.mean(axis=1) * math.sqrt(ends.shape[1] / (1 + 1 / (NEXT - 1)))


def _trimmed(about: Expansion) -> tuple[Expansion, list[str]]:
    """The fit without readings at the edges of cycles that are not of the decay."""
    cut, high = np.zeros(2, int), 0
    most = int(np.median(about.pieces.lengths)) // 3
    while cut.max() < most:
        first_off, last_off = _edges(about)
        far = np.array([abs(first_off), last_off]) > EDGE
        if not far.any():
            break
        high += int(first_off > EDGE)
        keep = np.ones(about.pieces.time.size, bool)
        first, lengths = about.pieces.first, about.pieces.lengths
        long = lengths > NEXT
        for side, ends in enumerate((first, first + lengths - 1)):
            keep[ends[long]] &= not far[side]
        about = with_course(solved(about.pieces.kept(keep, FEWEST_READINGS)))
        cut = cut + far
    said = []
    for side, why in enumerate(
        ("fresh beam decays faster" if 2 * high >= cut[0] else WITHIN, WITHIN)
    ):
        if cut[side]:
            which = f"{('first', 'last')[side]} {cut[side]}"
            of_each = (
                "reading of each cycle was" if cut[side] == 1 else "readings of each cycle were"
            )
            said.append(f"the {which} {of_each} left out: {why}")
    return about, said


def cleaned(cycles: Pieces) -> tuple[Expansion, tuple[str, ...]]:
    """The fit without readings, edges of cycles and cycles that are not of the decay."""
    plain = solved(cycles)
    about, said = _trimmed(with_course(plain))
    before = about.pieces
    plain = plain if before is cycles else solved(before)
    cut = np.repeat(_odd_cycles(plain), before.lengths)
    if cut.any():
        about = with_course(solved(before.kept(~cut, FEWEST_READINGS)))
        left = before.first.size - about.pieces.first.size
        were = "cycle was" if left == 1 else "cycles were"
        said.append(f"{left} {were} left out, whose loss rate lies far off the others'")
    if (lone := _far(about.left[:, -1])).any():
        said.append(f"{int(lone.sum())} readings were left out as outliers")
        about = with_course(solved(about.pieces.kept(~lone, FEWEST_READINGS)))
    return about, tuple(said)


# Prior probability that the loss rate changes within a part, as of a machine that is left alone.
CHANGES = 0.05
# Cycles of a part at least, and parts at most: so many draw any course.
PART, MOST_PARTS = 2, 64
# Steps of Gauss and Newton for them: each leaves the square of what the last one left.
COURSE_STEPS = 3


def with_course(about: Expansion) -> Expansion:
    """The law with as many parts, each with a loss rate of its own, as the cycles tell apart.

    Parameters
    ----------
    about : Expansion
        Of many cycles, with one a and one b.

    Returns
    -------
    Expansion
        The same where one loss rate does; else about the mean rate and the departures of the parts.

    Notes
    -----
    A part is divided where that is likelier than not: by the probability of its cycles' own rates
    with one mean and with two, the place and the size of the change averaged over, in noise whose
    size the differences of neighbours tell.

    Examples
    --------
    >>> t, noise = np.arange(0.0, 180.0, 10.0), np.random.default_rng(1).normal(size=(40, 18))
    >>> lives = np.where(np.arange(40) < 20, 36000.0, 30000.0)
    >>> pairs = zip(lives, noise, strict=True)
    >>> beam = [DecayRecord(t, 500 * np.exp(-t / life) + 1e-3 * row) for life, row in pairs]
    >>> with_course(solved(averaged(beam))).parts.first.size
    2
    """
    if not about.rested or about.level.size < 2 * PART:
        return about
    rate, error = _cycle_rates(about)
    apart = np.abs(np.diff(rate)) / np.hypot(error[1:], error[:-1])
    error = error * max(1.4826 * float(np.median(apart)), 1e-12)
    begins = _part_begins(rate, error, abs(float(about.numbers[0])))
    return _with_parts(about, np.array([0, *begins])) if begins else about


def _cycle_rates(about: Expansion) -> tuple[np.ndarray, np.ndarray]:
    """Departure of the loss of each cycle, in units of the search, and its error in noise of 1.

    What a power of a, within its prior, makes of cycles at other currents is taken off.
    """
    first, slope = about.pieces.first, about.left[:, LOSS]
    squares = np.add.reduceat(slope**2, first)
    columns = about.left[:, [POWER, -1]]
    power, rate = np.add.reduceat(slope[:, None] * columns, first).T / squares
    power, rate = (part - np.average(part, weights=squares) for part in (power, -rate))
    variance = max(float(squares @ rate**2) / rate.size, 1e-300)
    found = float(squares @ (power * rate)) / (squares @ power**2 + variance / BELOW**2)
    return rate - found * power, 1 / np.sqrt(squares)


def _part_begins(rate: np.ndarray, error: np.ndarray, mean: float) -> list[int]:
    """Cycles with which a part begins after the first; the likeliest changes first."""

    def with_change(begin: int, end: int) -> tuple[float, int, int, int]:
        odds, cut = _change(rate[begin:end], error[begin:end], mean)
        return odds, begin, begin + cut, end

    parts = [with_change(0, rate.size)]
    while len(parts) < MOST_PARTS and max(parts)[0] > 0:
        _, begin, cut, end = parts.pop(parts.index(max(parts)))
        parts += [with_change(begin, cut), with_change(cut, end)]
    return sorted(begin for _, begin, *_ in parts if begin)


def _change(rate: np.ndarray, error: np.ndarray, mean: float) -> tuple[float, int]:
    """Log odds that a rate changes among some cycles, and the likeliest first cycle after it."""
    if rate.size < 2 * PART:
        return -np.inf, 0
    weight = 1 / error**2
    before, sums = np.cumsum(weight)[:-1], np.cumsum(weight * rate)[:-1]
    after = weight.sum() - before
    change = (weight @ rate - sums) / after - sums / before
    variance = 1 / before + 1 / after
    place = slice(PART - 1, rate.size - PART)
    change, variance = change[place], variance[place]
    few = rate.size - 1  # neighbours tell the noise
    log = log_evidence_of_change(change**2 / variance, mean**2 / variance, few)
    odds = logsumexp(log) - np.log(log.size) + np.log(CHANGES / (1 - CHANGES))
    return float(odds), int(np.argmax(log)) + PART


def _with_parts(about: Expansion, begins: np.ndarray) -> Expansion:
    """The law about the mean loss rate and the departures of parts that begin with these cycles.

    The last departure follows from the others: weighed by time they add up to none. A cycle stands
    for the time until the next one, also where one between them was left out, but for no gap; of
    one that was left out between two parts each has a half. What was found with one loss rate may
    be far off, so that rows are taken anew, `COURSE_STEPS` times.
    """
    first, time = about.pieces.first[begins], about.pieces.time
    count = np.diff(first, append=time.size)
    apart = np.diff(time[about.pieces.first], append=time[-1])
    usual = float(np.median(apart))
    apart = np.minimum(apart, 2 * usual)
    half = 0.5 * np.maximum(apart[begins[1:] - 1] - usual, 0.0)
    lasts = np.add.reduceat(apart, begins) + np.append(0.0, half) - np.append(half, 0.0)
    shares = np.vstack([np.eye(begins.size - 1), -lasts[:-1] / lasts[-1]])
    numbers, departure = about.numbers, np.zeros(begins.size)
    for _ in range(COURSE_STEPS):
        found = Expansion.of(
            about.pieces, numbers, about.level, departure=np.repeat(departure, count)
        )
        rows = np.column_stack([found.rows, found.rows[:, [LOSS]] * np.repeat(shares, count, 0)])
        slopes = np.pad(found.slopes, ((0, 0), (0, begins.size - 1)))
        parts = Parts(first, shares, departure)
        found = replace(found, rows=rows, slopes=slopes, parts=parts, prior=about.prior)
        if not found.rested:  # a course with which the law has no value
            return about
        columns = found.columns()
        step = least_squares_step(found.left[:, [*columns, -1]], np.zeros((0, len(columns) + 1)))
        numbers, departure = numbers + np.append(step[:2], 0.0), departure + shares @ step[2:]
    return replace(
        found, numbers=numbers, residuals=found.left[:, -1] + found.left[:, columns] @ step,
        values=Physical(*(np.array(found.values) + slopes[:, columns] @ step)),
        parts=Parts(first, shares, departure),
    )  # fmt: skip
