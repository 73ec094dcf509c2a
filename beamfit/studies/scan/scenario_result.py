"""From the grey-box fit of a scenario to a judged emittance for each plane."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox import tree
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Problem
from beamfit.optics.beamline import Beamline
from beamfit.optics.particle import beta_gamma
from beamfit.quantity import Quantity, Status
from beamfit.statistics import chi2_probability, scaled_directions
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.results import Identifiability, Parameter, PlaneFit, Points, ScreenTwiss
from beamfit.studies.scan.scenario_data import Seen
from beamfit.studies.scan.scenario_judged import Found, Judged, judged
from beamfit.studies.scan.scenario_model import line_of, network_elements, row_elements, sigma_of
from beamfit.studies.scan.scenario_parameters import parameters_of
from beamfit.studies.scan.scenario_verdict import verdicts_on
from beamfit.studies.scan.scenario_words import null_directions, verdict_words
from beamfit.studies.scan.sigma import emittance_parts
from beamfit.studies.scan.transport import own_settings, own_units
from beamfit.studies.scan.verdict import CLEAR, POOR_FIT, Verdict, few_words, phase_coverage

__all__ = ["result_of"]


def result_of(
    seen: Seen, scenario: str, told: Assumptions, stated: Problem, fit: Fit
) -> EmittanceFit:
    """Make the result of a scenario.

    Parameters
    ----------
    seen : Seen
        The scan.
    scenario : str
        Which scenario.
    told : Assumptions
        What it was told.
    stated : Problem
        The problem, starting from first principles.
    fit : Fit
        The trained problem.

    Returns
    -------
    EmittanceFit
        With the line as fitted, the fitted parameters and the directions left open.
    """
    j = judged(fit)
    line = line_of(fit.model, seen.scanned)
    parameters = parameters_of(seen, scenario, told, j)
    points = {plane: _points(seen, plane, fit) for plane in seen.works}
    verdicts = verdicts_on(seen, points)
    planes = tuple(
        _plane(seen, scenario, told, j, plane, line, parameters, points[plane], verdicts[plane])
        for plane in seen.works
    )
    return EmittanceFit(
        planes,
        seen.scan,
        line,
        scenario=scenario,
        anchor=told.anchor.words,
        parameters=parameters,
        null_directions=null_directions(scenario, told, planes, parameters),
        fit=fit,
        stated=stated,
    )


@tree.node("plane", "last", "design", "has_transport")
class _Places:
    """Where the beam of a plane is asked for: at the last screen and at the design's place."""

    plane: str
    last: str
    design: str | None
    has_transport: bool
    line: Beamline
    twiss: Any


def _places(seen: Seen, scenario: str, plane: str) -> _Places:
    design = seen.scanned.design
    twiss = getattr(design, plane, None)
    last = seen.works[plane].given.last_screen
    known = scenario != "transport-network"  # C and D are unknown there
    return _Places(plane, last, design.at if twiss else None, known, seen.scanned, twiss)


def _numbers(model: Any, at: _Places) -> Array:
    """ε, β, α, σ11, σ12, σ22 at the start, β, α, size at the screen, BMAG to the design."""
    sigma = sigma_of(model["beam"][at.plane])
    start = [emittance_parts(sigma), sigma]
    if not at.has_transport:
        return jnp.concatenate([*start, jnp.full(4, jnp.nan)])
    places = tuple(dict.fromkeys((at.last, at.design) if at.design else (at.last,)))
    found = line_of(model, at.line).matrices(places)
    e = start[0][0]
    s11, s12, _ = _carried(getattr(found[at.last], at.plane), sigma)
    screen = [s11 / e, -s12 / e, jnp.sqrt(s11)]
    mismatch = jnp.asarray(jnp.nan)
    if at.design:
        d11, d12, d22 = _carried(getattr(found[at.design], at.plane), sigma)
        beta, alpha = at.twiss
        mismatch = 0.5 * ((1.0 + alpha**2) / beta * d11 + 2.0 * alpha * d12 + beta * d22) / e
    return jnp.concatenate([*start, jnp.stack([*screen, mismatch])])


def _carried(matrix: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """σ at a place: R σ Rᵀ (report eq. 36)."""
    (a, b), (c, d) = matrix[0, :2], matrix[1, :2]
    s11, s12, s22 = sigma
    return (
        a**2 * s11 + 2 * a * b * s12 + b**2 * s22,
        a * c * s11 + (a * d + b * c) * s12 + b * d * s22,
        c**2 * s11 + 2 * c * d * s12 + d**2 * s22,
    )


def _plane(
    seen: Seen,
    scenario: str,
    told: Assumptions,
    j: Judged,
    plane: str,
    line: Beamline,
    parameters: tuple[Parameter, ...],
    points: Points,
    on_sizes: Verdict,
) -> PlaneFit:
    work, fit = seen.works[plane], j.fit
    n = j.quantities(_numbers, _places(seen, scenario, plane))
    known_noise = work.evidence.noise_known
    distance = float(n.value[0] / (2.0 * n.error[0])) if n.error[0] > 0 else 0.0
    found = j.settled and fit.status not in (Status.not_finite, Status.infeasible)
    clear = bool(n.known[0]) and distance >= CLEAR
    determined = clear and found and on_sizes.cause is None

    def quantity(i: int, unit: str, factor: float = 1.0) -> Quantity:
        value = float(n.value[i] * factor)
        if not (determined and n.known[i]):
            return Quantity(value, None, unit)
        return Quantity(value, float(n.error[i] * factor), unit, float(n.raw[i] * factor))

    probability = chi2_probability(fit.chi2, fit.dof)
    poor = known_noise and probability is not None and probability < POOR_FIT
    status = Status.unidentified if not determined else Status.converged
    # What the data do not determine has no optimum to settle in: that comes first.
    if not found and (clear or fit.status is not Status.not_converged):
        status = fit.status
    elif determined and poor:
        status = Status.poor_fit
    words = verdict_words(scenario, told, fit, status, distance, parameters, bool(n.known[0]))
    words += few_words(known_noise, work.evidence.dof) if determined else ""
    if clear and found and on_sizes.cause is not None:
        words = f"Not determined in scenario {scenario}: {on_sizes.cause}."
    sigma_known = determined and bool(n.known[3:6].all())
    factor = float(beta_gamma(work.given.energy.mean(), seen.line.mass))
    own = own_settings(line, work.given.last_screen)
    return PlaneFit(
        plane=plane,
        status=status,
        message=words,
        emittance=quantity(0, "m"),
        normalized_emittance=quantity(0, "m", factor),
        beta=quantity(1, "m"),
        alpha=quantity(2, "1"),
        sigma=(quantity(3, "m^2"), quantity(4, "m rad"), quantity(5, "rad^2")),
        screen=ScreenTwiss(
            name=work.given.last_screen,
            settings=own,
            units=own_units(line, work.given.last_screen),
            beta=quantity(6, "m"),
            alpha=quantity(7, "1"),
            size=quantity(8, "m"),
        ),
        mismatch=None if getattr(line.design, plane, None) is None else quantity(9, "1"),
        chi2=fit.chi2 if known_noise else None,
        dof=fit.dof,
        rms_residual=Quantity(
            float(np.sqrt(np.mean((points.size - points.model) ** 2))), None, "m"
        ),
        covariance=n.slope[3:6] @ j.spread.covariance @ n.slope[3:6].T
        if sigma_known
        else np.full((3, 3), np.nan),
        error_scale=fit.scale,
        noise="given" if known_noise else "inferred from the fit with known transport",
        method=work.method,
        identifiability=_identifiability(seen, j, plane, points, n, determined, distance),
        points=points,
    )


_compiled_elements = jax.jit(row_elements)
_compiled_network = jax.jit(network_elements)


def _points(seen: Seen, plane: str, fit: Fit) -> Points:
    """The points of the known-transport fit, with this fit's model."""
    work, before = seen.works[plane], 0
    for record in fit.problem.records:
        if record.name == f"size {plane}":
            break
        before += record.measured.size
    residual = np.asarray(fit.problem.residual(fit.theta))
    residual = residual[before : before + record.measured.size]
    predicted = np.asarray(record.measured) + residual * np.asarray(record.error)
    model = 1e-6 * (np.sqrt(np.maximum(predicted, 0.0)) if seen.squared else predicted)
    if "map" in fit.model:
        r11, r12 = np.asarray(_compiled_network(fit.model, record.data))[:, :2].T
    else:
        r11, r12 = (np.asarray(v) for v in _compiled_elements(fit.model, record.data)[:2])
    return work.points._replace(model=model, pull=-residual, r11=r11, r12=r12)


def _identifiability(
    seen: Seen, j: Judged, plane: str, points: Points, n: Found, determined: bool, distance: float
) -> Identifiability:
    """Singular values of what is asked for, and the directions left open, in words."""
    p, e = j.fit.problem, seen.works[plane].evidence
    theta = j.fit.theta
    slopes, names, units = [], [], []
    sigma = n.value[3:6]
    scales = [sigma[0], math.sqrt(max(sigma[0] * sigma[2], 0.0)), sigma[2]]
    for i, name in enumerate(("sigma11", "sigma12", "sigma22")):
        slopes.append(n.slope[3 + i])
        names.append(name)
        units.append(scales[i])
    for i, name in enumerate(p.names):
        if not name.startswith("beam.") and not p.nuisance[i] and p.lower[i] < p.upper[i]:
            slopes.append(np.eye(len(theta))[i])
            names.append(name)
            units.append(abs(theta[i]) or 1.0)
    directions = scaled_directions(_marginal(j, np.array(slopes)), np.array(units), names)
    open_ones = directions.undetermined
    if not determined and "emittance" not in open_ones:
        open_ones = (*open_ones, "emittance")
    condition = directions.condition
    return Identifiability(
        determined=determined,
        singular_values=tuple(float(v) for v in directions.singular_values),
        condition=condition if math.isfinite(condition) else None,
        waist_bracketed=e.bracketed,
        phase_coverage=phase_coverage(points.r11, points.r12, *map(float, n.value[1:3])),
        zero_distance=distance,
        undetermined=open_ones,
        next_measurement=None,
    )


def _marginal(j: Judged, slopes: np.ndarray) -> np.ndarray:
    """A Jacobian of the asked numbers alone whose normal matrix is their marginal information.

    The covariance without bounds, S J⁺ J⁺ᵀ Sᵀ, has the inverse square root as its Jacobian;
    directions no residual sees have none of it.
    """
    p = j.fit.problem
    edge = np.array([v.state in ("lower", "upper") for v in j.fit.variables])
    loose = ~((edge & p.nuisance) | (p.lower == p.upper))
    length = np.linalg.norm(j.jacobian[:, loose], axis=0)
    unit = np.where(length > 0, 1.0 / np.where(length > 0, length, 1.0), 1.0)
    _, sizes, rows = np.linalg.svd(j.jacobian[:, loose] * unit, full_matrices=True)
    sizes = np.concatenate([sizes, np.zeros(len(rows) - len(sizes))])
    inverse = 1.0 / np.maximum(sizes, 1e-9 * max(sizes[0], 1e-300))
    half = slopes[:, loose] * unit @ (rows.T * inverse)
    left, spread, _ = np.linalg.svd(half, full_matrices=False)
    return (left / spread).T
