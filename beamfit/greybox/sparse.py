"""Sparse Jacobians and factors of normal equations, for problems of many free numbers.

The sparsity pattern of a Jacobian is found from its products with directions (sweeps). The numbers
are grouped in blocks; blocks that share no row are tested in one sweep, and blocks on which a row
depends are split, down to single numbers. Columns that share no row are then computed in one sweep
(A. R. Curtis, M. J. D. Powell & J. K. Reid, J. Inst. Math. Appl. 13 (1974) 117). A sweep along all
numbers tests at each point if the pattern is complete. The elements of the inverse at the nonzero
places of the factors cost no more than the factors (K. Takahashi, J. Fagan & M.-S. Chen, 8th PICA
Conf. (1973) 63; A. M. Erisman & W. F. Tinney, Commun. ACM 18 (1975) 177).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

# Steps of inverse iteration for the weakest directions. Each step reduces the part of the others by
# the ratio of eigenvalues.
INVERSE_ITERATIONS = 10
# Added to the diagonal of JᵀJ, with columns of unit length, to keep it positive despite rounding.
RIDGE = 1e-13

Rows = np.ndarray | sparse.csr_array


def lengths(rows: Rows) -> np.ndarray:
    """Compute the lengths of the columns of a matrix."""
    if sparse.issparse(rows):
        return np.sqrt(np.bincount(rows.indices, rows.data**2, minlength=rows.shape[1]))
    return np.sqrt(np.einsum("mn,mn->n", rows, rows))


def in_units(rows: Rows, unit: np.ndarray) -> Rows:
    """Divide each column of a matrix by its unit."""
    if not sparse.issparse(rows):
        return rows / unit
    parts = (rows.data / unit[rows.indices], rows.indices, rows.indptr)
    return sparse.csr_array(parts, shape=rows.shape)


def with_diagonal(matrix: Rows, values: np.ndarray | float) -> Rows:
    """Add numbers to the diagonal of a square matrix."""
    if sparse.issparse(matrix):
        return matrix + sparse.diags_array(np.broadcast_to(values, matrix.shape[:1]))
    found = matrix.copy()
    found[np.diag_indices(len(found))] += values
    return found


class Factor:
    """Factorization of a symmetric positive definite matrix, dense (Cholesky) or sparse (LU).

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, matrix: Rows):
        self.matrix = matrix
        if not sparse.issparse(matrix):
            self.factors: Any = linalg.cho_factor(matrix, check_finite=False)
            return
        try:
            self.factors = splu(
                sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )  # fmt: skip
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from None

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve A x = b for b of shape (n,) or (n, k)."""
        if sparse.issparse(self.matrix):
            return self.factors.solve(right)
        return linalg.cho_solve(self.factors, right, check_finite=False)

    @cached_property
    def inverse(self) -> Rows:
        """A⁻¹; for a sparse A only the elements at the nonzero places of its factors."""
        if sparse.issparse(self.matrix):
            return _selected(self.factors)
        factor, lower = self.factors
        found = linalg.lapack.dpotri(factor, lower=lower)[0]
        triangle = np.tril(found) if lower else np.triu(found)
        return triangle + triangle.T - np.diag(triangle.diagonal())

    def loss(self, more: np.ndarray) -> np.ndarray:
        """Compute the diagonal of A⁻¹ diag(more) A⁻¹.

        It is the rate at which the diagonal of A⁻¹ falls when diag(more) is added to A. If A is
        sparse, it is computed as the imaginary part of an inverse: (A + ih D)⁻¹ =
        A⁻¹ - ih A⁻¹ D A⁻¹ for an h so small that h² vanishes in double precision.
        """
        if not sparse.issparse(self.matrix):
            return self.inverse**2 @ more
        small = 1e-30
        shifted = Factor(with_diagonal(self.matrix.astype(complex), 1j * small * more))
        return -shifted.inverse.diagonal().imag / small


def weakest(rows: Rows, count: int) -> np.ndarray:
    """Estimate the right singular vectors of the smallest singular values, shape (n, count)."""
    normal = rows.T @ rows
    factor = Factor(with_diagonal(normal, RIDGE * np.max(normal.diagonal(), initial=1e-300)))
    found = np.random.default_rng(0).normal(size=(rows.shape[1], count))
    for _ in range(INVERSE_ITERATIONS):
        found = np.linalg.qr(factor.solve(found))[0]
    return found


def _selected(lu) -> sparse.csc_array:
    """Compute the elements of Z = A⁻¹, A = L D Lᵀ, at the nonzero places of L + Lᵀ.

    For each column j, from the last to the first, and its rows S below the diagonal:
    z_Sj = -Z_SS l_Sj and z_jj = 1/d_j - l_Sjᵀ z_Sj. Let s be the first row of S; all others are
    rows of column s too, so that Z_SS is part of the block computed for column s.
    """
    lower, pivots = sparse.csc_array(lu.L), lu.U.diagonal()
    below, values = _with_fill_in(lower)
    fronts: list[Any] = [None] * len(below)
    for j in range(len(below) - 1, -1, -1):
        s = below[j]
        front = np.empty((len(s) + 1, len(s) + 1), lower.dtype)
        front[0, 0] = 1.0 / pivots[j]
        if len(s):
            at = np.concatenate([[0], np.searchsorted(below[s[0]], s[1:]) + 1])
            block = fronts[s[0]][at[:, None], at]
            column = -(block @ values[j])
            front[0, 0] -= values[j] @ column
            front[0, 1:] = front[1:, 0] = column
            front[1:, 1:] = block
        fronts[j] = front
    back = np.argsort(lu.perm_c)
    rows = back[np.concatenate([part for j, s in enumerate(below) for part in ([j], s)])]
    columns = back[np.repeat(np.arange(len(below)), [len(s) + 1 for s in below])]
    data, off = np.concatenate([front[0] for front in fronts]), rows != columns
    places = np.append(rows, columns[off]), np.append(columns, rows[off])
    return sparse.csc_array((np.append(data, data[off]), places), shape=lower.shape)


def _with_fill_in(lower: sparse.csc_array) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rows and values below the diagonal of each column, including fill-in that is zero."""
    lower.sort_indices()
    ends, n = lower.indptr.tolist(), lower.shape[0]
    places = [lower.indices[a + 1 : b] for a, b in pairwise(ends)]
    values = [lower.data[a + 1 : b] for a, b in pairwise(ends)]
    more: list[set[int]] = [set() for _ in range(n)]
    for j in range(n):
        own = places[j].tolist()
        if more[j] and not more[j].issubset(own):
            filled = np.array(sorted(more[j].union(own)), int)
            spread = np.zeros(len(filled), lower.dtype)
            spread[np.searchsorted(filled, places[j])] = values[j]
            places[j], values[j], own = filled, spread, filled.tolist()
        if own:
            more[own[0]].update(own[1:])
    return places, values


# Share of nonzero entries, or of sweeps per column, above which dense matrices are faster.
MAX_FILL = 0.25
# The pattern is complete if the test sweep and the sparse matrix agree to this relative difference.
PATTERN_TOLERANCE = 1e-9
# Directions in a compiled call.
SWEEPS = 8
# Parts into which a block of numbers is split.
SPLIT = 4

# Function of directions (SWEEPS, n) to residuals (m,) and the products (SWEEPS, m) of their
# Jacobian with the directions.
Sweep = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Sparsity pattern of a Jacobian, and the sweep (colour) in which each column is computed."""

    places: sparse.csr_array
    colours: np.ndarray

    @cached_property
    def seeds(self) -> np.ndarray:
        """A direction for each sweep, and one along all numbers that tests the pattern."""
        n = self.places.shape[1]
        seeds = np.zeros((int(self.colours.max(initial=-1)) + 2, n))
        seeds[self.colours, np.arange(n)] = 1.0
        seeds[-1] = _weights(n)
        return seeds

    def jacobian(self, sweep: Sweep) -> tuple[np.ndarray, sparse.csr_array | None]:
        """Compute residuals and Jacobian; None for the latter if the pattern is incomplete."""
        r, products = _products(sweep, self.seeds)
        found = _from_products(self.places, self.colours, products)
        size = abs(found) @ self.seeds[-1]
        difference = np.abs(found @ self.seeds[-1] - products[-1])
        complete = not np.any(difference > PATTERN_TOLERANCE * (size + np.max(size, initial=0.0)))
        return r, found if complete else None


def _weights(n: int) -> np.ndarray:
    """Random weights, with which no sum of entries vanishes by chance."""
    return np.random.default_rng(0).uniform(0.5, 1.0, n)


def _products(sweep: Sweep, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute residuals, and the Jacobian's products with any number of directions."""
    padded = np.pad(directions, ((0, -len(directions) % SWEEPS), (0, 0)))
    found = [sweep(part) for part in np.split(padded, len(padded) // SWEEPS)]
    products = np.concatenate([np.asarray(part) for _, part in found])
    return np.asarray(found[0][0]), products[: len(directions)]


def _from_products(places: sparse.csr_array, colours: np.ndarray, products: np.ndarray):
    """Make a matrix of a pattern from its products with the direction of each colour."""
    rows = np.repeat(np.arange(places.shape[0]), np.diff(places.indptr))
    values = products[colours[places.indices], rows]
    return sparse.csr_array((values, places.indices, places.indptr), shape=places.shape)


def pattern_at(sweep: Sweep, shape: tuple[int, int], known: Pattern | None = None):
    """Find the sparsity pattern of a Jacobian at a point; None if it is not sparse enough.

    Parameters
    ----------
    sweep : callable
        Function for residuals and products at that point.
    shape : (int, int)
        Shape of the Jacobian.
    known : Pattern, optional
        Pattern at other points, which is extended.

    Returns
    -------
    Pattern or None

    Examples
    --------
    >>> rows = np.eye(8, 9) - np.eye(8, 9, 1)
    >>> found = pattern_at(lambda v: (np.zeros(8), v @ rows.T), rows.shape)
    >>> found.places.indices.tolist()[:6], found.colours.tolist()[:4]
    ([0, 1, 1, 2, 2, 3], [0, 1, 0, 1])
    """
    (m, n), width = shape, 1
    while width * SWEEPS * SPLIT < n:
        width *= SPLIT
    places = sparse.csr_array(np.ones((m, -(-n // width)), bool))
    while True:
        full = places.nnz == np.prod(places.shape)
        colours = np.arange(places.shape[1]) if full else _colours(places)
        if colours.max() >= max(MAX_FILL * n, SPLIT * SWEEPS):
            return None
        seeds = np.zeros((colours.max() + 1, n))
        seeds[colours[np.arange(n) // width], np.arange(n)] = _weights(n)
        places = sparse.csr_array(_from_products(places, colours, _products(sweep, seeds)[1]) != 0)
        if width == 1:
            break
        if places.shape[1] > SWEEPS and places.nnz > (1 - MAX_FILL) * np.prod(places.shape):
            return None
        width //= SPLIT
        places = sparse.kron(places, np.ones((1, SPLIT), bool), "csr")[:, : -(-n // width)]
    places = places if known is None else sparse.csr_array(places + known.places)
    places.sort_indices()
    colours = _colours(places)
    if places.nnz > MAX_FILL * m * n or colours.max(initial=0) >= MAX_FILL * n:
        return None
    return Pattern(places, colours)


def _colours(rows: sparse.csr_array) -> np.ndarray:
    """Assign each column to the first sweep in which no other column shares a row with it."""
    columns = rows.tocsc()
    used, found = [0] * rows.shape[0], []
    places, ends = columns.indices.tolist(), columns.indptr.tolist()
    for first, last in pairwise(ends):
        own, taken = places[first:last], 0
        for row in own:
            taken |= used[row]
        free = ~taken & (taken + 1)  # the lowest bit that is not set
        for row in own:
            used[row] |= free
        found.append(free.bit_length() - 1)
    return np.array(found, int)
