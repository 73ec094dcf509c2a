"""A sequence of elements and its transfer matrices as functions of the settings, one or many."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.answer import MAX_ROWS_SHOWN, Table, brief, shown
from beamfit.arrays import value
from beamfit.errors import InputError, nearest
from beamfit.optics.calibration import FocusingStrength, IntegratedStrength
from beamfit.optics.elements import IDENTITY, Element, Screen, SectorDipole, TransferMatrix
from beamfit.optics.sections import ElementSeries, LineSection, in_series
from beamfit.particles import ELECTRON_MASS

# Largest number of matrices in memory, elements times rows, if each row has its own energy.
MAX_MATRICES = 100_000
# Largest mean number of parameters in a calibration for direct differentiation; a network has more.
MAX_DIRECT_NUMBERS = 3


def _digest_parts(value: Any) -> Any:
    """Convert a value to nested lists of class names, texts and numbers, for its digest."""
    if is_dataclass(value):
        return [
            type(value).__name__,
            *(_digest_parts(getattr(value, f.name)) for f in fields(value)),
        ]
    if isinstance(value, tuple | list):
        return [_digest_parts(v) for v in value]
    return value if isinstance(value, str | bool) or value is None else np.asarray(value).tolist()


@shown
class Design(NamedTuple):
    """Design Twiss parameters of a line.

    Attributes
    ----------
    at : str
        Element at whose exit they apply.
    x, y : tuple of float, optional
        (β in m, α) of each plane.
    """

    at: str
    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None


@value("name", "mass", "design", "supplies")
class Beamline:
    """Elements in the order the beam meets them.

    Parameters
    ----------
    elements : tuple of Element
        The elements; names are unique among magnets and screens.
    energy : float
        Total energy in MeV.
    name : str
        Name of the line.
    mass : float
        Rest energy of the particle in MeV.
    energy_spread : float
        Relative momentum spread σ_δ, which widens the beam where there is dispersion.
    design : Design, optional
        Design Twiss parameters, at one of the elements.
    supplies : tuple of (str, tuple of str)
        Names of supplies and of the magnets on each. A setting of a supply sets all its magnets,
        each with its own length and calibration; these have no settings of their own.

    Notes
    -----
    Magnets with one name are equal and in series: a setting of that name sets them all.

    Examples
    --------
    >>> from beamfit.optics.elements import Drift, Quadrupole
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), energy=135.0)
    >>> round(float(line.matrix({"Q": 4.0}).x[0, 1]), 4)
    2.0595
    """

    elements: tuple[Element | LineSection | ElementSeries, ...]
    energy: ArrayLike
    name: str = "line"
    mass: float = ELECTRON_MASS
    energy_spread: ArrayLike = 0.0
    design: Design | None = None
    supplies: tuple[tuple[str, tuple[str, ...]], ...] = ()

    @property
    def headline(self) -> str:
        """The line in one line of text."""
        magnets, screens = (", ".join(names[:6]) for names in (self.magnets, self.screens))
        summary = f"{len(self)} elements, {brief(self.length)} m, {brief(self.energy)} MeV"
        return f"{self.name}: {summary}; magnets {magnets or 'none'}; screens {screens or 'none'}"

    def tables(self) -> tuple[Table, ...]:
        """Table of the first elements."""
        first_elements = self.elements[:MAX_ROWS_SHOWN]
        rows = [
            [e.name, type(e).__name__, brief(e.length), brief(e.setting)] for e in first_elements
        ]
        note = (
            f"the first {len(first_elements)} of {len(self)}"
            if len(first_elements) < len(self)
            else ""
        )
        return (Table(self.headline, ["element", "kind", "length m", "setting"], rows, note),)

    def __getitem__(self, name: str) -> Element:
        """Element of a name; for a supply, its first magnet."""
        return self.elements[self._index(self.members(name)[0])]

    def __len__(self) -> int:
        return len(self.elements)

    def _index(self, name: str) -> int:
        """Index of the first element of a name; raises an error for an unknown one."""
        if name not in self._first:
            known = [e.name for e in self.elements]
            raise InputError(f"no element '{name}' in line '{self.name}'", nearest(name, known))
        return self._first[name]

    @cached_property
    def _supply_members(self) -> frozenset[str]:
        """Magnets on supplies; functions that act for a supply may set them one by one."""
        return frozenset(member for _, members in self.supplies for member in members)

    @cached_property
    def _first(self) -> dict[str, int]:
        """Index of the first element of each name."""
        return {e.name: i for i, e in reversed(tuple(enumerate(self.elements)))}

    @cached_property
    def magnets(self) -> tuple[str, ...]:
        """Names with a setting: elements, and supplies in place of their magnets."""
        supply = {member: name for name, members in self.supplies for member in members}
        names = (e.name for e in self.elements if e.setting is not None)
        return tuple(dict.fromkeys(supply.get(name, name) for name in names))

    def members(self, name: str) -> tuple[str, ...]:
        """Magnets of this line on a supply; for any other name, that name.

        Examples
        --------
        >>> from beamfit.optics.elements import Quadrupole
        >>> pair = (Quadrupole("QF", 0.1), Quadrupole("QD", 0.1))
        >>> line = Beamline(pair, 100.0, supplies=(("QS", ("QF", "QD")),))
        >>> line.members("QS"), line.members("QF"), line.magnets
        (('QF', 'QD'), ('QF',), ('QS',))
        """
        found = dict(self.supplies).get(name, (name,))
        return tuple(member for member in found if member in self._first) or (name,)

    @property
    def screens(self) -> tuple[str, ...]:
        """Names of the screens."""
        return tuple(e.name for e in self.elements if isinstance(e, Screen))

    @property
    def length(self) -> ArrayLike:
        """Length along the reference orbit, m."""
        return sum(e.length for e in self.elements)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of elements, supplies and particle, but not energy: identifies a beam's line."""
        content = repr([_digest_parts(self.elements), list(self.supplies), float(self.mass)])
        return hashlib.sha256(content.encode()).hexdigest()

    def between(self, first: str, last: str) -> Beamline:
        """Cut out the line from the exit of ``first`` to the exit of ``last``.

        Parameters
        ----------
        first, last : str
            Element names, ``first`` upstream of ``last``.

        Returns
        -------
        Beamline
            The part, so that ``line.between(a, c)`` is ``a..b`` followed by ``b..c``.

        Raises
        ------
        InputError
            If a name is unknown or the order is reversed.

        Examples
        --------
        >>> from beamfit.optics.elements import Marker
        >>> line = Beamline((Marker("A"), Marker("B"), Marker("C")), energy=100.0)
        >>> [e.name for e in line.between("A", "C").elements]
        ['B', 'C']
        """
        i, j = self._index(first), self._index(last)
        if i > j:
            raise InputError(f"'{first}' lies downstream of '{last}'", "the upstream name first")
        return replace(self, elements=self.elements[i + 1 : j + 1])

    def upto(self, last: str) -> Beamline:
        """Cut the line after ``last``; the part keeps the start.

        Examples
        --------
        >>> from beamfit.optics.elements import Marker
        >>> line = Beamline((Marker("A"), Marker("B"), Marker("C")), energy=100.0)
        >>> [e.name for e in line.upto("B").elements]
        ['A', 'B']
        """
        return replace(self, elements=self.elements[: self._index(last) + 1])

    def with_element(self, element: Element) -> Beamline:
        """Return the line with every element of the same name replaced.

        Examples
        --------
        >>> line = Beamline((Screen("S"),), energy=100.0)
        >>> line.with_element(Screen("S", resolution=1e-5))["S"].resolution
        1e-05
        """
        self._index(element.name)  # raises an error if there is none
        return replace(
            self, elements=tuple(element if e.name == element.name else e for e in self.elements)
        )

    def held(self, energy: ArrayLike) -> Beamline:
        """Keep the magnets set for the line's own energy, for a beam of another energy.

        Bends, and strengths given as k1, otherwise scale with the energy of the beam; currents and
        gradients are fixed in any case. A line that is held already stays as it is.

        Parameters
        ----------
        energy : float
            Total energy in MeV of the beam, which becomes the line's.

        Returns
        -------
        Beamline

        Examples
        --------
        >>> from beamfit.optics.elements import Quadrupole
        >>> line = Beamline((Quadrupole("Q", 0.1, 4.0), Screen("S")), energy=100.0)
        >>> round(float(line.held(101.0)["Q"].k1(energy=101.0)), 4)
        3.9604
        """
        set_for = {"energy": self.energy, "mass": self.mass}
        return replace(
            self, elements=tuple(_tie_to_energy(e, set_for) for e in self.elements), energy=energy
        )

    def matrix(
        self,
        settings: Mapping[str, ArrayLike] | None = None,
        energy: ArrayLike | None = None,
    ) -> TransferMatrix:
        """Transfer matrix from the start of the line to its end.

        It is a JAX function of the settings, the energy and all numbers of the line, for jit, vmap
        and differentiation.

        Parameters
        ----------
        settings : mapping of str to float, optional
            Magnet name to setting, in the unit of that magnet's calibration; other magnets keep
            their own setting.
        energy : float, optional
            Total energy in MeV; the line's own if None.

        Returns
        -------
        TransferMatrix
            Both planes, ``x`` and ``y`` of shape (3, 3).

        Raises
        ------
        InputError
            If a setting names no magnet of the line, or is not a single number.

        Notes
        -----
        R = R_n … R_2 R_1, report eqs 30-31.
        """
        last = self.elements[-1].name if self.elements else None
        return self.matrices((last,), settings, energy)[last] if last else IDENTITY

    def matrices(
        self,
        places: tuple[str, ...],
        settings: Mapping[str, ArrayLike] | None = None,
        energy: ArrayLike | None = None,
    ) -> dict[str, TransferMatrix]:
        """Transfer matrices from the start to the exits of several elements, in one pass.

        Parameters
        ----------
        places : tuple of str
            Element names; for elements that share a name, the last one.
        settings, energy
            As in `matrix`.

        Returns
        -------
        dict of str to TransferMatrix
            One per place.

        Raises
        ------
        InputError
            If a setting names no magnet of the line or is not a single number, or a place no
            element.

        Examples
        --------
        >>> from beamfit.optics.elements import Drift
        >>> line = Beamline((Drift("A", 1.0), Screen("S"), Drift("B", 2.0)), energy=100.0)
        >>> [float(r.x[0, 1]) for r in line.matrices(("S", "B")).values()]
        [1.0, 3.0]
        """
        settings = dict(settings or {})
        unknown = sorted(set(settings) - set(self.magnets) - self._supply_members)
        if unknown:
            raise InputError(
                f"a setting for '{unknown[0]}'", nearest(unknown[0], list(self.magnets))
            )
        for name, setting in settings.items():
            if jnp.ndim(setting):
                expected = "one number; jax.vmap takes a function of it to many"
                raise InputError(f"{jnp.size(setting)} settings of '{name}' at once", expected)
        settings = {member: v for name, v in settings.items() for member in self.members(name)}
        for place in places:
            self._index(place)
        energy = self.energy if energy is None else energy
        total, found, start = IDENTITY, {}, 0
        for i, element in enumerate(self.elements, start=1):
            if element.name in places:
                part = in_series(self.elements[start:i], settings).matrix(None, energy)
                total = part if total is IDENTITY else part @ total
                found[element.name], start = total, i
        return {place: found[place] for place in places}

    def condensed(self, keep: Iterable[str], energy: ArrayLike | None = None) -> Beamline:
        """Multiply the matrices between some elements, before JAX traces the line.

        Parameters
        ----------
        keep : iterable of str
            Names of the elements to keep: magnets that will vary, and places.
        energy : float, optional
            The only energy in MeV at which the line will be used. If None, elements that depend on
            the energy are kept, stored by kind, and the line is valid at every energy.

        Returns
        -------
        Beamline
            A line of a few elements with the same matrices.

        Examples
        --------
        >>> from beamfit.optics.elements import Drift
        >>> line = Beamline((Drift("A", 1.0), Drift("B", 2.0), Screen("S")), energy=100.0)
        >>> [type(e).__name__ for e in line.condensed(("S",)).elements]
        ['LineSection', 'Screen']
        """

        def combine(part: ElementSeries) -> LineSection | ElementSeries:
            if energy is None:
                return part.multiplied()
            return LineSection(part.matrix(None, energy).planes, part.length)

        return self._with_parts(keep, combine)

    def stored_by_kind(self, keep: Iterable[str]) -> Beamline:
        """Store everything between some elements by kind, as arrays.

        The derivatives with respect to all numbers of the line are then a few arrays as well.
        """
        return self._with_parts(keep, lambda part: part)

    def _with_parts(self, keep: Iterable[str], combine: Callable) -> Beamline:
        """Keep elements of some names, and replace each series between them by its combination."""
        keep, parts = frozenset(m for name in keep for m in self.members(name)), []
        for stays, run in groupby(self.elements, lambda e: e.name in keep):
            parts.extend(run if stays else [combine(s) for s in [in_series(run)] if s.kinds])
        return replace(self, elements=tuple(parts))


def _tie_to_energy(element: Any, set_for: Mapping[str, Any]) -> Any:
    """Fix the energy and mass for which an element is set, unless they are fixed already."""
    if isinstance(element, SectorDipole):
        return replace(element, **set_for) if element.energy is None else element
    calibration = getattr(element, "calibration", None)
    if not isinstance(calibration, FocusingStrength | IntegratedStrength):
        return element
    held_calibration = (
        calibration if calibration.energy is not None else replace(calibration, **set_for)
    )
    return replace(element, calibration=held_calibration)


def transfer_rows(
    line: Beamline, settings: Mapping[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    """Transfer matrices from the start to several places, for many settings.

    Parameters
    ----------
    line : Beamline
        The line, with the calibrations of the scan's columns. Constant parts are multiplied first,
        except in a line that JAX traces (see `reduced_line`).
    settings : mapping of str to Array
        Magnet name to settings, shape (n,).
    energy : Array
        MeV, shape (n,), or one number.
    places : tuple of str
        Element names.

    Returns
    -------
    TransferMatrix
        ``planes`` of shape (n, 2, places, 3, 3).
    """
    if not any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(line)):
        line = reduced_line(line, settings, energy, places)
    return _rows(line, dict(settings), energy, places)


def reduced_line(
    line: Beamline, settings: Iterable[str], energy: ArrayLike, places: Iterable[str]
) -> Beamline:
    """Reduce a line for rows of given settings and energies: constant parts are multiplied."""
    energies = () if isinstance(energy, jax.core.Tracer) else np.unique(energy)
    keep = frozenset((*settings, *places))
    # The result is cached beyond the current JAX trace, so that it must not contain tracers.
    with jax.ensure_compile_time_eval():
        return _condensed(
            LineIdentity(line), keep, float(energies[0]) if len(energies) == 1 else None
        )


class LineIdentity(NamedTuple):
    """A line compared by identity, as the key of a cache: scans of one line share its reduction."""

    line: Beamline

    def __hash__(self) -> int:
        return id(self.line)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LineIdentity) and self.line is other.line


@lru_cache(maxsize=64)
def _condensed(identity: LineIdentity, keep: frozenset[str], energy: float | None) -> Beamline:
    """Reduced line, cached by the identity of the line."""
    return identity.line.condensed(keep, energy)


def _from_strengths(
    places: tuple[str, ...], strengths: dict[str, Array], line: Beamline, energy: Array
) -> Array:
    """Matrices of a line at places, shape (2, places, 3, 3), for given integrated strengths."""
    found = line.matrices(places, strengths, energy)
    return jnp.stack([jnp.asarray(found[p].planes) for p in places], axis=-3)


# A row has few strengths, a network has many weights. The line is therefore differentiated with
# respect to the strengths only, and their derivatives are multiplied in.
_by_strengths = jax.custom_jvp(_from_strengths, nondiff_argnums=(0,))


@partial(_by_strengths.defjvp, symbolic_zeros=True)
def _strengths_derivative(places, primals, tangents):
    """Derivative of `_from_strengths`, forward in the strengths and in whatever else varies."""
    strengths, *others = primals
    found = _from_strengths(places, *primals)
    slopes = jax.jacfwd(partial(_from_strengths, places))(*primals)
    contributions = [slopes[name] * d for name, d in tangents[0].items() if not _is_zero(d)]
    leaves, structure = jax.tree.flatten(others)
    other_tangents = jax.tree.leaves(tangents[1:], is_leaf=_is_zero)
    varying = [i for i, d in enumerate(other_tangents) if not _is_zero(d)]

    def of_others(values):
        all_leaves = dict(enumerate(leaves)) | dict(zip(varying, values, strict=True))
        return _from_strengths(
            places, strengths, *jax.tree.unflatten(structure, all_leaves.values())
        )

    if varying:
        values, directions = ([part[i] for i in varying] for part in (leaves, other_tangents))
        contributions.append(jax.jvp(of_others, (values,), (directions,))[1])
    return found, sum(contributions, jnp.zeros_like(found))


def _is_zero(change: Any) -> bool:
    """Test whether a tangent is known to be zero."""
    return isinstance(change, jax.custom_derivatives.SymbolicZero)


@partial(jax.jit, static_argnames="places")
def _rows(
    line: Beamline, settings: dict[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    """Matrices of all rows at once, or in batches if they are too many for memory."""
    bare_line, members = line, [(m, name) for name in settings for m in line.members(name)]
    sizes = [np.size(v) for m, _ in members for v in jax.tree.leaves(line[m].calibration)]
    strengths_to_matrices = (
        _by_strengths if sum(sizes) > MAX_DIRECT_NUMBERS * len(members) else _from_strengths
    )
    for m, _ in members:
        bare_line = bare_line.with_element(
            replace(line[m], calibration=IntegratedStrength(), setting=0.0)
        )

    def of_row(row: tuple[dict[str, Array], Array]) -> Array:
        setting, row_energy = row
        row_energy = energy if row_energy is None else row_energy
        strengths = {
            m: jnp.asarray(
                line[m].calibration.k1l(setting[name], line[m].length, row_energy), float
            )
            for m, name in members
        }
        return strengths_to_matrices(places, strengths, bare_line, row_energy)

    rows = (settings, None if jnp.ndim(energy) == 0 else energy)
    longest = max((e.order.size for e in line.elements if isinstance(e, ElementSeries)), default=0)
    if jnp.size(energy) * longest <= MAX_MATRICES:
        return TransferMatrix(jax.vmap(of_row)(rows))
    in_batches = jax.lax.map(
        jax.checkpoint(of_row), rows, batch_size=max(1, MAX_MATRICES // longest)
    )
    return TransferMatrix(in_batches)
