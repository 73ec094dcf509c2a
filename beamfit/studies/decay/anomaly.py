"""Has something changed? New decays against the fitted model: which of a, b moved, since when."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtrc

from beamfit.errors import InputError
from beamfit.lifetime.scaled import scaled_losses
from beamfit.quantity import Quantity, Status
from beamfit.studies.decay.scales import ScaleFit, pulls, stacked_terms, whitener
from beamfit.studies.decay.study import Decay
from beamfit.studies.decay.summary import summarise

__all__ = ["Anomaly", "find_anomaly"]

# Chance of a false alarm in one call.
FALSE_ALARM = 1e-3


class Anomaly(NamedTuple):
    """What moved, and since when.

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


class _Linear(NamedTuple):
    """Readings minus model (2n,), slopes by relative changes of a and b (2n, 2), and the root
    of their covariance, with the errors of scales and pressures in it."""

    off: np.ndarray
    change: np.ndarray
    root: np.ndarray

    def since(self, first: int) -> tuple[np.ndarray, np.ndarray]:
        """Whitened readings and slopes if the change began with a decay."""
        later = np.where(np.arange(len(self.off))[:, None] < 2 * first, 0.0, self.change)
        return np.linalg.solve(self.root, self.off), np.linalg.solve(self.root, later)


def _linearised(fit: ScaleFit, decays: Sequence[Decay]) -> _Linear:
    terms, measured = stacked_terms(decays, fit.machine), summarise(tuple(decays))
    scales = jnp.asarray(fit.vector)
    weight = whitener(scales, terms, measured, fit.pressure_error)
    off = np.asarray(pulls(scales, terms, measured, weight)).ravel()
    by_scale = np.asarray(jax.jacfwd(pulls)(scales, terms, measured, weight)).reshape(-1, 4)
    a, b = (np.asarray(part) for part in scaled_losses(scales, terms))
    quadratic = a * np.asarray(terms.current)
    zero = np.zeros_like(b)
    # parts are (a I, a I + b)
    change = np.stack([np.stack([quadratic, zero], -1), np.stack([quadratic, b], -1)], axis=1)
    change = np.einsum("nij,njk->nik", np.asarray(weight), change).reshape(-1, 2)
    known = np.where(np.isfinite(fit.covariance), fit.covariance, 0.0)
    covariance = fit.error_scale**2 * (np.eye(off.size) + by_scale @ known @ by_scale.T)
    return _Linear(-off, change, np.linalg.cholesky(covariance))


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
    linear = _linearised(fit, decays)
    trials = [_fitted(*linear.since(first)) for first in range(len(decays))]
    falls = np.array([fall for fall, _, _ in trials])
    best = int(np.argmax(falls))
    fall, found, covariance = trials[best]
    chance = min(1.0, len(decays) * float(chdtrc(2, fall)))
    error = np.sqrt(np.diag(covariance))
    a, b = (Quantity(float(v), float(e), "1") for v, e in zip(found, error, strict=True))
    if chance > FALSE_ALARM:
        message = f"{len(decays)} decays follow the model (p = {chance:.2g})."
        return Anomaly(Status.converged, message, None, (), a, b, chance)
    moved = _moved(*linear.since(best), fall)
    names = " and ".join(moved)
    since = decays[best].fit.record
    causes = {
        ("a",): "the bunch or the momentum acceptance changed, or the beam-induced pressure",
        (
            "b",
        ): "a gas loss that the gauge does not see: a leak away from it, heavier gas, aperture",
        ("a", "b"): "gas with desorption, or an aperture, that gauge and settings do not show",
    }
    changes = ", ".join(
        f"{name} by {100 * q.value:+.3g} ± {100 * q.error:.2g} %"
        for name, q in (("a", a), ("b", b))
        if name in moved
    )
    message = f"{names} moved since {since} ({changes}; p = {chance:.2g}): {causes[moved]}."
    return Anomaly(Status.poor_fit, message, since, moved, a, b, chance)


def _moved(off: np.ndarray, change: np.ndarray, fall: float) -> tuple[str, ...]:
    """Whether one of the two explains as much as both, within 10.8 of chi² (p = 1e-3)."""
    alone = {name: _fitted(off, change[:, [k]])[0] for k, name in enumerate("ab")}
    best = max(alone, key=alone.get)
    return (best,) if fall - alone[best] < 10.8 else ("a", "b")
