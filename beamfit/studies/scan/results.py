"""What a fit says of one plane: frozen values that answer whether to believe them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.quantity import Quantity, Status

if TYPE_CHECKING:
    from beamfit.optics.beam import BeamMatrix

__all__ = ["Identifiability", "Parameter", "PlaneFit", "Points", "ScreenTwiss"]


class Points(NamedTuple):
    """The points of a fit, each array of shape (n,).

    Attributes
    ----------
    settings : dict of str to ndarray
        Magnet name to setting.
    units : dict of str to str
        Magnet name to the unit of its settings.
    screen : tuple of str
        Where each was measured.
    size, error, model : ndarray
        Measured rms size, its error as used, and the fitted size, m.
    pull : ndarray
        Residual of the fitted quantity over its error as used.
    outlier_probability : ndarray or None
        From the robust fit.
    r11, r12 : ndarray
        Transfer-matrix elements from the start to the screen (R12 in m).
    known : ndarray
        Size² due to dispersion and resolution, m².
    """

    settings: dict[str, np.ndarray]
    units: dict[str, str]
    screen: tuple[str, ...]
    size: np.ndarray
    error: np.ndarray
    model: np.ndarray
    pull: np.ndarray
    outlier_probability: np.ndarray | None
    r11: np.ndarray
    r12: np.ndarray
    known: np.ndarray


class Parameter(NamedTuple):
    """A number fitted besides the beam: a calibration number, or k1 of a network.

    Attributes
    ----------
    name : str
        Such as "Q2.slope".
    value : Quantity
        With an error only if data and priors determine it.
    status : Status
        ``converged``, ``unidentified``, or ``at_limit`` for a number that ends on a bound.
    state : str
        ``free``, ``lower`` or ``upper``.
    lower, upper : float
        Bounds; infinite where there is none.
    prior : tuple of float, or None
        Mean and standard deviation.
    multiplier : float
        d(χ²/2)/d(bound) where it ends on one.
    """

    name: str
    value: Quantity
    status: Status
    state: str
    lower: float
    upper: float
    prior: tuple[float, float] | None
    multiplier: float

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``parameters``."""
        return self._asdict() | {
            "value": self.value.to_json(),
            "status": str(self.status),
            "prior": None if self.prior is None else list(self.prior),
        }


class ScreenTwiss(NamedTuple):
    """The beam at the screen, with every magnet at the lattice's own setting.

    Attributes
    ----------
    name : str
        The screen.
    settings : dict of str to float
        The settings it holds for.
    units : dict of str to str
        Their units.
    beta, alpha : Quantity
        Twiss parameters.
    size : Quantity
        Rms size without dispersion and resolution, m.
    """

    name: str
    settings: dict[str, float]
    units: dict[str, str]
    beta: Quantity
    alpha: Quantity
    size: Quantity


@dataclass(frozen=True)
class Identifiability:
    """What the scan determines.

    Attributes
    ----------
    determined : bool
        Whether the emittance is.
    singular_values : tuple of float
        Of the scaled design (σ11, σ12, σ22 in units of themselves), in standard errors.
    condition : float or None
        Largest over smallest; None if infinite.
    waist_bracketed : bool or None
        Whether sizes rise on both sides of the smallest; None for a scan of several magnets.
    phase_coverage : float or None
        Betatron phase over which the scan looked at the beam, degrees of 180.
    zero_distance : float
        Standard errors (sqrt of Δχ² over its scale) between the fit and a beam of no emittance.
    undetermined : tuple of str
        What the data leave open, in words.
    next_measurement : str or None
        The measurement that would help most.
    """

    determined: bool
    singular_values: tuple[float, ...]
    condition: float | None
    waist_bracketed: bool | None
    phase_coverage: float | None
    zero_distance: float
    undetermined: tuple[str, ...]
    next_measurement: str | None

    def to_json(self) -> dict[str, Any]:
        """Give the ``identifiability`` object of the JSON contract."""
        return {
            "verdict": "determined" if self.determined else "unidentified",
            "singular_values": list(self.singular_values),
            "condition": self.condition,
            "waist_bracketed": self.waist_bracketed,
            "phase_coverage_deg": self.phase_coverage,
            "zero_emittance_distance": self.zero_distance,
            "undetermined": list(self.undetermined),
            "next_measurement": self.next_measurement,
        }


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """The fitted beam of one plane at the start of the line.

    Attributes
    ----------
    plane : str
        "x" or "y".
    status : Status
        How far to believe it; ``message`` says why and what to do.
    emittance, normalized_emittance : Quantity
        Geometric and normalised emittance, m.
    beta, alpha : Quantity
        Twiss parameters at the start of the line, m and 1.
    sigma : tuple of Quantity
        σ11 (m²), σ12 (m rad), σ22 (rad²).
    screen : ScreenTwiss
        The same beam at the screen.
    mismatch : Quantity or None
        BMAG to the lattice's design Twiss.
    chi2 : float or None
        χ²; None where the noise was inferred from the residuals.
    dof : int
        Points less three.
    rms_residual : Quantity
        Rms of measured less fitted size, m.
    covariance : ndarray
        Shape (3, 3), of σ11, σ12, σ22, unscaled (``error_raw``); NaN if not determined.
    error_scale : float
        The factor on errors: sqrt(χ²/dof) where that exceeds 1.
    noise : str
        Where the errors came from, in words.
    identifiability : Identifiability
        What the data determine.
    points : Points
        Point by point.
    """

    plane: str
    status: Status
    message: str
    emittance: Quantity
    normalized_emittance: Quantity
    beta: Quantity
    alpha: Quantity
    sigma: tuple[Quantity, Quantity, Quantity]
    screen: ScreenTwiss
    mismatch: Quantity | None
    chi2: float | None
    dof: int
    rms_residual: Quantity
    covariance: np.ndarray
    error_scale: float
    noise: str
    method: str
    identifiability: Identifiability
    points: Points

    @property
    def beam(self) -> BeamMatrix:
        """The beam matrix at the start of the line.

        Raises
        ------
        InputError
            If the data allow no positive definite one (status ``unidentified``).
        """
        from beamfit.optics.beam import BeamMatrix

        return BeamMatrix.from_sigma(*(q.value for q in self.sigma))

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        s11, s12, s22 = self.sigma
        probability = self.points.outlier_probability
        return {
            "plane": self.plane,
            "status": str(self.status),
            "message": self.message,
            "emittance": self.emittance.to_json(),
            "normalized_emittance": self.normalized_emittance.to_json(),
            "beta": self.beta.to_json(),
            "alpha": self.alpha.to_json(),
            "sigma11": s11.to_json(),
            "sigma12": s12.to_json(),
            "sigma22": s22.to_json(),
            "chi2": self.chi2,
            "dof": self.dof,
            "rms_residual": self.rms_residual.to_json(),
            "identifiability": self.identifiability.to_json(),
            "covariance": self.covariance.tolist() if np.isfinite(self.covariance).all() else None,
            "error_scale": self.error_scale,
            "noise": self.noise,
            "method": self.method,
            "screen": {
                "name": self.screen.name,
                "settings": self.screen.settings,
                "units": self.screen.units,
                "beta": self.screen.beta.to_json(),
                "alpha": self.screen.alpha.to_json(),
                "size": self.screen.size.to_json(),
            },
            "mismatch": None if self.mismatch is None else self.mismatch.to_json(),
            "points": {
                "settings": {n: v.tolist() for n, v in self.points.settings.items()},
                "units": self.points.units,
                "screen": list(self.points.screen),
                "size_m": self.points.size.tolist(),
                "error_m": self.points.error.tolist(),
                "model_m": self.points.model.tolist(),
                "pull": self.points.pull.tolist(),
                "outlier_probability": None if probability is None else probability.tolist(),
            },
        }
