"""Arrays of NumPy or JAX, and dataclasses registered as JAX pytrees."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.answer import shown

C = TypeVar("C", bound=type)
# Smallest padded length of a record; lengths are powers of two, so that records share compiled
# code.
MIN_PADDED_LENGTH = 8


def registered(cls: C, static: Sequence[str]) -> C:
    """Register a dataclass as a pytree: `static` fields are structure (hashable), the rest data.

    `jax.tree_util.register_dataclass` is not used, because in JAX 0.10 the structures of two
    classes with equal field names compare equal and differ only in their hash. Occasionally one
    class then runs the program compiled for the other: settings in T/m were taken for kG.
    Unflattening does not run ``__post_init__``, so a class can check its input and still hold
    traced arrays.

    Examples
    --------
    >>> import jax
    >>> @dataclasses.dataclass
    ... class Scaled:
    ...     name: str
    ...     factor: float
    >>> jax.tree.leaves(registered(Scaled, ["name"])("a", 2.0))
    [2.0]
    """
    names = [f.name for f in dataclasses.fields(cls)]
    data = [name for name in names if name not in static]

    def flatten(value):
        # Reading the dictionary takes a third of the time of attribute access; a line has hundreds
        # of elements.
        own = vars(value)
        return [own[name] for name in data], tuple([own[name] for name in static])

    def flatten_with_keys(value):
        children, structure = flatten(value)
        keys = (jax.tree_util.GetAttrKey(name) for name in data)
        return list(zip(keys, children, strict=True)), structure

    def unflatten(structure, children):
        value = object.__new__(cls)
        for name, part in zip([*static, *data], [*structure, *children], strict=True):
            object.__setattr__(value, name, part)
        return value

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


@dataclass_transform(frozen_default=True)
def value(*structure: str) -> Callable[[C], C]:
    """Make a class a frozen dataclass and pytree; the fields in `structure` are static.

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
    """Return `jax.numpy` if a value is a JAX array, otherwise `numpy`, which compiles nothing.

    Examples
    --------
    >>> array_module(1.0, jnp.ones(2)).__name__, array_module(1.0, np.ones(2)).__name__
    ('jax.numpy', 'numpy')
    """
    return jnp if any(isinstance(v, jax.Array) for v in values) else np


def floats(number: ArrayLike) -> Array:
    """Convert to an array of floats, of NumPy or JAX like the argument.

    Examples
    --------
    >>> floats(2)
    array(2.)
    """
    return array_module(number).asarray(number, float)


def padded_length(n: int) -> int:
    """Return the padded length of a record of n values; a growing record is rarely recompiled.

    Examples
    --------
    >>> [padded_length(n) for n in (3, 8, 9, 100)]
    [8, 8, 16, 128]
    """
    return max(MIN_PADDED_LENGTH, 1 << max(n - 1, 0).bit_length())
