"""The report's own transport network: a box for the beam, limits for the gains (Appendix B).

The appendix asks that Σ max(s·dA/dI + 0.01, 0)² over the currents be at most 0. Where that holds,
its value and its gradient vanish together, so no multiplier exists (no constraint qualification),
and between the currents it asks nothing. Here a gain keeps to its limit in every cell of the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax import Array

from beamfit.errors import InputError, nearest
from beamfit.greybox.gains import certified_gain
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Free
from beamfit.greybox.terms import Constraint
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.model import UNIT, sigma_of
from beamfit.studies.scan.signed_network import MOST

SIGMA = ("sigma11", "sigma12", "sigma22")
# The appendix's random start of a weight; it gives the network no straight line to begin with.
START = 0.01


@dataclass(frozen=True)
class _Sigma:
    """σ11, σ12, σ22 of a plane in units of 1e-8 SI; equal ones share their compiled code."""

    plane: str

    def __call__(self, model: Any, data: None) -> Array:
        return sigma_of(model["beam"][self.plane]) / UNIT**2


def beam_box(told: Assumptions, planes: Sequence[str]) -> list[Constraint]:
    """The box of each plane's beam matrix, one constraint a plane that has bounds."""
    found = []
    for plane in planes:
        named = [told.bounds.get(f"{plane}.{name}", (-np.inf, np.inf)) for name in SIGMA]
        low, high = np.array(named).T / UNIT**2
        if np.isfinite(low).any():
            found.append(Constraint(f"box {plane}", _Sigma(plane), None, low, high))
    return found


def limited_network(
    inputs: Sequence[Port], outputs: Sequence[str], told: Assumptions, cells: int
) -> tuple[MLP, list[Free], list[Constraint]]:
    """The network of Appendix B: no scales, weights within ± 10, gains within their limits."""
    low, high = ([getattr(p, end) for p in inputs] for end in ("lower", "upper"))
    net = dense(inputs, outputs, [told.hidden], seed=told.seed, spread=START)
    free = [Free("map", -MOST, MOST, (-START, START), nuisance=True)]
    limits = []
    for name, (least, most) in told.gains.items():
        output, by = _parts(name)
        box = (low, high)
        limits += certified_gain("map", output, by, box, cells, lower=least, upper=most)
    return net, free, limits


def _parts(name: str) -> list[str]:
    """Output and input of a gain: "dA_x/dQ2" is A_x by Q2."""
    return [part.removeprefix("d") for part in name.split("/", 1)]


def check_box(told: Assumptions, inputs: Sequence[str], outputs: Sequence[str], planes) -> None:
    """Refuse bounds and gains of what there is not.

    Raises
    ------
    InputError
        Naming the nearest there is.
    """
    numbers = [f"{plane}.{name}" for plane in planes for name in SIGMA] + list(inputs)
    gains = [f"d{output}/d{by}" for output in outputs for by in inputs]
    for what, named, known in (("bounds on", told.bounds, numbers), ("gain", told.gains, gains)):
        for name in named:
            if name not in known:
                raise InputError(f"{what} '{name}'", nearest(name, known))
