"""Thousands of damaged files of every kind: read, or refused in one line of 400 characters.

`make soak` runs it: `python -m tests.soak [COUNT [READER ...]]`. Each reader is given COUNT files
with one to twenty things changed, in a process of its own; others with every value of SOAK_SEED.
A traceback, a file that takes more than 11 s of processor time (of the process it is read in too)
and a process of more than 1 GB are faults; the file is kept and the exit status is 1.
"""

from __future__ import annotations

import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import scipy.io

import beamfit
import beamfit.io.decay_record
from beamfit.errors import InputError
from beamfit.greybox.mlp import dense
from beamfit.io import isolated
from beamfit.io.columns import LAYOUT_FOLDER, layout_of
from beamfit.io.emittance_gui import read_emittance_gui
from beamfit.io.files import read_text
from beamfit.io.formulation import read_formulation, read_numbers
from beamfit.io.line import read_lattice
from beamfit.io.machine import read_scan_machine
from beamfit.io.result import load_fit, read_fitted_beams, save_fit
from beamfit.io.ring import read_ring, read_ring_tables
from beamfit.io.run import read_run
from beamfit.io.scan import read_quad_scan
from beamfit.language.network_xml import format_network, parse_network
from beamfit.language.plan import check_document
from beamfit.sampling.ensemble import draw
from beamfit.sampling.store import load
from tests.conftest import ROOT
from tests.io.forked import ENDED, SUBPROCESS
from tests.io.test_emittance_gui import gui_data
from tests.io.test_mutated_files import CSV, mutated
from tests.io.test_programs import SDDS
from tests.io.test_sequence import ELEGANT, MAD8, MADX
from tests.live.faulty import LINE, MACHINE
from tests.sampling.targets import half_normal, target

# Seconds, megabytes and letters.
PATIENCE, ROOM, LONGEST = 10, 1000, 391
STORE = "posterior store"
SEED = os.environ.get("SOAK_SEED", "")
# Share of files of which a row alone has slipped.
SLIP = 0.05
DATES = "time,beam_current_mA,rf_voltage_kV\n" + "".join(
    f"2024-03-01T12:{minute:02d}:00,{100 - 0.1 * minute},3200\n" for minute in range(30)
)
LIFETIMES = "beam_current_mA,tau_h\n100,50\n200,33\n300,25\n400,20\n"


class Reader(NamedTuple):
    """A kind of file: how its name ends, files of it, and what reads them."""

    suffix: str
    files: list[bytes]
    read: Callable[[Path], object]


def stored(folder: Path, name: str, **columns: object) -> bytes:
    with h5py.File(folder / name, "w") as store:
        store.attrs["note"] = "of a soak"
        store.attrs["number"] = 3
        for key, values in columns.items():
            one = store.create_dataset(key, data=values, compression="gzip", chunks=True)
            one.attrs["unit"] = key.rpartition("_")[2] if "_" in key else ""
    return (folder / name).read_bytes()


def readers(folder: Path, with_store: bool) -> dict[str, Reader]:
    """Every reader of the package, and small files that it reads."""

    def of(path: str) -> bytes:
        return (ROOT / path).read_bytes()

    hours = np.linspace(0.0, 36000.0, 40)
    current = 100.0 * np.exp(-hours / 2e5) + 0.001 * np.cos(50 * hours)
    settings = {"Q_kG": [-4.2, -3.2, -2.6, -2.1, -1.0], "size_x_um": [111.0, 63, 53, 56, 104]}
    archive = [{"secs": 1_700_000_000 + k, "nanos": 0, "val": 100 - 0.01 * k} for k in range(20)]
    exported = json.dumps([{"meta": {"EGU": "mA"}, "data": archive}]).encode()
    scipy.io.savemat(folder / "scan.mat", {"data": gui_data()}, do_compression=False)
    scipy.io.savemat(folder / "vectors.mat", settings, do_compression=False)
    save_fit(folder / "fit.json", beamfit.fit_decay(beamfit.DecayRecord(hours, current)))
    entry = {"plane": "x", "status": "converged", "message": "Good.", "covariance": None}
    entry |= {f"sigma{k}": {"value": 1e-8, "error": 1e-10} for k in ("11", "12", "22")}
    result = json.dumps({"beamfit": "0.1.0", "results": [entry]}).encode()
    stated = target(half_normal)
    if with_store:
        draw(stated, seed=1, store=folder / "store.h5", target_ess=100, walkers=16)
    ring = (ROOT / "lattices/spear3_2003_twiss.csv").read_bytes()
    (folder / "spear3_2003_twiss.csv").write_bytes(ring)
    twiss = b"* S BETX BETY DX DPX ALFX ALFY\n$ %le %le %le %le %le %le %le\n" + b"".join(
        b"%d 9.5 4.5 0.1 0 1.5 -0.5\n" % k for k in range(11)
    )
    text = [of(f"formulations/{name}.bf") for name in ("appendix_a", "appendix_c", "figure_3")]
    xml = [of(f"formulations/{name}.xml") for name in ("appendix_a", "appendix_c", "figure_3")]
    network = format_network(dense(["u"], ["y"], [2])).encode()
    store = [path.read_bytes() for path in folder.glob("store.h5")]
    lattice = [of("lattices/gtf_two_screens.toml"), of("lattices/lcls_otr2.toml")]
    scan = [CSV.encode(), of("measurements/lcls_otr2.csv")]
    layouts = [path.read_bytes() for path in sorted(LAYOUT_FOLDER.glob("*.toml"))]
    (folder / "line.toml").write_text(LINE)
    machine = MACHINE.format(scheme="", more="degauss = [-5.0, 2.0]")
    decay = [of("measurements/aps_1999_decay.csv"), DATES.encode(), LIFETIMES.encode()]

    def documents(path: Path) -> None:
        check_document(read_formulation(path))

    return {
        "scan .csv": Reader(".csv", scan, read_quad_scan),
        "scan .csv --skip-bad": Reader(".csv", scan, lambda p: read_quad_scan(p, skip_bad=True)),
        "scan .h5": Reader(".h5", [stored(folder, "s.h5", **settings)], read_quad_scan),
        "scan .mat": Reader(".mat", [(folder / "scan.mat").read_bytes()], read_emittance_gui),
        "vectors .mat": Reader(".mat", [(folder / "vectors.mat").read_bytes()], read_quad_scan),
        "SDDS": Reader(".sdds", [SDDS.encode()], read_quad_scan),
        "decay .csv": Reader(".csv", decay, beamfit.io.decay_record.read_lifetime_input),
        "decay .csv --skip-bad": Reader(
            ".csv", decay[:2], lambda p: beamfit.read_decay_record(p, skip_bad=True)
        ),
        "decay .h5": Reader(
            ".h5",
            [stored(folder, "d.h5", time_s=hours, beam_current_mA=current, bunches=[280] * 40)],
            beamfit.read_decay_record,
        ),
        "archive .json": Reader(".json", [exported], beamfit.read_decay_record),
        "run .csv": Reader(".csv", [of("measurements/valve_level_simulated.csv")[:4000]], read_run),
        "lattice .toml": Reader(".toml", lattice, read_lattice),
        "layout .toml": Reader(".toml", layouts, layout_of),
        "machine .toml": Reader(".toml", [machine.encode()], read_scan_machine),
        "ring .toml": Reader(".toml", [of("lattices/spear3_2003.toml")], read_ring),
        "optics .csv": Reader(
            ".csv", [ring], lambda p: read_ring_tables(234.144, Path(p), None)[0]
        ),
        "optics .tfs": Reader(".tfs", [twiss], lambda p: read_ring_tables(10.0, Path(p), None)[0]),
        "MAD-X": Reader(".madx", [MADX.encode()], read_lattice),
        "MAD-8": Reader(".mad8", [MAD8.encode()], read_lattice),
        "elegant": Reader(".lte", [ELEGANT.encode()], lambda p: read_lattice(p, energy=135.0)),
        "formulation .bf": Reader(".bf", text, documents),
        "formulation .xml": Reader(".xml", xml, documents),
        "network .xml": Reader(".xml", [network], lambda p: parse_network(read_text(p), p)),
        "numbers": Reader(".csv", [of("formulations/fitdata_simulated.csv")], read_numbers),
        "kept fit": Reader(".json", [(folder / "fit.json").read_bytes()], load_fit),
        "fitted beams": Reader(".json", [result], lambda p: read_fitted_beams(p, 0.511)),
        STORE: Reader(".h5", store, lambda p: load(p, stated, 1, 16)),
    }


def soaked(name: str, count: int) -> dict[str, object]:
    """Have one reader read so many damaged files, in this process."""
    warnings.simplefilter("ignore")
    isolated.subprocess = SUBPROCESS
    said = {"read": 0, "refused": 0, "slowest": 0.0, "faults": []}
    with tempfile.TemporaryDirectory() as place:
        reader = readers(Path(place), name == STORE)[name]
        path, rng = Path(place) / f"a{reader.suffix}", random.Random(name + SEED)
        for content in reader.files:  # the whole ones are good
            path.write_bytes(content)
            reader.read(path)
        signal.signal(signal.SIGPROF, late)
        for _ in range(count):
            content = rng.choice(reader.files)
            path.write_bytes((slipped if rng.random() < SLIP else mutated)(content, rng))
            began = spent()
            signal.setitimer(signal.ITIMER_PROF, PATIENCE + 1)
            try:
                reader.read(path)
                said["read"] += 1
            except InputError as error:
                said["refused"] += 1
                if "\n" in str(error) or len(str(error)) > LONGEST:
                    said["faults"].append(kept(path, name, "a message of several lines"))
            except Exception as error:
                said["faults"].append(kept(path, name, f"{type(error).__name__}: {error}"[:200]))
            signal.setitimer(signal.ITIMER_PROF, 0)
            said["slowest"] = max(said["slowest"], spent() - began)
    said["MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return said | {"ended": ENDED}


def slipped(content: bytes, rng: random.Random) -> bytes:
    """One file of which a row has a cell more or less, so that others stand beside their column."""
    lines = content.splitlines(keepends=True)
    at = rng.randrange(len(lines))
    cells = re.split(rb"([,;\t ]+)", lines[at])
    place = rng.randrange(len(cells))
    cells[place : place + 1] = rng.choice([[], [cells[place], b",", cells[place]], [b",", b""]])
    lines[at] = b"".join(cells)
    return b"".join(lines)


def spent() -> float:
    """Processor time of this process and of those it has waited for, s."""
    return sum(os.times()[:4])


def late(*_: object) -> None:
    raise TimeoutError(f"more than {PATIENCE} s")


def kept(path: Path, name: str, what: str) -> str:
    """Keep a file that was a fault, and say what and where."""
    folder = Path(tempfile.gettempdir()) / "beamfit-soak"
    folder.mkdir(exist_ok=True)
    place = folder / f"{len(list(folder.iterdir()))}-{name.replace(' ', '-')}{path.suffix}"
    place.write_bytes(path.read_bytes())
    return f"{place}: {what}"


def main() -> None:
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(soaked(sys.argv[2], int(sys.argv[3]))))
        return
    count = int(sys.argv[1]) if sys.argv[1:] else 10_000
    with tempfile.TemporaryDirectory() as place:
        names = sys.argv[2:] or list(readers(Path(place), False))
    print("| reader | read | refused | slowest, s | MB |\n|---|---|---|---|---|", flush=True)
    faults, ended = [], {}
    for name in names:
        command = [sys.executable, "-m", "tests.soak", "--one", name, str(count)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            faults.append(f"{name}: the process ended with {done.returncode}")
            continue
        said = json.loads(done.stdout.splitlines()[-1])
        cells = f"{said['read']} | {said['refused']} | {said['slowest']:.2f} | {said['MB']}"
        print(f"| {name} | {cells} |", flush=True)
        faults += said["faults"]
        ended = {key: ended.get(key, 0) + n for key, n in said["ended"].items()} or ended
        if said["MB"] > ROOM:
            faults.append(f"{name}: {said['MB']} MB")
    print("\n".join([f"{key}: {n}, each told in one line" for key, n in ended.items()]))
    print("\n".join([f"{len(faults)} faults", *faults]))
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
