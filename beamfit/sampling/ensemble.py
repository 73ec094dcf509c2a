"""One sampler for every problem: start, warm up, sample, judge, go on or stop."""

from __future__ import annotations

import time
from os import PathLike
from typing import Any

import numpy as np

from beamfit.errors import InputError
from beamfit.sampling import store as disk
from beamfit.sampling.convergence import Diagnostics, diagnose
from beamfit.sampling.moves import about, fitted, moves_of, share_of
from beamfit.sampling.place import check_place
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.progress import Watch
from beamfit.sampling.store import Checkpoint, Provenance
from beamfit.sampling.target import Target
from beamfit.sampling.verdict import conclude, refused

__all__ = ["draw", "first_walkers"]

# Steps between two looks at the chain; every decision falls at a multiple, so that a run that was
# interrupted decides as the uninterrupted one did.
BLOCK = 50
# Warm-up: rounds that end at these steps, until the walkers agree so well within half a round.
ROUNDS = (100, 250, 500, 900, 1500, 2500)
WARM = 1.15
FEWEST_WALKERS = 64
# Share of time that may go into writing checkpoints.
WRITING = 0.05
TRIES = 80


def draw(
    target: Target,
    *,
    seed: int = 0,
    target_ess: float = 4000.0,
    budget: int = 20_000,
    walkers: int | None = None,
    store: str | PathLike[str] | None = None,
    provenance: Provenance | None = None,
    progress: bool = False,
) -> Posterior:
    """Draw from a posterior until enough is known or the budget is spent.

    Parameters
    ----------
    target : Target
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
    provenance : Provenance, optional
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
    n = len(target.names)
    walkers = walkers or max(FEWEST_WALKERS, 4 * n)
    _check_options(n, target_ess, budget, walkers)
    if not (isinstance(seed, int | np.integer) and 0 <= seed < 2**32):
        raise InputError(f"seed {seed!r}", "a whole number from 0 to 4294967295")
    provenance = provenance or Provenance()
    if store is not None:
        check_place(store)
    state = None if store is None else disk.load(store, target, seed, walkers)
    if target.open_directions:
        return refused(target, seed, "unidentified", target.open_directions)
    start = None
    if state is None:
        random = np.random.RandomState(seed)
        start = first_walkers(target, walkers, random)
        if start is None:
            said = "no point within the bounds and constraints was found; relax them"
            return refused(target, seed, "infeasible", said)
        state = _begin(target, start, random, seed)
    return _run(target, state, start, target_ess, budget, store, provenance, progress)


def _check_options(n: int, target_ess: float, budget: int, walkers: int) -> None:
    if walkers < 2 * n or walkers % 2:
        raise InputError(f"{walkers} walkers for {n} numbers", f"an even number from {2 * n} on")
    if not target_ess > 0:
        raise InputError(f"a target of {target_ess} effective samples", "a positive number")
    if budget < BLOCK:
        raise InputError(f"a budget of {budget} steps", f"{BLOCK} or more")


def first_walkers(target: Target, number: int, random: np.random.RandomState) -> np.ndarray | None:
    """Place walkers inside the feasible set, spread as the fit's covariance says.

    Parameters
    ----------
    target : Target
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
    for _ in range(TRIES):
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


def _begin(
    target: Target, start: np.ndarray, random: np.random.RandomState, seed: int
) -> Checkpoint:
    walkers, n = start.shape
    return Checkpoint(
        chain=np.zeros((0, walkers, n)),
        log_prob=np.zeros((0, walkers)),
        accepted=np.zeros(walkers),
        accepted_before=np.zeros(walkers),
        random_state=random.get_state(),
        proposal=about(target.covariance, target.widening, target.blocks, 5.0),
        share=0.5,
        began=0,
        producing=False,
        seed=seed,
    )


def _run(
    target: Target,
    state: Checkpoint,
    start: np.ndarray | None,
    target_ess: float,
    budget: int,
    store: str | PathLike[str] | None,
    provenance: Provenance,
    progress: bool,
) -> Posterior:
    """Sample block by block; every decision depends on the chain alone."""
    spent, due = 0.0, time.perf_counter()
    stored = len(state.chain)
    with Watch(progress, target_ess, len(state.chain)) as watch:
        while True:
            found = _judged(state)
            enough = found is not None and found.settled and np.min(found.effective) >= target_ess
            steps = len(state.chain)
            if enough or steps + BLOCK > budget:
                break
            state = _next_stage(target, _block(target, state, start))
            start = None
            watch.show(state, found)
            if store is not None and time.perf_counter() >= due:
                spent = disk.save(store, target, state, provenance)
                stored = len(state.chain)
                due = time.perf_counter() + spent / WRITING
    kept = state.chain[state.began :] if state.producing else state.chain[:0]
    final = found if found is not None and found.steps == len(kept) else diagnose(kept)
    posterior = conclude(target, state, final, target_ess, budget)
    if store is not None and (stored < len(state.chain) or not disk.finished(store)):
        disk.save(store, target, state, provenance, posterior.to_json())
    return posterior


def _judged(state: Checkpoint) -> Diagnostics | None:
    """Judge the chain at lengths that grow by a quarter, None between them."""
    length = len(state.chain) - state.began
    if not state.producing or length < 2 * BLOCK:
        return None
    look = 2 * BLOCK
    while look < length:
        look = BLOCK * int(np.ceil(1.25 * look / BLOCK))
    return diagnose(state.chain[state.began :]) if look == length else None


def _block(target: Target, state: Checkpoint, start: np.ndarray | None) -> Checkpoint:
    """Advance the chain by one block."""
    import emcee

    walkers, n = state.chain.shape[1:]
    backend = emcee.backends.Backend()
    sampler = emcee.EnsembleSampler(
        walkers,
        n,
        target.log_probability,
        moves=moves_of(state.proposal, state.share),
        backend=backend,
        vectorize=True,
    )
    if start is None:
        last: Any = emcee.State(
            state.chain[-1], state.log_prob[-1], random_state=state.random_state
        )
    else:
        last = emcee.State(start, random_state=state.random_state)
    sampler.run_mcmc(last, BLOCK, skip_initial_state_check=True)
    return state._replace(
        chain=np.concatenate([state.chain, backend.chain]),
        log_prob=np.concatenate([state.log_prob, backend.log_prob]),
        accepted=state.accepted + backend.accepted,
        random_state=backend.random_state,
    )


def _next_stage(target: Target, state: Checkpoint) -> Checkpoint:
    """Refit the proposals at the end of a round of the warm-up; end it when walkers agree."""
    steps = len(state.chain)
    if state.producing or steps not in ROUNDS:
        return state
    half = slice((state.began + steps) // 2, steps)
    recent, log_prob = state.chain[half], state.log_prob[half]
    points, logs = recent.reshape(-1, recent.shape[2]), log_prob.ravel()
    proposal = fitted(points, state.proposal)
    # Chance of its own, so that looking at a proposal does not change the chain.
    drawn = proposal.draw(np.random.RandomState(steps), 8 * recent.shape[1])
    density = [target.log_probability(part) for part in np.split(drawn, 8)]
    share = share_of(proposal, points, logs, drawn, np.concatenate(density))
    agreed = bool(np.max(diagnose(recent).rhat) < WARM) and state.began > 0
    done = agreed or steps == ROUNDS[-1]
    return state._replace(
        proposal=proposal,
        share=share,
        began=steps,
        producing=done,
        accepted_before=state.accepted,
    )
