"""Focusing functions: one solution of u'' + k u = h, smooth through k = 0.

All elements are combinations of these three functions, so that a limit that is right here (a
quadrupole of zero strength is a drift) is right for all of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.arrays import array_module, floats

# |k L²| below which the series is used, and its number of terms: the remainder is below 1e-18.
_SERIES_LIMIT, _TERMS = 0.5, 9
_SERIES = np.array(
    [[(-1) ** n / math.factorial(2 * n + m) for m in (0, 1, 2)] for n in range(_TERMS)]
)


class Focusing(NamedTuple):
    """Functions C, S and D for a length L of constant focusing k.

    Attributes
    ----------
    cosine : Array
        C(L), the solution of u'' + k u = 0 with u = 1, u' = 0 at the start.
    sine : Array
        S(L) in m, the solution with u = 0, u' = 1 at the start.
    dispersion : Array
        D(L) in m², the solution of u'' + k u = 1 from rest, (1 - C)/k.
    """

    cosine: Array
    sine: Array
    dispersion: Array


def focusing(k: ArrayLike, length: ArrayLike) -> Focusing:
    """Solve the linear equation of motion over a length of constant focusing.

    Parameters
    ----------
    k : float or Array
        Focusing strength, 1/m². Positive focuses, negative defocuses, zero is a drift; value
        and all derivatives are continuous there.
    length : float or Array
        Length in m.

    Returns
    -------
    Focusing
        C, S, D with the broadcast shape of the arguments; NumPy arrays if the arguments are.

    Notes
    -----
    C = cos √k L, S = sin(√k L)/√k, and cosh, sinh for k < 0: eqs 20 and 22 of the report
    (its k is √k here). D = (1 - C)/k solves u'' + k u = 1 from rest, by substitution. Near
    k = 0 all three are summed as a series in k L².

    Examples
    --------
    >>> [float(f) for f in focusing(0.0, 2.0)]
    [1.0, 2.0, 2.0]
    """
    xp = array_module(k, length)
    k, length = floats(k), floats(length)
    x = k * length**2
    near = abs(x) < _SERIES_LIMIT
    series = _series(xp.where(near, x, 0.0))
    with np.errstate(over="ignore"):  # for an absurdly strong magnet: infinite, as in JAX
        c, s, d = xp.where(near, series, _closed_form(xp.where(near, 1.0, x)))
    return Focusing(cosine=c, sine=length * s, dispersion=length**2 * d)


def _series(x: Array) -> Array:
    """Sum cos √x, sin √x/√x and (1 - cos √x)/x as power series in x, by Horner's scheme."""
    total = np.zeros((3, *x.shape))
    for term in _SERIES[::-1]:
        total = total * x + term.reshape(3, *[1] * x.ndim)
    return total


def _closed_form(x: Array) -> Array:
    """Evaluate the same three functions away from x = 0."""
    xp = array_module(x)
    root = xp.sqrt(xp.abs(x))
    hyperbolic = xp.where(x < 0.0, root, 0.0)  # cosh of a large focusing phase would overflow
    c = xp.where(x > 0.0, xp.cos(root), xp.cosh(hyperbolic))
    s = xp.where(x > 0.0, xp.sin(root), xp.sinh(hyperbolic)) / root
    return xp.stack([c, s, (1.0 - c) / x])
