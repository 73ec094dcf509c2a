"""The fast way through a table gives what the slow one gives, or nothing."""

from pathlib import Path

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io import cells, table
from beamfit.io.decay_record import read_decay_record

DATA = ("measurements", "tests/golden/data")
SHIPPED = [path for folder in DATA for path in sorted(Path(folder).glob("*.csv"))]
HEAD = "time_s,beam_current_mA\n"
GOOD = {
    "plain": HEAD + "0,100\n1,99.5\n2,99",
    "crlf": (HEAD + "0,100\n1,99.5\n2,99\n").replace("\n", "\r\n"),
    "blanks": "time_s beam_current_mA\n 0  1e2\n1 99.5 \n",
    "semicolons": "time_s;beam_current_mA\n0; 100\n+1 ;.995E2\n",
    "comments first": "# a\n\n" + HEAD + "0,100\n1,99\n",
    "an index without a name": ",time_s,beam_current_mA\n0,0,100\n1,1,99\n",
    "units below": "time,beam_current\ns,mA\n0,100\n1,99\n",
}
OTHER = {
    "blank line": HEAD + "0,100\n\n1,99\n",
    "comment": HEAD + "0,100\n# refill\n1,99\n",
    "comment behind": HEAD + "0,100\n1,99 # refill\n",
    "not finite": HEAD + "0,100\n1,nan\n",
    "overflow": HEAD + "0,100\n1,1e999\n",
    "word": HEAD + "0,100\n1,off\n",
    "missing": HEAD + "0,100\n1,\n",
    "one cell": HEAD + "0,100\n1\n",
    "three cells": HEAD + "0,100\n1,2,3\n",
    "separator at the end": HEAD + "0,100,\n1,99,\n",
    "quotes": HEAD + '"0","100"\n1,99\n',
    "decimal comma": "time_s;beam_current_mA\n0;100,5\n1;99\n",
    "form feed": HEAD + "0,100\f1,99\n2,98\n",
    "carriage return": HEAD + "0,100\r1,99\n2,98\n",
    "underscore": HEAD + "0,1_00\n1,99\n",
    "two numbers": HEAD + "0,100 5\n1,99\n",
    "not text": HEAD + "0,100\n1,\xff\n",
    "dates": "time,beam_current_mA\n2024-03-01T12:00:00,100\n2024-03-01T12:01:00,99\n",
    "times without a unit": "time,beam_current_mA\n0,100\n1,99\n",
}


def outcome(path):
    """Columns and lines, or the error."""
    try:
        sheet = table.read_sheet(path, "time_s")
        numbers = []
        for name in sheet.names:
            try:
                numbers.append(sheet.numbers(name).tolist())
            except InputError as error:
                numbers.append(str(error))
        return (sheet.names, numbers, list(sheet.lines), sheet.header, sheet.comments, sheet.sha256)
    except InputError as error:
        return str(error)


def both(path, monkeypatch):
    slow = outcome(path)
    monkeypatch.setattr(cells, "MIN_FAST_BYTES", 0)
    calls = []

    def watched(*arguments):
        calls.append(cells.numeric_rows(*arguments))
        return calls[-1]

    monkeypatch.setattr(table, "numeric_rows", watched)
    return slow, outcome(path), any(call is not None for call in calls)


@pytest.mark.parametrize("path", SHIPPED, ids=str)
def test_shipped_tables_are_the_same_either_way(path, monkeypatch):
    slow, fast, _ = both(path, monkeypatch)
    assert fast == slow


@pytest.mark.parametrize("name", [*GOOD, *OTHER])
def test_odd_tables_are_the_same_either_way(name, tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    path.write_bytes((GOOD | OTHER)[name].encode("latin-1"))
    slow, fast, used = both(path, monkeypatch)
    assert fast == slow
    assert used == (name in GOOD)


def test_blocks_are_joined_at_lines(tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "BLOCK_BYTES", 1000)
    values = np.random.default_rng(1).normal(size=(500, 2)).round(6)
    path = tmp_path / "a.csv"
    path.write_text(HEAD + "\n".join(f"{a},{b}" for a, b in values))
    slow, fast, used = both(path, monkeypatch)
    assert used
    assert fast == slow


def test_a_large_record_names_the_line_of_a_bad_cell(tmp_path):
    rows = [f"{k},{500 - k / 1e4:.4f}" for k in range(100_000)]
    path = tmp_path / "a.csv"
    path.write_text(HEAD + "\n".join(rows) + "\n")
    assert len(read_decay_record(path)) == 100_000
    rows[99_990] = "99990,Disconnected"
    path.write_text(HEAD + "\n".join(rows) + "\n")
    with pytest.raises(InputError, match=r"99992.*Disconnected"):
        read_decay_record(path)
    rows[99_990] = "99990,-1"
    path.write_text(HEAD + "\n".join(rows) + "\n")
    with pytest.raises(InputError, match="99992"):
        read_decay_record(path)
    assert len(read_decay_record(path, skip_bad=True)) == 99_999
