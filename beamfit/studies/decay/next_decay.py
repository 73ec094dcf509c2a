"""Which decay to record next: the one that tells most about the scales."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.lifetime.decay import current as decayed
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scaled import loss_terms, scaled_losses
from beamfit.studies.decay.scales import ScaleFit, pulls, whitener
from beamfit.studies.decay.summary import Summaries, information_root, loss_parts

__all__ = ["Candidate", "Proposal", "next_decays"]

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


def _information(fit: ScaleFit, candidate: Candidate) -> np.ndarray:
    """What the candidate would add to the information on the scales, shape (4, 4)."""
    scales = jnp.asarray(fit.vector)
    terms = loss_terms(fit.machine.ring, candidate.operation, candidate.current)
    a, b = scaled_losses(scales, terms)
    time = jnp.linspace(0.0, candidate.duration, READINGS)
    mean = jnp.mean(decayed(time, candidate.current, a, b))
    parts = loss_parts(a, b, mean)
    weight = jnp.full(READINGS, 1 / candidate.noise)
    root = information_root(time, weight, candidate.current, parts, mean)
    one = Summaries(mean[None], parts[None], root[None])
    stacked = jax.tree.map(lambda part: jnp.asarray(part)[None], terms._replace(current=mean))
    white = whitener(scales, stacked, one, fit.pressure_error)
    rows = np.asarray(_slopes(scales, stacked, one, white)).reshape(-1, 4)
    return rows.T @ rows


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
    before = np.linalg.slogdet(known)[1]
    proposals = []
    for candidate in candidates:
        after = known + _information(fit, candidate)
        gain = 0.5 * (np.linalg.slogdet(after)[1] - before)
        errors = np.sqrt(np.diag(np.linalg.inv(after))) * fit.error_scale
        proposals.append(Proposal(candidate, float(gain), errors))
    return tuple(sorted(proposals, key=lambda proposal: -proposal.information))


def _known(fit: ScaleFit) -> np.ndarray:
    """Information so far, with a wide prior where there is none."""
    weight = whitener(fit.vector, fit.terms, fit.measured, fit.pressure_error)
    rows = np.asarray(_slopes(fit.vector, fit.terms, fit.measured, weight)).reshape(-1, 4)
    return rows.T @ rows + np.diag(1 / fit.prior_error**2) + np.eye(4) / WIDE**2
