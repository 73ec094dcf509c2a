"""Dataclasses that JAX walks, told apart by their class as well as by their fields."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import jax

C = TypeVar("C", bound=type)


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
