"""The lowest emittance of each draw of a map, and the most informative next row."""

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
    MEAN_SPREAD,
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

# Number of start settings of the search, as a power of two, number of Newton steps, and their
# dampings. Chosen.
SEARCH_POWER = 9
NEWTON_STEPS = 8
DAMPINGS = np.array([0.0, 0.03, 0.3, 3.0, 30.0, 300.0])
# Number of candidate knob settings, as a power of two, and of minima of draws added to them.
# Chosen.
KNOB_POWER = 7
MINIMUM_SETTINGS = 48
# Squared correlations below this number over the number of draws are noise.
CHANCE_CORRELATION = 2.0


class Emittances(NamedTuple):
    """Draws of ln of an emittance as a map of the knobs, the mean of one plane or two.

    Attributes
    ----------
    scales : tuple of KnobScales
        Scales of each plane, arrays (d, ...).
    coefficients : tuple of Array
        Coefficients of ln of the emittance, shape (d, 1 + features) each.
    """

    scales: tuple[KnobScales, ...]
    coefficients: tuple[Array, ...]


def emittances_of(planes: Sequence[MapPosterior]) -> Emittances:
    """Extract draws of ln of the geometric mean of the planes' emittances, in their coordinates."""
    one = [p.coefficients.reshape(len(p.coefficients), 3, -1)[:, 0] for p in planes]
    return Emittances(tuple(p.scales for p in planes), tuple(one))


def _draw_value(x: Array, draw: Emittances, orders: np.ndarray) -> Array:
    """Value of a single draw at a setting."""
    each = [
        log_emittance(MEAN_SPREAD * c[0], s.amplitude[0] * (features(x, s.length, orders) @ c[1:]))
        for s, c in zip(draw.scales, draw.coefficients, strict=True)
    ]
    return sum(each, jnp.zeros(())) / len(each)


@jax.jit
def values_at(draws: Emittances, x: Array) -> Array:
    """Values of every draw at settings, shape (m, knobs) to (d, m)."""
    orders = orders_of(x.shape[-1])
    at = jax.vmap(_draw_value, (0, None, None))
    return jax.vmap(lambda draw: at(x, draw, orders))(draws)


def _descend(x: Array, value: object) -> Array:
    """Find the lowest point near a start within the box by damped Newton steps."""

    def step(x: Array, _: None) -> tuple[Array, None]:
        slope, curvature = jax.grad(value)(x), jax.hessian(value)(x)
        at_limit = ((x >= 1.0) & (slope < 0.0)) | ((x <= -1.0) & (slope > 0.0))
        free = jnp.where(at_limit, 0.0, 1.0)
        curvature = curvature * jnp.outer(free, free) + jnp.diag(1.0 - free)
        size = jnp.maximum(jnp.abs(jnp.diag(curvature)).max(), 1e-30)  # 0 for a constant map
        values, vectors = jnp.linalg.eigh(curvature)
        components = vectors.T @ (slope * free)
        damped = jnp.abs(values) + (DAMPINGS[:, None] + 1e-9) * size
        trials = jnp.clip(x - (components / damped) @ vectors.T, -1.0, 1.0)
        trials = jnp.concatenate([x[None], trials])
        return trials[jnp.argmin(jax.vmap(value)(trials))], None

    return jax.lax.scan(step, x, length=NEWTON_STEPS)[0]


class Minima(NamedTuple):
    """Lowest value and place of every draw, shape (d,) and (d, knobs); place for the mean."""

    value: Array
    place: Array
    best: Array


@partial(jax.jit, static_argnames="knobs")
def minima_of(draws: Emittances, knobs: int) -> Minima:
    """Find the lowest value of every draw between the limits, and of the mean of all draws.

    A constant draw has its minimum at a random setting.

    Parameters
    ----------
    draws : Emittances
        The draws.
    knobs : int
        Number of knobs.

    Returns
    -------
    Minima
        Places in half ranges.
    """
    orders, starts = orders_of(knobs), jnp.asarray(settings_within(knobs))
    values = values_at(draws, starts)

    def mean(x: Array) -> Array:
        return jnp.mean(jax.vmap(lambda draw: _draw_value(x, draw, orders))(draws))

    def lowest(draw: Emittances, first: Array, anywhere: Array) -> tuple[Array, Array]:
        constant = sum(s.amplitude[0] for s in draw.scales) == 0.0
        x = jnp.where(constant, anywhere, _descend(first, lambda x: _draw_value(x, draw, orders)))
        return _draw_value(x, draw, orders), x

    anywhere = jax.random.uniform(jax.random.key(0), (len(values), knobs), minval=-1.0)
    value, place = jax.vmap(lowest)(draws, starts[jnp.argmin(values, axis=1)], anywhere)
    return Minima(value, place, _descend(starts[jnp.argmin(values.mean(0))], mean))


def settings_within(knobs: int, power: int = SEARCH_POWER) -> np.ndarray:
    """Settings that fill the box evenly, its middle first, shape (2^power, knobs).

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
        """Median of the fitted relative errors of the sizes."""
        present = np.asarray(self.readings.readings.present) > 0
        return float(np.median(np.asarray(self.posterior.error)[present]))


class Tuned(Protocol):
    """Parts of a `TuningFit` that the advice needs."""

    seen: PreparedScan | None
    knobs: Knobs
    maps: dict[str, PlaneMap]
    draws: Emittances
    minima: Minima


class NextRow(NamedTuple):
    """A row to measure next: settings of knobs and quadrupoles, and its information in nats."""

    settings: dict[str, float]
    information: float


def next_row(fit: Tuned, magnets: Mapping[str, tuple[float, float]] | None = None) -> NextRow:
    """Choose the row with the most information about the minimum.

    Parameters
    ----------
    fit : TuningFit
        Fit of the rows measured so far.
    magnets : mapping of str to (float, float), optional
        Quadrupoles and their limits; the scanned ranges if None.

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
        tables = candidate_settings(settings, magnets or _scanned_ranges(settings))
    x = np.concatenate(
        [settings_within(len(fit.knobs.names), KNOB_POWER), fit.minima.place[:MINIMUM_SETTINGS],
         fit.minima.best[None]]
    )  # fmt: skip
    goal = np.asarray(values_at(fit.draws, x[-MINIMUM_SETTINGS - 1 :]))
    best = None
    for table in tables.values():
        information = _row_information(fit, x, table, goal)
        i, j = np.unravel_index(np.argmax(information), information.shape)
        if best is None or information[i, j] > best.information:
            knobs = dict(zip(fit.knobs.names, map(float, fit.knobs.settings(x[i])), strict=True))
            row = knobs | {name: float(values[j]) for name, values in table.items()}
            best = NextRow(row, float(information[i, j]))
    return best


def _scanned_ranges(settings: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float]]:
    """Ranges of the magnets that were moved."""
    return {n: (float(v.min()), float(v.max())) for n, v in settings.items() if np.ptp(v) > 0}


def _row_information(
    fit: Tuned, x: np.ndarray, table: Mapping[str, np.ndarray], goal: np.ndarray
) -> np.ndarray:
    """Nats of sizes at knobs ``x`` and magnets about the goal, shape (settings, magnets)."""
    transport = _transport(fit, table)
    information = np.zeros((len(x), len(next(iter(transport.values()))[1])))
    on_screen = np.ones(information.shape, bool)
    for plane, (w, known) in transport.items():
        readings, posterior = fit.maps[plane]
        sizes = np.asarray(_log_sizes(posterior, x, w, known))
        present = np.asarray(readings.readings.present) > 0
        error = max(fit.maps[plane].noise, MIN_SIZE_ERROR)
        information += _information(sizes.reshape(len(sizes), -1), goal, error).reshape(
            information.shape
        )
        if fit.seen is not None:
            on_screen &= sizes.mean(0) <= np.asarray(readings.readings.y)[present].max()
    return np.where(on_screen, information, -1.0)


def _transport(
    fit: Tuned, table: Mapping[str, np.ndarray]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """R11, R12 and the known size² at settings of the magnets, as for `log_size`, by plane."""
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
    """Logarithm of the sizes of every draw, shape (d, settings, magnets)."""
    by_magnet = jax.vmap(log_size, (None, 0, 0))
    at = jax.vmap(jax.vmap(by_magnet, (0, None, None)), (0, None, None))
    return at(numbers_at(posterior, jnp.asarray(x)), jnp.asarray(w), jnp.asarray(known))


def _information(drawn: np.ndarray, goal: np.ndarray, error: float) -> np.ndarray:
    """Mean nats of readings with an error about normal goals: draws (d, m) and (d, k) to (m,).

    Chance correlations of the draws, 1/d on average in their square, are subtracted.

    Examples
    --------
    >>> same = np.array([[1.0], [-1.0]] * 50)
    >>> float(_information(same, same, 1.0)[0].round(2)), 0.5 * float(np.log(2).round(2))
    (0.34, 0.345)
    """
    deviation, goal_deviation = drawn - drawn.mean(0), goal - goal.mean(0)
    variance = (deviation**2).mean(0)
    cross = deviation.T @ goal_deviation / len(drawn)
    square = cross**2 / np.maximum(np.outer(variance, (goal_deviation**2).mean(0)), 1e-300)
    square = np.maximum(square - CHANCE_CORRELATION / len(drawn), 0.0)
    share = square * (variance / (variance + error**2))[:, None]
    return -0.5 * np.log1p(-np.minimum(share, 1.0 - 1e-12)).mean(1)
