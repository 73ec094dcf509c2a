"""Closed-form fit of a plane's beam matrix to measured sizes.

Size² is linear in σ (model.py). The functions are pure JAX functions of one scan in one plane; many
scans are a vmap of them.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from beamfit.answer import shown
from beamfit.emittance.beam_draws import FIT_ITERATIONS, MAX_SIZE_RATIO
from beamfit.emittance.model import coefficients

# The settings do not separate the three numbers of σ below this ratio of the diagonal of R.
_RANK_TOLERANCE = 1e-10


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
        Whether the settings separate the three numbers.
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


def size_for_weights(measured: Array, squared: Array) -> Array:
    """Model size for the weights, within a factor `MAX_SIZE_RATIO` of the measured size.

    The limits keep one outlier, or a negative size², from taking all weight.
    """
    low, high = (measured / MAX_SIZE_RATIO) ** 2, (measured * MAX_SIZE_RATIO) ** 2
    return jnp.sqrt(jnp.clip(squared, low, high))


def error_at(size: Any, measured: Any, error: Any, relative: Any) -> Any:
    """Error at another size than the measured one; ``relative`` errors are a share of the size."""
    return error * (1.0 + relative * (size / measured - 1.0))


def _least_squares(design: Array, target: Array) -> tuple[Array, Array, Array]:
    """Solve by QR with unit columns; errors are NaN where the rows do not have full rank."""
    norm = jnp.linalg.norm(design, axis=0)
    norm = jnp.where(norm > 0.0, norm, 1.0)
    q, r = _gram_schmidt(design / norm)
    diagonal = jnp.abs(jnp.diagonal(r))
    full_rank = jnp.min(diagonal) > _RANK_TOLERANCE * jnp.max(diagonal)
    r = jnp.where(full_rank, r, jnp.eye(3))
    inverse = _inverse_triangle(r) / norm[:, None]
    sigma = inverse @ (q.T @ target)
    return sigma, jnp.where(full_rank, inverse @ inverse.T, jnp.nan), full_rank


def _gram_schmidt(columns: Array) -> tuple[Array, Array]:
    """QR of three columns by Gram and Schmidt: a batch of 10 000 is one pass, without LAPACK.

    Each column is orthogonalised twice, which is enough: L. Giraud, J. Langou and M. Rozloznik,
    Comput. Math. Appl. 50 (2005) 1069.
    """
    q: list[Array] = []
    r = [[jnp.zeros(())] * 3 for _ in range(3)]
    for k in range(3):
        rest = columns[:, k]
        for _ in range(2):
            for j, other in enumerate(q):
                overlap = jnp.sum(other * rest)
                rest, r[j][k] = rest - overlap * other, r[j][k] + overlap
        r[k][k] = jnp.sqrt(jnp.sum(rest**2))
        q.append(rest / jnp.where(r[k][k] > 0.0, r[k][k], 1.0))
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
    """Fit the beam matrix to sizes and transfer-matrix elements of one scan or of many.

    Parameters
    ----------
    r11, r12 : array
        Transfer-matrix elements from the start to the screen, shape (n,) or (scans, n).
    size, error : array
        Rms sizes and standard errors in m, shape (n,) or (scans, n).
    known : array
        Size² in m² from dispersion and resolution; broadcast.
    relative : array
        1 where an error is a share of the size and so grows with the model size; broadcast.
    weights : {"model", "measured"}
        Size at which the error of size² is taken.

    Returns
    -------
    SigmaFit
        Arrays with the leading shape of ``size``.

    Notes
    -----
    Weighted linear least squares, the report's ``error_linear``: residual (model² - size²)/(2 size
    error), Appendix A. QR of the scaled design does not square its condition. With the measured
    size in the weights, a size that noise made small has more weight; this bias makes σ small by
    3 r² to 7 r² for a relative noise r, whatever the number of points. The model size is free of
    it.

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

    def solve_at(at: Array) -> tuple[Array, ...]:
        scale = 0.5 / (at * error_at(at, size, error, relative))
        target, design = (size**2 - known) * scale, rows * scale[:, None]
        return *_least_squares(design, target), design, target

    def iterate(_: int, at: Array) -> Array:
        return size_for_weights(size, rows @ solve_at(at)[0] + known)

    at = jax.lax.fori_loop(0, FIT_ITERATIONS if weights == "model" else 0, iterate, size)
    sigma, covariance, full_rank, design, target = solve_at(at)
    determinant = sigma[0] * sigma[2] - sigma[1] ** 2
    gradient = jnp.stack([sigma[2], -2.0 * sigma[1], sigma[0]])
    positive = full_rank & (determinant > 0.0) & (sigma[0] > 0.0)
    chi2 = jnp.sum((design @ sigma - target) ** 2)
    error = jnp.sqrt(gradient @ covariance @ gradient)
    return SigmaFit(sigma, covariance, chi2, determinant, error, full_rank, positive)
