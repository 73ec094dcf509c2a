"""Restoring a machine after a scan: on disk before anything moves, put back whatever happens."""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
import os
import signal
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path

from beamfit.compile_cache import own_folder
from beamfit.errors import InputError, plain
from beamfit.io.files import read_json
from beamfit.io.machine import APPROACHES, Magnet, ScanMachine, check_setting
from beamfit.io.toml import is_number
from beamfit.live.devices import Device, NotSettledError
from beamfit.writing import alone, write_atomically

FORMAT = "beamfit-journal-1"
# Ends of the names by which EPICS is told where variables are looked for.
LOOKED_FOR = ("_ADDR_LIST", "_NAME_SERVERS", "_SERVER_PORT", "_BROADCAST_PORT")
# Signals that end a scan; what they find is restored.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Seconds between two attempts to reach an IOC, and attempts to settle a magnet.
PAUSE, ATTEMPTS = 0.5, 2


@dataclass(frozen=True)
class Journal:
    """Magnets and the settings they had before a scan.

    Attributes
    ----------
    path : Path
        Where it is written.
    machine : str
        The machine file, for whoever finds the journal.
    before : tuple of (Magnet, float)
        Each magnet, with limits and variables of its own, and its setting.
    timeout, patience : float
        Within which a variable has to answer, and for how long it is asked again, s.
    """

    path: Path
    machine: str
    before: tuple[tuple[Magnet, float], ...]
    timeout: float = 5.0
    patience: float = 60.0

    def write(self) -> None:
        """Have it on disk, whole, its folder too.

        Raises
        ------
        InputError
            If the place cannot be written.
        """
        said = {
            "format": FORMAT,
            "what": "settings to restore: beamfit scan --recover THIS_FILE",
            "machine": self.machine,
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "by": f"process {os.getpid()} on {socket.gethostname()}",
            "timeout": self.timeout,
            "patience": self.patience,
            "magnets": [{**asdict(magnet), "setting": value} for magnet, value in self.before],
        }
        write_atomically(self.path, (json.dumps(said, indent=2) + "\n").encode())
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def done(self) -> None:
        """Remove it: all is restored."""
        self.path.unlink(missing_ok=True)


def check_none_left(path: Path) -> None:
    """Refuse to begin where an earlier scan has something to restore.

    Raises
    ------
    InputError
        Naming the journal.
    """
    if path.exists():
        found = "what a scan before this one has not restored"
        raise InputError(found, f"beamfit scan --recover {path} first", path=path)


@contextmanager
def alone_with(path: Path, magnets: Iterable[Magnet]) -> Iterator[None]:
    """Keep other scans from a journal and from its magnets, in whatever file these are named.

    The locks of magnets are in this user's folder of beamfit; without a home there are none.

    Raises
    ------
    InputError
        Naming the journal or the magnet that another scan has.
    """
    folder = own_folder()
    with ExitStack() as stack:
        stack.enter_context(alone(path))
        for magnet in magnets if folder else ():
            lock = Path(folder, f"magnet-{_found_as(magnet.set)}")
            try:
                stack.enter_context(alone(lock))
            except InputError:
                found = (
                    f"magnet '{plain(magnet.name)}' ({plain(magnet.set)}), which another scan has"
                )
                raise InputError(found, "another magnet, or that scan's end") from None
        yield


def _found_as(variable: str) -> str:
    """A word for a variable and where it is looked for: a simulation may have the same name."""
    where = sorted(f"{k}={v}" for k, v in os.environ.items() if k.endswith(LOOKED_FOR))
    said = "\n".join([variable.rpartition("://")[2], *where])
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def read_journal(path: str | PathLike[str]) -> Journal:
    """Read a journal.

    Raises
    ------
    InputError
        If the file is none.

    Examples
    --------
    >>> import tempfile
    >>> place = Path(tempfile.mkdtemp()) / "a.journal"
    >>> magnet = Magnet("Q", "Q:SET", "Q:READ", "A", -1.0, 1.0, 0.01, 0.1)
    >>> Journal(place, "machine.toml", ((magnet, 0.5),)).write()
    >>> read_journal(place).before == ((magnet, 0.5),)
    True
    """
    expected = f"a journal of beamfit scan, {FORMAT}"
    found = read_json(path, "a file that is none", expected)
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError("a file that is none", expected, path=path)
    try:
        before = tuple(_magnet(dict(table)) for table in found["magnets"])
        times = found["timeout"], found["patience"]
        for named_once in ({m.name for m, _ in before}, {m.set for m, _ in before}):
            _demand(0 < len(before) == len(named_once))
        _demand(all(is_number(time) and time > 0 for time in times))
        return Journal(Path(path), str(found["machine"]), before, *times)
    except (KeyError, TypeError, ValueError):
        expected = "it as the scan wrote it; put back by hand what can be read of it"
        raise InputError("a journal that was changed or cut", expected, path=path) from None


def _magnet(table: dict[str, object]) -> tuple[Magnet, float]:
    """Checked as a machine file is: a tolerance without end would call anything restored."""
    setting = table.pop("setting")
    table["degauss"] = tuple(table["degauss"])
    known = {field.name for field in fields(Magnet)}
    m = Magnet(**{name: value for name, value in table.items() if name in known})
    numbers = (setting, m.low, m.high, m.tolerance, m.settle, m.timeout, m.approach_by)
    _demand(all(isinstance(word, str) and word for word in (m.name, m.set, m.read, m.unit)))
    _demand(all(map(is_number, numbers)) and m.approach in APPROACHES)
    _demand(0 < m.tolerance < 0.1 * (m.high - m.low) and m.settle >= 0 and m.timeout > 0)
    _demand(m.low <= setting <= m.high)
    return m, float(setting)


def _demand(holds: bool) -> None:
    if not holds:
        raise ValueError


def journal_of(machine: ScanMachine, path: str | None) -> Path:
    """Path of a machine's journal unless it is given: beside the machine's file."""
    return Path(path or Path(machine.path).with_suffix(".journal")).absolute()


def named(before: Iterable[tuple[Magnet, float]]) -> str:
    """Magnets and their settings in words.

    Examples
    --------
    >>> named([(Magnet("Q", "Q:SET", "Q:READ", "T_per_m", -1.0, 1.0, 0.01, 0.1), 0.5)])
    'Q 0.5 T_per_m'
    """
    return ", ".join(f"{magnet.name} {value:.6g} {magnet.unit}" for magnet, value in before)


class NotRestoredError(InputError):
    """A magnet that could not be put back, or is not seen to be back."""


async def reach(
    magnet: Magnet, device: Device, value: float, present: float | None = None
) -> float:
    """Move a magnet to a setting, from below or above where that is asked for.

    Parameters
    ----------
    magnet : Magnet
        Its limits and the side.
    device : Device
        What moves it.
    value : float
        The setting, in the magnet's unit.
    present : float, optional
        The setting it comes from; asked unless given. From NaN it passes by whichever side it is.

    Returns
    -------
    float
        What is read back.

    Raises
    ------
    InputError
        If the setting is outside the limits (nothing is written then), or is not reached.
    """
    value, by = check_setting(magnet, value), magnet.approach_by
    present = await device.get() if present is None else present
    if magnet.approach == "below" and not present <= value:
        await _put(device, max(value - by, magnet.low))
    if magnet.approach == "above" and not present >= value:
        await _put(device, min(value + by, magnet.high))
    return await _put(device, value)


async def _put(device: Device, value: float) -> float:
    await device.put(value)
    return await device.settled(value)


async def restore(journal: Journal, magnets: Mapping[str, Device]) -> None:
    """Put every magnet of a journal back, see that it is there, and remove the journal.

    Parameters
    ----------
    journal : Journal
        What to restore.
    magnets : mapping of str to Device
        By name.

    Raises
    ------
    NotRestoredError
        If one is not back. All others are, and the journal stays.
    """
    until = time.monotonic() + journal.patience
    errors = await asyncio.gather(  # no magnet waits for another's IOC
        *(_restored(magnet, magnets[magnet.name], value, until) for magnet, value in journal.before)
    )
    first = next(filter(None, errors), None)
    if first is None:
        journal.done()
        return
    left = (one for one, error in zip(journal.before, errors, strict=True) if error)
    said = getattr(first, "found", plain(f"{type(first).__name__}: {first}")[:150])
    found = f"{named(left)} not seen to be restored ({said})"
    expected = f"beamfit scan --recover {journal.path}, or by hand"
    with suppress(InputError, OSError):  # somebody may have removed it
        journal.write()
    raise NotRestoredError(found, expected)


async def _restored(magnet: Magnet, device: Device, value: float, until: float) -> Exception | None:
    """Put a magnet back, again and again; the last error where that fails."""
    unsettled = 0
    while True:
        try:
            return await _put_back(magnet, device, value)
        except Exception as error:  # of whatever kind, of a library too: it may pass
            unsettled += isinstance(error, NotSettledError)
            if unsettled >= ATTEMPTS or time.monotonic() > until:
                return error
        await asyncio.sleep(PAUSE)


async def _put_back(magnet: Magnet, device: Device, value: float) -> None:
    """Move a magnet back, also where its set point is undefined: an IOC may return like that."""
    present = math.nan
    with suppress(Exception):
        present = await device.get()
    await reach(magnet, device, value, present)


@contextmanager
def ended_by_signals(task: asyncio.Future, tell: Callable[[str], None]) -> Iterator[list[int]]:
    """Have the first signal cancel something, and any more only say that all is being restored.

    Outside the main thread signals are left to whoever runs it.
    """
    loop, came, before = asyncio.get_running_loop(), [], {}

    def come(number: int) -> None:
        came.append(number)
        task.cancel()
        if len(came) > 1:
            tell("Restoring; wait, or the magnets stay where they are.")

    with suppress(RuntimeError, ValueError, NotImplementedError):
        for number in SIGNALS:
            kept = signal.getsignal(number)
            loop.add_signal_handler(number, come, number)
            before[number] = kept
    try:
        yield came
    finally:
        for number, kept in before.items():
            loop.remove_signal_handler(number)
            signal.signal(number, kept)
