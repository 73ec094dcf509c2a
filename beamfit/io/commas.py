"""Numbers with a decimal comma, as spreadsheets of much of Europe write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from beamfit.io.headers import is_number

COMMA = re.compile(r"[-+]?(\d+|\d{1,3}(?:[.'’\xa0\u202f]\d{3})+),\d+([eEdD][-+]?\d+)?")
POINTS = str.maketrans({",": "."} | dict.fromkeys(".'’\xa0\u202f"))
# What could also be thousands; a spreadsheet puts semicolons between cells only where the comma is
# the decimal one, but tabs everywhere.
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
# With fewer such cells one of them may be a slip.
FEWEST = 3


def with_points(
    rows: Sequence[Sequence[str]], separator: str
) -> tuple[Sequence[Sequence[str]], tuple[str, ...]]:
    """Put points in the place of decimal commas, where all numbers of a table have those.

    Parameters
    ----------
    rows : sequence of sequences of str
        The cells.
    separator : str
        What stands between them: semicolons or tabs, or commas are never decimal ones.

    Returns
    -------
    tuple
        The rows, and a note that says so if they were changed. They are not where a number has a
        point, or where every comma could be one of thousands.

    Examples
    --------
    >>> with_points([["0,5", "1"], ["1,5", "2"], ["2,5", "3"]], ";")[0]
    [['0.5', '1'], ['1.5', '2'], ['2.5', '3']]
    """
    if separator not in (";", "\t") or not any("," in c for row in rows[:FEWEST] for c in row):
        return rows, ()
    commas = [cell for row in rows for cell in row if COMMA.fullmatch(cell)]
    points = any("." in cell and is_number(cell) for row in rows for cell in row)
    unclear = separator == "\t" and all(map(THOUSANDS.fullmatch, commas))
    if len(commas) < FEWEST or points or unclear:
        return rows, ()
    changed = [[c.translate(POINTS) if COMMA.fullmatch(c) else c for c in row] for row in rows]
    return changed, (
        f"Numbers have a decimal comma: '{commas[0]}' is {commas[0].translate(POINTS)}.",
    )
