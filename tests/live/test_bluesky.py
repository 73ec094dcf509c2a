"""The scan as a plan of bluesky, on a real IOC."""

import asyncio
import re
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from bluesky import RunEngine
from bluesky.utils import RunEngineInterrupted

from beamfit.errors import InputError
from beamfit.io.line import build_line
from beamfit.io.machine import ScanMachine, read_scan_machine
from beamfit.live.bluesky import emittance_scan
from beamfit.live.channel import _close_connections
from beamfit.live.devices import NoSizesError
from tests.live.faulty import Injector
from tests.live.simulated import written


@pytest.fixture
def engine():
    """A RunEngine whose loop ends with the test, and its channels with it."""
    one = RunEngine({}, context_managers=[], call_returns_result=True)
    yield one
    closed(one)


def closed(engine):
    async def ended():
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for task in left:
            task.cancel()
        await asyncio.gather(*left, return_exceptions=True)
        _close_connections()

    asyncio.run_coroutine_threadsafe(ended(), engine.loop).result(5)
    engine.loop.call_soon_threadsafe(engine.loop.stop)
    engine._th.join(5)
    engine.loop.close()


class Bench(NamedTuple):
    """Machine and engine; the magnet at a setting of its own."""

    engine: RunEngine
    machine: ScanMachine
    value: Callable
    kept: dict

    def scan(self, **told):
        line = build_line(self.machine.lattice)
        return self.engine(emittance_scan(self.machine, line, **told)).plan_result

    def interrupted(self, call, **told):
        """Scan, have something done by another thread after two points; how many there are."""
        measured = []

        def tell(now):
            measured.extend([now] * now.measured)
            if now.measured and len(now.points) == 2:
                threading.Thread(target=call).start()

        with pytest.raises(RunEngineInterrupted):
            self.scan(tell=tell)
        return lambda: len(measured)

    def is_back(self):
        return abs(self.value("SIM:Q1:TRUE") + 1.5) < 1e-9 and not self.journal.exists()

    @property
    def journal(self):
        return Path(self.machine.path).with_suffix(".journal")


@pytest.fixture
def bench(ioc, engine, tmp_path, request):
    scheme, more = getattr(request, "param", ("", ""))
    machine = read_scan_machine(written(tmp_path, scheme=scheme, more=more))
    value = Injector(ioc, tmp_path).value
    value("SIM:Q1:SET", -1.5)
    kept = {name: [] for name in ("start", "descriptor", "event", "stop")}
    engine.subscribe(lambda name, document: kept[name].append(document))
    # Seven points of three shots do not always reach 4 %.
    return Bench(engine, replace(machine, goal=0.04, points=30), value, kept)


@pytest.mark.parametrize("bench", [("", ""), ("pva://", "")], indirect=True)
def test_a_scan_reaches_its_goal_through_a_pause_and_its_events_are_its_points(ioc, bench):
    measured = bench.interrupted(bench.engine.request_pause)
    before = measured()
    assert bench.journal.exists()
    time.sleep(1.0)
    assert measured() <= before + 1  # the setting that was begun is the last
    found = bench.engine.resume().plan_result
    assert found.reason == "the goal of 4 % is reached"
    assert bench.kept["stop"][0]["reason"] == f"{found.reason}. {found.doubt}".removesuffix(". ")
    assert bench.is_back()
    primary, fitted = (d["uid"] for d in bench.kept["descriptor"])
    events = [e for e in bench.kept["event"] if e["descriptor"] == primary]
    last = {event["seq_num"]: event["data"] for event in events}
    assert len(last) == 3 * len(found.points)
    for number, data in last.items():
        point, shot = divmod(number - 1, 3)
        assert data["Q1"] == found.points[point].settings["Q1"]
        for plane, sizes in found.points[point].shots.items():
            assert data[f"OTR-{plane}"] == pytest.approx(1e6 * sizes[shot])
    (fit,) = (event["data"] for event in bench.kept["event"] if event["descriptor"] == fitted)
    for plane in found.fit.planes:
        assert fit[f"{plane.plane}-emittance-error"] == plane.emittance.error
        assert fit[f"{plane.plane}-status"] == "converged"


@pytest.mark.parametrize("bench", [("", 'approach = "below"\napproach_by = 0.4')], indirect=True)
def test_who_aborts_a_scan_finds_the_magnet_back(bench):
    bench.interrupted(bench.engine.abort)
    assert bench.kept["stop"][0]["exit_status"] == "abort"
    assert bench.is_back()


def test_a_halt_restores_with_nobody_who_waits(bench):
    bench.interrupted(bench.engine.halt)
    until = time.monotonic() + 60
    while not bench.is_back() and time.monotonic() < until:
        time.sleep(0.1)
    assert bench.is_back()


def test_whatever_fails_the_magnet_is_back_and_the_error_is_the_scans_own(bench):
    bench.value("SIM:FAULT:NAN", 1.0)
    try:
        with pytest.raises(NoSizesError, match=r"no sizes at 3 settings in a row \("):
            bench.scan()
    finally:
        bench.value("SIM:FAULT:NAN", 0.0)
    assert bench.kept["stop"][0]["exit_status"] == "fail"
    assert bench.is_back()


def test_what_does_not_fit_the_machine_is_refused_before_anything_moves(ioc, bench):
    path = Path(bench.machine.path)
    path.write_text(path.read_text().replace("SIM:Q1:READ", "SIM:SCREEN:X"))
    ioc.log.write_text("")
    with pytest.raises(InputError, match="'SIM:SCREEN:X' in 'um'; expected T_per_m"):
        bench._replace(machine=read_scan_machine(path)).scan()
    assert ioc.puts("Q1") == []
    assert bench.kept["stop"][0]["exit_status"] == "fail"


def test_every_block_of_the_page_gives_what_stands_beside_it(ioc, root, tmp_path, monkeypatch):
    page = (root / "docs/live_adapters.md").read_text()
    files = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    for name, text in zip(("line.toml", "machine.toml"), files, strict=True):
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    engines, said = [], []

    def made(**how):
        engines.append(RunEngine(context_managers=[], **how))
        return engines[-1]

    monkeypatch.setattr("bluesky.RunEngine", made)
    names = {"print": lambda *words: said.append(" ".join(map(str, words)))}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    closed(*engines)
    assert said == re.findall(r"^print\(.*\)  # (.*)$", page, re.MULTILINE)
    assert len(said) == 5
