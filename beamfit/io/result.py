"""Results as one JSON object, the fitted beams of such an object, and fits kept in a file."""

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
from beamfit.io.files import laid_out, read_json
from beamfit.writing import write_atomically

if TYPE_CHECKING:
    from beamfit.emittance.fit import EmittanceFit
    from beamfit.lifetime.fit import DecayFit

HOW = "the output of beamfit emittance --json"
NUMBERS = ("sigma11", "sigma12", "sigma22")
# Correlations rounded by a fit of nearly dependent numbers may have eigenvalues below zero by this.
ROUNDED = 1e-9


def results_text(
    results: Sequence[Any],
    inputs: Mapping[str, str | None],
    command: str = "",
    **further: Any,
) -> str:
    """Write the one JSON object of a command, or of a script that answers as one.

    Parameters
    ----------
    results : sequence
        Results, or what they give as JSON; one entry each.
    inputs : mapping of str to str
        Input files and their SHA-256, as `QuadScan.sha256` or `beamfit.io.files.digest`.
    command : str
        The command line.
    **further
        What concerns all results together, after them.

    Returns
    -------
    str
        JSON text; numbers that JSON cannot hold are null.

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
        Of the particle, MeV: a file may hold no energy but both emittances, whose ratio is βγ.
    lattice : str, optional
        SHA-256 of the lattice file that the beam is for. A result that does not say in which line
        it was fitted must name it among its inputs.

    Returns
    -------
    dict of str to Beam
        By plane.

    Raises
    ------
    InputError
        If the file cannot be read or is something else, if a number in it is missing or cannot
        be, if the beam was fitted with another lattice, or together with a network: it belongs to
        the network's optics, which the file does not hold.

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
    document = read_json(path, "no fitted beams", HOW)
    with laid_out(path, "no fitted beams", HOW):
        entries = [e for e in document["results"] if e.get("slice", PROJECTED) == PROJECTED]
        found = {entry["plane"]: _beam(entry, rest_energy) for entry in entries}
        told = all("line" in entry for entry in entries) or "inputs" not in document
        if lattice is not None and not told and lattice not in document["inputs"].values():
            said = "a beam that was fitted with another lattice, or with another version of it"
            raise InputError(said, "a fit with this lattice")
        if not found:
            raise InputError("no result of the whole beam in the file", HOW)
    return found


def _beam(entry: Mapping[str, Any], rest_energy: float) -> Beam:
    _check_optics(entry)
    where = f"of plane {entry['plane']}"
    sigma = [_number(entry[name]["value"], f"{name} {where}") for name in NUMBERS]
    covariance = entry.get("covariance")
    if covariance is not None:
        scale = _number(entry.get("error_scale", 1.0), f"error_scale {where}")
        covariance = _covariance(covariance, where) * scale**2
    numbers = {
        p["name"]: _number(p["value"]["value"], p["name"])
        for p in entry.get("parameters", ())
        if entry.get("scenario") == "calibration"
    }
    energy = _energy(entry, rest_energy, where)
    line = (entry.get("line") or {}).get("sha256")
    return Beam(np.array(sigma), covariance, numbers, energy, _doubt(entry), line)


def _energy(entry: Mapping[str, Any], rest_energy: float, where: str) -> float | None:
    """Total energy in MeV, E² = m²(1 + (βγ)²) where only the emittances say it."""
    if "energy" in entry:
        energy = _number(entry["energy"]["value"], f"energy {where}")
        if not energy > rest_energy:
            raise InputError(f"energy {where} = {energy:g} MeV", f"more than {rest_energy:g} MeV")
        return energy
    geometric, normalised = (
        (entry.get(name) or {}).get("value") for name in ("emittance", "normalized_emittance")
    )
    if not geometric or normalised is None:
        return None
    ratio = _number(normalised, f"normalized_emittance {where}") / _number(
        geometric, f"emittance {where}"
    )
    return rest_energy * math.hypot(1.0, ratio)


def _check_optics(entry: Mapping[str, Any]) -> None:
    """Refuse a beam that belongs to optics other than the lattice's."""
    scenario, anchor = entry.get("scenario", "known"), str(entry.get("anchor", "none"))
    # An anchor at single settings is "first principles at ..." and leaves the scale open.
    tied = scenario == "transport-network" and anchor.startswith("first principles to ")
    if scenario not in ("known", "calibration") and not tied:
        raise InputError(
            f"a beam of scenario {scenario} with anchor {anchor}, which belongs to the optics of "
            "that network and not to the lattice's",
            "a result of scenario known or calibration, or of transport-network with "
            "--anchor first-principles=2%",
        )


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} = {json.dumps(value)}", f"a finite number, as in {HOW}")
    return float(value)


def _covariance(rows: object, where: str) -> np.ndarray:
    """Check a covariance by its correlations, which have no unit."""
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
        or np.linalg.eigvalsh(correlation).min() < -ROUNDED
    ):
        raise InputError(
            f"{name} that no numbers have", "a symmetric matrix without negative eigenvalues"
        )
    return found


def _doubt(entry: Mapping[str, Any]) -> str | None:
    """Why the fit does not determine the beam, in its own words."""
    open_ones = [name for name in NUMBERS if entry[name].get("error") is None]
    why = f"({entry['status']}: {entry.get('message', 'without a reason')})"
    if open_ones:
        return f"{', '.join(open_ones)} have no error {why}"
    if entry.get("covariance") is None:
        return f"no covariance of sigma11, sigma12, sigma22 {why}"
    return f"the emittance is open {why}" if entry["status"] == "unidentified" else None


FORMAT = "beamfit-fit-2"
KEPT = "a file that beamfit.save_fit wrote"
# What a file may hold, by where it is defined. A file names these and nothing else.
SCAN, DECAY, OPTICS = "beamfit.emittance", "beamfit.lifetime", "beamfit.optics"
HELD = {
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
HOMES = {name: home for home, names in HELD.items() for name in names.split()}
OWN = ("planes", "scan", "told", "parameters", "null_directions")
HOW_SEEN = ("method", "noise", "weights")


def save_fit(path: str | PathLike[str], fit: EmittanceFit | DecayFit) -> None:
    """Keep a fit in a file, to be loaded by `load_fit`.

    Parameters
    ----------
    path : str or path
        Where to; an existing file is replaced whole. The file is JSON, every number with all
        its digits.
    fit : EmittanceFit or DecayFit
        Of known transport, or a decay. What a scenario fitted besides the beam has its search in
        memory, which a file does not hold: sample it with ``store=``.

    Raises
    ------
    InputError
        If it is the fit of another scenario, or the place cannot be written.

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
        content = _plain(fit)
    elif not isinstance(fit, EmittanceFit):
        found = f"a {type(fit).__name__}"
        raise InputError(found, "one fit of an emittance or a decay", path=path)
    elif fit.statement.closed:
        content = {name: _plain(getattr(fit, name)) for name in OWN}
        content["line"] = _plain(fit.seen.line)
        content |= {name: _plain(getattr(fit.seen, name)) for name in HOW_SEEN}
    else:
        found = f"a fit of scenario {fit.scenario}"
        raise InputError(found, "a fit of scenario known, or of a decay", path=path)
    kind = type(fit).__name__
    document = {"format": FORMAT, "beamfit": __version__, "kind": kind, "fit": content}
    write_atomically(path, (json.dumps(document, allow_nan=False) + "\n").encode())


def load_fit(path: str | PathLike[str]) -> EmittanceFit | DecayFit:
    """Load a fit that `save_fit` kept.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    EmittanceFit or DecayFit
        As it was saved: nothing is fitted again, all numbers and sentences are those of the file.

    Raises
    ------
    InputError
        If the file cannot be read, is something else, or has the format of another version.

    Examples
    --------
    >>> load_fit("fit.json")
    Traceback (most recent call last):
    beamfit.errors.InputError: fit.json: no such file; expected a readable file
    """
    document = read_json(path, "no saved fit", KEPT)
    with laid_out(path, "no saved fit", KEPT):
        form, version = document["format"], f"beamfit {str(document['beamfit'])[:20]}"
    if form != FORMAT:
        expected = f"format {FORMAT}; load it with that version, or fit again"
        raise InputError(f"format {str(form)[:40]}, of {version}", expected, path=path)
    found = f"a fit saved by {version} that cannot be read here"
    with laid_out(path, found, KEPT, named=True):
        return _fit(document["kind"], document["fit"])


def _fit(kind: str, content: Any) -> EmittanceFit | DecayFit:
    if kind == "DecayFit":
        return _value(content)
    if kind != "EmittanceFit":
        raise InputError(f"a fit of kind {str(kind)[:40]}", "EmittanceFit or DecayFit")
    from beamfit.emittance.fit import EmittanceFit, scenario_of
    from beamfit.emittance.statement import prepare

    own = {name: _value(content[name]) for name in OWN}
    line, statement = _value(content["line"]), scenario_of("known")
    planes = tuple(p.plane for p in own["planes"])
    seen = prepare(own["scan"], line, planes, *(_value(content[name]) for name in HOW_SEEN))
    return EmittanceFit(
        own.pop("planes"), own.pop("scan"), line, statement, own.pop("told"), seen, **own
    )


def _plain(value: Any) -> Any:
    """A value as JSON that tells what it was: {"is": name, ...} where JSON has no word for it."""
    if isinstance(value, Enum):
        return {"is": type(value).__name__, "value": value.value}
    if dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
        return {"is": _named(value), "with": {k: _plain(v) for k, v in fields.items()}}
    if hasattr(value, "_asdict"):
        return {"is": _named(value), "with": {k: _plain(v) for k, v in value._asdict().items()}}
    if isinstance(value, Mapping):
        return {"is": "dict", "of": [[k, _plain(v)] for k, v in value.items()]}
    if isinstance(value, tuple):
        return {"is": "tuple", "of": [_plain(v) for v in value]}
    if isinstance(value, list):
        return [_plain(v) for v in value]
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        array = np.asarray(value)
        if array.ndim == 0:
            return _plain(array.item())
        numbers = [_plain(v) for v in array.ravel().tolist()]
        return {"is": "array", "type": array.dtype.str, "shape": array.shape, "of": numbers}
    if isinstance(value, float) and not np.isfinite(value):
        return {"is": "float", "value": str(value)}
    return str(value) if isinstance(value, PathLike) else value


def _named(value: Any) -> str:
    name = type(value).__name__
    if HOMES.get(name) != type(value).__module__:
        raise InputError(f"a {name}, which no file of fits holds", "a fit of beamfit's own values")
    return name


def _type(said: str) -> np.dtype:
    """The type of an array that a fit may hold: a number, or a short text."""
    found = np.dtype(said)
    if found.kind not in "biufU" or found.itemsize > 4000:
        raise ValueError(said)
    return found


def _value(plain: Any) -> Any:
    """The value that `_plain` made this of."""
    if isinstance(plain, list):
        return [_value(v) for v in plain]
    if not isinstance(plain, dict):
        return plain
    match plain["is"]:
        case "dict":
            return {k: _value(v) for k, v in plain["of"]}
        case "tuple":
            return tuple(_value(v) for v in plain["of"])
        case "array":
            numbers = np.array([_value(v) for v in plain["of"]], _type(plain["type"]))
            return numbers.reshape(plain["shape"])
        case "float":
            return float(plain["value"])
    name = plain["is"]
    if name not in HOMES:
        raise InputError(f"a value of kind {str(name)[:40]}", KEPT)
    cls = getattr(import_module(HOMES[name]), name)
    if "value" in plain:
        return cls(plain["value"])
    return cls(**{k: _value(v) for k, v in plain["with"].items()})
