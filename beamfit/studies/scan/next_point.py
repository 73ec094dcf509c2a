"""Which one further setting would sharpen the emittance most."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from beamfit.greybox.design import Information, rows_of, scores
from beamfit.optics.rows import transfer_rows
from beamfit.studies.scan.model import coefficients, size_squared
from beamfit.studies.scan.results import in_words
from beamfit.studies.scan.statement import Seen
from beamfit.studies.scan.verdict import LOST

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


def plausible_sigma(sigma: np.ndarray, covariance: np.ndarray) -> np.ndarray | None:
    """Find a beam near the fit with a positive emittance, to predict sizes with.

    Where the best matrix has det σ below its standard error it is moved along the direction
    that raises det most for its χ², until it has that much; None if that fails.

    Examples
    --------
    >>> plausible_sigma(np.array([1.0, 0.0, 0.0]), 1e-4 * np.eye(3)).round(2).tolist()
    [1.0, 0.0, 0.01]
    """
    gradient = np.array([sigma[2], -2.0 * sigma[1], sigma[0]])
    determinant = sigma[0] * sigma[2] - sigma[1] ** 2
    error = float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))
    if not error > 0.0:
        return None
    if determinant > error:
        return sigma
    moved = sigma + covariance @ gradient / error * (1.0 - determinant / error)
    good = moved[0] > 0 and moved[0] * moved[2] > moved[1] ** 2
    return moved if good else None


def next_measurement(seen: Seen, plane: str) -> str | None:
    """Say which further setting would help most, if one can be named."""
    work = seen.works[plane]
    e, p = work.evidence, work.points
    nothing_to_build_on = e.misfit > LOST or e.swamped or not e.full_rank
    if seen.scan.transfer or nothing_to_build_on or not np.isfinite(work.covariance).all():
        return None
    covariance = work.covariance * work.scale**2
    start = work.fit.sigma if e.positive else work.fit.symmetric
    sigma = plausible_sigma(start, covariance)
    if sigma is None:
        return None
    relative = max(float(np.median(p.error / p.size)) * work.scale, 1e-3)
    known, tried = _known(sigma, covariance), []
    for name, table in candidate_settings(p.settings):
        usable, r11, r12 = _usable(seen, plane, sigma, table)
        rows = np.stack(coefficients(r11, r12), -1)
        rows /= 2.0 * relative * np.maximum(size_squared(sigma, r11, r12), 1e-30)[:, None]
        after = scores(known, rows[:, None, :])
        tried += [(error, name, at) for error, at in zip(after, table[name][usable], strict=True)]
    if not tried:
        return None
    _, magnet, setting = min(tried, key=lambda each: each[0])
    values = p.settings[magnet]
    inside = values.min() <= setting <= values.max()
    held = {name: np.median(v) for name, v in p.settings.items() if name != magnet}
    others = f", with {in_words(held, p.units, 3)} at {seen.rows.places[-1]}" if held else ""
    return (
        f"Measure next near {magnet} = {setting:.3g} {p.units[magnet]}, "
        f"{'inside' if inside else 'beyond'} the scanned range{others}: of single points it would "
        "sharpen the emittance most; then judge again."
    )


def _known(sigma: np.ndarray, covariance: np.ndarray) -> Information:
    """What is known of the emittance of a beam."""
    emittance = np.sqrt(sigma[0] * sigma[2] - sigma[1] ** 2)
    slope = np.array([[sigma[2], -2.0 * sigma[1], sigma[0]]]) / (2.0 * emittance)
    free = np.full(3, np.inf)
    value, asked = np.array([emittance]), np.ones(3, bool)
    return Information(rows_of(covariance), value, slope, asked, -free, free)


def _usable(
    seen: Seen, plane: str, sigma: np.ndarray, table: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Settings at which no plane's size exceeds those measured (screens have edges); R11, R12."""
    energy = np.full(COUNT, seen.energy)
    matrices = transfer_rows(seen.scanned, table, energy, places=seen.rows.places[-1:])
    r11, r12 = np.moveaxis(np.asarray(matrices.planes)[:, :, 0, 0, :2], -1, 0)
    sigmas = {p: w.fit.sigma for p, w in seen.works.items() if w.evidence.positive}
    usable = np.ones(COUNT, bool)
    for each, beam in (sigmas | {plane: sigma}).items():
        i, largest = "xy".index(each), np.nanmax(seen.scan.size[each])
        usable &= size_squared(beam, r11[:, i], r12[:, i]) <= largest**2
    own = usable, "xy".index(plane)
    return usable, r11[own], r12[own]
