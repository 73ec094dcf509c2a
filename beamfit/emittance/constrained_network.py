"""Problems of beams and networks: anchors, or limits of gains and a box (Appendix B)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax import Array

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.model import UNIT, sigma_of
from beamfit.emittance.statement import PreparedScan, beam_problem
from beamfit.emittance.transport import padded
from beamfit.errors import InputError, nearest
from beamfit.greybox.gains import certified_gain
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record

# Bounds of the weights: the report's (appendix B).
MOST = 10.0


def network_problem(
    seen: PreparedScan,
    told: Assumptions,
    inputs: Sequence[str],
    common: Iterable[str],
    rows: Mapping[str, Any],
    part: Mapping[str, Any],
    weights: Iterable[Free],
    records: Iterable[Record],
    limits: Iterable[Constraint] = (),
) -> Problem:
    """Beams and networks, a part of the model, with the error that all settings share.

    A wrong energy or slope moves every setting alike, and does not average out over them. How much
    of a deviation is `common` to each of these nobody knows, so it may be all of it.
    """
    for name in (name for place in told.anchor.at for name in place):
        if name not in inputs:
            raise InputError(f"an anchor at '{name}'", f"a scanned magnet: {', '.join(inputs)}")
    sd = told.anchor.deviation
    shared = {} if sd is None else {"anchor": dict.fromkeys(common, 0.0)}
    names = [f"anchor.{name}" for name in shared.get("anchor", ())]
    free = [*weights, *(Free(name, -0.9, nuisance=True) for name in names)]
    priors = [Prior(name, 0.0, sd) for name in names]
    return beam_problem(seen, rows, {**part, **shared}, free, records, priors, limits)


def known_record(
    name: str, predict: Callable[[Any, Any], Any], data: Any, values: Any, sd: Any
) -> Record:
    """First principles as a record of a network, padded; ``data`` is padded already."""
    values = np.asarray(values, float)
    full = padded(values)
    weight = np.zeros(full.shape)
    weight[: len(values)] = 1.0
    return Record(name, predict, data, full, padded(np.broadcast_to(sd, values.shape)), weight)


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
    inputs: Sequence[str], box: np.ndarray, outputs: Sequence[str], told: Assumptions, cells: int
) -> tuple[MLP, list[Free], list[Constraint]]:
    """The network of Appendix B: no scales, weights within ± 10, gains limited in a box (2, n)."""
    low, high = box.tolist()
    ports = [Port(n, "", lower=a, upper=b) for n, a, b in zip(inputs, low, high, strict=True)]
    net = dense(ports, outputs, [told.hidden], seed=told.seed, spread=START)
    free = [Free("map", -MOST, MOST, (-START, START), nuisance=True)]
    limits = []
    for name, (least, most) in told.gains.items():
        output, by = _parts(name)
        limits += certified_gain("map", output, by, (low, high), cells, lower=least, upper=most)
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
