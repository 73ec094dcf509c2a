"""A scenario's fit in linear approximation: values with errors, and what rests on bounds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox import assess, tree
from beamfit.greybox.bounded import MOST_SHARE, Spread, spread_of
from beamfit.greybox.fit import Fit
from beamfit.quantity import Status

__all__ = ["Found", "Judged", "judged", "with_slope"]

# A further decrease of χ² below this changes nothing anybody asks for.
SETTLED = 0.01


class Found(NamedTuple):
    """Values, errors (as quoted, and raw), whether they are determined, and their slopes."""

    value: np.ndarray
    error: np.ndarray
    raw: np.ndarray
    known: np.ndarray
    slope: np.ndarray


class Judged(NamedTuple):
    """A fit with its first-order picture.

    Attributes
    ----------
    fit : Fit
        Of the grey-box core.
    jacobian : ndarray
        Residuals by free numbers, shape (m, n), priors and anchors among them, as scaled.
    spread : Spread
        Covariance with bounds counted as information, errors as given.
    scaled : Spread
        The same with the sizes' errors enlarged by sqrt(χ²/dof) where that exceeds 1. Priors and
        anchors are not enlarged: that the sizes miss the model says nothing against them.
    settled : bool
        Whether the search ended at an optimum, as far as the data can tell: the decrease of χ²
        that a further Gauss-Newton step promises is below 0.01. Networks have flat valleys in
        which a strict optimum is never reached and nothing changes any more.
    """

    fit: Fit
    jacobian: np.ndarray
    spread: Spread
    scaled: Spread
    settled: bool

    def quantities(self, function: Callable[[Any, Any], Array], data: Any) -> Found:
        """Values of ``function(model, data)`` with raw errors, and which the data determine.

        The function is compiled once if it is defined at the top of a module.
        """
        core, theta = self.fit.problem.core, jnp.asarray(self.fit.theta)
        value, slope = (np.asarray(v) for v in with_slope(function, core, theta, data))
        usable = np.isfinite(value) & np.isfinite(slope).all(axis=-1)
        slope = np.where(usable[:, None], slope, 0.0)
        known = usable & (self.scaled.share(slope) < MOST_SHARE)
        return Found(value, self.scaled.error(slope), self.spread.error(slope), known, slope)


@partial(jax.jit, static_argnums=0)
def with_slope(function, core, theta, data) -> tuple[Array, Array]:
    """``function(model, data)`` as a flat vector, with its derivatives by the free numbers."""

    def of_theta(t):
        return jnp.ravel(function(tree.replace(core.model, core.chosen, t), data))

    return of_theta(theta), jax.jacfwd(of_theta)(theta)


def judged(fit: Fit) -> Judged:
    """Linearise a fit at its end; weights held by their bounds stay where they are."""
    p = fit.problem
    at = assess.slopes(p, fit.theta)
    edge = np.array([v.state in ("lower", "upper") for v in fit.variables])
    held = (edge & p.nuisance) | (p.lower == p.upper)
    with_prior = np.isin(np.array(p.names), [prior.name for prior in p.priors])
    spread = spread_of(at.residual_jacobian, p.lower, p.upper, held, with_prior)
    sizes = [np.full(r.measured.size, r.name.startswith("size")) for r in p.records]
    sizes = np.concatenate([*sizes, np.zeros(len(at.residual) - sum(map(len, sizes)), bool)])
    rows = at.residual_jacobian / np.where(sizes, fit.scale, 1.0)[:, None]
    scaled = spread_of(rows, p.lower, p.upper, held, with_prior)
    outward = ((fit.theta <= p.lower) & (at.gradient > 0)) | (
        (fit.theta >= p.upper) & (at.gradient < 0)
    )
    pull = np.where(outward | held, 0.0, at.gradient)
    settled = fit.status is not Status.not_converged or bool(spread.error(pull) ** 2 < SETTLED)
    return Judged(fit, rows, spread, scaled, settled)
