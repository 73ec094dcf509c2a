"""Sparse Jacobians and factors of normal equations, for problems of many free numbers.

The pattern of a Jacobian, which residuals depend on which numbers, is found by products with
directions: those of blocks of numbers that share no row are looked at in one sweep, blocks that a
row depends on are split, down to single numbers. Columns that share no row are then computed in one
sweep (A. R. Curtis, M. J. D. Powell & J. K. Reid, J. Inst. Math. Appl. 13 (1974) 117), and a sweep
along all numbers tells at each point whether the pattern is complete. Elements of the inverse at
the places of the factors cost no more than these do (K. Takahashi, J. Fagan & M.-S. Chen, 8th PICA
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

# Rounds of inverse iteration for the weakest directions; each gains the ratio of eigenvalues.
ROUNDS = 10
# Added to the diagonal of A = J'J, columns of unit length, so that rounding leaves it positive.
RIDGE = 1e-13

Rows = np.ndarray | sparse.csr_array


def lengths(rows: Rows) -> np.ndarray:
    """Lengths of the columns of a matrix."""
    if sparse.issparse(rows):
        return np.sqrt(np.bincount(rows.indices, rows.data**2, minlength=rows.shape[1]))
    return np.sqrt(np.einsum("mn,mn->n", rows, rows))


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


# Share of nonzero entries, and of sweeps, above which dense matrices are faster.
FULL = 0.25
# Relative difference between probe and matrix up to which the pattern is complete.
PROBE = 1e-9
# Directions in a compiled call; parts into which a block of numbers is split.
SWEEPS, SPLIT = 8, 4

# Residuals (m,) and the products (SWEEPS, m) of their Jacobian with directions (SWEEPS, n).
Sweep = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Places of a Jacobian that may differ from zero, and the sweep of each column."""

    places: sparse.csr_array
    colours: np.ndarray

    @cached_property
    def seeds(self) -> np.ndarray:
        """A direction for each sweep, and one of all numbers that tells a wrong pattern."""
        n = self.places.shape[1]
        seeds = np.zeros((int(self.colours.max(initial=-1)) + 2, n))
        seeds[self.colours, np.arange(n)] = 1.0
        seeds[-1] = _weights(n)
        return seeds

    def jacobian(self, sweep: Sweep) -> tuple[np.ndarray, sparse.csr_array | None]:
        """Residuals and their Jacobian; None where places are missing."""
        r, swept = _swept(sweep, self.seeds)
        found = _filled_in(self.places, self.colours, swept)
        size = abs(found) @ self.seeds[-1]
        wrong = np.abs(found @ self.seeds[-1] - swept[-1])
        complete = not np.any(wrong > PROBE * (size + np.max(size, initial=0.0)))
        return r, found if complete else None


def _weights(n: int) -> np.ndarray:
    """Numbers with which no sum is zero by chance."""
    return np.random.default_rng(0).uniform(0.5, 1.0, n)


def _swept(sweep: Sweep, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals, and products with any number of directions."""
    padded = np.pad(directions, ((0, -len(directions) % SWEEPS), (0, 0)))
    found = [sweep(part) for part in np.split(padded, len(padded) // SWEEPS)]
    products = np.concatenate([np.asarray(part) for _, part in found])
    return np.asarray(found[0][0]), products[: len(directions)]


def _filled_in(places: sparse.csr_array, colours: np.ndarray, swept: np.ndarray):
    """A matrix with these places, from its products with the directions of its colours."""
    rows = np.repeat(np.arange(places.shape[0]), np.diff(places.indptr))
    values = swept[colours[places.indices], rows]
    return sparse.csr_array((values, places.indices, places.indptr), shape=places.shape)


def pattern_at(sweep: Sweep, shape: tuple[int, int], known: Pattern | None = None):
    """Find the pattern of a Jacobian at a point; None where it is of no use.

    Parameters
    ----------
    sweep : callable
        Residuals and products at that point.
    shape : (int, int)
        Of the Jacobian.
    known : Pattern, optional
        Of other points, to which places are added.

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
        if colours.max() >= max(FULL * n, SPLIT * SWEEPS):
            return None
        seeds = np.zeros((colours.max() + 1, n))
        seeds[colours[np.arange(n) // width], np.arange(n)] = _weights(n)
        places = sparse.csr_array(_filled_in(places, colours, _swept(sweep, seeds)[1]) != 0)
        if width == 1:
            break
        if places.shape[1] > SWEEPS and places.nnz > (1 - FULL) * np.prod(places.shape):
            return None
        width //= SPLIT
        places = sparse.kron(places, np.ones((1, SPLIT), bool), "csr")[:, : -(-n // width)]
    places = places if known is None else sparse.csr_array(places + known.places)
    places.sort_indices()
    colours = _colours(places)
    if places.nnz > FULL * m * n or colours.max(initial=0) >= FULL * n:
        return None
    return Pattern(places, colours)


def _colours(rows: sparse.csr_array) -> np.ndarray:
    """The first sweep for each column in which no other has one of its rows."""
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
