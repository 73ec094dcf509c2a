"""Model of a scan: a beam matrix, transport_sigma to the screens, predicts every size.

The physics is report eq. 37 with the two terms that every screen adds,

    size² = R11² σ11 + 2 R11 R12 σ12 + R12² σ22 + (R16 σ_δ)² + resolution²,

linear in σ. A model is a dictionary. ``beam`` holds the Cholesky factor of each plane's σ in units
of 1e-4 (m, rad), so that σ is in 1e-8 SI as in the report's Appendix A. ``magnets`` holds free
calibrations of magnets, ``map`` a network of R11 and R12, and ``systematics`` free parameters of
screen, energy, drifts and incoming dispersion. Parameters have paths such as ``beam.x.l11`` and
``magnets.Q2.slope``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

import beamfit.optics  # noqa: F401 - switches JAX to double precision
from beamfit.greybox import tree
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import scaled
from beamfit.particles import beta_gamma

UNIT = 1e-4  # unit of a beam's Cholesky factor: 0.1 mm and 0.1 mrad
# Quantities of a plane's answer, in this order everywhere, with units.
QUANTITIES = {
    "emittance": "m",
    "normalized_emittance": "m",
    "beta": "m",
    "alpha": "1",
    "sigma11": "m^2",
    "sigma12": "m rad",
    "sigma22": "rad^2",
    "screen_beta": "m",
    "screen_alpha": "1",
    "screen_size": "m",
    "mismatch": "1",
}
# Names of the beam matrix, and their positions in `QUANTITIES`.
SIGMA, SIGMA_SLICE = ("sigma11", "sigma12", "sigma22"), slice(4, 7)


def coefficients(r11: Any, r12: Any) -> tuple[Any, Any, Any]:
    """Coefficients of σ11, σ12, σ22 in size² (report eq. 37), for NumPy or JAX arrays of any shape.

    Examples
    --------
    >>> coefficients(2.0, 3.0)
    (4.0, 12.0, 9.0)
    """
    return r11 * r11, 2.0 * r11 * r12, r12 * r12


def size_squared(sigma: Any, r11: Any, r12: Any, known: Any = 0.0) -> Any:
    """Size² in m² of a beam.

    Parameters
    ----------
    sigma : array, shape (3,)
        σ11 (m²), σ12 (m rad), σ22 (rad²).
    r11, r12 : float or array
        Transfer-matrix elements from the start to the screen (R12 in m).
    known : float or array
        Contribution of dispersion and resolution, m².

    Returns
    -------
    float or array
        Of the shape of ``r11``.
    """
    a, b, c = coefficients(r11, r12)
    return sigma[0] * a + sigma[1] * b + sigma[2] * c + known


def sigma_of(beam: Mapping[str, Any]) -> Array:
    """σ11, σ12, σ22 in SI from the Cholesky factor of a beam, shape (3,)."""
    l11, l21, l22 = beam["l11"], beam["l21"], beam["l22"]
    return UNIT**2 * jnp.stack([l11**2, l11 * l21, l21**2 + l22**2])


def line_with(model: Mapping[str, Any], line: Beamline) -> Beamline:
    """Replace calibrations, gradients and drift lengths of a line by those of a model."""
    for name, calibration in model.get("magnets", {}).items():
        line = line.with_element(replace(line[name], calibration=calibration))
    systematics = model.get("systematics", {})
    for name, factor in systematics.get("gradient", {}).items():
        for member in line.members(name):
            own = scaled(line[member].calibration, factor)
            line = line.with_element(replace(line[member], calibration=own))
    for name, length in systematics.get("length", {}).items():
        line = line.with_element(replace(line[name], length=length))
    return line


def user_name(path: str) -> str:
    """Name of a free parameter for users: "Q2.slope", not "magnets.Q2.slope".

    Examples
    --------
    >>> [user_name(p) for p in ("magnets.Q2.slope", "systematics.length.D1", "systematics.energy")]
    ['Q2.slope', 'D1.length', 'energy']
    """
    first, _, rest = path.partition(".")
    if first == "systematics":
        kind, _, name = rest.partition(".")
        return f"{name}.{kind}" if name else kind
    return path.removeprefix("magnets.")


def predict_sizes(model: Mapping[str, Any], rows: Any) -> Array:
    """Predict size² in µm², or size in µm, of rows: one function for all scenarios.

    Parameters
    ----------
    model : mapping
        See the module.
    rows : Rows or NetworkRows
        With ``plane``, ``squared`` and ``elements(model)``: R11, R12 and known size² of each row.

    Returns
    -------
    Array, shape (n,)
    """
    squared = size_squared(sigma_of(model["beam"][rows.plane]), *rows.elements(model))
    return 1e12 * squared if rows.squared else 1e6 * jnp.sqrt(squared)


def emittance_parts(sigma: ArrayLike) -> Array:
    """Emittance, β and α of a positive definite σ.

    Parameters
    ----------
    sigma : Array
        Shape (3,): σ11, σ12, σ22.

    Returns
    -------
    Array
        Shape (3,): sqrt(det σ) in m, σ11/ε in m, -σ12/ε.

    Examples
    --------
    >>> emittance_parts(jnp.array([2.0, -1.0, 1.0])).tolist()
    [1.0, 2.0, 1.0]
    """
    s11, s12, s22 = sigma
    emittance = (s11 * s22 - s12**2) ** 0.5
    xp = np if isinstance(emittance, np.ndarray | np.generic) else jnp
    return xp.stack([emittance, s11 / emittance, -s12 / emittance])


def quantities_of(
    sigma: Array, factor: ArrayLike, to_screen: Array, to_design: Array, design: Array
) -> Array:
    """Quantities of a plane's answer, in the order of `QUANTITIES`.

    Parameters
    ----------
    sigma : Array
        Shape (3,), or (3, d) for d beams, at the start; NumPy or JAX.
    factor : float
        βγ.
    to_screen, to_design : Array
        Shape (3, 3) or (2, 2), from the start to the last screen and to the place of the design;
        NaN if unknown.
    design : Array
        Shape (2,), design β (m) and α; NaN if there is none.

    Returns
    -------
    Array, shape (11,) or (11, d)

    Examples
    --------
    >>> one = jnp.eye(2)
    >>> quantities_of(jnp.array([4.0, 0.0, 9.0]), 2.0, one, one, jnp.array([1.0, 0.0]))[:3].tolist()
    [6.0, 12.0, 0.6666666666666666]
    """
    emittance, beta, alpha = emittance_parts(sigma)
    s11, s12, _ = transport_sigma(to_screen, sigma)
    d11, d12, d22 = transport_sigma(to_design, sigma)
    gamma_d = (1.0 + design[1] ** 2) / design[0]
    # BMAG = Tr(σ σ_d⁻¹) ε_d/(2 ε), M. Sands, SLAC-AP-85 (1991).
    mismatch = 0.5 * (gamma_d * d11 + 2.0 * design[1] * d12 + design[0] * d22) / emittance
    start = (emittance, factor * emittance, beta, alpha, *sigma)
    xp = np if isinstance(emittance, np.ndarray | np.generic) else jnp
    return xp.stack([*start, s11 / emittance, -s12 / emittance, s11**0.5, mismatch])


def transport_sigma(matrix: Any, sigma: Any) -> tuple[Any, Any, Any]:
    """Transport σ: R σ Rᵀ (report eq. 36), R of shape (2, 2, ...), σ of shape (3, ...)."""
    (a, b), (c, d) = matrix[0, :2], matrix[1, :2]
    s11, s12, s22 = sigma
    s12_there = a * c * s11 + (a * d + b * c) * s12 + b * d * s22
    return size_squared(sigma, a, b), s12_there, size_squared(sigma, c, d)


@tree.node("plane", "screen", "place")
class AnswerPlaces:
    """Places that a plane's answer refers to: the last screen, and the place of the design.

    ``screen`` is None if a scenario does not know the map beyond R11 and R12.
    """

    plane: str
    screen: str | None
    place: str | None
    line: Beamline
    energy: Any
    design: Any


def place_optics(model: Mapping[str, Any], places: AnswerPlaces) -> tuple[Any, Any, Any, Any]:
    """βγ, matrices to the screen and to the place of the design, and the design itself."""
    to_screen = to_design = jnp.full((2, 2), jnp.nan)
    if places.screen is not None:
        place = places.place or places.screen
        names = tuple(dict.fromkeys((places.screen, place)))
        found = line_with(model, places.line).matrices(names)
        to_screen, to_design = (getattr(found[at], places.plane) for at in (places.screen, place))
    energy = places.energy * model.get("systematics", {}).get("energy", 1.0)
    return beta_gamma(energy, places.line.mass), to_screen, to_design, places.design


def model_quantities(model: Mapping[str, Any], places: AnswerPlaces) -> Array:
    """Compute the quantities of a model's beam, through the model's line."""
    return quantities_of(sigma_of(model["beam"][places.plane]), *place_optics(model, places))


def phase_coverage(r11: np.ndarray, r12: np.ndarray, beta: float, alpha: float) -> float | None:
    """Range of betatron phase covered by the scan, in degrees of 180.

    Parameters
    ----------
    r11, r12 : ndarray
        Transfer-matrix elements to the screen, shape (n,).
    beta, alpha : float
        Twiss parameters at the start, β in m.

    Returns
    -------
    float or None
        180° less the largest gap between the phases; None if β is not finite.

    Notes
    -----
    The phase advance φ to the screen has tan φ = R12/(β R11 - α R12), from
    R11 = sqrt(β_s/β)(cos φ + α sin φ), R12 = sqrt(β β_s) sin φ.

    Examples
    --------
    >>> phase_coverage(np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.0, 0.0)
    90.0
    """
    if not (math.isfinite(beta) and math.isfinite(alpha)):
        return None
    phase = np.sort(np.mod(np.degrees(np.arctan2(r12, beta * r11 - alpha * r12)), 180.0))
    gaps = np.diff(np.concatenate([phase, [phase[0] + 180.0]]))
    return float(180.0 - gaps.max())
