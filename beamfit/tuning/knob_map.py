"""The beam as a smooth map of the knobs, and the sizes that it predicts.

One-point functions of JAX arrays. Knobs are in half ranges, from -1 to 1 between their limits.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import prepare_jax

prepare_jax()

# Numbers of a beam: ln of the emittance, ln of beta, alpha, in coordinates even to the scan.
NUMBERS = 3
# How sharply the emittance's square turns away from zero, where its map would lead below.
SHARP = 3.0
# Highest total degree of the features by the number of knobs: beyond it their prior variance is
# below 1 % for lengths of a half range (of 0.7 for four knobs and more), and they are few.
DEGREE = {1: 10, 2: 8, 3: 6, 4: 5, 5: 4, 6: 4}
# Standard deviation of a number's mean over the knobs: any eccentricity of the ellipse.
MEAN = 3.0


class KnobScales(NamedTuple):
    """Scales of a map: length of each knob in half ranges, amplitude of each number, noise.

    ``length`` has shape (knobs,), ``amplitude`` (3,), ``noise`` (); all are positive.
    """

    length: Array
    amplitude: Array
    noise: Array


def orders_of(knobs: int) -> np.ndarray:
    """Powers of the knobs in each feature, up to the total degree, shape (features, knobs).

    Examples
    --------
    >>> len(orders_of(2)), orders_of(2)[:3].tolist()
    (45, [[0, 0], [0, 1], [1, 0]])
    """
    top = DEGREE.get(knobs, 3)
    every = [n for n in product(range(top + 1), repeat=knobs) if sum(n) <= top]
    return np.array(sorted(every, key=lambda n: (sum(n), n)))


def features(x: Array, length: Array, orders: np.ndarray) -> Array:
    """Features of a knob setting, shape (features,): their products make the Gaussian kernel.

    Parameters
    ----------
    x, length : Array
        Shape (knobs,), in half ranges.
    orders : ndarray
        As `orders_of`.

    Notes
    -----
    exp(-|x - x'|²/2) = Σ_n Π_k φ_n(x_k) φ_n(x'_k), φ_n(x) = exp(-x²/2) xⁿ/√n!: A. Cotter,
    J. Keshet and N. Srebro, Explicit approximations of the Gaussian kernel, arXiv:1109.4603
    (2011).

    Examples
    --------
    >>> a, b, one = jnp.array([0.3, -0.5]), jnp.array([0.6, 0.1]), jnp.ones(2)
    >>> orders = orders_of(2)
    >>> kernel = features(a, one, orders) @ features(b, one, orders)
    >>> round(float(kernel), 6), round(math.exp(-0.5 * (0.3**2 + 0.6**2)), 6)
    (0.798516, 0.798516)
    """
    z = x / length
    top = int(orders.max())
    root = np.array([math.sqrt(math.factorial(n)) for n in range(top + 1)])
    # Products, since the derivative of 0**n is not finite.
    powers = jnp.cumprod(jnp.concatenate([jnp.ones((1, len(z))), jnp.tile(z, (top, 1))]), axis=0)
    each = powers / root[:, None] * jnp.exp(-0.5 * z**2)
    return jnp.prod(each[orders, np.arange(orders.shape[1])], axis=1)


def design(x: Array, scales: KnobScales, orders: np.ndarray) -> Array:
    """Derivatives of the numbers of the map by its coefficients, shape (4, n).

    The numbers are those of `beam_of`: the level of ln ε, which no knob changes, the change of ε²,
    ln β and α. Coefficients are of one prior standard deviation: a mean, then features.
    """
    row = jnp.append(MEAN, jnp.ones(len(orders)))
    phi = jnp.append(1.0, features(x, scales.length, orders)) * row
    grown = jnp.concatenate(
        [jnp.ones((NUMBERS, 1)), jnp.repeat(scales.amplitude[:, None], len(orders), axis=1)], axis=1
    )
    rows = jnp.einsum("ij,ik->ijk", jnp.eye(NUMBERS), grown * phi).reshape(NUMBERS, -1)
    level = jnp.arange(rows.shape[1]) == 0
    return jnp.concatenate([jnp.where(level, rows[:1], 0.0), jnp.where(level, 0.0, rows[:1]),
                            rows[1:]])  # fmt: skip


def log_emittance(level: Array, change: Array) -> Array:
    """Logarithm of an emittance whose square is exp(2 level) (1 + change), kept above zero.

    What makes an emittance grow adds in squares: D. H. Dowell, Sources of emittance in RF
    photocathode injectors, arXiv:1610.01242 (2016). So its square is the smooth map.

    Examples
    --------
    >>> float(log_emittance(0.0, 0.0))
    0.0
    """
    square = jnp.logaddexp(SHARP * (1.0 + change), 0.0) / jnp.logaddexp(SHARP, 0.0)
    return level + 0.5 * jnp.log(square)


def beam_of(numbers: Array) -> Array:
    """ln ε, ln β and α of the numbers of the map: level, change of ε², ln β, α."""
    return jnp.append(log_emittance(numbers[0], numbers[1]), numbers[2:])


def log_size(numbers: Array, w: Array, known: Array) -> Array:
    """Logarithm of the size of a beam, in the unit of its coordinates.

    Parameters
    ----------
    numbers : Array
        Shape (3,): ln ε, ln β, α.
    w : Array
        Shape (3,): R11 and R12 in the coordinates, and 0; of an emittance, whose root stands for a
        size, 0, 0 and 1.
    known : Array
        Size² that is not due to the beam.

    Notes
    -----
    size² = ε (w1² β - 2 w1 w2 α + w2² (1 + α²)/β) + known: report eq. 37 in Twiss parameters.

    Examples
    --------
    >>> float(log_size(jnp.zeros(3), jnp.array([3.0, 4.0, 0.0]), jnp.array(0.0)) - jnp.log(5.0))
    0.0
    """
    emittance, beta, alpha = jnp.exp(numbers[0]), jnp.exp(numbers[1]), numbers[2]
    along = beta * (w[0] - w[1] * alpha / beta) ** 2 + w[1] ** 2 / beta + w[2]
    return 0.5 * jnp.log(emittance * along + known)
