"""The transport-network scenario: A_T and B_T are networks of the settings (report 3.3.2, case 2).

Signs of the gains, report eqs 38-39, are taken from first principles over the box of the scan,
where they have one sign, and hold by the signs of the weights. What the sizes then leave open is
large: see docs/scenarios.md. Anchors, or limits of gains and a box (Appendix B), come first: the
focusing network has the same anchors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.model import UNIT, sigma_of
from beamfit.emittance.statement import PreparedScan, Scenario, beam_problem, varied_magnets
from beamfit.emittance.transport import NetworkRows, padded
from beamfit.errors import InputError, nearest
from beamfit.greybox.gains import certified_gain
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record
from beamfit.greybox.signed_network import cells_along, signed_network
from beamfit.optics.beamline import transfer_rows

# Bounds of the weights: the report's (appendix B).
MOST = 10.0
# The appendix's random start of a weight; it gives the network no straight line to begin with.
START = 0.01
SIGMA = ("sigma11", "sigma12", "sigma22")
ELEMENTS = "ABCD"
# The sharpness of det T = 1.
DETERMINANT = 1e-3


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


@dataclass(frozen=True)
class _Sigma:
    """σ11, σ12, σ22 of a plane in units of 1e-8 SI; equal ones share their compiled code."""

    plane: str

    def __call__(self, model: Any, data: None) -> jax.Array:
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
    inputs: Sequence[str], box: np.ndarray, outputs: Sequence[str], told: Assumptions
) -> tuple[MLP, list[Free], list[Constraint]]:
    """The network of Appendix B: no scales, weights within ± 10, gains limited in a box (2, n)."""
    low, high = box.tolist()
    ports = [Port(n, "", lower=a, upper=b) for n, a, b in zip(inputs, low, high, strict=True)]
    net = dense(ports, outputs, [told.hidden], seed=told.seed, spread=START)
    free = [Free("map", -MOST, MOST, (-START, START), nuisance=True)]
    limits, cells = [], cells_along(len(inputs))
    for name, (least, most) in told.gains.items():
        output, by = (part.removeprefix("d") for part in name.split("/", 1))  # dA_x/dQ2
        limits += certified_gain("map", output, by, (low, high), cells, lower=least, upper=most)
    return net, free, limits


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


class _Layout(NamedTuple):
    """Inputs of the network, their columns and box, if the last is the energy; elements of T."""

    names: tuple[str, ...]
    columns: np.ndarray
    with_energy: bool
    elements: int
    box: np.ndarray


def _layout(seen: PreparedScan, told: Assumptions) -> _Layout:
    scan = seen.scan
    columns = {name: scan.settings[name] for name in varied_magnets(scan)}
    with_energy = scan.energy is not None and np.ptp(scan.energy) > 0
    columns |= {"energy": scan.energy} if with_energy else {}
    if not columns:
        found = "a transport network for a scan in which no magnet and no energy changes"
        raise scan.unusable(found, "scenario known: the network maps settings to R11 and R12")
    elements, values = 4 if told.anchor.determinant else 2, np.stack([*columns.values()], -1)
    return _Layout(tuple(columns), values, with_energy, elements, _box(seen, told, columns))


def _box(seen: PreparedScan, told: Assumptions, columns: dict[str, np.ndarray]) -> np.ndarray:
    """Ends of the inputs' box: those that were given, or else of the scan; shape (2, inputs)."""
    ends = []
    for name, values in columns.items():
        own = (values.min(), values.max())
        low, high = told.bounds.get(name, own)
        if low > own[0] or high < own[1]:
            found = f"bounds {name} = {low:g}:{high:g}, and a scan from {own[0]:g} to {own[1]:g}"
            raise seen.scan.unusable(found, "bounds that hold the scan", name)
        ends.append((low, high))
    return np.array(ends, float).T


def _first_principles(seen: PreparedScan, lay: _Layout, points: np.ndarray) -> np.ndarray:
    """A, B, C, D of the line, shape (points, planes, places, 4)."""
    full = padded(points)
    columns = dict(zip(lay.names, full.T, strict=True))
    energy = columns.pop("energy") if lay.with_energy else np.full(len(full), seen.energy)
    settings = {k: np.full(len(full), np.median(v)) for k, v in seen.scan.settings.items()}
    every = transfer_rows(seen.scanned, settings | columns, energy, seen.rows.places).planes
    r = np.asarray(every)[: len(points), ["xy".index(p) for p in seen.planes], :, :2, :2]
    return r.reshape(*r.shape[:3], 4)


def _grid(lay: _Layout) -> np.ndarray:
    """Points that fill the box, its edges included."""
    number = max(3, round(600 ** (1 / len(lay.names))))
    axes = [np.linspace(a, b, number) for a, b in zip(*lay.box, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


def _signs(seen: PreparedScan, lay: _Layout, grid: np.ndarray) -> np.ndarray:
    """Signs of the gains of A and B by first principles, shape (outputs, inputs); 0 if mixed."""
    half = 0.5 * (lay.box[1] - lay.box[0])
    found = np.zeros((len(seen.planes) * len(seen.rows.places) * lay.elements, len(half)))
    # Nothing is asked of the gains by the energy, nor of C and D.
    for i in range(len(half) - lay.with_energy):
        step = np.zeros(len(half))
        step[i] = 1e-4 * half[i]
        up, down = (_first_principles(seen, lay, grid + s) for s in (step, -step))
        sign = ((up > down).all(axis=0)).astype(int) - ((up < down).all(axis=0)).astype(int)
        sign[..., 2:] = 0
        found[:, i] = sign[..., : lay.elements].ravel()
    return found


def network_rows(seen: PreparedScan, lay: _Layout, plane: str) -> NetworkRows:
    """Inputs of the network and the place of A and B among its outputs, for one plane's rows."""
    return NetworkRows(
        plane,
        seen.rows.squared,
        padded(lay.columns),
        _columns(seen, lay, plane, seen.rows.which),
        seen.elements[2, "xy".index(plane)],
        seen.rows.damping,
    )


def _columns(seen: PreparedScan, lay: _Layout, plane: str, which: np.ndarray) -> np.ndarray:
    first = (seen.planes.index(plane) * len(seen.rows.places) + which) * lay.elements
    return first[:, None] + np.arange(lay.elements)


def _state(seen: PreparedScan, told: Assumptions) -> Problem:
    """Beams, and one network for A and B of every plane and screen."""
    lay = _layout(seen, told)
    outputs = _names(seen, lay)
    check_box(told, lay.names, outputs, seen.planes)
    if told.gains:
        net, weights, limits = limited_network(lay.names, lay.box, outputs, told)
    else:
        (net, weights), limits = _signed(seen, lay, told), []
    limits += beam_box(told, seen.planes)
    rows = {plane: network_rows(seen, lay, plane) for plane in seen.planes}
    anchors = [record for own in rows.values() for record in _anchors(seen, lay, told, own)]
    part = {"map": net}
    return network_problem(seen, told, lay.names, seen.planes, rows, part, weights, anchors, limits)


def _signed(seen: PreparedScan, lay: _Layout, told: Assumptions) -> tuple[MLP, list[Free]]:
    """A network scaled to its box, whose gains have the signs of first principles."""
    grid = _grid(lay)
    first = _first_principles(seen, lay, grid)[..., : lay.elements].reshape(len(grid), -1)
    inputs = [
        Port(n, "", 0, (b - a) / 2, (b + a) / 2)
        for n, a, b in zip(lay.names, *lay.box, strict=True)
    ]
    outputs = [
        Port(name, "", 0, np.ptp(v) / 2 or 1.0, (v.max() + v.min()) / 2)
        for name, v in zip(_names(seen, lay), first.T, strict=True)
    ]
    rising = _signs(seen, lay, grid)
    return signed_network("map", inputs, outputs, rising, told.hidden, told.seed, MOST)


def _names(seen: PreparedScan, lay: _Layout) -> list[str]:
    places = seen.rows.places
    return [
        f"{e}_{plane}" + (f"@{place}" if len(places) > 1 else "")
        for plane in seen.planes
        for place in places
        for e in ELEMENTS[: lay.elements]
    ]


def _anchors(
    seen: PreparedScan, lay: _Layout, told: Assumptions, rows: NetworkRows
) -> Iterator[Record]:
    """Tie of the network to first principles, as records."""
    anchor, plane, at = told.anchor, rows.plane, seen.measured(rows.plane)
    i, places = seen.planes.index(plane), len(seen.rows.places)
    points, which = lay.columns[at], seen.rows.which[at]
    own = _first_principles(seen, lay, points)[np.arange(len(at)), i, which]
    size = np.sqrt(np.mean(own**2, axis=0))[: lay.elements]

    def known(name, inputs, screens, values, sd, predict=_outputs, elements=lay.elements):
        columns = _columns(seen, lay, plane, padded(screens))[:, :elements]
        data = NetworkRows(plane, rows.squared, padded(inputs), columns, rows.known, rows.damping)
        return known_record(name, predict, data, values, sd)

    if anchor.deviation is not None:
        sd = anchor.deviation * size[:2]
        name = f"anchor {plane}"
        yield known(name, points, which, own[:, :2], sd, predict=_less_common, elements=2)
    for place in anchor.at:
        middle = 0.5 * (lay.box[0] + lay.box[1])
        point = np.array([[place.get(n, m) for n, m in zip(lay.names, middle, strict=True)]])
        here = _first_principles(seen, lay, point)[0, i, :, : lay.elements]
        inputs, screens = np.repeat(point, places, axis=0), np.arange(places)
        yield known(f"anchor {plane} at one setting", inputs, screens, here, anchor.sd * size)
    if anchor.determinant:
        yield known(f"det T {plane}", points, which, np.ones(len(at)), DETERMINANT, _determinant)


def _outputs(model, rows: NetworkRows) -> jax.Array:
    return rows.outputs(model)


def _less_common(model, rows: NetworkRows) -> jax.Array:
    """A and B without the error that all settings share."""
    return rows.outputs(model) / (1.0 + model["anchor"][rows.plane])


def _determinant(model, rows: NetworkRows) -> jax.Array:
    """A D - B C at every row."""
    a, b, c, d = rows.outputs(model).T
    return a * d - b * c


OPEN = (
    "[A B] -> [A B] G with sigma -> G^-1 sigma G^-T leaves every size as it is, for any "
    "invertible 2 x 2 matrix G (four directions; the emittance goes as 1/det G)",
    "at each setting one size is measured for two numbers A and B: what one gives the other can "
    "take",
)
SCENARIO = Scenario(
    "transport-network",
    _state,
    null_directions=lambda _seen, _parameters, identified: () if identified else OPEN,
    remedy=lambda _seen, _told: (
        "an anchor to first principles at every setting (--anchor first-principles=2%); T known at "
        "single settings or det T = 1 with C and D free do not suffice"
    ),
    network=True,
    whole_map=False,
)
