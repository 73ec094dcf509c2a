"""Whether a scan determines the emittance, and the sentence that says so."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from beamfit.quantity import Status
from beamfit.statistics import chi2_probability, one_sided_probability

__all__ = ["Evidence", "Verdict", "few_words", "judge", "phase_coverage", "waist_bracketed"]

# A fit this unlikely to be noise alone is a poor fit (docs/design.md, the JSON contract).
POOR_FIT = 1e-3
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
    """The numbers a verdict is made of.

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


class Verdict(NamedTuple):
    """A status and its sentence; ``cause`` is None where the emittance is determined."""

    status: Status
    message: str
    cause: str | None


def judge(e: Evidence, next_measurement: str | None, other_plane_clear: bool = False) -> Verdict:
    """Decide whether the emittance is determined, and how good the fit is.

    Parameters
    ----------
    e : Evidence
        The numbers.
    next_measurement : str or None
        What to measure, for the remedy.
    other_plane_clear : bool
        Whether the other plane of the same scan is determined by the full rule. It shares
        magnets, screen and settings, so a misfit here is then a matter of the profile and
        not of noise, and three standard errors suffice.

    Returns
    -------
    Verdict
        ``unidentified`` takes precedence over every other status.

    Notes
    -----
    The two distances from zero emittance must both exceed four standard errors, and the
    probability of that by chance (Student's t where the errors rest on these residuals,
    normal where they were known and fit) must be under 0.2 %. On simulated noise and
    one-sided scans this rule is measured in docs/verdict.md.

    Examples
    --------
    >>> good = Evidence(True, True, True, 11.0, 11, True, 31.0, 30.0, 0.02, True)
    >>> judge(good, None).status.value
    'converged'
    """
    # A neighbour vouches for a scan that has errors and a waist, and misses by no more than 20 %.
    vouched = other_plane_clear and e.noise_known and bool(e.bracketed) and e.misfit <= VOUCHED
    cause = _cause(e, vouched)
    if cause is not None:
        remedy = f" {next_measurement}" if next_measurement else ""
        return Verdict(Status.unidentified, f"Not determined: {cause}.{remedy}", cause)
    if not e.converged:
        return Verdict(
            Status.not_converged,
            "The iteration did not settle; use the plain fit of size squared, which needs none.",
            None,
        )
    clear = (
        "The scan determines the emittance: zero is "
        f"{_number(min(e.determinant_distance, e.zero_distance))} standard "
        f"errors away" + _waist_words(e.bracketed)
    )
    probability = chi2_probability(e.chi2, e.dof)
    if e.noise_known and probability is not None and probability < POOR_FIT:
        return Verdict(
            Status.poor_fit,
            f"Poor fit: chi2/dof = {_number(e.chi2 / e.dof)} (probability {probability:.1g}); the "
            f"sizes miss the model by {math.sqrt(e.chi2 / e.dof):.1f} times their errors, and all "
            "errors are scaled by that. Check how the sizes are taken from the profile, their "
            f"errors, and the lattice. {clear}.",
            None,
        )
    clear += few_words(e.noise_known, e.dof)
    if e.noise_known and e.chi2 > e.dof > 0:
        clear += f"; errors are scaled by sqrt(chi2/dof) = {math.sqrt(e.chi2 / e.dof):.2f}"
    return Verdict(Status.converged, clear + ".", None)


def _cause(e: Evidence, other_plane_clear: bool) -> str | None:
    """Name what keeps the emittance from being determined; None if nothing does."""
    if not e.full_rank:
        return (
            "the settings do not separate the three numbers of the beam matrix, as if the "
            "scanned magnet were downstream of the screen or hardly moved"
        )
    if e.robust and (e.dof < ROBUST_DOF or e.outliers > DOUBTED):
        return (
            f"the robust fit doubts {100 * e.outliers:.0f} % of the points and keeps {e.dof} "
            "degrees of freedom, too few to tell outliers from noise; measure more settings"
        )
    if e.dof == 0:
        return (
            "three points fit any three numbers exactly and leave nothing to judge them by; "
            "measure a fourth setting"
        )
    probability = chi2_probability(e.chi2, e.dof)
    poor = e.noise_known and probability is not None and probability < POOR_FIT
    if e.misfit > LOST and (poor or not e.noise_known) and not other_plane_clear:
        return (
            f"the sizes follow no beam through this line, the best one misses them by "
            f"{100 * e.misfit:.0f} % rms; check settings, units, energy and screen"
        )
    if e.swamped:
        return (
            "resolution and dispersion alone are larger than a measured size; check "
            "resolution_um and energy_spread"
        )
    if not e.positive:
        return "no beam fits better than one of zero emittance" + _one_sided(e)
    distance = min(e.determinant_distance, e.zero_distance)
    rests_on_residuals = not e.noise_known or e.robust or e.chi2 > e.dof
    estimated = e.dof if rests_on_residuals else None
    needed = CLEAR_BESIDE_ANOTHER if other_plane_clear else CLEAR
    chance = one_sided_probability(distance, estimated)
    if distance < needed or (chance > CHANCE and not other_plane_clear):
        if distance >= needed:
            return (
                f"zero emittance lies {distance:.1f} standard errors away, but with {e.dof} "
                f"degrees of freedom noise does that in {100 * chance:.2g} % of scans; measure "
                "more settings"
            )
        return f"zero emittance lies only {distance:.1f} standard errors away" + _one_sided(e)
    return None


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


def _waist_words(bracketed: bool | None) -> str:
    if bracketed is None:
        return ""
    return " and the waist is bracketed" if bracketed else ", though the waist is not bracketed"


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
