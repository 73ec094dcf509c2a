"""Decimal commas of a whole table are read, and never mistaken for anything else."""

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.scan import read_quad_scan

HEAD = "Q1_A,size_x_mm,size_x_error_mm\n"
ROWS = "-2.5,0.1114,0.0011\n-1.5,0.0634,0.0003\n0,0.0536,0.0003\n1.5,0.0567,0.0005\n"


def european(text, separator):
    return text.replace(",", separator).replace(".", ",")


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_scan_of_a_european_spreadsheet_is_that_with_points(separator, tmp_path):
    (tmp_path / "a.csv").write_text(european(HEAD + ROWS, separator))
    (tmp_path / "b.csv").write_text(HEAD + ROWS)
    found, plain = (read_quad_scan(tmp_path / name) for name in ("a.csv", "b.csv"))
    np.testing.assert_array_equal(found.size["x"], plain.size["x"])
    np.testing.assert_array_equal(found.settings["Q1"], plain.settings["Q1"])
    assert found.notes == ("Numbers have a decimal comma: '-2,5' is -2.5.",)


@pytest.mark.parametrize(
    ("separator", "rows"),
    [
        (";", ["0;1,5;1", "1;2.5;1", "2;3,5;1", "3;4,5;1"]),  # points too
        (";", ["0;1,5;1", "1;2,5;1", "2;3;1", "3;4;1"]),  # two may be slips
        ("\t", ["0\t1,500\t1", "1\t2,500\t1", "2\t3,500\t1"]),  # thousands, or not
    ],
)
def test_what_may_be_something_else_is_refused(separator, rows, tmp_path):
    (tmp_path / "a.csv").write_text(HEAD.replace(",", separator) + "\n".join(rows) + "\n")
    with pytest.raises(InputError, match=r":2: column 'size_x_mm': '1,50*'; .* decimal point"):
        read_quad_scan(tmp_path / "a.csv")
