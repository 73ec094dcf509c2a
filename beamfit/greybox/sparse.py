"""Sparse Jacobians and factors of normal equations, for problems of many free numbers.

The pattern of a Jacobian, which residuals depend on which numbers, is found by products with a
direction for each number. Columns that share no row are then computed in one sweep (A. R. Curtis,
M. J. D. Powell & J. K. Reid, J. Inst. Math. Appl. 13 (1974) 117), and a sweep along all numbers
tells at each point whether the pattern is complete.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

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
        # The solution x of A x = b, b of shape (n,) or (n, k).
        self.solve: Callable[[np.ndarray], np.ndarray]
        if not sparse.issparse(matrix):
            factor = linalg.cho_factor(matrix, check_finite=False)
            self.solve = partial(linalg.cho_solve, factor, check_finite=False)
            return
        try:
            self.solve = splu(
                sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            ).solve  # fmt: skip
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from None


def weakest(rows: Rows, count: int) -> np.ndarray:
    """The directions, shape (n, count), along which a matrix changes a vector least, about."""
    normal = rows.T @ rows
    factor = Factor(with_diagonal(normal, RIDGE * np.max(normal.diagonal(), initial=1e-300)))
    found = np.random.default_rng(0).normal(size=(rows.shape[1], count))
    for _ in range(10):  # inverse iteration: each round gains the ratio of the eigenvalues
        found = np.linalg.qr(factor.solve(found))[0]
    return found


# Share of nonzero entries, and of sweeps, above which dense matrices are faster.
FULL = 0.25
# Relative difference between probe and matrix up to which the pattern is complete.
PROBE = 1e-9
# Directions in a compiled call.
SWEEPS = 8

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
        seeds[-1] = np.random.default_rng(0).uniform(0.5, 1.0, n)  # no sum is zero by chance
        return seeds

    def jacobian(self, sweep: Sweep) -> tuple[np.ndarray, sparse.csr_array | None]:
        """Residuals and their Jacobian; None where places are missing."""
        padded = np.pad(self.seeds, ((0, -len(self.seeds) % SWEEPS), (0, 0)))
        (r, *_), products = zip(*map(sweep, np.split(padded, len(padded) // SWEEPS)), strict=True)
        swept, places = np.concatenate(products)[: len(self.seeds)], self.places
        rows = np.repeat(np.arange(places.shape[0]), np.diff(places.indptr))
        values = swept[self.colours[places.indices], rows]
        found = sparse.csr_array((values, places.indices, places.indptr), shape=places.shape)
        size = abs(found) @ self.seeds[-1]
        wrong = np.abs(found @ self.seeds[-1] - swept[-1])
        complete = not np.any(wrong > PROBE * (size + np.max(size, initial=0.0)))
        return np.asarray(r), found if complete else None


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
    (m, n), found = shape, []
    for first in range(0, n, SWEEPS):
        products = np.asarray(sweep(np.eye(SWEEPS, n, first))[1])
        found.append(sparse.csr_array(products != 0))
        if sum(part.nnz for part in found) > FULL * m * n:
            return None
    places = sparse.csr_array(sparse.vstack(found)[:n].T)
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
