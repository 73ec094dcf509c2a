"""Comparison of alternative descriptions of how the inputs act on an output.

Alternatives differ in the inputs between samples (held or moving), in a law of an input (or none)
and in the delay (whole samples or fractions of one); the response may also have one further term,
or be of second order instead of first.
Each is fitted under every noise of a grid, white or wandering, and is weighted by its marginal
likelihood, with the free numbers and the noise integrated out: a noise that wanders can absorb what
a missing law leaves, and gains are then far off. The most probable departure is named, and the
uncertainty that remains enters the errors.
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

from beamfit.dynamics.checks import FURTHER_LAGS, further_lags, further_responses, unit_responses
from beamfit.dynamics.input_laws import STATIC, InputLaw, laws_between
from beamfit.dynamics.model import (
    DrivenRun,
    PreparedOutput,
    growth_columns,
    pad_readings,
    predicted,
)
from beamfit.dynamics.paths import (
    Path,
    Paths,
    PreparedReadings,
    inputs_by_path,
    prepare_output,
    prepare_readings,
)
from beamfit.dynamics.record import Run, Way
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER
from beamfit.dynamics.search import (
    ResponseSearch,
    RunsFit,
    drift_columns,
    noise_grid,
    orthonormal_basis,
    response_case,
    shape_parameters,
)
from beamfit.greybox import tree
from beamfit.greybox.problem import Problem, with_slope
from beamfit.noise.correlated import Whitened, roots_by_each
from beamfit.noise.memory import CorrelatedNoise
from beamfit.statistics import MIN_SINGULAR_VALUE

# Noise grid of the comparison: number of correlation times, and ratios of white variance to the
# variance that the wandering part gains in a sample. Chosen for speed: coarser than the grid of the
# final fit.
CORRELATION_TIMES = 6
WHITE_RATIOS = (0.0, 1.0, 10.0, 100.0)
# Readings of each run that the comparison uses at most: chosen, for speed.
MAX_READINGS = 2048
# Prior odds that the response has no term beyond those of the model asked for, and that a first
# order is no second one: a guess.
ODDS_AGAINST_TERM = 10.0
# Where several laws are possible, the most probable ones are named until they make up this
# probability.
NAMED_PROBABILITY = 0.99
# Number of times the steps of the best static laws are made finer.
REFINEMENTS = 2
# A law counts as none if a gain and a level give its output to this relative accuracy.
LINEAR_TOLERANCE = 1e-6
# Residuals are clipped here, so that a diverged Gauss-Newton step stays finite.
MAX_RESIDUAL = 1e100
# Gauss-Newton rounds that screen all trials, number of the best trials that are kept, and rounds
# that follow for these. All chosen.
SCREENING_ROUNDS = 2
MAX_TRIALS = 128
FINAL_ROUNDS = 3
# The first round uses every NOISE_STRIDE-th noise of the grid, later ones the NOISES_PER_ROUND
# best.
NOISE_STRIDE = 3
NOISES_PER_ROUND = 4
# Delays shorter than that of the fit by up to this many samples are tried with each law, since a
# law can look like a delay.
MAX_DELAY_REPLACED = 3
# Alternatives below this probability are dropped: they move no end of a 95 % interval.
MIN_PROBABILITY = 1e-5
# Trials that are fitted together: one program is compiled for all batches.
TRIALS_PER_BATCH = 64


# Kinds of departures that are not laws of an input.
FURTHER, GROWTH, HIGHER = "further term", "growth", "second order"


class Departure(NamedTuple):
    """A departure from the plain response: a law of an input, a further term, a growth, or a second
    order.

    `words` describes it, `kind` is a kind of `InputLaw`, `FURTHER`, `GROWTH` or `HIGHER`.
    `without` is the probability of no departure at all.
    """

    words: str
    kind: str
    without: float = 1.0

    def with_growth(self, share: float) -> Departure:
        """Add the amount by which a growing quantity changes along the record to the words."""
        if self.kind != GROWTH:
            return self
        by, unit = (share, "samples") if self.words == "a delay" else (100.0 * share, "%")
        way = "grows" if by > 0 else "falls"
        return self._replace(words=f"{self.words} that {way} by about {abs(by):.2g} {unit}")


NO_DEPARTURE = Departure("", "")
# Departures of the columns of `growth_columns`, in their order.
GROWTH_DEPARTURES = [Departure("a delay", GROWTH), Departure("a gain", GROWTH)]


class Trial(NamedTuple):
    """A path, its log prior, and the index of a further term or second order if any."""

    path: Path
    prior: float
    term: int | None = None

    @property
    def is_departure(self) -> bool:
        """True if the trial has a law or a further term."""
        return self.path.law is not None or self.term is not None


class Alternatives(NamedTuple):
    """Posterior over the descriptions of how the inputs act on an output.

    Attributes
    ----------
    path : Path
        The most probable path without a law; that of the fit where the fit covers it.
    delay_error, early_probability : float
        Standard deviation of the delay about that of the fit, in samples, and probability that it
        is negative; both over the trials without a departure.
    departure : Departure
        The most probable departure, or those that make up 99 % with their probabilities.
    weight : array, shape (a,)
        Probability of each alternative to the fit.
    shift : array, shape (a, p)
        Free numbers with each alternative, less those of the fit.
    covariance : array, shape (a, p, p)
        Covariance of the free numbers with each alternative.
    """

    path: Path
    delay_error: float
    early_probability: float
    departure: Departure
    weight: np.ndarray
    shift: np.ndarray
    covariance: np.ndarray

    def error(self, slopes: np.ndarray, alone: np.ndarray) -> np.ndarray:
        """Give the errors of derived quantities about their fitted values, alternatives included.

        `slopes` (..., p) are the derivatives by the free numbers, `alone` the errors without
        alternatives.
        """
        slopes = slopes[..., : self.shift.shape[1]]  # the delay is no free number here
        spread = np.einsum("...p,apq,...q->...a", slopes, self.covariance, slopes)
        others = (spread + (slopes @ self.shift.T) ** 2) @ self.weight
        return np.sqrt(max(1.0 - self.weight.sum(), 0.0) * alone**2 + others)


@partial(jax.jit, static_argnums=0)
def _factored_rows(chosen: Any, model: Any, run: DrivenRun, data: Any, theta: Any, u: Any):
    """QR factors of slopes and residuals of each trial, in units of the reading errors.

    `data` holds readings, their errors, the further term, and the fractions of a row in the delays
    with their widths. The last free number is the amount of the further term, the change of the
    law's width in steps, or the change of the delay in widths.
    """
    y, error, term, delay = data

    def one(theta, u, term, delay):
        def output(t):
            fraction, width = delay
            shifted = replace(
                run, u=u[..., 0] + t[-1] * u[..., 1], delay_fraction=fraction + t[-1] * width
            )
            return predicted(tree.replace(model, chosen, t[:-1]), shifted) + t[-1] * term

        return with_slope(output, theta)

    value, slope = jax.vmap(one)(theta, u, term, delay)
    rows = jnp.concatenate([slope, (value - y)[..., None]], axis=2)
    return jnp.linalg.qr(
        jnp.clip(jnp.nan_to_num(rows, nan=MAX_RESIDUAL), -MAX_RESIDUAL, MAX_RESIDUAL)
        / error[:, None]
    )


class _Batch(NamedTuple):
    """Trials that are fitted together, under every noise of the grid.

    `inputs` and `terms` are by run, `delays` has the fractions of a row in the delays and their
    widths.
    """

    comparison: Comparison
    inputs: list[np.ndarray]
    delays: tuple[np.ndarray, np.ndarray]
    terms: list[np.ndarray]

    def whiten(self, theta: np.ndarray, noises: Sequence[int]) -> Whitened:
        """Whiten slopes and residuals of every trial by some noises of the grid."""
        c, some = self.comparison, [self.comparison.grid[k] for k in noises]
        triangles, volume, count = [], 0.0, 0
        padded = np.pad(theta, ((0, TRIALS_PER_BATCH - len(theta)), (0, 0)), mode="edge")
        for run, data, term, u in zip(
            c.prepared.drives, c.data, self.terms, self.inputs, strict=True
        ):
            y, time, error = data
            data = y, error, term, self.delays
            found = _factored_rows(c.chosen, c.model, run, data, padded, u)
            columns, triangle = (np.asarray(each)[: len(theta)] for each in found)
            columns = np.swapaxes(columns[:, : len(time)], 0, 1)
            roots, each = roots_by_each(some, columns, np.diff(time))
            triangles.append(roots @ triangle)
            volume, count = volume + each, count + len(time)
        offset = (theta - c.begin) @ c.prior.T
        prior_rows = np.concatenate(
            [np.tile(c.prior, (len(theta), 1, 1)), offset[..., None]], axis=2
        )
        rows = np.concatenate([*triangles, np.tile(prior_rows, (len(some), 1, 1, 1))], axis=2)
        volume = volume + np.log(np.linalg.norm(c.prior, axis=1)).sum()
        return repeat_for_noises(some, rows, volume, count + len(c.prior))

    def fit(self, begin: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
        """Fit the numbers of each trial by Gauss-Newton steps; return them and the lowest -2 ln L.

        Each trial steps under its best noise. The first round tries every `NOISE_STRIDE`-th noise,
        further rounds the `NOISES_PER_ROUND` noises of the best trials.
        """
        count, noises = len(begin), np.arange(len(self.comparison.grid))[::NOISE_STRIDE]
        best, trials = begin, np.arange(count)
        step, lowest = np.zeros_like(best), np.full(count, np.inf)
        for _ in range(rounds):
            white = self.whiten(best + step, noises)
            memory, squares = white.memory(), np.sum(white.triangle[..., -1] ** 2, axis=1)
            deviance = _deviance(white, squares).reshape(-1, count)
            next_deviance = _deviance(white, memory.squares).reshape(-1, count)
            best_noise = next_deviance.argmin(axis=0)
            next_step = memory.step.reshape(-1, count, best.shape[1])[best_noise, trials]
            better = deviance.min(axis=0) < lowest
            best = np.where(better[:, None], best + step, best)
            lowest = np.minimum(lowest, deviance.min(axis=0))
            step = np.where(better[:, None], next_step, 0.25 * step)
            ranked = noises[best_noise[np.argsort(next_deviance.min(axis=0))]]
            noises = np.array(list(dict.fromkeys(ranked))[:NOISES_PER_ROUND])
        return best, np.minimum(lowest, next_deviance.min(axis=0))

    def weigh(self, begin: np.ndarray) -> tuple[np.ndarray, ...]:
        """Log evidence of each trial, and mean and covariance of its numbers, over all noises."""
        (at, _), grid = self.fit(begin, FINAL_ROUNDS), len(self.comparison.grid)
        likelihood, mean, spread, _ = average_over_noises(self.whiten(at, range(grid)), grid)
        return likelihood, at + mean, spread


def repeat_for_noises(
    noises: Sequence[CorrelatedNoise], triangles: np.ndarray, volume: np.ndarray, count: int
) -> Whitened:
    """Flatten triangles of shape (noises, trials, rows, columns) to one axis."""
    trials = triangles.shape[1]
    noise = CorrelatedNoise(*np.repeat(np.array(noises).T, trials, axis=1))
    each = triangles.reshape(-1, *triangles.shape[2:])
    return Whitened(noise, each, np.repeat(volume, trials), count)


def average_over_noises(
    white: Whitened, grid: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Integrate the noise out: log evidence of each trial, its step and covariance, and the dof.

    The rows of `white` are those of each of the `grid` noises in turn, all trials of one together.
    """
    memory, logs = white.weighed()
    logs = logs.reshape(grid, -1)
    likelihood = logsumexp(logs, axis=0)
    share, step = np.exp(logs - likelihood), memory.step.reshape(*logs.shape, -1)
    half = memory.half.reshape(*logs.shape, *memory.half.shape[1:])
    size = (memory.squares / memory.dof).reshape(logs.shape)
    mean = np.einsum("ga,gap->ap", share, step)
    spread = np.einsum("ga,gapr,gaqr->apq", share * size, half, half, optimize=True)
    offset = step - mean
    spread += np.einsum("ga,gap,gaq->apq", share, offset, offset, optimize=True)
    return likelihood, mean, spread, memory.dof


def _deviance(white: Whitened, squares: np.ndarray) -> np.ndarray:
    """Give -2 ln L up to a constant from residual sums of squares, the noise level at its best."""
    return white.count * np.log(np.maximum(squares, np.finfo(float).tiny)) - 2.0 * white.volume


class _TrialPosterior(NamedTuple):
    """Trials with the log evidence, the free numbers and the covariance of each."""

    trials: list[Trial]
    log_evidence: np.ndarray
    numbers: np.ndarray
    spread: np.ndarray

    def select(self, kept: np.ndarray) -> _TrialPosterior:
        """Keep the trials of a mask."""
        trials = [trial for trial, keep in zip(self.trials, kept, strict=True) if keep]
        return _TrialPosterior(trials, *(each[kept] for each in self[1:]))

    def merge(self, other: _TrialPosterior) -> _TrialPosterior:
        """Join two sets of trials."""
        parts = zip(self[1:], other[1:], strict=True)
        return _TrialPosterior(self.trials + other.trials, *map(np.concatenate, parts))

    @property
    def log_posterior(self) -> np.ndarray:
        """Unnormalised log probability of each trial."""
        return self.log_evidence + np.array([trial.prior for trial in self.trials])

    @property
    def probability(self) -> np.ndarray:
        """Probability of each trial."""
        return np.exp(self.log_posterior - logsumexp(self.log_posterior))

    @property
    def no_departure(self) -> np.ndarray:
        """True for each trial without a law or further term."""
        return np.array([not trial.is_departure for trial in self.trials])

    def delay_moments(self, about: float) -> tuple[float, float]:
        """Rms of the delay about a value, in samples, and probability that it is negative."""
        paths = [trial.path for trial in self.trials]
        delays, width = np.array([(path.delay, path.width) for path in paths]).T
        shift = delays + width * self.numbers[:, -1] - about
        squares = shift**2 + width**2 * self.spread[:, -1, -1]
        return float(np.sqrt(self.probability @ squares)), float(self.probability @ (delays < 0))

    def best_static_laws(self) -> dict[tuple[str, str], int]:
        """Index of the most probable static law of each kind and input."""
        # In rising order, so that the most probable one of each kind stays.
        laws = [(int(k), self.trials[k].path.law) for k in np.argsort(self.log_posterior)]
        return {(law.kind, law.input): k for k, law in laws if law and law.kind in STATIC}


class Comparison(NamedTuple):
    """A fit with all that its alternatives are fitted with.

    `data` holds padded readings, times and padded errors of each run; `begin` the numbers of the
    fit without its delay and, last, 0 for the number that an alternative adds. `prior` has a row
    for each number with a prior about the fit, its inverse width: 1 for logarithms of time
    constants, raw numbers of a damping, and the added number; without it an alternative could take
    them where no data count. `grid` are noises, `terms` the columns of further terms by run,
    `departures` their descriptions.
    """

    runs: tuple[Run, ...]
    prepared: PreparedReadings
    data: list[tuple[np.ndarray, ...]]
    rows_per_sample: int
    chosen: tuple[Any, ...]
    model: Any
    begin: np.ndarray
    prior: np.ndarray
    grid: list[CorrelatedNoise]
    terms: list[np.ndarray]
    departures: list[Departure]

    @classmethod
    def prepare(
        cls, runs: tuple[Run, ...], found: RunsFit, paths: Paths, slopes: Sequence[np.ndarray]
    ) -> Comparison:
        """Prepare a fit; `slopes` are those of `fuller_model_slopes`."""
        prepared, fit = found.prepared, found.fit
        readings = prepare_readings(
            runs,
            prepared.output,
            prepared.runs[0].physics,
            paths.rows_per_sample,
            found.path.delay,
            MAX_READINGS,
        )
        drives = readings.drives
        errors = [noise.each[:MAX_READINGS] for (noise,) in found.noise]
        each = zip(drives, readings.measured, prepared.time, errors, strict=True)
        data = [
            (pad_readings(drive, y), time[:MAX_READINGS], pad_readings(drive, error, np.inf))
            for drive, y, time, error in each
        ]
        departures, columns = _further_terms(found, slopes)
        terms = [
            pad_readings(drive, each.T[:, :MAX_READINGS])
            for drive, each in zip(drives, columns, strict=True)
        ]
        grid = noise_grid(prepared.time, CORRELATION_TIMES, WHITE_RATIOS)
        numbers = _free_numbers(fit.problem, fit.theta, prepared)
        return cls(
            runs, readings, data, paths.rows_per_sample, *numbers, grid, terms, departures
        )  # fmt: skip

    def of_second_order(self, search: ResponseSearch) -> tuple[Path, Comparison]:
        """Prepare a second order for the same readings and noises; also give its best path.

        The prior of the slopes at the start is as wide as the output's scatter over T.
        """
        search = search._replace(physics=SECOND_ORDER)
        path, model, _ = search.start(self.runs)
        prepared = prepare_output(self.runs, search.output, SECOND_ORDER, path)
        case = response_case(prepared, path, search.offset)
        problem = case.problem(model, case.initial_noise)
        chosen, model, begin, prior = _free_numbers(problem, problem.start, prepared)
        slopes = np.eye(len(begin))[1 : 2 * len(self.runs) : 2]
        time = shape_parameters(prepared, model)[0]
        drives = tuple(replace(drive, physics=SECOND_ORDER) for drive in self.prepared.drives)
        return path, self._replace(
            prepared=self.prepared._replace(drives=drives), chosen=chosen, model=model,
            begin=begin, prior=np.concatenate([prior, slopes * time / prepared.output_scale]),
            terms=[each * 0.0 for each in self.terms],
        )  # fmt: skip

    def weigh(self, trials: list[Trial]) -> _TrialPosterior:
        """Weigh trials by their evidence.

        Of more than `MAX_TRIALS` those without a departure are kept, and the best others after
        `SCREENING_ROUNDS` rounds.
        """
        begin = np.tile(self.begin, (len(trials), 1))
        if len(trials) > MAX_TRIALS:
            batches = self._batches(trials, begin)
            parts = zip(*(b.fit(each, SCREENING_ROUNDS) for b, each in batches), strict=True)
            begin, cost = map(np.concatenate, parts)
            cost -= [2.0 * t.prior if t.is_departure else np.inf for t in trials]
            kept = np.argsort(cost)[:MAX_TRIALS]
            trials, begin = [trials[k] for k in kept], begin[kept]
        found = [batch.weigh(each) for batch, each in self._batches(trials, begin)]
        return _TrialPosterior(trials, *map(np.concatenate, zip(*found, strict=True)))

    def _batches(
        self, trials: list[Trial], begin: np.ndarray
    ) -> Iterator[tuple[_Batch, np.ndarray]]:
        """Split trials and their start numbers into batches; the last trial fills the last one."""
        trials = trials + trials[-1:] * (-len(trials) % TRIALS_PER_BATCH)
        for k in range(0, len(trials), TRIALS_PER_BATCH):
            some = trials[k : k + TRIALS_PER_BATCH]
            paths = [trial.path for trial in some]
            inputs, part = inputs_by_path(self.runs, self.prepared, self.rows_per_sample, paths)
            terms = [np.stack([0.0 * each[0] if t.term is None else each[t.term] for t in some])
                     for each in self.terms]  # fmt: skip
            width = self.rows_per_sample * np.array([path.width for path in paths])
            yield _Batch(self, inputs, (part, width), terms), begin[k : k + TRIALS_PER_BATCH]


def _free_numbers(
    problem: Problem, theta: np.ndarray, prepared: PreparedOutput
) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """Give `chosen`, `model`, `begin` and `prior` of a `Comparison`."""
    numbers = [name for name in problem.names if name != "late"]
    powers = prepared.runs[0].physics.units(len(prepared.inputs))
    indices = [numbers.index(f"map[{k}]") for k, (_, gain) in enumerate(powers)
               if not gain and f"map[{k}]" in numbers] + [len(numbers)]  # fmt: skip
    chosen = tuple(leaf for leaf in problem.core.chosen if leaf.path != "late")
    model = problem.core.model | {"late": jnp.zeros(())}
    begin = np.append(theta[: len(numbers)], 0.0)
    return chosen, model, begin, np.eye(len(begin))[indices]


def alternatives_of(
    runs: tuple[Run, ...],
    found: RunsFit,
    search: ResponseSearch,
    slopes: Sequence[np.ndarray],
    departures: bool,
) -> Alternatives:
    """Weigh every path, law and further term against those of a fit.

    With `departures` False neither laws nor further terms are tried. A second order is tried if
    another departure is more probable than none.
    """
    paths = search.paths
    comparison = Comparison.prepare(runs, found, paths, slopes)
    fitted_path = found.path._replace(delay=found.delay)
    lawless = paths.whole_delays() + paths.fractional_delays(fitted_path.delay)
    trials = [Trial(path, paths.log_prior(path)) for path in lawless]
    if departures:
        terms = len(comparison.terms[0])
        prior = paths.log_prior(fitted_path) - np.log(ODDS_AGAINST_TERM * terms)
        trials += _law_trials(comparison, fitted_path, paths)
        trials += [Trial(fitted_path, prior, k) for k in range(terms)]
    posterior = comparison.weigh(trials)
    has_law = np.array([trial.path.law is not None for trial in posterior.trials])
    if posterior.probability[has_law].sum() > posterior.probability[posterior.no_departure].sum():
        posterior = _refine_laws(comparison, posterior)
    names = comparison.departures
    if search.physics is FIRST_ORDER and posterior.probability[posterior.no_departure].sum() < 0.5:
        second, departure = _second_order(comparison, search)
        posterior, names = posterior.merge(second), [*names, departure]
    chance, no_departure = posterior.probability, posterior.no_departure
    others = ~no_departure | [not found.covers(trial.path) for trial in posterior.trials]
    others &= chance > MIN_PROBABILITY
    best_path = posterior.trials[
        np.where(no_departure, posterior.log_posterior, -np.inf).argmax()
    ].path
    return Alternatives(
        found.path if found.covers(best_path) else best_path,
        *posterior.select(no_departure).delay_moments(found.delay),
        _name_departure(posterior, names),
        chance[others],
        (posterior.numbers - comparison.begin)[others, :-1],
        posterior.spread[others, :-1, :-1],
    )


def _second_order(
    comparison: Comparison, search: ResponseSearch
) -> tuple[_TrialPosterior, Departure]:
    """Weigh a second order with all delays, and describe it.

    Its numbers are given as those of a first order, with the sum of its lags, 2 zeta T.
    """
    (_, way, delay), higher = comparison.of_second_order(search)
    paths, runs = search.paths, len(comparison.runs)
    tried = [p for p in paths.whole_delays() + paths.fractional_delays(delay) if p.way == way]
    term, odds = len(comparison.departures), np.log(ODDS_AGAINST_TERM)
    found = higher.weigh([Trial(path, paths.log_prior(path) - odds) for path in tried])
    time, zeta = np.exp(found.numbers[found.log_posterior.argmax(), 2 * runs : 2 * runs + 2])
    words = f"a second order with T of about {time:.2g} s and zeta of about {zeta:.2g}"
    # Without the slopes at the start; the logarithms of T and zeta become that of 2 zeta T.
    lower = np.delete(np.eye(len(higher.begin)), [*range(1, 2 * runs, 2), 2 * runs + 1], axis=0)
    lower[runs, 2 * runs + 1] = 1.0
    numbers = found.numbers @ lower.T
    numbers[:, runs] += np.log(2.0)
    trials = [trial._replace(term=term) for trial in found.trials]
    spread = lower @ found.spread @ lower.T
    return _TrialPosterior(trials, found.log_evidence, numbers, spread), Departure(words, HIGHER)


def _law_trials(comparison: Comparison, own: Path, paths: Paths) -> list[Trial]:
    """Trials of every law, equally probable over kinds, over the widths of a kind, and over paths.

    Delays are that of the fit and, where no delay is given, up to `MAX_DELAY_REPLACED` shorter
    ones.
    """
    runs = comparison.runs
    delays, next_whole = [own.delay], int(np.ceil(own.delay))
    if not paths.given:
        delays += range(max(0, next_whole - MAX_DELAY_REPLACED), next_whole)
    ways = [Path(None, way, float(delay)) for delay in delays for way in paths.ways]
    laws = [law for name in runs[0].inputs for law in _nonlinear_laws(runs, name, paths.movable)]
    per_kind = Counter(law.kind for law in laws)
    log_prior = {law: -np.log(len(per_kind) * per_kind[law.kind]) for law in laws}
    return [Trial(way._replace(law=law), paths.log_prior(way) + log_prior[law])
            for law in laws for way in ways]  # fmt: skip


def _nonlinear_laws(runs: Sequence[Run], name: str, way: Way) -> list[InputLaw]:
    """Laws of an input that a gain and a level cannot replace.

    They count from the first change of the input on, for `MAX_READINGS` rows: what was before is in
    the states at the start.
    An input with readings that scatter about levels counts at these levels, and laws that change it
    by less than the errors of the levels are dropped. An input that never changes has no law.
    """
    levels = [way.levels(run, name) for run in runs]
    inputs = [each.at for each in levels]
    first = [int(np.argmax(u != u[0])) for u in inputs]
    used = [u[: k + MAX_READINGS] for u, k in zip(inputs, first, strict=True)]
    moved = np.concatenate([u[k:] for u, k in zip(used, first, strict=True)])
    if np.ptp(moved) == 0.0:
        return []
    level_error = np.sqrt(sum(np.sum(each.variance[k : k + MAX_READINGS])
                         for each, k in zip(levels, first, strict=True)))  # fmt: skip
    laws = laws_between(name, *map(float, (min(map(np.min, inputs)), max(map(np.max, inputs)))))
    at = np.stack([
        np.concatenate([law.output_and_slope(u)[k:, 0]
                        for u, k in zip(used, first, strict=True)]) for law in laws
    ], axis=1)  # fmt: skip
    basis = np.linalg.qr(np.stack([np.ones(len(moved)), moved], axis=1))[0]
    at = at - at.mean(axis=0)
    linear = basis @ (basis.T @ at)
    gain = np.linalg.norm(linear, axis=0) / np.linalg.norm(moved - moved.mean())
    # Errors of the levels pass through a law with its gain, at most as they are.
    least = np.maximum(
        LINEAR_TOLERANCE * np.linalg.norm(at, axis=0),
        MIN_SINGULAR_VALUE * np.maximum(gain, 1.0) * level_error,
    )
    nonlinear = np.linalg.norm(at - linear, axis=0) > least
    return [law for law, own in zip(laws, nonlinear, strict=True) if own]


def _refine_laws(comparison: Comparison, posterior: _TrialPosterior) -> _TrialPosterior:
    """Replace the most probable static laws by ones in finer steps, `REFINEMENTS` times."""
    for _ in range(REFINEMENTS):
        best, kept = posterior.best_static_laws().values(), np.ones(len(posterior.trials), bool)
        trials: list[Trial] = []
        for at in best:
            path, prior, _ = posterior.trials[at]
            laws = path.law.finer(posterior.numbers[at, -1])
            trials += [Trial(path._replace(law=law), prior - np.log(len(laws))) for law in laws]
            kept[at] = False
        if trials:
            posterior = posterior.select(kept).merge(comparison.weigh(trials))
    return posterior


def _name_departure(posterior: _TrialPosterior, names: Sequence[Departure]) -> Departure:
    """Describe the most probable departures until they make up `NAMED_PROBABILITY`.

    Each kind of law and input and each further term is named once, by its most probable trial. The
    kind is that of the first.
    """
    best: dict[Any, tuple[float, Departure]] = {}
    by_key: Counter[Any] = Counter()
    for trial, p, numbers in zip(
        posterior.trials, posterior.probability, posterior.numbers, strict=True
    ):
        if not trial.is_departure:
            continue
        if trial.term is not None:
            key, named = names[trial.term], names[trial.term].with_growth(numbers[-1])
        else:
            law = trial.path.law.widened(numbers[-1])
            key, named = (law.kind, law.input), Departure(law.words(), law.kind)
        by_key[key] += float(p)
        best[key] = max(best.get(key, (0.0, named)), (float(p), named), key=lambda each: each[0])
    if not by_key:
        return NO_DEPARTURE
    total = max(sum(by_key.values()), np.finfo(float).tiny)
    ranked = [(key, p / total) for key, p in by_key.most_common()]
    before = np.cumsum([0.0, *(p for _, p in ranked)])[:-1]
    ranked = ranked[: int(np.sum(before < NAMED_PROBABILITY))]
    words = [best[key][1].words for key, _ in ranked]
    if len(words) > 1:
        words = [f"{w} (P = {p:.2f})" for w, (_, p) in zip(words, ranked, strict=True)]
    first = best[ranked[0][0]][1]
    none = float(posterior.probability[posterior.no_departure].sum())
    return first._replace(words=" or ".join(words), without=none)


def _further_terms(
    found: RunsFit, slopes: Sequence[np.ndarray]
) -> tuple[list[Departure], list[np.ndarray]]:
    """Further terms that a fuller response may have, and their columns by run.

    They are further lags, parameters that change with an input or grow along the record, and a gain
    or delay that grows. The prior of each has width 1, in units of the output's scatter, of the
    logarithm of a lag, or of a sample of delay. The part that a slow drift of the output also gives
    is removed.
    """
    prepared = found.prepared
    (lags, further), (names, changing) = _lag_terms(found), _parameter_terms(prepared, slopes)
    residuals = found.residuals
    fitted = (y - row[0] for y, row in zip(prepared.measured, residuals, strict=True))
    growing = (growth_columns(y, t) for y, t in zip(fitted, prepared.time, strict=True))
    by_run = [np.hstack(columns) for columns in zip(further, changing, growing, strict=True)]
    drifts = (drift_columns(t / t[-1], k, len(by_run)) for k, t in enumerate(prepared.time))
    drift = orthonormal_basis(np.concatenate([c.reshape(len(c), -1) for c in drifts]))
    columns, ends = np.concatenate(by_run), np.cumsum([len(columns) for columns in by_run])[:-1]
    return lags + names + GROWTH_DEPARTURES, np.split(columns - drift @ (drift.T @ columns), ends)


def _lag_terms(found: RunsFit) -> tuple[list[Departure], list[np.ndarray]]:
    """Further lags of the inputs, and their columns by run.

    A part of the gain follows the further lag instead of the response, so that the output at rest
    stays the same.
    """
    prepared, model = found.prepared, found.fit.model
    names = [Departure(f"a further lag of about {lag:.2g} s of {name}", FURTHER)
             for lag in further_lags(prepared) for name in prepared.inputs]  # fmt: skip
    shape, slow = shape_parameters(prepared, model), further_responses(prepared)
    gain = 1.0 + shape.sum() if prepared.runs[0].physics is ARX else 1.0
    late = (replace(r, delay_fraction=r.delay_fraction + model["late"]) for r in prepared.runs)
    own = (np.tile(gain * unit_responses(run, shape[None]), FURTHER_LAGS) for run in late)
    unit = _relative_rms(slow, prepared)
    return names, [(lagged - response) / unit for lagged, response in zip(slow, own, strict=True)]


def _parameter_terms(
    prepared: PreparedOutput, slopes: Sequence[np.ndarray]
) -> tuple[list[Departure], list[np.ndarray]]:
    """Parameters that change with an input or its square, and times that grow along the record.

    A gain that changes with its own input is left out: it is a static law. Columns are by run.
    """
    physics, m = prepared.runs[0].physics, len(prepared.inputs)
    names, kept, gains = [], [], []
    powers = zip(physics.parameters(prepared.inputs), physics.units(m), strict=True)
    number = np.cumsum([gain for _, gain in physics.units(m)]) - 1
    for i, (name, (time, gain)) in enumerate(powers):
        for k, by in enumerate((*prepared.inputs, *prepared.inputs, None)):
            if by is None and time:
                names.append(Departure(f"a {name}", GROWTH))
            elif by is not None and not (gain and k % m == number[i] % m):
                names.append(Departure(f"a {name} that changes with {by}", FURTHER))
            else:
                continue
            kept.append(i * (2 * m + 1) + k)
            gains.append(bool(gain))
    columns = [each[:, kept] for each in slopes]
    unit = np.where(gains, _relative_rms(columns, prepared), 1.0)
    return names, [each / unit for each in columns]


def _relative_rms(columns: Sequence[np.ndarray], prepared: PreparedOutput) -> np.ndarray:
    """Give the rms of each column over the output's scatter; 1 for a column of zeros."""
    found = np.sqrt(np.mean(np.concatenate(columns) ** 2, axis=0)) / prepared.output_scale
    return np.where(found > 0, found, 1.0)
