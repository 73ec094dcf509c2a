"""First principles fitted to many decays: how much each mechanism truly loses, and how sure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.answer import json_of, shown
from beamfit.errors import Finding, InputError, judge, nearest
from beamfit.greybox.covariance import Spread, spread_of
from beamfit.greybox.fit import Fit
from beamfit.greybox.posterior import Optimum, Statement, target_of
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.lifetime.expansion import DETERMINED, LEVEL, LOSS, QUADRATIC, Expansion
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.mechanisms import SCALES, LossTerms, loss_terms, scaled_losses
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.study import Decay, Machine, operation_during
from beamfit.quantity import Quantity, Status
from beamfit.statistics import POOR_FIT, chi2_probability

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


def _root(decay: Decay, parts: np.ndarray) -> np.ndarray:
    """The information that a decay holds on its parts, as of `Summaries`."""
    fit = decay.fit
    if fit.first is not None:
        return _together(fit, parts[1])
    about = fit.about
    scale = max(np.sqrt(about.residuals @ about.residuals / fit.dof), about.given)
    return _with_monitor(information_root(about, scale * fit.inflation), about)


def _with_monitor(root: np.ndarray, about: Expansion) -> np.ndarray:
    """The root with what is stated of the monitor added to the covariance of the parts."""
    changes = about.pieces.monitor_changes
    if not changes:
        return root
    moved = [about.moved(change) for change in changes]
    spread = root @ np.array([[m.a * about.pieces.units[1], m.rate_mean] for m in moved]).T
    whole = np.linalg.cholesky(np.eye(2) + spread @ spread.T)
    return np.linalg.qr(np.linalg.solve(whole, root), mode="r")


def _together(fit: DecayFit, rate: float) -> np.ndarray:
    """Many cycles, of which the share of a and the lifetime are uncorrelated."""
    share, error = fit.identifiability.share_error, fit.lifetime_mean.relative or np.inf
    return np.diag(1 / (rate * np.array([np.inf if share is None else share, error])))


def summarise(decays: tuple[Decay, ...]) -> Summaries:
    """Reduce decays to what they say of the loss.

    Parameters
    ----------
    decays : tuple of Decay
        Fitted decays. One without a finite fit or without noise says nothing: it gets no
        information.

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
        if np.isfinite(a) and fit.rms_residual > 0:
            parts[k] = loss_parts(a, b, fit.mean_current)
            root[k] = _root(decay, parts[k])
    return Summaries(*map(jnp.asarray, (current, parts, root)))


PRESSURE_ERROR = 0.05
RECORD = "decays"
LARGEST = 1e3
# The scale of the RF voltage is sought within so many errors of its prior, and losses computed at
# each of them.
WIDEST = 3
# A prior that data narrow by less than this share decides by itself.
NARROWED = 0.2
# How far walkers begin from scales that the decays do not tell.
WIDTH = 0.3


@shown
@dataclass(frozen=True, eq=False)
class ScaleFit:
    """Scales on the mechanisms of first principles, from many decays.

    Parameters
    ----------
    status : Status
        `converged`; `poor_fit` if chi² is improbable; `unidentified` if a mechanism is not
        separable from the others; `not_converged` if the search failed.
    message : str
        Cause and remedy.
    scales : mapping of str to Quantity
        Factors on the ring file's values: touschek, bremsstrahlung, elastic, desorption, also as
        attributes; without an error where the decays do not separate the mechanism. rf_voltage,
        true over stated, where it has a prior.
    fit : Fit
        Of the core, with the priors among its parts.
    dof : int
        Two numbers a decay, less the scales.
    covariance : array, shape (n, n)
        Linearised, not enlarged, of all scales whether separable or not; its entries are infinite
        along directions that nothing determines.
    pressure_error : float
        Relative error of the pressure readings, of each record independently.
    machine : Machine
        The ring and its usual operation.
    terms : LossTerms
        First principles at the settings of each decay.
    measured : Summaries
        What each decay says.
    names : tuple of str
        Names of the decays.
    """

    status: Status
    message: str
    scales: Mapping[str, Quantity]
    fit: Fit
    dof: int
    covariance: np.ndarray
    pressure_error: float
    machine: Machine
    terms: LossTerms
    measured: Summaries
    names: tuple[str, ...]

    @property
    def vector(self) -> np.ndarray:
        """All scales, separable or not, shape (n,)."""
        return self.fit.theta

    @property
    def chi2(self) -> float:
        """Sum of squares, priors not counted."""
        return self.fit.group(RECORD).chi2

    @property
    def error_scale(self) -> float:
        """sqrt(chi²/dof) where above 1."""
        return error_scale(self.chi2, self.dof)

    def terms_at(self, operation: Operation, current: float) -> LossTerms:
        """First principles at a setting, for these scales."""
        return loss_terms(self.machine.ring, operation, current, self.voltages)

    @property
    def voltages(self) -> np.ndarray | None:
        """True over stated RF voltages at which losses are computed, if its scale is free."""
        return None if self.terms.voltages is None else np.asarray(self.terms.voltages[0])

    def determines(self, quantity: Callable[[Array], Array]) -> np.ndarray:
        """Tell if decays and priors, and not the limits of the scales alone, determine quantities.

        ``quantity(scales)`` is an array in JAX; each is told if known to a third of itself, or of
        what the ring file says where that is more.
        """
        vector = jnp.asarray(self.vector)
        usual = jnp.ones_like(vector)
        size = np.maximum(np.abs(quantity(vector)), np.abs(quantity(usual)))
        error = spread_of_scales(self.fit).error(np.asarray(jax.jacfwd(quantity)(vector)))
        return self.error_scale * error < DETERMINED * size

    def about(self, terms: LossTerms, measured: Summaries) -> tuple[np.ndarray, ...]:
        """Expand decays: their weights, their `pulls`, and the slopes of these by the scales."""
        vector = jnp.asarray(self.vector)
        weight = whitener(vector, terms, measured, self.pressure_error)
        given = vector, terms, measured, weight
        return tuple(map(np.asarray, (weight, pulls(*given), _by_scales(*given))))

    def __str__(self) -> str:
        rows = [f"{len(self.names)} decays: {self.status}. {self.message}"]
        rows += [f"  {name:15s} {scale}" for name, scale in self.scales.items()]
        return "\n".join([*rows, f"  chi²/dof {self.chi2:.4g}/{self.dof}"])

    def __getattr__(self, name: str) -> Quantity:
        if name in (*SCALES, VOLTAGE) and name in vars(self).get("scales", {}):
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
            flat from 0 to 1000. The pressure errors are integrated out as in the fit.
        """
        from beamfit.sampling.ensemble import draw

        study = (self.terms, self.measured, self.pressure_error, self.error_scale)
        record = Record(RECORD, _pulls, study, np.zeros(self.measured.parts.shape), 1.0)
        stated = Statement(
            data=study,
            log_volume=_log_volume,
            units=dict.fromkeys(self.scales, "1"),
            width=dict.fromkeys(SCALES, WIDTH),
            priors_own=[name for name, scale in self.scales.items() if scale.error is None],
        )
        optimum = Optimum(self.vector, Finding(self.status, self.message), [1.0], [True])
        problem = replace(self.fit.problem, records=[record])
        return draw(target_of(problem, optimum, stated), seed=seed, **options)

    def to_json(self) -> dict[str, Any]:
        """Return the scales and the verdict as JSON's types."""
        verdict = {"status": self.status, "message": self.message}
        rest = {"chi2": self.chi2, "dof": self.dof, "decays": self.names}
        return json_of({**verdict, **self.scales, **rest})


def stacked_terms(
    decays: Sequence[Decay], machine: Machine, voltages: np.ndarray | None = None
) -> LossTerms:
    """First principles at the settings of each decay, each of shape (n,); `voltages` as of
    `LossTerms`.
    """
    settings = [(operation_during(d.segment, machine), d.fit.mean_current) for d in decays]
    rows = [loss_terms(machine.ring, *setting, voltages) for setting in settings]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *rows)


def _parts(scales: Array, terms: LossTerms, factor: Array) -> Array:
    return loss_parts(*scaled_losses(scales, terms, factor), terms.current)


@jax.jit
def whitener(scales: Array, terms: LossTerms, measured: Summaries, pressure_error: Array) -> Array:
    """W of shape (n, 2, 2) with WᵀW = Rᵀ (1 + g gᵀ)⁻¹ R, g = R ∂(parts)/∂(factor) times the
    relative pressure error: each decay's pressure factor integrated out (Sherman and Morrison).
    """
    ones = jnp.ones_like(terms.current)
    _, slope = jax.jvp(lambda factor: _parts(scales, terms, factor), (ones,), (ones,))
    g = jnp.einsum("nij,nj->ni", measured.root, slope * pressure_error)
    square = jnp.sum(g**2, -1)
    # (1 + g gᵀ)^(-1/2) = 1 - g gᵀ (1 - 1/sqrt(1 + g²))/g², which is 1/(s (1 + s)) of s² = 1 + g².
    root = jnp.sqrt(1 + square)
    shrink = jnp.eye(2) - g[:, :, None] * g[:, None, :] / (root * (1 + root))[:, None, None]
    return shrink @ measured.root


@jax.jit
def pulls(scales: Array, terms: LossTerms, measured: Summaries, weight: Array) -> Array:
    """Model minus measurement in standard errors, shape (n, 2); `weight` is that of `whitener`."""
    off = _parts(scales, terms, jnp.ones_like(terms.current)) - measured.parts
    return jnp.einsum("nij,nj->ni", weight, off)


_by_scales = jax.jit(jax.jacfwd(pulls))


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
    lowest = min(float(operation_during(d.segment, machine).rf_voltage) for d in decays)
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
    the model linearised in it.
    """
    if not decays:
        raise InputError("no decay", "one or more; several settings separate the mechanisms")
    priors = priors or {}
    known, voltages = _checked(priors), _voltages(decays, machine, priors.get(VOLTAGE))
    terms, measured = stacked_terms(decays, machine, voltages), summarise(tuple(decays))
    nothing = np.zeros(measured.parts.shape)
    free = [Free(name, 0.0, LARGEST) for name in SCALES]
    free += [] if voltages is None else [Free(VOLTAGE, voltages[0], voltages[-1])]
    names = (*SCALES, VOLTAGE)[: len(free)]
    vector = np.array([priors.get(name, (1.0, 0.0))[0] for name in names])
    for _ in range(5):  # the weight moves little with the scales: it settles in two or three
        weight = whitener(vector, terms, measured, pressure_error)
        record = Record(RECORD, _weighted, (terms, measured, weight), nothing, 1.0)
        found = solve(Problem(dict(zip(names, vector, strict=True)), free, [record], known))
        vector = found.theta
    seen = int(np.sum(np.any(np.asarray(measured.root) != 0, axis=-1)))
    spread, dof = spread_of_scales(found), seen - len(SCALES)
    blind = ~np.isfinite(spread.error(np.eye(vector.size)))
    covariance = np.where(np.outer(blind, blind), np.inf, spread.seen)
    chi2 = found.group(RECORD).chi2
    values = zip(names, vector, np.sqrt(np.diag(covariance)), strict=True)
    scale = error_scale(chi2, dof)
    scales = {name: _scale(name, *told, scale, priors) for name, *told in values}
    ended = found.status not in (Status.not_converged, Status.not_finite)
    verdict = finding_of_scales(ScaleEvidence(scales, chi2, dof, ended, len(decays)))
    return ScaleFit(
        verdict.status, verdict.cause, scales, found, dof, covariance, pressure_error, machine,
        terms, measured, tuple(d.fit.record for d in decays),
    )  # fmt: skip


def error_scale(chi2: float, dof: int) -> float:
    """sqrt(chi²/dof) where above 1."""
    return math.sqrt(max(1.0, chi2 / dof)) if dof > 0 else 1.0


def spread_of_scales(found: Fit) -> Spread:
    """Spread of the scales without their bounds, which stand for nothing known."""
    unbounded = np.full(found.theta.shape, np.inf)
    return spread_of(found.jacobian, -unbounded, unbounded)


def _vector(model: Mapping[str, Array]) -> Array:
    return jnp.stack([model[name] for name in (*SCALES, VOLTAGE) if name in model])


def _weighted(model: Mapping[str, Array], data: tuple[LossTerms, Summaries, Array]) -> Array:
    """Model minus measurement, in standard errors taken at the last scales."""
    return pulls(_vector(model), *data)


def _scale(
    name: str, value: float, raw: float, scale: float, priors: Mapping[str, tuple[float, float]]
) -> Quantity:
    """A scale, without an error where the decays do not tell it."""
    # Against 1 where the value is smaller: a mechanism found absent, 0.0 ± 0.1, is separable.
    known = scale * raw < DETERMINED * max(value, 1.0)
    if name == VOLTAGE:
        known = raw < (1 - NARROWED) * priors[name][1]
    found = Quantity(float(value), scale * float(raw), "1", float(raw))
    return found if known else found.open()


# First principles, the decays, the relative error of pressure readings, the factor on errors.
Study = tuple[LossTerms, Summaries, Array, Array]


def _whitened(scales: Mapping[str, Array], study: Study) -> tuple[Array, Array]:
    terms, measured, pressure_error, _ = study
    weight = whitener(_vector(scales), terms, measured, pressure_error)
    return weight, pulls(_vector(scales), terms, measured, weight)


def _pulls(scales: Mapping[str, Array], study: Study) -> Array:
    """Model minus measurement in standard errors, which move with the scales."""
    return _whitened(scales, study)[1] / study[3]


def _log_volume(scales: Mapping[str, Array], study: Study) -> Array:
    """det(W)/det(R): the normalisation, which changes with the scales as the errors do."""
    volume = jnp.abs(jnp.linalg.det(_whitened(scales, study)[0]))
    known = jnp.abs(jnp.linalg.det(study[1].root)) > 0
    return jnp.sum(jnp.where(known, jnp.log(jnp.where(known, volume, 1.0)), 0.0))


# The scale of the RF voltage, fitted where a prior says how well its reading is calibrated.
VOLTAGE = "rf_voltage"


class ScaleEvidence(NamedTuple):
    """A fit of scales as the rules see it."""

    scales: Mapping[str, Quantity]
    chi2: float
    dof: int
    ended: bool
    decays: int

    @property
    def improbable(self) -> bool:
        """True if chi² is improbable."""
        return self.dof > 0 and chi2_probability(self.chi2, self.dof) < POOR_FIT


def _lost(e: ScaleEvidence) -> Finding | None:
    said = "The search for the scales did not end: look at the records."
    return None if e.ended else Finding(Status.not_converged, said)


def _blind(e: ScaleEvidence) -> Finding | None:
    names = [name for name, scale in e.scales.items() if scale.error is None and name in SCALES]
    if not names:
        return None
    many = "one decay" if e.decays == 1 else f"{e.decays} decays"
    advice = ", ".join(dict.fromkeys(SCALES[name] for name in names))
    more = ""
    if e.improbable:
        more = f" First principles miss something besides: chi²/dof is {e.chi2 / e.dof:.3g}."
    return Finding(
        Status.unidentified,
        f"{' and '.join(names)} not separable by {many}: vary {advice}, or give a prior.{more}",
    )


def _improbable(e: ScaleEvidence) -> Finding | None:
    if not e.improbable:
        return None
    return Finding(
        Status.poor_fit,
        f"chi²/dof is {e.chi2 / e.dof:.3g}, improbable for first principles with these scales; "
        "the errors are enlarged to match: look for an anomaly, or correct by a network.",
    )


def _separable(e: ScaleEvidence) -> Finding:
    return Finding(Status.converged, "Every mechanism is separable.")


RULES = (_lost, _blind, _improbable, _separable)


def finding_of_scales(evidence: ScaleEvidence) -> Finding:
    """Status and sentences on the scales."""
    found = judge(evidence, RULES)
    voltage = evidence.scales.get(VOLTAGE)
    if voltage is None or voltage.error is not None:
        return found
    said = f"{found.cause} The decays do not tell the scale of the RF voltage: its prior does."
    return Finding(found.status, said)
