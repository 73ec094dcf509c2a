"""Arrays of numpy or JAX behind one type."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.nodes import registered
from beamfit.shown import shown

C = TypeVar("C", bound=type)


@dataclass_transform(frozen_default=True)
def value(*structure: str) -> Callable[[C], C]:
    """Make a class a frozen dataclass whose fields are JAX's data, but for those of structure.

    Examples
    --------
    >>> @value("name")
    ... class Lens:
    ...     name: str
    ...     strength: float
    >>> jax.tree.leaves(Lens("L", 2.0))
    [2.0]
    """

    def make(cls: C) -> C:
        return shown(registered(dataclass(frozen=True)(cls), structure))

    return make


def array_module(*values: Any) -> Any:
    """JAX's numpy where a value is JAX's, else numpy: plain numbers need no compiling.

    Examples
    --------
    >>> array_module(1.0, jnp.ones(2)).__name__, array_module(1.0, np.ones(2)).__name__
    ('jax.numpy', 'numpy')
    """
    return jnp if any(isinstance(v, jax.Array) for v in values) else np


def floats(number: ArrayLike) -> Array:
    """Return an array of floats, numpy's or JAX's as the number is.

    Examples
    --------
    >>> floats(2)
    array(2.)
    """
    return array_module(number).asarray(number, float)
