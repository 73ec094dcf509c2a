"""Fit of first principles to many decays: a scale on each loss mechanism, with errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import logsumexp
from scipy.linalg import block_diag

from beamfit.answer import json_of, shown
from beamfit.arrays import array_module, padded_length
from beamfit.errors import Finding, InputError, Judged, judge, nearest
from beamfit.greybox.covariance import Spread, spread_of
from beamfit.greybox.fit import Fit
from beamfit.greybox.posterior import Optimum, Statement, target_of
from beamfit.greybox.problem import Free, Prior, Problem, Record, with_slope
from beamfit.greybox.solve import solve
from beamfit.lifetime.expansion import LEVEL, LOSS, MAX_RELATIVE_ERROR, QUADRATIC, Expansion
from beamfit.lifetime.fill_noise import (
    MIN_HALF_RANGE,
    MODEL_SIZES,
    FillNoise,
    LinearDecays,
    log_likelihood,
    weigh_noises,
)
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.mechanisms import SCALES, LossTerms, loss_terms, scaled_losses
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.study import Decay, Machine, settings_of
from beamfit.quantity import Quantity, Status, percent
from beamfit.statistics import CENTRAL, POOR_FIT, WIDE

if TYPE_CHECKING:
    from beamfit.sampling.posterior import Posterior


class Summaries(NamedTuple):
    """Loss rates of decays at their mean currents, with the information matrix.

    They replace the readings: exact to second order about the fit.

    Attributes
    ----------
    current : array, shape (n,)
        Mean current I, mA.
    parts : array, shape (n, 2)
        Fitted a I and a I + b, 1/s. Every decay determines the second well, only a long one the
        first. Unlike a and b the two are nearly uncorrelated.
    root : array, shape (n, 2, 2)
        Upper triangular square root R of the information matrix: chi² of other values x, with I0
        adjusted, is |R (x - parts)|². A decay too short to separate a and b has a small entry
        there and takes part all the same.
    """

    current: Array
    parts: Array
    root: Array


def loss_parts(a: Array, b: Array, mean_current: Array) -> Array:
    """Parts a I and a I + b, 1/s, by which a decay is compared with a model."""
    quadratic = a * mean_current
    return array_module(quadratic).stack([quadratic, quadratic + b], axis=-1)


def loss_part_slopes(quadratic: Array, linear: Array) -> Array:
    """Slopes of the parts by relative changes of a and b, shape (n, 2, 2).

    `quadratic` is a I and `linear` is b, both 1/s.
    """
    xp = array_module(quadratic)
    rows = xp.asarray([[quadratic, xp.zeros_like(quadratic)], [quadratic, linear]])
    return xp.moveaxis(rows, -1, 0)


def information_root(expansion: Expansion, scale: float = 1.0) -> np.ndarray:
    """Upper triangular square root of the information on the two parts, s, with I0 eliminated.

    `scale` is the standard deviation of the residuals in units of their stated errors.
    """
    # QR eliminates columns from the left: the last two rows of R have the information without I0.
    rows = expansion.rows[:, [LEVEL, QUADRATIC, LOSS]] * (expansion.pieces.units[0] / scale)
    return np.linalg.qr(rows, mode="r")[1:, 1:]


def _decay_root(fit: DecayFit, expansion: Expansion) -> np.ndarray:
    """Root of the information of a decay, as in `Summaries`, with stated monitor errors added."""
    scale = max(np.sqrt(expansion.residuals @ expansion.residuals / fit.dof), expansion.min_factor)
    root = information_root(expansion, scale * fit.inflation)
    moved = [expansion.value_shifts(change) for change in expansion.pieces.monitor_changes]
    if not moved:
        return root
    changes = np.array([[m.a * expansion.pieces.units[1], m.rate_mean] for m in moved]).T
    return np.linalg.qr(add_errors(root, changes), mode="r")


def add_errors(root: Array, changes: Array) -> Array:
    """Add independent errors to the square root of an information matrix.

    Parameters
    ----------
    root : array, shape (..., n, n)
        Square root R of the information on n values, as in `Summaries`.
    changes : array, shape (..., n, k)
        Changes of the values by one standard deviation of each of k errors.

    Returns
    -------
    array, shape (..., n, n)
        W with WᵀW = Rᵀ (1 + G Gᵀ)⁻¹ R and G = R changes: the errors are integrated out.
    """
    xp, whitened = array_module(root, changes), root @ changes
    unit = xp.eye(root.shape[-1])
    cholesky = xp.linalg.cholesky(unit + whitened @ xp.swapaxes(whitened, -1, -2))
    return xp.linalg.solve(cholesky, root)


def _cycles_root(fit: DecayFit, rate: float) -> np.ndarray:
    """Root of the information of cycles fitted together: share of a and lifetime uncorrelated."""
    share, error = fit.identifiability.share_error, fit.lifetime_mean.relative or np.inf
    return np.diag(1 / (rate * np.array([np.inf if share is None else share, error])))


def summarise(decays: Sequence[Decay], power: float = 0.0) -> Summaries:
    """Reduce decays to their loss rates and information.

    Parameters
    ----------
    decays : sequence of Decay
        Fitted decays. A decay without a finite fit or without noise gets no information.
    power : float
        Exponent of a: a goes as this power of the current, and its value is that at the mean
        current. With an exponent, cycles fitted together get no information.

    Returns
    -------
    Summaries
        One row for each decay.

    Notes
    -----
    The residuals are linearised in (I0, a I, a I + b) about the fit, so chi² is a quadratic form;
    I0 is eliminated by QR. Errors are those of the fit, enlarged where chi²/dof exceeds 1 and for
    correlated residuals.

    Examples
    --------
    >>> from beamfit.lifetime.decay_law import current
    >>> from beamfit.lifetime.record import DecayRecord
    >>> from beamfit.lifetime.study import study_record
    >>> t = np.linspace(0, 36000, 100)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=100)
    >>> record = DecayRecord(t, np.array(current(t, 500.0, 2e-8, 1e-6)) + noise)
    >>> study = study_record(record, law="constant")
    >>> found = summarise(study.decays)
    >>> fit = study.decays[0].fit
    >>> error = 1 / abs(found.root[0, 1, 1])  # of the loss rate, with a I free
    >>> print(f"{error / found.parts[0, 1]:.1e}, by the fit {fit.lifetime_mean.relative:.1e}")
    2.1e-06, by the fit 2.1e-06
    """
    current = np.array([decay.fit.mean_current for decay in decays])
    parts, root = np.zeros((len(decays), 2)), np.zeros((len(decays), 2, 2))
    for k, decay in enumerate(decays):
        fit = decay.fit
        a, b = fit.if_constant("a").value, fit.if_constant("b").value
        if not (np.isfinite(a) and fit.rms_residual > 0):
            continue
        if fit.first is None:
            expansion = fit.with_power(power)
            parts[k] = loss_parts(expansion.values.a, expansion.values.b, fit.mean_current)
            root[k] = _decay_root(fit, expansion)
        elif not power:
            parts[k] = loss_parts(a, b, fit.mean_current)
            root[k] = _cycles_root(fit, parts[k, 1])
    return Summaries(current, parts, root)


# Relative error of a pressure reading by default: that of a calibrated gauge.
PRESSURE_ERROR = 0.05
# Name of the decays in the grey-box problem.
RECORD = "decays"
# Upper limit of a scale: far above any error of a ring file.
MAX_SCALE = 1e3
# Name of the scale of the RF voltage, which is free where a prior gives its calibration.
VOLTAGE = "rf_voltage"
# Range of that scale, in errors of its prior; losses are computed at each whole number of them.
VOLTAGE_RANGE = 3
# Largest number of iterations of fit and noise, and relative change of the scales at which they
# have converged.
MAX_ITERATIONS, SCALE_TOLERANCE = 8, 1e-3
# Scatter, or an odd decay, is mentioned above this probability.
MENTION_PROBABILITY = 0.95
# Relative step of the RF voltage for numerical differentiation of the losses.
VOLTAGE_STEP = 2e-3
# Number of noises that represent the mixture in the sampler: chosen for speed.
SAMPLED_NOISES = 48


class DecaySet(NamedTuple):
    """Measured losses of many decays, and those of first principles.

    Attributes
    ----------
    terms : LossTerms
        First principles at the settings of each decay; each part has shape (n,).
    measured : Summaries
        Measured loss rates.
    pressure_error : float
        Relative error of the pressure reading, independent in each record.
    """

    terms: LossTerms
    measured: Summaries
    pressure_error: Array

    @classmethod
    def of(
        cls,
        decays: Sequence[Decay],
        machine: Machine,
        pressure_error: float = PRESSURE_ERROR,
        voltages: np.ndarray | None = None,
    ) -> DecaySet:
        """Reduce decays and compute their loss terms; `voltages` as in `LossTerms`."""
        terms = _terms_of(settings_of(decays, machine), machine, voltages)
        return cls(terms, summarise(decays), pressure_error)

    def parts(self, scales: Array, factor: Array) -> Array:
        """Parts a I and a I + b of scaled first principles; `factor` multiplies the pressure."""
        return loss_parts(*scaled_losses(scales, self.terms, factor), self.terms.current)


def _terms_of(
    settings: Sequence[tuple[Operation, float]], machine: Machine, voltages: np.ndarray | None
) -> LossTerms:
    """Loss terms at settings and currents; each part has shape (n,)."""
    rows = [loss_terms(machine.ring, *setting, voltages) for setting in settings]
    return jax.tree.map(lambda *parts: np.stack(parts), *rows)


def whitener(scales: Array, decays: DecaySet) -> Array:
    """Root of the information with each pressure factor integrated out, shape (n, 2, 2)."""
    ones = jnp.ones_like(decays.terms.current)
    _, slope = jax.jvp(lambda factor: decays.parts(scales, factor), (ones,), (ones,))
    return add_errors(decays.measured.root, decays.pressure_error * slope[..., None])


def pulls(scales: Array, decays: DecaySet, weight: Array) -> Array:
    """Model minus measurement in standard errors, shape (n, 2); `weight` is from `whitener`."""
    difference = decays.parts(scales, jnp.ones_like(decays.terms.current)) - decays.measured.parts
    return jnp.einsum("nij,nj->ni", weight, difference)


@shown
@dataclass(frozen=True, eq=False)
class ScaleFit(Judged):
    """Scales on the mechanisms of first principles, from many decays.

    Parameters
    ----------
    fit : Fit
        Grey-box fit with the most probable noise; it includes the priors.
    machine : Machine
        The ring and its usual operation.
    decays : DecaySet
        Data of the fit.
    names : tuple of str
        Names of the decays.
    noise : FillNoise
        Scatter of the decays, and other departures, over which the answer is averaged.
    as_read : float
        Probability that the RF voltage equals its reading, if its scale is free without a prior.
    """

    fit: Fit
    machine: Machine
    decays: DecaySet
    names: tuple[str, ...]
    noise: FillNoise
    as_read: float = 1.0

    @cached_property
    def vector(self) -> np.ndarray:
        """All scales, separable or not: mean under the most probable model."""
        problem = self.fit.problem
        return np.clip(self.fit.theta + self.noise.centre, problem.lower, problem.upper)

    @cached_property
    def chi2(self) -> float:
        """chi² with the errors of decays and pressure readings, without scatter."""
        return float(np.sum(self.linearise(self.decays)[1] ** 2))

    @property
    def dof(self) -> int:
        """Degrees of freedom: two for each decay with information, less the scales."""
        informative = np.any(np.asarray(self.decays.measured.root) != 0, axis=-1)
        return int(np.sum(informative)) - len(SCALES)

    @cached_property
    def spread_raw(self) -> Spread:
        """Spread of the scales with the errors of decays and pressure readings, without scatter."""
        _, _, rows, _ = self.linearise(self.decays)
        priors = self.fit.dense_jacobian[2 * len(rows) :]
        unbounded = np.full(self.vector.shape, np.inf)
        rows = np.vstack([rows.reshape(-1, unbounded.size), priors])
        # The limits of the scales are no information.
        return spread_of(rows, -unbounded, unbounded)

    @cached_property
    def spread(self) -> Spread:
        """Spread of the scales over all noises."""
        return self.noise.spread(self.spread_raw)

    @cached_property
    def scatter(self) -> dict[str, Quantity]:
        """Relative scatter of a and of b from fill to fill, in addition to the known errors."""
        return {name: self._scatter(k) for k, name in enumerate("ab")}

    def _scatter(self, k: int) -> Quantity:
        sizes = self.noise.scatter[:, k]
        order = np.argsort(sizes)
        cumulated = np.cumsum(self.noise.weight[order])
        index = np.minimum(np.searchsorted(cumulated, (0.5, *CENTRAL, *WIDE)), len(order) - 1)
        median, low, high, *ends = map(float, sizes[order][index])
        return Quantity(median, (high - low) / 2, "1", None, tuple(ends))

    @property
    def remark(self) -> str:
        """Sentences on a misread voltage, scatter and an odd decay, where these are probable."""
        noise, sentences = self.noise, []
        if POOR_FIT < self.as_read < 1:
            sentences.append(f"{_misread(self)} (probability {1 - self.as_read:.2g}).")
        scatters = noise.scatter > 0
        likely = noise.weight @ scatters > 0.5
        sizes = [
            f"{percent(self.scatter[name].value)} in {name}"
            for name, is_likely in zip("ab", likely, strict=True)
            if is_likely and noise.weight @ scatters.any(axis=1) > MENTION_PROBABILITY
        ]
        if sizes:
            sentences.append(
                f"Decays scatter by {' and '.join(sizes)} beyond their errors, which the errors "
                "contain: record more fills, with orbit, coupling and fill pattern kept the same."
            )
        odd = np.bincount(noise.odd + 1, noise.weight, len(self.names) + 1)[1:]
        if odd.max() > MENTION_PROBABILITY:
            name = self.names[int(np.argmax(odd))]
            sentences.append(
                f"{name} does not follow the others and hardly counts: look at its record."
            )
        return " ".join(sentences)

    @cached_property
    def refuted_by(self) -> str | None:
        """Most probable departure from first principles, if scatter alone is refuted; else None."""
        if self.as_read < POOR_FIT:
            return VOLTAGE
        return None if self.noise.probabilities[0] > POOR_FIT else self.noise.model_name

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of all scales, separable or not, shape (n, n), in linear approximation.

        Infinite for scales that the data do not determine.
        """
        undetermined = ~np.isfinite(self.spread.errors)
        return np.where(np.outer(undetermined, undetermined), np.inf, self.spread.seen)

    @cached_property
    def scales(self) -> dict[str, Quantity]:
        """Factors on the ring file's losses: touschek, bremsstrahlung, elastic, desorption.

        A factor has no error where the decays do not separate the mechanism. With a prior also
        rf_voltage, the true voltage over its reading. All are attributes of the fit, too.
        """
        priors = {prior.name: prior.sd for prior in self.fit.problem.priors}
        names, undetermined, found = self.fit.problem.names, ~np.isfinite(self.spread.errors), {}
        for k, name in enumerate(names):
            raw = float(self.spread_raw.errors[k])
            quantity = self.noise.quantity(float(self.fit.theta[k]), k, raw)
            value = quantity.value
            # The error is compared with 1 where the value is smaller: an absent mechanism,
            # 0.0 ± 0.1, is separable. The voltage must be determined better than by its prior.
            determined = quantity.error < MAX_RELATIVE_ERROR * max(value, 1.0)
            if name == VOLTAGE:
                determined = 2 * quantity.error**2 < priors[name] ** 2
            found[name] = quantity if determined and not undetermined[k] else quantity.open()
        return found

    @cached_property
    def finding(self) -> Finding:
        """Status and sentences on the scales.

        `not_converged` if the search failed, `unidentified` if a mechanism is not separable,
        `poor_fit` if decays depart from first principles by more than scatter, else `converged`.
        """
        found, voltage = judge(self, RULES), self.scales.get(VOLTAGE)
        by_prior = voltage is not None and voltage.error is None
        remark = "The decays do not tell the scale of the RF voltage: its prior does." * by_prior
        return Finding(found.status, " ".join(filter(None, (found.cause, remark, self.remark))))

    @property
    def voltages(self) -> np.ndarray | None:
        """Ratios of true to read RF voltage at which losses are computed, if its scale is free."""
        ratios = self.decays.terms.voltages
        return None if ratios is None else np.asarray(ratios)[0]

    def terms_at(self, operation: Operation, current: float) -> LossTerms:
        """Loss terms of first principles at a setting."""
        return loss_terms(self.machine.ring, operation, current, self.voltages)

    def losses_at(self, operation: Operation, current: float) -> tuple[Array, Array]:
        """Scaled a, 1/(mA s), and b, 1/s, of first principles at a setting."""
        return scaled_losses(self.vector, self.terms_at(operation, current))

    def determines(
        self, quantity: Callable[[Array, LossTerms], Array], terms: LossTerms
    ) -> np.ndarray:
        """Return True for quantities that decays and priors determine.

        ``quantity(scales, terms)`` is a JAX array. A quantity is determined if its error is below a
        third of its value, or of the ring file's value if that is larger; the limits of the scales
        do not count.
        """
        value, slope = _value_and_slope(quantity, self.vector, terms)
        of_ring_file, _ = _value_and_slope(quantity, np.ones_like(self.vector), terms)
        size = np.maximum(np.abs(value), np.abs(of_ring_file))
        return self.spread.error(np.asarray(slope)) < MAX_RELATIVE_ERROR * size

    def linearise(self, decays: DecaySet) -> tuple[np.ndarray, ...]:
        """Linearise decays about the fitted scales.

        Returns
        -------
        weight : array, shape (n, 2, 2)
            `whitener`, without scatter.
        residuals : array, shape (n, 2)
            `pulls`.
        rows, change : array, shapes (n, 2, p), (n, 2, 2)
            Slopes of the pulls by the scales, and by ln a and ln b of each decay.
        """
        return jax.device_get(_linearise(self.vector, decays))

    def __str__(self) -> str:
        rows = [f"{len(self.names)} decays: {self.status}. {self.message}"]
        rows += [f"  {name:15s} {scale}" for name, scale in self.scales.items()]
        return "\n".join([*rows, f"  chi²/dof {self.chi2:.4g}/{self.dof}"])

    def __getattr__(self, name: str) -> Quantity:
        if name in (*SCALES, VOLTAGE) and name in self.scales:
            return self.scales[name]
        raise AttributeError(f"a ScaleFit has no '{name}'")

    def sample(self, seed: int = 0, **options: Any) -> Posterior:
        """Draw the scales from their posterior.

        Parameters
        ----------
        seed : int, optional
            Seed of the random numbers.
        **options
            As for `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior
            Posterior of the scales: the priors of the fit, otherwise flat from 0 to 1000. Pressure
            errors and scatter are integrated out as in the fit.
        """
        from beamfit.sampling.ensemble import draw

        statement = Statement(
            data=(self.decays, SampledNoises.of(self)),
            log_volume=_log_volume,
            units=dict.fromkeys(self.scales, "1"),
            averaged=[RECORD],
            priors_own=[name for name, scale in self.scales.items() if scale.error is None],
        )
        optimum = Optimum(self.vector, self.finding, [1.0], [True])
        problem = self.fit.problem
        return draw(target_of(problem, optimum, statement), seed=seed, **options)

    def to_json(self) -> dict[str, Any]:
        """Scales and verdict as JSON's types."""
        verdict = {"status": self.status, "message": self.message}
        rest = {"scatter": self.scatter, "chi2": self.chi2, "dof": self.dof, "decays": self.names}
        return json_of({**verdict, **self.scales, **rest})


def _check_priors(priors: Mapping[str, tuple[float, float]]) -> list[Prior]:
    for name, (value, spread) in priors.items():
        if name not in (*SCALES, VOLTAGE):
            raise InputError(f"a prior on '{name}'", nearest(name, [*SCALES, VOLTAGE]))
        if not (value >= 0 and spread > 0):
            raise InputError(f"{name} = {value} ± {spread}", "a mean of 0 or more, an error above")
    return [Prior(name, *priors[name]) for name in (*SCALES, VOLTAGE) if name in priors]


def _voltages(
    decays: Sequence[Decay], machine: Machine, prior: tuple[float, float] | None
) -> np.ndarray | None:
    """Ratios of true to read RF voltage at which losses are computed: all must store a beam."""
    if prior is None:
        return None
    mean, error = prior
    ratios = mean + error * np.arange(-VOLTAGE_RANGE, VOLTAGE_RANGE + 1)
    lowest = min(float(setting.rf_voltage) for setting, _ in settings_of(decays, machine))
    if not ratios[0] * lowest > float(machine.ring.energy_loss):
        expected = "an error at three times of which every decay is still stored"
        raise InputError(f"rf_voltage = {mean:g} ± {error:g}", expected)
    return ratios


def fit_scales(
    decays: Sequence[Decay],
    machine: Machine,
    *,
    pressure_error: float = PRESSURE_ERROR,
    priors: Mapping[str, tuple[float, float]] | None = None,
) -> ScaleFit:
    """Fit a scale on each mechanism to decays at different settings.

    Parameters
    ----------
    decays : sequence of Decay
        Fitted decays whose records carry RF voltage, scraper, bunches, pressure. Decays too short
        to separate a and b take part with their information.
    machine : Machine
        The ring, and the settings that the records do not give.
    pressure_error : float, optional
        Relative error of each record's pressure reading, independent from record to record. A
        common error of the gauge scales bremsstrahlung and elastic scattering instead.
    priors : mapping of str to (mean, standard deviation), optional
        Priors of the scales. A prior on rf_voltage, such as (1, 0.01), is the calibration of its
        reading; then the ratio of true to read voltage is fitted too.

    Returns
    -------
    ScaleFit
        Scales of zero or more with errors, and a verdict on which mechanisms are separable.

    Raises
    ------
    InputError
        If there is no decay, a prior's name is unknown, or a record's settings store no beam.

    Notes
    -----
    Least squares on the parts in `Summaries`, which is least squares on all readings to second
    order about each decay's own fit. The pressure factor of each record is integrated out, with
    the model linearised in it. The answer averages over the scatter of a and b from fill to fill,
    and compares it with other departures (`FillNoise`), linear in the scales. Where a misread RF
    voltage is the most probable, its scale is free with a prior of 1 ± 2 %.
    """
    if not decays:
        raise InputError("no decay", "one or more; several settings separate the mechanisms")
    priors = priors or {}
    prior_terms, voltages = _check_priors(priors), _voltages(decays, machine, priors.get(VOLTAGE))
    data = DecaySet.of(decays, machine, pressure_error, voltages)
    zeros = np.zeros(data.measured.parts.shape)
    free = [Free(name, 0.0, MAX_SCALE) for name in SCALES]
    free += [] if voltages is None else [Free(VOLTAGE, voltages[0], voltages[-1])]
    names = (*SCALES, VOLTAGE)[: len(free)]
    vector = np.array([priors.get(name, (1.0, 0.0))[0] for name in names])
    models = _departure_changes(decays, machine, vector, data.terms)
    limits = np.array([(each.lower, each.upper) for each in free], float).T
    last_best = None
    for _ in range(MAX_ITERATIONS):
        weight, *rows = jax.device_get(_linearise(vector, data))
        linear = LinearDecays(*rows, *_prior_rows(vector, prior_terms, names))
        noise = weigh_noises(linear, models, limits - vector)
        arguments = data, (weight, _whitening_matrix(linear.loss_slopes, noise))
        record = Record(RECORD, _whitened_pulls, arguments, zeros.ravel(), 1.0)
        found = solve(Problem(dict(zip(names, vector, strict=True)), free, [record], prior_terms))
        moved, vector = found.theta - vector, found.theta
        noise = replace(noise, shift=noise.shift - moved)
        best = noise.model[noise.most_probable], *noise.scatter[noise.most_probable]
        if last_best == best and np.all(np.abs(moved) < SCALE_TOLERANCE * np.maximum(vector, 1.0)):
            break
        last_best = best
    named = tuple(decay.fit.record for decay in decays)
    fit = ScaleFit(found, machine, data, named, noise)
    if noise.model_name != VOLTAGE:
        return fit
    # Predictions with a misread voltage need its scale: fit again with it free.
    try:
        free = {**priors, VOLTAGE: (1.0, MODEL_SIZES[VOLTAGE])}
        freed = fit_scales(decays, machine, pressure_error=pressure_error, priors=free)
    except InputError:  # a decay would not be stored three errors lower
        return fit
    return replace(freed, as_read=float(noise.probabilities[0]))


def _vector(model: Mapping[str, Array]) -> Array:
    return jnp.stack([model[name] for name in (*SCALES, VOLTAGE) if name in model])


def _whitened_pulls(
    model: Mapping[str, Array], data: tuple[DecaySet, tuple[Array, Array]]
) -> Array:
    """Model minus measurement in the standard errors of the last iteration."""
    decays, (weight, whiten) = data
    return whiten @ pulls(_vector(model), decays, weight).ravel()


@partial(jax.jit, static_argnums=0)
def _value_and_slope(
    quantity: Callable[[Array, LossTerms], Array], vector: Array, terms: LossTerms
) -> tuple[Array, Array]:
    return with_slope(lambda scales: quantity(scales, terms), vector)


@jax.jit
def _linearise(vector: Array, decays: DecaySet) -> tuple[Array, ...]:
    weight = whitener(vector, decays)
    residuals, rows = with_slope(lambda scales: pulls(scales, decays, weight), vector)
    return weight, residuals, rows, weight @ _loss_slopes(vector, decays)


@jax.jit
def _loss_slopes(vector: Array, decays: DecaySet) -> Array:
    """Slopes of the parts by ln a and ln b of each decay, shape (n, 2, 2)."""
    a, b = scaled_losses(vector, decays.terms)
    return loss_part_slopes(a * decays.terms.current, b)


def _prior_rows(
    vector: np.ndarray, priors: Sequence[Prior], names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of the priors, and their slopes by the scales."""
    index = [names.index(prior.name) for prior in priors]
    mean, sd = (np.array([getattr(p, n) for p in priors], float) for n in ("mean", "sd"))
    return (vector[index] - mean) / sd, np.eye(len(names))[index] / sd[:, None]


def _whitening_matrix(change: np.ndarray, noise: FillNoise) -> np.ndarray:
    """Whitening matrix, (2n, 2n), of all pulls with the most probable noise.

    `change` are the slopes of the pulls by ln a and ln b.
    """
    k = noise.most_probable
    scattered = block_diag(*(change * noise.sizes(k, len(change))[:, None, :]))
    smooth = (change @ noise.columns[noise.model[k]]).reshape(len(scattered), -1)
    return add_errors(np.eye(len(scattered)), np.hstack([scattered, smooth]))


def _departure_changes(
    decays: Sequence[Decay], machine: Machine, vector: np.ndarray, terms: LossTerms
) -> dict[str, np.ndarray]:
    """Changes of ln a and ln b of each decay by other departures, for `weigh_noises`."""
    settings, found = settings_of(decays, machine), {}
    if terms.voltages is None:
        factor = 1 + VOLTAGE_STEP
        raised = [(o._replace(rf_voltage=factor * o.rf_voltage), beam) for o, beam in settings]
        to, at = (np.log(scaled_losses(vector, each))
                  for each in (_terms_of(raised, machine, None), terms))  # fmt: skip
        found[VOLTAGE] = MODEL_SIZES[VOLTAGE] / VOLTAGE_STEP * (to - at).T[..., None]
    inputs = np.array([
        (1e-6 * o.rf_voltage, np.log(o.scraper_y), np.log(o.bunches)) for o, _ in settings
    ], float)  # fmt: skip
    middle, half = (inputs.max(0) + inputs.min(0)) / 2, np.ptp(inputs, axis=0) / 2
    scaled = (inputs - middle)[:, half > MIN_HALF_RANGE] / half[half > MIN_HALF_RANGE]
    shapes = np.hstack([scaled, scaled**2 - np.mean(scaled**2, axis=0)])
    if shapes.size:
        shapes = np.stack([np.kron(row, np.eye(2)) for row in shapes])
        found["settings"] = MODEL_SIZES["settings"] * shapes
    return {name: rows for name, rows in found.items() if np.any(rows)}


class SampledNoises(NamedTuple):
    """Noises of the sampler.

    Attributes
    ----------
    prior : array, shape (k,)
        Logarithm of the prior weight.
    sizes : array, shape (k, n, 2)
        Scatter of ln a and ln b.
    rows : array, shape (n, 2, 2)
        Slopes of the parts by ln a and ln b, fixed at the fit: a scatter that grows with the losses
        would allow any loss.
    columns : array, shape (k, n, 2, m)
        Changes of ln a and ln b by further parameters.
    """

    prior: Array
    sizes: Array
    rows: Array
    columns: Array

    @classmethod
    def of(cls, fit: ScaleFit) -> SampledNoises:
        """Choose a few noises that represent all: equidistant quantiles of their weight."""
        noise, count = fit.noise, len(fit.names)
        order = np.lexsort((*noise.scatter.T, noise.odd, noise.model))
        quantile = (np.arange(SAMPLED_NOISES) + 0.5) / SAMPLED_NOISES
        index = np.searchsorted(np.cumsum(noise.weight[order]), quantile)
        drawn, counts = np.unique(order[np.minimum(index, len(order) - 1)], return_counts=True)
        # Padded, so that few different shapes are compiled.
        drawn = np.pad(drawn, (0, padded_length(len(drawn)) - len(drawn)), mode="edge")
        counts = np.pad(counts, (0, len(drawn) - len(counts)))
        drawn_columns = [noise.columns[noise.model[k]] for k in drawn]
        width = max(one.shape[2] for one in drawn_columns)
        columns = [
            np.pad(one, ((0, 0), (0, 0), (0, width - one.shape[2]))) for one in drawn_columns
        ]
        return cls(
            prior=noise.prior[drawn] - np.log(noise.weight[drawn]) + jnp.log(counts),
            sizes=np.array([noise.sizes(k, count) for k in drawn]),
            rows=_loss_slopes(fit.vector, fit.decays),
            columns=np.array(columns),
        )


def _log_volume(scales: Mapping[str, Array], data: tuple[DecaySet, SampledNoises]) -> Array:
    """Log likelihood of the decays, averaged over the noises."""
    decays, noise = data
    vector = _vector(scales)
    weight = whitener(vector, decays)
    residuals, change = pulls(vector, decays, weight), weight @ noise.rows

    def with_noise(sizes: Array, columns: Array) -> Array:
        return log_likelihood(residuals, change, sizes, change @ columns)

    # The normalisation of the likelihood changes with the scales as the errors do.
    volume = jnp.abs(jnp.linalg.det(weight))
    informative = jnp.abs(jnp.linalg.det(decays.measured.root)) > 0
    normalisation = jnp.sum(jnp.log(jnp.where(informative, volume, 1.0)))
    return normalisation + logsumexp(noise.prior + jax.vmap(with_noise)(noise.sizes, noise.columns))


def _search_failed(found: ScaleFit) -> Finding | None:
    if found.fit.status not in (Status.not_converged, Status.not_finite):
        return None
    said = "The search for the scales did not end: look at the records."
    return Finding(Status.not_converged, said)


def _not_separable(found: ScaleFit) -> Finding | None:
    names = [name for name in SCALES if found.scales[name].error is None]
    if not names:
        return None
    count = len(found.names)
    decays = "one decay" if count == 1 else f"{count} decays"
    advice = ", ".join(dict.fromkeys(SCALES[name] for name in names))
    departure = f" {_departure(found)}" if found.refuted_by else ""
    return Finding(
        Status.unidentified,
        f"{' and '.join(names)} not separable by {decays}: vary {advice}, or give a prior."
        f"{departure}",
    )


def _departure(found: ScaleFit) -> str:
    """Sentence on a departure from first principles in addition to scatter."""
    size = f"chi²/dof is {found.chi2 / found.dof:.3g}" if found.dof > 0 else "beside their scatter"
    if found.refuted_by == "settings":
        return (
            f"Decays depart smoothly from first principles with the settings ({size}): correct by "
            "a network."
        )
    return f"{_misread(found)}: give a prior on rf_voltage, its calibration."


def _misread(found: ScaleFit) -> str:
    """Words on an RF voltage that differs from its reading."""
    if (scale := found.scales.get(VOLTAGE)) is None:
        return "The RF voltage is off its reading"
    error = "" if scale.error is None else f" ± {100 * scale.error:.1g}"
    return f"The RF voltage is {100 * (scale.value - 1):+.2g}{error} % off its reading"


def _refuted_principles(found: ScaleFit) -> Finding | None:
    if not found.refuted_by:
        return None
    said = f"{_departure(found)} The errors contain it."
    return Finding(Status.poor_fit, said)


def _separable(found: ScaleFit) -> Finding:
    return Finding(Status.converged, "Every mechanism is separable.")


RULES = (_search_failed, _not_separable, _refuted_principles, _separable)
