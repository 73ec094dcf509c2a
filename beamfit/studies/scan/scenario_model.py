"""Scenario models: what predicts the sizes of a scan from free numbers, in JAX.

A model is a dictionary: ``beam`` holds the Cholesky factor of each plane's beam matrix in units of
1e-4 (m, rad), so that σ is in 1e-8 SI as in the report's Appendix A; beside it stand calibrations
by magnet name, or a network. Its numbers have paths such as ``beam.x.l11`` and ``Q2.slope``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from beamfit.greybox import tree
from beamfit.greybox.mlp import MLP
from beamfit.optics.beamline import Beamline
from beamfit.studies.scan.transport import transfer_rows

__all__ = [
    "UNIT",
    "NetworkRows",
    "NetworkStrength",
    "Rows",
    "line_of",
    "network_elements",
    "predict_network",
    "predict_sizes",
    "row_elements",
    "sigma_of",
]

UNIT = 1e-4  # m and rad of a beam's numbers


@partial(jax.tree_util.register_dataclass, data_fields=["network"], meta_fields=["unit"])
@dataclass(frozen=True)
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


@tree.node("plane", "places", "squared")
class Rows:
    """The rows of one plane: what predicts their sizes besides the model.

    Parameters
    ----------
    plane : str
        "x" or "y".
    places : tuple of str
        Screens.
    squared : bool
        Whether size² in µm² is compared (the report's ``error_linear``), or size in µm.
    line : Beamline
        The line, with the calibrations of the scan's columns.
    settings : dict of str to Array
        Magnet name to settings, shape (n,), or (n, 2) with the branch.
    energy, which, spread, resolution : Array
        MeV, index into places, relative momentum spread and point-spread rms in m, shape (n,).
    """

    plane: str
    places: tuple[str, ...]
    squared: bool
    line: Beamline
    settings: Any
    energy: Any
    which: Any
    spread: Any
    resolution: Any


def line_of(model: Any, line: Beamline) -> Beamline:
    """Put a model's calibrations and strengths into a line."""
    for name, calibration in model.items():
        if name not in ("beam", "map"):
            line = line.with_element(replace(line[name], calibration=calibration))
    return line


def row_elements(model: Any, rows: Rows) -> tuple[Array, Array, Array]:
    """R11, R12 and R16 of every row, shape (n,) each, through the model's line."""
    line = line_of(model, rows.line)
    every = transfer_rows(line, rows.settings, rows.energy, rows.places).planes
    own = every[:, "xy".index(rows.plane)]
    r = own[jnp.arange(own.shape[0]), rows.which]
    return r[:, 0, 0], r[:, 0, 1], r[:, 0, 2]


def sigma_of(beam: Any) -> Array:
    """σ11, σ12, σ22 in SI from the numbers of a beam, shape (3,)."""
    l11, l21, l22 = beam["l11"], beam["l21"], beam["l22"]
    return UNIT**2 * jnp.stack([l11**2, l11 * l21, l21**2 + l22**2])


def predict_sizes(model: Any, rows: Rows) -> Array:
    """Predict size² in µm², or size in µm, with the line as the model has it (report eq. 37)."""
    a, b, dispersion = row_elements(model, rows)
    known = (dispersion * rows.spread) ** 2 + rows.resolution**2
    return _compared(_squared(model["beam"][rows.plane], a, b) + known, rows.squared)


def _squared(beam: Any, a: Array, b: Array) -> Array:
    """Size² in m² without dispersion and resolution: |(a, b) L|²."""
    p, q = a * beam["l11"] + b * beam["l21"], b * beam["l22"]
    return UNIT**2 * (p**2 + q**2)


def _compared(squared: Array, as_square: bool) -> Array:
    return 1e12 * squared if as_square else 1e6 * jnp.sqrt(squared)


@tree.node("plane", "squared")
class NetworkRows:
    """The rows of one plane for a transport network: inputs, where A and B stand, known size².

    ``columns`` has shape (n, 2): the network's outputs that are A and B at each row's screen.
    """

    plane: str
    squared: bool
    inputs: Any
    columns: Any
    known: Any


def network_elements(model: Any, rows: NetworkRows) -> Array:
    """A and B of every row from the model's network, shape (n, 2)."""
    every = jax.vmap(model["map"].values)(rows.inputs)
    return jnp.take_along_axis(every, rows.columns, axis=1)


def predict_network(model: Any, rows: NetworkRows) -> Array:
    """Predict size² in µm², or size in µm, with A and B from the model's network."""
    ab = network_elements(model, rows)
    squared = _squared(model["beam"][rows.plane], ab[:, 0], ab[:, 1]) + rows.known
    return _compared(squared, rows.squared)
