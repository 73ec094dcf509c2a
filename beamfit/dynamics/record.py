"""A run of a process: inputs that were set and outputs that were read, against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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


def rows_of(run: Run, moving: Sequence[str], parts: int) -> np.ndarray:
    """Inputs at so many rows a sample, shape (samples * parts, inputs), some moving between them.

    Those go on by the sines that they are made of (C. E. Shannon 1949), mirrored at both ends.
    """
    columns = []
    for name, u in run.inputs.items():
        if name in moving:
            waves = np.fft.rfft(np.concatenate([u, u[::-1]]))
            turn = 2j * np.pi * np.fft.rfftfreq(2 * len(u))
            late = (np.arange(parts) + 0.5) / parts  # each part holds its middle
            fine = [np.fft.irfft(waves * np.exp(turn * s), 2 * len(u))[: len(u)] for s in late]
            columns.append(np.stack(fine, axis=1).ravel())
        else:
            columns.append(np.repeat(u, parts))
    return np.stack(columns, axis=1)


def ordered(run: Run, first: Run) -> Run:
    """The run with its inputs in the order of the first: matrices have them by their place."""
    return replace(run, inputs={name: run.inputs[name] for name in first.inputs})
