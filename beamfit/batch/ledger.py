"""Ledger of answered files: parts written whole beside the table, and the table made of them."""

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

from beamfit.batch.columns import COLUMNS, KEY, NUMBERS, UNUSABLE
from beamfit.batch.job import Job
from beamfit.errors import InputError
from beamfit.io.files import digest_now
from beamfit.writing import replacing, write_atomically

# Rows converted from text to a table at a time, to bound the memory.
BLOCK = 4096


class RowRange(NamedTuple):
    """Place of a file's rows (bytes of a part), their statuses, and the reason if refused."""

    part: Path
    start: int
    end: int
    sha256: str
    statuses: tuple[str, ...]
    reason: str = ""


class Ledger:
    """The answers to a job, in the folder beside the table they are for.

    Parameters
    ----------
    out : Path
        The table; parts are in ``OUT.parts``, one a task, and never changed.
    job : Job
        What is asked. Parts of other jobs are passed over.
    """

    def __init__(self, out: Path, job: Job) -> None:
        self.out, self.job = out, job
        self.folder = out.with_name(f"{out.name}.parts")
        self.columns = COLUMNS[job.kind]
        self.header = (",".join(self.columns) + "\n").encode()
        self.places: dict[str, RowRange] = {}
        self._next = 0
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            found = f"a place that cannot be written ({error.strerror})"
            raise InputError(found, "a folder for parts", path=self.folder) from None
        for part in sorted(self.folder.glob("[0-9]*.csv")):
            self._next = int(part.name.split("-")[0]) + 1
            self._learn(part, part.read_bytes())

    def answered(self, file: str) -> bool:
        """True if this job has answered the same file before."""
        place = self.places.get(file)
        try:
            return place is not None and place.sha256 == digest_now(file)
        except InputError:
            return False

    def keep(self, text: str) -> None:
        """Write a part."""
        content = self.header + text.encode("utf-8", "replace")
        name = f"{self._next:08d}-{hashlib.sha256(content).hexdigest()[:16]}.csv"
        part, self._next = self.folder / name, self._next + 1
        write_atomically(part, content)
        self._learn(part, content)

    def _learn(self, part: Path, content: bytes) -> None:
        if not content.startswith(self.header):
            return
        found: dict[str, RowRange] = {}
        status, at = self.columns.index("status"), len(self.header)
        for raw in content[at:].splitlines(keepends=True):
            row = next(csv.reader([raw.decode()]))
            end = at + len(raw)
            if tuple(row[2 : len(KEY)]) == self.job.key:
                before = found.get(row[0], RowRange(part, at, at, row[1], ()))
                reason = row[status + 1] if row[status] == UNUSABLE else before.reason
                statuses = (*before.statuses, sys.intern(row[status]))
                found[row[0]] = before._replace(end=end, statuses=statuses, reason=reason)
            at = end
        self.places |= found

    def rows(self, files: Iterable[str]) -> Iterator[bytes]:
        """The lines of some files, in their order."""
        part, stream = None, io.BytesIO()
        for file in files:
            place = self.places[file]
            if place.part != part:
                part, stream = place.part, io.BytesIO(place.part.read_bytes())
            stream.seek(place.start)
            yield from stream.read(place.end - place.start).splitlines(keepends=True)

    def write(self, files: Iterable[str]) -> None:
        """Write the table of some files, in their order."""
        blocks = _blocks(self.rows(files))
        with replacing(self.out) as stream:
            WRITERS[self.out.suffix.lower()](stream, self.job.kind, blocks)


def _blocks(found: Iterator[bytes]) -> Iterator[bytes]:
    while block := b"".join(islice(found, BLOCK)):
        yield block


def _csv(stream: BinaryIO, kind: str, blocks: Iterator[bytes]) -> None:
    stream.write((",".join(COLUMNS[kind]) + "\n").encode())
    for block in blocks:
        stream.write(block)


def _parquet(stream: BinaryIO, kind: str, blocks: Iterator[bytes]) -> None:
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
    import h5py

    with h5py.File(stream, "w") as store:
        for name in COLUMNS[kind]:
            dtype = float if name in NUMBERS[kind] else h5py.string_dtype()
            store.create_dataset(name, (0,), dtype, maxshape=(None,), chunks=(BLOCK,))
        for block in blocks:
            columns = zip(*csv.reader(io.StringIO(block.decode())), strict=True)
            for name, cells in zip(COLUMNS[kind], columns, strict=True):
                _append(store[name], cells)


def _append(data: Any, cells: tuple[str, ...]) -> None:
    before = len(data)
    data.resize((before + len(cells),))
    numbers = data.dtype == float
    data[before:] = np.array([float(c or "nan") for c in cells]) if numbers else list(cells)


WRITERS = {".csv": _csv, ".parquet": _parquet, ".h5": _hdf5, ".hdf5": _hdf5}
