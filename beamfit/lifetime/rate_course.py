"""Course of the loss rate through many cycles, as of a week of top-up: in parts, by evidence.

Each cycle has a loss rate of its own, and how neighbours differ is the noise, whatever memory the
readings have within a cycle. A vacuum or a gap that changes moves all that follow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from beamfit.lifetime.expansion import LOSS, POWER, Expansion, Parts, Physical, expanded_about
from beamfit.lifetime.marginal import BELOW

# Prior probability that the loss rate changes within a part, as of a machine that is left alone.
CHANGES = 0.05
# A change is normal, its size a share of the loss rate flat in its logarithm: none smaller is seen,
# larger ones are of other beams.
SIZES = np.geomspace(1e-4, 0.5, 16)
# Cycles of a part at least, and parts at most: so many draw any course.
FEWEST, MOST = 2, 64
# Steps of Gauss and Newton for them: each leaves the square of what the last one left.
STEPS = 3


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
    >>> from beamfit.lifetime.cycles import averaged
    >>> from beamfit.lifetime.expansion import solved
    >>> from beamfit.lifetime.record import DecayRecord
    >>> t, noise = np.arange(0.0, 180.0, 10.0), np.random.default_rng(1).normal(size=(40, 18))
    >>> lives = np.where(np.arange(40) < 20, 36000.0, 30000.0)
    >>> pairs = zip(lives, noise, strict=True)
    >>> beam = [DecayRecord(t, 500 * np.exp(-t / life) + 1e-3 * row) for life, row in pairs]
    >>> with_course(solved(averaged(beam))).parts.first.size
    2
    """
    if not about.rested or about.level.size < 2 * FEWEST:
        return about
    rate, error = _cycle_rates(about)
    apart = np.abs(np.diff(rate)) / np.hypot(error[1:], error[:-1])
    error = error * max(1.4826 * float(np.median(apart)), 1e-12)
    begins = _divided(rate, error, abs(float(about.numbers[0])))
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


def _divided(rate: np.ndarray, error: np.ndarray, mean: float) -> list[int]:
    """Cycles with which a part begins after the first; the likeliest changes first."""

    def with_change(begin: int, end: int) -> tuple[float, int, int, int]:
        odds, cut = _change(rate[begin:end], error[begin:end], mean)
        return odds, begin, begin + cut, end

    parts = [with_change(0, rate.size)]
    while len(parts) < MOST and max(parts)[0] > 0:
        _, begin, cut, end = parts.pop(parts.index(max(parts)))
        parts += [with_change(begin, cut), with_change(cut, end)]
    return sorted(begin for _, begin, *_ in parts if begin)


def _change(rate: np.ndarray, error: np.ndarray, mean: float) -> tuple[float, int]:
    """Log odds that a rate changes among some cycles, and the likeliest first cycle after it."""
    if rate.size < 2 * FEWEST:
        return -np.inf, 0
    weight = 1 / error**2
    before, sums = np.cumsum(weight)[:-1], np.cumsum(weight * rate)[:-1]
    after = weight.sum() - before
    change = (weight @ rate - sums) / after - sums / before
    variance = 1 / before + 1 / after
    place = slice(FEWEST - 1, rate.size - FEWEST)
    change, variance = change[place], variance[place]
    worth = (mean * SIZES[:, None]) ** 2 / variance
    few, squares = rate.size - 1, change**2 / variance  # neighbours tell the noise: Student's
    log = np.log1p(squares / few) - np.log1p(squares / (1 + worth) / few)
    log = logsumexp(0.5 * (few + 1) * log - 0.5 * np.log1p(worth), axis=0) - np.log(SIZES.size)
    odds = logsumexp(log) - np.log(log.size) + np.log(CHANGES / (1 - CHANGES))
    return float(odds), int(np.argmax(log)) + FEWEST


def _with_parts(about: Expansion, begins: np.ndarray) -> Expansion:
    """The law about the mean loss rate and the departures of parts that begin with these cycles.

    The last departure follows from the others: weighed by readings they add up to none. What was
    found with one loss rate may be far off, so that rows are taken anew, `STEPS` times.
    """
    first = about.pieces.first[begins]
    count = np.diff(first, append=about.pieces.time.size)
    shares = np.vstack([np.eye(begins.size - 1), -count[:-1] / count[-1]])
    numbers, departure = about.numbers, np.zeros(begins.size)
    for _ in range(STEPS):
        found = expanded_about(about, numbers, np.repeat(departure, count))
        rows = np.column_stack([found.rows, found.rows[:, [LOSS]] * np.repeat(shares, count, 0)])
        slopes = np.pad(found.slopes, ((0, 0), (0, begins.size - 1)))
        found = replace(found, rows=rows, slopes=slopes, parts=Parts(first, shares, departure))
        columns = found.columns()
        step = np.linalg.lstsq(found.left[:, columns], -found.left[:, -1], rcond=None)[0]
        numbers, departure = numbers + np.append(step[:2], 0.0), departure + shares @ step[2:]
    return replace(
        found, numbers=numbers, residuals=found.left[:, -1] + found.left[:, columns] @ step,
        values=Physical(*(np.array(found.values) + slopes[:, columns] @ step)),
        parts=Parts(first, shares, departure),
    )  # fmt: skip
