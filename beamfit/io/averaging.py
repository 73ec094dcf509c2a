"""Several shots of a setting become one point whose error is what their scatter says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamfit.studies.scan.scans import QuadScan, row_keys

__all__ = ["average_shots"]

# Below this many shots a setting's own scatter is too uncertain to weight it by.
ENOUGH_SHOTS = 5
# With fewer repeats in all (two or three accidental ones) the scatter says nothing.
ENOUGH_DEGREES = 3


def average_shots(scan: QuadScan, *, marked: bool) -> QuadScan:
    """Average the rows that repeat a setting, an energy and a screen.

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
        One row a setting. The error is the standard error of the mean, s/√n with n - 1 in s;
        where a setting has fewer than five shots, s is the relative scatter pooled over all
        settings, because two or three shots can agree by chance. With fewer than three
        repeats in all the errors of the file stand, or there are none and the fit infers them.

    Examples
    --------
    >>> shots = QuadScan({"Q": [0, 0, 1, 1, 2, 2.0]}, {"Q": "A"},
    ...                  {"x": [1.0e-4, 1.2e-4, 2.0e-4, 2.2e-4, 3.0e-4, 3.2e-4]})
    >>> average_shots(shots, marked=True).size["x"].round(6).tolist()
    [0.00011, 0.00021, 0.00031]
    """
    groups = _groups(scan)
    repeated = max(len(g) for g in groups) > 1
    if not repeated or (scan.error and not marked):
        return scan if scan.error else replace(scan, error_source="none given")
    first = [g[0] for g in groups]
    size = {p: np.array([_mean(v[g]) for g in groups]) for p, v in scan.size.items()}
    scatter = {p: _standard_error(scan.size[p], groups) for p in scan.size}
    known = {p: e for p, e in scatter.items() if e is not None}
    # Too few repeats for a scatter: what the file says of its shots is kept.
    given = {p: _of_the_mean(e, groups) for p, e in scan.error.items() if p not in known}

    def pick(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[first]

    return replace(
        scan,
        settings={n: v[first] for n, v in scan.settings.items()},
        size=size,
        error=known | given,
        energy=pick(scan.energy),
        resolution=pick(scan.resolution),
        energy_spread=pick(scan.energy_spread),
        screen=None if scan.screen is None else tuple(scan.screen[i] for i in first),
        shots=np.array([len(g) for g in groups]),
        error_source="the scatter of the shots (standard error of the mean)"
        if known
        else ("the file" if given else "none given"),
    )


def _groups(scan: QuadScan) -> list[np.ndarray]:
    """Rows of equal settings, energy and screen, in the order of first appearance."""
    rows: dict[tuple, list[int]] = {}
    for i, key in enumerate(row_keys(scan.settings, scan.energy, scan.screen)):
        rows.setdefault(key, []).append(i)
    return [np.array(r) for r in rows.values()]


def _mean(values: np.ndarray) -> float:
    """Mean of the shots that were measured; NaN where none was."""
    measured = values[~np.isnan(values)]
    return float(measured.mean()) if len(measured) else np.nan


def _of_the_mean(error: np.ndarray, groups: list[np.ndarray]) -> np.ndarray:
    """Errors of the means of shots that bring errors of their own."""
    return np.array(
        [
            np.sqrt(np.nanmean(error[g] ** 2) / np.sum(~np.isnan(error[g])))
            if (~np.isnan(error[g])).any()
            else np.nan
            for g in groups
        ]
    )


def _standard_error(sizes: np.ndarray, groups: list[np.ndarray]) -> np.ndarray | None:
    """Standard error of each mean in m, or None where too few repeat or all agree."""
    shots = [sizes[g][~np.isnan(sizes[g])] for g in groups]
    degrees = sum(max(len(s) - 1, 0) for s in shots)
    if degrees < ENOUGH_DEGREES:
        return None
    relative = sum(((s - s.mean()) ** 2).sum() / s.mean() ** 2 for s in shots if len(s) > 1)
    pooled = np.sqrt(relative / degrees)
    if pooled == 0.0:
        return None
    errors = np.full(len(groups), np.nan)
    for i, s in enumerate(shots):
        if len(s):
            own = s.std(ddof=1) if len(s) >= ENOUGH_SHOTS else 0.0
            errors[i] = (own or pooled * s.mean()) / np.sqrt(len(s))
    return errors
