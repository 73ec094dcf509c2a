"""A shift as one answer: scales, loss budget, best point, next decay, anomaly."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from beamfit.studies.decay.anomaly import Anomaly, find_anomaly
from beamfit.studies.decay.loss_budget import Machine, operation_during
from beamfit.studies.decay.next_decay import Candidate, Proposal, next_decays
from beamfit.studies.decay.operating_point import BestPoint, Limits, best_operating_point
from beamfit.studies.decay.scale_sample import Interval, budget_intervals, sample_scales
from beamfit.studies.decay.scales import ScaleFit, fit_scales
from beamfit.studies.decay.study import Decay

__all__ = ["Shift", "study_shift"]


@dataclass(frozen=True, eq=False)
class Shift:
    """What many decays say together.

    Parameters
    ----------
    fit : ScaleFit
        Scales on the mechanisms.
    budget : tuple of Interval
        Loss budget at the machine's usual settings, 68 % credible intervals.
    current : float
        Current for budget and best point, mA: the highest mean current of the decays.
    limits : Limits
        The range of settings seen, within which the best point is sought.
    best : BestPoint
        The longest lifetime within them.
    proposals : tuple of Proposal
        Decays to record next, the most informative first.
    anomaly : Anomaly or None
        Whether the second half departs from a model fitted to the first; None if the first half
        does not separate the mechanisms.
    """

    fit: ScaleFit
    budget: tuple[Interval, ...]
    current: float
    limits: Limits
    best: BestPoint
    proposals: tuple[Proposal, ...]
    anomaly: Anomaly | None

    def to_json(self) -> dict[str, Any]:
        """Return the answer as JSON's types, in SI, mA and h."""
        best = self.best
        return {
            "scales": self.fit.to_json(),
            "current": {"value": self.current, "error": None, "unit": "mA"},
            "budget": [row._asdict() for row in self.budget],
            "best": {
                "rf_voltage": best.rf_voltage.to_json(),
                "scraper_y": {"value": best.scraper_y, "error": None, "unit": "m"},
                "bunches": best.bunches,
                "lifetime": best.lifetime.to_json(),
                "usual": best.usual.to_json(),
                "message": best.message,
            },
            "next": [
                {
                    "rf_voltage_V": float(p.candidate.operation.rf_voltage),
                    "scraper_y_m": float(p.candidate.operation.scraper_y),
                    "bunches": float(p.candidate.operation.bunches),
                    "current_mA": p.candidate.current,
                    "information": p.information,
                }
                for p in self.proposals
            ],
            "anomaly": None
            if self.anomaly is None
            else {
                "status": self.anomaly.status.value,
                "message": self.anomaly.message,
                "since": self.anomaly.since,
                "moved": list(self.anomaly.moved),
                "a": self.anomaly.a.to_json(),
                "b": self.anomaly.b.to_json(),
                "probability": self.anomaly.probability,
            },
        }


def study_shift(decays: Sequence[Decay], machine: Machine, seed: int = 0) -> Shift:
    """Study the decays of a shift together.

    Parameters
    ----------
    decays : sequence of Decay
        In order of time, at different settings.
    machine : Machine
        The ring, and what the records do not say.
    seed : int, optional
        Of the random numbers.

    Returns
    -------
    Shift
        Also where mechanisms are not separable: the scales say so.

    Raises
    ------
    InputError
        As for `fit_scales`.
    """
    fit = fit_scales(decays, machine)
    sample = sample_scales(fit, seed=seed)
    current = max(decay.fit.mean_current for decay in decays)
    settings = [operation_during(decay.segment, machine) for decay in decays]
    limits = Limits(*(_range(settings, name) for name in Limits._fields))
    return Shift(
        fit=fit,
        budget=budget_intervals(fit, sample, machine.operation, current),
        current=current,
        limits=limits,
        best=best_operating_point(fit, sample, limits, current),
        proposals=next_decays(fit, _candidates(decays, machine, limits, current))[:3],
        anomaly=_anomaly(decays, machine),
    )


def _range(settings: Sequence, name: str) -> tuple[float, float]:
    values = [float(getattr(setting, name)) for setting in settings]
    return min(values), max(values)


def _candidates(
    decays: Sequence[Decay], machine: Machine, limits: Limits, current: float
) -> list[Candidate]:
    """The corners of what was seen, as long and as noisy as the decays were."""
    duration = float(np.median([d.segment.span for d in decays]))
    noise = float(np.median([d.fit.rms_residual / np.sqrt(len(d.segment) / 64) for d in decays]))
    lowest = min(decay.fit.mean_current for decay in decays)
    corners = itertools.product(*(sorted(set(pair)) for pair in (*limits, (lowest, current))))
    return [
        Candidate(
            machine.operation._replace(rf_voltage=voltage, scraper_y=scraper, bunches=bunches),
            at,
            duration,
            max(noise, 1e-9),
        )
        for voltage, scraper, bunches, at in corners
    ]


def _anomaly(decays: Sequence[Decay], machine: Machine) -> Anomaly | None:
    half = len(decays) // 2
    if half < 4:
        return None
    reference = fit_scales(decays[:half], machine)
    # What the first half does not tell, the second cannot contradict.
    if not np.isfinite(reference.covariance).all():
        return None
    return find_anomaly(reference, decays[half:])
