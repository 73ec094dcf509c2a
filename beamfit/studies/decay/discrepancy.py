"""What a network of a and b may be wrong by: a smooth error of its model, known from its decays.

The truth is the network plus a Gaussian process in ln a and one in ln b (M. C. Kennedy and A.
O'Hagan, J. R. Stat. Soc. B 63 (2001) 425). Near decays it is known from what the network leaves
there; away from them it is as large as its size.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from beamfit.greybox.fit import Fit

# Sizes that are weighed, as relative errors of a and of b.
SIZES = tuple(0.005 * 2 ** (k / 2) for k in range(13))


class Discrepancy(NamedTuple):
    """Smooth errors of a model of decays.

    Attributes
    ----------
    size : (float, float)
        Standard deviation of ln a and of ln b about the network.
    inputs : array, shape (n, k)
        Of the decays.
    length : array, shape (k,)
        Correlation lengths.
    rows : array, shape (2n, 2n)
        Slopes of what the decays say, in their errors, by ln a and ln b of each decay.
    """

    size: tuple[float, float]
    inputs: np.ndarray
    length: np.ndarray
    rows: np.ndarray

    def kernel(self, at: np.ndarray) -> np.ndarray:
        """Covariance of (ln a, ln b) at inputs (m, k) with those at the decays, (2m, 2n)."""
        off = (at[:, None] - self.inputs) / self.length
        return np.kron(np.exp(-0.5 * np.sum(off**2, -1)), np.diag(np.square(self.size)))

    @property
    def root(self) -> np.ndarray:
        """Lower triangle of the covariance of the decays, in their own errors, (2n, 2n)."""
        covariance = self.rows @ self.kernel(self.inputs) @ self.rows.T
        return cholesky(np.eye(len(covariance)) + covariance, lower=True)

    def spread(
        self, at: np.ndarray, slopes: np.ndarray, left: np.ndarray, fit: Fit
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the truth is off the network by, at inputs (m, k): mean (2m,), covariance (2m, 2m).

        `slopes` of ln a and ln b by the network's free numbers, (2m, p); `left` of the decays'
        residuals, in their errors, (2n,). Weights and errors of the model are not told apart.
        """
        root = self.root
        reach = cho_solve((root, True), self.rows @ self.kernel(at).T)
        jacobian = root @ fit.jacobian[: left.size]
        total = slopes - reach.T @ jacobian
        own = Discrepancy(self.size, at, self.length, self.rows).kernel(at)
        rest = own - reach.T @ self.rows @ self.kernel(at).T
        return reach.T @ left, rest + total @ fit.covariance_raw @ total.T


def sized(trial: Discrepancy, left: np.ndarray, fit: Fit) -> Discrepancy:
    """The size by restricted likelihood: weights integrated out about a fit made with a trial size.

    `left` are the decays' residuals, in their errors.
    """
    free = [k for k, variable in enumerate(fit.variables) if variable.state == "free"]
    jacobian = fit.jacobian[:, free]
    seen, known = trial.root @ jacobian[: left.size], jacobian[left.size :]
    start = fit.theta[free]

    def likelihood(size: tuple[float, float]) -> float:
        root = trial._replace(size=size).root
        rows = solve_triangular(root, seen, lower=True)
        off = solve_triangular(root, left, lower=True)
        # Priors are normal about zero: their residuals are their rows times the weights.
        information = rows.T @ rows + known.T @ known
        pull = rows.T @ off - known.T @ (known @ start)
        rest = off @ off - pull @ np.linalg.solve(information, pull)
        return -np.log(np.diag(root)).sum() - 0.5 * (np.linalg.slogdet(information)[1] + rest)

    return trial._replace(size=max(itertools.product(SIZES, SIZES), key=likelihood))
