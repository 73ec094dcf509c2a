"""The focusing-network scenario: k1 of each scanned magnet is a monotonic network of its current.

Signs of the weights make k1 rise (or fall, as the lattice's own calibration does) with the current
at every current, not only at the measured ones. With hysteresis the network has a second input, the
branch, so that rising and falling currents have curves of their own.
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
from beamfit.emittance.transport import padded
from beamfit.emittance.transport_network import MOST, known_record, network_problem
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

    It takes the place of a calibration in a line. A setting is the current in A, or the pair of
    current and branch (+1 rising, -1 falling); a current alone is taken midway between branches.

    Parameters
    ----------
    network : MLP
        One input (current) or two (current, branch); its output is k1 · E in MeV/m².
    unit : str
        The word of a scan's column, as for other calibrations.

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
        """Integrated strength in 1/m at a setting, a length in m, an energy in MeV."""
        at = jnp.atleast_1d(jnp.asarray(setting, float))
        missing = len(self.network.inputs) - at.shape[0]
        at = jnp.concatenate([at, jnp.zeros(missing)]) if missing > 0 else at
        return self.network.values(at[: len(self.network.inputs)])[0] / energy * length


def branch_of(settings: np.ndarray) -> np.ndarray:
    """Branch of each setting in the order of measuring: +1 reached rising, -1 falling.

    A setting that repeats the one before keeps its branch; the first takes the next one's, as a
    magnet is brought to the start of a ramp from beyond it.

    Examples
    --------
    >>> branch_of(np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0])).tolist()
    [1.0, 1.0, 1.0, 1.0, -1.0, -1.0]
    """
    steps = np.sign(np.diff(settings))
    found = np.concatenate([[0.0], steps])
    for i in range(1, len(found)):
        found[i] = found[i] or found[i - 1]
    first = next((f for f in found if f != 0.0), 1.0)
    return np.where(found == 0.0, first, found)


def _first_strength(seen: PreparedScan, magnet: str, current: np.ndarray) -> np.ndarray:
    """k1 · E in MeV/m² as the lattice has it, at settings of a magnet."""
    element, energy = seen.scanned[magnet], float(seen.scanned.energy)
    return np.asarray(_strengths(element.calibration, current, element.length, energy)) * energy


@jax.jit
def _strengths(calibration: Any, settings: Array, length: float, energy: float) -> Array:
    """k1 in 1/m² at settings of shape (n,), or (n, 2) with branches."""
    return jax.vmap(lambda s: calibration.k1l(s, length, energy))(settings) / length


@tree.node("magnet")
class _Asked:
    """Settings of a magnet at which k1 is asked for, shape (n,) or (n, 2), with length, energy."""

    magnet: str
    settings: Any
    length: Any
    energy: Any


def _k1(model: Any, asked: _Asked) -> Array:
    return _strengths(model["magnets"][asked.magnet], asked.settings, asked.length, asked.energy)


def _loop(model: Any, asked: _Asked) -> Array:
    """Width of the hysteresis loop: k1 of the first setting less that of the second."""
    up, down = _k1(model, asked)
    return (up - down)[None]


def _predicted(model: Any, asked: _Asked) -> Array:
    """k1 · E, for a record of what is known beforehand."""
    return _k1(model, asked) * asked.energy


def _less_common(model: Any, asked: _Asked) -> Array:
    """The same without the error that all settings share."""
    return _predicted(model, asked) / (1.0 + model["anchor"][asked.magnet])


def _state(seen: PreparedScan, told: Assumptions) -> Problem:
    """Beams and one network of k1 for each scanned magnet."""
    varied = varied_magnets(seen.scan)
    if several := [name for name in varied if len(seen.scanned.members(name)) > 1]:
        found = f"a network of k1 for '{several[0]}', which feeds several magnets"
        raise InputError(found, "a scan of magnets on supplies of their own")
    branches = _branches(seen, varied) if told.hysteresis else {}
    strengths, weights, records = {}, [], []
    for name in varied:
        if not seen.scanned[name].length:
            raise InputError(f"a network of k1 for '{name}', which has no length", "a quadrupole")
        strengths[name], free = _strength(seen, name, told, name in branches)
        weights += free
        records += _anchors(seen, name, told, name in branches)
    settings = seen.rows.settings | {
        name: np.stack([seen.rows.settings[name], padded(branch)], -1)
        for name, branch in branches.items()
    }
    rows = {plane: seen.of_plane(plane, settings) for plane in seen.planes}
    part = {"magnets": strengths}
    return network_problem(seen, told, varied, varied, rows, part, weights, records)


def _branches(seen: PreparedScan, varied: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Branch of every row, where settings both rise and fall."""
    branches = {name: branch_of(seen.scan.settings[name]) for name in varied}
    single = [name for name, branch in branches.items() if np.ptp(branch) == 0]
    if single:
        raise seen.scan.unusable(
            f"settings of '{single[0]}' that only rise or only fall, with hysteresis",
            "rows in the order of measuring, with rising and falling settings",
            single[0],
        )
    return branches


def _strength(
    seen: PreparedScan, name: str, told: Assumptions, branches: bool
) -> tuple[NetworkStrength, list[Free]]:
    """A network that starts as the straight line between the lattice's own k1 at both ends."""
    settings = seen.scan.settings[name]
    low, high = float(settings.min()), float(settings.max())
    ends = _first_strength(seen, name, np.array([low, high]))
    ports = [Port("I", "", 0, (high - low) / 2, (high + low) / 2)]
    rising = [np.sign(ends[1] - ends[0]) or 1.0]
    if branches:
        # A branch moves k1 by a few per cent of its range at most: small weights do it.
        ports.append(Port("branch", "", 0, 10.0, 0.0))
        rising.append(0.0)
    half = abs(float(ends[1] - ends[0])) / 2 or 1.0
    output = Port(f"{name}.k1E", "", 0, half, float(ends.mean()))
    path, rises = f"magnets.{name}.network", np.array([rising])
    net, free = signed_network(path, ports, [output], rises, told.hidden, told.seed, MOST)
    return NetworkStrength(net, seen.scanned[name].calibration.unit), free


def _anchors(seen: PreparedScan, name: str, told: Assumptions, branches: bool) -> Iterator[Record]:
    """Prior knowledge of k1, midway between the branches where there are two."""
    settings, anchor = seen.scan.settings[name], told.anchor
    largest = float(np.abs(_first_strength(seen, name, settings)).max())
    places = np.array([place[name] for place in anchor.at if name in place], float)
    element, energy = seen.scanned[name], float(seen.scanned.energy)
    every = np.unique(settings), anchor.deviation, _less_common
    for at, sd, predict in (every, (places, anchor.sd, _predicted)):
        if sd is None or not len(at):
            continue
        points = np.stack([at, np.zeros(len(at))], -1) if branches else at
        data = _Asked(name, padded(points), float(element.length), energy)
        values = _first_strength(seen, name, at)
        yield known_record(f"anchor {name}", predict, data, values, sd * largest)


def _parameters(seen: PreparedScan, told: Assumptions, fit: Fit) -> Iterator[Parameter]:
    """k1 at both ends and the middle of the scanned range, and the width of the loop."""
    energy, settled = float(seen.scanned.energy), fit.status is not Status.not_converged
    for name in varied_magnets(seen.scan):
        low, high = (float(f(seen.scan.settings[name])) for f in (np.min, np.max))
        middle = 0.5 * (low + high)
        at = np.array([low, middle, high])
        length = float(seen.scanned[name].length)
        found = fit.derive(_k1, _Asked(name, at, length, energy))
        for i, current in enumerate(at):
            yield _derived(f"{name}.k1 at {current:g}", found, i, settled)
        if told.hysteresis:
            both = np.array([[middle, 1.0], [middle, -1.0]])
            found = fit.derive(_loop, _Asked(name, both, length, energy))
            yield _derived(f"{name}.k1 rising less falling at {middle:g}", found, 0, settled)


def _derived(name: str, found: Derived, i: int, settled: bool) -> Parameter:
    known = settled and bool(np.isfinite(found.error[i]))
    errors = (float(found.error[i]), float(found.error_raw[i])) if known else (None, None)
    value = Quantity(float(found.value[i]), errors[0], "1/m^2", errors[1])
    return Parameter(name, value, Status.converged if known else Status.unidentified)


OPEN = (
    "at each setting k1 is free to take up what the beam leaves: another beam with another curve "
    "k1(I) gives the same sizes"
)
SCENARIO = Scenario(
    "focusing-network",
    _state,
    _parameters,
    null_directions=lambda _seen, _parameters, identified: () if identified else (OPEN,),
    remedy=lambda _seen, _told: (
        "sizes at a second screen, or an anchor to the lattice's calibration "
        "(--anchor first-principles=2%)"
    ),
    network=True,
)
