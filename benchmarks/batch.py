"""Many synthetic scans through `beamfit batch`: files a second, growth, memory, and kills.

    python benchmarks/batch.py FOLDER [FILES]

FOLDER keeps the scans between runs. Written to docs/batch.md.
"""

from __future__ import annotations

import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
LATTICE = ROOT / "lattices/lcls_otr2.toml"
MEASURED = ROOT / "measurements/lcls_otr2.csv"
HEADER = "Q525_kG,size_x_um,size_x_error_um,size_y_um,size_y_error_um\n"
BAD = 500  # one file in so many is no scan
PAGE = os.sysconf("SC_PAGE_SIZE")


def write_scans(folder: Path, files: int) -> None:
    """Scans of the LCLS line: the beam drifts and differs from one to the next, noise of 2 %."""
    import beamfit

    line, rng = beamfit.load_lattice(LATTICE), np.random.default_rng(15)
    fit = beamfit.fit_emittance(beamfit.read_quad_scan(MEASURED), line)
    settings = np.linspace(-4.2, -1.0, 7)
    r = [line.matrix({"Q525": kg}) for kg in settings]
    squares = []
    for p in fit.planes:
        a, b = np.array([np.asarray(getattr(m, p.plane))[0, :2] for m in r]).T
        s11, s12, s22 = (q.value for q in p.sigma)
        squares.append(a * a * s11 + 2 * a * b * s12 + b * b * s22)
    for number in range(files):
        path = folder / f"{number // 1000:03d}" / f"scan_{number:06d}.csv"
        if path.exists():
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        columns = [settings]
        larger = 1 + 0.05 * rng.standard_normal() + 1e-6 * number
        for square in squares:
            size = 1e6 * np.sqrt(larger * square) * (1 + 0.02 * rng.standard_normal(len(square)))
            columns += [size, 0.02 * size]
        text = "\n".join(",".join(f"{v:.5f}" for v in row) for row in zip(*columns, strict=True))
        path.write_text("no scan\n" if number % BAD == BAD - 1 else f"{HEADER}{text}\n")


class Watch(threading.Thread):
    """Largest resident memory of each process of a run, MB."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self.root, self.most, self.running = pid, {}, True

    def run(self) -> None:
        while self.running:
            for pid in tree(self.root):
                try:
                    words = Path(f"/proc/{pid}/statm").read_text().split()
                    self.most[pid] = max(self.most.get(pid, 0), int(words[1]) * PAGE / 2**20)
                except (OSError, IndexError):
                    continue
            time.sleep(0.2)


def tree(pid: int) -> list[int]:
    """A process and what it started."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(p for child in children for p in tree(int(child)))]


def start(folders: list[Path], out: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "beamfit", "batch", *map(str, folders), "--kind", "emittance"]
    command += ["--lattice", str(LATTICE), "--out", str(out), *more]
    quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, **quiet, cwd=out.parent)


def clear(out: Path) -> None:
    out.unlink(missing_ok=True)
    shutil.rmtree(out.with_name(out.name + ".parts"), ignore_errors=True)


class Cost(NamedTuple):
    """Wall and processor seconds of a run from nothing, and the largest process in MB."""

    wall: float
    processor: float
    memory: float

    def of(self, files: int) -> str:
        return (
            f"{self.wall:.0f} s ({files / self.wall:.0f} files/s), "
            f"{self.processor:.0f} s of processor time, {self.memory:.0f} MB a process at most"
        )


def measured(folders: list[Path], out: Path, *more: str) -> Cost:
    clear(out)
    began, before = time.perf_counter(), os.times()
    run = start(folders, out, *more)
    watch = Watch(run.pid)
    watch.start()
    _, said = run.communicate()
    watch.running = False
    if run.returncode:
        raise RuntimeError(said.decode())
    after = os.times()
    spent = after.children_user + after.children_system
    spent -= before.children_user + before.children_system
    return Cost(time.perf_counter() - began, spent, max(watch.most.values()))


def rows_of(out: Path) -> Counter:
    with out.open(newline="") as stream:
        return Counter(row["file"] + " " + row["plane"] for row in csv.DictReader(stream))


def killed(folders: list[Path], out: Path, expected: Counter, kills: int) -> None:
    """Kill workers and the coordinator at random times; the last run is left alone."""
    clear(out)
    rng, told = random.Random(15), []
    for number in range(kills):
        run = start(folders, out, "--workers", "2")
        time.sleep(rng.uniform(6.0, 14.0))
        processes = tree(run.pid)
        coordinator = number % 2 == 1
        victims = [run.pid] if coordinator else processes[-1:]
        for pid in victims:
            os.kill(pid, signal.SIGKILL)
        told.append("coordinator" if coordinator else "worker")
        if not coordinator:
            time.sleep(rng.uniform(2.0, 6.0))
            if run.poll() is None:
                os.kill(run.pid, signal.SIGKILL)
        run.communicate()
        for pid in processes:  # orphans of a killed coordinator
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
    run = start(folders, out, "--workers", "2")
    time.sleep(8.0)
    workers = tree(run.pid)[-1:]
    if run.poll() is None and workers:
        os.kill(workers[0], signal.SIGKILL)
        told.append("worker, and the run went on")
    said = run.communicate()[0].decode().splitlines()[0]
    found = rows_of(out)
    same = found == expected
    print(f"killed -9: {', '.join(told)}; {said}; rows as of a run in peace: {same}")
    assert same


def main(folder: Path, files: int) -> None:
    write_scans(folder / "scans", files)
    every = sorted((folder / "scans").iterdir())[: max(files // 1000, 1)]
    out = folder / "out.csv"
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    sizes = [n for n in (100, 1_000, 10_000, 100_000) if n <= files]
    for n in sizes:
        chosen = every[: n // 1000] or sorted(every[0].iterdir())[:n]
        one = measured(chosen, out)
        print(f"{n} files, one process: {one.of(n)}; load {os.getloadavg()[0]:.1f}", flush=True)
        if n >= 10_000:
            two = measured(chosen, out, "--workers", "2")
            ratio = one.wall / two.wall
            print(f"{n} files, two workers: {two.of(n)}; {ratio:.2f} times as fast", flush=True)
    few = every[:10]
    measured(few, out)
    killed(few, out, rows_of(out), kills=6)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), int(sys.argv[2]) if len(sys.argv) > 2 else 100_000)
