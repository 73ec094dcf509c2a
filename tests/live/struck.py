"""Scans of the simulated injector, struck at random moments: do their files hold rows that lie?

`python -m tests.live.struck 100 [SEED]`: a supply that trips, somebody who moves the magnet, beam
that is lost or gone, each for 0.1 to 1 s, again and again while a scan goes on (docs/live.md).
"""

from __future__ import annotations

import csv
import os
import random
import sys
import tempfile
import threading
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from tests.live.conftest import Ioc, private_ports
from tests.live.faulty import MACHINE, Injector
from tests.live.truth import NOISE, size

STRIKES = ("TRIP", "MOVED", "LOSSY", "DIM", "DARK")
SHOTS = 10


class Strikes(threading.Thread):
    """Strikes of 0.1 to 1 s until it is told to end."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.rng, self.over, self.count = random.Random(seed), threading.Event(), 0

    def run(self) -> None:
        from p4p.client.thread import Context

        with Context("pva") as context:
            while not self.over.wait(self.rng.uniform(0.2, 1.5)):
                self.strike(context, self.rng.choice(STRIKES))

    def strike(self, context, kind: str) -> None:
        name, on = f"SIM:FAULT:{kind}", self.rng.choice([-1.5, -0.3, 0.3, 1.5])
        if kind == "MOVED":
            name, before = "SIM:Q1:SET", float(context.get("SIM:Q1:SET"))
        context.put(name, before + on if kind == "MOVED" else on, wait=False)
        self.over.wait(self.rng.uniform(0.1, 1.0))
        # Nobody who moved it knows where it should be by now: only what is still theirs is undone.
        if kind != "MOVED" or float(context.get(name)) == before + on:
            context.put(name, before if kind == "MOVED" else 0.0, wait=False)
        self.count += 1


def distances(path: Path) -> list[float]:
    """Distance of each point's mean from the truth at its setting, in errors, both planes."""
    points = defaultdict(list)
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    for row in csv.DictReader(lines):
        points[float(row["Q1_T_per_m"])].append(row)
    found = []
    for gradient, rows in points.items():
        count = sum(int(row.get("shots") or 1) for row in rows)
        for plane in "xy":
            mean = np.mean([1e-6 * float(row[f"size_{plane}_um"]) for row in rows])
            found.append(abs(mean / size(plane, gradient) - 1) / (NOISE / np.sqrt(count)))
    return found


def struck(injector: Injector, seed: int) -> tuple[str, list[float], int]:
    """What a scan said, how far its points lie, and how often it was struck."""
    injector.value("SIM:Q1:SET", -1.5)
    text = MACHINE.format(scheme=("", "pva://")[seed % 2], more="")
    text = text.replace("shots = 3", f"shots = {SHOTS}").replace("timeout_s = 0.5", "timeout_s = 2")
    text = text.replace("timeout_s = 1.5", "timeout_s = 5").replace("wait_s = 1", "wait_s = 10")
    (injector.folder / "machine.toml").write_text(text.replace("points = 7", "points = 12"))
    out = injector.folder / f"scan{seed}.csv"
    injector.worker.begin("scan", str(injector.folder / "machine.toml"), "--save", str(out))
    injector._wait_for_journal()
    strikes = Strikes(seed)
    strikes.start()
    _, said = injector.worker.end()
    strikes.over.set()
    strikes.join()
    injector._mended()
    if injector.journal.exists():
        injector.worker.begin("scan", "--recover", str(injector.journal))
        injector.worker.end()
    return said, distances(out) if out.exists() else [], strikes.count


def main(count: int, seed: int) -> None:
    os.environ.update(private_ports())
    folder = Path(tempfile.mkdtemp())
    injector, total = Injector(Ioc(folder).start(), folder), Counter()
    for number in range(seed, seed + count):
        said, far, strikes = struck(injector, number)
        lies = sum(one > 6 for one in far)
        total += Counter(
            scans=1, strikes=strikes, again=said.count("Measured again"),
            paused=said.count("Paused"), left_out=said.count("Left out"), sizes=len(far),
            beyond_6=lies, files_with_one=lies > 0, in_the_end="The scan ended" in said,
        )  # fmt: skip
        if lies or number % 10 == 9:
            print(number, dict(total), f"farthest {max(far, default=0):.1f}", flush=True)
    print(dict(total))
    injector.worker.close()
    injector.ioc.kill()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
