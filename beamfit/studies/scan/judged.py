"""From a solved statement to a judged result of each plane; here of the closed form."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from beamfit.optics.beamline import Beamline
from beamfit.quantity import Quantity
from beamfit.statistics import Directions, reach_of, scaled_directions
from beamfit.status import Status
from beamfit.studies.scan.model import QUANTITIES, coefficients, phase_coverage
from beamfit.studies.scan.next_point import next_measurement
from beamfit.studies.scan.results import Identifiability, PlaneFit, Points, ScreenTwiss
from beamfit.studies.scan.statement import Seen, asked_of
from beamfit.studies.scan.transport import setting_units
from beamfit.studies.scan.verdict import BEAM_RULES, LOST
from beamfit.verdict import Finding, judge

SIGMA = slice(4, 7)
# Doubted points that a message names.
MOST_NAMED = 5
# Draws for an upper limit, and how many of them must be beams.
DRAWS, ENOUGH = 20_000, 100
# Normalised emittances in m beyond which only a wrong unit leads: rings and linacs have 1e-9 and
# more, muons before cooling 2e-2; sizes a thousand times off are a million in this.
LEAST, MOST = 1e-10, 0.1
# What the three numbers of size² alone tell: σ, and the size at the screen.
LINEAR = np.isin(list(QUANTITIES), ("sigma11", "sigma12", "sigma22", "screen_size"))


class Answer(NamedTuple):
    """One plane, solved and judged: numbers in the order of `QUANTITIES`, NaN without an error."""

    finding: Finding
    determined: bool
    value: np.ndarray
    error: np.ndarray
    raw: np.ndarray
    covariance: np.ndarray
    chi2: float
    dof: int
    scale: float
    rests_on: float
    limits: tuple[float | None, float | None]
    distance: float
    points: Points
    directions: Directions
    advice: str | None = None
    holds: str = "statistics only"


def _quantity(
    value: float, error: float, raw: float, unit: str, limit: float | None, reach: float
) -> Quantity:
    """A number with its error; of one that is not determined what it cannot exceed, if known."""
    value, error = float(value), float(error)
    if not math.isfinite(error):
        return Quantity(value, None, unit, None, None if limit is None else (0.0, limit))
    return Quantity.reaching(value, error, unit, float(raw), reach * error)


def plane_fit(seen: Seen, line: Beamline, plane: str, a: Answer) -> PlaneFit:
    """The result of a plane: errors only for what the data determine."""
    a = _held(a, seen.scan.columns.get(f"size_{plane}", f"size_{plane}"))
    columns = a.value, a.error, a.raw, QUANTITIES.values(), a.limits
    numbers = [_quantity(*each, reach_of(a.rests_on)) for each in zip_longest(*columns)]
    emittance, normalized, beta, alpha, s11, s12, s22, *screen, mismatch = numbers
    place, p, e = seen.rows.places[-1], a.points, seen.works[plane].evidence
    own = {name: float(line[name].setting) for name in line.upto(place).magnets}
    return PlaneFit(
        plane=plane,
        status=a.finding.status,
        message=a.finding.message,
        emittance=emittance,
        normalized_emittance=normalized,
        beta=beta,
        alpha=alpha,
        sigma=(s11, s12, s22),
        screen=ScreenTwiss(place, own, setting_units(line, own), *screen),
        mismatch=None if getattr(seen.line.design, plane, None) is None else mismatch,
        chi2=a.chi2 if e.noise_known else None,
        dof=a.dof,
        rms_residual=Quantity(float(np.sqrt(np.mean((p.size - p.model) ** 2))), None, "m"),
        covariance=a.covariance,
        error_scale=a.scale,
        noise=seen.noises[plane].words,
        method=seen.method,
        weights=seen.weights,
        identifiability=Identifiability(
            determined=a.determined,
            singular_values=tuple(float(v) for v in a.directions.singular_values),
            condition=a.directions.condition if math.isfinite(a.directions.condition) else None,
            waist_bracketed=e.bracketed,
            phase_coverage=phase_coverage(p.r11, p.r12, float(a.value[2]), float(a.value[3])),
            zero_distance=a.distance,
            undetermined=(*a.directions.undetermined, *["emittance"] * (not a.determined)),
            next_measurement=a.advice,
        ),
        points=p,
        holds=a.holds,
    )


def _held(a: Answer, sizes: str) -> Answer:
    """An answer, or one without errors where it is of a size that only a wrong unit explains."""
    if not a.determined or LEAST <= (found := a.value[1]) <= MOST:
        return a
    cause = (
        f"Not determined: a normalised emittance of {found:.2g} m is "
        f"{'less' if found < LEAST else 'more'} than any accelerator has."
    )
    remedy = (
        f"Check the units of '{sizes}', the settings and the energy: sizes in mm under a header "
        "that says um make it a million times less."
    )
    none = np.full(len(a.value), np.nan)
    return a._replace(
        finding=Finding(Status.unidentified, cause, remedy),
        determined=False,
        error=none,
        raw=none,
        covariance=np.full_like(a.covariance, np.nan),
    )


def judged_beam(seen: Seen) -> tuple[PlaneFit, ...]:
    """Judge each plane of the closed form: nothing but the beam is unknown."""
    return tuple(plane_fit(seen, seen.line, p, _beam_answer(seen, p)) for p in seen.planes)


def _beam_answer(seen: Seen, plane: str) -> Answer:
    w = seen.works[plane]
    e, p = w.evidence, w.points
    finding, advice = judge(e, BEAM_RULES), None
    determined = finding.status is not Status.unidentified
    if not determined:
        advice = next_measurement(seen, plane)
        finding = judge(e._replace(advice=advice), BEAM_RULES)
    finding = finding._replace(remedy=f"{finding.remedy} {_outlier_words(p)}".strip())
    # The three numbers of size² can be known although the emittance is not.
    linear = determined or (e.full_rank and e.positive and e.misfit <= LOST and e.dof > 0)
    shown = np.isfinite(w.error) & np.where(LINEAR, linear, determined)
    value = w.value if e.positive else np.where(np.arange(len(w.value)) < 2, 0.0, w.value)
    raw = np.where(shown, w.error, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 2.0 * p.weighed * p.error * w.scale
        jacobian = np.stack(coefficients(p.r11, p.r12), -1) / scale[:, None]
    return Answer(
        finding=finding,
        determined=determined,
        value=value,
        error=raw * w.scale,
        raw=raw,
        covariance=w.covariance if linear else np.full((3, 3), np.nan),
        chi2=e.chi2,
        dof=e.dof,
        scale=w.scale,
        rests_on=e.rests_on,
        limits=(None, None) if determined else _limits(seen, plane),
        distance=e.distance,
        points=p,
        directions=scaled_directions(
            jacobian, np.array(units_of(w.fit.sigma)), list(QUANTITIES)[SIGMA]
        ),
        advice=advice,
    )


def _limits(seen: Seen, plane: str) -> tuple[float | None, float | None]:
    """Upper limits of the emittance and the normalised one, where the sizes follow some beam."""
    w = seen.works[plane]
    e = w.evidence
    if not e.full_rank or e.misfit > LOST or e.swamped or (e.dof == 0 and not e.noise_known):
        return None, None
    start = w.fit.sigma if e.positive else w.fit.symmetric
    limit = upper_limit(start, w.covariance * w.scale**2, e.rests_on)
    return limit, None if limit is None else limit * float(asked_of(seen, plane).factor)


def upper_limit(sigma: np.ndarray, covariance: np.ndarray, rests_on: float) -> float | None:
    """What the emittance exceeds in 5 % of the posterior, flat over positive definite σ, m.

    Parameters
    ----------
    sigma, covariance : ndarray
        The best symmetric matrix, positive or not, and its covariance.
    rests_on : float
        Degrees of freedom of that covariance: of the t distribution that is drawn from.

    Returns
    -------
    float or None
        None where hardly any such beam is compatible with the sizes.

    Examples
    --------
    >>> covariance = 1e-2 * np.eye(3)
    >>> round(upper_limit(np.array([1.0, 0.0, 1.0]), covariance, math.inf), 2)
    1.11
    >>> upper_limit(np.array([1.0, 0.0, -1.0]), covariance, math.inf) is None
    True
    """
    norm = np.sqrt(np.diag(covariance))
    if not (rests_on > 0 and np.isfinite(norm).all() and np.all(norm > 0)):
        return None
    # Half the root of the matrix of correlations: the numbers differ by orders of magnitude.
    values, vectors = np.linalg.eigh(covariance / np.outer(norm, norm))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    z = _draws(float(rests_on))
    s11, s12, s22 = (sigma + (z @ root.T) * norm).T
    determinant = s11 * s22 - s12**2
    beams = determinant[(s11 > 0) & (determinant > 0)]
    if len(beams) < ENOUGH:
        return None
    return float(np.sqrt(np.quantile(beams, 0.95)))


@lru_cache(maxsize=16)
def _draws(rests_on: float) -> np.ndarray:
    """Of the t distribution in three dimensions: the same ones for every scan."""
    draws = np.random.default_rng(0)
    z = draws.standard_normal((DRAWS, 3))
    if math.isfinite(rests_on):
        z /= np.sqrt(draws.chisquare(rests_on, (DRAWS, 1)) / rests_on)
    return z


def units_of(sigma: np.ndarray) -> list[float]:
    """A change of σ11, σ12 and σ22 by 100 %."""
    return [float(sigma[0]), math.sqrt(max(float(sigma[0] * sigma[2]), 0.0)), float(sigma[2])]


def _outlier_words(p: Points) -> str:
    """Name the points the robust fit doubts."""
    probability = p.outlier_probability
    doubted = [] if probability is None else np.flatnonzero(probability > 0.5)
    if not len(doubted):
        return ""
    places = [p.where(i) for i in doubted[:MOST_NAMED]]
    places += [f"{len(doubted) - MOST_NAMED} more"] * (len(doubted) > MOST_NAMED)
    said = f"{len(doubted)} of {len(probability)} points more likely outliers than not"
    return f"{said}: {'; '.join(places)}."
