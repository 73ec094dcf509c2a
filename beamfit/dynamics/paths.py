"""Paths from the recorded inputs to a process: behind a law, held or moving between samples, late.

Every path hands on rows of its own, as many a sample for all paths of a comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.input_laws import InputLaw, moved
from beamfit.dynamics.model import EQUAL, Driven, PreparedOutput
from beamfit.dynamics.record import PARTS, Run, between_rows
from beamfit.dynamics.response import Physics
from beamfit.greybox.problem import padded_length

# Longest delay that is tried, in samples, and as a share of the run.
LATEST, SHARE = 24, 0.1
# Logarithm of the odds of clocks of input and output that differ: 1 in 150, a guess.
AHEAD = 5.0


class Path(NamedTuple):
    """A law or none, names of the inputs that move between samples, and the delay in samples."""

    law: InputLaw | None
    moving: tuple[str, ...]
    delay: float

    @property
    def whole(self) -> int:
        """The whole samples of the delay."""
        return int(np.floor(self.delay))

    @property
    def part(self) -> float:
        """The part of a sample of the delay."""
        return self.delay - self.whole


class Paths(NamedTuple):
    """The paths without a law that a record may have.

    Attributes
    ----------
    moving : tuple of str
        Inputs without high frequencies, which may move between samples.
    delays : tuple of int
        Whole samples.
    parts : bool
        Whether parts of a sample are possible besides.
    """

    moving: tuple[str, ...]
    delays: tuple[float, ...]
    parts: bool

    @classmethod
    def of(
        cls, runs: Sequence[Run], moving: tuple[str, ...], delay: float | None, parts: bool
    ) -> Paths:
        """Those of runs; one delay if it is given."""
        if delay is not None:
            return cls(moving, (delay,), False)
        most = latest(runs)
        return cls(moving, tuple(range(-most, most + 1)), parts)

    @property
    def kinds(self) -> tuple[tuple[str, ...], ...]:
        """Inputs that move between samples, of each kind of path."""
        return ((), self.moving) if self.moving else ((),)

    def starts(self, delay: float) -> np.ndarray:
        """Where rows of a sample begin, so that this delay ends at one of them."""
        if not (self.parts or self.moving or delay % 1.0):
            return np.zeros(1)
        rows, part = np.arange(PARTS) / PARTS, delay % 1.0
        if part:
            rows[1 + np.argmin(np.abs(rows[1:] - part))] = part
        return rows

    def plain(self) -> list[Path]:
        """Paths of whole delays."""
        return [Path(None, kind, float(delay)) for delay in self.delays for kind in self.kinds]

    def around(self, path: Path, starts: np.ndarray) -> list[Path]:
        """Paths of parts of a sample less than one from a path."""
        if not self.parts:
            return []
        whole = [path.whole - 1, path.whole] if path.delay == path.whole else [path.whole]
        return [Path(None, kind, k + float(part))
                for k in whole for part in starts[1:] for kind in self.kinds
                if k + part < max(self.delays[-1], 1)]  # fmt: skip

    def log_prior(self, path: Path) -> float:
        """Even over delays, over whole ones and parts, and over the ways between samples."""
        log = -np.log(len(self.kinds))
        if len(self.delays) == 1:
            return float(log)
        log -= np.log(self.delays[-1] + 1.0) + (AHEAD if path.delay < 0 else 0.0)
        if self.parts:
            log -= np.log(2.0) + (np.log(PARTS - 1.0) if path.delay % 1.0 else 0.0)
        return float(log)


def latest(runs: Sequence[Run]) -> int:
    """The longest delay that is tried, in samples."""
    return min(LATEST, int(SHARE * min(map(len, runs))))


def with_rows(
    runs: Sequence[Run],
    seen: PreparedOutput,
    physics: Physics,
    starts: np.ndarray,
    most: int | None = None,
) -> tuple[tuple[Driven, ...], list[np.ndarray]]:
    """Runs without inputs at rows of a sample that begin there, and readings, `most` of each."""
    found, measured = [], []
    shares = np.diff(starts, append=1.0)
    for i, (run, y) in enumerate(zip(runs, seen.measured, strict=True)):
        rows = np.flatnonzero(np.isfinite(run.outputs[seen.output]))[:most]
        time = run.time[: rows[-1] + 1]
        apart = np.append(np.diff(time), 0.0)
        dt = np.outer(np.pad(apart, (0, padded_length(len(time)) - len(time))), shares).ravel()
        turn = len(starts) if np.ptp(apart[:-1]) <= EQUAL * apart[0] else 0
        each = (jnp.asarray(v) for v in (dt, time[rows] - time[0], rows * len(starts), i))
        found.append(Driven(physics, None, *each, None, turn))
        measured.append(y[:most])
    return tuple(found), measured


def handed_on(
    runs: Sequence[Run], counts: Sequence[int], paths: Sequence[Path], starts: np.ndarray
) -> list[np.ndarray]:
    """Inputs of each run behind each path and their changes by a step of a law's width.

    Shape (paths, rows, inputs, 2), rows of so many samples of each run. Inputs before the first
    sample equal it.
    """
    found = []
    for run, samples in zip(runs, counts, strict=True):
        plain = {(path.moving, path.part): _late(run, starts, path) for path in paths}
        behind = _behind(run, plain, paths)
        more, each = (0, max(samples - len(run), 0)), []
        for path in paths:
            u = plain[path.moving, path.part]
            rows = np.stack([u, np.zeros_like(u)], axis=3)
            if path.law is not None:
                k = list(run.inputs).index(path.law.input)
                rows[:, :, k] = behind[path._replace(delay=path.part)]
            rows = rows[np.clip(np.arange(len(rows)) - path.whole, 0, len(rows) - 1)]
            each.append(np.pad(rows, (more, *[(0, 0)] * 3), mode="edge")[:samples])
        found.append(np.stack(each).reshape(len(paths), -1, *each[0].shape[2:]))
    return found


def _late(run: Run, starts: np.ndarray, path: Path) -> np.ndarray:
    """Inputs a part of a sample late, shape (samples, rows, inputs)."""
    middle = 0.5 * (starts + np.append(starts[1:], 1.0)) - path.part
    columns = []
    for name, u in run.inputs.items():
        before = np.append(u[0], u[:-1])
        held = np.where(starts < path.part, before[:, None], u[:, None])
        columns.append(between_rows(u, middle) if name in path.moving else held)
    return np.stack(columns, axis=2)


def _behind(run: Run, plain: dict, paths: Sequence[Path]) -> dict[Path, np.ndarray]:
    """An input behind laws and its changes, (samples, rows, 2): alike laws at once."""

    def alike(path: Path) -> tuple:
        return path.law.kind, path.law.place, path.law.input, path.moving, path.part

    lawful = {path._replace(delay=path.part) for path in paths if path.law is not None}
    found = {}
    for (kind, place, name, *way), group in groupby(sorted(lawful, key=alike), alike):
        group = list(group)
        u = plain[tuple(way)][:, :, list(run.inputs).index(name)]
        width, step = np.array([path.law[2:4] for path in group]).T
        widths = width * np.exp(np.multiply.outer([0.0, 1.0, -1.0], step))
        behind = moved(u.ravel(), kind, widths, place)
        for path, at, wider, closer in zip(group, *behind, strict=True):
            turned = np.stack([at, 0.5 * (wider - closer)], axis=1)
            found[path] = turned.reshape(*u.shape, 2)
    return found
