"""The rules by which scales of many decays are judged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from beamfit.lifetime.losses import SCALES
from beamfit.quantity import Quantity, Status
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.verdict import Finding, judge

# The scale of the RF voltage, fitted where a prior says how well its reading is calibrated.
VOLTAGE = "rf_voltage"


class ScaleEvidence(NamedTuple):
    """What the rules look at."""

    scales: Mapping[str, Quantity]
    chi2: float
    dof: int
    ended: bool
    decays: int

    @property
    def improbable(self) -> bool:
        """Whether chi² is."""
        return self.dof > 0 and chi2_probability(self.chi2, self.dof) < POOR_FIT


def _lost(e: ScaleEvidence) -> Finding | None:
    said = "The search for the scales did not end: look at the records."
    return None if e.ended else Finding(Status.not_converged, said)


def _blind(e: ScaleEvidence) -> Finding | None:
    names = [name for name, scale in e.scales.items() if scale.error is None and name in SCALES]
    if not names:
        return None
    many = "one decay" if e.decays == 1 else f"{e.decays} decays"
    advice = ", ".join(dict.fromkeys(SCALES[name] for name in names))
    more = ""
    if e.improbable:
        more = f" First principles miss something besides: chi²/dof is {e.chi2 / e.dof:.3g}."
    return Finding(
        Status.unidentified,
        f"{' and '.join(names)} not separable by {many}: vary {advice}, or give a prior.{more}",
    )


def _improbable(e: ScaleEvidence) -> Finding | None:
    if not e.improbable:
        return None
    return Finding(
        Status.poor_fit,
        f"chi²/dof is {e.chi2 / e.dof:.3g}, improbable for first principles with these scales; "
        "the errors are enlarged to match: look for an anomaly, or correct by a network.",
    )


def _separable(e: ScaleEvidence) -> Finding:
    return Finding(Status.converged, "Every mechanism is separable.")


RULES = (_lost, _blind, _improbable, _separable)


def finding_of_scales(evidence: ScaleEvidence) -> Finding:
    """Status and sentences on the scales."""
    found = judge(evidence, RULES)
    voltage = evidence.scales.get(VOLTAGE)
    if voltage is None or voltage.error is not None:
        return found
    said = f"{found.cause} The decays do not tell the scale of the RF voltage: its prior does."
    return Finding(found.status, said)
