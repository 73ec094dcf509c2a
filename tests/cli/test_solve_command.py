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
        ("variable x; input x; output y; y = x;", ":1:10: a document without an objective"),
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


def test_a_mapping_is_computed_at_given_inputs_with_the_gains_asked_for(run, tmp_path, well_shown):
    """Figure 3 of the report, by hand: y4 sums rows of x4, y5 weighs them by sums of 2 x3."""
    given = ["--set", "x1=0.5", "--set", "x2=2", "--set", "x3=1", "--derivative", "dy5/dx4"]
    given += ["--set", "x4=" + ",".join(map(str, range(1, 13)))]
    _, found = result(run, "formulations/figure_3.xml", *given)
    assert found["outputs"]["y1"] == [2.5] * 10
    assert found["outputs"]["y4"] == [10, 26, 42]
    assert found["outputs"]["y5"] == 8 * (10 + 26 + 42)
    assert found["gains"] == {"dy5/dx4": [[8.0] * 4] * 3}
    page = tmp_path / "page.html"
    status, out, _ = run("solve", "formulations/figure_3.xml", *given, "--report", page)
    assert (status, "dy5/dx4[2, 3]" in out) == (0, True)
    assert well_shown(page, 0) == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--set", "x1=1"], ":7:16: input 'x2[10]' without a value; expected --set x2=NUMBER"),
        (["--set", "x9=1"], "an input of the document: one of x1"),
        (["--set", "x1=1,2"], "2 numbers in --set x1=...; expected one, or 10 for x1[I]"),
        (["--set", "x1=one"], "--set x1=one; expected a number"),
        (["--set", "x1=1", "--set", "x1=2"], "each name once"),
        (["--within", "0"], "--within 0; expected a number above 0"),
        (["--solver", "snopt"], "'snopt'"),
    ],
)
def test_what_is_given_to_a_mapping_is_checked(run, given, said):
    status, out, error = run("solve", "formulations/figure_3.xml", *given)
    assert (status, out, error.count("\n"), said in error) == (2, "", 1, True)


def test_gains_solver_and_tolerance_at_an_answer(run, tmp_path):
    """d/dx of x^4 at the minimum of x^4 - 4x, x = 1, from a start that is given."""
    text = "minimize y; variable x in [0, 3]; input x, c = 4; output y, z; y = x^4 - c*x; z = x^4;"
    (tmp_path / "quartic.bf").write_text(text)
    asked = ["--derivative", "dz/dx", "--solver", "ipopt", "--tolerance", "1e-9", "--set", "x=2.5"]
    _, found = result(run, tmp_path / "quartic.bf", *asked)
    assert (found["solver"], found["kkt_residual"] < 1e-9) == ("Uno ipopt", True)
    assert found["gains"]["dz/dx"] == pytest.approx(4.0, rel=1e-8)
    _, found = result(run, tmp_path / "quartic.bf", "--set", "c=32", "--within", "100")
    assert found["variables"][0]["value"]["value"] == pytest.approx(2.0, rel=1e-7)
    status, _, error = run("solve", tmp_path / "quartic.bf", "--solver", "levenberg-marquardt")
    assert (status, "one of filtersqp, ipopt, slsqp" in error) == (2, True)
    status, _, error = run("solve", tmp_path / "quartic.bf", "--derivative", "dz/dq")
    assert (status, "an input of the document: one of x, c" in error) == (2, True)


@pytest.mark.parametrize(
    ("text", "status", "places"),
    [
        ("minimize y;\nvariable x in [0, 1];\nconstraint low >= 3;\ninput x;\noutput y, low;\n"
         "y = x^2;\nlow = x + 1;", "infeasible",
         ["'low' at line 3, column 12", "'x' at line 2, column 10"]),
        ("minimize y;\nvariable x;\ninput x;\noutput y;\ny = -x;", "unbounded",
         ["'x' at line 2, column 10"]),
        ("minimize y;\nvariable x;\nvariable z;\nconstraint a = 1;\nconstraint b = 2;\n"
         "input x, z;\noutput y, a, b;\ny = z^2 + x^2;\na = x + z;\nb = 2*x + 2*z;", "degenerate",
         ["not independent; remove what follows from others ('a' at line 4, column 12, 'b' at"]),
        ("minimize y;\nvariable x = 7 in [0, 1];\ninput x;\noutput y;\ny = (x - 1/2)^2;", "optimal",
         ["At line 2, column 10: 'x' has the start 7 outside its bounds [0, 1]"]),
        ("minimize y;\nvariable x in [0, 1] random [5, 9] seed 1;\ninput x;\noutput y;\n"
         "y = (x - 1/2)^2;", "optimal",
         ["'x' has the random starts in [5, 9] outside its bounds"]),
    ],
)  # fmt: skip
def test_findings_of_the_solver_name_lines(run, tmp_path, text, status, places):
    (tmp_path / "m.bf").write_text(text)
    _, found = result(run, tmp_path / "m.bf")
    assert found["status"] == status
    notes = " ".join(found["notes"])
    assert all(place in notes for place in places)


def test_gains_in_series_are_a_freedom_of_the_model_that_no_data_end(run, tmp_path):
    (tmp_path / "m.bf").write_text(
        "minimize miss;\nvariable k1 = 1 in [0, 9];\nvariable k2 = 1.5 in [0, 9];\n"
        "input k1, k2;\noutput miss;\nset T = |1:5|;\n"
        "parameter seen[T] = [2.1, 3.9, 6.1, 8, 9.9];\n"
        "miss = sum(t in T | (k1*k2*t - seen[t])^2);"
    )
    _, found = result(run, tmp_path / "m.bf")
    assert found["status"] == "unidentified"
    assert "k1, k2 move together (k1 +1 %, k2 -1 %)" in found["message"]
    assert "whatever the data, a freedom of the model; fix one of them" in found["message"]
    notes = " ".join(found["notes"])
    assert "'k1' at line 2, column 10, 'k2' at line 3, column 10" in notes
    assert "add data" not in notes


def test_a_document_solved_again_compiles_nothing(root, tmp_path, caplog):
    """Neither the document read again nor another value of an input is traced again."""
    import jax

    from beamfit.io.formulation import read_formulation, solve_formulation

    path = tmp_path / "again.bf"
    path.write_text((root / "formulations/appendix_d.bf").read_text() + "# solved again")

    def solved(**given):
        caplog.clear()
        with jax.log_compiles():
            found = solve_formulation(read_formulation(path), path, **given)
        return found.objective, "Compiling" in caplog.text

    first, compiled = solved()
    assert compiled
    assert solved() == (first, False)
    other, compiled = solved(values={"dx_desired": [150.0]})
    assert (other != first, compiled) == (True, False)
