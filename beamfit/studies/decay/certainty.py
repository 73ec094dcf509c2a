"""What a network of a and b holds over, what is certain there, what it may be wrong by."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from beamfit.errors import InputError
from beamfit.greybox.fit import Fit
from beamfit.table import json_of

INPUTS = ("rf_voltage", "scraper_y", "pressure", "bunches")
# How the loss moves with each input; nothing is known of the sign for the RF voltage.
SIGNS = {"scraper_y": -1, "pressure": 1, "bunches": -1}
ROUNDING = 1e-9


def scaled(rf_voltage: float, scraper_y: float, pressure: float, bunches: float) -> np.ndarray:
    """Inputs of a network from V, m, Pa, number: MV, logarithms of mm, nPa and number."""
    values = np.array([1e3 * scraper_y, 1e9 * pressure, bunches], float)
    return np.array([1e-6 * float(rf_voltage), *np.log(values)])


class Box(NamedTuple):
    """A range of operation, the ends in SI: what a network is asked to hold over.

    Parameters
    ----------
    rf_voltage, scraper_y, pressure, bunches : (float, float)
        V, m, Pa at the mean current, and number.

    Raises
    ------
    InputError
        From `corners`, if a range is empty or not positive and finite.

    Examples
    --------
    >>> box = Box((1.6e6, 3.2e6), (3e-3, 6e-3), (1e-8, 1e-7), (100, 300))
    >>> box.corners()[0].round(2).tolist()
    [1.6, 1.1, 2.3, 4.61]
    """

    rf_voltage: tuple[float, float]
    scraper_y: tuple[float, float]
    pressure: tuple[float, float]
    bunches: tuple[float, float]

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Both corners in the network's inputs."""
        for name, (low, high) in zip(self._fields, self, strict=True):
            if not 0 < low <= high < np.inf:
                expected = "0 < lower <= upper, finite"
                raise InputError(f"range {low:g} to {high:g}", expected, column=name)
        low, high = np.array(self, float).T
        return scaled(*low), scaled(*high)


class Certificate(NamedTuple):
    """What holds for all inputs in the operating box.

    Attributes
    ----------
    lower, upper : array, shape (4,)
        Corners of the box: RF voltage MV, logarithms of scraper mm, pressure nPa, bunches.
    gains : array, shape (2, 4, 2)
        Enclosures of the slopes of the network's ln a and ln b by the four inputs over the box,
        rounded outward; of a correction, those of its factor.
    single_maximum : str
        Whether the lifetime has a single maximum in the RF voltage: "certified" by convex nodes of
        a network alone; of a correction "seen" or "broken" at points of the box, since first
        principles have no enclosure; "not asked".
    """

    lower: np.ndarray
    upper: np.ndarray
    gains: np.ndarray
    single_maximum: str

    @property
    def holds(self) -> bool:
        """Whether every slope of known sign has it, within rounding."""
        known = [INPUTS.index(name) for name in SIGNS]
        sign = np.array(list(SIGNS.values()))
        worst = np.where(sign > 0, -self.gains[:, known, 0], self.gains[:, known, 1])
        return bool(np.all(worst <= ROUNDING))

    def holds_at(self, inputs: np.ndarray) -> bool:
        """Whether a point is in the box, within rounding."""
        inside = (inputs >= self.lower - ROUNDING) & (inputs <= self.upper + ROUNDING)
        return bool(np.all(inside))

    def to_json(self) -> dict[str, Any]:
        """Return the range and the slopes as JSON's types."""
        return json_of({"holds": self.holds, **self._asdict()})


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
        jacobian = root @ fit.dense_jacobian[: left.size]
        total = slopes - reach.T @ jacobian
        own = Discrepancy(self.size, at, self.length, self.rows).kernel(at)
        rest = own - reach.T @ self.rows @ self.kernel(at).T
        return reach.T @ left, rest + total @ fit.covariance_raw @ total.T


def sized(trial: Discrepancy, fit: Fit, left: np.ndarray) -> Discrepancy:
    """The size by restricted likelihood: weights integrated out about a fit made with a trial size.

    `left` are the decays' residuals, in their errors.
    """
    free = [k for k, variable in enumerate(fit.variables) if variable.state == "free"]
    jacobian = fit.dense_jacobian[:, free]
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
