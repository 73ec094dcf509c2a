"""Files and table of a batch, checked before JAX is loaded."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from beamfit.errors import InputError
from beamfit.writing import check_place

FILE_SUFFIXES = {
    "emittance": (".csv", ".txt", ".h5", ".hdf5", ".mat", ".tfs"),
    "lifetime": (".csv", ".txt", ".h5", ".hdf5", ".json"),
}
# Formats of the table of answers.
TABLE_SUFFIXES = (".csv", ".parquet", ".h5", ".hdf5")
INSTALL_HINT = "the extra: pip install 'beamfit[batch]'"


def find_files(paths: Iterable[str], kind: str) -> tuple[str, ...]:
    """List files, and files of a kind in folders and their sub-folders, each once.

    Raises
    ------
    InputError
        If there are none. A single missing file among others is answered as `unusable`.
    """
    found: dict[str, None] = {}
    for path in paths:
        if Path(path).is_dir():
            inside = sorted(
                p for p in Path(path).rglob("*") if p.suffix.lower() in FILE_SUFFIXES[kind]
            )
            found |= dict.fromkeys(str(p) for p in inside if _is_input(p.relative_to(path)))
        else:
            found[path] = None
    if not any(Path(file).exists() for file in found):
        expected = f"files ending in {', '.join(FILE_SUFFIXES[kind])}"
        raise InputError("no files", expected, path=next(iter(paths), None))
    return tuple(found)


def _is_input(path: Path) -> bool:
    """True if a path in a folder is neither hidden nor a part of an earlier batch."""
    return not any(part.startswith(".") or part.endswith(".parts") for part in path.parts)


def check_request(out: Path, workers: int | None, scheduler: str | None) -> None:
    """Check the table and the packages of a batch before anything is computed.

    Raises
    ------
    InputError
        If the table has no known format or place, or a package is missing.
    """
    check_place(out)
    if out.suffix.lower() not in TABLE_SUFFIXES:
        raise InputError(f"a table '{out}'", f"a name ending in {', '.join(TABLE_SUFFIXES)}")
    if workers is not None and scheduler is not None:
        raise InputError("both workers and a scheduler", "one of them")
    try:
        if out.suffix.lower() == ".parquet":
            import pyarrow.parquet  # noqa: F401
        if workers is not None or scheduler is not None:
            import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(f"no package {error.name}", INSTALL_HINT) from None
