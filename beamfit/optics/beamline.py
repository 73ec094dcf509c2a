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

# Most matrices in memory, elements times rows, if each row has its own energy.
MOST_AT_ONCE = 100_000
# Most numbers of a calibration by which the line is differentiated directly; a network has more.
MOST_DIRECT = 3


def _plain(value: Any) -> Any:
    """A value as nested lists of class names, texts and numbers, for its digest."""
    if is_dataclass(value):
        return [type(value).__name__, *(_plain(getattr(value, f.name)) for f in fields(value))]
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value if isinstance(value, str | bool) or value is None else np.asarray(value).tolist()


@shown
class Design(NamedTuple):
    """Twiss parameters a line was designed for.

    Attributes
    ----------
    at : str
        The element at whose exit they hold.
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
        What to call the line.
    mass : float
        Rest energy of the particle in MeV.
    energy_spread : float
        Relative momentum spread σ_δ, which widens the beam where there is dispersion.
    design : Design, optional
        The Twiss parameters the line was designed for, at one of its elements.
    supplies : tuple of (str, tuple of str)
        Names of supplies and of the magnets on each: a setting of a supply sets them all, each
        with its own length and calibration, and none of them has a setting of its own.

    Notes
    -----
    Magnets of one name are alike and in series: a setting of that name sets them all.

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
        """The line in a line."""
        magnets, screens = (", ".join(names[:6]) for names in (self.magnets, self.screens))
        said = f"{len(self)} elements, {brief(self.length)} m, {brief(self.energy)} MeV"
        return f"{self.name}: {said}; magnets {magnets or 'none'}; screens {screens or 'none'}"

    def tables(self) -> tuple[Table, ...]:
        """The first elements, to be shown."""
        few = self.elements[:MAX_ROWS_SHOWN]
        rows = [[e.name, type(e).__name__, brief(e.length), brief(e.setting)] for e in few]
        more = f"the first {len(few)} of {len(self)}" if len(few) < len(self) else ""
        return (Table(self.headline, ["element", "kind", "length m", "setting"], rows, more),)

    def __getitem__(self, name: str) -> Element:
        """The element of a name; of a supply the first magnet on it."""
        return self.elements[self._index(self.members(name)[0])]

    def __len__(self) -> int:
        return len(self.elements)

    def _index(self, name: str) -> int:
        if name not in self._first:
            known = [e.name for e in self.elements]
            raise InputError(f"no element '{name}' in line '{self.name}'", nearest(name, known))
        return self._first[name]

    @cached_property
    def _set_apart(self) -> frozenset[str]:
        """Magnets on supplies, which those who compute what a supply does may set one by one."""
        return frozenset(member for _, members in self.supplies for member in members)

    @cached_property
    def _first(self) -> dict[str, int]:
        """Index of the first element of each name."""
        return {e.name: i for i, e in reversed(tuple(enumerate(self.elements)))}

    @cached_property
    def magnets(self) -> tuple[str, ...]:
        """Names that have a setting: of elements, and of supplies in place of their magnets."""
        supply = {member: name for name, members in self.supplies for member in members}
        names = (e.name for e in self.elements if e.setting is not None)
        return tuple(dict.fromkeys(supply.get(name, name) for name in names))

    def members(self, name: str) -> tuple[str, ...]:
        """The magnets of this line on a supply; of any other name itself.

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
        """SHA-256 of elements and supplies, not of the energy: what a fitted beam belongs to."""
        said = repr([_plain(self.elements), list(self.supplies), float(self.mass)])
        return hashlib.sha256(said.encode()).hexdigest()

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
        self._index(element.name)  # says so if there is none
        return replace(
            self, elements=tuple(element if e.name == element.name else e for e in self.elements)
        )

    def held(self, energy: ArrayLike) -> Beamline:
        """Let another beam into the line, whose magnets stay as they are for the line's own.

        Bends, and strengths given as k1, belong to the energy of the line and follow no other;
        currents and gradients do so anyway. A line that is held already stays held.

        Parameters
        ----------
        energy : float
            Total energy in MeV of the beam that comes, the line's from here on.

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
        own = {"energy": self.energy, "mass": self.mass}
        return replace(self, elements=tuple(_held(e, own) for e in self.elements), energy=energy)

    def matrix(
        self,
        settings: Mapping[str, ArrayLike] | None = None,
        energy: ArrayLike | None = None,
    ) -> TransferMatrix:
        """Transfer matrix from the start of the line to its end.

        A JAX function of the settings, the energy and every number of the line: jit, vmap,
        and differentiate it at will.

        Parameters
        ----------
        settings : mapping of str to float, optional
            Magnet name to setting, in the unit of that magnet's calibration; a magnet not
            named keeps its own setting.
        energy : float, optional
            Total energy in MeV; the line's own if None.

        Returns
        -------
        TransferMatrix
            Both planes, ``x`` and ``y`` of shape (3, 3).

        Raises
        ------
        InputError
            If a setting names no magnet of the line, or is no single number.

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
            Element names; of elements that share a name, the last counts.
        settings, energy
            As in `matrix`.

        Returns
        -------
        dict of str to TransferMatrix
            One a place.

        Raises
        ------
        InputError
            If a setting names no magnet of the line or is no single number, or a place no element.

        Examples
        --------
        >>> from beamfit.optics.elements import Drift
        >>> line = Beamline((Drift("A", 1.0), Screen("S"), Drift("B", 2.0)), energy=100.0)
        >>> [float(r.x[0, 1]) for r in line.matrices(("S", "B")).values()]
        [1.0, 3.0]
        """
        settings = dict(settings or {})
        unknown = sorted(set(settings) - set(self.magnets) - self._set_apart)
        if unknown:
            raise InputError(
                f"a setting for '{unknown[0]}'", nearest(unknown[0], list(self.magnets))
            )
        for name, setting in settings.items():
            if jnp.ndim(setting):
                many = "one number; jax.vmap takes a function of it to many"
                raise InputError(f"{jnp.size(setting)} settings of '{name}' at once", many)
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
        """Multiply out everything between some elements, before anything is traced.

        Parameters
        ----------
        keep : iterable of str
            Names of the elements that stay: magnets that will be varied, places.
        energy : float, optional
            The only energy in MeV the line will be asked at. If None, elements that feel the
            energy are kept, stored by kind, and the line is right at every energy.

        Returns
        -------
        Beamline
            A line with the same matrices, of a few elements.

        Examples
        --------
        >>> from beamfit.optics.elements import Drift
        >>> line = Beamline((Drift("A", 1.0), Drift("B", 2.0), Screen("S")), energy=100.0)
        >>> [type(e).__name__ for e in line.condensed(("S",)).elements]
        ['LineSection', 'Screen']
        """

        def one(part: ElementSeries) -> LineSection | ElementSeries:
            if energy is None:
                return part.multiplied()
            return LineSection(part.matrix(None, energy).planes, part.length)

        return self._with_parts(keep, one)

    def stored_by_kind(self, keep: Iterable[str]) -> Beamline:
        """Return the line with everything between some elements stored by kind, as arrays.

        Its derivatives by all its numbers are then a few arrays, too.
        """
        return self._with_parts(keep, lambda part: part)

    def _with_parts(self, keep: Iterable[str], one: Callable) -> Beamline:
        """Elements of some names stay; ``one`` says what takes the place of a series between."""
        keep, parts = frozenset(m for name in keep for m in self.members(name)), []
        for kept, run in groupby(self.elements, lambda e: e.name in keep):
            parts.extend(run if kept else [one(s) for s in [in_series(run)] if s.kinds])
        return replace(self, elements=tuple(parts))


def _held(element: Any, own: Mapping[str, Any]) -> Any:
    """Tie an element to the energy and mass it is set for, unless it is tied already."""
    if isinstance(element, SectorDipole):
        return replace(element, **own) if element.energy is None else element
    calibration = getattr(element, "calibration", None)
    if not isinstance(calibration, FocusingStrength | IntegratedStrength):
        return element
    tied = calibration if calibration.energy is not None else replace(calibration, **own)
    return replace(element, calibration=tied)


def transfer_rows(
    line: Beamline, settings: Mapping[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    """Transfer matrices from the start to several places, for many settings.

    Parameters
    ----------
    line : Beamline
        The line, with the calibrations of the scan's columns. What no setting moves is
        multiplied out first; a line that is traced is taken as it is (see `seen_line`).
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
        line = seen_line(line, settings, energy, places)
    return _rows(line, dict(settings), energy, places)


def seen_line(
    line: Beamline, settings: Iterable[str], energy: ArrayLike, places: Iterable[str]
) -> Beamline:
    """A line as rows of these settings and energies see it: all else multiplied out."""
    own = () if isinstance(energy, jax.core.Tracer) else np.unique(energy)
    keep = frozenset((*settings, *places))
    # Kept beyond a trace that this may be called in: what is known is computed, never traced.
    with jax.ensure_compile_time_eval():
        return _condensed(Same(line), keep, float(own[0]) if len(own) == 1 else None)


class Same(NamedTuple):
    """A line that is itself and no other: scan after scan of it shares what it is made into."""

    line: Beamline

    def __hash__(self) -> int:
        return id(self.line)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.line is other.line


@lru_cache(maxsize=64)
def _condensed(same: Same, keep: frozenset[str], energy: float | None) -> Beamline:
    return same.line.condensed(keep, energy)


def _from_strengths(
    places: tuple[str, ...], strengths: dict[str, Array], line: Beamline, energy: Array
) -> Array:
    found = line.matrices(places, strengths, energy)
    return jnp.stack([jnp.asarray(found[p].planes) for p in places], axis=-3)


# A row has few strengths, the weights of a network are many: so the line is differentiated by
# strengths alone, and what those hang on is carried through one small product.
_by_strengths = jax.custom_jvp(_from_strengths, nondiff_argnums=(0,))


@partial(_by_strengths.defjvp, symbolic_zeros=True)
def _through_strengths(places, given, changes):
    strengths, *others = given
    found = _from_strengths(places, *given)
    slopes = jax.jacfwd(partial(_from_strengths, places))(*given)
    moved = [slopes[name] * d for name, d in changes[0].items() if not _still(d)]
    leaves, kind = jax.tree.flatten(others)
    rest = jax.tree.leaves(changes[1:], is_leaf=_still)
    moving = [i for i, d in enumerate(rest) if not _still(d)]

    def by_rest(values):
        every = dict(enumerate(leaves)) | dict(zip(moving, values, strict=True))
        return _from_strengths(places, strengths, *jax.tree.unflatten(kind, every.values()))

    if moving:
        at, along = ([part[i] for i in moving] for part in (leaves, rest))
        moved.append(jax.jvp(by_rest, (at,), (along,))[1])
    return found, sum(moved, jnp.zeros_like(found))


def _still(change: Any) -> bool:
    return isinstance(change, jax.custom_derivatives.SymbolicZero)


@partial(jax.jit, static_argnames="places")
def _rows(
    line: Beamline, settings: dict[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    bare, members = line, [(m, name) for name in settings for m in line.members(name)]
    weights = [np.size(v) for m, _ in members for v in jax.tree.leaves(line[m].calibration)]
    through = _by_strengths if sum(weights) > MOST_DIRECT * len(members) else _from_strengths
    for m, _ in members:
        bare = bare.with_element(replace(line[m], calibration=IntegratedStrength(), setting=0.0))

    def one(row: tuple[dict[str, Array], Array]) -> Array:
        setting, at = row
        at = energy if at is None else at
        strengths = {
            m: jnp.asarray(line[m].calibration.k1l(setting[name], line[m].length, at), float)
            for m, name in members
        }
        return through(places, strengths, bare, at)

    rows = (settings, None if jnp.ndim(energy) == 0 else energy)
    long = max((e.order.size for e in line.elements if isinstance(e, ElementSeries)), default=0)
    if jnp.size(energy) * long <= MOST_AT_ONCE:
        return TransferMatrix(jax.vmap(one)(rows))
    by_turns = jax.lax.map(jax.checkpoint(one), rows, batch_size=max(1, MOST_AT_ONCE // long))
    return TransferMatrix(by_turns)
