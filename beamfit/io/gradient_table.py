"""Magnetic measurements: gradients of a quadrupole at currents, in a lattice or in a file."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from beamfit.io.sheet import Sheet, columns_of
from beamfit.io.table import read_sheet
from beamfit.io.toml import Section, is_number

EXAMPLE = "current_A,gradient_T_per_m"
# Columns of the gradient, and what makes them T/m in a magnet of some length in m.
GRADIENTS = {
    "gradient_T_per_m": lambda length: 1.0,
    "integrated_gradient_T": lambda length: 1.0 / length,
    "integrated_gradient_kG": lambda length: 0.1 / length,
}
# More points than any measurement of a magnet.
MOST_ROWS = 10_000


def gradient_table(section: Section, key: str, length: float) -> list[tuple[float, float]]:
    """Read the current in A and the gradient in T/m of a quadrupole, by rising current.

    Parameters
    ----------
    section : Section
        The quadrupole's table of the lattice.
    key : {"gradient_table", "gradient_table_file"}
        Pairs [A, T/m] in the lattice, or the name of a CSV file, from the lattice's folder.
    length : float
        Of the magnet, m.

    Returns
    -------
    list of (float, float)

    Raises
    ------
    InputError
        If there are fewer than two points, a current stands twice, or something is no number.
    """
    said = section.table[key]
    if key == "gradient_table":
        pairs = [p for p in said if isinstance(p, list) and len(p) == 2 and all(map(is_number, p))]
        if len(pairs) < len(said):
            wrong = next(p for p in said if p not in pairs)
            raise section.error(f"{wrong!r}"[:80], "pairs [current in A, gradient in T/m]", key)
        points = [(float(current), float(gradient)) for current, gradient in pairs]
    else:
        points = _points(read_sheet(Path(section.path).parent / said, EXAMPLE, MOST_ROWS), length)
    currents = sorted(current for current, _ in points)
    twice = next((a for a, b in pairwise(currents) if a == b), None)
    if len(points) < 2 or twice is not None:
        found = f"{twice:g} A twice" if twice is not None else f"{len(points)} points"
        expected = "two or more points of different currents, one of each"
        raise section.error(f"a gradient table with {found}", expected, key)
    return sorted(points)


def _points(sheet: Sheet, length: float) -> list[tuple[float, float]]:
    """The points of a file."""
    columns = columns_of(sheet, dict.fromkeys(("current_A", *GRADIENTS), ""))
    given = [name for name in GRADIENTS if name in columns]
    if "current_A" not in columns or len(given) != 1:
        found = "columns " + ", ".join(sheet.names)
        expected = "current_A and one of " + ", ".join(GRADIENTS)
        raise sheet.header_error(found, expected)
    factor = GRADIENTS[given[0]](length)
    gradients = factor * sheet.numbers(given[0])
    return list(zip(sheet.numbers("current_A").tolist(), gradients.tolist(), strict=True))
