"""The offset of a current monitor, stated or read without beam, and its stability."""

from __future__ import annotations

import re
from os import PathLike
from typing import NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.io.sheet import UNITS
from beamfit.studies.decay.record import Monitor

ZERO_BEAM = "zero-beam"
# Readings below this share of the largest are of no beam, if so many stand in a row. They scatter
# by less than the other share, or at least so many of them are no outliers.
NO_BEAM, FEWEST, STEADY, MOST = 0.02, 5, 2e-3, 0.9
# Robust standard deviations beyond which one of them does not count, as while the beam is dumped.
OUTLIER = 5.0
# Parts whose means tell the error, whatever the memory of the noise.
PARTS = 10


class Offset(NamedTuple):
    """What a monitor reads without beam, and its error, mA; which readings are of the beam."""

    value: float
    error: float
    beam: np.ndarray
    notes: tuple[str, ...] = ()


def offset_of(
    said: str | None, current: np.ndarray, path: str | PathLike[str] | None = None
) -> Offset:
    """Find the offset of a monitor.

    Parameters
    ----------
    said : str or None
        ``zero-beam``, or a current such as ``0.12mA`` or ``-30:uA``. None: no offset, and all
        readings are taken.
    current : array, shape (n,)
        Readings, mA.
    path : str or path, optional
        Their file, for messages.

    Returns
    -------
    Offset
        Readings of no beam are those below 2 % of the largest, five or more in a row.

    Raises
    ------
    InputError
        If it is neither, or no readings of no beam are there or they are not steady.

    Examples
    --------
    >>> offset_of("zero-beam", np.r_[np.tile([0.1, 0.3], 10), np.full(50, 500.0)]).notes[0]
    '20 readings without beam give the offset of the monitor, 0.2 ± 0.023 mA, which is taken off.'
    """
    beam = np.ones(current.size, bool)
    if said is None:
        return Offset(0.0, 0.0, beam)
    top = float(np.percentile(current, 99))
    low = np.abs(current) < NO_BEAM * top
    edges = np.flatnonzero(np.diff(np.r_[False, low, False].astype(int)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        beam[first:end] = end - first < FEWEST
    if said == ZERO_BEAM:
        value, error, count = _without_beam(current[~beam], top, path)
        note = (
            f"{count} readings without beam give the offset of the monitor, {value:.4g} ± "
            f"{error:.2g} mA, which is taken off."
        )
        return Offset(value, error, beam, (note,))
    units = "|".join(UNITS["current"])
    found = re.fullmatch(rf"\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*:?\s*({units})\s*", said)
    if found is None:
        raise InputError(f"--offset {said}", f"{ZERO_BEAM}, or a current such as 0.12mA")
    value = float(found[1]) * UNITS["current"][found[2]]
    return Offset(value, 0.0, beam, (f"The monitor's offset of {value:.4g} mA is taken off.",))


def _without_beam(dark: np.ndarray, top: float, path) -> tuple[float, float, int]:
    """Mean, error and number of readings without beam."""
    expected = "rows before injection or after the dump, or --offset with a current"
    if dark.size < FEWEST:
        raise InputError("no readings without beam", expected, path=path)
    off = np.abs(dark - np.median(dark))
    spread = 1.4826 * float(np.median(off))
    steady = off <= OUTLIER * spread
    if float(dark.std()) > STEADY * top and steady.mean() < MOST:
        found = f"readings near zero that scatter by {dark.std():.3g} mA"
        raise InputError(found, expected, path=path)
    dark = dark[steady]
    means = [part.mean() for part in np.array_split(dark, min(PARTS, dark.size))]
    several = np.std(means, ddof=1) / np.sqrt(len(means))
    error = max(float(several), float(dark.std(ddof=1)) / np.sqrt(dark.size))
    return float(dark.mean()), error, dark.size


def monitor_of(drift: str | None, offset: str | None) -> Monitor | None:
    """Read the stability of a current monitor; None if nothing is said of it.

    Parameters
    ----------
    drift : str or None
        A current for each time, such as ``10uA/h``: units as in a file's columns.
    offset : str or None
        A current, such as ``50uA``.

    Raises
    ------
    InputError
        If one is not of that form.

    Examples
    --------
    >>> print(monitor_of("0.24 mA/d", None))
    drifts by 10 µA/h
    """
    current = "|".join(UNITS["current"])
    found = []
    for name, text, per, example in (
        ("drift", drift, rf"\s*/\s*({'|'.join(UNITS['time'])})", "10uA/h"),
        ("offset", offset, "()", "50uA"),
    ):
        said = re.fullmatch(rf"\s*(\d+\.?\d*(?:[eE][-+]?\d+)?)\s*({current}){per}\s*", text or "")
        if text is not None and said is None:
            raise InputError(f"--monitor-{name} {text}", f"a stability such as {example}")
        value = 0.0 if said is None else float(said[1]) * UNITS["current"][said[2]]
        found.append(value * (3600 / UNITS["time"][said[3]] if said and said[3] else 1.0))
    return Monitor(*found) if any(found) else None
