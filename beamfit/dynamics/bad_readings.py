"""Readings that show no output: single ones far off, and a sensor that stands still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.ndimage import median_filter

from beamfit.dynamics.model import CLOSE
from beamfit.dynamics.paths import heard
from beamfit.dynamics.record import LEAST, Run
from beamfit.errors import Status

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


class FreeRun(NamedTuple):
    """An output beside the model that runs free: readings and what the model has there, by run, the
    delay in samples, and the scatter of the output.
    """

    output: str
    delay: float
    size: float
    measured: Sequence[np.ndarray]
    fitted: Sequence[np.ndarray]


class HasFreeRun(Protocol):
    """A fit of runs: `beamfit.dynamics.search.Begun`, or several of them."""

    def beside(self, runs: Sequence[Run]) -> list[FreeRun]:
        """Readings of some runs beside the fit."""


F, A = TypeVar("F", bound=HasFreeRun), TypeVar("A")
Runs = tuple[Run, ...]


def judged_without(
    runs: Runs,
    begin: Callable[[Runs], F],
    answer: Callable[[Runs, F, tuple[BadReadings, ...]], A],
) -> A:
    """The answer of runs without readings that show no output.

    A model that is refuted misses good readings: it is judged with all of them.
    """
    whole = begin(runs)
    fit = answer(*_sound(runs, whole, begin))
    if not fit.left_out or fit.status is not Status.poor_fit:
        return fit
    again = answer(runs, whole, ())
    return again if again.status is Status.poor_fit else fit


def _sound(
    runs: Runs,
    found: F,
    begin: Callable[[Runs], F],
) -> tuple[Runs, F, tuple[BadReadings, ...]]:
    """Runs without readings that show no output, the fit of the others, and what those were."""
    left_out: list[BadReadings] = []
    for _ in range(ROUNDS):
        trial, which = _without(runs, found.beside(runs), _lone, "far off their neighbours")
        if trial is None:
            break
        runs, left_out, found = trial, [*left_out, *which], begin(trial)
    trial, _ = _without(runs, found.beside(runs), _equal, "equal")
    if trial is not None:  # the process may stand still as well: a fit without them tells
        what = "that stand still as the process moves"
        trial, which = _without(runs, begin(trial).beside(runs), _still, what)
        if trial is not None:
            runs, left_out, found = trial, [*left_out, *which], begin(trial)
    return runs, found, tuple(left_out)


def _without(
    runs: Runs,
    outputs: Sequence[FreeRun],
    judge: Callable[[FreeRun], list[np.ndarray]],
    what: str,
) -> tuple[Runs | None, list[BadReadings]]:
    """Runs without the readings that are judged so, and which; None if there are none, or too few
    others.
    """
    kept, found = list(runs), []
    for each in outputs:
        for i, mask in enumerate(judge(each)):
            run, y = kept[i], kept[i].outputs[each.output].copy()
            rows = heard(run, each.output, each.delay)[mask]
            y[rows] = np.nan
            if np.isfinite(y).sum() < max(LEAST, len(rows)):
                return None, []
            kept[i] = replace(run, outputs={**run.outputs, each.output: y})
            if rows.size:
                said = f"readings of {each.output}" if len(outputs) > 1 else "readings"
                first = float(run.time[rows[0]])
                found.append(BadReadings(run.name, int(rows.size), first, f"{said} {what}"))
    return (tuple(kept) if found else None), found


def _lone(each: FreeRun) -> list[np.ndarray]:
    """Single readings that lie off, beyond the noise and the model's change nearby."""
    masks = []
    for y, fitted in zip(each.measured, each.fitted, strict=True):
        rest = y - fitted
        off = np.abs(rest - median_filter(rest, AROUND, mode="nearest"))
        noise = max(1.4826 * float(np.median(off)), CLOSE * each.size)
        steps = np.abs(np.diff(fitted, prepend=fitted[0], append=fitted[-1]))
        far = off > FAR * noise + MOVES * (steps[1:] + steps[:-1])
        if far.mean() > MOST:  # the model lacks something there, but what stands alone
            around = np.pad(far, 1)
            far = far & ~(around[2:] | around[:-2])
        masks.append(far & (far.mean() <= MOST))
    return masks


def _equal(each: FreeRun) -> list[np.ndarray]:
    """Readings in long series of equal ones."""
    return [np.repeat(lengths >= HELD, lengths) for lengths in map(_lengths, each.measured)]


def _still(each: FreeRun) -> list[np.ndarray]:
    """Those from which a model that was fitted without them moves away."""
    equal, masks = _equal(each), []
    rest = [y - f for y, f in zip(each.measured, each.fitted, strict=True)]
    others = np.concatenate([r[~mask] for r, mask in zip(rest, equal, strict=True)])
    noise = 1.4826 * float(np.median(np.abs(others)))
    for y, r, mask in zip(each.measured, rest, equal, strict=True):
        lengths = _lengths(y)
        first = np.append(0, np.cumsum(lengths)[:-1])
        off = np.sqrt(np.add.reduceat(r**2, first) / lengths)
        masks.append(mask & np.repeat(off > AWAY * noise, lengths))
    return masks


def _lengths(y: np.ndarray) -> np.ndarray:
    """Lengths of series of equal readings."""
    return np.diff(np.flatnonzero(np.diff(y, prepend=np.nan, append=np.nan) != 0))
