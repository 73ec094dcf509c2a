"""What a scenario fits besides the beam, as quantities: calibration numbers, k1, loop width."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox import tree
from beamfit.greybox.bounded import MOST_SHARE
from beamfit.quantity import Quantity, Status
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.results import Parameter
from beamfit.studies.scan.scenario_data import Seen, varied_magnets

if TYPE_CHECKING:
    from beamfit.studies.scan.scenario_judged import Found, Judged

__all__ = ["parameters_of"]

UNITS = {
    "slope": "MeV/(m^2 A)",
    "intercept": "MeV/m^2",
    "scale": "1",
    "coefficients.0": "T/m",
    "coefficients.1": "T/(m A)",
}


def parameters_of(seen: Seen, scenario: str, told: Assumptions, j: Judged) -> tuple[Parameter, ...]:
    """List the fitted numbers besides the beam.

    Parameters
    ----------
    seen : Seen
        The scan.
    scenario : str
        Which scenario.
    told : Assumptions
        Priors and bounds.
    j : Judged
        The fit.

    Returns
    -------
    tuple of Parameter
        Empty for a transport network, whose weights nobody asks for.
    """
    if scenario == "calibration":
        return tuple(_calibration(told, j))
    if scenario == "focusing-network":
        return tuple(_strengths(seen, told, j))
    return ()


def _calibration(told: Assumptions, j: Judged):
    p = j.fit.problem
    every = np.eye(len(p.names))
    errors, raws, shares = j.scaled.error(every), j.spread.error(every), j.scaled.share(every)
    for i, variable in enumerate(j.fit.variables):
        if variable.name.startswith("beam."):
            continue
        determined = j.settled and shares[i] < MOST_SHARE
        edge = variable.state in ("lower", "upper")
        status = Status.converged if determined else Status.unidentified
        if edge:
            status = Status.at_limit
        error, raw = (float(errors[i]), float(raws[i])) if determined and not edge else (None, None)
        unit = next((u for end, u in UNITS.items() if variable.name.endswith(end)), "1")
        yield Parameter(
            name=variable.name,
            value=Quantity(variable.value, error, unit, raw),
            status=status,
            state=variable.state,
            lower=variable.lower,
            upper=variable.upper,
            prior=told.priors.get(variable.name),
            multiplier=variable.reduced_gradient,
        )


@tree.node("magnet")
class _Asked:
    """Settings of a magnet at which k1 is asked for, shape (n,) or (n, 2), with length, energy."""

    magnet: str
    settings: Any
    length: Any
    energy: Any


def _k1(model: Any, asked: _Asked) -> Array:
    strength = model[asked.magnet]
    one = jax.vmap(lambda s: strength.k1l(s, asked.length, asked.energy))
    return one(asked.settings) / asked.length


def _loop(model: Any, asked: _Asked) -> Array:
    """Width of the hysteresis loop: k1 of the first setting less that of the second."""
    up, down = _k1(model, asked)
    return up - down


def _strengths(seen: Seen, told: Assumptions, j: Judged):
    """k1 at both ends and the middle of the scanned range, and the width of the loop."""
    energy = float(seen.scanned.energy)
    for name in varied_magnets(seen):
        low, high = (float(f(seen.scan.settings[name])) for f in (np.min, np.max))
        middle = 0.5 * (low + high)
        at = np.array([low, middle, high])
        length = float(seen.scanned[name].length)
        found = j.quantities(_k1, _Asked(name, jnp.asarray(at), length, energy))
        for i, current in enumerate(at):
            yield _derived(f"{name}.k1 at {current:g}", found, i, j.settled)
        if told.hysteresis:
            both = jnp.array([[middle, 1.0], [middle, -1.0]])
            found = j.quantities(_loop, _Asked(name, both, length, energy))
            yield _derived(f"{name}.k1 rising less falling at {middle:g}", found, 0, j.settled)


def _derived(name: str, found: Found, i: int, settled: bool) -> Parameter:
    known = settled and bool(found.known[i])
    error = (float(found.error[i]), float(found.raw[i])) if known else (None, None)
    return Parameter(
        name=name,
        value=Quantity(float(found.value[i]), error[0], "1/m^2", error[1]),
        status=Status.converged if known else Status.unidentified,
        state="free",
        lower=-np.inf,
        upper=np.inf,
        prior=None,
        multiplier=0.0,
    )
