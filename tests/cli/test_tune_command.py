"""`beamfit tune` as a person and as a script use it."""

import json

import pytest

TABLE, LATTICE = "measurements/gun_tuning_simulated.csv", "lattices/gun_tuning.toml"
KNOBS = ("--vary", "SOL=190:210", "--vary", "phase_deg=-12:12")


def test_the_answer_and_the_page(run, tmp_path):
    page = tmp_path / "tune.html"
    status, out, err = run("tune", TABLE, "--lattice", LATTICE, *KNOBS, "--report", page)
    assert (status, err) == (0, "")
    assert out.strip().splitlines()[0].startswith("converged: normalised emittance")
    for words in ("Best setting, from", "SOL", "phase_deg", "Measure next at SOL ="):
        assert words in out
    text = page.read_text()
    assert "map of SOL and phase_deg" in text
    assert "course of the best emittance" in text


def test_the_answer_as_json(run):
    status, out, err = run("tune", TABLE, "--lattice", LATTICE, *KNOBS, "--json")
    assert (status, err) == (0, "")
    [result] = json.loads(out)["results"]
    # The truth of benchmarks/guns.py: 0.715 µm at 198.0 A.
    low, high = result["settings"]["SOL"]["interval_95"]
    assert low < 198.03 < high
    low, high = result["minimum"]["interval_95"]
    assert low < 0.7151e-6 < high
    assert set(result["next"]["settings"]) == {"SOL", "phase_deg", "Q"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "no --vary"),
        (("--vary", "SOLL=1:2"), f"{TABLE}:2: no column of the knob 'SOLL'"),
        (("--vary", "SOL=1:2"), "limits 1:2 of SOL, which was set from 190"),
        (("--vary", "SOL=210:190", *KNOBS[2:]), "limits 210:190 of SOL; expected two numbers"),
        (KNOBS[2:], f"{TABLE}: column 'SOL_A': no magnet 'SOL' in the lattice"),
        ((*KNOBS, "--goal", "emittance_y"), "no sizes in plane y"),
        ((*KNOBS, "--close", "none"), "none"),
    ],
)
def test_bad_input_is_named(run, words, said):
    status, out, err = run("tune", TABLE, "--lattice", LATTICE, *words)
    assert (status, out) == (2, "")
    assert said in err


def test_a_wrong_cell_is_named_by_its_line_and_the_header_of_the_file(run, tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("Q_k1l,phase_deg,size_x_um\n0,1,100\n1,x,120\n2,3,90\n")
    status, _, err = run("tune", table, "--lattice", LATTICE, "--vary", "phase_deg=0:3")
    assert status == 2
    assert "table.csv:3: column 'phase_deg': 'x'; expected a number" in err
