"""The beam as a smooth map of the knobs, the sizes it predicts, and the posterior of the map.

Knobs are in half ranges, from -1 to 1 between their limits. The map is functions of one point; its
posterior is by Laplace's method, the scales averaged over.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import prepare_jax
from beamfit.noise.model import LN_2PI

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
# Priors of ln of the scales, middle and standard deviation. Lengths of 0.6 to 2.7 half ranges: a
# range is chosen so that the beam bends once or twice; longer ones would have a weak knob's
# emittance straight, and its minimum at a limit. What a knob adds to the square of the emittance is
# as large as what is there without, a factor of three to either side; beta and alpha change by a
# third to a factor of five.
LENGTH, EMITTANCE, TWISS = (0.2, 0.4), (0.0, 1.0), (-0.4, 0.9)
# Rounds of scales and map; steps of the map and of the scales in each; steps tried.
ROUNDS, STEPS, NEWTON = 6, 6, 2
TRIED = np.array([1.0, 0.5, 0.2, 0.05, 0.0])
# Weights of all readings that a search begins with: bad ones that stand together hide each other
# from a map that begins with all of them.
GOOD = np.array([1.0, 0.1])
# Draws of the scales, and the farthest step of them in standard deviations of the prior.
SETS, FAR = 64, 1.5


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


class KnobReadings(NamedTuple):
    """Sizes of one plane at knob settings, padded; arrays begin with the n rows.

    Attributes
    ----------
    x : Array
        Shape (n, knobs), in half ranges.
    w, known : Array
        Shape (n, 3) and (n,): as for `log_size`.
    y : Array
        ln of the size.
    floor, unit : Array
        Relative standard deviation in any case, and what the scale of the noise multiplies.
    there : Array
        1 of a row, 0 of padding.
    noise : Array
        Shape (2,): prior mean and deviation of ln of the noise's scale.
    odds, wide : Array
        Prior odds of a bad reading, and how much wider it scatters.
    """

    x: Array
    w: Array
    known: Array
    y: Array
    floor: Array
    unit: Array
    there: Array
    noise: Array
    odds: Array
    wide: Array


class MapPosterior(NamedTuple):
    """Draws of a plane's map, with the logarithm of its evidence.

    Attributes
    ----------
    scales : KnobScales
        Of each draw, arrays (d, ...).
    coefficients : Array
        Shape (d, n): in prior standard deviations, as `design` multiplies them.
    log_evidence : Array
        Of the sizes, all scales averaged over.
    bad, model : Array
        Shape (rows,): share of its weight that a reading lost, near the probability that it is
        bad; fitted ln size.
    error : Array
        Shape (rows,): relative error of the sizes that was found.
    """

    scales: KnobScales
    coefficients: Array
    log_evidence: Array
    bad: Array
    model: Array
    error: Array


def prior_of(data: KnobReadings) -> tuple[Array, Array]:
    """Prior means and deviations of ln of all scales: lengths, amplitudes, noise."""
    own = [LENGTH] * data.x.shape[1] + [EMITTANCE] + [TWISS] * (NUMBERS - 1)
    mean, spread = jnp.array(own).T
    return jnp.append(mean, data.noise[0]), jnp.append(spread, data.noise[1])


def scales_of(eta: Array, varies: Array) -> KnobScales:
    """Scales from their logarithms; ``varies`` is 1, or 0 for an emittance that is constant."""
    each = jnp.exp(eta)
    return KnobScales(each[:-4], each[-4:-1].at[0].multiply(varies), each[-1])


class _Peak(NamedTuple):
    """Coefficients of the map, ln of its scales, and how good each reading is, from 0 to 1."""

    v: Array
    eta: Array
    good: Array


def _variance(data: KnobReadings, noise: Array, good: Array) -> Array:
    """Variance of ln of the sizes; of padding 1."""
    own = data.floor**2 + (noise * data.unit) ** 2
    return jnp.where(data.there > 0, own / good, 1.0)


def _numbers_at(data: KnobReadings, scales: KnobScales, orders: np.ndarray) -> Array:
    """Derivatives of every row's numbers by the coefficients, shape (n, 3, coefficients)."""
    return jax.vmap(lambda x: design(x, scales, orders))(data.x)


def _log_size(numbers: Array, w: Array, known: Array) -> Array:
    return log_size(beam_of(numbers), w, known)


def _slopes(data: KnobReadings, u: Array) -> tuple[Array, Array]:
    """Predicted ln sizes and their derivatives by the rows' numbers."""
    both = jax.vmap(jax.value_and_grad(_log_size))(u, data.w, data.known)
    return both[0], both[1] * data.there[:, None]


def _settled(data: KnobReadings, state: _Peak, varies: Array, orders: np.ndarray) -> Array:
    """Coefficients that fit best at given scales: Gauss-Newton with the best of a few steps."""
    scales = scales_of(state.eta, varies)
    every = _numbers_at(data, scales, orders)
    variance = _variance(data, scales.noise, state.good)

    def cost(v: Array) -> Array:
        off = data.y - jax.vmap(_log_size)(every @ v, data.w, data.known)
        return jnp.sum(v**2) + jnp.sum(data.there * off**2 / variance)

    def step(v: Array, _: None) -> tuple[Array, None]:
        model, slope = _slopes(data, every @ v)
        a = jnp.einsum("ij,ijk->ik", slope, every)
        off = data.there * (data.y - model) + a @ v
        root = jax.scipy.linalg.cho_factor(a @ a.T + jnp.diag(variance))
        whole = a.T @ jax.scipy.linalg.cho_solve(root, off)
        tried = v + TRIED[:, None] * (whole - v)
        return tried[jnp.nanargmin(jax.vmap(cost)(tried))], None

    return jax.lax.scan(step, state.v, length=STEPS)[0]


class _Linear(NamedTuple):
    """Readings that are linear about the numbers of the rows: how good each is, and a constant."""

    data: KnobReadings
    off: Array
    slope: Array
    good: Array
    varies: Array


def _linear(data: KnobReadings, u: Array, good: Array, varies: Array) -> _Linear:
    """The readings, linear about the numbers ``u`` of the rows, shape (n, 3)."""
    model, slope = _slopes(data, u)
    off = data.there * (data.y - model) + jnp.sum(slope * u, axis=1)
    return _Linear(data, off, slope, good, varies)


def _covariance(eta: Array, by: _Linear, orders: np.ndarray) -> Array:
    """Covariance of the readings under scales, shape (n, n)."""
    scales = scales_of(eta, by.varies)
    a = jnp.einsum("ij,ijk->ik", by.slope, _numbers_at(by.data, scales, orders))
    return a @ a.T + jnp.diag(_variance(by.data, scales.noise, by.good))


def _inverse(covariance: Array) -> Array:
    factor = jax.scipy.linalg.cho_factor(covariance)
    return jax.scipy.linalg.cho_solve(factor, jnp.eye(len(covariance)))


def _log_evidence(eta: Array, by: _Linear, orders: np.ndarray) -> Array:
    """Log evidence of the scales times their prior.

    C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. 2.30.
    """
    root = jnp.linalg.cholesky(_covariance(eta, by, orders))
    z = jax.scipy.linalg.solve_triangular(root, by.off, lower=True)
    mean, spread = prior_of(by.data)
    own = -0.5 * jnp.sum(((eta - mean) / spread) ** 2 + 2.0 * jnp.log(spread) + LN_2PI)
    count = jnp.sum(by.data.there)
    return own - 0.5 * jnp.sum(z**2) - jnp.sum(jnp.log(jnp.diag(root))) - 0.5 * count * LN_2PI


def _scoring(eta: Array, by: _Linear, orders: np.ndarray) -> tuple[Array, Array]:
    """Slope of the log evidence, and its expected curvature with the prior's, both by ln scales.

    Rasmussen and Williams, eq. 5.9; Fisher's information of a normal distribution, ½ tr(S⁻¹ S_i
    S⁻¹ S_j), of S. M. Kay, Fundamentals of Statistical Signal Processing (1993), eq. 3.31.
    """
    covariance = _covariance(eta, by, orders)
    changes = jnp.moveaxis(jax.jacfwd(_covariance)(eta, by, orders), -1, 0)
    inverse = _inverse(covariance)
    each, z = inverse @ changes, inverse @ by.off
    mean, spread = prior_of(by.data)
    slope = 0.5 * (jnp.einsum("i,kij,j->k", z, changes, z) - jnp.trace(each, axis1=1, axis2=2))
    fisher = 0.5 * jnp.einsum("aij,bji->ab", each, each)
    return slope - (eta - mean) / spread**2, fisher + jnp.diag(spread**-2)


def _judged(eta: Array, by: _Linear, orders: np.ndarray) -> tuple[Array, Array]:
    """Weight of each reading by what the others predict of it, and what that adds to the evidence.

    A reading is good, or bad as those of scans: `beamfit.noise.sizes.log_likelihood`. A map bends
    to any reading that it has; so it is judged by the map that it has no part in (Rasmussen and
    Williams, eq. 5.12), as expectation propagation does (sect. 3.6).
    """
    data, covariance = by.data, _covariance(eta, by, orders)
    inverse = _inverse(covariance)
    alone = 1.0 / jnp.diag(inverse)
    square = (alone * (inverse @ by.off)) ** 2
    own = _variance(data, jnp.exp(eta[-1]), 1.0)
    known = jnp.maximum(alone - own / by.good, 0.0)

    def log_normal(variance: Array) -> Array:
        return -0.5 * (square / variance + jnp.log(variance))

    wide = known + data.wide**2 * own
    bad = jnp.log(data.odds) + 0.5 * jnp.log(2.0 / jnp.pi / wide) - jnp.log1p(square / wide)
    either = jnp.logaddexp(log_normal(known + own), bad)
    doubt = jnp.exp(bad - either)
    good = 1.0 - doubt + doubt * 2.0 * own / (wide + square)
    beside = either - jnp.log1p(data.odds) - log_normal(known + own / good)
    there = data.there > 0
    return jnp.where(there, good, 1.0), jnp.sum(jnp.where(there, beside, 0.0))


def _fitted(
    data: KnobReadings, start: Array, good: Array, varies: Array, orders: np.ndarray
) -> tuple[_Peak, _Linear, Array, Array]:
    """The best map and scales, readings about it, log evidence, root of the scales' covariance."""
    mean, spread = prior_of(data)

    def newton(eta: Array, by: _Linear) -> Array:
        slope, curvature = _scoring(eta, by, orders)
        step = jnp.linalg.solve(curvature, slope)
        step = step * jnp.minimum(1.0, FAR / jnp.linalg.norm(step / spread))
        tried = eta + TRIED[:, None] * step
        found = jax.vmap(lambda each: _log_evidence(each, by, orders))(tried)
        return tried[jnp.argmax(jnp.nan_to_num(found, nan=-jnp.inf))]

    def settled(state: _Peak) -> tuple[_Peak, _Linear, Array]:
        v = _settled(data, state, varies, orders)
        u = _numbers_at(data, scales_of(state.eta, varies), orders) @ v
        by = _linear(data, u, state.good, varies)
        good, beside = _judged(state.eta, by, orders)
        return _Peak(v, state.eta, good), by._replace(good=good), beside

    def round_of(state: _Peak, _: None) -> tuple[_Peak, None]:
        state, by, _ = settled(state)
        eta = jax.lax.fori_loop(0, NEWTON, lambda _, e: newton(e, by), state.eta)
        return state._replace(eta=eta), None

    state = _Peak(start, mean, jnp.full(len(data.y), good))
    state, by, beside = settled(jax.lax.scan(round_of, state, length=ROUNDS)[0])
    root = jnp.linalg.cholesky(jnp.linalg.inv(_scoring(state.eta, by, orders)[1]))
    whole = _log_evidence(state.eta, by, orders) + beside + 0.5 * len(mean) * LN_2PI
    return state, by, whole + jnp.sum(jnp.log(jnp.diag(root))), root


def _draw(key: Array, data: KnobReadings, state: _Peak, varies: Array, orders: np.ndarray) -> Array:
    """A draw of the map at given scales: a prior draw, corrected by the readings.

    J. T. Wilson et al., Pathwise conditioning of Gaussian processes, J. Mach. Learn. Res. 22 (2021)
    105, with the sizes linear about the best map.
    """
    scales = scales_of(state.eta, varies)
    every = _numbers_at(data, scales, orders)
    a = jnp.einsum("ij,ijk->ik", _slopes(data, every @ state.v)[1], every)
    variance = _variance(data, scales.noise, state.good)
    of_map, of_noise = jax.random.split(key)
    free = jax.random.normal(of_map, state.v.shape)
    noise = jnp.sqrt(variance) * jax.random.normal(of_noise, variance.shape)
    root = jax.scipy.linalg.cho_factor(a @ a.T + jnp.diag(variance))
    return state.v + free - a.T @ jax.scipy.linalg.cho_solve(root, a @ free + noise)


@partial(jax.jit, static_argnames=("knobs", "draws"))
def map_posterior(
    data: KnobReadings, start: Array, seed: Array, knobs: int, draws: int
) -> MapPosterior:
    """Draw maps of a plane's beam from their posterior, with an emittance that varies or not.

    Parameters
    ----------
    data : KnobReadings
        The sizes.
    start : Array
        Shape (3,): numbers of a beam to begin with, the same at all knobs.
    seed : Array
        Of the random numbers.
    knobs, draws : int
        How many.

    Returns
    -------
    MapPosterior
        Every array with a first axis of two: an emittance that varies with the knobs, and one that
        none of them changes.

    Notes
    -----
    The map is a Gaussian process of each number of the beam, the sizes are linear about the best
    map (Laplace's method: Rasmussen and Williams, sect. 3.4). Its scales are drawn from the normal
    distribution about their best and weighed by the evidence, as D. J. C. MacKay, Information
    Theory, Inference, and Learning Algorithms (2003), sect. 29.2.
    """
    orders = orders_of(knobs)
    first = jnp.zeros((NUMBERS, 1 + len(orders))).at[:, 0].set(start / MEAN).ravel()
    of_sets, of_choice, of_draws = jax.random.split(jax.random.key(seed), 3)

    def drawn(varies: Array) -> MapPosterior:
        every = jax.lax.map(lambda good: _fitted(data, first, good, varies, orders), GOOD)
        best = jnp.nanargmax(every[2])
        state, by, log_evidence, root = jax.tree.map(lambda v: v[best], every)
        z = jax.random.normal(of_sets, (SETS, len(state.eta))).at[0].set(0.0)
        eta = state.eta + z @ root.T
        log = jax.vmap(lambda e: _log_evidence(e, by, orders))(eta)
        weight = jax.nn.softmax(jnp.nan_to_num(log, nan=-jnp.inf) + 0.5 * jnp.sum(z**2, axis=1))
        # Systematic resampling: every set as often as its weight says, up to one.
        at = (jax.random.uniform(of_choice) + jnp.arange(draws)) / draws
        chosen = jnp.minimum(jnp.searchsorted(jnp.cumsum(weight), at), SETS - 1)
        settled = jax.vmap(lambda e: _settled(data, state._replace(eta=e), varies, orders))(eta)
        coefficients = jax.vmap(
            lambda key, i: _draw(key, data, _Peak(settled[i], eta[i], state.good), varies, orders)
        )(jax.random.split(of_draws, draws), chosen)
        bad, error = 1.0 - state.good, jnp.sqrt(_variance(data, jnp.exp(state.eta[-1]), 1.0))
        u = _numbers_at(data, scales_of(state.eta, varies), orders) @ state.v
        scales = jax.vmap(lambda e: scales_of(e, varies))(eta[chosen])
        return MapPosterior(scales, coefficients, log_evidence, bad, _slopes(data, u)[0], error)

    return jax.lax.map(drawn, jnp.array([1.0, 0.0]))


def mixed(both: MapPosterior, still: np.ndarray) -> MapPosterior:
    """Take draws of the map that varies, and where ``still`` of the one that does not.

    Parameters
    ----------
    both : MapPosterior
        From `map_posterior`.
    still : ndarray of bool
        Shape (d,). Fitted sizes and errors are of the model that most draws have.
    """
    most = int(still.mean() > 0.5)

    def each(v: np.ndarray) -> np.ndarray:
        v = np.asarray(v)
        return np.where(still.reshape(-1, *[1] * (v.ndim - 2)), v[1], v[0])

    scales, coefficients = jax.tree.map(each, (both.scales, both.coefficients))
    rest = (np.asarray(v)[most] for v in both[2:])
    return MapPosterior(scales, coefficients, *rest)


@jax.jit
def numbers_at(posterior: MapPosterior, x: np.ndarray) -> Array:
    """ln ε, ln β, α of every draw at settings, shape (m, knobs) to (d, m, 3), in coordinates."""
    orders = orders_of(x.shape[-1])

    def one(scales: KnobScales, v: Array) -> Array:
        return jax.vmap(lambda at: beam_of(design(at, scales, orders) @ v))(jnp.asarray(x))

    return jax.vmap(one)(posterior.scales, posterior.coefficients)
