"""Scans of the simulated injector with a fault each: what became of the magnet.

`python -m tests.live.faulty 1000 [SEED [FAULT ...]]` runs as many: docs/live_measured.md.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from tests.live.conftest import ROOT, Ioc, private_ports

LINE = """format = "beamfit-lattice-1"
name = "simulated injector"
energy_MeV = 135.0
[[element]]
type = "quadrupole"
name = "Q1"
length_m = 0.108
gradient_T_per_m = -2.5
[[element]]
type = "drift"
name = "D1"
length_m = 2.2094
[[element]]
type = "screen"
name = "OTR"
"""
MACHINE = """format = "beamfit-machine-1"
name = "injector"
lattice = "line.toml"
timeout_s = 1
[[magnet]]
name = "Q1"
set = "{scheme}SIM:Q1:SET"
read = "{scheme}SIM:Q1:READ"
unit = "T/m"
low = -5.5
high = 2.5
tolerance = 0.01
settle_s = 0.05
timeout_s = 1.5
{more}
[screen]
x = "{scheme}SIM:SCREEN:X"
y = "{scheme}SIM:SCREEN:Y"
shots = 3
timeout_s = 0.5
[beam]
present = "SIM:BEAM"
present_above = 0.1
loss = "SIM:LOSS"
loss_below = 1.0
wait_s = 1
[scan]
goal_percent = 0.5
points = 7
restore_s = 20
"""
LOW, HIGH = -5.5, 2.5
# Within which the IOC answers on a busy machine, s.
BUSY = 60
SCREEN = ("NAN", "STALE", "DARK", "LOSSY", "DIM")
READBACK = ("STUCK", "DRIFT", "SIGN", "DEAF", "TRIP")
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGKILL")
UNDEFINED = ("IOC back undefined", "SIGKILL, IOC back undefined")
KINDS = (*SIGNALS, *READBACK, *SCREEN, "dark for a while", "IOC back", *UNDEFINED, "IOC gone")
KINDS += ("disk", "limits")


class Fate(NamedTuple):
    """How a scan with a fault ended.

    Attributes
    ----------
    status : int or None
        Of the command; None where it was killed.
    said : str
        What it said.
    journal : bool
        Whether it left a journal.
    restored : bool
        Whether the magnet was where it was before, once the command had ended.
    recovered : bool
        Whether it was in the end, after --recover where there was a journal.
    outside : int
        Values written outside the limits.
    """

    status: int | None
    said: str
    journal: bool
    restored: bool
    recovered: bool
    outside: int


class Worker:
    """A process that runs commands; after its death there is a new one."""

    def __init__(self) -> None:
        self.process = None

    def begin(self, *arguments: str, file_size: int | None = None) -> None:
        if self.process is None or self.process.poll() is not None:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.live.worker"], cwd=ROOT, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        command = {"arguments": list(arguments), "file_size": file_size}
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()

    def end(self) -> tuple[int | None, str]:
        line = self.process.stdout.readline()
        if not line:  # it was killed
            self.process.communicate()
            return None, ""
        found = json.loads(line)
        return found["status"], found["said"]

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.stdin.close()
            self.process.wait()
            self.process.stdout.close()


class Injector:
    """An IOC, a worker and the files of a machine."""

    def __init__(self, ioc: Ioc, folder: Path) -> None:
        self.ioc, self.folder, self.worker = ioc, folder, Worker()
        self.journal = folder / "machine.journal"
        (folder / "line.toml").write_text(LINE)

    def value(self, name: str, put: float | None = None) -> float:
        """Read a variable, or write it, by a client of our own."""
        from p4p.client.thread import Context

        with Context("pva") as context:
            if put is not None:
                context.put(name, put, timeout=BUSY, wait=True)
            return float(context.get(name, timeout=BUSY))

    def scan(self, fault: str, seed: int, scheme: str = "") -> Fate:
        """Run a scan from a setting of its own, with a fault at a random moment of it."""
        rng = random.Random(seed)
        before = round(rng.uniform(LOW + 0.5, HIGH - 0.5), 3)
        self._mended()
        self.value("SIM:Q1:SET", before)
        self.ioc.log.write_text("")
        side = rng.choice(["", 'approach = "below"\napproach_by = 0.4'])
        text = MACHINE.format(scheme=scheme, more=side)
        if fault == "limits":  # the file's are wider than the control system's
            text = text.replace("low = -5.5", "low = -50").replace("high = 2.5", "high = 50")
        (self.folder / "machine.toml").write_text(text)
        out = self.folder / "scan.csv"
        out.unlink(missing_ok=True)
        size = rng.randrange(900, 1400) if fault == "disk" else None
        machine = str(self.folder / "machine.toml")
        self.worker.begin("scan", machine, "--save", str(out), file_size=size)
        if not self._wait_for_journal():  # a busy machine: nothing answered in time
            self.worker.end()
            return self.scan(fault, seed, scheme)
        time.sleep(rng.uniform(0.0, 1.5))
        self._strike(fault, rng)
        status, said = self.worker.end()
        journal = self.journal.exists()
        if fault == "IOC gone":
            self.ioc.start()
        restored = self._at(before)
        self._mended()
        if journal:
            self.worker.begin("scan", "--recover", str(self.journal))
            recovered_status, more = self.worker.end()
            said += more
            recovered = recovered_status == 0 and self._at(before) and not self.journal.exists()
        else:
            recovered = restored
        if fault in UNDEFINED:  # its set point keeps the alarm, with which no scan begins
            self.ioc.kill()
            self.ioc.start()
        within = (-8.0, 8.0) if fault == "limits" else (LOW, HIGH)
        outside = sum(not within[0] <= v <= within[1] for v in self.ioc.puts("Q1"))
        return Fate(status, said, journal, restored, recovered, outside)

    def _wait_for_journal(self) -> bool:
        until = time.monotonic() + 120
        while not (begun := self.journal.exists()) and time.monotonic() < until:
            time.sleep(0.01)
        return begun

    def _strike(self, fault: str, rng: random.Random) -> None:
        if fault in SIGNALS:
            for _ in range(rng.choice([1, 1, 2])):
                with suppress(ProcessLookupError):
                    os.kill(self.worker.process.pid, signal.Signals[fault])
                time.sleep(rng.uniform(0, 0.3))
        elif fault in (*READBACK, *SCREEN):
            self.value(f"SIM:FAULT:{fault}", 1.0)
        elif fault == "dark for a while":
            self.value("SIM:FAULT:DARK", 1.0)
            time.sleep(rng.uniform(0.1, 0.7))
            self.value("SIM:FAULT:DARK", 0.0)
        elif "IOC" in fault:
            if "SIGKILL" in fault:
                self.worker.process.kill()
            self.ioc.kill()
            if "back" in fault:
                time.sleep(rng.uniform(0.0, 1.0))
                self.ioc.start(*["undefined"] * ("undefined" in fault))

    def _mended(self) -> None:
        for name in (*READBACK, *SCREEN):
            self.value(f"SIM:FAULT:{name}", 0.0)

    def _at(self, before: float) -> bool:
        """Whether the magnet itself, not its read-back, is there, or comes there."""
        for _ in range(20):
            if abs(self.value("SIM:Q1:TRUE") - before) < 1e-6:
                return True
            time.sleep(0.05)
        return False


def main(count: int, seed: int, kinds: Sequence[str]) -> None:
    os.environ.update(private_ports())
    folder = Path(tempfile.mkdtemp())
    injector = Injector(Ioc(folder).start(), folder)
    rows: dict[str, Counter] = {kind: Counter() for kind in kinds}
    for number in range(count):
        kind = kinds[number % len(kinds)]
        fate = injector.scan(kind, seed + number, ("", "pva://")[number // len(kinds) % 2])
        row = rows[kind]
        row["scans"] += 1
        row["ended well"] += fate.status == 0
        row["restored"] += fate.restored
        row["journal left"] += fate.journal
        row["restored in the end"] += fate.recovered
        row["written outside"] += fate.outside
        if not fate.recovered or fate.outside or not (fate.restored or fate.journal):
            print(number, kind, fate, flush=True)
        if number % 50 == 49:
            print(number + 1, dict(sum(rows.values(), Counter())), flush=True)
    names = ("scans", "ended well", "restored", "journal left", "restored in the end")
    names += ("written outside",)
    print("| fault | " + " | ".join(names) + " |\n|---|" + "---|" * len(names))
    for kind, row in [*rows.items(), ("all", sum(rows.values(), Counter()))]:
        print(f"| {kind} | " + " | ".join(str(row[name]) for name in names) + " |")
    injector.worker.close()
    injector.ioc.kill()


if __name__ == "__main__":
    count, seed, *kinds = (*sys.argv[1:], *["0"] * (len(sys.argv) < 3))
    main(int(count), int(seed), kinds or KINDS)
