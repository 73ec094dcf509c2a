"""Mass balances of a fed-batch process (report eqs 45 and 46), as concentrations in a volume.

Concentrations are in g/L, volumes in L, times in h; rates are per gram of biomass.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from beamfit.compile_cache import prepare_jax

prepare_jax()


class Flow(NamedTuple):
    """Flows of the vessel: feed and outflow in L/h, substrate in the feed in g/L."""

    feed: jax.Array
    fed: jax.Array
    out: jax.Array


def balances(x: jax.Array, rates: jax.Array, flow: Flow) -> jax.Array:
    """Slopes of biomass, substrate and volume.

    Parameters
    ----------
    x : array, shape (3,)
        Biomass X and substrate S in g/L, volume V in L.
    rates : array, shape (2,)
        Growth mu_b and consumption mu_s, both per gram of biomass, 1/h.
    flow : Flow
        The feed brings no biomass; what runs out has the concentrations inside.

    Returns
    -------
    jax.Array, shape (3,)
        Per hour.

    Notes
    -----
    Report eqs 45 and 46, accumulation = in - out + generation, are balances of the masses X V and
    S V: (X V)' = mu_b X V - out X, (S V)' = feed S_f - out S - mu_s X V. With V' = feed - out the
    outflow leaves the concentrations. The report multiplies mu_s by the substrate; a rate of
    consumption is one of the cells, so that it is of the biomass here.

    Examples
    --------
    >>> flow = Flow(jnp.array(0.1), jnp.array(200.0), jnp.array(0.0))
    >>> print(balances(jnp.array([2.0, 5.0, 4.0]), jnp.array([0.2, 0.4]), flow))
    [0.35  4.075 0.1  ]
    """
    thinned = flow.feed / x[2]
    return jnp.stack(
        [
            (rates[0] - thinned) * x[0],
            thinned * (flow.fed - x[1]) - rates[1] * x[0],
            flow.feed - flow.out,
        ]
    )


def titre_of(
    begin: jax.Array, made: jax.Array, x: jax.Array, out: jax.Array, dt: jax.Array
) -> jax.Array:
    """Titre along a course: the mass of product, (P V)' = q X V - out P, over the volume.

    Parameters
    ----------
    begin : array, shape ()
        Titre at the first point, g/L.
    made : array, shape (2, n)
        Product formed, q, per gram of biomass, 1/h: from each point on, and just before the next.
    x : array, shape (n, 3)
        Biomass, substrate, volume.
    out : array, shape (n,)
        Outflow until the next point, L/h.
    dt : array, shape (n,)
        Time to the next point, h; the last is not used.

    Returns
    -------
    jax.Array, shape (n,)
        By the trapezoidal rule: with kept(t) = exp(-∫ out/V), P V = kept (P0 V0 + ∫ q X V/kept).

    Examples
    --------
    >>> x = jnp.tile(jnp.array([10.0, 1.0, 4.0]), (3, 1))
    >>> titre_of(jnp.array(1.0), jnp.full((2, 3), 0.1), x, jnp.zeros(3), jnp.ones(3)).tolist()
    [1.0, 2.0, 3.0]
    """
    mass, dt, start = x[:, 0] * x[:, 2], dt[:-1], jnp.zeros(1)
    lost = 0.5 * out[:-1] * dt * (1.0 / x[:-1, 2] + 1.0 / x[1:, 2])
    lost = jnp.concatenate([start, jnp.cumsum(lost)])
    grown = mass * jnp.exp(lost)
    gained = 0.5 * dt * (made[0, :-1] * grown[:-1] + made[1, :-1] * grown[1:])
    whole = begin * x[0, 2] + jnp.concatenate([start, jnp.cumsum(gained)])
    return jnp.exp(-lost) * whole / x[:, 2]
