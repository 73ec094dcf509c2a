"""Transport-network scenario: A_T and B_T are networks of the settings (report 3.3.2, case 2).

Signs of the gains, report eqs 38-39, come from first principles over the box of the scan, if they
have one sign there; signs of the weights enforce them. The sizes alone leave much open: see
docs/scenarios.md. The anchors, and limits of gains in a box (Appendix B), come first in the module:
the focusing network shares the anchors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.model import SIGMA, UNIT, sigma_of
from beamfit.emittance.statement import PreparedScan, Scenario, beam_problem, varied_magnets
from beamfit.emittance.transport import NetworkRows, pad_rows
from beamfit.errors import InputError, nearest
from beamfit.greybox.gains import certified_gain
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record
from beamfit.greybox.signed_network import cells_along, signed_network
from beamfit.optics.beamline import transfer_rows

# Bounds of the weights, as in the report (appendix B).
MAX_WEIGHT = 10.0
# Range of the random start of a weight, as in the appendix.
WEIGHT_START = 0.01
ELEMENTS = "ABCD"
# Standard deviation of det T about 1.
DETERMINANT_ERROR = 1e-3


def network_problem(
    prepared: PreparedScan,
    assumptions: Assumptions,
    inputs: Sequence[str],
    common: Iterable[str],
    rows: Mapping[str, Any],
    model: Mapping[str, Any],
    weights: Iterable[Free],
    records: Iterable[Record],
    limits: Iterable[Constraint] = (),
) -> Problem:
    """Problem of beams and networks, with the anchor's error that all settings share.

    A wrong energy or slope changes all settings alike and does not average out. The share of such
    errors in the deviation is unknown, so that the common error may be all of it. It applies to
    each name in `common`.
    """
    for name in (name for place in assumptions.anchor.at for name in place):
        if name not in inputs:
            raise InputError(f"an anchor at '{name}'", f"a scanned magnet: {', '.join(inputs)}")
    sd = assumptions.anchor.deviation
    shared = {} if sd is None else {"anchor": dict.fromkeys(common, 0.0)}
    names = [f"anchor.{name}" for name in shared.get("anchor", ())]
    free = [*weights, *(Free(name, -0.9, nuisance=True) for name in names)]
    priors = [Prior(name, 0.0, sd) for name in names]
    return beam_problem(prepared, rows, {**model, **shared}, free, records, priors, limits)


def known_record(
    name: str, predict: Callable[[Any, Any], Any], data: Any, values: Any, sd: Any
) -> Record:
    """Record that ties a network to first principles; pads the values, but not ``data``."""
    values = np.asarray(values, float)
    padded_values = pad_rows(values)
    weight = np.zeros(padded_values.shape)
    weight[: len(values)] = 1.0
    return Record(
        name, predict, data, padded_values, pad_rows(np.broadcast_to(sd, values.shape)), weight
    )


@dataclass(frozen=True)
class _Sigma:
    """σ11, σ12, σ22 of a plane in units of 1e-8 SI; equal instances share their compiled code."""

    plane: str

    def __call__(self, model: Any, data: None) -> jax.Array:
        return sigma_of(model["beam"][self.plane]) / UNIT**2


def beam_box(assumptions: Assumptions, planes: Sequence[str]) -> list[Constraint]:
    """Bounds of each plane's beam matrix, one constraint per plane with bounds."""
    found = []
    for plane in planes:
        bounds = [assumptions.bounds.get(f"{plane}.{name}", (-np.inf, np.inf)) for name in SIGMA]
        low, high = np.array(bounds).T / UNIT**2
        if np.isfinite(low).any():
            found.append(Constraint(f"box {plane}", _Sigma(plane), None, low, high))
    return found


def limited_network(
    inputs: Sequence[str], box: np.ndarray, outputs: Sequence[str], assumptions: Assumptions
) -> tuple[MLP, list[Free], list[Constraint]]:
    """Network of Appendix B: no scales, weights within ± 10, gains limited in a box (2, n)."""
    low, high = box.tolist()
    ports = [Port(n, "", lower=a, upper=b) for n, a, b in zip(inputs, low, high, strict=True)]
    net = dense(ports, outputs, [assumptions.hidden], seed=assumptions.seed, spread=WEIGHT_START)
    free = [Free("map", -MAX_WEIGHT, MAX_WEIGHT, (-WEIGHT_START, WEIGHT_START), nuisance=True)]
    limits, cells = [], cells_along(len(inputs))
    for name, (lower, upper) in assumptions.gains.items():
        output, by = (part.removeprefix("d") for part in name.split("/", 1))  # dA_x/dQ2
        limits += certified_gain("map", output, by, (low, high), cells, lower=lower, upper=upper)
    return net, free, limits


def check_box(
    assumptions: Assumptions, inputs: Sequence[str], outputs: Sequence[str], planes
) -> None:
    """Raise an error for bounds and gains of unknown names.

    Raises
    ------
    InputError
        With the nearest possible name.
    """
    numbers = [f"{plane}.{name}" for plane in planes for name in SIGMA] + list(inputs)
    gains = [f"d{output}/d{by}" for output in outputs for by in inputs]
    for what, named, possible in (
        ("bounds on", assumptions.bounds, numbers),
        ("gain", assumptions.gains, gains),
    ):
        for name in named:
            if name not in possible:
                raise InputError(f"{what} '{name}'", nearest(name, possible))


class _Layout(NamedTuple):
    """Inputs of a network: names, columns, whether the last is the energy, elements of T, box."""

    names: tuple[str, ...]
    columns: np.ndarray
    with_energy: bool
    elements: int
    box: np.ndarray


def _layout(prepared: PreparedScan, assumptions: Assumptions) -> _Layout:
    """Inputs and outputs of the network for a scan."""
    scan = prepared.scan
    columns = {name: scan.settings[name] for name in varied_magnets(scan)}
    with_energy = scan.energy is not None and np.ptp(scan.energy) > 0
    columns |= {"energy": scan.energy} if with_energy else {}
    if not columns:
        found = "a transport network for a scan in which no magnet and no energy changes"
        raise scan.unusable(found, "scenario known: the network maps settings to R11 and R12")
    elements, values = 4 if assumptions.anchor.determinant else 2, np.stack([*columns.values()], -1)
    return _Layout(
        tuple(columns), values, with_energy, elements, _box(prepared, assumptions, columns)
    )


def _box(
    prepared: PreparedScan, assumptions: Assumptions, columns: dict[str, np.ndarray]
) -> np.ndarray:
    """Box of the inputs, given or else the range of the scan; shape (2, inputs)."""
    ends = []
    for name, values in columns.items():
        scanned = (values.min(), values.max())
        low, high = assumptions.bounds.get(name, scanned)
        if low > scanned[0] or high < scanned[1]:
            found = f"bounds {name} = {low:g}:{high:g}, and a scan from "
            found += f"{scanned[0]:g} to {scanned[1]:g}"
            raise prepared.scan.unusable(found, "bounds that hold the scan", name)
        ends.append((low, high))
    return np.array(ends, float).T


def _first_principles(prepared: PreparedScan, layout: _Layout, points: np.ndarray) -> np.ndarray:
    """A, B, C, D of the line, shape (points, planes, places, 4)."""
    full = pad_rows(points)
    columns = dict(zip(layout.names, full.T, strict=True))
    energy = columns.pop("energy") if layout.with_energy else np.full(len(full), prepared.energy)
    settings = {k: np.full(len(full), np.median(v)) for k, v in prepared.scan.settings.items()}
    planes = transfer_rows(
        prepared.scanned, settings | columns, energy, prepared.rows.places
    ).planes
    r = np.asarray(planes)[: len(points), ["xy".index(p) for p in prepared.planes], :, :2, :2]
    return r.reshape(*r.shape[:3], 4)


def _grid(layout: _Layout) -> np.ndarray:
    """Points that fill the box, including its edges."""
    number = max(3, round(600 ** (1 / len(layout.names))))
    axes = [np.linspace(a, b, number) for a, b in zip(*layout.box, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


def _signs(prepared: PreparedScan, layout: _Layout, grid: np.ndarray) -> np.ndarray:
    """Signs of the gains of A and B from first principles, (outputs, inputs); 0 if mixed."""
    half = 0.5 * (layout.box[1] - layout.box[0])
    signs = np.zeros(
        (len(prepared.planes) * len(prepared.rows.places) * layout.elements, len(half))
    )
    # Gains of the energy, and those of C and D, are not constrained.
    for i in range(len(half) - layout.with_energy):
        step = np.zeros(len(half))
        step[i] = 1e-4 * half[i]
        up, down = (_first_principles(prepared, layout, grid + s) for s in (step, -step))
        sign = ((up > down).all(axis=0)).astype(int) - ((up < down).all(axis=0)).astype(int)
        sign[..., 2:] = 0
        signs[:, i] = sign[..., : layout.elements].ravel()
    return signs


def network_rows(prepared: PreparedScan, layout: _Layout, plane: str) -> NetworkRows:
    """Inputs of the network, and positions of A and B among its outputs, for a plane's rows."""
    return NetworkRows(
        plane,
        prepared.rows.squared,
        pad_rows(layout.columns),
        _columns(prepared, layout, plane, prepared.rows.screen_index),
        prepared.elements[2, "xy".index(plane)],
        prepared.rows.damping,
    )


def _columns(
    prepared: PreparedScan, layout: _Layout, plane: str, screen_index: np.ndarray
) -> np.ndarray:
    """Positions of a plane's elements among the outputs, for screens given by their index."""
    first = (
        prepared.planes.index(plane) * len(prepared.rows.places) + screen_index
    ) * layout.elements
    return first[:, None] + np.arange(layout.elements)


def _state(prepared: PreparedScan, assumptions: Assumptions) -> Problem:
    """Problem of the beams and one network for A and B of every plane and screen."""
    layout = _layout(prepared, assumptions)
    outputs = _names(prepared, layout)
    check_box(assumptions, layout.names, outputs, prepared.planes)
    if assumptions.gains:
        net, weights, limits = limited_network(layout.names, layout.box, outputs, assumptions)
    else:
        (net, weights), limits = _sign_network(prepared, layout, assumptions), []
    limits += beam_box(assumptions, prepared.planes)
    rows = {plane: network_rows(prepared, layout, plane) for plane in prepared.planes}
    anchors = [
        record
        for plane_rows in rows.values()
        for record in _anchors(prepared, layout, assumptions, plane_rows)
    ]
    model = {"map": net}
    return network_problem(
        prepared, assumptions, layout.names, prepared.planes, rows, model, weights, anchors, limits
    )


def _sign_network(
    prepared: PreparedScan, layout: _Layout, assumptions: Assumptions
) -> tuple[MLP, list[Free]]:
    """Network scaled to its box, whose gains have the signs of first principles."""
    grid = _grid(layout)
    elements = _first_principles(prepared, layout, grid)[..., : layout.elements].reshape(
        len(grid), -1
    )
    inputs = [
        Port(n, "", 0, (b - a) / 2, (b + a) / 2)
        for n, a, b in zip(layout.names, *layout.box, strict=True)
    ]
    outputs = [
        Port(name, "", 0, np.ptp(v) / 2 or 1.0, (v.max() + v.min()) / 2)
        for name, v in zip(_names(prepared, layout), elements.T, strict=True)
    ]
    rising = _signs(prepared, layout, grid)
    return signed_network(
        "map", inputs, outputs, rising, assumptions.hidden, assumptions.seed, MAX_WEIGHT
    )


def _names(prepared: PreparedScan, layout: _Layout) -> list[str]:
    """Names of the network's outputs."""
    places = prepared.rows.places
    return [
        f"{e}_{plane}" + (f"@{place}" if len(places) > 1 else "")
        for plane in prepared.planes
        for place in places
        for e in ELEMENTS[: layout.elements]
    ]


def _anchors(
    prepared: PreparedScan, layout: _Layout, assumptions: Assumptions, rows: NetworkRows
) -> Iterator[Record]:
    """Records that tie the network of a plane to first principles."""
    anchor, plane, at = assumptions.anchor, rows.plane, prepared.measured(rows.plane)
    i, places = prepared.planes.index(plane), len(prepared.rows.places)
    points, screen_index = layout.columns[at], prepared.rows.screen_index[at]
    line_elements = _first_principles(prepared, layout, points)[np.arange(len(at)), i, screen_index]
    size = np.sqrt(np.mean(line_elements**2, axis=0))[: layout.elements]

    def record(name, inputs, screens, values, sd, predict=_outputs, elements=layout.elements):
        columns = _columns(prepared, layout, plane, pad_rows(screens))[:, :elements]
        data = NetworkRows(plane, rows.squared, pad_rows(inputs), columns, rows.known, rows.damping)
        return known_record(name, predict, data, values, sd)

    if anchor.deviation is not None:
        sd = anchor.deviation * size[:2]
        name = f"anchor {plane}"
        yield record(
            name,
            points,
            screen_index,
            line_elements[:, :2],
            sd,
            predict=_without_common_error,
            elements=2,
        )
    for place in anchor.at:
        middle = 0.5 * (layout.box[0] + layout.box[1])
        point = np.array([[place.get(n, m) for n, m in zip(layout.names, middle, strict=True)]])
        at_point = _first_principles(prepared, layout, point)[0, i, :, : layout.elements]
        inputs, screens = np.repeat(point, places, axis=0), np.arange(places)
        yield record(f"anchor {plane} at one setting", inputs, screens, at_point, anchor.sd * size)
    if anchor.determinant:
        yield record(
            f"det T {plane}",
            points,
            screen_index,
            np.ones(len(at)),
            DETERMINANT_ERROR,
            _determinant,
        )


def _outputs(model, rows: NetworkRows) -> jax.Array:
    """Elements of T at the rows."""
    return rows.outputs(model)


def _without_common_error(model, rows: NetworkRows) -> jax.Array:
    """A and B without the error that all settings share."""
    return rows.outputs(model) / (1.0 + model["anchor"][rows.plane])


def _determinant(model, rows: NetworkRows) -> jax.Array:
    """A D - B C at each row."""
    a, b, c, d = rows.outputs(model).T
    return a * d - b * c


NULL_DIRECTIONS = (
    "[A B] -> [A B] G with sigma -> G^-1 sigma G^-T leaves every size as it is, for any "
    "invertible 2 x 2 matrix G (four directions; the emittance goes as 1/det G)",
    "at each setting one size is measured for two numbers A and B: what one gives the other can "
    "take",
)
SCENARIO = Scenario(
    "transport-network",
    _state,
    null_directions=lambda _prepared, _parameters, identified: (
        () if identified else NULL_DIRECTIONS
    ),
    remedy=lambda _prepared, _assumptions: (
        "an anchor to first principles at every setting (--anchor first-principles=2%); T known at "
        "single settings or det T = 1 with C and D free do not suffice"
    ),
    network=True,
    whole_map=False,
)
