"""A record of beam current against time: what is measured, checked on construction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from beamfit.errors import InputError
from beamfit.frames import frame_of
from beamfit.shown import shown
from beamfit.studies.decay.conditions import PLAUSIBLE, Conditions, first_fault
from beamfit.table import Table

if TYPE_CHECKING:
    from pandas import DataFrame

    from beamfit.studies.decay.monitor import Monitor

FEWEST_LIFETIMES = 4
# Readings of a record that a notebook shows.
MOST_SHOWN = 20
# A pressure that departs from P0 + P1 I by less than this share of the record's mean, on average
# up to any time, follows the current.
FOLLOWS = 2e-3


def _digit(values: np.ndarray) -> float | None:
    """The step between readings that often repeat; None where they seldom do, or the levels lie at
    no multiples of it, as of values that are held until the next.
    """
    levels = np.unique(values)
    if levels.size < 2 or levels.size > values.size / 2:
        return None
    steps = np.diff(levels)
    step = float(steps.min())
    off = np.abs(steps / step - np.round(steps / step))
    return step if float(np.median(off)) < 0.1 else None


def _frozen(values: object, rows: int, quantity: str) -> np.ndarray:
    array = np.array(values, float)
    if array.shape != (rows,):
        found = f"{quantity} of shape {array.shape}"
        raise InputError(found, f"{rows} readings", column=quantity)
    array.flags.writeable = False
    return array


@shown
@dataclass(frozen=True, eq=False, repr=False)
class DecayRecord:
    """Beam current against time, validated and immutable.

    Parameters
    ----------
    time : array, shape (n,)
        Times, s, increasing; kept relative to the first.
    current : array, shape (n,)
        Beam current, mA; zero where the monitor dropped out.
    error : array, shape (n,), optional
        Standard deviation of each reading, mA. Without it the noise is inferred from the fit.
    name : str, optional
        What to call the record in results: the file's name.
    start : float, optional
        Unix time of the first reading, s.
    conditions : Conditions, optional
        Operating conditions in SI, each of shape (n,).
    comments : tuple of str, optional
        Provenance, as written in the file.
    notes : tuple of str, optional
        What was done to its numbers, such as rows left out.
    monitor : Monitor, optional
        Stability of the current monitor, which errors of results then contain.

    Raises
    ------
    InputError
        If there are fewer than two readings, shapes differ, times do not increase, a current or
        condition is negative or not finite, an error is not positive, or units are mixed.

    Examples
    --------
    >>> record = DecayRecord([0, 60, 120], [100.0, 99.9, 99.8])
    >>> print(record)
    record: 3 readings over 0.0333 h, 100 to 99.8 mA
    """

    time: np.ndarray
    current: np.ndarray
    error: np.ndarray | None = None
    name: str = "record"
    start: float | None = None
    conditions: Conditions = field(default_factory=Conditions)
    comments: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    monitor: Monitor | None = None

    def __post_init__(self) -> None:
        rows = np.size(self.time)
        if self.monitor is not None:
            self.monitor.check()
        if rows < 2:
            raise InputError(f"{rows} readings", "two or more", path=self.name)

        def frozen(given: Mapping[str, object]) -> dict[str, np.ndarray]:
            return {name: _frozen(v, rows, name) for name, v in given.items() if v is not None}

        own = frozen({name: getattr(self, name) for name in ("time", "current", "error")})
        conditions = Conditions(**frozen(self.conditions.given))
        fault = first_fault(own["time"], own["current"], own.get("error"), conditions)
        if fault is not None:
            found = f"reading {fault.row + 1}: {fault.found}"
            raise InputError(found, fault.expected, path=self.name, column=fault.quantity)
        own |= frozen({"time": own["time"] - own["time"][0]})
        vars(self).update(own, conditions=conditions)

    def __len__(self) -> int:
        return self.time.size

    def __str__(self) -> str:
        return (
            f"{self.name}: {len(self)} readings over {self.span / 3600:.3g} h, "
            f"{self.current[0]:.6g} to {self.current[-1]:.6g} mA"
        )

    def to_frame(self) -> DataFrame:
        """Give a pandas data frame, its columns named as in a file; `read_decay_record` takes it.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        start, error = self.start or 0.0, self.error
        columns = {"time_s": start + self.time, "beam_current_mA": self.current}
        columns |= {} if error is None else {"beam_current_error_mA": error}
        for name, values in self.conditions.given.items():
            unit = PLAUSIBLE[name][2]
            columns[name if name == unit else f"{name}_{unit}"] = values
        return frame_of(columns)

    @property
    def headline(self) -> str:
        """The record in a line."""
        return str(self)

    def tables(self) -> tuple[Table, ...]:
        """The first readings, to be shown."""
        few = range(min(len(self), MOST_SHOWN))
        rows = [[f"{self.time[i]:.6g}", f"{self.current[i]:.6g}"] for i in few]
        more = f"the first {len(few)} of {len(self)} readings" if len(few) < len(self) else ""
        return (Table(str(self), ["time s", "beam current mA"], rows, more, numeric=True),)

    @property
    def span(self) -> float:
        """Time from the first to the last reading, s."""
        return float(self.time[-1])

    @property
    def resolution(self) -> float | None:
        """Step of a coarsely quantised reading, mA; None where readings seldom repeat, or lie at
        no multiples of a step.
        """
        return _digit(self.current)

    @cached_property
    def gauge(self) -> np.ndarray | None:
        """Integral of the pressure over its mean, s, where it does not follow the current.

        None where no pressure is given, or it is P0 + P1 I with positive P0 to within `FOLLOWS`
        or the last digit of the gauge: the beam's own gas is part of a, as in the report.
        """
        pressure = self.conditions.pressure
        if pressure is None or not pressure.mean() > 0:
            return None
        slope, base = np.polyfit(self.current, pressure, 1)
        off = pressure - base - slope * self.current
        follows = np.abs(self.integral(off)).max() < FOLLOWS * pressure.mean() * self.span
        if base > 0 and (follows or np.abs(off).max() < (_digit(pressure) or 0.0)):
            return None
        return self.integral(pressure / self.integral(pressure)[-1] * self.span)

    @property
    def monitor_changes(self) -> list[np.ndarray]:
        """What a stated instability of the monitor does to the readings, over their errors."""
        over = 1.0 if self.error is None else self.error
        changes = {} if self.monitor is None else self.monitor.changes(self.time)
        return [change / over for change in changes.values()]

    def integral(self, values: np.ndarray) -> np.ndarray:
        """Integral over time from the first reading on, by the trapezoidal rule.

        Examples
        --------
        >>> record = DecayRecord([0.0, 1.0, 3.0], [3.0, 2.0, 1.0])
        >>> record.integral(np.array([1.0, 3.0, 3.0])).tolist()
        [0.0, 2.0, 8.0]
        """
        parts = np.diff(self.time) * (values[1:] + values[:-1]) / 2
        return np.concatenate([[0.0], np.cumsum(parts)])

    def blocks(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Time, current and its error as means of neighbouring readings, in so many blocks."""
        first = np.linspace(0, len(self), number, endpoint=False).astype(int)
        count = np.diff(first, append=len(self))
        time, current = (np.add.reduceat(v, first) / count for v in (self.time, self.current))
        if self.error is None:
            return time, current, None
        return time, current, np.sqrt(np.add.reduceat(self.error**2, first)) / count

    def select(self, rows: np.ndarray | slice, name: str | None = None) -> DecayRecord:
        """Take some of the readings.

        Parameters
        ----------
        rows : slice, or array of bool or int
            Which readings; at least two.
        name : str, optional
            Name of the new record.

        Returns
        -------
        DecayRecord
            With time counted from its own first reading, and `start` moved with it.

        Raises
        ------
        InputError
            If fewer than two readings are left.

        Examples
        --------
        >>> DecayRecord([0, 60, 120], [100.0, 99.9, 99.8], start=1e9).select(slice(1, 3)).start
        1000000060.0
        """
        time = self.time[rows]
        moved = None if self.start is None or not time.size else self.start + float(time[0])
        return replace(
            self,
            time=time,
            current=self.current[rows],
            error=None if self.error is None else self.error[rows],
            name=self.name if name is None else name,
            start=moved,
            conditions=Conditions(**{n: v[rows] for n, v in self.conditions.given.items()}),
        )


@shown
@dataclass(frozen=True, eq=False)
class LifetimeTable:
    """Lifetimes measured at several currents.

    Parameters
    ----------
    current : array, shape (n,)
        Beam current, mA.
    lifetime : array, shape (n,)
        Lifetime there, h.
    error : array, shape (n,), optional
        Standard deviation of each lifetime, h.
    name : str, optional
        What to call it.
    comments, notes : tuple of str, optional
        Provenance, and what was done to its numbers.

    Raises
    ------
    InputError
        If there are fewer than four points, or a number is not positive.
    """

    current: np.ndarray
    lifetime: np.ndarray
    error: np.ndarray | None = None
    name: str = "lifetimes"
    comments: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        rows = np.size(self.current)
        if rows < FEWEST_LIFETIMES:
            raise InputError(f"{rows} lifetimes", f"{FEWEST_LIFETIMES} or more", path=self.name)
        for name in ("current", "lifetime", "error"):
            values = getattr(self, name)
            if values is None:
                continue
            values = np.array(values, float)
            if values.shape != (rows,) or not np.all((values > 0) & (values < np.inf)):
                raise InputError(f"{name} {values}", f"{rows} positive numbers", path=self.name)
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return self.current.size

    def __str__(self) -> str:
        low, high = self.current.min(), self.current.max()
        return f"{self.name}: {len(self)} lifetimes at {low:.4g} to {high:.4g} mA"
