"""Which one further setting would sharpen the emittance most."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from beamfit.optics.rows import transfer_rows
from beamfit.studies.scan.model import size_squared
from beamfit.studies.scan.results import in_words
from beamfit.studies.scan.statement import Seen

# Candidates reach half the scanned range beyond either end.
REACH, COUNT = 0.5, 41
# A setting below this share of the range is the rounding of zero.
ROUNDING = 1e-9


def candidate_settings(
    settings: Mapping[str, np.ndarray],
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """Settings to consider: one magnet after the other over its range, the others held.

    Parameters
    ----------
    settings : mapping of str to ndarray
        The settings already measured.
    limits : mapping of str to (float, float), optional
        Magnets and their ranges; each scanned one, half its range beyond either end if None.

    Returns
    -------
    list of (str, dict)
        For each magnet the settings of all, each of shape (41,). The others stay at their median.

    Examples
    --------
    >>> [(name, table)] = candidate_settings({"Q": np.array([0.0, 2.0])})
    >>> name, table["Q"][[0, -1]].tolist()
    ('Q', [-1.0, 3.0])
    """
    if limits is None:
        spans = {n: (v.min(), v.max(), REACH * np.ptp(v)) for n, v in settings.items()}
        limits = {n: (low - far, high + far) for n, (low, high, far) in spans.items() if far > 0}
    held = {n: np.full(COUNT, np.median(v)) for n, v in settings.items()}
    found = []
    for name, (low, high) in limits.items():
        values = np.linspace(low, high, COUNT)
        values[np.abs(values) < ROUNDING * (high - low)] = 0.0
        found.append((name, held | {name: values}))
    return found


def next_measurement(seen: Seen, plane: str) -> str | None:
    """Say which further setting would help most, if one can be named.

    Every draw of the posterior predicts a size at every setting. A further size of the scan's own
    error takes cov(ln ε, size)²/(var(size) + error²) off the variance of ln ε (the regression of
    one on the other; C. E. Rasmussen and C. K. I. Williams (2006), eq. A.6).
    """
    work = seen.works[plane]
    p, post = work.points, work.posterior
    if seen.scan.transfer or not post.seen:
        return None
    kept = post.weight > 0.0
    sigma, weight = post.sigma[kept].T, post.weight[kept]
    log = 0.5 * np.log(np.maximum(sigma[0] * sigma[2] - sigma[1] ** 2, 1e-300))
    log = log - weight @ log
    relative, tried = float(np.median(p.error / p.size)), []
    for name, table in candidate_settings(p.settings):
        usable, r11, r12 = _usable(seen, plane, post.best, table)
        size = np.sqrt(size_squared(sigma, r11[:, None], r12[:, None]))
        middle = size @ weight
        off = size - middle[:, None]
        noise = off**2 @ weight + (relative * middle) ** 2
        gain = ((off * log) @ weight) ** 2 / noise
        tried += [(-each, name, at) for each, at in zip(gain, table[name][usable], strict=True)]
    if not tried:
        return None
    _, magnet, setting = min(tried, key=lambda each: each[0])
    values = p.settings[magnet]
    inside = values.min() <= setting <= values.max()
    held = {name: np.median(v) for name, v in p.settings.items() if name != magnet}
    others = f", with {in_words(held, p.units, 3)} at {seen.rows.places[-1]}" if held else ""
    return (
        f"Measure next near {magnet} = {setting:.3g} {p.units[magnet]}, "
        f"{'inside' if inside else 'beyond'} the scanned range{others}: this single point reduces "
        "the error most."
    )


def _usable(
    seen: Seen, plane: str, sigma: np.ndarray, table: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Settings at which no plane's size exceeds those measured (screens have edges); R11, R12."""
    energy = np.full(COUNT, seen.energy)
    matrices = transfer_rows(seen.scanned, table, energy, places=seen.rows.places[-1:])
    r11, r12 = np.moveaxis(np.asarray(matrices.planes)[:, :, 0, 0, :2], -1, 0)
    sigmas = {p: w.posterior.best for p, w in seen.works.items()}
    usable = np.ones(COUNT, bool)
    for each, beam in (sigmas | {plane: sigma}).items():
        i, largest = "xy".index(each), np.nanmax(seen.scan.size[each])
        usable &= size_squared(beam, r11[:, i], r12[:, i]) <= largest**2
    own = usable, "xy".index(plane)
    return usable, r11[own], r12[own]
