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

from beamfit.answer import shown
from beamfit.emittance.beam_draws import FURTHEST, ROUNDS
from beamfit.emittance.model import coefficients

# A direction of σ is lost when its diagonal of R is this far below the largest.
_RANK = 1e-10


@shown
class SigmaFit(NamedTuple):
    """A fitted beam matrix and its covariance.

    Attributes
    ----------
    sigma : Array
        Shape (3,): σ11 (m²), σ12 (m rad), σ22 (rad²) of the best symmetric matrix.
    covariance : Array
        Shape (3, 3), for the errors as given (not χ²-scaled); NaN if ``full_rank`` is false.
    chi2 : Array
        χ² of ``sigma``.
    determinant, determinant_error : Array
        det σ, m² rad², and its standard error.
    full_rank : Array
        Whether the settings separate the three numbers at all.
    positive : Array
        Whether the matrix is positive definite.
    """

    sigma: Array
    covariance: Array
    chi2: Array
    determinant: Array
    determinant_error: Array
    full_rank: Array
    positive: Array


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
    q, r = _orthonormal(design / norm)
    diagonal = jnp.abs(jnp.diagonal(r))
    full_rank = jnp.min(diagonal) > _RANK * jnp.max(diagonal)
    r = jnp.where(full_rank, r, jnp.eye(3))
    inverse = _inverse_triangle(r) / norm[:, None]
    sigma = inverse @ (q.T @ target)
    return sigma, jnp.where(full_rank, inverse @ inverse.T, jnp.nan), full_rank


def _orthonormal(columns: Array) -> tuple[Array, Array]:
    """QR of three columns by Gram and Schmidt: a batch of 10 000 is one pass, without LAPACK.

    Each is made orthogonal twice, which is enough: L. Giraud, J. Langou and M. Rozloznik, Comput.
    Math. Appl. 50 (2005) 1069.
    """
    q: list[Array] = []
    r = [[jnp.zeros(())] * 3 for _ in range(3)]
    for k in range(3):
        left = columns[:, k]
        for _ in range(2):
            for j, other in enumerate(q):
                along = jnp.sum(other * left)
                left, r[j][k] = left - along * other, r[j][k] + along
        r[k][k] = jnp.sqrt(jnp.sum(left**2))
        q.append(left / jnp.where(r[k][k] > 0.0, r[k][k], 1.0))
    return jnp.stack(q, axis=1), jnp.stack([jnp.stack(row) for row in r])


def _inverse_triangle(r: Array) -> Array:
    """Invert an upper triangular 3 × 3 matrix in closed form (a batch of 10 000 is one pass)."""
    a, b, c = r[0, 0], r[1, 1], r[2, 2]
    r01, r02, r12 = r[0, 1], r[0, 2], r[1, 2]
    zero = jnp.zeros_like(a)
    first = [1 / a, -r01 / (a * b), (r01 * r12 - r02 * b) / (a * b * c)]
    rows = first, [zero, 1 / b, -r12 / (b * c)], [zero, zero, 1 / c]
    return jnp.stack([jnp.stack(row) for row in rows])


@partial(jax.jit, static_argnames="weights")
def fit_sizes(
    r11: ArrayLike,
    r12: ArrayLike,
    size: ArrayLike,
    error: ArrayLike,
    known: ArrayLike = 0.0,
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
    relative : array
        1 where an error is a share of the size and so grows with the model's; broadcast.
    weights : {"model", "measured"}
        Whose size the error of size² is taken at.

    Returns
    -------
    SigmaFit
        Arrays with the leading shape of ``size``.

    Notes
    -----
    Weighted linear least squares, the report's ``error_linear``: residual (model² - size²)/(2 size
    error), Appendix A. QR of the scaled design, so that its condition is not squared. With the
    measured size in the weights a size that noise made small counts for more, which makes σ small
    by 3 r² to 7 r² for a relative noise r, however many points there are; the model's size has no
    part in the noise.

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
    given = (r11, r12, known, size, error, relative)
    arrays = jnp.broadcast_arrays(*(jnp.asarray(v, float) for v in given))

    def one(*columns: Array) -> SigmaFit:
        return _fit(*columns, weights)

    for _ in arrays[0].shape[:-1]:
        one = jax.vmap(one)
    return one(*arrays)


def _fit(
    r11: Array, r12: Array, known: Array, size: Array, error: Array, relative: Array, weights: str
) -> SigmaFit:
    """Fit one scan in one plane, all arrays of shape (n,)."""
    rows = jnp.stack(coefficients(r11, r12), axis=-1)

    def fitted(at: Array) -> tuple[Array, ...]:
        scale = 0.5 / (at * error_at(at, size, error, relative))
        target, design = (size**2 - known) * scale, rows * scale[:, None]
        return *_least_squares(design, target), design, target

    def again(_: int, at: Array) -> Array:
        return weighed_size(size, rows @ fitted(at)[0] + known)

    at = jax.lax.fori_loop(0, ROUNDS if weights == "model" else 0, again, size)
    sigma, covariance, full_rank, design, target = fitted(at)
    determinant = sigma[0] * sigma[2] - sigma[1] ** 2
    gradient = jnp.stack([sigma[2], -2.0 * sigma[1], sigma[0]])
    positive = full_rank & (determinant > 0.0) & (sigma[0] > 0.0)
    chi2 = jnp.sum((design @ sigma - target) ** 2)
    error = jnp.sqrt(gradient @ covariance @ gradient)
    return SigmaFit(sigma, covariance, chi2, determinant, error, full_rank, positive)
