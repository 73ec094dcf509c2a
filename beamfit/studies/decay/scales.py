"""First principles fitted to many decays: how much each mechanism truly loses, and how sure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import least_squares

from beamfit.errors import InputError, nearest
from beamfit.lifetime.losses import SCALES
from beamfit.lifetime.scaled import Terms, loss_terms, scaled_losses
from beamfit.quantity import Quantity, Status
from beamfit.statistics import chi2_probability
from beamfit.studies.decay.loss_budget import Machine, operation_during
from beamfit.studies.decay.study import Decay
from beamfit.studies.decay.summary import Summaries, loss_parts, summarise

if TYPE_CHECKING:
    from beamfit.sampling.posterior import Posterior

__all__ = ["ScaleFit", "fit_scales", "pulls", "stacked_terms", "whitener"]

POOR_FIT = 1e-3
# A scale known to a third or worse cannot be told from a third more or less of another cause.
SEPARABLE = 1 / 3
PRESSURE_ERROR = 0.05


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
    touschek, bremsstrahlung, elastic, desorption : Quantity
        Factors on the ring file's values; without an error where the decays do not separate the
        mechanism.
    chi2 : float
        Sum of squares, priors not counted.
    dof : int
        Two numbers a decay, less the four scales.
    vector, covariance : array, shape (4,) and (4, 4)
        All four scales whether separable or not, and their linearised covariance, not enlarged;
        its entries are infinite along directions that nothing determines.
    error_scale : float
        sqrt(chi²/dof) where above 1.
    pressure_error : float
        Relative error of the pressure readings, of each record independently.
    machine : Machine
        The ring and its usual operation.
    terms : Terms
        First principles at the settings of each decay.
    measured : Summaries
        What each decay says.
    names : tuple of str
        Names of the decays.
    prior_mean, prior_error : array, shape (4,)
        Priors on the scales; an infinite error for none.
    """

    status: Status
    message: str
    touschek: Quantity
    bremsstrahlung: Quantity
    elastic: Quantity
    desorption: Quantity
    chi2: float
    dof: int
    vector: np.ndarray
    covariance: np.ndarray
    error_scale: float
    pressure_error: float
    machine: Machine
    terms: Terms
    measured: Summaries
    names: tuple[str, ...]
    prior_mean: np.ndarray
    prior_error: np.ndarray

    def __str__(self) -> str:
        rows = [f"{len(self.names)} decays: {self.status}. {self.message}"]
        rows += [f"  {name:15s} {getattr(self, name)}" for name in SCALES]
        return "\n".join([*rows, f"  chi²/dof {self.chi2:.4g}/{self.dof}"])

    def sample(self, seed: int = 0, **options: Any) -> Posterior:
        """Draw the scales from their posterior: see `beamfit.studies.decay.scale_sample`."""
        from beamfit.studies.decay.scale_sample import sample_scales

        return sample_scales(self, seed, **options)

    def to_json(self) -> dict[str, Any]:
        """Return the scales and the verdict as JSON's types."""
        return {
            "status": self.status.value,
            "message": self.message,
            **{name: getattr(self, name).to_json() for name in SCALES},
            "chi2": self.chi2,
            "dof": self.dof,
            "decays": list(self.names),
        }


def stacked_terms(decays: Sequence[Decay], machine: Machine) -> Terms:
    """First principles at the settings of each decay.

    Parameters
    ----------
    decays : sequence of Decay
        Decays whose records carry their settings.
    machine : Machine
        The ring, and what the records do not say.

    Returns
    -------
    Terms
        Each of shape (n,).

    Raises
    ------
    InputError
        As for `beamfit.studies.decay.loss_budget.operation_during`.
    """
    rows = [
        loss_terms(machine.ring, operation_during(d.segment, machine), d.fit.mean_current)
        for d in decays
    ]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *rows)


def _parts(scales: Array, terms: Terms, factor: Array) -> Array:
    return loss_parts(*scaled_losses(scales, terms, factor), terms.current)


@jax.jit
def whitener(scales: Array, terms: Terms, measured: Summaries, pressure_error: Array) -> Array:
    """Square root of each decay's information, its pressure reading's error included.

    Parameters
    ----------
    scales : array, shape (4,)
        Where the model is linearised in the pressure.
    terms, measured : Terms, Summaries
        Each of n decays.
    pressure_error : float
        Relative.

    Returns
    -------
    array, shape (n, 2, 2)
        W with WᵀW = Rᵀ (1 + g gᵀ)⁻¹ R, g = R ∂(parts)/∂(factor) times the error: the pressure
        factor integrated out (Sherman and Morrison).
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
def pulls(scales: Array, terms: Terms, measured: Summaries, weight: Array) -> Array:
    """Model minus measurement in standard errors, two for each decay.

    Parameters
    ----------
    scales : array, shape (4,)
        Factors.
    terms, measured : Terms, Summaries
        Each of n decays.
    weight : array, shape (n, 2, 2)
        From `whitener`.

    Returns
    -------
    array, shape (n, 2)
        Uncorrelated where the weight is right.
    """
    off = _parts(scales, terms, jnp.ones_like(terms.current)) - measured.parts
    return jnp.einsum("nij,nj->ni", weight, off)


_slopes = jax.jit(jax.jacfwd(pulls))


def _check_priors(priors: Mapping[str, tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    mean, error = np.ones(4), np.full(4, np.inf)
    for name, (value, spread) in priors.items():
        if name not in SCALES:
            raise InputError(f"a prior on '{name}'", nearest(name, list(SCALES)))
        if not (value >= 0 and spread > 0):
            raise InputError(f"{name} = {value} ± {spread}", "a mean of 0 or more, an error above")
        place = list(SCALES).index(name)
        mean[place], error[place] = value, spread
    return mean, error


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
        What is known of the scales beforehand.

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
    terms, measured = stacked_terms(decays, machine), summarise(tuple(decays))
    mean, error = _check_priors(priors or {})
    vector, success = mean, True
    for _ in range(4):  # the weight moves little with the scales: it settles in two or three
        weight = whitener(vector, terms, measured, pressure_error)
        found = _search(vector, terms, measured, weight, (mean, error))
        vector, success = found.x, found.success
    weight = whitener(vector, terms, measured, pressure_error)
    residual = np.asarray(pulls(vector, terms, measured, weight)).ravel()
    jacobian = np.asarray(_slopes(vector, terms, measured, weight)).reshape(-1, 4)
    covariance = _covariance(np.vstack([jacobian, np.diag(1 / error)]))
    seen = int(np.sum(np.any(np.asarray(measured.root) != 0, axis=-1)))
    chi2, dof = float(residual @ residual), seen - 4
    scale = math.sqrt(max(1.0, chi2 / dof)) if dof > 0 else 1.0
    quantities = _quantities(vector, covariance, scale)
    status, message = _verdict(vector, covariance, scale, chi2, dof, success, decays)
    return ScaleFit(
        status, message, *quantities, chi2, dof, vector, covariance, scale, pressure_error,
        machine, terms, measured, tuple(d.fit.record for d in decays), mean, error,
    )  # fmt: skip


def _search(vector, terms, measured, weight, prior):
    mean, error = prior

    def residual(scales):
        data = np.asarray(pulls(scales, terms, measured, weight)).ravel()
        return np.concatenate([data, (scales - mean) / error])

    def slopes(scales):
        data = np.asarray(_slopes(scales, terms, measured, weight)).reshape(-1, 4)
        return np.vstack([data, np.diag(1 / error)])

    start = np.maximum(vector, 1e-3)
    return least_squares(
        residual, start, slopes, bounds=(0, 1e3), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )


def _covariance(jacobian: np.ndarray) -> np.ndarray:
    """Inverse information; infinite along what nothing determines."""
    _, sizes, directions = np.linalg.svd(jacobian, full_matrices=False)
    known = sizes > 1e-12 * max(sizes[0], 1e-300)
    spread = (directions[known].T / sizes[known]) @ (directions[known].T / sizes[known]).T
    blind = np.abs(directions[~known]).max(axis=0, initial=0.0) > 1e-6
    spread[np.ix_(blind, blind)] = np.inf
    return spread


def _separable(vector: np.ndarray, covariance: np.ndarray, scale: float) -> np.ndarray:
    error = scale * np.sqrt(np.diag(covariance))
    # Against 1 where the value is smaller: a mechanism found absent, 0.0 ± 0.1, is separable.
    return error < SEPARABLE * np.maximum(vector, 1.0)


def _quantities(vector: np.ndarray, covariance: np.ndarray, scale: float) -> list[Quantity]:
    known = _separable(vector, covariance, scale)
    raw = np.sqrt(np.diag(covariance))
    return [
        Quantity(float(v), float(scale * e), "1", float(e)) if k else Quantity(float(v), None, "1")
        for v, e, k in zip(vector, raw, known, strict=True)
    ]


def _verdict(vector, covariance, scale, chi2, dof, success, decays):
    """Status and sentence, the gravest first."""
    if not success:
        return Status.not_converged, "The search for the scales did not end: look at the records."
    blind = [
        name
        for name, known in zip(SCALES, _separable(vector, covariance, scale), strict=True)
        if not known
    ]
    if blind:
        cures = {
            "touschek": "the RF voltage or the number of bunches",
            "bremsstrahlung": "the scraper at constant pressure",
            "elastic": "the scraper at constant pressure",
            "desorption": "the current at constant settings",
        }
        advice = ", ".join(dict.fromkeys(cures[name] for name in blind))
        missed = dof > 0 and chi2_probability(chi2, dof) < POOR_FIT
        more = (
            f" First principles miss something besides: chi²/dof is {chi2 / dof:.3g}."
            if missed
            else ""
        )
        return Status.unidentified, (
            f"{' and '.join(blind)} not separable by {len(decays)} decays: vary {advice}, or give "
            f"a prior.{more}"
        )
    if dof > 0 and chi2_probability(chi2, dof) < POOR_FIT:
        return Status.poor_fit, (
            f"chi²/dof is {chi2 / dof:.3g}, improbable for first principles with these scales; "
            "the errors are enlarged to match: look for an anomaly, or correct by a network."
        )
    return Status.converged, "Every mechanism is separable."
