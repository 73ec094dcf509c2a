"""Alternatives of what stands between the inputs and an output, compared by one evidence.

Inputs are held from sample to sample or move between, pass a law or none, and come late by whole
samples or by a part of one; the response may have one more term. Each is fitted under every noise
of a grid, white or wandering, and weighed by its likelihood with the numbers and the noise
integrated out: a noise that wanders takes for its own what a law leaves, and gains are then far
off. The likeliest is named, and what stays open goes into errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp

from beamfit.dynamics.checks import SLOW, paths_by, slow_lags, slow_paths
from beamfit.dynamics.input_laws import STATIC, InputLaw, laws_between
from beamfit.dynamics.model import Driven, PreparedOutput, filled, growing_of, predicted
from beamfit.dynamics.paths import Path, Paths, Undriven, handed_on, undriven
from beamfit.dynamics.record import Run, Way
from beamfit.dynamics.response import ARX
from beamfit.dynamics.search import Begun, drift_columns, noises_of, shape_of, spanned
from beamfit.greybox import tree
from beamfit.greybox.problem import with_slope
from beamfit.noise.correlated import Whitened, roots_by_each
from beamfit.noise.memory import CorrelatedNoise
from beamfit.statistics import MIN_SINGULAR_VALUE

# Correlation times and white variances of the noises that each is fitted with, and most readings.
CORRELATION_TIMES, WHITE, MOST = 6, (0.0, 1.0, 10.0, 100.0), 2048
# Odds that a response has no more terms than the model that was asked for: a guess.
FULLER = 10.0
# Probability of the laws that are named, where several are possible.
NAMED = 0.99
# How many times a law of the value alone is looked at in finer steps.
ZOOMS = 2
# Share of what a law hands on that no gain and level give, below which it is none.
SAME = 1e-6
# Largest residual, of a step that went astray.
VAST = 1e100
# Gauss-Newton rounds of all, and of the `MANY` that are likeliest then; every how many-th noise of
# the grid the first one looks at, and how many the others.
FIRST, MANY, ROUNDS, SPREAD, FEW = 2, 128, 3, 3, 4
# Shorter delays that a law may stand for.
LATE = 3
# Below this probability an alternative moves no end of a 95 % interval, however far off it is.
LEAST = 1e-5
# Alternatives that are fitted at once: one program is compiled for all.
BATCH = 64


# Kinds of departures that are no laws of an input.
FURTHER, GROWTH = "further term", "growth"


class Departure(NamedTuple):
    """A law of an input, a term of a fuller response, or something that grows along the record,
    beside a response. In words, by its kind, and its probability where no departure and
    these are all that can be.
    """

    words: str
    kind: str
    probability: float = 0.0

    def grown(self, share: float) -> Departure:
        """The same with the amount by which it grows."""
        if self.kind != GROWTH:
            return self
        by, unit = (share, "samples") if self.words == "a delay" else (100.0 * share, "%")
        way = "grows" if by > 0 else "falls"
        return self._replace(words=f"{self.words} that {way} by about {abs(by):.2g} {unit}")


NONE = Departure("", "")
# Departures by the columns of `growing_of`: a delay grows by a sample, a gain by itself.
GROWING = [Departure("a delay", GROWTH), Departure("a gain", GROWTH)]


class Trial(NamedTuple):
    """A path, the logarithm of its prior, and the number of a further term of the response."""

    path: Path
    prior: float
    term: int | None = None

    @property
    def lawful(self) -> bool:
        """True for a law or a further term."""
        return self.path.law is not None or self.term is not None


class Alternatives(NamedTuple):
    """Posterior over what may stand between the inputs and an output.

    Attributes
    ----------
    path : Path
        The likeliest one without a law; that of the fit where it contains it.
    late, ahead : float
        Standard deviation of the delay about that of the fit, in samples, and the probability that
        it is below zero, without a law.
    departure : Departure
        The likeliest law or further term, or those that make 99 % with their probabilities.
    weight : array, shape (a,)
        Probability of each alternative to the answer.
    shift : array, shape (a, p)
        The numbers of the fit with each, less those of the answer.
    covariance : array, shape (a, p, p)
        Of the numbers, with each.
    """

    path: Path
    late: float
    ahead: float
    departure: Departure
    weight: np.ndarray
    shift: np.ndarray
    covariance: np.ndarray

    def error(self, slopes: np.ndarray, alone: np.ndarray) -> np.ndarray:
        """Errors of quantities by their slopes, shape (..., p), about the value of the answer.

        `alone` has the errors without alternatives.
        """
        slopes = slopes[..., : self.shift.shape[1]]  # a delay is that of each path
        spread = np.einsum("...p,apq,...q->...a", slopes, self.covariance, slopes)
        others = (spread + (slopes @ self.shift.T) ** 2) @ self.weight
        return np.sqrt(max(1.0 - self.weight.sum(), 0.0) * alone**2 + others)


@partial(jax.jit, static_argnums=0)
def _columns(chosen: Any, model: Any, run: Driven, data: Any, theta: Any, u: Any):
    """Slopes and residuals of each trial: columns at right angles, and the triangle they make.

    `data` are readings, their errors, what is added, and the parts of a row in delays with their
    widths. The last number is the share of what is added, by how much the width of a law is
    another, or in widths the delay.
    """
    y, error, term, late = data

    def one(theta, u, term, late):
        def output(t):
            part, width = late
            own = replace(run, u=u[..., 0] + t[-1] * u[..., 1], part=part + t[-1] * width)
            return predicted(tree.replace(model, chosen, t[:-1]), own) + t[-1] * term

        return with_slope(output, theta)

    value, slope = jax.vmap(one)(theta, u, term, late)
    rows = jnp.concatenate([slope, (value - y)[..., None]], axis=2)
    return jnp.linalg.qr(jnp.clip(jnp.nan_to_num(rows, nan=VAST), -VAST, VAST) / error[:, None])


class _Batch(NamedTuple):
    """Trials to be fitted, each under every noise of a grid: their inputs and terms, by run, and
    the parts of a row in their delays with their widths.
    """

    comparison: Comparison
    inputs: list[np.ndarray]
    late: tuple[np.ndarray, np.ndarray]
    terms: list[np.ndarray]

    def whitened(self, theta: np.ndarray, noises: Sequence[int]) -> Whitened:
        """Rows of every trial by some noises of the grid."""
        c, some = self.comparison, [self.comparison.grid[k] for k in noises]
        triangles, volume, count = [], 0.0, 0
        for run, data, term, u in zip(c.seen.drives, c.data, self.terms, self.inputs, strict=True):
            y, time, error = data
            found = _columns(c.chosen, c.model, run, (y, error, term, self.late), theta, u)
            columns, triangle = map(np.asarray, found)
            columns = np.swapaxes(columns[:, : len(time)], 0, 1)
            roots, each = roots_by_each(some, columns, np.diff(time))
            triangles.append(roots @ triangle)
            volume, count = volume + each, count + len(time)
        prior = np.eye(len(c.begin))[c.near]
        away = (theta - c.begin) @ prior.T
        known = np.concatenate([np.tile(prior, (len(theta), 1, 1)), away[..., None]], axis=2)
        both = np.concatenate([*triangles, np.tile(known, (len(some), 1, 1, 1))], axis=2)
        return by_each(some, both, volume, count + len(prior))

    def fitted(self, begin: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of each trial, by Gauss-Newton steps that lower -2 ln L, and its least.

        The first step is by the noise of a few that is likeliest with each trial, further ones by
        the `FEW` that are so with the likeliest trials.
        """
        count, noises = len(begin), np.arange(len(self.comparison.grid))[::SPREAD]
        best, each = begin, np.arange(count)
        step, least = np.zeros_like(best), np.full(count, np.inf)
        for _ in range(rounds):
            white = self.whitened(best + step, noises)
            memory, squares = white.memory(), np.sum(white.triangle[..., -1] ** 2, axis=1)
            now, after = (_minus(white, s).reshape(-1, count) for s in (squares, memory.squares))
            likeliest = after.argmin(axis=0)
            further = memory.step.reshape(-1, count, best.shape[1])[likeliest, each]
            better = now.min(axis=0) < least
            best = np.where(better[:, None], best + step, best)
            least = np.minimum(least, now.min(axis=0))
            step = np.where(better[:, None], further, 0.25 * step)
            ranked = noises[likeliest[np.argsort(after.min(axis=0))]]
            noises = np.array(list(dict.fromkeys(ranked))[:FEW])
        return best, np.minimum(least, after.min(axis=0))

    def weighed(self, begin: np.ndarray) -> tuple[np.ndarray, ...]:
        """Log evidence, numbers and covariances of each trial, numbers and noise integrated out."""
        (at, _), grid = self.fitted(begin, ROUNDS), len(self.comparison.grid)
        likelihood, mean, spread, _ = over_noises(self.whitened(at, range(grid)), grid)
        return likelihood, at + mean, spread


def by_each(
    noises: Sequence[CorrelatedNoise], triangles: np.ndarray, volume: np.ndarray, count: int
) -> Whitened:
    """Trials by each noise, shape (noises, trials, rows, columns), in one row."""
    trials = triangles.shape[1]
    noise = CorrelatedNoise(*np.repeat(np.array(noises).T, trials, axis=1))
    each = triangles.reshape(-1, *triangles.shape[2:])
    return Whitened(noise, each, np.repeat(volume, trials), count)


def over_noises(white: Whitened, grid: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Log evidence of each trial by so many noises in turn, its step and the covariance with the
    noise integrated out, and the degrees of freedom.
    """
    memory, logs = white.weighed()
    logs = logs.reshape(grid, -1)
    likelihood = logsumexp(logs, axis=0)
    share, step = np.exp(logs - likelihood), memory.step.reshape(*logs.shape, -1)
    half = memory.half.reshape(*logs.shape, *memory.half.shape[1:])
    size = (memory.squares / memory.dof).reshape(logs.shape)
    mean = np.einsum("ga,gap->ap", share, step)
    spread = np.einsum("ga,gapr,gaqr->apq", share * size, half, half, optimize=True)
    away = step - mean
    spread += np.einsum("ga,gap,gaq->apq", share, away, away, optimize=True)
    return likelihood, mean, spread, memory.dof


def _minus(white: Whitened, squares: np.ndarray) -> np.ndarray:
    """-2 ln L by each noise, up to a constant, of so large sums of squares."""
    return white.count * np.log(np.maximum(squares, np.finfo(float).tiny)) - 2.0 * white.volume


class _Weighed(NamedTuple):
    """Trials with the logarithms of their likelihoods, their numbers, and the covariances."""

    trials: list[Trial]
    log: np.ndarray
    numbers: np.ndarray
    spread: np.ndarray

    def where(self, kept: np.ndarray) -> _Weighed:
        """Some of them."""
        trials = [trial for trial, keep in zip(self.trials, kept, strict=True) if keep]
        return _Weighed(trials, *(each[kept] for each in self[1:]))

    def beside(self, other: _Weighed) -> _Weighed:
        """These and others."""
        parts = zip(self[1:], other[1:], strict=True)
        return _Weighed(self.trials + other.trials, *(np.concatenate(pair) for pair in parts))

    @property
    def logs(self) -> np.ndarray:
        """Logarithm of the probability of each, up to a constant."""
        return self.log + np.array([trial.prior for trial in self.trials])

    @property
    def chance(self) -> np.ndarray:
        """Probability of each."""
        return np.exp(self.logs - logsumexp(self.logs))

    @property
    def none(self) -> np.ndarray:
        """True for those without a law or a further term."""
        return np.array([not trial.lawful for trial in self.trials])

    def late(self, about: float) -> tuple[float, float]:
        """Standard deviation of the delay about one, and the probability that it is below zero."""
        paths = [trial.path for trial in self.trials]
        delays, width = np.array([(path.delay, path.width) for path in paths]).T
        away = delays + width * self.numbers[:, -1] - about
        squares = away**2 + width**2 * self.spread[:, -1, -1]
        return float(np.sqrt(self.chance @ squares)), float(self.chance @ (delays < 0))

    def best(self) -> dict[tuple[str, str], int]:
        """The likeliest law of the value alone, by kind and input."""
        laws = [(int(k), self.trials[k].path.law) for k in np.argsort(self.logs)]  # the last stays
        return {(law.kind, law.input): k for k, law in laws if law and law.kind in STATIC}


class Comparison(NamedTuple):
    """A fit that alternatives are compared with: its runs, readings, numbers and noises.

    `data` are readings, their times and errors, by run, readings and errors padded; `begin` the
    numbers of the fit without its delay and, last, a share of nothing; `near` those that have a
    prior of width 1: the logarithm of a time constant, what a damping is made of, the share of a
    term or the change of a width. An alternative may take them to where nothing tells them.
    """

    runs: tuple[Run, ...]
    seen: Undriven
    data: list[tuple[np.ndarray, ...]]
    parts: int
    chosen: tuple[Any, ...]
    model: Any
    begin: np.ndarray
    near: list[int]
    grid: list[CorrelatedNoise]
    terms: list[np.ndarray]
    names: list[Departure]

    @classmethod
    def of(
        cls, runs: tuple[Run, ...], found: Begun, paths: Paths, slopes: Sequence[np.ndarray]
    ) -> Comparison:
        """Prepare the fit of runs; `slopes` are those of `changing_of`."""
        seen, fit = found.seen, found.settled.fit
        physics, delay = seen.runs[0].physics, found.path.delay
        whole = undriven(runs, seen.output, physics, paths.parts, delay, MOST)
        drives = whole.drives
        errors = [noise.each[:MOST] for (noise,) in found.settled.noise]
        data = [
            (filled(drive, y), time[:MOST], filled(drive, error, np.inf))
            for drive, y, time, error in zip(drives, whole.measured, seen.time, errors, strict=True)
        ]
        names, more = _terms(found, slopes)
        terms = [filled(drive, each.T[:, :MOST]) for drive, each in zip(drives, more, strict=True)]
        numbers = [v.name for v in fit.variables if v.name != "late"]
        powers = physics.units(len(seen.inputs))
        near = [numbers.index(f"map[{k}]") for k, (_, gain) in enumerate(powers)
                if not gain and f"map[{k}]" in numbers] + [len(numbers)]  # fmt: skip
        core = fit.problem.core
        chosen = tuple(leaf for leaf in core.chosen if leaf.path != "late")
        grid = noises_of(seen.time, CORRELATION_TIMES, WHITE)
        begin = np.append(fit.theta[: len(numbers)], 0.0)
        model = core.model | {"late": jnp.zeros(())}
        return cls(runs, whole, data, paths.parts, chosen, model, begin, near, grid, terms, names)

    def weighed(self, trials: list[Trial]) -> _Weighed:
        """Weigh trials: those of no law, and the likeliest after a step or two from the fit."""
        begin = np.tile(self.begin, (len(trials), 1))
        if len(trials) > MANY:
            steps = [batch.fitted(each, FIRST) for batch, each in self._batches(trials, begin)]
            parts = zip(*steps, strict=True)
            begin, cost = (np.concatenate(part)[: len(trials)] for part in parts)
            cost -= [2.0 * t.prior if t.lawful else np.inf for t in trials]
            kept = np.argsort(cost)[:MANY]
            trials, begin = [trials[k] for k in kept], begin[kept]
        found = [batch.weighed(each) for batch, each in self._batches(trials, begin)]
        parts = (np.concatenate(part)[: len(trials)] for part in zip(*found, strict=True))
        return _Weighed(trials, *parts)

    def _batches(
        self, trials: list[Trial], begin: np.ndarray
    ) -> Iterator[tuple[_Batch, np.ndarray]]:
        """`BATCH` trials at once, the last ones repeated, and where they begin."""
        more = -len(trials) % BATCH
        trials, begin = trials + trials[-1:] * more, np.pad(begin, ((0, more), (0, 0)), mode="edge")
        for k in range(0, len(trials), BATCH):
            some = trials[k : k + BATCH]
            paths = [trial.path for trial in some]
            inputs, part = handed_on(self.runs, self.seen, self.parts, paths)
            terms = [np.stack([0.0 * each[0] if t.term is None else each[t.term] for t in some])
                     for each in self.terms]  # fmt: skip
            width = self.parts * np.array([path.width for path in paths])
            yield _Batch(self, inputs, (part, width), terms), begin[k : k + BATCH]


def alternatives_of(
    runs: tuple[Run, ...], found: Begun, paths: Paths, slopes: Sequence[np.ndarray], lawful: bool
) -> Alternatives:
    """Weigh every path and law of the inputs against those of a fit.

    `lawful` is False where no law, and no term of a fuller response, is looked for.
    """
    comparison = Comparison.of(runs, found, paths, slopes)
    own = found.path._replace(delay=found.exact)
    plain = paths.plain() + paths.around(own.delay)
    trials = [Trial(path, paths.log_prior(path)) for path in plain]
    if lawful:
        terms = len(comparison.terms[0])
        prior = paths.log_prior(own) - np.log(FULLER * terms)
        trials += _lawful(comparison, own, paths)
        trials += [Trial(own, prior, k) for k in range(terms)]
    posterior = comparison.weighed(trials)
    behind = np.array([trial.path.law is not None for trial in posterior.trials])
    if posterior.chance[behind].sum() > posterior.chance[posterior.none].sum():
        posterior = _finer(comparison, posterior)
    chance, none = posterior.chance, posterior.none
    others = ~none | [not found.contains(trial.path) for trial in posterior.trials]
    others &= chance > LEAST
    likeliest = posterior.trials[np.where(none, posterior.logs, -np.inf).argmax()].path
    return Alternatives(
        found.path if found.contains(likeliest) else likeliest,
        *posterior.where(none).late(found.exact),
        _named(posterior, comparison.names),
        chance[others],
        (posterior.numbers - comparison.begin)[others, :-1],
        posterior.spread[others, :-1, :-1],
    )


def _lawful(comparison: Comparison, own: Path, paths: Paths) -> list[Trial]:
    """Every law at even odds: over its kinds, the widths of one, and the paths.

    Delays are that of the fit and, where none is given, shorter ones that a law may stand for. Laws
    that a gain and a level stand for are none.
    """
    runs = comparison.runs
    delays, whole = [own.delay], int(np.ceil(own.delay))
    if not paths.given:
        delays += range(max(0, whole - LATE), whole)
    ways = [Path(None, way, float(delay)) for delay in delays for way in paths.ways]
    laws = [law for name in runs[0].inputs for law in _laws_of(runs, name, paths.most)]
    alike = Counter(law.kind for law in laws)
    return [
        Trial(way._replace(law=law), paths.log_prior(way) - np.log(len(alike) * alike[law.kind]))
        for law in laws for way in ways
    ]  # fmt: skip


def _laws_of(runs: Sequence[Run], name: str, way: Way) -> list[InputLaw]:
    """Laws of an input that a gain and a level do not stand for, from its first change on: what was
    before is a number at the start.

    Of readings that may scatter about levels these are what counts, but for their errors: a narrow
    saturation of two of them hides the scatter, and a dead zone about the middle one of three is
    undetermined. An input that stays where it is has none.
    """
    levels = [way.taken(run, name) for run in runs]
    inputs = [each.at for each in levels]
    since = [u[int(np.argmax(u != u[0])) :] for u in inputs]
    plain = np.concatenate(since)
    if np.ptp(plain) == 0.0:
        return []
    unsure = np.sqrt(sum(np.sum(each.variance[-len(u) :])
                         for each, u in zip(levels, since, strict=True)))  # fmt: skip
    laws = laws_between(name, *map(float, (min(map(np.min, inputs)), max(map(np.max, inputs)))))
    at = np.stack([
        np.concatenate([law.behind(u)[-len(some) :, 0]
                        for u, some in zip(inputs, since, strict=True)]) for law in laws
    ], axis=1)  # fmt: skip
    basis = np.linalg.qr(np.stack([np.ones(len(plain)), plain], axis=1))[0]
    at = at - at.mean(axis=0)
    same = basis @ (basis.T @ at)
    gain = np.linalg.norm(same, axis=0) / np.linalg.norm(plain - plain.mean())
    # Beside its gain a law hands errors on as they are, outside a dead zone.
    least = np.maximum(
        SAME * np.linalg.norm(at, axis=0), MIN_SINGULAR_VALUE * np.maximum(gain, 1.0) * unsure
    )
    bends = np.linalg.norm(at - same, axis=0) > least
    return [law for law, own in zip(laws, bends, strict=True) if own]


def _finer(comparison: Comparison, posterior: _Weighed) -> _Weighed:
    """The posterior with the likeliest laws of the value alone in finer steps."""
    for _ in range(ZOOMS):
        best, kept = posterior.best().values(), np.ones(len(posterior.trials), bool)
        trials: list[Trial] = []
        for at in best:
            path, prior, _ = posterior.trials[at]
            laws = path.law.finer(posterior.numbers[at, -1])
            trials += [Trial(path._replace(law=law), prior - np.log(len(laws))) for law in laws]
            kept[at] = False
        if trials:
            posterior = posterior.where(kept).beside(comparison.weighed(trials))
    return posterior


def _named(posterior: _Weighed, names: Sequence[Departure]) -> Departure:
    """The likeliest law of each kind and input, or further term, in words: as many as make 99 % of
    all, of the kind of the first, with the probability of any.
    """
    best: dict[Any, tuple[float, Departure]] = {}
    whole: Counter[Any] = Counter()
    for trial, p, numbers in zip(
        posterior.trials, posterior.chance, posterior.numbers, strict=True
    ):
        if not trial.lawful:
            continue
        if trial.term is not None:
            key, named = names[trial.term], names[trial.term].grown(numbers[-1])
        else:
            law = trial.path.law.changed(numbers[-1])
            key, named = (law.kind, law.input), Departure(law.words(), law.kind)
        whole[key] += float(p)
        best[key] = max(best.get(key, (0.0, named)), (float(p), named), key=lambda each: each[0])
    if not whole:
        return NONE
    total = max(sum(whole.values()), np.finfo(float).tiny)
    ranked = [(key, p / total) for key, p in whole.most_common()]
    above = np.cumsum([0.0, *(p for _, p in ranked)])[:-1]
    ranked = [each for each, before in zip(ranked, above, strict=True) if before < NAMED]
    words = [best[key][1].words for key, _ in ranked]
    if len(words) > 1:
        words = [f"{w} (P = {p:.2f})" for w, (_, p) in zip(words, ranked, strict=True)]
    first = best[ranked[0][0]][1]
    none = float(posterior.chance[posterior.none].sum())
    return first._replace(words=" or ".join(words), probability=max(1.0 - none, 0.0))


def _terms(found: Begun, slopes: Sequence[np.ndarray]) -> tuple[list[Departure], list[np.ndarray]]:
    """Terms that a fuller response may have, and their columns by run: further lags, parameters
    that change with an input or grow along the record, a gain or a delay that grows.

    Their prior is of width 1: of the output's scatter, of the logarithm of a lag, of a sample of
    delay. What a slow drift of the output does as well is no term.
    """
    seen = found.seen
    (lags, further), (names, changing) = _further_lags(found), _changing(seen, slopes)
    fitted = (y - row[0] for y, row in zip(seen.measured, found.settled.rest, strict=True))
    growing = (growing_of(y, t) for y, t in zip(fitted, seen.time, strict=True))
    each = [np.hstack(columns) for columns in zip(further, changing, growing, strict=True)]
    drifts = (drift_columns(t / t[-1], k, len(each)) for k, t in enumerate(seen.time))
    drift = spanned(np.concatenate([columns.reshape(len(columns), -1) for columns in drifts]))
    whole, ends = np.concatenate(each), np.cumsum([len(columns) for columns in each])[:-1]
    return lags + names + GROWING, np.split(whole - drift @ (drift.T @ whole), ends)


def _further_lags(found: Begun) -> tuple[list[Departure], list[np.ndarray]]:
    """Further lags of the inputs, and their columns by run: a part of the gain goes by each in the
    place of the response's own way, so that what the output settles at stays the same.
    """
    seen, model = found.seen, found.settled.fit.model
    names = [Departure(f"a further lag of about {lag:.2g} s of {name}", FURTHER)
             for lag in slow_lags(seen) for name in seen.inputs]  # fmt: skip
    shape, slow = shape_of(seen, model), slow_paths(seen)
    gain = 1.0 + shape.sum() if seen.runs[0].physics is ARX else 1.0
    late = (replace(run, part=run.part + model["late"]) for run in seen.runs)
    own = (np.tile(gain * paths_by(run, shape[None]), SLOW) for run in late)
    unit = _scatter(slow, seen)
    return names, [(path - away) / unit for path, away in zip(slow, own, strict=True)]


def _changing(
    seen: PreparedOutput, slopes: Sequence[np.ndarray]
) -> tuple[list[Departure], list[np.ndarray]]:
    """Parameters that change with an input or its square, and times that grow along the record;
    their columns by run. A gain that changes with its own input is a static law, and none of these.
    """
    physics, m = seen.runs[0].physics, len(seen.inputs)
    names, kept, gains = [], [], []
    powers = zip(physics.parameters(seen.inputs), physics.units(m), strict=True)
    number = np.cumsum([gain for _, gain in physics.units(m)]) - 1
    for i, (name, (time, gain)) in enumerate(powers):
        for k, by in enumerate((*seen.inputs, *seen.inputs, None)):
            if by is None and time:
                names.append(Departure(f"a {name}", GROWTH))
            elif by is not None and not (gain and k % m == number[i] % m):
                names.append(Departure(f"a {name} that changes with {by}", FURTHER))
            else:
                continue
            kept.append(i * (2 * m + 1) + k)
            gains.append(bool(gain))
    columns = [each[:, kept] for each in slopes]
    unit = np.where(gains, _scatter(columns, seen), 1.0)
    return names, [each / unit for each in columns]


def _scatter(columns: Sequence[np.ndarray], seen: PreparedOutput) -> np.ndarray:
    """Root mean square of each column over the output's scatter; 1 of one that is zero."""
    found = np.sqrt(np.mean(np.concatenate(columns) ** 2, axis=0)) / seen.size_y
    return np.where(found > 0, found, 1.0)
