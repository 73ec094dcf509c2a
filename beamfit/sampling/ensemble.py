"""The sampler: start, warm up, sample, judge, go on or stop."""

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
from beamfit.sampling.moves import IndependenceProposal, about, fitted, moves_of, share_of
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.store import FROM_PYTHON, Checkpoint, Provenance
from beamfit.sampling.target import SamplingTarget
from beamfit.writing import alone

# Steps between two looks at the chain; every decision falls at a multiple, so that a run that was
# interrupted decides as the uninterrupted one did.
BLOCK = 50
# Steps at which the rounds of the warm-up end, until R-hat within half a round falls below WARM.
ROUNDS = (100, 250, 500, 900, 1500, 2500)
# R-hat that ends the warm-up.
WARM = 1.15
# Fewest walkers, for proposals fitted to them.
FEWEST_WALKERS = 64
# Largest share of the time spent on writing checkpoints.
WRITING = 0.05


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
    """Draw from a posterior until enough is known or the budget is spent.

    Parameters
    ----------
    target : SamplingTarget
        What to sample.
    seed : int
        Of the random numbers: the same seed, problem and versions give the same chain.
    target_ess : float
        Effective sample size of every number at which to stop, once the chain is also 50
        autocorrelation times long and split R-hat below 1.01.
    budget : int
        Steps at which to stop in any case, the warm-up included.
    walkers : int, optional
        Even, and at least twice the numbers; 64 or four times the numbers by default.
    store : str or path, optional
        HDF5 file to keep the chain in. If it holds the beginning of this chain, sampling goes on
        from there.
    provenance : Provenance
        For the store.
    progress : bool
        Show a progress bar on standard error.

    Returns
    -------
    Posterior
        Never raises for a posterior that cannot be sampled: `Posterior.status` says so.

    Raises
    ------
    InputError
        If an option makes no sense or the store is of another problem, damaged or not writable.

    Notes
    -----
    The ensemble sampler emcee (D. Foreman-Mackey et al., PASP 125, 306 (2013)) with the moves of
    `beamfit.sampling.moves`. The proposals of the leaps are refitted to the walkers during the
    warm-up and stay fixed afterwards, so that what is kept is an exact Markov chain.
    """
    walkers = walkers or max(FEWEST_WALKERS, 4 * len(target.names))
    _check_options(len(target.names), seed, target_ess, budget, walkers)
    with nullcontext() if store is None else alone(store):
        state = None if store is None else disk.load(store, target, seed, walkers)
        if target.open_directions:
            return _refused(target, seed, Status.unidentified, target.open_directions)
        start, random = None, np.random.RandomState(seed)
        if state is None:
            start = first_walkers(target, walkers, random)
            if start is None:
                said = "no point within the bounds and constraints was found; relax them"
                return _refused(target, seed, Status.infeasible, said)
            chain = np.zeros((0, *start.shape))
            state = Checkpoint(chain, chain[..., 0], random.get_state(), 0.5, 0, False, seed)
        stored, due, begun = len(state.chain), time.perf_counter(), state
        with Watch(progress, target_ess) as watch:
            for state, found in _blocks(target, begun, start, target_ess, budget):
                watch.show(state, found)
                if store is not None and time.perf_counter() >= due:
                    spent = disk.save(store, target, state, provenance)
                    stored, due = len(state.chain), time.perf_counter() + spent / WRITING
        posterior = _concluded(target, state, target_ess, budget)
        if store is not None and (stored < len(state.chain) or not disk.finished(store)):
            disk.save(store, target, state, provenance, posterior.to_json())
        return posterior


def _check_options(n: int, seed: int, target_ess: float, budget: int, walkers: int) -> None:
    if walkers < 2 * n or walkers % 2:
        raise InputError(f"{walkers} walkers for {n} numbers", f"an even number from {2 * n} on")
    if not target_ess > 0:
        raise InputError(f"a target of {target_ess} effective samples", "a positive number")
    if budget < BLOCK:
        raise InputError(f"a budget of {budget} steps", f"{BLOCK} or more")
    if not (isinstance(seed, int | np.integer) and 0 <= seed < 2**32):
        raise InputError(f"seed {seed!r}", "a whole number from 0 to 4294967295")


def first_walkers(
    target: SamplingTarget, number: int, random: np.random.RandomState
) -> np.ndarray | None:
    """Place walkers inside the feasible set, spread as the fit's covariance says.

    Parameters
    ----------
    target : SamplingTarget
        What is to be sampled.
    number : int
        How many.
    random : RandomState
        Where chance comes from.

    Returns
    -------
    array, shape (number, n), or None
        None if no feasible point was found, however near the fit's optimum.
    """
    proposal = about(target.covariance, target.widening, target.blocks, 10.0)
    found = np.zeros((0, len(target.mode)))
    centre, reach = target.mode, 1.0
    for _ in range(80):  # nearer, each time that few are feasible
        offsets = proposal.draw(random, number) - target.mode
        points = centre + reach * offsets
        # Walkers may start anywhere, so those outside a bound are mirrored into it.
        points = np.where(points < target.lower, 2 * target.lower - points, points)
        points = np.where(points > target.upper, 2 * target.upper - points, points)
        points = np.clip(points, target.lower, target.upper)
        good = points[np.isfinite(target.log_probability(points))]
        found = np.concatenate([found, good])
        if len(found) >= number:
            return found[:number]
        if len(good) < number // 8:
            reach *= 0.7  # the feasible set is small: look nearer
            centre = found[0] if len(found) else centre
    return None


def _blocks(
    target: SamplingTarget,
    state: Checkpoint,
    start: np.ndarray | None,
    target_ess: float,
    budget: int,
) -> Iterator[tuple[Checkpoint, Diagnostics | None]]:
    """Sample block by block; every decision depends on the chain alone."""
    proposal = _proposal(target, state)
    while True:
        found = _judged(state)
        enough = found is not None and found.settled and np.min(found.effective) >= target_ess
        if enough or len(state.chain) + BLOCK > budget:
            return
        state, start = _block(target, state, start, proposal), None
        if not state.producing and len(state.chain) in ROUNDS:
            state = state._replace(began=len(state.chain))
            proposal = _proposal(target, state)
            state = _next_stage(target, state, proposal)
        yield state, found


def _judged(state: Checkpoint) -> Diagnostics | None:
    """Judge the chain at lengths that grow by a quarter, None between them."""
    length = len(state.counting)
    if length < 2 * BLOCK:
        return None
    look = 2 * BLOCK
    while look < length:
        look = BLOCK * int(np.ceil(1.25 * look / BLOCK))
    return diagnose(state.counting) if look == length else None


def _block(
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
        moves=moves_of(proposal, state.share),
        backend=backend,
        vectorize=True,
    )
    at, log_prob = (state.chain[-1], state.log_prob[-1]) if start is None else (start, None)
    last = emcee.State(at, log_prob, random_state=state.random_state)
    sampler.run_mcmc(last, BLOCK, skip_initial_state_check=True)
    return state._replace(
        chain=np.concatenate([state.chain, backend.chain]),
        log_prob=np.concatenate([state.log_prob, backend.log_prob]),
        random_state=backend.random_state,
    )


def _half_round(state: Checkpoint) -> slice:
    """The later half of the round of the warm-up that ended where the present stage began."""
    before = max((end for end in ROUNDS if end < state.began), default=0)
    return slice((before + state.began) // 2, state.began)


def _proposal(target: SamplingTarget, state: Checkpoint) -> IndependenceProposal:
    """Proposal of long moves: about the fit at first, then fitted to the last half round."""
    first = about(target.covariance, target.widening, target.blocks)
    recent = state.chain[_half_round(state)]
    return fitted(recent.reshape(-1, recent.shape[2]), first) if state.began else first


def _next_stage(
    target: SamplingTarget, state: Checkpoint, proposal: IndependenceProposal
) -> Checkpoint:
    """Set the share of long moves from now on; end the warm-up once the walkers agree."""
    half = _half_round(state)
    recent, log_prob = state.chain[half], state.log_prob[half]
    # Chance of its own, so that looking at a proposal does not change the chain.
    drawn = proposal.draw(np.random.RandomState(state.began), 8 * recent.shape[1])
    density = [target.log_probability(part) for part in np.split(drawn, 8)]
    points = recent.reshape(-1, recent.shape[2])
    share = share_of(proposal, points, log_prob.ravel(), drawn, np.concatenate(density))
    agreed = state.began > ROUNDS[0] and np.max(diagnose(recent).rhat) < WARM
    return state._replace(share=share, producing=bool(agreed) or state.began == ROUNDS[-1])


def _refused(target: SamplingTarget, seed: int, status: Status, said: str) -> Posterior:
    """A posterior that was not sampled, and why."""
    chain = np.zeros((0, 0, len(target.names)))
    every, nothing = (*target.derived_names, *target.names), diagnose(chain)
    message = f"Not sampled: {said}."
    return Posterior(
        target, chain, chain[..., 0], status, message, nothing, float("nan"), 0, seed, every
    )


def _concluded(
    target: SamplingTarget, state: Checkpoint, target_ess: float, budget: int
) -> Posterior:
    """Judge a finished chain."""
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
    said = (verdict.message, sampled if len(chain) else "", target.remark)
    return Posterior(
        target=target,
        chain=chain,
        log_prob=state.log_prob[len(state.log_prob) - len(chain) :],
        status=verdict.status,
        message=" ".join(part for part in said if part),
        diagnostics=found,
        acceptance=state.acceptance,
        warmup=began,
        seed=state.seed,
        held=held,
    )


class Watch(Progress):
    """Shows how far a run is; does nothing where nobody asked.

    Parameters
    ----------
    shown : bool
        Whether to show anything.
    target_ess : float
        Effective samples at which the run ends.
    """

    def __init__(self, shown: bool, target_ess: float) -> None:
        words = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"))
        place = Console(stderr=True)
        super().__init__(
            *words, TimeRemainingColumn(), console=place, transient=True, disable=not shown
        )
        self.target_ess, self.rate = target_ess, 0.0
        self.bar = self.add_task("warming up", total=None, said="")

    def show(self, state: Checkpoint, found: Diagnostics | None) -> None:
        """Show a chain; `found` is the latest judgement, if there is a new one."""
        if self.disable:
            return
        if found is not None:
            # Effective samples a step: what the time to go is estimated from.
            self.rate = float(np.min(found.effective)) / max(found.steps, 1)
        said = f"{len(state.chain)} steps, {100 * state.acceptance:.0f} % accepted"
        reached = min(self.rate * len(state.counting), self.target_ess)
        if self.rate:
            said += f", {reached:.0f} of {self.target_ess:.0f} effective draws"
        word = "sampling" if state.producing else "warming up"
        total = self.target_ess if self.rate else None
        self.update(self.bar, description=word, completed=reached, total=total, said=said)
