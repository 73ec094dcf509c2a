"""First principles fitted to many decays: how much each mechanism truly loses, and how sure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import logsumexp
from scipy.linalg import block_diag

from beamfit.answer import json_of, shown
from beamfit.arrays import padded_length
from beamfit.errors import Finding, InputError, Judged, judge, nearest
from beamfit.greybox.covariance import Spread, spread_of
from beamfit.greybox.fit import Fit
from beamfit.greybox.posterior import Optimum, Statement, target_of
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.lifetime.expansion import LEVEL, LOSS, MAX_RELATIVE_ERROR, QUADRATIC, Expansion
from beamfit.lifetime.fill_noise import (
    BY,
    SHORTEST,
    FillNoise,
    LinearDecays,
    compared,
    log_likelihood,
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
    """Decays by their loss rates at the mean current; exact to second order about the fit.

    Attributes
    ----------
    current : array, shape (n,)
        Mean current I, mA.
    parts : array, shape (n, 2)
        Fitted a I and a I + b, 1/s. The second is well determined by any decay, the first by a
        long one only; the two are nearly uncorrelated, unlike a and b.
    root : array, shape (n, 2, 2)
        Upper triangle R with (R (x - parts))² summed the chi² of other values x, I0 adjusted.
        A decay too short to tell a from b has a small entry there and takes part all the same.
    """

    current: Array
    parts: Array
    root: Array


def loss_parts(a: Array, b: Array, mean_current: Array) -> Array:
    """The two numbers by which a decay is compared with a model: a I and a I + b, in 1/s."""
    quadratic = a * mean_current
    return jnp.stack([quadratic, quadratic + b], axis=-1)


def by_losses(quadratic: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Slopes of the two parts, a I and a I + b, by relative changes of a and b, shape (n, 2, 2)."""
    rows = np.array([[quadratic, np.zeros_like(quadratic)], [quadratic, linear]])
    return np.moveaxis(rows, -1, 0)


def information_root(about: Expansion, scale: float = 1.0) -> np.ndarray:
    """Root of the information that readings hold on the two parts, I0 eliminated; a triangle, s.

    `scale` is the size of the errors of what residuals are divided by.
    """
    # Columns in order of elimination: the last two rows of R hold what is left beside I0.
    rows = about.rows[:, [LEVEL, QUADRATIC, LOSS]] * (about.pieces.units[0] / scale)
    return np.linalg.qr(rows, mode="r")[1:, 1:]


def _root(fit: DecayFit, about: Expansion) -> np.ndarray:
    """The information that a decay holds on its parts, as of `Summaries`; what is stated of the
    monitor is added to their covariance.
    """
    scale = max(np.sqrt(about.residuals @ about.residuals / fit.dof), about.min_factor)
    root = information_root(about, scale * fit.inflation)
    moved = [about.value_shifts(change) for change in about.pieces.monitor_changes]
    if not moved:
        return root
    changes = np.array([[m.a * about.pieces.units[1], m.rate_mean] for m in moved]).T
    return np.linalg.qr(widened(root, changes), mode="r")


def widened(root: Array, changes: Array) -> Array:
    """Root of the information where values also err by independent changes.

    Parameters
    ----------
    root : array, shape (..., n, n)
        As of `Summaries`, of two values; or of more.
    changes : array, shape (..., n, k)
        By how much each of k errors moves the values, one standard deviation.

    Returns
    -------
    array, shape (..., n, n)
        W with WᵀW = Rᵀ (1 + G Gᵀ)⁻¹ R, G = R times the changes: the errors integrated out.
    """
    own = root @ changes
    unit = jnp.eye(root.shape[-1])
    whole = jnp.linalg.cholesky(unit + own @ jnp.swapaxes(own, -1, -2))
    return jnp.linalg.solve(whole, root)


def _together(fit: DecayFit, rate: float) -> np.ndarray:
    """Many cycles, of which the share of a and the lifetime are uncorrelated."""
    share, error = fit.identifiability.share_error, fit.lifetime_mean.relative or np.inf
    return np.diag(1 / (rate * np.array([np.inf if share is None else share, error])))


def summarise(decays: Sequence[Decay], power: float = 0.0) -> Summaries:
    """Reduce decays to what they say of the loss.

    Parameters
    ----------
    decays : sequence of Decay
        Fitted decays. One without a finite fit or without noise says nothing: it gets no
        information.
    power : float
        a goes as this power of the current, and is that at the mean current; many cycles fitted
        together say nothing of such a law.

    Returns
    -------
    Summaries
        In the order of the decays.

    Notes
    -----
    With the residuals linear in (I0, a I, a I + b) about the fit, chi² is a quadratic form whose
    matrix is the information; eliminating I0 by QR loses nothing. Errors are the fit's, enlarged
    where chi²/dof exceeds 1 and for correlated residuals.

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
    >>> error = 1 / abs(found.root[0, 1, 1])  # of the loss rate, a I being free
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
            about = fit.with_power(power)
            parts[k] = loss_parts(about.values.a, about.values.b, fit.mean_current)
            root[k] = _root(fit, about)
        elif not power:
            parts[k] = loss_parts(a, b, fit.mean_current)
            root[k] = _together(fit, parts[k, 1])
    return Summaries(*map(jnp.asarray, (current, parts, root)))


PRESSURE_ERROR = 0.05
RECORD = "decays"
LARGEST = 1e3
# The scale of the RF voltage, fitted where a prior says how well its reading is calibrated.
VOLTAGE = "rf_voltage"
# It is sought within so many errors of that prior, and losses computed at each of them.
WIDEST = 3
# Noises are weighed about the scales, and these fitted, in so many rounds, until they move by less.
ROUNDS, SETTLED = 8, 1e-3
# Scatter, or that a decay is odd, is said from this probability on.
LIKELY = 0.95
# Share of the RF voltage by which losses are differentiated.
STEP = 2e-3
# Noises that stand for all of them in the sampler.
SAMPLED = 48


class DecaySet(NamedTuple):
    """Many decays beside first principles.

    Attributes
    ----------
    terms : LossTerms
        First principles at the settings of each decay, each part of shape (n,).
    measured : Summaries
        What each decay says.
    pressure_error : float
        Relative error of the pressure readings, of each record independently.
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
        """Reduce decays; `voltages` as of `LossTerms`."""
        settings = settings_of(decays, machine)
        rows = [loss_terms(machine.ring, *setting, voltages) for setting in settings]
        terms = jax.tree.map(lambda *parts: jnp.stack(parts), *rows)
        return cls(terms, summarise(decays), pressure_error)

    def parts(self, scales: Array, factor: Array) -> Array:
        """a I and a I + b of scaled first principles, where the pressure is so many times read."""
        return loss_parts(*scaled_losses(scales, self.terms, factor), self.terms.current)


@jax.jit
def whitener(scales: Array, decays: DecaySet) -> Array:
    """Roots of the information, each decay's pressure factor integrated out; shape (n, 2, 2)."""
    ones = jnp.ones_like(decays.terms.current)
    _, slope = jax.jvp(lambda factor: decays.parts(scales, factor), (ones,), (ones,))
    return widened(decays.measured.root, decays.pressure_error * slope[..., None])


@jax.jit
def pulls(scales: Array, decays: DecaySet, weight: Array) -> Array:
    """Model minus measurement in standard errors, shape (n, 2); `weight` is that of `whitener`."""
    off = decays.parts(scales, jnp.ones_like(decays.terms.current)) - decays.measured.parts
    return jnp.einsum("nij,nj->ni", weight, off)


_by_scales = jax.jit(jax.jacfwd(pulls))


@shown
@dataclass(frozen=True, eq=False)
class ScaleFit(Judged):
    """Scales on the mechanisms of first principles, from many decays.

    Parameters
    ----------
    fit : Fit
        Of the core by the likeliest noise, with the priors among its parts.
    machine : Machine
        The ring and its usual operation.
    decays : DecaySet
        What it was fitted to.
    names : tuple of str
        Names of the decays.
    noise : FillNoise
        How they scatter, and what may be wrong besides, averaged over.
    as_read : float
        Probability that the RF voltage is what is read, where its scale was freed without a prior.
    """

    fit: Fit
    machine: Machine
    decays: DecaySet
    names: tuple[str, ...]
    noise: FillNoise
    as_read: float = 1.0

    @cached_property
    def vector(self) -> np.ndarray:
        """All scales, separable or not, by the likeliest model, its noise averaged over."""
        problem = self.fit.problem
        return np.clip(self.fit.theta + self.noise.centre, problem.lower, problem.upper)

    @cached_property
    def chi2(self) -> float:
        """Sum of squares by the decays' own errors and the pressures', without scatter."""
        return float(np.sum(self.about(self.decays)[1] ** 2))

    @property
    def dof(self) -> int:
        """Two numbers a decay, less the scales."""
        told = np.any(np.asarray(self.decays.measured.root) != 0, axis=-1)
        return int(np.sum(told)) - len(SCALES)

    @cached_property
    def spread_raw(self) -> Spread:
        """Spread of the scales by the decays' own errors and the pressures', without scatter."""
        _, _, rows, _ = self.about(self.decays)
        priors = self.fit.dense_jacobian[2 * len(rows) :]
        unbounded = np.full(self.vector.shape, np.inf)
        rows = np.vstack([rows.reshape(-1, unbounded.size), priors])
        # Bounds stand for nothing known.
        return spread_of(rows, -unbounded, unbounded)

    @cached_property
    def spread(self) -> Spread:
        """Spread of the scales over all noises."""
        return self.noise.spread(self.spread_raw)

    @cached_property
    def scatter(self) -> dict[str, Quantity]:
        """Scatter of a and of b from fill to fill beyond what decays and pressures err by."""
        return {name: self._scatter(k) for k, name in enumerate("ab")}

    def _scatter(self, k: int) -> Quantity:
        sizes = self.noise.scatter[:, k]
        order = np.argsort(sizes)
        heap = np.cumsum(self.noise.weight[order])
        at = np.minimum(np.searchsorted(heap, (0.5, *CENTRAL, *WIDE)), len(order) - 1)
        middle, low, high, *ends = map(float, sizes[order][at])
        return Quantity(middle, (high - low) / 2, "1", None, tuple(ends))

    @property
    def remark(self) -> str:
        """Sentences on scatter and an odd decay, where they are likely."""
        noise, said = self.noise, []
        if POOR_FIT < self.as_read < 1:
            said.append(f"{_misread(self)} (probability {1 - self.as_read:.2g}).")
        scatters = noise.scatter > 0
        likely = noise.weight @ scatters > 0.5
        sizes = [
            f"{percent(self.scatter[name].value)} in {name}"
            for name, has in zip("ab", likely, strict=True)
            if has and noise.weight @ scatters.any(axis=1) > LIKELY
        ]
        if sizes:
            said.append(
                f"Decays scatter by {' and '.join(sizes)} beyond their errors, which the errors "
                "contain: record more fills, with orbit, coupling and fill pattern kept the same."
            )
        odd = np.bincount(noise.odd + 1, noise.weight, len(self.names) + 1)[1:]
        if odd.max() > LIKELY:
            name = self.names[int(np.argmax(odd))]
            said.append(f"{name} does not follow the others and hardly counts: look at its record.")
        return " ".join(said)

    @cached_property
    def refuted_by(self) -> str | None:
        """The likeliest departure from first principles where these are refuted beside scatter."""
        if self.as_read < POOR_FIT:
            return VOLTAGE
        return None if self.noise.probabilities[0] > POOR_FIT else self.noise.model_name

    @property
    def covariance(self) -> np.ndarray:
        """Linearised, of all scales whether separable or not, shape (n, n); infinite along
        directions that nothing determines.
        """
        blind = ~np.isfinite(self.spread.errors)
        return np.where(np.outer(blind, blind), np.inf, self.spread.seen)

    @cached_property
    def scales(self) -> dict[str, Quantity]:
        """Factors on the ring file's values: touschek, bremsstrahlung, elastic, desorption, also as
        attributes; without an error where the decays do not separate the mechanism. rf_voltage,
        true over stated, where it has a prior.
        """
        priors = {prior.name: prior.sd for prior in self.fit.problem.priors}
        names, blind, found = self.fit.problem.names, ~np.isfinite(self.spread.errors), {}
        for k, name in enumerate(names):
            raw = float(self.spread_raw.errors[k])
            quantity = self.noise.quantity(float(self.fit.theta[k]), k, raw)
            value = quantity.value
            # Against 1 where the value is smaller: a mechanism found absent, 0.0 ± 0.1, is
            # separable. A voltage that its prior tells better than the decays is the prior's.
            known = quantity.error < MAX_RELATIVE_ERROR * max(value, 1.0)
            if name == VOLTAGE:
                known = 2 * quantity.error**2 < priors[name] ** 2
            found[name] = quantity if known and not blind[k] else quantity.open()
        return found

    @cached_property
    def finding(self) -> Finding:
        """Status and sentences on the scales: `converged`; `poor_fit` if decays depart from first
        principles otherwise than by scatter; `unidentified` if a mechanism is not separable from
        the others; `not_converged` if the search failed.
        """
        found, voltage = judge(self, RULES), self.scales.get(VOLTAGE)
        untold = voltage is not None and voltage.error is None
        prior = "The decays do not tell the scale of the RF voltage: its prior does." * untold
        return Finding(found.status, " ".join(filter(None, (found.cause, prior, self.remark))))

    @property
    def voltages(self) -> np.ndarray | None:
        """True over stated RF voltages at which losses are computed, if its scale is free."""
        known = self.decays.terms.voltages
        return None if known is None else np.asarray(known)[0]

    def terms_at(self, operation: Operation, current: float) -> LossTerms:
        """First principles at a setting, for these scales."""
        return loss_terms(self.machine.ring, operation, current, self.voltages)

    def losses_at(self, operation: Operation, current: float) -> tuple[Array, Array]:
        """a, 1/(mA s), and b, 1/s, of scaled first principles at a setting."""
        return scaled_losses(jnp.asarray(self.vector), self.terms_at(operation, current))

    def determines(self, quantity: Callable[[Array], Array]) -> np.ndarray:
        """Tell if decays and priors, and not the limits of the scales alone, determine quantities.

        ``quantity(scales)`` is an array in JAX; each is told if known to a third of itself, or of
        what the ring file says where that is more.
        """
        vector = jnp.asarray(self.vector)
        usual = jnp.ones_like(vector)
        size = np.maximum(np.abs(quantity(vector)), np.abs(quantity(usual)))
        error = self.spread.error(np.asarray(jax.jacfwd(quantity)(vector)))
        return error < MAX_RELATIVE_ERROR * size

    def about(self, decays: DecaySet) -> tuple[np.ndarray, ...]:
        """Expand decays: their weights without scatter, their `pulls`, and the slopes of these by
        the scales and by ln a and ln b of each decay, shape (n, 2, 2).
        """
        return _expanded(self.vector, decays)

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
            Of the random numbers.
        **options
            As of `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior
            Of Touschek, bremsstrahlung, elastic, desorption, with the priors of the fit, otherwise
            flat from 0 to 1000. Pressure errors are integrated out and the scatter is averaged
            over as in the fit.
        """
        from beamfit.sampling.ensemble import draw

        stated = Statement(
            data=(self.decays, SampledNoises.of(self)),
            log_volume=_log_volume,
            units=dict.fromkeys(self.scales, "1"),
            averaged=[RECORD],
            priors_own=[name for name, scale in self.scales.items() if scale.error is None],
        )
        optimum = Optimum(self.vector, self.finding, [1.0], [True])
        problem = self.fit.problem
        return draw(target_of(problem, optimum, stated), seed=seed, **options)

    def to_json(self) -> dict[str, Any]:
        """Return the scales and the verdict as JSON's types."""
        verdict = {"status": self.status, "message": self.message}
        rest = {"scatter": self.scatter, "chi2": self.chi2, "dof": self.dof, "decays": self.names}
        return json_of({**verdict, **self.scales, **rest})


def _checked(priors: Mapping[str, tuple[float, float]]) -> list[Prior]:
    for name, (value, spread) in priors.items():
        if name not in (*SCALES, VOLTAGE):
            raise InputError(f"a prior on '{name}'", nearest(name, [*SCALES, VOLTAGE]))
        if not (value >= 0 and spread > 0):
            raise InputError(f"{name} = {value} ± {spread}", "a mean of 0 or more, an error above")
    return [Prior(name, *priors[name]) for name in (*SCALES, VOLTAGE) if name in priors]


def _voltages(
    decays: Sequence[Decay], machine: Machine, prior: tuple[float, float] | None
) -> np.ndarray | None:
    """RF voltages at which losses are computed for a free scale: all must store a beam."""
    if prior is None:
        return None
    mean, error = prior
    found = mean + error * np.arange(-WIDEST, WIDEST + 1)
    lowest = min(float(setting.rf_voltage) for setting, _ in settings_of(decays, machine))
    if not found[0] * lowest > float(machine.ring.energy_loss):
        expected = "an error at three times of which every decay is still stored"
        raise InputError(f"rf_voltage = {mean:g} ± {error:g}", expected)
    return found


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
        Fitted decays whose records carry RF voltage, scraper, bunches, pressure. Those too short
        to tell a from b take part with what they say.
    machine : Machine
        The ring, and what the records do not say.
    pressure_error : float, optional
        Relative error of each record's pressure reading. A common error of the gauge is no such
        error: it scales bremsstrahlung and elastic scattering alike.
    priors : mapping of str to (mean, standard deviation), optional
        What is known of the scales beforehand. One on rf_voltage, such as (1, 0.01), is the
        calibration of the reading, and has the true over the read voltage fitted too.

    Returns
    -------
    ScaleFit
        Scales, not negative, with errors, and a verdict on which mechanisms are separable.

    Raises
    ------
    InputError
        If there is no decay, a prior's name is unknown, or a record's settings store no beam.

    Notes
    -----
    Least squares on the pairs of `Summaries`, which is least squares on all readings to second
    order about each decay's own fit. The pressure factor of each record is integrated out with
    the model linearised in it. How a and b scatter from fill to fill is averaged over, and what is
    no scatter compared with it (`FillNoise`), with all linear in the scales. Where a misread RF
    voltage is the likeliest, its scale is free with a prior of 1 ± 2 %.
    """
    if not decays:
        raise InputError("no decay", "one or more; several settings separate the mechanisms")
    priors = priors or {}
    known, voltages = _checked(priors), _voltages(decays, machine, priors.get(VOLTAGE))
    together = DecaySet.of(decays, machine, pressure_error, voltages)
    nothing = np.zeros(together.measured.parts.shape)
    free = [Free(name, 0.0, LARGEST) for name in SCALES]
    free += [] if voltages is None else [Free(VOLTAGE, voltages[0], voltages[-1])]
    names = (*SCALES, VOLTAGE)[: len(free)]
    vector = np.array([priors.get(name, (1.0, 0.0))[0] for name in names])
    models = _departures(decays, machine, vector, voltages)
    limits = np.array([(each.lower, each.upper) for each in free], float).T
    before = None
    for _ in range(ROUNDS):
        linear = _linear(vector, together, known, names)
        noise = compared(linear, models, limits - vector)
        given = together, (whitener(vector, together), _whole(linear.change, noise))
        record = Record(RECORD, _weighted, given, nothing.ravel(), 1.0)
        found = solve(Problem(dict(zip(names, vector, strict=True)), free, [record], known))
        moved, vector = found.theta - vector, found.theta
        noise = replace(noise, shift=noise.shift - moved)
        likeliest = noise.model[noise.likeliest], *noise.scatter[noise.likeliest]
        if before == likeliest and np.all(np.abs(moved) < SETTLED * np.maximum(vector, 1.0)):
            break
        before = likeliest
    named = tuple(decay.fit.record for decay in decays)
    fit = ScaleFit(found, machine, together, named, noise)
    if noise.model_name != VOLTAGE:
        return fit
    # What a misread voltage predicts needs its scale.
    try:
        free = {**priors, VOLTAGE: (1.0, BY[VOLTAGE])}
        freed = fit_scales(decays, machine, pressure_error=pressure_error, priors=free)
    except InputError:  # a decay would not be stored three errors lower
        return fit
    return replace(freed, as_read=float(noise.probabilities[0]))


def _vector(model: Mapping[str, Array]) -> Array:
    return jnp.stack([model[name] for name in (*SCALES, VOLTAGE) if name in model])


def _weighted(model: Mapping[str, Array], data: tuple[DecaySet, tuple[Array, Array]]) -> Array:
    """Model minus measurement in standard errors taken at the last scales."""
    decays, (weight, whiten) = data
    return whiten @ pulls(_vector(model), decays, weight).ravel()


def _expanded(vector: np.ndarray, decays: DecaySet) -> tuple[np.ndarray, ...]:
    weight = whitener(jnp.asarray(vector), decays)
    given = jnp.asarray(vector), decays, weight
    weight, off, rows = map(np.asarray, (weight, pulls(*given), _by_scales(*given)))
    return weight, off, rows, weight @ _changes(vector, decays)


def _changes(vector: np.ndarray, decays: DecaySet) -> np.ndarray:
    """Changes of the parts by ln a and ln b of each decay, shape (n, 2, 2)."""
    a, b = map(np.asarray, scaled_losses(jnp.asarray(vector), decays.terms))
    return by_losses(a * np.asarray(decays.terms.current), b)


def _linear(
    vector: np.ndarray, decays: DecaySet, priors: Sequence[Prior], names: Sequence[str]
) -> LinearDecays:
    """Decays about some scales, and the priors of these."""
    _, off, rows, change = _expanded(vector, decays)
    at = [names.index(prior.name) for prior in priors]
    mean, sd = (np.array([getattr(p, n) for p in priors], float) for n in ("mean", "sd"))
    known = np.eye(len(names))[at] / sd[:, None]
    return LinearDecays(off, rows, change, (vector[at] - mean) / sd, known)


def _whole(change: np.ndarray, noise: FillNoise) -> Array:
    """Root of the information of all decays beside the likeliest noise, (2n, 2n), over that of
    each; `change` has their slopes by ln a and ln b.
    """
    k = noise.likeliest
    scattered = block_diag(*(change * noise.sizes(k, len(change))[:, None, :]))
    smooth = (change @ noise.columns[noise.model[k]]).reshape(len(scattered), -1)
    return widened(np.eye(len(scattered)), np.hstack([scattered, smooth]))


def _departures(
    decays: Sequence[Decay], machine: Machine, vector: np.ndarray, voltages: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Changes of ln a and ln b of each decay by what may be wrong besides, as of `compared`."""
    settings, scales = settings_of(decays, machine), jnp.asarray(vector[: len(SCALES)])

    def logs(operation: Operation, current: float) -> np.ndarray:
        terms = loss_terms(machine.ring, operation, current)
        return np.log(np.array(scaled_losses(scales, terms), float))

    found = {}
    if voltages is None:
        higher = [(o._replace(rf_voltage=(1 + STEP) * o.rf_voltage), beam) for o, beam in settings]
        change = np.array([logs(*to) - logs(*at) for to, at in zip(higher, settings, strict=True)])
        found[VOLTAGE] = BY[VOLTAGE] / STEP * change[..., None]
    inputs = np.array([
        (1e-6 * o.rf_voltage, np.log(o.scraper_y), np.log(o.bunches)) for o, _ in settings
    ], float)  # fmt: skip
    middle, half = (inputs.max(0) + inputs.min(0)) / 2, np.ptp(inputs, axis=0) / 2
    moved = (inputs - middle)[:, half > SHORTEST] / half[half > SHORTEST]
    bends = np.hstack([moved, moved**2 - np.mean(moved**2, axis=0)])
    if bends.size:
        found["settings"] = BY["settings"] * np.stack([np.kron(row, np.eye(2)) for row in bends])
    return {name: rows for name, rows in found.items() if np.any(rows)}


class SampledNoises(NamedTuple):
    """Noises for the sampler.

    Attributes
    ----------
    prior : array, shape (k,)
        Logarithm of their weight before the decays.
    sizes : array, shape (k, n, 2)
        Scatter of ln a and ln b.
    rows : array, shape (n, 2, 2)
        Changes of the parts by ln a and ln b. Those of the fit: a scatter that grew with the losses
        would allow any loss.
    columns : array, shape (k, n, 2, m)
        Changes of ln a and ln b by further numbers.
    """

    prior: Array
    sizes: Array
    rows: Array
    columns: Array

    @classmethod
    def of(cls, fit: ScaleFit) -> SampledNoises:
        """Draw noises evenly by their weight: a few stand for many."""
        noise, count = fit.noise, len(fit.names)
        order = np.lexsort((*noise.scatter.T, noise.odd, noise.model))
        at = (np.arange(SAMPLED) + 0.5) / SAMPLED
        place = np.searchsorted(np.cumsum(noise.weight[order]), at)
        drawn, often = np.unique(order[np.minimum(place, len(order) - 1)], return_counts=True)
        # Compiled code is shared by a few numbers of noises.
        drawn = np.pad(drawn, (0, padded_length(len(drawn)) - len(drawn)), mode="edge")
        often = np.pad(often, (0, len(drawn) - len(often)))
        own = [noise.columns[noise.model[k]] for k in drawn]
        wide = max(one.shape[2] for one in own)
        columns = [np.pad(one, ((0, 0), (0, 0), (0, wide - one.shape[2]))) for one in own]
        return cls(
            prior=jnp.asarray(noise.prior[drawn] - np.log(noise.weight[drawn])) + jnp.log(often),
            sizes=jnp.asarray([noise.sizes(k, count) for k in drawn]),
            rows=jnp.asarray(_changes(fit.vector, fit.decays)),
            columns=jnp.asarray(columns),
        )


def _log_volume(scales: Mapping[str, Array], data: tuple[DecaySet, SampledNoises]) -> Array:
    """Log likelihood of the decays, the noise averaged over."""
    decays, noise = data
    vector = _vector(scales)
    weight = whitener(vector, decays)
    off, change = pulls(vector, decays, weight), weight @ noise.rows

    def beside(sizes: Array, columns: Array) -> Array:
        return log_likelihood(off, change, sizes, change @ columns)

    # det(W)/det(R): the normalisation, which changes with the scales as the errors do.
    volume = jnp.abs(jnp.linalg.det(weight))
    known = jnp.abs(jnp.linalg.det(decays.measured.root)) > 0
    usual = jnp.sum(jnp.where(known, jnp.log(jnp.where(known, volume, 1.0)), 0.0))
    return usual + logsumexp(noise.prior + jax.vmap(beside)(noise.sizes, noise.columns))


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
    many = "one decay" if count == 1 else f"{count} decays"
    advice = ", ".join(dict.fromkeys(SCALES[name] for name in names))
    more = f" {_departure(found)}" if found.refuted_by else ""
    return Finding(
        Status.unidentified,
        f"{' and '.join(names)} not separable by {many}: vary {advice}, or give a prior.{more}",
    )


def _departure(found: ScaleFit) -> str:
    """Sentence on a departure from first principles beside scatter."""
    worth = f"chi²/dof is {found.chi2 / found.dof:.3g}" if found.dof > 0 else "beside their scatter"
    if found.refuted_by == "settings":
        return (
            f"Decays depart smoothly from first principles with the settings ({worth}): correct by "
            "a network."
        )
    return f"{_misread(found)}: give a prior on rf_voltage, its calibration."


def _misread(found: ScaleFit) -> str:
    """Words for an RF voltage that is off its reading."""
    if (scale := found.scales.get(VOLTAGE)) is None:
        return "The RF voltage is off its reading"
    error = "" if scale.error is None else f" ± {100 * scale.error:.1g}"
    return f"The RF voltage is {100 * (scale.value - 1):+.2g}{error} % off its reading"


def _refuted(found: ScaleFit) -> Finding | None:
    if not found.refuted_by:
        return None
    said = f"{_departure(found)} The errors contain it."
    return Finding(Status.poor_fit, said)


def _separable(found: ScaleFit) -> Finding:
    return Finding(Status.converged, "Every mechanism is separable.")


RULES = (_search_failed, _not_separable, _refuted, _separable)
