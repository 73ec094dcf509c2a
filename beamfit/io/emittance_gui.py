"""Files of SLAC's emittance_gui: a scan or several monitors, with its matrices and size methods."""

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
from beamfit.io.files import digest, laid_out, name_of
from beamfit.io.isolated import matlab_variables
from beamfit.io.lattice import LatticeFile
from beamfit.io.shots import FEWEST_SETTINGS
from beamfit.quantity import Quantity

# GeV, of files that have none; the electron's is the only particle there.
USUAL_ENERGY = 0.135
# The size method that answers unless another is asked for.
USUAL_METHOD = "RMS"
# Numbers in `stats`: of the planes in µm, and the sum of the counts.
STATS = ("middle x", "middle y", "x", "y", "correlation", "sum")
# A shot with less of the usual light than this shows no beam: light follows the charge, and a pulse
# of a tenth of the charge is not the beam whose emittance is asked for. Missed pulses have 1e-3.
LEAST_LIGHT = 0.1
# Relative: a mean that differs by more is another one, and not rounded otherwise.
ROUNDED = 1e-6
# Shots and sizes that are odd, of which so many are named.
MOST_NAMED = 4
MATLAB, VARIABLE = ".mat", "data"
EXPECTED = "a file saved by emittance_gui"


@dataclass(frozen=True)
class EmittanceGuiFile:
    """Contents of a file of emittance_gui.

    Attributes
    ----------
    scans : dict of str to QuadScan
        Size method to the scan that its shots give, with the rows' own matrices.
    means : dict of str to QuadScan
        Size method to the scan by the file's own mean sizes and their standard errors, from which
        its emittances were computed.
    stored : dict of str to dict of str to Quantity
        Method and plane to the normalised emittance that the program found, m.
    lattice : LatticeFile
        The energy, the monitor, and the design Twiss parameters where the matrices begin.
    left_out : dict of str to str
        Size methods that give no scan, and why.
    """

    scans: Mapping[str, QuadScan]
    means: Mapping[str, QuadScan]
    stored: Mapping[str, Mapping[str, Quantity]]
    lattice: LatticeFile
    left_out: Mapping[str, str] = field(default_factory=dict)

    def scan(self, method: str | None = None) -> QuadScan:
        """The scan of a size method: "RMS" or, where there is none, the first.

        Raises
        ------
        InputError
            If there is no such method, or it gives no scan.
        """
        names = list(self.scans)
        wanted = (USUAL_METHOD if USUAL_METHOD in names else names[0]) if method is None else method
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
    """Tell a file of emittance_gui from others: MATLAB's by its name, and no table of vectors."""
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
        Errors of the sizes are standard errors over the shots. The notes of each scan name what
        was left out: settings that failed, were taken out (``status``, ``use``) or never taken,
        shots without beam or size, and planes and methods that then have too few settings.

    Raises
    ------
    InputError
        If it is another file, is damaged, lacks sizes or matrices, or no size method has three
        settings.

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
    source = _Fields(path, found[VARIABLE])
    with laid_out(path, "a struct 'data' that is laid out otherwise", EXPECTED, named=True):
        return _read(source)


class _Fields(dict[str, np.ndarray]):
    """The fields of the struct that are not empty, each as the array it is."""

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
        """A field of finite numbers, flat; of n of them if that is said."""
        value = self.need(field)
        if value.dtype.kind not in "iuf" or not np.isfinite(value).all():
            raise self.error("something else than finite numbers", field)
        if n is not None and value.size != n:
            raise self.error(f"{value.size} numbers for {n} settings", field)
        return value.ravel().astype(float)

    def number(self, field: str, usual: float) -> float:
        return float(self.numbers(field, 1)[0]) if field in self else usual

    def texts(self, field: str) -> list[str]:
        return [_text(value) for value in self[field].ravel()] if field in self else []

    def text(self, field: str, usual: str = "") -> str:
        return _text(self.get(field)) or usual


def _text(value: Any) -> str:
    """A text out of the arrays of one that MATLAB makes of it."""
    while isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return str(value).strip() if isinstance(value, str) else ""


def _read(source: _Fields) -> EmittanceGuiFile:
    beams = _beams(source)
    used, n = _used(source, len(beams))
    beams, lattice = beams[used], _lattice(source, n)
    settings, dark = _settings(source, used, n, lattice), _without_beam(source, beams)
    notes = [*settings.notes]
    if dark.any():
        named = _shots(dark, settings.labels)
        notes.append(f"Left out for less than a tenth of the usual light, so no beam: {named}.")
    scans, means, left_out = {}, {}, {}
    names = [_method(beams[:, :, k], k) for k in range(beams.shape[2])]
    for k, name in enumerate(names):
        each = {p: np.where(dark, np.nan, _sizes(beams[:, :, k], p)) for p in PLANES}
        own, error = (_own(source, part, used, k) for part in ("beam", "beamStd"))
        called = f"{Path(name_of(source.path)).stem}, {name} sizes"
        if (mean := _scan(settings, own, error, called)) is not None:
            means[name] = replace(mean, error_source="the file")
        alone = error if beams.shape[1] == 1 else {}
        profiles = _profiles(beams, k)
        if (scan := _scan(settings, each, alone, called, profiles)) is None:
            left_out[name] = _counted(each, settings.labels)
            continue
        said = (*notes, *_notes(each, dark, own, settings.labels))
        scans[name] = replace(average_shots(scan, marked=True), notes=said)
    if not scans:
        raise source.error(f"sizes with {next(iter(left_out.values()))}", "beamList")
    gone = tuple(f"No {name} sizes: {why}." for name, why in left_out.items())
    scans = {name: replace(scan, notes=scan.notes + gone) for name, scan in scans.items()}
    return EmittanceGuiFile(scans, means, _stored(source, names), lattice, left_out)


def _beams(source: _Fields) -> np.ndarray:
    """Records of the beam by setting, shot and method."""
    field, usual = ("beamList", 3) if "beamList" in source else ("beam", 2)
    beams = source.need(field)
    if beams.dtype.names is None or "stats" not in beams.dtype.names:
        raise source.error("no sizes", field)
    if beams.ndim != usual:
        found = f"sizes of shape {beams.shape}, as of slices"
        expected = "a scan of the whole beam; write the sizes of a slice as CSV, with r11_x, ..."
        raise InputError(found, expected, source.path, column=field)
    return beams if usual == 3 else beams[:, None, :]


def _used(source: _Fields, taken: int) -> tuple[np.ndarray, int]:
    """Numbers of the settings that were taken and count, and how many there were to be."""
    word = "monitors" if _of_several(source) else "settings"
    marks = [field for field in ("status", "use") if field in source]
    n = max(taken, *(source[field].size for field in marks), 0)
    used = np.arange(n) < taken
    for mark in marks:
        used &= source.numbers(mark, n) > 0
    if used.sum() < FEWEST_SETTINGS:
        found = f"{used.sum()} of {n} {word} taken and in use"
        raise InputError(found, "at least three: the beam matrix has three numbers", source.path)
    return np.flatnonzero(used), n


class _Settings(NamedTuple):
    """Settings, or monitors, that count: columns of a `QuadScan` with a row each, and their names.

    ``about`` is what a `QuadScan` has but once.
    """

    columns: dict[str, Any]
    labels: list[str]
    about: dict[str, Any]
    notes: tuple[str, ...]


def _settings(source: _Fields, used: np.ndarray, n: int, lattice: LatticeFile) -> _Settings:
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
    if _of_several(source):
        names = _monitors(source, n)
        labels = [names[i] for i in used]
        columns["screen"] = tuple(labels)
    else:
        magnet = source.text("quadName", "quadrupole")
        columns["settings"] = {magnet: source.numbers("quadVal", n)[used]}
        labels = [f"{kg:.5g} kG" for kg in columns["settings"][magnet]]
    left = n - len(used)
    notes = [f"{left} of {n} settings failed or were not taken or used (status, use)."] * (left > 0)
    if "energy" not in source:
        notes.append(f"The file has no energy; {1e3 * USUAL_ENERGY:g} MeV is taken, as there.")
    about = {
        "units": dict.fromkeys(columns["settings"], "kG"),
        "path": source.path,
        "sha256": lattice.sha256,
        "provenance": tuple(_provenance(source)),
    }
    return _Settings(columns, labels, about, tuple(notes))


def _of_several(source: _Fields) -> bool:
    """Tell a file of several monitors at one setting from a scan."""
    return source.text("type") == "multi"


def _monitors(source: _Fields, n: int) -> list[str]:
    """The monitor of each of n sizes, or the one of all."""
    named = source.texts("name") or [""]
    if _of_several(source) and len(named) != n:
        return [f"monitor {i + 1}" for i in range(n)]
    return [name or "screen" for name in (named if _of_several(source) else named[:1])]


def _provenance(source: _Fields) -> list[str]:
    said = [f"emittance_gui, {source.text('type', 'scan')}"]
    for word, name in (("monitor", "name"), ("quadrupole", "quadName")):
        if named := ", ".join(source.texts(name)):
            said.append(f"{word} {named}")
    if 366 < (days := source.number("ts", 0.0)) < 1e6:  # MATLAB counts days from the year 0
        said.append(f"{datetime(1, 1, 1) + timedelta(days=days - 367):%Y-%m-%d %H:%M:%S}")
    if "charge" in source:
        said.append(f"charge {source.number('charge', 0.0):.3g} nC")
    return said


def _method(beams: np.ndarray, k: int) -> str:
    """The name of a size method, from any shot that has it."""
    named = (_text(v) for v in beams["method"].ravel()) if "method" in beams.dtype.names else ()
    return next((name for name in named if name), f"method {k + 1}")


def _stat(beams: np.ndarray, name: str) -> np.ndarray:
    """One of the numbers in `stats` of each record, NaN where it is missing or not finite."""
    found, place = np.full(beams.shape, np.nan), STATS.index(name)
    for at, stats in np.ndenumerate(beams["stats"]):
        values = np.asarray(stats)
        if values.dtype.kind in "iuf" and values.size > place:
            value = float(values.ravel()[place])
            found[at] = value if math.isfinite(value) else np.nan
    return found


def _sizes(beams: np.ndarray, plane: str) -> np.ndarray:
    """Sizes in m; NaN where there is none that a beam can have."""
    size = 1e-6 * _stat(beams, plane)
    return np.where((size >= POSSIBLE[0]) & (size <= POSSIBLE[1]), size, np.nan)


def _without_beam(source: _Fields, beams: np.ndarray) -> np.ndarray:
    """Mark the shots, by setting, that show no beam: far less light than is usual.

    The light is the median over size methods. Monitors differ, and have a usual light each.
    """
    light = np.median(np.nan_to_num(_stat(beams, "sum")), axis=2)
    usual = np.median(light, axis=1, keepdims=True) if _of_several(source) else np.median(light)
    return light < LEAST_LIGHT * usual


def _own(source: _Fields, field: str, used: np.ndarray, k: int) -> dict[str, np.ndarray]:
    """Mean sizes of a method in m, or their standard errors, as the file has them: shape (n, 1)."""
    beams = source.get(field)
    if beams is None or "stats" not in (beams.dtype.names or ()) or beams.ndim != 2:
        return {}
    if beams.shape[0] <= used.max() or beams.shape[1] <= k:
        return {}
    own = beams[used, k, None]
    return {p: _sizes(own, p) if field == "beam" else 1e-6 * _stat(own, p) for p in PLANES}


def _scan(
    settings: _Settings,
    sizes: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray],
    name: str,
    profiles: Iterable[Profile] = (),
) -> QuadScan | None:
    """The scan of sizes by setting and shot, a row each; None if no plane has enough settings.

    A plane has errors where each of its sizes has one.
    """
    kept = {p: v for p, v in sizes.items() if _distinct(v, settings.labels) >= FEWEST_SETTINGS}
    if not kept:
        return None
    at = np.flatnonzero(~np.isnan(list(kept.values())).all(axis=0))
    size = {p: v.ravel()[at] for p, v in kept.items()}
    error = {p: errors[p].ravel()[at] for p in kept if p in errors}
    error = {p: v for p, v in error.items() if (v[~np.isnan(size[p])] > 0.0).all()}
    own = at // next(iter(kept.values())).shape[1]
    seen = tuple(
        p._replace(row=int(np.argmax(own == p.row)))
        for p in profiles
        if p.row in own and p.plane in kept
    )
    part = at_rows(settings.columns, own) | settings.about
    return QuadScan(**part, size=size, error=error, name=name, profiles=seen)


def _distinct(sizes: np.ndarray, labels: list[str]) -> int:
    """Count the settings that have a size."""
    return len({labels[i] for i in np.flatnonzero(~np.isnan(sizes).all(axis=1))})


def _counted(sizes: Mapping[str, np.ndarray], labels: list[str]) -> str:
    """Say how many settings each plane of a method has."""
    return " and ".join(f"{_distinct(v, labels)} settings in {p}" for p, v in sizes.items())


def _shots(marked: np.ndarray, labels: list[str]) -> str:
    """Shots in words, by number and setting."""
    return _first([f"shot {j + 1} at {labels[i]}" for i, j in np.argwhere(marked)])


def _first(found: list[str]) -> str:
    more = len(found) - MOST_NAMED
    return ", ".join(found[:MOST_NAMED]) + f" and {more} more" * (more > 0)


def _notes(
    sizes: Mapping[str, np.ndarray],
    dark: np.ndarray,
    own: Mapping[str, np.ndarray],
    labels: list[str],
) -> Iterator[str]:
    """Name what was left out of the sizes of one method, and means that differ."""
    lost: dict[str, list[str]] = {}
    for plane, each in sizes.items():
        if named := _shots(np.isnan(each) & ~dark, labels):
            lost.setdefault(named, []).append(plane)
    for named, planes in lost.items():
        yield f"Left out in {' and '.join(planes)}, without a size a beam can have: {named}."
    for plane, each in sizes.items():
        if (n := _distinct(each, labels)) < FEWEST_SETTINGS:
            yield f"Left out: plane {plane}, with sizes at {n} of {len(labels)} settings."
            continue
        number = np.maximum((~np.isnan(each)).sum(axis=1), 1)
        mean = np.nansum(each, axis=1) / number
        said = own[plane][:, 0] if plane in own else np.full(len(mean), np.nan)
        other = np.flatnonzero((np.abs(said - mean) > ROUNDED * said) & (mean > 0.0))
        places = [f"{1e6 * said[i]:.4g} for {1e6 * mean[i]:.4g} µm at {labels[i]}" for i in other]
        if places:
            yield f"The file's means in {plane} are not those of these shots: {_first(places)}."


def _profiles(beams: np.ndarray, k: int) -> tuple[Profile, ...]:
    """Projected profiles of the shots of one method, as far as the file has them."""
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


def _stored(source: _Fields, methods: list[str]) -> dict[str, dict[str, Quantity]]:
    """The program's own normalised emittances and their errors, m; 0 there means no beam found."""
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


def _lattice(source: _Fields, n: int) -> LatticeFile:
    """Energy, monitors and design Twiss parameters, as of a line."""
    energy = 1e3 * source.number("energy", USUAL_ENERGY)
    if not 1.0 < energy < 1e6:
        raise source.error(f"an energy of {1e-3 * energy:g} GeV", "energy")
    # Of several monitors the matrices begin somewhere before; of one, at it.
    places = [*dict.fromkeys(_monitors(source, n)), *["start"] * _of_several(source)]
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
