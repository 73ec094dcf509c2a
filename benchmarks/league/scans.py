"""SIMULATED families of quadrupole scans: good ones, traps, and what no scan can show.

Line, beam, points, noise and strength are drawn anew for each scan; lines and families of noise
are those of benchmarks/verdict.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from beamfit.emittance.scan import QuadScan

from .. import verdict
from ..verdict import Line, Truth, scan_of

Draw = Callable[[np.random.Generator], "Scan"]
Spoil = Callable[[np.random.Generator, Truth], tuple[np.ndarray, np.ndarray]]


class Scan(NamedTuple):
    """One measurement for all tools; `truth` is the emittance in m, 0 where there is none."""

    given: QuadScan
    line: Line
    truth: float

    @property
    def k1(self) -> np.ndarray:
        return self.given.settings["Q"]

    @property
    def size(self) -> np.ndarray:
        return self.given.size["x"]

    @property
    def error(self) -> np.ndarray | None:
        return self.given.error.get("x")

    @property
    def rows(self) -> np.ndarray:
        """R11 and R12 (m) of every point by the line that is said, shape (n, 2)."""
        return self.line.rows(self.k1)


def of(draw: Callable, points: tuple[int, ...] = verdict.POINTS) -> Draw:
    """A family of benchmarks/verdict.py, its number of points at random."""

    def drawn(rng: np.random.Generator) -> Scan:
        t, given = draw(rng, int(rng.choice(points)))
        return Scan(given, t.line, float(np.nan_to_num(t.emittance)))

    return drawn


def among(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two, its logarithm flat."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def spoiled(
    spoil: Spoil,
    share: tuple[float, float] = (0.005, 0.05),
    points: tuple[int, ...] = (6, 8, 12, 30),
    waist: tuple[float, float] = (-0.3, 0.3),
    stated: tuple[float, float] = (1.0, 1.0),
    known: float = 0.5,
) -> Draw:
    """A family whose screen and read-back are not those of the beam.

    `spoil` makes of a scan the sizes that the screen shows without noise and the k1 that the file
    says. Noise is a share of the size; the file states it, times `stated`, in a part `known`.
    """

    def drawn(rng: np.random.Generator) -> Scan:
        t, part = verdict.truth(rng, int(rng.choice(points)), waist), among(rng, *share)
        shown, said = spoil(rng, t)
        t = t._replace(size=shown, k1=said)
        size = verdict.noisy(rng, t, part * shown)
        error = among(rng, *stated) * part * size if rng.random() < known else None
        return Scan(scan_of(t, size, error), t.line, t.emittance)

    return drawn


def sized(change: Callable[[np.random.Generator, np.ndarray], np.ndarray], **more) -> Draw:
    """A family whose sizes alone are spoiled."""
    return spoiled(lambda rng, t: (change(rng, t.size), t.k1), **more)


def magnet(change: Callable[[np.random.Generator, np.ndarray], np.ndarray], **more) -> Draw:
    """A family whose settings alone are misread."""
    return spoiled(lambda rng, t: (t.size, change(rng, t.k1)), **more)


def moved(rng, t: Truth, k1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The magnet is at `k1` where the file says `t.k1`."""
    return verdict.sizes(t.line, k1, t.emittance, t.beta), t.k1


def exact(rng, t: Truth):
    return t.size, t.k1


def at_any_share(stated: float | None, low: float, high: float) -> Draw:
    """Noise in proportion to the size, its share at random."""
    return of(lambda rng, n: verdict.relative(among(rng, low, high), stated)(rng, n))


def at_any_scatter(lost: float = 0.0) -> Draw:
    """Five shots a setting, their settings scattered by 0 to 5 % beyond."""
    return of(lambda rng, n: verdict.of_shots(rng.uniform(0.0, 0.05), lost)(rng, n))


def late(rng, t: Truth):
    """The field lags behind its read-back, by a tenth to a half of each step."""
    order = rng.permutation(len(t.k1)) if rng.random() < 0.5 else np.arange(len(t.k1))
    field, now, lag = np.empty(len(t.k1)), t.k1[order[0]], rng.uniform(0.1, 0.5)
    for place in order:
        now += (1 - lag) * (t.k1[place] - now)
        field[place] = now
    return moved(rng, t, field)


def up_and_down(rng, t: Truth):
    """Hysteresis: the same settings from above and from below differ by 5 to 20 % of the range."""
    lag = rng.uniform(0.025, 0.1) * np.ptp(t.k1)
    up, _ = moved(rng, t, t.k1 - lag)
    down, _ = moved(rng, t, t.k1 + lag)
    return np.r_[up, down[::-1]], np.r_[t.k1, t.k1[::-1]]


def energy_drift(rng, t: Truth):
    """The energy drifts by 1 to 5 % along the scan."""
    drift = rng.choice([-1, 1]) * among(rng, 0.01, 0.05)
    return moved(rng, t, t.k1 * (1 + drift * np.linspace(-0.5, 0.5, len(t.k1))))


def stops(rng, t: Truth):
    """The magnet stops at 20 to 60 % of the scan, the read-back goes on."""
    stop = int(rng.uniform(0.2, 0.6) * len(t.k1))
    return moved(rng, t, t.k1[np.minimum(np.arange(len(t.k1)), stop)])


def swapped(rng, t: Truth):
    """Sizes of the other plane: another waist and emittance, and the magnet defocuses."""
    ratio, beta = among(rng, 0.3, 3.0), t.beta * among(rng, 0.3, 3.0)
    return verdict.sizes(t.line, -t.k1, ratio * t.emittance, beta), t.k1


def clipped(rng, size):
    """A Gaussian profile on a screen that ends at 1.5 to 4 of the smallest sizes either side."""
    from scipy.stats import truncnorm

    edge = rng.uniform(1.5, 4.0) * size.min() / size
    return size * truncnorm.std(-edge, edge)


def halo(rng, size):
    """A part of 2 to 10 %, three times as wide, seen as far as 4 to 8 smallest sizes reach.

    The truth is the emittance of core and halo; a window of full sensitivity has rms w / sqrt(3).
    """
    part, window = among(rng, 0.02, 0.1), rng.uniform(4.0, 8.0) * size.min()
    wide = np.minimum(9 * size**2, window**2 / 3)
    return np.sqrt(((1 - part) * size**2 + part * wide) / (1 + 8 * part))


def pixels(rng, size):
    """Sizes in whole pixels of a fifth to one smallest size."""
    pixel = rng.uniform(0.2, 1.0) * size.min()
    return pixel * np.maximum(np.round(size / pixel), 0.5)


def outliers(rng, size):
    """One or two readings off by a factor of 1.3 to 2.5."""
    factor = among(rng, 1.3, 2.5) ** rng.choice([-1, 1])
    return size * np.where(rng.permutation(len(size)) < rng.integers(1, 3), factor, 1.0)


def widths(rng, size):
    """Some sizes, one to a third of them, are full widths at half maximum."""
    few = rng.integers(1, len(size) // 3 + 1)
    return size * np.where(rng.permutation(len(size)) < few, 2.355, 1.0)


def tails(rng, size):
    return size * np.clip(1 + 0.02 * rng.standard_t(2, len(size)), 0.4, 1.6)


def at_waist(low: float, high: float, power: float) -> Callable:
    """Adds to size² a part of the smallest, times (smallest / size)^`power`."""

    def change(rng, size):
        smallest = size.min()
        return np.sqrt(size**2 + among(rng, low, high) * smallest**2 * (smallest / size) ** power)

    return change


def repeated(rng: np.random.Generator) -> Scan:
    """A good scan of which a part of the rows, or all, stand two or three times in the file."""
    case = spoiled(exact)(rng)
    n = len(case.k1)
    rows = np.r_[np.arange(n), np.tile(rng.permutation(n)[: rng.integers(2, n + 1)], 2)]
    rows = np.sort(rows[: rng.integers(n + 2, len(rows) + 1)])
    t = Truth(case.line, case.k1[rows], case.size[rows], case.truth, 0.0)
    error = None if case.error is None else case.error[rows]
    return case._replace(given=scan_of(t, t.size, error))


def unseen(rng: np.random.Generator) -> Scan:
    """A beam whose waist is a hundredth of the noise, which is the same everywhere."""
    t = verdict.truth(rng, int(rng.choice((6, 8, 12, 30))))
    small = 1e-4 * t.emittance
    beam = verdict.sizes(t.line, t.k1, small, 1e4 * t.beta)
    noise = np.full(len(beam), rng.uniform(0.02, 0.1) * beam.max())
    size = np.abs(beam + noise * rng.standard_normal(len(beam)))
    return Scan(scan_of(t, size, noise if rng.random() < 0.5 else None), t.line, 0.0)


GOOD: dict[str, Draw] = {
    "errors stated, 0.5-5 %": at_any_share(1.0, 0.005, 0.05),
    "errors stated, 5-20 %": at_any_share(1.0, 0.05, 0.2),
    "no errors, 0.5-5 %": at_any_share(None, 0.005, 0.05),
    "no errors, 5-10 %": at_any_share(None, 0.05, 0.1),
    "no errors, the same µm": of(verdict.constant),
    "errors stated at twice, 1-10 %": at_any_share(2.0, 0.01, 0.1),
    "five shots, settings scatter by 0-5 %": at_any_scatter(),
    "waist near one end": spoiled(exact, waist=(0.3, 0.5)),
}
TRAPS: dict[str, Draw] = {
    **{name: of(draw) for name, draw in verdict.OTHERS.items()},
    "three or four points, 2-10 %": spoiled(exact, (0.02, 0.1), (3, 4)),
    "no errors, 20 %": of(verdict.relative(0.2, None)),
    "errors stated at half, 1-10 %": at_any_share(0.5, 0.01, 0.1),
    "errors stated at a third": spoiled(exact, (0.02, 0.1), stated=(0.3, 0.4), known=1.0),
    "one side of the waist": of(verdict.one_sided),
    "far from the waist": spoiled(exact, waist=(1.6, 2.2)),
    "smallest size × 0.6-1.7": of(lambda r, n: verdict.bad_at_waist(among(r, 0.6, 1.7))(r, n)),
    "one or two outliers": sized(outliers),
    "heavy tails": sized(tails),
    "shots that miss": at_any_scatter(0.05),
    "rows repeated in the file": repeated,
    "some sizes are FWHM": sized(widths),
    "sizes in whole pixels": sized(pixels),
    "screen ends, smoothly": sized(clipped),
    "large sizes cut": sized(lambda r, s: np.minimum(s, r.uniform(1.3, 2.5) * s.min())),
    "small sizes lifted": sized(lambda r, s: np.maximum(s, r.uniform(1.2, 2.0) * s.min())),
    "halo beyond the window": sized(halo),
    "magnet stops": spoiled(stops),
    "magnet is late": spoiled(late),
    "hysteresis, up and down": spoiled(up_and_down, points=(5, 6, 8)),
    "energy drifts by 1-5 %": spoiled(energy_drift),
    "planes swapped": spoiled(swapped),
    "rows mixed up": sized(lambda r, s: r.permutation(s)),
    "a hill": sized(lambda r, s: s.max() + s.min() - s),
    "waist far below the noise": unseen,
}

PRECISE = {"share": (0.003, 0.01), "known": 1.0}
# What one scan of sizes cannot show: (family, the cause in beamfit's budget).
HIDDEN: dict[str, tuple[Draw, str]] = {
    "screen scale 3-10 % off": (
        sized(lambda r, s: s * (1 + among(r, 0.03, 0.1)), **PRECISE), "screen scale",
    ),
    "saturation, size² + c": (sized(at_waist(0.1, 1.0, 0.0), **PRECISE), "resolution"),
    "space charge at the waist": (sized(at_waist(0.1, 1.0, 2.0), **PRECISE), "smallest size"),
    "pedestal at the waist": (sized(at_waist(0.1, 1.0, 4.0), **PRECISE), "smallest size"),
    "gradient 3-10 % off": (magnet(lambda r, k: k * (1 + among(r, 0.03, 0.1)), **PRECISE), "Q "),
    "magnet of the wrong sign": (magnet(lambda r, k: -k, **PRECISE), ""),
    "settings in another unit": (magnet(lambda r, k: 10 * k, **PRECISE), ""),
    "charge grows along the scan": (
        sized(lambda r, s: s * np.linspace(1, 1 + among(r, 0.03, 0.2), len(s)), **PRECISE), "",
    ),
}  # fmt: skip
