"""Tables of profiles: a line a bin of each shot, with the settings beside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamfit.density.profiles import FEWEST_BINS, profile_size
from beamfit.emittance.scan import PLANES, Profile
from beamfit.io.columns import Sheet, columns_of
from beamfit.io.headers import spelled

COUNTS, BACKGROUND, POSITION = "counts", "background", "position"


def has_profiles(sheet: Sheet) -> bool:
    """Tell a table of profiles: it has columns counts_x or counts_y."""
    return any(f"{COUNTS}_{plane}" in sheet.names for plane in PLANES)


def of_profiles(sheet: Sheet) -> tuple[Sheet, tuple[Profile, ...]]:
    """Take the bins out of a table of profiles.

    Parameters
    ----------
    sheet : Sheet
        With ``position_um`` (or ``position_x_um``, ``position_y_um``), ``counts_x``, ``counts_y``
        and perhaps ``background_x``, ``background_y``. Lines in which all other columns are the
        same, one after the other, are one shot.

    Returns
    -------
    Sheet, tuple of Profile
        A line a shot, with the rms sizes of the profiles; and these.

    Raises
    ------
    InputError
        If a shot has fewer than twelve bins, or a column of positions is missing.
    """
    planes = [p for p in PLANES if f"{COUNTS}_{p}" in sheet.names]
    bins = {f"{kind}_{p}" for kind in (COUNTS, BACKGROUND) for p in planes}
    places = [n for n in sheet.names if spelled(n).startswith(POSITION)]
    rest = [n for n in sheet.names if n not in bins and n not in places]
    starts, ends = _shots(sheet, rest)
    keys = [POSITION, *(f"{POSITION}_{p}" for p in PLANES)]
    position = columns_of(sheet.only(places), dict.fromkeys(keys, "length"))
    found, sizes = [], {}
    for plane in planes:
        column = position.get(f"{POSITION}_{plane}") or position.get(POSITION)
        if column is None:
            raise sheet.header_error(f"no position of counts_{plane}", "a column position_um")
        x, counts = sheet.values(column), sheet[f"{COUNTS}_{plane}"]
        if not isinstance(counts, np.ndarray):  # of HDF5, NaN beyond the shorter side of an image
            counts = sheet.numbers(f"{COUNTS}_{plane}")
        if f"{BACKGROUND}_{plane}" in sheet.names:
            counts = counts - sheet.numbers(f"{BACKGROUND}_{plane}")
        shots = [
            Profile(plane, row, x[a:b], counts[a:b], None)
            for row, (a, b) in enumerate(zip(starts, ends, strict=True))
        ]
        short = next((s for s in shots if len(s.position) < FEWEST_BINS), None)
        if short is not None:
            said = f"a profile of {len(short.position)} bins"
            raise sheet.error(said, f"{FEWEST_BINS} lines or more a shot", int(starts[short.row]))
        sizes[f"size_{plane}_m"] = np.array([profile_size(s) for s in shots])
        found += shots
    kept = sheet.only(rest).rows(list(starts))
    cells = [*kept.cells, *(list(map(str, v)) for v in sizes.values())]
    return replace(kept, names=(*kept.names, *sizes), cells=cells), tuple(found)


def _shots(sheet: Sheet, rest: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """First line of each shot, and the first after it."""
    same = list(zip(*(list(map(str, sheet[name])) for name in rest), strict=True))
    new = [i for i in range(len(sheet)) if i == 0 or same[i] != same[i - 1]]
    return np.array(new), np.array([*new[1:], len(sheet)])
