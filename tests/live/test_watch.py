"""`beamfit watch` beside a real IOC: lifetime, served variables, page, a restart, and no put."""

import asyncio
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from beamfit.cli import main
from beamfit.errors import InputError
from beamfit.io.machine import Watched, read_watch_machine
from beamfit.lifetime.watch import Plan, State
from beamfit.live import watch as live_watch
from beamfit.live.channel import Described, PvReading, open_channel, run
from beamfit.live.served import values_of
from beamfit.live.watch import Arrived, _RunningWatch
from tests.live.conftest import ROOT
from tests.live.truth import A, B
from tests.report.browser import NAME

MACHINE = """format = "beamfit-machine-1"
name = "ring <b>&amp;</b>"
timeout_s = 2
[ring]
beam_current_mA = "pva://SIM:RING:CURRENT"
rf_voltage_kV = "SIM:RING:RF"
pressure_Pa = "SIM:RING:PRESSURE"
[watch]
window_s = 3600
interval_s = 300
prefix = "WATCH:"
"""


def put(**values):
    for name, value in values.items():
        run(open_channel(f"SIM:RING:{name}", 30.0).put(value))


class Watching:
    """The command in a process of its own, and what its page is told."""

    def __init__(self, folder, ioc):
        self.ioc = ioc
        (folder / "ring.toml").write_text(MACHINE)
        self.err = folder / "err.txt"
        command = [sys.executable, "-m", "beamfit", "watch", "ring.toml", "--port", "0", "--json"]
        told = {"cwd": folder, "env": {**os.environ, "PYTHONPATH": str(ROOT)}}
        with self.err.open("w") as err:
            streams = {"stdout": subprocess.PIPE, "stderr": err, "text": True}
            self.process = subprocess.Popen(command, **streams, **told)
        self.until(lambda: "; Ctrl-C" in self.err.read_text())
        said = self.err.read_text()
        self.url = said[said.index("http") :].partition(";")[0]

    def until(self, there, wait=60):
        end = time.monotonic() + wait
        while not (found := there()):
            assert self.process.poll() is None, self.err.read_text()
            assert time.monotonic() < end, self.state()
            time.sleep(0.2)
        return found

    def state(self, path="state"):
        with urllib.request.urlopen(self.url + path, timeout=10) as answer:
            return json.loads(answer.read())

    def known(self, that=lambda told: told["quantities"]["a"]):
        return self.until(lambda: (t := self.state()).get("sound") and that(t) and t, 150)


@pytest.fixture(scope="module")
def watching(_ioc, tmp_path_factory):
    _ioc.log.write_text("")
    put(SPEED=100.0, REFILL=200.0)
    one = Watching(tmp_path_factory.mktemp("watch"), _ioc)
    yield one
    one.process.kill()
    one.process.communicate()


def test_the_lifetime_and_both_losses_are_those_of_the_ring(watching):
    told = watching.known()
    assert told["status"] == "converged"
    found = told["quantities"]
    rate = A * told["mean_current"] + B
    for name, truth in (("lifetime", 1 / rate / 3600), ("a", A), ("b", B)):
        assert abs(found[name]["value"] - truth) < 5 * found[name]["error"], name
    assert found["normalised"]["unit"] == "mA h"
    assert (told["alarm"]["moved"], told["lost"], told["silent"]) == ("", [], None)


def test_what_is_found_is_served_and_nobody_writes_it(watching):
    async def read():
        names = ("LIFETIME", "LIFETIME:ERROR", "A", "SINCE")
        found = {n: await open_channel(f"pva://WATCH:{n}").get() for n in names}
        unit = (await open_channel("pva://WATCH:LIFETIME").describe()).unit
        with pytest.raises(InputError, match="refuses"):
            await open_channel("pva://WATCH:LIFETIME").put(1.0)
        return found, unit

    watching.known()
    found, unit = run(read())
    told = watching.state()
    assert unit == "h"
    lifetime = told["quantities"]["lifetime"]
    assert found["LIFETIME"].value == pytest.approx(lifetime["value"], rel=0.05)
    assert abs(found["LIFETIME"].time - told["time"]) < 1000  # of the machine, not of this computer
    assert found["LIFETIME"].good
    assert not found["SINCE"].good  # nothing moved, and no number says when


def request(url, head):
    host, port = url[7:-1].split(":")
    with socket.create_connection((host, int(port)), 5) as one:
        one.sendall(head.encode())
        return one.makefile("rb").readline().decode()


def test_the_page_is_read_and_nothing_else(watching):
    assert watching.url.startswith("http://127.0.0.1:")
    for head, status in (
        ("POST / HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        ("PUT /state HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        ("GET /../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        ("GET / HTTP/1.1\r\nHost: elsewhere.example\r\n\r\n", 403),
        ("GET / HTTP/1.1\r\n\r\n", 400),
    ):
        assert request(watching.url, head).split()[1] == str(status)
    with urllib.request.urlopen(watching.url, timeout=5) as answer:
        policy, page = answer.headers["Content-Security-Policy"], answer.read().decode()
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "ring <b>" not in page


SEEN = """({wide: document.documentElement.scrollWidth - document.documentElement.clientWidth,
  ...Object.fromEntries([...document.querySelectorAll('[id]')].map(e => [e.id, e.textContent]))})"""


@pytest.mark.skipif(NAME is None, reason="no Chromium here: apt-get install chromium")
def test_the_page_shows_it_in_a_browser(watching, browser):
    watching.known()
    page = SimpleNamespace(as_uri=lambda: watching.url, name="watch")
    for width in ("phone", "screen"):
        faults = browser.faults(page, width, 0)
        seen, end = {}, time.monotonic() + 20
        while "converged" not in seen.get("headline", "") and time.monotonic() < end:
            asked = {"expression": SEEN, "returnByValue": True}
            seen = browser.ask("Runtime.evaluate", **asked)["result"]["value"]
            time.sleep(0.1)
        assert "±" in seen["tiles"]
        assert seen["name"] == "ring <b>&amp;</b>"  # as text
        assert seen["wide"] == 0
        assert seen["lifetime"].count(":") >= 2  # times below the course
        told = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        assert faults + [e for e in browser.events if e["method"] in told] == []
    browser.events.clear()
    browser.ask("Page.navigate", url="about:blank")
    while not any(e["method"] == "Page.loadEventFired" for e in browser.events):
        browser.events.append(browser._message())


def test_an_ioc_that_ends_is_said_and_followed_again(watching):
    # A busy IOC's simulated time falls behind this computer's, at which the next one begins.
    watching.until(lambda: watching.state()["time"] > time.time() + 600, 150)
    watching.ioc.kill()
    gone = watching.until(lambda: (t := watching.state())["lost"] and t)
    assert gone["headline"].startswith("No connection to ")
    known = gone["silent"] is None and gone["quantities"]["lifetime"] is not None
    assert (gone["colour"], gone["sound"]) == ("red", known)
    before = gone["counts"]["readings"]
    watching.ioc.start()
    # Its simulated time begins anew: a clock set back. Made faster only when that was seen, or it
    # would be past the last reading before a client on a busy computer has found it again.
    enough = lambda t: t["counts"]["readings"] > before + 100 and t["counts"]["clock"]  # noqa: E731
    told = watching.known(lambda t: enough(t) and t["lost"] == [])
    put(SPEED=100.0)
    assert any("again a connection" in text for _, text in told["events"])


def test_at_the_end_there_is_one_object_and_nothing_was_written(watching):
    with urllib.request.urlopen(watching.url + "events", timeout=30) as events:
        assert events.readline().startswith(b"data: {")  # a page is open when it ends
        watching.process.send_signal(signal.SIGINT)
        out, _ = watching.process.communicate(timeout=30)
    assert watching.process.returncode == 130
    said = watching.err.read_text()
    assert said.endswith("beamfit: interrupted\n")
    assert said.count("\n") == 2  # where the page is, and this: libraries say nothing
    document = json.loads(out)
    [result] = document["results"]
    assert list(document["inputs"]) == ["ring.toml"]
    assert result["record"] == "ring <b>&amp;</b>"
    assert result["counts"]["readings"] > 100
    assert {"a", "b", "i0", "lifetime_mean", "identifiability", "alarms"} <= set(result)
    assert watching.ioc.log.read_text() == ""  # no magnet was written to


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[ring]\nrf_voltage_kV = 'A'\n", "ring.toml:2: column 'beam_current_mA': no beam current"),
        ("[ring]\nbeam_current_mA = 'A'\nbeam_current_A = 'B'\n", "one beam_current"),
        ("[ring]\nbeam_current = 'A'\n", "did you mean beam_current"),
        ("[ring]\nbeam_current_A = 'A'\nfile = 'r.toml'\n", "reference_current_mA"),
        ("[ring]\nbeam_current_A = 'A'\n[watch]\nwindow_s = 60\ninterval_s = 30\n", "a third of"),
    ],
)
def test_a_machine_file_that_cannot_be_watched_is_refused(tmp_path, text, said):
    (tmp_path / "ring.toml").write_text(f'format = "beamfit-machine-1"\n{text}')
    with pytest.raises(InputError) as refused:
        read_watch_machine(tmp_path / "ring.toml")
    assert said in str(refused.value)


def test_a_variable_that_comes_back_in_another_unit_ends_the_watch():
    class Changed:
        async def monitor(self):
            for value in (1.0, None, 1.0):
                yield value and PvReading(value, 1.7e9)

        async def describe(self):
            return Described("A")

    course = _RunningWatch(Plan(), asyncio.Queue())
    with pytest.raises(InputError, match="unit 'A' of 'I'; expected mA, as in the machine file"):
        asyncio.run(course.follow(Watched("beam_current", "I", "mA", 1.0), Changed()))
    assert course.queue.qsize() == 2  # nothing was taken for mA that is not


def test_another_unit_or_a_taken_port_is_one_line(ioc, tmp_path, monkeypatch, capsys):
    def refusal(text, port):
        (tmp_path / "ring.toml").write_text(text)
        arguments = ["beamfit", "watch", str(tmp_path / "ring.toml"), "--port", str(port)]
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as stop:
            main()
        out, err = capsys.readouterr()
        assert (stop.value.code, out, err.count("\n")) == (2, "", 1)
        return err

    said = refusal(MACHINE.replace("beam_current_mA", "beam_current_A"), 0)
    assert "unit 'mA' of 'pva://SIM:RING:CURRENT'; expected A, as in the machine file" in said
    said = refusal(MACHINE.replace("WATCH:", "SIM:RING:"), 0)
    assert "', which somebody serves; expected another prefix in the machine file" in said
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"port {port}" in refusal(MACHINE, port)


CURRENT = Watched("beam_current", "I", "mA", 1.0)


def arrived(begin, at):
    """A minute of readings that came at a time of this computer's clock."""
    beam = [300.0 * np.exp(-k / 3e4) for k in range(60)]
    return [Arrived(CURRENT, PvReading(i, begin + k), at) for k, i in enumerate(beam)]


def test_what_is_shown_is_as_old_as_the_newest_reading_that_is_fitted(monkeypatch):
    now = 5000.0  # of a clock that stands still, however long a fit takes
    monkeypatch.setattr(live_watch, "time", SimpleNamespace(monotonic=lambda: now))
    course = _RunningWatch(Plan(every=10.0), asyncio.Queue(), arrived=now)
    for late in (40.0, 0.0):  # fits that fall behind, and that do not
        for one in arrived(1.7e9 - 100 * late, now - late):
            course.queue.put_nowait(one)
        asyncio.run(course.take())
        told = course.view()
        assert told.silent is None
        assert told.age == late
        assert told.old == (not told.sound) == (late > 0)
        assert ("fits fall behind" in told.headline[1]) == told.old
        found = values_of(told)
        assert (found["AGE"][1] == found["STATUS"][1] == 3) == told.old
        assert found["AGE"][0] == told.to_json()["age"] == told.age


def test_a_lost_connection_is_said_before_what_it_makes_old():
    lost = live_watch.WatchView(Plan(), State(), ("SR:I",), silent=12.0)
    said = "No connection to SR:I, no reading of the current for 12 s: all below is old"
    assert lost.headline == ("red", said)
    assert replace(lost, lost=()).headline[1].startswith("No reading of the current for 12 s")
    assert replace(lost, silent=None).headline == ("red", "No connection to SR:I")


def test_a_name_that_would_turn_the_line_round_is_shown_by_its_number(tmp_path):
    text = 'format = "beamfit-machine-1"\nname = "a\\u202Eb\\u200F"\n[ring]\nbeam_current_A = "I"\n'
    (tmp_path / "ring.toml").write_text(text)
    assert read_watch_machine(tmp_path / "ring.toml").name == "a\\u202eb\\u200f"


def test_libraries_do_not_print_on_the_screen():
    work = (
        "from beamfit.live.channel import open_channel, run\ntry: run(open_channel('A', 0.1).get())"
    )
    work += "\nexcept Exception as error: print(type(error).__name__)"
    told = os.environ | {"EPICS_CA_ADDR_LIST": "127.0.0.1 127.0.0.1"}  # libca remarks on it
    done = subprocess.run(
        [sys.executable, "-c", work], env=told, cwd=ROOT, capture_output=True, text=True
    )
    assert (done.stdout, done.stderr) == ("SilentError\n", "")


def test_nobody_but_this_computer_is_answered():
    tried = ["unshare", "-rn", "ip", "link", "set", "lo", "up"]
    if (
        not all(map(shutil.which, ("unshare", "ip", "ss")))
        or subprocess.run(tried, capture_output=True).returncode
    ):
        pytest.skip("no network of its own can be made here")
    told = {k: v for k, v in os.environ.items() if not k.startswith("EPICS_")}
    command = [*tried[:2], sys.executable, "-m", "tests.live.alone"]
    done = subprocess.run(command, cwd=ROOT, env=told, capture_output=True, text=True)
    found = json.loads(done.stdout)
    assert found == {"answered": {"127.0.0.1": True, "10.9.9.1": False}, "listening": ["127.0.0.1"]}
