"""Laws between an input and what it moves, such as a play or a dead zone, by evidence.

A response behind a law leaves residuals that a noise that wanders takes for its own, and gains far
off. So every law is fitted beside no law and beside one more term of a fuller response, each under
every noise, and weighed by its likelihood with the numbers and the noise integrated out. What stays
open between no law and the laws goes into errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.checks import RunSlopes, slow_paths
from beamfit.dynamics.model import Driven, PreparedOutput, delayed, predicted
from beamfit.dynamics.record import Run
from beamfit.dynamics.search import Settled, noises_of
from beamfit.greybox import tree
from beamfit.greybox.memory import Memory, Whitened
from beamfit.greybox.problem import with_slope
from beamfit.noise.memory import CorrelatedNoise, innovations

# Laws, and half widths of each as shares of an input's range: prior flat in their logarithm. A stop
# hands on other values as soon as its width passes a move. The others change smoothly with it, so
# that it is a number to be fitted, with a prior about each of these as wide as half their distance.
LAWS = {law: np.geomspace(0.005, 0.4, count) for law, count in
        (("play", 8), ("hysteresis", 8), ("stop", 24), ("shift", 8), ("dead zone", 8))}  # fmt: skip
BETWEEN = 0.5 * np.log(80.0) / 7
# Places of a dead zone in a range without 0: prior flat.
PLACES = np.linspace(0.1, 0.9, 5)
# Plays of a hysteresis, as shares of the widest, which is twice its half width.
PLAYS = (0.0, 0.4, 0.8, 1.2, 1.6, 2.0)
# Correlation times and white variances of the noises that each is fitted with, and most readings.
CORRELATION_TIMES, WHITE, MOST = 6, (0.0, 1.0, 10.0, 100.0), 2048
# Share of what a law hands on that no gain and level give, below which it is none.
SAME = 1e-6
# Largest residual, of a step that went astray.
VAST = 1e100
# Gauss-Newton rounds of each, noises in those after the first, and shorter delays that a law may
# stand for.
ROUNDS, FEW, LATE = 4, 4, 3


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


def moved(u: np.ndarray, law: str, width: float | np.ndarray, place: float = 0.0) -> np.ndarray:
    """One input as a law hands it on, shape (rows,), for each of several widths if given.

    A play follows when its clearance is used up; a hysteresis is the mean of plays of several
    widths (Prandtl, Ishlinskii); a stop (Coulomb friction) goes all the way once it moves at all; a
    shift (friction against a spring) is to the side that the input last came from. A dead zone lies
    about a place.
    """
    half = np.asarray(width)[..., None]
    if law == "dead zone":
        return u - np.clip(u - place, -half, half)
    if law == "shift":
        sign = np.sign(np.diff(u, prepend=u[0]))
        last = np.maximum.accumulate(np.where(sign != 0, np.arange(len(u)), 0))
        return u - half * sign[last]
    changes = np.diff(u, prepend=np.nan) != 0
    widths = np.multiply.outer(width, PLAYS if law == "hysteresis" else (1.0,))
    at, found = u[0] + 0 * widths, []
    for now in u[changes]:
        at = (np.where(np.abs(now - at) > widths, now, at) if law == "stop"
              else np.clip(at, now - widths, now + widths))  # fmt: skip
        found.append(at)
    return np.moveaxis(np.mean(found, axis=-1), 0, -1)[..., np.cumsum(changes) - 1]


def _with_width(u: np.ndarray, law: str, widths: np.ndarray, place: float) -> np.ndarray:
    """Inputs that a law hands on at each width, and changes with it, shape (widths, rows, 2)."""
    at = moved(u, law, widths, place)
    if law == "stop":
        return np.stack([at, 0.0 * at], axis=2)
    wider, closer = (moved(u, law, widths * np.exp(s), place) for s in (BETWEEN, -BETWEEN))
    return np.stack([at, 0.5 * (wider - closer)], axis=2)


class _Candidates(NamedTuple):
    """Laws of the inputs at each delay, no law first; and terms of a fuller response, without one.

    Attributes
    ----------
    names : list of str
        Kind, input and half width of each law at one delay; empty of none.
    prior : array, shape (a,)
        Prior of each law at each delay, at even odds of a law: even over its kinds, the widths of
        one, the delays. Laws that a gain and a level stand for have none.
    inputs : list of array, shape (a + terms, samples, inputs, 2)
        Inputs of each run behind each, and how they change with its width.
    terms : list of array, shape (a + terms, readings)
        What is added to the output of each run, zero for laws.
    """

    names: list[str]
    prior: np.ndarray
    inputs: list[np.ndarray]
    terms: list[np.ndarray]


def shorter(delay: float) -> list[float]:
    """A delay that was found, and the shorter ones that a law may stand for."""
    whole = int(np.ceil(delay))
    return [delay, *range(max(0, whole - LATE), whole)]


def _candidates(
    runs: Sequence[Run], seen: PreparedOutput, delays: Sequence[float], more: Sequence[np.ndarray]
) -> _Candidates:
    plain = [np.stack(list(run.inputs.values()), axis=1) for run in runs]
    names, kinds = [""], [""]
    behind = [[np.stack([u, 0.0 * u], axis=2)] for u in plain]
    ends = zip(seen.inputs, seen.points.min(axis=0), seen.points.max(axis=0), strict=True)
    for i, (name, low, high) in enumerate(ends):
        design = np.concatenate([np.stack([u[:, i], np.ones(len(u))], axis=1) for u in plain])
        places = [0.0] if low < 0 < high else low + PLACES * (high - low)
        shapes = [(law, at) for law in LAWS for at in (places if law == "dead zone" else [0.0])]
        for law, at in shapes:
            widths = LAWS[law] * (high - low)
            turned = [_with_width(u[:, i], law, widths, at) for u in plain]
            whole = np.concatenate([v[..., 0] for v in turned], axis=1).T
            rest = whole - design @ np.linalg.lstsq(design, whole, rcond=1e-10)[0]
            size = np.linalg.norm(whole - whole.mean(axis=0), axis=0)
            kinds += np.where(np.linalg.norm(rest, axis=0) > SAME * size, law, "same").tolist()
            names += [f"a {law} of {name} by ±{w:.2g}" for w in widths]
            for each, t in zip(behind, turned, strict=True):
                every = np.repeat(each[:1], len(t), axis=0)
                every[:, :, i] = t
                each += list(every)
    alike = Counter(kinds)
    some = max(len(alike.keys() - {"", "same"}), 1)
    odds = {kind: 1.0 / (some if kind else 1) / count for kind, count in alike.items()}
    prior = [(odds | {"same": 0.0})[kind] for kind in kinds]
    unit = np.sqrt(np.mean(np.concatenate(more) ** 2, axis=0)) / seen.size_y
    unit, terms = np.where(unit > 0, unit, 1.0), more[0].shape[1]
    inputs, added = [], []
    for run, each, x in zip(seen.runs, behind, more, strict=True):
        flat = np.array(each).reshape(len(each), len(each[0]), -1)
        late = [np.stack([delayed(u, delay) for u in flat]) for delay in delays]
        late = [np.repeat(u, len(run.u) // u.shape[1], axis=1) for u in late]
        late = np.concatenate([*late, np.repeat(late[0][:1], terms, axis=0)])
        inputs.append(late.reshape(*late.shape[:2], *each[0].shape[1:]))
        added.append(np.concatenate([np.zeros((len(each) * len(delays), len(x))), (x / unit).T]))
    return _Candidates(names, np.tile(prior, len(delays)) / len(delays), inputs, added)


@partial(jax.jit, static_argnums=0)
def _triangles(chosen: Any, model: Any, run: Driven, data: Any, theta: Any, u: Any, noise: Any):
    """Triangular factors of slopes and residuals of each law, and log volumes, by each noise.

    `data` are readings, their times, their errors, and what is added; `noise` all that
    are looked at, which of them first, and how many. The last number is the share of what is added,
    or by how much the width of a law is another.
    """
    y, time, error, term = data
    every, order, count = noise

    def one(theta, u, term):
        def output(t):
            own = replace(run, u=u[..., 0] + t[-1] * u[..., 1])
            return predicted(tree.replace(model, chosen, t[:-1]), own) + t[-1] * term

        return with_slope(output, theta)

    value, slope = jax.vmap(one)(theta, u, term)
    rows = jnp.concatenate([slope, (value - y)[..., None]], axis=2)[:, :MOST]
    rows = rows / error[:MOST, None]
    rows = jnp.swapaxes(jnp.clip(jnp.nan_to_num(rows, nan=VAST), -VAST, VAST), 0, 1)

    def whiten(k, found):
        at = order[k]
        white, volume = innovations(rows, time[:MOST], jax.tree.map(lambda v: v[at], every))
        triangle = jnp.linalg.qr(jnp.swapaxes(white, 0, 1), mode="r")
        return found[0].at[at].set(triangle), found[1].at[at].set(-volume)

    size = len(order), len(theta), *[rows.shape[2]] * 2
    return jax.lax.fori_loop(0, count, whiten, (jnp.zeros(size), jnp.full(len(order), -jnp.inf)))


class _LawFits(NamedTuple):
    """Laws to be fitted beside the fit without one, each under every noise of a grid."""

    found: Settled
    seen: PreparedOutput
    candidates: _Candidates
    grid: CorrelatedNoise

    @property
    def begin(self) -> np.ndarray:
        """The numbers without a law, and the share of a term."""
        return np.append(self.found.fit.theta, 0.0)

    @property
    def near(self) -> list[int]:
        """Raw numbers with a prior of width 1: the logarithm of a time constant, what a damping is
        made of, the share of a term or the change of a width. A law may take them to where nothing
        tells them.
        """
        powers = self.seen.runs[0].physics.units(len(self.seen.inputs))
        names = [v.name for v in self.found.fit.variables]
        return [names.index(f"map[{k}]") for k, (_, gain) in enumerate(powers)
                if not gain and f"map[{k}]" in names] + [len(names)]  # fmt: skip

    def whitened(self, theta: np.ndarray, noises: Sequence[int]) -> Whitened:
        """Rows of every law by some noises, in this order: one of them is one of the grid."""
        seen, core, g = self.seen, self.found.fit.problem.core, len(self.grid.time)
        order = np.array([*noises, *range(g - len(noises))])
        triangles, volume, count = [], 0.0, 0
        for run, *data, term, u in zip(
            seen.runs, seen.measured, seen.time,
            [noise.each for (noise,) in self.found.noise], self.candidates.terms, self.candidates.inputs, strict=True,
        ):  # fmt: skip
            noise = self.grid, order, len(noises)
            each = _triangles(core.chosen, core.model, run, (*data, term), theta, u, noise)
            triangles.append(np.asarray(each[0]))
            volume, count = volume + np.asarray(each[1]), count + min(len(data[0]), MOST)
        prior = np.eye(len(self.begin))[self.near]
        away = (theta - self.begin) @ prior.T
        known = np.concatenate([np.tile(prior, (len(theta), 1, 1)), away[..., None]], axis=2)
        both = np.concatenate([*triangles, np.tile(known, (g, 1, 1, 1))], axis=2)
        noise = CorrelatedNoise(*np.repeat(np.array(self.grid), len(theta), axis=1))
        both, volume = both.reshape(-1, *both.shape[2:]), np.repeat(volume, len(theta))
        return Whitened(noise, both, volume, count + len(prior))

    def fitted(self) -> np.ndarray:
        """The numbers of each law, by Gauss-Newton steps that lower -2 ln L.

        The first step is by the noise that is likeliest with each law, further ones by the `FEW`
        that are so with the likeliest laws.
        """
        count, noises = len(self.candidates.inputs[0]), range(len(self.grid.time))
        best, each = np.tile(self.begin, (count, 1)), np.arange(count)
        step, least = np.zeros_like(best), np.full(count, np.inf)
        for _ in range(ROUNDS):
            white = self.whitened(best + step, noises)
            memory, squares = white.memory(), np.sum(white.triangle[..., -1] ** 2, axis=1)
            now, after = (_minus(white, s).reshape(-1, count) for s in (squares, memory.squares))
            likeliest = after.argmin(axis=0)
            further = memory.step.reshape(-1, count, best.shape[1])[likeliest, each]
            better = now.min(axis=0) < least
            best = np.where(better[:, None], best + step, best)
            least = np.minimum(least, now.min(axis=0))
            step = np.where(better[:, None], further, 0.25 * step)
            noises = list(dict.fromkeys(likeliest[np.argsort(after.min(axis=0))]))[:FEW]
        return best


def _minus(white: Whitened, squares: np.ndarray) -> np.ndarray:
    """-2 ln L by each noise, up to a constant, of so large sums of squares."""
    return white.count * np.log(np.maximum(squares, np.finfo(float).tiny)) - 2.0 * white.volume


def _moments(memory: Memory, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Likelihood of each law, the mean of its steps over noises, and the covariance."""
    weight = np.maximum(memory.weight, np.finfo(float).tiny).reshape(-1, count)
    share, step = weight / weight.sum(axis=0), memory.step.reshape(*weight.shape, -1)
    half = memory.half.reshape(*weight.shape, *memory.half.shape[1:])
    size = (memory.squares / memory.dof).reshape(weight.shape)
    mean = np.einsum("ga,gap->ap", share, step)
    spread = np.einsum("ga,gapr,gaqr->apq", share * size, half, half, optimize=True)
    away = step - mean
    spread += np.einsum("ga,gap,gaq->apq", share, away, away, optimize=True)
    return weight.sum(axis=0), mean, spread


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
    grid = noises_of(seen.time, CORRELATION_TIMES, WHITE)
    candidates = _candidates(runs, seen, delays, more)
    laws = _LawFits(found, seen, candidates, CorrelatedNoise(*np.array(grid).T))
    at, count = laws.fitted(), len(candidates.prior)
    memory = laws.whitened(at, range(len(grid))).memory()
    likelihood, mean, spread = _moments(memory, len(at))
    fuller, chance = likelihood[count:].mean(), likelihood[:count] * candidates.prior
    none = np.arange(count) % len(candidates.names) == 0
    law = float(chance[~none].sum())
    best = candidates.names[int(np.argmax(np.where(none, -1.0, chance))) % len(candidates.names)]
    chance /= chance.sum()
    return LawEvidence(
        float(chance[none].sum()),
        float(fuller / (fuller + law)),
        best,
        chance[~none],
        (at + mean - laws.begin)[:count, :-1][~none],
        spread[:count, :-1, :-1][~none],
    )
