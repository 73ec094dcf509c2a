"""The beam as a smooth map of the knobs, the sizes it predicts, and the posterior of the map.

Knobs are in half ranges, from -1 to 1 between their limits. The map is a set of functions of one
setting. Its posterior is by Laplace's method, averaged over the scales.
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

# Numbers of a beam: ln of the emittance, ln of beta, and alpha, in the coordinates of the scan.
NUMBERS = 3
# Sharpness of the bend that keeps the squared emittance positive where its map would be negative:
# chosen.
SHARPNESS = 3.0
# Highest total degree of the features by number of knobs. Higher degrees have less than 1 % of the
# prior variance for lengths of a half range (0.7 for four knobs and more).
MAX_DEGREE = {1: 10, 2: 8, 3: 6, 4: 5, 5: 4, 6: 4}
# Prior standard deviation of a number's mean over the knobs: wide enough for any ellipse.
MEAN_SPREAD = 3.0
# Priors of ln of the scales, mean and standard deviation. Lengths are 0.6 to 2.7 half ranges: a
# range is chosen so that the beam changes its trend once or twice, and longer lengths would make
# the emittance of a weak knob straight, with its minimum at a limit. The share of a knob in the
# squared emittance is as large as the rest, within a factor of three. Beta and alpha change by a
# third to a factor of five.
LENGTH_PRIOR = (0.2, 0.4)
EMITTANCE_PRIOR = (0.0, 1.0)
TWISS_PRIOR = (-0.4, 0.9)
# Rounds of fitting map and scales, and steps of the map and of the scales in each. Chosen.
ROUNDS = 6
MAP_STEPS = 6
SCALE_STEPS = 2
# Shares of a step that are tried.
STEP_LENGTHS = np.array([1.0, 0.5, 0.2, 0.05, 0.0])
# Weights of all readings at the two starts of a search: with full weights, several bad readings
# together would hide each other.
START_WEIGHTS = np.array([1.0, 0.1])
# Draws of the scales, and their largest step in a search, in standard deviations of the prior.
SCALE_DRAWS = 64
MAX_SCALE_STEP = 1.5


class KnobScales(NamedTuple):
    """Scales of a map: length of each knob in half ranges, amplitude of each number, noise.

    ``length`` has shape (knobs,), ``amplitude`` (3,), ``noise`` (); all are positive.
    """

    length: Array
    amplitude: Array
    noise: Array


def orders_of(knobs: int) -> np.ndarray:
    """Powers of the knobs in each feature, up to the highest total degree, shape (features, knobs).

    Examples
    --------
    >>> len(orders_of(2)), orders_of(2)[:3].tolist()
    (45, [[0, 0], [0, 1], [1, 0]])
    """
    top = MAX_DEGREE.get(knobs, 3)
    every = [n for n in product(range(top + 1), repeat=knobs) if sum(n) <= top]
    return np.array(sorted(every, key=lambda n: (sum(n), n)))


def features(x: Array, length: Array, orders: np.ndarray) -> Array:
    """Features of a knob setting, shape (features,), whose products give the Gaussian kernel.

    Parameters
    ----------
    x, length : Array
        Shape (knobs,), in half ranges.
    orders : ndarray
        Result of `orders_of`.

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

    The numbers are those of `beam_of`: the level of ln ε, which no knob changes, the relative
    change of ε², ln β, and α. Coefficients are in prior standard deviations: a mean, then features.
    """
    row = jnp.append(MEAN_SPREAD, jnp.ones(len(orders)))
    phi = jnp.append(1.0, features(x, scales.length, orders)) * row
    amplitudes = jnp.concatenate(
        [jnp.ones((NUMBERS, 1)), jnp.repeat(scales.amplitude[:, None], len(orders), axis=1)], axis=1
    )
    rows = jnp.einsum("ij,ik->ijk", jnp.eye(NUMBERS), amplitudes * phi).reshape(NUMBERS, -1)
    level = jnp.arange(rows.shape[1]) == 0
    return jnp.concatenate([jnp.where(level, rows[:1], 0.0), jnp.where(level, 0.0, rows[:1]),
                            rows[1:]])  # fmt: skip


def log_emittance(level: Array, change: Array) -> Array:
    """Logarithm of an emittance whose square is exp(2 level) (1 + change), kept positive.

    Contributions to the emittance add in squares (D. H. Dowell, Sources of emittance in RF
    photocathode injectors, arXiv:1610.01242 (2016)), so its square is the smooth map.

    Examples
    --------
    >>> float(log_emittance(0.0, 0.0))
    0.0
    """
    square = jnp.logaddexp(SHARPNESS * (1.0 + change), 0.0) / jnp.logaddexp(SHARPNESS, 0.0)
    return level + 0.5 * jnp.log(square)


def beam_of(numbers: Array) -> Array:
    """Give ln ε, ln β and α from the numbers of the map: level, change of ε², ln β, α."""
    return jnp.append(log_emittance(numbers[0], numbers[1]), numbers[2:])


def log_size(numbers: Array, w: Array, known: Array) -> Array:
    """Logarithm of the size of a beam, in the unit of the coordinates.

    Parameters
    ----------
    numbers : Array
        ln ε, ln β, α, shape (3,).
    w : Array
        R11 and R12 in the coordinates, and 0, shape (3,); 0, 0, 1 for an emittance, whose root
        stands for a size.
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
        Knobs in half ranges, shape (n, knobs).
    w, known : Array
        Arguments of `log_size`, shapes (n, 3) and (n,).
    y : Array
        ln of the size.
    floor, unit : Array
        Parts of the relative standard deviation: fixed, and multiplied by the scale of the noise.
    present : Array
        1 for a row, 0 for padding.
    noise : Array
        Prior mean and standard deviation of ln of the noise's scale, shape (2,).
    odds, bad_width : Array
        Prior odds of a bad reading, and the factor by which it scatters more.
    """

    x: Array
    w: Array
    known: Array
    y: Array
    floor: Array
    unit: Array
    present: Array
    noise: Array
    odds: Array
    bad_width: Array


class MapPosterior(NamedTuple):
    """Draws of a plane's map, with its log evidence.

    Attributes
    ----------
    scales : KnobScales
        Scales of each draw, arrays (d, ...).
    coefficients : Array
        Coefficients for `design`, in prior standard deviations, shape (d, n).
    log_evidence : Array
        Log evidence of the sizes, averaged over all scales.
    bad, model : Array
        Share of its weight that a reading lost, which is near the probability that it is bad, and
        fitted ln size, shape (rows,).
    error : Array
        Fitted relative error of the sizes, shape (rows,).
    """

    scales: KnobScales
    coefficients: Array
    log_evidence: Array
    bad: Array
    model: Array
    error: Array


def prior_of(data: KnobReadings) -> tuple[Array, Array]:
    """Prior means and standard deviations of ln of all scales: lengths, amplitudes, noise."""
    own = [LENGTH_PRIOR] * data.x.shape[1] + [EMITTANCE_PRIOR] + [TWISS_PRIOR] * (NUMBERS - 1)
    mean, spread = jnp.array(own).T
    return jnp.append(mean, data.noise[0]), jnp.append(spread, data.noise[1])


def scales_of(eta: Array, varies: Array) -> KnobScales:
    """Scales from their logarithms; ``varies`` is 1, or 0 for a constant emittance."""
    each = jnp.exp(eta)
    return KnobScales(each[:-4], each[-4:-1].at[0].multiply(varies), each[-1])


class _MapState(NamedTuple):
    """Coefficients of the map, ln of its scales, and weight of each reading, from 0 to 1."""

    v: Array
    eta: Array
    good: Array


def _variance(data: KnobReadings, noise: Array, good: Array) -> Array:
    """Variance of ln of the sizes; 1 for padding."""
    own = data.floor**2 + (noise * data.unit) ** 2
    return jnp.where(data.present > 0, own / good, 1.0)


def _row_designs(data: KnobReadings, scales: KnobScales, orders: np.ndarray) -> Array:
    """Derivatives of every row's numbers by the coefficients, shape (n, 4, coefficients)."""
    return jax.vmap(lambda x: design(x, scales, orders))(data.x)


def _log_size(numbers: Array, w: Array, known: Array) -> Array:
    return log_size(beam_of(numbers), w, known)


def _slopes(data: KnobReadings, u: Array) -> tuple[Array, Array]:
    """Predicted ln sizes and their derivatives by the rows' numbers."""
    both = jax.vmap(jax.value_and_grad(_log_size))(u, data.w, data.known)
    return both[0], both[1] * data.present[:, None]


def _fit_coefficients(
    data: KnobReadings, state: _MapState, varies: Array, orders: np.ndarray
) -> Array:
    """Fit the coefficients at given scales by Gauss-Newton steps of the best length."""
    scales = scales_of(state.eta, varies)
    designs = _row_designs(data, scales, orders)
    variance = _variance(data, scales.noise, state.good)

    def cost(v: Array) -> Array:
        residual = data.y - jax.vmap(_log_size)(designs @ v, data.w, data.known)
        return jnp.sum(v**2) + jnp.sum(data.present * residual**2 / variance)

    def step(v: Array, _: None) -> tuple[Array, None]:
        model, slope = _slopes(data, designs @ v)
        a = jnp.einsum("ij,ijk->ik", slope, designs)
        residual = data.present * (data.y - model) + a @ v
        root = jax.scipy.linalg.cho_factor(a @ a.T + jnp.diag(variance))
        full = a.T @ jax.scipy.linalg.cho_solve(root, residual)
        tried = v + STEP_LENGTHS[:, None] * (full - v)
        return tried[jnp.nanargmin(jax.vmap(cost)(tried))], None

    return jax.lax.scan(step, state.v, length=MAP_STEPS)[0]


class _LinearReadings(NamedTuple):
    """Readings linearised about the numbers of the rows, weight of each, and ``varies``."""

    data: KnobReadings
    target: Array
    slope: Array
    good: Array
    varies: Array


def _linearise(data: KnobReadings, u: Array, good: Array, varies: Array) -> _LinearReadings:
    """Linearise the readings about the numbers ``u`` of the rows, shape (n, 4)."""
    model, slope = _slopes(data, u)
    target = data.present * (data.y - model) + jnp.sum(slope * u, axis=1)
    return _LinearReadings(data, target, slope, good, varies)


def _covariance(eta: Array, by: _LinearReadings, orders: np.ndarray) -> Array:
    """Covariance of the readings at given scales, shape (n, n)."""
    scales = scales_of(eta, by.varies)
    a = jnp.einsum("ij,ijk->ik", by.slope, _row_designs(by.data, scales, orders))
    return a @ a.T + jnp.diag(_variance(by.data, scales.noise, by.good))


def _inverse(covariance: Array) -> Array:
    factor = jax.scipy.linalg.cho_factor(covariance)
    return jax.scipy.linalg.cho_solve(factor, jnp.eye(len(covariance)))


def _log_evidence(eta: Array, by: _LinearReadings, orders: np.ndarray) -> Array:
    """Log evidence of the scales times their prior.

    C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. 2.30.
    """
    root = jnp.linalg.cholesky(_covariance(eta, by, orders))
    z = jax.scipy.linalg.solve_triangular(root, by.target, lower=True)
    mean, spread = prior_of(by.data)
    own = -0.5 * jnp.sum(((eta - mean) / spread) ** 2 + 2.0 * jnp.log(spread) + LN_2PI)
    count = jnp.sum(by.data.present)
    return own - 0.5 * jnp.sum(z**2) - jnp.sum(jnp.log(jnp.diag(root))) - 0.5 * count * LN_2PI


def _scoring(eta: Array, by: _LinearReadings, orders: np.ndarray) -> tuple[Array, Array]:
    """Gradient of the log evidence by ln scales, and its expected curvature, both with the prior.

    Rasmussen and Williams, eq. 5.9; Fisher information of a normal distribution, ½ tr(S⁻¹ S_i S⁻¹
    S_j), from S. M. Kay, Fundamentals of Statistical Signal Processing (1993), eq. 3.31.
    """
    covariance = _covariance(eta, by, orders)
    changes = jnp.moveaxis(jax.jacfwd(_covariance)(eta, by, orders), -1, 0)
    inverse = _inverse(covariance)
    each, z = inverse @ changes, inverse @ by.target
    mean, spread = prior_of(by.data)
    slope = 0.5 * (jnp.einsum("i,kij,j->k", z, changes, z) - jnp.trace(each, axis1=1, axis2=2))
    fisher = 0.5 * jnp.einsum("aij,bji->ab", each, each)
    return slope - (eta - mean) / spread**2, fisher + jnp.diag(spread**-2)


def _weigh_readings(eta: Array, by: _LinearReadings, orders: np.ndarray) -> tuple[Array, Array]:
    """Weigh each reading by its prediction from the others; also give the change of log evidence.

    A reading is good, or bad as in scans: `beamfit.noise.sizes.log_likelihood`. A map bends towards
    any reading that it is fitted to, so a reading is judged by the map without it (Rasmussen and
    Williams, eq. 5.12), as in expectation propagation (sect. 3.6).
    """
    data, covariance = by.data, _covariance(eta, by, orders)
    inverse = _inverse(covariance)
    predictive = 1.0 / jnp.diag(inverse)
    square = (predictive * (inverse @ by.target)) ** 2
    own = _variance(data, jnp.exp(eta[-1]), 1.0)
    map_variance = jnp.maximum(predictive - own / by.good, 0.0)

    def log_normal(variance: Array) -> Array:
        return -0.5 * (square / variance + jnp.log(variance))

    bad_variance = map_variance + data.bad_width**2 * own
    bad = (
        jnp.log(data.odds)
        + 0.5 * jnp.log(2.0 / jnp.pi / bad_variance)
        - jnp.log1p(square / bad_variance)
    )
    either = jnp.logaddexp(log_normal(map_variance + own), bad)
    bad_probability = jnp.exp(bad - either)
    good = 1.0 - bad_probability + bad_probability * 2.0 * own / (bad_variance + square)
    gain = either - jnp.log1p(data.odds) - log_normal(map_variance + own / good)
    present = data.present > 0
    return jnp.where(present, good, 1.0), jnp.sum(jnp.where(present, gain, 0.0))


def _fit_map(
    data: KnobReadings, start: Array, good: Array, varies: Array, orders: np.ndarray
) -> tuple[_MapState, _LinearReadings, Array, Array]:
    """Fit map and scales; also give linear readings, log evidence, and the scales' factor."""
    mean, spread = prior_of(data)

    def newton(eta: Array, by: _LinearReadings) -> Array:
        slope, curvature = _scoring(eta, by, orders)
        step = jnp.linalg.solve(curvature, slope)
        step = step * jnp.minimum(1.0, MAX_SCALE_STEP / jnp.linalg.norm(step / spread))
        trials = eta + STEP_LENGTHS[:, None] * step
        found = jax.vmap(lambda each: _log_evidence(each, by, orders))(trials)
        return trials[jnp.argmax(jnp.nan_to_num(found, nan=-jnp.inf))]

    def fit_and_weigh(state: _MapState) -> tuple[_MapState, _LinearReadings, Array]:
        v = _fit_coefficients(data, state, varies, orders)
        u = _row_designs(data, scales_of(state.eta, varies), orders) @ v
        by = _linearise(data, u, state.good, varies)
        good, gain = _weigh_readings(state.eta, by, orders)
        return _MapState(v, state.eta, good), by._replace(good=good), gain

    def round_of(state: _MapState, _: None) -> tuple[_MapState, None]:
        state, by, _ = fit_and_weigh(state)
        eta = jax.lax.fori_loop(0, SCALE_STEPS, lambda _, e: newton(e, by), state.eta)
        return state._replace(eta=eta), None

    state = _MapState(start, mean, jnp.full(len(data.y), good))
    state, by, gain = fit_and_weigh(jax.lax.scan(round_of, state, length=ROUNDS)[0])
    root = jnp.linalg.cholesky(jnp.linalg.inv(_scoring(state.eta, by, orders)[1]))
    total = _log_evidence(state.eta, by, orders) + gain + 0.5 * len(mean) * LN_2PI
    return state, by, total + jnp.sum(jnp.log(jnp.diag(root))), root


def _draw(
    key: Array, data: KnobReadings, state: _MapState, varies: Array, orders: np.ndarray
) -> Array:
    """Draw a map at given scales: a prior draw, corrected by the readings.

    J. T. Wilson et al., Pathwise conditioning of Gaussian processes, J. Mach. Learn. Res. 22 (2021)
    105, with the sizes linearised about the best map.
    """
    scales = scales_of(state.eta, varies)
    designs = _row_designs(data, scales, orders)
    a = jnp.einsum("ij,ijk->ik", _slopes(data, designs @ state.v)[1], designs)
    variance = _variance(data, scales.noise, state.good)
    map_key, noise_key = jax.random.split(key)
    free = jax.random.normal(map_key, state.v.shape)
    noise = jnp.sqrt(variance) * jax.random.normal(noise_key, variance.shape)
    root = jax.scipy.linalg.cho_factor(a @ a.T + jnp.diag(variance))
    return state.v + free - a.T @ jax.scipy.linalg.cho_solve(root, a @ free + noise)


@partial(jax.jit, static_argnames=("knobs", "draws"))
def map_posterior(
    data: KnobReadings, start: Array, seed: Array, knobs: int, draws: int
) -> MapPosterior:
    """Draw maps of a plane's beam from their posterior, with a varying and a constant emittance.

    Parameters
    ----------
    data : KnobReadings
        The sizes.
    start : Array
        Numbers of the beam to start with, the same at all knobs, shape (3,).
    seed : Array
        Seed of the random numbers.
    knobs, draws : int
        Numbers of knobs and draws.

    Returns
    -------
    MapPosterior
        Every array has a first axis of two: an emittance that varies with the knobs, and a constant
        one.

    Notes
    -----
    Each number of the beam is a Gaussian process, and the sizes are linearised about the best map
    (Laplace's method: Rasmussen and Williams, sect. 3.4). Scales are drawn from the normal
    distribution about their optimum and weighted by the evidence (importance sampling: D. J. C.
    MacKay, Information Theory, Inference, and Learning Algorithms (2003), sect. 29.2).
    """
    orders = orders_of(knobs)
    first = jnp.zeros((NUMBERS, 1 + len(orders))).at[:, 0].set(start / MEAN_SPREAD).ravel()
    scale_key, choice_key, draw_key = jax.random.split(jax.random.key(seed), 3)

    def draw_maps(varies: Array) -> MapPosterior:
        starts = jax.lax.map(
            lambda good: _fit_map(data, first, good, varies, orders), START_WEIGHTS
        )
        best = jnp.nanargmax(starts[2])
        state, by, log_evidence, root = jax.tree.map(lambda v: v[best], starts)
        z = jax.random.normal(scale_key, (SCALE_DRAWS, len(state.eta))).at[0].set(0.0)
        eta = state.eta + z @ root.T
        log = jax.vmap(lambda e: _log_evidence(e, by, orders))(eta)
        weight = jax.nn.softmax(jnp.nan_to_num(log, nan=-jnp.inf) + 0.5 * jnp.sum(z**2, axis=1))
        # Systematic resampling: the count of each set is its weight times the draws, within one.
        quantiles = (jax.random.uniform(choice_key) + jnp.arange(draws)) / draws
        chosen = jnp.minimum(jnp.searchsorted(jnp.cumsum(weight), quantiles), SCALE_DRAWS - 1)
        fits = jax.vmap(lambda e: _fit_coefficients(data, state._replace(eta=e), varies, orders))(
            eta
        )
        coefficients = jax.vmap(
            lambda key, i: _draw(key, data, _MapState(fits[i], eta[i], state.good), varies, orders)
        )(jax.random.split(draw_key, draws), chosen)
        bad, error = 1.0 - state.good, jnp.sqrt(_variance(data, jnp.exp(state.eta[-1]), 1.0))
        u = _row_designs(data, scales_of(state.eta, varies), orders) @ state.v
        scales = jax.vmap(lambda e: scales_of(e, varies))(eta[chosen])
        return MapPosterior(scales, coefficients, log_evidence, bad, _slopes(data, u)[0], error)

    return jax.lax.map(draw_maps, jnp.array([1.0, 0.0]))


def mix_draws(both: MapPosterior, constant: np.ndarray) -> MapPosterior:
    """Take draws of the varying map, and of the constant one where ``constant`` is True.

    Parameters
    ----------
    both : MapPosterior
        From `map_posterior`.
    constant : ndarray of bool
        Shape (d,). Fitted sizes and errors are those of the model that most draws have.
    """
    majority = int(constant.mean() > 0.5)

    def each(v: np.ndarray) -> np.ndarray:
        v = np.asarray(v)
        return np.where(constant.reshape(-1, *[1] * (v.ndim - 2)), v[1], v[0])

    scales, coefficients = jax.tree.map(each, (both.scales, both.coefficients))
    fitted = (np.asarray(v)[majority] for v in both[2:])
    return MapPosterior(scales, coefficients, *fitted)


@jax.jit
def numbers_at(posterior: MapPosterior, x: np.ndarray) -> Array:
    """Give ln ε, ln β, α of every draw at settings, shape (m, knobs) to (d, m, 3)."""
    orders = orders_of(x.shape[-1])

    def one(scales: KnobScales, v: Array) -> Array:
        return jax.vmap(lambda at: beam_of(design(at, scales, orders) @ v))(jnp.asarray(x))

    return jax.vmap(one)(posterior.scales, posterior.coefficients)
