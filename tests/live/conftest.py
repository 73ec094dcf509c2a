"""A real IOC on loopback and private ports for every test of this folder."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from beamfit.live import restore

# Run as programs of their own.
collect_ignore = ["ioc.py", "worker.py"]
ROOT = Path(__file__).resolve().parents[2]


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return str(one.getsockname()[1])


def private_ports():
    """Environment of an IOC and its clients that nobody else can hear."""
    tcp, udp = socket.SOCK_STREAM, socket.SOCK_DGRAM
    here, access, pva, search = "127.0.0.1", free_port(tcp), free_port(tcp), free_port(udp)
    return {
        "EPICS_CA_ADDR_LIST": here, "EPICS_CA_AUTO_ADDR_LIST": "NO",
        "EPICS_CA_SERVER_PORT": access, "EPICS_CA_REPEATER_PORT": free_port(udp),
        "EPICS_CA_MAX_SEARCH_PERIOD": "60",
        "EPICS_CAS_INTF_ADDR_LIST": here, "EPICS_CAS_BEACON_ADDR_LIST": here,
        "EPICS_PVA_ADDR_LIST": here, "EPICS_PVA_AUTO_ADDR_LIST": "NO",
        "EPICS_PVA_SERVER_PORT": pva, "EPICS_PVA_BROADCAST_PORT": search,
        "EPICS_PVAS_INTF_ADDR_LIST": here, "EPICS_PVAS_SERVER_PORT": pva,
        "EPICS_PVAS_BROADCAST_PORT": search, "EPICS_PVAS_BEACON_ADDR_LIST": here,
    }  # fmt: skip


class Ioc:
    """The IOC of tests/live/ioc.py, started, killed and started again."""

    def __init__(self, folder):
        self.log = folder / "puts.txt"
        self.process = None

    def start(self, *how):
        command = [sys.executable, "-m", "tests.live.ioc", str(self.log), *how]
        self.log.touch()
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for line in self.process.stdout:
            if line.strip() == "ready":
                return self
        raise RuntimeError("the IOC did not start")

    def kill(self):
        self.process.kill()
        self.process.communicate()

    def puts(self, magnet):
        """Every value that was written to a magnet."""
        rows = map(str.split, self.log.read_text().splitlines())
        return [float(value) for _, name, value in rows if name == magnet]


@pytest.fixture(autouse=True)
def _locks_of_this_process(tmp_path_factory, monkeypatch):
    """Tests of two processes may scan a simulated magnet of one name."""
    monkeypatch.setattr(restore, "own_folder", lambda: str(tmp_path_factory.getbasetemp()))


@pytest.fixture(scope="session")
def _ports():
    # Clients read the environment when they first connect, so that it stays for the session.
    os.environ.update(private_ports())


@pytest.fixture(scope="package")
def _ioc(_ports, tmp_path_factory):
    # For a package's tests alone: its shots take a tenth of a processor for as long as it runs.
    one = Ioc(tmp_path_factory.mktemp("ioc")).start()
    yield one
    one.kill()


@pytest.fixture
def ioc(_ioc):
    """The IOC, running, without faults."""
    if _ioc.process.poll() is not None:
        _ioc.start()
    _ioc.log.write_text("")
    return _ioc
