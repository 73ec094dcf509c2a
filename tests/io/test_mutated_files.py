"""Damaged files of every kind are read or refused in one line: no traceback, no hang, no growth.

`make soak` reads 10 000 of every kind (tests/soak.py).
"""

import random
import zlib

import pytest
import scipy.io

import beamfit
from beamfit.errors import InputError
from beamfit.io.emittance_gui import read_emittance_gui
from beamfit.io.line import build_line, read_lattice
from beamfit.io.scan import read_quad_scan
from tests.conftest import resident
from tests.io.forked import in_forks  # noqa: F401
from tests.io.test_emittance_gui import gui_data
from tests.io.test_sequence import MADX
from tests.simulations import simulations

# MB that reading so many files may leave behind: caches of compiled code and of the parser.
GROWTH = 150
TOKENS = [
    b"nan",
    b"-",
    b",,",
    b"\0",
    b'"',
    b"9" * 400,
    b"(",
    b")",
    b"=",
    b":",
    b";",
    b"1e999",
    b"\n",
]
TOKENS += [
    b"#",
    b"\xff\xfe",
    b"{",
    b"}",
    b"&",
    b"0",
    b"-1",
    b"*",
    b"/",
    b"_A",
    b"\r",
    b"\xc3\xa9",
    b"!",
]
# Whole numbers of 5000 digits, which Python reads at once and does not write in decimal digits.
TOKENS += [b"0x" + b"f" * 5000, b"0o" + b"7" * 5000, b"0b" + b"1" * 5000, b"9" * 5000]
CSV = (
    "# a scan\nQ525_kG,energy_MeV,screen,size_x_um,size_x_error_um,fwhm_y_um,fwhm_y_err_um,note_\n"
    + "".join(
        f"{q},135,OTR2,{x},{0.01 * x},{2 * x + 5},{0.02 * x},ok\n"
        for q, x in ((-4.2, 111.4), (-3.2, 63.4), (-2.6, 53.6), (-2.1, 56.7), (-1.0, 104.8))
    )
)


def mutated(content, rng):
    """One file with one to twenty things changed."""
    found = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 5, 20])):
        at, what = rng.randrange(len(found) + 1), rng.randrange(7)
        length = min(rng.choice([1, 4, 8, 60]), len(found))
        if what == 0 and found:
            found[at % len(found)] = rng.randrange(256)
        elif what == 1 and found:
            found[at % len(found)] ^= 1 << rng.randrange(8)
        elif what == 2:
            del found[at : at + length]
        elif what == 3:
            found[at:at] = rng.choice(TOKENS)
        elif what == 4:
            start = rng.randrange(len(found) + 1)
            found[at:at] = found[start : start + length]
        elif what == 5:
            number = rng.choice([0, 1, 255, 2**16, 2**31 - 1, 2**32 - 1])
            found[at : at + 4] = number.to_bytes(4, "little")
        elif rng.random() < 0.1:
            del found[at:]
    return bytes(found)


def read_all(path, content, read, seed, count):
    """Read mutated files; how many were refused, and how much memory stayed."""
    rng, refused, before = random.Random(seed), 0, None
    for number in range(count):
        path.write_bytes(mutated(content, rng))
        try:
            read(path)
        except InputError as error:
            refused += 1
            said = str(error)
            assert "\n" not in said
            assert len(said) <= 391
        if number == count // 5:  # what is loaded once is loaded
            before = resident()
    return refused, resident() - (before or resident())


def fit(scan, line):
    """The fit of what could be read, which may refuse it too."""
    return str(beamfit.fit_emittance(scan, line))


@simulations(60, 300)
def test_csv(tmp_path, root, count):
    line = beamfit.load_lattice(root / "lattices/lcls_otr2.toml")
    path = tmp_path / "scan.csv"
    refused, grown = read_all(path, CSV.encode(), lambda p: fit(read_quad_scan(p), line), 1, count)
    assert 0.3 * count < refused < count
    assert grown < GROWTH
    kept, _ = read_all(
        path, CSV.encode(), lambda p: read_quad_scan(p, skip_bad=True, ignore=["note_*"]), 2, count
    )
    assert kept < count


@simulations(16, 100)
@pytest.mark.parametrize("compressed", [True, False])
def test_mat(compressed, tmp_path, count):
    path = tmp_path / "scan.mat"
    scipy.io.savemat(path, {"data": gui_data()}, do_compression=compressed)
    content = path.read_bytes()

    def read(file):
        gui = read_emittance_gui(file)
        fit(gui.scan(), build_line(gui.lattice))

    refused, grown = read_all(path, content, read, 3, count)
    assert 0.3 * count < refused <= count
    assert grown < GROWTH


@simulations(16, 100)
def test_mat_packed_after_the_damage(tmp_path, count):
    """So that the damage lies in what is unpacked, and not in the packing."""
    path = tmp_path / "scan.mat"
    scipy.io.savemat(path, {"data": gui_data()})
    whole = path.read_bytes()

    def packed(damaged):
        content = zlib.compress(damaged, 1)
        tag = (15).to_bytes(4, "little") + len(content).to_bytes(4, "little")
        path.write_bytes(whole[:128] + tag + content)

    def read(file):
        packed(file.read_bytes())
        read_emittance_gui(file)

    refused, grown = read_all(path, whole[128:], read, 4, count)
    assert 0.3 * count < refused <= count
    assert grown < GROWTH


@simulations(60, 300)
def test_madx(tmp_path, count):
    pytest.importorskip("at", reason="accelerator-toolbox is not installed")
    path = tmp_path / "line.madx"
    refused, grown = read_all(path, MADX.encode(), lambda p: build_line(read_lattice(p)), 5, count)
    assert 0.3 * count < refused < count
    assert grown < GROWTH
