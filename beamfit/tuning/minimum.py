"""The lowest emittance of every draw of a map, within the limits of the knobs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.stats.qmc import Sobol

from beamfit.tuning.knob_map import MEAN, KnobScales, features, log_emittance, orders_of
from beamfit.tuning.posterior import MapPosterior

# Settings among which the search begins, as a power of two, its steps, and its dampings.
BEGIN, STEPS = 9, 8
DAMPED = np.array([0.0, 0.03, 0.3, 3.0, 30.0, 300.0])


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
