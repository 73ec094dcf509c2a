"""Fits kept in a file: every number as it is, so that what is loaded says the same."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from enum import Enum
from importlib import import_module
from os import PathLike
from typing import Any

import numpy as np

from beamfit import __version__
from beamfit.errors import InputError
from beamfit.io.files import laid_out, read_json
from beamfit.studies.decay.fit import DecayFit
from beamfit.studies.scan.fit import EmittanceFit, scenario_of
from beamfit.studies.scan.known import see
from beamfit.writing import write_atomically

FORMAT = "beamfit-fit-2"
HOW = "a file that beamfit.save_fit wrote"
# What a file may hold, by where it is defined. A file names these and nothing else.
SCAN, DECAY, OPTICS = "beamfit.studies.scan", "beamfit.studies.decay", "beamfit.optics"
HELD = {
    "beamfit.quantity": "Quantity",
    "beamfit.status": "Status",
    "beamfit.noise.model": "Noise Lognormal",
    f"{SCAN}.scans": "QuadScan Profile",
    f"{SCAN}.results": "PlaneFit Points Parameter ScreenTwiss Identifiability",
    f"{SCAN}.assumptions": "Anchor Assumptions Entry",
    f"{SCAN}.focusing_network": "NetworkStrength",
    f"{DECAY}.record": "DecayRecord Conditions Monitor",
    f"{DECAY}.fit": "DecayFit",
    f"{DECAY}.evidence": "Separability",
    f"{DECAY}.alternatives": "ConstantA LifetimeLaw Change Outgassing",
    f"{DECAY}.marginal": "FreeLaw Span",
    f"{OPTICS}.beamline": "Beamline Design",
    f"{OPTICS}.elements": "Drift Quadrupole ThinLens SectorDipole Marker Screen TransferMatrix",
    f"{OPTICS}.sections": "Section Series",
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
    document = read_json(path, "no saved fit", HOW)
    with laid_out(path, "no saved fit", HOW):
        form, version = document["format"], f"beamfit {str(document['beamfit'])[:20]}"
    if form != FORMAT:
        expected = f"format {FORMAT}; load it with that version, or fit again"
        raise InputError(f"format {str(form)[:40]}, of {version}", expected, path=path)
    found = f"a fit saved by {version} that cannot be read here"
    with laid_out(path, found, HOW, named=True):
        return _fit(document["kind"], document["fit"])


def _fit(kind: str, content: Any) -> EmittanceFit | DecayFit:
    if kind == "DecayFit":
        return _value(content)
    if kind != "EmittanceFit":
        raise InputError(f"a fit of kind {str(kind)[:40]}", "EmittanceFit or DecayFit")
    own = {name: _value(content[name]) for name in OWN}
    line, statement = _value(content["line"]), scenario_of("known")
    planes = tuple(p.plane for p in own["planes"])
    seen = see(own["scan"], line, planes, *(_value(content[name]) for name in HOW_SEEN))
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
        raise InputError(f"a value of kind {str(name)[:40]}", HOW)
    cls = getattr(import_module(HOMES[name]), name)
    if "value" in plain:
        return cls(plain["value"])
    return cls(**{k: _value(v) for k, v in plain["with"].items()})
