"""The next row of a tuning table: the setting of knobs and quadrupole that tells most."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.emittance.advice import SHARPEST, candidate_settings, elements_at
from beamfit.emittance.statement import Seen
from beamfit.errors import InputError
from beamfit.tuning.knob_map import log_size
from beamfit.tuning.knobs import Knobs
from beamfit.tuning.minimum import Emittances, Minima, settings_within, values_at
from beamfit.tuning.posterior import MapPosterior, numbers_at
from beamfit.tuning.readings import PlaneReadings

# Knob settings that are considered, as a power of two, and minima of draws that are besides.
POWER, PLACES = 7, 48
# Draws on a correlation of which rests what a row would tell; less is noise.
CHANCE = 2.0


class PlaneMap(NamedTuple):
    """A plane's readings and the posterior of its map."""

    readings: PlaneReadings
    posterior: MapPosterior

    @property
    def noise(self) -> float:
        """Median relative error of the sizes that was found."""
        there = np.asarray(self.readings.readings.there) > 0
        return float(np.median(np.asarray(self.posterior.error)[there]))


class Tuned(Protocol):
    """Parts of a `TuningFit` that advice rests on."""

    seen: Seen | None
    knobs: Knobs
    maps: dict[str, PlaneMap]
    draws: Emittances
    minima: Minima


class NextRow(NamedTuple):
    """A row to measure next: knobs and quadrupoles, and the nats it tells of the minimum."""

    settings: dict[str, float]
    information: float


def next_row(fit: Tuned, magnets: Mapping[str, tuple[float, float]] | None = None) -> NextRow:
    """Choose the single row that tells most about the minimum.

    Parameters
    ----------
    fit : TuningFit
        What is measured already.
    magnets : mapping of str to (float, float), optional
        Quadrupoles and their limits; what was scanned if None.

    Returns
    -------
    NextRow

    Notes
    -----
    The information of a size about the emittance where some draw has its minimum, on average over
    draws: W. Neiswanger, K. A. Wang and S. Ermon, Bayesian algorithm execution, Proc. 38th ICML
    (2021), with the covariances of draws through the known line: -½ ln(1 - ρ² v/(v + e²)) of
    a correlation ρ, a variance v of ln of the size over draws and its error e.

    Examples
    --------
    >>> NextRow({"SOL": 200.0, "Q": 3.0}, 0.5).settings["SOL"]
    200.0
    """
    tables: dict[str, dict[str, np.ndarray]] = {"": {}}  # an emittance needs no quadrupole
    if fit.seen is not None:
        settings = fit.seen.scan.settings
        if not settings:
            raise InputError("rows without a quadrupole", "settings of one, to choose the next of")
        tables = candidate_settings(settings, magnets or _scanned(settings))
    x = np.concatenate(
        [settings_within(len(fit.knobs.names), POWER), fit.minima.place[:PLACES],
         fit.minima.best[None]]
    )  # fmt: skip
    goal = np.asarray(values_at(fit.draws, x[-PLACES - 1 :]))
    best = None
    for table in tables.values():
        told = _told(fit, x, table, goal)
        i, j = np.unravel_index(np.argmax(told), told.shape)
        if best is None or told[i, j] > best.information:
            knobs = dict(zip(fit.knobs.names, map(float, fit.knobs.settings(x[i])), strict=True))
            row = knobs | {name: float(values[j]) for name, values in table.items()}
            best = NextRow(row, float(told[i, j]))
    return best


def _scanned(settings: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float]]:
    """Ranges of the magnets that were moved."""
    return {n: (float(v.min()), float(v.max())) for n, v in settings.items() if np.ptp(v) > 0}


def _told(
    fit: Tuned, x: np.ndarray, table: Mapping[str, np.ndarray], goal: np.ndarray
) -> np.ndarray:
    """Nats that sizes at knobs ``x`` and magnets tell of the goal, shape (settings, magnets)."""
    through = _through(fit, table)
    told = np.zeros((len(x), len(next(iter(through.values()))[1])))
    on_screen = np.ones(told.shape, bool)
    for plane, (w, known) in through.items():
        readings, posterior = fit.maps[plane]
        drawn = np.asarray(_log_sizes(posterior, x, w, known))
        there = np.asarray(readings.readings.there) > 0
        error = max(fit.maps[plane].noise, SHARPEST)
        told += _information(drawn.reshape(len(drawn), -1), goal, error).reshape(told.shape)
        if fit.seen is not None:
            on_screen &= drawn.mean(0) <= np.asarray(readings.readings.y)[there].max()
    return np.where(on_screen, told, -1.0)


def _through(
    fit: Tuned, table: Mapping[str, np.ndarray]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """R11, R12 and what is known at settings of the magnets, as for `log_size`, by plane."""
    seen = fit.seen
    if seen is None:
        return dict.fromkeys(fit.maps, (np.array([[0.0, 0.0, 1.0]]), np.zeros(1)))
    energy = np.full(len(next(iter(table.values()))), seen.energy)
    every = elements_at(seen, seen.scanned, table, seen.rows.places[-1], energy)
    found = {}
    for plane, (readings, _) in fit.maps.items():
        c, (r11, r12, known) = readings.coordinates, every["xy".index(plane)]
        w = np.stack([r11, r12], -1) @ c.back
        found[plane] = np.column_stack([w, np.zeros(len(w))]), known / c.unit**2
    return found


@jax.jit
def _log_sizes(posterior: MapPosterior, x: np.ndarray, w: np.ndarray, known: np.ndarray):
    """ln of the sizes of every draw, shape (d, settings, magnets)."""
    by_magnet = jax.vmap(log_size, (None, 0, 0))
    at = jax.vmap(jax.vmap(by_magnet, (0, None, None)), (0, None, None))
    return at(numbers_at(posterior, jnp.asarray(x)), jnp.asarray(w), jnp.asarray(known))


def _information(drawn: np.ndarray, goal: np.ndarray, error: float) -> np.ndarray:
    """Mean nats of readings of an error about normal goals: draws (d, m) and (d, k) to (m,).

    Correlations that draws have by chance, 1/d on average in their square, count for nothing.

    Examples
    --------
    >>> same = np.array([[1.0], [-1.0]] * 50)
    >>> float(_information(same, same, 1.0)[0].round(2)), 0.5 * float(np.log(2).round(2))
    (0.34, 0.345)
    """
    off, far = drawn - drawn.mean(0), goal - goal.mean(0)
    variance = (off**2).mean(0)
    cross = off.T @ far / len(drawn)
    square = cross**2 / np.maximum(np.outer(variance, (far**2).mean(0)), 1e-300)
    square = np.maximum(square - CHANCE / len(drawn), 0.0)
    share = square * (variance / (variance + error**2))[:, None]
    return -0.5 * np.log1p(-np.minimum(share, 1.0 - 1e-12)).mean(1)
