"""A run of a process: inputs that were set and outputs that were read, against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from beamfit.answer import shown
from beamfit.errors import InputError

# Fewest readings of an output; with fewer its response and its start are not separable.
LEAST = 8
# An input is band-limited if its changes have less than the share `FAINT` of their power above the
# share `HIGH` of the highest frequency; white ones have a tenth there, noise that is fed back too.
HIGH, FAINT = 0.9, 2e-3
# Rows a sample by which an input that moves between samples is followed: what is left of a sine of
# half the highest frequency is right to 1e-3.
PARTS = 8
# A step of an input's readings makes their squares less by so many logarithms of their number than
# none: the modified information criterion of N. R. Zhang and D. O. Siegmund, Biometrics 63 (2007).
STEP = 3.0


@shown
@dataclass(frozen=True, eq=False)
class Run:
    """A run.

    Parameters
    ----------
    time : array, shape (n,)
        When each row was taken, s; increasing, at any distances.
    inputs : mapping of str to array
        What was set, each shape (n,); a value holds until the next row.
    outputs : mapping of str to array
        What was read, each shape (n,); NaN where nothing was.
    name : str
        Of the run, for messages.
    path, sha256 : str
        The file, if there is one.
    provenance, notes : tuple of str
        Comments of the file, and what was done to its numbers.

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
        late = np.flatnonzero(~(np.diff(self.time) > 0))
        if late.size or not np.isfinite(self.time).all():
            k = int(late[0]) + 1 if late.size else 0
            before = f" after {self.time[k - 1]:.10g} s" if k else ""
            raise self.unusable(f"time {self.time[k]:.10g} s{before}", "times that increase", k)
        for name, values in self.inputs.items():
            if (bad := np.flatnonzero(~np.isfinite(values))).size:
                raise self.unusable(f"no value of {name}", "a number", int(bad[0]))
        for name, values in self.outputs.items():
            if (read := int(np.isfinite(values).sum())) < LEAST:
                raise self.unusable(f"{read} readings of {name}", f"at least {LEAST}")

    def unusable(self, found: str, expected: str, row: int | None = None) -> InputError:
        """Make the error that names the run, and the row if there is one."""
        place = "" if row is None else f"row {row + 1}: "
        return InputError(f"{place}{found}", expected, path=self.path or self.name)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def step(self) -> float | None:
        """The distance of the samples, s; None where they are not equal (to 1 %)."""
        apart = np.diff(self.time)
        usual = float(np.median(apart))
        return usual if np.allclose(apart, usual, rtol=0.01, atol=0.0) else None

    @property
    def headline(self) -> str:
        """Size and content of the record, in a line."""
        span = self.time[-1] - self.time[0]
        kinds = f"inputs {', '.join(self.inputs)}, outputs {', '.join(self.outputs)}"
        return f"{self.name}: {len(self)} rows over {span:.4g} s, {kinds}"

    def __str__(self) -> str:
        return self.headline


def checked(
    runs: Run | Sequence[Run], held: Sequence[Run], even: bool
) -> tuple[tuple[Run, ...], tuple[Run, ...]]:
    """Runs and those held back with their inputs in one order, as matrices have them.

    Refuses what does not fit together; `even` for models that need equal steps.
    """
    runs, held = (runs,) if isinstance(runs, Run) else tuple(runs), tuple(held)
    if not runs:
        raise InputError("no runs", "at least one")
    first = runs[0]
    for run in (*runs, *held):
        if set(run.inputs) != set(first.inputs) or set(run.outputs) != set(first.outputs):
            said = f"inputs {', '.join(run.inputs)} and outputs {', '.join(run.outputs)}"
            raise run.unusable(said, f"those of {first.name}: {first.headline.partition(', ')[2]}")
        if even and run.step is None:
            raise run.unusable("samples at unequal distances", "equal ones, or --model first-order")
        if even and not np.isclose(run.step, first.step, rtol=0.01):
            expected = f"{first.step:.4g} s, as in {first.name}, or --model first-order"
            raise run.unusable(f"samples every {run.step:.4g} s", expected)
    return tuple(tuple(ordered(run, first) for run in each) for each in (runs, held))


def check_inputs(runs: tuple[Run, ...]) -> None:
    """Refuse runs of which an input never changes."""
    first = runs[0]
    for name in first.inputs:
        if all(np.ptp(run.inputs[name]) == 0 for run in runs):
            said = f"input {name} at {runs[0].inputs[name][0]:g} all the time"
            raise first.unusable(said, "an input that changes: a step at least")


def band_limited(runs: Sequence[Run]) -> tuple[str, ...]:
    """Inputs of runs at equal steps that have no high frequencies."""
    if any(run.step is None for run in runs):
        return ()
    found = []
    for name in runs[0].inputs:
        high = whole = 0.0
        for run in runs:
            changes = np.diff(run.inputs[name])
            power = np.abs(np.fft.rfft(changes * np.hanning(len(changes)))) ** 2
            high, whole = high + power[int(HIGH * len(power)) :].sum(), whole + power.sum()
        found += [name] if high < FAINT * whole else []
    return tuple(found)


def _means(values: np.ndarray, weight: np.ndarray, least: float) -> np.ndarray:
    """Means of pieces, divided in two as long as two means explain so much more."""
    total, sums = (np.append(0.0, np.cumsum(each)) for each in (weight, weight * values))
    waiting, found = [(0, len(values))], [0]
    while waiting:
        low, high = waiting.pop()
        at = np.arange(low + 1, high)
        before, after = total[at] - total[low], total[high] - total[at]
        change = (sums[high] - sums[at]) / after - (sums[at] - sums[low]) / before
        explained = change**2 * before * after / (total[high] - total[low])
        if at.size and explained.max() > least:
            middle = int(at[explained.argmax()])
            found.append(middle)
            waiting += [(low, middle), (middle, high)]
    first = np.sort(found)
    means = np.add.reduceat(weight * values, first) / np.add.reduceat(weight, first)
    return np.repeat(means, np.diff(first, append=len(values)))


class InputLevels(NamedTuple):
    """Levels at which an input stood, by row, their variances, and how many rows each has."""

    at: np.ndarray
    variance: np.ndarray
    rows: np.ndarray


def levels_of(u: np.ndarray) -> InputLevels:
    """Levels of an input between its steps, if readings scatter about them by more than digits;
    those that are alike within their errors are one where that is likelier.

    Means of readings lie farther apart than what they are means of, by their errors: a gain would
    be too small (regression calibration: R. J. Carroll et al., Measurement Error in Nonlinear
    Models (2006), section 4.4).

    Examples
    --------
    >>> read = np.repeat([0.0, 1.0, 0.0], 20) + 0.01 * np.random.default_rng(1).normal(size=60)
    >>> np.abs(np.unique(levels_of(read).at)).round(2).tolist()
    [0.0, 1.0]
    """
    size = 1.4826 * np.median(np.abs(np.diff(u))) / np.sqrt(2)
    if size == 0:
        return InputLevels(u, np.zeros(len(u)), np.ones(len(u)))
    least = STEP * np.log(len(u)) * size**2
    found = _means(u, np.ones(len(u)), least)
    first = np.flatnonzero(np.diff(found, prepend=np.nan) != 0)
    lengths, order = np.diff(first, append=len(u)), np.argsort(found[first])
    means, weight = found[first][order], lengths[order].astype(float)
    alike = _means(means, weight, least)
    # Levels anywhere in the range, or each one of a few: what places cost, or saying which.
    few, error = len(np.unique(alike)), size / np.sqrt(lengths.mean())
    places = (len(means) - few) * np.log(max(np.ptp(means) / error, 1.0) / np.sqrt(2 * np.pi))
    missed = 0.5 * weight @ (means - alike) ** 2 / size**2
    if places > missed + len(means) * np.log(few):
        found = np.repeat(alike[np.argsort(order)], lengths)
    levels, which, count = np.unique(found, return_inverse=True, return_counts=True)
    error = np.sum((u - found) ** 2) / max(len(u) - len(levels), 1) / count
    kept = np.maximum(1.0 - error / max(found.var(), np.finfo(float).tiny), 0.0)
    at = found.mean() + kept * (levels - found.mean())
    return InputLevels(at[which], (kept * error)[which], count[which])


class Way(NamedTuple):
    """Names of inputs that move between samples, smoothly or in straight lines, and of those that
    stand at levels between steps though their readings scatter; others are as they were read, and
    hold to the next sample.
    """

    smooth: tuple[str, ...] = ()
    ramping: tuple[str, ...] = ()
    standing: tuple[str, ...] = ()

    @property
    def moving(self) -> tuple[str, ...]:
        """Those that move."""
        return self.smooth + self.ramping

    def taken(self, run: Run, name: str) -> InputLevels:
        """An input of a run as it was read, each row a level without an error, or at its levels."""
        u = run.inputs[name]
        if name in self.standing:
            return levels_of(u)
        return InputLevels(u, np.zeros(len(u)), np.ones(len(u)))


def unsure_gain(runs: Sequence[Run], way: Way, name: str) -> float:
    """Share by which the errors of an input's levels make its gain unsure, as those of a straight
    line's points.
    """
    squares = spread = 0.0
    for run in runs:
        at, variance, rows = way.taken(run, name)
        away = at - at.mean()
        squares, spread = squares + np.sum(rows * away**2 * variance), spread + away @ away
    return float(np.sqrt(squares) / spread)


def rows_of(run: Run, way: Way, parts: int) -> np.ndarray:
    """Inputs by a way at so many rows a sample, each held from its middle, shape
    (samples * parts, inputs).

    Smooth ones go on by the sines that they are made of (C. E. Shannon 1949) beside the line from
    the first sample to the last, as if they swung on about both ends.
    """
    late = (np.arange(parts) + 0.5) / parts
    columns = []
    for name in run.inputs:
        u = way.taken(run, name).at
        if name in way.smooth:
            slope, rows = (u[-1] - u[0]) / (len(u) - 1), np.arange(len(u))
            swing = u - u[0] - slope * rows
            both = np.concatenate([swing, -swing[-2:0:-1]])
            fine = 2 * parts * np.fft.irfft(np.fft.rfft(both), 2 * parts * len(both))
            line = u[0] + slope * np.add.outer(rows, late).ravel()
            columns.append(line + fine[1 : 2 * parts * len(u) : 2])
        elif name in way.ramping:
            steps = np.diff(u, append=2.0 * u[-1] - u[-2])
            columns.append((u[:, None] + np.outer(steps, late)).ravel())
        else:
            columns.append(np.repeat(u, parts))
    return np.stack(columns, axis=1)


def ordered(run: Run, first: Run) -> Run:
    """The run with its inputs in the order of the first: matrices have them by their place."""
    return replace(run, inputs={name: run.inputs[name] for name in first.inputs})
