"""Write results as JSON, read fitted beams from them, and save and load fits."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from enum import Enum
from importlib import import_module
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit import __version__
from beamfit.answer import json_of
from beamfit.emittance.scan import PROJECTED
from beamfit.emittance.targets import Beam
from beamfit.errors import InputError
from beamfit.io.files import read_json, structure_errors
from beamfit.writing import write_atomically

if TYPE_CHECKING:
    from beamfit.emittance.fit import EmittanceFit
    from beamfit.lifetime.fit import DecayFit

SOURCE_TEXT = "the output of beamfit emittance --json"
SIGMA_KEYS = ("sigma11", "sigma12", "sigma22")
# Eigenvalues of a correlation matrix may be negative by this much, from rounding.
EIGENVALUE_TOLERANCE = 1e-9


def results_text(
    results: Sequence[Any],
    inputs: Mapping[str, str | None],
    command: str = "",
    **further: Any,
) -> str:
    """Write the JSON object of a command.

    Parameters
    ----------
    results : sequence
        Results, or their JSON values; one entry each.
    inputs : mapping of str to str
        Input files and their SHA-256, as `QuadScan.sha256` or `beamfit.io.files.digest`.
    command : str
        The command line.
    **further
        Further entries, after the results.

    Returns
    -------
    str
        JSON text; NaN and infinities are null.

    Examples
    --------
    >>> json.loads(results_text([{"a": float("inf")}], {}))["results"]
    [{'a': None}]
    """
    document = {"beamfit": __version__, "command": command, "inputs": inputs, "results": results}
    return json.dumps(json_of(document | further), indent=2, allow_nan=False)


def read_fitted_beams(
    path: str | PathLike[str], rest_energy: float, lattice: str | None = None
) -> dict[str, Beam]:
    """Read the fitted beam of each plane.

    Parameters
    ----------
    path : str or path
        A file with the JSON object of ``beamfit emittance --json``.
    rest_energy : float
        Rest energy of the particle, MeV, for files without energy: the ratio of the two
        emittances is βγ.
    lattice : str, optional
        SHA-256 of the lattice file for which the beam is used. A result without its line must name
        this file among its inputs.

    Returns
    -------
    dict of str to Beam
        By plane.

    Raises
    ------
    InputError
        If the file cannot be read or is of another kind, a number is missing or impossible, or the
        beam was fitted with another lattice or together with a network: it then belongs to the
        network's optics, which the file does not contain.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> file = Path(tempfile.mkdtemp()) / "fit.json"
    >>> entry = {"plane": "x", "status": "converged", "message": "Good.", "covariance": None}
    >>> entry |= {f"sigma{k}": {"value": 1e-8, "error": None} for k in ("11", "12", "22")}
    >>> _ = file.write_text(json.dumps({"beamfit": "0.1.0", "results": [entry]}))
    >>> beam = read_fitted_beams(file, 0.511)["x"]
    >>> beam.sigma.tolist(), beam.doubt
    ([1e-08, 1e-08, 1e-08], 'sigma11, sigma12, sigma22 have no error (converged: Good.)')
    """
    document = read_json(path, "no fitted beams", SOURCE_TEXT)
    with structure_errors(path, "no fitted beams", SOURCE_TEXT):
        entries = [e for e in document["results"] if e.get("slice", PROJECTED) == PROJECTED]
        found = {entry["plane"]: _beam(entry, rest_energy) for entry in entries}
        names_line = all("line" in entry for entry in entries) or "inputs" not in document
        if lattice is not None and not names_line and lattice not in document["inputs"].values():
            other = "a beam that was fitted with another lattice, or with another version of it"
            raise InputError(other, "a fit with this lattice")
        if not found:
            raise InputError("no result of the whole beam in the file", SOURCE_TEXT)
    return found


def _beam(entry: Mapping[str, Any], rest_energy: float) -> Beam:
    """Fitted beam of an entry of ``results``."""
    _check_optics(entry)
    where = f"of plane {entry['plane']}"
    sigma = [_checked_number(entry[name]["value"], f"{name} {where}") for name in SIGMA_KEYS]
    covariance = entry.get("covariance")
    if covariance is not None:
        scale = _checked_number(entry.get("error_scale", 1.0), f"error_scale {where}")
        covariance = _covariance(covariance, where) * scale**2
    numbers = {
        p["name"]: _checked_number(p["value"]["value"], p["name"])
        for p in entry.get("parameters", ())
        if entry.get("scenario") == "calibration"
    }
    energy = _energy(entry, rest_energy, where)
    line = (entry.get("line") or {}).get("sha256")
    return Beam(np.array(sigma), covariance, numbers, energy, _doubt(entry), line)


def _energy(entry: Mapping[str, Any], rest_energy: float, where: str) -> float | None:
    """Total energy in MeV; without one in the file, from E² = m²(1 + (βγ)²) and the emittances."""
    if "energy" in entry:
        energy = _checked_number(entry["energy"]["value"], f"energy {where}")
        if not energy > rest_energy:
            raise InputError(f"energy {where} = {energy:g} MeV", f"more than {rest_energy:g} MeV")
        return energy
    emittance, normalized = (
        (entry.get(name) or {}).get("value") for name in ("emittance", "normalized_emittance")
    )
    if not emittance or normalized is None:
        return None
    ratio = _checked_number(normalized, f"normalized_emittance {where}") / _checked_number(
        emittance, f"emittance {where}"
    )
    return rest_energy * math.hypot(1.0, ratio)


def _check_optics(entry: Mapping[str, Any]) -> None:
    """Refuse a beam that belongs to optics other than the lattice's."""
    scenario, anchor = entry.get("scenario", "known"), str(entry.get("anchor", "none"))
    # An anchor at single settings is "first principles at ...": it leaves the scale undetermined.
    is_anchored = scenario == "transport-network" and anchor.startswith("first principles to ")
    if scenario not in ("known", "calibration") and not is_anchored:
        raise InputError(
            f"a beam of scenario {scenario} with anchor {anchor}, which belongs to the optics of "
            "that network and not to the lattice's",
            "a result of scenario known or calibration, or of transport-network with "
            "--anchor first-principles=2%",
        )


def _checked_number(value: object, name: str) -> float:
    """A finite number, or an error that names it."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} = {json.dumps(value)}", f"a finite number, as in {SOURCE_TEXT}")
    return float(value)


def _covariance(rows: object, where: str) -> np.ndarray:
    """Check a covariance matrix by its correlations, which are dimensionless."""
    name, found = f"covariance {where}", np.array(rows)
    if found.shape != (3, 3) or found.dtype.kind not in "if" or not np.isfinite(found).all():
        raise InputError(
            f"{name} of another shape", "three rows of three numbers, each a finite number"
        )
    variance = np.diagonal(found)
    sd = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = found / np.outer(sd, sd)
    if (
        variance.min() < 0
        or found[variance == 0].any()
        or not np.allclose(correlation, correlation.T, rtol=0.0, atol=1e-6)
        or np.linalg.eigvalsh(correlation).min() < -EIGENVALUE_TOLERANCE
    ):
        raise InputError(
            f"{name} that no numbers have", "a symmetric matrix without negative eigenvalues"
        )
    return found


def _doubt(entry: Mapping[str, Any]) -> str | None:
    """Reason why the fit does not determine the beam, with its message; None if it does."""
    undetermined = [name for name in SIGMA_KEYS if entry[name].get("error") is None]
    reason = f"({entry['status']}: {entry.get('message', 'without a reason')})"
    if undetermined:
        return f"{', '.join(undetermined)} have no error {reason}"
    if entry.get("covariance") is None:
        return f"no covariance of sigma11, sigma12, sigma22 {reason}"
    return f"the emittance is open {reason}" if entry["status"] == "unidentified" else None


FORMAT = "beamfit-fit-2"
SAVED_FIT_TEXT = "a file that beamfit.save_fit wrote"
# Classes that a file may contain, by module. No others are imported from a file.
SCAN, DECAY, OPTICS = "beamfit.emittance", "beamfit.lifetime", "beamfit.optics"
CLASSES_BY_MODULE = {
    "beamfit.quantity": "Quantity",
    "beamfit.errors": "Status",
    "beamfit.noise.model": "Noise Lognormal",
    f"{SCAN}.scan": "QuadScan Profile",
    f"{SCAN}.results": "PlaneFit Points Parameter ScreenTwiss Identifiability",
    f"{SCAN}.assumptions": "Anchor Assumptions Entry",
    f"{SCAN}.focusing_network": "NetworkStrength",
    f"{DECAY}.record": "DecayRecord Conditions Monitor",
    f"{DECAY}.fit": "DecayFit",
    f"{DECAY}.evidence": "Separability RatePart",
    f"{DECAY}.alternatives": "ConstantA LifetimeLaw Change Outgassing SuddenLoss",
    f"{DECAY}.free_law": "FreeLaw",
    f"{OPTICS}.beamline": "Beamline Design",
    f"{OPTICS}.elements": "Drift Quadrupole ThinLens SectorDipole Marker Screen TransferMatrix",
    f"{OPTICS}.sections": "LineSection ElementSeries",
    f"{OPTICS}.calibration": "SlopeIntercept CurrentPolynomial CurrentTable Gradient "
    "IntegratedGradient FocusingStrength IntegratedStrength",
}
MODULE_OF_CLASS = {
    name: home for home, names in CLASSES_BY_MODULE.items() for name in names.split()
}
FIT_FIELDS = ("planes", "scan", "told", "parameters", "null_directions")
PREPARE_OPTIONS = ("method", "noise", "weights")


def save_fit(path: str | PathLike[str], fit: EmittanceFit | DecayFit) -> None:
    """Save a fit in a file, to be loaded by `load_fit`.

    Parameters
    ----------
    path : str or path
        The file (JSON, numbers with all digits); an existing one is replaced atomically.
    fit : EmittanceFit or DecayFit
        Of known transport, or a decay. Fits of other scenarios cannot be saved, as their search is
        needed later: sample them with ``store=``.

    Raises
    ------
    InputError
        If the fit is of another scenario, or the file cannot be written.

    Examples
    --------
    >>> import tempfile, beamfit
    >>> file = tempfile.mkdtemp() + "/fit.json"
    >>> hours = np.linspace(0.0, 36000.0, 40)
    >>> fit = beamfit.fit_decay(beamfit.DecayRecord(hours, 100.0 / (1.0 + 1e-5 * hours)))
    >>> save_fit(file, fit)
    >>> str(load_fit(file)) == str(fit)
    True
    """
    from beamfit.emittance.fit import EmittanceFit
    from beamfit.lifetime.fit import DecayFit  # JAX from here on

    if isinstance(fit, DecayFit):
        content = _encode(fit)
    elif not isinstance(fit, EmittanceFit):
        found = f"a {type(fit).__name__}"
        raise InputError(found, "one fit of an emittance or a decay", path=path)
    elif fit.statement.closed:
        content = {name: _encode(getattr(fit, name)) for name in FIT_FIELDS}
        content["line"] = _encode(fit.seen.line)
        content |= {name: _encode(getattr(fit.seen, name)) for name in PREPARE_OPTIONS}
    else:
        found = f"a fit of scenario {fit.scenario}"
        raise InputError(found, "a fit of scenario known, or of a decay", path=path)
    kind = type(fit).__name__
    document = {"format": FORMAT, "beamfit": __version__, "kind": kind, "fit": content}
    write_atomically(path, (json.dumps(document, allow_nan=False) + "\n").encode())


def load_fit(path: str | PathLike[str]) -> EmittanceFit | DecayFit:
    """Load a fit that `save_fit` wrote.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    EmittanceFit or DecayFit
        The saved fit; nothing is fitted again.

    Raises
    ------
    InputError
        If the file cannot be read, is of another kind, or has the format of another version.

    Examples
    --------
    >>> load_fit("fit.json")
    Traceback (most recent call last):
    beamfit.errors.InputError: fit.json: no such file; expected a readable file
    """
    document = read_json(path, "no saved fit", SAVED_FIT_TEXT)
    with structure_errors(path, "no saved fit", SAVED_FIT_TEXT):
        format_name, version = document["format"], f"beamfit {str(document['beamfit'])[:20]}"
    if format_name != FORMAT:
        expected = f"format {FORMAT}; load it with that version, or fit again"
        raise InputError(f"format {str(format_name)[:40]}, of {version}", expected, path=path)
    found = f"a fit saved by {version} that cannot be read here"
    with structure_errors(path, found, SAVED_FIT_TEXT, with_cause=True):
        return _decode_fit(document["kind"], document["fit"])


def _decode_fit(kind: str, content: Any) -> EmittanceFit | DecayFit:
    """Decode a fit; one of a scan needs its prepared scan again, which is computed."""
    if kind == "DecayFit":
        return _decode(content)
    if kind != "EmittanceFit":
        raise InputError(f"a fit of kind {str(kind)[:40]}", "EmittanceFit or DecayFit")
    from beamfit.emittance.fit import EmittanceFit, scenario_of
    from beamfit.emittance.statement import prepare

    own = {name: _decode(content[name]) for name in FIT_FIELDS}
    line, statement = _decode(content["line"]), scenario_of("known")
    planes = tuple(p.plane for p in own["planes"])
    seen = prepare(own["scan"], line, planes, *(_decode(content[name]) for name in PREPARE_OPTIONS))
    return EmittanceFit(line=line, statement=statement, seen=seen, **own)


def _encode(value: Any) -> Any:
    """Encode a value as JSON; types that JSON lacks become {"is": name, ...}."""
    if isinstance(value, Enum):
        return {"is": type(value).__name__, "value": value.value}
    if dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
        return {"is": _class_name(value), "with": {k: _encode(v) for k, v in fields.items()}}
    if hasattr(value, "_asdict"):
        return {
            "is": _class_name(value),
            "with": {k: _encode(v) for k, v in value._asdict().items()},
        }
    if isinstance(value, Mapping):
        return {"is": "dict", "of": [[k, _encode(v)] for k, v in value.items()]}
    if isinstance(value, tuple):
        return {"is": "tuple", "of": [_encode(v) for v in value]}
    if isinstance(value, list):
        return [_encode(v) for v in value]
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        array = np.asarray(value)
        if array.ndim == 0:
            return _encode(array.item())
        numbers = [_encode(v) for v in array.ravel().tolist()]
        return {"is": "array", "type": array.dtype.str, "shape": array.shape, "of": numbers}
    if isinstance(value, float) and not np.isfinite(value):
        return {"is": "float", "value": str(value)}
    return str(value) if isinstance(value, PathLike) else value


def _class_name(value: Any) -> str:
    """Name of a value's class, which must be among those a file may contain."""
    name = type(value).__name__
    if MODULE_OF_CLASS.get(name) != type(value).__module__:
        raise InputError(f"a {name}, which no file of fits holds", "a fit of beamfit's own values")
    return name


def _array_type(dtype_text: str) -> np.dtype:
    """Type of an array: numbers or short texts; others are refused."""
    found = np.dtype(dtype_text)
    if found.kind not in "biufU" or found.itemsize > 4000:
        raise ValueError(dtype_text)
    return found


def _decode(encoded: Any) -> Any:
    """Decode a value encoded by `_encode`."""
    if isinstance(encoded, list):
        return [_decode(v) for v in encoded]
    if not isinstance(encoded, dict):
        return encoded
    match encoded["is"]:
        case "dict":
            return {k: _decode(v) for k, v in encoded["of"]}
        case "tuple":
            return tuple(_decode(v) for v in encoded["of"])
        case "array":
            numbers = np.array([_decode(v) for v in encoded["of"]], _array_type(encoded["type"]))
            return numbers.reshape(encoded["shape"])
        case "float":
            return float(encoded["value"])
    name = encoded["is"]
    if name not in MODULE_OF_CLASS:
        raise InputError(f"a value of kind {str(name)[:40]}", SAVED_FIT_TEXT)
    cls = getattr(import_module(MODULE_OF_CLASS[name]), name)
    if "value" in encoded:
        return cls(encoded["value"])
    return cls(**{k: _decode(v) for k, v in encoded["with"].items()})
