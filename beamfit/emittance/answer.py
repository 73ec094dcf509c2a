"""Result of a plane from its posterior, for all scenarios."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from beamfit.emittance.advice import next_measurement
from beamfit.emittance.comparison import (
    QUANTILES,
    PlanePosterior,
    emittance_quantiles,
    weighted_quantiles,
)
from beamfit.emittance.model import (
    QUANTITIES,
    SIGMA,
    SIGMA_SLICE,
    coefficients,
    phase_coverage,
    place_optics,
    quantities_of,
)
from beamfit.emittance.results import Identifiability, PlaneFit, Points, ScreenTwiss
from beamfit.emittance.statement import PreparedScan, answer_places
from beamfit.emittance.transport import setting_units
from beamfit.emittance.verdict import (
    CARRYING_SHIFT,
    PlaneEvidence,
    noise_remark,
    point_remarks,
    resolution_remark,
    suspect_remark,
    verdict,
    waist_bracketed,
)
from beamfit.errors import Finding, Status
from beamfit.optics.beamline import Beamline
from beamfit.quantity import Quantity
from beamfit.statistics import MIN_EFFECTIVE_DRAWS, Directions, chi2_probability, scaled_directions

# Normalised emittances in m outside this range come from a wrong unit: rings and linacs have 1e-9
# and more, muons before cooling 2e-2; sizes in the wrong unit change them by a factor of a million.
MIN_EMITTANCE, MAX_EMITTANCE = 1e-10, 0.1
# Quantities that have errors even where the emittance is not determined: σ and the screen size.
LINEAR_QUANTITIES = np.isin(list(QUANTITIES), (*SIGMA, "screen_size"))
# Quantities of either sign. The others are positive: further unknowns spread them by a factor.
SIGNED_QUANTITIES = np.isin(list(QUANTITIES), ("alpha", "sigma12", "screen_alpha"))
# βγ, matrices to the screen and to the place of the design, and the design.
Places = tuple[Any, Any, Any, Any]


class BestFit(NamedTuple):
    """Best fit of a plane, with the contribution of a scenario's other unknowns.

    Attributes
    ----------
    value, spread : ndarray
        Shape (11,), in the order of `QUANTITIES`: best values, and standard deviations to add in
        quadrature for the other unknowns.
    covariance : ndarray
        Shape (3, 3), of σ11, σ12, σ22; in a scenario with the errors found.
    directions : Directions
        Directions that the data do not determine.
    dof : float
        Degrees of freedom of the plane's sizes.
    ending, open_cause, remedy, scenario
        As in `PlaneEvidence`; empty where nothing else is unknown.
    remark : str
        Further sentence.
    holds : str
        Contributions that the error includes.
    """

    value: np.ndarray
    spread: np.ndarray
    covariance: np.ndarray
    directions: Directions
    dof: float
    ending: Finding | None = None
    open_cause: str = ""
    remedy: str = ""
    remark: str = ""
    scenario: str = ""
    holds: str = "statistics only"


class Influence(NamedTuple):
    """Point without which the emittance moves most, its place, the shift in errors, and the
    emittance without it (m).
    """

    point: int = 0
    place: str = ""
    shift: float = 0.0
    without: float = math.nan


class PlaneNumbers(NamedTuple):
    """Quantities of a plane in the order of `QUANTITIES`, each of shape (11,).

    ``half`` is half of the central 68 %, ``low`` and ``high`` are the ends of the central 95 %,
    ``raw`` is the error from the stated errors alone.
    """

    value: np.ndarray
    half: np.ndarray
    low: np.ndarray
    high: np.ndarray
    raw: np.ndarray

    @property
    def scale(self) -> float:
        """Error of the emittance over that from the stated errors alone; 1 without them."""
        half, raw = float(self.half[0]), float(self.raw[0])
        return half / raw if math.isfinite(raw) and raw > 0 else 1.0

    def quantities(self, known: np.ndarray, limits: bool) -> list[Quantity]:
        """Quantities with errors where they are known, or with intervals if the model holds."""
        found, rows = [], zip(*(part.tolist() for part in self), strict=True)
        for (value, half, low, high, raw), unit, has_error in zip(
            rows, QUANTITIES.values(), known, strict=True
        ):
            finite = math.isfinite(low) and math.isfinite(high)
            error = half if has_error and finite else None
            raw = raw if error is not None and math.isfinite(raw) else None
            interval = (low, high) if finite and (has_error or limits) else None
            found.append(Quantity(value, error, unit, raw, interval))
        return found


def beam_answers(prepared: PreparedScan) -> tuple[PlaneFit, ...]:
    """Answer for each plane where only the beam is unknown; needs no compilation."""
    found = []
    for plane in prepared.planes:
        posterior, points = prepared.solutions[plane].posterior, prepared.solutions[plane].points
        places = place_optics({}, answer_places(prepared, plane))
        covariance = (
            posterior.stated_covariance
            if np.isfinite(posterior.stated_covariance).all()
            else posterior.covariance
        )
        value, dof = quantities_of(posterior.best, *places), max(len(points.size) - 3, 0)
        best = BestFit(
            value, np.zeros(len(value)), covariance, _directions(points, posterior.best), dof
        )
        found.append(plane_answer(prepared, prepared.line, plane, places, best))
    return tuple(found)


def plane_answer(
    prepared: PreparedScan, line: Beamline, plane: str, places: Places, best: BestFit
) -> PlaneFit:
    """Answer for one plane.

    Parameters
    ----------
    prepared : PreparedScan
        The scan through its line, as fitted.
    line : Beamline
        The line as fitted.
    plane : str
        "x" or "y".
    places : tuple
        Optics of the places that the answer refers to.
    best : BestFit
        Best fit, and the contribution of a scenario.

    Returns
    -------
    PlaneFit
        Errors, half of the central 68 % of the posterior, only for what the data determine.
    """
    solution = prepared.solutions[plane]
    posterior, points = solution.posterior, solution.points
    numbers, carrying = _numbers(posterior, points, places, best)
    evidence = _evidence(prepared, plane, numbers, best)
    needs_advice = (
        not best.scenario
        and evidence.of_a_beam
        and evidence.ending is None
        and not evidence.determined
    )
    advice = next_measurement(prepared, plane) if needs_advice else None
    finding = verdict(
        evidence, _remarks(prepared, plane, evidence, best, carrying, numbers), advice or ""
    )
    holds = evidence.of_a_beam and evidence.ending is None
    with_error = evidence.determined | (LINEAR_QUANTITIES & holds & (not best.scenario))
    emittance, normalized, beta, alpha, s11, s12, s22, *screen, mismatch = numbers.quantities(
        with_error, holds and not evidence.open_cause
    )
    scale = numbers.scale if evidence.determined else 1.0
    covariance = best.covariance if with_error[SIGMA_SLICE].all() else np.full((3, 3), np.nan)
    place = prepared.rows.places[-1]
    settings = {name: float(line[name].setting) for name in line.upto(place).magnets}
    return PlaneFit(
        plane=plane,
        status=finding.status,
        message=finding.message,
        emittance=emittance,
        normalized_emittance=normalized,
        beta=beta,
        alpha=alpha,
        sigma=(s11, s12, s22),
        screen=ScreenTwiss(place, settings, setting_units(line, settings), *screen),
        mismatch=None if getattr(prepared.line.design, plane, None) is None else mismatch,
        chi2=posterior.chi2 if math.isfinite(posterior.chi2) else None,
        dof=round(best.dof),
        rms_residual=Quantity(
            float(np.sqrt(np.mean((points.size - points.model) ** 2))), None, "m"
        ),
        covariance=covariance / scale**2 if best.scenario else covariance,
        error_scale=scale,
        noise=noise_words(posterior.noise, posterior.scale, posterior.relative, points),
        method=prepared.method,
        weights=prepared.weights,
        identifiability=_identifiability(points, numbers, evidence, advice, best.directions),
        points=points,
        holds=best.holds,
    )


def _numbers(
    posterior: PlanePosterior, points: Points, places: Places, best: BestFit
) -> tuple[PlaneNumbers, Influence]:
    """Quantities of a plane, and the point that carries the emittance."""
    low, *ends, high = _quantiles(posterior, places, best.spread)
    half = 0.5 * (ends[2] - ends[0])
    testable = posterior.positive and len(points.size) > 3
    carrying = _influence(points, posterior.best, half[0]) if testable else Influence()
    if carrying.place:
        low, high, half = _extend_to_carrying(low, high, half, best.value, carrying.without)
    raw = np.hypot(_raw_errors(posterior, places), best.spread)
    return PlaneNumbers(best.value, half, low, high, raw), carrying


def _remarks(
    prepared: PreparedScan, plane: str, evidence: PlaneEvidence, best: BestFit, carrying: Influence,
    numbers: PlaneNumbers,
) -> str:  # fmt: skip
    """Further sentences on noise and points."""
    solution = prepared.solutions[plane]
    posterior, points, remarks = solution.posterior, solution.points, [solution.shot_words]
    if evidence.of_a_beam:
        chance = chi2_probability(posterior.chi2, max(len(points.size) - 3, 0))
        by_noise = evidence.determined and not best.scenario and not carrying.place
        enlarged = numbers.scale if by_noise else 1.0
        remarks.insert(0, noise_remark(posterior.noise, posterior.scale, chance, enlarged))
        without = carrying.without * numbers.value[1] / numbers.value[0]
        place = "" if evidence.open_cause else carrying.place
        if place:
            place += _bad_in_other_plane(prepared, plane, carrying.point)
        remarks += point_remarks(points, place, float(without))
    else:
        remarks.append(suspect_remark(points, evidence.beam))
    remarks.append(resolution_remark(points.size, points.known))
    remarks += [best.remark] * evidence.determined
    return " ".join(filter(None, remarks))


def _identifiability(
    points: Points,
    numbers: PlaneNumbers,
    evidence: PlaneEvidence,
    advice: str | None,
    directions: Directions,
) -> Identifiability:
    """Collect the evidence on how well the data determine the plane's emittance."""
    return Identifiability(
        determined=evidence.determined,
        probability=evidence.posterior.probability,
        singular_values=tuple(float(v) for v in directions.singular_values),
        condition=directions.condition if math.isfinite(directions.condition) else None,
        waist_bracketed=evidence.bracketed,
        phase_coverage=phase_coverage(
            points.r11, points.r12, float(numbers.value[2]), float(numbers.value[3])
        ),
        undetermined=(*directions.undetermined, *["emittance"] * (not evidence.determined)),
        next_measurement=advice,
    )


def _quantiles(posterior: PlanePosterior, places: tuple, spread: np.ndarray) -> np.ndarray:
    """Quantiles `QUANTILES` of every quantity, shape (5, 11)."""
    weight = posterior.weight
    with np.errstate(invalid="ignore", divide="ignore"):
        numbers = quantities_of(posterior.sigma.T, *places)
    if spread.any():
        # Normal quantiles at equal steps in golden-ratio order, which is unrelated to the draws'.
        z = ndtri((0.5 + np.arange(len(weight)) * 0.6180339887498949) % 1.0)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            middle = np.abs(numbers @ (weight / weight.sum()))
            scaled = numbers * np.exp(z * (spread / middle)[:, None])
            numbers = np.where(SIGNED_QUANTITIES[:, None], numbers + z * spread[:, None], scaled)
            numbers = np.where(np.isfinite(spread)[:, None], numbers, 0.0)
    emittances = [
        emittance_quantiles(row, weight, posterior.zero_emittance_probability, QUANTILES)
        for row in numbers[:2]
    ]
    others = [weighted_quantiles(row, weight, QUANTILES) for row in numbers[2:]]
    return np.where(np.isfinite(spread), np.array([*emittances, *others]).T, np.nan)


def _extend_to_carrying(
    low: np.ndarray, high: np.ndarray, half: np.ndarray, value: np.ndarray, without: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Extend intervals to the emittance without the point that carries it."""
    shift = without - value[0]  # NaN where the others give no emittance
    reach = np.array([shift, shift * value[1] / value[0]])
    low, high, half = low.copy(), high.copy(), half.copy()
    low[:2] = np.fmin(low[:2], value[:2] + reach)
    high[:2] = np.fmax(high[:2], value[:2] + reach)
    # One of two answers is right. Half of their distance equals the error at the threshold where a
    # point begins to carry the answer.
    half[:2] = np.fmax(half[:2], np.abs(reach) / CARRYING_SHIFT)
    return low, high, half


def _bad_in_other_plane(prepared: PreparedScan, plane: str, point: int) -> str:
    """Name another plane in which the same row is probably bad: both planes share its setting."""
    row = prepared.measured(plane)[point]
    for other, solution in prepared.solutions.items():
        if np.any(solution.posterior.bad[prepared.measured(other) == row] > 0.5):
            return f", which is probably bad in {other}"
    return ""


def _evidence(
    prepared: PreparedScan, plane: str, numbers: PlaneNumbers, best: BestFit
) -> PlaneEvidence:
    """Evidence for the verdict, with too few effective draws or an impossible emittance noted."""
    solution, low, high = prepared.solutions[plane], float(numbers.low[1]), float(numbers.high[1])
    points, causes = solution.points, (best.ending, best.scenario, best.open_cause, best.remedy)
    waist = waist_bracketed(points.settings, points.screen, points.size, points.error)
    evidence = PlaneEvidence(solution.posterior, solution.sizes, low, high, waist, *causes)
    emittance = float(numbers.value[1])
    draws = solution.posterior.effective_draws
    if evidence.determined and draws < MIN_EFFECTIVE_DRAWS and not best.scenario:
        return replace(evidence, open_cause=f"its posterior has only {draws:.0f} effective draws")
    if not evidence.determined or MIN_EMITTANCE <= emittance <= MAX_EMITTANCE:
        return evidence
    too_small = emittance < MIN_EMITTANCE
    cause = (
        f"Not determined: a normalised emittance of {emittance:.2g} m is "
        f"{'less' if too_small else 'more'} than any accelerator has."
    )
    real_unit, header_unit = ("mm", "um") if too_small else ("um", "mm")
    remedy = (
        f"Check the units of '{prepared.scan.columns.get(f'size_{plane}', f'size_{plane}')}', the "
        f"settings and the energy: sizes a thousand times too {'small' if too_small else 'large'} "
        f"(such as {real_unit} under a header that says {header_unit}) make it a million times "
        f"{'less' if too_small else 'more'}."
    )
    return replace(evidence, ending=Finding(Status.unidentified, cause, remedy))


def _raw_errors(posterior: PlanePosterior, places: tuple) -> np.ndarray:
    """Errors from the stated errors alone: sqrt(∇f C ∇f), with complex-step derivatives."""
    if not np.isfinite(posterior.stated_covariance).all():
        return np.full(len(QUANTITIES), np.nan)
    unit = np.sqrt(np.diag(posterior.stated_covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        steps = np.array(posterior.best, complex)[:, None] + 1e-20j * np.diag(unit)
        slope = quantities_of(steps, *places).imag / 1e-20 / unit
        return np.sqrt(np.sum((slope @ posterior.stated_covariance) * slope, axis=1))


def _directions(points: Points, sigma: np.ndarray) -> Directions:
    """Directions of σ that the sizes do not determine."""
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian = (
            np.stack(coefficients(points.r11, points.r12), -1)
            / (2.0 * points.weighed * points.error)[:, None]
        )
    return scaled_directions(jacobian, np.array(sigma_units(sigma)), list(SIGMA))


def sigma_units(sigma: np.ndarray) -> list[float]:
    """Changes of σ11, σ12 and σ22 by 100 %; of σ12 by sqrt(σ11 σ22)."""
    return [float(sigma[0]), math.sqrt(max(float(sigma[0] * sigma[2]), 0.0)), float(sigma[2])]


def _influence(points: Points, sigma: np.ndarray, error: float) -> Influence:
    """Find the point without which the emittance moves most, at the weights of the fit.

    Notes
    -----
    For weighted rows a_i with residuals r_i and leverages h_i = a_iᵀ(AᵀA)⁻¹a_i, leaving out row i
    changes σ by -(AᵀA)⁻¹ a_i r_i/(1 - h_i): R. D. Cook and S. Weisberg, Residuals and Influence in
    Regression (1982), eq. 2.2.3.
    """
    scale = 0.5 / (points.weighed * points.error)
    rows = np.stack(coefficients(points.r11, points.r12), -1) * scale[:, None]
    residual = (points.size**2 - points.known) * scale - rows @ sigma
    norm = np.linalg.norm(rows, axis=0)
    q, r = np.linalg.qr(rows / norm)
    redundancy = np.maximum(1.0 - np.sum(q**2, axis=1), 1e-12)
    changes = np.linalg.solve(r, q.T).T * (residual / redundancy)[:, None] / norm
    s11, s12, s22 = (sigma - changes).T
    determinant = np.where((s11 > 0) & (s22 > 0), s11 * s22 - s12**2, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        without = np.sqrt(determinant)
        shifts = (without - math.sqrt(sigma[0] * sigma[2] - sigma[1] ** 2)) / error
    # A bad reading has no weight in the answer.
    shifts = np.where(points.outlier_probability > 0.5, 0.0, shifts)
    largest = int(np.argmax(np.where(np.isnan(shifts), np.inf, np.abs(shifts))))
    if abs(shifts[largest]) <= CARRYING_SHIFT:
        return Influence()
    return Influence(
        largest, points.where(largest), float(shifts[largest]), float(without[largest])
    )


def noise_words(noise: str, scale: np.ndarray, relative: float, points: Points) -> str:
    """Source of the errors, in a few words."""
    if noise in ("shots", "beyond"):
        source = "of the shots" if noise == "shots" else "given"
        return f"{source}, settings ± {100 * scale[0]:.2g} % beyond"
    if noise != "none":
        return "given" if scale[1] <= 1.05 else f"given, × {scale[0]:.2f}"
    if relative < 0.5:
        return f"inferred, {1e6 * float(np.median(points.error)):.2g} µm"
    return f"inferred, {100 * float((points.error / points.weighed).mean()):.2g} % of size"
