"""Laws between an input and what it moves: play, hysteresis, stop and dead zone, by evidence.

A response behind a law leaves residuals that a noise that wanders takes for its own, and gains far
off. So every law is fitted beside no law and beside one more term of a fuller response, each under
every noise, and weighed by its likelihood with the numbers and the noise integrated out. What stays
open between no law and the laws goes into errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.compile_cache import SELDOM
from beamfit.dynamics.checks import RunSlopes, slow_paths
from beamfit.dynamics.model import Driven, PreparedOutput, predicted
from beamfit.dynamics.record import Run
from beamfit.dynamics.search import Settled, seen_of
from beamfit.greybox import tree
from beamfit.greybox.memory import Memory, Whitened, noises, range_of
from beamfit.greybox.problem import with_slope
from beamfit.noise.correlated import CorrelatedNoise, whitened_of_both

# Laws, and half widths of each as shares of an input's range: prior flat in their logarithm. A stop
# hands on other values as soon as its width passes a move, the others change smoothly with it.
LAWS = {law: np.geomspace(0.005, 0.4, count) for law, count in
        (("play", 8), ("hysteresis", 8), ("stop", 24), ("dead zone", 8))}  # fmt: skip
# Plays of a hysteresis, as shares of the widest, which is twice its half width.
PLAYS = (0.0, 0.4, 0.8, 1.2, 1.6, 2.0)
# Prior odds of a law: even.
ODDS = 1.0
# Correlation times and white variances of the noises that each is fitted with, and most readings.
CORRELATION_TIMES, WHITE, MOST = 6, (0.0, 1.0, 10.0, 100.0), 2048
# Share of what a law hands on that no gain and level give, below which it is none.
SAME = 1e-6
# Smallest weight and sum of squares; largest residual, of a step that went astray.
TINY, VAST = 1e-300, 1e100
# Prior: a law changes the logarithm of a time constant, or what a damping is made of, by so much.
FACTOR = 1.0
# Gauss-Newton rounds of each, and shorter delays that a law may stand for.
ROUNDS, LATE = 4, 3


class LawEvidence(NamedTuple):
    """Posterior over laws of the inputs.

    Attributes
    ----------
    none : float
        Probability of no law, where a law is the only other possibility.
    fuller : float
        Probability that one more term of a fuller response explains more than a law does.
    likeliest : str
        The likeliest law: its name, input and half width.
    weight : array, shape (a,)
        Probability of each law; with `none` they make 1.
    shift : array, shape (a, p)
        The numbers of the fit with each, less those without.
    covariance : array, shape (a, p, p)
        Of the numbers, with each.
    """

    none: float
    fuller: float
    likeliest: str
    weight: np.ndarray
    shift: np.ndarray
    covariance: np.ndarray

    def error(self, slopes: np.ndarray, alone: np.ndarray) -> np.ndarray:
        """Errors of quantities by their slopes, shape (..., p), about the value without a law.

        `alone` has the errors without one.
        """
        spread = np.einsum("...p,apq,...q->...a", slopes, self.covariance, slopes)
        with_law = (spread + (slopes @ self.shift.T) ** 2) @ self.weight
        return np.sqrt(self.none * alone**2 + with_law)


def moved(u: np.ndarray, law: str, width: float) -> np.ndarray:
    """One input as a law hands it on.

    A play follows when its clearance is used up; a hysteresis is the mean of plays of several
    widths (Prandtl, Ishlinskii); a stop (Coulomb friction) goes all the way once it moves at all. A
    dead zone lies about 0, or about the middle of a range without it.
    """
    low, high = float(u.min()), float(u.max())
    if law == "dead zone":
        away = u - (0.0 if low < 0 < high else 0.5 * (low + high))
        return u - np.clip(away, -width, width)
    changes = np.diff(u, prepend=np.nan) != 0
    widths = width * np.array(PLAYS if law == "hysteresis" else (1.0,))
    at, found = u[0] + 0 * widths, []
    for now in u[changes]:
        at = (np.where(np.abs(now - at) > widths, now, at) if law == "stop"
              else np.clip(at, now - widths, now + widths))  # fmt: skip
        found.append(at)
    return np.mean(found, axis=1)[np.cumsum(changes) - 1]


class _Law(NamedTuple):
    """A law of an input and its half width, behind a delay; no law where there is no input."""

    late: float
    law: str = ""
    name: str = ""
    width: float = 0.0

    def __str__(self) -> str:
        return f"a {self.law} of {self.name} by ±{self.width:.2g}"


def _laws(runs: Sequence[Run], seen: PreparedOutput, delays: Sequence[float]) -> list[_Law]:
    """No law and each law that a gain and a level do not stand for, at each delay."""
    found = []
    for name, wide in zip(seen.inputs, np.ptp(seen.points, axis=0), strict=True):
        inputs = [run.inputs[name] for run in runs]
        design = np.stack([np.concatenate(inputs), np.ones(sum(map(len, inputs)))], axis=1)
        for law, width in ((law, float(w * wide)) for law, each in LAWS.items() for w in each):
            turned = np.concatenate([moved(u, law, width) for u in inputs])
            rest = turned - design @ np.linalg.lstsq(design, turned, rcond=1e-10)[0]
            if np.linalg.norm(rest) > SAME * np.linalg.norm(turned - turned.mean()):
                found.append((law, name, width))
    return [law for late in delays for law in (_Law(late), *(_Law(late, *own) for own in found))]


def shorter(delay: float) -> list[float]:
    """A delay that was found, and the shorter ones that a law may stand for."""
    whole = int(np.ceil(delay))
    return [delay, *range(max(0, whole - LATE), whole)]


def _inputs(runs: Sequence[Run], seen: PreparedOutput, laws: Sequence[_Law]) -> list[np.ndarray]:
    """Inputs of each run by each law, shape (laws, rows, inputs)."""
    found: list[list[np.ndarray]] = [[] for _ in runs]
    for late, own in groupby(laws, key=lambda law: law.late):
        delayed = seen_of(tuple(runs), seen.output, seen.runs[0].physics, late)
        behind = list(own)
        for each, run, course in zip(found, seen.runs, delayed.runs, strict=True):
            u = np.repeat(np.asarray(course.u), len(run.u) // len(course.u), axis=0)
            for law in behind:
                turned = u.copy()
                if law.name:
                    i = seen.inputs.index(law.name)
                    turned[:, i] = moved(u[:, i], law.law, law.width)
                each.append(turned)
    return [np.array(each) for each in found]


@partial(jax.jit, static_argnums=0, compiler_options=SELDOM)
def _predicted(chosen: Any, model: Any, run: Driven, theta: jax.Array, u: jax.Array) -> Any:
    """Outputs and slopes of each law, shapes (laws, readings), (laws, readings, numbers)."""

    def one(theta, u):
        own = replace(run, u=u)
        return with_slope(lambda t: predicted(tree.replace(model, chosen, t), own), theta)

    return jax.vmap(one)(theta, u)


def _triangles(grid: Sequence[CorrelatedNoise], rows: np.ndarray, interval: np.ndarray):
    """Triangular factors of rows, shape (laws, n, m), and log volumes, whitened by each noise."""
    each = [whitened_of_both(np.swapaxes(rows, 0, 1), interval, noise) for noise in grid]
    triangles = [np.linalg.qr(np.swapaxes(row, 0, 1), mode="r") for row, _ in each]
    return np.array(triangles), np.array([volume for _, volume in each])


def _shape(found: Settled, seen: PreparedOutput) -> list[int]:
    """Raw numbers of time constants and dampings, which a law may take to where none tells them."""
    powers = seen.runs[0].physics.units(len(seen.inputs))
    names = [v.name for v in found.fit.variables]
    return [names.index(f"map[{k}]") for k, (_, gain) in enumerate(powers)
            if not gain and f"map[{k}]" in names]  # fmt: skip


def _rows(
    found: Settled, seen: PreparedOutput, inputs: Sequence, terms: Sequence, theta: np.ndarray
) -> list:
    """Slopes and residuals by run, and their times, in units of the noise; those of priors last.

    The last number is the share of a term, shape (laws, readings) of each run.
    """
    fit, core, parts = found.fit, found.fit.problem.core, []
    for run, u, term, y, time, size in zip(
        seen.runs, inputs, terms, seen.measured, seen.time, found.noise[:, 0], strict=True
    ):
        value, slope = _predicted(core.chosen, core.model, run, theta[:, :-1], u)
        rest = np.asarray(value) + theta[:, -1:] * term - y
        rows = np.concatenate([slope, term[..., None], rest[..., None]], axis=2)
        parts.append((np.clip(np.nan_to_num(rows[:, :MOST]) / size, -VAST, VAST), time[:MOST]))
    near = _shape(found, seen)
    prior = np.concatenate([np.eye(theta.shape[1])[near] / FACTOR, np.eye(theta.shape[1])[-1:]])
    rest = (theta - np.append(fit.theta, 0.0)) @ prior.T
    known = np.concatenate([np.tile(prior, (len(theta), 1, 1)), rest[..., None]], axis=2)
    return [*parts, (known, None)]


def _whitened(parts: list, grid: Sequence[CorrelatedNoise]) -> Whitened:
    """Rows of every law by every noise, in this order: one of them is one of `grid`."""
    *runs, (known, _) = parts
    each = [_triangles(grid, rows, np.diff(time)) for rows, time in runs]
    triangles = [t for t, _ in each] + [np.tile(known, (len(grid), 1, 1, 1))]
    both = np.concatenate(triangles, axis=2)
    both = both.reshape(-1, *both.shape[2:])
    noise = CorrelatedNoise(*np.repeat(np.array(grid).T, len(known), axis=1))
    count = sum(len(time) for _, time in runs) + known.shape[1]
    return Whitened(noise, both, np.repeat(sum(v for _, v in each), len(known)), count)


def _numbers(rows: Callable, count: int, begin: np.ndarray, grid: Sequence) -> np.ndarray:
    """The numbers of each law, by Gauss-Newton steps that lower -2 ln L."""
    best = np.tile(begin, (count, 1))
    step, least, each = np.zeros_like(best), np.full(count, np.inf), np.arange(count)
    for _ in range(ROUNDS):
        white = _whitened(rows(best + step), grid)
        squares, memory = np.sum(white.triangle[..., -1] ** 2, axis=1), white.memory()
        now, after = (
            (white.count * np.log(np.maximum(s, TINY)) - 2 * white.volume).reshape(-1, count)
            for s in (squares, memory.squares)
        )
        further = memory.step.reshape(-1, count, best.shape[1])[after.argmin(axis=0), each]
        better = now.min(axis=0) < least
        best = np.where(better[:, None], best + step, best)
        least = np.minimum(least, now.min(axis=0))
        step = np.where(better[:, None], further, 0.25 * step)
    return best


def _moments(memory: Memory, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Likelihood of each law, the mean of its steps over noises, and the covariance."""
    weight = np.maximum(memory.weight, TINY).reshape(-1, count)
    share, step = weight / weight.sum(axis=0), memory.step.reshape(*weight.shape, -1)
    half = memory.half.reshape(*weight.shape, *memory.half.shape[1:])
    size = (memory.squares / memory.dof).reshape(weight.shape)
    mean = np.einsum("ga,gap->ap", share, step)
    spread = np.einsum("ga,gapr,gaqr->apq", share * size, half, half, optimize=True)
    away = step - mean
    spread += np.einsum("ga,gap,gaq->apq", share, away, away, optimize=True)
    return weight.sum(axis=0), mean, spread


def _prior(laws: Sequence[_Law]) -> np.ndarray:
    """Prior of each: even over the kinds of law, the widths of one and the delays."""
    alike = Counter(law.law for law in laws)
    odds = {kind: ODDS / (len(alike) - 1) if kind else 1.0 for kind in alike}
    return np.array([odds[law.law] / alike[law.law] for law in laws])


def laws_of(
    runs: Sequence[Run],
    seen: PreparedOutput,
    found: Settled,
    delays: Sequence[float],
    slopes: Sequence[RunSlopes],
) -> LawEvidence:
    """Weigh laws of the inputs against none, with the numbers and the noise integrated out.

    `delays` are those that a law is looked for with. Terms of a fuller response are a further path
    of first order or a parameter that changes with an input, as large as the output's scatter.
    """
    paths = zip(slow_paths(seen), slopes, strict=True)
    more = [np.concatenate([slow, each.changing], axis=1) for slow, each in paths]
    apart = min(float(np.median(np.diff(t))) for t in seen.time)
    ends = np.array([range_of(t) for t in seen.time])
    grid = noises((ends[:, 0].min(), ends[:, 1].max()), apart, CORRELATION_TIMES, WHITE)
    laws, count = _laws(runs, seen, delays), more[0].shape[1]
    inputs = _inputs(runs, seen, laws)
    inputs = [jnp.asarray(np.concatenate([u, np.tile(u[:1], (count, 1, 1))]))
              for u in inputs]  # fmt: skip
    unit = np.sqrt(np.mean(np.concatenate(more) ** 2, axis=0)) / seen.size_y
    terms = [np.concatenate([np.zeros((len(laws), len(x))), (x / np.where(unit > 0, unit, 1.0)).T])
             for x in more]  # fmt: skip
    rows = partial(_rows, found, seen, inputs, terms)
    begin, whole = np.append(found.fit.theta, 0.0), len(laws) + count
    at = _numbers(rows, whole, begin, grid)
    likelihood, mean, spread = _moments(_whitened(rows(at), grid).memory(), whole)
    none = np.array([not law.name for law in laws])
    by_law, fuller = likelihood[: len(laws)], likelihood[len(laws) :].mean()
    chance = by_law * _prior(laws)
    law = float(chance[~none].sum())
    shift = (at + mean - begin)[: len(laws), :-1]
    best = int(np.argmax(np.where(none, -1.0, chance)))
    chance /= chance.sum()
    return LawEvidence(
        float(chance[none].sum()),
        float(fuller / (fuller + law)),
        str(laws[best]),
        chance[~none],
        shift[~none],
        spread[: len(laws), :-1, :-1][~none],
    )
