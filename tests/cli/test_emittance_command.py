"""The command as a person and as a script use it."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import beamfit

ROOT = Path(__file__).resolve().parents[2]
REAL = ("emittance", "measurements/lcls_otr2.csv", "--lattice", "lattices/lcls_otr2.toml")


def test_json_is_one_object_and_nothing_else(run, root):
    status, out, err = run(*REAL, "--json")
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert list(document) == ["beamfit", "command", "inputs", "results"]
    assert document["beamfit"] == beamfit.__version__
    assert document["command"].startswith("beamfit emittance measurements/lcls_otr2.csv")
    for path, digest in document["inputs"].items():
        assert digest == hashlib.sha256((root / path).read_bytes()).hexdigest()
    x, y = document["results"]
    assert (x["plane"], x["status"]) == ("x", "converged")
    assert (y["plane"], y["status"]) == ("y", "converged")
    quantity = x["normalized_emittance"]
    assert quantity["unit"] == "m"
    # The published one, and an error that holds what settings scatter beyond their shots.
    assert abs(quantity["value"] - 0.705e-6) < quantity["error"]
    assert 0.0155e-6 < quantity["error"] < 0.04e-6
    assert quantity["error_raw"] < quantity["error"]
    assert x["identifiability"]["verdict"] == "determined"
    effects = [abs(c["normalized_emittance"]) for c in x["systematics"]]
    assert effects == sorted(effects, reverse=True)
    assert "screen scale +1 %" in [c["cause"] for c in x["systematics"]]
    assert len(x["range"]) == 6


@pytest.mark.parametrize(("option", "planes"), [("x", ["x"]), ("y", ["y"]), ("both", ["x", "y"])])
def test_plane(run, option, planes):
    status, out, _ = run(*REAL, "--json", "--plane", option)
    assert status == 0
    assert [r["plane"] for r in json.loads(out)["results"]] == planes


def test_both_planes_of_a_scan_that_has_one(run):
    status, out, err = run(
        "emittance",
        "measurements/gtf_simulated.csv",
        "--lattice",
        "lattices/gtf.toml",
        "--plane",
        "both",
    )
    assert (status, out) == (2, "")
    assert err == (
        "beamfit: measurements/gtf_simulated.csv: no sizes in plane y; "
        "expected a column size_y_um\n"
    )


def test_the_tables_and_the_verdict(run):
    status, out, err = run(*REAL, "--full")
    assert (status, err) == (0, "")
    for words in (
        "x converged: normalised emittance 0.70",
        "of the size beyond their shots, which the error includes",
        "/2 = ",
        "P(beam)",
        "drift D1 +1 cm",
        "without Q525 = -4.219 kG",
    ):
        assert words in " ".join(out.split())


def test_an_undetermined_scan_is_answered_with_status_0_and_null(run, tmp_path):
    scan = tmp_path / "noise.csv"
    rows = [(0.0, 90), (0.5, 160), (1.0, 70), (1.5, 150), (2.0, 60), (2.5, 170), (3.0, 80)]
    scan.write_text("Q2_A,size_x_um\n" + "".join(f"{a},{s}\n" for a, s in rows))
    status, out, _ = run("emittance", scan, "--lattice", "lattices/gtf.toml", "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    assert result["status"] == "unidentified"
    assert result["emittance"]["error"] is None
    assert result["normalized_emittance"]["error"] is None
    assert result["systematics"] == []


def test_robust_and_size(run):
    status, out, _ = run(*REAL, "--json", "--plane", "x", "--robust")
    assert status == 0
    # It doubts the worst of five readings more than a fit with the usual prior does.
    doubts = max(json.loads(out)["results"][0]["points"]["outlier_probability"])
    _, out, _ = run(*REAL, "--json", "--plane", "x")
    assert doubts > 3 * max(json.loads(out)["results"][0]["points"]["outlier_probability"]) > 0.0
    status, out, _ = run(*REAL, "--json", "--plane", "x", "--method", "size")
    assert json.loads(out)["results"][0]["method"] == "size"


def test_help_has_an_example(run):
    for arguments in (("--help",), ("emittance", "--help")):
        status, out, _ = run(*arguments)
        assert status == 0
        assert "xample" in out
        assert "beamfit emittance" in out


def test_the_fit_loads_nothing_of_other_studies_and_nothing_that_samples():
    """emcee brings scipy.stats, half a second that an emittance does not need."""
    check = (
        "import sys; sys.argv = ['beamfit', 'emittance', 'measurements/lcls_otr2.csv', "
        "'--lattice', 'lattices/lcls_otr2.toml']\n"
        "from beamfit.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'emcee', 'scipy.stats', 'matplotlib', 'beamfit.sampling.ensemble'}\n"
        "print(heavy & set(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stderr.strip() == "set()"


def test_the_energy_of_the_rows_is_in_the_result(run, tmp_path, root):
    """A scan at another energy than the lattice's."""
    header, *rows = (
        line for line in (root / "measurements/gtf_simulated.csv").read_text().splitlines()
        if not line.startswith("#")
    )  # fmt: skip
    scan = tmp_path / "scan.csv"
    scan.write_text("\n".join([f"{header},energy_MeV", *(f"{row},25" for row in rows)]))
    _, out, _ = run("emittance", scan, "--lattice", "lattices/gtf.toml", "--json")
    [result] = json.loads(out)["results"]
    assert (result["energy"]["value"], result["energy"]["unit"]) == (25.0, "MeV")


def test_rows_left_out_are_named_in_the_answer(run, tmp_path, root):
    lines = (root / "measurements/lcls_otr2.csv").read_text().splitlines()
    head, rows = lines[:6], lines[6:]
    lines = [*head[:5], head[5] + ",pressure_mbar", *(row + ",1e-9" for row in rows)]
    path = tmp_path / "scan.csv"
    path.write_text("\n".join([*lines, "-1.5,off,off,off,off,,\n"]))
    plain = ["emittance", str(path), *REAL[2:], "--ignore", "pressure*"]
    assert run(*plain)[0] == 2
    _, out, _ = run(*plain, "--skip-bad", "--json")
    note = f"1 of 6 rows was left out: line {len(lines) + 1}, column 'size_x_um', 'off'."
    assert [r["notes"] for r in json.loads(out)["results"]] == [[note]] * 2
    assert note in " ".join(run(*plain, "--skip-bad")[1].split())


SLICES = (
    "emittance",
    "measurements/gtf_slices_simulated.csv",
    "--lattice",
    "lattices/gtf.toml",
)


def test_slices_are_fitted_in_one_command(run, tmp_path, well_shown):
    page = tmp_path / "slices.html"
    status, out, err = run(*SLICES, "--report", page)
    assert (status, err) == (0, "")
    assert "\nx, slices 1, 2, 3, 4, 5, projected: Determined" in out
    assert max(map(len, out.splitlines()[-12:])) <= 80
    assert out.count("\n") <= 24
    assert "Slices of gtf_slices_simulated, x plane" in out
    assert page.read_text().count("<img") == 7
    assert well_shown(page, 7) == []
    status, out, err = run(*SLICES, "--json")
    assert (status, err) == (0, "")
    results = json.loads(out)["results"]
    assert [(r["slice"], r["plane"]) for r in results][::5] == [("1", "x"), ("projected", "x")]
    assert all(r["systematics"] and r["range"] for r in results)
    assert results[0]["energy"]["value"] == pytest.approx(30.256)


def test_slices_are_sampled_one_by_one(run):
    status, out, err = run(*SLICES, "--sample")
    assert (status, out) == (2, "")
    assert "--sample for 6 slices" in err
    assert err.count("\n") == 1
