"""What `beamfit check` says of each kind of file, and of those that cannot be used."""

import json

import h5py
import numpy as np
import pytest

from beamfit.io.check import file_summary, with_lattice

SCAN = """Q2_A,fwhm_x_mm,size_y_um,size_y_error_um,energy_MeV,screen
0,0.2,200,4,30,PRE
1,0.3,,,30,PRE
2,0.4,220,4,30,PRE
3,0.5,210,4,31,PRE
"""
LATTICE = """format = "beamfit-lattice-1"
energy_MeV = 30.5
[[element]]
type = "quadrupole"
name = "Q2"
length_m = 0.1
current_A = 1.5
slope = 160.0
intercept = 40.0
[[element]]
type = "sector_dipole"
name = "B"
radius_m = 0.4
angle_deg = -90.0
bend_plane = "y"
[[element]]
type = "screen"
name = "PRE"
"""
RING = """[ring]
energy_GeV = 3.0
"""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "scan.csv").write_text(SCAN)
    (tmp_path / "line.toml").write_text(LATTICE)
    with h5py.File(tmp_path / "fill.h5", "w") as store:
        store["time_s"] = 1e9 + 60.0 * np.arange(30)
        store["beam_current_A"] = 0.1 * np.exp(-np.arange(30) / 600)
        store["beam_current_error_A"] = np.full(30, 1e-5)
        store["rf_voltage_kV"] = np.full(30, 900.0)
    return tmp_path


def facts(found):
    return {fact.label: fact.value for fact in found.facts}


def test_a_scan(files):
    found = facts(file_summary(files / "scan.csv"))
    assert (found["rows"], found["planes"]) == (4, {"x": 4, "y": 3})
    assert found["magnet Q2"] == {"low": 0, "high": 3, "unit": "A", "settings": 4}
    rms = 1e-3 / np.sqrt(8 * np.log(2))
    assert found["size x"]["low"] == pytest.approx(0.2 * rms)
    assert found["size x"]["column"] == "fwhm_x_mm"
    assert found["errors x"] is None
    assert found["errors y"]["median_relative"] == pytest.approx(4 / 210)
    assert found["energy"] == {"low": 30, "high": 31, "unit": "MeV", "kind": "total"}
    assert found["screens"] == {"PRE": 4}


def test_a_scan_is_held_against_each_lattice(files):
    (files / "other.toml").write_text(LATTICE.replace('"Q2"', '"Q3"'))
    scan, good = file_summary(files / "scan.csv"), file_summary(files / "line.toml")
    said = with_lattice(with_lattice(scan, good), file_summary(files / "other.toml"))
    assert facts(said)["on line.toml"] == {"fits": True}
    assert "did you mean Q3?" in facts(said)["on other.toml"]["why"]


def test_a_scan_that_fits_no_lattice_is_unusable_with_them(run, files):
    scan, good, other = (files / name for name in ("scan.csv", "line.toml", "other.toml"))
    other.write_text(LATTICE.replace('"Q2"', '"Q3"'))
    status, out, error = run("check", scan, other)
    assert (status, error.count("\n")) == (2, 1)
    assert "other.toml: a lattice" in out
    assert f"beamfit: {scan}: " in error
    assert "did you mean Q3?" in error
    assert run("check", scan, good, other)[::2] == (0, "")


def test_sizes_and_settings_in_another_unit_are_asked_about(files):
    (files / "scan.csv").write_text(SCAN.replace("fwhm_x_mm", "size_x_m").replace(",0.", ",0.02"))
    wide = file_summary(files / "scan.csv")
    assert any("unusually large" in note for note in wide.notes)
    strong = SCAN.replace("Q2_A", "Q2_T_per_m").replace("\n3,", "\n3000,")
    (files / "scan.csv").write_text(strong)
    said = with_lattice(file_summary(files / "scan.csv"), file_summary(files / "line.toml"))
    assert any("3e+03 T/m" in note for note in said.notes)


def test_a_file_of_emittance_gui(shared):
    found = facts(file_summary(shared / "data/lcls_otr2/test_scan2.mat"))
    assert len(found["size methods"]) == 7
    assert (found["matrices"], found["shots"]["high"]) == (True, 5)


def test_a_lattice(files):
    found = file_summary(files / "line.toml")
    said = facts(found)
    assert said["energy"] == {"value": 30.5, "unit": "MeV", "particle": "electron"}
    assert said["length"] == pytest.approx(0.1 + 0.4 * np.pi / 2)
    assert said["elements"] == {"quadrupole": 1, "sector_dipole": 1, "screen": 1}
    assert said["magnet Q2"] == {"setting": 1.5, "unit": "A"}
    words = next(f.words for f in found.facts if f.label == "magnet Q2")
    assert words == "1.5 A, 0.1 m long, intercept 40 and slope 160"


def test_a_record(files):
    found = facts(file_summary(files / "fill.h5"))
    assert found["readings"] == {"count": 30, "span_h": pytest.approx(29 / 60)}
    assert found["beam current"]["high"] == pytest.approx(100.0)
    assert found["errors"]["low"] == pytest.approx(0.01)
    assert found["began"] == "2001-09-09T01:46:40+00:00"
    assert found["rf voltage"] == {"low": 9e5, "high": 9e5, "unit": "V"}
    assert found["decays"] == {"count": 1, "events": {}}


def test_a_ring(root):
    found = facts(file_summary(root / "lattices/spear3_2003.toml"))
    assert found["circumference"]["value"] == pytest.approx(234.144012)
    assert (found["bunches"]["value"], found["RF voltage"]["value"]) == (280, 3200)


def test_all_files_are_gone_through_before_it_is_said_which_cannot_be_used(run, files, root):
    (files / "bad.csv").write_text("Q2_A,size_x_um\n1,2\n2,x\n3,4\n")
    (files / "ring.toml").write_text(RING)
    given = ("bad.csv", "scan.csv", "ring.toml", "no.csv", "fill.h5")
    paths = [files / name for name in given]
    twiss = root / "lattices/spear3_2003_twiss.csv"
    status, out, error = run("check", *paths, twiss)
    assert status == 2
    assert "scan.csv: a scan" in out
    assert "fill.h5: a record" in out
    lines = error.splitlines()
    assert [line.split(":")[1].split("/")[-1] for line in lines] == [
        "bad.csv",
        "ring.toml",
        "no.csv",
        "spear3_2003_twiss.csv",
    ]
    assert "bad.csv:3: column 'size_x_um': 'x'" in lines[0]
    assert "the ring file" in lines[3]


def test_json_holds_the_good_and_the_bad(run, files):
    status, out, error = run("check", files / "scan.csv", files / "no.csv", "--json")
    document = json.loads(out)
    assert (status, error.count("\n")) == (2, 1)
    assert list(document["inputs"]) == [str(files / "scan.csv")]
    good, bad = document["results"]
    assert (good["kind"], good["contents"]["rows"]) == ("scan", 4)
    assert bad["kind"] is None
    assert "no such file" in bad["error"]
    assert any("FWHM" in note for note in good["notes"])


def test_a_lattice_of_another_program_is_chosen_by_use(run, tmp_path):
    text = """Q: QUADRUPOLE, L=0.1, K1=2.0; M: MONITOR; BEAM, PARTICLE=ELECTRON, ENERGY=0.1;
ONE: LINE=(Q, M); TWO: LINE=(M, Q, M);
"""
    (tmp_path / "line.madx").write_text(text)
    status, out, error = run("check", tmp_path / "line.madx")
    assert (status, out, error.count("\n")) == (2, "", 1)
    status, out, _ = run("check", tmp_path / "line.madx", "--use", "ONE")
    assert status == 0
    assert "100 MeV total, electrons" in out
    assert "2 1/m² (k1), 0.1 m long" in out


def test_columns_that_resemble_nothing_beside_a_time_are_a_run(run, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time_s,valve,level\n0,0,0.1\n1,1,0.2\n")
    status, out, error = run("check", path)
    assert status == 2
    assert '# "valve" = ""  # 0: u_valve if an input, y_valve if an output' in out
    assert "expected inputs u_... and outputs y_..., or --input COLUMN and --output" in error


def test_runs_and_formulations_are_understood(run):
    run_of, text = "measurements/valve_level_simulated.csv", "formulations/appendix_d.bf"
    status, out, err = run("check", run_of, text, "--json")
    assert status == 0, err
    process, formulation = json.loads(out)["results"]
    assert process["kind"] == "run"
    assert process["contents"]["rows"] == {"count": 800, "span_s": 399.5, "step_s": 0.5}
    assert set(process["contents"]) == {"rows", "input_valve", "output_level"}
    assert formulation["kind"] == "formulation"
    assert formulation["contents"]["variables"] == ["I_2"]
    assert formulation["contents"]["objectives"] == ["obj"]
