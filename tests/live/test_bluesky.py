"""The scan as a plan of bluesky, its devices on a real IOC."""

import asyncio
import re
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from bluesky import RunEngine
from bluesky import plan_stubs as bps
from bluesky.plans import count
from bluesky.utils import RunEngineInterrupted
from ophyd_async.plan_stubs import ensure_connected

from beamfit.errors import InputError
from beamfit.io.line import build_line
from beamfit.io.machine import ScanMachine, read_scan_machine
from beamfit.live.bluesky import emittance_scan
from beamfit.live.devices import NoSizesError
from beamfit.live.journal import read_journal
from beamfit.live.ophyd import ScreenDevice, devices_of
from tests.live.faulty import Injector
from tests.live.simulated import written


@pytest.fixture
def engine():
    """A RunEngine whose loop ends with the test, and its channels with it."""
    one = RunEngine({}, context_managers=[], call_returns_result=True)
    yield one
    closed(one)


def closed(engine):
    import aioca

    async def ended():
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for task in left:  # such as a shot that nobody waits for any more
            task.cancel()
        await asyncio.gather(*left, return_exceptions=True)
        aioca.purge_channel_caches()

    asyncio.run_coroutine_threadsafe(ended(), engine.loop).result(5)
    engine.loop.call_soon_threadsafe(engine.loop.stop)
    engine._th.join(5)
    engine.loop.close()


class Bench(NamedTuple):
    """Machine and devices, connected; the magnet at a setting of its own."""

    engine: RunEngine
    machine: ScanMachine
    magnets: dict
    screen: ScreenDevice
    value: Callable
    kept: dict

    def scan(self, **told):
        line = build_line(self.machine.lattice)
        return self.engine(
            emittance_scan(self.magnets, self.screen, self.machine, line, **told)
        ).plan_result

    def at(self, command, number, call):
        """Have something done by another thread as soon as a message comes for the nth time."""
        seen = []

        def look(message):
            seen.extend([message] * (message.command == command))
            if message.command == command and len(seen) == number:
                threading.Thread(target=call).start()

        self.engine.msg_hook = look

    @property
    def journal(self):
        return Path(self.machine.path).with_suffix(".journal")


@pytest.fixture
def bench(ioc, engine, tmp_path, request):
    scheme, more = getattr(request, "param", ("", ""))
    machine = read_scan_machine(written(tmp_path, scheme=scheme, more=more))
    machine = replace(machine, goal=0.03)
    magnets, screen = devices_of(machine)
    engine(ensure_connected(*magnets.values(), screen))
    engine(bps.mv(magnets["Q1"], -1.5))
    ioc.log.write_text("")
    kept = {name: [] for name in ("start", "descriptor", "event", "stop")}
    engine.subscribe(lambda name, document: kept[name].append(document))
    return Bench(engine, machine, magnets, screen, Injector(ioc, tmp_path).value, kept)


def test_a_scan_reaches_its_goal_through_a_pause_and_its_events_are_its_points(bench):
    bench.at("trigger", 8, bench.engine.request_pause)  # between two shots of the third setting
    with pytest.raises(RunEngineInterrupted):
        bench.scan()
    assert bench.journal.exists()
    found = bench.engine.resume().plan_result
    assert found.reason == bench.kept["stop"][0]["reason"] == "the goal of 3 % is reached"
    assert bench.value("SIM:Q1:TRUE") == pytest.approx(-1.5, abs=1e-9)
    assert not bench.journal.exists()
    primary, fitted = (d["uid"] for d in bench.kept["descriptor"])
    events = [e for e in bench.kept["event"] if e["descriptor"] == primary]
    last = {event["seq_num"]: event["data"] for event in events}
    assert len(last) == 3 * len(found.points)
    assert len(events) > len(last)  # what was repeated has the number of what it replaces
    for number, data in last.items():
        point, shot = divmod(number - 1, 3)
        assert data["Q1"] == pytest.approx(found.points[point].settings["Q1"], abs=0.01)
        for plane, sizes in found.points[point].shots.items():
            assert data[f"OTR-{plane}"] == pytest.approx(1e6 * sizes[shot])
    (fit,) = (event["data"] for event in bench.kept["event"] if event["descriptor"] == fitted)
    for plane in found.fit.planes:
        assert fit[f"{plane.plane}-emittance-error"] == plane.emittance.error
        assert fit[f"{plane.plane}-status"] == "converged"


@pytest.mark.parametrize("bench", [("", 'approach = "below"\napproach_by = 0.4')], indirect=True)
def test_who_aborts_a_scan_finds_the_magnet_back_and_a_stop_ends_a_move(ioc, bench):
    bench.at("set", 1, bench.engine.abort)  # on its way to -4.7, by -5.1
    with pytest.raises(RunEngineInterrupted):
        bench.scan()
    assert bench.kept["stop"][0]["exit_status"] == "abort"
    assert bench.value("SIM:Q1:TRUE") == pytest.approx(-1.5, abs=1e-9)
    assert not bench.journal.exists()

    def stopped():
        yield from bps.abs_set(bench.magnets["Q1"], -4.7)
        while not ioc.puts("Q1"):
            yield from bps.sleep(0.01)
        yield from bps.stop(bench.magnets["Q1"])
        yield from bps.sleep(0.3)

    ioc.log.write_text("")
    bench.engine(stopped())
    assert ioc.puts("Q1") == [pytest.approx(-5.1)]  # and not what it was on its way to


def test_a_halt_restores_nothing_and_leaves_the_journal(bench):
    bench.at("trigger", 5, bench.engine.halt)
    with pytest.raises(RunEngineInterrupted):
        bench.scan()
    assert read_journal(bench.journal).before[0][1] == pytest.approx(-1.5)
    with pytest.raises(InputError, match="has not restored; expected beamfit scan --recover"):
        bench.scan()


def test_whatever_fails_the_magnet_is_back_and_the_error_is_the_devices_own(bench):
    bench.value("SIM:FAULT:NAN", 1.0)
    try:
        with pytest.raises(NoSizesError, match=r"no sizes at 3 settings in a row \("):
            bench.scan()
    finally:
        bench.value("SIM:FAULT:NAN", 0.0)
    assert bench.kept["stop"][0]["exit_status"] == "fail"
    assert bench.value("SIM:Q1:TRUE") == pytest.approx(-1.5, abs=1e-9)
    assert not bench.journal.exists()


@pytest.mark.parametrize("bench", [("pva://", "")], indirect=True)
def test_devices_read_what_the_variables_say_and_write_nothing_outside_the_limits(ioc, bench):
    with pytest.raises(InputError, match=r"a setting of 2\.6 for Q1; expected within its limits"):
        bench.engine(bps.mv(bench.magnets["Q1"], 2.6))
    assert ioc.puts("Q1") == []
    at = bench.engine(bps.locate(bench.magnets["Q1"])).plan_result
    assert at["setpoint"] == bench.value("SIM:Q1:SET")
    assert at["readback"] == pytest.approx(bench.value("SIM:Q1:READ"), abs=0.002)
    first, second = (bench.engine(count([bench.screen])) and bench.kept["event"][-1] for _ in "12")
    assert second["data"]["OTR-x"] == pytest.approx(bench.value("SIM:SCREEN:X"), rel=0.2)
    assert second["timestamps"]["OTR-x"] > first["timestamps"]["OTR-x"]


def test_another_unit_is_refused_when_a_device_is_connected(ioc, engine, tmp_path):
    machine = read_scan_machine(written(tmp_path, change=("SIM:Q1:READ", "SIM:SCREEN:X")))
    with pytest.raises(Exception, match="'SIM:SCREEN:X' in 'um'; expected T_per_m"):
        engine(ensure_connected(*devices_of(machine)[0].values()))
    machine = read_scan_machine(written(tmp_path, change=("shots = 3", 'shots = 3\nunit = "mm"')))
    with pytest.raises(Exception, match="'SIM:SCREEN:X' in 'um'; expected mm"):
        engine(ensure_connected(devices_of(machine)[1]))


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
