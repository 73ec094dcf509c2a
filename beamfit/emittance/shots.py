"""Repeated settings: rows that are shots of one setting become one row with `shot_size`."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from beamfit.emittance.scan import KNOB, QuadScan, row_keys

# Fewer repeats in all, perhaps accidental ones, do not determine the scatter.
MIN_DEGREES = 3
# Largest difference of readbacks of one setting, as a share of the scanned range: supplies repeat
# to 1e-4 of their range, and the steps of a scan are a hundredth of it or more.
READBACK_TOLERANCE = 1e-3


def group_shots(scan: QuadScan, *, marked: bool = False) -> QuadScan:
    """Combine rows that repeat a setting to one row of shots; see `average_shots`.

    A scan with shots in its rows is returned as it is.
    """
    if scan.shot_size:
        return scan
    scan = steady_settings(scan)
    rows = row_keys(scan)
    return average_shots(scan, marked=marked) if len(set(rows)) < len(rows) else scan


def steady_settings(scan: QuadScan) -> QuadScan:
    """Replace readbacks of one setting, in consecutive rows, by their median.

    Parameters
    ----------
    scan : QuadScan
        Rows in the order in which they were measured.

    Returns
    -------
    QuadScan
        Settings that agree to a thousandth of their range are equal. A magnet that moves less than
        a thousandth of its value is taken as constant.

    Examples
    --------
    >>> read = QuadScan({"Q": [1, 1.0004, 2, 3.0002, 3]}, {"Q": "A"}, {"x": [1e-4] * 5})
    >>> steady_settings(read).settings["Q"].round(4).tolist()
    [1.0002, 1.0002, 2.0, 3.0001, 3.0001]
    """
    if not scan.settings:
        return scan
    values = np.stack(list(scan.settings.values()), -1)
    constant = np.ptp(values, axis=0) <= READBACK_TOLERANCE * np.abs(values).max(0)
    constant &= [scan.units[name] != KNOB for name in scan.settings]
    if constant.all():  # no magnet moved enough: the rows are no repeats
        return scan
    # Range of evenly spaced settings, from the median deviation: robust against one wrong cell.
    span = 4.0 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    tolerance = np.where(constant, np.inf, READBACK_TOLERANCE * span)
    step = np.abs(np.diff(values, axis=0))
    if not np.any((step <= tolerance).all(1) & (step > 0).any(1)):
        return scan
    first, start_of_run = 0, np.zeros(len(values), int)
    for i, row in enumerate(values):
        first = first if np.all(np.abs(row - values[first]) <= tolerance) else i
        start_of_run[i] = first
    for rows in np.split(np.arange(len(start_of_run)), np.flatnonzero(np.diff(start_of_run)) + 1):
        values[rows] = np.median(values[rows], axis=0)
    share = f"{100 * READBACK_TOLERANCE:g} %"
    note = f"Settings that agree to {share} of their range, row to row, count as one."
    settings = dict(zip(scan.settings, values.T, strict=True))
    return replace(scan, settings=settings, notes=(*scan.notes, note))


def average_shots(scan: QuadScan, *, marked: bool) -> QuadScan:
    """Average rows that repeat a setting, an energy, a screen and a slice.

    Parameters
    ----------
    scan : QuadScan
        One row per shot.
    marked : bool
        Whether the file marks its rows as shots. If not, rows with errors of their own are shots of
        one setting only if they are consecutive: a setting that was left was measured again.

    Returns
    -------
    QuadScan
        One row per setting, with the shots in ``shot_size`` for the fit. The error is the standard
        error of the mean, s/√n with n - 1 in s, and ``shots`` is their number. With fewer than
        three repeats in all, or less than half of the settings repeated in a file without marked
        shots, the file's errors are kept; if it has none the fit infers them. Unmarked rows that
        differ at one setting far more than at the others stay as they are.

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
    shots = {plane: _shot_table(values, group) for plane, values in scan.size.items()}
    no_repeats = len(rows) == len(group)
    if no_repeats or not (marked or all(map(_one_relative_scatter, shots.values()))):
        return scan if scan.error else replace(scan, error_source="none given")
    size, scatter, stated = {}, {}, {}
    repeated = marked or np.median(np.bincount(group)) > 1
    for plane, values in shots.items():
        size[plane], error = _means_and_errors(values)
        if error is not None and (repeated or plane not in scan.error):
            scatter[plane] = error
        elif plane in scan.error:  # too few repeats: the file's errors are kept
            square = _shot_table(scan.error[plane] ** 2, group)
            number = np.where(np.isnan(size[plane]), np.nan, np.sum(~np.isnan(square), axis=1))
            stated[plane] = np.sqrt(np.nansum(square, axis=1)) / number
    first = np.unique(group, return_index=True)[1]
    single = {plane: shots[plane] for plane in scatter}
    source = "the scatter of the shots (standard error of the mean)" if scatter else "the file"
    # The file's errors are not derived from these shots.
    means = {
        "size": size,
        "error": scatter | stated,
        "shots": None if stated else np.bincount(group),
    }
    means["shot_size"] = single
    source = f"{source}, in the place of the file's" if scatter and scan.error else source
    source = source if scatter or stated else "none given"
    profiles = tuple(p._replace(row=int(group[p.row])) for p in scan.profiles)
    means |= {"error_source": source, "profiles": profiles}
    return replace(scan, **scan.columns_at(first) | means)


def _shot_table(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Table of the shots, one row per setting, padded with NaN."""
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    place = np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)
    table = np.full((len(counts), counts.max()), np.nan)
    table[group[order], place] = values[order]
    return table


def _scatter(shots: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of each setting's shots, degrees of freedom, and sum of squared deviations."""
    number = np.sum(~np.isnan(shots), axis=1)
    with np.errstate(invalid="ignore"):
        mean = np.nansum(shots, axis=1) / number
    square = np.nansum((shots - mean[:, None]) ** 2, axis=1)
    return mean, np.maximum(number - 1, 0), square


def _one_relative_scatter(shots: np.ndarray) -> bool:
    """Test by F whether all repeats have one relative scatter, without shots that show no beam."""
    from beamfit.noise.sizes import shot_means  # loads scipy, which most scans do not need
    from beamfit.statistics import POOR_FIT

    shots = shots[np.any(shots > 0.0, axis=1)]
    found = shot_means(shots)
    mean, degrees, square = _scatter(
        shots if found is None else np.where(found.bad > 0.5, np.nan, shots)
    )
    return bool(_excess_chance(square / mean**2, degrees).min(initial=1.0) > POOR_FIT)


def _excess_chance(square: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Probability that each setting scatters so much more than all others by chance, by an F test.

    Examples
    --------
    >>> _excess_chance(np.array([4.0, 4.0, 400.0]), np.array([4.0, 4.0, 4.0])).round(4).tolist()
    [1.0, 1.0, 0.0]
    """
    from scipy.special import fdtrc

    others, other_squares = degrees.sum() - degrees, square.sum() - square
    tested = (degrees > 0) & (others >= MIN_DEGREES)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num((square / degrees) / (other_squares / others), nan=1.0)
    probability = np.where(tested, fdtrc(np.maximum(degrees, 1), np.maximum(others, 1), ratio), 1.0)
    return np.minimum(probability * max(int(tested.sum()), 1), 1.0)


def _means_and_errors(shots: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of the shots of each setting, m, and its standard error.

    The error is None if too few repeat or all agree. A setting with one shot, or whose shots agree
    to the last digit, has the relative error of all settings together.
    """
    mean, degrees, square = _scatter(shots)
    pooled = np.sqrt(np.nansum(square / mean**2) / max(degrees.sum(), 1))
    if degrees.sum() < MIN_DEGREES or pooled == 0.0:
        return mean, None
    scatter = np.sqrt(square / np.maximum(degrees, 1))
    deviation = np.where((degrees > 0) & (scatter > 0), scatter, pooled * mean)
    return mean, deviation / np.sqrt(np.where(np.isnan(mean), np.nan, degrees + 1))
