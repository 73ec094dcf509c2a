"""The information a fit has about its emittances, ready to be added to."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import assess, tree
from beamfit.greybox.covariance import MOST_SHARE
from beamfit.greybox.design import Information
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.model import emittance_parts, predict_sizes, sigma_of
from beamfit.studies.scan.verdict import CLEAR


def by_plane(fit: EmittanceFit, known: Information) -> dict[str, float]:
    """Relative error of each plane's emittance."""
    error = map(float, known.relative_error)
    return dict(zip((p.plane for p in fit.planes), error, strict=True))


def identified(known: Information) -> bool:
    """Whether every emittance rests on data and priors and is clear of zero."""
    clear = known.relative_error.max() <= 1.0 / (2.0 * CLEAR)
    return bool(clear and (known.share < MOST_SHARE).all())


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
    scale = {plane.plane: plane.error_scale for plane in fit.planes}
    sizes = [scale[r.data.plane] if r.predict is predict_sizes else 1.0 for r in p.records]
    rows = np.ones(len(jacobian))
    counts = [r.measured.size for r in p.records]
    rows[: sum(counts)] = np.repeat(sizes, counts)
    jacobian = jacobian / rows[:, None]
    held = p.lower == p.upper
    if fit.solved is not None and _determined(fit):
        edge = np.array([v.state in ("lower", "upper") for v in fit.fit.variables])
        held = held | (edge & p.nuisance)
    planes = tuple(plane.plane for plane in fit.planes)
    found = [with_slope(_emittance, p.core, jnp.asarray(theta), _named(plane)) for plane in planes]
    return Information(
        jacobian,
        np.array([float(v[0]) for v, _ in found]),
        np.array([np.asarray(s)[0] for _, s in found]),
        ~p.nuisance & ~held,
        p.lower,
        p.upper,
        held,
        np.isin(np.array(p.names), [prior.name for prior in p.priors]),
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
