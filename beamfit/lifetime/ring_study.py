"""Study of the decays of a shift: scales, loss budget, best settings, next decay, changes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag
from scipy.special import chdtrc, logsumexp

from beamfit.answer import Row, Table, answer, cell, json_of, labelled
from beamfit.errors import Finding, InputError, Judged
from beamfit.greybox.design import Information, scores
from beamfit.lifetime.decay_law import current as beam_at
from beamfit.lifetime.expansion import MAX_RELATIVE_ERROR, Expansion, lifetime_of
from beamfit.lifetime.fill_noise import quantiles
from beamfit.lifetime.fit import bare
from beamfit.lifetime.loss_network import N_VOLTAGES, NetworkFit, fit_loss_network
from beamfit.lifetime.mechanisms import (
    MECHANISMS,
    SCALES,
    LossTerms,
    scaled_losses,
    scaled_parts,
    terms_at_voltages,
)
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scales import (
    MENTION_PROBABILITY,
    VOLTAGE,
    DecaySet,
    ScaleFit,
    Summaries,
    add_errors,
    fit_scales,
    information_root,
    loss_parts,
)
from beamfit.lifetime.study import Decay, Machine, settings_json, settings_of
from beamfit.quantity import HOUR, Quantity, Status, percent
from beamfit.sampling.posterior import Interval, Posterior
from beamfit.statistics import CENTRAL, POOR_FIT, quantity_of_draws

# Likely causes of a change of a, b, or both.
CAUSES = {
    "a": "the bunch or the momentum acceptance changed, or the beam-induced pressure",
    "b": "a gas loss that the gauge does not see: a leak away from it, heavier gas, aperture",
    "a and b": "gas with desorption, or an aperture, that gauge and settings do not show",
}


class Anomaly(NamedTuple):
    """Lasting change of a or b, and its start.

    Attributes
    ----------
    status : Status
        `converged` if the decays follow the model, `poor_fit` if a or b changed.
    message : str
        Verdict in a sentence.
    since : str or None
        Name of the first decay after the change.
    moved : tuple of str
        "a", "b", both or none.
    a, b : Quantity
        Relative change of a and b since then.
    probability : float
        Probability of a change as large, at any time, by chance.
    """

    status: Status
    message: str
    since: str | None
    moved: tuple[str, ...]
    a: Quantity
    b: Quantity
    probability: float


def _whitened_residuals(fit: ScaleFit, decays: Sequence[Decay]) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of later decays against the fit, whitened under each noise of the fit.

    The errors of scales and pressures and the scatter are part of the covariance.

    Returns
    -------
    residuals : array, shape (k, 2n)
        Measurement minus model.
    slopes : array, shape (k, 2n, n, 2)
        Slopes by relative changes of a and of b of each decay.
    """
    later = DecaySet.of(decays, fit.machine, fit.decays.pressure_error, fit.voltages)
    _, residuals, rows, change = fit.linearise(later)
    count, noise, found = 2 * len(decays), fit.noise, []
    loss_slopes = block_diag(*change).reshape(count, -1, 2)
    for k in range(noise.weight.size):
        by_scales = (rows @ noise.covariance_root[k]).reshape(count, -1)
        scattered = (loss_slopes * noise.scatter[k]).reshape(count, -1)
        shifted = (residuals + rows @ (noise.shift[k] - noise.centre)).ravel()
        whiten = add_errors(np.eye(count), np.hstack([by_scales, scattered]))
        found.append((-whiten @ shifted, np.tensordot(whiten, loss_slopes, 1)))
    return tuple(map(np.array, zip(*found, strict=True)))


def _fit_changes(
    residuals: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reduction of chi², best changes, and their covariance, for each noise."""
    transposed = np.swapaxes(slopes, 1, 2)
    covariance = np.linalg.pinv(transposed @ slopes)
    score = np.einsum("kij,kj->ki", transposed, residuals)
    found = np.einsum("kij,kj->ki", covariance, score)
    return np.sum(found * score, axis=1), found, covariance


def find_anomaly(fit: ScaleFit, decays: Sequence[Decay]) -> Anomaly:
    """Look for a lasting change of a or b against the fitted model.

    Parameters
    ----------
    fit : ScaleFit
        Model fitted to earlier decays, which are taken as normal.
    decays : sequence of Decay
        Later decays, in order of time.

    Returns
    -------
    Anomaly
        Most probable change and its start, if chance does not explain the decays.

    Raises
    ------
    InputError
        If there is no decay, or a record's settings store no beam.

    Notes
    -----
    For each possible start, relative changes of a and b from there on are fitted by linear least
    squares with the covariance of readings, scatter, pressure gauge and scales. The reduction of
    chi² has two degrees of freedom; its probability, averaged over the noises of the fit, is
    multiplied by the number of starts. A pressure rise that the gauge shows is part of the model.
    """
    if not decays:
        raise InputError("no decay", "one or more to compare with the model")
    # A reduction of chi² by two parameters has the probability exp(-reduction/2).
    (residuals, slopes), weight = _whitened_residuals(fit, decays), fit.noise.weight
    since = [slopes[:, :, first:].sum(axis=2) for first in range(len(decays))]
    trials = [_fit_changes(residuals, step) for step in since]
    logs = [logsumexp(np.log(weight) - reduction / 2) for reduction, *_ in trials]
    best = int(np.argmin(logs))
    probability = min(1.0, len(decays) * math.exp(logs[best]))
    reductions, found, covariance = trials[best]
    mean = weight @ found
    spread = np.diagonal(covariance, axis1=1, axis2=2) + (found - mean) ** 2
    error = np.sqrt(weight @ spread)
    a, b = (Quantity(float(v), float(e), "1") for v, e in zip(mean, error, strict=True))
    if probability > POOR_FIT:
        message = f"{len(decays)} decays follow the model (p = {probability:.2g})."
        return Anomaly(Status.converged, message, None, (), a, b, probability)
    moved = _changed_names(residuals, since[best], reductions, weight)
    start = decays[best].fit.record
    names = " and ".join(moved)
    changes = ", ".join(
        f"{name} by {100 * q.value:+.3g} ± {100 * q.error:.2g} %"
        for name, q in (("a", a), ("b", b))
        if name in moved
    )
    message = f"{names} moved since {start} ({changes}; p = {probability:.2g}): {CAUSES[names]}."
    return Anomaly(Status.poor_fit, message, start, moved, a, b, probability)


def _changed_names(
    residuals: np.ndarray, slopes: np.ndarray, reductions: np.ndarray, weight: np.ndarray
) -> tuple[str, ...]:
    """Names of what changed: a or b alone, if that explains the decays as well as both."""
    alone = {name: _fit_changes(residuals, slopes[:, :, [k]])[0] for k, name in enumerate("ab")}
    reductions = {name: np.maximum(reductions - own, 0.0) for name, own in alone.items()}
    probability = {name: weight @ chdtrc(1.0, reduction) for name, reduction in reductions.items()}
    best = max(probability, key=probability.get)
    return (best,) if probability[best] > POOR_FIT else ("a", "b")


# Units of the rows of a loss budget.
BUDGET_UNITS = {m.name: "1/h" for m in MECHANISMS if m.vary} | {
    "a": "1/(mA s)", "b": "1/s", "lifetime": "h"
}  # fmt: skip


@jax.jit
def _budget_row(scales: Array, terms: LossTerms) -> Array:
    """Values of `BUDGET_UNITS` at the current of the terms."""
    losses = scaled_parts(scales, terms)
    rates = losses.rates(terms.current)
    parts = [HOUR * rates[name] for name in BUDGET_UNITS if name in rates]
    return jnp.stack([*parts, losses.a, losses.b, 1 / _rate(scales, terms) / HOUR])


def budget_intervals(
    fit: ScaleFit,
    sample: Posterior,
    operation: Operation,
    current: float,
    probability: float = 0.68,
) -> tuple[Interval, ...]:
    """Loss budget at a setting, with credible intervals.

    Parameters
    ----------
    fit : ScaleFit
        Fitted scales.
    sample : Posterior
        Their draws.
    operation : Operation
        Settings and vacuum.
    current : float
        Beam current, mA.
    probability : float, optional
        Probability of the intervals.

    Returns
    -------
    tuple of Interval
        Loss rate of each mechanism, 1/h, a, b, and the lifetime, h; NaN where only the limits of
        the scales determine them.
    """
    terms = fit.terms_at(operation, current)
    draws = np.asarray(jax.vmap(_budget_row, (0, None))(sample.draws, terms))
    ends = np.percentile(draws, [50, 50 - 50 * probability, 50 + 50 * probability], axis=0)
    determined = fit.determines(_budget_row, terms)
    found = np.where(determined, ends, np.nan).T
    return tuple(
        Interval(name, *map(float, values), unit, bool(known))
        for (name, unit), values, known in zip(BUDGET_UNITS.items(), found, determined, strict=True)
    )


@jax.jit
def _rate(scales: Array, terms: LossTerms) -> Array:
    """Loss rate at the mean current, 1/s."""
    a, b = scaled_losses(scales, terms)
    return a * terms.current + b


# Number of readings, means of neighbours, that represent a possible decay: chosen, enough for its
# curvature.
CANDIDATE_READINGS = 64


class DecayCandidate(NamedTuple):
    """Decay that could be recorded next.

    Attributes
    ----------
    operation : Operation
        Settings and vacuum.
    current : float
        Initial current, mA.
    duration : float
        Duration, s.
    noise : float
        Standard deviation of the mean of the readings in 1/64 of the duration, mA.
    """

    operation: Operation
    current: float
    duration: float
    noise: float


class Proposal(NamedTuple):
    """Possible decay with the information it would bring.

    Attributes
    ----------
    candidate : DecayCandidate
        The decay.
    information : float
        Logarithm of the factor by which the volume of the scales' error ellipsoid shrinks.
    errors : array, shape (4,)
        Expected standard deviations of the scales Touschek, bremsstrahlung, elastic, desorption
        with this decay.
    """

    candidate: DecayCandidate
    information: float
    errors: np.ndarray


def _candidate_rows(fit: ScaleFit, candidate: DecayCandidate) -> np.ndarray:
    """Slopes of the candidate's parts by the scales, in standard errors, shape (2, scales)."""
    terms = fit.terms_at(candidate.operation, candidate.current)
    a, b = map(float, scaled_losses(fit.vector, terms))
    time = np.linspace(0.0, candidate.duration, CANDIDATE_READINGS)
    beam = np.asarray(beam_at(time, candidate.current, a, b))
    record = DecayRecord(time, beam, np.full(CANDIDATE_READINGS, candidate.noise))
    mean, root = beam.mean(), information_root(Expansion.at(record, candidate.current, a, b))
    summary = Summaries(mean, loss_parts(a, b, mean), root)
    candidate_set = terms._replace(current=mean), summary
    batch = jax.tree.map(lambda part: np.asarray(part)[None], candidate_set)
    candidate_set = DecaySet(*batch, fit.decays.pressure_error)
    *_, [rows], [change] = fit.linearise(candidate_set)
    # Scatter of a new decay: that of the most probable noise.
    scattered = change * fit.noise.scatter[fit.noise.most_probable]
    return add_errors(np.eye(2), scattered) @ rows


def next_decays(fit: ScaleFit, candidates: Sequence[DecayCandidate]) -> tuple[Proposal, ...]:
    """Rank possible decays by the information on the scales that they would bring.

    Parameters
    ----------
    fit : ScaleFit
        Fit to the decays so far.
    candidates : sequence of DecayCandidate
        Possible decays.

    Returns
    -------
    tuple of Proposal
        Most informative decay first (D-optimality, in linear approximation).

    Raises
    ------
    InputError
        If there is no candidate, or one has no duration, current or noise.
    """
    if not candidates:
        raise InputError("no candidate", "one decay or more to choose from")
    for candidate in candidates:
        if not min(candidate.current, candidate.duration, candidate.noise) > 0:
            raise InputError(f"{candidate[1:]}", "current, duration and noise above zero")
    # The limits of the scales count as a wide prior.
    problem, identity = fit.fit.problem, np.eye(fit.vector.size)
    with_prior = np.isin(problem.names, [prior.name for prior in problem.priors])
    information = Information(
        fit.fit.dense_jacobian, np.ones(1), identity, np.ones(len(identity), bool), problem.lower,
        problem.upper, with_prior=with_prior,
    )  # fmt: skip
    rows = np.array([_candidate_rows(fit, candidate) for candidate in candidates])
    [before] = scores(information, np.zeros((1, *rows.shape[1:])), volume=True)
    gains = 0.5 * (before - scores(information, rows, volume=True))
    proposals = [
        Proposal(candidate, float(gain), information.with_rows(candidate_rows).error)
        for candidate, candidate_rows, gain in zip(candidates, rows, gains, strict=True)
    ]
    return tuple(sorted(proposals, key=lambda proposal: -proposal.information))


class Limits(NamedTuple):
    """Lower and upper limit of each setting.

    Attributes
    ----------
    rf_voltage : (float, float)
        RF voltage, V.
    scraper_y : (float, float)
        Distance of the scraper from the beam, m.
    bunches : (float, float)
        Number of bunches.
    """

    rf_voltage: tuple[float, float]
    scraper_y: tuple[float, float]
    bunches: tuple[float, float]


class BestPoint(NamedTuple):
    """Settings of the longest lifetime.

    Attributes
    ----------
    rf_voltage : Quantity
        Best RF voltage, V. Its error is the spread of the best voltage over the posterior, and
        contains the step of the search.
    scraper_y, bunches : float
        Distance of the scraper, m, and number of bunches: always the upper limits.
    lifetime : Quantity
        Lifetime at these settings, h; NaN where the decays do not determine it.
    usual : Quantity
        Lifetime at the machine's usual settings, h; NaN where the decays do not determine it.
    message : str
        Sentence on what limits the voltage.
    """

    rf_voltage: Quantity
    scraper_y: float
    bunches: float
    lifetime: Quantity
    usual: Quantity
    message: str

    @property
    def status(self) -> Status:
        """`unidentified` where the decays do not determine the lifetime there."""
        return Status.unidentified if self.lifetime.error is None else Status.converged


def _lifetime(fit: ScaleFit, sample: Posterior, operation: Operation, current: float) -> Quantity:
    terms = fit.terms_at(operation, current)
    if not fit.determines(_rate, terms):
        return Quantity(math.nan, None, "h")
    rates = jax.vmap(_rate, (0, None))(sample.draws, terms)
    return quantity_of_draws(1 / np.asarray(rates) / HOUR, "h")


def best_operating_point(
    fit: ScaleFit, sample: Posterior, limits: Limits, current: float
) -> BestPoint:
    """Find the settings of the longest lifetime within limits.

    Parameters
    ----------
    fit : ScaleFit
        Fitted scales.
    sample : Posterior
        Their draws.
    limits : Limits
        Limits of the settings.
    current : float
        Beam current, mA.

    Returns
    -------
    BestPoint
        Best settings, with the spread of the voltage over the posterior.

    Raises
    ------
    InputError
        If a limit is empty, or no voltage within the limits stores a beam.

    Notes
    -----
    More bunches and a wider scraper never shorten the lifetime (a_T falls with both bunch
    population and length, the elastic cross section with the acceptance), so both sit at their
    upper limits. The voltage has an inner optimum where the bucket outgrows the lattice's
    acceptance: a grid, refined once around the best points of all draws.
    """
    for name, (low, high) in limits._asdict().items():
        if not 0 < low <= high:
            raise InputError(f"limits {low:g} to {high:g}", "0 < lower <= upper", column=name)
    low, high = limits.rf_voltage
    loss = float(fit.machine.ring.energy_loss)
    if high <= loss:
        expected = f"more than the loss of {loss:.6g} V a turn, or no beam is stored"
        raise InputError(f"at most {high:.6g} V", expected, column="rf_voltage")
    operation = fit.machine.operation
    open_settings = operation._replace(
        scraper_y=limits.scraper_y[1], bunches=float(limits.bunches[1])
    )
    low, draws = max(low, 1.01 * loss), sample.thinned()
    # The search is over true voltages; the setting is a reading.
    ratio = np.ones(len(draws)) if fit.voltages is None else draws[:, len(SCALES)]
    ends = max(low * ratio.min(), 1.01 * loss), max(high, low) * ratio.max()
    for _ in range(2):
        voltages = np.linspace(*ends, N_VOLTAGES)
        terms = terms_at_voltages(fit.machine.ring, open_settings, current, voltages)
        true = voltages[np.argmin(jax.vmap(_rate, (0, None))(draws, terms), axis=1)]
        step = voltages[1] - voltages[0]
        ends = max(voltages[0], true.min() - step), min(voltages[-1], true.max() + step)
    found = np.clip(true / ratio, low, max(high, low))
    spread = quantity_of_draws(found, "V")
    best, error = spread.value, math.hypot(spread.error, step / math.sqrt(12))
    is_inside = low + step < best < high - step
    lifetime = _lifetime(fit, sample, open_settings._replace(rf_voltage=best), current)
    message = (
        "The best RF voltage lies within its limits, where bucket and lattice acceptance meet."
        if is_inside
        else "The best RF voltage is at its limit: more range would help."
    )
    if lifetime.error is None:
        message = "The decays do not tell the lifetime at other settings: vary them."
        is_inside = False
    return BestPoint(
        rf_voltage=Quantity(best, error if is_inside else None, "V"),
        scraper_y=limits.scraper_y[1],
        bunches=limits.bunches[1],
        lifetime=lifetime,
        usual=_lifetime(fit, sample, operation, current),
        message=message,
    )


class LeaveOneOut(NamedTuple):
    """Leave-one-out prediction of a decay.

    Attributes
    ----------
    name : str
        Name of the decay.
    predicted : Quantity
        Lifetime at its mean current, h, from a fit to the other decays. The error contains those of
        the scales, of the decay's pressure reading, and its scatter.
    measured : Quantity
        Measured lifetime, h.
    pull : float
        Predicted minus measured loss rate, in standard errors of the difference.
    """

    name: str
    predicted: Quantity
    measured: Quantity
    pull: float


def predict_held_back(fit: ScaleFit) -> tuple[LeaveOneOut, ...]:
    """Predict the lifetime of each decay by a fit to all the others.

    Parameters
    ----------
    fit : ScaleFit
        Fit to all decays.

    Returns
    -------
    tuple of LeaveOneOut
        Predictions in the order of the decays, without decays that have no information on the loss
        and those that the other decays do not predict.

    Notes
    -----
    Least squares linearised about the fit, averaged over the noises. With the hat matrix
    H = J (JᵀJ)⁻¹ Jᵀ of one decay's whitened rows and its residuals r, the residuals of the fit
    without it are (1 - H)⁻¹ r, with covariance (1 - H)⁻¹: R. D. Cook and S. Weisberg, Residuals and
    Influence in Regression (1982), section 2.2.

    Examples
    --------
    >>> import beamfit
    >>> from beamfit.lifetime.scales import fit_scales
    >>> from beamfit.lifetime.study import Machine, study_record
    >>> path = "lattices/spear3_2003.toml"
    >>> machine = Machine(beamfit.read_ring(path), beamfit.read_operation(path))
    >>> record = beamfit.read_decay_record("measurements/spear3_shift_simulated.csv")
    >>> found = predict_held_back(fit_scales(study_record(record).decays, machine))
    >>> print(found[3].predicted, "predicted,", found[3].measured, "measured")
    9.82 ± 0.14 h predicted, 9.730669 ± 0.000098 h measured
    """
    measured, noise, found = fit.decays.measured, fit.noise, []
    weight, residuals, rows, change = fit.linearise(fit.decays)
    sizes = np.array([noise.sizes(i, len(fit.names)) for i in range(noise.weight.size)])
    for k, name in enumerate(fit.names):
        root = measured.root[k]
        if not np.any(root):
            continue
        inverse = np.linalg.inv(weight[k])
        difference, spread = _predict_without(
            residuals[k] + (noise.shift - noise.centre) @ rows[k].T,
            rows[k] @ noise.covariance_root,
            change[k] * sizes[:, k, None],
            change[k] * noise.scatter[:, None],
        )
        difference, variance = difference @ inverse[1], inverse[1] @ spread @ inverse[1]
        reading = np.linalg.inv(root)[1]
        rate, error = measured.parts[k, 1], np.linalg.norm(reading)
        # Under some noises a decay alone determines a scale, and is not predicted by the others.
        predicted = variance - error**2 < (MAX_RELATIVE_ERROR * rate) ** 2
        noise_weight = noise.weight * predicted
        if not noise_weight.sum() > MENTION_PROBABILITY:
            continue
        noise_weight = noise_weight / noise_weight.sum()
        low, high = quantiles(noise_weight, difference, np.sqrt(variance), CENTRAL)
        middle, spread = (low + high) / 2, (high - low) / 2
        by_others = np.sqrt(max(spread**2 - error**2, 0.0))
        lifetimes = lifetime_of(rate + middle, by_others), lifetime_of(rate, error)
        found.append(LeaveOneOut(name, *lifetimes, middle / spread))
    return tuple(found)


def _predict_without(
    residuals: np.ndarray, slopes: np.ndarray, scatter: np.ndarray, usual_scatter: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of a decay, (k, 2), against the fit to the others, and their covariance, by noise.

    Parameters
    ----------
    residuals : array, shape (k, 2)
        Residuals against the fit to all decays.
    slopes : array, shape (k, 2, r)
        Slopes by standard errors of the scales in the fit to all.
    scatter, usual_scatter : array, shape (k, 2, 2)
        Slopes by the scatter of this decay in the fit, and of any decay.
    """
    covariance = np.eye(2) + scatter @ scatter.mT
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, slopes)
    shares, vectors = np.linalg.eigh(white @ white.mT)
    # A decay that alone determines a scale has a prediction with infinite error.
    inverse = vectors / np.maximum(1 - shares, np.finfo(float).eps)[:, None] @ vectors.mT
    spread = root @ inverse @ root.mT - covariance + np.eye(2) + usual_scatter @ usual_scatter.mT
    return (root @ inverse @ np.linalg.solve(root, residuals[..., None]))[..., 0], spread


NOTE = (
    "Scales multiply the ring file's first principles. Brackets are 68 % credible intervals. The "
    "best point is sought within the range of settings seen."
)


@answer
@dataclass(frozen=True, eq=False)
class Shift(Judged):
    """Joint answer of the decays of a shift.

    Parameters
    ----------
    fit : ScaleFit
        Scales on the mechanisms.
    budget : tuple of Interval
        Loss budget at the machine's usual settings, 68 % credible intervals.
    current : float
        Current of budget and best point, mA: the highest mean current of the decays.
    limits : Limits
        Range of the settings in the decays, within which the best point is searched.
    best : BestPoint
        Settings of the longest lifetime within the limits.
    proposals : tuple of Proposal
        Decays to record next, the most informative first.
    anomaly : Anomaly or None
        Change of the second half of the decays against a fit to the first; None if the first half
        does not separate the mechanisms.
    network : NetworkFit or None
        Network that corrects first principles, if one was asked for.
    """

    fit: ScaleFit
    budget: tuple[Interval, ...]
    current: float
    limits: Limits
    best: BestPoint
    proposals: tuple[Proposal, ...]
    anomaly: Anomaly | None
    network: NetworkFit | None = None

    @property
    def finding(self) -> Finding:
        """Status and sentence on the scales."""
        return self.fit.finding

    @property
    def headline(self) -> str:
        """Number of decays and the status, in a line."""
        return f"{self._count} together: {cell(self.status)}"

    @property
    def _count(self) -> str:
        count = len(self.fit.names)
        return "1 decay" if count == 1 else f"{count} decays"

    @property
    def verdicts(self) -> list[tuple[str, Status, str]]:
        """Verdicts: name, status and sentence of each."""
        found = [(f"{self._count} together", self.status, self.message)]
        if self.undetermined:
            found.append(("loss budget", Status.unidentified, self.undetermined))
        found.append((f"best lifetime {self.best.lifetime}", self.best.status, self.best.message))
        if (moved := self.anomaly) is not None:
            found.append(("second half against the first", moved.status, moved.message))
        if self.network is not None:
            found.append(("network", self.network.fit.status, self.network.fit.message))
        return found

    @property
    def undetermined(self) -> str:
        """Sentence on the losses that the decays do not determine; empty if there are none."""
        names = [row.name for row in self.budget if not row.separable]
        if not names:
            return ""
        return (
            f"{', '.join(names)} at {self.current:.4g} mA and the usual settings are not "
            "determined, only limited by those of the scales: record longer, or vary the settings."
        )

    @cached_property
    def leave_one_out(self) -> tuple[LeaveOneOut, ...]:
        """Leave-one-out predictions of the decays."""
        return predict_held_back(self.fit)

    def tables(self) -> tuple[Table, ...]:
        """Tables of the scales with budget and advice, and of the network."""
        rows = [Row("status", [self.status]), *self._scale_rows(), *self._advice_rows()]
        tables = [labelled("First principles fitted to", [self._count], rows, NOTE)]
        if self.network is not None:
            rows = self.network.rows(self.current)
            tables.append(labelled("First principles corrected by a network", [self._count], rows))
        return tuple(tables)

    def _scale_rows(self) -> list[Row]:
        fit, rows = self.fit, []
        for name, scale in fit.scales.items():
            meaning, without = "scale on the ring file", "not separable"
            if name == VOLTAGE:
                meaning, without = "true over read", "not told: its prior's"
            value = without if scale.error is None else scale
            rows.append(Row(f"{name}, {meaning}", [value], True))
        chi2 = f"{fit.chi2:.4g}/{fit.dof}" if fit.dof > 0 else "not testable"
        rows.append(Row("chi2/dof without scatter", [chi2], True))
        for name, scatter in fit.scatter.items():
            limit = f"below {percent(scatter.interval_95[1])} at 95 %"
            text = percent(scatter.value) if scatter.value else limit
            rows.append(Row(f"scatter of {name} from fill to fill", [text], True))
        for row in self.budget:
            text = str(row).removeprefix(f"{row.name}: ") if row.separable else "not determined"
            rows.append(Row(f"{row.name} at {self.current:.4g} mA", [text], row.name == "lifetime"))
        return rows

    def _advice_rows(self) -> list[Row]:
        best, rows = self.best, []
        volts, error = best.rf_voltage.value / 1e3, best.rf_voltage.error
        limit = f"{volts:.6g} kV, at its limit"
        voltage = limit if error is None else Quantity(volts, error / 1e3, "kV")
        rows.append(Row("best RF voltage", [voltage], True))
        others = f"{1e3 * best.scraper_y:.4g} mm, {best.bunches:.6g}"
        rows.append(Row("best scraper and bunches", [others], True))
        rows.append(Row("lifetime there", [best.lifetime], True))
        if self.leave_one_out:
            pulls = np.abs([one.pull for one in self.leave_one_out])
            text = f"{sum(pulls < 1)} of {pulls.size} within 1, {sum(pulls < 2)} within 2 errors"
            rows.append(Row("each decay predicted by the others", [text]))
        for number, proposal in enumerate(self.proposals, 1):
            wanted = proposal.candidate
            at, scraper, bunches = map(float, wanted.operation[:3])
            text = f"{at / 1e3:.6g} kV, {1e3 * scraper:.4g} mm, {bunches:.6g} bunches, "
            text += f"{wanted.current:.4g} mA (information {proposal.information:.3g})"
            rows.append(Row(f"next decay, choice {number}", [text], number == 1))
        return rows

    def to_json(self) -> dict[str, Any]:
        """Answer as JSON's types, in SI units, mA and h."""
        proposals = [
            settings_json(p.candidate.operation)
            | {"current_mA": p.candidate.current, "information": p.information}
            for p in self.proposals
        ]
        found = {
            "scales": self.fit,
            "current": bare(self.current, "mA"),
            "budget": self.budget,
            "not_determined": self.undetermined,
            "held_back": self.leave_one_out,
            "best": self.best._asdict() | {"scraper_y": bare(self.best.scraper_y, "m")},
            "next": proposals,
            "anomaly": self.anomaly,
        }
        if self.network is not None:
            found["network"] = self.network.to_json(self.current)
        return json_of(found)


def study_shift(
    decays: Sequence[Decay],
    machine: Machine,
    seed: int = 0,
    network: bool = False,
    priors: Mapping[str, tuple[float, float]] | None = None,
) -> Shift:
    """Study the decays of a shift together.

    Parameters
    ----------
    decays : sequence of Decay
        Decays in order of time, at different settings.
    machine : Machine
        The ring, and the settings that the records do not give.
    seed : int, optional
        Seed of the random numbers.
    network : bool, optional
        Also fit a network that corrects first principles.
    priors : mapping of str to (mean, standard deviation), optional
        As for `fit_scales`.

    Returns
    -------
    Shift
        Joint answer; its scales show which mechanisms are not separable.

    Raises
    ------
    InputError
        As for `fit_scales`.

    Examples
    --------
    >>> import beamfit
    >>> beamfit.study_shift([], "lattices/spear3_2003.toml")
    Traceback (most recent call last):
    beamfit.errors.InputError: no decay; expected one or more; several settings separate the
    mechanisms
    """
    fit = fit_scales(decays, machine, priors=priors)
    sample = fit.sample(seed=seed)
    settings, currents = zip(*settings_of(decays, machine), strict=True)
    ranges = [[float(getattr(setting, name)) for setting in settings] for name in Limits._fields]
    limits, current = Limits(*((min(values), max(values)) for values in ranges)), max(currents)
    return Shift(
        fit=fit,
        budget=budget_intervals(fit, sample, machine.operation, current),
        current=current,
        limits=limits,
        best=best_operating_point(fit, sample, limits, current),
        proposals=next_decays(fit, _candidates(decays, machine, limits, current))[:3],
        anomaly=_anomaly(decays, machine, priors),
        network=fit_loss_network(decays, fit, seed=seed) if network else None,
    )


def _candidates(
    decays: Sequence[Decay], machine: Machine, limits: Limits, current: float
) -> list[DecayCandidate]:
    """Possible decays at the corners of the range of settings, as long and noisy as the decays."""
    duration = float(np.median([d.segment.span for d in decays]))
    means = [d.fit.rms_residual / np.sqrt(len(d.segment) / CANDIDATE_READINGS) for d in decays]
    noise = float(np.median(means))
    lowest = min(decay.fit.mean_current for decay in decays)
    corners = itertools.product(*(sorted(set(pair)) for pair in (*limits, (lowest, current))))
    return [
        DecayCandidate(
            machine.operation._replace(rf_voltage=voltage, scraper_y=scraper, bunches=bunches),
            at,
            duration,
            max(noise, 1e-9),
        )
        for voltage, scraper, bunches, at in corners
    ]


def _anomaly(
    decays: Sequence[Decay], machine: Machine, priors: Mapping[str, tuple[float, float]] | None
) -> Anomaly | None:
    half = len(decays) // 2
    if half < 4:
        return None
    reference = fit_scales(decays[:half], machine, priors=priors)
    # The second half cannot contradict scales that the first does not determine.
    if not np.isfinite(reference.spread.errors).all():
        return None
    return find_anomaly(reference, decays[half:])
