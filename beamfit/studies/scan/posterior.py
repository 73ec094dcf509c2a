"""The posterior of beam matrices: σ of each plane, flat over all that are positive definite."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.greybox.posterior import LAW, Sampled, target_of
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.particle import beta_gamma
from beamfit.quantity import Status
from beamfit.sampling.likelihood import Group, Likelihood
from beamfit.sampling.priors import Distribution, checked
from beamfit.sampling.target import Derived, Law, Target
from beamfit.studies.scan.model import UNIT, size_squared
from beamfit.studies.scan.results import PlaneFit

__all__ = ["Sizes", "beam_target", "scenario_target"]

NAMES, UNITS = ("sigma11", "sigma12", "sigma22"), ("m^2", "m rad", "rad^2")
TWISS = {"emittance": "m", "normalized_emittance": "m", "beta": "m", "alpha": "1", "mismatch": "1"}


class Sizes(NamedTuple):
    """What was measured in one plane; arrays of shape (n,).

    Attributes
    ----------
    r11, r12 : Array
        Transfer-matrix elements, start to screen (R12 in m).
    known : Array
        Size² in m² that is not due to σ.
    size, error : Array
        Rms size and its standard error, m.
    factor : Array
        βγ.
    to_design : Array
        Shape (2, 2), start to where the design holds.
    design : Array
        Shape (2,): design β (m) and α.
    """

    r11: Array
    r12: Array
    known: Array
    size: Array
    error: Array
    factor: Array
    to_design: Array
    design: Array

    def squared(self, sigma: Array) -> Array:
        """Size² of a beam matrix at every point (report equation 37)."""
        return size_squared(sigma, self.r11, self.r12, self.known)


# The planes by name; a name in a mapping is structure to JAX, so that each pair compiles once.
Planes = dict[str, Sizes]


def _sigmas(data: Planes, theta: Array) -> list[tuple[Sizes, Array]]:
    return [(data[plane], theta[3 * i : 3 * i + 3]) for i, plane in enumerate(sorted(data))]


def residual_squared(data: Planes, theta: Array) -> tuple[Array, ...]:
    """Of size², with the error 2 x dx (the report's ``error_linear``)."""
    return tuple(
        (plane.squared(sigma) - plane.size**2) / (2.0 * plane.size * plane.error)
        for plane, sigma in _sigmas(data, theta)
    )


def residual_size(data: Planes, theta: Array) -> tuple[Array, ...]:
    """Of the size (the report's ``error_nonlinear``)."""
    return tuple(
        (jnp.sqrt(jnp.maximum(plane.squared(sigma), 1e-30)) - plane.size) / plane.error
        for plane, sigma in _sigmas(data, theta)
    )


def positive_definite(data: Planes, theta: Array) -> Array:
    """Flat where every σ is positive definite, nothing elsewhere."""
    inside = jnp.asarray(True)
    for _, (s11, s12, s22) in _sigmas(data, theta):
        inside &= (s11 > 0) & (s22 > 0) & (s11 * s22 > s12 * s12)
    return jnp.where(inside, 0.0, -jnp.inf)


def beams(data: Planes, theta: Array) -> dict[str, BeamMatrix]:
    """The beam matrix of each plane."""
    pairs = zip(sorted(data), _sigmas(data, theta), strict=True)
    return {name: BeamMatrix.from_sigma(*sigma) for name, (_, sigma) in pairs}


def twiss_numbers(data: Planes, theta: Array) -> Array:
    """Emittance, normalised emittance, β, α at the start and mismatch, plane after plane."""
    found = []
    for name, beam in beams(data, theta).items():
        plane, twiss = data[name], beam.twiss
        ideal = BeamMatrix.from_twiss(1.0, plane.design[0], plane.design[1])
        mismatch = beam.transport(plane.to_design).mismatch(ideal)
        emittance = beam.emittance
        found += [emittance, plane.factor * emittance, twiss.beta, twiss.alpha, mismatch]
    return jnp.stack(found)


LAWS = {
    "size_squared": Law(residual_squared, positive_definite, twiss_numbers, beams),
    "size": Law(residual_size, positive_definite, twiss_numbers, beams),
}


def beam_target(
    fit: Any,
    planes: tuple[str, ...] | None = None,
    noise: str | None = None,
    outliers: bool | None = None,
    priors: Mapping[str, Distribution] | None = None,
) -> Target:
    """State the posterior of a fitted scan.

    Parameters
    ----------
    fit : Any
        The fit.
    planes : tuple of str, optional
        Which; all that were fitted if None.
    noise : {"known", "inferred"}, optional
        None: of each plane inferred where the scan has no errors or the fit enlarged them, else
        known.
    outliers : bool, optional
        None: as the fit was robust or not.
    priors : mapping of str to distribution, optional
        On numbers such as ``x.sigma11``, besides the flat prior.

    Returns
    -------
    Target
        Names ``x.sigma11`` and so on, derived numbers ``x.emittance`` and so on.

    Raises
    ------
    InputError
        If a plane was not fitted, an option is not understood, or a prior's name is not known.

    Notes
    -----
    The likelihood compares what the fit compared, size² or size, so that its maximum is the fit.
    A plane whose scan does not determine σ11, σ12 and σ22 has no posterior unless priors on all
    three give it one; it is left out and named.
    """
    asked = _planes(fit, planes)
    every = tuple(f"{p.plane}.{name}" for p in asked for name in NAMES)
    priors = checked(priors, every)
    kept = [p for p in asked if np.isfinite(p.covariance).all() or _given(p, priors)]
    lost = ", ".join(f"{p.plane} plane" for p in asked if p not in kept)
    chosen = kept or asked
    data = {p.plane: _sizes(fit, p) for p in chosen}
    groups = tuple(_group(p, noise, outliers) for p in chosen)
    names = tuple(f"{p.plane}.{name}" for p in chosen for name in NAMES)
    spread = [_start(p, priors) for p in chosen]
    covariance = np.zeros((len(names),) * 2)
    for i, (_, part) in enumerate(spread):
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = part
    words = "the scan does not determine sigma11, sigma12 and sigma22"
    worst = max(chosen, key=lambda p: p.status is Status.poor_fit)
    return Target(
        law=LAWS[chosen[0].method],
        data=data,
        names=names,
        units=UNITS * len(chosen),
        lower=np.tile([0.0, -np.inf, 0.0], len(chosen)),
        upper=np.full(len(names), np.inf),
        mode=np.concatenate([mode for mode, _ in spread]),
        covariance=covariance,
        likelihood=Likelihood(groups),
        noise=tuple(p.error_scale for p in chosen),
        priors=priors,
        derived=_derived(fit, chosen),
        observed=_observed(chosen, data),
        priors_own=_open(chosen, kept),
        open_directions="" if kept else f"{words} in the {lost}; {chosen[0].message}",
        verdict=(worst.status.value, worst.message),
        hidden=_without_design(fit, chosen),
        group_of=tuple(i for i in range(len(chosen)) for _ in NAMES),
        remark=f"Left out: the {lost}, because {words}." if kept and lost else "",
    )


def _planes(fit: Any, planes: tuple[str, ...] | None) -> list[PlaneFit]:
    fitted = [p.plane for p in fit.planes]
    for plane in planes or ():
        if plane not in fitted:
            raise InputError(f"plane '{plane}'", f"one that was fitted: {', '.join(fitted)}")
    return [p for p in fit.planes if planes is None or p.plane in planes]


def _given(p: PlaneFit, priors: Mapping[str, Distribution]) -> bool:
    """Whether priors on all three numbers make a posterior in any case."""
    return all(f"{p.plane}.{name}" in priors for name in NAMES)


def _start(p: PlaneFit, priors: Mapping[str, Distribution]) -> tuple[np.ndarray, np.ndarray]:
    """Where to begin and how wide: the fit, or else the priors."""
    if np.isfinite(p.covariance).all():
        return np.array([q.value for q in p.sigma]), p.covariance * p.error_scale**2
    if not _given(p, priors):
        return np.array([q.value for q in p.sigma]), np.eye(3)
    own = [priors[f"{p.plane}.{name}"] for name in NAMES]
    return np.array([q.mean() for q in own]), np.diag([float(q.std()) ** 2 for q in own])


def _sizes(fit: Any, p: PlaneFit) -> Sizes:
    look, i = fit.seen.look, "xy".index(p.plane)
    given = fit.scan.error.get(p.plane)
    # A robust fit widened the errors of points it doubts; a mixture does its own doubting.
    stated = p.points.size if given is None else given[fit.seen.measured(p.plane)]
    error = stated if p.points.outlier_probability is not None else p.points.error
    design = getattr(fit.line.design, p.plane, None) or (1.0, 0.0)
    return Sizes(
        r11=p.points.r11,
        r12=p.points.r12,
        known=p.points.known,
        size=p.points.size,
        error=np.nan_to_num(error, nan=1.0),
        factor=np.asarray(float(beta_gamma(fit.seen.energy(p.plane), fit.line.mass))),
        to_design=look.to_design[i, :2, :2],
        design=np.array([float(v) for v in design]),
    )


def _group(p: PlaneFit, noise: str | None, outliers: bool | None) -> Group:
    robust = p.points.outlier_probability is not None
    if noise is None:
        noise = "inferred" if p.chi2 is None or p.error_scale > 1 else "known"
    return Group(p.plane, noise, robust if outliers is None else outliers)


def _derived(fit: Any, chosen: list[PlaneFit]) -> Derived:
    names = tuple(f"{p.plane}.{name}" for p in chosen for name in TWISS)
    return Derived(names, tuple(TWISS.values()) * len(chosen))


def _without_design(fit: Any, chosen: list[PlaneFit]) -> tuple[str, ...]:
    return tuple(f"{p.plane}.mismatch" for p in chosen if p.mismatch is None)


def _open(chosen: list[PlaneFit], kept: list[PlaneFit]) -> tuple[str, ...]:
    """Twiss numbers that positive definiteness decides where the scan does not."""
    doubtful = [p for p in chosen if not p.identifiability.determined or p not in kept]
    return tuple(f"{p.plane}.{name}" for p in doubtful for name in TWISS)


def _observed(chosen: list[PlaneFit], data: Planes) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for p in chosen:
        found |= {f"{p.plane} {n} setting": v for n, v in p.points.settings.items()}
        found[f"{p.plane} screen"] = np.array(p.points.screen)
        found[f"{p.plane} size m"] = np.asarray(data[p.plane].size)
        found[f"{p.plane} error m"] = np.asarray(data[p.plane].error)
    return found


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
    fit: Any,
    noise: str | None,
    outliers: bool | None,
    priors: Mapping[str, Distribution] | None,
) -> Target:
    """State the posterior of a scenario, all planes together.

    Parameters
    ----------
    fit : Any
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
    plain = target_of(fit.fit, noise, bool(outliers), priors)
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
