"""A shift as one answer: scales, loss budget, best point, next decay, and what has changed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtrc, chdtri

from beamfit.answer import json_of, shown
from beamfit.errors import InputError
from beamfit.lifetime.advice import (
    BestPoint,
    DecayCandidate,
    Limits,
    Proposal,
    best_operating_point,
    next_decays,
)
from beamfit.lifetime.expansion import DETERMINED, lifetime_of
from beamfit.lifetime.fit import bare
from beamfit.lifetime.loss_network import Network, NetworkFit, fit_loss_network
from beamfit.lifetime.mechanisms import MECHANISMS, scaled_losses, scaled_parts
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scales import (
    ScaleFit,
    by_losses,
    fit_scales,
    spread_of_scales,
    stacked_terms,
    summarise,
)
from beamfit.lifetime.study import Decay, Machine, operation_during, settings_json
from beamfit.quantity import HOUR, Quantity, Status
from beamfit.sampling.posterior import Interval, Posterior
from beamfit.statistics import POOR_FIT

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


def _linearised(
    fit: ScaleFit, decays: Sequence[Decay]
) -> tuple[np.ndarray, Callable[[int], np.ndarray]]:
    """Readings minus model (2n,), and their slopes (2n, 2) by relative changes of a and b from a
    decay on; whitened, with the errors of scales and pressures.
    """
    terms = stacked_terms(decays, fit.machine, fit.voltages)
    measured = summarise(tuple(decays))
    weight, off, by_scale = fit.about(terms, measured)
    off, by_scale = off.ravel(), by_scale.reshape(off.size, -1)
    a, b = (np.asarray(part) for part in scaled_losses(jnp.asarray(fit.vector), terms))
    change = (weight @ by_losses(a * np.asarray(terms.current), b)).reshape(-1, 2)
    known = np.where(np.isfinite(fit.covariance), fit.covariance, 0.0)
    covariance = fit.error_scale**2 * (np.eye(off.size) + by_scale @ known @ by_scale.T)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    return -whiten @ off, lambda first: whiten[:, 2 * first :] @ change[2 * first :]


def _fitted(off: np.ndarray, change: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Fall of chi², the changes that bring it, and their covariance."""
    information = change.T @ change
    covariance = np.linalg.pinv(information)
    found = covariance @ (change.T @ off)
    return float(found @ information @ found), found, covariance


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
    least squares with the covariance of readings, pressure gauge and scales. The fall of chi² has
    two degrees of freedom; its probability is multiplied by the number of starts. A pressure
    rise that the gauge shows is part of the model and no anomaly.
    """
    if not decays:
        raise InputError("no decay", "one or more to compare with the model")
    off, since = _linearised(fit, decays)
    trials = [_fitted(off, since(first)) for first in range(len(decays))]
    falls = np.array([fall for fall, _, _ in trials])
    best = int(np.argmax(falls))
    fall, found, covariance = trials[best]
    chance = min(1.0, len(decays) * float(chdtrc(2, fall)))
    error = np.sqrt(np.diag(covariance))
    a, b = (Quantity(float(v), float(e), "1") for v, e in zip(found, error, strict=True))
    if chance > POOR_FIT:
        message = f"{len(decays)} decays follow the model (p = {chance:.2g})."
        return Anomaly(Status.converged, message, None, (), a, b, chance)
    moved, begun = _moved(off, since(best), fall), decays[best].fit.record
    names = " and ".join(moved)
    changes = ", ".join(
        f"{name} by {100 * q.value:+.3g} ± {100 * q.error:.2g} %"
        for name, q in (("a", a), ("b", b))
        if name in moved
    )
    message = f"{names} moved since {begun} ({changes}; p = {chance:.2g}): {CAUSES[names]}."
    return Anomaly(Status.poor_fit, message, begun, moved, a, b, chance)


def _moved(off: np.ndarray, change: np.ndarray, fall: float) -> tuple[str, ...]:
    """Test if one of the two explains as much as both."""
    alone = {name: _fitted(off, change[:, [k]])[0] for k, name in enumerate("ab")}
    best = max(alone, key=alone.get)
    return (best,) if fall - alone[best] < chdtri(1.0, POOR_FIT) else ("a", "b")


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
    terms = fit.terms_at(operation, current)
    units = {m.name: "1/h" for m in MECHANISMS if m.vary}
    units |= {"a": "1/(mA s)", "b": "1/s", "lifetime": "h"}

    def rows(scales):
        losses = scaled_parts(scales, terms)
        rates = losses.rates(current)
        a, b = losses.a, losses.b
        parts = [HOUR * rates[name] for name in units if name in rates]
        return jnp.stack([*parts, a, b, 1 / (a * current + b) / HOUR])

    values = np.asarray(jax.vmap(rows)(jnp.asarray(sample.draws)))
    ends = np.percentile(values, [50, 50 - 50 * probability, 50 + 50 * probability], axis=0)
    told = fit.determines(rows)
    found = np.where(told, ends, np.nan).T
    return tuple(
        Interval(name, *map(float, of), unit, bool(known))
        for (name, unit), of, known in zip(units.items(), found, told, strict=True)
    )


@shown
@dataclass(frozen=True, eq=False)
class Shift:
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
        A network of the losses, where one was asked for.
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
    network: Network | None = None,
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
    network : Network, optional
        Also fit a network of the losses: alone, or as a correction of first principles.
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
    current = max(decay.fit.mean_current for decay in decays)
    settings = [operation_during(decay.segment, machine) for decay in decays]
    seen = [[float(getattr(setting, name)) for setting in settings] for name in Limits._fields]
    limits = Limits(*((min(values), max(values)) for values in seen))
    corrected = fit if network is Network.correction else None
    return Shift(
        fit=fit,
        budget=budget_intervals(fit, sample, machine.operation, current),
        current=current,
        limits=limits,
        best=best_operating_point(fit, sample, limits, current),
        proposals=next_decays(fit, _candidates(decays, machine, limits, current))[:3],
        anomaly=_anomaly(decays, machine, priors),
        network=network and fit_loss_network(decays, machine, corrected, seed=seed),
    )


def _candidates(
    decays: Sequence[Decay], machine: Machine, limits: Limits, current: float
) -> list[DecayCandidate]:
    """The corners of what was seen, as long and as noisy as the decays were."""
    duration = float(np.median([d.segment.span for d in decays]))
    noise = float(np.median([d.fit.rms_residual / np.sqrt(len(d.segment) / 64) for d in decays]))
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
    if not np.isfinite(reference.covariance).all():
        return None
    return find_anomaly(reference, decays[half:])


class HeldBack(NamedTuple):
    """A decay as the others predict it.

    Attributes
    ----------
    name : str
        Of the decay.
    predicted : Quantity
        Lifetime at its mean current, h, from a fit to the other decays; the error is that of the
        scales and of this decay's pressure reading.
    measured : Quantity
        What the decay itself says, h.
    pull : float
        Predicted less measured loss rate, in standard errors of both.
    """

    name: str
    predicted: Quantity
    measured: Quantity
    pull: float


# A decay that leaves less than this of one to the others is known by nothing else.
LEAST = 1e-6


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
    Least squares linear about the fit: with H = J (JᵀJ)⁻¹ Jᵀ of one decay's whitened rows J and its
    residuals r, those of the fit without it are (1 - H)⁻¹ r, with the covariance (1 - H)⁻¹: R. D.
    Cook and S. Weisberg, Residuals and Influence in Regression (1982), section 2.2.

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
    measured = fit.measured
    weight, left, rows = fit.about(fit.terms, measured)
    half = spread_of_scales(fit.fit).half
    found = []
    for k, name in enumerate(fit.names):
        root, own = np.asarray(measured.root[k]), rows[k] @ half
        rest = np.eye(2) - own @ own.T
        if not np.any(root) or np.linalg.eigvalsh(rest)[0] < LEAST:
            continue
        back = np.linalg.inv(weight[k])
        whole = back @ np.linalg.inv(rest) @ back.T * fit.error_scale**2
        off = (back @ np.linalg.solve(rest, left[k]))[1]
        reading = np.linalg.inv(root)[1]
        rate, error = measured.parts[k, 1], fit.error_scale * np.linalg.norm(reading)
        spread = np.sqrt(max(whole[1, 1] - error**2, 0.0))
        if not spread < DETERMINED * rate:
            continue
        found.append(
            HeldBack(
                name,
                lifetime_of(rate + off, spread),
                lifetime_of(rate, error),
                float(off / np.sqrt(whole[1, 1])),
            )
        )
    return tuple(found)
