"""Ledger of answered files: parts, each written atomically, and the table made from them."""

from __future__ import annotations

import csv
import hashlib
import io
import sys
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from beamfit.batch.columns import COLUMNS, KEY_COLUMNS, NUMBERS, UNUSABLE
from beamfit.batch.job import Job
from beamfit.batch.request import TABLE_SUFFIXES
from beamfit.errors import InputError
from beamfit.io.files import digest_now
from beamfit.writing import replacing, write_atomically

# Rows converted from text to a table at a time, to limit the memory.
BLOCK_ROWS = 4096


class RowRange(NamedTuple):
    """Rows of a file: bytes in a part, statuses, and the reason if it is unusable."""

    part: Path
    start: int
    end: int
    sha256: str
    statuses: tuple[str, ...]
    reason: str = ""


class Ledger:
    """Answers of a job, kept in a folder next to the table.

    Parameters
    ----------
    out : Path
        The table. Parts are in ``OUT.parts``, one for each task, and are never changed.
    job : Job
        The job; parts of other jobs are ignored.
    """

    def __init__(self, out: Path, job: Job) -> None:
        self.out, self.job = out, job
        self.folder = out.with_name(f"{out.name}.parts")
        self.columns = COLUMNS[job.kind]
        self.header = (",".join(self.columns) + "\n").encode()
        self.places: dict[str, RowRange] = {}
        self._next_number = 0
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            found = f"a place that cannot be written ({error.strerror})"
            raise InputError(found, "a folder for parts", path=self.folder) from None
        for part in sorted(self.folder.glob("[0-9]*.csv")):
            self._next_number = int(part.name.split("-")[0]) + 1
            self._index_part(part, part.read_bytes())

    def has_answer(self, file: str) -> bool:
        """True if the job has an answer for a file with the present content."""
        place = self.places.get(file)
        try:
            return place is not None and place.sha256 == digest_now(file)
        except InputError:
            return False

    def add_part(self, text: str) -> None:
        """Write a part, and index it."""
        content = self.header + text.encode("utf-8", "replace")
        name = f"{self._next_number:08d}-{hashlib.sha256(content).hexdigest()[:16]}.csv"
        part, self._next_number = self.folder / name, self._next_number + 1
        write_atomically(part, content)
        self._index_part(part, content)

    def _index_part(self, part: Path, content: bytes) -> None:
        """Record where the rows of each file are in a part, if they belong to this job."""
        if not content.startswith(self.header):
            return
        ranges: dict[str, RowRange] = {}
        status, position = self.columns.index("status"), len(self.header)
        for raw in content[position:].splitlines(keepends=True):
            row = next(csv.reader([raw.decode()]))
            end = position + len(raw)
            if tuple(row[2 : len(KEY_COLUMNS)]) == self.job.key:
                row_range = ranges.get(row[0], RowRange(part, position, position, row[1], ()))
                reason = row[status + 1] if row[status] == UNUSABLE else row_range.reason
                statuses = (*row_range.statuses, sys.intern(row[status]))
                ranges[row[0]] = row_range._replace(end=end, statuses=statuses, reason=reason)
            position = end
        self.places |= ranges

    def rows(self, files: Iterable[str]) -> Iterator[bytes]:
        """Lines of CSV of files, in their order."""
        part, stream = None, io.BytesIO()
        for file in files:
            place = self.places[file]
            if place.part != part:
                part, stream = place.part, io.BytesIO(place.part.read_bytes())
            stream.seek(place.start)
            yield from stream.read(place.end - place.start).splitlines(keepends=True)

    def write(self, files: Iterable[str]) -> None:
        """Write the table of files, in their order."""
        blocks = _blocks(self.rows(files))
        with replacing(self.out) as stream:
            WRITERS[self.out.suffix.lower()](stream, self.job.kind, blocks)


def _blocks(found: Iterator[bytes]) -> Iterator[bytes]:
    """Join rows to blocks of `BLOCK_ROWS`."""
    while block := b"".join(islice(found, BLOCK_ROWS)):
        yield block


def _csv(stream: BinaryIO, kind: str, blocks: Iterator[bytes]) -> None:
    """Write blocks of rows as CSV."""
    stream.write((",".join(COLUMNS[kind]) + "\n").encode())
    for block in blocks:
        stream.write(block)


def _parquet(stream: BinaryIO, kind: str, blocks: Iterator[bytes]) -> None:
    """Write blocks of rows as Parquet."""
    import pyarrow as arrow
    from pyarrow import csv as arrow_csv
    from pyarrow import parquet

    types = {n: arrow.float64() if n in NUMBERS[kind] else arrow.string() for n in COLUMNS[kind]}
    read = arrow_csv.ReadOptions(column_names=list(types))
    convert = arrow_csv.ConvertOptions(column_types=types, null_values=[""])
    with parquet.ParquetWriter(stream, arrow.schema(types)) as writer:
        for block in blocks:
            buffer = io.BytesIO(block)
            writer.write_table(arrow_csv.read_csv(buffer, read, convert_options=convert))


def _hdf5(stream: BinaryIO, kind: str, blocks: Iterator[bytes]) -> None:
    """Write blocks of rows as HDF5, one dataset for each column."""
    import h5py

    with h5py.File(stream, "w") as store:
        for name in COLUMNS[kind]:
            dtype = float if name in NUMBERS[kind] else h5py.string_dtype()
            store.create_dataset(name, (0,), dtype, maxshape=(None,), chunks=(BLOCK_ROWS,))
        for block in blocks:
            columns = zip(*csv.reader(io.StringIO(block.decode())), strict=True)
            for name, cells in zip(COLUMNS[kind], columns, strict=True):
                _append_cells(store[name], cells)


def _append_cells(data: Any, cells: tuple[str, ...]) -> None:
    """Append cells to a dataset; empty numbers are NaN."""
    before = len(data)
    data.resize((before + len(cells),))
    numbers = data.dtype == float
    data[before:] = np.array([float(c or "nan") for c in cells]) if numbers else list(cells)


WRITERS = dict(zip(TABLE_SUFFIXES, (_csv, _parquet, _hdf5, _hdf5), strict=True))
