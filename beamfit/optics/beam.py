"""Beam matrix of one plane, positive definite by construction, and its Twiss parameters."""

from __future__ import annotations

from dataclasses import KW_ONLY
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.answer import shown
from beamfit.arrays import value
from beamfit.errors import InputError
from beamfit.particles import ELECTRON_MASS, beta_gamma


@shown
class Twiss(NamedTuple):
    """Twiss parameters of one plane.

    Attributes
    ----------
    beta : Array
        β in m.
    alpha : Array
        α, dimensionless; positive for a converging beam.
    gamma : Array
        γ = (1 + α²)/β in 1/m.
    """

    beta: Array
    alpha: Array
    gamma: Array


@value()
class BeamMatrix:
    """σ = L Lᵀ of one plane, stored as its Cholesky factor.

    For any three numbers σ is symmetric and positive, so that a fit or a sampler never meets the
    square root of a negative number. The emittance is l11·l22, without the cancellation of
    σ11σ22 - σ12².

    Parameters
    ----------
    l11, l21, l22 : float or Array
        L in m, rad, rad; l11 and l22 positive. They are keyword-only, to avoid confusion with σ11,
        σ12, σ22 (`from_sigma`) or ε, β, α (`from_twiss`).

    Examples
    --------
    >>> beam = BeamMatrix.from_twiss(emittance=2.67e-9, beta=1.28, alpha=-0.08)
    >>> round(float(beam.emittance) * 1e9, 6), round(float(beam.twiss.alpha), 6)
    (2.67, -0.08)
    """

    _: KW_ONLY
    l11: ArrayLike
    l21: ArrayLike
    l22: ArrayLike

    @classmethod
    def from_sigma(cls, s11: ArrayLike, s12: ArrayLike, s22: ArrayLike) -> BeamMatrix:
        """Factor σ11 (m²), σ12 (m rad), σ22 (rad²).

        Raises
        ------
        InputError
            If σ is not positive definite; numbers traced by JAX are not checked.

        Examples
        --------
        >>> float(BeamMatrix.from_sigma(4.0, 0.0, 9.0).emittance)
        6.0
        """
        determinant = s11 * s22 - s12 * s12
        untraced = not isinstance(determinant, jax.core.Tracer)
        if untraced and not (np.all(np.asarray(s11) > 0) and np.all(np.asarray(determinant) > 0)):
            raise InputError(
                f"sigma11 = {s11}, sigma12 = {s12}, sigma22 = {s22}",
                "sigma11 > 0 and sigma11*sigma22 > sigma12**2: a positive definite matrix",
            )
        l11 = jnp.sqrt(s11)
        return cls(l11=l11, l21=s12 / l11, l22=jnp.sqrt(determinant) / l11)

    @classmethod
    def from_twiss(cls, emittance: ArrayLike, beta: ArrayLike, alpha: ArrayLike) -> BeamMatrix:
        """Compute σ = ε [[β, -α], [-α, γ]] from ε in m, β in m, α.

        Raises
        ------
        InputError
            If ε or β is not positive; numbers traced by JAX are not checked.
        """
        for name, number in (("emittance", emittance), ("beta", beta)):
            if not isinstance(number, jax.core.Tracer) and not np.all(np.asarray(number) > 0):
                raise InputError(f"{name} = {number}", "a positive number")
        root = jnp.sqrt(emittance / beta)
        return cls(l11=beta * root, l21=-alpha * root, l22=root)

    @property
    def sigma(self) -> Array:
        """σ as an array of shape (..., 2, 2)."""
        s11, s12 = jnp.square(self.l11), self.l11 * self.l21
        s22 = jnp.square(self.l21) + jnp.square(self.l22)
        return jnp.stack([jnp.stack([s11, s12], -1), jnp.stack([s12, s22], -1)], -2)

    @property
    def emittance(self) -> Array:
        """Geometric emittance sqrt(det σ) in m."""
        return jnp.abs(jnp.asarray(self.l11) * self.l22)

    def normalized_emittance(self, energy: ArrayLike, mass: float = ELECTRON_MASS) -> Array:
        """βγ ε in m, at a total energy and a rest energy in MeV."""
        return self.emittance * beta_gamma(energy, mass)

    @property
    def twiss(self) -> Twiss:
        """β = σ11/ε, α = -σ12/ε, γ = (1 + α²)/β."""
        beta = jnp.abs(jnp.asarray(self.l11) / self.l22)
        alpha = -jnp.sign(self.l11) * self.l21 / jnp.abs(self.l22)
        return Twiss(beta, alpha, (1.0 + alpha**2) / beta)

    def mismatch(self, design: BeamMatrix) -> Array:
        """BMAG = (β γ_d - 2 α α_d + γ β_d)/2 to a design beam; 1 for a matched beam.

        The beta mismatch parameter of M. Sands, SLAC-AP-85 (1991): the factor by which the
        emittance grows when the mismatched beam filaments. The design's emittance does not
        enter. Tested as Tr(σ σ_d⁻¹) ε_d/(2 ε).

        Examples
        --------
        >>> beam = BeamMatrix.from_twiss(1e-9, 2.0, 0.5)
        >>> round(float(beam.mismatch(beam)), 12)
        1.0
        """
        b, d = self.twiss, design.twiss
        return 0.5 * (b.beta * d.gamma - 2.0 * b.alpha * d.alpha + b.gamma * d.beta)

    def transport(self, matrix: ArrayLike) -> BeamMatrix:
        """Transport the beam through R: σ → R σ Rᵀ (report eq. 36).

        Parameters
        ----------
        matrix : Array
            Shape (..., 2, 2) or (..., 3, 3), one plane of a transfer matrix.

        Returns
        -------
        BeamMatrix
            The beam after R; its emittance is exactly ``|det R|`` times this one's.
        """
        r = jnp.asarray(matrix)
        a, b, c, d = r[..., 0, 0], r[..., 0, 1], r[..., 1, 0], r[..., 1, 1]
        # Rows of R L; a rotation that puts the first one on the axis gives its Cholesky factor.
        p, q = a * self.l11 + b * self.l21, b * self.l22
        u, v = c * self.l11 + d * self.l21, d * self.l22
        l11 = jnp.sqrt(p * p + q * q)
        l21, l22 = (p * u + q * v) / l11, jnp.abs(p * v - q * u) / l11
        return BeamMatrix(l11=l11, l21=l21, l22=l22)
