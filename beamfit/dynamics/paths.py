"""Paths from the recorded inputs to a process: a law, the motion between samples, and a delay.

All paths of a comparison have the same number of rows per sample.
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
from beamfit.dynamics.model import DrivenRun, PreparedOutput, padded_readings
from beamfit.dynamics.record import (
    ROWS_PER_SAMPLE,
    Run,
    Way,
    band_limited,
    interpolate_inputs,
    levels_of,
)
from beamfit.dynamics.response import Physics
from beamfit.noise.memory import is_correlated

# Longest delay that is tried, in samples and as a share of the shortest run; longest lead of the
# output that is tried, in samples. Chosen.
MAX_DELAY = 24
MAX_DELAY_SHARE = 0.1
MAX_LEAD = 3
# Log odds against clocks of input and output that differ: 1 in 150, a guess.
LEAD_LOG_ODDS = 5.0
# Change between steps of a straight line, as a share of the largest step, that digits may make.
STRAIGHT_TOLERANCE = 1e-3
# Readings scatter about levels at random if the correlation of neighbours is below this many
# standard errors; above it the input moves smoothly.
SMOOTH_CORRELATION = 4.0


class Path(NamedTuple):
    """A law if any, the motion of the inputs between samples, and the delay in samples."""

    law: InputLaw | None
    way: Way
    delay: float

    @property
    def width(self) -> float:
        """Standard deviation of a fractional delay within its part of a sample; else 0."""
        return 1 / (ROWS_PER_SAMPLE * np.sqrt(12)) if self.delay % 1.0 else 0.0


# Path of inputs without delay that hold from sample to sample.
DIRECT_PATH = Path(None, Way(), 0.0)


class Paths(NamedTuple):
    """The paths without a law that a record may have.

    Attributes
    ----------
    movable : Way
        Inputs that may move between samples, smoothly or in straight lines, and inputs whose
        readings scatter about levels that they may stand at.
    delays : tuple of float
        Whole samples, or the one given delay.
    fractional : bool
        True if fractions of a sample are possible too.
    """

    movable: Way
    delays: tuple[float, ...]
    fractional: bool

    @classmethod
    def of(cls, runs: Sequence[Run], delay: float | None, even: bool) -> Paths:
        """List the paths of runs; `even` for models that need whole samples."""
        moves = moving_inputs(runs)
        standing = tuple(name for name in inputs_with_levels(runs) if name not in sum(moves, ()))
        way = Way(*(((), ()) if even else moves), standing)
        if delay is not None:
            return cls(way, (delay,), False)
        most = max_delay(runs)
        return cls(way, tuple(map(float, range(-min(MAX_LEAD, most), most + 1))), not even)

    @property
    def given(self) -> bool:
        """True if the delay is given."""
        return len(self.delays) == 1

    @property
    def ways(self) -> tuple[Way, ...]:
        """Possible motions of the inputs between samples."""
        choices = (((), names) for names in self.movable)
        return tuple(dict.fromkeys(Way(*choice) for choice in product(*choices)))

    @property
    def rows_per_sample(self) -> int:
        """Rows per sample that all paths share."""
        return ROWS_PER_SAMPLE if self.movable.moving else 1

    def whole_delays(self) -> list[Path]:
        """Paths of whole delays."""
        return [Path(None, way, delay) for delay in self.delays for way in self.ways]

    def fractional_delays(self, delay: float) -> list[Path]:
        """Paths with fractional delays less than a sample from a given one."""
        if not self.fractional:
            return []
        low, high = delay - 1, min(delay + 1, max(self.delays[-1], 1))
        parts = np.arange(np.ceil(ROWS_PER_SAMPLE * low), np.floor(ROWS_PER_SAMPLE * high))
        middles = ((parts + 0.5) / ROWS_PER_SAMPLE).tolist()
        return [Path(None, way, middle) for middle in middles for way in self.ways]

    def log_prior(self, path: Path) -> float:
        """Give the log prior of a path: flat over motions, delays, and whole or fractional delays.

        A held input may be set by the clock of the readings, so that whole delays are as probable
        as all fractions together; a moving input knows no clock.
        """
        log = -np.log(len(self.ways))
        if self.given:
            return float(log)
        log -= np.log(self.delays[-1] + 1.0) + (LEAD_LOG_ODDS if path.delay < 0 else 0.0)
        if self.fractional and path.way.moving:
            log -= np.log(ROWS_PER_SAMPLE + 1.0)
        elif self.fractional:
            log -= np.log(2.0) + (np.log(ROWS_PER_SAMPLE) if path.delay % 1.0 else 0.0)
        return float(log)


def moving_inputs(runs: Sequence[Run]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Find inputs that may move between samples, smoothly or in straight lines.

    Smooth inputs have no high frequencies. Inputs on straight lines rest or keep their slope at
    most samples, and some of their changes take several samples.
    """
    smooth = band_limited(runs)

    def moves_straight(u: np.ndarray) -> bool:
        steps = np.diff(u)
        change = np.minimum(np.abs(steps[1:]), np.abs(np.diff(steps)))
        straight = change <= STRAIGHT_TOLERANCE * np.abs(steps).max()
        return bool(steps[1:] @ steps[:-1] > 0 and straight.mean() > 0.5)

    others = (name for name in runs[0].inputs if name not in smooth)
    return smooth, tuple(n for n in others if all(moves_straight(run.inputs[n]) for run in runs))


def inputs_with_levels(runs: Sequence[Run]) -> tuple[str, ...]:
    """Inputs whose readings scatter at random about levels between steps."""

    def has_levels(u: np.ndarray) -> bool:
        levels = levels_of(u).at
        scatters = bool(np.ptp(levels) and np.any(u != levels))
        used = np.unique(levels).size
        return scatters and not is_correlated(u - levels, used, SMOOTH_CORRELATION)

    return tuple(
        name for name in runs[0].inputs if all(has_levels(run.inputs[name]) for run in runs)
    )


def max_delay(runs: Sequence[Run]) -> int:
    """Longest delay that is tried, in samples."""
    return min(MAX_DELAY, int(MAX_DELAY_SHARE * min(map(len, runs))))


def usable_rows(run: Run, output: str, delay: float) -> np.ndarray:
    """Rows with a reading that depends, after the delay, on an input of the record."""
    rows = np.arange(len(run))
    recorded = (rows >= delay) & (rows < len(run) + delay)
    return np.flatnonzero(np.isfinite(run.outputs[output]) & recorded)


class PreparedReadings(NamedTuple):
    """Runs without inputs, their readings, and the first row of each.

    The first row is that of the first usable reading of any output.
    """

    drives: tuple[DrivenRun, ...]
    measured: tuple[np.ndarray, ...]
    first: tuple[int, ...]


def prepare_readings(
    runs: Sequence[Run],
    output: str,
    physics: Physics,
    rows_per_sample: int,
    delay: float = 0.0,
    max_readings: int | None = None,
) -> PreparedReadings:
    """Prepare the first `max_readings` readings of each run after a delay, without inputs."""
    drives, measured, firsts = [], [], []
    for i, run in enumerate(runs):
        read = usable_rows(run, output, delay)[:max_readings]
        if read.size < 2:
            problem = f"{read.size} readings of {output} after a delay of {delay:g} samples"
            raise run.unusable(problem, "a longer run")
        begin = min(int(rows[0]) for n in run.outputs if (rows := usable_rows(run, n, delay)).size)
        time = run.time[begin : None if max_readings is None else read[-1] + 1]
        steps = np.diff(time, append=time[-1:])
        dt = np.repeat(
            np.pad(steps, (0, padded_length(len(time)) - len(time))) / rows_per_sample,
            rows_per_sample,
        )
        even_rows = rows_per_sample if np.ptp(steps[:-1]) <= 1e-9 * steps[0] else 0
        where = padded_readings(run.time[read] - run.time[0], (read - begin) * rows_per_sample)
        drives.append(
            DrivenRun(
                physics, None, jnp.asarray(dt), *where, len(read), jnp.asarray(i), 0.0, even_rows
            )
        )
        measured.append(run.outputs[output][read])
        firsts.append(begin)
    return PreparedReadings(tuple(drives), tuple(measured), tuple(firsts))


def inputs_by_path(
    runs: Sequence[Run], prepared: PreparedReadings, rows_per_sample: int, paths: Sequence[Path]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Give the inputs of each run for each path, and the fraction of a row in each path's delay.

    The inputs have shape (paths, rows, inputs, 2): values after the law, and their change by one
    step of its width. Before the first sample an input has its first value.
    """
    whole_rows = [int(np.floor(path.delay * rows_per_sample)) for path in paths]
    found = []
    for run, drive, first in zip(runs, prepared.drives, prepared.first, strict=True):
        by_way = {
            way: interpolate_inputs(run, way, rows_per_sample)
            for way in {path.way for path in paths}
        }
        by_law: dict[Any, np.ndarray] = {}
        each, rows = [], first * rows_per_sample + np.arange(len(drive.dt))
        last = rows[-1] + 1 - min(whole_rows)
        for path, shift in zip(paths, whole_rows, strict=True):
            u = by_way[path.way][:last]
            u = np.stack([u, np.zeros_like(u)], axis=2)
            if path.law is not None:
                k = list(run.inputs).index(path.law.input)
                if path[:2] not in by_law:
                    by_law[path[:2]] = path.law.output_and_slope(u[:, k, 0])
                u[:, k] = by_law[path[:2]]
            each.append(u[np.clip(rows - shift, 0, len(u) - 1)])
        found.append(np.stack(each))
    return found, np.array([rows_per_sample * path.delay for path in paths]) - whole_rows


def prepare_output(
    runs: Sequence[Run], output: str, physics: Physics, path: Path
) -> PreparedOutput:
    """Prepare runs for a path without a law.

    A fraction of a row in the delay becomes a free number of the fit.
    """
    rows_per_sample = ROWS_PER_SAMPLE if path.way.moving else 1
    readings = prepare_readings(runs, output, physics, rows_per_sample, path.delay)
    inputs, (fraction,) = inputs_by_path(runs, readings, rows_per_sample, [path])
    drives = tuple(replace(drive, u=jnp.asarray(u[0, ..., 0]), delay_fraction=fraction)
                   for drive, u in zip(readings.drives, inputs, strict=True))  # fmt: skip
    limits = (-fraction, 1.0 - fraction) if fraction else None
    time = tuple(np.asarray(drive.time)[: drive.count] for drive in drives)
    u = np.concatenate([np.stack(list(run.inputs.values()), axis=1) for run in runs])
    spread = float(np.concatenate(readings.measured).std()) or 1.0
    delay = rows_per_sample * path.delay
    names = tuple(runs[0].inputs)
    input_scale = np.where(u.std(0) > 0, u.std(0), 1.0)
    return PreparedOutput(
        names, output, drives, readings.measured, time, u.mean(0), input_scale, spread, delay,
        rows_per_sample, limits,
    )  # fmt: skip
