"""The example files: written whole, never over others, answered at once, as README shows them."""

import re
import subprocess
import sys
from importlib.resources import files

import numpy as np
import pytest

from beamfit import read_decay_record, read_quad_scan
from beamfit.cli.example import EXAMPLE_FILES

GROUP = re.compile(r"```\w*\n(.*?)```", re.DOTALL)


def run_module(*arguments):
    call = [sys.executable, "-m", "beamfit", *map(str, arguments)]
    return subprocess.run(call, capture_output=True, text=True)


def test_a_new_folder_is_made_and_nothing_in_it_overwritten(tmp_path):
    folder = tmp_path / "a" / "first"
    done = run_module("example", folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted(p.name for p in folder.iterdir()) == sorted(EXAMPLE_FILES)
    (folder / "scan.csv").unlink()
    (folder / "decay.csv").write_text("mine")
    again = run_module("example", folder)
    assert (again.returncode, again.stdout) == (2, "")
    assert "lattice.toml: a file that is there already" in again.stderr
    assert (folder / "decay.csv").read_text() == "mine"
    assert not (folder / "scan.csv").exists()


def test_a_place_that_is_no_folder_is_refused(run, tmp_path):
    (tmp_path / "taken").write_text("")
    status, out, error = run("example", tmp_path / "taken")
    assert (status, out, error.count("\n")) == (2, "", 1)
    assert "taken: a place where no folder can be" in error


def test_the_commands_it_names_answer_it(run, tmp_path):
    _, said, _ = run("example", tmp_path)
    commands = [line.split() for line in said.splitlines() if line.startswith("  beamfit ")]
    answers = {"check": "has all its magnets and screens", "emittance": "converged"}
    answers |= {"lifetime": "converged"}
    assert {words[1] for words in commands} == set(answers)
    for _, *arguments in commands:
        status, out, error = run(*arguments)
        assert (status, error) == (0, "")
        assert answers[arguments[0]] in out


def test_readme_shows_the_files_and_the_answer(run, tmp_path, root):
    blocks = GROUP.findall((root / "README.md").read_text())
    for name in ("scan.csv", "lattice.toml"):
        assert (files("beamfit") / "example" / name).read_text() in blocks
    run("example", tmp_path)
    commands = {
        "first/": ("--lattice", tmp_path / "lattice.toml", tmp_path / "scan.csv"),
        "measurements/": ("measurements/aps_1999_decay.csv",),
    }
    names = {"first/": "emittance", "measurements/": "lifetime"}
    for place, arguments in commands.items():
        name = names[place]
        (answer,) = (block for block in blocks if f"$ beamfit {name} {place}" in block)
        said = " ".join(run(name, *arguments)[1].split())
        for shown in answer.partition("\n")[2].split("...\n"):
            assert " ".join(shown.split()) in said


def test_the_tutorial_is_what_happens(run, tmp_path, root, monkeypatch):
    text = (root / "docs/tutorial.md").read_text()
    monkeypatch.chdir(tmp_path)
    shown = "".join(block for block in GROUP.findall(text) if block.startswith("$ "))
    steps = re.split(r"^\$ ", shown, flags=re.MULTILINE)[1:]
    for step in steps:
        command, _, answer = step.partition("\n")
        name, *arguments = command.split()
        if name != "beamfit":
            subprocess.run(command, shell=True, check=True)
            continue
        status, out, error = run(*arguments)
        assert (status, error) == (0, ""), command
        said = " ".join(out.split())
        for part in answer.split("...\n"):
            assert " ".join(part.split()) in said, command
    assert len(steps) == 6
    said, names = [], {}
    names["print"] = lambda *words: said.append(" ".join(map(str, words)))
    for script in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(script, names)
    assert said[:2] == re.findall(r"^print\(.*\)  # (.*)$", text, re.MULTILINE)
    assert said[2].startswith("a is determined; b lies between")
    assert (tmp_path / "first/scan_y.png").is_file()
    assert (tmp_path / "first/scan.html").is_file()


def sizes_of(plane, current, emittance, beta, alpha):
    """Rms sizes in m behind the example's quadrupole and drift, written out anew."""
    momentum = np.sqrt(100.0**2 - 0.51099895**2)
    k1 = 299.792458 * 0.5 * current / momentum * (1 if plane == "x" else -1)
    root = np.sqrt(k1.astype(complex)) + 1e-12
    c, s = np.cos(root * 0.1).real, (np.sin(root * 0.1) / root).real
    r11, r12 = c - 2.0 * k1 * s, s + 2.0 * c
    gamma = (1 + alpha**2) / beta
    geometric = emittance / (momentum / 0.51099895)
    spread = r11**2 * beta - 2 * r11 * r12 * alpha + r12**2 * gamma
    return np.sqrt(geometric * spread + 10e-6**2)


@pytest.mark.parametrize(("plane", "truth"), [("x", (1e-6, 8, 0.5)), ("y", (1.2e-6, 6, -0.4))])
def test_the_scan_is_what_its_head_says(plane, truth):
    rows = read_quad_scan(files("beamfit") / "example" / "scan.csv").rows(plane)
    true = sizes_of(plane, rows.settings["Q1"], *truth)
    pull = (rows.size - true) / (0.02 * true)
    assert 0.3 < np.sqrt(np.mean(pull**2)) < 1.7
    np.testing.assert_allclose(rows.error, 0.02 * true, rtol=0.05)


def test_the_decay_is_what_its_head_says():
    record = read_decay_record(files("beamfit") / "example" / "decay.csv")
    fall = np.exp(-1.5e-5 * record.time)
    true = 100.0 * fall / (1 + 4e-7 / 1.5e-5 * 100.0 * (1 - fall))
    assert 0.005 < np.std(record.current - true) < 0.02
