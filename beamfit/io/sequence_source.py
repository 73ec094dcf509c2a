"""The MAD-X, MAD-8 or elegant file being read, to say where something stands in it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from os import PathLike

from beamfit.errors import InputError

__all__ = ["Source"]


@dataclass(frozen=True)
class Source:
    """The file being read, to say where something stands."""

    path: str | PathLike[str]
    text: str
    dialect: str

    def line_of(self, name: str) -> int | None:
        """Line on which a name is defined, if it is in this file."""
        pattern = re.compile(rf'\s*"?{re.escape(name)}"?\s*(:|=)', re.IGNORECASE)
        lines = enumerate(self.text.splitlines(), start=1)
        return next((n for n, t in lines if pattern.match(t)), None)

    def error(self, found: str, expected: str, name: str | None = None) -> InputError:
        """Make the error that names the file, and the line that defines ``name``."""
        line = None if name is None else self.line_of(name)
        return InputError(found, expected, path=self.path, line=line)
