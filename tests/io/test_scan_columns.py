"""What the header of a scan may be called, and what is done to rows that cannot be used."""

import itertools
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamfit.errors import InputError
from beamfit.io.scan import read_quad_scan

ROWS = [(-4.0, 111.5, 1.5), (-3.0, 60.0, 0.5), (-1.0, 104.0, 1.0)]
METRES = np.array([111.5e-6, 60e-6, 104e-6])


@pytest.fixture
def read(tmp_path):
    def from_text(content, **options):
        path = tmp_path / "scan.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_quad_scan(path, **options)

    return from_text


def table(header, rows=ROWS, end="\n"):
    return end.join([",".join(header), *(",".join(map(repr, row)) for row in rows)]) + end


NAMES = [
    "size_x_um",
    "x_size_um",
    "sigma_x_um",
    "x_sigma_um",
    "rms_x_um",
    "x_rms_um",
    "xrms_um",
    "sigmax_um",
    "sigx_um",
    "rms_size_x_um",
    "beam_size_x_um",
    "Sigma_X_um",
    "size_x_rms_µm",
    "σx [µm]",
    "sx (um)",
    "Horizontal beam size (um)",
    "sigma_h_um",
    "sigma_x_fit_um",
    "x_rms_nm",
    "sigma_x_cm",
]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_a_size(name, read):
    factor = {"nm": 1e3, "cm": 1e-4}.get(name[-2:], 1.0)
    rows = [(q, factor * s, e) for q, s, e in ROWS]
    scan = read(table(["Q_A", name, "size_x_error_um"], rows))
    np.testing.assert_allclose(scan.size["x"], METRES, rtol=1e-14)
    assert scan.columns["size_x"] == name
    assert scan.notes == ()


@pytest.mark.parametrize("word", ["error", "err", "std", "sd"])
@pytest.mark.parametrize("parts", list(itertools.permutations(["sigma", "y", "ERR"])))
def test_names_of_an_error(parts, word, read):
    name = "_".join(word if part == "ERR" else part for part in parts)
    for header in (f"{name}_mm", f"sigma_y_mm_{word}"):
        scan = read(table(["Q_A", "y_rms_mm", header]))
        np.testing.assert_allclose(scan.error["y"], [1.5e-3, 0.5e-3, 1e-3], rtol=1e-14)


@pytest.mark.parametrize("unit", ["m", "mm", "um"])
def test_a_fwhm_is_that_of_a_gaussian(unit, read):
    factor = {"m": 1e-6, "mm": 1e-3, "um": 1.0}[unit]
    rows = [(q, factor * s, factor * e) for q, s, e in ROWS]
    scan = read(table(["Q_A", f"fwhm_x_{unit}", f"fwhm_x_err_{unit}"], rows))
    # A Gaussian falls to one half at sqrt(2 ln 2) on either side.
    half = np.exp(-0.5 * (0.5 * METRES / scan.size["x"]) ** 2)
    np.testing.assert_allclose(half, 0.5, rtol=1e-12)
    np.testing.assert_allclose(scan.error["x"], np.array([1.5, 0.5, 1]) * 1e-6 / 2.354820045)
    assert scan.notes == (
        f"Sizes are FWHM/2.3548 of fwhm_x_{unit}, which is their rms for a Gaussian profile only.",
    )


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (["Q_A", "fwhm_x_um", "size_x_error_um"], "FWHM"),
        (["Q_A", "size_x_um", "fwhm_x_error_um"], "FWHM"),
        (["Q_A", "size_x_sigma_um", "note_"], "size_x_um"),
        (["Q_A", "sigma_xy_um", "note_"], "coupled"),
        (["Q_A", "size_x_um", "sigma_x_mm"], "twice"),
        (["Q_T_per_m", "Q_A", "size_x_mm"], "twice"),
        (["Q_A", "size_x_um", "pressure_mbar"], "--ignore"),
        (["Q_A", "size_x_um", "sigma_y_err_um"], "size_y_um"),
        (["Q_A", "size_x_um", "size_y_T_per_m"], "size_y_um"),
        (["energy_MeV", "momentum_MeV", "size_x_um"], "magnet"),
    ],
)
def test_names_that_are_not_understood(header, words, read):
    with pytest.raises(InputError, match=words) as raised:
        read(table(header))
    assert raised.value.line == 1


def test_the_gradient_itself_is_a_setting(read):
    scan = read(table(["Q1_T_per_m", "size_x_um", "size_x_error_um"]))
    assert (scan.units, scan.columns["Q1"]) == ({"Q1": "T_per_m"}, "Q1_T_per_m")


@pytest.mark.parametrize(
    ("name", "value", "total"),
    [
        ("energy_MeV", 988.0, 988.0),
        ("kinetic_energy_MeV", 50.0, 50.0 + 938.27208943),
        ("momentum_MeV", 300.0, math.sqrt(300.0**2 + 938.27208943**2)),
    ],
)
def test_momentum_and_kinetic_energy_wait_for_the_particle(name, value, total, read):
    scan = read(table(["Q_A", "size_x_um", name], [(q, s, value) for q, s, _ in ROWS]))
    found = scan.of_particle(938.27208943)
    np.testing.assert_allclose(found.energy, total, rtol=1e-15)
    assert found.of_particle(0.511) is found


def test_one_energy_column_is_enough(read):
    header = ["Q_A", "size_x_um", "energy_MeV", "momentum_MeV"]
    with pytest.raises(InputError, match="one of them"):
        read(table(header, [(q, s, 100.0, 99.0) for q, s, _ in ROWS]))
    with pytest.raises(InputError, match="momentum"):
        read(table(["Q_A", "size_x_um", "momentum_MeV"], [(q, s, 0.0) for q, s, _ in ROWS]))


def test_columns_are_ignored_on_request(read):
    text = table(["Q_A", "size_x_um", "pressure_mbar"])
    assert read(text, ignore=["pressure_mbar"]).planes == ("x",)
    assert read(text, ignore=["press*", "*_mbar"]).error == {}
    words = text.replace("1.5\n", "bad\n")
    assert len(read(words, ignore=["pressure_mbar"])) == 3
    with pytest.raises(InputError, match="did you mean pressure_mbar"):
        read(text, ignore=["presure_mbar"])
    with pytest.raises(InputError, match="to read"):
        read(text, ignore=["*"])


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("start", ["", "\ufeff", "sep=,\n", '"sep=;"\n'])
def test_separators_at_the_end_of_lines_and_what_excel_adds(start, separator, end, read):
    text = table(["Q_A", "size_x_um", "size_x_error_um"], end=end).replace(",", separator)
    marked = start.replace("\n", end) + text
    scan = read(marked.replace(end, separator * 2 + end) if "sep" not in start else marked)
    np.testing.assert_allclose(scan.size["x"], METRES)
    ragged = start.replace("\n", end) + text.replace("60.0", f"60.0{separator}{separator}")
    with pytest.raises(InputError, match="5 cells"):
        read(ragged)


BAD = {
    "text": "-2,saturated,1\n",
    "too few cells": "-2,80\n",
    "too many cells": "-2,80,1,7\n",
    "no setting": ",80,1\n",
    "negative": "-2,-80,1\n",
    "no error": "-2,80,\n",
    "infinite": "-2,inf,1\n",
    "a decimal comma": '-2,"80,5",1\n',
    "another unit": "-2,80000,1\n",
}


@pytest.mark.parametrize("case", BAD)
def test_bad_rows_are_left_out_on_request_and_counted(case, read):
    text = table(["Q_A", "size_x_um", "size_x_error_um"]) + BAD[case]
    with pytest.raises(InputError) as raised:
        read(text)
    assert raised.value.line == 5
    scan = read(text, skip_bad=True)
    np.testing.assert_allclose(scan.size["x"], METRES)
    (note,) = scan.notes
    assert note.startswith("1 of 4 rows was left out: line 5, ")
    assert raised.value.found in note


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_what_is_left_are_the_good_rows_in_their_order(tmp_path_factory, good):
    path = tmp_path_factory.getbasetemp() / "some_bad.csv"
    rows = [f"{i},{100 + i}" if ok else f"{i},?" for i, ok in enumerate(good)]
    path.write_text("\n".join(["Q_A,size_x_um", *rows]))
    expected = [float(i) for i, ok in enumerate(good) if ok]
    if len(expected) < 3:
        with pytest.raises(InputError):
            read_quad_scan(path, skip_bad=True)
        return
    scan = read_quad_scan(path, skip_bad=True)
    assert scan.settings["Q"].tolist() == expected
    assert len(scan.notes) == (len(expected) < len(good))
    if scan.notes:
        assert scan.notes[0].startswith(f"{len(good) - len(expected)} of {len(good)} rows")


def test_bad_readings_of_hdf5_are_left_out_too(tmp_path):
    import h5py

    with h5py.File(tmp_path / "scan.h5", "w") as store:
        store["Q_A"], store["size_x_um"] = [0.0, 1.0, 2.0, 3.0], [100.0, np.nan, -5.0, 90.0]
        store["size_y_um"] = [100.0, 90.0, 95.0, 90.0]
    with pytest.raises(InputError, match="reading 2"):
        read_quad_scan(tmp_path / "scan.h5")
    with pytest.raises(InputError, match="2 distinct"):
        read_quad_scan(tmp_path / "scan.h5", skip_bad=True)


def test_large_and_small_beams_are_taken_as_they_stand(read):
    for header, rows in (
        ("size_x_mm", [(0, 25.0), (1, 21.0), (2, 40.0)]),
        ("size_x_um", [(0, 0.045), (1, 0.037), (2, 0.08)]),
    ):
        factor = 1e-3 if "mm" in header else 1e-6
        scan = read(table(["Q_A", header], rows))
        np.testing.assert_allclose(scan.size["x"], [factor * s for _, s in rows])


@pytest.mark.parametrize("name", ["4sigma_x_um", "4 sigma x [um]", "D4Sigma_x_um", "x_4rms_um"])
def test_several_sigma_are_said_to_be_several(name, read):
    scan = read(table(["Q_A", name, "4sigma_x_err_um"], [(q, 4 * s, 4 * e) for q, s, e in ROWS]))
    np.testing.assert_allclose(scan.size["x"], METRES)
    np.testing.assert_allclose(scan.error["x"], [1.5e-6, 0.5e-6, 1e-6])
    assert scan.notes == (f"Sizes are a share of 1/4 of {name}.",)
    with pytest.raises(InputError, match="several sigma"):
        read(table(["Q_A", name, "size_x_error_um"]))


@pytest.mark.parametrize("name", ["size_x_error_%", "sigma_x err (%)", "d sigma_x [percent]"])
def test_errors_in_percent_are_of_the_size(name, read):
    scan = read(table(["Q_A", "fwhm_x_um", name], [(q, s, 2.0) for q, s, _ in ROWS]))
    np.testing.assert_allclose(scan.error["x"], 0.02 * scan.size["x"], rtol=1e-14)


@pytest.mark.parametrize(
    "name", ["Q:5:BACT [A]", "Q:5 Current (A)", "Q:5.BDES_A", "Q:5 current setpoint [A]"]
)
def test_a_magnet_is_called_by_its_name_alone(name, read):
    assert read(table([name, "size_x_um", "note_"])).units == {"Q:5": "A"}
    with pytest.raises(InputError, match=r"also in column .* --ignore 'Q:5_A'"):
        read(table([name, "Q:5_A", "size_x_um"]))


def test_all_columns_that_nobody_knows_are_named_at_once(read):
    with pytest.raises(InputError, match="--ignore 'mean_x_mm' --ignore 'ICT'"):
        read("Q_A,size_x_um,mean_x_mm,ICT\n0,1,2,3\n")


def test_a_size_that_says_nan_was_not_measured(read):
    scan = read("Q_A,size_x_um,size_y_um\n0,90,NaN\n0,nan,80\n1,60,70\n2,95,N/A\n3,99,60\n")
    assert (len(scan.rows("x").size), len(scan.rows("y").size)) == (4, 3)
    with pytest.raises(InputError, match="no error beside it; --skip-bad"):
        read("Q_A,size_x_um,size_x_error_um\n0,90,1\n1,nan,1\n2,60,1\n3,90,1\n")


def test_a_comment_that_speaks_of_another_width_is_asked_about(read):
    for said in ("Gauss fit, FWHM by eye", "sizes were FWHM, divided by 2.35", "1 px = 27 um"):
        text = f"# {said}\n" + table(["Q_A", "size_x_um", "note_"])
        (note,) = read(text).notes
        assert f"'{said}'" in note
        assert "fwhm_x_um" in note
        assert said not in "".join(read(text.replace("size_x", "fwhm_x")).notes)
    (note,) = read("# units: A, mm\n" + table(["Q_A", "size_x_um", "note_"])).notes
    assert "'units: A, mm', and the sizes are taken in um" in note
    assert not read("# units: A, µm\n" + table(["Q_A", "size_x_um", "note_"])).notes


# What is stated of all sizes -> the header under which it would be true.
STATEMENTS = {
    "all widths are FWHM": "fwhm_x_um",
    "scan of QA, FWHM sizes": None,
    "FWHM beam sizes": "fwhm_x_um",
    "Beam size (rms) in mm": "size_x_mm",
    "OTR2: sizes = 4 sigma": "4sigma_x_um",
    "screen size in mm": None,
    "size errors in mm": None,
    "sizes in µm": None,
}


@pytest.mark.parametrize("said", STATEMENTS)
def test_a_comment_that_contradicts_the_header_is_refused_in_its_line(said, read):
    text, mend = f"# day 3\n# {said}\n" + table(["Q_A", "size_x_um", "note_"]), STATEMENTS[said]
    if mend is None:
        assert len(read(text)) == len(ROWS)
        return
    with pytest.raises(InputError, match=rf":2: column 'size_x_um': .*'{re.escape(said)}'") as no:
        read(text)
    assert f"rename the column {mend} if" in str(no.value)
    assert len(read(text.replace("size_x_um", mend))) == len(ROWS)


def test_a_comment_of_rms_over_a_fwhm_and_one_of_pixels_are_refused(read):
    text = "# sizes are rms\n" + table(["Q_A", "fwhm_x_um", "note_"])
    with pytest.raises(InputError, match="rename the column size_x_um"):
        read(text)
    with pytest.raises(InputError, match="give lengths, in um"):
        read(text.replace("rms", "in pixels").replace("fwhm", "size"))


def test_errors_that_are_all_zero_are_to_be_left_unread(read):
    with pytest.raises(InputError, match="--ignore 'size_x_error_um'"):
        read(table(["Q_A", "size_x_um", "size_x_error_um"], [(q, s, 0) for q, s, _ in ROWS]))


@pytest.mark.parametrize(("unit", "energy"), [("GeV", 0.135), ("keV", 135e3), ("eV", 135e6)])
def test_an_energy_may_have_another_unit(tmp_path, unit, energy):
    path = tmp_path / "scan.csv"
    rows = "".join(f"{k},200,{energy}\n" for k in range(3))
    path.write_text(f"Q2_A,size_x_um,energy_{unit}\n{rows}")
    np.testing.assert_allclose(read_quad_scan(path).energy, 135)
