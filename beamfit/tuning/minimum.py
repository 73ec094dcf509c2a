"""The lowest emittance of each draw of a map, and the row that tells most of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.stats.qmc import Sobol

from beamfit.emittance.advice import MIN_SIZE_ERROR, candidate_settings, elements_at
from beamfit.emittance.statement import PreparedScan
from beamfit.errors import InputError
from beamfit.tuning.knob_map import (
    MEAN,
    KnobScales,
    MapPosterior,
    features,
    log_emittance,
    log_size,
    numbers_at,
    orders_of,
)
from beamfit.tuning.knobs import Knobs
from beamfit.tuning.readings import PlaneReadings

# Settings among which the search begins, as a power of two, its steps, and its dampings.
BEGIN, STEPS = 9, 8
DAMPED = np.array([0.0, 0.03, 0.3, 3.0, 30.0, 300.0])
# Knob settings that are considered, as a power of two, and minima of draws that are besides.
POWER, PLACES = 7, 48
# Draws on a correlation of which rests what a row would tell; less is noise.
CHANCE = 2.0


class Emittances(NamedTuple):
    """Draws of ln of an emittance as a map of the knobs, the mean of one plane or two.

    Attributes
    ----------
    scales : tuple of KnobScales
        One a plane, arrays (d, ...).
    coefficients : tuple of Array
        Shape (d, 1 + features) each: of ln of the emittance alone.
    """

    scales: tuple[KnobScales, ...]
    coefficients: tuple[Array, ...]


def emittances_of(planes: Sequence[MapPosterior]) -> Emittances:
    """Draws of ln of the geometric mean of some planes' emittances, in their coordinates."""
    one = [p.coefficients.reshape(len(p.coefficients), 3, -1)[:, 0] for p in planes]
    return Emittances(tuple(p.scales for p in planes), tuple(one))


def _of_draw(x: Array, draw: Emittances, orders: np.ndarray) -> Array:
    """Value of a single draw at a setting."""
    each = [
        log_emittance(MEAN * c[0], s.amplitude[0] * (features(x, s.length, orders) @ c[1:]))
        for s, c in zip(draw.scales, draw.coefficients, strict=True)
    ]
    return sum(each, jnp.zeros(())) / len(each)


@jax.jit
def values_at(draws: Emittances, x: Array) -> Array:
    """Values of every draw at settings, shape (m, knobs) to (d, m)."""
    orders = orders_of(x.shape[-1])
    at = jax.vmap(_of_draw, (0, None, None))
    return jax.vmap(lambda draw: at(x, draw, orders))(draws)


def _lowered(x: Array, value: object) -> Array:
    """The lowest point near one, within the box: Newton's steps on the knobs that are free."""

    def step(x: Array, _: None) -> tuple[Array, None]:
        slope, bend = jax.grad(value)(x), jax.hessian(value)(x)
        held = ((x >= 1.0) & (slope < 0.0)) | ((x <= -1.0) & (slope > 0.0))
        free = jnp.where(held, 0.0, 1.0)
        bend = bend * jnp.outer(free, free) + jnp.diag(1.0 - free)
        size = jnp.maximum(jnp.abs(jnp.diag(bend)).max(), 1e-30)  # of a level map 0
        values, vectors = jnp.linalg.eigh(bend)
        along = vectors.T @ (slope * free)
        curved = jnp.abs(values) + (DAMPED[:, None] + 1e-9) * size
        tried = jnp.clip(x - (along / curved) @ vectors.T, -1.0, 1.0)
        tried = jnp.concatenate([x[None], tried])
        return tried[jnp.argmin(jax.vmap(value)(tried))], None

    return jax.lax.scan(step, x, length=STEPS)[0]


class Minima(NamedTuple):
    """Lowest value and its place in every draw, shape (d,) and (d, knobs); those of the mean."""

    value: Array
    place: Array
    best: Array


@partial(jax.jit, static_argnames="knobs")
def minima_of(draws: Emittances, knobs: int) -> Minima:
    """Search the lowest value of every draw between the limits, and of the mean of all.

    A draw that no knob changes has its minimum at a setting drawn at random.

    Parameters
    ----------
    draws : Emittances
        The draws.
    knobs : int
        How many knobs.

    Returns
    -------
    Minima
        Places in half ranges.
    """
    orders, begin = orders_of(knobs), jnp.asarray(settings_within(knobs))
    every = values_at(draws, begin)

    def mean(x: Array) -> Array:
        return jnp.mean(jax.vmap(lambda draw: _of_draw(x, draw, orders))(draws))

    def lowest(draw: Emittances, first: Array, anywhere: Array) -> tuple[Array, Array]:
        still = sum(s.amplitude[0] for s in draw.scales) == 0.0
        x = jnp.where(still, anywhere, _lowered(first, lambda x: _of_draw(x, draw, orders)))
        return _of_draw(x, draw, orders), x

    anywhere = jax.random.uniform(jax.random.key(0), (len(every), knobs), minval=-1.0)
    value, place = jax.vmap(lowest)(draws, begin[jnp.argmin(every, axis=1)], anywhere)
    return Minima(value, place, _lowered(begin[jnp.argmin(every.mean(0))], mean))


def settings_within(knobs: int, power: int = BEGIN) -> np.ndarray:
    """Settings that fill the box evenly, shape (2^power, knobs), and its middle first.

    Examples
    --------
    >>> settings_within(2, 3).shape
    (8, 2)
    """
    found = 2.0 * Sobol(knobs, rng=1).random_base2(power) - 1.0
    found[0] = 0.0
    return found


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

    seen: PreparedScan | None
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
        error = max(fit.maps[plane].noise, MIN_SIZE_ERROR)
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
