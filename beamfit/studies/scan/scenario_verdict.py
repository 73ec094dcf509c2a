"""Whether a scan determines the emittance when more than the beam is unknown: the rules."""

from __future__ import annotations

import math
from typing import NamedTuple

from beamfit.statistics import POOR_FIT
from beamfit.status import Status
from beamfit.studies.scan.verdict import CLEAR, few_words
from beamfit.verdict import Finding


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
    probability : float or None
        Of that χ².
    rests_on : float
        Degrees of freedom of the errors as scaled.
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
    probability: float | None
    rests_on: float
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
    return Finding(Status.unidentified, said, f"Needed: {u.remedy}." if u.remedy else "")


def _poor_in_scenario(u: Unknowns) -> Finding | None:
    if u.probability is None or u.probability >= POOR_FIT:
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
        f"errors away{few_words(u.rests_on)}.{u.remark}"
    )


# Of sizes when more than the beam is unknown.
SCENARIO_RULES = (
    _refuted_by_sizes, _no_answer, _left_open, _poor_in_scenario, _determined_in_scenario
)  # fmt: skip
