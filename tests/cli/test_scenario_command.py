"""Scenarios and designs on the command line."""

import json

import pytest

GTF = ("measurements/gtf_simulated.csv", "--lattice", "lattices/gtf.toml")
CALIBRATION = ("emittance", *GTF, "--scenario", "calibration")
CONTRACT = (
    "plane", "status", "message", "emittance", "normalized_emittance", "beta", "alpha", "sigma11",
    "sigma12", "sigma22", "chi2", "dof", "rms_residual", "identifiability",
)  # fmt: skip


@pytest.mark.parametrize("sign", ["+-", "±"])
def test_a_prior_as_it_is_typed(run, sign):
    status, out, err = run(*CALIBRATION, "--prior", f"Q2.slope=167.23{sign}3.3446", "--json")
    assert (status, err) == (0, "")
    [result] = json.loads(out)["results"]
    assert set(CONTRACT) <= set(result)
    assert 0.02 < result["emittance"]["error"] / result["emittance"]["value"] < 0.03
    slope = next(p for p in result["parameters"] if p["name"] == "Q2.slope")
    assert slope["prior"] == [167.23, 3.3446]


def test_without_it_the_emittance_has_no_error(run):
    status, out, _ = run(*CALIBRATION, "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    assert result["status"] == "unidentified"
    assert result["emittance"]["error"] is None
    assert result["identifiability"]["verdict"] == "unidentified"
    slope = next(p for p in result["parameters"] if p["name"] == "Q2.slope")
    assert slope["state"] in ("lower", "upper")
    assert slope["value"]["value"] in (pytest.approx(147.23), pytest.approx(187.23))
    assert slope["multiplier"] != 0.0


def test_the_terminal_says_what_is_left_open(run):
    status, out, _ = run("emittance", *GTF, "--scenario", "transport-network", "--starts", "2")
    assert status == 0
    assert "Not determined: " in out
    assert "[A B] -> [A B] G" in " ".join(out.split())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--prior", "Q2.slope=167.23"), "NAME=MEAN+-SD"),
        (("--prior", "Q2.slope=a+-b"), "NAME=MEAN+-SD"),
        (("--prior", "Q2.slop=1+-1"), "did you mean Q2.slope"),
        (("--prior", "Q2.slope=167+--3"), "positive deviation"),
        (("--prior", "Q2.slope=1+-1", "--prior", "Q2.slope=2+-1"), "given twice"),
        (("--bounds", "Q2.slope=2:1"), "lower first"),
        (("--bounds", "Q2.slope=1"), "NAME=LOWER:UPPER"),
        (("--anchor", "first-principles=2%"), "transport-network or focusing-network"),
        (("--anchor", "first-principles"), "first-principles=2%"),
        (("--anchor", "first-principles=2"), "was 2% meant?"),
        (("--anchor", "Q2=0%"), "first-principles=2%"),
        (("--anchor", "Q2=1,first-principles=2%"), "first-principles=2%"),
        (("--anchor", "first-principles=2%", "--anchor", "first-principles=3%"), "once"),
        (("--bounds", "Q2.slope=147%:187"), "NAME=LOWER:UPPER"),
        (("--prior", "Q2.slope=167%+-3"), "NAME=MEAN+-SD"),
        (("--hidden", "0"), "at least 1"),
        (("--hysteresis",), "focusing-network"),
    ],
)
def test_bad_words_are_one_line(run, options, words):
    status, out, err = run(*CALIBRATION, *options)
    assert (status, out) == (2, "")
    assert words in err
    assert err.startswith("beamfit: ")
    assert err.count("\n") == 1


def test_design_as_json_and_on_the_terminal(run):
    status, out, err = run("design", *GTF, "--vary", "Q2=0:5", "--goal", "1%", "--json")
    assert (status, err) == (0, "")
    [result] = json.loads(out)["results"]
    assert result["status"] == "converged"
    assert 0.0 <= result["next"][0]["settings"]["Q2"] <= 5.0
    assert result["next"][-1]["relative_error"]["x"] <= 0.01
    status, out, _ = run("design", *GTF, "--scenario", "calibration")
    assert status == 0
    assert "new screen in the middle of D1" in " ".join(out.split())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--goal", "0"), "per cent"),
        (("--energies", "a"), "MeV"),
        (("--energies", "25,0.1"), "rest energy of 0.510999 MeV"),
        (("--energies", "1e9"), "10 TeV"),
        (("--energies", "nan"), "rest energy"),
        (("--vary", "Q2"), "NAME="),
        (("--vary", "Q2=0:10%"), "NAME="),
        (("--vary", "Q9=0:10"), "lattices/gtf.toml: --vary Q9: no magnet"),
    ],
)
def test_bad_wishes_of_a_design(run, options, words):
    status, _, err = run("design", *GTF, *options)
    assert status == 2
    assert words in err
