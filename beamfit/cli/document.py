"""What every command does alike: the JSON object, the command line, the name of a report."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from beamfit import __version__
from beamfit.errors import InputError
from beamfit.quantity import finite

__all__ = ["check_report_name", "command_line", "json_text"]


def check_report_name(report: str | None) -> None:
    """Find out before anything is computed whether the report could be written.

    Raises
    ------
    InputError
        If the name ends in anything but .html or .pdf, is a folder's, or its folder does not
        exist or may not be written to.
    """
    if report is None:
        return
    if Path(report).suffix.lower() not in (".html", ".pdf"):
        raise InputError(f"report '{report}'", "a name ending in .html or .pdf")
    folder = Path(report).parent
    if Path(report).is_dir():
        raise InputError(f"report '{report}', which is a folder", "the name of a file")
    if not folder.is_dir():
        raise InputError(f"report '{report}'", f"a folder that exists; '{folder}' is none")
    if not os.access(folder, os.W_OK):
        raise InputError(f"report '{report}'", f"a folder one may write to; '{folder}' is not")


def command_line() -> str:
    """The command as it was typed, quoted for a shell."""
    return shlex.join(["beamfit", *sys.argv[1:]])


def json_text(
    command: str,
    inputs: Mapping[str, str | None],
    results: Sequence[Mapping[str, Any]],
    further: Mapping[str, Any] | None = None,
) -> str:
    """Write the one JSON object of a command.

    Parameters
    ----------
    command : str
        The command line.
    inputs : mapping of str to str
        Input files and their SHA-256.
    results : sequence of mapping
        One entry a result.
    further : mapping, optional
        What concerns all results together, after them.

    Returns
    -------
    str
        JSON text; numbers that JSON cannot hold are null.

    Examples
    --------
    >>> json.loads(json_text("beamfit", {}, [{"a": float("inf")}]))["results"]
    [{'a': None}]
    """
    document = {"beamfit": __version__, "command": command, "inputs": inputs, "results": results}
    document |= further or {}
    return json.dumps(finite(document), indent=2, allow_nan=False)
