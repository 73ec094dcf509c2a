"""Results of earlier commands: the JSON that ``beamfit emittance --json`` wrote."""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError

__all__ = ["FittedBeam", "read_fitted_beams"]

HOW = "the output of beamfit emittance --json"


class FittedBeam(NamedTuple):
    """A fitted beam of one plane.

    Attributes
    ----------
    sigma : ndarray
        σ11 (m²), σ12 (m rad), σ22 (rad²).
    covariance : ndarray or None
        Shape (3, 3), scaled as the errors are; None where the fit determined none.
    status : str
        Of the fit.
    calibration : dict of str to float
        Fitted calibration numbers that go with it, such as "Q2.slope".
    """

    sigma: np.ndarray
    covariance: np.ndarray | None
    status: str
    calibration: dict[str, float]


def read_fitted_beams(path: str | PathLike[str]) -> dict[str, FittedBeam]:
    """Read the fitted beam of each plane.

    Parameters
    ----------
    path : str or path
        A file with the JSON object of ``beamfit emittance --json``.

    Returns
    -------
    dict of str to FittedBeam
        By plane.

    Raises
    ------
    InputError
        If the file cannot be read or is something else.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "fit.json"
    >>> entry = {"plane": "x", "status": "converged", "covariance": None}
    >>> entry |= {f"sigma{k}": {"value": 1e-8} for k in ("11", "12", "22")}
    >>> _ = file.write_text(json.dumps({"beamfit": "0.1.0", "results": [entry]}))
    >>> read_fitted_beams(file)["x"].sigma.tolist()
    [1e-08, 1e-08, 1e-08]
    """
    try:
        document = json.loads(Path(path).read_text())
        entries = document["results"]
        found = {entry["plane"]: _beam(entry) for entry in entries}
    except OSError as error:
        raise InputError(f"no readable file ({error.strerror})", HOW, path=path) from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError("no fitted beams", HOW, path=path) from None
    if not found:
        raise InputError("no result in the file", HOW, path=path)
    return found


def _beam(entry: Mapping[str, Any]) -> FittedBeam:
    sigma = np.array([entry[f"sigma{k}"]["value"] for k in ("11", "12", "22")], float)
    covariance = entry.get("covariance")
    if covariance is not None:
        covariance = np.array(covariance, float) * float(entry.get("error_scale", 1.0)) ** 2
    numbers = {
        p["name"]: float(p["value"]["value"])
        for p in entry.get("parameters", ())
        if entry.get("scenario") == "calibration"
    }
    return FittedBeam(sigma, covariance, str(entry["status"]), numbers)
