"""Files of other programs, each on the one reader of columns: SDDS, vectors of MATLAB."""

import random
import struct
import sys
import time

import numpy as np
import pytest
import scipy.io

from beamfit.errors import InputError
from beamfit.io.check import file_summary
from beamfit.io.decay_record import read_decay_record
from beamfit.io.scan import read_quad_scan
from beamfit.io.table import read_sheet
from tests.io.forked import in_forks  # noqa: F401
from tests.io.test_mutated_files import mutated

sdds = pytest.importorskip("sdds", reason="soliday-sdds is not installed")

ROWS = [(-4.2, 111.4, 1.1), (-3.2, 63.4, 0.3), (-2.6, 53.6, 0.3), (-2.1, 56.7, 0.5)]
PAGE = "".join(f"{q} {x} {e} OTR2\n" for q, x, e in ROWS)
SDDS = f"""SDDS1
!# little-endian
&description text="a \\"scan\\" of Q525", contents="a & b" &end
&parameter name=Energy, units=MeV, type=double, &end
&parameter name=By, type=string, fixed_value="me, at noon" &end
&column name=Q525, units=kG, type=double,
   description="integrated gradient" &end
&column name=size_x, units=um, symbol="$gs$r$bx$n", type=double &end
&column name=size_x_error_um, units=um, type=double &end
&column name=screen, type=string &end
&data mode=ascii, no_row_counts=0 &end
! page 1
135.0
4
{PAGE}"""


def read(path, content, reader=read_quad_scan):
    path.write_text(content, newline="")
    return reader(path)


def as_binary(path):
    """The same file as elegant writes it unless it is asked for ASCII."""
    data = sdds.load(str(path))
    data.mode = data.SDDS_BINARY
    data.save(str(path))


@pytest.mark.parametrize("binary", [False, True])
def test_sdds(binary, tmp_path):
    path = tmp_path / "a.sdds"
    path.write_text(SDDS)
    if binary:
        as_binary(path)
    scan = read_quad_scan(path)
    assert scan.units == {"Q525": "kG"}
    np.testing.assert_allclose(scan.settings["Q525"], [q for q, _, _ in ROWS])
    np.testing.assert_allclose(scan.size["x"], [1e-6 * x for _, x, _ in ROWS])
    np.testing.assert_allclose(scan.error["x"], [1e-6 * e for _, _, e in ROWS])
    assert scan.screen == ("OTR2",) * 4
    assert scan.provenance == ("Energy: 135.0 MeV", "By: me, at noon")
    assert file_summary(path).kind == "scan"


def test_the_final_properties_of_elegant(tmp_path):
    """A page each step of a scan, with parameters alone: Sx and Sy in m, and what was varied."""
    data = sdds.SDDS()
    for name, unit, values in (
        ("Step", "", [1, 2, 3, 4]),
        ("Sx", "m", [1e-6 * x for _, x, _ in ROWS]),
        ("Sy", "m", [2e-6 * x for _, x, _ in ROWS]),
        ("ex", "m", [1e-9] * 4),
        ("Q525.K1", "1/m$a2$n", [q for q, _, _ in ROWS]),
    ):
        data.defineParameter(name, units=unit, type=data.SDDS_DOUBLE)
        data.setParameterValueList(name, values)
    path = tmp_path / "run.fin"
    data.save(str(path))
    for binary in (False, True):
        if binary:
            as_binary(path)
        scan = read_quad_scan(path, columns="elegant, Q525.K1=Q525_k1")
        np.testing.assert_allclose(scan.settings["Q525"], [q for q, _, _ in ROWS])
        np.testing.assert_allclose(scan.size["y"], [2e-6 * x for _, x, _ in ROWS])
        assert scan.units == {"Q525": "k1"}
    with pytest.raises(InputError, match=r"run\.fin: column 'Step'.*--columns"):
        read_quad_scan(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("&column name=Q", '&include filename="z" &end\n&column name=Q', "SDDS file with &include"),
        ("\n4\n", "\n5\n", "not SDDS, or is damaged"),
        ("\n4\n", "\n3\n", "another number of rows than it announces"),
        ("\n4\n", "\n1\n", "another number of rows than it announces"),
        ("\n4\n", "\n0\n", "another number of rows than it announces"),
        (PAGE, f"{PAGE}135.0\n4\n{PAGE}", "2 pages; expected one; sddscombine -merge"),
        ("\n4\n", "\nfour\n", "is damaged"),
        ("53.6", "x", "is damaged"),
        ("53.6 0.3", "53.6", "is damaged"),
        ("&data", "&dat", "is damaged"),
        ("um,", "furlong,", "column 'size_x_furlong'"),
        ("units=um, type=double &end\n&column name=screen", "units=mm, type=double &end\n&column "
         "name=screen", "units = 'mm'; expected one unit, um"),
    ],
)  # fmt: skip
def test_sdds_that_is_no_table(old, new, words, tmp_path):
    with pytest.raises(InputError, match=words) as raised:
        read(tmp_path / "a.sdds", SDDS.replace(old, new))
    assert "\n" not in str(raised.value)


def test_sdds_of_few_rows_or_with_blank_lines_is_read(tmp_path):
    counted = SDDS.replace("no_row_counts=0", "no_row_counts=1").replace("\n4\n", "\n")
    for text in (counted, SDDS + "\n\n", SDDS.rstrip()):
        assert len(read(tmp_path / "a.sdds", text)) == 4


@pytest.mark.parametrize("rows", [0, 1, 3, 5])
def test_binary_sdds_with_a_wrong_row_count(rows, tmp_path):
    path = tmp_path / "a.sdds"
    path.write_text(SDDS)
    as_binary(path)
    content = path.read_bytes()
    place = content.index(b"\n", content.index(b"&data")) + 1
    path.write_bytes(content[:place] + struct.pack("<i", rows) + content[place + 4 :])
    with pytest.raises(InputError, match=r"another number of rows|pages|is damaged"):
        read_quad_scan(path)


def test_sdds_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "sdds", None)
    with pytest.raises(InputError, match=r"needs soliday-sdds to read; .*'beamfit\[sdds\]'"):
        read(tmp_path / "a.sdds", SDDS)


def test_labview_files_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "a.lvm").write_text("LabVIEW Measurement\nWriter_Version\t2\n")
    with pytest.raises(InputError, match="a LabVIEW file; expected a text table: export it as CSV"):
        read_decay_record(tmp_path / "a.lvm")


def test_vectors_of_matlab(tmp_path):
    q, x, e = np.transpose(ROWS)
    path, columns = tmp_path / "a.mat", {"Q525_kG": q, "size_x_um": x, "size_x_error_um": e}
    for orient in ("row", "column"):
        more = {"operator": "me", "energy": 135.0, "image": np.eye(3), "note": {"a": 1}}
        scipy.io.savemat(path, columns | more, oned_as=orient, do_compression=orient == "row")
        scan = read_quad_scan(path)
        np.testing.assert_array_equal(scan.settings["Q525"], q)
        np.testing.assert_allclose(scan.error["x"], 1e-6 * e)
        assert file_summary(path).kind == "scan"
    scipy.io.savemat(path, {"time_s": np.arange(4), "beam_current_mA": 200.0 - np.arange(4)})
    assert read_decay_record(path).current.tolist() == [200, 199, 198, 197]
    assert file_summary(path).kind == "record"
    scipy.io.savemat(path, columns | {"size_x_um": x[1:]})
    with pytest.raises(InputError, match="column 'size_x_um': 3 readings; expected 4"):
        read_quad_scan(path)
    scipy.io.savemat(path, {"energy": 135.0})
    with pytest.raises(InputError, match="vectors Q2_A, size_x_um"):
        read_quad_scan(path)


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(time, "sleep", lambda _: None)  # SDDS opens what it cannot read twice
    rng, refused, path = random.Random(6), [], tmp_path / "a.txt"
    for _ in range(100):
        path.write_bytes(mutated(SDDS.encode(), rng))
        try:
            read_sheet(path, "Q2_A,size_x_um")
        except InputError as error:
            refused.append(str(error))
    assert 10 < len(refused) < 100
    assert not any("\n" in said for said in refused)
