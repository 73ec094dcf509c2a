"""What is known of the errors of screen, beam and line, from a TOML file."""

from __future__ import annotations

import math
from os import PathLike
from typing import Any

from beamfit.io.toml import NUMBERS, TABLE, Key, Section, is_number, read_toml

FORMAT = "beamfit-systematics-1"
# Key of the file: the number's name, and the SI value of one unit.
TERMS = {
    "size_scale": ("size_scale", 1.0),
    "resolution_um": ("resolution", 1e-6),
    "wire_diameter_um": ("wire", 1e-6),
    "energy": ("energy", 1.0),
    "dispersion_m": ("dispersion", 1.0),
    "dispersion_slope": ("dispersion_slope", 1.0),
}
# Tables, one key an element: what of it, and the SI value of one unit.
TABLES = {"gradient": ("gradient", 1.0), "length_mm": ("length", 1e-3)}
SHAPE = "a standard deviation, or a list of mean and standard deviation"


def read_systematics(path: str | PathLike[str]) -> dict[str, tuple[float | None, float]]:
    """Read priors on screen, beam and line.

    Parameters
    ----------
    path : str or path
        A TOML file with any of ``size_scale``, ``resolution_um``, ``wire_diameter_um``,
        ``energy``, ``dispersion_m``, ``dispersion_slope``, and the tables ``gradient`` and
        ``length_mm`` with an element a key. Each has a standard deviation, or a list of mean and
        standard deviation. Scales and gradients are relative: 0.02 is 2 %.

    Returns
    -------
    dict of str to (float or None, float)
        As ``priors`` of `beamfit.fit_emittance`; a mean of None is what the line says.

    Raises
    ------
    InputError
        Naming file, line and key.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "known.toml"
    >>> _ = file.write_text("energy = 0.02\\ndispersion_m = [0.1, 0.02]\\n[gradient]\\nQ = 0.01")
    >>> read_systematics(file)
    {'energy': (None, 0.02), 'dispersion': (0.1, 0.02), 'Q.gradient': (None, 0.01)}
    """
    top = read_toml(path, "systematics", FORMAT, needed=False)
    schema = {name: Key(default=None, kind=NUMBERS) for name in TERMS}
    schema |= {name: Key(kind=TABLE, default=None) for name in TABLES}
    top.values(schema)
    found = {
        name: _prior(top, key, factor) for key, (name, factor) in TERMS.items() if key in top.table
    }
    for key, (what, factor) in TABLES.items():
        if key in top.table:
            part = top.section(key)
            found |= {f"{name}.{what}": _prior(part, name, factor) for name in part.table}
    if not found:
        raise top.error("a file that says nothing", f"one of {', '.join((*TERMS, *TABLES))}")
    return found


def _prior(part: Section, key: str, factor: float) -> tuple[float | None, float]:
    given: Any = part.table[key]
    numbers = given if isinstance(given, list) else [None, given]
    usable = len(numbers) == 2 and all(n is None or is_number(n) for n in numbers)
    if not usable or not (numbers[1] > 0 and math.isfinite(numbers[1])):
        raise part.error(f"{key} = {given}", SHAPE, key)
    mean, sd = numbers
    return None if mean is None else factor * mean, factor * sd
