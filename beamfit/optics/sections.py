"""Parts of a line as one object: elements of a kind are evaluated together, then multiplied.

The cost of a line is that of a few arrays: what JAX traces and compiles grows neither with the
number of elements nor with their order.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import jax
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.arrays import array_module, value
from beamfit.optics.elements import IDENTITY, Marker, TransferMatrix


@value("name")
class LineSection:
    """A part of a line as a whole: its transfer matrix and its length in m.

    Examples
    --------
    >>> LineSection(IDENTITY.planes).matrix().x[0, 0].item()
    1.0
    """

    planes: ArrayLike
    length: ArrayLike = 0.0
    name: str = ""
    setting: ClassVar[None] = None

    def matrix(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> TransferMatrix:
        """Return the matrix; neither a setting nor the energy enters."""
        return TransferMatrix(self.planes)


@value("name")
class ElementSeries:
    """Elements in series, stored by kind.

    Parameters
    ----------
    kinds : tuple of Element
        One element per kind; its numbers are arrays with one entry for each element of the kind.
    order : Array
        For each element, in the order of the beam: its index among all elements counted kind after
        kind.
    length : float
        Total length, m.

    Examples
    --------
    >>> from beamfit.optics.elements import Drift
    >>> pair = in_series((Drift("A", 1.0), Drift("B", 2.0)))
    >>> pair.kinds[0].length.tolist(), pair.matrix().x[0, 1].item()
    ([1.0, 2.0], 3.0)
    """

    kinds: tuple[Any, ...]
    order: ArrayLike
    length: ArrayLike = 0.0
    name: str = ""
    setting: ClassVar[None] = None

    def matrix(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> TransferMatrix:
        """Transfer matrix at an energy in MeV; NumPy multiplies the parts JAX does not trace."""
        if not self.kinds:
            return IDENTITY
        planes = [_planes(k, energy) for k in self.kinds]
        traced = [isinstance(p, jax.Array) for p in planes]
        matrices, order = _multiply_runs(planes, traced, self.order)
        matrices += [p for p, t in zip(planes, traced, strict=True) if t]
        return TransferMatrix(_product(array_module(*matrices).concatenate(matrices)[order]))

    def multiplied(self) -> LineSection | ElementSeries:
        """Multiply the parts that do not depend on the energy; all of it if nothing does.

        Examples
        --------
        >>> from beamfit.optics.elements import Drift
        >>> type(in_series((Drift("A", 1.0), Drift("B", 2.0))).multiplied()).__name__
        'LineSection'
        """
        # At energy NaN, matrices that depend on the energy are NaN.
        planes = [_planes(k, np.nan) for k in self.kinds]
        depends = [bool(np.isnan(p).any()) for p in planes]
        if not any(depends):
            return LineSection(self.matrix().planes, self.length)
        products, order = _multiply_runs(planes, depends, self.order)
        remaining = (k for k, f in zip(self.kinds, depends, strict=True) if f)
        return ElementSeries((*map(LineSection, products), *remaining), order, self.length)


def in_series(
    elements: Iterable[Any], settings: Mapping[str, ArrayLike] | None = None
) -> ElementSeries:
    """Store elements by kind, with the given settings of magnets or else their own.

    Markers and screens are left out. Elements with numbers traced by JAX form kinds of their own.
    """
    settings, groups, length = settings or {}, {}, 0.0
    elements = [e for e in elements if not isinstance(e, Marker)]
    for i, element in enumerate(elements):
        length = length + element.length
        unnamed = replace(element, name="")
        if unnamed.setting is not None and element.name in settings:
            unnamed = replace(unnamed, setting=settings[element.name])
        leaves, structure = jax.tree.flatten(unnamed)
        traced = any(isinstance(v, jax.core.Tracer) for v in leaves)
        own_arrays = None if all(np.ndim(v) == 0 for v in leaves) else i
        groups.setdefault((structure, traced, own_arrays), []).append((i, unnamed, leaves))
    kinds = tuple(_stack_elements(*key, members) for key, members in groups.items())
    places = [i for members in groups.values() for i, _, _ in members]
    return ElementSeries(kinds, np.argsort(places), length)


def _stack_elements(
    structure: Any, traced: bool, own_arrays: int | None, members: Sequence[Any]
) -> Any:
    """Combine elements of a kind to one with arrays; one with arrays of its own stays as it is."""
    if own_arrays is not None:
        return members[0][1]
    columns = zip(*(leaves for _, _, leaves in members), strict=True)
    xp = jax.numpy if traced else np
    return jax.tree.unflatten(structure, [xp.array(column, float) for column in columns])


def _planes(element: Any, energy: ArrayLike) -> Array:
    """Matrices of the elements of a kind, shape (elements, 2, 3, 3)."""
    return element.matrix(None, energy).planes.reshape(-1, 2, 3, 3)


def _multiply_runs(
    planes: Sequence[Array], separate: Sequence[bool], order: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Multiply the runs of elements between those of the separate kinds.

    Returns the products, and the order of products and separate elements, products counted first.
    """
    if all(separate):
        return [], order
    matrices = np.concatenate([p for p, a in zip(planes, separate, strict=True) if not a])
    is_separate = np.repeat(separate, [len(p) for p in planes])
    # Index of each element among the separate or the other ones.
    position = (np.where(is_separate, np.cumsum(is_separate), np.cumsum(~is_separate)) - 1)[order]
    is_separate = is_separate[order]
    starts = ~is_separate & np.append(True, is_separate[:-1])  # of each run
    runs = np.split(matrices[position[~is_separate]], np.flatnonzero(starts[~is_separate])[1:])
    merged = np.where(is_separate, len(runs) + position, np.cumsum(starts) - 1)
    return [np.stack([_product(run) for run in runs])], merged[is_separate | starts]


def _product(planes: Array) -> Array:
    """Product of matrices, with the beam passing the first one first.

    JAX uses a loop, whose program size is constant; NumPy multiplies pairs, then pairs of pairs.
    """
    if isinstance(planes, jax.Array):
        return jax.lax.scan(lambda total, part: (part @ total, None), planes[0], planes[1:])[0]
    while (count := len(planes)) > 1:
        even = count - count % 2
        pairs = planes[1:even:2] @ planes[0:even:2]
        planes = pairs if even == count else np.concatenate([pairs, planes[even:]])
    return planes[0]
