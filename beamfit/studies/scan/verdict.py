"""Whether a scan determines the emittance: evidence, and rules that each have their sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np

from beamfit.statistics import POOR_FIT, few_words, one_sided_probability
from beamfit.status import Status
from beamfit.studies.scan.outliers import Influence
from beamfit.verdict import Finding

# The emittance is determined if zero is this many standard errors away ...
CLEAR = 4.0
# ... and this many where the waist is not bracketed and residuals tell the noise: the few answers
# of such a scan are else those that noise has made large and sure at once.
EXTRAPOLATED = 6.0
# ... and noise would lift it so far less often than this, counting the degrees of freedom.
CHANCE = 2e-3
# Sizes that miss every beam by this much, rms and relative, follow no beam.
LOST = 0.15
# A robust fit must keep this many degrees of freedom, and may doubt this share of the points.
ROBUST_DOF, DOUBTED = 4, 0.2
# Sizes answer a magnet if a constant size is less likely than this.
CONSTANT = 0.01
# Above this probability of χ² the errors are overstated.
OVERSTATED = 0.999


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
    probability : float or None
        Of a χ² at least this large; None where there is nothing to judge it by.
    rests_on : float
        Degrees of freedom of the errors as scaled; infinite for errors that were given.
    influence : Influence
        What single points do to the answer.
    constant : float or None
        Probability that noise alone makes the sizes differ, if one magnet was scanned.
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
    scanned : bool
        Whether a magnet was moved; sizes at several monitors are all there is otherwise.
    advice : str or None
        What to measure, for the remedy.
    """

    full_rank: bool
    positive: bool
    converged: bool
    chi2: float
    dof: int
    noise_known: bool
    probability: float | None
    rests_on: float
    determinant_distance: float
    zero_distance: float
    misfit: float
    bracketed: bool | None
    smallest_at_end: bool = False
    swamped: bool = False
    outliers: float = 0.0
    robust: bool = False
    influence: Influence = Influence()
    constant: float | None = None
    scanned: bool = True
    advice: str | None = None

    @property
    def distance(self) -> float:
        """Standard errors from zero emittance, the lesser of both."""
        return min(self.determinant_distance, self.zero_distance)

    @property
    def poor(self) -> bool:
        """Whether given errors make the residuals improbable."""
        return self.probability is not None and self.probability < POOR_FIT

    @property
    def chance(self) -> float:
        """How often noise alone comes this far from zero emittance."""
        return one_sided_probability(self.distance, self.rests_on)


def _no_beam(e: Evidence) -> Iterator[str]:
    """Why the sizes tell nothing of a beam, gravest first."""
    if not e.full_rank:
        yield (
            "the settings do not separate the three numbers of the beam matrix, as if the "
            "scanned magnet were downstream of the screen or hardly moved"
        )
    if e.robust and (e.dof < ROBUST_DOF or e.outliers > DOUBTED):
        yield (
            f"the robust fit doubts {100 * e.outliers:.0f} % of the points and keeps {e.dof} "
            "degrees of freedom, too few to tell outliers from noise; measure more settings"
        )
    if not e.dof and (e.scanned or not e.noise_known):
        yield (
            "three points fit any three numbers exactly and leave nothing to judge them by; "
            "measure a fourth setting"
        )
    if e.dof == 1 and not e.noise_known:
        yield (
            "four points without errors leave one residual, which may be small by accident; "
            "measure a fifth setting or give the errors of the sizes"
        )
    if e.misfit > LOST and (e.poor or not e.noise_known):
        outlier = e.influence.outlier
        yield (
            f"the sizes follow no beam with {outlier}, and do without; measure again, or fit with "
            "--robust"
            if outlier
            else "the sizes follow no beam through this line, the best one misses them by "
            f"{100 * e.misfit:.0f} % rms; check settings, units, energy and screen"
        )
    if e.constant is not None and e.constant >= CONSTANT:
        yield (
            "the sizes do not answer the magnet, one size meets them all within their errors "
            f"(probability {e.constant:.2g}); check that the magnet moved, that the screen shows "
            "the beam, and scan further"
        )
    if e.swamped:
        yield (
            "resolution and dispersion alone are larger than a measured size; check "
            "resolution_um and energy_spread"
        )


def _perhaps_zero(e: Evidence) -> Iterator[str]:
    """Why the emittance of the beam they tell of may be zero, gravest first."""
    away = f"zero emittance lies {e.distance:.1f} standard errors away"
    end = "; the smallest size is at the end of the scan" if e.smallest_at_end else ""
    if not e.positive:
        yield "no beam fits better than one of zero emittance" + end
    if e.distance < CLEAR:
        yield f"zero emittance lies only {e.distance:.1f} standard errors away{end}"
    if not e.noise_known and e.bracketed is False and e.distance < EXTRAPOLATED:
        yield (
            f"{away} by the scatter of sizes on one side of the waist; scan over the waist, or "
            "give the errors of the sizes"
        )
    if e.chance > CHANCE:
        yield (
            f"{away}, but with errors that rest on {e.rests_on:.3g} degrees of freedom noise does "
            f"that in {100 * e.chance:.2g} % of scans; measure more settings"
        )


def cause_of(e: Evidence) -> str | None:
    """Name what keeps the emittance from being determined; None if nothing does.

    Examples
    --------
    >>> good = Evidence(True, True, True, 11.0, 11, True, 0.44, math.inf, 31.0, 30.0, 0.02, True)
    >>> cause_of(good), cause_of(good._replace(zero_distance=3.5))
    (None, 'zero emittance lies only 3.5 standard errors away')
    """
    return next(chain(_no_beam(e), _perhaps_zero(e)), None)


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
    ratio = e.chi2 / e.dof
    blame = "Check how the sizes are taken from the profile, their errors, and the lattice."
    if e.influence.outlier:
        blame = (
            f"Without {e.influence.outlier} the rest fits (probability "
            f"{e.influence.without:.1g}): measure it again, or fit with --robust."
        )
    return Finding(
        Status.poor_fit,
        f"Poor fit: chi2/dof = {_number(ratio)} (probability {e.probability:.1g}); the "
        f"sizes miss the model by {math.sqrt(ratio):.1f} times their errors, and all "
        f"errors are scaled by that. {blame} {_clear(e)}{_carried(e)}.",
    )


def _one_refutes(e: Evidence) -> Finding | None:
    """Sizes without errors have no χ² to be poor by, but one or two can refute the others."""
    if e.noise_known or not e.influence.outlier:
        return None
    return Finding(
        Status.poor_fit,
        f"Poor fit: by their scatter the other points leave no room for {e.influence.outlier} "
        f"(probability {e.influence.chance:.1g}): value and errors are spoilt. Measure "
        f"again, or fit with --robust. {_clear(e)}.",
    )


def _determined(e: Evidence) -> Finding:
    words = _clear(e) + few_words(e.rests_on) + _carried(e)
    if not e.dof:
        words += (
            "; not testable: three monitors give three numbers exactly, and nothing is left to "
            "test line and stated errors by, from which the error here is propagated"
        )
    if e.noise_known and e.chi2 > e.dof > 0:
        words += f"; errors are scaled by sqrt(chi2/dof) = {math.sqrt(e.chi2 / e.dof):.2f}"
    if e.noise_known and e.probability is not None and e.probability > OVERSTATED:
        words += (
            f"; chi2/dof = {_number(e.chi2 / e.dof)} is less than noise of the stated errors "
            f"leaves (probability {1 - e.probability:.1g}): they seem overstated, and so is the "
            "error here"
        )
    return Finding(Status.converged, words + ".")


# Of sizes whose line is known; on simulated noise and one-sided scans measured in docs/verdict.md.
BEAM_RULES = (_undetermined, _unsettled, _poor, _one_refutes, _determined)


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


def _carried(e: Evidence) -> str:
    """Say of a point that decides the answer what the others say."""
    point, shift = e.influence.carrying, e.influence.shift
    if not point:
        return ""
    if math.isnan(shift):
        return f"; it rests on the point at {point}, without which the rest determines none"
    more = "larger" if shift > 0 else "smaller"
    return (
        f"; it rests on the point at {point}: without it the emittance is {abs(shift):.1f} errors "
        f"{more}"
    )


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def one_magnet(settings: dict[str, np.ndarray], screens: tuple[str, ...]) -> np.ndarray | None:
    """The settings of the one magnet that was scanned before one screen; None if there were more.

    Examples
    --------
    >>> one_magnet({"Q1": np.zeros(3), "Q2": np.arange(3.0)}, ("S",) * 3).tolist()
    [0.0, 1.0, 2.0]
    """
    varied = [v for v in settings.values() if np.ptp(v) > 0]
    return varied[0] if len(varied) == 1 and len(set(screens)) == 1 else None


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
    varied = one_magnet(settings, screens)
    if varied is None:
        return None
    order = np.argsort(varied, kind="stable")
    size, error = size[order], error[order]
    low = int(np.argmin(size))
    rise = (size - size[low]) > 2.0 * np.hypot(error, error[low])
    return bool(rise[:low].any() and rise[low + 1 :].any())
