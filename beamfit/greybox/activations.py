"""The node functions of a network (report 3.1.3), and the certified ranges of their derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp


class Activation(NamedTuple):
    """A node function and where its derivatives turn.

    Parameters
    ----------
    function : callable
        The node function of a scalar.
    turns : tuple of tuple of float
        For the function and its derivatives of order 1 to 3: the points between which it is
        monotonic.
    monotonic : bool
        Whether the function never falls.
    """

    function: Callable[[jax.Array], jax.Array]
    turns: tuple[tuple[float, ...], ...]
    monotonic: bool

    def derivative(self, order: int) -> Callable[[jax.Array], jax.Array]:
        """The derivative of an order, as JAX makes it."""
        function = self.function
        for _ in range(order):
            function = jax.grad(function)
        return function


@jax.custom_jvp
def _logcosh(s):
    return jnp.logaddexp(s, -s) - math.log(2.0)


# JAX's own derivative of logaddexp loses digits in proportion to |s|; d log cosh(s)/ds = tanh(s).
_logcosh.defjvps(lambda t, _, s: jnp.tanh(s) * t)

# Zeros of the next derivative. With t = tanh(s), the third derivative of tanh is
# -2 (1-t^2) (1-3t^2), the fourth 8 t (1-t^2) (2-3t^2); sigmoid(s) = (1 + tanh(s/2))/2; those of
# exp(-s^2) are zeros of the Hermite polynomials of order 1 to 4.
_T2, _T3 = math.atanh(math.sqrt(1 / 3)), math.atanh(math.sqrt(2 / 3))
_G1, _G2 = math.sqrt(1 / 2), math.sqrt(3 / 2)
_G3, _G4 = (math.sqrt((3 + sign * math.sqrt(6)) / 2) for sign in (-1, 1))
_NONE: tuple[tuple[float, ...], ...] = ((), (), (), ())

KINDS: dict[str, Activation] = {
    "identity": Activation(lambda s: s, _NONE, True),
    "linear": Activation(lambda s: s, _NONE, True),
    "quadratic": Activation(lambda s: s * s, ((0.0,), (), (), ()), False),
    "sigmoid": Activation(
        jax.nn.sigmoid, ((), (0.0,), (-2 * _T2, 2 * _T2), (-2 * _T3, 0.0, 2 * _T3)), True
    ),
    "tanh": Activation(jnp.tanh, ((), (0.0,), (-_T2, _T2), (-_T3, 0.0, _T3)), True),
    "gaussian": Activation(
        lambda s: jnp.exp(-s * s),
        ((0.0,), (-_G1, _G1), (-_G2, 0.0, _G2), (-_G4, -_G3, _G3, _G4)),
        False,
    ),
    "logcosh": Activation(_logcosh, ((0.0,), (), (0.0,), (-_T2, _T2)), False),
}
"""Node functions by the report's names; gaussian is exp(-s^2), logcosh is log(cosh(s))."""


class Range(NamedTuple):
    """An enclosure: everything lies between `lower` and `upper`."""

    lower: jax.Array
    upper: jax.Array

    def widened(self, error: jax.Array) -> Range:
        """Move both ends outward by a rounding error, which no derivative sees."""
        error = jax.lax.stop_gradient(error)
        return Range(self.lower - error, self.upper + error)


# The error of one evaluation is at most 64 roundings of 1 + |value|: tests compare every derivative
# with 50-digit arithmetic. XLA's tanh and exp are good to a few roundings.
_ERROR = 64 * 2.0**-53


def range_of(kind: str, order: int, s: Range) -> Range:
    """Enclose the derivative of a node function over ranges of its argument.

    Between the turning points the derivative is monotonic, so its range is spanned by its values
    at the ends and at the turning points inside; rounding is added outward.

    Parameters
    ----------
    kind : str
        A key of `KINDS`.
    order : int
        0 to 3.
    s : Range
        The argument, of any shape.

    Returns
    -------
    Range
        Of the same shape.

    Examples
    --------
    >>> slope = range_of("tanh", 1, Range(jnp.array([-1.0]), jnp.array([2.0])))
    >>> round(float(slope.lower[0]), 4), round(float(slope.upper[0]), 4)
    (0.0707, 1.0)
    """
    turns = KINDS[kind].turns[order]
    at = [s.lower, s.upper, *(jnp.clip(t, s.lower, s.upper) for t in turns)]
    values = jnp.vectorize(KINDS[kind].derivative(order))(jnp.stack(at))
    found = Range(jnp.min(values, axis=0), jnp.max(values, axis=0))
    return found.widened(_ERROR * (1 + jnp.max(jnp.abs(values), axis=0)))
