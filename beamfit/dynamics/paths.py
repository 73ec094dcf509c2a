"""Paths from the recorded inputs to a process: behind a law, by a way between samples, late.

Every path hands on rows of its own, as many a sample for all paths of a comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from beamfit.arrays import padded_length
from beamfit.dynamics.input_laws import InputLaw
from beamfit.dynamics.model import Driven, PreparedOutput, readings_of
from beamfit.dynamics.record import PARTS, Run, Way, band_limited, levels_of, rows_of
from beamfit.dynamics.response import Physics
from beamfit.noise.memory import is_correlated

# Longest delay that is tried, in samples, and as a share of the run; most samples that clocks are
# taken to be apart.
LATEST, SHARE, EARLIEST = 24, 0.1, 3
# Logarithm of the odds of clocks of input and output that differ: 1 in 150, a guess.
AHEAD = 5.0
# Change of a step, as a share of the largest, that digits make.
STRAIGHT = 1e-3
# Correlation of neighbours about levels, in standard errors, of an input that is smooth instead.
SMOOTH = 4.0


class Path(NamedTuple):
    """A law or none, the way of the inputs between samples, and the delay in samples."""

    law: InputLaw | None
    way: Way
    delay: float

    @property
    def width(self) -> float:
        """Standard deviation of the delay in its part of a sample, in samples; 0 of a whole one."""
        return 1 / (PARTS * np.sqrt(12)) if self.delay % 1.0 else 0.0


class Paths(NamedTuple):
    """The paths without a law that a record may have.

    Attributes
    ----------
    most : Way
        Inputs that may move between samples, without high frequencies or in straight lines, and
        those that scatter about levels, at which they may stand.
    delays : tuple of float
        Whole samples, or the one delay that is given.
    some : bool
        Whether parts of a sample are possible besides.
    """

    most: Way
    delays: tuple[float, ...]
    some: bool

    @classmethod
    def of(cls, runs: Sequence[Run], delay: float | None, even: bool) -> Paths:
        """List those of runs, `even` where a model has whole samples; one delay if it is given."""
        moves = moving(runs)
        standing = tuple(name for name in stepwise(runs) if name not in sum(moves, ()))
        way = Way(*(((), ()) if even else moves), standing)
        if delay is not None:
            return cls(way, (delay,), False)
        most = latest(runs)
        return cls(way, tuple(map(float, range(-min(EARLIEST, most), most + 1))), not even)

    @property
    def given(self) -> bool:
        """True if the delay is."""
        return len(self.delays) == 1

    @property
    def ways(self) -> tuple[Way, ...]:
        """Ways of the inputs between samples."""
        each = (((), names) for names in self.most)
        return tuple(dict.fromkeys(Way(*some) for some in product(*each)))

    @property
    def parts(self) -> int:
        """Rows a sample that all paths have in common."""
        return PARTS if self.most.moving else 1

    def plain(self) -> list[Path]:
        """Paths of whole delays."""
        return [Path(None, way, delay) for delay in self.delays for way in self.ways]

    def around(self, delay: float) -> list[Path]:
        """Paths of parts of a sample less than one from a delay, at the middle of each part."""
        low, high = PARTS * (delay - 1), min(PARTS * (delay + 1), PARTS * max(self.delays[-1], 1))
        parts = np.arange(np.ceil(low), np.floor(high)) if self.some else np.zeros(0)
        return [Path(None, way, (k + 0.5) / PARTS) for k in parts.tolist() for way in self.ways]

    def log_prior(self, path: Path) -> float:
        """Even over the ways between samples, over delays, and over whole ones and parts: an input
        that is held may be set by the clock of the readings, one that moves knows no clock.
        """
        log = -np.log(len(self.ways))
        if self.given:
            return float(log)
        log -= np.log(self.delays[-1] + 1.0) + (AHEAD if path.delay < 0 else 0.0)
        if self.some and path.way.moving:
            log -= np.log(PARTS + 1.0)
        elif self.some:
            log -= np.log(2.0) + (np.log(PARTS) if path.delay % 1.0 else 0.0)
        return float(log)


def moving(runs: Sequence[Run]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Inputs that may move between samples: those without high frequencies, and those that rest or
    go straight on at most samples and some of whose changes take several.
    """
    smooth = band_limited(runs)

    def goes_on(u: np.ndarray) -> bool:
        steps = np.diff(u)
        least = np.minimum(np.abs(steps[1:]), np.abs(np.diff(steps)))
        straight = least <= STRAIGHT * np.abs(steps).max()
        return bool(steps[1:] @ steps[:-1] > 0 and straight.mean() > 0.5)

    others = (name for name in runs[0].inputs if name not in smooth)
    return smooth, tuple(n for n in others if all(goes_on(run.inputs[n]) for run in runs))


def stepwise(runs: Sequence[Run]) -> tuple[str, ...]:
    """Inputs whose readings scatter at random about levels between steps."""

    def steps(u: np.ndarray) -> bool:
        levels = levels_of(u).at
        scatters = bool(np.ptp(levels) and np.any(u != levels))
        return scatters and not is_correlated(u - levels, np.unique(levels).size, SMOOTH)

    return tuple(name for name in runs[0].inputs if all(steps(run.inputs[name]) for run in runs))


def latest(runs: Sequence[Run]) -> int:
    """The longest delay that is tried, in samples."""
    return min(LATEST, int(SHARE * min(map(len, runs))))


def heard(run: Run, output: str, delay: float) -> np.ndarray:
    """Rows with a reading that hears an input of the record: others hear what nobody knows."""
    rows = np.arange(len(run))
    since = (rows >= delay) & (rows < len(run) + delay)
    return np.flatnonzero(np.isfinite(run.outputs[output]) & since)


class Undriven(NamedTuple):
    """Runs without inputs, their readings, and the row of each where it begins: the first with a
    reading of any output.
    """

    drives: tuple[Driven, ...]
    measured: tuple[np.ndarray, ...]
    first: tuple[int, ...]


def undriven(
    runs: Sequence[Run],
    output: str,
    physics: Physics,
    parts: int,
    delay: float = 0.0,
    most: int | None = None,
) -> Undriven:
    """Runs of so many rows a sample as they are heard after a delay, `most` readings of each."""
    found, measured, first = [], [], []
    for i, run in enumerate(runs):
        read = heard(run, output, delay)[:most]
        if read.size < 2:
            said = f"{read.size} readings of {output} after a delay of {delay:g} samples"
            raise run.unusable(said, "a longer run")
        since = min(int(rows[0]) for n in run.outputs if (rows := heard(run, n, delay)).size)
        time = run.time[since : None if most is None else read[-1] + 1]
        apart = np.diff(time, append=time[-1:])
        dt = np.repeat(np.pad(apart, (0, padded_length(len(time)) - len(time))) / parts, parts)
        turn = parts if np.ptp(apart[:-1]) <= 1e-9 * apart[0] else 0
        each = (jnp.asarray(dt), *readings_of(run.time[read] - run.time[0], (read - since) * parts))
        found.append(Driven(physics, None, *each, len(read), jnp.asarray(i), 0.0, turn))
        measured.append(run.outputs[output][read])
        first.append(since)
    return Undriven(tuple(found), tuple(measured), tuple(first))


def handed_on(
    runs: Sequence[Run], seen: Undriven, parts: int, paths: Sequence[Path]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Inputs of each run behind each path and their changes by a step of a law's width, and the
    part of a row by which each path is later still.

    Shape (paths, rows, inputs, 2). Inputs before the first sample equal it.
    """
    whole = [int(np.floor(path.delay * parts)) for path in paths]
    found = []
    for run, drive, first in zip(runs, seen.drives, seen.first, strict=True):
        plain = {way: rows_of(run, way, parts) for way in {path.way for path in paths}}
        behind: dict[Any, np.ndarray] = {}
        each, rows = [], first * parts + np.arange(len(drive.dt))
        for path, late in zip(paths, whole, strict=True):
            u = plain[path.way]
            u = np.stack([u, np.zeros_like(u)], axis=2)
            if path.law is not None:
                at = list(run.inputs).index(path.law.input)
                if path[:2] not in behind:
                    behind[path[:2]] = path.law.behind(u[:, at, 0])
                u[:, at] = behind[path[:2]]
            each.append(u[np.clip(rows - late, 0, len(u) - 1)])
        found.append(np.stack(each))
    return found, np.array([parts * path.delay for path in paths]) - whole


def prepared(runs: Sequence[Run], output: str, physics: Physics, path: Path) -> PreparedOutput:
    """Runs as the model sees them behind a path without a law.

    A part of a row in the delay is a number of the fit.
    """
    parts = PARTS if path.way.moving else 1
    found = undriven(runs, output, physics, parts, path.delay)
    inputs, (part,) = handed_on(runs, found, parts, [path])
    drives = tuple(replace(drive, u=jnp.asarray(u[0, ..., 0]), part=part)
                   for drive, u in zip(found.drives, inputs, strict=True))  # fmt: skip
    ends = (-part, 1.0 - part) if part else None
    time = tuple(np.asarray(drive.time)[: drive.count] for drive in drives)
    u = np.concatenate([np.stack(list(run.inputs.values()), axis=1) for run in runs])
    spread = float(np.concatenate(found.measured).std()) or 1.0
    delay = parts * path.delay
    names = tuple(runs[0].inputs)
    wide = np.where(u.std(0) > 0, u.std(0), 1.0)
    return PreparedOutput(
        names, output, drives, found.measured, time, u.mean(0), wide, spread, delay, parts, ends
    )
