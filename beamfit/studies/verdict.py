"""Whether a scan determines the emittance, and the sentence that says so."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from beamfit.inference.identifiability import chi2_probability, one_sided_probability
from beamfit.inference.quantity import Status

__all__ = ["Evidence", "Verdict", "judge", "phase_coverage", "waist_bracketed"]

# A fit this unlikely to be noise alone is a poor fit (docs/design.md, the JSON contract).
POOR_FIT = 1e-3
# The emittance is determined if zero is this many standard errors away ...
CLEAR, CLEAR_BESIDE_ANOTHER = 4.0, 3.0
# ... and noise would lift it so far less often than this, counting the degrees of freedom.
CHANCE = 2e-3
# Sizes that miss every beam by this much, rms and relative, follow no beam.
LOST = 0.15


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
    cause = _cause(e, other_plane_clear)
    if cause is not None:
        remedy = f" {next_measurement}" if next_measurement else ""
        return Verdict(Status.unidentified, f"Not determined: {cause}.{remedy}", cause)
    if not e.converged:
        return Verdict(
            Status.not_converged,
            "The iteration did not settle; use the fit of size squared, which needs none.",
            None,
        )
    clear = (
        f"The scan determines the emittance: zero is {_number(e.determinant_distance)} standard "
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
    if e.dof == 0 and not e.noise_known:
        return "three points without errors fit exactly and leave nothing to judge them by"
    probability = chi2_probability(e.chi2, e.dof)
    poor = e.noise_known and probability is not None and probability < POOR_FIT
    if e.misfit > LOST and (poor or not e.noise_known) and not other_plane_clear:
        return (
            f"the sizes follow no beam through this line, the best one misses them by "
            f"{100 * e.misfit:.0f} % rms; check settings, units, energy and screen"
        )
    if not e.positive:
        return "no beam fits better than one of zero emittance" + _one_sided(e.bracketed)
    distance = min(e.determinant_distance, e.zero_distance)
    estimated = e.dof if (not e.noise_known or e.chi2 > e.dof > 0) else None
    needed = CLEAR_BESIDE_ANOTHER if other_plane_clear else CLEAR
    chance = one_sided_probability(distance, estimated)
    if distance < needed or (chance > CHANCE and not other_plane_clear):
        few = f" on {e.dof} degrees of freedom" if distance >= needed else ""
        return f"zero emittance lies only {distance:.1f} standard errors away{few}" + _one_sided(
            e.bracketed
        )
    return None


def _one_sided(bracketed: bool | None) -> str:
    return "; the smallest size is at the end of the scan" if bracketed is False else ""


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
