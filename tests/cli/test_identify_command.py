"""`beamfit identify`: the contract, the page, and what it refuses."""

import json
from functools import partial

import pytest

from beamfit.dynamics import fit

RECORD = "measurements/valve_level_simulated.csv"
HEAD = "time_s,u_valve,y_level\n"
ROWS = [f"{k},{(k // 5) % 2},{k % 5 / 5:.2f}\n" for k in range(20)]


def table(*rows, head=HEAD):
    return head + "".join(rows)


def test_json_has_the_contract_s_keys_and_the_page_is_written(run, tmp_path, well_shown):
    page = tmp_path / "page.html"
    status, out, err = run("identify", RECORD, "--json", "--delay", 2, "--report", page)
    found = json.loads(out)
    assert status == 0, err
    assert set(found) == {"beamfit", "command", "inputs", "results"}
    assert len(found["inputs"][RECORD]) == 64
    (one,) = found["results"]
    assert one["output"] == "level"
    assert one["status"] == "poor_fit"  # its parameters change with the valve
    assert set(one["parameters"]) == {"tau", "K", "offset"}
    assert set(one["parameters"]["tau"]) == {"value", "error", "error_raw", "unit", "interval_95"}
    assert one["delay_samples"] == 2
    assert "SIMULATED" in page.read_text()
    assert well_shown(page, 2) == []
    assert "Try parameters that change" in one["message"]


def test_a_network_answers_with_curves(run, monkeypatch):
    monkeypatch.setattr(fit, "identify", partial(fit.identify, starts=1))
    status, out, _ = run("identify", RECORD, "--map", "network", "--delay", 2)
    assert status == 0
    assert "level converged" in out
    shown = out.partition("tau by valve")[2].partition("K by valve")[0]
    assert shown.count(" ± ") == 3  # of nine; --full has all


def test_columns_of_any_name_without_a_time(run, tmp_path):
    lines = ["Valve,Level,Remark\n", *(f"{(k // 8) % 2},{k % 8 / 9:.3f},ok\n" for k in range(64))]
    (tmp_path / "log.csv").write_text("".join(lines))
    said = ("--input", "Valve", "--output", "Level", "--step", 4, "--json")
    status, out, err = run("identify", tmp_path / "log.csv", *said)
    assert status == 0, err
    assert json.loads(out)["results"][0]["output"] == "Level"


def test_a_named_column_may_have_its_unit_in_brackets(run, tmp_path):
    lines = [
        "Time [s],Valve [%],Level (m)\n",
        *(f"{k},{(k // 8) % 2},{k % 8 / 9:.3f}\n" for k in range(64)),
    ]
    (tmp_path / "log.csv").write_text("".join(lines))
    said = ("--input", "Valve [%]", "--output", "Level (m)", "--json")
    status, out, err = run("identify", tmp_path / "log.csv", *said)
    assert status == 0, err
    assert json.loads(out)["results"][0]["output"] == "Level_m"


BAD = {
    "time backwards": (table(*ROWS[:9], ROWS[3], *ROWS[10:]), (), [":11:", "time_s", "increase"]),
    "a constant input": (
        table(*(r.replace(f",{(k // 5) % 2},", ",1,") for k, r in enumerate(ROWS))),
        (),
        ["valve", "changes"],
    ),
    "too short": (table(*ROWS[:4]), (), ["4 readings", "8"]),
    "no input": (table(*ROWS, head="time_s,note_a,y_level\n"), (), [":1:", "u_"]),
    "no output": (table(*ROWS, head="time_s,u_valve,note_b\n"), (), [":1:", "y_"]),
    "no time": (table(*ROWS, head="note_c,u_valve,y_level\n"), (), [":1:", "--step"]),
    "an unknown column": (table(*ROWS, head="time_s,valve,y_level\n"), (), [":1:", "valve"]),
    "unknown columns": (
        table(*ROWS, head="time_s,valve,level\n"),
        (),
        ["inputs u_...", "outputs y_...", "--input", "--output"],
    ),
    "a word": (table(*ROWS[:3], "3,open,1\n", *ROWS[4:]), (), [":5:", "u_valve", "open"]),
    "a blank input": (table(*ROWS[:3], "3,,1\n", *ROWS[4:]), (), [":5:", "u_valve", "empty"]),
    "an input that is none": (table(*ROWS), ("--input", "vavle"), ["vavle"]),
    "uneven samples": (
        table(*(f"{k * k},{(k // 5) % 2},{k}\n" for k in range(20))),
        ("--model", "arx"),
        ["unequal"],
    ),
    "an order of no state space": (table(*ROWS), ("--order", "2"), ["--order 2", "state-space"]),
    "more states than readings": (
        table(*ROWS),
        ("--model", "state-space", "--order", "9"),
        ["order 9 with 20 readings", "1 to 1"],
    ),
    "uneven samples of a state space": (
        table(*(f"{k * k},{(k // 5) % 2},{k}\n" for k in range(20))),
        ("--model", "state-space"),
        ["unequal"],
    ),
    "constant rates of a fed batch": (
        table(*ROWS),
        ("--model", "fed-batch"),
        ["--model fed-batch", "--map network"],
    ),
    "no biomass of a fed batch": (
        table(*ROWS),
        ("--model", "fed-batch", "--map", "network"),
        ["a.csv: no output biomass", "y_biomass"],
    ),
    "empty": ("", (), ["empty"]),
    "no step": (table(*ROWS, head="note_c,u_valve,y_level\n"), ("--step", "-1"), ["--step", "0"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_exit_2(case, run, tmp_path):
    content, options, words = BAD[case]
    (tmp_path / "a.csv").write_text(content)
    status, out, err = run("identify", tmp_path / "a.csv", *options)
    assert (status, out, err.count("\n")) == (2, "", 1), err
    for word in words:
        assert word in err, err
