"""The beam matrix of a plane from measured sizes in closed form: the fast path of the model.

Size² is linear in σ (model.py). Everything here is a pure JAX function of one scan in one plane;
many scans are a vmap of it.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from beamfit.greybox.descend import descend_one
from beamfit.shown import shown
from beamfit.studies.scan.model import coefficients, size_squared

# A direction of σ is lost when its diagonal of R is this far below the largest.
_RANK = 1e-10
# How often weights are taken anew from the model, and how far its size may be from the measured.
ROUNDS, FURTHEST = 6, 3.0
# Directions tried at once for the best beam of no emittance, and how often the search zooms in.
_DIRECTIONS, _ZOOMS = 48, 5


class SizeData(NamedTuple):
    """One scan in one plane, as the fit sees it.

    Attributes
    ----------
    r11 : Array
        Shape (n,), start of line to screen.
    r12 : Array
        Shape (n,), m.
    known : Array
        Shape (n,), m²: size² not due to σ (dispersion and resolution).
    size : Array
        Shape (n,), rms sizes in m.
    error : Array
        Shape (n,), their standard errors in m; infinite takes a point out.
    relative : Array
        Shape () or (n,): 1 where the error is a share of the size, so that it grows with the
        model's size; 0 where it is as it stands.
    """

    r11: Array
    r12: Array
    known: Array
    size: Array
    error: Array
    relative: ArrayLike = 0.0

    @property
    def design(self) -> Array:
        """Coefficients of σ11, σ12, σ22 in size², shape (n, 3)."""
        return jnp.stack(coefficients(self.r11, self.r12), axis=-1)


@shown
class SigmaFit(NamedTuple):
    """A fitted beam matrix and what is needed to judge it.

    Attributes
    ----------
    sigma : Array
        Shape (3,): σ11 (m²), σ12 (m rad), σ22 (rad²) of the best positive (semi)definite
        matrix.
    covariance : Array
        Shape (3, 3), for the errors as given (not χ²-scaled); NaN if ``full_rank`` is false.
    chi2 : Array
        χ² of ``sigma``.
    determinant : Array
        det σ of the best symmetric matrix, positive or not, m² rad².
    determinant_error : Array
        Its standard error.
    chi2_zero : Array
        The smallest χ² a beam of zero emittance reaches.
    full_rank : Array
        Whether the settings separate the three numbers at all.
    positive : Array
        Whether the best symmetric matrix is positive definite; if not, ``sigma`` is the best
        one of zero emittance.
    converged : Array
        Whether the iteration ended at a minimum; always so for the linear fit.
    error : Array
        Shape (n,): errors of the sizes as the weights took them, m.
    weighed : Array
        Shape (n,): the sizes that the errors of size² were taken at, m.
    symmetric : Array
        Shape (3,): the best symmetric matrix, positive or not, where ``full_rank``.
    """

    sigma: Array
    covariance: Array
    chi2: Array
    determinant: Array
    determinant_error: Array
    chi2_zero: Array
    full_rank: Array
    positive: Array
    converged: Array
    error: Array
    weighed: Array
    symmetric: Array


def solve_size_squared(data: SizeData, weights: str = "model") -> SigmaFit:
    """Fit size² by weighted linear least squares: the report's ``error_linear``.

    Parameters
    ----------
    data : SizeData
        One scan in one plane.
    weights : {"model", "measured"}
        Whose size the error of size² is taken at.

    Returns
    -------
    SigmaFit
        The best positive semidefinite σ. The problem is convex: where the unconstrained
        solution is positive definite it is the answer, else the answer has det σ = 0.

    Notes
    -----
    Residual (model² - size²)/(2 size error): Appendix A of the report. QR of the scaled
    design, so that its condition is not squared. With the measured size in the weights a size
    that noise made small counts for more, which makes σ small by 3 r² to 7 r² for a relative
    noise r, however many points there are; the model's size has no part in the noise.
    """
    return _linear(data, weights)[0]


def _linear(data: SizeData, weights: str) -> tuple[SigmaFit, Array]:
    """The linear fit, and the best beam of no emittance."""
    size, error = _weighed(data, weights)
    scale = 0.5 / (size * error)
    target, design = (data.size**2 - data.known) * scale, data.design * scale[:, None]
    sigma, covariance, full_rank = _least_squares(design, target)
    determinant, determinant_error = _determinant(sigma, covariance)
    degenerate, chi2_zero = zero_emittance(data.r11, data.r12, target, scale)
    positive = full_rank & (determinant > 0.0) & (sigma[0] > 0.0)
    best = jnp.where(positive, sigma, degenerate)
    chi2, rested = jnp.sum((design @ best - target) ** 2), jnp.asarray(True)
    judged = determinant, determinant_error, chi2_zero, full_rank, positive, rested
    return SigmaFit(best, covariance, chi2, *judged, error, size, sigma), degenerate


def _determinant(sigma: Array, covariance: Array) -> tuple[Array, Array]:
    """Of the beam matrix, with its error."""
    gradient = jnp.stack([sigma[2], -2.0 * sigma[1], sigma[0]])
    return sigma[0] * sigma[2] - sigma[1] ** 2, jnp.sqrt(gradient @ covariance @ gradient)


def _weighed(data: SizeData, weights: str) -> tuple[Array, Array]:
    """Sizes to take the error of size² at, and errors there: of a model fitted with the last."""

    def again(_: int, size: Array) -> Array:
        scale = 0.5 / (size * error_at(size, data.size, data.error, data.relative))
        target = (data.size**2 - data.known) * scale
        sigma = _least_squares(data.design * scale[:, None], target)[0]
        return weighed_size(data.size, size_squared(sigma, data.r11, data.r12, data.known))

    rounds = ROUNDS if weights == "model" else 0
    size = jax.lax.fori_loop(0, rounds, again, data.size)
    return size, error_at(size, data.size, data.error, data.relative)


def weighed_size(measured: Array, squared: Array) -> Array:
    """The model's size to weigh by, within `FURTHEST` of the measured one: one wild point, or
    a negative size², must not take all weight.
    """
    low, high = (measured / FURTHEST) ** 2, (measured * FURTHEST) ** 2
    return jnp.sqrt(jnp.clip(squared, low, high))


def error_at(size: Any, measured: Any, error: Any, relative: Any) -> Any:
    """The error of a size that differs from the measured one: one that is a share grows with it."""
    return error * (1.0 + relative * (size / measured - 1.0))


def _least_squares(design: Array, target: Array) -> tuple[Array, Array, Array]:
    """Solve by QR with unit columns; a direction the rows do not have leaves NaN errors."""
    norm = jnp.linalg.norm(design, axis=0)
    norm = jnp.where(norm > 0.0, norm, 1.0)
    q, r = jnp.linalg.qr(design / norm)
    diagonal = jnp.abs(jnp.diagonal(r))
    full_rank = jnp.min(diagonal) > _RANK * jnp.max(diagonal)
    r = jnp.where(full_rank, r, jnp.eye(3))
    inverse = _inverse_triangle(r) / norm[:, None]
    sigma = inverse @ (q.T @ target)
    return sigma, jnp.where(full_rank, inverse @ inverse.T, jnp.nan), full_rank


def _inverse_triangle(r: Array) -> Array:
    """Invert an upper triangular 3 × 3 matrix in closed form (a batch of 10 000 is one pass)."""
    a, b, c = r[0, 0], r[1, 1], r[2, 2]
    r01, r02, r12 = r[0, 1], r[0, 2], r[1, 2]
    zero = jnp.zeros_like(a)
    first = [1 / a, -r01 / (a * b), (r01 * r12 - r02 * b) / (a * b * c)]
    rows = first, [zero, 1 / b, -r12 / (b * c)], [zero, zero, 1 / c]
    return jnp.stack([jnp.stack(row) for row in rows])


def solve_size(data: SizeData, weights: str = "model") -> SigmaFit:
    """Fit the size itself: the report's ``error_nonlinear``.

    Parameters
    ----------
    data : SizeData
        One scan in one plane.
    weights : {"model", "measured"}
        Whose size an error that is a share of the size is taken at.

    Returns
    -------
    SigmaFit
        As `solve_size_squared`, from which it starts.

    Notes
    -----
    Residual (model - size)/error (Appendices A and C of the report), on the Cholesky factor of σ
    in units of its start, so that every iterate has a size.
    """
    start, degenerate = _linear(data, weights)
    scale = 1.0 / start.error
    design = data.design
    unit = jnp.sqrt(jnp.abs(start.sigma[jnp.array([0, 2])]))

    def sigma_of(p: Array) -> Array:
        a, b, c = p[0] * unit[0], p[1] * unit[1], p[2] * unit[1]
        return jnp.stack([a**2, a * b, b**2 + c**2])

    def residual(p: Array) -> Array:
        squared = jnp.maximum(design @ sigma_of(p) + data.known, 1e-30)
        return (jnp.sqrt(squared) - data.size) * scale

    correlation = start.sigma[1] / (unit[0] * unit[1])
    width = jnp.sqrt(jnp.maximum(1.0 - correlation**2, 1e-6))
    first, free = jnp.stack([jnp.ones(()), correlation, width]), jnp.full(3, jnp.inf)
    end = descend_one(residual, first, -free, free)
    sigma = sigma_of(end.theta)
    model = jnp.sqrt(design @ sigma + data.known)
    _, covariance, full_rank = _least_squares(design * (0.5 * scale / model)[:, None], data.size)
    determinant, determinant_error = _determinant(sigma, covariance)
    chi2 = 2.0 * end.cost
    flat = jnp.sqrt(design @ degenerate + data.known)
    flat_chi2 = jnp.sum(((flat - data.size) * scale) ** 2)
    return start._replace(
        sigma=sigma,
        covariance=covariance,
        chi2=chi2,
        determinant=determinant,
        determinant_error=determinant_error,
        chi2_zero=jnp.maximum(chi2, jnp.minimum(flat_chi2, start.chi2_zero)),
        full_rank=full_rank,
        positive=start.positive & (determinant > 0.0),
        converged=end.rested,
    )


SOLVE = {"size_squared": solve_size_squared, "size": solve_size}


@partial(jax.jit, static_argnames=("method", "weights"))
def fit_sizes(
    r11: ArrayLike,
    r12: ArrayLike,
    size: ArrayLike,
    error: ArrayLike,
    known: ArrayLike = 0.0,
    method: str = "size_squared",
    *,
    relative: ArrayLike = 0.0,
    weights: str = "model",
) -> SigmaFit:
    """Fit one scan or many in one call, from transfer-matrix elements and sizes.

    Parameters
    ----------
    r11, r12 : array
        Transfer-matrix elements from the start to the screen, shape (n,) or (scans, n).
    size, error : array
        Rms sizes and standard errors in m, shape (n,) or (scans, n).
    known : array
        Size² in m² that dispersion and resolution contribute; broadcast.
    method : {"size_squared", "size"}
        Which residual: the report's ``error_linear`` or ``error_nonlinear``.
    relative : array
        1 where an error is a share of the size and so grows with the model's; broadcast.
    weights : {"model", "measured"}
        Whose size the error of size² is taken at.

    Returns
    -------
    SigmaFit
        Arrays with the leading shape of ``size``.

    Examples
    --------
    Ten thousand simulated scans of one line:

    >>> r11, r12 = jnp.linspace(1, -1, 9), jnp.full(9, 2.0)
    >>> true = jnp.sqrt(r11**2 * 4e-8 + r12**2 * 1e-8)
    >>> noise = 1 + 0.02 * jax.random.normal(jax.random.key(0), (10_000, 9))
    >>> fits = fit_sizes(r11, r12, true * noise, 0.02 * true)
    >>> fits.sigma.shape, bool(abs(fits.determinant.mean() / 4e-16 - 1) < 0.05)
    ((10000, 3), True)
    """
    solve = SOLVE[method]
    given = (r11, r12, known, size, error, relative)
    arrays = jnp.broadcast_arrays(*(jnp.asarray(v, float) for v in given))

    def one(*columns: Array) -> SigmaFit:
        return solve(SizeData(*columns), weights)

    for _ in arrays[0].shape[:-1]:
        one = jax.vmap(one)
    return one(*arrays)


def zero_emittance(r11: Array, r12: Array, target: Array, scale: Array) -> tuple[Array, Array]:
    """Find the beam of no emittance that fits best: how far the data are from allowing one.

    Such a beam is a line in phase space, σ = v vᵀ: a direction and a length. For a direction
    the length is linear least squares, and the direction is searched over the half circle,
    in coordinates in which the scan looks at it evenly.

    Parameters
    ----------
    r11, r12 : Array
        Shape (n,).
    target : Array
        Shape (n,): measured size² less what is known, over its error.
    scale : Array
        Shape (n,): one over the error of size².

    Returns
    -------
    tuple of Array
        σ of shape (3,), and its χ².
    """
    used = jnp.where(scale > 0.0, 1.0, 0.0)
    g11 = jnp.sum(used * r11**2)
    g12 = jnp.sum(used * r11 * r12)
    g22 = jnp.sum(used * r12**2)
    # Coordinates in which the rows look in all directions evenly.
    rest = jnp.sqrt(jnp.maximum(g22 - g12**2 / g11, _RANK * g22))
    along, across = r11 / jnp.sqrt(g11), (r12 - r11 * g12 / g11) / rest

    # Of a direction θ the row is linear in (1, cos 2θ, sin 2θ): sums over rows are done once.
    parts = 0.5 * jnp.stack([along**2 + across**2, along**2 - across**2, 2.0 * along * across])
    parts = parts * scale
    projection, gram = parts @ target, parts @ parts.T

    def length_and_gain(angle: Array) -> tuple[Array, Array]:
        basis = jnp.stack([jnp.ones_like(angle), jnp.cos(2.0 * angle), jnp.sin(2.0 * angle)])
        norm = jnp.sum((gram @ basis) * basis, axis=0)
        overlap = jnp.maximum(projection @ basis, 0.0)
        length = overlap / jnp.where(norm > 0.0, norm, 1.0)
        return length, length * overlap

    steps = (jnp.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS - 0.5

    def zoom(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        angle, width = state
        tried = angle + width * steps
        return tried[jnp.argmax(length_and_gain(tried)[1])], 2.0 * width / _DIRECTIONS

    angle, _ = jax.lax.fori_loop(0, _ZOOMS, zoom, (jnp.asarray(0.0), jnp.asarray(jnp.pi)))
    length, gain = length_and_gain(angle)
    chi2 = jnp.sum(target**2) - gain
    w = jnp.sin(angle) / rest
    v1, v2 = jnp.cos(angle) / jnp.sqrt(g11) - w * g12 / g11, w
    return length * jnp.stack([v1**2, v1 * v2, v2**2]), chi2
