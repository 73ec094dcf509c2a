"""The one reader of columns: however a file is laid out, it is the same table, or a place named."""

import hashlib

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamfit.errors import InputError
from beamfit.io.columns import UNITS, Sheet, columns_of
from beamfit.io.table import read_sheet
from tests.io.forked import in_forks  # noqa: F401

EXAMPLE = "s_m,beta_x_m"
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
ROWS = st.integers(1, 4).flatmap(
    lambda width: st.lists(
        st.lists(NUMBERS, min_size=width, max_size=width), min_size=1, max_size=8
    )
)
BETWEEN = st.lists(st.sampled_from(["", "  ", "# noon", "#", " # 1,2;3", ",,", ";"]), max_size=3)

# As editors and spreadsheets save text: Excel's "Unicode text" is UTF-16.
CODES = ["utf-8", "utf-8-sig", "utf-16-le", "utf-16-be"]


def fill(path, lines, end="\n", code="utf-8"):
    start = "\ufeff" if code.endswith("e") else ""  # the other codes write the mark themselves
    path.write_bytes((start + end.join(lines)).encode(code))
    return read_sheet(path, EXAMPLE)


@given(ROWS, st.data())
def test_separators_comments_blanks_and_quotes_change_nothing(tmp_path_factory, rows, data):
    separator = data.draw(st.sampled_from([",", ";", "\t", " ", " , ", "  "]))
    quote = data.draw(st.sampled_from(["", '"']))
    names = [f"column{i}" for i in range(len(rows[0]))]
    lines, places = [], []
    for cells in [names, *[[repr(v) for v in row] for row in rows]]:
        lines += data.draw(BETWEEN)
        lines.append(separator.join(quote + cell + quote for cell in cells))
        places.append(len(lines))
    path = tmp_path_factory.getbasetemp() / "laid_out.csv"
    end = data.draw(st.sampled_from(["\n", "\r\n"]))
    sheet = fill(path, lines, end, data.draw(st.sampled_from(CODES)))
    assert list(sheet.names) == names
    assert (sheet.header, sheet.lines) == (places[0], places[1:])
    found = np.transpose([sheet.numbers(name) for name in names])
    np.testing.assert_array_equal(found, rows)
    assert len(sheet.comments) == sum("#" in line for line in lines)


@given(ROWS, st.data())
def test_a_row_with_another_number_of_cells_is_named(tmp_path_factory, rows, data):
    separator = data.draw(st.sampled_from([",", ";", "\t"]))
    width, wrong = len(rows[0]) + 1, data.draw(st.integers(0, len(rows) - 1))
    lines = [separator.join(f"c{i}" for i in range(width))]
    lines += [
        separator.join(map(repr, [*row, 1.0][: width - (i == wrong)])) for i, row in enumerate(rows)
    ]
    with pytest.raises(InputError, match=f"{width - 1} cells; expected {width}") as raised:
        fill(tmp_path_factory.getbasetemp() / "ragged.csv", lines)
    assert raised.value.line == wrong + 2


@given(ROWS, st.data())
def test_a_cell_that_is_no_number_is_named(tmp_path_factory, rows, data):
    row = data.draw(st.integers(0, len(rows) - 1))
    column = data.draw(st.integers(0, len(rows[0]) - 1))
    word, expected = data.draw(
        st.sampled_from(
            [
                ("x", "a number"),
                ("1,5", "a decimal point"),
                ("nan", "a finite number"),
                ("", "a number"),
            ]
        )
    )
    cells = [[repr(v) for v in values] for values in rows]
    cells[row][column] = word
    lines = [";".join(f"c{i}" for i in range(len(rows[0])))]
    lines += [";".join([*line, "1"]) for line in cells]
    lines[0] += ";last"
    sheet = fill(tmp_path_factory.getbasetemp() / "words.csv", lines)
    with pytest.raises(InputError, match=expected) as raised:
        sheet.numbers(f"c{column}")
    assert (raised.value.line, raised.value.column) == (row + 2, f"c{column}")


def test_tfs_has_descriptors_types_and_quoted_names(tmp_path):
    lines = [
        '@ NAME %05s "TWISS"',
        "* name s betx",
        "$ %s %le %le",
        ' "a drift" 0.0 1.5',
        ' "Q" 1.0 2.5',
    ]
    sheet = fill(tmp_path / "ring.tfs", lines)
    assert sheet.names == ("NAME", "S", "BETX")
    assert list(sheet["NAME"]) == ["a drift", "Q"]
    assert sheet.numbers("BETX").tolist() == [1.5, 2.5]
    assert sheet.comments[0] == '@ NAME %05s "TWISS"'


@given(ROWS)
@settings(max_examples=8)
def test_hdf5_holds_the_same_numbers(tmp_path_factory, rows):
    path = tmp_path_factory.getbasetemp() / "same.h5"
    with h5py.File(path, "w") as store:
        for i, column in enumerate(np.transpose(rows)):
            store[f"column{i}"] = column
    sheet = read_sheet(path, EXAMPLE)
    np.testing.assert_array_equal(np.transpose([sheet.numbers(n) for n in sheet.names]), rows)


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        (b"", None, "an empty file"),
        (b"\n  \n", None, "no header"),
        (b"# only words\n", None, "no header"),
        (b"1;2\n3;4\n", 1, "numbers where the header should be"),
        (b"a,b\n1,2\n\x00\x01\n", 3, "binary"),
        (b"a,b\n1,2\n\xe9,3\n", 3, "UTF-8"),
        (b'a,b\n1,"2\n3",4\n', 2, "quotation mark that does not end"),
        (b'* A B\n$ %le %le\n1 "2\n', 3, "quotation mark that does not end"),
        (b'format = "beamfit-lattice-1"\n[[element]]\n', 1, "a lattice"),
    ],
)
def test_what_is_no_table_is_named(tmp_path, content, line, words):
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as raised:
        read_sheet(path, EXAMPLE)
    assert raised.value.line == line
    assert str(raised.value).startswith(str(path))


def test_units_are_those_of_the_quantity():
    for kind, units in UNITS.items():
        for unit, factor in units.items():
            sheet = Sheet("a.csv", (f"name_{unit}",), [["1"]], [2], 1, ())
            assert columns_of(sheet, {"name": kind})["name"].factor == factor
    sheet = Sheet("a.csv", ("pressure_inch",), [["1"]], [2], 1, ())
    with pytest.raises(InputError, match="unknown unit 'inch'; expected one of Pa, mbar"):
        columns_of(sheet, {"pressure": "pressure"})
    sheet = Sheet("a.csv", ("presure_Pa",), [["1"]], [2], 1, ())
    with pytest.raises(InputError, match=r"did you mean pressure_Pa\?"):
        columns_of(sheet, {"pressure": "pressure"})


def test_the_unicode_text_of_excel_is_read_with_its_commas_and_its_own_digest(tmp_path):
    file = tmp_path / "a.txt"
    text = "Größe\tsize x [µm]\r\n" + "".join(f"{k}\t{k},5\r\n" for k in range(30_000))
    file.write_bytes(text.encode("utf-16"))
    sheet = read_sheet(file, EXAMPLE)
    assert sheet.names == ("Größe", "size x [µm]")
    assert sheet.numbers("size x [µm]").tolist() == [k + 0.5 for k in range(30_000)]
    assert sheet.sha256 == hashlib.sha256(file.read_bytes()).hexdigest()
