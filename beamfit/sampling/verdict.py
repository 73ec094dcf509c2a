"""What a chain is worth: status and sentence, the gravest first."""

from __future__ import annotations

import numpy as np

from beamfit.sampling.convergence import Diagnostics, diagnose
from beamfit.sampling.likelihood import FRACTION
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.store import Checkpoint
from beamfit.sampling.target import Target
from beamfit.sampling.text import noise_words, plain_name
from beamfit.status import Status

__all__ = ["conclude", "held_by_priors", "refused"]

# Data that leave this much of a prior's width have told a little more than half of what it did.
LITTLE = 0.8


def refused(target: Target, seed: int, status: str, said: str) -> Posterior:
    """A posterior that was not sampled, and why."""
    n = len(target.names)
    chain = np.zeros((0, 0, n))
    message = f"Not sampled: {said}."
    return Posterior(
        target=target,
        chain=chain,
        log_prob=np.zeros((0, 0)),
        status=Status(status),
        message=message,
        diagnostics=diagnose(chain),
        acceptance=float("nan"),
        warmup=0,
        seed=seed,
        held=(*target.derived_names, *target.names),
    )


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
    spread = np.std(draws, axis=0)
    box = (target.upper - target.lower) / np.sqrt(12.0)
    names = []
    for i, name in enumerate(target.names):
        prior = target.priors.get(name)
        before = box[i] if prior is None else min(float(prior.std()), box[i])
        # How many points are outliers is asked on the way; its prior is the sampler's own.
        if not name.endswith(FRACTION) and np.isfinite(before) and spread[i] > LITTLE * before:
            names.append(name)
    return tuple(names)


def _sampled(found: Diagnostics, steps_before: int) -> str:
    return (
        f"{np.min(found.effective):.0f} effective draws after {steps_before} steps left out "
        f"(autocorrelation {np.max(found.autocorrelation):.1f} steps, "
        f"R-hat {np.max(found.rhat):.3f})"
    )


def conclude(
    target: Target, state: Checkpoint, found: Diagnostics, target_ess: float, budget: int
) -> Posterior:
    """Judge a finished chain.

    Parameters
    ----------
    target : Target
        What was sampled.
    state : Checkpoint
        The chain.
    found : Diagnostics
        Of the part that counts.
    target_ess, budget : float, int
        What was asked.

    Returns
    -------
    Posterior
    """
    chain, log_prob = state.chain[state.began :], state.log_prob[state.began :]
    if not state.producing:
        chain, log_prob = state.chain[:0], state.log_prob[:0]
    draws = chain.reshape(-1, chain.shape[2])
    held = held_by_priors(target, draws) if len(draws) else (*target.derived_names, *target.names)
    held = tuple(dict.fromkeys((*target.priors_own, *held)))
    shown = [plain_name(name) for name in held if name not in target.hidden]
    status, message = _judge(target, found, target_ess, budget, len(draws) > 0, shown)
    if len(draws):
        message = f"{message} {_sampled(found, state.began)}."
    message = f"{message} {target.remark}".strip()
    return Posterior(
        target=target,
        chain=chain,
        log_prob=log_prob,
        status=status,
        message=message,
        diagnostics=found,
        acceptance=float(np.mean(state.accepted - state.accepted_before)) / max(len(chain), 1),
        warmup=state.began,
        seed=state.seed,
        held=held,
    )


def _judge(
    target: Target,
    found: Diagnostics,
    target_ess: float,
    budget: int,
    sampled: bool,
    held: list[str],
) -> tuple[Status, str]:
    """Status, and the sentence without the count of draws."""
    if not sampled:
        said = f"The walkers did not settle within the budget of {budget} steps: raise it."
        return Status.not_converged, said
    if not found.settled:
        worst = plain_name(target.names[int(np.argmax(found.rhat / (1 + 1 / found.effective)))])
        said = (
            f"The budget of {budget} steps ended before the walkers agreed (slowest: {worst}): "
            "raise it, and distrust the intervals."
        )
        return Status.not_converged, said
    if np.min(found.effective) < target_ess:
        said = (
            f"The walkers agree, but the budget of {budget} steps ended before {target_ess:.0f} "
            "effective draws: raise it for smoother intervals."
        )
        return Status.not_converged, said
    if held:
        said = (
            f"What is said of {', '.join(held)} is the prior's or the bounds', not the data's: "
            "measure more, or bring a prior of which you are sure."
        )
        return Status.unidentified, said
    groups = target.likelihood.groups
    if target.verdict[0] == "poor_fit" and all(
        group.noise == "known" and not group.outliers for group in groups
    ):
        said = (
            "The fit is poor, and with errors taken as known the intervals are too narrow: mend "
            "the model, or infer the noise."
        )
        return Status.poor_fit, said
    return Status.converged, f"The walkers agree; errors {noise_words(target.likelihood)}."
