"""A run of a process: inputs that were set and outputs that were read, against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from beamfit.answer import shown
from beamfit.errors import InputError

# Smallest number of readings of an output: with fewer, response and start are not separable.
MIN_READINGS = 8
# An input is band-limited if its changes have less than MAX_HIGH_POWER of their power above the
# share HIGH_BAND of the highest frequency. White changes have a tenth there, and so has noise that
# is fed back.
HIGH_BAND = 0.9
MAX_HIGH_POWER = 2e-3
# Rows per sample that follow an input moving between samples: a sine of half the highest frequency
# is then right to 1e-3.
ROWS_PER_SAMPLE = 8
# Cost of a step between levels, in logarithms of the number of readings: the modified information
# criterion of N. R. Zhang and D. O. Siegmund, Biometrics 63 (2007).
STEP_PENALTY = 3.0


@shown
@dataclass(frozen=True, eq=False)
class Run:
    """A run of a process.

    Parameters
    ----------
    time : array, shape (n,)
        Times of the rows, s; increasing, at any distances.
    inputs : mapping of str to array
        Inputs that were set, each of shape (n,); a value holds until the next row.
    outputs : mapping of str to array
        Outputs that were read, each of shape (n,); NaN where there is no reading.
    name : str
        Name of the run, for messages.
    path, sha256 : str
        The file, if there is one.
    provenance, notes : tuple of str
        Comments of the file, and changes made to its numbers.

    Raises
    ------
    InputError
        If lengths differ, times do not increase, an input is not finite, or an output has fewer
        than 8 readings.

    Examples
    --------
    >>> t = np.arange(10.0)
    >>> print(Run(t, {"valve": t > 3}, {"level": t}))
    run: 10 rows over 9 s, inputs valve, outputs level
    """

    time: np.ndarray
    inputs: Mapping[str, np.ndarray]
    outputs: Mapping[str, np.ndarray]
    name: str = "run"
    path: str | None = None
    sha256: str = ""
    provenance: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "time", np.asarray(self.time, float))
        for kind in ("inputs", "outputs"):
            columns = {name: np.asarray(v, float) for name, v in getattr(self, kind).items()}
            object.__setattr__(self, kind, columns)
            if not columns:
                raise self.unusable(f"no {kind}", "at least one")
        n = len(self.time)
        for name, values in {**self.inputs, **self.outputs}.items():
            if values.shape != (n,):
                raise self.unusable(f"{len(values)} values of {name}", f"{n}, one a time")
        bad = np.flatnonzero(~(np.diff(self.time) > 0))
        if bad.size or not np.isfinite(self.time).all():
            k = int(bad[0]) + 1 if bad.size else 0
            before = f" after {self.time[k - 1]:.10g} s" if k else ""
            raise self.unusable(f"time {self.time[k]:.10g} s{before}", "times that increase", k)
        for name, values in self.inputs.items():
            if (bad := np.flatnonzero(~np.isfinite(values))).size:
                raise self.unusable(f"no value of {name}", "a number", int(bad[0]))
        for name, values in self.outputs.items():
            if (read := int(np.isfinite(values).sum())) < MIN_READINGS:
                raise self.unusable(f"{read} readings of {name}", f"at least {MIN_READINGS}")

    def unusable(self, found: str, expected: str, row: int | None = None) -> InputError:
        """Make an error that names the run, and the row if given."""
        place = "" if row is None else f"row {row + 1}: "
        return InputError(f"{place}{found}", expected, path=self.path or self.name)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def step(self) -> float | None:
        """Time between samples, s; None if they are not equally spaced to 1 %."""
        steps = np.diff(self.time)
        median = float(np.median(steps))
        return median if np.allclose(steps, median, rtol=0.01, atol=0.0) else None

    @property
    def headline(self) -> str:
        """Size and content of the record in one line."""
        span = self.time[-1] - self.time[0]
        kinds = f"inputs {', '.join(self.inputs)}, outputs {', '.join(self.outputs)}"
        return f"{self.name}: {len(self)} rows over {span:.4g} s, {kinds}"

    def __str__(self) -> str:
        return self.headline


def check_runs(
    runs: Run | Sequence[Run], held: Sequence[Run], even: bool
) -> tuple[tuple[Run, ...], tuple[Run, ...]]:
    """Bring the inputs of runs and held-out runs into one order, and check that they fit together.

    `even` requires equal time steps.
    """
    runs, held = (runs,) if isinstance(runs, Run) else tuple(runs), tuple(held)
    if not runs:
        raise InputError("no runs", "at least one")
    first = runs[0]
    for run in (*runs, *held):
        if set(run.inputs) != set(first.inputs) or set(run.outputs) != set(first.outputs):
            found = f"inputs {', '.join(run.inputs)} and outputs {', '.join(run.outputs)}"
            raise run.unusable(found, f"those of {first.name}: {first.headline.partition(', ')[2]}")
        if even and run.step is None:
            raise run.unusable("samples at unequal distances", "equal ones, or --model first-order")
        if even and not np.isclose(run.step, first.step, rtol=0.01):
            expected = f"{first.step:.4g} s, as in {first.name}, or --model first-order"
            raise run.unusable(f"samples every {run.step:.4g} s", expected)
    return tuple(tuple(reorder_inputs(run, first) for run in each) for each in (runs, held))


def check_inputs(runs: tuple[Run, ...]) -> None:
    """Refuse runs in which an input never changes."""
    first = runs[0]
    for name in first.inputs:
        if all(np.ptp(run.inputs[name]) == 0 for run in runs):
            found = f"input {name} at {runs[0].inputs[name][0]:g} all the time"
            raise first.unusable(found, "an input that changes: a step at least")


def band_limited(runs: Sequence[Run]) -> tuple[str, ...]:
    """Inputs of runs with equal steps that have no high frequencies."""
    if any(run.step is None for run in runs):
        return ()
    found = []
    for name in runs[0].inputs:
        high = total = 0.0
        for run in runs:
            changes = np.diff(run.inputs[name])
            power = np.abs(np.fft.rfft(changes * np.hanning(len(changes)))) ** 2
            high, total = high + power[int(HIGH_BAND * len(power)) :].sum(), total + power.sum()
        found += [name] if high < MAX_HIGH_POWER * total else []
    return tuple(found)


def _split_means(values: np.ndarray, weight: np.ndarray, min_gain: float) -> np.ndarray:
    """Piecewise means; pieces are divided while that lowers the squares by `min_gain`."""
    weights, sums = (np.append(0.0, np.cumsum(each)) for each in (weight, weight * values))
    pending, starts = [(0, len(values))], [0]
    while pending:
        low, high = pending.pop()
        cuts = np.arange(low + 1, high)
        before, after = weights[cuts] - weights[low], weights[high] - weights[cuts]
        change = (sums[high] - sums[cuts]) / after - (sums[cuts] - sums[low]) / before
        explained = change**2 * before * after / (weights[high] - weights[low])
        if cuts.size and explained.max() > min_gain:
            cut = int(cuts[explained.argmax()])
            starts.append(cut)
            pending += [(low, cut), (cut, high)]
    first = np.sort(starts)
    means = np.add.reduceat(weight * values, first) / np.add.reduceat(weight, first)
    return np.repeat(means, np.diff(first, append=len(values)))


class InputLevels(NamedTuple):
    """Level of an input at each row, variance of the level, and number of rows that it has."""

    at: np.ndarray
    variance: np.ndarray
    rows: np.ndarray


def levels_of(u: np.ndarray) -> InputLevels:
    """Estimate the levels of an input between its steps, if its readings scatter by more than
    digits.

    Levels that agree within their errors are merged where that is more probable. The means of
    readings are shrunk towards their mean: by their errors they lie farther apart than the true
    levels, and a gain would be too small (regression calibration: R. J. Carroll et al., Measurement
    Error in Nonlinear Models (2006), section 4.4).

    Examples
    --------
    >>> read = np.repeat([0.0, 1.0, 0.0], 20) + 0.01 * np.random.default_rng(1).normal(size=60)
    >>> np.abs(np.unique(levels_of(read).at)).round(2).tolist()
    [0.0, 1.0]
    """
    noise = 1.4826 * np.median(np.abs(np.diff(u))) / np.sqrt(2)
    if noise == 0:
        return InputLevels(u, np.zeros(len(u)), np.ones(len(u)))
    min_gain = STEP_PENALTY * np.log(len(u)) * noise**2
    means_by_row = _split_means(u, np.ones(len(u)), min_gain)
    first = np.flatnonzero(np.diff(means_by_row, prepend=np.nan) != 0)
    lengths, order = np.diff(first, append=len(u)), np.argsort(means_by_row[first])
    means, weight = means_by_row[first][order], lengths[order].astype(float)
    merged = _split_means(means, weight, min_gain)
    # Information of separate levels anywhere in the range, against a choice among a few levels.
    choices, error = len(np.unique(merged)), noise / np.sqrt(lengths.mean())
    separate = (len(means) - choices) * np.log(max(np.ptp(means) / error, 1.0) / np.sqrt(2 * np.pi))
    misfit = 0.5 * weight @ (means - merged) ** 2 / noise**2
    if separate > misfit + len(means) * np.log(choices):
        means_by_row = np.repeat(merged[np.argsort(order)], lengths)
    levels, which, count = np.unique(means_by_row, return_inverse=True, return_counts=True)
    error = np.sum((u - means_by_row) ** 2) / max(len(u) - len(levels), 1) / count
    shrinkage = np.maximum(1.0 - error / max(means_by_row.var(), np.finfo(float).tiny), 0.0)
    shrunk = means_by_row.mean() + shrinkage * (levels - means_by_row.mean())
    return InputLevels(shrunk[which], (shrinkage * error)[which], count[which])


class Way(NamedTuple):
    """Motion of inputs between samples, by name.

    `smooth` inputs move as sums of sines and `ramping` ones in straight lines. `standing` inputs
    stand at levels about which their readings scatter. Others are taken as read and hold until the
    next sample.
    """

    smooth: tuple[str, ...] = ()
    ramping: tuple[str, ...] = ()
    standing: tuple[str, ...] = ()

    @property
    def moving(self) -> tuple[str, ...]:
        """Inputs that move between samples."""
        return self.smooth + self.ramping

    def levels(self, run: Run, name: str) -> InputLevels:
        """Give an input of a run at its levels, or as read with each row an exact level."""
        u = run.inputs[name]
        if name in self.standing:
            return levels_of(u)
        return InputLevels(u, np.zeros(len(u)), np.ones(len(u)))


def gain_error_share(runs: Sequence[Run], way: Way, name: str) -> float:
    """Relative error of a gain from the errors of its input's levels."""
    squares = spread = 0.0
    for run in runs:
        at, variance, rows = way.levels(run, name)
        deviation = at - at.mean()
        squares += np.sum(rows * deviation**2 * variance)
        spread += deviation @ deviation
    return float(np.sqrt(squares) / spread)


def interpolate_inputs(run: Run, way: Way, rows_per_sample: int) -> np.ndarray:
    """Sample the inputs at the middle of each row, shape (samples * rows_per_sample, inputs).

    Smooth inputs follow their Fourier series (C. E. Shannon 1949) about the line from the first
    sample to the last, mirrored at both ends.
    """
    middles = (np.arange(rows_per_sample) + 0.5) / rows_per_sample
    columns = []
    for name in run.inputs:
        u = way.levels(run, name).at
        if name in way.smooth:
            slope, rows = (u[-1] - u[0]) / (len(u) - 1), np.arange(len(u))
            swing = u - u[0] - slope * rows
            mirrored = np.concatenate([swing, -swing[-2:0:-1]])
            factor = 2 * rows_per_sample
            fine = factor * np.fft.irfft(np.fft.rfft(mirrored), factor * len(mirrored))
            line = u[0] + slope * np.add.outer(rows, middles).ravel()
            columns.append(line + fine[1 : 2 * rows_per_sample * len(u) : 2])
        elif name in way.ramping:
            steps = np.diff(u, append=2.0 * u[-1] - u[-2])
            columns.append((u[:, None] + np.outer(steps, middles)).ravel())
        else:
            columns.append(np.repeat(u, rows_per_sample))
    return np.stack(columns, axis=1)


def reorder_inputs(run: Run, first: Run) -> Run:
    """Put the inputs of a run into the order of the first run."""
    return replace(run, inputs={name: run.inputs[name] for name in first.inputs})
