"""`beamfit solve`: documents in, answers and places of mistakes out. Data are SIMULATED."""

import json

import pytest

DATA = ("--data", "d=formulations/fitdata_simulated.csv")


def result(run, *arguments):
    status, out, error = run("solve", *arguments, "--json")
    assert (status, error) == (0, "")
    document = json.loads(out)
    assert list(document) == ["beamfit", "command", "inputs", "results"]
    (found,) = document["results"]
    return document, found


def test_the_set_point_of_the_report_in_words_and_in_json(run):
    status, out, error = run("solve", "formulations/appendix_d.bf")
    assert (status, error) == (0, "")
    assert "I_2       1.0885976      0     10   free" in out
    assert "obj = 2.1137780" in out
    assert "major step limit" in out
    document, found = result(run, "formulations/appendix_d.xml")
    assert list(document["inputs"]) == ["formulations/appendix_d.xml"]
    assert found["variables"][0]["value"]["value"] == pytest.approx(1.0885976, abs=5e-8)
    assert (found["status"], found["direction"]) == ("local_optimum", "minimize")
    assert found["outputs"]["dx_model"] == pytest.approx(199.5498, abs=1e-4)


def test_starts_are_drawn_again_from_the_same_seeds_until_they_are_finite(run, root, tmp_path):
    text = (root / "formulations/appendix_c.bf").read_text()
    text = text.replace("seed 11;", "seed 2;").replace("seed 12;", "seed 4;")
    (tmp_path / "c.bf").write_text(text)
    _, found = result(run, tmp_path / "c.bf", *DATA)
    assert found["status"] == "at_limit"
    assert found["objective"] == pytest.approx(4.87688, rel=1e-4)
    (note,) = (n for n in found["notes"] if "drawn again from the same seeds" in n)
    assert "in Transfer for k = " in note
    assert "in BeamTransfer: sqrt(dx2) is not a number (line 50, column 14)" in note
    assert "dx2 = -" in note


def test_constraints_have_multipliers_and_a_page_is_written(run, tmp_path, well_shown):
    page = tmp_path / "page.html"
    text = """maximize area; variable a in [0, 9]; variable b in [0, 9]; constraint round <= 8;
              input a, b; output area, round; area = a*b; round = 2*a + 2*b;"""
    (tmp_path / "field.bf").write_text(text)
    _, found = result(run, tmp_path / "field.bf", "--start", "3", "--report", page)
    assert found["objective"] == pytest.approx(4.0)
    (limit,) = found["constraints"]
    assert (limit["name"], limit["state"], limit["lower"]) == ("round", "upper", None)
    assert limit["multiplier"] == pytest.approx(1.0, rel=1e-4)  # d(area)/d(round) = round/8
    assert well_shown(page, 0) == []
    status, out, err = run("solve", tmp_path / "field.bf", "--report", tmp_path / "field.png")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "without a picture" in err
    assert len(found["starts"]) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("minimize y; variable x; input x; output y; y = z^2;", ":1:48: unknown name 'z'"),
        ("minimize y;\nvariable x in [2, 1];\ninput x; output y; y = x;", ":2:10: bounds of 'x'"),
        ("minimize y;\nvariable q;\ninput x; output y; y = x;", ":2:10: no input 'q'"),
        ("output y;\ny = 2 +;", ":2:8: ';'"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><mapping/>", "XML without entities"),
        (
            "<mapping><output name='y'/><expressions>\n y = sinn(2);</expressions></mapping>",
            ":2:6:",
        ),
        ("output y; y = 2;", "a document without an objective"),
        ('table t = "no.csv"; output y; minimize y; y = t[1, 1];', ":1:7: table 't'"),
    ],
)
def test_mistakes_have_a_place(run, tmp_path, text, said):
    (tmp_path / "wrong.bf").write_text(text)
    status, out, error = run("solve", tmp_path / "wrong.bf")
    assert (status, out, error.count("\n")) == (2, "", 1)
    assert "wrong.bf" in error
    assert said in error


@pytest.mark.parametrize("start", ["0", "few", "-1"])
def test_odd_starts_are_refused(run, start):
    status, _, error = run("solve", "formulations/appendix_d.bf", "--start", start)
    assert (status, f"--start '{start}'" in error) == (2, True)


def test_tables_of_other_sizes_are_refused(run, tmp_path):
    (tmp_path / "short.csv").write_text("a;b\n1;2\n3;4\n")
    data = f"d={tmp_path / 'short.csv'}"
    status, _, error = run("solve", "formulations/appendix_a.bf", "--data", data)
    assert (status, "short.csv: 2 x 2 numbers; expected 14 x 23" in error) == (2, True)
    status, _, error = run("solve", "formulations/appendix_a.bf", "--data", "q=x.csv")
    assert (status, "a table of it: d" in error) == (2, True)
