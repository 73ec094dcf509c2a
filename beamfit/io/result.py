"""Results as the one JSON object that commands print, and the fitted beams of such an object."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np

from beamfit import __version__
from beamfit.errors import InputError
from beamfit.io.files import laid_out, read_json
from beamfit.studies.scan.scans import PROJECTED
from beamfit.studies.scan.wishes import Beam
from beamfit.table import json_of

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
    name = f"covariance {where}"
    if not (
        isinstance(rows, list)
        and len(rows) == 3
        and all(isinstance(row, list) and len(row) == 3 for row in rows)
    ):
        raise InputError(f"{name} of another shape", "three rows of three numbers")
    found = np.array([[_number(v, f"a number in the {name}") for v in row] for row in rows])
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
