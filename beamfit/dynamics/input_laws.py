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
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit, logsumexp

from beamfit.dynamics.checks import RunSlopes, slow_paths
from beamfit.dynamics.model import Driven, PreparedOutput, delayed, predicted
from beamfit.dynamics.record import Run
from beamfit.dynamics.search import Settled, noises_of
from beamfit.greybox import tree
from beamfit.greybox.problem import with_slope
from beamfit.noise.correlated import Whitened
from beamfit.noise.memory import CorrelatedNoise, innovations

# Laws, and half widths of each as shares of an input's range: prior flat in their logarithm. A stop
# hands on other values as soon as its width passes a move. The others change smoothly with it, so
# that it is a number to be fitted, with a prior about each of these as wide as half their distance.
# A saturation leaves this share of the range on one side of its place, flat in the logarithm of
# what is cut off. A square law bends up or down; as wide as the range it is a square from one end.
LAWS = {law: np.geomspace(0.005, 0.4, count) for law, count in
        (("play", 8), ("hysteresis", 8), ("stop", 24), ("shift", 8), ("dead zone", 8))}  # fmt: skip
LAWS |= {
    "saturation": 1.0 - np.geomspace(0.02, 0.9, 8),
    "square law": np.outer((1.0, -1.0), np.geomspace(0.1, 50.0, 8)).ravel(),
}
# Places in the range about which a law lies, as shares of it: prior flat. A dead zone of a range
# with 0 lies there; a saturation about an end of the range is one of the other end.
PLACES = {
    "dead zone": (0.1, 0.3, 0.5, 0.7, 0.9),
    "saturation": (0.0, 0.5, 1.0),
    "square law": (0.5,),
}
# Laws of the value alone, whatever came before.
STATIC = tuple(PLACES)
# Probability of the laws that are named, where several are possible.
NAMED = 0.99
# Parts of a law's width and of its place that are looked at between neighbours, how many times, and
# how many that makes at most.
FINER, ZOOMS = 5, 2
MOST_FINER = FINER**2
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
        The likeliest kind of law in words, or those that make 99 % with their probabilities.
    static : bool
        Whether the likeliest law is one of the value alone.
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
    static: bool
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
    about a place, a saturation leaves what is about one, and a square law bends about one.
    """
    half = np.asarray(width)[..., None]
    if law == "dead zone":
        return u - np.clip(u - place, -half, half)
    if law == "saturation":
        return place + np.clip(u - place, -half, half)
    if law == "square law":
        return u + (u - place) ** 2 / half
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


class InputLaw(NamedTuple):
    """A law of an input that goes from `low` to `high`, as wide as `width` about `place`.

    `step` is half the distance to the next width, in the logarithm, and the width of a prior about
    this one; `stride` half the distance to the next place.
    """

    kind: str
    input: str
    width: float
    step: float
    place: float
    stride: float
    low: float
    high: float

    def changed(self, change: float) -> InputLaw:
        """The law `change` steps wider; a dead zone to an end of the range is a saturation."""
        law = self._replace(width=self.width * float(np.exp(change * self.step)))
        ends = law.place - law.width, law.place + law.width
        if law.kind == "dead zone" and ends[1] >= law.high > ends[0] > law.low:
            return law._replace(kind="saturation", place=law.low, width=ends[0] - law.low)
        if law.kind == "dead zone" and ends[0] <= law.low < ends[1] < law.high:
            return law._replace(kind="saturation", place=law.high, width=law.high - ends[1])
        return law

    def finer(self, change: float) -> list[InputLaw]:
        """Laws between this one, `change` steps wider, and those next to it."""
        at = np.linspace(-1.0, 1.0, FINER + 1)
        at = 0.5 * (at[1:] + at[:-1])
        widths = self.width * np.exp(self.step * (change + at))
        places = self.place + self.stride * at if self.stride else [self.place]
        less = {"step": self.step / FINER, "stride": self.stride / FINER}
        return [self._replace(width=float(w), place=float(p), **less)
                for p in places for w in widths]  # fmt: skip

    def words(self) -> str:
        """The law in words."""
        width, name = self.width, self.input
        if self.kind == "saturation":
            ends = self.place - width, self.place + width
            below = [f"below {ends[0]:.3g}"] if ends[0] > self.low else []
            above = [f"above {ends[1]:.3g}"] if ends[1] < self.high else []
            return f"a saturation of {name} {' and '.join(below + above)}"
        if self.kind == "square law":
            ends = 1.0 + np.array([-1.0, 1.0]) * (self.high - self.low) / width
            return f"a square law of {name} (gain {ends[0]:.2g} to {ends[1]:.2g} of its mean)"
        about = f" about {self.place:.3g}" if self.kind in STATIC else ""
        return f"a {self.kind} of {name} by ±{width:.2g}{about}"


class _Trial(NamedTuple):
    """A law, or none, at a delay, with the logarithm of its prior."""

    law: InputLaw | None
    delay: float
    prior: float


def shorter(delay: float) -> list[float]:
    """A delay that was found, and the shorter ones that a law may stand for."""
    whole = int(np.ceil(delay))
    return [delay, *range(max(0, whole - LATE), whole)]


def _laws(name: str, low: float, high: float) -> list[InputLaw]:
    """The laws that are looked at of an input with this range."""
    found = []
    for kind, shares in LAWS.items():
        at_zero = kind not in PLACES or (kind == "dead zone" and low < 0 < high)
        places = [0.0] if at_zero else low + np.array(PLACES[kind]) * (high - low)
        stride = 0.5 * (places[1] - places[0]) if len(places) > 1 else 0.0
        apart = np.abs(np.diff(np.log(np.abs(shares))))
        near = 0.5 * np.minimum(np.append(apart, np.inf), np.append(np.inf, apart))
        for place in places:
            ended = kind == "saturation" and place in (low, high)
            reach = max(place - low, high - place) if kind == "saturation" else high - low
            found += [
                InputLaw(kind, name, w * reach, 0.0 if kind == "stop" else float(step),
                         float(place), 0.0 if ended else float(stride), low, high)
                for w, step in zip(shares, near, strict=True)
            ]  # fmt: skip
    return found


# Inputs of each run behind a law and their changes by a step of its width, (rows, inputs, 2).
Behind = dict[InputLaw | None, list[np.ndarray]]


def _behind(runs: Sequence[Run], laws: Sequence[InputLaw]) -> Behind:
    """Inputs behind no law and each of some."""
    inputs = list(runs[0].inputs)
    plain = [np.stack(list(run.inputs.values()), axis=1) for run in runs]
    found: Behind = {None: [np.stack([u, 0.0 * u], axis=2) for u in plain]}
    for (kind, place, name), group in groupby(laws, lambda law: (law.kind, law.place, law.input)):
        alike, k = list(group), inputs.index(name)
        width, step = np.array([(law.width, law.step) for law in alike]).T
        widths = width * np.exp(np.multiply.outer([0.0, 1.0, -1.0], step))
        for law in alike:
            found[law] = [u.copy() for u in found[None]]
        for i, u in enumerate(plain):
            at, wider, closer = moved(u[:, k], kind, widths, place)
            for law, *turned in zip(alike, at, 0.5 * (wider - closer), strict=True):
                found[law][i][:, k] = np.stack(turned, axis=1)
    return found


def _is_none(behind: Behind, law: InputLaw, k: int) -> bool:
    """True if a gain and a level stand for a law of input k, from its first change on: what was
    before is a number at the start.
    """
    since = [np.argmax(u[:, k, 0] != u[0, k, 0]) for u in behind[None]]
    u, at = (
        np.concatenate([each[row:, k, 0] for each, row in zip(behind[of], since, strict=True)])
        for of in (None, law)
    )
    design = np.stack([u, np.ones(len(u))], axis=1)
    rest = at - design @ np.linalg.lstsq(design, at, rcond=1e-10)[0]
    return bool(np.linalg.norm(rest) <= SAME * np.linalg.norm(at - at.mean()))


def _trials(behind: Behind, inputs: Sequence[str], delays: Sequence[float]) -> list[_Trial]:
    """No law and every law at each delay, at even odds of a law: even over its kinds, the widths
    of one, the delays. Laws that a gain and a level stand for are none.
    """
    laws = [law for law in behind
            if law is not None and not _is_none(behind, law, inputs.index(law.input))]  # fmt: skip
    alike, each = Counter(law.kind for law in laws), -np.log(len(delays))
    priors = [each - np.log(len(alike) * alike[law.kind]) for law in laws]
    pairs = [(None, each), *zip(laws, priors, strict=True)]
    return [_Trial(law, delay, prior) for law, prior in pairs for delay in delays]


def _candidates(
    seen: PreparedOutput,
    behind: Behind,
    trials: Sequence[_Trial],
    more: Sequence[np.ndarray],
    count: int,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Inputs of each run behind each trial and their changes with its width, the first repeated
    until they are `count`, shape (count + terms, samples, inputs, 2); and what is added to the
    output, zero for laws, shape (count + terms, readings).
    """
    unit = np.sqrt(np.mean(np.concatenate(more) ** 2, axis=0)) / seen.size_y
    unit, inputs, terms = np.where(unit > 0, unit, 1.0), [], []
    for i, (run, x) in enumerate(zip(seen.runs, more, strict=True)):
        each = []
        for law, delay, _ in trials:
            u = behind[law][i]
            late = delayed(u.reshape(len(u), -1), delay)
            late = np.repeat(late, len(run.u) // len(late), axis=0)
            each.append(late.reshape(len(late), *u.shape[1:]))
        inputs.append(np.stack(each + [each[0]] * (count - len(each) + x.shape[1])))
        terms.append(np.concatenate([np.zeros((count, len(x))), (x / unit).T]))
    return inputs, terms


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
    """Laws and terms to be fitted beside the fit without one, each under every noise of a grid."""

    found: Settled
    seen: PreparedOutput
    grid: CorrelatedNoise
    inputs: list[np.ndarray]
    terms: list[np.ndarray]

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
        errors = [noise.each for (noise,) in self.found.noise]
        for run, *data, term, u in zip(
            seen.runs, seen.measured, seen.time, errors,
            self.terms, self.inputs, strict=True,
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
        count, noises = len(self.inputs[0]), range(len(self.grid.time))
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


class _Weighed(NamedTuple):
    """Trials with the logarithms of their likelihoods, their numbers, and the covariances."""

    trials: list[_Trial]
    log: np.ndarray
    numbers: np.ndarray
    spread: np.ndarray

    def first(self, count: int) -> _Weighed:
        """The first of them."""
        return _Weighed(self.trials[:count], *(each[:count] for each in self[1:]))

    @property
    def chance(self) -> np.ndarray:
        """Probability of each."""
        logs = self.log + np.array([trial.prior for trial in self.trials])
        return np.exp(logs - logsumexp(logs))

    @property
    def none(self) -> np.ndarray:
        """True for those without a law."""
        return np.array([trial.law is None for trial in self.trials])

    def best(self) -> dict[tuple[str, str], int]:
        """The likeliest law of the value alone, by kind and input."""
        logs = self.log + np.array([trial.prior for trial in self.trials])
        found: dict[tuple[str, str], int] = {}
        for k, (law, *_) in enumerate(self.trials):
            if law is not None and law.kind in STATIC:
                key = law.kind, law.input
                found[key] = k if logs[k] > logs[found.get(key, k)] else found.get(key, k)
        return found

    def with_finer(self, at: int, other: _Weighed) -> _Weighed:
        """These with others in the place of one."""
        parts = zip(self[1:], other[1:], strict=True)
        trials = self.trials[:at] + self.trials[at + 1 :] + other.trials
        return _Weighed(trials, *(np.concatenate([np.delete(a, at, 0), b]) for a, b in parts))


def _weighed(laws: _LawFits, trials: list[_Trial]) -> _Weighed:
    """Fit trials, and terms if there are more candidates, with numbers and noise integrated out."""
    at, grid = laws.fitted(), len(laws.grid.time)
    white = laws.whitened(at, range(grid))
    memory, logs = white.memory(), -0.5 * white.evidences().reshape(grid, -1)
    likelihood = logsumexp(logs, axis=0)
    share, step = np.exp(logs - likelihood), memory.step.reshape(*logs.shape, -1)
    half = memory.half.reshape(*logs.shape, *memory.half.shape[1:])
    size = (memory.squares / memory.dof).reshape(logs.shape)
    mean = np.einsum("ga,gap->ap", share, step)
    spread = np.einsum("ga,gapr,gaqr->apq", share * size, half, half, optimize=True)
    away = step - mean
    spread += np.einsum("ga,gap,gaq->apq", share, away, away, optimize=True)
    return _Weighed(trials, likelihood, at + mean, spread)


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
    paths, bent = zip(slow_paths(seen), slopes, strict=True), _bent(seen)
    more = [np.concatenate([slow, each.changing[:, ~bent]], axis=1) for slow, each in paths]
    grid = CorrelatedNoise(*np.array(noises_of(seen.time, CORRELATION_TIMES, WHITE)).T)

    def weighed(behind: Behind, trials: list[_Trial], terms: Any, count: int) -> _Weighed:
        candidates = _candidates(seen, behind, trials, terms, count)
        return _weighed(_LawFits(found, seen, grid, *candidates), trials)

    ends = zip(seen.inputs, seen.points.min(axis=0), seen.points.max(axis=0), strict=True)
    behind = _behind(runs, [law for each in ends for law in _laws(*each)])
    trials = _trials(behind, seen.inputs, delays)
    whole = weighed(behind, trials, more, len(trials))
    posterior, terms = whole.first(len(trials)), whole.log[len(trials) :]
    law = logsumexp((posterior.log + [t.prior for t in trials])[~posterior.none])
    fuller = expit(logsumexp(terms) - np.log(len(terms)) - law)
    if posterior.chance[posterior.none].sum() < 0.5:
        nothing = [term[:, :0] for term in more]
        for _ in range(ZOOMS):
            for kind in posterior.best():
                at = posterior.best()[kind]
                law, delay, prior = posterior.trials[at]
                laws = law.finer(posterior.numbers[at, -1])
                finer = [_Trial(each, delay, prior - np.log(len(laws))) for each in laws]
                other = weighed(_behind(runs, laws), finer, nothing, MOST_FINER)
                posterior = posterior.with_finer(at, other.first(len(finer)))
    chance, none = posterior.chance, posterior.none
    words, static = _named(posterior)
    begin = np.append(found.fit.theta, 0.0)
    return LawEvidence(
        float(chance[none].sum()),
        float(fuller),
        words,
        static,
        chance[~none],
        (posterior.numbers - begin)[~none, :-1],
        posterior.spread[~none, :-1, :-1],
    )


def _named(posterior: _Weighed) -> tuple[str, bool]:
    """The likeliest law of each kind and input in words, as many as make 99 % of all laws, and if
    the first is one of the value alone.
    """
    best: dict[tuple[str, str], tuple[float, InputLaw]] = {}
    whole: Counter[tuple[str, str]] = Counter()
    for (begun, *_), p, numbers in zip(
        posterior.trials, posterior.chance, posterior.numbers, strict=True
    ):
        if begun is not None:
            law = begun.changed(numbers[-1])
            kind = law.kind, law.input
            whole[kind] += float(p)
            best[kind] = max(best.get(kind, (0.0, law)), (float(p), law), key=lambda each: each[0])
    if not whole:
        return "", False
    total = max(sum(whole.values()), np.finfo(float).tiny)
    ranked = [(kind, p / total) for kind, p in whole.most_common()]
    above = np.cumsum([0.0, *(p for _, p in ranked)])[:-1]
    ranked = [each for each, before in zip(ranked, above, strict=True) if before < NAMED]
    words = [best[kind][1].words() for kind, _ in ranked]
    if len(words) > 1:
        words = [f"{w} (P = {p:.2f})" for w, (_, p) in zip(words, ranked, strict=True)]
    return " or ".join(words), ranked[0][0][0] in STATIC


def _bent(seen: PreparedOutput) -> np.ndarray:
    """True for the terms of a fuller response that are static laws: gains by their own input."""
    m = len(seen.inputs)
    gains = [power for _, power in seen.runs[0].physics.units(m)]
    number = np.cumsum(gains) - 1
    own = [gain and k % m == number[i] % m for i, gain in enumerate(gains) for k in range(2 * m)]
    return np.array(own, bool)
