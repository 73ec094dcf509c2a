"""The stability of a current monitor, as people write it."""

from __future__ import annotations

import re

from beamfit.errors import InputError
from beamfit.io.table import UNITS
from beamfit.studies.decay.monitor import Monitor


def monitor_of(drift: str | None, offset: str | None) -> Monitor | None:
    """Read the stability of a current monitor; None if nothing is said of it.

    Parameters
    ----------
    drift : str or None
        A current for each time, such as ``10uA/h``: units as in a file's columns.
    offset : str or None
        A current, such as ``50uA``.

    Raises
    ------
    InputError
        If one is not of that form.

    Examples
    --------
    >>> print(monitor_of("0.24 mA/d", None))
    drifts by 10 µA/h
    """
    current = "|".join(UNITS["current"])
    found = []
    for name, text, per, example in (
        ("drift", drift, rf"\s*/\s*({'|'.join(UNITS['time'])})", "10uA/h"),
        ("offset", offset, "()", "50uA"),
    ):
        said = re.fullmatch(rf"\s*(\d+\.?\d*(?:[eE][-+]?\d+)?)\s*({current}){per}\s*", text or "")
        if text is not None and said is None:
            raise InputError(f"--monitor-{name} {text}", f"a stability such as {example}")
        value = 0.0 if said is None else float(said[1]) * UNITS["current"][said[2]]
        found.append(value * (3600 / UNITS["time"][said[3]] if said and said[3] else 1.0))
    return Monitor(*found) if any(found) else None
