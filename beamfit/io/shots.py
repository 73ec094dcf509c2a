"""Shots of a scan: profiles and images that become sizes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from beamfit.density.profiles import MIN_BINS, profile_size
from beamfit.emittance.scan import PLANES, Profile
from beamfit.errors import InputError
from beamfit.io.columns import Sheet, columns_of, spelled
from beamfit.io.files import LARGEST, read_bytes
from beamfit.io.isolated import PIXEL, columns_of_images, isolated, projections

# What a table of images names, and what an image should be.
IMAGE, SHOT, PICTURES = "image", "shot", "PNG, or TIFF"
COUNTS, BACKGROUND, POSITION = "counts", "background", "position"
# Settings without which a plane has no emittance.
FEWEST_SETTINGS = 3


def of_images(sheet: Sheet) -> Sheet:
    """Make a table of images a table of profiles, which are their projections.

    Parameters
    ----------
    sheet : Sheet
        With ``image``, the name of a file beside the table (PNG, or what else Pillow reads), and
        ``pixel_um``; each line is a shot.

    Returns
    -------
    Sheet
        A line a bin; the shorter side of an image is filled with NaN.

    Raises
    ------
    InputError
        If a file is no image, or there is no ``pixel_um``.
    """
    if PIXEL not in sheet.names:
        raise sheet.header_error(f"images and no column {PIXEL}", "the width of a pixel")
    place = Path(sheet.path).parent if sheet.path else Path()
    files = [str(place / str(name).strip()) for name in sheet[IMAGE]]
    content = {}
    for row, name in enumerate(files):
        try:
            content[name] = read_bytes(name, "a smaller image", LARGEST // len(files))
        except InputError as error:
            raise sheet.error(f"{name}: {error.found}", error.expected, row, IMAGE) from None
    found = isolated("an image", sheet.path, PICTURES, image_projections, content)
    seen, pixel = [found[name] for name in files], sheet.numbers(PIXEL)
    added = columns_of_images(seen, pixel)
    kept = sheet.only([n for n in sheet.names if n not in (IMAGE, PIXEL, SHOT)])
    kept = kept.rows(added[SHOT].tolist())
    return replace(kept, names=(*kept.names, *added), cells=[*kept.cells, *added.values()])


def image_projections(content: Mapping[str, bytes]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Project images on x and y, by name; called in a process of its own."""
    from PIL import Image

    found = {}
    for name, image in content.items():
        try:
            with Image.open(io.BytesIO(image)) as picture:
                coloured = picture.mode == "P" or len(picture.getbands()) > 1
                pixels = np.asarray(picture.convert("RGB") if coloured else picture, float)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise InputError("no image, or a damaged one", PICTURES, name) from error
        if coloured:
            pixels = pixels.mean(axis=2)
        found[name] = projections(pixels)
    return found


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
        A line a shot, with the rms sizes of the profiles; and these. A plane that shows a beam
        at fewer than three settings is left out where the other shows more.

    Raises
    ------
    InputError
        If a shot has fewer than twelve bins or a position twice, a column of positions is missing,
        or no profile shows a beam.
    """
    planes = [p for p in PLANES if f"{COUNTS}_{p}" in sheet.names]
    bins = {f"{kind}_{p}" for kind in (COUNTS, BACKGROUND) for p in planes}
    places = [n for n in sheet.names if spelled(n).startswith(POSITION)]
    rest = [n for n in sheet.names if n not in bins and n not in places]
    starts, ends = _shots(sheet, rest)
    keys = [POSITION, *(f"{POSITION}_{p}" for p in PLANES)]
    position = columns_of(sheet.only(places), dict.fromkeys(keys, "length"))
    found, sizes = {}, {}
    for plane in planes:
        column = position.get(f"{POSITION}_{plane}") or position.get(POSITION)
        if column is None:
            raise sheet.header_error(f"no position of counts_{plane}", "a column position_um")
        x, counts = sheet.values(column), sheet[f"{COUNTS}_{plane}"]
        if not isinstance(counts, np.ndarray):  # of images, NaN beyond the shorter side
            counts = sheet.numbers(f"{COUNTS}_{plane}")
        if f"{BACKGROUND}_{plane}" in sheet.names:
            counts = counts - sheet.numbers(f"{BACKGROUND}_{plane}")
        shots = [
            Profile(plane, row, x[a:b], counts[a:b], None)
            for row, (a, b) in enumerate(zip(starts, ends, strict=True))
        ]
        for row, count, places in ((s.row, len(s.position), len(set(s.position))) for s in shots):
            if count < MIN_BINS:
                expected = f"{MIN_BINS} lines or more a shot"
                raise sheet.error(f"a profile of {count} bins", expected, int(starts[row]))
            if places < count:
                expected = "bins at positions of their own, a pixel above zero, and a column shot"
                raise sheet.error("a profile with a position twice", expected, int(starts[row]))
        sizes[plane], found[plane] = np.array([profile_size(s) for s in shots]), shots
    kept = sheet.only(rest).rows(list(starts))
    seen, notes = _settings_with_beam(kept, sizes), list(kept.notes)
    for plane in [p for p in planes if seen[p] < min(FEWEST_SETTINGS, max(seen.values()))]:
        notes.append(f"Left out: {plane}, whose profiles show a beam at {seen[plane]} settings.")
        del sizes[plane], found[plane]
    cells = [*kept.cells, *(list(map(str, v)) for v in sizes.values())]
    names = (*kept.names, *(f"size_{plane}_m" for plane in sizes))
    profiles = tuple(shot for shots in found.values() for shot in shots)
    return replace(kept, names=names, cells=cells, notes=tuple(notes)), profiles


def _settings_with_beam(sheet: Sheet, sizes: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Count the settings at which a plane has a size."""
    columns = [sheet[name] for name in sheet.names if spelled(name) != "shot"]
    settings = list(zip(*(map(str, cells) for cells in columns), strict=True))
    seen = {
        plane: len({where for where, size in zip(settings, own, strict=True) if np.isfinite(size)})
        for plane, own in sizes.items()
    }
    if not any(seen.values()):
        expected = "counts that rise above the noise of their bins, with background at both ends"
        raise sheet.header_error("no profile that shows a beam", expected)
    return seen


def _shots(sheet: Sheet, rest: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """First line of each shot, and the first after it."""
    same = list(zip(*(list(map(str, sheet[name])) for name in rest), strict=True))
    new = [i for i in range(len(sheet)) if i == 0 or same[i] != same[i - 1]]
    return np.array(new), np.array([*new[1:], len(sheet)])
