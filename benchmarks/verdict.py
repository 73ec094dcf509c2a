"""How often answers of scans hold the truth: python benchmarks/verdict.py [DRAWS] [SEED] [PAGE].

Every scan is SIMULATED and drawn from a family anew: line, beam, phase advance covered, number of
points and noise. Tables go to docs/verdict_measured.md, between its markers, or to another PAGE.
"""

from __future__ import annotations

import re
import secrets
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv

from beamfit.emittance.fit import fit_many
from beamfit.emittance.scan import QuadScan
from beamfit.errors import Status
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Quadrupole, Screen

PAGE = Path(__file__).resolve().parents[1] / "docs" / "verdict_measured.md"
MARKS = "<!-- measured: benchmarks/verdict.py -->", "<!-- end of measured -->"
POINTS = (4, 5, 6, 8, 12, 30)
ENERGY = 100.0  # MeV


class Line(NamedTuple):
    """A scanned quadrupole, then drifts (k1 = 0) and fixed quadrupoles, then the screen.

    Matrices are written out here in plain numpy, so that no tool is its own judge.
    """

    length: float  # m
    rest: tuple[tuple[float, float], ...]  # (k1 in 1/m², length in m), as the beam goes

    @property
    def after(self) -> np.ndarray:
        """Matrix of the rest, shape (2, 2)."""
        matrix = np.eye(2)
        for k1, length in self.rest:
            matrix = thick(np.array([k1]), length)[0] @ matrix
        return matrix

    def rows(self, k1: np.ndarray) -> np.ndarray:
        """R11 and R12 (m) of every setting, shape (n, 2)."""
        return (self.after @ thick(k1, self.length))[:, 0]

    def strengths(self, beta: float, angle: np.ndarray) -> np.ndarray:
        """k1 at which a beam with a waist of `beta` m before the magnet has such phases."""
        k1 = np.linspace(-8.0, 8.0, 4001) / self.length
        r11, r12 = self.rows(k1).T
        phase = np.unwrap(np.arctan2(beta * r11, r12))
        return np.interp(-np.asarray(angle), -phase, k1)


def thick(k1: np.ndarray, length: float) -> np.ndarray:
    """Matrices of a quadrupole (Wiedemann, Particle Accelerator Physics, 5.2): a complex phase."""
    root = np.sqrt(np.where(k1 == 0, 1e-12, k1).astype(complex))
    c, s = np.cos(root * length), np.sin(root * length)
    return np.array([[c, s / root], [-root * s, c]]).real.transpose(2, 0, 1)


class Truth(NamedTuple):
    """A scan as it would be without noise: line, k1 (1/m²), sizes (m) and the emittance (m)."""

    line: Line
    k1: np.ndarray
    size: np.ndarray
    emittance: float
    beta: float


def truth(rng: np.random.Generator, n: int, waist: tuple[float, float] = (-0.3, 0.3)) -> Truth:
    """Draw a line and a beam; the waist lies within so many radians of the middle of the scan.

    One line in three has a fixed quadrupole behind the scanned one.
    """
    drift, beta = rng.uniform(1.0, 4.0), 10 ** rng.uniform(0.3, 1.5)
    emittance = 10 ** rng.uniform(-9.5, -8.0)
    half, middle = 0.5 * np.radians(rng.uniform(100.0, 165.0)), rng.uniform(*waist)
    angle = np.linspace(max(middle - half, -1.45), min(middle + half, 1.45), n)
    fixed = rng.uniform(-5.0, 5.0) / drift if rng.random() < 1 / 3 else 0.0
    line = Line(rng.uniform(0.05, 0.15), ((0.0, 0.4 * drift), (fixed, 0.1), (0.0, 0.6 * drift)))
    k1 = line.strengths(beta, angle)
    return Truth(line, k1, sizes(line, k1, emittance, beta), emittance, beta)


def sizes(line: Line, k1: np.ndarray, emittance: float, beta: float) -> np.ndarray:
    """Rms sizes in m of a beam with its waist before the magnet."""
    r11, r12 = line.rows(k1).T
    return np.sqrt(emittance * (beta * r11**2 + r12**2 / beta))


def beamline(line: Line) -> Beamline:
    parts = [
        Quadrupole(f"F{i}", length, k1) if k1 else Drift(f"D{i}", length)
        for i, (k1, length) in enumerate(line.rest)
    ]
    return Beamline((Quadrupole("Q", line.length), *parts, Screen("S")), ENERGY)


def scan_of(t: Truth, size: np.ndarray, error: np.ndarray | None, **more) -> QuadScan:
    """A scan of one plane, as a user has it."""
    given = {} if error is None else {"x": error}
    return QuadScan({"Q": t.k1}, {"Q": "k1"}, {"x": size}, given, **more)


def noisy(rng, t: Truth, deviation: np.ndarray) -> np.ndarray:
    return np.maximum(t.size + deviation * rng.standard_normal(len(t.size)), 0.05 * t.size)


def relative(share: float, stated: float | None) -> Callable:
    """Noise in proportion to the size; `stated` is what the file says of it, as a part of it."""

    def draw(rng, n):
        t = truth(rng, n)
        size = noisy(rng, t, share * t.size)
        return t, scan_of(t, size, None if stated is None else stated * share * size)

    return draw


def constant(rng, n):
    """The same µm everywhere, 10 to 20 % of the smallest size, not stated."""
    t = truth(rng, n)
    return t, scan_of(t, noisy(rng, t, np.full(n, rng.uniform(0.1, 0.2) * t.size.min())), None)


def of_shots(scatter: float, lost: float = 0.0) -> Callable:
    """Five shots of 2 %; settings scatter besides; some shots show no beam."""

    def draw(rng, n):
        t = truth(rng, n)
        level = t.size * (1 + scatter * rng.standard_normal(n))
        shots = np.abs(level[:, None] * (1 + 0.02 * rng.standard_normal((n, 5))))
        gone = rng.random(shots.shape) < lost
        shots[gone] = (rng.uniform(0.0, 2.0, shots.shape) * t.size.max())[gone]
        error = shots.std(1, ddof=1) / np.sqrt(5)
        more = {"shots": np.full(n, 5), "shot_size": {"x": shots}}
        return t, scan_of(t, np.maximum(shots.mean(1), 1e-7), np.maximum(error, 1e-9), **more)

    return draw


def stated_short(rng, n):
    """Errors of single profiles, .1 to 1 % and different at each; settings scatter by 3 %."""
    t = truth(rng, n)
    size = noisy(rng, t, 0.03 * t.size)
    return t, scan_of(t, size, 0.003 * np.exp(0.7 * rng.standard_normal(n)) * size)


def few_shots(rng, n):
    """Means of three shots of 3 %, with their standard errors; of how many shots is not said."""
    t = truth(rng, n)
    shots = np.abs(t.size[:, None] * (1 + 0.03 * rng.standard_normal((n, 3))))
    return t, scan_of(t, shots.mean(1), shots.std(1, ddof=1) / np.sqrt(3))


def one_sided(rng, n):
    """The waist at the end of the scan or beyond; 2 % stated."""
    t = truth(rng, n, (0.6, 1.0))
    size = noisy(rng, t, 0.02 * t.size)
    return t, scan_of(t, size, 0.02 * size)


def bad_at_waist(factor: float) -> Callable:
    """The smallest size is off by a factor; 3 % stated."""

    def draw(rng, n):
        t = truth(rng, n)
        size = noisy(rng, t, 0.03 * t.size)
        size[np.argmin(t.size)] *= factor
        return t, scan_of(t, size, 0.03 * size)

    return draw


def nothing(kind: str) -> Callable:
    """Sizes that know nothing of the magnet; errors of 2 to 10 % stated in half of the scans."""

    def draw(rng, n):
        t = truth(rng, n)
        share = rng.uniform(0.02, 0.1)
        size = {
            "uniform": lambda: rng.uniform(0.4, 1.6, n),
            "lognormal": lambda: np.exp(rng.uniform(0.1, 0.4) * rng.standard_normal(n)),
            "walk": lambda: np.exp(np.cumsum(rng.uniform(0.03, 0.2) * rng.standard_normal(n))),
            "stuck": lambda: 1.0 + share * rng.standard_normal(n),
            "tent": lambda: 0.4 + np.abs(np.linspace(-1, 1, n) - rng.uniform(-0.3, 0.3)),
        }[kind]()
        size = 1e-4 * np.maximum(size, 0.05)
        if kind == "tent":
            size = size * (1 + share * rng.standard_normal(n))
        error = share * size if rng.random() < 0.5 or kind == "tent" else None
        return t._replace(emittance=np.nan), scan_of(t, size, error)

    return draw


BEAMS = {
    **{f"errors stated, right, {100 * r:g} %": relative(r, 1.0) for r in (0.02, 0.05, 0.1, 0.2)},
    **{f"no errors, {100 * r:g} % of the size": relative(r, None) for r in (0.02, 0.05, 0.1, 0.2)},
    "no errors, the same µm, 10-20 % of the smallest": constant,
    **{f"errors stated at half, {100 * r:g} %": relative(r, 0.5) for r in (0.02, 0.05, 0.1)},
    "errors stated at twice, 5 %": relative(0.05, 2.0),
    **{f"five shots, settings ± {s} % beyond": of_shots(s / 100) for s in (0, 1, 2, 4, 5)},
    "five shots, one in twenty shows no beam": of_shots(0.02, 0.05),
    "one side of the waist, 2 %": one_sided,
    **{f"smallest size × {f}, 3 %": bad_at_waist(f) for f in (0.7, 1.3, 1.6)},
    "errors stated, .1 to 1 %, settings ± 3 %": stated_short,
    "errors of three shots, of how many not said": few_shots,
}
OTHERS = {
    "sizes uniform from 40 to 160 %": nothing("uniform"),
    "sizes at random, 10 to 40 %": nothing("lognormal"),
    "a walk of 3 to 20 % a setting": nothing("walk"),
    "a stuck magnet": nothing("stuck"),
    "a tent": nothing("tent"),
}


def limits(hits: int, of: int) -> str:
    """A share in % with its central 95 % (Clopper-Pearson)."""
    if not of:
        return "–"
    low = betaincinv(hits, of - hits + 1, 0.025) if hits else 0.0
    high = betaincinv(hits + 1, of - hits, 0.975) if hits < of else 1.0
    return f"{100 * hits / of:.0f} ({100 * low:.0f}–{100 * high:.0f})"


def fitted(draw: Callable, rng, n: int, draws: int) -> Iterator:
    pairs = [draw(rng, n) for _ in range(draws)]
    for start in range(0, draws, 250):
        part = pairs[start : start + 250]
        fits = fit_many((scan, beamline(t.line)) for t, scan in part)
        yield from zip((t for t, _ in part), (fit.x for fit in fits), strict=True)


def beam_cell(found: list) -> str:
    answered = [(t, p) for t, p in found if p.emittance.error is not None]
    intervals = [(*p.emittance.interval_95, t.emittance) for t, p in answered]
    held = sum(low <= true <= high for low, high, true in intervals)
    pulls = [abs(p.emittance.value - t.emittance) / p.emittance.error for t, p in answered]
    inner, off = sum(v <= 1 for v in pulls), sum(v > 4 for v in pulls)
    n = len(answered)
    if not n:
        return "none"
    share = f"{100 * n / len(found):.0f} / {100 * inner / n:.0f}"
    return f"{share} / {limits(held, n)} / {100 * off / n:.1f}"


def other_cell(found: list) -> str:
    answered = sum(p.emittance.error is not None for _, p in found)
    loose = [p.emittance for _, p in found if p.emittance.error is None]
    limited = sum(q.interval_95 is not None for q in loose)
    return f"{limits(answered, len(found))} / {100 * limited / len(found):.1f}"


def table(rng, families: dict, cell: Callable, draws: int) -> Iterator[str]:
    yield "| family | " + " | ".join(f"{n} points" for n in POINTS) + " |"
    yield "|---" * (len(POINTS) + 1) + "|"
    for name, draw in families.items():
        row = [cell(list(fitted(draw, rng, n, draws))) for n in POINTS]
        print(name, *row, sep=" | ", flush=True)
        yield f"| {name} | " + " | ".join(row) + " |"


def same_status(rng, draws: int) -> str:
    """Scans whose status changes as right stated errors are halved and doubled."""
    changed = 0
    for _ in range(draws):
        t, scan = relative(rng.uniform(0.01, 0.08), 1.0)(rng, int(rng.integers(6, 13)))
        again = [scan_of(t, scan.size["x"], f * scan.error["x"]) for f in (0.5, 1.0, 2.0)]
        fits = fit_many((s, beamline(t.line)) for s in again)
        changed += len({fit.x.status for fit in fits} - {Status.not_finite}) > 1
    return limits(changed, draws)


def main(draws: int = 200, seed: int | None = None, page: str = str(PAGE)) -> None:
    seed = secrets.randbelow(10**6) if seed is None else seed
    rng = np.random.default_rng(seed)
    command = f"python benchmarks/verdict.py {draws} {seed}"
    said = [
        MARKS[0],
        f"Made by `{command}`: {draws} simulated scans per cell, new ones for each seed.",
        "",
        "Beams. In each cell, in %: answered / **of the answers** within one error / with the "
        "truth in `interval_95` (binomial 95 % limits) / beyond 4 errors.",
        "",
        *table(rng, BEAMS, beam_cell, draws),
        "",
        "No beams. In %: called an emittance (binomial 95 % limits) / given an interval "
        "nevertheless.",
        "",
        *table(rng, OTHERS, other_cell, draws),
        "",
        "Scans of 6 to 12 points whose status changes as right stated errors of 1 to 8 % are "
        f"halved and doubled: {same_status(rng, draws)} %.",
        MARKS[1],
    ]
    file = Path(page)
    text = file.read_text() if file.exists() else "\n".join(MARKS)
    whole = re.sub("(?s)" + MARKS[0] + ".*" + MARKS[1], lambda _: "\n".join(said), text)
    file.write_text(whole)
    print("\n".join(said))


if __name__ == "__main__":
    main(*(int(a) if a.isdigit() else a for a in sys.argv[1:]))
