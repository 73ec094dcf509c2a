"""Whether a store could be written, known before anything is computed."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path

from beamfit.errors import InputError

__all__ = ["check_place"]


def check_place(path: str | PathLike[str]) -> None:
    """Find out before anything is computed whether a store could be written.

    Raises
    ------
    InputError
        If the path is a folder's, or its folder does not exist or may not be written to.
    """
    folder = Path(path).parent
    if Path(path).is_dir():
        raise InputError("a folder", "the name of a file", path=path)
    if not folder.is_dir():
        raise InputError(f"no folder '{folder}'", "a folder that exists", path=path)
    if not os.access(folder, os.W_OK):
        raise InputError(f"folder '{folder}' that may not be written to", "another", path=path)
