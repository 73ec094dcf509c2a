"""Calibrations of magnets: from amperes, kilogauss or 1/m² to focusing strength.

Each calibration is a frozen value with ``unit`` (the ending of a scan's column header) and
``k1l(setting, length, energy)``, the integrated strength in 1/m, for arrays of any shape.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from jax import Array
from jax.typing import ArrayLike

from beamfit.arrays import array_module, value
from beamfit.particles import ELECTRON_MASS, rigidity

SETTING_UNITS = {"A": "A", "kG": "kG", "T_per_m": "T/m", "k1": "1/m²", "k1l": "1/m"}
"""Units of settings for display."""


@value()
class SlopeIntercept:
    """Focusing strength linear in the current: k1 = (slope · I + intercept)/E.

    Report eq. 40 and the text after eq. 22; its α, β are ``slope``, ``intercept``.

    Parameters
    ----------
    slope : float
        MeV/(m² A).
    intercept : float
        MeV/m², the focusing that remains at zero current.

    Examples
    --------
    >>> q = SlopeIntercept(slope=167.23, intercept=43.17)
    >>> round(float(q.k1l(1.0, length=0.07677, energy=30.5)) / 0.07677, 4)
    6.8984
    """

    slope: ArrayLike
    intercept: ArrayLike
    unit: ClassVar[str] = "A"

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m at a current in A, a length in m, an energy in MeV."""
        return (self.slope * setting + self.intercept) / energy * length


@value("signed_intercept", "mass")
class CurrentPolynomial:
    """Gradient as a polynomial of the current, from a magnetic measurement.

    G(I) = c0 + c1 I + c2 I² + … in T/m, and k1 = G/(Bρ).

    Parameters
    ----------
    coefficients : tuple of float
        c0, c1, … in T/m, T/(m A), …; any order.
    signed_intercept : bool
        The remanent field c0 takes the sign of the current, as it does in a magnet that is
        cycled to the same polarity before each use.
    mass : float
        Rest energy of the particle, MeV.

    Examples
    --------
    >>> q = CurrentPolynomial((0.1, 2.0, -0.01), signed_intercept=True)
    >>> [round(float(q.gradient(i)), 3) for i in (-1.0, 1.0)]
    [-2.11, 2.09]
    """

    coefficients: tuple[ArrayLike, ...]
    signed_intercept: bool = False
    mass: float = ELECTRON_MASS
    unit: ClassVar[str] = "A"

    def gradient(self, current: ArrayLike) -> Array:
        """Gradient in T/m at a current in A."""
        remanent, *rest = self.coefficients
        if self.signed_intercept:
            remanent = remanent * array_module(current).sign(current)
        rising = sum(c * current ** (n + 1) for n, c in enumerate(rest))
        return remanent + rising

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m at a current in A, a length in m, an energy in MeV."""
        return self.gradient(setting) * length / rigidity(energy, self.mass)


@value("currents", "gradients", "mass")
class CurrentTable:
    """Gradient by straight lines between the points of a magnetic measurement.

    Parameters
    ----------
    currents : tuple of float
        A, rising.
    gradients : tuple of float
        T/m at these currents; the first and last segments are extrapolated.
    scale : float
        Factor on the gradient; 1 for the table as it is.
    mass : float
        Rest energy of the particle, MeV.

    Examples
    --------
    >>> q = CurrentTable((0.0, 1.0, 3.0), (0.1, 2.1, 5.1))
    >>> [round(float(q.gradient(i)), 3) for i in (0.5, 2.0, 4.0)]
    [1.1, 3.6, 6.6]
    """

    currents: tuple[float, ...]
    gradients: tuple[float, ...]
    scale: ArrayLike = 1.0
    mass: float = ELECTRON_MASS
    unit: ClassVar[str] = "A"

    def gradient(self, current: ArrayLike) -> Array:
        """Gradient in T/m at a current in A."""
        xp = array_module(current, self.scale)
        at, values = xp.asarray(self.currents), xp.asarray(self.gradients)
        i = xp.clip(xp.searchsorted(at, current) - 1, 0, len(self.currents) - 2)
        rise = (values[i + 1] - values[i]) / (at[i + 1] - at[i])
        return self.scale * (values[i] + rise * (current - at[i]))

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m at a current in A, a length in m, an energy in MeV."""
        return self.gradient(setting) * length / rigidity(energy, self.mass)


@value("mass")
class Gradient:
    """The setting is the gradient in T/m; positive focuses x.

    Parameters
    ----------
    scale : float
        Factor on the setting; 1 for the control system's value.
    mass : float
        Rest energy of the particle, MeV.

    Examples
    --------
    >>> round(float(Gradient().k1l(2.0, length=0.1, energy=135.0)), 6)
    0.44414
    """

    scale: ArrayLike = 1.0
    mass: float = ELECTRON_MASS
    unit: ClassVar[str] = "T_per_m"

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m at a gradient in T/m, a length in m, an energy in MeV."""
        return self.scale * setting * length / rigidity(energy, self.mass)


@value("mass")
class IntegratedGradient:
    """The setting is the integrated gradient in kG; positive focuses x.

    Parameters
    ----------
    scale : float
        Factor on the setting; 1 for the control system's value.
    mass : float
        Rest energy of the particle, MeV.

    Examples
    --------
    >>> round(float(IntegratedGradient().k1l(-4.219084, length=0.108, energy=135.0)), 6)
    -0.936932
    """

    scale: ArrayLike = 1.0
    mass: float = ELECTRON_MASS
    unit: ClassVar[str] = "kG"

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m at an integrated gradient in kG and an energy in MeV."""
        return 0.1 * self.scale * setting / rigidity(energy, self.mass)


@value("mass")
class FocusingStrength:
    """The setting is k1 itself, in 1/m²; positive focuses x.

    Parameters
    ----------
    scale : float
        Factor on the setting.
    energy : float, optional
        Total energy in MeV for which the magnet is set; a beam of higher momentum is focused less,
        as 1/p. If None the setting is k1 for every beam.
    mass : float
        Rest energy of the particle, MeV.

    Examples
    --------
    >>> float(FocusingStrength().k1l(6.0, length=0.5, energy=100.0))
    3.0
    """

    scale: ArrayLike = 1.0
    energy: ArrayLike | None = None
    mass: float = ELECTRON_MASS
    unit: ClassVar[str] = "k1"

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m at a k1 in 1/m² and a length in m."""
        return self.scale * setting * length * _stiffness(self, energy)


@value("mass")
class IntegratedStrength:
    """The setting is the inverse focal length k1·L of a thin lens, in 1/m.

    Parameters
    ----------
    scale, energy, mass : float
        As for `FocusingStrength`.

    Examples
    --------
    >>> float(IntegratedStrength().k1l(0.25, length=0.0, energy=100.0))
    0.25
    """

    scale: ArrayLike = 1.0
    energy: ArrayLike | None = None
    mass: float = ELECTRON_MASS
    unit: ClassVar[str] = "k1l"

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m, which is the setting."""
        return self.scale * setting * _stiffness(self, energy)


def _stiffness(magnet: FocusingStrength | IntegratedStrength, energy: ArrayLike) -> ArrayLike:
    """Rigidity of the beam for which a magnet is set over that of the actual beam."""
    if magnet.energy is None:
        return 1.0
    return rigidity(magnet.energy, magnet.mass) / rigidity(energy, magnet.mass)


Calibration = (
    SlopeIntercept
    | CurrentPolynomial
    | CurrentTable
    | Gradient
    | IntegratedGradient
    | FocusingStrength
    | IntegratedStrength
)


def scaled(calibration: Calibration, factor: ArrayLike) -> Calibration:
    """Scale the strength of a calibration; for `SlopeIntercept`, the slope only.

    Parameters
    ----------
    calibration : Calibration
        Calibration of one magnet, or of several stored as arrays.
    factor : float or array
        Factor, of their shape.

    Returns
    -------
    Calibration

    Examples
    --------
    >>> scaled(SlopeIntercept(160.0, 40.0), 1.01)
    <SlopeIntercept slope=161.6, intercept=40>
    """
    if isinstance(calibration, SlopeIntercept):
        return replace(calibration, slope=calibration.slope * factor)
    if isinstance(calibration, CurrentPolynomial):
        return replace(
            calibration, coefficients=tuple(v * factor for v in calibration.coefficients)
        )
    return replace(calibration, scale=calibration.scale * factor)


def plain_meaning(unit: str, mass: float) -> Calibration | None:
    """Calibration of settings in a unit other than amperes; None for amperes.

    Examples
    --------
    >>> plain_meaning("kG", 0.511).unit, plain_meaning("A", 0.511)
    ('kG', None)
    """
    return {
        "kG": IntegratedGradient(mass=mass),
        "T_per_m": Gradient(mass=mass),
        "k1": FocusingStrength(),
        "k1l": IntegratedStrength(),
    }.get(unit)
