"""The cycles of a record with many refills, as of top-up: cleaned for one law, and how their loss
rate changes.
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
    least_squares_step,
    solved,
)
from beamfit.lifetime.free_law import EXPONENT_SD_BELOW
from beamfit.lifetime.pieces import MIN_CYCLE_READINGS, MIN_CYCLES
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.statistics import CLEAR_ODDS, log_evidence_of_change

# Cycles whose settings and pressure agree to this share have one a and one b.
SAME = 0.02
# Noise over the height of a sawtooth that is looked at.
NOISES = (0.01, 0.03, 0.1, 0.2)
# Refills of top-up come every 3 min, within a factor 3, those of fills hours apart; lifetimes are
# 15 h within a factor 3, the rest within seconds to years:
# middle, s, width of the logarithm, and its whole range about that.
PERIOD, LIFETIME = (180.0, 1.2, 12.0), (15 * 3600.0, 1.2, 17.0)
# Of these so many are usual; and records without a decay so often have refills that none shows.
USUAL, HELD = 0.8, 0.1


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
    stands = cycles[0].mean and float(np.mean([cycle.mean_current for cycle in cycles]))
    return DecayRecord(
        time, all_of([cycle.current for cycle in cycles]),
        all_of([cycle.error for cycle in cycles]), name, begin,
        Conditions(*map(all_of, zip(*(c.conditions for c in cycles), strict=True))),
        notes=cycles[0].notes, mean=stands,
    )  # fmt: skip


# Readings beyond which neighbours are averaged, in blocks within a cycle.
MOST = 16384
# Robust standard deviations off which a reading or a cycle is left out; at most this share of them.
OUTLIER, SHARE = 7.0, 0.2
# Errors of the mean by which readings at the edges of cycles lie off the law where they are of an
# injection: what stays below is in the errors (`beamfit.lifetime.expansion.SHIFTS`).
EDGE, WITHIN = 2.5, "they lie within injections"
FRESH, SETTLES = "fresh beam decays faster", f"{WITHIN}, or the monitor settles"
# Neighbours that tell where a cycle, or a reading at the edge of one, should lie.
NEXT = 9
# Time constants of fresh beam that are looked for, and the part of its error to which it has faded.
TAILS, FADED = 12, 0.1


def averaged(cycles: Sequence[DecayRecord]) -> Pieces:
    """All readings, in time; of very many the means of neighbours within a cycle."""
    size = -(-sum(map(len, cycles)) // MOST)
    begin, place, parts = 0.0, 0, []
    known = all(cycle.start is not None for cycle in cycles)
    for cycle in cycles:
        begin = cycle.start if known else begin
        time, current, error = cycle.means(min(size, len(cycle) // MIN_CYCLE_READINGS))
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
    if ends.shape[1] < MIN_CYCLES:
        return np.zeros(2)
    off = -about.left[:, -1]
    scatter = max(1.4826 * float(np.median(np.abs(off))), 1e-300)
    inward = np.array([[1], [-1]])[..., None] * np.arange(1, NEXT)
    beside = off[ends] - off[ends[..., None] + inward].mean(axis=2)
    beside = np.clip(beside / scatter, -OUTLIER, OUTLIER)
    return beside.mean(axis=1) * math.sqrt(ends.shape[1] / (1 + 1 / (NEXT - 1)))


def _settles(about: Expansion, most: int) -> tuple[int, bool]:
    """Readings at the start of a cycle until fresh beam, which decays faster, or the monitor has
    settled, at most so many; and whether they are high. How its size differs from cycle to cycle
    tells the error: noise may have a memory.
    """
    pieces, first = about.pieces, about.pieces.first
    times = np.geomspace(1.0, max(most / math.log(EDGE / FADED), 1.0), TAILS)
    columns = about.beside(np.exp(-pieces.place[:, None] / times) * pieces.weight[:, None])
    law = np.linalg.qr(about.left[:, about.columns(POWER)])[0]
    columns -= law @ (law.T @ columns)
    above = np.add.reduceat(-about.left[:, [-1]] * columns, first)
    squares = np.add.reduceat(columns**2, first)
    off = above - above.sum(axis=0) / squares.sum(axis=0) * squares
    cycles = first.size
    error = np.sqrt(np.sum(off**2, axis=0) * cycles / (cycles - 1))
    excess = above.sum(axis=0) / np.maximum(error, 1e-300)
    best = int(np.argmax(np.abs(excess)))
    size, high = abs(excess[best]), bool(excess[best] > 0)
    if not 2 * stdtr(cycles - 1, -size) * times.size < ndtr(-EDGE):
        return 0, high
    return min(math.ceil(math.log(size / FADED) * times[best]), most), high


def _trimmed(about: Expansion) -> tuple[Expansion, list[str]]:
    """The fit without readings at the edges of cycles that are not of the decay."""
    cut, high = np.zeros(2, int), 0
    most = int(np.median(about.pieces.lengths)) // 3
    while cut.max() < most:
        first_off, last_off = _edges(about)
        settled, above = _settles(about, most - cut[0])
        far = np.array([max(abs(first_off) > EDGE, settled), last_off > EDGE], int)
        if not far.any():
            break
        high += max(int(first_off > EDGE), settled * above)
        place, lengths = about.pieces.place, about.pieces.lengths
        whole = np.repeat(lengths, lengths)
        keep = (place >= far[0]) & (place < whole - far[1]) | (whole <= NEXT)
        about = with_course(solved(about.pieces.kept(keep, MIN_CYCLE_READINGS)))
        cut = cut + far
    said = []
    for side, why in enumerate((FRESH if 2 * high >= cut[0] else SETTLES, WITHIN)):
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
        about = with_course(solved(before.kept(~cut, MIN_CYCLE_READINGS)))
        left = before.first.size - about.pieces.first.size
        were = "cycle was" if left == 1 else "cycles were"
        said.append(f"{left} {were} left out, whose loss rate lies far off the others'")
    if (lone := _far(about.left[:, -1])).any():
        said.append(f"{int(lone.sum())} readings were left out as outliers")
        about = with_course(solved(about.pieces.kept(~lone, MIN_CYCLE_READINGS)))
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
    found = float(squares @ (power * rate)) / (squares @ power**2 + variance / EXPONENT_SD_BELOW**2)
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
