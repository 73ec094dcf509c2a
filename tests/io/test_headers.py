"""Headers as laboratories write them are read as those of the manual."""

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.check import file_summary, proposed_layout
from beamfit.io.columns import standard_header
from beamfit.io.decay_record import read_decay_record
from beamfit.io.scan import read_quad_scan

ROWS = "-4.2,111.4,1.1\n-3.2,63.4,0.3\n-2.6,53.6,0.3\n-2.1,56.7,0.5\n"
# What stands above the rows -> how many lines it has.
HEADS = {
    "the manual's": "Q525_kG,size_x_um,size_x_error_um\n",
    "square brackets": "Q525 [kG],size_x [um],size_x_error [um]\n",
    "round ones": "Q525 (kG),Size X (µm),Size X Error (µm)\n",
    "a stroke": "Q525 / kG,size_x / um,size_x_error / um\n",
    "blanks": "Q525 kG,size x um,size x error um\n",
    "capitals": "Q525_KG,SIZE_X_UM,SIZE_X_ERROR_UM\n",
    "a row of units": "Q525,size_x,size_x_error\nkG,um,um\n",
    "units in brackets": "Q525,size_x,size_x_error\n[kG],[µm],[µm]\n",
    "a title": "Scan of Q525 on Monday\n\nQ525_kG,size_x_um,size_x_error_um\n",
    "comments of MATLAB": "% by me\nQ525_kG,size_x_um,size_x_error_um\n",
    "hidden by MATLAB": "% by me\n%Q525_kG,size_x_um,size_x_error_um\n",
    "names and numbers": "By,me\nEnergy,135\n\nQ525_kG,size_x_um,size_x_error_um\n",
    "several": "Date: 2024-03-01, night\nBy: A, B, C\nQ525_kG,size_x_um,size_x_error_um\n",
}


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("code", ["utf-8", "cp1252"])
def test_a_scan_is_the_same_under_every_header(head, code, tmp_path):
    (tmp_path / "a.csv").write_bytes((HEADS[head] + ROWS).encode(code))
    (tmp_path / "b.csv").write_text(HEADS["the manual's"] + ROWS)
    found, plain = (read_quad_scan(tmp_path / name) for name in ("a.csv", "b.csv"))
    assert found.units == {"Q525": "kG"}
    np.testing.assert_array_equal(found.rows("x").size, plain.rows("x").size)
    np.testing.assert_array_equal(found.error["x"], plain.error["x"])
    assert file_summary(tmp_path / "a.csv").kind == "scan"


def test_what_stands_above_a_header_is_kept_as_comments(tmp_path):
    (tmp_path / "a.csv").write_text(HEADS["several"] + ROWS)
    assert read_quad_scan(tmp_path / "a.csv").provenance == (
        "Date: 2024-03-01, night",
        "By: A, B, C",
    )


def test_a_wrong_number_is_named_in_its_line_and_by_the_header_of_the_file(tmp_path):
    (tmp_path / "a.csv").write_text(
        HEADS["several"].replace("size_x_um", "size_x [um]") + "1,x,1\n"
    )
    with pytest.raises(InputError, match=r"a\.csv:4: column 'size_x \[um\]': 'x'"):
        read_quad_scan(tmp_path / "a.csv")


def test_a_record_of_a_logger_is_read(tmp_path):
    rows = "".join(f"{t / 60},{500 - t / 10}\n" for t in range(9))
    (tmp_path / "a.csv").write_text("Storage ring, decay\nTime [h],Beam Current (mA)\n" + rows)
    (tmp_path / "b.csv").write_text("time_h,beam_current_mA\n" + rows)
    found, plain = (read_decay_record(tmp_path / name) for name in ("a.csv", "b.csv"))
    np.testing.assert_array_equal(found.time, plain.time)
    np.testing.assert_array_equal(found.current, plain.current)
    assert file_summary(tmp_path / "a.csv").kind == "record"


def test_scans_and_records_in_each_others_place_are_told_so(tmp_path):
    (tmp_path / "decay.csv").write_text("time_s,beam_current_mA\n0,5\n1,4\n")
    for head in HEADS["the manual's"], "Q525_A,x_rms_um,x_rms_err_um\n", "Q525,size_x,note_a\n":
        (tmp_path / "scan.csv").write_text(head + ROWS)
        with pytest.raises(InputError, match="`beamfit emittance` reads scans"):
            read_decay_record(tmp_path / "scan.csv")
    with pytest.raises(InputError, match="`beamfit lifetime` reads it"):
        read_quad_scan(tmp_path / "decay.csv")


def test_units_that_could_mean_another_are_left_as_they_stand():
    same = ("rf_voltage_mv", "Q_a", "Q552_mA2", "size_x", "SR:DCCT:CURRENT", "note_by hand")
    assert [standard_header(header) for header in same] == list(same)


def test_an_index_without_a_name_is_ignored(tmp_path):
    text = ",Q525_kG,size_x_um\n0,-4.2,111.4\n1,-3,63\n2,2,98\n"
    (tmp_path / "a.csv").write_text(text)
    scan = read_quad_scan(tmp_path / "a.csv")
    assert scan.settings["Q525"].tolist() == [-4.2, -3, 2]
    np.testing.assert_allclose(scan.size["x"], [111.4e-6, 63e-6, 98e-6])
    assert file_summary(tmp_path / "a.csv").kind == "scan"


def test_a_header_behind_a_mark_may_stand_above_dates(tmp_path):
    rows = "".join(f"2024/03/01 12:00:0{s}.25\t{500 - s}\n" for s in range(4))
    (tmp_path / "a.txt").write_text("# Data Browser\n#Time\tSR:I\n" + rows)
    record = read_decay_record(tmp_path / "a.txt", columns="SR:I=beam_current_mA")
    assert record.current.tolist() == [500, 499, 498, 497]


def test_shots_side_by_side_and_errors_of_nothing_are_told_what_to_do(tmp_path):
    (tmp_path / "a.csv").write_text("Q525_kG,size_x_um_1,size_x_um_2\n" + ROWS)
    with pytest.raises(InputError, match="'size_x_um_1': a size with a number behind it: shots"):
        read_quad_scan(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("Q525_kG,size_x_um,err_x_mm\n" + ROWS)
    with pytest.raises(InputError, match="size_x_error_mm is that of a size"):
        read_quad_scan(tmp_path / "b.csv")
    assert '"err_x_mm" = "size_x_error_mm"' in proposed_layout(tmp_path / "b.csv")
