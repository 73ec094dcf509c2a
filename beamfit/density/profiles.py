"""Profiles of a scan, one for each setting: the mean of its shots about their own centres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.emittance.scan import Profile, QuadScan

# A profile shows a beam with at least this many bins, and this much light in errors of the sum.
MIN_BINS = 12
MIN_LIGHT = 5.0
# Shots with less than this share of their setting's median light, or more than its inverse, show
# another beam.
MIN_LIGHT_RATIO = 0.5
# Share of the window at each end that gives the first estimate of the background.
ENDS = 0.1
# Range of the first estimate of a size, in sizes: the density finds the tails.
SIZE_RANGE = 4.0
# The centre of a shot is that of its bins above this share of the peak.
MIN_CENTRE_SHARE = 0.2
# Largest number of neighbouring bins at exactly the highest count of an unsaturated, rounded peak.
MAX_FLAT_BINS = 3
# Largest number of settings: time grows with the cube of their number.
MAX_SETTINGS = 20


class MeanProfile(NamedTuple):
    """Profile of one setting, the mean of its shots.

    Attributes
    ----------
    row : int
        Row of the scan.
    position, charge : ndarray
        Distance from the centre, m, and counts per bin less the background, any unit, shape (n,).
    size : float
        First estimate of the rms size, m.
    shots : int
        Number of averaged shots.
    """

    row: int
    position: np.ndarray
    charge: np.ndarray
    size: float
    shots: int

    @property
    def step(self) -> float:
        """Width of a bin, m."""
        return float(self.position[1] - self.position[0])


def mean_profiles(scan: QuadScan, plane: str) -> tuple[list[MeanProfile], list[str]]:
    """Average the shots of each setting, and list what was left out.

    Parameters
    ----------
    scan : QuadScan
        A scan with ``profiles``, any number for each row.
    plane : str
        "x" or "y".

    Returns
    -------
    list of MeanProfile, list of str
        Profiles in the order of the rows; sentences on shots without light and saturated ones.

    Examples
    --------
    >>> position = np.linspace(-1e-3, 1e-3, 81)
    >>> beam = 100.0 * np.exp(-0.5 * (position / 2e-4) ** 2)
    >>> shots = tuple(Profile("x", 0, position + 1e-5 * i, beam + 3.0, None) for i in range(2))
    >>> scan = QuadScan({"Q": [0.0, 1, 2]}, {"Q": "A"}, {"x": 3 * [2e-4]}, profiles=shots)
    >>> [one], notes = mean_profiles(scan, "x")
    >>> one.shots, round(1e6 * one.size), notes
    (2, 200, [])
    """
    rows: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    of_plane, found, dark, flat = [p for p in scan.profiles if p.plane == plane], [], 0, 0
    for p in of_plane:
        if (shot := _shot(p)) is None:
            dark += 1
        elif _saturated(p):
            flat += 1
        else:
            rows.setdefault(p.row, []).append(shot)
    for row, shots in sorted(rows.items()):
        light = np.array([charge.sum() for _, charge in shots])
        good_light = np.abs(np.log(light / np.median(light))) < -np.log(MIN_LIGHT_RATIO)
        dark += int((~good_light).sum())
        found.append(_mean(row, [s for s, good in zip(shots, good_light, strict=True) if good]))
    excluded = {"no beam, or another charge": dark, "saturated, flat at the top": flat}
    kept = found
    if len(found) > MAX_SETTINGS:
        kept = [found[i] for i in np.linspace(0, len(found) - 1, MAX_SETTINGS).astype(int)]
    notes = [f"Left out in {plane}: {count} of {len(of_plane)} profiles ({why})."
             for why, count in excluded.items() if count]  # fmt: skip
    if kept is not found:
        notes.append(
            f"Of {len(found)} settings in {plane} {MAX_SETTINGS} are taken, evenly among all."
        )
    return kept, notes


def _saturated(profile: Profile) -> bool:
    """True if more neighbouring bins are at the highest count than a peak has."""
    top = profile.counts == np.nanmax(profile.counts)
    return bool(
        np.convolve(top, np.ones(MAX_FLAT_BINS + 1), "valid").max(initial=0.0) > MAX_FLAT_BINS
    )


def profile_size(profile: Profile) -> float:
    """Rms size of a profile, m, with the background from its ends; NaN if it shows no beam.

    Examples
    --------
    >>> x = np.linspace(-1e-3, 1e-3, 81)
    >>> beam = Profile("x", 0, x, 5.0 + 100.0 * np.exp(-0.5 * (x / 2e-4) ** 2), None)
    >>> round(1e6 * profile_size(beam))
    200
    """
    shot = _shot(profile)
    return np.nan if shot is None else _mean(profile.row, [shot]).size


def _shot(profile: Profile) -> tuple[np.ndarray, np.ndarray] | None:
    """Give positions about the centre and counts less the background; None if there is no beam."""
    good = np.isfinite(profile.counts) & np.isfinite(profile.position)
    order = np.argsort(profile.position[good])
    x, counts = profile.position[good][order], profile.counts[good][order]
    if len(x) < MIN_BINS:
        return None
    n = max(3, round(ENDS * len(x)))
    ends = np.stack([counts[:n], counts[-n:]])
    level = np.median(ends, axis=1, keepdims=True)
    low, high = x[n // 2], x[-1 - n // 2]  # the middles of the ends
    charge = counts - level[0] - (level[1] - level[0]) * (x - low) / (high - low)
    # Second differences of normal noise have sqrt(6) times its error. A beam of few bins has large
    # ones too; its noise is that of the background.
    roughness = np.median(np.abs(np.diff(charge, 2))) / (np.sqrt(6.0) * 0.6745)
    noise = min(roughness, np.sqrt(np.sum((ends - level) ** 2) / (2 * n - 2)))
    # The sum has the noise of its bins, and in every bin that of the medians of both ends.
    error = noise * np.sqrt(len(x) + len(x) ** 2 * np.pi / 2.0 / (2.0 * n))
    if charge.sum() <= MIN_LIGHT * error:
        return None
    top = np.where(charge > MIN_CENTRE_SHARE * charge.max(), charge, 0.0)
    return x - np.average(x, weights=top), charge


def _mean(row: int, shots: list[tuple[np.ndarray, np.ndarray]]) -> MeanProfile:
    """Average shots of equal light on the bins that all of them have."""
    step = float(np.median(np.diff(shots[0][0])))
    low, high = max(x[0] for x, _ in shots), min(x[-1] for x, _ in shots)
    position = low + step * np.arange(int((high - low) / step) + 1)
    charge = np.mean([np.interp(position, x, c / c.sum()) for x, c in shots], axis=0)
    centre, size = 0.0, float(np.sqrt(np.average(position**2, weights=np.maximum(charge, 0.0))))
    for _ in range(8):
        inside = np.abs(position - centre) < SIZE_RANGE * size
        light = charge[inside].sum()
        centre = float(charge[inside] @ position[inside] / light)
        size = float(
            np.sqrt(max(charge[inside] @ (position[inside] - centre) ** 2 / light, step**2))
        )
    return MeanProfile(row, position - centre, charge, size, len(shots))
