"""Which decay to record next: the one that tells most about the scales."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox.design import Information, scores
from beamfit.lifetime.decay import current as decayed
from beamfit.lifetime.losses import Terms, scaled_losses
from beamfit.lifetime.ring import Operation
from beamfit.studies.decay.scales import ScaleFit, pulls, whitener
from beamfit.studies.decay.summary import Summaries, information_root, loss_parts

# So wide a prior on scales near 1 decides nothing, and keeps determinants finite.
WIDE = 10.0
READINGS = 64


class Candidate(NamedTuple):
    """A decay that could be recorded.

    Attributes
    ----------
    operation : Operation
        Settings and vacuum.
    current : float
        Current at the start, mA.
    duration : float
        s.
    noise : float
        Standard deviation of the mean of what is read in 1/64 of the duration, mA.
    """

    operation: Operation
    current: float
    duration: float
    noise: float


class Proposal(NamedTuple):
    """A candidate and what it would bring.

    Attributes
    ----------
    candidate : Candidate
        The decay.
    information : float
        Logarithm of the factor by which the volume of the scales' error ellipsoid shrinks.
    errors : array, shape (4,)
        Expected standard deviations of Touschek, bremsstrahlung, elastic, desorption afterwards.
    """

    candidate: Candidate
    information: float
    errors: np.ndarray


_slopes = jax.jit(jax.jacfwd(pulls))


def _rows(fit: ScaleFit, candidate: Candidate) -> np.ndarray:
    """What the candidate would measure by the scales, over its errors, shape (2, scales)."""
    scales = jnp.asarray(fit.vector)
    terms = fit.terms_at(candidate.operation, candidate.current)
    a, b = scaled_losses(scales, terms)
    time = jnp.linspace(0.0, candidate.duration, READINGS)
    mean = jnp.mean(decayed(time, candidate.current, a, b))
    parts = loss_parts(a, b, mean)
    weight = jnp.full(READINGS, 1 / candidate.noise)
    root = information_root(time, weight, candidate.current, parts, mean)
    one = Summaries(mean[None], parts[None], root[None])
    stacked = jax.tree.map(lambda part: jnp.asarray(part)[None], terms._replace(current=mean))
    return _rows_of(fit, stacked, one)


def _rows_of(fit: ScaleFit, terms: Terms, measured: Summaries) -> np.ndarray:
    weight = whitener(fit.vector, terms, measured, fit.pressure_error)
    slopes = _slopes(fit.vector, terms, measured, weight)
    return np.asarray(slopes).reshape(-1, len(fit.vector))


def next_decays(fit: ScaleFit, candidates: Sequence[Candidate]) -> tuple[Proposal, ...]:
    """Rank decays by what they would tell about the scales.

    Parameters
    ----------
    fit : ScaleFit
        What is known so far.
    candidates : sequence of Candidate
        What could be recorded.

    Returns
    -------
    tuple of Proposal
        The most informative first (D-optimality, in linear approximation).

    Raises
    ------
    InputError
        If there is no candidate, or one has no duration, current or noise.
    """
    if not candidates:
        raise InputError("no candidate", "one decay or more to choose from")
    for candidate in candidates:
        if not min(candidate.current, candidate.duration, candidate.noise) > 0:
            raise InputError(f"{candidate[1:]}", "current, duration and noise above zero")
    known = _known(fit)
    rows = np.array([_rows(fit, candidate) for candidate in candidates])
    [before] = scores(known, np.zeros((1, *rows.shape[1:])), volume=True)
    gains = 0.5 * (before - scores(known, rows, volume=True))
    proposals = [
        Proposal(candidate, float(gain), known.with_rows(own).error * fit.error_scale)
        for candidate, own, gain in zip(candidates, rows, gains, strict=True)
    ]
    return tuple(sorted(proposals, key=lambda proposal: -proposal.information))


def _known(fit: ScaleFit) -> Information:
    """Information on the scales so far, with a wide prior where there is none."""
    one = np.eye(len(fit.vector))
    rows = np.vstack([_rows_of(fit, fit.terms, fit.measured), *_priors(fit), one / WIDE])
    free = np.full(len(one), np.inf)
    return Information(rows, np.ones(len(one)), one, free > 0, -free, free)


def _priors(fit: ScaleFit) -> list[np.ndarray]:
    problem = fit.fit.problem
    return [np.equal(problem.names, prior.name) / prior.sd for prior in problem.priors]
