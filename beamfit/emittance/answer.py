"""From the posterior of a plane to its result: the one way of every scenario."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from beamfit.emittance.advice import next_measurement
from beamfit.emittance.comparison import AT, PlanePosterior, emittance_quantiles, weighted_quantiles
from beamfit.emittance.model import (
    QUANTITIES,
    asked_places,
    coefficients,
    numbers_of,
    phase_coverage,
)
from beamfit.emittance.results import Identifiability, PlaneFit, Points, ScreenTwiss
from beamfit.emittance.statement import PreparedScan, asked_of
from beamfit.emittance.transport import setting_units
from beamfit.emittance.verdict import (
    CARRIES,
    PlaneEvidence,
    noise_remark,
    point_remarks,
    resolution_remark,
    verdict,
    waist_bracketed,
)
from beamfit.errors import Finding, Status
from beamfit.optics.beamline import Beamline
from beamfit.quantity import Quantity
from beamfit.statistics import MIN_EFFECTIVE_DRAWS, Directions, chi2_probability, scaled_directions

SIGMA = slice(4, 7)
# Normalised emittances in m beyond which only a wrong unit leads: rings and linacs have 1e-9 and
# more, muons before cooling 2e-2; sizes a thousand times off are a million in this.
LEAST, MOST = 1e-10, 0.1
# What a beam of unknown emittance may have all the same: σ, and the size at the screen.
LINEAR = np.isin(list(QUANTITIES), ("sigma11", "sigma12", "sigma22", "screen_size"))
# Numbers of either sign; the others are positive, and spread by a factor.
SIGNED = np.isin(list(QUANTITIES), ("alpha", "sigma12", "screen_alpha"))
# βγ, matrices to the screen and the design's place, and the design: see `asked_places`.
Places = tuple[Any, Any, Any, Any]


class BestFit(NamedTuple):
    """The best fit of a plane, with what further unknowns of a scenario add to its answer.

    Attributes
    ----------
    value, spread : ndarray
        Shape (11,), in the order of `QUANTITIES`: best values, and standard deviations that the
        other unknowns add to those of known transport.
    covariance : ndarray
        Shape (3, 3), of σ11, σ12, σ22; in a scenario with the errors found.
    directions : Directions
        What the data leave open.
    dof : float
        Degrees of freedom of the plane's sizes.
    ending, opened, remedy, remark, scenario
        As of `PlaneEvidence`, and a further sentence; empty where nothing else is unknown.
    holds : str
        What the error includes.
    """

    value: np.ndarray
    spread: np.ndarray
    covariance: np.ndarray
    directions: Directions
    dof: float
    ending: Finding | None = None
    opened: str = ""
    remedy: str = ""
    remark: str = ""
    scenario: str = ""
    holds: str = "statistics only"


class Influence(NamedTuple):
    """The point without which the emittance moves most: which, where, by how many errors."""

    point: int = 0
    place: str = ""
    shift: float = 0.0
    without: float = math.nan


class PlaneNumbers(NamedTuple):
    """Numbers of a plane in the order of `QUANTITIES`, each of shape (11,)."""

    value: np.ndarray
    half: np.ndarray
    low: np.ndarray
    high: np.ndarray
    raw: np.ndarray

    @property
    def scale(self) -> float:
        """The error of the emittance over that by the stated errors alone; 1 without."""
        half, raw = float(self.half[0]), float(self.raw[0])
        return half / raw if math.isfinite(raw) and raw > 0 else 1.0

    def quantities(self, known: np.ndarray, limits: bool) -> list[Quantity]:
        """Quantities with errors where they are known, else with intervals if the model holds."""
        found, rows = [], zip(*(part.tolist() for part in self), strict=True)
        for (value, half, low, high, raw), unit, own in zip(
            rows, QUANTITIES.values(), known, strict=True
        ):
            finite = math.isfinite(low) and math.isfinite(high)
            error = half if own and finite else None
            raw = raw if error is not None and math.isfinite(raw) else None
            ends = (low, high) if finite and (own or limits) else None
            found.append(Quantity(value, error, unit, raw, ends))
        return found


def judged_beam(seen: PreparedScan) -> tuple[PlaneFit, ...]:
    """Answer for each plane where nothing but the beam is unknown; no program is compiled."""
    found = []
    for plane in seen.planes:
        post, p = seen.solutions[plane].posterior, seen.solutions[plane].points
        places = asked_places({}, asked_of(seen, plane))
        covariance = post.stated if np.isfinite(post.stated).all() else post.covariance
        value, dof = numbers_of(post.best, *places), max(len(p.size) - 3, 0)
        b = BestFit(value, np.zeros(len(value)), covariance, _directions(p, post.best), dof)
        found.append(plane_answer(seen, seen.line, plane, places, b))
    return tuple(found)


def plane_answer(
    seen: PreparedScan, line: Beamline, plane: str, places: Places, b: BestFit
) -> PlaneFit:
    """Answer for one plane.

    Parameters
    ----------
    seen : PreparedScan
        The scan through its line, as found.
    line : Beamline
        The line as found.
    plane : str
        "x" or "y".
    places : tuple
        Where the beam is asked for, from `asked_places`.
    b : BestFit
        What fits best, and what a scenario adds.

    Returns
    -------
    PlaneFit
        Errors only for what the data determine: half of the central 68 % of the posterior.
    """
    work = seen.solutions[plane]
    post, p = work.posterior, work.points
    n, carrying = _numbers(post, p, places, b)
    e = _evidence(seen, plane, n, b)
    asked = not b.scenario and e.of_a_beam and e.ending is None and not e.determined
    advice = next_measurement(seen, plane) if asked else None
    finding = verdict(e, _remarks(seen, plane, e, b, carrying, n), advice or "")
    holds = e.of_a_beam and e.ending is None
    known = e.determined | (LINEAR & holds & (not b.scenario))
    emittance, normalized, beta, alpha, s11, s12, s22, *screen, mismatch = n.quantities(
        known, holds and not e.opened
    )
    scale = n.scale if e.determined else 1.0
    covariance = b.covariance if known[SIGMA].all() else np.full((3, 3), np.nan)
    place = seen.rows.places[-1]
    own = {name: float(line[name].setting) for name in line.upto(place).magnets}
    return PlaneFit(
        plane=plane,
        status=finding.status,
        message=finding.message,
        emittance=emittance,
        normalized_emittance=normalized,
        beta=beta,
        alpha=alpha,
        sigma=(s11, s12, s22),
        screen=ScreenTwiss(place, own, setting_units(line, own), *screen),
        mismatch=None if getattr(seen.line.design, plane, None) is None else mismatch,
        chi2=post.chi2 if math.isfinite(post.chi2) else None,
        dof=round(b.dof),
        rms_residual=Quantity(float(np.sqrt(np.mean((p.size - p.model) ** 2))), None, "m"),
        covariance=covariance / scale**2 if b.scenario else covariance,
        error_scale=scale,
        noise=noise_words(post.noise, post.scale, post.relative, p),
        method=seen.method,
        weights=seen.weights,
        identifiability=_identifiability(p, n, e, advice, b.directions),
        points=p,
        holds=b.holds,
    )


def _numbers(
    post: PlanePosterior, p: Points, places: Places, b: BestFit
) -> tuple[PlaneNumbers, Influence]:
    """The numbers of a plane, and the point that carries them."""
    low, *ends, high = _quantiles(post, places, b.spread)
    half = 0.5 * (ends[2] - ends[0])
    alone = post.positive and len(p.size) > 3
    carrying = _influence(p, post.best, half[0]) if alone else Influence()
    if carrying.place:
        low, high, half = _reaching(low, high, half, b.value, carrying.without)
    raw = np.hypot(_raw(post, places), b.spread)
    return PlaneNumbers(b.value, half, low, high, raw), carrying


def _remarks(
    seen: PreparedScan, plane: str, e: PlaneEvidence, b: BestFit, carrying: Influence,
    n: PlaneNumbers,
) -> str:  # fmt: skip
    """Further sentences on noise and points."""
    work = seen.solutions[plane]
    post, p, remarks = work.posterior, work.points, [work.shot_words]
    if e.of_a_beam:
        likely = chi2_probability(post.chi2, max(len(p.size) - 3, 0))
        by_noise = e.determined and not b.scenario and not carrying.place
        enlarged = n.scale if by_noise else 1.0
        remarks.insert(0, noise_remark(post.noise, post.scale, likely, enlarged))
        without = carrying.without * n.value[1] / n.value[0]
        place = "" if e.opened else carrying.place
        if place:
            place += _bad_elsewhere(seen, plane, carrying.point)
        remarks += point_remarks(p, place, float(without))
    remarks.append(resolution_remark(p.size, p.known))
    remarks += [b.remark] * e.determined
    return " ".join(filter(None, remarks))


def _identifiability(
    p: Points, n: PlaneNumbers, e: PlaneEvidence, advice: str | None, directions: Directions
) -> Identifiability:
    return Identifiability(
        determined=e.determined,
        probability=e.posterior.probability,
        singular_values=tuple(float(v) for v in directions.singular_values),
        condition=directions.condition if math.isfinite(directions.condition) else None,
        waist_bracketed=e.bracketed,
        phase_coverage=phase_coverage(p.r11, p.r12, float(n.value[2]), float(n.value[3])),
        undetermined=(*directions.undetermined, *["emittance"] * (not e.determined)),
        next_measurement=advice,
    )


def _quantiles(post: PlanePosterior, given: tuple, spread: np.ndarray) -> np.ndarray:
    """Quantiles `AT` of every number, shape (5, 11)."""
    weight = post.weight
    with np.errstate(invalid="ignore", divide="ignore"):
        numbers = numbers_of(post.sigma.T, *given)
    if spread.any():
        # Even steps of a normal distribution, in an order that has nothing to do with the draws'.
        z = ndtri((0.5 + np.arange(len(weight)) * 0.6180339887498949) % 1.0)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            middle = np.abs(numbers @ (weight / weight.sum()))
            grown = numbers * np.exp(z * (spread / middle)[:, None])
            numbers = np.where(SIGNED[:, None], numbers + z * spread[:, None], grown)
            numbers = np.where(np.isfinite(spread)[:, None], numbers, 0.0)
    emittances = [emittance_quantiles(row, weight, post.flat, AT) for row in numbers[:2]]
    others = [weighted_quantiles(row, weight, AT) for row in numbers[2:]]
    return np.where(np.isfinite(spread), np.array([*emittances, *others]).T, np.nan)


def _reaching(
    low: np.ndarray, high: np.ndarray, half: np.ndarray, value: np.ndarray, without: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intervals that reach to the emittance without the point that carries it."""
    shift = without - value[0]  # NaN where the others give no emittance
    reach = np.array([shift, shift * value[1] / value[0]])
    low, high, half = low.copy(), high.copy(), half.copy()
    low[:2] = np.fmin(low[:2], value[:2] + reach)
    high[:2] = np.fmax(high[:2], value[:2] + reach)
    # Two answers, one of which is right: half of what lies between them, which is the error where
    # a point begins to carry the answer.
    half[:2] = np.fmax(half[:2], np.abs(reach) / CARRIES)
    return low, high, half


def _bad_elsewhere(seen: PreparedScan, plane: str, point: int) -> str:
    """Say in which other plane the row of a point is probably bad: both have its setting."""
    row = seen.measured(plane)[point]
    for other, work in seen.solutions.items():
        if np.any(work.posterior.bad[seen.measured(other) == row] > 0.5):
            return f", which is probably bad in {other}"
    return ""


def _evidence(seen: PreparedScan, plane: str, n: PlaneNumbers, b: BestFit) -> PlaneEvidence:
    work, low, high = seen.solutions[plane], float(n.low[1]), float(n.high[1])
    p, told = work.points, (b.ending, b.scenario, b.opened, b.remedy)
    waist = waist_bracketed(p.settings, p.screen, p.size, p.error)
    e = PlaneEvidence(work.posterior, work.sizes, low, high, waist, *told)
    emittance = float(n.value[1])
    worth = work.posterior.worth
    if e.determined and worth < MIN_EFFECTIVE_DRAWS and not b.scenario:
        opened = f"draws from its posterior are worth no more than {worth:.0f} independent ones"
        return replace(e, opened=opened)
    if not e.determined or LEAST <= emittance <= MOST:
        return e
    little = emittance < LEAST
    cause = (
        f"Not determined: a normalised emittance of {emittance:.2g} m is "
        f"{'less' if little else 'more'} than any accelerator has."
    )
    own, said = ("mm", "um") if little else ("um", "mm")
    remedy = (
        f"Check the units of '{seen.scan.columns.get(f'size_{plane}', f'size_{plane}')}', the "
        f"settings and the energy: sizes a thousand times too {'small' if little else 'large'} "
        f"(such as {own} under a header that says {said}) make it a million times "
        f"{'less' if little else 'more'}."
    )
    return replace(e, ending=Finding(Status.unidentified, cause, remedy))


def _raw(post: PlanePosterior, given: tuple) -> np.ndarray:
    """Errors by the stated errors alone: sqrt(∇f C ∇f), derivatives by complex steps."""
    if not np.isfinite(post.stated).all():
        return np.full(len(QUANTITIES), np.nan)
    unit = np.sqrt(np.diag(post.stated))
    with np.errstate(invalid="ignore", divide="ignore"):
        steps = np.array(post.best, complex)[:, None] + 1e-20j * np.diag(unit)
        slope = numbers_of(steps, *given).imag / 1e-20 / unit
        return np.sqrt(np.sum((slope @ post.stated) * slope, axis=1))


def _directions(p: Points, sigma: np.ndarray) -> Directions:
    """Directions of σ that the sizes leave open."""
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian = np.stack(coefficients(p.r11, p.r12), -1) / (2.0 * p.weighed * p.error)[:, None]
    return scaled_directions(jacobian, np.array(units_of(sigma)), list(QUANTITIES)[SIGMA])


def units_of(sigma: np.ndarray) -> list[float]:
    """A change of σ11, σ12 and σ22 by 100 %."""
    return [float(sigma[0]), math.sqrt(max(float(sigma[0] * sigma[2]), 0.0)), float(sigma[2])]


def _influence(p: Points, sigma: np.ndarray, error: float) -> Influence:
    """Leave out each point in turn, at the weights of the fit.

    Notes
    -----
    Of weighted rows a_i with residuals r_i and leverages h_i = a_iᵀ(AᵀA)⁻¹a_i, leaving out row i
    changes σ by -(AᵀA)⁻¹ a_i r_i/(1 - h_i): R. D. Cook and S. Weisberg, Residuals and Influence in
    Regression (1982), eq. 2.2.3.
    """
    scale = 0.5 / (p.weighed * p.error)
    rows = np.stack(coefficients(p.r11, p.r12), -1) * scale[:, None]
    left = (p.size**2 - p.known) * scale - rows @ sigma
    norm = np.linalg.norm(rows, axis=0)
    q, r = np.linalg.qr(rows / norm)
    free = np.maximum(1.0 - np.sum(q**2, axis=1), 1e-12)
    moves = np.linalg.solve(r, q.T).T * (left / free)[:, None] / norm
    s11, s12, s22 = (sigma - moves).T
    determinant = np.where((s11 > 0) & (s22 > 0), s11 * s22 - s12**2, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        without = np.sqrt(determinant)
        shifts = (without - math.sqrt(sigma[0] * sigma[2] - sigma[1] ** 2)) / error
    # A reading that is bad already has no part in the answer.
    shifts = np.where(p.outlier_probability > 0.5, 0.0, shifts)
    most = int(np.argmax(np.where(np.isnan(shifts), np.inf, np.abs(shifts))))
    if abs(shifts[most]) <= CARRIES:
        return Influence()
    return Influence(most, p.where(most), float(shifts[most]), float(without[most]))


def noise_words(noise: str, scale: np.ndarray, relative: float, p: Points) -> str:
    """Source of the errors, in a few words."""
    if noise in ("shots", "beyond"):
        source = "of the shots" if noise == "shots" else "given"
        return f"{source}, settings ± {100 * scale[0]:.2g} % beyond"
    if noise != "none":
        return "given" if scale[1] <= 1.05 else f"given, × {scale[0]:.2f}"
    if relative < 0.5:
        return f"inferred, {1e6 * float(np.median(p.error)):.2g} µm"
    return f"inferred, {100 * float((p.error / p.weighed).mean()):.2g} % of size"
