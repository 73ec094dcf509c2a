"""Shots that become points: means over the repeats of a setting, and their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamfit.emittance.scan import QuadScan, row_keys

# With fewer repeats in all (two or three accidental ones) the scatter says nothing.
ENOUGH_DEGREES = 3


def average_shots(scan: QuadScan, *, marked: bool) -> QuadScan:
    """Average the rows that repeat a setting, an energy, a screen and a slice.

    Parameters
    ----------
    scan : QuadScan
        One row a shot.
    marked : bool
        Whether the file says its rows are shots. If not, rows that carry errors of their own
        stay as they are: each is a measurement by itself.

    Returns
    -------
    QuadScan
        One row a setting, with ``shot_size``, the shots themselves, for the fit. The error is the
        standard error of the mean, s/√n with n - 1 in s, and ``shots`` says of how many. With
        fewer than three repeats in all the errors of the file stand, or there are none and the fit
        infers them. Rows that are not said to be shots, and differ at one setting far more than at
        the others, stay as they are.

    Examples
    --------
    >>> shots = QuadScan({"Q": [0, 0, 1, 1, 2, 2.0]}, {"Q": "A"},
    ...                  {"x": [1.0e-4, 1.2e-4, 2.0e-4, 2.2e-4, 3.0e-4, 3.2e-4]})
    >>> average_shots(shots, marked=True).size["x"].round(6).tolist()
    [0.00011, 0.00021, 0.00031]
    """
    rows: dict[tuple, int] = {}
    keys = row_keys(scan)
    group = np.array([rows.setdefault(key, len(rows)) for key in keys])
    if len(rows) == len(group) or (scan.error and not marked):
        return scan if scan.error else replace(scan, error_source="none given")
    if not marked and not all(_alike(values, group) for values in scan.size.values()):
        return replace(scan, error_source="none given")
    size, scatter, given = {}, {}, {}
    for plane, values in scan.size.items():
        size[plane], error = _shot_means(values, group)
        if error is not None:
            scatter[plane] = error
        elif plane in scan.error:  # too few repeats: what the file says of its shots is kept
            shots, mean_square = _means(scan.error[plane] ** 2, group)
            given[plane] = np.sqrt(mean_square / shots)
    first = np.unique(group, return_index=True)[1]
    single = {p: _table_of(values, group) for p, values in scan.size.items() if p in scatter}
    said = "the scatter of the shots (standard error of the mean)" if scatter else "the file"
    # Errors that the file gives are not taken from these shots.
    means = {"size": size, "error": scatter | given, "shots": None if given else np.bincount(group)}
    means["shot_size"] = single
    said = said if scatter or given else "none given"
    profiles = tuple(p._replace(row=int(group[p.row])) for p in scan.profiles)
    means |= {"error_source": said, "profiles": profiles}
    return replace(scan, **scan.columns_at(first) | means)


def _table_of(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The shots of each setting in a row, NaN where it has fewer."""
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    place = np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)
    table = np.full((len(counts), counts.max()), np.nan)
    table[group[order], place] = values[order]
    return table


def _means(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count and mean of the numbers of each group; NaN, a shot not measured, is none."""
    measured = ~np.isnan(values)
    number = np.bincount(group, measured)
    with np.errstate(invalid="ignore"):
        return number, np.bincount(group, np.where(measured, values, 0.0)) / number


def scatter_of(size: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of each setting's shots, their degrees of freedom, and their sum of squares."""
    number, mean = _means(size, group)
    with np.errstate(invalid="ignore"):
        square = number * _means((size - mean[group]) ** 2, group)[1]
    return mean, np.maximum(number - 1, 0), np.nan_to_num(square)


def _alike(size: np.ndarray, group: np.ndarray) -> bool:
    """Tell repeats that scatter by one relative noise: the largest against all others by F."""
    from beamfit.statistics import POOR_FIT  # scipy, which most scans are read without

    mean, degrees, square = scatter_of(size, group)
    return bool(_outstanding(square / mean**2, degrees).min() > POOR_FIT)


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


def _shot_means(size: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of the shots of each setting, m, and its standard error.

    The error is None where too few repeat or all agree; of a setting that has one shot, or whose
    shots agree to the last digit, it is that of all settings together.
    """
    mean, degrees, square = scatter_of(size, group)
    pooled = np.sqrt(np.nansum(square / mean**2) / max(degrees.sum(), 1))
    if degrees.sum() < ENOUGH_DEGREES or pooled == 0.0:
        return mean, None
    own = np.sqrt(square / np.maximum(degrees, 1))
    deviation = np.where((degrees > 0) & (own > 0), own, pooled * mean)
    return mean, deviation / np.sqrt(np.where(np.isnan(mean), np.nan, degrees + 1))
