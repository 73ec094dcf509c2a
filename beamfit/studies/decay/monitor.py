"""What is known of the stability of a current monitor, beside the noise of its readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.shown import shown

HOUR = 3600.0


@shown
class Monitor(NamedTuple):
    """One standard deviation of what moves all readings of a record together.

    Attributes
    ----------
    drift : float
        Of a straight drift, mA/h.
    offset : float
        Of the reading without beam, mA.

    Examples
    --------
    >>> print(Monitor(drift=0.01, offset=0.05))
    drifts by 10 µA/h and is off by 50 µA
    """

    drift: float = 0.0
    offset: float = 0.0

    def check(self) -> None:
        """Refuse what is no stability; `InputError`."""
        for name, value in self._asdict().items():
            if not 0 <= value < np.inf:
                raise InputError(f"monitor {name} {value}", "zero or more", column=name)

    def beside(self, other: Monitor | None) -> Monitor:
        """What is known of one monitor from two sources, added in quadrature."""
        return self if other is None else Monitor(*map(float, np.hypot(self, other)))

    def changes(self, time: np.ndarray) -> dict[str, np.ndarray]:
        """Change of the readings at times in s, mA, by its cause in words."""
        found = {}
        if self.drift:
            found[f"drifts by {1e3 * self.drift:.4g} µA/h"] = self.drift / HOUR * time
        if self.offset:
            found[f"reads {1e3 * self.offset:.4g} µA too much"] = np.full(time.size, self.offset)
        return found

    def __str__(self) -> str:
        drift, offset = (f"{1e3 * value:.4g} µA" for value in self)
        said = [f"drifts by {drift}/h"] if self.drift else []
        said += [f"is off by {offset}"] if self.offset else []
        return " and ".join(said) or "neither drifts nor is off"
