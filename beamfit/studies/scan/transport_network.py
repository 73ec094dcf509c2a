"""The transport-network scenario: A_T and B_T are networks of the settings (report 3.3.2, case 2).

Signs of the gains, report eqs 38-39, are taken from first principles over the box of the scan,
where they have one sign, and hold by the signs of the weights. What the sizes then leave open is
large: see docs/scenarios.md.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox.bounds import over_cells
from beamfit.greybox.mlp import MLP, Port
from beamfit.greybox.problem import Problem, Record
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.focusing_network import signed_network, weight_free
from beamfit.studies.scan.scenario_data import (
    Seen,
    beam_free,
    beam_numbers,
    size_record,
    varied_magnets,
)
from beamfit.studies.scan.scenario_model import NetworkRows, network_elements, predict_network
from beamfit.studies.scan.transport import transfer_rows

__all__ = ["Certificate", "Gain", "certificate_of", "network_rows", "transport_problem"]

CELLS = 32
ELEMENTS = "ABCD"
# The sharpness of det T = 1.
DETERMINANT = 1e-3


class Gain(NamedTuple):
    """A gain of the network over the box of the scan: its enclosure, and the sign it must have."""

    name: str
    lower: float
    upper: float
    sign: int

    @property
    def holds(self) -> bool:
        """Whether the enclosure keeps to the sign; rounding is part of the enclosure."""
        reach = 1e-12 * max(abs(self.lower), abs(self.upper))
        if self.sign == 0:
            return True
        return self.upper <= reach if self.sign < 0 else self.lower >= -reach


class Certificate(NamedTuple):
    """Certified gains of a fitted network, and the box they hold over."""

    gains: tuple[Gain, ...]
    box: dict[str, tuple[float, float]]

    @property
    def holds(self) -> bool:
        """Whether every gain keeps to its sign everywhere in the box."""
        return all(gain.holds for gain in self.gains)


class _Layout(NamedTuple):
    """Inputs with their ranges, screens, and how many elements of T a screen has."""

    inputs: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    places: tuple[str, ...]
    elements: int


def _layout(seen: Seen, told: Assumptions) -> _Layout:
    varied = varied_magnets(seen)
    columns = {name: seen.scan.settings[name] for name in varied}
    if seen.scan.energy is not None and np.ptp(seen.scan.energy) > 0:
        columns["energy"] = seen.scan.energy
    order = [e.name for e in seen.scanned.elements]
    named = seen.scan.screen or (seen.scanned.screens[-1],)
    places = tuple(sorted(set(named), key=order.index))
    low, high = (np.array([f(v) for v in columns.values()]) for f in (np.min, np.max))
    return _Layout(tuple(columns), low, high, places, 4 if told.anchor.determinant else 2)


def _first_principles(seen: Seen, lay: _Layout, points: np.ndarray) -> np.ndarray:
    """A, B, C, D of the line, shape (points, planes, places, 4)."""
    held = {n: np.median(v) for n, v in seen.scan.settings.items()}
    settings = {n: jnp.full(len(points), v) for n, v in held.items()}
    energy = jnp.full(len(points), float(np.mean(seen.works[seen.planes[0]].given.energy)))
    for i, name in enumerate(lay.inputs):
        if name == "energy":
            energy = jnp.asarray(points[:, i])
        else:
            settings[name] = jnp.asarray(points[:, i])
    every = np.asarray(transfer_rows(seen.scanned, settings, energy, lay.places).planes)
    r = every[:, ["xy".index(p) for p in seen.planes]]
    return np.stack([r[..., 0, 0], r[..., 0, 1], r[..., 1, 0], r[..., 1, 1]], -1)


def _grid(lay: _Layout) -> np.ndarray:
    """Points that fill the box, its edges included."""
    number = max(3, round(600 ** (1 / len(lay.inputs))))
    axes = [np.linspace(a, b, number) for a, b in zip(lay.low, lay.high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


def _signs(seen: Seen, lay: _Layout, grid: np.ndarray) -> np.ndarray:
    """Signs of the gains of A and B by first principles, shape (outputs, inputs); 0 if mixed."""
    half = 0.5 * (lay.high - lay.low)
    found = []
    for i in range(len(lay.inputs)):
        step = np.zeros(len(lay.inputs))
        step[i] = 1e-4 * half[i]
        change = _first_principles(seen, lay, grid + step) - _first_principles(
            seen, lay, grid - step
        )
        down, up = (change < 0).all(axis=0), (change > 0).all(axis=0)
        sign = up.astype(int) - down.astype(int)
        sign[..., 2:] = 0  # nothing is asked of C and D
        if lay.inputs[i] == "energy":
            sign[:] = 0
        found.append(sign[..., : lay.elements].reshape(-1))
    return np.array(found, float).T


def network_rows(seen: Seen, lay: _Layout, plane: str) -> NetworkRows:
    """Inputs of the network and the place of A and B among its outputs, for one plane's rows."""
    given = seen.works[plane].given
    columns = [given.energy if n == "energy" else given.settings[n] for n in lay.inputs]
    which = np.array([lay.places.index(s) for s in given.screen])
    return NetworkRows(
        plane,
        seen.squared,
        jnp.asarray(np.stack(columns, -1)),
        jnp.asarray(_columns(seen, lay, plane, which)),
        jnp.asarray(given.known),
    )


def _columns(seen: Seen, lay: _Layout, plane: str, which: np.ndarray) -> np.ndarray:
    first = (seen.planes.index(plane) * len(lay.places) + which) * lay.elements
    return first[:, None] + np.arange(lay.elements)


def transport_problem(seen: Seen, told: Assumptions) -> Problem:
    """State the problem: beams, and one network for A and B of every plane and screen.

    Parameters
    ----------
    seen : Seen
        The scan.
    told : Assumptions
        Hidden nodes, anchor.

    Returns
    -------
    Problem

    Raises
    ------
    InputError
        If an anchor names a magnet that was not scanned.
    """
    lay = _layout(seen, told)
    for place in told.anchor.at:
        for name in place:
            if name not in lay.inputs:
                raise InputError(
                    f"an anchor at '{name}'", f"a scanned magnet: {', '.join(lay.inputs)}"
                )
    grid = _grid(lay)
    first = _first_principles(seen, lay, grid)[..., : lay.elements].reshape(len(grid), -1)
    signs = _signs(seen, lay, grid)
    net, bounds = signed_network(
        [
            Port(n, "", 0, (b - a) / 2, (b + a) / 2)
            for n, a, b in zip(lay.inputs, lay.low, lay.high, strict=True)
        ],
        [
            Port(name, "", 0, np.ptp(v) / 2 or 1.0, (v.max() + v.min()) / 2)
            for name, v in zip(_names(seen, lay), first.T, strict=True)
        ],
        signs,
        told.hidden,
        told.seed,
    )
    beams = beam_numbers(seen)
    records = []
    for plane in seen.planes:
        rows = network_rows(seen, lay, plane)
        records.append(size_record(seen, plane, rows, predict_network))
        records += _anchors(seen, lay, told, plane, rows)
    return Problem(
        {"beam": beams, "map": net}, beam_free(beams) + weight_free("map", bounds), records
    )


def _names(seen: Seen, lay: _Layout) -> list[str]:
    several = len(lay.places) > 1
    return [
        f"{e}_{plane}" + (f"@{place}" if several else "")
        for plane in seen.planes
        for place in lay.places
        for e in ELEMENTS[: lay.elements]
    ]


def _anchors(seen: Seen, lay: _Layout, told: Assumptions, plane: str, rows) -> list[Record]:
    """What ties the network to first principles, as records."""
    anchor, found = told.anchor, []
    own = _first_principles(seen, lay, np.asarray(rows.inputs))[:, seen.planes.index(plane)]
    which = np.asarray(rows.columns)[:, 0] // lay.elements % len(lay.places)
    own = own[np.arange(len(own)), which]
    size = np.sqrt(np.mean(own**2, axis=0))
    if anchor.deviation is not None:
        only = rows.columns[:, :2]
        sd = anchor.deviation * size[:2]
        found.append(_known(f"anchor {plane}", rows, rows.inputs, only, own[:, :2], sd))
    for place in anchor.at:
        middle = 0.5 * (lay.low + lay.high)
        point = np.array([[place.get(n, m) for n, m in zip(lay.inputs, middle, strict=True)]])
        here = _first_principles(seen, lay, point)[0, seen.planes.index(plane), :, : lay.elements]
        points = np.repeat(point, len(lay.places), axis=0)
        columns = _columns(seen, lay, plane, np.arange(len(lay.places)))
        sd = anchor.sd * size[: lay.elements]
        name = f"anchor {plane} at one setting"
        found.append(_known(name, rows, jnp.asarray(points), jnp.asarray(columns), here, sd))
    if anchor.determinant:
        found.append(Record(f"det T {plane}", _determinant, rows, np.ones(len(own)), DETERMINANT))
    return found


def _known(name: str, rows: NetworkRows, inputs, columns, values, sd) -> Record:
    data = NetworkRows(rows.plane, rows.squared, inputs, columns, rows.known)
    error = np.broadcast_to(sd, np.shape(values))
    return Record(name, network_elements, data, values, error)


def _determinant(model, rows: NetworkRows) -> jax.Array:
    """A D - B C at every row."""
    a, b, c, d = network_elements(model, rows).T
    return a * d - b * c


def certificate_of(problem: Problem, net: MLP) -> Certificate:
    """Enclose the gains of a fitted network over the box of the scan.

    Parameters
    ----------
    problem : Problem
        From `transport_problem`; its bounds tell which sign each gain must have.
    net : MLP
        The fitted network.

    Returns
    -------
    Certificate
        For every current in the box, not only the measured ones, outward rounding included.
    """
    ports = net.input_ports
    low = np.array([p.bias - p.scale for p in ports])
    high = np.array([p.bias + p.scale for p in ports])
    bound = over_cells(net, low, high, CELLS if len(ports) == 1 else 8)
    lower, upper = np.asarray(bound.lower).min(axis=0), np.asarray(bound.upper).max(axis=0)
    sign = _asked(problem, net)
    gains = tuple(
        Gain(f"d{out.name}/d{port.name}", float(lower[o, i]), float(upper[o, i]), int(sign[o, i]))
        for o, out in enumerate(net.output_ports)
        for i, port in enumerate(ports)
    )
    box = {p.name: (float(a), float(b)) for p, a, b in zip(ports, low, high, strict=True)}
    return Certificate(gains, box)


def _asked(problem: Problem, net: MLP) -> np.ndarray:
    """Signs the bounds of the weights ask of the gains, shape (outputs, inputs)."""
    ends = {
        f.path.rsplit(".", 1)[-1]: np.sign(np.asarray(f.lower) + np.asarray(f.upper))
        for f in problem.free
        if ".weights." in f.path
    }
    first, last = (ends[f"layer{i}->layer{i + 1}"][...] for i in (0, 1))
    return last[0][:, None] * first[:, 0][None, :]
