"""The posterior of a scan: σ of each plane, flat over all that are positive definite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.errors import InputError
from beamfit.greybox.fit import Fit
from beamfit.greybox.posterior import Optimum, Statement, record_of, target_of
from beamfit.greybox.problem import Problem
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.beamline import Beamline
from beamfit.optics.particle import beta_gamma
from beamfit.quantity import Status
from beamfit.sampling.posterior import Expected, Posterior
from beamfit.sampling.priors import Distribution, checked
from beamfit.sampling.target import Target
from beamfit.studies.scan.results import PlaneFit
from beamfit.studies.scan.scans import QuadScan
from beamfit.studies.scan.scenario_data import see
from beamfit.studies.scan.scenario_model import UNIT, sigma_of
from beamfit.verdict import Finding

__all__ = ["beam_target", "expected_sizes"]

CHOLESKY = ("l11", "l21", "l22")
SIGMA = {"sigma11": "m^2", "sigma12": "m rad", "sigma22": "rad^2"}
TWISS = {"emittance": "m", "normalized_emittance": "m", "beta": "m", "alpha": "1", "mismatch": "1"}
OPEN = "the scan does not determine sigma11, sigma12 and sigma22"


class Scanned(Protocol):
    """A fitted scan, of any scenario."""

    planes: tuple[PlaneFit, ...]
    scan: QuadScan
    line: Beamline
    fit: Fit | None
    problem: Problem


def _quoted(model: Mapping[str, Any]) -> dict[str, Any]:
    """σ in SI in the place of its Cholesky factor."""
    beams = model["beam"].items()
    sigmas = {plane: dict(zip(CHOLESKY, sigma_of(beam), strict=True)) for plane, beam in beams}
    return {**model, "beam": sigmas}


def _own(model: Mapping[str, Any]) -> dict[str, Any]:
    """The Cholesky factor of σ again, NaN where it is not positive definite."""
    beams = {}
    for plane, sigma in model["beam"].items():
        s11, s12, s22 = (sigma[name] / UNIT**2 for name in CHOLESKY)
        l11 = jnp.sqrt(s11)
        beams[plane] = {"l11": l11, "l21": s12 / l11, "l22": jnp.sqrt(s22 - s12**2 / s11)}
    return {**model, "beam": beams}


def _beams(model: Mapping[str, Any], data: Any) -> dict[str, Any]:
    """The beam matrix of each plane, and the model, for functions of the user's."""
    parts = model["beam"].items()
    beams = {p: BeamMatrix(*(UNIT * beam[name] for name in CHOLESKY)) for p, beam in parts}
    return {**beams, "model": model}


def _twiss(model: Mapping[str, Any], data: Mapping[str, tuple[Array, ...]]) -> Array:
    """Emittance, normalised emittance, β, α at the start and mismatch, plane after plane."""
    beams, found = _beams(model, data), []
    for plane, (factor, to_design, design) in sorted(data.items()):
        beam = beams[plane]
        mismatch = beam.transport(to_design).mismatch(BeamMatrix.from_twiss(1.0, *design))
        e, twiss = beam.emittance, beam.twiss
        found += [e, factor * e, twiss.beta, twiss.alpha, mismatch]
    return jnp.stack(found)


def beam_target(
    fit: Scanned,
    planes: Sequence[str] | None = None,
    noise: str | None = None,
    outliers: bool | None = None,
    priors: Mapping[str, Distribution] | None = None,
) -> Target:
    """State the posterior of a fitted scan.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.
    planes : sequence of str, optional
        Which; all that were fitted if None.
    noise, outliers, priors
        As of `beamfit.greybox.posterior.target_of`; priors on ``x.sigma11`` and so on. A robust
        fit is sampled with outliers by default.

    Returns
    -------
    Target
        Names ``x.sigma11`` and so on, derived numbers ``x.emittance`` and so on.

    Raises
    ------
    InputError
        If a plane was not fitted, or as `target_of`.

    Notes
    -----
    The likelihood compares what the fit compared, size² or size, so that its maximum is the fit.
    A plane whose scan does not determine σ11, σ12 and σ22 has no posterior unless priors on all
    three give it one; it is left out and named.
    """
    asked = _asked(fit, planes)
    if fit.fit is not None:
        problem, optimum, kept = fit.problem, fit.fit.optimum, asked
    else:
        checked(priors, [f"{p.plane}.{name}" for p in asked for name in SIGMA])
        kept = [p for p in asked if np.isfinite(p.covariance).all() or _given(p, priors)]
        problem, optimum = _of_planes(fit.problem, kept or asked, priors)
    robust = any(p.points.outlier_probability is not None for p in kept)
    return target_of(
        problem,
        optimum,
        _stated(fit, kept, asked),
        noise=noise,
        outliers=robust if outliers is None else outliers,
        priors=priors,
    )


def _asked(fit: Scanned, planes: Sequence[str] | None) -> list[PlaneFit]:
    fitted = [p.plane for p in fit.planes]
    for plane in planes or ():
        if plane not in fitted:
            raise InputError(f"plane '{plane}'", f"one that was fitted: {', '.join(fitted)}")
    if fit.fit is not None and planes is not None and list(planes) != fitted:
        expected = f"all that were fitted, {', '.join(fitted)}: they have their unknowns in common"
        raise InputError(f"planes {', '.join(planes)} alone", expected)
    return [p for p in fit.planes if planes is None or p.plane in planes]


def _given(p: PlaneFit, priors: Mapping[str, Distribution] | None) -> bool:
    """Whether priors on all three numbers make a posterior in any case."""
    return all(f"{p.plane}.{name}" in (priors or {}) for name in SIGMA)


def _of_planes(
    problem: Problem, chosen: Sequence[PlaneFit], priors: Mapping[str, Distribution] | None
) -> tuple[Problem, Optimum]:
    """The problem of some planes, and where to begin: the fit, or else the priors."""
    parts = [f"beam.{p.plane}." for p in chosen]
    own = replace(
        problem,
        model={"beam": {p.plane: problem.model["beam"][p.plane] for p in chosen}},
        free=[f for f in problem.free if any(f.path.startswith(part) for part in parts)],
        records=[r for r in problem.records if r.data.plane in [p.plane for p in chosen]],
    )
    begin = {}
    for p in chosen:
        s11, s12, s22 = (q.value / UNIT**2 for q in p.sigma)
        if not np.isfinite(p.covariance).all() and _given(p, priors):
            means = (priors[f"{p.plane}.{name}"].mean() for name in SIGMA)
            s11, s12, s22 = (mean / UNIT**2 for mean in means)
        l11 = np.sqrt(max(s11, 1e-6))
        # Walkers begin a little off zero emittance, which is an edge.
        l22 = np.sqrt(max(s22 - (s12 / l11) ** 2, 1e-4 * max(s22, 1e-6)))
        begin |= {f"beam.{p.plane}.l11": l11, f"beam.{p.plane}.l21": s12 / l11}
        begin[f"beam.{p.plane}.l22"] = l22
    theta = np.array([begin[name] for name in own.names])
    worst = max(chosen, key=lambda p: p.status is Status.poor_fit)
    scales, given = [p.error_scale for p in chosen], [p.chi2 is not None for p in chosen]
    return own, Optimum(theta, Finding(worst.status, worst.message), scales, given)


def _stated(fit: Scanned, kept: Sequence[PlaneFit], asked: Sequence[PlaneFit]) -> Statement:
    chosen = kept or asked
    line, energy = fit.line, fit.scan.energy
    works = see(fit.scan, line, [p.plane for p in chosen], chosen[0].method).works
    factor = beta_gamma(float(line.energy if energy is None else np.mean(energy)), line.mass)
    data, hidden = {}, []
    for p in chosen:
        twiss = getattr(line.design, p.plane, None)
        to_design = works[p.plane].given.to_design[:2, :2]
        data[p.plane] = (np.asarray(factor), to_design, np.asarray(twiss or (1.0, 0.0)))
        hidden += [] if twiss else [f"{p.plane}.mismatch"]
    doubtful = [
        f"{p.plane}.{name}"
        for p in chosen
        for name in TWISS
        if (q := getattr(p, name)) is not None and q.error is None
    ]
    lost = ", ".join(f"{p.plane} plane" for p in asked if p not in kept)
    names = [(p.plane, name) for p in chosen for name in SIGMA]
    cholesky = [name for _ in chosen for name in CHOLESKY]
    return Statement(
        derived={f"{p.plane}.{name}": unit for p in chosen for name, unit in TWISS.items()},
        derive=_twiss,
        build=_beams,
        data=data,
        quoted=_quoted,
        own=_own,
        renamed={
            f"beam.{plane}.{own}": f"{plane}.{name}"
            for (plane, name), own in zip(names, cholesky, strict=True)
        },
        units={f"{plane}.{name}": SIGMA[name] for plane, name in names},
        lower={f"{plane}.{name}": 0.0 for plane, name in names if name != "sigma12"},
        labels={f"size {p.plane}": p.plane for p in chosen},
        priors_own=doubtful,
        hidden=hidden,
        remark=f"Left out: the {lost}, because {OPEN}." if kept and lost else "",
        nothing="" if kept else f"{OPEN} in the {lost}; {chosen[0].message}",
    )


def expected_sizes(posterior: Posterior, fit: Scanned, plane: str) -> Expected:
    """Sizes that the posterior of a scan expects, m.

    Parameters
    ----------
    posterior : Posterior
        Of `EmittanceFit.sample`.
    fit : EmittanceFit
        The fit.
    plane : str
        "x" or "y".
    """
    record = record_of(posterior.target, f"size {plane}")
    squared = fit.planes[0].method == "size_squared"

    def sizes(drawn: Mapping[str, Any]) -> Array:
        found = record.predict(drawn["model"], record.data)
        return 1e-6 * (jnp.sqrt(found) if squared else found)

    # Of size²: 2 x dx.
    slope = 2.0 * np.sqrt(record.measured) if squared else 1.0
    return posterior.expected(sizes, 1e-6 * np.asarray(record.error) / slope, plane)
