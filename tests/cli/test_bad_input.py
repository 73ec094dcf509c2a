"""Unusable input through the real command line: one line, exit 2, nothing written, no JAX.

Each case is what somebody did with a scan or a lattice; the words asserted are the ones that
say where it is and what to do about it.
"""

import hashlib
import json
import os
import subprocess
import sys
import threading

import h5py
import numpy as np
import pytest

from beamfit.cli import main

HEADER = "Q525_kG,size_x_um,size_x_error_um,size_y_um,size_y_error_um"
ROWS = [
    "-4.2,111.4,1.1,63.1,0.7",
    "-3.2,63.4,0.3,57.9,0.2",
    "-2.6,53.6,0.3,74.7,0.5",
    "-2.1,56.7,0.5,96.0,0.7",
    "-1.0,104.8,0.8,157.9,2.4",
]
GOOD = "\n".join([HEADER, *ROWS]) + "\n"
LATTICE = """format = "beamfit-lattice-1"
energy_MeV = 135.0
[[element]]
type = "quadrupole"
name = "Q525"
length_m = 0.108
integrated_gradient_kG = -2.983
[[element]]
type = "drift"
length_m = 2.2094
[[element]]
type = "screen"
name = "OTR2"
"""
# Answers a command in a process of its own, then says what it had imported and its memory.
PROBE = """
import atexit, os, resource, sys
def tell():
    loaded = [m for m in ("jax", "matplotlib", "scipy.optimize") if m in sys.modules]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    open(os.environ["PROBE"], "w").write(f"{loaded} {peak}")
atexit.register(tell)
from beamfit.cli import main
main()
"""


def changed(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


def column(name, *values):
    """The good scan with one more column."""
    lines = [HEADER, *ROWS]
    return "\n".join(f"{line},{v}" for line, v in zip(lines, (name, *values), strict=True)) + "\n"


# What the scan file holds -> the words the message must have; a line is given as :number:.
SCANS = {
    "no size column": ("Q525_kG,energy_MeV\n1,135\n2,135\n3,135\n", ["a.csv:1:", "size_x_um"]),
    "no magnet column": ("size_x_um\n100\n90\n80\n", ["a.csv:1:", "magnet setting"]),
    "unknown unit": (changed("size_x_um", "size_x_inch"), [":1:", "'inch'", "size_x_um"]),
    "milliamperes": (changed("Q525_kG", "Q525_mA"), [":1:", "Q525_mA", "_A"]),
    "no unit": (changed("Q525_kG", "Q525"), [":1:", "_kG"]),
    "a typo": (changed("size_x_error_um", "size_x_eror_um"), [":1:", "size_x_error_um"]),
    "unknown magnet": (changed("Q525_kG", "Q552_kG"), ["Q552", "did you mean Q525?"]),
    "lower case magnet": (changed("Q525_kG", "q525_kG"), ["did you mean Q525?"]),
    "amperes without calibration": (changed("Q525_kG", "Q525_A"), ["Q525_A", "_kG"]),
    "NaN": (changed("53.6", "NaN"), [":4:", "size_x_um", "NaN"]),
    "infinite": (changed("-2.6", "inf"), [":4:", "Q525_kG", "inf"]),
    "negative size": (changed("53.6", "-53.6"), [":4:", "size_x_um", "-53.6", "positive"]),
    "zero size": (changed("53.6", "0"), [":4:", "size_x_um", "positive"]),
    "zero error": (changed("-2.6,53.6,0.3", "-2.6,53.6,0.0"), [":4:", "size_x_error_um"]),
    "blank error": (changed("-2.6,53.6,0.3", "-2.6,53.6,"), [":4:", "size_x_error_um", "empty"]),
    "blank setting": (changed("-2.6,", ","), [":4:", "Q525_kG", "empty"]),
    "text in a number": (changed("53.6", "saturated"), [":4:", "size_x_um", "saturated"]),
    "two settings": ("\n".join([HEADER, *ROWS[:2]]), ["2 distinct", "three"]),
    "one setting repeated": ("\n".join([HEADER, *[ROWS[0]] * 5]), ["1 distinct", "three"]),
    "empty": ("", ["empty"]),
    "blank lines": ("\n\n\n", ["no header"]),
    "comments only": ("# nothing\n# yet\n", ["no header"]),
    "header only": (HEADER + "\n", ["no rows", "three"]),
    "micrometres as metres": (
        GOOD.replace("_um", "_m"),
        ["implausible", "size_x_m", "um", "rename"],
    ),
    "metres as micrometres": (
        "Q525_kG,size_x_um\n1,1.1e-4\n2,9e-5\n3,1.2e-4\n",
        ["implausible", "size_x_um", "size_x_m"],
    ),
    "one slipped row": (changed("53.6", "53600"), [":4:", "size_x_um"]),
    "one row in mm": (changed("53.6,0.3", "0.0536,0.0003"), [":4:", "size_x_um", "one unit"]),
    "an error without a unit": (
        GOOD.replace("size_x_error_um", "size_x_error"),
        [":1:", "size_x_error", "no unit", "size_x_error_um"],
    ),
    "a beam current beside sizes": (
        column("beam_current_mA", *["2"] * 5),
        ["beam_current_mA", "no size depends", "--ignore"],
    ),
    "errors larger than sizes": (
        changed(",0.3,74", ",300,74").replace(",0.5,96", ",500,96").replace(",0.3,57", ",300,57"),
        ["size_x_error_um", "errors"],
    ),
    "decimal commas beside points": (
        GOOD.replace(",", ";").replace("111.4", "111,4"),
        [":2:", "'111,4'", "decimal point"],
    ),
    "decimal commas between tabs": (
        GOOD.replace(",", "\t").replace("111.4", "111,4"),
        [":2:", "'111,4'", "decimal point"],
    ),
    "commas after a header of semicolons": (
        HEADER.replace(",", ";") + "\n" + "\n".join(ROWS),
        [":2:", "1 cells", "5"],
    ),
    "quoted decimal commas": (changed("53.6", '"53,6"'), [":4:", "53,6", "decimal point"]),
    "a column twice": (changed("size_y_um", "size_x_um"), [":1:", "size_x_um", "twice"]),
    "two units of one size": (changed("size_y_um", "size_x_mm"), [":1:", "size_x_", "twice"]),
    "two settings of one magnet": (
        "Q525_kG,Q525_A,size_x_um\n1,1,90\n2,2,80\n3,3,95\n",
        [":1:", "Q525", "twice"],
    ),
    "error without size": (
        "Q525_kG,size_x_um,size_y_error_um\n1,9,1\n2,8,1\n3,9,1\n",
        [":1:", "size_y_error"],
    ),
    "too few cells": (changed(",74.7,0.5", ",74.7"), [":4:", "4 cells", "5"]),
    "too many cells": (changed("53.6,", "53.6,1,"), [":4:", "6 cells", "5"]),
    "no header": ("\n".join(ROWS), [":1:", "header"]),
    "energy in GeV": (column("energy_MeV", *["0.135"] * 5), [":2:", "energy_MeV", "GeV"]),
    "energy in eV": (column("energy_MeV", *["1.35e8"] * 5), [":2:", "energy_MeV", "eV"]),
    "negative energy": (column("energy_MeV", 135, 135, -135, 135, 135), [":4:", "energy_MeV"]),
    "unknown screen": (column("screen", *["OTR2"] * 4, "OTR3"), ["OTR3", "did you mean OTR2?"]),
    "blank screen": (column("screen", *["OTR2"] * 4, ""), [":6:", "screen"]),
    "negative resolution": (column("resolution_um", 5, 5, -5, 5, 5), [":4:", "resolution_um"]),
    "negative spread": (column("energy_spread", 0, 0, -1e-3, 0, 0), [":4:", "energy_spread"]),
    "percent spread": (column("energy_spread", 0.1, 0.1, 1.5, 0.1, 0.1), [":4:", "energy_spread"]),
    "a lattice": (LATTICE, ["lattice", "scan"]),
    "binary": (b"\x00\x01\x02\xff" * 100, [":1:", "binary"]),
    "Latin-1": (changed("Q525", "Qé25").encode("latin-1"), [":1:", "UTF-8"]),
    "UTF-16 cut off": (GOOD.encode("utf-16")[:-3], [":6:", "size_y_error_um", "a number"]),
    "a spreadsheet": (b"PK\x03\x04" + bytes(100), ["spreadsheet", "CSV"]),
    "one endless line": ("1," * 200_000, ["characters"]),
}

LATTICES = {
    "empty": ("", ["empty"]),
    "without the screen": (LATTICE.replace('"screen"', '"drift"\nlength_m = 1'), ["screen"]),
    "without the magnet": (LATTICE.replace("Q525", "QX"), ["Q525", "QX"]),
    "not TOML": (LATTICE.replace("0.108", "0.108 m"), ["a.toml:6:", "TOML"]),
    "unknown element": (LATTICE.replace("quadrupole", "quadropole"), [":4:", "quadrupole"]),
    "energy in GeV": (LATTICE.replace("135.0", "0.135"), [":2:", "energy_MeV", "GeV"]),
    "length in mm": (LATTICE.replace("length_m = 0.108", "length_mm = 108"), ["length_m"]),
    "binary": (b"\x00\x01" * 50, ["binary"]),
    "another format": (LATTICE.replace("lattice-1", "lattice-2"), [":1:", "beamfit-lattice-1"]),
    "a scan": (GOOD, ["scan", "lattice"]),
}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder with a good scan and a good lattice, in which the command runs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.csv").write_text(GOOD)
    (tmp_path / "good.toml").write_text(LATTICE)
    return tmp_path


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def answer(capfd, monkeypatch, *arguments, command="emittance"):
    """Run the command in this process."""
    monkeypatch.setattr(sys, "argv", ["beamfit", command, *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    said = capfd.readouterr()
    return stopped.value.code, said.out, said.err


def check(place, code, out, err, words):
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert "Traceback" not in err
    assert len(err) < 700
    for word in words:
        assert word in err
    assert not list(place.glob("*.html"))
    assert not list(place.glob(".*"))


def in_a_process(place, *arguments):
    """Run the command as a user does; also what it imported, and its peak memory in MB."""
    probe = place.parent / "probe.txt"
    command = [sys.executable, "-c", PROBE, *map(str, arguments)]
    ran = subprocess.run(
        command,
        cwd=place,
        env=os.environ | {"PROBE": str(probe), "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    loaded, peak = probe.read_text().rsplit(" ", 1)
    return ran, loaded, int(peak)


@pytest.mark.parametrize("case", SCANS)
def test_bad_scan(case, place, capfd, monkeypatch):
    content, words = SCANS[case]
    write(place / "a.csv", content)
    said = answer(
        capfd, monkeypatch, "a.csv", "--lattice", "good.toml", "--report", "r.html", "--json"
    )
    check(place, *said, ["a.csv", *words])


@pytest.mark.parametrize("case", LATTICES)
def test_bad_lattice(case, place, capfd, monkeypatch):
    content, words = LATTICES[case]
    write(place / "a.toml", content)
    said = answer(capfd, monkeypatch, "good.csv", "--lattice", "a.toml", "--report", "r.html")
    check(place, *said, words)
    assert "a.toml" in said[2] or "good.csv" in said[2]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["missing.csv", "--lattice", "good.toml"], ["missing.csv", "no such file"]),
        (["good.csv", "--lattice", "missing.toml"], ["missing.toml", "no such file"]),
        ([".", "--lattice", "good.toml"], [".", "directory"]),
        (["good.csv", "--lattice", "."], [".", "directory"]),
        (["good.csv/x.csv", "--lattice", "good.toml"], ["good.csv/x.csv"]),
        (["good.toml", "--lattice", "good.csv"], ["good.toml", "swap"]),
        (["good.csv"], ["--lattice"]),
        (["--lattice", "good.toml"], ["SCAN"]),
        (["good.csv", "--lattice", "good.toml", "--plane", "z"], ["--plane", "'z'"]),
        (["good.csv", "--lattice", "good.toml", "--plain", "x"], ["--plain", "--plane"]),
        (["good.csv", "--lattice", "good.toml", "--energy", "x"], ["--energy", "'x'"]),
        (["good.csv", "--lattice", "good.toml", "--use", "LC"], ["--use", "good.toml"]),
        (["good.csv", "--lattice", "good.toml", "--energy", "140"], ["--energy", "good.toml"]),
        (["good.csv", "--lattice", "good.toml", "--report", "r.txt"], ["r.txt", ".html"]),
        (["good.csv", "--lattice", "good.toml", "--report", "no/r.html"], ["no/r.html", "folder"]),
        (["good.csv", "--lattice", "good.toml", "--report", "good.csv/r.pdf"], ["good.csv/r.pdf"]),
    ],
)
def test_bad_arguments(arguments, words, place, capfd, monkeypatch):
    check(place, *answer(capfd, monkeypatch, *arguments), words)


def test_only_one_plane_measured(place, capfd, monkeypatch):
    write(place / "a.csv", "Q525_kG,size_x_um\n-4,111\n-3,60\n-1,104\n")
    for plane in ("y", "both"):
        said = answer(capfd, monkeypatch, "a.csv", "--lattice", "good.toml", "--plane", plane)
        check(place, *said, ["a.csv", "plane y", "size_y_um"])


def test_hdf5_named_csv_and_csv_named_hdf5(place, capfd, monkeypatch):
    with h5py.File(place / "a.csv", "w") as store:
        store["Q525_kG"] = np.arange(5.0)
    said = answer(capfd, monkeypatch, "a.csv", "--lattice", "good.toml")
    check(place, *said, ["a.csv", "HDF5", ".h5"])
    write(place / "a.h5", GOOD)
    said = answer(capfd, monkeypatch, "a.h5", "--lattice", "good.toml")
    check(place, *said, ["a.h5", "HDF5", ".csv"])


HDF5 = {
    "empty": ({}, "no datasets"),
    "lengths": ({"Q525_kG": [1.0, 2, 3], "size_x_um": [1.0, 2]}, "lengths"),
    "two dimensions": ({"Q525_kG": np.ones((3, 2)), "size_x_um": [90.0, 80, 90]}, "one-dim"),
    "complex": ({"Q525_kG": [1j, 2, 3], "size_x_um": [90.0, 80, 90]}, "Q525_kG"),
    "structured": (
        {"Q525_kG": np.zeros(3, [("a", float)]), "size_x_um": [90.0, 80, 90]},
        "Q525_kG",
    ),
    "NaN": ({"Q525_kG": [1.0, 2, 3], "size_x_um": [90.0, np.nan, 90]}, "size_x_um"),
    "no rows": ({"Q525_kG": np.zeros(0), "size_x_um": np.zeros(0)}, "no rows"),
    "bad text": (
        {"Q525_kG": [1.0, 2, 3], "size_x_um": [90.0, 80, 90], "screen": np.array([b"\xff"] * 3)},
        "screen",
    ),
}


@pytest.mark.parametrize("case", HDF5)
def test_bad_hdf5(case, place, capfd, monkeypatch):
    datasets, word = HDF5[case]
    with h5py.File(place / "a.h5", "w") as store:
        for name, values in datasets.items():
            store[name] = values
    said = answer(capfd, monkeypatch, "a.h5", "--lattice", "good.toml")
    check(place, *said, ["a.h5", word])


def test_a_truncated_hdf5_file(place, capfd, monkeypatch):
    with h5py.File(place / "a.h5", "w") as store:
        store["Q525_kG"] = np.arange(1000.0)
    whole = (place / "a.h5").read_bytes()
    write(place / "a.h5", whole[: len(whole) // 2])
    check(place, *answer(capfd, monkeypatch, "a.h5", "--lattice", "good.toml"), ["a.h5", "HDF5"])


@pytest.mark.parametrize("case", ["NaN", "unknown magnet", "binary", "micrometres as metres"])
def test_no_jax_on_the_way_to_an_error(case, place):
    content, words = SCANS[case]
    write(place / "a.csv", content)
    arguments = ("emittance", "a.csv", "--lattice", "good.toml", "--report", "r.html")
    ran, loaded, _ = in_a_process(place, *arguments)
    check(place, ran.returncode, ran.stdout, ran.stderr, ["a.csv", *words])
    assert loaded == "[]"


SETPOINT = "setpoint --lattice good.toml --vary Q525=0:5 --sigma 3e-8,2e-8,2e-8 --target"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("design good.csv --lattice good.toml --vary Q525=5:0", "lower first"),
        (f"{SETPOINT} match", "match=BETA_M:ALPHA"),
        (f"{SETPOINT} size_y=1mm", "--plane y"),
        ("batch none --kind lifetime --out a.csv", "no files"),
        ("batch . --kind emittance --lattice good.toml --out a.xlsx", ".parquet"),
        ("identify constant.csv", "input a at 1 all the time"),
        ("solve short.bf --set b=1", "one of a"),
    ],
)
def test_no_jax_on_the_way_to_an_error_of_other_commands(arguments, words, place):
    rows = "".join(f"{k},1,{k}\n" for k in range(20))
    (place / "constant.csv").write_text(f"time_s,u_a,y_b\n{rows}")
    (place / "short.bf").write_text("input a = 1; output y; y = 2 * a;")
    ran, loaded, _ = in_a_process(place, *arguments.split())
    check(place, ran.returncode, ran.stdout, ran.stderr, [words])
    assert "jax" not in loaded


@pytest.mark.parametrize("arguments", [[], ["--help"], ["emittance", "--help"], ["--version"]])
def test_no_jax_for_help(arguments, place):
    ran, loaded, _ = in_a_process(place, *arguments)
    assert (ran.returncode, ran.stderr, loaded) == (0, "", "[]")
    assert ran.stdout


def test_ten_million_rows_are_refused_in_bounded_memory(place):
    row = ROWS[0].encode() + b"\n"
    with open(place / "a.csv", "wb") as file:
        file.write(HEADER.encode() + b"\n")
        for _ in range(100):
            file.write(row * 100_000)
    small, _, usual = in_a_process(place, "emittance", "good.csv", "--lattice", "none.toml")
    ran, loaded, peak = in_a_process(place, "emittance", "a.csv", "--lattice", "good.toml")
    check(place, ran.returncode, ran.stdout, ran.stderr, ["a.csv:100002:", "more than 100000 rows"])
    assert small.returncode == 2
    assert loaded == "[]"
    assert peak - usual < 150


@pytest.mark.parametrize("command", ["emittance", "lifetime", "check"])
def test_a_pipe_is_read_once_and_its_digest_is_that_of_what_it_gave(
    command, root, capfd, monkeypatch
):
    """As `beamfit lifetime <(zcat decay.csv.gz)` has it."""
    name = "lcls_otr2.csv" if command == "emittance" else "aps_1999_decay.csv"
    content = (root / "measurements" / name).read_bytes()
    more = ["--lattice", root / "lattices" / "lcls_otr2.toml"] if command == "emittance" else []
    read, write = os.pipe()
    threading.Thread(target=lambda: (os.write(write, content), os.close(write))).start()
    arguments = (f"/dev/fd/{read}", *more, "--json")
    status, out, err = answer(capfd, monkeypatch, *arguments, command=command)
    os.close(read)
    assert status == 0, err
    digests = json.loads(out)["inputs"]
    assert digests[f"/dev/fd/{read}"] == hashlib.sha256(content).hexdigest()
