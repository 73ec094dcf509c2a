"""A response and its noise, fitted in turn: residuals tell the noise, the noise weighs them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from beamfit.dynamics.case import (
    GAINED,
    Case,
    Settled,
    information,
    settled,
    with_memory,
)
from beamfit.dynamics.model import PreparedOutput, weight_priors
from beamfit.dynamics.noise import Noise
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import FIRST_ORDER, Physics
from beamfit.dynamics.starts import best_start, driven_by, start_of
from beamfit.greybox.problem import Free

# Steps of a round, after which the noise is estimated again, and most rounds.
STEPS, ROUNDS = 100, 30


def case_of(seen: PreparedOutput, offset: bool, network: bool = False) -> Case:
    """The case of one output: constant raw numbers or a network of them."""
    free = [Free("start", nuisance=True), Free("map", nuisance=network)]
    free += [Free("offset")] if offset else []
    free += [] if seen.runs[0].held is None else [Free("late")]
    return Case((seen,), seen.runs, tuple(free), weight_priors("map") if network else ())


def _round(case: Case, model: Any, noise: np.ndarray, memory: Noise | None = None) -> Settled:
    """A search that pays for what it uses; the part of a sample in a delay begins anew."""
    found = case.search(model | {"late": 0.0}, noise, STEPS, memory)
    return found._replace(likelihood=information(case, found, memory))


def remembering(case: Case, models: Sequence[Any]) -> Settled:
    """The best fit from some starts, its noise with a memory where residuals are correlated.

    The noise weighs against the priors of a network, so it is taken anew in every round.
    """
    found = settled(case, models, _round, lambda f: GAINED + 1e-9 * abs(f.likelihood), ROUNDS)
    if not found.correlated(case):
        return found
    again = with_memory(case, found, _round)
    return again._replace(rests=found.rests, errors=again.remembered(case)[0])


class Begun(NamedTuple):
    """Runs as the model sees them, the delay, and the fit with constant parameters."""

    seen: PreparedOutput
    delay: float
    plain: Settled


def begun(
    runs: tuple[Run, ...], output: str, physics: Physics, delay: float | None, offset: bool
) -> Begun:
    """Identify with constant parameters; the delay among candidates if None."""
    start, seen, delay = start_of(runs, output, physics, delay, offset)
    return Begun(seen, delay, remembering(case_of(seen, offset), [start.model]))


def is_first_order(found: Begun, offset: bool) -> bool:
    """True if a first order does as well as a higher one by the Bayesian information criterion."""
    if found.seen.runs[0].physics is FIRST_ORDER:
        return False
    lower = found.seen._replace(runs=driven_by(found.seen, FIRST_ORDER))
    start = best_start(lower, offset)
    return remembering(case_of(lower, offset), [start.model]).likelihood <= found.plain.likelihood
