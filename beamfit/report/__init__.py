"""Report pages: the only package that draws."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from beamfit.errors import InputError

PAGES, PICTURES = (".html", ".pdf"), (".png", ".svg")


def kind_of(path: str | PathLike[str]) -> str:
    """Return the suffix of the name of a report, which must be that of a page or of pictures."""
    suffix = Path(path).suffix.lower()
    if suffix not in PAGES + PICTURES:
        expected = "a name ending in .html or .pdf, or in .png or .svg for its pictures"
        raise InputError(f"report '{path}'", expected)
    return suffix
