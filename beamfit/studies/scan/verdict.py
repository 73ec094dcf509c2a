"""Whether a scan determines the emittance: evidence, and rules that each have their sentence."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from beamfit.statistics import POOR_FIT, chi2_probability, one_sided_probability
from beamfit.status import Status
from beamfit.verdict import Finding, judge

__all__ = [
    "BEAM_RULES",
    "CLEAR",
    "LOST",
    "SCENARIO_RULES",
    "Evidence",
    "Unknowns",
    "cause_of",
    "judge",
    "phase_coverage",
    "waist_bracketed",
]

# The emittance is determined if zero is this many standard errors away ...
CLEAR, CLEAR_BESIDE_ANOTHER = 4.0, 3.0
# (sizes of such a scan may miss the beam by this much, relative and rms)
VOUCHED = 0.2
# ... and noise would lift it so far less often than this, counting the degrees of freedom.
CHANCE = 2e-3
# Sizes that miss every beam by this much, rms and relative, follow no beam.
LOST = 0.15
# A robust fit must keep this many degrees of freedom, and may doubt this share of the points.
ROBUST_DOF, DOUBTED = 4, 0.2
# From so many degrees of freedom on, Student's distribution is nearly normal.
MANY = 8


class Evidence(NamedTuple):
    """What tells whether sizes determine a beam when the line is known.

    Attributes
    ----------
    full_rank, positive, converged : bool
        As in `SigmaFit`.
    chi2 : float
        χ² for the errors as used.
    dof : int
        Points less three.
    noise_known : bool
        Whether the errors were given, not inferred from these residuals.
    determinant_distance : float
        det σ over its scaled standard error.
    zero_distance : float
        sqrt of (χ² of the best beam of no emittance - χ²), scaled.
    misfit : float
        Rms relative miss of the sizes, corrected for the three fitted numbers.
    bracketed : bool or None
        Whether the waist is.
    smallest_at_end : bool
        Whether the smallest size is the first or last setting of the scan.
    swamped : bool
        Whether dispersion and resolution alone exceed a measured size.
    outliers : float
        Share of the points the robust fit thinks bad; 0 for a plain fit.
    robust : bool
        Whether the fit was robust: its noise then rests on its own judgement.
    neighbour : bool
        Whether the other plane of the same scan is determined by the full rule. It shares
        magnets, screen and settings, so a misfit here is then a matter of the profile and
        not of noise, and three standard errors suffice.
    advice : str or None
        What to measure, for the remedy.
    """

    full_rank: bool
    positive: bool
    converged: bool
    chi2: float
    dof: int
    noise_known: bool
    determinant_distance: float
    zero_distance: float
    misfit: float
    bracketed: bool | None
    smallest_at_end: bool = False
    swamped: bool = False
    outliers: float = 0.0
    robust: bool = False
    neighbour: bool = False
    advice: str | None = None

    @property
    def vouched(self) -> bool:
        """A neighbour vouches for given errors, a bracketed waist and a miss of up to 20 %."""
        return (
            self.neighbour and self.noise_known and bool(self.bracketed) and self.misfit <= VOUCHED
        )

    @property
    def distance(self) -> float:
        """Standard errors from zero emittance, the lesser of both."""
        return min(self.determinant_distance, self.zero_distance)

    @property
    def poor(self) -> bool:
        """Whether given errors make the residuals improbable."""
        return self.noise_known and improbable(self.chi2, self.dof)

    @property
    def chance(self) -> float:
        """How often noise alone comes this far from zero emittance."""
        rests_on_residuals = not self.noise_known or self.robust or self.chi2 > self.dof
        return one_sided_probability(self.distance, self.dof if rests_on_residuals else None)


def improbable(chi2: float, dof: float) -> bool:
    """Whether noise alone gives such a χ² less than once in a thousand."""
    probability = chi2_probability(chi2, dof)
    return probability is not None and probability < POOR_FIT


def _no_rank(e: Evidence) -> str | None:
    if e.full_rank:
        return None
    return (
        "the settings do not separate the three numbers of the beam matrix, as if the "
        "scanned magnet were downstream of the screen or hardly moved"
    )


def _doubted(e: Evidence) -> str | None:
    if not (e.robust and (e.dof < ROBUST_DOF or e.outliers > DOUBTED)):
        return None
    return (
        f"the robust fit doubts {100 * e.outliers:.0f} % of the points and keeps {e.dof} "
        "degrees of freedom, too few to tell outliers from noise; measure more settings"
    )


def _three_points(e: Evidence) -> str | None:
    if e.dof:
        return None
    return (
        "three points fit any three numbers exactly and leave nothing to judge them by; "
        "measure a fourth setting"
    )


def _lost(e: Evidence) -> str | None:
    if not (e.misfit > LOST and (e.poor or not e.noise_known)) or e.vouched:
        return None
    return (
        f"the sizes follow no beam through this line, the best one misses them by "
        f"{100 * e.misfit:.0f} % rms; check settings, units, energy and screen"
    )


def _swamped(e: Evidence) -> str | None:
    if not e.swamped:
        return None
    return (
        "resolution and dispersion alone are larger than a measured size; check "
        "resolution_um and energy_spread"
    )


def _not_positive(e: Evidence) -> str | None:
    return None if e.positive else "no beam fits better than one of zero emittance" + _one_sided(e)


def _near_zero(e: Evidence) -> str | None:
    """Both distances must exceed four standard errors; three do where a neighbour vouches."""
    if e.distance >= (CLEAR_BESIDE_ANOTHER if e.vouched else CLEAR):
        return None
    return f"zero emittance lies only {e.distance:.1f} standard errors away" + _one_sided(e)


def _by_chance(e: Evidence) -> str | None:
    if e.vouched or not e.chance > CHANCE:
        return None
    return (
        f"zero emittance lies {e.distance:.1f} standard errors away, but with {e.dof} "
        f"degrees of freedom noise does that in {100 * e.chance:.2g} % of scans; measure "
        "more settings"
    )


# What keeps sizes from determining an emittance, gravest first.
CAUSES: tuple[Callable[[Evidence], str | None], ...] = (
    _no_rank, _doubted, _three_points, _lost, _swamped, _not_positive, _near_zero, _by_chance
)  # fmt: skip


def cause_of(e: Evidence) -> str | None:
    """Name what keeps the emittance from being determined; None if nothing does.

    Examples
    --------
    >>> good = Evidence(True, True, True, 11.0, 11, True, 31.0, 30.0, 0.02, True)
    >>> cause_of(good), cause_of(good._replace(zero_distance=3.5))
    (None, 'zero emittance lies only 3.5 standard errors away')
    """
    return next((cause for rule in CAUSES if (cause := rule(e)) is not None), None)


def _undetermined(e: Evidence) -> Finding | None:
    cause = cause_of(e)
    if cause is None:
        return None
    return Finding(Status.unidentified, f"Not determined: {cause}.", e.advice or "")


def _unsettled(e: Evidence) -> Finding | None:
    if e.converged:
        return None
    said = "The iteration did not settle; use the plain fit of size squared, which needs none."
    return Finding(Status.not_converged, said)


def _poor(e: Evidence) -> Finding | None:
    if not e.poor:
        return None
    probability, ratio = chi2_probability(e.chi2, e.dof), e.chi2 / e.dof
    return Finding(
        Status.poor_fit,
        f"Poor fit: chi2/dof = {_number(ratio)} (probability {probability:.1g}); the "
        f"sizes miss the model by {math.sqrt(ratio):.1f} times their errors, and all "
        "errors are scaled by that. Check how the sizes are taken from the profile, their "
        f"errors, and the lattice. {_clear(e)}.",
    )


def _determined(e: Evidence) -> Finding:
    words = _clear(e) + few_words(e.noise_known, e.dof)
    if e.noise_known and e.chi2 > e.dof > 0:
        words += f"; errors are scaled by sqrt(chi2/dof) = {math.sqrt(e.chi2 / e.dof):.2f}"
    return Finding(Status.converged, words + ".")


# Of sizes whose line is known; on simulated noise and one-sided scans measured in docs/verdict.md.
BEAM_RULES = (_undetermined, _unsettled, _poor, _determined)


class Unknowns(NamedTuple):
    """What tells whether sizes determine a beam when more than the beam is unknown.

    Attributes
    ----------
    scenario, tied : str
        Its name, and what ties it to first principles, in words.
    cause : str or None
        What keeps sizes from determining a beam even if the line were as found (`cause_of`).
    ending : Finding or None
        How the search ended, where that was no answer.
    on_data : bool
        Whether the error of the emittance rests on data and priors, not on bounds.
    distance : float
        Standard errors between det σ and zero.
    chi2, dof : float
        Of the plane's own sizes.
    noise_known : bool
        Whether their errors were given.
    points_dof : int
        Points less three.
    edges, remedy, remark : str
        Numbers that end on bounds; what is needed; what else is open or rests on priors.
    """

    scenario: str
    tied: str
    cause: str | None
    ending: Finding | None
    on_data: bool
    distance: float
    chi2: float
    dof: float
    noise_known: bool
    points_dof: int
    edges: str
    remedy: str
    remark: str

    @property
    def clear(self) -> bool:
        """Whether the emittance is known and clearly not zero."""
        return self.on_data and self.distance >= CLEAR


def _refuted_by_sizes(u: Unknowns) -> Finding | None:
    """Priors and anchors can make a covariance finite where the sizes are noise or too few."""
    if not u.clear or u.ending is not None or u.cause is None:
        return None
    said = f"Not determined in scenario {u.scenario}: {u.cause}."
    return Finding(Status.unidentified, said)


def _no_answer(u: Unknowns) -> Finding | None:
    """What the data do not determine has no optimum to settle in: that comes first."""
    if u.ending is None or (not u.clear and u.ending.status is Status.not_converged):
        return None
    return u.ending


def _left_open(u: Unknowns) -> Finding | None:
    if u.clear and u.ending is None:
        return None
    why = (
        f"zero emittance lies only {u.distance:.1f} standard errors away"
        if u.on_data
        else "its value is decided by bounds and starting point, not by the data"
    )
    said = f"Not determined in scenario {u.scenario}{u.tied}: {why}{u.edges}."
    return Finding(Status.unidentified, said, f"Needed: {u.remedy}.")


def _poor_in_scenario(u: Unknowns) -> Finding | None:
    if not (u.noise_known and improbable(u.chi2, u.dof)):
        return None
    ratio = u.chi2 / u.dof
    words = (
        f"Poor fit: chi2/dof = {ratio:.2g}; the sizes' errors are scaled by {math.sqrt(ratio):.1f}."
    )
    return Finding(Status.poor_fit, f"{words} {_in_scenario(u)}")


def _determined_in_scenario(u: Unknowns) -> Finding:
    return Finding(Status.converged, _in_scenario(u))


def _in_scenario(u: Unknowns) -> str:
    return (
        f"Determined in scenario {u.scenario}{u.tied}: zero emittance is {u.distance:.0f} standard "
        f"errors away.{u.remark}{few_words(u.noise_known, u.points_dof)}"
    )


# Of sizes when more than the beam is unknown.
SCENARIO_RULES = (
    _refuted_by_sizes, _no_answer, _left_open, _poor_in_scenario, _determined_in_scenario
)  # fmt: skip


def _clear(e: Evidence) -> str:
    waist = {
        None: "",
        True: " and the waist is bracketed",
        False: ", though the waist is not bracketed",
    }
    return (
        f"The scan determines the emittance: zero is {_number(e.distance)} standard errors away"
        + waist[e.bracketed]
    )


def few_words(noise_known: bool, dof: int) -> str:
    """Say how far errors reach whose noise was inferred from few residuals.

    Examples
    --------
    >>> few_words(False, 2)
    '; noise inferred on 2 degrees of freedom: 95 % of answers lie within 4.3 errors'
    """
    if noise_known or not 0 < dof < MANY:
        return ""
    reach = float(stdtrit(dof, 0.975))
    return (
        f"; noise inferred on {dof} degrees of freedom: 95 % of answers lie within "
        f"{reach:.1f} errors"
    )


def _one_sided(e: Evidence) -> str:
    return "; the smallest size is at the end of the scan" if e.smallest_at_end else ""


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def waist_bracketed(
    settings: dict[str, np.ndarray], screens: tuple[str, ...], size: np.ndarray, error: np.ndarray
) -> bool | None:
    """Whether the sizes rise, by two standard errors, on both sides of the smallest.

    Parameters
    ----------
    settings : dict of str to ndarray
        Magnet name to settings.
    screens : tuple of str
        The screen of each point.
    size, error : ndarray
        Sizes and errors, m.

    Returns
    -------
    bool or None
        None if more than one magnet or screen was varied: there is no side then.

    Examples
    --------
    >>> sizes = np.array([2.0, 1.0, 3.0])
    >>> waist_bracketed({"Q": np.arange(3.0)}, ("S",) * 3, sizes, 0.1 * sizes)
    True
    """
    varied = [v for v in settings.values() if np.ptp(v) > 0]
    if len(varied) != 1 or len(set(screens)) > 1:
        return None
    order = np.argsort(varied[0], kind="stable")
    size, error = size[order], error[order]
    low = int(np.argmin(size))
    rise = (size - size[low]) > 2.0 * np.hypot(error, error[low])
    return bool(rise[:low].any() and rise[low + 1 :].any())


def phase_coverage(r11: np.ndarray, r12: np.ndarray, beta: float, alpha: float) -> float | None:
    """Betatron phase from which the scan saw the beam, in degrees of a half turn.

    Parameters
    ----------
    r11, r12 : ndarray
        Transfer-matrix elements to the screen, shape (n,).
    beta, alpha : float
        Twiss parameters at the start, β in m.

    Returns
    -------
    float or None
        180° less the largest gap between the phases; None if β is not finite.

    Notes
    -----
    The phase advance φ to the screen has tan φ = R12/(β R11 - α R12), from
    R11 = sqrt(β_s/β)(cos φ + α sin φ), R12 = sqrt(β β_s) sin φ.

    Examples
    --------
    >>> phase_coverage(np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.0, 0.0)
    90.0
    """
    if not (math.isfinite(beta) and math.isfinite(alpha)):
        return None
    phase = np.sort(np.mod(np.degrees(np.arctan2(r12, beta * r11 - alpha * r12)), 180.0))
    gaps = np.diff(np.concatenate([phase, [phase[0] + 180.0]]))
    return float(180.0 - gaps.max())
