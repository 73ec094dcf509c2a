"""SIMULATED quadrupole scans: good ones, traps, and what no scan can show.

Matrices are written out here in plain numpy, so that no tool is its own judge. Every beam has a
waist at the screen at the middle setting. Ranges are in reaches: the change of strength that makes
the size there sqrt(2) times the waist's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

ELECTRON = 0.51099895  # MeV
Spoil = Callable[[np.random.Generator, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Line(NamedTuple):
    """A scanned quadrupole, then drifts (k1 = 0) and fixed quadrupoles, then the screen."""

    energy: float = 135.0  # MeV
    length: float = 0.108  # m
    middle: float = 6.0  # k1 of the waist, 1/m²
    rest: tuple[tuple[float, float], ...] = ((0.0, 2.2094),)  # (k1, length), as the beam goes

    @property
    def after(self) -> np.ndarray:
        """Matrix of the rest, shape (2, 2)."""
        matrix = np.eye(2)
        for k1, length in self.rest:
            matrix = thick(np.array([k1]), length)[0] @ matrix
        return matrix

    def matrices(self, k1: np.ndarray) -> np.ndarray:
        """Of every setting, shape (n, 2, 2)."""
        return self.after @ thick(k1, self.length)

    @property
    def boost(self) -> float:
        """β γ."""
        return float(np.sqrt((self.energy / ELECTRON) ** 2 - 1))


def thick(k1: np.ndarray, length: float) -> np.ndarray:
    """Matrices of a quadrupole (Wiedemann, Particle Accelerator Physics, 5.2): a complex phase."""
    root = np.sqrt(np.where(k1 == 0, 1e-12, k1).astype(complex))
    c, s = np.cos(root * length), np.sin(root * length)
    return np.array([[c, s / root], [-root * s, c]]).real.transpose(2, 0, 1)


class Scan(NamedTuple):
    """One measurement: sizes and errors in m, `truth` the normalised emittance in m."""

    line: Line
    k1: np.ndarray
    size: np.ndarray
    error: np.ndarray | None
    truth: float

    @property
    def rows(self) -> np.ndarray:
        """R11 and R12 of every point, shape (n, 2)."""
        return self.line.matrices(self.k1)[:, 0]


OTR = Line()
GUN = Line(6.0, 0.1, 15.0, ((0.0, 1.2),))
LINAC = Line(4300.0, 0.3, 0.35, ((0.0, 12.0),))
DOUBLET = Line(135.0, 0.108, 12.0, ((0.0, 0.4), (-6.0, 0.108), (0.0, 2.0)))


def strengths(line: Line, beta: float, low: float, high: float, n: int) -> np.ndarray:
    """k1 from `low` to `high` reaches off a waist of `beta` m."""
    far = line.matrices(np.array([line.middle]))[0, 0, 1]
    return line.middle + np.linspace(low, high, n) * beta / (far**2 * line.length)


def true_sizes(line: Line, k1: np.ndarray, emittance: float, beta: float) -> np.ndarray:
    """Rms sizes in m of a beam of a normalised emittance in m."""
    back = np.linalg.inv(line.matrices(np.array([line.middle]))[0])
    sigma = back @ np.diag([beta, 1 / beta]) @ back.T * emittance / line.boost
    rows = line.matrices(k1)[:, 0]
    return np.sqrt(np.einsum("ni,ij,nj->n", rows, sigma, rows))


def scan(
    rng: np.random.Generator,
    line: Line = OTR,
    n: int = 9,
    low: float = -3.0,
    high: float = 3.0,
    noise: float = 0.02,
    stated: float | None = 1.0,
    emittance: float = 1e-6,
    beta: float = 0.8,
    floor: float = 0.0,
    spoil: Spoil | None = None,
    chosen: tuple[float, ...] | None = None,
) -> Scan:
    """A scan with noise that is a share of the size, `floor` m at least.

    The file says `stated` times the noise, or nothing. `spoil` makes of true sizes and strengths
    what the screen shows without noise and what the file says of the magnet. `chosen` are reaches.
    """
    k1 = strengths(line, beta, low, high, n)
    if chosen is not None:
        k1 = line.middle + (k1[-1] - line.middle) / high * np.array(chosen)
    shown, said = true_sizes(line, k1, emittance, beta), k1
    if spoil is not None:
        shown, said = spoil(rng, shown, k1)
    error = np.maximum(noise * shown, floor)
    size = np.abs(shown + error * rng.normal(size=len(shown)))
    told = None if stated is None else stated * np.maximum(noise * size, floor)
    return Scan(line, said, size, told, emittance)


def no_beam(rng: np.random.Generator, n: int, stated: float | None, draw: Callable) -> Scan:
    """Sizes that know nothing of the magnet: the truth is that there is no emittance to find."""
    size = 1e-6 * draw(rng, n)
    return Scan(OTR, strengths(OTR, 0.8, -3, 3, n), size, stated and stated * size, 0.0)


def outliers(rng, size, k1, count=1, factor=1.5):
    return size * np.where(rng.permutation(len(size)) < count, factor, 1.0), k1


def stuck(rng, size, k1):
    """The magnet stops at a third, the read-back goes on."""
    last = len(size) // 3
    return np.where(np.arange(len(size)) > last, size[last], size), k1


def hysteresis(rng, size, k1):
    """Up and down again, the field lags by half a reach."""
    lag = 0.5 * (k1[-1] - k1[0]) / 6
    return np.r_[size, size[::-1]], np.r_[k1 + lag, k1[::-1] - lag]


def tails(rng, size, k1):
    return size * np.clip(1 + 0.02 * rng.standard_t(2, len(size)), 0.4, 1.6), k1


def sized(change: Callable, rng, size, k1):
    return change(size), k1


def magnet(change: Callable, rng, size, k1):
    return size, change(k1)


def flip(size):
    return size.max() + size.min() - size


def tent(size):
    """Sizes that grow linearly from the waist, as those of no beam."""
    far = np.sqrt(np.maximum((size / size.min()) ** 2 - 1, 0))
    return size.min() * (1 + far)


GOOD: dict[str, Callable[[np.random.Generator], Scan]] = {
    "9 points, 2 %": scan,
    "4 points, 1 %": partial(scan, n=4, noise=0.01),
    "5 points, 2 %": partial(scan, n=5),
    "5 points, 1 %, no errors": partial(scan, n=5, noise=0.01, stated=None),
    "6 points, 3 %": partial(scan, n=6, noise=0.03),
    "8 points, 5 %": partial(scan, n=8, noise=0.05),
    "12 points, 3 %, no errors": partial(scan, n=12, noise=0.03, stated=None),
    "12 points, 10 %": partial(scan, n=12, noise=0.1, low=-4, high=4),
    "30 points, 5 %, no errors": partial(scan, n=30, noise=0.05, stated=None),
    "waist near one end": partial(scan, n=10, low=-1, high=5),
    "5 µm at every size": partial(scan, n=10, noise=0.0, floor=5e-6),
    "gun, 6 MeV, thick lens": partial(scan, line=GUN, n=10, beta=0.4, emittance=2e-6),
    "linac, 4.3 GeV": partial(scan, line=LINAC, n=9, beta=8.0, emittance=5e-7),
    "doublet": partial(scan, line=DOUBLET, n=9, beta=0.6, emittance=3e-6),
    "large beam, 20 µm": partial(scan, n=7, emittance=2e-5),
}

TRAPS: dict[str, Callable[[np.random.Generator], Scan]] = {
    "noise, 50 to 200 µm": partial(
        no_beam, n=9, stated=0.02, draw=lambda r, n: r.uniform(50, 200, n)
    ),
    "noise, 100 µm ± 30 %, no errors": partial(
        no_beam, n=9, stated=None, draw=lambda r, n: np.abs(100 + 30 * r.normal(size=n)) + 5
    ),
    "constant size, 1 %": partial(
        no_beam, n=9, stated=0.01, draw=lambda r, n: 100 + r.normal(size=n)
    ),
    "constant size, 5 points, no errors": partial(
        no_beam, n=5, stated=None, draw=lambda r, n: 100 + 3 * r.normal(size=n)
    ),
    "three points": partial(scan, n=3, stated=None, noise=0.05),
    "four points, 5 %, no errors": partial(scan, n=4, noise=0.05, stated=None),
    "five points, 5 %, no errors": partial(scan, n=5, noise=0.05, stated=None),
    "five points, 10 %, no errors": partial(scan, n=5, noise=0.1, stated=None),
    "six points, 10 %, no errors": partial(scan, n=6, noise=0.1, stated=None),
    "two settings, three times each": partial(scan, chosen=(-2, 2, -2, 2, -2, 2), stated=None),
    "one side, far from the waist": partial(scan, low=3, high=9, n=8),
    "one side, 5 %, no errors": partial(scan, low=1, high=7, n=8, noise=0.05, stated=None),
    "one outlier": partial(scan, n=10, spoil=outliers),
    "one outlier, no errors": partial(scan, n=10, stated=None, spoil=outliers),
    "two outliers of ten, no errors": partial(
        scan, n=10, stated=None, spoil=partial(outliers, count=2)
    ),
    "heavy tails": partial(scan, n=10, spoil=tails),
    "heavy tails, no errors": partial(scan, n=10, noise=0.01, stated=None, spoil=tails),
    "errors a third of the noise": partial(scan, noise=0.06, stated=1 / 3),
    "half of the sizes are FWHM": partial(
        scan, spoil=lambda r, s, k: (s * np.where(np.arange(len(s)) % 2, 2.355, 1), k)
    ),
    "screen saturates, small sizes shown large": partial(
        scan, n=12, spoil=partial(sized, lambda s: np.maximum(s, 1.6 * s.min()))
    ),
    "large sizes leave the screen": partial(
        scan, n=12, spoil=partial(sized, lambda s: np.minimum(s, 2 * s.min()))
    ),
    "magnet stops at a third": partial(scan, n=10, spoil=stuck),
    "hysteresis, up and down": partial(scan, n=9, spoil=hysteresis),
    "rows mixed up": partial(scan, spoil=lambda r, s, k: (r.permutation(s), k)),
    "no beam's curve: a hill": partial(scan, spoil=partial(sized, flip)),
    "no beam's curve: a tent": partial(scan, n=12, spoil=partial(sized, tent)),
    "no emittance but 5 µm of noise": partial(
        scan, emittance=1e-10, noise=0.0, floor=5e-6, beta=20.0
    ),
}

# What one scan of sizes cannot show: (what happens, cause in beamfit's budget, its steps).
HIDDEN: dict[str, tuple[Callable[[np.random.Generator], Scan], str, float]] = {
    "screen scale 10 % too large": (
        partial(scan, noise=0.005, spoil=partial(sized, lambda s: 1.1 * s)), "screen scale", 10.0,
    ),
    "resolution 40 µm, not told": (
        partial(scan, noise=0.005, spoil=partial(sized, lambda s: np.hypot(s, 40e-6))),
        "resolution", 16.0,
    ),
    "gradient 10 % too large": (
        partial(scan, noise=0.005, spoil=partial(magnet, lambda k: 1.1 * k)), "Q strength", 10.0,
    ),
    "magnet of the wrong sign": (
        partial(scan, spoil=partial(magnet, lambda k: -k)), "", 0.0,
    ),
    "settings in a unit ten times larger": (
        partial(scan, spoil=partial(magnet, lambda k: 10 * k)), "", 0.0,
    ),
    "beam grows by 40 % along the scan": (
        partial(scan, spoil=lambda r, s, k: (s * np.linspace(1, 1.18, len(s)), k)), "", 0.0,
    ),
}  # fmt: skip
