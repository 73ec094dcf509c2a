"""Shots of a scan: images to projections, profiles to rms sizes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from beamfit.density.profiles import MIN_BINS, profile_size
from beamfit.emittance.scan import PLANES, Profile
from beamfit.errors import InputError
from beamfit.io.columns import Sheet, columns_of, standard_header
from beamfit.io.files import MAX_BYTES, read_bytes
from beamfit.io.isolated import PIXEL, columns_of_images, projections, run_isolated

# Columns of a table of images, and the expected kind of image.
IMAGE, SHOT, PICTURES = "image", "shot", "PNG, or TIFF"
COUNTS, BACKGROUND, POSITION = "counts", "background", "position"
# Smallest number of settings: the beam matrix has three numbers.
MIN_SETTINGS = 3


def profiles_from_images(sheet: Sheet) -> Sheet:
    """Convert a table of images to a table of their projections.

    Parameters
    ----------
    sheet : Sheet
        With ``image``, the path of a file relative to the table (PNG, or any other format of
        Pillow), and ``pixel_um``; each row is a shot.

    Returns
    -------
    Sheet
        A row for each bin; the shorter projection of an image ends with NaN.

    Raises
    ------
    InputError
        If a file is no image, or ``pixel_um`` is missing.
    """
    if PIXEL not in sheet.names:
        raise sheet.header_error(f"images and no column {PIXEL}", "the width of a pixel")
    folder = Path(sheet.path).parent if sheet.path else Path()
    files = [str(folder / str(name).strip()) for name in sheet[IMAGE]]
    content = {}
    for row, name in enumerate(files):
        try:
            content[name] = read_bytes(name, "a smaller image", MAX_BYTES // len(files))
        except InputError as error:
            raise sheet.error(f"{name}: {error.found}", error.expected, row, IMAGE) from None
    found = run_isolated("an image", sheet.path, PICTURES, image_projections, content)
    projected, pixel = [found[name] for name in files], sheet.numbers(PIXEL)
    added = columns_of_images(projected, pixel)
    kept = sheet.select([n for n in sheet.names if n not in (IMAGE, PIXEL, SHOT)])
    kept = kept.take(added[SHOT].tolist())
    return replace(kept, names=(*kept.names, *added), cells=[*kept.cells, *added.values()])


def image_projections(content: Mapping[str, bytes]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Project images on x and y, by name; called in the child process."""
    from PIL import Image

    found = {}
    for name, image in content.items():
        try:
            with Image.open(io.BytesIO(image)) as picture:
                is_coloured = picture.mode == "P" or len(picture.getbands()) > 1
                pixels = np.asarray(picture.convert("RGB") if is_coloured else picture, float)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise InputError("no image, or a damaged one", PICTURES, name) from error
        if is_coloured:
            pixels = pixels.mean(axis=2)
        found[name] = projections(pixels)
    return found


def sizes_from_profiles(sheet: Sheet) -> tuple[Sheet, tuple[Profile, ...]]:
    """Convert a table of profiles to a table of rms sizes.

    Parameters
    ----------
    sheet : Sheet
        With ``position_um`` (or ``position_x_um``, ``position_y_um``), ``counts_x``, ``counts_y``
        and optionally ``background_x``, ``background_y``. Consecutive rows in which all other
        columns are equal are one shot.

    Returns
    -------
    Sheet, tuple of Profile
        A row for each shot with the rms sizes; and the profiles. A plane with a beam at fewer than
        three settings is left out if the other has more.

    Raises
    ------
    InputError
        If a shot has fewer than twelve bins or a repeated position, the positions are missing, or
        no profile shows a beam.
    """
    planes = [p for p in PLANES if f"{COUNTS}_{p}" in sheet.names]
    bins = {f"{kind}_{p}" for kind in (COUNTS, BACKGROUND) for p in planes}
    position_headers = [n for n in sheet.names if standard_header(n).startswith(POSITION)]
    others = [n for n in sheet.names if n not in bins and n not in position_headers]
    starts, ends = _shot_rows(sheet, others)
    keys = [POSITION, *(f"{POSITION}_{p}" for p in PLANES)]
    position = columns_of(sheet.select(position_headers), dict.fromkeys(keys, "length"))
    found, sizes = {}, {}
    for plane in planes:
        column = position.get(f"{POSITION}_{plane}") or position.get(POSITION)
        if column is None:
            raise sheet.header_error(f"no position of counts_{plane}", "a column position_um")
        x, counts = sheet.values(column), sheet[f"{COUNTS}_{plane}"]
        if not isinstance(counts, np.ndarray):  # from images; NaN beyond the shorter side
            counts = sheet.numbers(f"{COUNTS}_{plane}")
        if f"{BACKGROUND}_{plane}" in sheet.names:
            counts = counts - sheet.numbers(f"{BACKGROUND}_{plane}")
        shots = [
            Profile(plane, row, x[a:b], counts[a:b], None)
            for row, (a, b) in enumerate(zip(starts, ends, strict=True))
        ]
        for row, count, distinct in ((s.row, len(s.position), len(set(s.position))) for s in shots):
            if count < MIN_BINS:
                expected = f"{MIN_BINS} lines or more a shot"
                raise sheet.error(f"a profile of {count} bins", expected, int(starts[row]))
            if distinct < count:
                expected = "bins at positions of their own, a pixel above zero, and a column shot"
                raise sheet.error("a profile with a position twice", expected, int(starts[row]))
        sizes[plane], found[plane] = np.array([profile_size(s) for s in shots]), shots
    shot_sheet = sheet.select(others).take(list(starts))
    settings, notes = _settings_with_beam(shot_sheet, sizes), list(shot_sheet.notes)
    for plane in [p for p in planes if settings[p] < min(MIN_SETTINGS, max(settings.values()))]:
        notes.append(
            f"Left out: {plane}, whose profiles show a beam at {settings[plane]} settings."
        )
        del sizes[plane], found[plane]
    cells = [*shot_sheet.cells, *(list(map(str, v)) for v in sizes.values())]
    names = (*shot_sheet.names, *(f"size_{plane}_m" for plane in sizes))
    profiles = tuple(shot for shots in found.values() for shot in shots)
    return replace(shot_sheet, names=names, cells=cells, notes=tuple(notes)), profiles


def _settings_with_beam(sheet: Sheet, sizes: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Number of settings at which each plane has a size."""
    columns = [sheet[name] for name in sheet.names if standard_header(name) != "shot"]
    settings = list(zip(*(map(str, cells) for cells in columns), strict=True))
    counts = {
        plane: len({setting for setting, s in zip(settings, own, strict=True) if np.isfinite(s)})
        for plane, own in sizes.items()
    }
    if not any(counts.values()):
        expected = "counts that rise above the noise of their bins, with background at both ends"
        raise sheet.header_error("no profile that shows a beam", expected)
    return counts


def _shot_rows(sheet: Sheet, others: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """First row of each shot, and the row after its last."""
    keys = list(zip(*(list(map(str, sheet[name])) for name in others), strict=True))
    starts = [i for i in range(len(sheet)) if i == 0 or keys[i] != keys[i - 1]]
    return np.array(starts), np.array([*starts[1:], len(sheet)])
