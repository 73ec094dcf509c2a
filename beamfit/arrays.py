"""Arrays of NumPy or JAX behind one type, and dataclasses that JAX walks."""

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
# Shortest padded record; lengths are powers of two, so that records share compiled code.
SHORTEST = 8


def registered(cls: C, static: Sequence[str]) -> C:
    """Have JAX walk a dataclass: `static` fields are structure (hashable), the rest data.

    `jax.tree_util.register_dataclass` will not do: in JAX 0.10 the structures of two classes with
    fields of the same names are equal and differ in their hash alone, so that now and then one
    class runs the program compiled for the other: settings in T/m were taken for kG. Rebuilding
    does not run ``__post_init__``, so a class can check its input and still hold traced arrays.

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
        # A line has hundreds of elements: reading the dictionary is a third of the time.
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


def padded_length(n: int) -> int:
    """The length to pad a record of n values to, so that a growing one is not compiled anew.

    Examples
    --------
    >>> [padded_length(n) for n in (3, 8, 9, 100)]
    [8, 8, 16, 128]
    """
    return max(SHORTEST, 1 << max(n - 1, 0).bit_length())
