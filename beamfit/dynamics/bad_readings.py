"""Readings that show no output: single ones far off, and a sensor that stands still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import expit

from beamfit.dynamics.model import CLOSE, PreparedOutput
from beamfit.dynamics.paths import heard
from beamfit.dynamics.record import LEAST, Run
from beamfit.dynamics.search import JITTER_COST, Begun, spread_by_jitter
from beamfit.errors import Status
from beamfit.noise.digits import digit_of
from beamfit.noise.model import Noise
from beamfit.noise.sizes import bad_density
from beamfit.statistics import CLEAR_ODDS, POOR_FIT

# Of more readings than this share, or of such as follow the inputs, the model is wrong and not the
# monitor.
MOST = 0.2
# A residual is judged about the running median of so many; most searches in turn.
AROUND, ROUNDS = 7, 5
# Number of equal readings that count as stuck, if the model moves away by AWAY times the noise.
HELD, AWAY = 8, 3.0
OFF, STILL = "far off their neighbours", "that stand still as the process moves"


class BadReadings(NamedTuple):
    """Readings of a run that are left out: how many, the first one's time, and what they are."""

    run: str
    count: int
    since: float
    what: str

    def __str__(self) -> str:
        return f"{self.count} {self.what} ({self.run}, the first at {self.since:.4g} s)"


F, A = TypeVar("F"), TypeVar("A")
Runs = tuple[Run, ...]
# True for readings of each run, shape (rows, outputs).
Masks = tuple[np.ndarray, ...]


def judged_without(
    runs: Runs,
    searches: Sequence[Callable[[Runs], F]],
    fit_of: Callable[[F], Begun],
    answer: Callable[[Runs, F, tuple[BadReadings, ...]], A],
) -> A:
    """The answer of runs without readings that show no output.

    Readings are judged beside each search's fit, which `fit_of` gives: the last search is the one
    that is answered by, others before it are quicker. A model that is refuted misses good readings:
    it is judged with all of them.
    """
    fit = answer(*_sound(runs, searches, fit_of))
    if not fit.left_out or fit.status is not Status.poor_fit:
        return fit
    again = answer(runs, searches[-1](runs), ())
    return again if again.status is Status.poor_fit else fit


def _sound(
    runs: Runs, searches: Sequence[Callable[[Runs], F]], fit_of: Callable[[F], Begun]
) -> tuple[Runs, F, tuple[BadReadings, ...]]:
    """Runs without readings that show no output, the fit of the others, and what those were."""
    kept, off = runs, _none(runs)
    for search in searches:
        found = search(kept)
        for _ in range(ROUNDS):
            trial, now = _settled(runs, fit_of(found), off)
            if trial is None or _same(now, off):
                break
            kept, off, found = trial, now, search(trial)
    if any(np.any(mask.mean(axis=0) > MOST) for mask in off) or _follows(runs, off):
        kept, off, found = runs, _none(runs), search(runs)
    left_out = _named(runs, off, OFF)
    trial = _without(kept, _judged(kept, fit_of(found), _equal))
    if trial is not kept and trial is not None:  # the process may stand still as well: a fit tells
        stuck = _judged(kept, fit_of(found).again(trial), _still)
        trial = _without(kept, stuck)
        if trial is not kept and trial is not None:
            kept, found = trial, search(trial)
            left_out += _named(runs, stuck, STILL)
    return kept, found, left_out


def _settled(runs: Runs, fit: Begun, off: Masks) -> tuple[Runs | None, Masks]:
    """Runs without readings that are far off a fit of the others, and which they are.

    Each round judges all readings: one that a worse fit missed comes back.
    """
    before: list[Masks] = []
    while True:
        before.append(off)
        off = _judged(runs, fit, _lone)
        trial = _without(runs, off)
        if trial is None or any(_same(off, each) for each in before):
            return trial, off
        fit = fit.again(trial)


def _follows(runs: Runs, off: Masks) -> bool:
    """True if readings that are far off come sooner after a change of an input than others, by
    their ranks: the model then misses how the output begins to move.
    """
    late, out = [], []
    for run, mask in zip(runs, off, strict=True):
        moves = np.any([np.diff(u, prepend=u[0]) != 0 for u in run.inputs.values()], axis=0)
        rows = np.arange(len(run))
        late.append(rows - np.maximum.accumulate(np.where(moves, rows, -len(run))))
        out.append(mask.any(axis=1))
    late, out = np.concatenate(late), np.concatenate(out)
    if not out.any():
        return False
    from scipy.stats import mannwhitneyu  # half a second that only such readings should cost

    sooner = mannwhitneyu(late[out], late[~out], alternative="less")
    return bool(sooner.pvalue < POOR_FIT)


def _none(runs: Runs) -> Masks:
    return tuple(np.zeros((len(run), len(run.outputs)), bool) for run in runs)


def _same(one: Masks, other: Masks) -> bool:
    return all(np.array_equal(*pair) for pair in zip(one, other, strict=True))


def _judged(
    runs: Runs,
    fit: Begun,
    judge: Callable[[PreparedOutput, Sequence[np.ndarray]], list[np.ndarray]],
) -> Masks:
    """Readings of runs that are judged so beside a fit of some of them."""
    case, masks = fit.on(runs), _none(runs)
    rest = case.rest(fit.settled.fit.model)
    for k, seen in enumerate(case.seen):
        for i, mask in enumerate(judge(seen, [row[k] for row in rest])):
            masks[i][heard(runs[i], seen.output, fit.path.delay), k] = mask
    return masks


def _without(runs: Runs, masks: Masks) -> Runs | None:
    """Runs without some readings; None if too few others are left."""
    if not any(map(np.any, masks)):
        return runs
    kept = []
    for run, mask in zip(runs, masks, strict=True):
        outputs = {}
        for (name, y), out in zip(run.outputs.items(), mask.T, strict=True):
            outputs[name] = np.where(out, np.nan, y)
            left, read = (int(np.isfinite(each).sum()) for each in (outputs[name], y))
            if left < max(LEAST, read - left):
                return None
        kept.append(replace(run, outputs=outputs))
    return tuple(kept)


def _named(runs: Runs, masks: Masks, what: str) -> tuple[BadReadings, ...]:
    """Readings that are left out, by run and output."""
    found = []
    for run, mask in zip(runs, masks, strict=True):
        for k, name in enumerate(run.outputs):
            if mask[:, k].any():
                said = f"readings of {name}" if len(run.outputs) > 1 else "readings"
                first = float(run.time[mask[:, k].argmax()])
                found.append(BadReadings(run.name, int(mask[:, k].sum()), first, f"{said} {what}"))
    return tuple(found)


def _lone(seen: PreparedOutput, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Readings that lie off beyond the noise by clear odds and are in no series of equal ones."""
    digit = digit_of(np.concatenate(seen.measured)) or 0.0
    least, found = np.hypot(CLOSE * seen.size_y, digit / np.sqrt(12.0)), []
    each = zip(seen.measured, residuals, seen.time, _equal(seen, residuals), strict=True)
    for y, rest, time, equal in each:
        off = rest - median_filter(rest, AROUND, mode="nearest")
        found.append((odds_of_bad(off, y - rest, time, float(least)) > CLEAR_ODDS) & ~equal)
    return found


def odds_of_bad(off: np.ndarray, fitted: np.ndarray, time: np.ndarray, least: float) -> np.ndarray:
    """Logarithm of the odds that readings are bad.

    Parameters
    ----------
    off, fitted, time : array, shape (n,)
        Residuals, the model, and when readings were taken, s.
    least : float
        Smallest standard deviation of good readings.

    Returns
    -------
    array, shape (n,)

    Notes
    -----
    The good-and-bad-data model of `beamfit.noise.sizes.bad_density`. Good readings scatter by a
    part that is the same everywhere and one that goes with the model's slope (a jitter of the
    clock, or a model that comes a little late), both at their likeliest by expectation and
    maximisation.

    Examples
    --------
    >>> off = np.append(np.random.default_rng(0).normal(size=50), 9.0)
    >>> (odds_of_bad(off, np.zeros(51), np.arange(51.0), 1e-3) > 0).nonzero()[0].tolist()
    [50]
    """
    scale, _ = spread_by_jitter(fitted, time)
    pulls = off / scale
    size = np.maximum(1.4826 * np.median(np.abs(pulls), axis=1), least)[:, None]
    for _ in range(50):
        pull = (pulls / size) ** 2
        bad = np.log(bad_density(pull, Noise()))
        good = expit(-0.5 * pull - bad)
        size = np.sqrt(
            np.sum(good * pulls**2, axis=1, keepdims=True) / good.sum(axis=1, keepdims=True)
        )
        size = np.maximum(size, least)
    minus = np.log(size * scale) - np.logaddexp(-0.5 * pull, bad)
    cost = 2.0 * minus.sum(axis=1) + JITTER_COST * (np.arange(len(scale)) > 0)
    return (bad + 0.5 * pull)[cost.argmin()]


def _equal(seen: PreparedOutput, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Readings in long series of equal ones."""
    return [np.repeat(lengths >= HELD, lengths) for lengths in map(_lengths, seen.measured)]


def _still(seen: PreparedOutput, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Those from which a model that was fitted without them moves away."""
    equal, masks = _equal(seen, residuals), []
    others = np.concatenate([r[~mask] for r, mask in zip(residuals, equal, strict=True)])
    noise = 1.4826 * float(np.median(np.abs(others)))
    for y, r, mask in zip(seen.measured, residuals, equal, strict=True):
        lengths = _lengths(y)
        first = np.append(0, np.cumsum(lengths)[:-1])
        off = np.sqrt(np.add.reduceat(r**2, first) / lengths)
        masks.append(mask & np.repeat(off > AWAY * noise, lengths))
    return masks


def _lengths(y: np.ndarray) -> np.ndarray:
    """Lengths of series of equal readings."""
    return np.diff(np.flatnonzero(np.diff(y, prepend=np.nan, append=np.nan) != 0))
