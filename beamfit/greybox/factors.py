"""Symmetric positive matrices, dense or sparse: factors, solutions, elements of the inverse.

Above `FEW` free numbers steps and errors come from A = JᵀJ in the place of orthogonal factors of J,
and from its sparse factors where most of J is zero. Elements of A⁻¹ at the places of the factors
cost no more than these do (K. Takahashi, J. Fagan & M.-S. Chen, 8th PICA Conf. (1973) 63;
A. M. Erisman & W. F. Tinney, Commun. ACM 18 (1975) 177).
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

# Free numbers up to which all is dense, by orthogonal factors and singular values.
FEW = 200
# Rounds of inverse iteration for the weakest directions; each gains the ratio of eigenvalues.
ROUNDS = 10
# Added to the diagonal of A = J'J, columns of unit length, so that rounding leaves it positive.
RIDGE = 1e-13

Rows = np.ndarray | sparse.csr_array


def lengths(rows: Rows) -> np.ndarray:
    """Lengths of the columns of a matrix."""
    if sparse.issparse(rows):
        return np.sqrt(np.bincount(rows.indices, rows.data**2, minlength=rows.shape[1]))
    return np.linalg.norm(rows, axis=0)


def in_units(rows: Rows, unit: np.ndarray) -> Rows:
    """A matrix with each column divided by a number."""
    if not sparse.issparse(rows):
        return rows / unit
    parts = (rows.data / unit[rows.indices], rows.indices, rows.indptr)
    return sparse.csr_array(parts, shape=rows.shape)


def with_diagonal(matrix: Rows, values: np.ndarray | float) -> Rows:
    """A square matrix with numbers added to its diagonal."""
    if sparse.issparse(matrix):
        return matrix + sparse.diags_array(np.broadcast_to(values, matrix.shape[:1]))
    found = matrix.copy()
    found[np.diag_indices(len(found))] += values
    return found


class Factor:
    """Factors of a symmetric positive matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive.
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
        """The solution x of A x = b, b of shape (n,) or (n, k)."""
        if sparse.issparse(self.matrix):
            return self.factors.solve(right)
        return linalg.cho_solve(self.factors, right, check_finite=False)

    @cached_property
    def inverse(self) -> Rows:
        """A⁻¹, of a sparse A only at the places of its factors."""
        if sparse.issparse(self.matrix):
            return _selected(self.factors)
        factor, lower = self.factors
        found = linalg.lapack.dpotri(factor, lower=lower)[0]
        half = np.tril(found) if lower else np.triu(found)
        return half + half.T - np.diag(half.diagonal())

    def loss(self, more: np.ndarray) -> np.ndarray:
        """Diagonal of A⁻¹ diag(more) A⁻¹: how fast that of A⁻¹ falls with what A has more.

        Of a sparse A as the imaginary part of an inverse: (A + ih D)⁻¹ = A⁻¹ - ih A⁻¹ D A⁻¹ exactly
        to rounding, for an h so small that h² is nothing.
        """
        if not sparse.issparse(self.matrix):
            return self.inverse**2 @ more
        small = 1e-30
        turned = Factor(with_diagonal(self.matrix.astype(complex), 1j * small * more))
        return -turned.inverse.diagonal().imag / small


def weakest(rows: Rows, count: int) -> np.ndarray:
    """The directions, shape (n, count), along which a matrix changes a vector least, about."""
    normal = rows.T @ rows
    factor = Factor(with_diagonal(normal, RIDGE * np.max(normal.diagonal(), initial=1e-300)))
    found = np.random.default_rng(0).normal(size=(rows.shape[1], count))
    for _ in range(ROUNDS):
        found = np.linalg.qr(factor.solve(found))[0]
    return found


def _selected(lu) -> sparse.csc_array:
    """Elements of the inverse of A = L D Lᵀ at the places of L + Lᵀ.

    From the last column j to the first, with S its places below the diagonal: z_Sj = -Z_SS l_Sj and
    z_jj = 1/d_j - l_Sjᵀ z_Sj. All of S but its first place lies in that place's own S, so that Z_SS
    is a part of what was found there.
    """
    lower, pivots = sparse.csc_array(lu.L), lu.U.diagonal()
    below, values = _filled(lower)
    fronts: list[Any] = [None] * len(below)
    for j in range(len(below) - 1, -1, -1):
        s = below[j]
        front = np.empty((len(s) + 1, len(s) + 1), lower.dtype)
        front[0, 0] = 1.0 / pivots[j]
        if len(s):
            at = np.concatenate([[0], np.searchsorted(below[s[0]], s[1:]) + 1])
            known = fronts[s[0]][at[:, None], at]
            column = -(known @ values[j])
            front[0, 0] -= values[j] @ column
            front[0, 1:] = front[1:, 0] = column
            front[1:, 1:] = known
        fronts[j] = front
    back = np.argsort(lu.perm_c)
    rows = back[np.concatenate([part for j, s in enumerate(below) for part in ([j], s)])]
    columns = back[np.repeat(np.arange(len(below)), [len(s) + 1 for s in below])]
    data, off = np.concatenate([front[0] for front in fronts]), rows != columns
    places = np.append(rows, columns[off]), np.append(columns, rows[off])
    return sparse.csc_array((np.append(data, data[off]), places), shape=lower.shape)


def _filled(lower: sparse.csc_array) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Places and values below the diagonal of each column, zeros that elimination leaves too."""
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
