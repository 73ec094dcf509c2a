"""`beamfit setpoint` as a person and as a script use it."""

import json

import numpy as np
import pytest

from beamfit.io.line import load_lattice

APPENDIX_D = (
    "setpoint", "--lattice", "lattices/gtf.toml",
    "--sigma", "2.6367971e-8,1.5738242e-8,1.4354411e-8",
    "--vary", "Q2=0:10", "--target", "size=200um", "--target", "divergence=140urad",
)  # fmt: skip


def test_appendix_d_as_json(run):
    status, out, err = run(*APPENDIX_D, "--json")
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert list(document) == ["beamfit", "command", "inputs", "results"]
    [result] = document["results"]
    assert result["settings"]["Q2"] == pytest.approx(1.08860, abs=5e-6)
    assert result["units"] == {"Q2": "A"}
    assert result["energy"]["value"] == 30.5
    assert result["objective"] == pytest.approx(2.1138, abs=5e-4)
    assert result["size"]["value"] == pytest.approx(199.55e-6, abs=1e-8)
    assert result["divergence"]["value"] == pytest.approx(141.38e-6, abs=1e-8)
    assert result["other_minima"][0]["settings"]["Q2"] == pytest.approx(2.97, abs=0.005)


def test_the_table(run):
    status, out, err = run(*APPENDIX_D)
    assert (status, err) == (0, "")
    for words in ("1.0886 A", "2.11378", "199.55 µm", "Q2 = 2.97 A: objective 5647.55"):
        assert words in out


@pytest.mark.parametrize("micro", ["\u00b5", "\u03bc"])
def test_the_micro_sign_and_the_greek_letter_are_one_unit(run, micro):
    wish = ("--target", f"size=200{micro}m", "--target", f"divergence=140{micro}rad")
    status, out, _ = run(*APPENDIX_D[:7], *wish, "--json")
    assert status == 0
    assert json.loads(out)["results"][0]["settings"]["Q2"] == pytest.approx(1.08860, abs=5e-6)


def test_the_fitted_beam_brings_its_errors(run, tmp_path):
    scan = ("measurements/lcls_otr2.csv", "--lattice", "lattices/lcls_otr2.toml")
    _, out, _ = run("emittance", *scan, "--json")
    fit = tmp_path / "fit.json"
    fit.write_text(out)
    command = ("setpoint", *scan[1:], "--fit", fit, "--vary", "Q525=-6:6", "--target", "match_x")
    status, out, err = run(*command, "--json")
    assert (status, err) == (0, "")
    [result] = json.loads(out)["results"]
    assert result["size"]["error"] > 0
    assert result["setting_errors"]["Q525"] > 0
    # The published BMAG is 1.08 with the magnet where it stood; turning it does no worse.
    assert 0 <= result["objective"] < 0.1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--vary", "Q2=0"), "NAME=LOW:HIGH"),
        (("--target", "size=200"), "a number with a unit"),
        (("--target", "width=200um"), "size=200um"),
        (("--fit", "nowhere.json"), "both --sigma and --fit"),
        (("--target", "match"), "without design Twiss"),
        (("--vary", "Q9=0:1"), "lattices/gtf.toml: --vary Q9: no magnet 'Q9'"),
        (("--vary", "Q1=0:10%"), "NAME=LOW:HIGH"),
        (("--target", "match=5:nan"), "alpha = nan"),
    ],
)
def test_bad_words_are_one_line(run, change, words):
    status, out, err = run(*APPENDIX_D, *change)
    assert (status, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1


def test_a_file_that_is_no_result(run, tmp_path):
    other = tmp_path / "other.json"
    other.write_text('{"results": [{"plane": "x"}]}')
    status, _, err = run(*APPENDIX_D[:3], "--fit", other, *APPENDIX_D[5:])
    assert status == 2
    assert "no fitted beams; expected the output of beamfit emittance --json" in err


SIGMA = (2.6367971e-8, 1.5738242e-8, 1.4354411e-8)
FIT = {
    "plane": "x",
    "status": "converged",
    "message": "Determined.",
    **{
        f"sigma{k}": {"value": v, "error": 0.02 * v}
        for k, v in zip((11, 12, 22), SIGMA, strict=True)
    },
    "covariance": np.diag((0.02 * np.array(SIGMA)) ** 2).tolist(),
    "error_scale": 1.0,
}


@pytest.fixture
def of_fit(run, tmp_path):
    """Run `beamfit setpoint --fit` on a result that differs from a good one."""

    def call(change, *options):
        file = tmp_path / "fit.json"
        file.write_text(json.dumps({"beamfit": "0.1.0", "results": [FIT | change]}))
        wish = ("--vary", "Q2=0:2", "--target", "size=200um")
        return run("setpoint", "--lattice", "lattices/gtf.toml", "--fit", file, *wish, *options)

    return call


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scenario": "focusing-network", "anchor": "first principles to 2 %"}, "not to the lat"),
        ({"scenario": "transport-network", "anchor": "none"}, "scenario transport-network"),
        (
            {"scenario": "transport-network", "anchor": "first principles at Q2 = 0 to 0.1 %"},
            "--anchor first-principles=2%",
        ),
        ({"covariance": [[1e-20, 0], [0, 1e-20]]}, "three rows of three numbers"),
        ({"covariance": "none"}, "three rows of three numbers"),
        ({"covariance": [[1e-20, 0, 0], [0, float("inf"), 0], [0, 0, 1e-20]]}, "finite number"),
        ({"covariance": [[1e-20, 0, 0], [0, 1e-20, 0], [0, 0, -1e-20]]}, "negative eigenvalues"),
        ({"covariance": [[1e-20, 2e-20, 0], [2e-20, 1e-20, 0], [0, 0, 1e-20]]}, "symmetric"),
        ({"covariance": [[1e-20, 1e-21, 0], [0, 1e-20, 0], [0, 0, 1e-20]]}, "symmetric"),
        ({"covariance": [[0, 1e-20, 0], [1e-20, 1e-20, 0], [0, 0, 1e-20]]}, "symmetric"),
        ({"sigma11": {"value": None, "error": None}}, "sigma11 of plane x = null"),
        ({"sigma12": {"value": "1e-8", "error": None}}, 'sigma12 of plane x = "1e-8"'),
        ({"error_scale": None}, "error_scale of plane x"),
        ({"energy": {"value": 0.1}}, "0.1 MeV"),
    ],
)
def test_a_damaged_or_foreign_result_is_refused(of_fit, change, words):
    status, out, err = of_fit(change)
    assert (status, out) == (2, "")
    assert "fit.json: " in err
    assert words in err
    assert err.count("\n") == 1


def test_a_doubted_beam_is_named_with_its_reason(of_fit):
    change = {"covariance": None, "message": "The waist is not bracketed."}
    status, out, _ = of_fit(change, "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    assert result["beam_undetermined"] == ["x"]
    assert "The waist is not bracketed" in result["message"]
    assert "The waist is not bracketed" in " ".join(of_fit(change)[1].split())


def test_the_beam_is_carried_at_the_energy_of_its_scan(of_fit, root):
    status, out, _ = of_fit({"energy": {"value": 25.0, "error": None, "unit": "MeV"}}, "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    assert result["energy"]["value"] == 25.0
    assert "At 25 MeV" in result["message"]
    assert "30.5 MeV" in result["message"]
    line = load_lattice(root / "lattices/gtf.toml")
    a, b = np.asarray(line.matrix(result["settings"], 25.0).x)[0, :2]
    size = np.sqrt(a * a * SIGMA[0] + 2 * a * b * SIGMA[1] + b * b * SIGMA[2])
    assert size == pytest.approx(200e-6, rel=1e-6)


def test_two_energies_are_refused(run, tmp_path):
    file = tmp_path / "fit.json"
    planes = [{"plane": p, "energy": {"value": e}} for p, e in (("x", 25.0), ("y", 30.5))]
    file.write_text(json.dumps({"results": [FIT | p for p in planes]}))
    wish = ("--vary", "Q2=0:2", "--target", "size=200um", "--target", "size_y=200um")
    status, _, err = run("setpoint", "--lattice", "lattices/gtf.toml", "--fit", file, *wish)
    assert status == 2
    assert "energies 25 MeV (plane x), 30.5 MeV (plane y); expected one energy" in err


def test_a_calibrated_beam_says_that_its_errors_are_too_large(of_fit):
    slope = {"name": "Q2.slope", "value": {"value": 160.0, "error": 3.0}}
    status, out, _ = of_fit({"scenario": "calibration", "parameters": [slope]}, "--json")
    assert status == 0
    assert "errors here are too large" in json.loads(out)["results"][0]["message"]


def test_a_bare_beam_says_why_it_has_no_errors(run):
    _, out, _ = run(*APPENDIX_D, "--json")
    assert "No errors: pass --fit" in json.loads(out)["results"][0]["message"]


GTF = ("--lattice", "lattices/gtf.toml")
LCLS = ("--lattice", "lattices/lcls_otr2.toml")
WANTED = ("--vary", "Q2=0:5", "--target", "size=200um")


def fitted(run, path, *options):
    status, out, _ = run("emittance", *options, "--json")
    assert status == 0
    path.write_text(out)
    return json.loads(out)


def test_a_beam_of_another_line_is_refused(run, tmp_path, root):
    """Its matrix holds where its own line begins."""
    fit = tmp_path / "fit.json"
    document = fitted(run, fit, "measurements/lcls_otr2.csv", *LCLS)
    status, out, err = run("setpoint", *GTF, "--fit", fit, *WANTED)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "fitted in another line than 'GTF'" in err
    # A result of a version that did not say the line names the lattice among its inputs.
    for entry in document["results"]:
        del entry["line"]
    fit.write_text(json.dumps(document))
    status, out, err = run("setpoint", *GTF, "--fit", fit, *WANTED)
    assert (status, out) == (2, "")
    assert "another lattice" in err
    assert "fit.json" in err
    status, _, _ = run("setpoint", *LCLS, "--fit", fit, "--vary", "Q525=-6:6", *WANTED[2:])
    assert status == 0


def test_comments_of_a_lattice_and_its_energy_do_not_make_another_line(run, tmp_path, root):
    fit, same = tmp_path / "fit.json", tmp_path / "same.toml"
    fitted(run, fit, "measurements/gtf_simulated.csv", *GTF)
    text = (root / "lattices/gtf.toml").read_text()
    same.write_text("# copied\n" + text.replace("energy_MeV = 30.5", "momentum_MeV = 30.6"))
    assert run("setpoint", "--lattice", same, "--fit", fit, *WANTED)[0] == 0
    for change in (("1.834615", "1.834616"), ("slope = 167.23", "slope = 167.24")):
        same.write_text(text.replace(*change))
        assert run("setpoint", "--lattice", same, "--fit", fit, *WANTED)[0] == 2
    status, _, err = run("setpoint", *GTF, "--from", "Q2", "--fit", fit, *WANTED)
    assert (status, "another line" in err) == (2, True)


def test_a_magnet_that_was_not_scanned_may_be_set(run, tmp_path):
    fit = tmp_path / "fit.json"
    fitted(run, fit, "measurements/gtf_simulated.csv", *GTF)
    status, out, _ = run("setpoint", *GTF, "--fit", fit, "--vary", "Q1=-1:1", *WANTED[2:], "--json")
    assert status == 0
    assert list(json.loads(out)["results"][0]["settings"]) == ["Q1"]
    scan = "measurements/gtf_simulated.csv"
    status, out, _ = run("design", scan, *GTF, "--vary", "Q1=-1:1", "--count", "1", "--json")
    assert status == 0
    assert "Q1" in json.loads(out)["results"][0]["next"][0]["settings"]


def test_a_size_of_nothing_is_refused_in_words(run):
    status, _, err = run(*APPENDIX_D[:-2], "--target", "size=0um")
    assert (status, err.count("\n")) == (2, 1)
    assert "no beam gets to zero" in err
