"""Tests of the residuals of an identified response, and predictions of held-out runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc

from beamfit.dynamics.model import (
    DrivenRun,
    PreparedOutput,
    operating_point_slopes,
)
from beamfit.dynamics.record import Run, Way
from beamfit.dynamics.response import FIRST_ORDER
from beamfit.dynamics.search import (
    RunsFit,
    best_drift_degree,
    drift_columns,
    orthonormal_basis,
    unit_outputs,
    whiten,
    with_physics,
)
from beamfit.greybox.fit import Fit
from beamfit.noise.digits import digit_of, rounding_variance
from beamfit.noise.memory import CorrelatedNoise

# Largest numbers of lags in the tests: of the residuals, of earlier inputs, and of later inputs.
# Chosen.
RESIDUAL_LAGS = 20
PAST_LAGS = 10
LATER_LAGS = 5
# Number of further time constants in the test for a fuller model: chosen.
FURTHER_LAGS = 5
# An input is not separable if less than this share of its variance is independent of the others.
MIN_OWN_VARIANCE = 1e-3


class Checks(NamedTuple):
    """Tests of the residuals of the free-running output.

    Attributes
    ----------
    free_run_percent : float
        Explained part of the output in a free run, 100 (1 - |residual| / |output - mean|).
    one_step_percent : float
        The same for predictions from the previous reading, by the correlation of the noise.
    nothing_probability : float
        Probability (F test) that a response explains so much of an output that depends on no input.
    white_probability : float
        Probability of such large residual correlations in white noise (Ljung and Box 1978).
    input_probability : float
        Probability (F test) that past inputs, or parameters that change with the operating point,
        explain so much of the whitened residuals by chance.
    input_share : float
        Share of the whitened sum of squares that these explain.
    feedback_probability, feedback_share : float
        The same for inputs of the same moment and later, which only feedback would explain.
    against_constant : float or None
        Fall of the Bayesian information criterion from constant parameters.
    together : tuple of str
        Inputs that the others determine but for a thousandth of their variance.
    first_order : bool
        True if a first order does as well.
    law : str or None
        Law of an input, further term or growth that is more probable than none, in words; several
        where the runs do not distinguish them.
    no_law_probability : float
        Probability that there is no such departure.
    law_kind : str
        Kind of the departure.
    band_limited : tuple of str
        Inputs without high frequencies that the model holds from sample to sample; if they move in
        between, later inputs explain residuals.
    way : Way
        Inputs that the model follows between samples, and those that it takes at their levels.
    jitter : float
        Standard deviation of the times of readings about those of the record, s.
    drift : int
        Degree of the drift of the output that is fitted together with the response.
    """

    free_run_percent: float
    one_step_percent: float
    nothing_probability: float
    white_probability: float
    input_probability: float
    input_share: float
    feedback_probability: float
    feedback_share: float
    against_constant: float | None
    together: tuple[str, ...] = ()
    first_order: bool = False
    law: str | None = None
    no_law_probability: float = 1.0
    law_kind: str = ""
    band_limited: tuple[str, ...] = ()
    way: Way = Way()
    jitter: float = 0.0
    drift: int = 0

    def rows(self) -> list[list[str]]:
        """List labels and values."""
        rows = [
            ["free run explains", f"{self.free_run_percent:.2f} %"],
            ["one step ahead", f"{self.one_step_percent:.2f} %"],
            ["residuals white", f"p = {self.white_probability:.2g}"],
        ]
        explained = f"{100 * self.input_share:.1f} %, p = {self.input_probability:.2g}"
        rows.append(["residuals explained", explained])
        if self.against_constant is not None:
            rows.append(["BIC below constant", f"{self.against_constant:.1f}"])
        return rows


class HeldOutRun(NamedTuple):
    """Prediction of a held-out run: its name, the explained percentage, and its rms residual."""

    name: str
    free_run_percent: float
    rms: float

    def row(self) -> list[str]:
        """Give label and value."""
        return [f"held back {self.name}", f"{self.free_run_percent:.2f} %, rms {self.rms:.3g}"]


def explained_percent(residuals: np.ndarray, y: np.ndarray) -> float:
    """Explained part of y in percent: 100 (1 - |residuals| / |y - mean|)."""
    scatter = float(np.linalg.norm(y - y.mean()))
    return 100.0 * (1.0 - float(np.linalg.norm(residuals)) / scatter) if scatter > 0 else 0.0


def checks_of(
    found: RunsFit, k: int, changing: Sequence[np.ndarray], used: int, gain: float | None = None
) -> Checks:
    """Test the residuals of output k in all runs together.

    `changing` are the slopes of each run's output by the terms of fuller models, `used` is the
    number of fitted numbers, `gain` the fall of the information criterion from constant parameters.
    """
    case, prepared = found.case, found.case.prepared[k]
    by_run = tuple(row[k] for row in found.residuals)
    own = [case.split(i, slopes)[k] for i, slopes in enumerate(found.slopes())]
    jitter, memory = max(row[k].jitter for row in found.noise), found.errors and found.errors.noise
    errors = [row[k].each for row in found.noise]
    noise = RunNoises(prepared.time, errors, memory, prepared.rows_per_sample if jitter else 0)
    with_drift = zip(prepared.measured, case.drifts(found.fit.model), strict=True)
    y = [m - row[k] - np.mean(m - row[k]) for m, row in with_drift]
    residuals = np.concatenate(by_run)
    tests = _score_tests(prepared, by_run, noise, own, changing)
    (explained, explained_p), (later, later_p) = tests
    white = _ljung_box([r / error for r, error in zip(by_run, noise.errors, strict=True)])
    # Such small residuals are rounding, or the detail of a network.
    if residuals.std() <= prepared.floor:
        explained, explained_p, later, later_p, white = 0.0, 1.0, 0.0, 1.0, 1.0
    # What is explained may be no more than the rounding of the readings.
    rounded = digit_variance(prepared, residuals.std())
    if explained * residuals.var() <= rounded:
        explained, explained_p = 0.0, 1.0
    if later * residuals.var() <= rounded:
        later, later_p = 0.0, 1.0
    total, unexplained = (float(v @ v) for v in (noise.whiten(y), noise.whiten(by_run)))
    return Checks(
        explained_percent(residuals, np.concatenate(y)),
        explained_percent(noise.one_step_residuals(by_run), np.concatenate(y)),
        _f_probability(total - unexplained, unexplained, used, len(residuals) - used),
        white,
        explained_p,
        explained,
        later_p,
        later,
        gain,
        _inseparable_inputs(prepared),
        way=found.path.way,
        jitter=jitter,
        drift=case.degree,
    )


def _inseparable_inputs(prepared: PreparedOutput) -> tuple[str, ...]:
    """Inputs whose gains are not separable: their variance inflation is above a thousand."""
    u = (prepared.points - prepared.points.mean(0)) / prepared.input_scale
    names = []
    for i, name in enumerate(prepared.inputs):
        one, others = u[:, i], np.delete(u, i, axis=1)
        own = one - others @ np.linalg.lstsq(others, one, rcond=1e-10)[0]
        if own @ own < MIN_OWN_VARIANCE * (one @ one):
            names.append(name)
    return tuple(names)


def _f_probability(explained: float, unexplained: float, used: int, free: int) -> float:
    """Probability that `used` numbers explain so large a sum of squares by chance (F test)."""
    if free < 1 or used < 1 or explained <= 0.0:
        return 1.0
    return float(fdtrc(used, free, explained / used / max(unexplained / free, 1e-300)))


class RunNoises(NamedTuple):
    """Noise of an output: times and errors of the readings of each run, and the correlated noise.

    `jitter` is the number of rows by which readings may have been taken earlier or later.
    """

    times: Sequence[np.ndarray]
    errors: Sequence[np.ndarray]
    memory: CorrelatedNoise | None
    jitter: int = 0

    def whiten(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Whiten columns of readings, given by run, to unit variance."""
        each = zip(parts, self.errors, self.times, strict=True)
        return np.concatenate([
            whiten(part / np.expand_dims(error, tuple(range(1, part.ndim))),
                          time, self.memory)[0]
            for part, error, time in each
        ])  # fmt: skip

    def drift(self, own: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """Choose drift columns, given whitened slopes and residuals."""
        runs = len(self.times)
        waves = self.whiten([drift_columns(t / t[-1], i, runs).reshape(len(t), -1)
                            for i, t in enumerate(self.times)])  # fmt: skip
        return waves[:, : runs * best_drift_degree(own, waves, residuals)]

    def one_step_residuals(self, residuals: Sequence[np.ndarray]) -> np.ndarray:
        """Residuals of predictions from the previous readings."""
        found = []
        for r, error, time in zip(residuals, self.errors, self.times, strict=True):
            white, volume = whiten(r / error, time, self.memory)
            found.append(white * error * np.exp(volume / len(r)))
        return np.concatenate(found)


def _ljung_box(residuals: Sequence[np.ndarray]) -> float:
    count = sum(map(len, residuals))
    lags = min(RESIDUAL_LAGS, count // 5)
    squares = max(sum(float(r @ r) for r in residuals), 1e-300)
    found = [sum(float(r[k:] @ r[:-k]) for r in residuals) / squares for k in range(1, lags + 1)]
    q = count * (count + 2) * sum(c**2 / (count - k) for k, c in enumerate(found, start=1))
    return float(chdtrc(lags, q))


def _score_tests(
    prepared: PreparedOutput,
    residuals: tuple[np.ndarray, ...],
    noise: RunNoises,
    own: Sequence[np.ndarray],
    changing: Sequence[np.ndarray],
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Test for a fuller model, and for later inputs in what it leaves: share explained and
    probability.

    Score tests (Lagrange multipliers). The columns are earlier inputs, those within the delay,
    further paths of first order, and the slopes of the output by parameters that change with the
    operating point, less what the model's own numbers explain.
    """
    quick, later, delay = [], [], int(np.floor(prepared.delay))
    for run, added in zip(prepared.runs, changing, strict=True):
        u = prepared.scaled(run.u)
        index = run.read
        past = [u[np.clip(index + k, 0, len(u) - 1)] for k in range(-PAST_LAGS, delay)]
        first = delay + noise.jitter  # a late reading has seen the input of its row
        after = [u[np.clip(index + first + k, 0, len(u) - 1)] for k in range(LATER_LAGS)]
        later.append(np.concatenate(after, axis=1))
        quick.append(np.concatenate([*past, added], axis=1))
    parts = own, further_responses(prepared), quick, later
    own, slow, quick, later = map(noise.whiten, parts)
    white = noise.whiten(residuals)
    own = np.hstack([own, noise.drift(own, white)])
    basis = orthonormal_basis(own)
    white = white - basis @ (basis.T @ white)
    tests = [_score_test(white, basis, columns) for columns in (slow, quick)]
    share, probability = min(tests, key=lambda each: each[1])
    basis = orthonormal_basis(np.hstack([own, slow, quick]))
    white = white - basis @ (basis.T @ white)
    return (share, min(2.0 * probability, 1.0)), _score_test(white, basis, later)


def further_lags(prepared: PreparedOutput) -> np.ndarray:
    """Time constants of the further paths, s."""
    return np.geomspace(prepared.interval, prepared.duration / 4, FURTHER_LAGS)


def further_responses(prepared: PreparedOutput) -> list[np.ndarray]:
    """Outputs of further first-order paths of each input, shape (readings, paths), by run."""
    lags = further_lags(prepared)[:, None]
    return [unit_responses(run, lags) for run in with_physics(prepared, FIRST_ORDER)]


def unit_responses(run: DrivenRun, shapes: np.ndarray) -> np.ndarray:
    """Outputs of a run for unit gains and each shape, shape (readings, shapes * inputs)."""
    found = np.asarray(unit_outputs(run, shapes))[:, : run.u.shape[1], : run.count]
    return found.reshape(-1, run.count).T


def _score_test(
    residuals: np.ndarray, basis: np.ndarray, columns: np.ndarray
) -> tuple[float, float]:
    """Share of the sum of squares that columns explain beyond a basis, and its probability."""
    new = orthonormal_basis(columns - basis @ (basis.T @ columns), np.linalg.norm(columns, axis=0))
    free = len(residuals) - basis.shape[1] - new.shape[1]
    explained, total = float(np.sum((new.T @ residuals) ** 2)), float(residuals @ residuals)
    if free < 1 or not explained:
        return 0.0, 1.0
    return explained / total, _f_probability(explained, total - explained, new.shape[1], free)


def digit_variance(prepared: PreparedOutput, rms: float) -> float:
    """Variance of the mean error of readings rounded to the digits of the output."""
    digit = digit_of(np.concatenate(prepared.measured))
    if digit is None:
        return 0.0
    return rounding_variance(digit, max(rms**2 - digit**2 / 12, 0.0) ** 0.5)


def digit_covariance(found: RunsFit) -> np.ndarray:
    """Covariance of a fit's free numbers by the digits of its outputs.

    Readings of one value have the same rounding error, so that many are worth no more than one.
    """
    case, slopes = found.case, found.slopes()
    parts = zip(*(case.split(i, each) for i, each in enumerate(slopes)), strict=True)
    own = [np.concatenate(part) for part in parts]  # by output
    rms = np.sqrt(np.mean(found.rms**2, axis=0))
    variances = [digit_variance(s, float(r)) for s, r in zip(case.prepared, rms, strict=True)]
    covariance = np.zeros((own[0].shape[1],) * 2)
    if not any(variances):
        return covariance
    noise = np.maximum(rms, [s.floor for s in case.prepared])
    weight = np.repeat(1.0 / noise, list(map(len, own)))
    inverse = np.linalg.pinv(weight[:, None] * np.concatenate(own))
    each = np.split((inverse * weight).T, np.cumsum(list(map(len, own)))[:-1])
    for s, variance, part in zip(case.prepared, variances, each, strict=True):
        values, which = np.unique(np.concatenate(s.measured), return_inverse=True)
        by_value = np.zeros((len(values), len(covariance)))
        np.add.at(by_value, which, part)
        covariance += variance * by_value.T @ by_value
    return covariance


def predict_runs(found: RunsFit, runs: Sequence[Run]) -> dict[str, tuple[HeldOutRun, ...]]:
    """Predict held-out runs, by output."""
    predictions: dict[str, list[HeldOutRun]] = {s.output: [] for s in found.case.prepared}
    for run in runs:
        case = found.case.for_runs((run,))
        for prepared, residuals in zip(case.prepared, case.predict_held_out(found), strict=True):
            percent = explained_percent(residuals, prepared.measured[0])
            rms = float(np.sqrt(np.mean(residuals**2)))
            predictions[prepared.output].append(HeldOutRun(run.name, percent, rms))
    return {name: tuple(each) for name, each in predictions.items()}


def fuller_model_slopes(prepared: PreparedOutput, fit: Fit) -> list[np.ndarray]:
    """Slopes of the output by parameters that change with the inputs, their squares, or time, by
    run.

    All are centred, so that a parameter keeps its mean.
    """
    found = []
    for run in prepared.runs:
        u, time = prepared.scaled(run.u), np.cumsum(np.asarray(run.dt))[:, None]
        added = operating_point_slopes(
            fit.model, run, np.concatenate([u, u**2 - 1.0, time / time[-1] - 0.5], axis=1)
        )
        found.append(np.asarray(added)[: run.count])
    return found
