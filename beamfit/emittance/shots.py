"""Repeats of a setting: rows of a scan that are shots of one, as `shot_size` of one row."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from beamfit.emittance.scan import KNOB, QuadScan, row_keys

# With fewer repeats in all (two or three accidental ones) the scatter says nothing.
ENOUGH_DEGREES = 3
# Readbacks of one setting differ by at most this share of what is scanned: supplies repeat to 1e-4
# of their range, and the steps of a scan are a hundredth of it or more.
READBACK = 1e-3


def of_settings(scan: QuadScan, *, marked: bool = False) -> QuadScan:
    """Make rows that repeat a setting one row of shots; see `average_shots`.

    Rows that have their shots with them are taken as they are.
    """
    if scan.shot_size:
        return scan
    scan = steady_settings(scan)
    rows = row_keys(scan)
    return average_shots(scan, marked=marked) if len(set(rows)) < len(rows) else scan


def steady_settings(scan: QuadScan) -> QuadScan:
    """Give rows that stand together, and whose readbacks agree, the median of these.

    Parameters
    ----------
    scan : QuadScan
        Rows in the order in which they were measured.

    Returns
    -------
    QuadScan
        Settings read to a thousandth of their range. A magnet that moves less than that of its
        value was held, and tells no rows apart.

    Examples
    --------
    >>> read = QuadScan({"Q": [1, 1.0004, 2, 3.0002, 3]}, {"Q": "A"}, {"x": [1e-4] * 5})
    >>> steady_settings(read).settings["Q"].round(4).tolist()
    [1.0002, 1.0002, 2.0, 3.0001, 3.0001]
    """
    if not scan.settings:
        return scan
    values = np.stack(list(scan.settings.values()), -1)
    held = np.ptp(values, axis=0) <= READBACK * np.abs(values).max(0)
    held &= [scan.units[name] != KNOB for name in scan.settings]
    if held.all():  # a magnet that hardly moved is no repeat
        return scan
    # The range of even settings, which one wrong cell does not change.
    span = 4.0 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    near = np.where(held, np.inf, READBACK * span)
    step = np.abs(np.diff(values, axis=0))
    if not np.any((step <= near).all(1) & (step > 0).any(1)):
        return scan
    first, run = 0, np.zeros(len(values), int)
    for i, row in enumerate(values):
        first = first if np.all(np.abs(row - values[first]) <= near) else i
        run[i] = first
    for rows in np.split(np.arange(len(run)), np.flatnonzero(np.diff(run)) + 1):
        values[rows] = np.median(values[rows], axis=0)
    said = f"Settings that agree to {100 * READBACK:g} % of their range, row to row, count as one."
    settings = dict(zip(scan.settings, values.T, strict=True))
    return replace(scan, settings=settings, notes=(*scan.notes, said))


def average_shots(scan: QuadScan, *, marked: bool) -> QuadScan:
    """Average the rows that repeat a setting, an energy, a screen and a slice.

    Parameters
    ----------
    scan : QuadScan
        One row a shot.
    marked : bool
        Whether the file says its rows are shots. If not, rows that carry errors of their own
        are shots of a setting where they stand together: one that was set again is measured again.

    Returns
    -------
    QuadScan
        One row a setting, with ``shot_size``, the shots themselves, for the fit. The error is the
        standard error of the mean, s/√n with n - 1 in s, and ``shots`` says of how many. With
        fewer than three repeats in all, or less than half of the settings repeated in a file that
        does not speak of shots, its errors stand, or there are none and the fit infers them. Rows
        that are not said to be shots, and differ at one setting far more than at the others, stay
        as they are.

    Examples
    --------
    >>> shots = QuadScan({"Q": [0, 0, 1, 1, 2, 2.0]}, {"Q": "A"},
    ...                  {"x": [1.0e-4, 1.2e-4, 2.0e-4, 2.2e-4, 3.0e-4, 3.2e-4]})
    >>> average_shots(shots, marked=True).size["x"].round(6).tolist()
    [0.00011, 0.00021, 0.00031]
    """
    rows: dict[tuple, int] = {}
    keys = row_keys(scan)
    if scan.error and not marked:
        visit = np.cumsum([0, *(a != b for a, b in pairwise(keys))])
        keys = list(zip(visit, keys, strict=True))
    group = np.array([rows.setdefault(key, len(rows)) for key in keys])
    shots = {plane: _by_setting(values, group) for plane, values in scan.size.items()}
    alone = len(rows) == len(group)
    if alone or not (marked or all(map(_alike, shots.values()))):
        return scan if scan.error else replace(scan, error_source="none given")
    size, scatter, given = {}, {}, {}
    usual = marked or np.median(np.bincount(group)) > 1
    for plane, values in shots.items():
        size[plane], error = _shot_means(values)
        if error is not None and (usual or plane not in scan.error):
            scatter[plane] = error
        elif plane in scan.error:  # too few repeats: what the file says of its shots is kept
            square = _by_setting(scan.error[plane] ** 2, group)
            number = np.where(np.isnan(size[plane]), np.nan, np.sum(~np.isnan(square), axis=1))
            given[plane] = np.sqrt(np.nansum(square, axis=1)) / number
    first = np.unique(group, return_index=True)[1]
    single = {plane: shots[plane] for plane in scatter}
    said = "the scatter of the shots (standard error of the mean)" if scatter else "the file"
    # Errors that the file gives are not taken from these shots.
    means = {"size": size, "error": scatter | given, "shots": None if given else np.bincount(group)}
    means["shot_size"] = single
    said = f"{said}, in the place of the file's" if scatter and scan.error else said
    said = said if scatter or given else "none given"
    profiles = tuple(p._replace(row=int(group[p.row])) for p in scan.profiles)
    means |= {"error_source": said, "profiles": profiles}
    return replace(scan, **scan.columns_at(first) | means)


def _by_setting(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The shots of each setting in a row, NaN where it has fewer."""
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    place = np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)
    table = np.full((len(counts), counts.max()), np.nan)
    table[group[order], place] = values[order]
    return table


def _scatter(shots: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of each setting's shots, their degrees of freedom, and their sum of squares."""
    number = np.sum(~np.isnan(shots), axis=1)
    with np.errstate(invalid="ignore"):
        mean = np.nansum(shots, axis=1) / number
    square = np.nansum((shots - mean[:, None]) ** 2, axis=1)
    return mean, np.maximum(number - 1, 0), square


def _alike(shots: np.ndarray) -> bool:
    """Tell repeats that scatter by one relative noise: the largest against all others by F.

    Shots that show no beam are none of them.
    """
    from beamfit.noise.sizes import shot_means  # scipy, which most scans are read without
    from beamfit.statistics import POOR_FIT

    shots = shots[np.any(shots > 0.0, axis=1)]
    found = shot_means(shots)
    mean, degrees, square = _scatter(
        shots if found is None else np.where(found.bad > 0.5, np.nan, shots)
    )
    return bool(_outstanding(square / mean**2, degrees).min(initial=1.0) > POOR_FIT)


def _outstanding(square: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Probability that some setting scatters so much more than all others, by the F test of each.

    Examples
    --------
    >>> _outstanding(np.array([4.0, 4.0, 400.0]), np.array([4.0, 4.0, 4.0])).round(4).tolist()
    [1.0, 1.0, 0.0]
    """
    from scipy.special import fdtrc

    others, rest = degrees.sum() - degrees, square.sum() - square
    tested = (degrees > 0) & (others >= ENOUGH_DEGREES)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num((square / degrees) / (rest / others), nan=1.0)
    chance = np.where(tested, fdtrc(np.maximum(degrees, 1), np.maximum(others, 1), ratio), 1.0)
    return np.minimum(chance * max(int(tested.sum()), 1), 1.0)


def _shot_means(shots: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of the shots of each setting, m, and its standard error.

    The error is None where too few repeat or all agree; of a setting that has one shot, or whose
    shots agree to the last digit, it is that of all settings together.
    """
    mean, degrees, square = _scatter(shots)
    pooled = np.sqrt(np.nansum(square / mean**2) / max(degrees.sum(), 1))
    if degrees.sum() < ENOUGH_DEGREES or pooled == 0.0:
        return mean, None
    own = np.sqrt(square / np.maximum(degrees, 1))
    deviation = np.where((degrees > 0) & (own > 0), own, pooled * mean)
    return mean, deviation / np.sqrt(np.where(np.isnan(mean), np.nan, degrees + 1))
