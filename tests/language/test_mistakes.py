"""Mistakes of many kinds: line, column and culprit are named. The table is mistakes.txt."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest

from beamfit.errors import InputError
from beamfit.io.formulation import read_numbers
from beamfit.language.parse import parse_document
from beamfit.language.plan import check_document
from beamfit.language.problem import formulate, starts_of
from beamfit.language.trace import cause_of
from tests.language.documents import SHORT

LINES = (Path(__file__).parent / "mistakes.txt").read_text().splitlines()


class Mistake(NamedTuple):
    """A row of the table."""

    document: str
    old: str
    new: str
    culprit: str
    said: tuple[str, ...]


def rows():
    for line in LINES:
        if line and not line.startswith("#"):
            document, old, new, culprit, said = line.replace("\\n", "\n").split(" ~ ")
            words = tuple(said.split(" && "))
            yield Mistake(document, old, new, culprit, words)


def place_of(text, at, mistake):
    """Line and column of the culprit, counted from 1."""
    if mistake.culprit.startswith("^"):
        found = text.index(mistake.culprit[1:])
    elif mistake.culprit.startswith(";"):
        found = text.index(mistake.culprit[1:]) + len(mistake.culprit) - 1
    else:
        found = at + mistake.new.index(mistake.culprit)
    return text.count("\n", 0, found) + 1, found - text.rfind("\n", 0, found)


def diagnosis(text, tables):
    """What is said of a document: line, column, words."""
    try:
        document = parse_document(text)
        tables = tables if document.mapping.tables else {}
        check_document(document, {name: table.shape for name, table in tables.items()})
        made = formulate(document, tables)
    except InputError as error:
        return error.line, error.column, str(error)
    goals = [g.model for g in document.problem.goals] if document.problem else []
    said = cause_of(made.program, next(starts_of(made)), goals) or "line 0, column 0"
    line, column = re.search(r"line (\d+), column (\d+)", said).groups()
    return int(line), int(column), said


@pytest.fixture(scope="module")
def texts(root):
    long = {p.stem: p.read_text() for p in (root / "formulations").glob("*.bf")}
    return long | SHORT


@pytest.fixture(scope="module")
def tables(root):
    return {"d": read_numbers(root / "formulations/fitdata_simulated.csv")}


def test_there_are_two_hundred_of_a_dozen_documents():
    table = list(rows())
    assert len(table) == len(set(table)) >= 200
    assert len({row.document for row in table}) >= 11


@pytest.mark.parametrize("document", sorted({row.document for row in rows()}))
def test_line_column_and_culprit_are_named(texts, tables, document):
    missed = []
    for row in (row for row in rows() if row.document == document):
        text = texts[row.document]
        assert row.old in text, row
        at = text.index(row.old)
        wrong = text.replace(row.old, row.new, 1)
        line, column, said = diagnosis(wrong, tables)
        right = (line, column) == place_of(wrong, at, row) and all(w in said for w in row.said)
        if not right:
            missed.append(
                (row.old, row.new, place_of(wrong, at, row), row.said, line, column, said)
            )
    assert not missed, "\n".join(map(str, missed))
