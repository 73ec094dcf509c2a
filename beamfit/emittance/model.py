"""The model of a scan: a beam matrix, seen through a map to the screens, predicts every size.

The physics is report eq. 37 with the two terms that every screen adds,

    size² = R11² σ11 + 2 R11 R12 σ12 + R12² σ22 + (R16 σ_δ)² + resolution²,

linear in σ. A model is a dictionary: ``beam`` holds the Cholesky factor of each plane's σ in units
of 1e-4 (m, rad), so that σ is in 1e-8 SI as in the report's Appendix A; ``magnets`` holds what the
setting of a magnet means where that is free, ``map`` a network of R11 and R12, ``systematics`` what
is free of screen, energy, drifts and incoming dispersion. Its numbers have paths such as
``beam.x.l11`` and ``magnets.Q2.slope``.
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

UNIT = 1e-4  # m and rad of a beam's numbers
# What people quote of a plane, in this order everywhere, with units.
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


def coefficients(r11: Any, r12: Any) -> tuple[Any, Any, Any]:
    """Coefficients of σ11, σ12, σ22 in size² (report eq. 37), for any shape, NumPy's or JAX's.

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
        What dispersion and resolution add, m².

    Returns
    -------
    float or array
        Of the shape of ``r11``.
    """
    a, b, c = coefficients(r11, r12)
    return sigma[0] * a + sigma[1] * b + sigma[2] * c + known


def sigma_of(beam: Mapping[str, Any]) -> Array:
    """σ11, σ12, σ22 in SI from the numbers of a beam, shape (3,)."""
    l11, l21, l22 = beam["l11"], beam["l21"], beam["l22"]
    return UNIT**2 * jnp.stack([l11**2, l11 * l21, l21**2 + l22**2])


def line_of(model: Mapping[str, Any], line: Beamline) -> Beamline:
    """Put into a line what a model says of its magnets and drifts."""
    for name, calibration in model.get("magnets", {}).items():
        line = line.with_element(replace(line[name], calibration=calibration))
    found = model.get("systematics", {})
    for name, factor in found.get("gradient", {}).items():
        for member in line.members(name):
            own = scaled(line[member].calibration, factor)
            line = line.with_element(replace(line[member], calibration=own))
    for name, length in found.get("length", {}).items():
        line = line.with_element(replace(line[name], length=length))
    return line


def spoken(path: str) -> str:
    """The path of a free number as users say it: "Q2.slope", not "magnets.Q2.slope".

    Examples
    --------
    >>> spoken("magnets.Q2.slope"), spoken("systematics.length.D1"), spoken("systematics.energy")
    ('Q2.slope', 'D1.length', 'energy')
    """
    first, _, rest = path.partition(".")
    if first == "systematics":
        kind, _, name = rest.partition(".")
        return f"{name}.{kind}" if name else kind
    return path.removeprefix("magnets.")


def predict_sizes(model: Mapping[str, Any], rows: Any) -> Array:
    """Predict size² in µm², or size in µm, of rows: the one prediction of every scenario.

    Parameters
    ----------
    model : mapping
        As above.
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


def numbers_of(
    sigma: Array, factor: ArrayLike, to_screen: Array, to_design: Array, design: Array
) -> Array:
    """Everything people quote of a plane, in the order of `QUANTITIES`.

    Parameters
    ----------
    sigma : Array
        Shape (3,), or (3, d) of d beams, at the start; NumPy's or JAX's.
    factor : float
        βγ.
    to_screen, to_design : Array
        Shape (3, 3) or (2, 2), start to the last screen and to where the design holds; NaN where
        they are not known.
    design : Array
        Shape (2,), design β (m) and α; NaN where there is none.

    Returns
    -------
    Array, shape (11,) or (11, d)

    Examples
    --------
    >>> one = jnp.eye(2)
    >>> numbers_of(jnp.array([4.0, 0.0, 9.0]), 2.0, one, one, jnp.array([1.0, 0.0]))[:3].tolist()
    [6.0, 12.0, 0.6666666666666666]
    """
    emittance, beta, alpha = emittance_parts(sigma)
    s11, s12, _ = carried(to_screen, sigma)
    d11, d12, d22 = carried(to_design, sigma)
    gamma_d = (1.0 + design[1] ** 2) / design[0]
    # BMAG = Tr(σ σ_d⁻¹) ε_d/(2 ε), M. Sands, SLAC-AP-85 (1991).
    mismatch = 0.5 * (gamma_d * d11 + 2.0 * design[1] * d12 + design[0] * d22) / emittance
    start = (emittance, factor * emittance, beta, alpha, *sigma)
    xp = np if isinstance(emittance, np.ndarray | np.generic) else jnp
    return xp.stack([*start, s11 / emittance, -s12 / emittance, s11**0.5, mismatch])


def carried(matrix: Any, sigma: Any) -> tuple[Any, Any, Any]:
    """σ at a place: R σ Rᵀ (report eq. 36), R of shape (2, 2, ...), σ of shape (3, ...)."""
    (a, b), (c, d) = matrix[0, :2], matrix[1, :2]
    s11, s12, s22 = sigma
    crossed = a * c * s11 + (a * d + b * c) * s12 + b * d * s22
    return size_squared(sigma, a, b), crossed, size_squared(sigma, c, d)


@tree.node("plane", "screen", "place")
class Asked:
    """Places of a plane's numbers: the last screen, and where the design holds.

    ``screen`` is None where the map beyond R11 and R12 is not known.
    """

    plane: str
    screen: str | None
    place: str | None
    line: Beamline
    energy: Any
    design: Any


def asked_places(model: Mapping[str, Any], asked: Asked) -> tuple[Any, Any, Any, Any]:
    """βγ, matrices to the screen and the design's place, and the design, of a model's line."""
    to_screen = to_design = jnp.full((2, 2), jnp.nan)
    if asked.screen is not None:
        place = asked.place or asked.screen
        places = tuple(dict.fromkeys((asked.screen, place)))
        found = line_of(model, asked.line).matrices(places)
        to_screen, to_design = (getattr(found[at], asked.plane) for at in (asked.screen, place))
    energy = asked.energy * model.get("systematics", {}).get("energy", 1.0)
    return beta_gamma(energy, asked.line.mass), to_screen, to_design, asked.design


def asked_numbers(model: Mapping[str, Any], asked: Asked) -> Array:
    """`numbers_of` a model's beam, through the line as the model has it."""
    return numbers_of(sigma_of(model["beam"][asked.plane]), *asked_places(model, asked))


def phase_coverage(r11: np.ndarray, r12: np.ndarray, beta: float, alpha: float) -> float | None:
    """Betatron phase from which the scan saw the beam, in degrees of a half turn.

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
