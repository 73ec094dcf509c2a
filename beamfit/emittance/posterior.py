"""Posterior of a scan for the sampler: the fit's, averaged over the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.emittance.beam_draws import LN_T_SPREAD
from beamfit.emittance.model import (
    QUANTITIES,
    SIGMA,
    UNIT,
    AnswerPlaces,
    model_quantities,
    sigma_of,
    size_squared,
    user_name,
)
from beamfit.emittance.results import PlaneFit
from beamfit.emittance.statement import (
    PreparedScan,
    Scanned,
    cholesky_numbers,
    problem_places,
    size_records,
)
from beamfit.errors import Finding, InputError
from beamfit.greybox import tree
from beamfit.greybox.posterior import Optimum, Statement, predicted, target_of
from beamfit.greybox.problem import Problem
from beamfit.noise.model import Noise
from beamfit.noise.sizes import NoiseKind, Scales, log_average, log_likelihood
from beamfit.optics.beam import BeamMatrix
from beamfit.quantity import Status
from beamfit.sampling.posterior import Expected, Posterior
from beamfit.sampling.priors import Distribution
from beamfit.sampling.target import SamplingTarget

# Names of the Cholesky factor in a model, and of the derived quantities in a posterior.
CHOLESKY = ("l11", "l21", "l22")
TWISS = ("emittance", "normalized_emittance", "beta", "alpha", "mismatch")
TWISS_POSITIONS = np.array([list(QUANTITIES).index(name) for name in TWISS])
UNDETERMINED = "the scan does not determine sigma11, sigma12 and sigma22"


def _with_sigma(model: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the Cholesky factor of each beam by σ in SI."""
    beams = model["beam"].items()
    sigmas = {plane: dict(zip(CHOLESKY, sigma_of(beam), strict=True)) for plane, beam in beams}
    return {**model, "beam": sigmas}


def _with_cholesky(model: Mapping[str, Any]) -> dict[str, Any]:
    """Replace σ of each beam by its Cholesky factor; NaN if σ is not positive definite."""
    beams = {}
    for plane, sigma in model["beam"].items():
        s11, s12, s22 = (sigma[name] / UNIT**2 for name in CHOLESKY)
        l11 = jnp.sqrt(s11)
        beams[plane] = {"l11": l11, "l21": s12 / l11, "l22": jnp.sqrt(s22 - s12**2 / s11)}
    return {**model, "beam": beams}


@tree.node("plane", "noise")
class PlaneLikelihood:
    """Data for the likelihood of a plane: rows, measured sizes, and noise.

    ``used`` are the measured rows, ``size`` is in units of ``unit`` (m), and ``trace @ sigma`` is
    the T of the beam's prior.
    """

    plane: str
    noise: Noise
    rows: Any
    used: Any
    size: Any
    unit: Any
    trace: Any
    kinds: tuple[NoiseKind, ...]
    scales: tuple[Scales, ...]

    def log_density(self, model: Mapping[str, Any]) -> Array:
        """Log likelihood of the sizes, averaged over the noise, plus the log prior of the beam."""
        sigma = sigma_of(model["beam"][self.plane])
        squared = size_squared(sigma, *(v[self.used] for v in self.rows.elements(model)))
        size = jnp.sqrt(jnp.maximum(squared, 1e-300))[None] / self.unit
        residual, parts = self.size[None] - size, []
        for kind, nodes in zip(self.kinds, self.scales, strict=True):
            log = log_likelihood(residual, size, kind, nodes.scale, self.noise)[0]
            parts.append(log_average(log, nodes.log_weight) + kind.log_weight)
        log_t = jnp.log(jnp.maximum(self.trace @ sigma, 1e-300))
        determinant = jnp.maximum(sigma[0] * sigma[2] - sigma[1] ** 2, 1e-300)
        prior = -2.0 * log_t - 0.5 * (log_t / LN_T_SPREAD) ** 2 - 0.5 * jnp.log(determinant)
        return log_average(jnp.stack(parts), 0.0) + prior


class DensityData(NamedTuple):
    """Data of the functions of a scan's statement."""

    places: tuple[AnswerPlaces, ...]
    sizes: tuple[PlaneLikelihood, ...]


def _log_volume(model: Mapping[str, Any], data: DensityData) -> Array:
    """Sum of the planes' log likelihoods, averaged over the noise, and log priors of the beams."""
    return sum((each.log_density(model) for each in data.sizes), jnp.zeros(()))


def _sizes_of(
    problem: Problem, prepared: PreparedScan, planes: Sequence[str]
) -> tuple[PlaneLikelihood, ...]:
    """Data for the likelihood of each plane."""
    records, found = size_records(problem), []
    for plane in planes:
        solution = prepared.solutions[plane]
        post = solution.posterior
        at, size = prepared.measured(plane), solution.sizes.size / post.unit
        likelihood_data = (
            records[plane].data,
            at,
            size,
            post.unit,
            post.trace,
            post.kinds,
            post.scales,
        )
        found.append(PlaneLikelihood(plane, prepared.noise.of_points(len(size)), *likelihood_data))
    return tuple(found)


def _beams(model: Mapping[str, Any], data: DensityData) -> dict[str, Any]:
    """Beam matrix of each plane, and the model, for functions of users."""
    parts = model["beam"].items()
    beams = {p: BeamMatrix(**{name: UNIT * beam[name] for name in CHOLESKY}) for p, beam in parts}
    return {**beams, "model": model}


def _twiss(model: Mapping[str, Any], data: DensityData) -> Array:
    """Emittance, normalised emittance, β, α at the start and mismatch, plane after plane."""
    return jnp.concatenate([model_quantities(model, p)[TWISS_POSITIONS] for p in data.places])


def beam_target(
    fit: Scanned,
    planes: Sequence[str] | None = None,
    priors: Mapping[str, Distribution] | None = None,
) -> SamplingTarget:
    """State the posterior of a fitted scan for the sampler.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.
    planes : sequence of str, optional
        Planes to sample; all that were fitted if None.
    priors
        As in `beamfit.greybox.posterior.target_of`; on ``x.sigma11`` and so on, in addition to the
        fit's own.

    Returns
    -------
    SamplingTarget
        Names ``x.sigma11`` and so on, derived numbers ``x.emittance`` and so on.

    Raises
    ------
    InputError
        If a plane was not fitted, or as `target_of`.

    Notes
    -----
    Likelihood and prior are those of the fit, averaged over noise and bad readings. With known
    transport, a plane whose scan does not determine σ11, σ12 and σ22 is left out and named, unless
    priors on all three determine them.
    """
    chosen = _chosen_planes(fit, planes)
    if fit.solved is not None:
        problem, optimum, kept = fit.solved.problem, fit.solved.optimum, chosen
    else:
        given = [p for p in chosen if all(f"{p.plane}.{name}" in (priors or {}) for name in SIGMA)]
        kept = [p for p in chosen if np.isfinite(p.covariance).all() or p in given]
        names = tuple(p.plane for p in kept or chosen)
        problem = fit.statement.state(fit.seen._replace(planes=names), fit.told)
        optimum = _optimum(problem.names, kept or chosen, given, priors or {})
    return target_of(
        problem, optimum, _sampling_statement(problem, fit, kept, chosen), priors=priors
    )


def _chosen_planes(fit: Scanned, planes: Sequence[str] | None) -> list[PlaneFit]:
    """Fits of the chosen planes; raises an error for planes that were not fitted."""
    fitted = [p.plane for p in fit.planes]
    for plane in planes or ():
        if plane not in fitted:
            raise InputError(f"plane '{plane}'", f"one that was fitted: {', '.join(fitted)}")
    if fit.solved is not None and planes is not None and list(planes) != fitted:
        expected = f"all that were fitted, {', '.join(fitted)}: their unknowns are common"
        raise InputError(f"planes {', '.join(planes)} of this scenario", expected)
    return [p for p in fit.planes if planes is None or p.plane in planes]


def _optimum(
    names: Sequence[str],
    chosen: Sequence[PlaneFit],
    given: Sequence[PlaneFit],
    priors: Mapping[str, Distribution],
) -> Optimum:
    """Starting point from the fit or the priors, kept away from the bound at zero emittance."""
    start = {}
    for p in chosen:
        sigma = [q.value for q in p.sigma]
        if not np.isfinite(p.covariance).all() and p in given:
            sigma = [priors[f"{p.plane}.{name}"].mean() for name in SIGMA]
        numbers = cholesky_numbers(sigma, 1e-4)
        start |= {f"beam.{p.plane}.{name}": value for name, value in numbers.items()}
    theta = np.array([start[name] for name in names])
    worst = max(chosen, key=lambda p: p.status is Status.poor_fit)
    return Optimum(
        theta, Finding(worst.status, worst.message), [1.0] * len(chosen), [True] * len(chosen)
    )


def _sampling_statement(
    problem: Problem, fit: Scanned, kept: Sequence[PlaneFit], requested: Sequence[PlaneFit]
) -> Statement:
    """Functions and names of the posterior, with remarks on planes left out."""
    chosen = kept or requested
    planes = [p.plane for p in chosen]
    places = problem_places(problem, fit.seen, planes, fit.statement.whole_map)
    twiss = {(p.plane, name): getattr(p, name) for p in chosen for name in TWISS}
    missing = ", ".join(f"{p.plane} plane" for p in requested if p not in kept)
    sigmas = [f"{p.plane}.{name}" for p in chosen for name in SIGMA]
    factors = [f"beam.{p.plane}.{name}" for p in chosen for name in CHOLESKY]
    labels = {f"size {p.plane}": p.plane for p in chosen}
    # Names of calibration parameters for users, such as Q2.slope.
    renamed = {name: user_name(name) for name in problem.names}
    return Statement(
        derived={f"{plane}.{name}": QUANTITIES[name] for plane, name in twiss},
        derive=_twiss,
        build=_beams,
        data=DensityData(places, _sizes_of(problem, fit.seen, planes)),
        log_volume=_log_volume,
        averaged=[f"size {plane}" for plane in planes],
        quoted=_with_sigma,
        own=_with_cholesky,
        renamed=renamed | dict(zip(factors, sigmas, strict=True)),
        units={name: QUANTITIES[name.split(".")[1]] for name in sigmas},
        lower={f"{p.plane}.{name}": 0.0 for p in chosen for name in ("sigma11", "sigma22")},
        labels=labels,
        trusted=[record.name for record in problem.records if record.name not in labels],
        priors_own=[f"{p}.{name}" for (p, name), q in twiss.items() if q and q.error is None],
        hidden=[f"{plane}.{name}" for (plane, name), q in twiss.items() if q is None],
        remark=f"Left out: the {missing}, because {UNDETERMINED}." if kept and missing else "",
        nothing="" if kept else f"{UNDETERMINED} in the {missing}; {chosen[0].message}",
    )


def expected_sizes(posterior: Posterior, plane: str) -> Expected:
    """Expected sizes, m, at the points of a plane, from the posterior of a scan.

    Parameters
    ----------
    posterior : Posterior
        From `EmittanceFit.sample`.
    plane : str
        "x" or "y".
    """
    draws, measured, error = predicted(posterior, f"size {plane}")
    records = {record.name: record for record in posterior.target.data.core.records}
    if records[f"size {plane}"].data.squared:  # the error of size² is 2 x dx
        draws, error = np.sqrt(draws), error / (2.0 * np.sqrt(measured))
    return posterior.expected(1e-6 * draws, 1e-6 * error, plane)
