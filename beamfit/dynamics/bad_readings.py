"""Readings that do not show the output: single outliers, and series of a stuck sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import expit

from beamfit.dynamics.model import PreparedOutput
from beamfit.dynamics.paths import usable_rows
from beamfit.dynamics.record import MIN_READINGS, Run
from beamfit.dynamics.search import (
    JITTER_PENALTY,
    MAX_NOISE_READINGS,
    RunsFit,
    jitter_scales,
)
from beamfit.errors import Status
from beamfit.noise.digits import digit_of
from beamfit.noise.model import Noise
from beamfit.noise.sizes import bad_density
from beamfit.statistics import CLEAR_ODDS, POOR_FIT

# If more than this share of readings is bad, or bad readings follow the inputs, the model is wrong
# and not the monitor.
MAX_SHARE = 0.2
# Residuals are judged about a running median of this many readings.
MEDIAN_WIDTH = 7
# Largest number of searches in turn.
MAX_ROUNDS = 5
# This many equal readings count as stuck if the model moves away by this multiple of the noise.
MIN_STUCK = 8
MIN_STUCK_RATIO = 3.0
# Descriptions of the two kinds.
OUTLIER_WORDS = "far off their neighbours"
STUCK_WORDS = "that stand still as the process moves"


class BadReadings(NamedTuple):
    """Readings of a run that are left out: their number, the time of the first, and their kind."""

    run: str
    count: int
    since: float
    what: str

    def __str__(self) -> str:
        return f"{self.count} {self.what} ({self.run}, the first at {self.since:.4g} s)"


F, A = TypeVar("F"), TypeVar("A")
Runs = tuple[Run, ...]
# Mask of the readings of each run, shape (rows, outputs).
Masks = tuple[np.ndarray, ...]


def answer_without_bad_readings(
    runs: Runs,
    searches: Sequence[Callable[[Runs], F]],
    fit_of: Callable[[F], RunsFit],
    answer: Callable[[Runs, F, tuple[BadReadings, ...]], A],
) -> A:
    """Answer from runs without bad readings.

    Readings are judged against the fit that `fit_of` takes from each search; the last search is the
    one to answer with, the ones before are faster. A refuted model misses good readings, so it is
    judged with all of them.
    """
    fit = answer(*_exclude_bad_readings(runs, searches, fit_of))
    if not fit.left_out or fit.status is not Status.poor_fit:
        return fit
    with_all = answer(runs, searches[-1](runs), ())
    return with_all if with_all.status is Status.poor_fit else fit


def _exclude_bad_readings(
    runs: Runs, searches: Sequence[Callable[[Runs], F]], fit_of: Callable[[F], RunsFit]
) -> tuple[Runs, F, tuple[BadReadings, ...]]:
    """Remove bad readings; return the runs, their fit, and descriptions of the bad readings."""
    kept, masks = runs, _empty_masks(runs)
    for search in searches:
        fit = search(kept)
        for _ in range(MAX_ROUNDS):
            trial, new_masks = _exclude_outliers(runs, fit_of(fit), masks)
            if trial is None or _same_masks(new_masks, masks):
                break
            kept, masks, fit = trial, new_masks, search(trial)
    if any(np.any(mask.mean(axis=0) > MAX_SHARE) for mask in masks) or _follow_inputs(runs, masks):
        kept, masks, fit = runs, _empty_masks(runs), search(runs)
    left_out = _describe(runs, masks, OUTLIER_WORDS)
    trial = _remove_readings(kept, _mask_readings(kept, fit_of(fit), _equal_series))
    if trial is not kept and trial is not None:  # a fit shows if the process itself rests
        stuck = _mask_readings(kept, fit_of(fit).refit(trial), _stuck)
        trial = _remove_readings(kept, stuck)
        if trial is not kept and trial is not None:
            kept, fit = trial, search(trial)
            left_out += _describe(runs, stuck, STUCK_WORDS)
    return kept, fit, left_out


def _exclude_outliers(runs: Runs, fit: RunsFit, masks: Masks) -> tuple[Runs | None, Masks]:
    """Remove readings far off a fit of the others; return the runs and the masks.

    Each round judges all readings, so that one missed by a worse fit returns.
    """
    tried: list[Masks] = []
    while True:
        tried.append(masks)
        masks = _mask_readings(runs, fit, _outliers)
        trial = _remove_readings(runs, masks)
        if trial is None or any(_same_masks(masks, each) for each in tried):
            return trial, masks
        fit = fit.refit(trial)


def _follow_inputs(runs: Runs, masks: Masks) -> bool:
    """True if outliers follow changes of an input sooner than other readings, by a rank test.

    The model then misses how the output begins to move.
    """
    since, bad = [], []
    for run, mask in zip(runs, masks, strict=True):
        moves = np.any([np.diff(u, prepend=u[0]) != 0 for u in run.inputs.values()], axis=0)
        rows = np.arange(len(run))
        since.append(rows - np.maximum.accumulate(np.where(moves, rows, -len(run))))
        bad.append(mask.any(axis=1))
    since, bad = np.concatenate(since), np.concatenate(bad)
    if not bad.any():
        return False
    from scipy.stats import mannwhitneyu  # slow to import

    test = mannwhitneyu(since[bad], since[~bad], alternative="less")
    return bool(test.pvalue < POOR_FIT)


def _empty_masks(runs: Runs) -> Masks:
    return tuple(np.zeros((len(run), len(run.outputs)), bool) for run in runs)


def _same_masks(one: Masks, other: Masks) -> bool:
    return all(np.array_equal(*pair) for pair in zip(one, other, strict=True))


def _mask_readings(
    runs: Runs,
    fit: RunsFit,
    judge: Callable[[PreparedOutput, Sequence[np.ndarray]], list[np.ndarray]],
) -> Masks:
    """Judge the readings of runs against a fit of some of them."""
    case, masks = fit.case.for_runs(runs), _empty_masks(runs)
    residuals = case.residuals(fit.fit.model)
    for k, prepared in enumerate(case.prepared):
        for i, mask in enumerate(judge(prepared, [row[k] for row in residuals])):
            masks[i][usable_rows(runs[i], prepared.output, fit.path.delay), k] = mask
    return masks


def _remove_readings(runs: Runs, masks: Masks) -> Runs | None:
    """Remove readings from runs; None if too few are left."""
    if not any(map(np.any, masks)):
        return runs
    kept = []
    for run, run_mask in zip(runs, masks, strict=True):
        outputs = {}
        for (name, y), mask_of_output in zip(run.outputs.items(), run_mask.T, strict=True):
            outputs[name] = np.where(mask_of_output, np.nan, y)
            remaining, read = (int(np.isfinite(each).sum()) for each in (outputs[name], y))
            if remaining < max(MIN_READINGS, read - remaining):
                return None
        kept.append(replace(run, outputs=outputs))
    return tuple(kept)


def _describe(runs: Runs, masks: Masks, what: str) -> tuple[BadReadings, ...]:
    """Describe the readings that are left out, by run and output."""
    found = []
    for run, mask in zip(runs, masks, strict=True):
        for k, name in enumerate(run.outputs):
            if mask[:, k].any():
                kind = f"readings of {name}" if len(run.outputs) > 1 else "readings"
                first = float(run.time[mask[:, k].argmax()])
                found.append(BadReadings(run.name, int(mask[:, k].sum()), first, f"{kind} {what}"))
    return tuple(found)


def _outliers(prepared: PreparedOutput, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Mark readings that are off by clear odds and not in a series of equal ones."""
    digit = digit_of(np.concatenate(prepared.measured)) or 0.0
    floor, found = np.hypot(prepared.floor, digit / np.sqrt(12.0)), []
    equal_series = _equal_series(prepared, residuals)
    each = zip(prepared.measured, residuals, prepared.time, equal_series, strict=True)
    for y, r, time, equal in each:
        around = sliding_window_view(np.pad(r, MEDIAN_WIDTH // 2, "edge"), MEDIAN_WIDTH)
        off = r - np.median(around, axis=1)
        found.append((odds_of_bad(off, y - r, time, float(floor)) > CLEAR_ODDS) & ~equal)
    return found


def odds_of_bad(off: np.ndarray, fitted: np.ndarray, time: np.ndarray, floor: float) -> np.ndarray:
    """Log odds that readings are bad.

    Parameters
    ----------
    off, fitted, time : array, shape (n,)
        Residuals, the model, and the times of the readings, s.
    floor : float
        Smallest standard deviation of good readings.

    Returns
    -------
    array, shape (n,)

    Notes
    -----
    The good-and-bad-data model of `beamfit.noise.sizes.bad_density`. Good readings scatter by a
    constant part and a part proportional to the model's slope (jitter of the clock, or a small
    error of the delay), both estimated by expectation and maximisation from `MAX_NOISE_READINGS`
    readings at most.

    Examples
    --------
    >>> off = np.append(np.random.default_rng(0).normal(size=50), 9.0)
    >>> (odds_of_bad(off, np.zeros(51), np.arange(51.0), 1e-3) > 0).nonzero()[0].tolist()
    [50]
    """
    scale, _ = jitter_scales(fitted, time)
    some = slice(None, None, -(-len(off) // MAX_NOISE_READINGS))
    pulls = off[some] / scale[:, some]
    level = np.maximum(1.4826 * np.median(np.abs(pulls), axis=1), floor)[:, None]
    for _ in range(50):
        pull = (pulls / level) ** 2
        bad = np.log(bad_density(pull, Noise()))
        good = expit(-0.5 * pull - bad)
        squares = np.sum(good * pulls**2, axis=1, keepdims=True)
        last, level = level, np.maximum(np.sqrt(squares / good.sum(axis=1, keepdims=True)), floor)
    minus = np.log(level * scale[:, some]) - np.logaddexp(-0.5 * pull, bad)
    cost = 2.0 * minus.sum(axis=1) + JITTER_PENALTY * (np.arange(len(scale)) > 0)
    best = cost.argmin()
    pull = (off / scale[best] / last[best]) ** 2
    return np.log(bad_density(pull, Noise())) + 0.5 * pull


def _equal_series(prepared: PreparedOutput, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Mark readings in long series of equal ones."""
    return [
        np.repeat(lengths >= MIN_STUCK, lengths)
        for lengths in map(_series_lengths, prepared.measured)
    ]


def _stuck(prepared: PreparedOutput, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Mark series of equal readings from which a model fitted without them moves away."""
    equal, masks = _equal_series(prepared, residuals), []
    others = np.concatenate([r[~mask] for r, mask in zip(residuals, equal, strict=True)])
    noise = 1.4826 * float(np.median(np.abs(others)))
    for y, r, mask in zip(prepared.measured, residuals, equal, strict=True):
        lengths = _series_lengths(y)
        first = np.append(0, np.cumsum(lengths)[:-1])
        off = np.sqrt(np.add.reduceat(r**2, first) / lengths)
        masks.append(mask & np.repeat(off > MIN_STUCK_RATIO * noise, lengths))
    return masks


def _series_lengths(y: np.ndarray) -> np.ndarray:
    """Lengths of series of equal readings."""
    return np.diff(np.flatnonzero(np.diff(y, prepend=np.nan, append=np.nan) != 0))
