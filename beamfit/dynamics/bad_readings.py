"""Readings that show no output: single ones far off, and a sensor that stands still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from beamfit.dynamics.model import CLOSE, output_of
from beamfit.dynamics.paths import heard, prepared
from beamfit.dynamics.record import LEAST, Run
from beamfit.dynamics.search import Begun

# A single reading is bad beyond FAR times the noise, the residual about a running median of AROUND
# readings, plus MOVES times the model's step there. More than the share MOST are the
# process's own. The search is repeated ROUNDS times, each beside a fit without those found.
FAR, MOST, AROUND, MOVES, ROUNDS = 10.0, 0.05, 7, 3.0, 3
# Number of equal readings that count as stuck, if the model moves away by AWAY times the noise.
HELD, AWAY = 8, 3.0


class BadReadings(NamedTuple):
    """Readings of a run that are left out: how many, the first one's time, and what they are."""

    run: str
    count: int
    since: float
    what: str

    def __str__(self) -> str:
        return f"{self.count} {self.what} ({self.run}, the first at {self.since:.4g} s)"


def sound(
    runs: tuple[Run, ...], output: str, begin: Callable[[tuple[Run, ...]], Begun]
) -> tuple[tuple[Run, ...], tuple[BadReadings, ...], Begun]:
    """Runs without readings that show no output, what those were, and the fit of the others."""
    found, left_out = begin(runs), []
    for _ in range(ROUNDS):
        delay = found.path.delay
        masks = [_lone(y, f, found.seen.size_y) for y, f in _beside(runs, output, found)]
        trial, which = _without(runs, output, delay, masks, "readings far off their neighbours")
        if trial is None:
            break
        runs, left_out, found = trial, [*left_out, *which], begin(trial)
    delay = found.path.delay
    trial, _ = _without(runs, output, delay, [_still(y) for y in found.seen.measured], "")
    if trial is not None:  # the process may stand still as well: a fit without them tells
        other = begin(trial)
        rest = np.concatenate([left for (left,) in other.plain.rest])
        noise = 1.4826 * float(np.median(np.abs(rest)))
        masks = [_still(y, f, noise) for y, f in _beside(runs, output, other)]
        trial, which = _without(
            runs, output, other.path.delay, masks, "readings that stand still as the process moves"
        )
        if trial is not None:
            runs, left_out, found = trial, [*left_out, *which], begin(trial)
    return runs, tuple(left_out), found


def _beside(
    runs: tuple[Run, ...], output: str, found: Begun
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Readings of each run, and the free-running output there."""
    seen = prepared(runs, output, found.seen.runs[0].physics, found.path)
    pairs = zip(seen.measured, seen.runs, strict=True)
    return [(y, output_of(found.plain.fit.model, run)) for y, run in pairs]


def _without(
    runs: tuple[Run, ...], output: str, delay: float, masks: Sequence[np.ndarray], what: str
) -> tuple[tuple[Run, ...] | None, list[BadReadings]]:
    """Runs without some of the readings that are used, and which; None if there are none, or too
    few others.
    """
    kept, found = [], []
    for run, mask in zip(runs, masks, strict=True):
        y = run.outputs[output].copy()
        rows = heard(run, output, delay)[mask]
        y[rows] = np.nan
        if np.isfinite(y).sum() < max(LEAST, len(rows)):
            return None, []
        kept.append(replace(run, outputs={**run.outputs, output: y}))
        if rows.size:
            found.append(BadReadings(run.name, int(rows.size), float(run.time[rows[0]]), what))
    return (tuple(kept) if found else None), found


def _lone(y: np.ndarray, fitted: np.ndarray, size: float) -> np.ndarray:
    """Single readings that lie off, beyond the noise and the model's change nearby."""
    rest = y - fitted
    off = np.abs(rest - median_filter(rest, AROUND, mode="nearest"))
    noise = max(1.4826 * float(np.median(off)), CLOSE * size)
    steps = np.abs(np.diff(fitted, prepend=fitted[0], append=fitted[-1]))
    far = off > FAR * noise + MOVES * (steps[1:] + steps[:-1])
    return far & (far.mean() <= MOST)


def _still(y: np.ndarray, fitted: np.ndarray | None = None, noise: float = 0.0) -> np.ndarray:
    """Readings in long series of equal ones, where a model, if given, says otherwise."""
    edges = np.flatnonzero(np.diff(y, prepend=np.nan, append=np.nan) != 0)
    mask = np.zeros(len(y), bool)
    for a, b in pairwise(edges):
        off = np.inf if fitted is None else float(np.sqrt(np.mean((y[a:b] - fitted[a:b]) ** 2)))
        mask[a:b] = b - a >= HELD and off > AWAY * noise
    return mask
