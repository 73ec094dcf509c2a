"""The keys of a TOML lattice: which element has which, of what kind, in what range."""

from __future__ import annotations

import math
from typing import Any

__all__ = ["ELEMENTS", "FORMAT", "KINDS", "RANGES", "STRENGTHS", "TOP", "amiss"]

FORMAT = "beamfit-lattice-1"
# Settings a magnet may be given, one of them; the key says the unit.
STRENGTHS = {
    "current_A": "A",
    "integrated_gradient_kG": "kG",
    "k1_per_m2": "k1",
    "k1l_per_m": "k1l",
}
NUMBER, TEXT, LIST, FLAG = (int, float), str, list, bool
# Keys whose numbers have a range: from, to (open), and how to say it.
RANGES = {
    "length_m": (0.0, math.inf, "a positive number"),
    "radius_m": (0.0, math.inf, "a positive number; a negative angle bends the other way"),
    "resolution_um": (-1e-9, 2e4, "zero or more micrometres, below 20 mm"),
    "energy_spread": (-1e-9, 0.2, "a relative spread between 0 and 0.2; is it in %?"),
    "energy_offset": (-0.5, 0.5, "a relative offset between -0.5 and 0.5; is it in %?"),
    "angle_deg": (-360.0, 360.0, "an angle below 360 degrees"),
    "entrance_edge_deg": (-90.0, 90.0, "an angle below 90 degrees"),
    "exit_edge_deg": (-90.0, 90.0, "an angle below 90 degrees"),
}
ELEMENTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    # type: (required keys, optional keys)
    "drift": ({"length_m": NUMBER}, {"name": TEXT}),
    "quadrupole": (
        {"name": TEXT, "length_m": NUMBER},
        {
            "current_A": NUMBER,
            "slope": NUMBER,
            "intercept": NUMBER,
            "gradient_polynomial_T_per_m": LIST,
            "signed_intercept": FLAG,
            "integrated_gradient_kG": NUMBER,
            "k1_per_m2": NUMBER,
        },
    ),
    "thin_lens": ({"name": TEXT}, {"k1l_per_m": NUMBER, "integrated_gradient_kG": NUMBER}),
    "sector_dipole": (
        {"name": TEXT, "radius_m": NUMBER, "angle_deg": NUMBER, "bend_plane": TEXT},
        {
            "entrance_edge_deg": NUMBER,
            "exit_edge_deg": NUMBER,
            "energy_offset": NUMBER,
            "k1_per_m2": NUMBER,
        },
    ),
    "marker": ({"name": TEXT}, {}),
    "screen": ({"name": TEXT}, {"resolution_um": NUMBER}),
}
TOP = (
    {"format": TEXT, "energy_MeV": NUMBER, "element": LIST},
    {"name": TEXT, "source": TEXT, "particle": TEXT, "energy_spread": NUMBER, "design": dict},
)
# How each kind of value is called in a message.
KINDS = (
    (NUMBER, "a number"),
    (TEXT, "text in quotes"),
    (LIST, "a list"),
    (FLAG, "true or false"),
    (dict, "a table"),
)


def amiss(key: str, value: object, kind: Any) -> str | None:
    """Say what should stand under a key instead of a value, or None if the value is good.

    Examples
    --------
    >>> amiss("length_m", -1.0, NUMBER)
    'a positive number'
    """
    expected = next(said for k, said in KINDS if k == kind)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not FLAG):
        return expected
    if kind == NUMBER:
        low, high, said = RANGES.get(key, (-1e300, 1e300, expected))
        if not (abs(value) < 1e300 and low < value < high):
            return said if abs(value) < 1e300 else expected
    if key == "name" and not str(value).strip():
        return "a name"
    return None
