"""Which decay to record next, and where to run the ring, by the scales of many decays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.errors import InputError
from beamfit.greybox.design import Information, scores
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.expansion import Expansion
from beamfit.lifetime.mechanisms import LossTerms, loss_terms, scaled_losses
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scales import ScaleFit, Summaries, information_root, loss_parts
from beamfit.quantity import HOUR, Quantity, Status
from beamfit.sampling.posterior import Posterior

# So wide a prior on scales near 1 decides nothing, and keeps determinants finite.
WIDE = 10.0
READINGS = 64
# Voltages that are looked at, twice.
GRID = 33


class DecayCandidate(NamedTuple):
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
    candidate : DecayCandidate
        The decay.
    information : float
        Logarithm of the factor by which the volume of the scales' error ellipsoid shrinks.
    errors : array, shape (4,)
        Expected standard deviations of Touschek, bremsstrahlung, elastic, desorption afterwards.
    """

    candidate: DecayCandidate
    information: float
    errors: np.ndarray


def _rows(fit: ScaleFit, candidate: DecayCandidate) -> np.ndarray:
    """Readings of the candidate predicted by the scales, over its errors, shape (2, scales)."""
    terms = fit.terms_at(candidate.operation, candidate.current)
    a, b = map(float, scaled_losses(jnp.asarray(fit.vector), terms))
    time = np.linspace(0.0, candidate.duration, READINGS)
    beam = np.asarray(current(time, candidate.current, a, b))
    record = DecayRecord(time, beam, np.full(READINGS, candidate.noise))
    mean, root = beam.mean(), information_root(Expansion.at(record, candidate.current, a, b))
    one = Summaries(*(jnp.asarray(part)[None] for part in (mean, loss_parts(a, b, mean), root)))
    stacked = jax.tree.map(lambda part: jnp.asarray(part)[None], terms._replace(current=mean))
    return fit.about(stacked, one)[2].reshape(-1, fit.vector.size)


def next_decays(fit: ScaleFit, candidates: Sequence[DecayCandidate]) -> tuple[Proposal, ...]:
    """Rank decays by what they would tell about the scales.

    Parameters
    ----------
    fit : ScaleFit
        What is known so far.
    candidates : sequence of DecayCandidate
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
    one, problem = np.eye(len(fit.vector)), fit.fit.problem
    measured = fit.about(fit.terms, fit.measured)[2].reshape(-1, len(one))
    priors = [np.equal(problem.names, prior.name) / prior.sd for prior in problem.priors]
    rows = np.vstack([measured, *priors, one / WIDE])
    free = np.full(len(one), np.inf)
    return Information(rows, np.ones(len(one)), one, free > 0, -free, free)


class Limits(NamedTuple):
    """Lowest and highest value allowed of each setting.

    Attributes
    ----------
    rf_voltage : (float, float)
        V.
    scraper_y : (float, float)
        Distance from the beam, m.
    bunches : (float, float)
        Number of bunches.
    """

    rf_voltage: tuple[float, float]
    scraper_y: tuple[float, float]
    bunches: tuple[float, float]


class BestPoint(NamedTuple):
    """The settings of the longest lifetime.

    Attributes
    ----------
    rf_voltage : Quantity
        V; its error is the spread of the best voltage over the posterior, at least the grid's.
    scraper_y, bunches : float
        m, and number: always the upper limits.
    lifetime : Quantity
        Lifetime there, h; NaN where the decays do not tell it.
    usual : Quantity
        Lifetime at the machine's usual settings, h; NaN where the decays do not tell it.
    message : str
        What limits it.
    """

    rf_voltage: Quantity
    scraper_y: float
    bunches: float
    lifetime: Quantity
    usual: Quantity
    message: str

    @property
    def status(self) -> Status:
        """`unidentified` where the decays do not tell the lifetime there."""
        return Status.unidentified if self.lifetime.error is None else Status.converged


def _over_voltages(
    fit: ScaleFit, operation: Operation, current: float, at: np.ndarray
) -> LossTerms:
    def one(voltage):
        return loss_terms(fit.machine.ring, operation._replace(rf_voltage=voltage), current)

    if fit.voltages is None:
        return jax.lax.map(one, jnp.asarray(at))
    shape = (at.size, fit.voltages.size)
    found = jax.lax.map(one, jnp.asarray(np.outer(at, fit.voltages).ravel()))
    parts = tuple(part.reshape(shape) for part in found.parts)
    rest = [part.reshape(shape)[:, 0] for part in found[1:-1]]
    return LossTerms(parts, *rest, jnp.broadcast_to(fit.voltages, shape))


def _rate(scales: Array, terms: LossTerms) -> Array:
    """Loss rate at the mean current, 1/s."""
    a, b = scaled_losses(scales, terms)
    return a * terms.current + b


_rates = jax.vmap(_rate, (0, None))


def _lifetime(fit: ScaleFit, draws: Array, operation: Operation, current: float) -> Quantity:
    terms = fit.terms_at(operation, current)
    if not fit.determines(partial(_rate, terms=terms)):
        return Quantity(math.nan, None, "h")
    hours = np.asarray(1 / _rates(draws, terms) / HOUR)
    return Quantity(float(hours.mean()), float(hours.std()), "h")


def best_operating_point(
    fit: ScaleFit, sample: Posterior, limits: Limits, current: float
) -> BestPoint:
    """Find the settings of the longest lifetime within limits.

    Parameters
    ----------
    fit : ScaleFit
        Fitted scales.
    sample : Posterior
        Their draws.
    limits : Limits
        What may be set.
    current : float
        Beam current to run at, mA.

    Returns
    -------
    BestPoint
        With the spread over the posterior.

    Raises
    ------
    InputError
        If a limit is empty, or no voltage within the limits stores a beam.

    Notes
    -----
    More bunches and a wider scraper never shorten the lifetime (a_T falls with both bunch
    population and length, the elastic cross section with the acceptance), so both sit at their
    upper limits. The voltage has an inner optimum where the bucket outgrows the lattice's
    acceptance: a grid, refined once around the best points of all draws.
    """
    for name, (low, high) in limits._asdict().items():
        if not 0 < low <= high:
            raise InputError(f"limits {low:g} to {high:g}", "0 < lower <= upper", column=name)
    low, high = limits.rf_voltage
    loss = float(fit.machine.ring.energy_loss)
    if high <= loss:
        expected = f"more than the loss of {loss:.6g} V a turn, or no beam is stored"
        raise InputError(f"at most {high:.6g} V", expected, column="rf_voltage")
    low = max(low, 1.01 * loss)
    usual = fit.machine.operation
    wide = usual._replace(scraper_y=limits.scraper_y[1], bunches=float(limits.bunches[1]))
    draws = jnp.asarray(np.asarray(sample.draws)[:: max(1, len(sample.draws) // 2000)])
    ends = low, max(high, low)
    for _ in range(2):
        at = np.linspace(*ends, GRID)
        found = at[np.argmin(_rates(draws, _over_voltages(fit, wide, current, at)), axis=1)]
        step = at[1] - at[0]
        ends = max(low, found.min() - step), min(at[-1], found.max() + step)
    error = float(np.hypot(found.std(), step / np.sqrt(12)))
    best = float(np.median(found))
    inside = low + step < best < high - step
    reached = _lifetime(fit, draws, wide._replace(rf_voltage=best), current)
    message = (
        "The best RF voltage lies within its limits, where bucket and lattice acceptance meet."
        if inside
        else "The best RF voltage is at its limit: more range would help."
    )
    if reached.error is None:
        message, inside = "The decays do not tell the lifetime at other settings: vary them.", False
    return BestPoint(
        rf_voltage=Quantity(best, error if inside else None, "V"),
        scraper_y=limits.scraper_y[1],
        bunches=limits.bunches[1],
        lifetime=reached,
        usual=_lifetime(fit, draws, usual, current),
        message=message,
    )
