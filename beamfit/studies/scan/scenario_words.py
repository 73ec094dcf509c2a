"""What a scenario cannot know, and how far to believe it, in sentences."""

from __future__ import annotations

import math

from beamfit.greybox.fit import Fit
from beamfit.quantity import Status
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.results import Parameter, PlaneFit

__all__ = ["null_directions", "verdict_words"]

GAUGE = (
    "[A B] -> [A B] G with sigma -> G^-1 sigma G^-T leaves every size as it is, for any invertible "
    "2 x 2 matrix G (four directions; the emittance goes as 1/det G)"
)
POINTWISE = (
    "at each setting one size is measured for two numbers A and B: what one gives the other "
    "can take"
)
REMEDY = {
    "calibration": "a prior on {slope}, or a second screen (see beamfit design)",
    "transport-network": (
        "an anchor to first principles at every setting (--anchor first-principles=2%); T known at "
        "single settings or det T = 1 with C and D free do not suffice"
    ),
    "focusing-network": (
        "sizes at a second screen, or an anchor to the lattice's calibration "
        "(--anchor first-principles=2%)"
    ),
}


def null_directions(
    scenario: str, told: Assumptions, planes: tuple[PlaneFit, ...], parameters=()
) -> tuple[str, ...]:
    """Name the changes of the unknowns that the data do not see.

    Parameters
    ----------
    scenario : str
        Which scenario.
    told : Assumptions
        What it was told.
    planes : tuple of PlaneFit
        The judged planes.
    parameters : tuple of Parameter
        The fitted numbers besides the beam.

    Returns
    -------
    tuple of str
        Empty where everything asked for is determined.
    """
    open_planes = [p for p in planes if not p.identifiability.determined]
    said = []
    if scenario == "transport-network" and open_planes:
        return (GAUGE, POINTWISE)
    if scenario == "focusing-network" and open_planes:
        return (
            "at each setting k1 is free to take up what the beam leaves: another beam with another "
            "curve k1(I) gives the same sizes",
        )
    for parameter in parameters:
        if parameter.status is Status.converged:
            continue
        if parameter.name.endswith(("intercept", "coefficients.0")):
            said.append(
                f"{parameter.name}: a shift of k1 is undone by a lens at that magnet in the beam, "
                "so beta and alpha change and the emittance does not (exact for a thin lens)"
            )
        elif open_planes:
            said.append(
                f"{parameter.name}: a steeper calibration with a beam of smaller emittance gives "
                "the same sizes (emittance as 1/slope)"
            )
    if scenario == "calibration" and open_planes and not said:
        said.append("the calibration and the beam together: no single number is to blame")
    return tuple(said)


def verdict_words(
    scenario: str,
    told: Assumptions,
    fit: Fit,
    status: Status,
    distance: float,
    parameters: tuple[Parameter, ...],
    bounds_do_not_decide: bool,
) -> str:
    """One or two sentences for a plane: verdict, cause and remedy.

    Parameters
    ----------
    scenario, told, fit, parameters
        As elsewhere.
    status : Status
        The verdict on the plane.
    distance : float
        Standard errors between det sigma and zero.
    bounds_do_not_decide : bool
        Whether the error of the emittance rests on data and priors, not on bounds.

    Returns
    -------
    str
    """
    if status is Status.not_converged and scenario.endswith("network"):
        return (
            f"The search from {told.starts} starts came to no rest (chi2 = {fit.chi2:.4g}); give "
            "more starts, another seed, or fewer hidden nodes."
        )
    if status in (Status.not_finite, Status.not_converged, Status.infeasible):
        return fit.message[0].upper() + fit.message[1:]
    tied = "" if told.anchor.words == "none" else f" with {told.anchor.words}"
    if status is Status.unidentified:
        slope = next(
            (p.name for p in parameters if p.name.endswith(("slope", "scale", ".1"))), "the slope"
        )
        remedy = REMEDY[scenario].format(slope=slope)
        why = (
            f"zero emittance lies only {distance:.1f} standard errors away"
            if bounds_do_not_decide
            else "its value is decided by bounds and starting point, not by the data"
        )
        edge = "".join(
            f"; {p.name} ends at its {p.state} bound {p.value.value:.6g} "
            f"(d(chi2/2)/d(bound) = {p.multiplier:.2g})"
            for p in parameters
            if p.state in ("lower", "upper")
        )
        return f"Not determined in scenario {scenario}{tied}: {why}{edge}. Needed: {remedy}."
    words = (
        f"Determined in scenario {scenario}{tied}: zero emittance is {distance:.0f} standard "
        "errors away."
    )
    if status is Status.poor_fit:
        ratio = fit.chi2 / fit.dof
        words = (
            f"Poor fit: chi2/dof = {ratio:.2g} over all planes; the sizes' errors are scaled by "
            f"{math.sqrt(ratio):.1f}. " + words
        )
    open_ones = [p.name for p in parameters if p.status is not Status.converged]
    if open_ones:
        words += f" {', '.join(open_ones)} not determined: what depends on it has no error"
        words += ", and the emittance hardly does." if scenario == "calibration" else "."
    priors = [p.name for p in parameters if p.prior is not None]
    if priors:
        words += f" Rests on the prior of {', '.join(priors)}."
    return words
