"""Focusing-network scenario: k1 of each scanned magnet is a monotonic network of its current.

Signs of the weights make k1 rise (or fall, like the lattice's calibration) with the current at all
currents, not only at the measured ones. With hysteresis the network has the branch as a second
input, so that rising and falling currents have different curves.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.results import Parameter
from beamfit.emittance.statement import PreparedScan, Scenario, varied_magnets
from beamfit.emittance.transport import pad_rows
from beamfit.emittance.transport_network import MAX_WEIGHT, known_record, network_problem
from beamfit.errors import InputError, Status
from beamfit.greybox import tree
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.mlp import MLP, Port
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.greybox.signed_network import signed_network
from beamfit.quantity import Quantity


@tree.node("unit")
class NetworkStrength:
    """A magnet whose strength is a network of its current: k1 = network(I, branch)/E.

    It replaces a calibration in a line. A setting is the current in A, or the pair of current and
    branch (+1 rising, -1 falling); a current alone is midway between the branches.

    Parameters
    ----------
    network : MLP
        One input (current) or two (current, branch); its output is k1 · E in MeV/m².
    unit : str
        Unit of a scan's column, as for other calibrations.

    Examples
    --------
    >>> from beamfit.greybox.mlp import Layer, Port
    >>> net = MLP([Layer("in", "identity", 1), Layer("out", "linear", 1)], [("in", "out")],
    ...           [Port("I", "in")], [Port("k1E", "out")], {"in->out": [[160.0]]})
    >>> float(NetworkStrength(net).k1l(2.0, length=0.1, energy=32.0))
    1.0
    """

    network: MLP
    unit: str = "A"
    inputs: ClassVar[tuple[str, ...]] = ("current", "branch")

    def k1l(self, setting: ArrayLike, length: ArrayLike, energy: ArrayLike) -> Array:
        """Integrated strength in 1/m at a setting, for a length in m and an energy in MeV."""
        current_and_branch = jnp.atleast_1d(jnp.asarray(setting, float))
        missing = len(self.network.inputs) - current_and_branch.shape[0]
        current_and_branch = (
            jnp.concatenate([current_and_branch, jnp.zeros(missing)])
            if missing > 0
            else current_and_branch
        )
        return (
            self.network.values(current_and_branch[: len(self.network.inputs)])[0] / energy * length
        )


def branch_of(settings: np.ndarray) -> np.ndarray:
    """Branch of each setting in the order of the measurement: +1 rising, -1 falling.

    A setting that repeats the previous one keeps its branch. The first one takes that of the next:
    a magnet is brought to the start of a ramp from beyond it.

    Examples
    --------
    >>> branch_of(np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0])).tolist()
    [1.0, 1.0, 1.0, 1.0, -1.0, -1.0]
    """
    steps = np.sign(np.diff(settings))
    branches = np.concatenate([[0.0], steps])
    for i in range(1, len(branches)):
        branches[i] = branches[i] or branches[i - 1]
    first = next((f for f in branches if f != 0.0), 1.0)
    return np.where(branches == 0.0, first, branches)


def _lattice_strength(prepared: PreparedScan, magnet: str, current: np.ndarray) -> np.ndarray:
    """k1 · E in MeV/m² of the lattice, at settings of a magnet."""
    element, energy = prepared.scanned[magnet], float(prepared.scanned.energy)
    return np.asarray(_strengths(element.calibration, current, element.length, energy)) * energy


@jax.jit
def _strengths(calibration: Any, settings: Array, length: float, energy: float) -> Array:
    """k1 in 1/m² at settings of shape (n,), or (n, 2) with branches."""
    return jax.vmap(lambda s: calibration.k1l(s, length, energy))(settings) / length


@tree.node("magnet")
class _Currents:
    """Settings of a magnet at which k1 is derived, (n,) or (n, 2), with length and energy."""

    magnet: str
    settings: Any
    length: Any
    energy: Any


def _k1(model: Any, currents: _Currents) -> Array:
    """k1 in 1/m² of a model's magnet."""
    return _strengths(
        model["magnets"][currents.magnet], currents.settings, currents.length, currents.energy
    )


def _loop(model: Any, currents: _Currents) -> Array:
    """Width of the hysteresis loop: k1 of the first setting minus that of the second."""
    up, down = _k1(model, currents)
    return (up - down)[None]


def _scaled_k1(model: Any, currents: _Currents) -> Array:
    """k1 · E, for the records of an anchor."""
    return _k1(model, currents) * currents.energy


def _without_common_error(model: Any, currents: _Currents) -> Array:
    """k1 · E without the error that all settings share."""
    return _scaled_k1(model, currents) / (1.0 + model["anchor"][currents.magnet])


def _state(prepared: PreparedScan, assumptions: Assumptions) -> Problem:
    """Problem of the beams and one network of k1 for each scanned magnet."""
    varied = varied_magnets(prepared.scan)
    if shared := [name for name in varied if len(prepared.scanned.members(name)) > 1]:
        found = f"a network of k1 for '{shared[0]}', which feeds several magnets"
        raise InputError(found, "a scan of magnets on supplies of their own")
    branches = _branches(prepared, varied) if assumptions.hysteresis else {}
    strengths, weights, records = {}, [], []
    for name in varied:
        if not prepared.scanned[name].length:
            raise InputError(f"a network of k1 for '{name}', which has no length", "a quadrupole")
        strengths[name], free = _strength(prepared, name, assumptions, name in branches)
        weights += free
        records += _anchors(prepared, name, assumptions, name in branches)
    settings = prepared.rows.settings | {
        name: np.stack([prepared.rows.settings[name], pad_rows(branch)], -1)
        for name, branch in branches.items()
    }
    rows = {plane: prepared.of_plane(plane, settings) for plane in prepared.planes}
    model = {"magnets": strengths}
    return network_problem(prepared, assumptions, varied, varied, rows, model, weights, records)


def _branches(prepared: PreparedScan, varied: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Branch of every row; raises an error if settings only rise or only fall."""
    branches = {name: branch_of(prepared.scan.settings[name]) for name in varied}
    single = [name for name, branch in branches.items() if np.ptp(branch) == 0]
    if single:
        raise prepared.scan.unusable(
            f"settings of '{single[0]}' that only rise or only fall, with hysteresis",
            "rows in the order of measuring, with rising and falling settings",
            single[0],
        )
    return branches


def _strength(
    prepared: PreparedScan, name: str, assumptions: Assumptions, branches: bool
) -> tuple[NetworkStrength, list[Free]]:
    """Network that starts as the straight line between the lattice's k1 at both ends."""
    settings = prepared.scan.settings[name]
    low, high = float(settings.min()), float(settings.max())
    ends = _lattice_strength(prepared, name, np.array([low, high]))
    ports = [Port("I", "", 0, (high - low) / 2, (high + low) / 2)]
    rising = [np.sign(ends[1] - ends[0]) or 1.0]
    if branches:
        # A branch changes k1 by at most a few per cent of its range: small weights suffice.
        ports.append(Port("branch", "", 0, 10.0, 0.0))
        rising.append(0.0)
    half_range = abs(float(ends[1] - ends[0])) / 2 or 1.0
    output = Port(f"{name}.k1E", "", 0, half_range, float(ends.mean()))
    path, rises = f"magnets.{name}.network", np.array([rising])
    net, free = signed_network(
        path, ports, [output], rises, assumptions.hidden, assumptions.seed, MAX_WEIGHT
    )
    return NetworkStrength(net, prepared.scanned[name].calibration.unit), free


def _anchors(
    prepared: PreparedScan, name: str, assumptions: Assumptions, branches: bool
) -> Iterator[Record]:
    """Records that tie k1 to the lattice, midway between the branches if there are two."""
    settings, anchor = prepared.scan.settings[name], assumptions.anchor
    largest = float(np.abs(_lattice_strength(prepared, name, settings)).max())
    places = np.array([place[name] for place in anchor.at if name in place], float)
    element, energy = prepared.scanned[name], float(prepared.scanned.energy)
    at_settings = np.unique(settings), anchor.deviation, _without_common_error
    for currents, sd, predict in (at_settings, (places, anchor.sd, _scaled_k1)):
        if sd is None or not len(currents):
            continue
        points = np.stack([currents, np.zeros(len(currents))], -1) if branches else currents
        data = _Currents(name, pad_rows(points), float(element.length), energy)
        values = _lattice_strength(prepared, name, currents)
        yield known_record(f"anchor {name}", predict, data, values, sd * largest)


def _parameters(prepared: PreparedScan, assumptions: Assumptions, fit: Fit) -> Iterator[Parameter]:
    """k1 at both ends and the middle of the scanned range, and the width of the loop."""
    energy, settled = float(prepared.scanned.energy), fit.status is not Status.not_converged
    for name in varied_magnets(prepared.scan):
        low, high = (float(f(prepared.scan.settings[name])) for f in (np.min, np.max))
        middle = 0.5 * (low + high)
        at = np.array([low, middle, high])
        length = float(prepared.scanned[name].length)
        found = fit.derive(_k1, _Currents(name, at, length, energy))
        for i, current in enumerate(at):
            yield _derived_parameter(f"{name}.k1 at {current:g}", found, i, settled)
        if assumptions.hysteresis:
            branches = np.array([[middle, 1.0], [middle, -1.0]])
            found = fit.derive(_loop, _Currents(name, branches, length, energy))
            yield _derived_parameter(
                f"{name}.k1 rising less falling at {middle:g}", found, 0, settled
            )


def _derived_parameter(name: str, found: Derived, i: int, settled: bool) -> Parameter:
    """Parameter from a derived value, with an error if the data determine it."""
    determined = settled and bool(np.isfinite(found.error[i]))
    errors = (float(found.error[i]), float(found.error_raw[i])) if determined else (None, None)
    value = Quantity(float(found.value[i]), errors[0], "1/m^2", errors[1])
    return Parameter(name, value, Status.converged if determined else Status.unidentified)


NULL_DIRECTION = (
    "at each setting k1 is free to take up what the beam leaves: another beam with another curve "
    "k1(I) gives the same sizes"
)
SCENARIO = Scenario(
    "focusing-network",
    _state,
    _parameters,
    null_directions=lambda _prepared, _parameters, identified: (
        () if identified else (NULL_DIRECTION,)
    ),
    remedy=lambda _prepared, _assumptions: (
        "sizes at a second screen, or an anchor to the lattice's calibration "
        "(--anchor first-principles=2%)"
    ),
    network=True,
)
