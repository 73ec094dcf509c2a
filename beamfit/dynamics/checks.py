"""Tests of the residuals of an identified response, and predictions of runs it never saw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc

from beamfit.dynamics.model import CLOSE, Driven, PreparedOutput, changed_by
from beamfit.dynamics.record import Run, Way
from beamfit.dynamics.response import FIRST_ORDER
from beamfit.dynamics.search import (
    Begun,
    drift_columns,
    drift_costs,
    driven_by,
    spanned,
    unit_outputs,
    whitened_rows,
)
from beamfit.greybox.fit import Fit
from beamfit.noise.digits import digit_of, rounding_variance
from beamfit.noise.memory import CorrelatedNoise

# Most lags of residuals, of earlier inputs, and of later inputs.
LAGS, PAST, LATER = 20, 10, 5
# Time constants of the additional paths in the test for a fuller model.
SLOW = 5
# Share of an input's variance, independent of other inputs, below which its gain is not separable.
ALONE = 1e-3


class Checks(NamedTuple):
    """Tests of the residuals of the free-running output.

    Attributes
    ----------
    free_run_percent : float
        100 (1 - |residual| / |output - mean|).
    one_step_percent : float
        The same for predictions from the reading before, by the noise's memory.
    nothing_probability : float
        Chance that a response explains so much of an output that hangs on no input (F).
    white_probability : float
        Chance of so large correlations of the residuals in white noise (Ljung and Box 1978).
    input_probability : float
        Chance that past inputs, or parameters that change with the operating point, explain so
        much of the whitened residuals if they have no part in them (F).
    input_share : float
        The part of the whitened residuals' squares that these explain.
    feedback_probability, feedback_share : float
        The same for inputs of the same moment and later, which only a feedback would explain.
    against_constant : float or None
        By how much the Bayesian information criterion falls from constant parameters.
    together : tuple of str
        Inputs that the others give but for a thousandth of their variance.
    first_order : bool
        Whether a first order does as well.
    law : str or None
        The law of an input, or the further term of a fuller response, that is likelier than none,
        or those between which the runs do not tell, in words.
    law_probability : float
        Its probability, where it and none are all that can be.
    law_kind : str
        Its kind.
    band_limited : tuple of str
        Inputs without high frequencies that the model holds from sample to sample; if they move
        between, that goes with later inputs.
    way : Way
        Inputs without high frequencies that the model follows between samples, and those that it
        has at the levels about which their readings scatter.
    jitter : float
        Standard deviation of the times of readings about those of the record, s.
    drift : int
        Degree of the drift of the output that is fitted beside the response.
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
    law_probability: float = 0.0
    law_kind: str = ""
    band_limited: tuple[str, ...] = ()
    way: Way = Way()
    jitter: float = 0.0
    drift: int = 0

    def rows(self) -> list[list[str]]:
        """Label and value."""
        rows = [
            ["free run explains", f"{self.free_run_percent:.2f} %"],
            ["one step ahead", f"{self.one_step_percent:.2f} %"],
            ["residuals white", f"p = {self.white_probability:.2g}"],
            [
                "residuals explained",
                f"{100 * self.input_share:.1f} %, p = {self.input_probability:.2g}",
            ],
        ]
        if self.against_constant is not None:
            rows.append(["BIC below constant", f"{self.against_constant:.1f}"])
        return rows


class HeldOutRun(NamedTuple):
    """A run that was only predicted: its name, how much is explained, and its rms residual."""

    name: str
    free_run_percent: float
    rms: float

    def row(self) -> list[str]:
        """Label and value."""
        return [f"held back {self.name}", f"{self.free_run_percent:.2f} %, rms {self.rms:.3g}"]


def percent(rest: np.ndarray, y: np.ndarray) -> float:
    """Explained part of y in percent: 100 (1 - |rest| / |y - mean|)."""
    whole = float(np.linalg.norm(y - y.mean()))
    return 100.0 * (1.0 - float(np.linalg.norm(rest)) / whole) if whole > 0 else 0.0


def checks_of(
    begun: Begun, k: int, changing: Sequence[np.ndarray], used: int, gain: float | None = None
) -> Checks:
    """Test the residuals of an output in every run together.

    `changing` are slopes of each run's output by what fuller models would have, `used` is the
    count of numbers that were fitted to it.
    """
    (case, path, found), seen = begun, begun.case.seen[k]
    residuals = tuple(row[k] for row in found.rest)
    own = [case.split(i, slopes)[k] for i, slopes in enumerate(found.slopes(case))]
    jitter, memory = max(row[k].jitter for row in found.noise), found.errors and found.errors.noise
    errors = [row[k].each for row in found.noise]
    noise = RunNoises(seen.time, errors, memory, seen.parts if jitter else 0)
    moved = zip(seen.measured, case.drifts(found.fit.model), strict=True)
    y = [m - row[k] - np.mean(m - row[k]) for m, row in moved]
    rest = np.concatenate(residuals)
    (explained, chance), (later, fed) = _explained(seen, residuals, noise, own, changing)
    white = _white([r / error for r, error in zip(residuals, noise.errors, strict=True)])
    if rest.std() <= CLOSE * seen.size_y:  # what is left is rounding, or the network's own detail
        explained, chance, later, fed, white = 0.0, 1.0, 0.0, 1.0, 1.0
    rounded = variance_of_digits(seen, rest.std())  # what is explained may be no more than that
    if explained * rest.var() <= rounded:
        explained, chance = 0.0, 1.0
    if later * rest.var() <= rounded:
        later, fed = 0.0, 1.0
    whole, left = (float(v @ v) for v in (noise.white(y), noise.white(residuals)))
    return Checks(
        percent(rest, np.concatenate(y)),
        percent(noise.ahead(residuals), np.concatenate(y)),
        _chance(whole - left, left, used, len(rest) - used),
        white,
        chance,
        explained,
        fed,
        later,
        gain,
        _together(seen),
        way=path.way,
        jitter=jitter,
        drift=case.degree,
    )


def _together(seen: PreparedOutput) -> tuple[str, ...]:
    """Inputs whose gains cannot be told apart: their variance inflation is above a thousand."""
    u = (seen.points - seen.points.mean(0)) / seen.wide
    found = []
    for i, name in enumerate(seen.inputs):
        one, others = u[:, i], np.delete(u, i, axis=1)
        rest = one - others @ np.linalg.lstsq(others, one, rcond=1e-10)[0]
        if rest @ rest < ALONE * (one @ one):
            found.append(name)
    return tuple(found)


def _chance(explained: float, left: float, used: int, free: int) -> float:
    """Chance that so many numbers explain so much of squares if nothing is to be explained (F)."""
    if free < 1 or used < 1 or explained <= 0.0:
        return 1.0
    return float(fdtrc(used, free, explained / used / max(left / free, 1e-300)))


class RunNoises(NamedTuple):
    """Noise of an output: times and errors of the readings of each run, and the memory.

    `jitter` is how many rows earlier or later readings may have been taken.
    """

    times: Sequence[np.ndarray]
    errors: Sequence[np.ndarray]
    memory: CorrelatedNoise | None
    jitter: int = 0

    def white(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Columns of readings, by run, in noise without a memory and of size 1."""
        each = zip(parts, self.errors, self.times, strict=True)
        return np.concatenate([
            whitened_rows(part / np.expand_dims(error, tuple(range(1, part.ndim))),
                          time, self.memory)[0]
            for part, error, time in each
        ])  # fmt: skip

    def drift(self, own: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Columns of a drift that whitened residuals show beside a model's own slopes, as many as
        the Bayesian information criterion wants.
        """
        runs = len(self.times)
        waves = self.white([drift_columns(t / t[-1], i, runs).reshape(len(t), -1)
                            for i, t in enumerate(self.times)])  # fmt: skip
        triangle = np.linalg.qr(np.column_stack([spanned(own), waves, rest]), mode="r")
        return waves[:, : runs * int(drift_costs(triangle, runs, len(rest)).argmin())]

    def ahead(self, residuals: Sequence[np.ndarray]) -> np.ndarray:
        """Residuals of predictions from the readings before."""
        found = []
        for r, error, time in zip(residuals, self.errors, self.times, strict=True):
            white, volume = whitened_rows(r / error, time, self.memory)
            found.append(white * error * np.exp(volume / len(r)))
        return np.concatenate(found)


def _white(residuals: Sequence[np.ndarray]) -> float:
    count = sum(map(len, residuals))
    lags = min(LAGS, count // 5)
    squares = max(sum(float(r @ r) for r in residuals), 1e-300)
    found = [sum(float(r[k:] @ r[:-k]) for r in residuals) / squares for k in range(1, lags + 1)]
    q = count * (count + 2) * sum(c**2 / (count - k) for k, c in enumerate(found, start=1))
    return float(chdtrc(lags, q))


def _explained(
    seen: PreparedOutput,
    residuals: tuple[np.ndarray, ...],
    noise: RunNoises,
    own: Sequence[np.ndarray],
    changing: Sequence[np.ndarray],
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Share of the whitened residuals that a fuller model explains, with its chance, and the share
    of the rest that later inputs explain.

    A score test (Lagrange multipliers): columns are inputs before, those within the delay too,
    further paths of first order, and the slopes of the output by parameters that change with the
    operating point, less what the model's own numbers can do.
    """
    quick, later, delay = [], [], int(np.floor(seen.delay))
    for run, added in zip(seen.runs, changing, strict=True):
        u = seen.scaled(run.u)
        index = run.read
        past = [u[np.clip(index + k, 0, len(u) - 1)] for k in range(-PAST, delay)]
        first = delay + noise.jitter  # a late reading has seen the input of its row
        after = [u[np.clip(index + first + k, 0, len(u) - 1)] for k in range(LATER)]
        later.append(np.concatenate(after, axis=1))
        quick.append(np.concatenate([*past, added], axis=1))
    own, slow, quick, later = (noise.white(part) for part in (own, slow_paths(seen), quick, later))
    rest = noise.white(residuals)
    own = np.hstack([own, noise.drift(own, rest)])
    basis = spanned(own)
    rest = rest - basis @ (basis.T @ rest)
    tests = [_tested(rest, basis, columns) for columns in (slow, quick)]
    share, chance = min(tests, key=lambda each: each[1])
    basis = spanned(np.hstack([own, slow, quick]))
    rest = rest - basis @ (basis.T @ rest)
    return (share, min(2.0 * chance, 1.0)), _tested(rest, basis, later)


def slow_lags(seen: PreparedOutput) -> np.ndarray:
    """Time constants of the further paths, s."""
    return np.geomspace(seen.apart, seen.span / 4, SLOW)


def slow_paths(seen: PreparedOutput) -> list[np.ndarray]:
    """Outputs of further paths of first order from each input, shape (readings, paths) by run."""
    return [paths_by(run, slow_lags(seen)[:, None]) for run in driven_by(seen, FIRST_ORDER)]


def paths_by(run: Driven, shapes: np.ndarray) -> np.ndarray:
    """Outputs of a run for unit gains by each shape, shape (readings, shapes * inputs)."""
    found = np.asarray(unit_outputs(run, shapes))[:, : run.u.shape[1], : run.count]
    return found.reshape(-1, run.count).T


def _tested(rest: np.ndarray, basis: np.ndarray, columns: np.ndarray) -> tuple[float, float]:
    """Share of the squares that columns explain beyond a basis, and its chance (F)."""
    new = spanned(columns - basis @ (basis.T @ columns), np.linalg.norm(columns, axis=0))
    free = len(rest) - basis.shape[1] - new.shape[1]
    inside, whole = float(np.sum((new.T @ rest) ** 2)), float(rest @ rest)
    if free < 1 or not inside:
        return 0.0, 1.0
    return inside / whole, _chance(inside, whole - inside, new.shape[1], free)


def variance_of_digits(seen: PreparedOutput, rms: float) -> float:
    """Variance of the mean error of readings that were rounded to the digits of the output."""
    digit = digit_of(np.concatenate(seen.measured))
    if digit is None:
        return 0.0
    return rounding_variance(digit, max(rms**2 - digit**2 / 12, 0.0) ** 0.5)


def digits_of(begun: Begun) -> np.ndarray:
    """Covariance of a fit's free numbers by the digits of its outputs: readings of one value were
    all rounded alike, so that many are worth no more than one.
    """
    case, slopes = begun.case, begun.settled.slopes(begun.case)
    parts = zip(*(case.split(i, each) for i, each in enumerate(slopes)), strict=True)
    own = [np.concatenate(part) for part in parts]  # by output
    rms = np.sqrt(np.mean(begun.settled.rms**2, axis=0))
    variances = [variance_of_digits(s, float(r)) for s, r in zip(case.seen, rms, strict=True)]
    found = np.zeros((own[0].shape[1],) * 2)
    if not any(variances):
        return found
    least = np.maximum(rms, [CLOSE * s.size_y for s in case.seen])
    weight = np.repeat(1.0 / least, list(map(len, own)))
    inverse = np.linalg.pinv(weight[:, None] * np.concatenate(own))
    each = np.split((inverse * weight).T, np.cumsum(list(map(len, own)))[:-1])
    for s, variance, part in zip(case.seen, variances, each, strict=True):
        values, which = np.unique(np.concatenate(s.measured), return_inverse=True)
        by_value = np.zeros((len(values), len(found)))
        np.add.at(by_value, which, part)
        found += variance * by_value.T @ by_value
    return found


def held_out(begun: Begun, runs: Sequence[Run]) -> dict[str, tuple[HeldOutRun, ...]]:
    """Predict runs that were held back, by output."""
    ahead: dict[str, list[HeldOutRun]] = {s.output: [] for s in begun.case.seen}
    for run in runs:
        case = begun.on((run,))
        for s, rest in zip(case.seen, case.ahead(begun.settled), strict=True):
            rms = float(np.sqrt(np.mean(rest**2)))
            ahead[s.output].append(HeldOutRun(run.name, percent(rest, s.measured[0]), rms))
    return {name: tuple(each) for name, each in ahead.items()}


def changing_of(seen: PreparedOutput, fit: Fit) -> list[np.ndarray]:
    """Slopes of a response's output by parameters that change with the inputs, their squares and
    the time, by run: all about their means, so that a parameter is its mean.
    """
    found = []
    for run in seen.runs:
        u, time = seen.scaled(run.u), np.cumsum(np.asarray(run.dt))[:, None]
        added = changed_by(
            fit.model, run, np.concatenate([u, u**2 - 1.0, time / time[-1] - 0.5], axis=1)
        )
        found.append(np.asarray(added)[: run.count])
    return found
