"""Profiles of a scan, one a setting: the mean of its shots about their own centres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.emittance.scan import Profile, QuadScan

# Bins and light (in errors of the sum) without which a profile shows no beam.
FEWEST_BINS, LEAST_LIGHT = 12, 5.0
# A shot with less than this of the usual light of its setting, or its inverse, shows another beam.
USUAL_LIGHT = 0.5
# Share of the window at each end that is taken for background to begin with, and the reach of a
# size in sizes: the tails are the density's to tell.
ENDS, REACH = 0.1, 4.0
# Share of the peak above which a shot's bins tell its centre.
CENTRE = 0.2
# Neighbouring bins at exactly the highest count, of which a rounded peak has no more.
FLAT = 3
# Settings that are taken at most: time grows with the cube of their number.
MOST = 20


class MeanProfile(NamedTuple):
    """Profile of one setting, mean of its shots.

    Attributes
    ----------
    row : int
        Row of the scan.
    position, charge : ndarray
        Shape (n,): m from the centre, and counts a bin less the background, of any unit.
    size : float
        Rms, m, to begin with.
    shots : int
        How many were averaged.
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
    """Average the shots of each setting, and say what was left out.

    Parameters
    ----------
    scan : QuadScan
        With ``profiles``, any number a row.
    plane : str
        "x" or "y".

    Returns
    -------
    list of MeanProfile, list of str
        In the order of the rows; sentences on shots without light and on saturated ones.

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
    own, found, dark, flat = [p for p in scan.profiles if p.plane == plane], [], 0, 0
    for p in own:
        if (shot := _shot(p)) is None:
            dark += 1
        elif _saturated(p):
            flat += 1
        else:
            rows.setdefault(p.row, []).append(shot)
    for row, shots in sorted(rows.items()):
        light = np.array([charge.sum() for _, charge in shots])
        usual = np.abs(np.log(light / np.median(light))) < -np.log(USUAL_LIGHT)
        dark += int((~usual).sum())
        found.append(_mean(row, [s for s, good in zip(shots, usual, strict=True) if good]))
    lost = {"no beam, or another charge": dark, "saturated, flat at the top": flat}
    few = found
    if len(found) > MOST:
        few = [found[i] for i in np.linspace(0, len(found) - 1, MOST).astype(int)]
    notes = [f"Left out in {plane}: {count} of {len(own)} profiles ({why})."
             for why, count in lost.items() if count]  # fmt: skip
    if few is not found:
        notes.append(f"Of {len(found)} settings in {plane} {MOST} are taken, evenly among all.")
    return few, notes


def _saturated(profile: Profile) -> bool:
    """True if more neighbouring bins are at the highest count than a peak has."""
    top = profile.counts == np.nanmax(profile.counts)
    return bool(np.convolve(top, np.ones(FLAT + 1), "valid").max(initial=0.0) > FLAT)


def profile_size(profile: Profile) -> float:
    """Find the rms size of a profile, m, its background by the ends; NaN where it shows no beam.

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
    """Position about the centre and counts less the background; None where there is no beam."""
    good = np.isfinite(profile.counts) & np.isfinite(profile.position)
    order = np.argsort(profile.position[good])
    x, counts = profile.position[good][order], profile.counts[good][order]
    if len(x) < FEWEST_BINS:
        return None
    n = max(3, round(ENDS * len(x)))
    ends = np.stack([counts[:n], counts[-n:]])
    level = np.median(ends, axis=1, keepdims=True)
    low, high = x[n // 2], x[-1 - n // 2]  # the middles of the ends
    charge = counts - level[0] - (level[1] - level[0]) * (x - low) / (high - low)
    # Second differences of normal noise have sqrt(6) times its error; so have those of a beam of
    # few bins, whose background tells the noise then.
    jagged = np.median(np.abs(np.diff(charge, 2))) / (np.sqrt(6.0) * 0.6745)
    noise = min(jagged, np.sqrt(np.sum((ends - level) ** 2) / (2 * n - 2)))
    # The sum has the noise of its bins and that of the medians of both ends, off its every bin.
    error = noise * np.sqrt(len(x) + len(x) ** 2 * np.pi / 2.0 / (2.0 * n))
    if charge.sum() <= LEAST_LIGHT * error:
        return None
    top = np.where(charge > CENTRE * charge.max(), charge, 0.0)
    return x - np.average(x, weights=top), charge


def _mean(row: int, shots: list[tuple[np.ndarray, np.ndarray]]) -> MeanProfile:
    """Mean of shots of equal light on the bins that all of them have."""
    step = float(np.median(np.diff(shots[0][0])))
    low, high = max(x[0] for x, _ in shots), min(x[-1] for x, _ in shots)
    at = low + step * np.arange(int((high - low) / step) + 1)
    charge = np.mean([np.interp(at, x, c / c.sum()) for x, c in shots], axis=0)
    centre, size = 0.0, float(np.sqrt(np.average(at**2, weights=np.maximum(charge, 0.0))))
    for _ in range(8):
        near = np.abs(at - centre) < REACH * size
        light = charge[near].sum()
        centre = float(charge[near] @ at[near] / light)
        size = float(np.sqrt(max(charge[near] @ (at[near] - centre) ** 2 / light, step**2)))
    return MeanProfile(row, at - centre, charge, size, len(shots))
