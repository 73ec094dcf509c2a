"""Read MATLAB files of SLAC's emittance_gui: quadrupole scans and multi-monitor measurements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beamfit.emittance.scan import PLANES, POSSIBLE, Profile, QuadScan, at_rows
from beamfit.emittance.shots import average_shots
from beamfit.errors import InputError, nearest
from beamfit.io.files import digest, name_of, structure_errors
from beamfit.io.isolated import matlab_variables
from beamfit.io.lattice import LatticeFile
from beamfit.io.shots import MIN_SETTINGS
from beamfit.quantity import Quantity

# Energy of files that give none, GeV: that of the program. Its particle is always the electron.
DEFAULT_ENERGY = 0.135
# Default size method.
DEFAULT_METHOD = "RMS"
# Order of the numbers in `stats`: positions, sizes (µm), correlation, sum of the counts.
STATS = ("middle x", "middle y", "x", "y", "correlation", "sum")
# A shot with less than this share of the median light has no beam: light is proportional to charge,
# and a pulse of a tenth of the charge is another beam. Missed pulses have about 1e-3.
MIN_LIGHT = 0.1
# Relative difference of mean sizes above which they are not the same mean but for rounding.
MEAN_TOLERANCE = 1e-6
# Omitted shots that a note lists; more are counted.
MAX_LISTED = 4
MATLAB, VARIABLE = ".mat", "data"
EXPECTED = "a file saved by emittance_gui"


@dataclass(frozen=True)
class EmittanceGuiFile:
    """Contents of a file of emittance_gui.

    Attributes
    ----------
    scans : dict of str to QuadScan
        Scan made from the shots, by size method; rows have their own matrices.
    means : dict of str to QuadScan
        Scan made from the stored mean sizes and standard errors, by size method. The program
        computed its emittances from these.
    stored : dict of str to dict of str to Quantity
        Normalised emittance of the program, m, by method and plane.
    lattice : LatticeFile
        Energy, monitors, and design Twiss parameters at the start of the matrices.
    left_out : dict of str to str
        Reason why a size method gives no scan.
    """

    scans: Mapping[str, QuadScan]
    means: Mapping[str, QuadScan]
    stored: Mapping[str, Mapping[str, Quantity]]
    lattice: LatticeFile
    left_out: Mapping[str, str] = field(default_factory=dict)

    def scan(self, method: str | None = None) -> QuadScan:
        """Scan of a size method; by default "RMS" or, without it, the first.

        Raises
        ------
        InputError
            If there is no such method, or it gives no scan.
        """
        names = list(self.scans)
        default = DEFAULT_METHOD if DEFAULT_METHOD in names else names[0]
        wanted = default if method is None else method
        if wanted in self.left_out:
            expected = f"a size method with three settings or more: {', '.join(names)}"
            raise InputError(
                f"{wanted} sizes with {self.left_out[wanted]}", expected, self.lattice.path
            )
        if wanted not in self.scans:
            found = f"no size method '{wanted}'"
            raise InputError(found, nearest(wanted, names), self.lattice.path)
        return self.scans[wanted]


def is_emittance_gui(path: str | PathLike[str]) -> bool:
    """True if a file is a MATLAB file by its name, and no table of vectors."""
    if Path(path).suffix.lower() != MATLAB:
        return False
    return set(matlab_variables(path, VARIABLE)) <= {VARIABLE}


def read_emittance_gui(path: str | PathLike[str]) -> EmittanceGuiFile:
    """Read a file that SLAC's emittance_gui saved.

    Parameters
    ----------
    path : str or path
        A MATLAB file (version 5 to 7) with a struct ``data``; its fields: docs/files_reference.md.

    Returns
    -------
    EmittanceGuiFile
        Errors of the sizes are standard errors over the shots. The notes of each scan list
        omissions: settings that failed, were deselected (``status``, ``use``) or not taken, shots
        without beam or size, and planes and methods with too few settings.

    Raises
    ------
    InputError
        If the file is of another kind or damaged, lacks sizes or matrices, or no size method has
        three settings.

    Examples
    --------
    >>> read_emittance_gui("orbit.csv")
    Traceback (most recent call last):
    beamfit.errors.InputError: orbit.csv: no such file; expected a readable file
    """
    if VARIABLE not in (found := matlab_variables(path, VARIABLE)):
        expected = (
            f"a struct '{VARIABLE}' of emittance_gui, or vectors Q2_A, size_x_um, one a column"
        )
        raise InputError(f"no variable '{VARIABLE}'", expected, path)
    source = _Struct(path, found[VARIABLE])
    unlike = "a struct 'data' that is laid out otherwise"
    with structure_errors(path, unlike, EXPECTED, with_cause=True):
        return _read_struct(source)


class _Struct(dict[str, np.ndarray]):
    """Non-empty fields of the struct, as arrays."""

    def __init__(self, path: str | PathLike[str], data: Any) -> None:
        if data.dtype.names is None or data.size != 1:
            raise InputError("a variable 'data' that is no struct", EXPECTED, path)
        record, self.path = data.ravel()[0], path
        values = ((name, np.asarray(record[name])) for name in data.dtype.names)
        super().__init__((name, value) for name, value in values if value.size)

    def error(self, found: str, field: str) -> InputError:
        return InputError(found, EXPECTED, self.path, column=field)

    def need(self, field: str) -> np.ndarray:
        if field not in self:
            raise self.error("a field that is missing or empty", field)
        return self[field]

    def numbers(self, field: str, n: int | None = None) -> np.ndarray:
        """Field of finite numbers, flat; of n numbers if n is given."""
        value = self.need(field)
        if value.dtype.kind not in "iuf" or not np.isfinite(value).all():
            raise self.error("something else than finite numbers", field)
        if n is not None and value.size != n:
            raise self.error(f"{value.size} numbers for {n} settings", field)
        return value.ravel().astype(float)

    def number(self, field: str, default: float) -> float:
        return float(self.numbers(field, 1)[0]) if field in self else default

    def texts(self, field: str) -> list[str]:
        return [_text(value) for value in self[field].ravel()] if field in self else []

    def text(self, field: str, default: str = "") -> str:
        return _text(self.get(field)) or default


def _text(value: Any) -> str:
    """Text inside nested arrays of one element, as MATLAB stores it."""
    while isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return str(value).strip() if isinstance(value, str) else ""


def _read_struct(source: _Struct) -> EmittanceGuiFile:
    """Read the struct: scans of all size methods, stored results, and the lattice."""
    beams = _shot_records(source)
    used, n = _used_settings(source, len(beams))
    beams, lattice = beams[used], _lattice(source, n)
    settings, dark = _settings(source, used, n, lattice), _dark_shots(source, beams)
    notes = [*settings.notes]
    if dark.any():
        dark_list = _shot_list(dark, settings.labels)
        notes.append(f"Left out for less than a tenth of the usual light, so no beam: {dark_list}.")
    scans, means, left_out = {}, {}, {}
    names = [_method_name(beams[:, :, k], k) for k in range(beams.shape[2])]
    for k, name in enumerate(names):
        sizes = {p: np.where(dark, np.nan, _sizes(beams[:, :, k], p)) for p in PLANES}
        mean_sizes, error = (_stored_sizes(source, part, used, k) for part in ("beam", "beamStd"))
        scan_name = f"{Path(name_of(source.path)).stem}, {name} sizes"
        if (mean := _make_scan(settings, mean_sizes, error, scan_name)) is not None:
            means[name] = replace(mean, error_source="the file")
        shot_errors = error if beams.shape[1] == 1 else {}
        profiles = _profiles(beams, k)
        if (scan := _make_scan(settings, sizes, shot_errors, scan_name, profiles)) is None:
            left_out[name] = _settings_text(sizes, settings.labels)
            continue
        scan_notes = (*notes, *_omission_notes(sizes, dark, mean_sizes, settings.labels))
        scans[name] = replace(average_shots(scan, marked=True), notes=scan_notes)
    if not scans:
        raise source.error(f"sizes with {next(iter(left_out.values()))}", "beamList")
    method_notes = tuple(f"No {name} sizes: {why}." for name, why in left_out.items())
    scans = {name: replace(scan, notes=scan.notes + method_notes) for name, scan in scans.items()}
    return EmittanceGuiFile(scans, means, _stored_emittances(source, names), lattice, left_out)


def _shot_records(source: _Struct) -> np.ndarray:
    """Records of the beam: shape (settings, shots, methods)."""
    field, dimensions = ("beamList", 3) if "beamList" in source else ("beam", 2)
    beams = source.need(field)
    if beams.dtype.names is None or "stats" not in beams.dtype.names:
        raise source.error("no sizes", field)
    if beams.ndim != dimensions:
        found = f"sizes of shape {beams.shape}, as of slices"
        expected = "a scan of the whole beam; write the sizes of a slice as CSV, with r11_x, ..."
        raise InputError(found, expected, source.path, column=field)
    return beams if dimensions == 3 else beams[:, None, :]


def _used_settings(source: _Struct, n_taken: int) -> tuple[np.ndarray, int]:
    """Indices of the settings that were taken and selected, and the number planned."""
    noun = "monitors" if _has_monitors(source) else "settings"
    marks = [field for field in ("status", "use") if field in source]
    n = max(n_taken, *(source[field].size for field in marks), 0)
    used = np.arange(n) < n_taken
    for mark in marks:
        used &= source.numbers(mark, n) > 0
    if used.sum() < MIN_SETTINGS:
        found = f"{used.sum()} of {n} {noun} taken and in use"
        raise InputError(found, "at least three: the beam matrix has three numbers", source.path)
    return np.flatnonzero(used), n


class _Settings(NamedTuple):
    """Settings or monitors in use: columns of a `QuadScan` with one row each, and their labels.

    ``about`` has the other fields of a `QuadScan`.
    """

    columns: dict[str, Any]
    labels: list[str]
    about: dict[str, Any]
    notes: tuple[str, ...]


def _settings(source: _Struct, used: np.ndarray, n: int, lattice: LatticeFile) -> _Settings:
    """Settings or monitors in use, with their transfer matrices."""
    cells = source.need("rMatrix").ravel()
    if len(cells) <= used.max():
        raise source.error(f"{len(cells)} matrices for {n} settings", "rMatrix")
    matrices = [np.asarray(cells[i], float) for i in used]
    for i, r in zip(used, matrices, strict=True):
        if r.shape != (6, 6) or not np.isfinite(r).all():
            raise source.error(f"matrix {i + 1} of shape {r.shape}", "rMatrix")
    r = np.array(matrices)
    columns: dict[str, Any] = {
        "settings": {},
        "energy": np.full(len(used), lattice.energy),
        "transfer": {"x": r[:, 0, [0, 1, 5]], "y": r[:, 2, [2, 3, 5]]},
    }
    if _has_monitors(source):
        names = _monitors(source, n)
        labels = [names[i] for i in used]
        columns["screen"] = tuple(labels)
    else:
        magnet = source.text("quadName", "quadrupole")
        columns["settings"] = {magnet: source.numbers("quadVal", n)[used]}
        labels = [f"{kg:.5g} kG" for kg in columns["settings"][magnet]]
    n_omitted = n - len(used)
    notes = []
    if n_omitted:
        notes.append(f"{n_omitted} of {n} settings failed or were not taken or used (status, use).")
    if "energy" not in source:
        notes.append(f"The file has no energy; {1e3 * DEFAULT_ENERGY:g} MeV is taken, as there.")
    about = {
        "units": dict.fromkeys(columns["settings"], "kG"),
        "path": source.path,
        "sha256": lattice.sha256,
        "provenance": tuple(_provenance(source)),
    }
    return _Settings(columns, labels, about, tuple(notes))


def _has_monitors(source: _Struct) -> bool:
    """True for a measurement with several monitors at one setting."""
    return source.text("type") == "multi"


def _monitors(source: _Struct, n: int) -> list[str]:
    """Name of the monitor of each of n sizes; of a scan, one name."""
    names = source.texts("name") or [""]
    if _has_monitors(source) and len(names) != n:
        return [f"monitor {i + 1}" for i in range(n)]
    return [name or "screen" for name in (names if _has_monitors(source) else names[:1])]


def _provenance(source: _Struct) -> list[str]:
    """Provenance lines: program, monitor, quadrupole, date, charge."""
    lines = [f"emittance_gui, {source.text('type', 'scan')}"]
    for word, name in (("monitor", "name"), ("quadrupole", "quadName")):
        if text := ", ".join(source.texts(name)):
            lines.append(f"{word} {text}")
    if 366 < (days := source.number("ts", 0.0)) < 1e6:  # MATLAB counts days from the year 0
        lines.append(f"{datetime(1, 1, 1) + timedelta(days=days - 367):%Y-%m-%d %H:%M:%S}")
    if "charge" in source:
        lines.append(f"charge {source.number('charge', 0.0):.3g} nC")
    return lines


def _method_name(beams: np.ndarray, k: int) -> str:
    """Name of a size method, from the first shot that has one."""
    names = (_text(v) for v in beams["method"].ravel()) if "method" in beams.dtype.names else ()
    return next((name for name in names if name), f"method {k + 1}")


def _statistic(beams: np.ndarray, name: str) -> np.ndarray:
    """Number in `stats` of each record by name; NaN if missing or not finite."""
    found, index = np.full(beams.shape, np.nan), STATS.index(name)
    for at, stats in np.ndenumerate(beams["stats"]):
        values = np.asarray(stats)
        if values.dtype.kind in "iuf" and values.size > index:
            value = float(values.ravel()[index])
            found[at] = value if math.isfinite(value) else np.nan
    return found


def _sizes(beams: np.ndarray, plane: str) -> np.ndarray:
    """Sizes in m; NaN if missing or outside the possible range."""
    size = 1e-6 * _statistic(beams, plane)
    return np.where((size >= POSSIBLE[0]) & (size <= POSSIBLE[1]), size, np.nan)


def _dark_shots(source: _Struct, beams: np.ndarray) -> np.ndarray:
    """True for shots, by setting, without beam: with much less light than the median.

    Light is the median over size methods; it is compared separately for each monitor.
    """
    light = np.median(np.nan_to_num(_statistic(beams, "sum")), axis=2)
    typical = np.median(light, axis=1, keepdims=True) if _has_monitors(source) else np.median(light)
    return light < MIN_LIGHT * typical


def _stored_sizes(source: _Struct, field: str, used: np.ndarray, k: int) -> dict[str, np.ndarray]:
    """Stored mean sizes of a method in m, or their standard errors; shape (n, 1)."""
    beams = source.get(field)
    if beams is None or "stats" not in (beams.dtype.names or ()) or beams.ndim != 2:
        return {}
    if beams.shape[0] <= used.max() or beams.shape[1] <= k:
        return {}
    own = beams[used, k, None]
    return {p: _sizes(own, p) if field == "beam" else 1e-6 * _statistic(own, p) for p in PLANES}


def _make_scan(
    settings: _Settings,
    sizes: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray],
    name: str,
    profiles: Iterable[Profile] = (),
) -> QuadScan | None:
    """Make a scan with a row for each setting and shot; None if no plane has enough settings.

    A plane has errors only if each of its sizes has one.
    """
    planes = {p: v for p, v in sizes.items() if _count_settings(v, settings.labels) >= MIN_SETTINGS}
    if not planes:
        return None
    rows = np.flatnonzero(~np.isnan(list(planes.values())).all(axis=0))
    size = {p: v.ravel()[rows] for p, v in planes.items()}
    error = {p: errors[p].ravel()[rows] for p in planes if p in errors}
    error = {p: v for p, v in error.items() if (v[~np.isnan(size[p])] > 0.0).all()}
    setting = rows // next(iter(planes.values())).shape[1]
    profiles_kept = tuple(
        p._replace(row=int(np.argmax(setting == p.row)))
        for p in profiles
        if p.row in setting and p.plane in planes
    )
    fields = at_rows(settings.columns, setting) | settings.about
    return QuadScan(**fields, size=size, error=error, name=name, profiles=profiles_kept)


def _count_settings(sizes: np.ndarray, labels: list[str]) -> int:
    """Number of settings with a size."""
    return len({labels[i] for i in np.flatnonzero(~np.isnan(sizes).all(axis=1))})


def _settings_text(sizes: Mapping[str, np.ndarray], labels: list[str]) -> str:
    """Number of settings of each plane, in words."""
    return " and ".join(f"{_count_settings(v, labels)} settings in {p}" for p, v in sizes.items())


def _shot_list(marked: np.ndarray, labels: list[str]) -> str:
    """List of shots, in words."""
    return _short_list([f"shot {j + 1} at {labels[i]}" for i, j in np.argwhere(marked)])


def _short_list(items: list[str]) -> str:
    """Join the first items of a list, and count the others."""
    n_more = len(items) - MAX_LISTED
    return ", ".join(items[:MAX_LISTED]) + f" and {n_more} more" * (n_more > 0)


def _omission_notes(
    sizes: Mapping[str, np.ndarray],
    dark: np.ndarray,
    means: Mapping[str, np.ndarray],
    labels: list[str],
) -> Iterator[str]:
    """Notes on omitted sizes of one method, and on stored means that differ."""
    planes_by_shots: dict[str, list[str]] = {}
    for plane, plane_sizes in sizes.items():
        if shots := _shot_list(np.isnan(plane_sizes) & ~dark, labels):
            planes_by_shots.setdefault(shots, []).append(plane)
    for shots, planes in planes_by_shots.items():
        yield f"Left out in {' and '.join(planes)}, without a size a beam can have: {shots}."
    for plane, plane_sizes in sizes.items():
        if (n := _count_settings(plane_sizes, labels)) < MIN_SETTINGS:
            yield f"Left out: plane {plane}, with sizes at {n} of {len(labels)} settings."
            continue
        count = np.maximum((~np.isnan(plane_sizes)).sum(axis=1), 1)
        mean = np.nansum(plane_sizes, axis=1) / count
        stored = means[plane][:, 0] if plane in means else np.full(len(mean), np.nan)
        others = np.flatnonzero((np.abs(stored - mean) > MEAN_TOLERANCE * stored) & (mean > 0.0))
        found = [f"{1e6 * stored[i]:.4g} for {1e6 * mean[i]:.4g} µm at {labels[i]}" for i in others]
        if found:
            listed = _short_list(found)
            yield f"The file's means in {plane} are not those of these shots: {listed}."


def _profiles(beams: np.ndarray, k: int) -> tuple[Profile, ...]:
    """Projected profiles of the shots of one method."""
    found = []
    for (row, shot), plane in product(np.ndindex(beams.shape[:2]), PLANES):
        field = f"prof{plane}"
        if field not in beams.dtype.names:
            continue
        values = np.asarray(beams[field][row, shot, k])
        if values.ndim == 2 and values.shape[0] in (2, 3) and values.dtype.kind in "iuf":
            position, counts, *curve = np.asarray(values, float)
            found.append(Profile(plane, row, 1e-6 * position, counts, *(curve or [None])))
    return tuple(found)


def _stored_emittances(source: _Struct, methods: list[str]) -> dict[str, dict[str, Quantity]]:
    """Normalised emittances and errors stored by the program, m; it writes 0 if no beam fits."""
    values, errors = source.get("twiss"), source.get("twissstd")
    if values is None or errors is None:
        return {}
    shape = (4, 2, len(methods))
    values, errors = (np.asarray(v, float) for v in (values, errors))
    if values.shape[:3] != shape or errors.shape != values.shape:
        return {}
    values, errors = (v.reshape(*shape, -1)[0, ..., 0] for v in (values, errors))
    found: dict[str, dict[str, Quantity]] = {name: {} for name in methods}
    for p, k in np.argwhere(np.isfinite(values + errors) & (values > 0.0)):
        quantity = Quantity(float(values[p, k]), float(errors[p, k]), "m")
        found[methods[k]][PLANES[p]] = quantity
    return found


def _lattice(source: _Struct, n: int) -> LatticeFile:
    """Lattice of the matrices: energy, monitors and design Twiss parameters."""
    energy = 1e3 * source.number("energy", DEFAULT_ENERGY)
    if not 1.0 < energy < 1e6:
        raise source.error(f"an energy of {1e-3 * energy:g} GeV", "energy")
    # The matrices start upstream of several monitors, and at the only monitor of a scan.
    places = [*dict.fromkeys(_monitors(source, n)), *["start"] * _has_monitors(source)]
    design = None
    twiss = source.get("twiss0")
    if twiss is not None and twiss.shape == (3, 2) and twiss.dtype.kind in "iuf":
        beta, alpha = np.asarray(twiss[1:], float)
        if np.isfinite([beta, alpha]).all() and beta.min() > 0.0:
            design = {"at": places[-1]} | {
                p: {"beta_m": float(beta[i]), "alpha": float(alpha[i])}
                for i, p in enumerate(PLANES)
            }
    return LatticeFile(
        path=source.path,
        sha256=digest(source.path),
        name=f"matrices of {name_of(source.path)}",
        energy=energy,
        particle="electron",
        elements=tuple({"type": "screen", "name": name} for name in places),
        design=design,
    )
