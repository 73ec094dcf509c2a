"""Files of SLAC's emittance_gui: a scan or several monitors, with its matrices and size methods."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.files import digest, laid_out, name_of
from beamfit.io.lattice import LatticeFile
from beamfit.io.matlab import read_variable, read_vectors
from beamfit.io.shots import scatter_of
from beamfit.quantity import Quantity
from beamfit.studies.scan.scans import Profile, QuadScan

# GeV, of files that have none; the electron's is the only particle there.
USUAL_ENERGY = 0.135
# The size method that answers unless another is asked for.
USUAL_METHOD = "RMS"
# Where the sizes stand in `stats`, µm.
SIZE = {"x": 2, "y": 3}
MATLAB, VARIABLE = ".mat", "data"
EXPECTED = "a file saved by emittance_gui"


@dataclass(frozen=True)
class EmittanceGuiFile:
    """What such a file holds.

    Attributes
    ----------
    scans : dict of str to QuadScan
        One for each way of taking the sizes from the profiles, with the rows' own matrices.
    stored : dict of str to dict of str to Quantity
        Method and plane to the normalised emittance that the program found, m.
    lattice : LatticeFile
        The energy, the monitor, and the design Twiss parameters where the matrices begin.
    """

    scans: Mapping[str, QuadScan]
    stored: Mapping[str, Mapping[str, Quantity]]
    lattice: LatticeFile

    def scan(self, method: str | None = None) -> QuadScan:
        """The scan of a size method: "RMS" or, where there is none, the first.

        Raises
        ------
        InputError
            If there is no such method.
        """
        names = list(self.scans)
        wanted = (USUAL_METHOD if USUAL_METHOD in names else names[0]) if method is None else method
        if wanted not in self.scans:
            found = f"no size method '{wanted}'"
            raise InputError(found, nearest(wanted, names), self.lattice.path)
        return self.scans[wanted]


def is_emittance_gui(path: str | PathLike[str]) -> bool:
    """Whether a file is one: of MATLAB by its name, and no table of vectors."""
    return Path(path).suffix.lower() == MATLAB and not read_vectors(path, VARIABLE)


def read_emittance_gui(path: str | PathLike[str]) -> EmittanceGuiFile:
    """Read a file that SLAC's emittance_gui saved.

    Parameters
    ----------
    path : str or path
        A MATLAB file (version 5 to 7) with a struct ``data``; docs/files.md names its fields.

    Returns
    -------
    EmittanceGuiFile
        Errors of the sizes are standard errors over the shots. Settings that failed or were taken
        out (``status``, ``use``) are left out and counted in the notes of each scan.

    Raises
    ------
    InputError
        If it is another file, is damaged, or lacks sizes or matrices.

    Examples
    --------
    >>> read_emittance_gui("orbit.csv")
    Traceback (most recent call last):
    beamfit.errors.InputError: orbit.csv: no such file; expected a readable file
    """
    source = _Fields(path, read_variable(path, VARIABLE))
    with laid_out(path, "a struct 'data' that is laid out otherwise", EXPECTED, named=True):
        return _read(source)


class _Fields:
    """The fields of the struct, each as the array it is."""

    def __init__(self, path: str | PathLike[str], data: Any) -> None:
        self.path = path
        if data.dtype.names is None or data.size != 1:
            raise InputError("a variable 'data' that is no struct", EXPECTED, path)
        self.record = data.ravel()[0]
        self.names = data.dtype.names

    def error(self, found: str, field: str) -> InputError:
        return InputError(found, EXPECTED, self.path, column=field)

    def get(self, field: str) -> np.ndarray | None:
        """A field as an array; None if the file has none, or an empty one."""
        if field not in self.names:
            return None
        value = np.asarray(self.record[field])
        return value if value.size else None

    def need(self, field: str) -> np.ndarray:
        if (value := self.get(field)) is None:
            raise self.error("a field that is missing or empty", field)
        return value

    def numbers(self, field: str, n: int | None = None) -> np.ndarray:
        """A field of finite numbers, flat; of n of them if that is said."""
        value = self.need(field)
        if value.dtype.kind not in "iuf" or not np.isfinite(value).all():
            raise self.error("something else than finite numbers", field)
        if n is not None and value.size != n:
            raise self.error(f"{value.size} numbers for {n} settings", field)
        return value.ravel().astype(float)

    def number(self, field: str, usual: float) -> float:
        return usual if self.get(field) is None else float(self.numbers(field, 1)[0])


def _text(value: Any) -> str:
    """A text out of the arrays of one that MATLAB makes of it."""
    while isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return str(value).strip() if isinstance(value, str) else ""


def _texts(value: np.ndarray | None) -> list[str]:
    return [] if value is None else [_text(v) for v in value.ravel()]


def _read(source: _Fields) -> EmittanceGuiFile:
    beams = _beams(source)
    n, _, methods = beams.shape
    lattice = _lattice(source, n)
    used = np.ones(n, bool)
    for field in ("status", "use"):
        if source.get(field) is not None:
            used &= source.numbers(field, n) > 0
    names = [_method(beams[:, :, k], k) for k in range(methods)]
    shared = _shared(source, np.flatnonzero(used), n, lattice)
    scans = {}
    for k, name in enumerate(names):
        sizes, error, shots = _sizes(beams[used, :, k])
        scans[name] = QuadScan(
            **shared,
            size=sizes,
            error=error,
            shots=shots if error else None,
            profiles=_profiles(source.get("beam"), np.flatnonzero(used), k),
            name=f"{Path(name_of(source.path)).stem}, {name} sizes",
        )
    return EmittanceGuiFile(scans, _stored(source, names), lattice)


def _beams(source: _Fields) -> np.ndarray:
    """Records of the beam by setting, shot and method."""
    field, usual = ("beamList", 3) if source.get("beamList") is not None else ("beam", 2)
    beams = source.need(field)
    if beams.dtype.names is None or "stats" not in beams.dtype.names:
        raise source.error("no sizes", field)
    if beams.ndim != usual:
        found = f"sizes of shape {beams.shape}, as of slices"
        expected = "a scan of the whole beam; write the sizes of a slice as CSV, with r11_x, ..."
        raise InputError(found, expected, source.path, column=field)
    return beams if usual == 3 else beams[:, None, :]


def _shared(source: _Fields, used: np.ndarray, n: int, lattice: LatticeFile) -> dict[str, Any]:
    """What scans of all methods share: settings or monitors, matrices, provenance."""
    cells = source.need("rMatrix").ravel()
    if len(cells) != n:
        raise source.error(f"{len(cells)} matrices for {n} settings", "rMatrix")
    matrices = []
    for i in used:
        r = np.asarray(cells[i], float)
        if r.shape != (6, 6) or not np.isfinite(r).all():
            raise source.error(f"matrix {i + 1} of shape {r.shape}", "rMatrix")
        matrices.append(r)
    r = np.array(matrices).reshape(-1, 6, 6)
    settings, units, screen = {}, {}, None
    if _of_several(source):
        screen = tuple(_monitors(source, n)[i] for i in used)
    else:
        magnet = _text(source.get("quadName")) or "quadrupole"
        settings, units = {magnet: source.numbers("quadVal", n)[used]}, {magnet: "kG"}
    left = n - len(used)
    notes = [f"{left} of {n} settings failed or were taken out, by status and use."] if left else []
    if source.get("energy") is None:
        notes.append(f"The file has no energy; {1e3 * USUAL_ENERGY:g} MeV is taken, as there.")
    return {
        "settings": settings,
        "units": units,
        "screen": screen,
        "energy": np.full(len(used), lattice.energy),
        "transfer": {"x": r[:, 0, [0, 1, 5]], "y": r[:, 2, [2, 3, 5]]},
        "path": source.path,
        "sha256": lattice.sha256,
        "provenance": tuple(_provenance(source)),
        "notes": tuple(notes),
        "error_source": "the scatter of the shots (standard error of the mean)",
    }


def _of_several(source: _Fields) -> bool:
    """Whether several monitors saw one setting, and not one monitor several."""
    return _text(source.get("type")) == "multi"


def _monitors(source: _Fields, n: int) -> list[str]:
    """The monitor of each of n sizes, or the one of all."""
    named = _texts(source.get("name")) or [""]
    if _of_several(source) and len(named) != n:
        return [f"monitor {i + 1}" for i in range(n)]
    return [name or "screen" for name in (named if _of_several(source) else named[:1])]


def _provenance(source: _Fields) -> list[str]:
    said = [f"emittance_gui, {_text(source.get('type')) or 'scan'}"]
    for word, name in (("monitor", "name"), ("quadrupole", "quadName")):
        if named := ", ".join(_texts(source.get(name))):
            said.append(f"{word} {named}")
    if source.get("ts") is not None:
        days = source.number("ts", 0.0)
        if 366 < days < 1e6:  # MATLAB counts days from the year 0
            moment = datetime(1, 1, 1) + timedelta(days=days - 367)
            said.append(f"{moment:%Y-%m-%d %H:%M:%S}")
    if source.get("charge") is not None:
        said.append(f"charge {source.number('charge', 0.0):.3g} nC")
    return said


def _method(beams: np.ndarray, k: int) -> str:
    """The name of a size method, from any shot that has it."""
    named = (_text(v) for v in beams["method"].ravel()) if "method" in beams.dtype.names else ()
    return next((name for name in named if name), f"method {k + 1}")


def _stats(beams: np.ndarray, plane: str) -> np.ndarray:
    """Sizes in m of settings and shots; NaN for shots that failed."""
    found = np.full(beams.shape, np.nan)
    for place, stats in np.ndenumerate(beams["stats"]):
        values = np.asarray(stats)
        if values.dtype.kind in "iuf" and values.size > SIZE[plane]:
            size = 1e-6 * float(values.ravel()[SIZE[plane]])
            found[place] = size if 0.0 < size < math.inf else np.nan
    return found


def _sizes(
    beams: np.ndarray,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]:
    """Mean sizes of the planes, their standard errors, both in m, and how many shots they rest on.

    The error is s/√n of the shots, s with n - 1; a plane has none where a setting has no scatter.
    """
    sizes, errors, shots = {}, {}, np.zeros(len(beams), int)
    for plane in SIZE:
        each = _stats(beams, plane)
        group = np.repeat(np.arange(len(beams)), each.shape[1])
        mean, degrees, square = scatter_of(each.ravel(), group)
        measured = ~np.isnan(mean)
        if not measured.any():
            continue
        sizes[plane] = mean
        shots = np.maximum(shots, np.where(measured, degrees + 1, 0).astype(int))
        error = np.sqrt(square / np.maximum(degrees, 1) / (degrees + 1))
        if (error[measured] > 0.0).all():
            errors[plane] = np.where(measured, error, np.nan)
    return sizes, errors, shots


def _profiles(beam: np.ndarray | None, used: np.ndarray, k: int) -> tuple[Profile, ...]:
    """Projected profiles of one method, as far as the file has them."""
    found = []
    if beam is None or beam.dtype.names is None or beam.ndim < 2 or k >= beam.shape[1]:
        return ()
    for row, i in enumerate(used):
        for plane in SIZE:
            record = beam[(i, k, *(0,) * (beam.ndim - 2))]
            field = f"prof{plane}"
            values = np.asarray(record[field]) if field in beam.dtype.names else np.zeros(0)
            if values.ndim == 2 and values.shape[0] in (2, 3) and values.dtype.kind in "iuf":
                position, counts, *curve = np.asarray(values, float)
                found.append(Profile(plane, row, 1e-6 * position, counts, *(curve or [None])))
    return tuple(found)


def _stored(source: _Fields, methods: list[str]) -> dict[str, dict[str, Quantity]]:
    """The program's own normalised emittances and their errors, m."""
    values, errors = source.get("twiss"), source.get("twissstd")
    if values is None or errors is None:
        return {}
    shape = (4, 2, len(methods))
    values, errors = (np.asarray(v, float) for v in (values, errors))
    if values.ndim < 3 or values.shape[:3] != shape or errors.shape != values.shape:
        return {}
    first = (slice(None),) * 3 + (0,) * (values.ndim - 3)
    values, errors = values[first], errors[first]
    return {
        name: {
            plane: Quantity(float(values[0, p, k]), float(errors[0, p, k]), "m")
            for p, plane in enumerate(SIZE)
            if np.isfinite([values[0, p, k], errors[0, p, k]]).all()
        }
        for k, name in enumerate(methods)
    }


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
                p: {"beta_m": float(beta[i]), "alpha": float(alpha[i])} for i, p in enumerate(SIZE)
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
