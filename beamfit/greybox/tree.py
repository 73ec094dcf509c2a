"""Models as trees of numbers: dataclasses known to JAX, and leaves addressed by path."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.arrays import registered
from beamfit.errors import InputError, nearest

C = TypeVar("C", bound=type)


@dataclass_transform(frozen_default=True)
def node(*static: str):
    """Make a class a frozen dataclass and a JAX tree: `static` fields are structure, others data.

    Parameters
    ----------
    *static : str
        Names of the fields that are structure (hashable, compared by value).

    Returns
    -------
    decorator
        Turns a class with annotated fields into the registered dataclass.

    Examples
    --------
    >>> @node("name")
    ... class Scaled:
    ...     name: str
    ...     factor: float
    >>> jax.tree_util.tree_leaves(Scaled("a", 2.0))
    [2.0]
    """

    def decorate(cls: C) -> C:
        return registered(dataclasses.dataclass(frozen=True, eq=False)(cls), static)

    return decorate


class Leaf(NamedTuple):
    """One array of a tree: its place among the leaves, its path and its shape."""

    index: int
    path: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape, dtype=int))


def leaves(tree: Any) -> tuple[Leaf, ...]:
    """List the leaves of a tree with their paths.

    Parameters
    ----------
    tree : pytree
        Any JAX tree.

    Returns
    -------
    tuple of Leaf
        In JAX's order; a path reads ``sigma.s11`` or ``map.layers.1.bias``.

    Examples
    --------
    >>> [leaf.path for leaf in leaves({"a": 1.0, "b": (2.0, 3.0)})]
    ['a', 'b.0', 'b.1']
    """
    values, structure = jax.tree_util.tree_flatten(tree)
    return _leaves(structure, tuple(map(np.shape, values)))


@lru_cache(maxsize=256)
def _leaves(structure: jax.tree_util.PyTreeDef, shapes: tuple[tuple[int, ...], ...]):
    """List the leaves of a tree structure, cached: a problem looks up each of its numbers."""
    found = jax.tree_util.tree_leaves_with_path(structure.unflatten(range(len(shapes))))
    named = partial(jax.tree_util.keystr, simple=True, separator=".")
    return tuple(Leaf(i, named(path), shapes[i]) for path, i in found)


def find_leaves(tree: Any, path: str) -> tuple[Leaf, ...]:
    """Find the leaf at a path, or every leaf below it.

    Parameters
    ----------
    tree : pytree
        The model.
    path : str
        A leaf's path, or the path of a part that contains leaves; ``""`` is the whole.

    Returns
    -------
    tuple of Leaf
        At least one.

    Raises
    ------
    InputError
        If there is no leaf at that path.

    Examples
    --------
    >>> [leaf.path for leaf in find_leaves({"a": 1.0, "b": (2.0, 3.0)}, "b")]
    ['b.0', 'b.1']
    """
    every = leaves(tree)
    below = f"{path}."
    found = tuple(one for one in every if path in ("", one.path) or one.path.startswith(below))
    if not found:
        known = nearest(path, [leaf.path for leaf in every])
        raise InputError(f"no leaf at '{path}'", f"a path in the model: {known}")
    return found


def element_names(leaf: Leaf) -> tuple[str, ...]:
    """Name each number of a leaf.

    Parameters
    ----------
    leaf : Leaf
        A leaf of any shape.

    Returns
    -------
    tuple of str
        ``path`` for a scalar, ``path[i,j]`` in C order otherwise.

    Examples
    --------
    >>> element_names(Leaf(0, "w", (2, 1)))
    ('w[0,0]', 'w[1,0]')
    """
    if leaf.shape == ():
        return (leaf.path,)
    return tuple(f"{leaf.path}[{','.join(map(str, i))}]" for i in np.ndindex(*leaf.shape))


def read(tree: Any, chosen: Sequence[Leaf]) -> jax.Array:
    """Gather leaves into one flat vector.

    Parameters
    ----------
    tree : pytree
        The model.
    chosen : sequence of Leaf
        The leaves, in the order of the vector.

    Returns
    -------
    jax.Array, shape (n,)
        Their elements.

    Examples
    --------
    >>> model = {"a": 1.0, "b": (2.0, 3.0)}
    >>> read(model, find_leaves(model, "b")).tolist()
    [2.0, 3.0]
    """
    values = jax.tree_util.tree_leaves(tree)
    parts = [jnp.ravel(jnp.asarray(values[leaf.index], float)) for leaf in chosen]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


def replace(tree: Any, chosen: Sequence[Leaf], vector: jax.Array) -> Any:
    """Return the tree with the chosen leaves taken from a flat vector.

    Parameters
    ----------
    tree : pytree
        The model.
    chosen : sequence of Leaf
        The leaves, in the order of the vector.
    vector : array, shape (n,)
        Their new elements.

    Returns
    -------
    pytree
        Of the same structure.

    Examples
    --------
    >>> model = {"a": 1.0, "b": (2.0, 3.0)}
    >>> new = replace(model, find_leaves(model, "b"), jnp.array([5.0, 6.0]))
    >>> float(new["b"][1])
    6.0
    """
    values, structure = jax.tree_util.tree_flatten(tree)
    start = 0
    for leaf in chosen:
        # NumPy slices a vector that is not traced, so that nothing is compiled.
        values[leaf.index] = jnp.asarray(vector[start : start + leaf.size].reshape(leaf.shape))
        start += leaf.size
    return jax.tree_util.tree_unflatten(structure, values)
