"""The range a network of the losses is asked to hold over, and what is certified there."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.table import json_of

INPUTS = ("rf_voltage", "scraper_y", "pressure", "bunches")
# How the loss moves with each input; nothing is known of the sign for the RF voltage.
SIGNS = {"scraper_y": -1, "pressure": 1, "bunches": -1}
ROUNDING = 1e-9


def scaled(rf_voltage: float, scraper_y: float, pressure: float, bunches: float) -> np.ndarray:
    """Inputs of a network from V, m, Pa, number: MV, logarithms of mm, nPa and number."""
    values = np.array([1e3 * scraper_y, 1e9 * pressure, bunches], float)
    return np.array([1e-6 * float(rf_voltage), *np.log(values)])


class Box(NamedTuple):
    """A range of operation, the ends in SI: what a network is asked to hold over.

    Parameters
    ----------
    rf_voltage, scraper_y, pressure, bunches : (float, float)
        V, m, Pa at the mean current, and number.

    Raises
    ------
    InputError
        From `corners`, if a range is empty or not positive and finite.

    Examples
    --------
    >>> box = Box((1.6e6, 3.2e6), (3e-3, 6e-3), (1e-8, 1e-7), (100, 300))
    >>> box.corners()[0].round(2).tolist()
    [1.6, 1.1, 2.3, 4.61]
    """

    rf_voltage: tuple[float, float]
    scraper_y: tuple[float, float]
    pressure: tuple[float, float]
    bunches: tuple[float, float]

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Both corners in the network's inputs."""
        for name, (low, high) in zip(self._fields, self, strict=True):
            if not 0 < low <= high < np.inf:
                expected = "0 < lower <= upper, finite"
                raise InputError(f"range {low:g} to {high:g}", expected, column=name)
        low, high = np.array(self, float).T
        return scaled(*low), scaled(*high)


class Certificate(NamedTuple):
    """What holds for all inputs in the operating box.

    Attributes
    ----------
    lower, upper : array, shape (4,)
        Corners of the box: RF voltage MV, logarithms of scraper mm, pressure nPa, bunches.
    gains : array, shape (2, 4, 2)
        Enclosures of the slopes of the network's ln a and ln b by the four inputs over the box,
        rounded outward; of a correction, those of its factor.
    single_maximum : str
        Whether the lifetime has a single maximum in the RF voltage: "certified" by convex nodes of
        a network alone; of a correction "seen" or "broken" at points of the box, since first
        principles have no enclosure; "not asked".
    """

    lower: np.ndarray
    upper: np.ndarray
    gains: np.ndarray
    single_maximum: str

    @property
    def holds(self) -> bool:
        """Whether every slope of known sign has it, within rounding."""
        known = [INPUTS.index(name) for name in SIGNS]
        sign = np.array(list(SIGNS.values()))
        worst = np.where(sign > 0, -self.gains[:, known, 0], self.gains[:, known, 1])
        return bool(np.all(worst <= ROUNDING))

    def holds_at(self, inputs: np.ndarray) -> bool:
        """Whether a point is in the box, within rounding."""
        inside = (inputs >= self.lower - ROUNDING) & (inputs <= self.upper + ROUNDING)
        return bool(np.all(inside))

    def to_json(self) -> dict[str, Any]:
        """Return the range and the slopes as JSON's types."""
        return json_of({"holds": self.holds, **self._asdict()})
