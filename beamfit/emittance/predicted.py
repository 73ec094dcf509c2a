"""Predicted sizes of a fitted beam at other settings, and correlations of its numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import shown
from beamfit.emittance.comparison import QUANTILES, PlanePosterior, weighted_quantiles
from beamfit.emittance.model import (
    SIGMA,
    coefficients,
    emittance_parts,
    predict_sizes,
    size_squared,
)
from beamfit.emittance.results import PlaneFit
from beamfit.emittance.statement import Scanned
from beamfit.emittance.transport import Rows, pad_rows
from beamfit.errors import InputError, nearest
from beamfit.optics.beamline import reduced_line
from beamfit.sampling.posterior import Correlations

NAMES = (*SIGMA, "emittance", "beta", "alpha")


@shown
@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted sizes of a fitted beam.

    Attributes
    ----------
    plane, screen : str
        Plane of the size, and its screen.
    settings : dict of str to ndarray
        Settings of the magnets that were given, shape (n,), in the units of the scan.
    size : ndarray
        Rms size with dispersion and resolution, m, shape (n,).
    error : ndarray
        Standard error from the error of the beam alone, m, shape (n,); a further reading also
        scatters by its own error. NaN where the data do not determine the beam.
    """

    plane: str
    screen: str
    settings: dict[str, np.ndarray]
    size: np.ndarray
    error: np.ndarray


def predicted_sizes(
    fit: Scanned, settings: Mapping[str, Any], plane: str, screen: str | None = None
) -> Prediction:
    """Predict sizes; see `EmittanceFit.predict`.

    size² = R11² σ11 + 2 R11 R12 σ12 + R12² σ22 + known (report eq. 37) is linear in σ. Other fitted
    parameters of a scenario add their error in linear approximation.
    """
    fitted = {p.plane: p for p in fit.planes}
    if plane not in fitted:
        raise InputError(f"no fit of plane '{plane}'", " or ".join(fitted))
    p = fitted[plane]
    try:
        given = {name: np.atleast_1d(np.asarray(v, float)) for name, v in settings.items()}
        n = max((len(v) for v in given.values()), default=1)
        given = {name: np.array(np.broadcast_to(v, n)) for name, v in given.items()}
    except ValueError:
        expected = "a number for each magnet, or arrays of one length"
        raise InputError(f"settings {dict(settings)}", expected) from None
    rows = _rows(fit, given, n, plane, screen)
    model = {} if fit.statement.closed else fit.solved.model
    r11, r12, known = (np.asarray(part)[:n] for part in rows.elements(model))
    post = fit.seen.solutions[plane].posterior
    spread = _spread(post, r11, r12, known)
    if fit.statement.closed:
        sigma = np.array([q.value for q in p.sigma])
        size = np.sqrt(np.maximum(size_squared(sigma, r11, r12, known), 0.0))
        error = np.where(np.isfinite(p.covariance).all(), spread, np.nan)
    else:
        found = fit.solved.derive(predict_sizes, rows)
        size, total_error = 1e-6 * found.value[:n], 1e-6 * found.error[:n]
        slope = np.stack(coefficients(r11, r12), -1) / (2.0 * size[:, None])
        beam_variance = np.einsum("ij,jk,ik->i", slope, post.covariance, slope)
        # Other fitted parameters add to the posterior of the beam, in linear approximation.
        other_error = np.sqrt(np.maximum(total_error**2 - beam_variance, 0.0))
        error = np.where(np.isfinite(total_error), np.hypot(spread, other_error), total_error)
    return Prediction(plane, rows.places[0], given, size, error)


def _spread(
    post: PlanePosterior, r11: np.ndarray, r12: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Half of the central 68 % of predicted sizes over the posterior draws."""
    sizes = np.sqrt(size_squared(post.sigma.T, r11[:, None], r12[:, None], known[:, None]))
    ends = [weighted_quantiles(row, post.weight, (QUANTILES[1], QUANTILES[3])) for row in sizes]
    return 0.5 * np.diff(ends, axis=1)[:, 0]


def _rows(
    fit: Scanned, given: Mapping[str, np.ndarray], n: int, plane: str, screen: str | None
) -> Rows:
    """Rows of a scan at the given settings, padded."""
    prepared, line = fit.seen, fit.seen.scanned
    if prepared.scan.transfer or not fit.statement.whole_map or fit.told.hysteresis:
        found = "a fit that knows the transport at the measured rows alone"
        raise InputError(found, "a scan with a lattice, and a scenario that keeps its map")
    place = screen or prepared.rows.places[-1]
    for name in given:
        if name not in line.magnets:
            raise InputError(f"no magnet '{name}'", nearest(name, list(line.magnets)))
    if place not in (known := [e.name for e in line.elements]):
        raise InputError(f"no screen '{place}'", nearest(place, known))
    model = {} if fit.statement.closed else fit.solved.model
    variable = dict.fromkeys((*given, *model.get("magnets", {})))
    table = {
        name: pad_rows(given.get(name, np.full(n, float(line[name].setting)))) for name in variable
    }
    energy = pad_rows(np.full(n, prepared.energy))
    reduced = reduced_line(line, tuple(variable), energy, (place,))
    return prepared.rows_at(reduced, plane, place, table, energy)


def correlations_of(p: PlaneFit) -> Correlations:
    """Correlate the errors of σ11, σ12, σ22, emittance, β and α, in linear approximation.

    The last three follow from the gradients of ε = sqrt(σ11σ22 - σ12²), σ11/ε and -σ12/ε.
    """
    sigma = np.array([q.value for q in p.sigma])
    if not np.isfinite(p.covariance).all() or not p.emittance.value > 0:
        return Correlations(NAMES, np.full((6, 6), np.nan))
    slope = np.concatenate(
        [np.eye(3), np.asarray(jax.jacobian(emittance_parts)(jnp.asarray(sigma)))]
    )
    covariance = slope @ p.covariance @ slope.T
    error = np.sqrt(np.diagonal(covariance))
    return Correlations(NAMES, covariance / np.outer(error, error))
