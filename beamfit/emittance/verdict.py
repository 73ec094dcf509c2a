"""Verdict on a plane's emittance: the comparison of models in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from beamfit.emittance.comparison import (
    BEAM,
    CONSTANT,
    CURVE,
    DRIFTING,
    RANDOM,
    ZERO_EMITTANCE,
    PlanePosterior,
    PlaneSizes,
)
from beamfit.emittance.results import Points
from beamfit.errors import Finding, Status
from beamfit.quantity import display_unit
from beamfit.statistics import of_use

# Probability above which a model is sure: one answer in a hundred may be wrong.
SURE = 0.99
# A point carries the answer if the emittance moves by more than this many errors without it, which
# is outside the 95 % interval; the interval is then extended to that emittance.
CARRYING_SHIFT = 2.0
# An error above this multiple of the one from the stated errors alone is explained in a sentence.
ENLARGED_ERROR = 1.5
# Stated errors are called too large above this probability of a larger χ²: one scan in a thousand.
OVERSTATED_PROBABILITY = 0.999
# Largest number of points that a sentence names.
MAX_NAMED = 5
# Checks to suggest where a rival explains the sizes.
REMEDIES = {
    ZERO_EMITTANCE: "The smallest sizes decide: measure over the waist, and check resolution_um.",
    CONSTANT: "Check that the magnet moved and that the screen shows the beam, and scan further.",
    RANDOM: "Check settings, units, energy and screen, or measure more settings.",
    DRIFTING: "Check that the beam was stable while the scan was taken.",
    CURVE: (
        "Check the line, the settings' units, and how sizes are taken from the profile "
        "(saturation, background, cut edges)."
    ),
}


@dataclass(frozen=True, eq=False)
class PlaneEvidence:
    """Evidence for the verdict on one plane.

    Attributes
    ----------
    posterior : PlanePosterior
        Probabilities of a beam and its rivals.
    sizes : PlaneSizes
        Measured sizes.
    low, high : float
        Central 95 % of the normalised emittance, m; infinite where other unknowns leave it open.
    bracketed : bool or None
        Whether the waist is bracketed.
    ending : Finding or None
        Result of a failed search, or of an emittance beyond any accelerator's.
    scenario : str
        Free parameters besides the beam, in words; empty if there are none.
    open_cause : str
        Reason why a scenario leaves the emittance open, in words.
    remedy : str
        Measurement or input that would determine it, in words.
    """

    posterior: PlanePosterior
    sizes: PlaneSizes
    low: float
    high: float
    bracketed: bool | None = None
    ending: Finding | None = None
    scenario: str = ""
    open_cause: str = ""
    remedy: str = ""

    @property
    def beam(self) -> float:
        """Probability of a beam."""
        return self.posterior.probability[BEAM]

    @property
    def three_points(self) -> bool:
        """True if there are at most three points: no degree of freedom is left for a test."""
        return len(self.sizes.size) <= 3

    @property
    def untested(self) -> bool:
        """True for three monitors with stated errors: an answer that cannot be tested."""
        return self.three_points and not self.sizes.moved and self.sizes.error is not None

    @cached_property
    def of_a_beam(self) -> bool:
        """True if the sizes are a beam's, of zero emittance or not."""
        if not self.posterior.separable or self.three_points:
            return self.posterior.separable and self.untested
        return self.beam + self.posterior.probability[ZERO_EMITTANCE] > SURE

    @cached_property
    def determined(self) -> bool:
        """True if the sizes are a beam's and determine its emittance."""
        is_sure = self.untested or self.beam > SURE
        useful = of_use((self.low, self.high)) and not self.open_cause and self.ending is None
        return self.of_a_beam and is_sure and useful


def verdict(evidence: PlaneEvidence, remarks: str = "", advice: str = "") -> Finding:
    """State whether a plane's sizes determine its emittance.

    Parameters
    ----------
    evidence : PlaneEvidence
        Evidence of the plane.
    remarks : str
        Further sentences on noise and points.
    advice : str
        Next measurement, in words.
    """
    if evidence.ending is not None and (
        evidence.of_a_beam or evidence.ending.status is not Status.not_converged
    ):
        return evidence.ending
    if evidence.determined:
        return Finding(Status.converged, f"{_determined_sentence(evidence)} {remarks}".strip())
    posterior, status = evidence.posterior, Status.unidentified
    if posterior.cause == CURVE and posterior.probability[CURVE] > SURE:
        status = Status.poor_fit
    where = f" in scenario {evidence.scenario}" if evidence.scenario else ""
    sentence = f"Not determined{where}: {_undetermined_cause(evidence)}."
    remedies = [
        advice or (_remedy(evidence) if not evidence.of_a_beam and posterior.separable else "")
    ]
    remedies += [f"Needed: {evidence.remedy}."] if evidence.remedy and evidence.of_a_beam else []
    return Finding(status, f"{sentence} {remarks}".strip(), " ".join(filter(None, remedies)))


def _determined_sentence(evidence: PlaneEvidence) -> str:
    """Sentence on an emittance that is determined."""
    where = f" in scenario {evidence.scenario}" if evidence.scenario else ""
    if evidence.untested:
        return (
            f"Determined{where}, but not testable: three monitors give three numbers exactly, and "
            "nothing is left to test line and stated errors by."
        )
    waist = {None: "", True: ", the waist is bracketed", False: ", the waist is not bracketed"}
    sure = f"P > {SURE:g}" if evidence.beam > SURE else f"P = {evidence.beam:.2f}"
    return (
        f"Determined{where}: the sizes are those of a beam with {sure}{waist[evidence.bracketed]}."
    )


def _best_rival(evidence: PlaneEvidence) -> str:
    """The most probable model other than a beam, of zero emittance or not."""
    rest = {
        k: v for k, v in evidence.posterior.probability.items() if k not in (BEAM, ZERO_EMITTANCE)
    }
    return max(rest, key=rest.__getitem__)


def _remedy(evidence: PlaneEvidence) -> str:
    """Checks to suggest where the sizes may be a rival's."""
    rival = evidence.posterior.cause
    return REMEDIES.get(
        _best_rival(evidence) if rival == BEAM and not evidence.three_points else rival, ""
    )


def _undetermined_cause(evidence: PlaneEvidence) -> str:
    """Reason why the emittance is not determined, in words."""
    probability, rival = evidence.posterior.probability, evidence.posterior.cause
    if not evidence.posterior.separable:
        return (
            "the settings do not separate the three numbers of the beam matrix, as if the "
            "scanned magnet were downstream of the screen or hardly moved"
        )
    if evidence.three_points and not evidence.untested:
        return (
            "three points fit any three numbers exactly and leave nothing to judge them by; "
            "measure a fourth setting"
        )
    other = _best_rival(evidence)
    undecided = (
        f"these sizes may be a beam's (P = {evidence.beam:.4g}, and {SURE:g} is needed), or else "
        f"{other} (P = {probability[other]:.2g})"
    )
    if not evidence.of_a_beam:
        if rival in (BEAM, ZERO_EMITTANCE):
            return undecided
        return f"the sizes look like {rival} (P = {probability[rival]:.2g}), not like a beam's"
    if evidence.open_cause:
        return evidence.open_cause
    if evidence.beam <= SURE:
        if probability[other] > probability[ZERO_EMITTANCE]:
            return undecided
        no_emittance = probability[ZERO_EMITTANCE]
        return f"a beam of no emittance explains the sizes, too (P = {no_emittance:.2g})"
    if not evidence.low > 0.0:
        return "the 95 % interval of the emittance begins at zero"
    factor = evidence.high / evidence.low
    factor_text = f"{factor:.2g}" if factor < 100 else "more than 100"
    waist = " and the waist is not bracketed" if evidence.bracketed is False else ""
    return f"the 95 % interval of the emittance spans a factor {factor_text}{waist}"


def noise_remark(
    noise: str, scale: np.ndarray, probability: float | None = None, enlarged: float = 1.0
) -> str:
    """Describe the noise where it differs from the stated errors.

    Parameters
    ----------
    noise : {"stated", "share", "beyond", "shots", "none"}
        Kind of errors given, or "beyond" if settings scatter beyond their stated errors.
    scale : ndarray
        Median and central 68 % of the noise scale.
    probability : float, optional
        Probability of a χ² at least as large as that of the stated errors.
    enlarged : float
        Ratio of the error to the one from the stated errors alone.

    Examples
    --------
    >>> noise_remark("stated", np.array([2.0, 1.6, 2.5]))
    'Stated errors are too small by a factor 2 (1.6 to 2.5), which the error includes.'
    """
    middle, low, high = scale
    if noise in ("stated", "share"):
        if low > 1.05:
            return (
                f"Stated errors are too small by a factor {middle:.2g} ({low:.2g} to {high:.2g}), "
                "which the error includes."
            )
        if probability is not None and probability > OVERSTATED_PROBABILITY:
            rest = 1.0 - probability
            chance = f"{rest:.1g}" if rest > 1e-6 else "below 1e-6"
            return (
                "Stated errors seem too large, and so is the error here: the sizes scatter less "
                f"(probability {chance})."
            )
        if enlarged > ENLARGED_ERROR:
            return (
                f"The error is {enlarged:.2g} times that by the stated errors alone: errors like "
                "these are often too small, and these points do not tell."
            )
    if noise in ("shots", "beyond") and middle > 0.005:
        baseline = "shots" if noise == "shots" else "stated errors"
        return (
            f"Settings scatter by {100 * middle:.2g} % ({round(100 * low, 2):.2g} to "
            f"{100 * high:.2g} %) of the size beyond their {baseline}, which the error includes."
        )
    return ""


def point_remarks(points: Points, carrying: str = "", without: float = math.nan) -> Iterator[str]:
    """Name bad readings, and the point that carries the answer.

    Parameters
    ----------
    points : Points
        Points with their probability of being bad.
    carrying, without : str and float
        Point without which the emittance moves most, and the normalised emittance without it, m;
        NaN where the other points give none.
    """
    bad = np.flatnonzero(points.outlier_probability > 0.5)
    if len(bad):
        verb = "are" if len(bad) > 1 else "is"
        bad_count = f"{len(bad)} of {len(points.size)} readings {verb} probably bad"
        yield f"{bad_count}: {name_places([points.where(i) for i in bad])}."
    if carrying and math.isnan(without):
        yield f"It rests on the point at {carrying}: without it there is no answer."
    elif carrying:
        factor, unit = display_unit(without, "m")
        yield (
            f"It rests on the point at {carrying}: without it the normalised emittance is "
            f"{without / factor:.3g} {unit}, to which the interval reaches."
        )


def suspect_remark(points: Points, beam: float) -> str:
    """Name readings that are probably bad, where the sizes are a beam's with probability `beam`."""
    bad = np.flatnonzero(beam * points.outlier_probability > 0.5)
    if not len(bad):
        return ""
    verb, object_ = ("are", "them") if len(bad) > 1 else ("is", "it")
    places = name_places([points.where(i) for i in bad])
    return (
        f"If they are, {len(bad)} of {len(points.size)} readings {verb} bad: {places}. Measure "
        f"{object_} again, or leave {object_} out."
    )


def name_places(places: Sequence[str]) -> str:
    """List the first few places.

    Examples
    --------
    >>> name_places("abcdefg")
    'a; b; c; d; e; 2 more'
    """
    more = len(places) - MAX_NAMED
    return "; ".join([*places[:MAX_NAMED], *[f"{more} more"] * (more > 0)])


def resolution_remark(size: np.ndarray, known: np.ndarray) -> str:
    """Count sizes below the contribution ``known`` of resolution and dispersion, in m².

    Examples
    --------
    >>> resolution_remark(np.array([2e-5, 9e-5]), np.array([9e-10, 9e-10]))
    '1 of 2 sizes is smaller than resolution and dispersion alone make it: check both.'
    """
    below = int(np.sum(size**2 < known))
    if not below:
        return ""
    verb, them = ("are", "them") if below > 1 else ("is", "it")
    return (
        f"{below} of {len(size)} sizes {verb} smaller than resolution and dispersion alone make "
        f"{them}: check both."
    )


def waist_bracketed(
    settings: dict[str, np.ndarray], screens: tuple[str, ...], size: np.ndarray, error: np.ndarray
) -> bool | None:
    """Test whether the sizes rise by two standard errors on both sides of the smallest.

    Parameters
    ----------
    settings : dict of str to ndarray
        Magnet name to settings.
    screens : tuple of str
        Screen of each point.
    size, error : ndarray
        Sizes and errors, m.

    Returns
    -------
    bool or None
        None if several magnets or screens were varied, so that there are no two sides.

    Examples
    --------
    >>> sizes = np.array([2.0, 1.0, 3.0])
    >>> waist_bracketed({"Q": np.arange(3.0)}, ("S",) * 3, sizes, 0.1 * sizes)
    True
    """
    varied = [v for v in settings.values() if np.ptp(v) > 0]
    if len(varied) != 1 or len(set(screens)) != 1:
        return None
    order = np.argsort(varied[0], kind="stable")
    size, error = size[order], error[order]
    low = int(np.argmin(size))
    rise = (size - size[low]) > 2.0 * np.hypot(error, error[low])
    return bool(rise[:low].any() and rise[low + 1 :].any())
