"""The information a fit has about its emittances, ready to be added to."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import assess, tree
from beamfit.greybox.covariance import MOST_SHARE, Spread, spread_of
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.model import emittance_parts, sigma_of
from beamfit.studies.scan.verdict import CLEAR

__all__ = ["Information", "information_of", "linearised_at", "with_slope"]


class Information(NamedTuple):
    """Residuals by free numbers, and what is asked of those numbers.

    Attributes
    ----------
    jacobian : ndarray
        Shape (m, n), errors scaled as the fit scaled them.
    lower, upper, held, with_prior : ndarray
        Bounds, what does not move, and what has a prior.
    asked : ndarray
        Which numbers are asked for (not weights of networks), for D-optimality.
    planes : tuple of str
        The planes, in the order of ``emittance`` and ``slope``.
    emittance, slope : ndarray
        Emittances, shape (planes,), and their derivatives, (planes, n).
    """

    jacobian: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    held: np.ndarray
    with_prior: np.ndarray
    asked: np.ndarray
    planes: tuple[str, ...]
    emittance: np.ndarray
    slope: np.ndarray

    @property
    def spread(self) -> Spread:
        """Covariance of the numbers, bounds counted as information."""
        return spread_of(self.jacobian, self.lower, self.upper, self.held, self.with_prior)

    def with_rows(self, rows: np.ndarray) -> Information:
        """The information with further rows of the Jacobian."""
        return self._replace(jacobian=np.vstack([self.jacobian, rows]))

    def share(self) -> np.ndarray:
        """Share of each emittance's variance that rests on bounds."""
        return self.spread.share(self.slope)

    def relative_error(self) -> dict[str, float]:
        """Relative error of each emittance."""
        error = self.spread.error(self.slope) / self.emittance
        return {p: float(e) for p, e in zip(self.planes, error, strict=True)}

    @property
    def identified(self) -> bool:
        """Whether every emittance rests on data and priors and is clear of zero."""
        worst = max(self.relative_error().values())
        return bool((self.share() < MOST_SHARE).all()) and worst <= 1.0 / (2.0 * CLEAR)

    def score(self, criterion: str, rows: np.ndarray | None) -> float:
        """What is to be small, after further rows: relative emittance error, or error volume."""
        spread = self.spread
        c = spread.covariance
        if rows is not None:
            gain = c @ rows.T
            c = c - gain @ np.linalg.solve(np.eye(len(rows)) + rows @ gain, gain.T)
        if criterion == "D":
            own = c[np.ix_(self.asked, self.asked)]
            unit = np.sqrt(np.diagonal(spread.covariance)[self.asked])
            return float(np.linalg.slogdet(own / np.outer(unit, unit))[1])
        variance = np.einsum("ij,jk,ik->i", self.slope, c, self.slope)
        return float(np.sqrt(np.sum(np.maximum(variance, 0.0) / self.emittance**2)))


def information_of(fit: EmittanceFit) -> Information:
    """Gather the information of a fit in any scenario.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.

    Returns
    -------
    Information
    """
    p, theta = fit.problem, linearised_at(fit)
    jacobian = assess.slopes(p, theta).residual_jacobian
    # Errors as the fit scaled them: a fit that misses its sizes learns less from the next one.
    scale = max(plane.error_scale for plane in fit.planes)
    rows = np.concatenate(
        [np.full(r.measured.size, scale if r.name.startswith("size") else 1.0) for r in p.records]
        + [np.ones(len(jacobian) - sum(r.measured.size for r in p.records))]
    )
    jacobian = jacobian / rows[:, None]
    held = p.lower == p.upper
    if fit.solved is not None and _determined(fit):
        edge = np.array([v.state in ("lower", "upper") for v in fit.fit.variables])
        held = held | (edge & p.nuisance)
    planes = tuple(plane.plane for plane in fit.planes)
    found = [with_slope(_emittance, p.core, jnp.asarray(theta), _named(plane)) for plane in planes]
    return Information(
        jacobian,
        p.lower,
        p.upper,
        held,
        np.isin(np.array(p.names), [prior.name for prior in p.priors]),
        ~p.nuisance & ~held,
        planes,
        np.array([float(v[0]) for v, _ in found]),
        np.array([np.asarray(s)[0] for _, s in found]),
    )


def linearised_at(fit: EmittanceFit) -> np.ndarray:
    """Where to take derivatives: at the answer, or at first principles where there is none.

    Numbers that the data do not determine end anywhere; what a measurement would tell is then
    asked of the line and the beam one started from.
    """
    if fit.solved is None:
        return fit.problem.start
    if _determined(fit):
        return fit.fit.theta
    return np.clip(fit.stated.start, fit.stated.lower, fit.stated.upper)


def _determined(fit: EmittanceFit) -> bool:
    return all(plane.identifiability.determined for plane in fit.planes)


@partial(jax.jit, static_argnums=0)
def with_slope(function, core, theta, data):
    """``function(model, data)`` as a flat vector, with its derivatives by the free numbers."""

    def of_theta(t):
        return jnp.ravel(function(tree.replace(core.model, core.chosen, t), data))

    return of_theta(theta), jax.jacfwd(of_theta)(theta)


def _named(plane: str) -> dict:
    """A plane's name as a tree, which JAX compiles for."""
    return {plane: jnp.zeros(0)}


def _emittance(model, plane):
    (name,) = plane.keys()
    return emittance_parts(sigma_of(model["beam"][name]))[:1]
