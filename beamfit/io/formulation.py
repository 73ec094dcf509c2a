"""Read, write and solve formulation files, and read the tables of numbers they use."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.errors import InputError, located
from beamfit.io.cells import check_length
from beamfit.io.files import read_text, text_lines
from beamfit.language.document import Document
from beamfit.language.parse import parse_document
from beamfit.language.plan import check_document, check_mapping
from beamfit.language.scope import values_of
from beamfit.language.text import format_document
from beamfit.language.xml import format_xml, parse_xml
from beamfit.writing import write_atomically

if TYPE_CHECKING:
    from beamfit.language.compiled import Computed
    from beamfit.language.solution import ProblemSolution

# Largest number of numbers in a table: 32 MB, far more than a formulation needs.
MAX_NUMBERS = 4_000_000


def read_formulation(path: str | PathLike[str]) -> Document:
    """Read a document: XML if it begins with ``<``, otherwise text.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    Document

    Raises
    ------
    InputError
        With file, line and column, if it cannot be read or parsed.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "short.bf"
    >>> _ = file.write_text("output y; y = 2;")
    >>> read_formulation(file).mapping.outputs[0].name
    'y'
    """
    text = read_text(path)
    with located(path):
        return parse_xml(text) if text.lstrip().startswith("<") else parse_document(text)


def write_formulation(path: str | PathLike[str], document: Document) -> None:
    """Write a document atomically, as XML if the name ends in ``.xml``, otherwise as text.

    Parameters
    ----------
    path : str or path
        Replaced if it exists.
    document : Document
        What to write.

    Raises
    ------
    InputError
        If the place cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "short.xml"
    >>> write_formulation(file, parse_document("output y; y = 2;"))
    >>> read_formulation(file) == parse_document("output y; y = 2;")
    True
    """
    xml = Path(path).suffix.lower() == ".xml"
    write_atomically(path, (format_xml if xml else format_document)(document).encode())


def read_numbers(path: str | PathLike[str]) -> np.ndarray:
    """Read a table of numbers, separated by commas, semicolons or blanks.

    Lines that begin with ``#`` are comments; a first line with a word in it is a header.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    array, shape (rows, columns)

    Raises
    ------
    InputError
        With file and line, if a line has something else than numbers, or another count of them.
    """
    rows: list[np.ndarray] = []
    header = None
    for number, line in enumerate(text_lines(path), 1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            row = np.array(words, float)
        except ValueError:
            if rows or header:
                raise InputError(f"'{line.strip()}'", "numbers", path, number) from None
            header = words
            continue
        if not np.all(np.isfinite(row)):
            raise InputError(f"'{line.strip()}'", "finite numbers", path, number)
        if rows and len(row) != len(rows[0]):
            raise InputError(f"{len(row)} numbers", f"{len(rows[0])} as above", path, number)
        rows.append(row)
        check_length(len(rows) * len(row), MAX_NUMBERS, path, number)
    if not rows:
        raise InputError("no numbers", "rows of numbers", path)
    return np.array(rows)


def read_tables(
    document: Document, path: str | PathLike[str], data_files: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read the tables of a document, from given files or those it names.

    Parameters
    ----------
    document : Document
        From `read_formulation`.
    path : str or path
        Its file.
    data_files : mapping of str to str
        Files by the name of the table.

    Returns
    -------
    (dict of str to array, dict of str to str)
        Tables and their files, by name.

    Raises
    ------
    InputError
        If a name is not that of a table, a file cannot be read, or a table has another shape than
        the document declares.
    """
    tables = {table.name: table for table in document.mapping.tables}
    for name in data_files:
        if name not in tables:
            raise InputError(f"--data {name}=...", f"a table of it: {', '.join(tables) or 'none'}")
    found, files = {}, {}
    for name, table in tables.items():
        file = files[name] = data_files.get(name, str(Path(path).parent / table.file))
        try:
            found[name] = read_numbers(file)
        except InputError as error:
            if name in data_files or error.found != "no such file":
                raise
            position = table.at
            missing = f"table '{name}' in the file '{table.file}', which is not there"
            raise InputError(
                missing, f"--data {name}=FILE", path, position.line, position.column
            ) from None
        shape = (table.rows, table.columns)
        if None not in shape and found[name].shape != shape:
            size = " x ".join(map(str, found[name].shape))
            expected = f"{table.rows} x {table.columns} as line {table.at.line} of {path} says"
            raise InputError(f"{size} numbers", expected, file)
    return found, files


def solve_formulation(
    document: Document,
    path: str | PathLike[str],
    tables: Mapping[str, np.ndarray] | None = None,
    starts: int = 1,
    values: Mapping[str, Sequence[float]] | None = None,
    gains: Iterable[str] = (),
    **options: Any,
) -> ProblemSolution | Computed:
    """Solve a document, or compute its mapping if it has no objective; errors name its file.

    Parameters
    ----------
    document, tables, starts, values, gains, **options
        As for `beamfit.language.solution.solve_document`.
    path : str or path
        The file of the document.

    Returns
    -------
    ProblemSolution or Computed

    Raises
    ------
    InputError
        With file, line and column.
    """
    with located(path):
        shapes = {n: t.shape for n, t in (tables or {}).items()}
        check_document(document, shapes, values or ())
        values_of(check_mapping(document.mapping, shapes).scope, values or {})
        if document.problem is None:
            from beamfit.language.compiled import compute_document  # JAX from here on

            return compute_document(document, tables, values, gains)
        from beamfit.language.solution import solve_document

        return solve_document(document, tables, starts, values, gains, **options)
