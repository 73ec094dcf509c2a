"""Files that never end, never begin, lie about their size, or lead somewhere else."""

import hashlib
import os
import socket
import sys

import h5py
import numpy as np
import pytest

import beamfit
from beamfit.errors import InputError
from beamfit.io import files, isolated
from beamfit.io.files import digest, read_json
from beamfit.io.isolated import hdf5_content
from beamfit.io.result import load_fit, read_fitted_beams
from beamfit.io.table import read_sheet
from beamfit.io.toml import read_toml

DECAY = "time_s,beam_current_mA\n0,100\n60,99\n120,98\n"
NUMBERS = np.arange(4.0)


def refused(read, path):
    with pytest.raises(InputError) as error:
        read(path)
    return str(error.value)


@pytest.mark.parametrize("end", ["\r", "\r\n", "\n"])
def test_every_kind_of_line_end(end, tmp_path):
    decay, twiss = tmp_path / "decay.csv", tmp_path / "twiss.tfs"
    decay.write_text(DECAY.replace("\n", end), newline="")
    assert beamfit.read_decay_record(decay).current.tolist() == [100, 99, 98]
    long = "* S BETX BETY DX\n$ %le %le %le %le\n" + "".join(f"{k} 1.5 2 0\n" for k in range(9000))
    twiss.write_text(long.replace("\n", end), newline="")
    sheet = read_sheet(twiss, "s_m,beta_x_m")
    assert len(sheet) == 9000
    assert sheet.lines[-1] == 9002


def test_what_is_no_file_is_refused(tmp_path, monkeypatch):
    pipe, place = tmp_path / "pipe", tmp_path / "socket"
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(place))
        for path in (place, "/dev/zero", "/dev/null"):
            assert "a device or a socket" in refused(beamfit.read_decay_record, path)
    monkeypatch.setattr(files, "MAX_SILENCE", 0.05)
    assert "a pipe that gives nothing" in refused(beamfit.read_decay_record, pipe)


def test_the_digest_is_that_of_what_was_read(tmp_path):
    path = tmp_path / "decay.csv"
    path.write_text(DECAY)
    beamfit.read_decay_record(path)
    path.write_text("changed since")
    assert digest(path) == hashlib.sha256(DECAY.encode()).hexdigest()


def hdf5_files(folder):
    """Name and content that an HDF5 file may have, and the word that refuses it."""
    other = folder / "other.h5"
    with h5py.File(other, "w") as store:
        store["x"] = NUMBERS
    (folder / "raw").write_bytes(NUMBERS.tobytes())

    def virtual(store):
        layout = h5py.VirtualLayout(shape=(4,), dtype=float)
        layout[:] = h5py.VirtualSource(other, "x", shape=(4,))
        store.create_virtual_dataset("a", layout)

    def outside(store):
        store.create_dataset("a", (4,), float, external=[(str(folder / "raw"), 0, 32)])

    def linked(link):
        return lambda store: store.__setitem__("a", link)

    def huge(store):
        store.create_dataset("a", (1_600_000_000,), float, chunks=(1000,), compression="gzip")

    def words(store):
        store.create_dataset("a", (5_000_000,), h5py.string_dtype(), chunks=(1000,))

    def filtered(store):
        store.create_dataset("a", data=np.arange(4), scaleoffset=2)

    yield virtual, "numbers in another file"
    yield outside, "numbers in another file"
    yield linked(h5py.ExternalLink(other, "x")), "a link"
    yield linked(h5py.SoftLink("/a")), "a link"
    yield huge, "more than 12000000 rows"
    yield words, "more than 4000000 rows"
    yield filtered, "a filter of number 6"


def test_hdf5_files_that_lead_elsewhere_or_claim_too_much(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    for make, said in hdf5_files(tmp_path):
        with h5py.File(path, "w") as store:
            make(store)
        # In this process: the same code, without the time of starting another.
        with pytest.raises(InputError) as error:
            hdf5_content(path.read_bytes(), 12_000_000, 4_000_000)
        assert error.value.found == said
    assert "a filter of number 6" in refused(lambda p: read_sheet(p, ""), path)


def test_a_process_that_crashes_or_never_ends_is_one_line(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as store:
        store["a"], store["b"], store["word"] = NUMBERS, np.float32(NUMBERS), ["x"] * 4
    sheet = read_sheet(path, "")
    assert (sheet["b"].tolist(), sheet["word"]) == ([0, 1, 2, 3], ["x"] * 4)
    monkeypatch.setattr(isolated, "MAX_SECONDS", 0.01)
    assert "does not read within 0.01 s" in refused(lambda p: read_sheet(p, ""), path)
    monkeypatch.setattr(isolated, "MAX_SECONDS", 10)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert "is damaged" in refused(lambda p: read_sheet(p, ""), path)


@pytest.mark.parametrize("content", ["[" * 100_000, '{"a":' * 100_000, "9" * 5000, "\xff", "{"])
def test_json_of_great_depth_and_long_numbers(content, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(content, encoding="latin-1")
    for read in (
        load_fit,
        lambda p: read_fitted_beams(p, 0.511),
        lambda p: read_sheet(p, ""),
    ):
        assert str(path) in refused(read, path)
    path.write_text("9" * 400)
    assert read_json(path, "", "") == float("inf")


def test_toml_of_great_depth_and_long_numbers(tmp_path):
    path = tmp_path / "a.toml"
    for content in ("a = " + "[" * 90_000, "a = " + "9" * 5000, "a." * 40_000 + "b=1"):
        path.write_text(content)
        assert "TOML that does not parse" in refused(lambda p: read_toml(p, "a lattice"), path)
    path.write_text('format = "beamfit-lattice-1"\nenergy_MeV = ' + "9" * 400)
    assert "energy_MeV" in refused(beamfit.load_lattice, path)


def test_a_lattice_of_more_elements_than_any_machine_is_refused(tmp_path):
    path = tmp_path / "line.toml"
    head = 'format = "beamfit-lattice-1"\nenergy_MeV = 135.0\n'
    path.write_text(head + "element = [" + "{ type = 'drift' },\n" * 50_001 + "]\n")
    with pytest.raises(InputError, match=r"line\.toml:3: .*'element': more than 50000 elements"):
        beamfit.load_lattice(path)
