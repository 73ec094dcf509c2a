"""A decay as two numbers and their information: what a study of many records works with."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.decay import current
from beamfit.studies.decay.expansion import padded_size
from beamfit.studies.decay.fit import DecayFit
from beamfit.studies.decay.study import Decay
from beamfit.studies.decay.systematics import about_fit


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


@jax.jit
def information_root(
    time: Array, weight: Array, i0: Array, parts: Array, mean_current: Array
) -> Array:
    """Root of the information that readings hold on the two parts, I0 eliminated; a triangle, s."""

    def weighted(theta: Array) -> Array:
        quadratic, rate = theta[1], theta[2]
        law = current(time, theta[0], quadratic / mean_current, rate - quadratic)
        return weight * law

    jacobian = jax.jacfwd(weighted)(jnp.array([i0, parts[0], parts[1]]))
    # Columns in order of elimination: the last two rows of R hold what is left beside I0.
    return jnp.linalg.qr(jacobian, mode="r")[1:, 1:]


def _root(decay: Decay, parts: np.ndarray) -> np.ndarray:
    """The information that a decay holds on its parts, as of `Summaries`."""
    segment, fit, rows = decay.segment, decay.fit, len(decay.segment)
    if fit.first is not None:
        return _together(fit, parts[1])
    if fit.noise_inferred:
        error = np.full(rows, fit.noise)
    else:
        pulls = fit.residuals / segment.error
        error = segment.error * max(1.0, np.sqrt(pulls @ pulls / fit.dof))
    weight = 1 / (error * fit.inflation)
    extra = (0, padded_size(rows) - rows)
    time, weight = np.pad(segment.time, extra, mode="edge"), np.pad(weight, extra)
    root = np.asarray(information_root(time, weight, fit.i0.value, parts, fit.mean_current))
    return _with_monitor(root, fit)


def _with_monitor(root: np.ndarray, fit: DecayFit) -> np.ndarray:
    """The root with what is stated of the monitor added to the covariance of the parts."""
    changes = fit.readings.monitor_changes
    if not changes:
        return root
    about = about_fit(fit)
    moved = [about.moved(change) for change in changes]
    spread = root @ np.array([[m.a * fit.mean_current, m.rate_mean] for m in moved]).T
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
    >>> from beamfit.studies.decay.record import DecayRecord
    >>> from beamfit.studies.decay.study import study_record
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
