"""The noise of a fed-batch process's outputs, and the verdict on what was fitted to them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from beamfit.dynamics.curve import Curve
from beamfit.dynamics.fedbatch_model import RATES, PreparedBatches
from beamfit.dynamics.verdict import WORSE
from beamfit.greybox.fit import Fit
from beamfit.status import Status
from beamfit.verdict import Finding

# Floor of a relative noise, as a share of the one at the largest value.
FLOOR = 0.05
# Standard errors beyond which neighbouring residuals are correlated (p < 1e-3).
ALIKE = 3.1
# Rates above this share of their bound count as at the bound.
BOUND = 0.95


class ReadingNoise(NamedTuple):
    """Noise of an output: a share of the value where `relative`, else the same everywhere."""

    size: float
    relative: bool

    def errors(self, values: np.ndarray) -> np.ndarray:
        """Standard deviation of each value."""
        if not self.relative:
            return np.full_like(values, self.size)
        return self.size * np.hypot(values, FLOOR * np.max(np.abs(values)))

    def __str__(self) -> str:
        return f"{100 * self.size:.2g} % of the value" if self.relative else f"{self.size:.3g}"


def noise_of(rest: np.ndarray, fitted: np.ndarray, read: np.ndarray) -> ReadingNoise:
    """The noise of one output, of the kind that is likelier."""
    found = []
    for relative in (False, True):
        unit = ReadingNoise(1.0, relative).errors(fitted)[read]
        size = max(float(np.sqrt(np.mean((rest[read] / unit) ** 2))), 1e-12)
        found.append((float(np.sum(np.log(size * unit))), ReadingNoise(size, relative)))
    return min(found, key=lambda each: each[0])[1]


class RateEvidence(NamedTuple):
    """Input of the rules; `fitted` has the shape of the readings."""

    fit: Fit
    rests: bool
    seen: PreparedBatches
    fitted: np.ndarray
    noise: dict[str, ReadingNoise]
    curves: tuple[Curve, ...] = ()
    held: Mapping[str, float] = MappingProxyType({})


def _lost(e: RateEvidence) -> Finding | None:
    if e.rests and e.fit.status is not Status.not_finite:
        return None
    lost = e.fit.status is Status.not_finite
    return Finding(Status.not_finite if lost else Status.not_converged, e.fit.message)


def _open(e: RateEvidence) -> Finding | None:
    left = [f"{c.parameter}({c.input})" for c in e.curves
            if not np.any(np.isfinite(c.error) & c.visited & (c.error < c.value))]  # fmt: skip
    if not left:
        return None
    cause = f"The batches do not determine {', '.join(left)}."
    return Finding(Status.unidentified, cause, "Add batches that visit more, or read more often.")


def _bounded(e: RateEvidence) -> Finding | None:
    most = dict(zip(RATES, np.asarray(e.seen.batches.most), strict=True))
    held = {c.parameter for c in e.curves
            if np.any(c.value[c.visited] > BOUND * most[c.parameter])}  # fmt: skip
    if not held:
        return None
    cause = f"{', '.join(sorted(held))} is held by its bound."
    return Finding(Status.at_limit, cause, "Give higher bounds (most=) if the physics allows.")


def _refuted(e: RateEvidence) -> Finding | None:
    """Residuals that follow one another; those of free numbers fitted to them lean away."""
    follow, squares, count = np.zeros(len(e.noise)), np.zeros(len(e.noise)), 0
    for k, noise in enumerate(e.noise.values()):
        rest = (e.seen.measured - e.fitted)[..., k] / noise.errors(e.fitted[..., k])
        each = [r[ok] for r, ok in zip(rest, e.seen.read[..., k], strict=True)]
        follow[k] = sum(float(r[1:] @ r[:-1]) for r in each)
        squares[k], count = sum(float(r @ r) for r in each), count + sum(map(len, each))
    alike = follow.sum() / squares.sum() + 1.0 - e.fit.groups[0].dof / count
    if alike * np.sqrt(count) < ALIKE:
        return None
    name = list(e.noise)[int(np.argmax(follow / squares))]
    cause = (
        f"Residuals follow one another (correlation of neighbours {alike:.2f}), of {name} most: "
        "the rates hang on something else, or a balance lacks a flow."
    )
    remedy = "Give what else was set as an input, or more hidden nodes."
    return Finding(Status.poor_fit, cause, remedy)


def _worse(e: RateEvidence) -> Finding | None:
    bad = {name: r for name, r in e.held.items() if r > WORSE}
    if not bad:
        return None
    name, rest = max(bad.items(), key=lambda each: each[1])
    cause = f"Batch {name}, held back, is predicted with {rest:.1f} times the noise."
    return Finding(Status.poor_fit, cause, "Use batches that cover its range, or fewer nodes.")


def _good(e: RateEvidence) -> Finding:
    said = ", ".join(f"{name} {noise}" for name, noise in e.noise.items())
    cause = f"The balances follow all batches within noise: {said}."
    never = sorted({c.input for c in e.curves if not c.visited.all()})
    more = f" Parts of the range of {', '.join(never)} were not visited." if never else ""
    return Finding(Status.converged, cause + more)


RULES = (_lost, _open, _bounded, _refuted, _worse, _good)
