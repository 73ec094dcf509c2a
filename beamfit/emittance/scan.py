"""A quadrupole scan: settings, sizes and errors in SI, checked once.

Plain NumPy, so that a bad file is reported before JAX is loaded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.answer import MAX_ROWS_SHOWN, Table, frame_of, shown
from beamfit.errors import InputError, expect, nearest
from beamfit.particles import ENERGY_KEYS, total_energy

if TYPE_CHECKING:
    from pandas import DataFrame


PLANES = ("x", "y")
# Units of settings: current, integrated gradient, gradient, focusing strength, 1/focal length.
SETTINGS = ("A", "kG", "T_per_m", "k1", "k1l")
# Unit of a setting that is not a magnet of the line: a knob to tune the machine.
KNOB = "knob"
# Slice name of rows that measure the whole beam.
PROJECTED = "projected"
# Rms sizes in m: beyond the first range an error, beyond the second a warning on the unit.
POSSIBLE, USUAL = (1e-8, 0.3), (1e-6, 2e-2)
# Fields with a value for each row.
ROW_COLUMNS = ("settings", "size", "error", "energy", "screen", "resolution", "energy_spread")
ROW_COLUMNS += ("shots", "shot_size", "slice", "transfer")


@shown
class PlaneRows(NamedTuple):
    """Rows of a `QuadScan` in which one plane was measured, each of shape (n,).

    ``error``, ``energy``, ``screen``, ``resolution`` and ``energy_spread`` are None if the scan has
    none.
    """

    settings: dict[str, np.ndarray]
    size: np.ndarray
    error: np.ndarray | None
    energy: np.ndarray | None
    screen: tuple[str, ...] | None
    resolution: np.ndarray | None
    energy_spread: np.ndarray | None


class Profile(NamedTuple):
    """A projection of the beam from which a size was taken, for display.

    ``row`` is the row of the scan. Position (m), counts and the fitted curve, if there is one, have
    shape (n,).
    """

    plane: str
    row: int
    position: np.ndarray
    counts: np.ndarray
    curve: np.ndarray | None


def middle(values: np.ndarray) -> float:
    """Median of some numbers without NaN; fast for a few.

    Examples
    --------
    >>> middle(np.array([4.0, np.nan, 1.0, 2.0])), middle(np.array([3.0, 1.0]))
    (2.0, 2.0)
    """
    ordered = np.sort(values[~np.isnan(values)])
    return float(0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]))


def first_unusable(values: np.ndarray, *, blank: bool = False) -> tuple[int, str] | None:
    """Find the first value that is not a positive finite number.

    Parameters
    ----------
    values : ndarray
        Sizes, errors or energies.
    blank : bool
        Whether NaN stands for an empty cell and is skipped.

    Returns
    -------
    tuple of int and str, or None
        Index of the value, and its description; None if all are usable.

    Examples
    --------
    >>> first_unusable(np.array([1.0, -2.0]))
    (1, 'the value -2')
    """
    wrong = ~(np.isfinite(values) & (values > 0))
    if blank:
        wrong &= ~np.isnan(values)
    if not wrong.any():
        return None
    index = int(np.argmax(wrong))
    return index, f"the value {values[index]:g}"


@shown
@dataclass(frozen=True, eq=False)
class QuadScan:
    """Beam sizes against magnet settings or at several screens, in one or both planes.

    Rows that repeat a setting are its shots if they follow one another or have no errors of their
    own: a fit combines them to one row with ``shot_size``, as `beamfit.read_quad_scan` does.

    Parameters
    ----------
    settings : mapping of str to array
        Magnet name to settings, each of shape (n,), in the unit given by ``units``; empty if
        nothing was scanned.
    units : mapping of str to str
        Magnet name to ``"A"``, ``"kG"`` (integrated gradient), ``"T_per_m"`` (gradient), ``"k1"``
        (1/m²) or ``"k1l"`` (1/m).
    size : mapping of str to array
        Plane ("x", "y") to rms sizes in m, shape (n,); NaN if a row has none.
    error : mapping of str to array, optional
        Plane to standard errors in m. For a plane without them the fit infers the errors.
    energy : array or float, optional
        Energy of each row in MeV, or of all; the lattice's if None.
    energy_kind : {"total", "kinetic", "momentum"}
        Kind of that energy; a momentum is p c.
    screen : sequence of str, optional
        Screen of each row; the lattice's only one if None.
    resolution, energy_spread : array or float, optional
        Point-spread rms in m and relative momentum spread of each row, or of all.
    shots : array or int, optional
        Number of shots averaged in each row.
    shot_size : mapping of str to array, optional
        Plane to the sizes of single shots in m, shape (n, m), NaN if a row has fewer than m. The
        fit uses these instead of means and errors, each with a probability of showing no beam.
    slice : sequence of str, optional
        Slice of the beam measured in each row, "projected" (or blank) for the whole beam: see
        `of_slice`. Magnets then stay as they are for the line's energy, whatever a row's energy.
    transfer : mapping of str to array, optional
        Plane to R11, R12 (m) and, with dispersion, R16 (m) of each row, shape (n, 2) or (n, 3): the
        rows' own matrices, which need no lattice. Settings then only label the rows.
    profiles : tuple of Profile
        Profiles from which the sizes were taken, for display.
    error_source : str
        Source of the errors, in words, for the report.
    name, path, sha256 : str
        Name of the scan, and its file.
    provenance : tuple of str
        Comment lines of the file.
    notes : tuple of str
        Changes made to the numbers of the file, in words.
    columns : mapping of str to str
        Name of each column in the file, for error messages.

    Raises
    ------
    InputError
        If sizes, errors or energies are not positive numbers, shapes differ, or fewer than
        three distinct settings remain in a plane.

    Examples
    --------
    >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "A"}, {"x": [2e-4, 1e-4, 3e-4]})
    >>> scan.planes, len(scan)
    (('x',), 3)
    """

    settings: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    size: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray] = field(default_factory=dict)
    energy: np.ndarray | None = None
    energy_kind: str = "total"
    screen: tuple[str, ...] | None = None
    resolution: np.ndarray | None = None
    energy_spread: np.ndarray | None = None
    shots: np.ndarray | None = None
    shot_size: Mapping[str, np.ndarray] = field(default_factory=dict)
    slice: tuple[str, ...] | None = None
    transfer: Mapping[str, np.ndarray] | None = None
    profiles: tuple[Profile, ...] = ()
    error_source: str = "given"
    name: str = "scan"
    path: str | PathLike[str] | None = None
    sha256: str | None = None
    provenance: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key in ("settings", "size", "error"):
            expect(
                getattr(self, key), Mapping, f'{{"{"Q1" if key == "settings" else "x"}": values}}'
            )
            arrays = {k: self._numbers(v, k) for k, v in getattr(self, key).items()}
            object.__setattr__(self, key, arrays)
        shots = {k: np.asarray(v, float) for k, v in self.shot_size.items()}
        object.__setattr__(self, "shot_size", shots)
        for key in ("screen", "slice"):
            if isinstance(getattr(self, key), str):
                raise self.unusable(f"{key} = '{getattr(self, key)}'", "a name for each row", key)
        if self.slice is not None:
            names = tuple(str(name).strip() or PROJECTED for name in self.slice)
            object.__setattr__(self, "slice", names)
        if self.transfer is not None:
            object.__setattr__(self, "transfer", self._whole_transfer(self.transfer))
        self._check_shapes()
        self._check_units()
        for key in ("energy", "resolution", "energy_spread", "shots"):
            if getattr(self, key) is not None:
                object.__setattr__(self, key, self._column(key))
        self._check_values()
        for plane in self.planes:
            self._check_three_settings(plane)

    def __len__(self) -> int:
        return len(next(iter(self.size.values())))

    @property
    def planes(self) -> tuple[str, ...]:
        """The planes that were measured."""
        return tuple(p for p in PLANES if p in self.size)

    @property
    def slices(self) -> tuple[str, ...]:
        """Slices of the beam in the order of the rows, the projected beam last."""
        names = dict.fromkeys(self.slice or ())
        return tuple(sorted(names, key=PROJECTED.__eq__))

    @property
    def headline(self) -> str:
        """The scan in one line."""
        scanned = ", ".join(f"{name} ({self.units[name]})" for name in self.settings)
        screens = f", {len(set(self.screen))} screens" if self.screen else ""
        errors = "errors given" if self.error else "no errors"
        rows_text = f"{len(self)} rows of {scanned or 'no magnet'}{screens}"
        return f"{self.name}: {rows_text}, planes {', '.join(self.planes)}, {errors}"

    def tables(self) -> tuple[Table, ...]:
        """Table of the first rows."""
        columns = {f"{n} {self.units[n]}": v for n, v in self.settings.items()}
        for p in self.planes:
            columns[f"size {p} µm"] = 1e6 * self.size[p]
            columns |= {f"error {p} µm": 1e6 * self.error[p]} if p in self.error else {}
        first_rows = range(min(len(self), MAX_ROWS_SHOWN))
        rows = [[f"{values[i]:.5g}" for values in columns.values()] for i in first_rows]
        note = (
            f"the first {len(first_rows)} of {len(self)} rows"
            if len(first_rows) < len(self)
            else ""
        )
        return (Table(self.headline, list(columns), rows, note, numeric=True),)

    def to_frame(self) -> DataFrame:
        """Give a pandas data frame with columns named as in a file, for `read_quad_scan`.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        energy_names = {kind: key for key, kind in ENERGY_KEYS.items()}
        columns = {f"{name}_{self.units[name]}": v for name, v in self.settings.items()}
        columns |= {f"size_{p}_m": v for p, v in self.size.items()}
        columns |= {f"size_{p}_error_m": v for p, v in self.error.items()}
        for p, r in (self.transfer or {}).items():
            columns |= {f"{name}_{p}": r[:, i] for i, name in enumerate(("r11", "r12", "r16"))}
        optional = {energy_names[self.energy_kind]: self.energy, "screen": self.screen}
        optional |= {"resolution_m": self.resolution, "energy_spread": self.energy_spread}
        optional |= {"shots": self.shots, "slice": self.slice}
        return frame_of(columns | {k: v for k, v in optional.items() if v is not None})

    def rows(self, plane: str) -> PlaneRows:
        """Select the rows in which one plane was measured.

        Raises
        ------
        InputError
            If the scan has no sizes of that plane.
        """
        if plane not in self.size:
            raise self.unusable(f"no sizes in plane {plane}", f"a column size_{plane}_um")
        part = self.columns_at(np.flatnonzero(~np.isnan(self.size[plane])))
        plane_columns = {"size": part["size"][plane], "error": part["error"].get(plane)}
        return PlaneRows(**{name: (part | plane_columns)[name] for name in PlaneRows._fields})

    def columns_at(self, rows: Sequence[int]) -> dict[str, Any]:
        """Select rows, as arguments of `QuadScan` by name."""
        return {name: at_rows(getattr(self, name), rows) for name in ROW_COLUMNS}

    def of_slice(self, name: str) -> QuadScan:
        """Select the rows of one slice of the beam, in the planes in which it was measured.

        Raises
        ------
        InputError
            If there is no slice of that name; the error offers the nearest.

        Examples
        --------
        >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0] * 2}, {"Q": "A"},
        ...                 {"x": [2e-4, 1e-4, 3e-4, 3e-4, 2e-4, 4e-4]}, slice=[*"aaa", *3 * [""]])
        >>> scan.slices, scan.of_slice("projected").size["x"].tolist()
        (('a', 'projected'), [0.0003, 0.0002, 0.0004])
        """
        if name not in self.slices:
            raise self.unusable(f"no slice '{name}'", nearest(name, list(self.slices)), "slice")
        rows = [i for i, row_slice in enumerate(self.slice) if row_slice == name]
        part = self.columns_at(rows)
        measured = [p for p, v in part["size"].items() if not np.isnan(v).all()]
        for key in ("size", "error", "shot_size", "transfer"):
            part[key] = part[key] and {p: v for p, v in part[key].items() if p in measured}
        profiles = tuple(p._replace(row=rows.index(p.row)) for p in self.profiles if p.row in rows)
        word = "" if name == PROJECTED else "slice "
        return replace(self, **part, profiles=profiles, name=f"{self.name}, {word}{name}")

    def without_settings(self, names: Iterable[str]) -> QuadScan:
        """Remove settings that are not magnets of the line.

        Examples
        --------
        >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0], "phase": [5.0, 6.0, 7.0]},
        ...                 {"Q": "A", "phase": KNOB}, {"x": [2e-4, 1e-4, 3e-4]})
        >>> list(scan.without_settings(["phase"]).settings)
        ['Q']
        """
        kept = {n: v for n, v in self.settings.items() if n not in set(names)}
        return replace(self, settings=kept, units={n: self.units[n] for n in kept})

    def of_particle(self, rest_energy: float) -> QuadScan:
        """Convert energies to total energies, for a particle with a rest energy in MeV.

        Examples
        --------
        >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "A"}, {"x": [2e-4, 1e-4, 3e-4]},
        ...                 energy=[3.0, 3.0, 3.0], energy_kind="momentum")
        >>> scan.of_particle(4.0).energy.tolist()
        [5.0, 5.0, 5.0]
        """
        if self.energy is None or self.energy_kind == "total":
            return self
        total = total_energy(self.energy, self.energy_kind, rest_energy)
        return replace(self, energy=total, energy_kind="total")

    def unusable(self, found: str, expected: str, key: str | None = None) -> InputError:
        """Create an error that names this scan's file and the column of ``key``."""
        column = None if key is None else self.columns.get(key, key)
        return InputError(found, expected, path=self.path, column=column)

    def _check_units(self) -> None:
        """Raise an error for unknown units of settings or energy."""
        expect(self.units, Mapping, '{"Q1": "kG"}')
        for name in self.settings:
            unit = self.units.get(name)
            if unit not in (*SETTINGS, KNOB):
                found = f"'{name}' in the unit {unit!r}" if unit else f"no unit for '{name}'"
                raise self.unusable(found, f"units of {nearest(str(unit), list(SETTINGS))}", name)
        if self.energy_kind not in ENERGY_KEYS.values():
            expected = nearest(str(self.energy_kind), list(ENERGY_KEYS.values()))
            raise self.unusable(f"energy_kind '{self.energy_kind}'", expected, "energy")

    def _check_shapes(self) -> None:
        """Raise an error for missing columns, and for columns of different lengths."""
        if not self.settings and self.screen is None and self.transfer is None:
            expected = "a column such as Q2_A, Q2_kG or Q2_k1, or several screens"
            raise self.unusable("no magnet settings", expected)
        if not self.planes:
            raise self.unusable("no beam sizes", "a column such as size_x_um")
        lengths = {k: len(v) for k, v in self.settings.items()}
        lengths |= {f"size_{p}": len(v) for p, v in self.size.items()}
        lengths |= {f"size_{p}_error": len(v) for p, v in self.error.items()}
        lengths |= {f"shots of {p}": len(v) for p, v in self.shot_size.items()}
        names = {"slice": self.slice, "screen": self.screen}
        lengths |= {name: len(v) for name, v in names.items() if v is not None}
        lengths |= {f"R in {p}": len(v) for p, v in (self.transfer or {}).items()}
        if without_sizes := [p for p in self.error if p not in self.size]:
            raise self.unusable(
                f"errors in {without_sizes[0]} without sizes", f"size_{without_sizes[0]}, too"
            )
        if len(set(lengths.values())) != 1:
            raise self.unusable(f"lengths {lengths}", "one length for all columns")

    def _numbers(self, values: object, key: str) -> np.ndarray:
        """Convert a column to an array of numbers."""
        if isinstance(values, np.ma.MaskedArray):  # masked values were not measured
            values = values.astype(float).filled(np.nan)
        try:
            found = np.asarray(values, float)
        except (TypeError, ValueError):
            found = np.zeros(())
        if found.ndim != 1:
            raise self.unusable(f"{values!r}"[:60], "an array of numbers, one a row", key)
        return found

    def _column(self, key: str) -> np.ndarray:
        """Array of numbers for each row, from one for each or one for all."""
        given = np.asarray(getattr(self, key))
        n = len(self)
        if given.dtype.kind not in "iuf" or given.shape not in ((), (n,)):
            found = f"{key} of shape {given.shape}" if given.dtype.kind in "iuf" else f"{given}"
            raise self.unusable(found, f"a number for each of {n} rows, or one for all", key)
        if key != "shots":
            given = given.astype(float)
        elif not (given >= 1).all():
            raise self.unusable(f"{given.min():g} shots", "one or more for each row", key)
        return np.full(n, given) if given.ndim == 0 else given

    def _whole_transfer(self, given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """R11, R12 and R16 of each row and plane, shape (n, 3)."""
        found = {}
        for plane in self.planes:
            r = np.asarray(given.get(plane, ()), float)
            if r.ndim != 2 or r.shape[1] not in (2, 3) or not np.isfinite(r).all():
                expected = f"r11_{plane} and r12_{plane} (m) of every row, finite"
                raise self.unusable(f"no matrix elements in plane {plane}", expected)
            found[plane] = np.pad(r, ((0, 0), (0, 3 - r.shape[1])))
        return found

    def _check_values(self) -> None:
        """Raise an error for settings, sizes, errors or energies that are not possible."""
        for name, values in self.settings.items():
            if not np.isfinite(values).all():
                raise self.unusable("a setting that is not a number", "finite settings", name)
        checks = [(f"size_{p}", v, True) for p, v in self.size.items()]
        checks += [(f"size_{p}_error", v, True) for p, v in self.error.items()]
        checks += [("energy", self.energy, False)] if self.energy is not None else []
        for key, values, blank in checks:
            wrong = first_unusable(values, blank=blank)
            if wrong:
                raise self.unusable(f"{wrong[1]} at point {wrong[0] + 1}", "a positive number", key)
        for plane, size in self.size.items():
            if np.isnan(size).all():
                continue
            typical = middle(size)
            if not (POSSIBLE[0] <= typical and np.nanmax(size) <= POSSIBLE[1]):
                found = f"sizes around {typical:g} m, which no beam has"
                raise self.unusable(
                    found, "rms sizes in m: are these in um or mm?", f"size_{plane}"
                )

    def _check_three_settings(self, plane: str) -> None:
        """Raise an error for fewer than three distinct settings in a plane."""
        kind = "setting" if self.settings or self.transfer else "screen"
        keys = dict.fromkeys(compress(row_keys(self), ~np.isnan(self.size[plane])))
        for name, number in (Counter(key[0] for key in keys) or {"": 0}).items():
            if number < 3:
                of_slice = f" of slice {name}" if name else ""
                raise self.unusable(
                    f"{number} distinct {kind}{'s' * (number != 1)}{of_slice} in plane {plane}",
                    "at least three: the beam matrix has three numbers",
                )


def at_rows(values: Any, rows: Sequence[int]) -> Any:
    """Select rows of a column, or of each of several columns by name; None stays None.

    Examples
    --------
    >>> at_rows({"x": np.array([1.0, 2.0]), "screen": ("A", "B")}, [1])
    {'x': array([2.]), 'screen': ('B',)}
    """
    if isinstance(values, Mapping):
        return {name: at_rows(v, rows) for name, v in values.items()}
    if values is None or isinstance(values, tuple):
        return values and tuple(values[i] for i in rows)
    return np.asarray(values)[rows]


def row_keys(scan: QuadScan) -> list[tuple]:
    """Key of each row; rows with one key are one measurement, repeated."""
    columns = [scan.slice or ("",) * len(scan), *(list(v) for v in scan.settings.values())]
    columns += [list(v) for v in (scan.energy, scan.screen) if v is not None]
    columns += [list(map(tuple, v)) for v in (scan.transfer or {}).values()]
    return list(zip(*columns, strict=True))


def check_names(
    scan: QuadScan,
    calibrations: Mapping[str, str],
    places: list[str],
    default: str | None,
    rest_energy: float = 0.0,
) -> None:
    """Raise an error if a lattice lacks the magnets or screens of a scan.

    Parameters
    ----------
    scan : QuadScan
        The scan.
    calibrations : mapping of str to str
        Magnet name to the unit of its calibration in the lattice.
    places : list of str
        Names of possible screens.
    default : str or None
        Screen of rows without one.
    rest_energy : float
        Rest energy of the lattice's particle, MeV.

    Raises
    ------
    InputError
        If a magnet or screen is missing (the error offers the nearest), or a current is given for
        a magnet without current calibration.

    Examples
    --------
    >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "A"}, {"x": [2e-4, 1e-4, 3e-4]})
    >>> check_names(scan, {"Q": "A"}, ["OTR"], "OTR")
    """
    for name, unit in () if scan.transfer else scan.units.items():
        if name not in calibrations:
            expected = f"{nearest(name, list(calibrations))} before the unit _{unit}; --ignore "
            expected += "leaves the column unread"
            raise scan.unusable(f"no magnet '{name}' in the lattice", expected, name)
        if unit == "A" and calibrations[name] != "A":
            raise scan.unusable(
                f"currents for '{name}', which the lattice gives no current calibration",
                f"slope and intercept for {name} in the lattice, or a column {name}_kG",
                name,
            )
    scan = scan.of_particle(rest_energy)
    if scan.energy is not None and scan.energy.min() <= rest_energy:
        raise scan.unusable(
            f"{scan.energy.min():g} MeV",
            f"total energies above the particle's rest energy of {rest_energy:g} MeV",
            "energy_MeV",
        )
    for screen in sorted(set(scan.screen or ())):
        if screen not in places:
            raise scan.unusable(
                f"no screen '{screen}' in the lattice", nearest(screen, places), "screen"
            )
    if scan.screen is None and default is None:
        raise scan.unusable(
            "a lattice without a screen", 'an element of type "screen" where sizes were measured'
        )
