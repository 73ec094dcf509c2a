"""The ensemble sampler: start, warm-up, sampling until converged, verdict."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import nullcontext
from os import PathLike

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from beamfit.errors import InputError, Status, judge
from beamfit.sampling import store as disk
from beamfit.sampling.convergence import RULES, ChainEvidence, Diagnostics, diagnose, held_by_priors
from beamfit.sampling.moves import (
    IndependenceProposal,
    fit_proposal,
    long_move_share,
    mix_moves,
    proposal_about,
)
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.store import FROM_PYTHON, Checkpoint, Provenance
from beamfit.sampling.target import SamplingTarget
from beamfit.writing import alone

# Steps between two tests of the chain. All decisions are made at multiples of it, so that a run
# that was interrupted continues like an uninterrupted one.
BLOCK_STEPS = 50
# Steps at which the rounds of the warm-up end. The last round is the first one in whose second half
# R-hat is below `WARMUP_RHAT`.
WARMUP_ENDS = (100, 250, 500, 900, 1500, 2500)
# R-hat that ends the warm-up.
WARMUP_RHAT = 1.15
# Smallest number of walkers: enough to fit proposals to them.
MIN_WALKERS = 64
# Largest share of the time that is spent on writing checkpoints.
MAX_WRITING_SHARE = 0.05


def draw(
    target: SamplingTarget,
    *,
    seed: int = 0,
    target_ess: float = 4000.0,
    budget: int = 20_000,
    walkers: int | None = None,
    store: str | PathLike[str] | None = None,
    provenance: Provenance = FROM_PYTHON,
    progress: bool = False,
) -> Posterior:
    """Draw from a posterior until it is determined well enough or the budget is spent.

    Parameters
    ----------
    target : SamplingTarget
        The posterior to sample.
    seed : int
        Seed of the random numbers: the same seed, problem and versions give the same chain.
    target_ess : float
        Effective sample size of every number at which to stop, if the chain is also 50
        autocorrelation times long and split R-hat is below 1.01.
    budget : int
        Largest number of steps, the warm-up included.
    walkers : int, optional
        Number of walkers: even, and at least twice the number of sampled numbers. Default: four
        times that number, at least 64.
    store : str or path, optional
        HDF5 file of the chain. If it holds the beginning of this chain, sampling continues from
        there.
    provenance : Provenance
        Origin of the posterior, for the store.
    progress : bool
        True to show a progress bar on standard error.

    Returns
    -------
    Posterior
        A posterior that cannot be sampled raises nothing: `Posterior.status` states it.

    Raises
    ------
    InputError
        If an option has no meaning, or the store is of another problem, damaged or not writable.

    Notes
    -----
    The sampler is emcee (D. Foreman-Mackey et al., PASP 125, 306 (2013)) with the moves of
    `beamfit.sampling.moves`. The proposals of long moves are refitted to the walkers during the
    warm-up and fixed afterwards, so that the chain that is kept is an exact Markov chain.
    """
    walkers = walkers or max(MIN_WALKERS, 4 * len(target.names))
    _check_options(len(target.names), seed, target_ess, budget, walkers)
    with nullcontext() if store is None else alone(store):
        state = None if store is None else disk.load(store, target, seed, walkers)
        if target.open_directions:
            return _refuse(target, seed, Status.unidentified, target.open_directions)
        start, random = None, np.random.RandomState(seed)
        if state is None:
            start = first_walkers(target, walkers, random)
            if start is None:
                text = "no point within the bounds and constraints was found; relax them"
                return _refuse(target, seed, Status.infeasible, text)
            chain = np.zeros((0, *start.shape))
            state = Checkpoint(chain, chain[..., 0], random.get_state(), 0.5, 0, False, seed)
        stored, due, first_state = len(state.chain), time.perf_counter(), state
        with ProgressBar(progress, target_ess) as watch:
            for state, found in _sample_blocks(target, first_state, start, target_ess, budget):
                watch.show(state, found)
                if store is not None and time.perf_counter() >= due:
                    spent = disk.save(store, target, state, provenance)
                    stored, due = len(state.chain), time.perf_counter() + spent / MAX_WRITING_SHARE
        posterior = _conclude(target, state, target_ess, budget)
        if store is not None and (stored < len(state.chain) or not disk.finished(store)):
            disk.save(store, target, state, provenance, posterior.to_json())
        return posterior


def _check_options(n: int, seed: int, target_ess: float, budget: int, walkers: int) -> None:
    """Raise an error for options of `draw` that have no meaning."""
    if walkers < 2 * n or walkers % 2:
        raise InputError(f"{walkers} walkers for {n} numbers", f"an even number from {2 * n} on")
    if not target_ess > 0:
        raise InputError(f"a target of {target_ess} effective samples", "a positive number")
    if budget < BLOCK_STEPS:
        raise InputError(f"a budget of {budget} steps", f"{BLOCK_STEPS} or more")
    if not (isinstance(seed, int | np.integer) and 0 <= seed < 2**32):
        raise InputError(f"seed {seed!r}", "a whole number from 0 to 4294967295")


def first_walkers(
    target: SamplingTarget, number: int, random: np.random.RandomState
) -> np.ndarray | None:
    """Place walkers inside the feasible set, distributed with the fit's covariance.

    Parameters
    ----------
    target : SamplingTarget
        The posterior to sample.
    number : int
        Number of walkers.
    random : RandomState
        Random generator.

    Returns
    -------
    array, shape (number, n), or None
        None if no feasible point was found near the fit's optimum.
    """
    proposal = proposal_about(target.covariance, target.widening, target.blocks, 10.0)
    found = np.zeros((0, len(target.mode)))
    centre, reach = target.mode, 1.0
    for _ in range(80):  # closer to the optimum each time that few points are feasible
        offsets = proposal.draw(random, number) - target.mode
        points = centre + reach * offsets
        # Mirror points outside a bound: the distribution of the first walkers is arbitrary.
        points = np.where(points < target.lower, 2 * target.lower - points, points)
        points = np.where(points > target.upper, 2 * target.upper - points, points)
        points = np.clip(points, target.lower, target.upper)
        good = points[np.isfinite(target.log_probability(points))]
        found = np.concatenate([found, good])
        if len(found) >= number:
            return found[:number]
        if len(good) < number // 8:
            reach *= 0.7  # the feasible set is small
            centre = found[0] if len(found) else centre
    return None


def _sample_blocks(
    target: SamplingTarget,
    state: Checkpoint,
    start: np.ndarray | None,
    target_ess: float,
    budget: int,
) -> Iterator[tuple[Checkpoint, Diagnostics | None]]:
    """Sample block by block; all decisions depend on the chain alone."""
    proposal = _proposal(target, state)
    while True:
        found = _diagnose(state)
        enough = found is not None and found.settled and np.min(found.effective) >= target_ess
        if enough or len(state.chain) + BLOCK_STEPS > budget:
            return
        state, start = _sample_block(target, state, start, proposal), None
        if not state.producing and len(state.chain) in WARMUP_ENDS:
            state = state._replace(began=len(state.chain))
            proposal = _proposal(target, state)
            state = _set_share(target, state, proposal)
        yield state, found


def _diagnose(state: Checkpoint) -> Diagnostics | None:
    """Diagnose the chain at lengths that grow by a quarter; None between them."""
    length = len(state.counting)
    if length < 2 * BLOCK_STEPS:
        return None
    next_length = 2 * BLOCK_STEPS
    while next_length < length:
        next_length = BLOCK_STEPS * int(np.ceil(1.25 * next_length / BLOCK_STEPS))
    return diagnose(state.counting) if next_length == length else None


def _sample_block(
    target: SamplingTarget,
    state: Checkpoint,
    start: np.ndarray | None,
    proposal: IndependenceProposal,
) -> Checkpoint:
    """Advance the chain by one block."""
    import emcee

    backend = emcee.backends.Backend()
    sampler = emcee.EnsembleSampler(
        *state.chain.shape[1:],
        target.log_probability,
        moves=mix_moves(proposal, state.share),
        backend=backend,
        vectorize=True,
    )
    at, log_prob = (state.chain[-1], state.log_prob[-1]) if start is None else (start, None)
    last = emcee.State(at, log_prob, random_state=state.random_state)
    sampler.run_mcmc(last, BLOCK_STEPS, skip_initial_state_check=True)
    return state._replace(
        chain=np.concatenate([state.chain, backend.chain]),
        log_prob=np.concatenate([state.log_prob, backend.log_prob]),
        random_state=backend.random_state,
    )


def _half_round(state: Checkpoint) -> slice:
    """Return the second half of the warm-up round before the present proposal came into use."""
    before = max((end for end in WARMUP_ENDS if end < state.began), default=0)
    return slice((before + state.began) // 2, state.began)


def _proposal(target: SamplingTarget, state: Checkpoint) -> IndependenceProposal:
    """Make the proposal of long moves: from the fit at first, then from the last half round."""
    first = proposal_about(target.covariance, target.widening, target.blocks)
    recent = state.chain[_half_round(state)]
    return fit_proposal(recent.reshape(-1, recent.shape[2]), first) if state.began else first


def _set_share(
    target: SamplingTarget, state: Checkpoint, proposal: IndependenceProposal
) -> Checkpoint:
    """Set the share of long moves for the next steps; end the warm-up if the walkers agree."""
    half = _half_round(state)
    recent, log_prob = state.chain[half], state.log_prob[half]
    # A random generator of its own, so that testing a proposal does not change the chain.
    drawn = proposal.draw(np.random.RandomState(state.began), 8 * recent.shape[1])
    density = [target.log_probability(part) for part in np.split(drawn, 8)]
    points = recent.reshape(-1, recent.shape[2])
    share = long_move_share(proposal, points, log_prob.ravel(), drawn, np.concatenate(density))
    agreed = state.began > WARMUP_ENDS[0] and np.max(diagnose(recent).rhat) < WARMUP_RHAT
    return state._replace(share=share, producing=bool(agreed) or state.began == WARMUP_ENDS[-1])


def _refuse(target: SamplingTarget, seed: int, status: Status, text: str) -> Posterior:
    """Make a posterior that was not sampled, with the reason."""
    chain = np.zeros((0, 0, len(target.names)))
    names, diagnostics = (*target.derived_names, *target.names), diagnose(chain)
    message = f"Not sampled: {text}."
    return Posterior(
        target, chain, chain[..., 0], status, message, diagnostics, float("nan"), 0, seed, names
    )


def _conclude(
    target: SamplingTarget, state: Checkpoint, target_ess: float, budget: int
) -> Posterior:
    """Make the posterior of a finished chain, with its verdict."""
    chain, began = state.counting, state.began
    found = diagnose(chain)
    held = (*target.derived_names, *target.names)
    if len(chain):
        held = held_by_priors(target, chain.reshape(-1, chain.shape[2]))
    held = tuple(dict.fromkeys((*target.priors_own, *held)))
    shown = tuple(name for name in held if name not in target.hidden)
    verdict = judge(ChainEvidence(found, target, target_ess, budget, shown), RULES)
    sampled = (
        f"{np.min(found.effective):.0f} effective draws after {began} steps left out "
        f"(autocorrelation {np.max(found.autocorrelation):.1f} steps, "
        f"R-hat {np.max(found.rhat):.3f})."
    )
    text = (verdict.message, sampled if len(chain) else "", target.remark)
    return Posterior(
        target=target,
        chain=chain,
        log_prob=state.log_prob[len(state.log_prob) - len(chain) :],
        status=verdict.status,
        message=" ".join(part for part in text if part),
        diagnostics=found,
        acceptance=state.acceptance,
        warmup=began,
        seed=state.seed,
        held=held,
    )


class ProgressBar(Progress):
    """Progress bar of a run.

    Parameters
    ----------
    shown : bool
        True to show it.
    target_ess : float
        Effective sample size at which the run ends.
    """

    def __init__(self, shown: bool, target_ess: float) -> None:
        words = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
        place = Console(stderr=True)
        super().__init__(
            *words, TimeRemainingColumn(), console=place, transient=True, disable=not shown
        )
        self.target_ess, self.rate = target_ess, 0.0
        self.bar = self.add_task("warming up", total=None, text="")

    def show(self, state: Checkpoint, found: Diagnostics | None) -> None:
        """Update the bar; `found` has new diagnostics of the chain, if any."""
        if self.disable:
            return
        if found is not None:
            # Effective draws per step, for an estimate of the remaining time.
            self.rate = float(np.min(found.effective)) / max(found.steps, 1)
        text = f"{len(state.chain)} steps, {100 * state.acceptance:.0f} % accepted"
        reached = min(self.rate * len(state.counting), self.target_ess)
        if self.rate:
            text += f", {reached:.0f} of {self.target_ess:.0f} effective draws"
        word = "sampling" if state.producing else "warming up"
        total = self.target_ess if self.rate else None
        self.update(self.bar, description=word, completed=reached, total=total, text=text)
