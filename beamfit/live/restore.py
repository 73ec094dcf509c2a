"""Restoring of a machine after a scan, with a journal written before anything moves."""

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
# Ends of the names of the environment variables that tell EPICS where to search for variables.
SEARCH_VARIABLES = ("_ADDR_LIST", "_NAME_SERVERS", "_SERVER_PORT", "_BROADCAST_PORT")
# Signals that end a scan, with restoring.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Time between attempts to reach an IOC, s.
RETRY_INTERVAL = 0.5
# Number of attempts to settle a magnet.
MAX_ATTEMPTS = 2


@dataclass(frozen=True)
class Journal:
    """Magnets and the settings they had before a scan.

    Attributes
    ----------
    path : Path
        File of the journal.
    machine : str
        The machine file, as information for a person.
    before : tuple of (Magnet, float)
        Each magnet, with its limits and variables, and its setting.
    timeout, patience : float
        Longest time to an answer of a variable, and time for which it is retried, s.
    """

    path: Path
    machine: str
    before: tuple[tuple[Magnet, float], ...]
    timeout: float = 5.0
    patience: float = 60.0

    def write(self) -> None:
        """Write the journal atomically, and flush its folder to disk.

        Raises
        ------
        InputError
            If the file cannot be written.
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
        """Remove the journal after everything is restored."""
        self.path.unlink(missing_ok=True)


def check_none_left(path: Path) -> None:
    """Refuse to begin while a journal of an earlier scan exists.

    Raises
    ------
    InputError
        With the name of the journal.
    """
    if path.exists():
        found = "what a scan before this one has not restored"
        raise InputError(found, f"beamfit scan --recover {path} first", path=path)


@contextmanager
def alone_with(path: Path, magnets: Iterable[Magnet]) -> Iterator[None]:
    """Lock a journal and its magnets against other scans, whatever machine file names them.

    The locks of magnets are in the beamfit folder of this user; without a home there are none.

    Raises
    ------
    InputError
        With the name of the journal or of the magnet that another scan uses.
    """
    folder = own_folder()
    with ExitStack() as stack:
        stack.enter_context(alone(path))
        for magnet in magnets if folder else ():
            lock = Path(folder, f"magnet-{_lock_name(magnet.set)}")
            try:
                stack.enter_context(alone(lock))
            except InputError:
                found = (
                    f"magnet '{plain(magnet.name)}' ({plain(magnet.set)}), which another scan has"
                )
                raise InputError(found, "another magnet, or that scan's end") from None
        yield


def _lock_name(variable: str) -> str:
    """Hash a variable with its search path, because a simulation may use the same name."""
    where = sorted(f"{k}={v}" for k, v in os.environ.items() if k.endswith(SEARCH_VARIABLES))
    said = "\n".join([variable.rpartition("://")[2], *where])
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def read_journal(path: str | PathLike[str]) -> Journal:
    """Read a journal.

    Raises
    ------
    InputError
        If the file is not a valid journal.

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
            _require(0 < len(before) == len(named_once))
        _require(all(is_number(time) and time > 0 for time in times))
        return Journal(Path(path), str(found["machine"]), before, *times)
    except (KeyError, TypeError, ValueError):
        expected = "it as the scan wrote it; put back by hand what can be read of it"
        raise InputError("a journal that was changed or cut", expected, path=path) from None


def _magnet(table: dict[str, object]) -> tuple[Magnet, float]:
    """Read a magnet and its setting with the checks of a machine file.

    An infinite tolerance, for example, would accept any read-back as restored.
    """
    setting = table.pop("setting")
    table["degauss"] = tuple(table["degauss"])
    field_names = {field.name for field in fields(Magnet)}
    m = Magnet(**{name: value for name, value in table.items() if name in field_names})
    numbers = (setting, m.low, m.high, m.tolerance, m.settle, m.timeout, m.approach_by)
    _require(all(isinstance(word, str) and word for word in (m.name, m.set, m.read, m.unit)))
    _require(all(map(is_number, numbers)) and m.approach in APPROACHES)
    _require(0 < m.tolerance < 0.1 * (m.high - m.low) and m.settle >= 0 and m.timeout > 0)
    _require(m.low <= setting <= m.high)
    return m, float(setting)


def _require(holds: bool) -> None:
    if not holds:
        raise ValueError


def journal_of(machine: ScanMachine, path: str | None) -> Path:
    """Return the path of the journal; by default next to the machine file."""
    return Path(path or Path(machine.path).with_suffix(".journal")).absolute()


def settings_words(before: Iterable[tuple[Magnet, float]]) -> str:
    """Write magnets and their settings as text.

    Examples
    --------
    >>> settings_words([(Magnet("Q", "Q:SET", "Q:READ", "T_per_m", -1.0, 1.0, 0.01, 0.1), 0.5)])
    'Q 0.5 T_per_m'
    """
    return ", ".join(f"{magnet.name} {value:.6g} {magnet.unit}" for magnet, value in before)


class NotRestoredError(InputError):
    """Error of a magnet that was not restored, or whose read-back does not confirm it."""


async def reach(
    magnet: Magnet, device: Device, value: float, present: float | None = None
) -> float:
    """Move a magnet to a setting, approaching from the requested side.

    Parameters
    ----------
    magnet : Magnet
        Its limits and the side.
    device : Device
        Device of the magnet.
    value : float
        The setting, in the unit of the magnet.
    present : float, optional
        The present setting; read if None. With NaN the approach is always made.

    Returns
    -------
    float
        The read-back.

    Raises
    ------
    InputError
        If the setting is outside the limits (then nothing is written), or is not reached.
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
    """Restore every magnet of a journal, verify the read-backs, and remove the journal.

    Parameters
    ----------
    journal : Journal
        Settings to restore.
    magnets : mapping of str to Device
        Devices by name.

    Raises
    ------
    NotRestoredError
        If a magnet is not restored. All others are, and the journal stays.
    """
    until = time.monotonic() + journal.patience
    errors = await asyncio.gather(  # in parallel: no magnet waits for the IOC of another
        *(_restore_magnet(m, magnets[m.name], value, until) for m, value in journal.before)
    )
    first = next(filter(None, errors), None)
    if first is None:
        journal.done()
        return
    left = (one for one, error in zip(journal.before, errors, strict=True) if error)
    said = getattr(first, "found", plain(f"{type(first).__name__}: {first}")[:150])
    found = f"{settings_words(left)} not seen to be restored ({said})"
    expected = f"beamfit scan --recover {journal.path}, or by hand"
    with suppress(InputError, OSError):  # the journal may have been removed
        journal.write()
    raise NotRestoredError(found, expected)


async def _restore_magnet(
    magnet: Magnet, device: Device, value: float, until: float
) -> Exception | None:
    """Restore a magnet with retries; return the last error if that fails."""
    unsettled = 0
    while True:
        try:
            return await _put_back(magnet, device, value)
        except Exception as error:  # any error, also of a library, may be temporary
            unsettled += isinstance(error, NotSettledError)
            if unsettled >= MAX_ATTEMPTS or time.monotonic() > until:
                return error
        await asyncio.sleep(RETRY_INTERVAL)


async def _put_back(magnet: Magnet, device: Device, value: float) -> None:
    """Restore a magnet, also if its set point is undefined after a restart of the IOC."""
    present = math.nan
    with suppress(Exception):
        present = await device.get()
    await reach(magnet, device, value, present)


@contextmanager
def ended_by_signals(task: asyncio.Future, tell: Callable[[str], None]) -> Iterator[list[int]]:
    """Cancel a task at the first signal; further ones only print that magnets are being restored.

    Outside the main thread no handlers are installed.
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
