"""Responses whose parameters may change with the operating point (report 3.2, eqs 5-19).

Each physics is a value: names of its parameters, the transform from unbounded raw numbers to stable
parameters, and one exact step under an input held from one sample to the next (zero-order hold). A
step is a function of one sample; the code that uses it scans and vectorises it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from beamfit.dynamics.states import Matrices, affine_course, linear_outputs


class Physics(NamedTuple):
    """A response of one output to m inputs.

    Attributes
    ----------
    name : str
        Name on the command line.
    parameters : callable
        ``parameters(inputs)``: names of p; each gain has one value for each input.
    units : callable
        ``units(inputs)``: powers of (time, output/input) of each parameter.
    free_states : int
        Unknown numbers in the state at the start.
    physical : callable
        ``physical(q)``: stable parameters p of unbounded raw numbers q.
    raw : callable
        Inverse of `physical`.
    begin : callable
        ``begin(free, u0)``: the state at the first sample.
    advance : callable
        ``advance(p, x, u, dt)``: the state after dt under the input u, shape (m,), affine in x.
        The output is x[0].
    even : bool
        True if it needs equally spaced samples.
    """

    name: str
    parameters: Callable[[tuple[str, ...]], tuple[str, ...]]
    units: Callable[[int], tuple[tuple[int, int], ...]]
    free_states: int
    physical: Callable[[jax.Array], jax.Array]
    raw: Callable[[jax.Array], jax.Array]
    begin: Callable[[jax.Array, jax.Array], jax.Array]
    advance: Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]
    even: bool = False

    def __reduce__(self) -> tuple[Callable[[str], Physics], tuple[str]]:
        """Pickle the name: there is one response of each."""
        return response_named, (self.name,)


def _gains(inputs: tuple[str, ...], letter: str = "K") -> tuple[str, ...]:
    return (letter,) if len(inputs) == 1 else tuple(f"{letter}_{name}" for name in inputs)


# ---- first order: tau y' + y = K u (eq 5)


def _advance_first(p, x, u, dt):
    settled = p[1:] @ u
    return settled + (x - settled) * jnp.exp(-dt / p[0])


FIRST_ORDER = Physics(
    "first-order",
    lambda inputs: ("tau", *_gains(inputs)),
    lambda m: ((1, 0),) + ((0, 1),) * m,
    1,
    jax.jit(lambda q: jnp.concatenate([jnp.exp(q[:1]), q[1:]])),
    jax.jit(lambda p: jnp.concatenate([jnp.log(p[:1]), p[1:]])),
    lambda free, u0: free,
    _advance_first,
)


# ---- second order: T² y'' + 2 zeta T y' + y = K u; T² = tau1 tau2, 2 zeta T = tau1 + tau2 (eq 8)


def _cosh_sinhc(square):
    """Give cosh(r) and sinh(r)/r for r² = square; cos and sin/r for negative squares.

    For positive squares both lack the factor e^|r|, so that nothing overflows.
    """
    size = jnp.sqrt(jnp.where(jnp.abs(square) > 1e-8, jnp.abs(square), 1.0))
    fall = jnp.exp(-2.0 * size)
    grown = 0.5 * (1.0 + fall), 0.5 * (1.0 - fall) / size
    waving = jnp.cos(size), jnp.sin(size) / size
    small = 1.0 + square / 2.0, 1.0 + square / 6.0
    return tuple(
        jnp.where(square > 1e-8, g, jnp.where(square < -1e-8, w, s))
        for g, w, s in zip(grown, waving, small, strict=True)
    )


def _advance_second(p, x, u, dt):
    """Advance the state (y, y') of eq 8; the two lags may be in any order.

    With s = zeta/T and r² = s² - 1/T², the deviation d from K u moves by
    e^(-s t) (cosh(rt) (d, d') + t sinh(rt)/(rt) (s d + d', -d/T² - s d')).
    """
    time, zeta, settled = p[0], p[1], p[2:] @ u
    s, square = zeta / time, (zeta**2 - 1.0) * (dt / time) ** 2
    c, sc = _cosh_sinhc(square)
    grown = jnp.where(square > 1e-8, jnp.sqrt(jnp.where(square > 1e-8, square, 1.0)), 0.0)
    fall = jnp.exp(grown - s * dt)
    d, v = x[0] - settled, x[1]
    moved = jnp.stack([c * d + dt * sc * (s * d + v), c * v - dt * sc * (d / time**2 + s * v)])
    return fall * moved + jnp.stack([settled, 0.0 * settled])


SECOND_ORDER = Physics(
    "second-order",
    lambda inputs: ("T", "zeta", *_gains(inputs)),
    lambda m: ((1, 0), (0, 0)) + ((0, 1),) * m,
    2,
    jax.jit(lambda q: jnp.concatenate([jnp.exp(q[:2]), q[2:]])),
    jax.jit(lambda p: jnp.concatenate([jnp.log(p[:2]), p[2:]])),
    lambda free, u0: free,
    _advance_second,
)


# ---- difference equation: y(k+1) = -a1 y(k) - a2 y(k-1) + b1 u(k) + b2 u(k-1) (eq 12)


@jax.jit
def _stable_arx(q):
    """Map raw numbers into the stability triangle |a2| < 1, |a1| < 1 + a2."""
    a2 = jnp.tanh(q[1])
    return jnp.concatenate([jnp.stack([(1.0 + a2) * jnp.tanh(q[0]), a2]), q[2:]])


@jax.jit
def _raw_arx(p):
    a2 = jnp.clip(p[1], -0.999999, 0.999999)
    a1 = jnp.clip(p[0] / (1.0 + a2), -0.999999, 0.999999)
    return jnp.concatenate([jnp.arctanh(jnp.stack([a1, a2])), p[2:]])


def _advance_arx(p, x, u, dt):
    m = u.shape[0]
    new = -p[0] * x[0] - p[1] * x[1] + p[2 : 2 + m] @ u + p[2 + m :] @ x[2:]
    return jnp.concatenate([jnp.stack([new, x[0]]), u])


ARX = Physics(
    "arx",
    lambda inputs: ("a1", "a2", *_gains(inputs, "b1"), *_gains(inputs, "b2")),
    lambda m: ((0, 0), (0, 0)) + ((0, 1),) * (2 * m),
    2,
    _stable_arx,
    _raw_arx,
    lambda free, u0: jnp.concatenate([free, u0]),
    _advance_arx,
    even=True,
)

PHYSICS = {each.name: each for each in (FIRST_ORDER, SECOND_ORDER, ARX)}


def response_named(name: str) -> Physics:
    """Return the response of that name.

    Examples
    --------
    >>> response_named("arx").even
    True
    """
    return PHYSICS[name]


def simulate(
    physics: Physics, p: jax.Array, u: jax.Array, dt: jax.Array, free: jax.Array
) -> jax.Array:
    """Run a response on its own state (output error).

    Parameters
    ----------
    physics : Physics
        The response.
    p : array, shape (samples, parameters)
        Its parameters while the input of each sample holds.
    u : array, shape (samples, m)
        Inputs, each from its sample to the next.
    dt : array, shape (samples,)
        Time to the next sample; the last is not used.
    free : array, shape (free states,)
        The unknown part of the state at the first sample.

    Returns
    -------
    jax.Array, shape (samples,)
        The output at each sample.

    Examples
    --------
    >>> p = jnp.tile(jnp.array([2.0, 3.0]), (4, 1))
    >>> y = simulate(FIRST_ORDER, p, jnp.ones((4, 1)), jnp.full(4, 2.0), jnp.zeros(1))
    >>> [round(float(v), 4) for v in y]
    [0.0, 1.8964, 2.594, 2.8506]
    """
    return run_from(physics, p, u, dt, physics.begin(free, u[0]))


def response_at(
    physics: Physics,
    p: jax.Array,
    u: jax.Array,
    dt: jax.Array,
    free: jax.Array,
    index: jax.Array,
    fraction: jax.Array,
) -> jax.Array:
    """Output at some samples, with inputs delayed by a fraction of the mean step, at most one step.

    Parameters
    ----------
    physics, p, u, dt, free
        As for `simulate`.
    index : array of int, shape (readings,)
        The samples.
    fraction : float
        The fraction.

    Returns
    -------
    jax.Array, shape (readings,)

    Examples
    --------
    >>> p, dt, u = jnp.array([[2.0, 3.0]] * 4), jnp.full(4, 2.0), jnp.ones((4, 1))
    >>> y = response_at(FIRST_ORDER, p, u, dt, jnp.zeros(1), jnp.arange(4), 0.0)
    >>> [round(float(v), 4) for v in y]
    [0.0, 1.8964, 2.594, 2.8506]
    """
    x0 = physics.begin(free, u[0])
    delay = jnp.minimum(fraction * mean_step(dt), dt)
    first = x0 if physics.even else physics.advance(p[0], x0, u[0], delay[0])
    step = dt - delay + jnp.append(delay[1:], delay[-1:])
    x = affine_course(lambda x, p, *now: physics.advance(p, x, *now), first, p, u, step)[1]
    before = jnp.maximum(index - 1, 0)
    y = jax.vmap(physics.advance)(p[before], x[before], u[before], (dt - delay)[before])[:, 0]
    return jnp.where(index == 0, x0[0], y)


@jax.jit
def mean_step(dt: jax.Array) -> jax.Array:
    """Mean of the steps, leaving out padding, where they are 0."""
    return jnp.sum(dt) / jnp.maximum(jnp.sum(dt > 0), 1)


@partial(jax.jit, static_argnums=(0, 5))
def even_response(
    physics: Physics,
    p: jax.Array,
    u: jax.Array,
    dt: jax.Array,
    free: jax.Array,
    stride: int,
    fraction: jax.Array,
) -> jax.Array:
    """Output of constant parameters p at every `stride`-th of equal steps dt.

    Inputs are delayed by a fraction of a step. The number of samples is a multiple of the stride.

    Examples
    --------
    >>> p, u = jnp.array([2.0, 3.0]), jnp.ones((4, 1))
    >>> y = even_response(FIRST_ORDER, p, u, 2.0, jnp.zeros(1), 1, 0.0)
    >>> [round(float(v), 4) for v in y]
    [0.0, 1.8964, 2.594, 2.8506]
    """
    x0, m = physics.begin(free, u[0]), u.shape[1]
    n = len(x0)

    def moved(length, unit):
        return physics.advance(p, unit[:n], unit[n:], length)

    each = jax.vmap(jax.vmap(moved, (None, 0), 1), (0, None))
    steps = each(jnp.stack([dt, (1.0 - fraction) * dt]), jnp.eye(n + m))
    a, b, last, into = steps[0, :, :n], steps[0, :, n:], steps[1, :, :n], steps[1, :, n:]
    powers = [jnp.eye(n)]
    for _ in range(stride):
        powers.append(a @ powers[-1])
    to_state = jnp.concatenate([powers[k] @ b for k in range(stride - 1, -1, -1)], axis=1)
    earlier = (last @ powers[k] @ b for k in range(stride - 2, -1, -1))
    to_output = jnp.concatenate([*earlier, into], axis=1)
    drive, into_both = u.reshape(-1, stride * m), jnp.concatenate([to_state, to_output[:1]])
    if stride * m > n + 1:  # fewer columns: the drives of the state and of the next output
        drive, into_both = drive @ into_both.T, jnp.eye(n + 1)
    output = (last @ powers[stride - 1])[:1]
    system = Matrices(powers[stride], into_both[:n], output, into_both[n:], jnp.zeros(1))
    first = x0 if physics.even else physics.advance(p, x0, u[0], fraction * dt)
    return jnp.append(x0[:1], linear_outputs(system, drive, first)[0][:-1, 0])


def run_from(
    physics: Physics, p: jax.Array, u: jax.Array, dt: jax.Array, x0: jax.Array
) -> jax.Array:
    """Run a response like `simulate`, from a complete state at the first sample."""
    return affine_course(lambda x, p, *now: physics.advance(p, x, *now), x0, p, u, dt)[1][:, 0]
