"""A scan's columns from the datasets of an HDF5 file."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from beamfit.errors import InputError
from beamfit.io.columns import MOST_ROWS, Column, Table, check_header, column_of
from beamfit.io.files import digest

if TYPE_CHECKING:
    import h5py

__all__ = ["read_hdf5"]


def read_hdf5(path: str | PathLike[str]) -> Table:
    """Read one dataset a column, under the names a CSV header would have.

    Raises
    ------
    InputError
        If the file is not HDF5, is damaged, or a dataset is no column of numbers or text.
    """
    import h5py

    digest(path)  # says what is wrong with the path itself
    try:
        with h5py.File(path, "r") as store:
            names = [n for n in store if isinstance(store.get(n), h5py.Dataset)]
            if not names:
                raise InputError("no datasets", "one dataset a column, as size_x_um", path=path)
            columns = [column_of(n, path, None) for n in names]
            cells = [_cells(store[c.header], c, path) for c in columns]
            provenance = [f"{key}: {value}" for key, value in store.attrs.items()]
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError, TypeError, KeyError):
        raise InputError(
            "a file that is not HDF5, or is damaged", "an HDF5 file; text is .csv", path=path
        ) from None
    lengths = {c.header: len(d) for c, d in zip(columns, cells, strict=True)}
    if len(set(lengths.values())) > 1:
        raise InputError(f"datasets of lengths {lengths}", "one length for all", path=path)
    table = Table(path, columns, provenance=provenance)
    check_header(table, None)
    table.cells = [list(row) for row in zip(*cells, strict=True)]
    table.lines = list(range(1, len(table.cells) + 1))
    return table


def _cells(data: h5py.Dataset, column: Column, path: str | PathLike[str]) -> list[str]:
    """Write the values of a dataset as a CSV file would have them."""
    import h5py

    def error(found: str, expected: str) -> InputError:
        return InputError(found, expected, path=path, column=column.header)

    if data.shape is None or data.ndim > 1:
        raise error(f"a dataset of shape {data.shape}", "a one-dimensional dataset")
    if data.size > MOST_ROWS:
        raise error(f"more than {MOST_ROWS} rows", "a scan of settings")
    if h5py.check_string_dtype(data.dtype) is not None:
        try:
            return [str(v) for v in np.atleast_1d(data.asstr("utf-8")[()])]
        except UnicodeDecodeError:
            raise error("bytes that are not text", "UTF-8 text") from None
    if data.dtype.kind not in "iuf":
        raise error(f"values of type {data.dtype}", "numbers or text")
    return [repr(float(v)) for v in np.atleast_1d(data[()])]
