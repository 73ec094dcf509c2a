"""What a scan file means: units, shots, screens, energies; and that nothing else is read."""

import csv

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamfit.errors import InputError
from beamfit.io.scan import read_quad_scan
from beamfit.noise.sizes import pooled_variance
from tests.io.forked import in_forks  # noqa: F401

PLAIN = "Q_kG,size_x_um,size_x_error_um\n-4,111.5,1.5\n-3,60,0.5\n-1,104,1\n"


@pytest.fixture
def read(tmp_path):
    def from_text(content, name="scan.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_quad_scan(path)

    return from_text


@pytest.mark.parametrize(
    ("unit", "metre"), [("m", 1.0), ("mm", 1e3), ("um", 1e6), ("µm", 1e6), ("μm", 1e6)]
)
def test_sizes_are_metres_inside(unit, metre, read):
    scan = read(
        f"Q_A,size_y_{unit},size_y_error_{unit}\n"
        + "".join(
            f"{i},{s * metre!r},{0.01 * s * metre!r}\n" for i, s in enumerate((2e-4, 1e-4, 3e-4))
        )
    )
    np.testing.assert_allclose(scan.size["y"], [2e-4, 1e-4, 3e-4], rtol=1e-14)
    np.testing.assert_allclose(scan.error["y"], [2e-6, 1e-6, 3e-6], rtol=1e-14)
    assert scan.planes == ("y",)


@pytest.mark.parametrize("unit", ["A", "kG", "k1", "k1l"])
def test_unit_of_the_setting(unit, read):
    scan = read(PLAIN.replace("Q_kG", f"QM_1_{unit}"))
    assert scan.units == {"QM_1": unit}
    assert scan.settings["QM_1"].tolist() == [-4.0, -3.0, -1.0]
    assert scan.columns["QM_1"] == f"QM_1_{unit}"


def test_several_magnets(read):
    scan = read("Q1_A,Q2_kG,size_x_um\n0,1,100\n0,2,90\n1,1,80\n")
    assert scan.units == {"Q1": "A", "Q2": "kG"}
    assert len(scan) == 3


def test_provenance_is_kept_wherever_it_stands(read):
    scan = read("# taken at noon\n" + PLAIN + "# by the night shift, 2020\n")
    assert scan.provenance == ("taken at noon", "by the night shift, 2020")
    assert scan.error_source == "the file"


@pytest.mark.parametrize(
    "text",
    [
        b"\xef\xbb\xbf" + PLAIN.encode(),
        PLAIN.replace("\n", "\r\n"),
        b"\xef\xbb\xbf# from Excel\r\n\r\n" + PLAIN.replace("\n", "\r\n").encode() + b",,\r\n",
        PLAIN.replace(",", " , ").replace("\n", "  \n"),
        PLAIN.rstrip("\n"),
        PLAIN.replace("Q_kG", '"Q_kG"').replace("60", '"60"'),
        PLAIN.replace("60", "6.0E1"),
        PLAIN.replace(",", ";"),
        PLAIN.replace(",", "\t"),
        PLAIN.replace(",", "  "),
    ],
    ids=[
        "BOM",
        "CRLF",
        "Excel",
        "spaces",
        "no last line end",
        "quotes",
        "exponent",
        "semicolons",
        "tabs",
        "blanks between",
    ],
)
def test_how_programs_write_csv(text, read):
    scan = read(text)
    np.testing.assert_allclose(scan.size["x"], [111.5e-6, 60e-6, 104e-6])
    np.testing.assert_allclose(scan.error["x"], [1.5e-6, 0.5e-6, 1e-6])


def test_a_cell_left_blank_is_a_plane_not_measured(read):
    scan = read("Q_A,size_x_um,size_y_um\n0,100,\n1,90,50\n2,80,60\n3,,70\n4,85,80\n")
    assert scan.rows("x").settings["Q"].tolist() == [0.0, 1.0, 2.0, 4.0]
    np.testing.assert_allclose(scan.rows("y").size, [50e-6, 60e-6, 70e-6, 80e-6])
    with pytest.raises(InputError, match="2 distinct settings in plane y"):
        read("Q_A,size_x_um,size_y_um\n0,100,\n1,90,50\n2,80,60\n")


def test_screens_energies_resolution_and_spread(read):
    scan = read(
        "Q_A,screen,energy_MeV,resolution_um,energy_spread,size_x_um,note_shift\n"
        "0,A,135,5,1e-3,100,late\n0,B,135,5,1e-3,90,late\n0,B,140,8,0,80,early\n"
    )
    assert scan.screen == ("A", "B", "B")
    assert scan.energy.tolist() == [135.0, 135.0, 140.0]
    np.testing.assert_allclose(scan.resolution, [5e-6, 5e-6, 8e-6])
    assert scan.energy_spread.tolist() == [1e-3, 1e-3, 0.0]


def test_five_shots_give_the_standard_error_of_their_mean(read):
    rng = np.random.default_rng(7)
    sizes = rng.normal(100.0, 3.0, (3, 5))
    rows = [f"{i},{n},{s!r}" for i, shots in enumerate(sizes.tolist()) for n, s in enumerate(shots)]
    scan = read("\n".join(["Q_A,shot,size_x_um", *rows]))
    np.testing.assert_allclose(scan.size["x"], 1e-6 * sizes.mean(axis=1), rtol=1e-12)
    # s/√n with n - 1 in s
    np.testing.assert_allclose(
        scan.error["x"], 1e-6 * sizes.std(axis=1, ddof=1) / np.sqrt(5), rtol=1e-12
    )
    assert scan.shots.tolist() == [5, 5, 5]
    assert "standard error" in scan.error_source


def test_shots_even_out_over_the_settings(read):
    """Of each setting its own scatter; the fit takes it together with that of all."""
    sizes = [[100.0, 104.0], [50.0, 50.0], [80.0, 79.0, 84.0]]
    rows = [f"{i},{s}" for i, shots in enumerate(sizes) for s in shots]
    scan = read("\n".join(["Q_A,size_x_um", *rows]))
    # by hand: squares of the deviations over the squared mean, over the degrees of freedom
    squares = 2 * (2 / 102) ** 2 + 0.0 + (1 + 4 + 9) / 81**2
    pooled = np.sqrt(squares / (1 + 1 + 2))
    own = np.array(
        [np.sqrt(8) / np.sqrt(2), pooled * 50 / np.sqrt(2), np.sqrt(14 / 2) / np.sqrt(3)]
    )
    np.testing.assert_allclose(scan.error["x"], 1e-6 * own, rtol=1e-12)
    relative, freedom = own / [102, 50, 81] * np.sqrt([2, 2, 3]), np.array([1, 1, 2])
    together = freedom @ relative**2 / freedom.sum()
    shrunken = np.sqrt((20 * together + freedom * relative**2) / (20 + freedom))
    expected = 1e-12 * (shrunken * [102, 50, 81]) ** 2
    found = pooled_variance(
        scan.error["x"] ** 2 * [2, 2, 3] * freedom, 1.0 * freedom, scan.size["x"]
    )
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(scan.shot_size["x"][0, :2], [100e-6, 104e-6])


def test_repeats_that_differ_far_more_than_others_are_not_averaged(read):
    """A setting met twice with another history is two measurements, not two shots."""
    sizes = [[100, 101], [90, 90.5], [80, 81], [75, 95], [85, 84.2], [99, 98.5]]
    rows = [f"{i},{s}" for i, shots in enumerate(sizes) for s in shots]
    text = "\n".join(["Q_A,size_x_um", *rows])
    scan = read(text)
    assert len(scan) == 12
    assert scan.shots is None
    assert not scan.error
    marked = "\n".join(["Q_A,size_x_um,shot", *(f"{r},{i}" for i, r in enumerate(rows))])
    assert len(read(marked)) == 6


def test_rows_with_errors_of_their_own_are_shots_where_they_stand_together(read):
    """A setting that was set again is measured again: what settings scatter differs."""
    rows = ["0,100,1", "1,90,1", "1,91,1", "2,95,1"]
    text = "\n".join(["Q_A,size_x_um,size_x_error_um", *rows])
    assert len(read(text)) == 3
    text = "\n".join(["Q_A,size_x_um,size_x_error_um", *rows, "0,102,1"])
    assert len(read(text)) == 4
    marked = text.replace("Q_A,", "shot,Q_A,").replace("\n", "\n1,")
    assert len(read(marked)) == 3


def test_errors_of_the_file_stand_where_few_settings_are_repeated(read):
    """One setting of five was measured four times: its errors are averaged, others are kept."""
    rows = ["0,200,4", *(f"1,{150 + i},3" for i in range(4)), "2,100,2", "3,140,3", "4,190,4"]
    scan = read("\n".join(["Q_A,size_x_um,size_x_error_um", *rows]))
    np.testing.assert_allclose(scan.error["x"], 1e-6 * np.array([4, 1.5, 2, 3, 4]), rtol=1e-12)
    assert scan.shots is None


def test_readbacks_that_differ_in_their_digits_are_one_setting(read):
    """Three shots of each of four settings, the other magnet held: its readback tells nothing."""
    rng = np.random.default_rng(1)
    first = np.repeat([1.0, 2.0, 3.0, 4.0], 3) + 5e-4 * rng.normal(size=12)
    held = 7.0 + 1e-3 * rng.normal(size=12)
    rows = [f"{a:.6g},{b:.6g},{100 + i}" for i, (a, b) in enumerate(zip(first, held, strict=True))]
    scan = read("\n".join(["Q_A,P_A,size_x_um", *rows]))
    assert scan.shots.tolist() == [3] * 4
    np.testing.assert_allclose(scan.settings["Q"], [1, 2, 3, 4], atol=2e-3)
    assert any("count as one" in note for note in scan.notes)


def test_fine_steps_and_those_beside_a_wrong_cell_are_settings_of_their_own(read):
    rows = [f"{q:.6g},{100 + q:.6g}" for q in np.linspace(0.0, 1.0, 500)]
    assert len(read("\n".join(["Q_A,size_x_um", *rows]))) == 500
    assert len(read("Q_A,size_x_um\n0,100\n1,90\n2,95\n3000,110\n4,120")) == 5
    crossed = ["0,1,100", "0,2,90", "0,3,95", "0,4,99", "1,4,90", "2,4,95", "0,4,98"]
    assert len(read("\n".join(["P_A,Q_A,size_x_um", *crossed]))) == 6


def test_errors_of_the_file_are_no_scatter_of_two_shots(read):
    """One setting of five was met twice: its errors are averaged, and worth what was stated."""
    rows = ["0,1,200,4", "1,1,150,3", "1,2,152,3", "2,1,100,2", "3,1,140,3", "4,1,190,4"]
    scan = read("\n".join(["Q_A,shot,size_x_um,size_x_error_um", *rows]))
    stated = 1e-6 * np.array([4, 3 / np.sqrt(2), 2, 3, 4])
    np.testing.assert_allclose(scan.error["x"], stated, rtol=1e-12)
    assert scan.shots is None
    assert "x" not in scan.shot_size


def test_shots_of_another_screen_or_energy_are_not_averaged(read):
    rows = ["0,A,100,90", "0,B,100,80", "0,B,100,82", "0,B,120,70", "0,B,120,70"]
    scan = read("\n".join(["Q_A,screen,energy_MeV,size_x_um", *rows]))
    assert scan.shots.tolist() == [1, 2, 2]
    assert scan.screen == ("A", "B", "B")


def test_without_errors_and_shots_there_are_none(read):
    scan = read("Q_A,size_x_um\n0,100\n1,90\n2,95\n")
    assert scan.error == {}
    assert scan.error_source == "none given"


def test_real_shots_reproduce_the_published_errors(shared, tmp_path):
    folder = shared / "data/lcls_otr2"
    with open(folder / "lcls_otr2_shots.csv") as file:
        shots = [r for r in csv.DictReader(file) if r["method"] == "RMS"]
    with open(folder / "lcls_otr2_scan.csv") as file:
        means = [r for r in csv.DictReader(file) if r["method"] == "RMS"]
    rows = [[r[k] for k in ("quad_BDES_kG", "shot", "xrms_um", "yrms_um")] for r in shots]
    path = tmp_path / "shots.csv"
    path.write_text(
        "\n".join(",".join(r) for r in [["Q_kG", "shot", "size_x_um", "size_y_um"], *rows])
    )
    scan = read_quad_scan(path)
    assert scan.shots.tolist() == [5] * 5
    for plane in "xy":
        size = [1e-6 * float(r[f"{plane}rms_um"]) for r in means]
        error = [1e-6 * float(r[f"{plane}rms_std_um"]) for r in means]
        np.testing.assert_allclose(scan.size[plane], size, rtol=1e-9)
        np.testing.assert_allclose(scan.error[plane], error, rtol=1e-9)


def test_the_scan_that_comes_along_is_the_published_one(root, shared):
    scan = read_quad_scan(root / "measurements/lcls_otr2.csv")
    with open(shared / "data/lcls_otr2/lcls_otr2_scan.csv") as file:
        means = [r for r in csv.DictReader(file) if r["method"] == "RMS"]
    for plane in "xy":
        published = [1e-6 * float(r[f"{plane}rms_um"]) for r in means]
        np.testing.assert_allclose(scan.size[plane], published, atol=6e-13)
    np.testing.assert_allclose(
        scan.settings["Q525"], [float(r["quad_BDES_kG"]) for r in means], atol=6e-7
    )
    assert "slaclab/lcls-tools" in " ".join(scan.provenance)


def test_hdf5_says_the_same_as_csv(tmp_path, read):
    text = read("# by hand\nQ_A,screen,size_x_um\n0,A,100\n1,A,90\n2,B,95\n3,B,\n")
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as store:
        store.attrs["origin"] = "by hand"
        store["Q_A"] = [0, 1, 2]
        store["screen"] = ["A", "A", "B"]
        store["size_x_um"] = np.array([100, 90, 95], "f4")
        store.create_group("more")["ignored"] = 1.0
    scan = read_quad_scan(path)
    assert scan.settings["Q"].tolist() == [0.0, 1.0, 2.0]
    assert scan.screen == text.screen[:3]
    np.testing.assert_array_equal(scan.size["x"], text.size["x"][:3])
    assert scan.provenance == ("origin: by hand",)
    assert len(scan.sha256) == 64


def read_or_refuse(path):
    """A scan, or the one exception there may be."""
    try:
        return read_quad_scan(path)
    except InputError as error:
        said = str(error)
    assert str(path) in said
    assert "\n" not in said
    return None


@given(st.one_of(st.binary(max_size=400), st.text(max_size=400).map(str.encode)))
def test_any_bytes_are_read_or_refused(tmp_path_factory, content):
    for name in ("fuzz.csv", "fuzz.h5"):
        path = tmp_path_factory.getbasetemp() / name
        path.write_bytes(content)
        assert read_or_refuse(path) is None


CELL = st.one_of(
    st.floats(width=64).map(repr),
    st.text(alphabet="0123456789.eE+-,;\"' \t#nanif_\r\0é", max_size=8),
    st.sampled_from(["", "100", "90", "1e400", "-0", "1e-320", "1e308", "１２", "1_0"]),
)


@given(
    st.lists(
        st.sampled_from(
            [
                "Q_A",
                "Q_kG",
                "size_x_um",
                "size_x_error_um",
                "size_y_m",
                "energy_MeV",
                "screen",
                "shot",
                "resolution_um",
                "energy_spread",
                "time",
                "note_",
                "_A",
                "",
                "x",
            ]
        ),
        max_size=6,
    ),
    st.lists(st.lists(CELL, min_size=1, max_size=6), max_size=6),
)
def test_any_cells_are_read_or_refused(tmp_path_factory, header, rows):
    path = tmp_path_factory.getbasetemp() / "cells.csv"
    width = max(len(header), 1)
    lines = [",".join(header), *(",".join((row * width)[:width]) for row in rows)]
    path.write_bytes("\n".join(lines).encode("utf-8", "surrogatepass"))
    read_or_refuse(path)


@given(st.lists(st.lists(CELL, min_size=3, max_size=3), min_size=1, max_size=5))
def test_a_good_header_with_any_cells_is_read_or_refused(tmp_path_factory, rows):
    path = tmp_path_factory.getbasetemp() / "rows.csv"
    path.write_bytes("\n".join(["Q_A,size_x_um,size_x_error_um", *map(",".join, rows)]).encode())
    scan = read_or_refuse(path)
    if scan is not None:
        assert np.nanmin(scan.size["x"]) > 0
        assert np.nanmin(scan.error["x"]) > 0


@given(st.integers(0, 4000), st.binary(min_size=1, max_size=20))
def test_damaged_hdf5_is_read_or_refused(tmp_path_factory, position, damage):
    path = tmp_path_factory.getbasetemp() / "damaged.h5"
    with h5py.File(path, "w") as store:
        store["Q_A"] = np.arange(5.0)
        store["size_x_um"] = np.full(5, 100.0)
        store["screen"] = ["A"] * 5
    content = bytearray(path.read_bytes())
    content[position : position + len(damage)] = damage
    path.write_bytes(content)
    read_or_refuse(path)


def test_a_name_the_system_cannot_have():
    with pytest.raises(InputError):
        read_quad_scan("a\0b.csv")


def test_shots_of_size_zero_show_no_beam(tmp_path):
    sizes = {-1: (100, 102, 0), 0: (60, 0, 0), 1: (60, 61, 62), 2: (150, 153, 149), 3: (0, 0, 0)}
    rows = [f"{k},{j},{size}" for k, three in sizes.items() for j, size in enumerate(three)]
    path = tmp_path / "shots.csv"
    path.write_text("\n".join(["Q_k1,shot,size_x_um", *rows]) + "\n")
    scan = read_quad_scan(path)
    assert scan.notes == ("6 shots of size 0 show no beam and are left out.",)
    assert np.isfinite(scan.shot_size["x"]).sum(axis=1).tolist() == [2, 1, 3, 3, 0]
    assert scan.rows("x").size.round(9).tolist() == [1.01e-4, 6e-5, 6.1e-5, 1.50667e-4]
