"""Parts of a line taken as one: elements of a kind are evaluated together, then multiplied.

So the cost of a line is that of its arrays: what is traced and compiled grows neither with the
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
    """A part of a line that is known as a whole: its transfer matrix and its length in m.

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
        One element a kind; its numbers are arrays, one entry for each element of the kind.
    order : Array
        Of each element, in the order of the beam: where it stands among those of all kinds,
        counted kind after kind.
    length : float
        Length of all of them, m.

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
        """Transfer matrix at an energy in MeV; numpy multiplies what JAX need not trace."""
        if not self.kinds:
            return IDENTITY
        planes = [_planes(k, energy) for k in self.kinds]
        traced = [isinstance(p, jax.Array) for p in planes]
        every, order = _multiplied(planes, traced, self.order)
        every += [p for p, t in zip(planes, traced, strict=True) if t]
        return TransferMatrix(_product(array_module(*every).concatenate(every)[order]))

    def multiplied(self) -> LineSection | ElementSeries:
        """Multiply out what does not depend on the energy: all of it, if nothing does.

        Examples
        --------
        >>> from beamfit.optics.elements import Drift
        >>> type(in_series((Drift("A", 1.0), Drift("B", 2.0))).multiplied()).__name__
        'LineSection'
        """
        # A kind that feels the energy is no number where the energy is none.
        planes = [_planes(k, np.nan) for k in self.kinds]
        feels = [bool(np.isnan(p).any()) for p in planes]
        if not any(feels):
            return LineSection(self.matrix().planes, self.length)
        products, order = _multiplied(planes, feels, self.order)
        kept = (k for k, f in zip(self.kinds, feels, strict=True) if f)
        return ElementSeries((*map(LineSection, products), *kept), order, self.length)


def in_series(
    elements: Iterable[Any], settings: Mapping[str, ArrayLike] | None = None
) -> ElementSeries:
    """Store elements by kind, magnets at the settings given by name or else at their own.

    Markers and screens, which are no more than places, are left out. Numbers that JAX traces
    stay apart from those it need not see.
    """
    settings, groups, length = settings or {}, {}, 0.0
    elements = [e for e in elements if not isinstance(e, Marker)]
    for i, element in enumerate(elements):
        length = length + element.length
        bare = replace(element, name="")
        if bare.setting is not None and element.name in settings:
            bare = replace(bare, setting=settings[element.name])
        leaves, kind = jax.tree.flatten(bare)
        traced = any(isinstance(v, jax.core.Tracer) for v in leaves)
        alone = None if all(np.ndim(v) == 0 for v in leaves) else i
        groups.setdefault((kind, traced, alone), []).append((i, bare, leaves))
    kinds = tuple(_stacked(*key, members) for key, members in groups.items())
    places = [i for members in groups.values() for i, _, _ in members]
    return ElementSeries(kinds, np.argsort(places), length)


def _stacked(kind: Any, traced: bool, alone: int | None, members: Sequence[Any]) -> Any:
    """One element whose numbers are arrays; one with arrays of its own stays as it is."""
    if alone is not None:
        return members[0][1]
    columns = zip(*(leaves for _, _, leaves in members), strict=True)
    xp = jax.numpy if traced else np
    return jax.tree.unflatten(kind, [xp.array(column, float) for column in columns])


def _planes(element: Any, energy: ArrayLike) -> Array:
    """Matrices of the elements of a kind, shape (elements, 2, 3, 3)."""
    return element.matrix(None, energy).planes.reshape(-1, 2, 3, 3)


def _multiplied(
    planes: Sequence[Array], apart: Sequence[bool], order: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Multiply out the runs of elements between those of the kinds that stay apart.

    Returns the products, and the order of products and elements apart, products counted first.
    """
    if all(apart):
        return [], order
    known = np.concatenate([p for p, a in zip(planes, apart, strict=True) if not a])
    stays = np.repeat(apart, [len(p) for p in planes])
    # Where an element stands among those of its sort, known or apart.
    place = (np.where(stays, np.cumsum(stays), np.cumsum(~stays)) - 1)[order]
    stays = stays[order]
    first = ~stays & np.append(True, stays[:-1])  # of each run
    runs = np.split(known[place[~stays]], np.flatnonzero(first[~stays])[1:])
    merged = np.where(stays, len(runs) + place, np.cumsum(first) - 1)
    return [np.stack([_product(run) for run in runs])], merged[stays | first]


def _product(planes: Array) -> Array:
    """Product of matrices, the first the beam meets first.

    JAX gets a loop, whose program does not grow; numpy multiplies pairs, then pairs of pairs.
    """
    if isinstance(planes, jax.Array):
        return jax.lax.scan(lambda total, part: (part @ total, None), planes[0], planes[1:])[0]
    while (count := len(planes)) > 1:
        even = count - count % 2
        pairs = planes[1:even:2] @ planes[0:even:2]
        planes = pairs if even == count else np.concatenate([pairs, planes[even:]])
    return planes[0]
