"""A shift as one answer: scales, loss budget, best point, next decay, and what has changed."""

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
from beamfit.lifetime.expansion import DETERMINED, Expansion, lifetime_of
from beamfit.lifetime.fill_noise import quantiles
from beamfit.lifetime.fit import bare
from beamfit.lifetime.loss_network import VOLTAGES, NetworkFit, fit_loss_network
from beamfit.lifetime.mechanisms import (
    MECHANISMS,
    SCALES,
    LossTerms,
    scaled_losses,
    scaled_parts,
    terms_along,
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

CAUSES = {
    "a": "the bunch or the momentum acceptance changed, or the beam-induced pressure",
    "b": "a gas loss that the gauge does not see: a leak away from it, heavier gas, aperture",
    "a and b": "gas with desorption, or an aperture, that gauge and settings do not show",
}


class Anomaly(NamedTuple):
    """Mechanism that moved, and since when.

    Attributes
    ----------
    status : Status
        `converged` if the decays follow the model, `poor_fit` if something moved.
    message : str
        The verdict in a sentence.
    since : str or None
        Name of the first decay after the change.
    moved : tuple of str
        "a", "b", both or none.
    a, b : Quantity
        Relative change of a and b since then, in units of 1.
    probability : float
        Chance of so large a change, at any time, if nothing moved.
    """

    status: Status
    message: str
    since: str | None
    moved: tuple[str, ...]
    a: Quantity
    b: Quantity
    probability: float


def _linearised(fit: ScaleFit, decays: Sequence[Decay]) -> tuple[np.ndarray, np.ndarray]:
    """Later decays beside each of the noises that earlier ones may have, whitened with the errors
    of scales and pressures: readings minus model, (k, 2n), and their slopes by relative changes of
    a and of b of each decay, (k, 2n, n, 2).
    """
    together = DecaySet.of(decays, fit.machine, fit.decays.pressure_error, fit.voltages)
    _, off, rows, change = fit.linearise(together)
    count, noise, found = 2 * len(decays), fit.noise, []
    whole = block_diag(*change).reshape(count, -1, 2)
    for k in range(noise.weight.size):
        by_scales = (rows @ noise.covariance_root[k]).reshape(count, -1)
        scattered = (whole * noise.scatter[k]).reshape(count, -1)
        moved = (off + rows @ (noise.shift[k] - noise.centre)).ravel()
        whiten = np.asarray(add_errors(np.eye(count), np.hstack([by_scales, scattered])))
        found.append((-whiten @ moved, np.tensordot(whiten, whole, 1)))
    return tuple(map(np.array, zip(*found, strict=True)))


def _fitted(off: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fall of chi², the changes that bring it, and their covariance, by noise."""
    turned = np.swapaxes(change, 1, 2)
    covariance = np.linalg.pinv(turned @ change)
    score = np.einsum("kij,kj->ki", turned, off)
    found = np.einsum("kij,kj->ki", covariance, score)
    return np.sum(found * score, axis=1), found, covariance


def find_anomaly(fit: ScaleFit, decays: Sequence[Decay]) -> Anomaly:
    """Look for a lasting change of a or b against the fitted model.

    Parameters
    ----------
    fit : ScaleFit
        Model fitted to earlier decays, taken to be in order.
    decays : sequence of Decay
        Later decays, in order of time.

    Returns
    -------
    Anomaly
        The change and its start that explain the decays best, if chance does not.

    Raises
    ------
    InputError
        If there is no decay, or a record's settings store no beam.

    Notes
    -----
    For each possible start, the relative changes of a and b from there on are fitted by linear
    least squares with the covariance of readings, scatter, pressure gauge and scales. The fall of
    chi² has two degrees of freedom; its probability, averaged over the noise that the earlier
    decays leave open, is multiplied by the number of starts. A pressure
    rise that the gauge shows is part of the model and no anomaly.
    """
    if not decays:
        raise InputError("no decay", "one or more to compare with the model")
    # A fall of chi² by two numbers has the probability exp(-fall/2), averaged over the noise.
    (off, change), weight = _linearised(fit, decays), fit.noise.weight
    since = [change[:, :, first:].sum(axis=2) for first in range(len(decays))]
    trials = [_fitted(off, one) for one in since]
    logs = [logsumexp(np.log(weight) - fall / 2) for fall, *_ in trials]
    best = int(np.argmin(logs))
    chance = min(1.0, len(decays) * math.exp(logs[best]))
    falls, found, covariance = trials[best]
    middle = weight @ found
    spread = np.diagonal(covariance, axis1=1, axis2=2) + (found - middle) ** 2
    error = np.sqrt(weight @ spread)
    a, b = (Quantity(float(v), float(e), "1") for v, e in zip(middle, error, strict=True))
    if chance > POOR_FIT:
        message = f"{len(decays)} decays follow the model (p = {chance:.2g})."
        return Anomaly(Status.converged, message, None, (), a, b, chance)
    moved, begun = _moved(off, since[best], falls, weight), decays[best].fit.record
    names = " and ".join(moved)
    changes = ", ".join(
        f"{name} by {100 * q.value:+.3g} ± {100 * q.error:.2g} %"
        for name, q in (("a", a), ("b", b))
        if name in moved
    )
    message = f"{names} moved since {begun} ({changes}; p = {chance:.2g}): {CAUSES[names]}."
    return Anomaly(Status.poor_fit, message, begun, moved, a, b, chance)


def _moved(
    off: np.ndarray, change: np.ndarray, falls: np.ndarray, weight: np.ndarray
) -> tuple[str, ...]:
    """Test if one of the two explains as much as both."""
    alone = {name: _fitted(off, change[:, :, [k]])[0] for k, name in enumerate("ab")}
    falls = {name: np.maximum(falls - own, 0.0) for name, own in alone.items()}
    chance = {name: weight @ chdtrc(1.0, fall) for name, fall in falls.items()}
    best = max(chance, key=chance.get)
    return (best,) if chance[best] > POOR_FIT else ("a", "b")


def budget_intervals(
    fit: ScaleFit,
    sample: Posterior,
    operation: Operation,
    current: float,
    probability: float = 0.68,
) -> tuple[Interval, ...]:
    """The loss budget at a setting, with credible intervals.

    Parameters
    ----------
    fit : ScaleFit
        The fit.
    sample : Posterior
        Its draws.
    operation : Operation
        Settings and vacuum.
    current : float
        Beam current, mA.
    probability : float, optional
        Of the intervals.

    Returns
    -------
    tuple of Interval
        Loss rates 1/h by mechanism, a, b, and the lifetime h; NaN where only the limits of the
        scales decide.
    """
    units = {m.name: "1/h" for m in MECHANISMS if m.vary}
    units |= {"a": "1/(mA s)", "b": "1/s", "lifetime": "h"}
    terms = fit.terms_at(operation, current)

    def rows(scales: Array) -> Array:
        losses = scaled_parts(scales, terms)
        rates = losses.rates(current)
        parts = [HOUR * rates[name] for name in units if name in rates]
        return jnp.stack([*parts, losses.a, losses.b, 1 / _rate(scales, terms) / HOUR])

    values = np.asarray(jax.vmap(rows)(jnp.asarray(sample.draws)))
    ends = np.percentile(values, [50, 50 - 50 * probability, 50 + 50 * probability], axis=0)
    told = fit.determines(rows)
    found = np.where(told, ends, np.nan).T
    return tuple(
        Interval(name, *map(float, of), unit, bool(known))
        for (name, unit), of, known in zip(units.items(), found, told, strict=True)
    )


def _rate(scales: Array, terms: LossTerms) -> Array:
    """Loss rate at the mean current, 1/s."""
    a, b = scaled_losses(scales, terms)
    return a * terms.current + b


# Means of neighbouring readings that stand for a decay that could be recorded.
READINGS = 64


class DecayCandidate(NamedTuple):
    """A decay that could be recorded.

    Attributes
    ----------
    operation : Operation
        Settings and vacuum.
    current : float
        Current at the start, mA.
    duration : float
        s.
    noise : float
        Standard deviation of the mean of what is read in 1/64 of the duration, mA.
    """

    operation: Operation
    current: float
    duration: float
    noise: float


class Proposal(NamedTuple):
    """A candidate and what it would bring.

    Attributes
    ----------
    candidate : DecayCandidate
        The decay.
    information : float
        Logarithm of the factor by which the volume of the scales' error ellipsoid shrinks.
    errors : array, shape (4,)
        Expected standard deviations of Touschek, bremsstrahlung, elastic, desorption afterwards.
    """

    candidate: DecayCandidate
    information: float
    errors: np.ndarray


def _rows(fit: ScaleFit, candidate: DecayCandidate) -> np.ndarray:
    """Readings of the candidate predicted by the scales, over its errors, shape (2, scales)."""
    terms = fit.terms_at(candidate.operation, candidate.current)
    a, b = map(float, scaled_losses(jnp.asarray(fit.vector), terms))
    time = np.linspace(0.0, candidate.duration, READINGS)
    beam = np.asarray(beam_at(time, candidate.current, a, b))
    record = DecayRecord(time, beam, np.full(READINGS, candidate.noise))
    mean, root = beam.mean(), information_root(Expansion.at(record, candidate.current, a, b))
    summary = Summaries(mean, loss_parts(a, b, mean), root)
    one = terms._replace(current=mean), summary
    alone = jax.tree.map(lambda part: jnp.asarray(part)[None], one)
    one = DecaySet(*alone, fit.decays.pressure_error)
    *_, [rows], [change] = fit.linearise(one)
    # A new decay scatters as the likeliest noise says.
    scattered = change * fit.noise.scatter[fit.noise.most_probable]
    return np.asarray(add_errors(np.eye(2), scattered)) @ rows


def next_decays(fit: ScaleFit, candidates: Sequence[DecayCandidate]) -> tuple[Proposal, ...]:
    """Rank decays by what they would tell about the scales.

    Parameters
    ----------
    fit : ScaleFit
        What is known so far.
    candidates : sequence of DecayCandidate
        What could be recorded.

    Returns
    -------
    tuple of Proposal
        The most informative first (D-optimality, in linear approximation).

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
    # Of what is known of the scales so far their limits are a part, as a wide prior.
    problem, one = fit.fit.problem, np.eye(fit.vector.size)
    with_prior = np.isin(problem.names, [prior.name for prior in problem.priors])
    known = Information(
        fit.fit.dense_jacobian, np.ones(1), one, np.ones(len(one), bool), problem.lower,
        problem.upper, with_prior=with_prior,
    )  # fmt: skip
    rows = np.array([_rows(fit, candidate) for candidate in candidates])
    [before] = scores(known, np.zeros((1, *rows.shape[1:])), volume=True)
    gains = 0.5 * (before - scores(known, rows, volume=True))
    proposals = [
        Proposal(candidate, float(gain), known.with_rows(own).error)
        for candidate, own, gain in zip(candidates, rows, gains, strict=True)
    ]
    return tuple(sorted(proposals, key=lambda proposal: -proposal.information))


class Limits(NamedTuple):
    """Lowest and highest value allowed of each setting.

    Attributes
    ----------
    rf_voltage : (float, float)
        V.
    scraper_y : (float, float)
        Distance from the beam, m.
    bunches : (float, float)
        Number of bunches.
    """

    rf_voltage: tuple[float, float]
    scraper_y: tuple[float, float]
    bunches: tuple[float, float]


class BestPoint(NamedTuple):
    """The settings of the longest lifetime.

    Attributes
    ----------
    rf_voltage : Quantity
        V; its error is the spread of the best voltage over the posterior, at least the search's.
    scraper_y, bunches : float
        m, and number: always the upper limits.
    lifetime : Quantity
        Lifetime there, h; NaN where the decays do not tell it.
    usual : Quantity
        Lifetime at the machine's usual settings, h; NaN where the decays do not tell it.
    message : str
        What limits it.
    """

    rf_voltage: Quantity
    scraper_y: float
    bunches: float
    lifetime: Quantity
    usual: Quantity
    message: str

    @property
    def status(self) -> Status:
        """`unidentified` where the decays do not tell the lifetime there."""
        return Status.unidentified if self.lifetime.error is None else Status.converged


def _lifetime(fit: ScaleFit, sample: Posterior, operation: Operation, current: float) -> Quantity:
    terms = fit.terms_at(operation, current)
    if not fit.determines(lambda scales: _rate(scales, terms)):
        return Quantity(math.nan, None, "h")
    rates = jax.vmap(_rate, (0, None))(jnp.asarray(sample.draws), terms)
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
        What may be set.
    current : float
        Beam current to run at, mA.

    Returns
    -------
    BestPoint
        With the spread over the posterior.

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
    usual = fit.machine.operation
    wide = usual._replace(scraper_y=limits.scraper_y[1], bunches=float(limits.bunches[1]))
    low, draws = max(low, 1.01 * loss), sample.thinned()
    # True voltages are looked at; what is set is a reading.
    by = np.ones(len(draws)) if fit.voltages is None else draws[:, len(SCALES)]
    ends = max(low * by.min(), 1.01 * loss), max(high, low) * by.max()
    for _ in range(2):
        at = np.linspace(*ends, VOLTAGES)
        terms = terms_along(fit.machine.ring, wide, current, jnp.asarray(at))
        true = at[np.argmin(jax.vmap(_rate, (0, None))(jnp.asarray(draws), terms), axis=1)]
        step = at[1] - at[0]
        ends = max(at[0], true.min() - step), min(at[-1], true.max() + step)
    found = np.clip(true / by, low, max(high, low))
    spread = quantity_of_draws(found, "V")
    best, error = spread.value, math.hypot(spread.error, step / math.sqrt(12))
    inside = low + step < best < high - step
    reached = _lifetime(fit, sample, wide._replace(rf_voltage=best), current)
    message = (
        "The best RF voltage lies within its limits, where bucket and lattice acceptance meet."
        if inside
        else "The best RF voltage is at its limit: more range would help."
    )
    if reached.error is None:
        message, inside = "The decays do not tell the lifetime at other settings: vary them.", False
    return BestPoint(
        rf_voltage=Quantity(best, error if inside else None, "V"),
        scraper_y=limits.scraper_y[1],
        bunches=limits.bunches[1],
        lifetime=reached,
        usual=_lifetime(fit, sample, usual, current),
        message=message,
    )


class HeldBack(NamedTuple):
    """A decay as the others predict it.

    Attributes
    ----------
    name : str
        Of the decay.
    predicted : Quantity
        Lifetime at its mean current, h, from a fit to the other decays; the error is that of the
        scales, of this decay's pressure reading, and of its scatter.
    measured : Quantity
        What the decay itself says, h.
    pull : float
        Predicted less measured loss rate, in standard errors of both.
    """

    name: str
    predicted: Quantity
    measured: Quantity
    pull: float


def predict_held_back(fit: ScaleFit) -> tuple[HeldBack, ...]:
    """Predict the lifetime of each decay by a fit to all the others.

    Parameters
    ----------
    fit : ScaleFit
        Of all decays.

    Returns
    -------
    tuple of HeldBack
        In the order of the decays. Those that say nothing of the loss, and those without which the
        scales do not predict them, are left out.

    Notes
    -----
    Least squares linear about the fit, averaged over the noise: with H = J (JᵀJ)⁻¹ Jᵀ of one
    decay's whitened rows J and its residuals r, those of the fit without it are (1 - H)⁻¹ r, with
    the covariance (1 - H)⁻¹: R. D. Cook and S. Weisberg, Residuals and Influence in Regression
    (1982), section 2.2.

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
    weight, left, rows, change = fit.linearise(fit.decays)
    for k, name in enumerate(fit.names):
        root = np.asarray(measured.root[k])
        if not np.any(root):
            continue
        back = np.linalg.inv(weight[k])
        each = [
            _left_out(
                left[k] + rows[k] @ (noise.shift[i] - noise.centre),
                rows[k] @ noise.covariance_root[i],
                change[k] * noise.sizes(i, len(fit.names))[k],
                change[k] * noise.scatter[i],
            )
            for i in range(noise.weight.size)
        ]
        off = np.array([(back @ one)[1] for one, _ in each])
        square = np.array([back[1] @ spread @ back[1] for _, spread in each])
        reading = np.linalg.inv(root)[1]
        rate, error = measured.parts[k, 1], np.linalg.norm(reading)
        # By some noises a decay may alone tell of something.
        told = square - error**2 < (DETERMINED * rate) ** 2
        weight_told = noise.weight * told
        if not weight_told.sum() > MENTION_PROBABILITY:
            continue
        low, high = quantiles(weight_told / weight_told.sum(), off, np.sqrt(square), CENTRAL)
        middle, spread = (low + high) / 2, (high - low) / 2
        by_others = np.sqrt(max(spread**2 - error**2, 0.0))
        both = lifetime_of(rate + middle, by_others), lifetime_of(rate, error)
        found.append(HeldBack(name, *both, middle / spread))
    return tuple(found)


def _left_out(
    off: np.ndarray, own: np.ndarray, here: np.ndarray, usual: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (2,) of a decay by the fit to the others, and their covariance.

    `own` are its slopes by what the scales err by in the fit to all, `here` and `usual` its scatter
    there and that of any decay.
    """
    covariance = np.eye(2) + here @ here.T
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, own)
    shares, turned = np.linalg.eigh(white @ white.T)
    # A decay that alone tells of something is predicted by nothing else: infinitely badly.
    rest = turned / np.maximum(1 - shares, np.finfo(float).eps) @ turned.T
    spread = root @ rest @ root.T - covariance + np.eye(2) + usual @ usual.T
    return root @ rest @ np.linalg.solve(root, off), spread


NOTE = (
    "Scales multiply the ring file's first principles. Brackets are 68 % credible intervals. The "
    "best point is sought within the range of settings seen."
)


@answer
@dataclass(frozen=True, eq=False)
class Shift(Judged):
    """Joint answer of many decays.

    Parameters
    ----------
    fit : ScaleFit
        Scales on the mechanisms.
    budget : tuple of Interval
        Loss budget at the machine's usual settings, 68 % credible intervals.
    current : float
        Current for budget and best point, mA: the highest mean current of the decays.
    limits : Limits
        The range of settings seen, within which the best point is sought.
    best : BestPoint
        The longest lifetime within them.
    proposals : tuple of Proposal
        Decays to record next, the most informative first.
    anomaly : Anomaly or None
        Whether the second half departs from a model fitted to the first; None if the first half
        does not separate the mechanisms.
    network : NetworkFit or None
        A network that corrects first principles, where one was asked for.
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
        """Name, status and sentence of each verdict."""
        found = [(f"{self._count} together", self.status, self.message)]
        if self.untold:
            found.append(("loss budget", Status.unidentified, self.untold))
        found.append((f"best lifetime {self.best.lifetime}", self.best.status, self.best.message))
        if (moved := self.anomaly) is not None:
            found.append(("second half against the first", moved.status, moved.message))
        if self.network is not None:
            found.append(("network", self.network.fit.status, self.network.fit.message))
        return found

    @property
    def untold(self) -> str:
        """The sentence on what the decays do not tell of the budget; empty if nothing."""
        names = [row.name for row in self.budget if not row.separable]
        if not names:
            return ""
        return (
            f"{', '.join(names)} at {self.current:.4g} mA and the usual settings are not "
            "determined, only limited by those of the scales: record longer, or vary the settings."
        )

    @cached_property
    def held_back(self) -> tuple[HeldBack, ...]:
        """Each decay as the others predict it."""
        return predict_held_back(self.fit)

    def tables(self) -> tuple[Table, ...]:
        """The scales and what follows from them, and the network."""
        rows = [Row("status", [self.status]), *self._scale_rows(), *self._advice_rows()]
        tables = [labelled("First principles fitted to", [self._count], rows, NOTE)]
        if self.network is not None:
            rows = self.network.rows(self.current)
            tables.append(labelled("First principles corrected by a network", [self._count], rows))
        return tuple(tables)

    def _scale_rows(self) -> list[Row]:
        fit, rows = self.fit, []
        for name, scale in fit.scales.items():
            of, untold = "scale on the ring file", "not separable"
            if name == VOLTAGE:
                of, untold = "true over read", "not told: its prior's"
            rows.append(Row(f"{name}, {of}", [untold if scale.error is None else scale], True))
        worth = f"{fit.chi2:.4g}/{fit.dof}" if fit.dof > 0 else "not testable"
        rows.append(Row("chi2/dof without scatter", [worth], True))
        for name, scatter in fit.scatter.items():
            most = f"below {percent(scatter.interval_95[1])} at 95 %"
            said = percent(scatter.value) if scatter.value else most
            rows.append(Row(f"scatter of {name} from fill to fill", [said], True))
        for row in self.budget:
            said = str(row).removeprefix(f"{row.name}: ") if row.separable else "not determined"
            rows.append(Row(f"{row.name} at {self.current:.4g} mA", [said], row.name == "lifetime"))
        return rows

    def _advice_rows(self) -> list[Row]:
        best, rows = self.best, []
        volts, error = best.rf_voltage.value / 1e3, best.rf_voltage.error
        limit = f"{volts:.6g} kV, at its limit"
        told = limit if error is None else Quantity(volts, error / 1e3, "kV")
        rows.append(Row("best RF voltage", [told], True))
        others = f"{1e3 * best.scraper_y:.4g} mm, {best.bunches:.6g}"
        rows.append(Row("best scraper and bunches", [others], True))
        rows.append(Row("lifetime there", [best.lifetime], True))
        if self.held_back:
            off = np.abs([one.pull for one in self.held_back])
            said = f"{sum(off < 1)} of {off.size} within 1, {sum(off < 2)} within 2 errors"
            rows.append(Row("each decay predicted by the others", [said]))
        for number, proposal in enumerate(self.proposals, 1):
            asked = proposal.candidate
            at, scraper, bunches = map(float, asked.operation[:3])
            said = f"{at / 1e3:.6g} kV, {1e3 * scraper:.4g} mm, {bunches:.6g} bunches, "
            said += f"{asked.current:.4g} mA (information {proposal.information:.3g})"
            rows.append(Row(f"next decay, choice {number}", [said], number == 1))
        return rows

    def to_json(self) -> dict[str, Any]:
        """Return the answer as JSON's types, in SI, mA and h."""
        proposals = [
            settings_json(p.candidate.operation)
            | {"current_mA": p.candidate.current, "information": p.information}
            for p in self.proposals
        ]
        found = {
            "scales": self.fit,
            "current": bare(self.current, "mA"),
            "budget": self.budget,
            "not_determined": self.untold,
            "held_back": self.held_back,
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
        In order of time, at different settings.
    machine : Machine
        The ring, and what the records do not say.
    seed : int, optional
        Of the random numbers.
    network : bool, optional
        Also fit a network that corrects first principles.
    priors : mapping of str to (mean, standard deviation), optional
        As of `fit_scales`.

    Returns
    -------
    Shift
        Also where mechanisms are not separable: the scales say so.

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
    seen = [[float(getattr(setting, name)) for setting in settings] for name in Limits._fields]
    limits, current = Limits(*((min(values), max(values)) for values in seen)), max(currents)
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
    """The corners of what was seen, as long and as noisy as the decays were."""
    duration = float(np.median([d.segment.span for d in decays]))
    noise = float(
        np.median([d.fit.rms_residual / np.sqrt(len(d.segment) / READINGS) for d in decays])
    )
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
    # What the first half does not tell, the second cannot contradict.
    if not np.isfinite(reference.spread.errors).all():
        return None
    return find_anomaly(reference, decays[half:])
