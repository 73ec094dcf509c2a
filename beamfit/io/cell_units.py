"""Units behind the numbers of a column's cells, as logbooks and forms write them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike

from beamfit.errors import InputError
from beamfit.io.headers import (
    NUMBER,
    is_number,
    named,
    plain_unit,
    spelled,
    unit_at_end,
    unit_behind,
)

# Columns of words, of which one may look so: a screen 2A.
WORDS = re.compile(r"(screen|slice|note|comment|remark).*", re.IGNORECASE)


def without_units(
    names: Sequence[str], rows: Sequence[Sequence[str]], path: str | PathLike[str], lines: list[int]
) -> tuple[list[str], Sequence[Sequence[str]]]:
    """Take units off cells, where they are those of the header or all cells have one.

    Parameters
    ----------
    names : sequence of str
        Headers; one without a unit gets that of its cells.
    rows : sequence of sequences of str
        The cells. Of a unit other than its column's a cell stays as it is, and is no number.
    path, lines
        Where they are from.

    Returns
    -------
    tuple
        Names and rows.

    Raises
    ------
    InputError
        If a number has no unit where the cells above it have one and the header none.

    Examples
    --------
    >>> without_units(["Q2_A", "size_x"], [["1", "627 um"], ["2 A", "580um"]], "a.csv", [2, 3])
    (['Q2_A', 'size_x_um'], [['1', '627'], ['2', '580']])
    """
    names, changed = list(names), None
    for i, name in enumerate(names):
        own = unit_at_end(plain_unit(spelled(name)))
        unit = own or unit_behind(next((row[i] for row in rows if row[i]), ""))
        said = [unit_behind(row[i]) for row in rows] if unit and not WORDS.match(name) else ()
        if unit is None or unit not in said:
            continue
        changed = changed or [list(row) for row in rows]
        names[i] = name if own else named(name, unit)
        for row, its, line in zip(changed, said, lines, strict=True):
            if its == unit:
                row[i] = NUMBER.fullmatch(row[i])[1]
            elif own is None and is_number(row[i].replace(",", ".")):
                expected = f"{unit} behind it, as above, or one unit in the header: {names[i]}"
                raise InputError(f"'{row[i]}' without a unit", expected, path, line, name)
    return names, changed or rows
