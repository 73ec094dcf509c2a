"""Code blocks of the documentation: every command and every Python block runs as it stands.

Blocks with a test beside their subject are run there: tutorial, README and the example's files
(cli/test_example, test_readme), extending, control and fedbatch in Python, live_adapters, the
language's own examples, and scans and watches of a machine (tests/live).
"""

import json
import os
import re
import shlex
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import click
import pytest

from beamfit.cli import cli, main

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
# An indented or fenced line that begins with the program's name, and the lines it goes on in.
COMMAND = re.compile(r"^(?:    |\$ )\$? ?(beamfit (?:.*\\\n)*.*)$", re.MULTILINE)
ELSEWHERE = {"README", "tutorial", "language", "live", "watch"}
PYTHON_ELSEWHERE = {"README", "tutorial", "python", "extending", "control", "fedbatch"}
PYTHON_ELSEWHERE |= {"live_adapters", "batch"}  # the batch's wants a cluster's queue
# What the last two show, their commands run.
PYTHON_SLOW = {"lifetime_study", "response", "density", "tuning"}
# Networks, studies of a shift, posteriors, workers and tuning, whose very command
# cli/test_tune_command runs, take 10 s and more: `make calibrate`.
SLOW = {"network", "--study", "--sample", "--workers", "state-space", "--hold-back", "--trend"}
SLOW |= {"transport-network", "tune"}
# Sampling computes for minutes in programs that are not optimised, as those of the tests are.
OPTIMISED = {"density"}
DECAY, VALVE = "beamfit/example/decay.csv", "measurements/valve_level_simulated.csv"
# Files of a reader's own that pages name, and what stands in for them.
OWN = {
    "line.toml": "lattices/lcls_otr2.toml",
    "spear3_2003_twiss.csv": "lattices/spear3_2003_twiss.csv",
    "ring.toml": "lattices/spear3_2003.toml",
    **{f"scans/{day}.csv": "measurements/lcls_otr2.csv" for day in ("mon", "tue", "wed")},
    **dict.fromkeys(("fills/one.csv", "fill.csv", "fill1.csv", "fill2.csv"), DECAY),
    "shift.csv": "measurements/spear3_shift_simulated.csv",
    **dict.fromkeys(("measured.csv", "monday.csv", "tuesday.csv", "friday.csv"), VALVE),
}
SCAN_HEADERS = {"Q525_kG": "QUAD:Q525:BACT", "size_x_um": "xrms", "size_x_error_um": "err"}


def commands():
    """Page and words of each command; what stands behind # is a remark."""
    for page in PAGES:
        for found in COMMAND.findall(page.read_text()):
            words = shlex.split(found.replace("\\\n", " "), comments=True)
            if len(words) > 1 and words[1] in cli.commands:
                yield page, words[1:]


def slow(words):
    return bool(SLOW & set(words))


def row(page, words, marks=()):
    return pytest.param(page, words, id=f"{page.stem}: {' '.join(words)[:60]}", marks=marks)


@pytest.mark.parametrize(
    ("page", "words"),
    [
        row(page, words, [pytest.mark.calibrate] * slow(words))
        for page, words in commands()
        if page.stem not in ELSEWHERE
    ],
)
def test_every_command_of_every_page_runs(page, words, tmp_path, monkeypatch, capsys):
    lay_out(page, words, tmp_path)
    monkeypatch.chdir(tmp_path)
    asked = ["beamfit", *expanded(words, tmp_path)]
    if words[0] in OPTIMISED:
        plain = os.environ | {"XLA_FLAGS": ""}
        done = subprocess.run([sys.executable, "-m", *asked], env=plain, capture_output=True)
        assert done.returncode == 0, done.stderr.decode()
        assert done.stdout
        return
    monkeypatch.setattr(sys, "argv", asked)
    with pytest.raises(SystemExit) as stop:
        main()
    shown = capsys.readouterr()
    assert stop.value.code == 0, shown.err
    assert shown.out


def lay_out(page, words, folder):
    """Write what stands in for a reader's files, and the files whose text the page has."""
    for name in ("measurements", "lattices", "formulations"):
        (folder / name).symlink_to(ROOT / name)
    for name, source in OWN.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text((ROOT / source).read_text())
    if words[0] != "example":
        (folder / "first").symlink_to(ROOT / "beamfit/example")
    renamed(ROOT / "measurements/lcls_otr2.csv", folder / "scan.csv", SCAN_HEADERS)
    dated(ROOT / DECAY, folder)
    for block in re.findall(r"(?:^    .*\n|^\n)+", page.read_text(), re.MULTILINE):
        text = re.sub(r"^    ", "", block, flags=re.MULTILINE).strip()
        if text.startswith('format = "beamfit-layout-1"'):
            (folder / "lcls.toml").write_text(text.partition("beamfit emittance")[0])
        if text.startswith("# known.toml"):
            (folder / "known.toml").write_text(text.partition("beamfit emittance")[0])


def renamed(source, path, headers):
    """Copy a scan under a laboratory's own headers."""
    head, *rows = lines_of(source)
    head = ",".join(headers.get(name, name) for name in head.split(","))
    path.write_text("\n".join([head, *rows]) + "\n")


def dated(source, folder):
    """Write readings of two weeks, as an archive exports them and as EPICS' archiver gives them."""
    rows = [[float(cell) for cell in line.split(",")[:2]] for line in lines_of(source)[1:]]
    begin = datetime(2024, 3, 1, tzinfo=UTC)
    heads = {"week1": "time,beam_current_mA", "week2": "time,beam_current_mA"}
    for week, (name, head) in enumerate({"export": "Timestamp,SR:DCCT:CURRENT", **heads}.items()):
        start = begin + week * timedelta(days=7)
        lines = [f"{start + timedelta(seconds=time):%Y-%m-%d %H:%M:%S},{i}" for time, i in rows]
        (folder / f"{name}.csv").write_text("\n".join([head, *lines]) + "\n")
    data = [{"secs": int(begin.timestamp() + time), "nanos": 0, "val": i} for time, i in rows]
    archived = [{"meta": {"name": "SR:DCCT:CURRENT", "EGU": "mA"}, "data": data}]
    (folder / "archiver.json").write_text(json.dumps(archived))


def lines_of(source):
    return [line for line in source.read_text().splitlines() if not line.startswith("#")]


def expanded(words, folder):
    """The words as a shell gives them: patterns of files as their names."""
    for word in words:
        found = sorted(folder.glob(word)) if re.search(r"[*?]", word) and "=" not in word else []
        yield from (str(path.relative_to(folder)) for path in found) if found else [word]


@pytest.mark.parametrize(
    ("page", "words"), [row(p, w) for p, w in commands() if p.stem in ELSEWHERE or slow(w)]
)
def test_commands_that_run_elsewhere_or_seldom_have_the_options_that_they_name(page, words):
    parsed(words)


def parsed(words):
    """The words of a command by option, none of them looked up."""
    name, *arguments = [word for word in words if word not in ("…", "...")]
    context = click.Context(cli.commands[name], info_name=name)
    return cli.commands[name].make_parser(context).parse_args(arguments)[0]


def test_an_option_that_is_none_is_found():
    assert parsed(["emittance", "scan.csv", "--json"])["as_json"]
    with pytest.raises(click.NoSuchOption):
        parsed(["emittance", "scan.csv", "--jsn"])


def python_pages():
    """Pages with Python that no other test runs; networks and knobs take 10 s and more."""
    for page in PAGES:
        if page.stem not in PYTHON_ELSEWHERE and "```python\n" in page.read_text():
            marks = [pytest.mark.calibrate] if page.stem in PYTHON_SLOW else []
            yield pytest.param(page, id=page.stem, marks=marks)


@pytest.mark.parametrize("page", list(python_pages()))
def test_python_runs_as_it_stands(page, monkeypatch, tmp_path, capsys):
    lay_out(page, [""], tmp_path)
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
        exec(block, names)
