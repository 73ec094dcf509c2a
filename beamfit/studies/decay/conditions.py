"""Operating conditions along a record, and the numbers that no record of a stored beam holds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.shown import shown

# mA. The ISR of CERN stored 57 A of protons, more than any ring before or since.
MOST_CURRENT = 1e5
# Beyond these a column is in another unit than its name says: RF voltages up to LEP's 3.6 GV, a
# scraper from 0.1 mm, a vacuum in which a beam can be stored.
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
        """What the file gives, by name."""
        return {name: values for name, values in self._asdict().items() if values is not None}


class Fault(NamedTuple):
    """The first thing wrong with a record's numbers.

    Attributes
    ----------
    row : int
        Index of the reading.
    quantity : str
        Which of `time`, `current`, `error`, or a name in `Conditions`.
    found, expected : str
        For the error message.
    """

    row: int
    quantity: str
    found: str
    expected: str


def _first(bad: np.ndarray) -> int | None:
    return int(np.argmax(bad)) if bad.any() else None


def _unit_change(current: np.ndarray) -> int | None:
    """Where A follow mA or the other way round: by 1000, and the decay goes on from there."""
    with np.errstate(divide="ignore", invalid="ignore"):
        decades = np.abs(np.log10(current[1:] / current[:-1]))
    for row in np.flatnonzero(np.abs(decades - 3) < 0.01) + 1:
        before, after = np.median(current[max(row - 3, 0) : row]), np.median(current[row : row + 3])
        if before > 0 and after > 0 and abs(abs(np.log10(after / before)) - 3) < 0.05:
            return int(row)
    return None


def _odd_setting(conditions: Conditions) -> Fault | None:
    """A setting that is negative, or no machine has in the unit of its column."""
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
    """Find the first number that no record of a stored beam can hold.

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
    named = {"time": time, "current": current} | ({} if error is None else {"error": error})
    for name, values in (named | conditions.given).items():
        if (row := _first(~np.isfinite(values))) is not None:
            return Fault(row, name, f"{values[row]}", "a finite number")
    if (row := _first(np.diff(time, prepend=-np.inf) <= 0)) is not None:
        found = f"time {time[row]:.10g} s after {time[row - 1]:.10g} s"
        return Fault(row, "time", found, "times that increase")
    if (row := _first(current < 0)) is not None:
        found = f"a negative current, {current[row]:.6g} mA"
        return Fault(row, "current", found, NOT_NEGATIVE)
    if (row := _first(current > MOST_CURRENT)) is not None:
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
