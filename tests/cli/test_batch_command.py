"""Many files, each answered as by itself; what stops a run or a worker loses and doubles none."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as parquet
import pytest

from beamfit.batch import run as running
from beamfit.batch.columns import COLUMNS, NUMBERS
from beamfit.batch.course import courses_of, summary_of
from beamfit.batch.job import Job
from beamfit.batch.run import run_batch
from beamfit.errors import InputError

FACTORS = (1.0, 1.01, 0.99, 1.0, 1.01, 0.99, 1.0, 1.4)


def table(path):
    with open(path, newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def year(root, tmp_path_factory):
    """Scans of one line, the last of another beam; and three files that nobody can use."""
    folder = tmp_path_factory.mktemp("year")
    head, *rows = (root / "measurements/gtf_simulated.csv").read_text().splitlines()
    while head.startswith("#"):
        head, *rows = rows
    at = [i for i, name in enumerate(head.split(",")) if name.startswith("size_")]
    for number, factor in enumerate(FACTORS):
        cells = [row.split(",") for row in rows]
        for row in cells:
            for i in at:
                row[i] = repr(factor * float(row[i]))
        text = "\n".join([head, *map(",".join, cells)])
        (folder / f"scan{number}.csv").write_text(text + "\n")
    (folder / "text.csv").write_text("nothing\n")
    (folder / "empty.csv").write_text("")
    (folder / "wide.csv").write_text("Q2_A,size_x_um\n0,1\n1,2\n2,many\n")
    return folder


@pytest.fixture(scope="module")
def job(root):
    return Job("emittance", str(root / "lattices/gtf.toml"))


@pytest.fixture(scope="module")
def answered(year, job, tmp_path_factory):
    return run_batch([str(year)], str(tmp_path_factory.mktemp("out") / "a.csv"), job)


def test_a_row_says_what_the_command_says_of_the_file_alone(answered, run, year):
    rows = table(answered.ledger.out)
    lattice = answered.ledger.job.lattice
    for name in ("scan0.csv", "scan7.csv"):
        [row] = [row for row in rows if row["file"].endswith(name)]
        _, out, _ = run("emittance", year / name, "--lattice", lattice, "--json")
        [said] = json.loads(out)["results"]
        assert (row["status"], row["message"]) == (said["status"], said["message"])
        assert row["sha256"] == json.loads(out)["inputs"][str(year / name)]
        for quantity in ("emittance", "beta", "alpha", "sigma12"):
            unit = {"sigma12": "_m_rad", "alpha": ""}.get(quantity, "_m")
            low, high = said[quantity]["interval_95"]
            told = {"": "value", "_error": "error", "_error_raw": "error_raw"}
            expected = {end: said[quantity][key] for end, key in told.items()}
            for end, number in (expected | {"_low_95": low, "_high_95": high}).items():
                assert math.isclose(float(row[quantity + end + unit]), number, rel_tol=1e-9)
        known = said["identifiability"]
        assert float(row["chi2"]) == pytest.approx(said["chi2"], rel=1e-9)
        assert float(row["singular_value_3"]) == pytest.approx(known["singular_values"][2])


def test_what_cannot_be_used_is_a_row_with_its_reason(answered, run, year):
    assert answered.statuses["unusable"] == 3
    rows = {Path(row["file"]).name: row for row in table(answered.ledger.out)}
    for name in ("text.csv", "empty.csv", "wide.csv"):
        code, _, said = run("emittance", year / name, "--lattice", answered.ledger.job.lattice)
        assert code == 2
        assert said == f"beamfit: {rows[name]['message']}\n"


def test_a_second_run_answers_what_is_new_and_tables_of_all_kinds_agree(answered, year, job, run):
    out = answered.ledger.out
    before = out.read_bytes()
    again = run_batch([str(year)], str(out), job)
    assert (again.new, out.read_bytes()) == (0, before)
    (year / "empty.csv").write_text("still nothing\n")
    command = [
        "batch",
        year,
        "--kind",
        "emittance",
        "--lattice",
        job.lattice,
        "--out",
        out,
        "--json",
    ]
    code, said, _ = run(*command)
    [found] = json.loads(said)["results"]
    assert (code, found["new"], found["files"]) == (0, 1, len(FACTORS) + 3)
    with_other_options = Job("emittance", job.lattice, weights="measured")
    assert not any(map(type(again.ledger)(out, with_other_options).has_answer, again.files))

    rows = table(out)
    for suffix in (".h5", ".parquet"):
        other = out.with_suffix(suffix)
        (out.parent / f"{out.name}.parts").rename(out.parent / f"{other.name}.parts")
        assert run_batch([str(year)], str(other), job).new == 0
        (out.parent / f"{other.name}.parts").rename(out.parent / f"{out.name}.parts")
        if suffix == ".h5":
            with h5py.File(other) as store:
                columns = {n: [v if v == v else None for v in store[n][()]] for n in store}
            columns = {
                n: [v.decode() if isinstance(v, bytes) else v for v in c]
                for n, c in columns.items()
            }
        else:
            columns = parquet.read_table(other).to_pydict()
        assert set(columns) == set(COLUMNS["emittance"])
        for name, values in columns.items():
            said = [row[name] for row in rows]
            numbers = (
                [float(v) if v else None for v in said] if name in NUMBERS["emittance"] else said
            )
            assert list(values) == numbers, (suffix, name)


def test_the_course_names_the_beam_that_is_another(answered, run, year, tmp_path):
    [course] = courses_of(answered)
    assert [Path(f).name for f, off in zip(course.files, course.beyond, strict=True) if off] == [
        "scan7.csv"
    ]
    usual = [course.value[i] for i in range(4)]
    assert course.centre == pytest.approx(np.mean(usual))
    page, out = tmp_path / "page.html", answered.ledger.out
    told = ["--lattice", answered.ledger.job.lattice, "--out", out, "--report", page]
    code, _, _ = run("batch", year, "--kind", "emittance", *told, "--quantity", "emittance")
    assert code == 0
    link = "page_reports/01_scan7.html"
    assert f'href="{link}"' in page.read_text()
    assert "scan7" in (tmp_path / link).read_text()


def test_records_are_answered_too(root, tmp_path):
    out = tmp_path / "fills.csv"
    found = run_batch([str(root / "measurements/aps_1999_decay.csv")], str(out), Job("lifetime"))
    [row] = table(out)
    assert found.statuses == {"converged": 1}
    assert float(row["lifetime_mean_h"]) == pytest.approx(39.149, abs=1e-3)
    # Of the law that is quoted; of constant a and b 0.901.
    assert float(row["share"]) == pytest.approx(0.829, abs=2e-3)
    # One answer scatters by nothing that it knows of.
    assert ["standard deviation", "-"] in [list(r) for r in summary_of(courses_of(found)).rows]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--kind", "lifetime", "--lattice", "a.toml"], "--lattice with --kind lifetime"),
        (["--kind", "emittance", "--columns", "t"], "--columns t; expected HEADER=NAME"),
        (["--kind", "emittance", "--out", "a.txt"], "a name ending in .csv"),
        (["--kind", "emittance", "--workers", "2", "--scheduler", "tcp://a:1"], "one of them"),
        (["--kind", "emittance"], "no files"),
        (
            ["a.csv", "--kind", "lifetime", "--quantity", "lifetime_maen"],
            "did you mean lifetime_mean",
        ),
    ],
)
def test_a_wrong_command_is_one_line(run, tmp_path, monkeypatch, more, words):
    monkeypatch.chdir(tmp_path)
    if more[0] == "a.csv":
        Path("a.csv").touch()
    out = [] if "--out" in more else ["--out", tmp_path / "b.csv"]
    code, _, said = run("batch", tmp_path, *more, *out)
    assert code == 2
    assert words in said
    assert said.count("\n") == 1


@pytest.fixture
def unusable(tmp_path):
    folder = tmp_path / "files"
    folder.mkdir()
    for number in range(8):
        (folder / f"{number}.csv").write_text(f"file {number}\n")
    return folder


STOPPED = """
import os, signal, sys
from beamfit import writing
from beamfit.batch import run
from beamfit.batch.job import Job

run.FILES_PER_TASK, left, replace = 2, [int(sys.argv[1])], os.replace


def last(*paths):
    left[0] -= 1
    if left[0] < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(*paths)


writing.os.replace = last
run.run_batch([sys.argv[2]], sys.argv[3], Job("emittance"))
"""


def test_a_run_killed_as_it_writes_loses_and_doubles_nothing(unusable, tmp_path):
    out = tmp_path / "a.csv"
    command = [sys.executable, "-c", STOPPED]
    for parts in (2, 1, 1):  # the last as the table itself is written
        done = subprocess.run([*command, str(parts), str(unusable), str(out)])
        assert done.returncode == -signal.SIGKILL
        assert not out.exists()
    found = run_batch([str(unusable)], str(out), Job("emittance"))
    assert found.new == 0
    assert [Path(row["file"]).name for row in table(out)] == [f"{n}.csv" for n in range(8)]


class Deadly(Job):
    """Ends its worker by kill -9: at one file every time, at another once."""

    def answer(self, files):
        once = Path(self.reading["mark"])
        names = {Path(file).name for file in files}
        if "5.csv" in names or ("2.csv" in names and not once.exists()):
            once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().answer(files)


def test_workers_that_die_lose_and_double_nothing(unusable, tmp_path, monkeypatch):
    import dask
    import distributed  # its settings, before they are changed  # noqa: F401

    monkeypatch.setattr(running, "FILES_PER_TASK", 2)
    monkeypatch.setattr(running, "TIMEOUT", 3.0)
    out, job = tmp_path / "a.csv", Deadly("emittance", reading={"mark": str(tmp_path / "mark")})
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}):
        found = run_batch([str(unusable)], str(out), job, workers=1)
    rows = table(out)
    assert [Path(row["file"]).name for row in rows] == [f"{n}.csv" for n in range(8)]
    assert [i for i, row in enumerate(rows) if "ended the process" in row["message"]] == [5]
    assert found.statuses == {"unusable": 8}


def test_no_scheduler_is_one_line(unusable, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "TIMEOUT", 1.0)
    with pytest.raises(InputError, match="no scheduler at tcp"):
        run_batch(
            [str(unusable)],
            str(tmp_path / "a.csv"),
            Job("emittance"),
            scheduler="tcp://127.0.0.1:9",
        )
