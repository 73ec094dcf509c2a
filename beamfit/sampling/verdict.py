"""What a chain is worth: rules of its verdict, the gravest first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.sampling.convergence import Diagnostics
from beamfit.sampling.likelihood import FRACTION, Group, noise_words
from beamfit.sampling.summary import plain_name
from beamfit.sampling.target import Target
from beamfit.status import Status
from beamfit.verdict import Finding

__all__ = ["RULES", "Evidence", "held_by_priors"]

# Data that leave this much of a prior's width have told a little more than half of what it did.
LITTLE = 0.8


class Evidence(NamedTuple):
    """What the rules look at: a chain's diagnostics, what was asked, and what the fit said.

    `held` names the numbers asked for that the prior or the bounds decide.
    """

    diagnostics: Diagnostics
    names: tuple[str, ...]
    target_ess: float
    budget: int
    held: tuple[str, ...]
    fit: Finding
    groups: tuple[Group, ...]


def held_by_priors(target: Target, draws: np.ndarray) -> tuple[str, ...]:
    """Name the numbers whose posterior is about as wide as what held them beforehand.

    Parameters
    ----------
    target : Target
        The problem.
    draws : array, shape (m, n)
        Its draws.

    Returns
    -------
    tuple of str
        Numbers spread by 0.8 or more of their prior, or of a flat one between their bounds.
    """
    before = (target.upper - target.lower) / np.sqrt(12.0)
    for name, prior in target.priors.items():
        i = target.names.index(name)
        before[i] = min(float(prior.std()), before[i])
    wide = np.isfinite(before) & (np.std(draws, axis=0) > LITTLE * before)
    # How many points are outliers is asked on the way; its prior is the sampler's own.
    return tuple(
        name
        for name, held in zip(target.names, wide, strict=True)
        if held and not name.endswith(FRACTION)
    )


def _never_settled(e: Evidence) -> Finding | None:
    if e.diagnostics.steps:
        return None
    said = f"The walkers did not settle within the budget of {e.budget} steps: raise it."
    return Finding(Status.not_converged, said)


def _walkers_disagree(e: Evidence) -> Finding | None:
    if e.diagnostics.settled:
        return None
    worst = e.names[int(np.argmax(e.diagnostics.rhat / (1 + 1 / e.diagnostics.effective)))]
    cause = f"The budget of {e.budget} steps ended before the walkers agreed"
    said = f"{cause} (slowest: {plain_name(worst)}): raise it, and distrust the intervals."
    return Finding(Status.not_converged, said)


def _too_few_draws(e: Evidence) -> Finding | None:
    if np.min(e.diagnostics.effective) >= e.target_ess:
        return None
    cause = f"The walkers agree, but the budget of {e.budget} steps ended before"
    said = f"{cause} {e.target_ess:.0f} effective draws: raise it for smoother intervals."
    return Finding(Status.not_converged, said)


def _priors_decide(e: Evidence) -> Finding | None:
    if not e.held:
        return None
    named = ", ".join(plain_name(name) for name in e.held)
    cause = f"What is said of {named} is the prior's or the bounds', not the data's:"
    return Finding(
        Status.unidentified, f"{cause} measure more, or bring a prior of which you are sure."
    )


def _poor_model(e: Evidence) -> Finding | None:
    forgiving = any(group.inferred or group.outliers for group in e.groups)
    if e.fit.status is not Status.poor_fit or forgiving:
        return None
    cause = "The fit is poor, and with errors taken as known the intervals are too narrow:"
    return Finding(Status.poor_fit, f"{cause} mend the model, or infer the noise.")


def _agreed(e: Evidence) -> Finding:
    return Finding(Status.converged, f"The walkers agree; errors {noise_words(e.groups)}.")


RULES = (_never_settled, _walkers_disagree, _too_few_draws, _priors_decide, _poor_model, _agreed)
