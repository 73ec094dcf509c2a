"""The posterior of a scenario: the beam and what else is unknown, drawn together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox import tree
from beamfit.greybox.posterior import LAW, Sampled
from beamfit.optics.particle import beta_gamma
from beamfit.sampling.priors import Distribution
from beamfit.sampling.target import Derived, Law, Target
from beamfit.studies.scan.scenario_model import UNIT

if TYPE_CHECKING:
    from beamfit.studies.scan.fit import EmittanceFit

__all__ = ["TWISS", "scenario_target"]

TWISS = {"emittance": "m", "normalized_emittance": "m", "beta": "m", "alpha": "1"}


@tree.node()
class _Data:
    """A sampled problem, and the factor to normalised emittance of each plane."""

    sampled: Sampled
    factor: dict[str, Any]


def _beams(data: _Data, theta: Array) -> dict[str, Any]:
    return LAW.build(data.sampled, theta)["beam"]


def _residual(data: _Data, theta: Array) -> tuple[Array, ...]:
    return LAW.residual(data.sampled, theta)


def _log_prior(data: _Data, theta: Array) -> Array:
    """The problem's own priors, and a beam that is flat in σ and not in its Cholesky factor.

    With σ11 = l11², σ12 = l11 l21 and σ22 = l21² + l22² the determinant of the change of
    variables is 4 l11² l22.
    """
    volume = jnp.zeros(())
    for beam in _beams(data, theta).values():
        volume += 2 * jnp.log(jnp.abs(beam["l11"])) + jnp.log(jnp.abs(beam["l22"]))
    return LAW.log_prior(data.sampled, theta) + volume


def _derive(data: _Data, theta: Array) -> Array:
    """Emittance, normalised emittance, β and α of each plane from its Cholesky factor."""
    found = []
    for plane, beam in sorted(_beams(data, theta).items()):
        emittance = UNIT**2 * beam["l11"] * beam["l22"]
        found += [emittance, data.factor[plane] * emittance]
        found += [beam["l11"] / beam["l22"], -beam["l21"] / beam["l22"]]
    return jnp.stack(found)


def _build(data: _Data, theta: Array) -> Any:
    return LAW.build(data.sampled, theta)


_LAW = Law(_residual, _log_prior, _derive, _build)


def scenario_target(
    fit: EmittanceFit,
    noise: str | None,
    outliers: bool | None,
    priors: Mapping[str, Distribution] | None,
) -> Target:
    """State the posterior of a scenario, all planes together.

    Parameters
    ----------
    fit : EmittanceFit
        Of any scenario but "known".
    noise, outliers, priors
        As `beamfit.greybox.fit.Fit.sample`.

    Returns
    -------
    Target
        Of the problem's numbers; ``x.emittance``, ``x.normalized_emittance``, ``x.beta`` and
        ``x.alpha`` are derived, and the prior's own where the
        fit gives them no error.

    Raises
    ------
    InputError
        As `Fit.sample`.
    """
    plain = fit.fit.target(noise, bool(outliers), priors)
    planes = sorted(p.plane for p in fit.planes)
    energy = np.mean(fit.scan.energy) if fit.scan.energy is not None else fit.line.energy
    factor = {plane: jnp.asarray(beta_gamma(float(energy), fit.line.mass)) for plane in planes}
    names = tuple(f"{plane}.{name}" for plane in planes for name in TWISS)
    open_ones = tuple(
        f"{p.plane}.{name}" for p in fit.planes for name in TWISS if getattr(p, name).error is None
    )
    own = plain.likelihood.names
    count = len(plain.names) - len(own)
    return replace(
        plain,
        law=_LAW,
        data=_Data(plain.data, factor),
        names=plain.names[:count],
        units=plain.units[:count],
        lower=plain.lower[:count],
        upper=plain.upper[:count],
        mode=plain.mode[:count],
        covariance=plain.covariance[:count, :count],
        derived=Derived(names, tuple(TWISS.values()) * len(planes)),
        priors_own=(*plain.priors_own, *open_ones),
        hidden=(*plain.hidden, *(n for n in plain.names if n.startswith("beam."))),
    )
