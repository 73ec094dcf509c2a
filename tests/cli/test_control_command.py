"""`beamfit control`: the contract, the page, and what it refuses."""

import json

import numpy as np
import pytest

HEAD = "time_s,u_valve,y_level\n"


@pytest.fixture
def record(tmp_path):
    level, rows = 0.0, []
    random = np.random.default_rng(2)
    for k, valve in enumerate(random.uniform(0, 3, 12).repeat(6)):
        rows.append(f"{k},{valve:.4f},{level + 0.02 * random.normal():.4f}\n")
        level += (2.0 * valve - level) * (1 - np.exp(-1 / 3))
    (tmp_path / "run.csv").write_text(HEAD + "".join(rows))
    return str(tmp_path / "run.csv")


def test_a_loop_answers_in_json_and_on_a_page(run, record, tmp_path, well_shown):
    page = tmp_path / "loop.html"
    said = ("--delay", 0, "--set", "level=2.5", "--set", "level=4@30", "--limit", "valve=0:3")
    said += ("--rate", "valve=0.5", "--limit", "level=:4.5", "--disturb", "level=-0.5@60")
    status, out, err = run("control", record, *said, "--json", "--report", page)
    assert status == 0, err
    found = json.loads(out)
    assert set(found) == {"beamfit", "command", "inputs", "results"}
    (one,) = found["results"]
    assert one["status"] == "converged"
    assert one["limits"]["rate"] == [0.5]
    assert [c["time"] for c in one["changes"]] == [0.0, 30.0, 60.0]
    u = np.array(one["loop"]["inputs"])[:, 0]
    assert np.abs(np.diff(u)).max() <= 0.5 + 1e-12
    assert "SIMULATED" in page.read_text()
    assert well_shown(page, 1) == []
    status, out, _ = run("control", record, *said)
    assert status == 0
    assert "disturbed by -0.5" in out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set", "level"), ["--set 'level'", "level=2.5@60"]),
        (("--set", "lvl=2"), ["--set of 'lvl'", "level"]),
        (("--set", "level=2", "--limit", "pump=0:1"), ["--limit of 'pump'", "valve"]),
        (("--set", "level=2", "--limit", "valve=2:1"), ["limits 2 to 1 of valve"]),
        (("--set", "level=2", "--rate", "valve=fast"), ["--rate 'valve=fast'"]),
        (("--set", "level=2", "--rate", "valve=1.2.3"), ["--rate 'valve=1.2.3'"]),
        (("--set", "level=2", "--for", 1e9), ["a loop of 1e+09 s", "at most 100000 steps"]),
        (("--set", "level=2", "--rate", "pump=1"), ["--rate of 'pump'", "valve"]),
        (("--set", "level=2", "--for", -3), ["a loop of -3 s", "a step"]),
        (("--set", "level=nan"), ["nan for level", "finite"]),
        (("--set", "level=9", "--limit", "level=:5"), ["level wanted at 9", "at most 5"]),
    ],
)
def test_bad_input_is_one_line_and_exit_2(options, words, run, record):
    status, out, err = run("control", record, "--delay", 0, *options)
    assert (status, out, err.count("\n")) == (2, "", 1), err
    for word in words:
        assert word in err, err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set", "level=2", "--rate", "valve=-1"), ["rate -1 of valve", "above 0"]),
        (("--set", "level=2", "--limit", "valve=2:1"), ["limits 2 to 1 of valve"]),
        (("--set", "level=4", "--limit", "level=:3"), ["level wanted at 4", "at most 3"]),
        (("--set", "level=2@-5"), ["level at -5 s", "0 s or later"]),
        (("--set", "level=2", "--disturb", "level=inf"), ["inf for level", "finite"]),
        (("--set", "level=2", "--smooth", 0), ["--smooth", "0"]),
    ],
)
def test_limits_are_refused_before_the_runs_are_identified(
    options, words, run, record, monkeypatch
):
    """After 23 s, they were."""
    monkeypatch.setattr("beamfit.control", None)
    status, out, err = run("control", record, *options)
    assert (status, out) == (2, ""), err
    for word in words:
        assert word in err, err
