"""What a file or its name says is shown and not obeyed; Ctrl-C, closed output, no home."""

import os
import signal
import subprocess
import sys

import pytest

from beamfit import __main__ as command
from beamfit import writing
from beamfit.answer import Table
from beamfit.cli.show import Terminal
from beamfit.errors import InputError, nearest

COMMAND = [sys.executable, "-m", "beamfit"]
BARE = {"PYTHONPATH": os.pathsep.join(sys.path)}
EVIL = os.fsdecode(b"d\x1b[31m\xff.csv")


def test_nothing_that_a_file_says_is_obeyed(run, root, tmp_path):
    record, page = tmp_path / EVIL, tmp_path / "r.html"
    record.write_bytes(
        b"# \x1b]0;owned\x07\n" + (root / "measurements/aps_1999_decay.csv").read_bytes()
    )
    shown = run("check", record)
    told = run("lifetime", record, "--report", page)
    refused = run("emittance", record)
    assert (shown[0], told[0], refused[0]) == (0, 0, 2)
    for said in (*shown[1:], *told[1:], *refused[1:], page.read_text()):
        assert not {"\x1b", "\x07", "\udcff"} & set(said)
    assert "d\\x1b[31m\\xff.csv converged" in told[1]


@pytest.mark.parametrize(
    "error",
    [
        InputError("'" + "x y " * 500 + "'", nearest("Q", [f"magnet{k}" for k in range(500)])),
        InputError("no file", "a file", path="long/" * 400 + "a.csv", line=3, column="c d" * 300),
        InputError("a" * 1000 + " b" * 1000, "c " * 1000 + "; do this", path="a.csv", line=7),
    ],
)
def test_a_message_is_a_few_lines_of_a_terminal(error):
    said = str(error)
    assert len(f"beamfit: {said}") <= 400
    assert said.endswith(error.expected.strip()[-10:])
    assert error.path is None or "a.csv:" in said


def test_a_narrow_terminal_cuts_nothing_short(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "40")
    label = "smallest size 5 % too large, as of saturation"
    Terminal().table(Table("", ["if", "x", "y"], [[label, "+12.37 %", "-8 %"]]))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 40
    assert all(number in lines[1] for number in ("+12.37 %", "-8 %"))
    assert " ".join(line[:25].strip() for line in lines[1:]).startswith(label)


def test_ctrl_c_is_one_line(tmp_path):
    pipe = tmp_path / "decay.csv"
    os.mkfifo(pipe)
    process = subprocess.Popen([*COMMAND, "lifetime", pipe], stderr=subprocess.PIPE, env=BARE)
    with open(pipe, "wb"):  # which the command has opened now, and waits for
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
    assert (process.returncode, said) == (130, b"beamfit: interrupted\n")


def test_what_is_half_written_goes_with_the_process(tmp_path, monkeypatch, capfd):
    half = tmp_path / ".page.html.x"
    half.write_text("<")
    monkeypatch.setattr(writing, "UNFINISHED", {str(half), str(tmp_path / "gone")})
    monkeypatch.setattr(os, "_exit", lambda status: None)
    command._exit_on_signal(signal.SIGTERM, None)
    assert not half.exists()
    assert capfd.readouterr().err == "beamfit: interrupted\n"


def test_no_output_no_home_and_a_reader_that_leaves(root, tmp_path):
    """Descriptors closed before the start, an empty environment, and `| head -1`."""
    path = root / "measurements/aps_1999_decay.csv"
    shut = ["sh", "-c", f'exec {sys.executable} -m beamfit check "{path}" >&- 2>&-']
    assert subprocess.run(shut, env=BARE, cwd=tmp_path, check=False).returncode == 0
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [*COMMAND, "check", path], env=BARE, stdout=write, stderr=subprocess.PIPE, check=False
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_table_of_which_nobody_reads_the_end(monkeypatch):
    def broken(*_):
        raise BrokenPipeError

    monkeypatch.setattr(sys.stdout, "write", broken)
    with pytest.raises(BrokenPipeError):
        Terminal().line("said")
