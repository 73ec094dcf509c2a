"""A record of beam current against time, its operating conditions and its monitor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from beamfit.answer import MAX_ROWS_SHOWN, Table, frame_of, shown
from beamfit.errors import InputError
from beamfit.noise.digits import digit_of
from beamfit.quantity import HOUR

if TYPE_CHECKING:
    from pandas import DataFrame

# Largest beam current, mA. The ISR of CERN stored 57 A of protons, more than any ring before or
# since.
MAX_CURRENT = 1e5
# Plausible ranges of the conditions; outside them a column is in another unit than its name says.
# RF voltages reach 3.6 GV (LEP), scrapers stand 0.1 mm or more from the beam, and the pressures are
# those at which a beam can be stored.
PLAUSIBLE = {
    "rf_voltage": (1e3, 4e9, "V"),
    "scraper_y": (1e-4, 0.5, "m"),
    "pressure": (1e-14, 1e-2, "Pa"),
    "bunches": (1.0, 1e5, "bunches"),
    "bunch_length": (1e-5, 1.0, "m"),
}
NOT_NEGATIVE = (
    "a current of zero or more; take off what the monitor reads without beam (--offset), or leave "
    "such rows out (--skip-bad)"
)


@shown
class Conditions(NamedTuple):
    """Operating conditions along a record, in SI; None where the file does not give them.

    Attributes
    ----------
    rf_voltage : array, shape (n,), or None
        Sum of the peak RF voltages, V.
    scraper_y : array, shape (n,), or None
        Distance from the beam to the vertical scraper jaw, m.
    pressure : array, shape (n,), or None
        Average pressure, Pa.
    bunches : array, shape (n,), or None
        Number of filled bunches.
    bunch_length : array, shape (n,), or None
        Rms bunch length, m.
    """

    rf_voltage: np.ndarray | None = None
    scraper_y: np.ndarray | None = None
    pressure: np.ndarray | None = None
    bunches: np.ndarray | None = None
    bunch_length: np.ndarray | None = None

    @property
    def given(self) -> dict[str, np.ndarray]:
        """Columns that the file gives, by name."""
        return {name: values for name, values in self._asdict().items() if values is not None}


class Fault(NamedTuple):
    """The first fault in a record's numbers.

    Attributes
    ----------
    row : int
        Index of the reading.
    quantity : str
        `time`, `current`, `error`, or a name in `Conditions`.
    found, expected : str
        Text for the error message.
    """

    row: int
    quantity: str
    found: str
    expected: str


def _first(bad: np.ndarray) -> int | None:
    """Index of the first true value, None if there is none."""
    return int(np.argmax(bad)) if bad.any() else None


# Smallest number of digits of a reading with beam, where units may be mixed; chosen.
MIN_DIGITS = 10


def _unit_change(current: np.ndarray) -> int | None:
    """Row at which the unit switches between A and mA.

    The current jumps by a factor of 1000, and the decay continues from there. Readings of a few
    digits are what a monitor shows without beam.
    """
    low, high = 2.99, 3.01
    if np.max(current) < 10**low * np.min(current):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        decades = current[1:] / current[:-1]
        np.abs(np.log10(decades, out=decades), out=decades)
    rows = np.flatnonzero((decades > low) & (decades < high)) + 1
    if not rows.size:
        return None
    small = np.unique(current[current < np.max(current) / 100])
    digit = np.diff(small).min() if small.size > 1 else 0.0
    for row in rows:
        if min(current[row - 1], current[row]) < MIN_DIGITS * digit:
            continue
        before, after = np.median(current[max(row - 3, 0) : row]), current[row : row + 3]
        # After a dump a single noisy reading may be a thousandth by chance, not several.
        with np.errstate(divide="ignore", invalid="ignore"):
            stays_there = np.abs(np.abs(np.log10(after / before)) - 3) < 0.05
        if stays_there.size > 1 and stays_there.all():
            return int(row)
    return None


def _odd_setting(conditions: Conditions) -> Fault | None:
    """Find a setting that is negative, or implausible in the unit of its column."""
    for name, values in conditions.given.items():
        low, high, unit = PLAUSIBLE[name]
        if (row := _first(values < 0)) is not None:
            return Fault(row, name, f"a negative {name}, {values[row]:.6g}", "zero or more")
        if name == "pressure" and values.any() and (row := _first(values == 0)) is not None:
            expected = "above zero; leave out a gauge that is off at times with --ignore"
            return Fault(row, name, "a pressure of zero", expected)
        row = _first((values > high) | ((values < low) & (values > 0)))
        if row is not None:
            expected = f"{low:g} to {high:g} {unit}; check the unit of the column"
            return Fault(row, name, f"{name} {values[row]:.3g} {unit}", expected)
    return None


def first_fault(
    time: np.ndarray, current: np.ndarray, error: np.ndarray | None, conditions: Conditions
) -> Fault | None:
    """Find the first number that no record of a stored beam can contain.

    Parameters
    ----------
    time, current : array, shape (n,)
        In s and mA.
    error : array, shape (n,), or None
        Standard deviations of the current, mA.
    conditions : Conditions
        Operating conditions.

    Returns
    -------
    Fault or None
        None if all is usable.

    Examples
    --------
    >>> import numpy as np
    >>> first_fault(np.array([0.0, 1.0, 1.0]), np.ones(3), None, Conditions()).found
    'time 1 s after 1 s'
    """
    columns = {"time": time, "current": current} | ({} if error is None else {"error": error})
    for name, values in (columns | conditions.given).items():
        if (row := _first(~np.isfinite(values))) is not None:
            return Fault(row, name, f"{values[row]}", "a finite number")
    if (row := _first(np.append(False, time[1:] <= time[:-1]))) is not None:
        found = f"time {time[row]:.10g} s after {time[row - 1]:.10g} s"
        return Fault(row, "time", found, "times that increase")
    if (row := _first(current < 0)) is not None:
        found = f"a negative current, {current[row]:.6g} mA"
        return Fault(row, "current", found, NOT_NEGATIVE)
    if (row := _first(current > MAX_CURRENT)) is not None:
        found = f"a current of {1e-3 * current[row]:.6g} A, more than any ring has stored"
        return Fault(row, "current", found, "mA: are these readings in mA or µA?")
    if error is not None and (row := _first(error <= 0)) is not None:
        return Fault(row, "error", f"an error of {error[row]:.6g} mA", "a positive one")
    if (fault := _odd_setting(conditions)) is not None:
        return fault
    if (row := _unit_change(current)) is not None:
        found = f"{current[row]:.6g} mA after {current[row - 1]:.6g} mA, a factor of 1000"
        return Fault(row, "current", found, "one unit throughout, A or mA")
    return None


@shown
class Monitor(NamedTuple):
    """Stability of a current monitor: standard deviations of errors common to all readings.

    Attributes
    ----------
    drift : float
        Linear drift, mA/h.
    offset : float
        Reading without beam, mA.

    Examples
    --------
    >>> print(Monitor(drift=0.01, offset=0.05))
    drifts by 10 µA/h and is off by 50 µA
    """

    drift: float = 0.0
    offset: float = 0.0

    def check(self) -> None:
        """Raise `InputError` unless both values are finite and not negative."""
        for name, value in self._asdict().items():
            if not 0 <= value < np.inf:
                raise InputError(f"monitor {name} {value}", "zero or more", column=name)

    def beside(self, other: Monitor | None) -> Monitor:
        """Combine two independent statements on one monitor, in quadrature."""
        return self if other is None else Monitor(*map(float, np.hypot(self, other)))

    def changes(self, time: np.ndarray) -> dict[str, np.ndarray]:
        """Changes of the readings at times in s, mA, by their cause in words."""
        found = {}
        if self.drift:
            found[f"drifts by {1e3 * self.drift:.4g} µA/h"] = self.drift / HOUR * time
        if self.offset:
            found[f"reads {1e3 * self.offset:.4g} µA too much"] = np.full(time.size, self.offset)
        return found

    def __str__(self) -> str:
        drift, offset = (f"{1e3 * value:.4g} µA" for value in self)
        parts = [f"drifts by {drift}/h"] if self.drift else []
        parts += [f"is off by {offset}"] if self.offset else []
        return " and ".join(parts) or "neither drifts nor is off"


# Smallest number of points in a table of lifetimes.
FEWEST_LIFETIMES = 4
# A pressure follows the current if the integral of its departure from P0 + P1 I never exceeds this
# share of the mean pressure times the span.
FOLLOWS = 2e-3


def _frozen(values: object, rows: int, quantity: str) -> np.ndarray:
    if isinstance(values, np.ndarray) and values.base is None and not values.flags.writeable:
        array = np.asarray(values, float)  # shared with another record
    else:
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
        Name of the record in results: that of the file.
    start : float, optional
        Unix time of the first reading, s.
    conditions : Conditions, optional
        Operating conditions in SI, each of shape (n,).
    comments : tuple of str, optional
        Provenance, as written in the file.
    notes : tuple of str, optional
        Changes made to its numbers, such as rows left out.
    monitor : Monitor, optional
        Stability of the current monitor, which errors of results then contain.
    mean : float, optional
        Mean current, mA, if these readings stand for others; that of the readings by default.
    digit : float, optional
        Step of the full record, mA, if these are too few of its readings to show it.

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
    mean: float | None = None
    digit: float | None = None

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
        if own["time"][0] != 0:
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
        """Return a pandas data frame with the columns of a file; `read_decay_record` takes it.

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
        """Build the table of the first readings."""
        count = min(len(self), MAX_ROWS_SHOWN)
        rows = [[f"{self.time[i]:.6g}", f"{self.current[i]:.6g}"] for i in range(count)]
        caption = f"the first {count} of {len(self)} readings" if count < len(self) else ""
        return (Table(str(self), ["time s", "beam current mA"], rows, caption, numeric=True),)

    @property
    def span(self) -> float:
        """Time from the first to the last reading, s."""
        return float(self.time[-1])

    @property
    def mean_current(self) -> float:
        """Current at which the mean lifetime is quoted, mA."""
        return float(self.current.mean()) if self.mean is None else self.mean

    @cached_property
    def resolution(self) -> float | None:
        """Step of a quantised reading, mA; None if the readings are not multiples of one."""
        return digit_of(self.current) or self.digit

    @cached_property
    def gauge(self) -> np.ndarray | None:
        """Integral of the pressure over its mean, s, if the pressure does not follow the current.

        None if no pressure is given, or if it is P0 + P1 I with positive P0 to within `FOLLOWS` or
        the last digit of the gauge: the beam's own gas is then part of a, as in the report.
        """
        pressure = self.conditions.pressure
        if pressure is None or not pressure.mean() > 0:
            return None
        slope, base = np.polyfit(self.current, pressure, 1)
        departure = pressure - base - slope * self.current
        follows = np.abs(self.integral(departure)).max() < FOLLOWS * pressure.mean() * self.span
        if base > 0 and (follows or np.abs(departure).max() < (digit_of(pressure) or 0.0)):
            return None
        return self.integral(pressure / self.integral(pressure)[-1] * self.span)

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

    def means(
        self, size: int, law: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Average time, current and its error over blocks of `size` neighbours.

        Readings that do not fill the last block are left out. A `law` corrects for its own bend
        within a block, which matters for a block with a gap.

        Examples
        --------
        >>> DecayRecord(np.arange(7.0), np.full(7, 100.0)).means(3)[0].tolist()
        [1.0, 4.0]
        """
        whole = len(self) // size * size

        def mean(values: np.ndarray) -> np.ndarray:
            return values[:whole].reshape(-1, size).mean(axis=1)

        time, current = mean(self.time), mean(self.current)
        if law is not None:
            current += law(time) - mean(law(self.time))
        if self.error is None:
            return time, current, None
        return time, current, np.sqrt(mean(self.error**2) / size)

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
        start = None if self.start is None or not time.size else self.start + float(time[0])
        return replace(
            self,
            mean=None,
            digit=self.digit or self.resolution,
            time=time,
            current=self.current[rows],
            error=None if self.error is None else self.error[rows],
            name=self.name if name is None else name,
            start=start,
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
        Lifetime at each current, h.
    error : array, shape (n,), optional
        Standard deviation of each lifetime, h.
    name : str, optional
        Name of the table in results.
    comments, notes : tuple of str, optional
        Provenance, and changes made to its numbers.

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
