"""Variables of a control system, read and written through EPICS (CA or PVA).

aioca provides Channel Access, p4p PV Access; both come with ``beamfit[live]`` and are imported by
the first channel that needs them. Addresses and ports come from the environment variables of EPICS
(EPICS_CA_ADDR_LIST, EPICS_PVA_ADDR_LIST, ...).
"""

from __future__ import annotations

import asyncio
import math
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from beamfit.errors import InputError, plain

T = TypeVar("T")
# Severity from which a reading is invalid: INVALID_ALARM of EPICS.
INVALID = 3
# Largest number of queued readings of a variable; then the oldest is dropped.
MAX_QUEUE = 100_000
# PV Access contexts by event loop.
CONTEXTS: dict[asyncio.AbstractEventLoop, Any] = {}


class PvReading(NamedTuple):
    """Reading of a variable.

    Attributes
    ----------
    value : float or array
        A number, NaN if the variable has none; an array for a waveform.
    time : float
        Time stamp of the control system, Unix time in s.
    severity : int
        Severity of its alarm: 0 none, 1 minor, 2 major, 3 invalid.
    """

    value: Any
    time: float
    severity: int = 0

    @property
    def good(self) -> bool:
        """True for finite values without an INVALID alarm."""
        return self.severity < INVALID and bool(np.all(np.isfinite(self.value)))


class Described(NamedTuple):
    """Unit of a variable in the control system, and its control limits (infinite if none)."""

    unit: str = ""
    low: float = -math.inf
    high: float = math.inf


class LostError(InputError):
    """Error of a variable that does not answer, or refuses a value."""


class SilentError(LostError):
    """Error of a variable that does not answer in time."""


class Channel(Protocol):
    """Variable that can be read, written and monitored."""

    name: str

    async def get(self) -> PvReading:
        """Read the variable."""

    async def put(self, value: float) -> None:
        """Write the variable, and return when the control system reports completion."""

    async def describe(self) -> Described:
        """Return unit and limits."""

    def monitor(self) -> AsyncIterator[PvReading | None]:
        """Yield each reading as it arrives, and None when the connection is lost."""


def open_channel(name: str, timeout: float = 5.0) -> Channel:
    """Open a variable by name; ``pva://NAME`` uses PV Access, other names Channel Access.

    Parameters
    ----------
    name : str
        Name of the process variable.
    timeout : float
        Longest time to an answer, s.

    Returns
    -------
    Channel
        It connects on first use.

    Raises
    ------
    InputError
        If the packages of EPICS are not installed.

    Examples
    --------
    >>> open_channel("pva://SR:CURRENT").name
    'SR:CURRENT'
    """
    scheme, _, rest = name.rpartition("://")
    kinds = {"": _channel_access, "ca": _channel_access, "pva": _pv_access}
    if scheme not in kinds:
        raise InputError(f"variable '{plain(name)}'", "a name, ca://NAME or pva://NAME")
    if not rest.isprintable() or not rest.strip():
        raise InputError(f"variable '{plain(name)}'", "a name of letters that can be shown")
    try:
        return Variable(rest, timeout, kinds[scheme]())
    except ImportError as error:
        found = f"no package {error.name}, which speaks to the control system"
        raise InputError(found, "pip install 'beamfit[live]'") from None


def run(work: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine that uses channels, then close their connections.

    Parameters
    ----------
    work : coroutine
        Coroutine to run.

    Returns
    -------
    object
        Its return value.

    Examples
    --------
    >>> async def answer():
    ...     return 42
    >>> run(answer())
    42
    """

    async def closed_after() -> T:
        try:
            return await work
        finally:
            _close_connections()

    with _hide_library_output():
        return asyncio.run(closed_after())


@contextmanager
def _hide_library_output() -> Iterator[None]:
    """Redirect file descriptor 2, where the EPICS libraries print, but keep `sys.stderr`."""
    before, saved = sys.stderr, os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with open(os.dup(saved), "w", 1, "utf-8", "backslashreplace") as screen:
        with suppress(AttributeError, OSError, ValueError):  # keep a replaced stream
            if before.fileno() == 2:
                before.flush()
                sys.stderr = screen
        os.dup2(nowhere, 2)
        os.close(nowhere)
        try:
            yield
        finally:
            sys.stderr = before
            os.dup2(saved, 2)
            os.close(saved)


def _close_connections() -> None:
    """Close the connections of this event loop; aioca and p4p do not notice its end."""
    if aioca := sys.modules.get("aioca"):
        aioca.purge_channel_caches()
    if context := CONTEXTS.pop(asyncio.get_running_loop(), None):
        context.close()


class Protocols(NamedTuple):
    """Functions of a protocol to read, write, describe and monitor a variable."""

    get: Callable[[str], Awaitable[PvReading]]
    put: Callable[[str, float], Awaitable[Any]]
    describe: Callable[[str], Awaitable[Described]]
    follow: Callable[[str, Callable[[Any], None]], Any]


@dataclass(frozen=True)
class Variable:
    """Variable of EPICS, by either protocol."""

    name: str
    timeout: float
    speech: Protocols

    async def get(self) -> PvReading:
        """As `Channel.get`."""
        return await self._await_answer(self.speech.get(self.name))

    async def put(self, value: float) -> None:
        """As `Channel.put`."""
        await self._await_answer(self.speech.put(self.name, value))

    async def describe(self) -> Described:
        """As `Channel.describe`."""
        return await self._await_answer(self.speech.describe(self.name))

    async def monitor(self) -> AsyncIterator[PvReading | None]:
        """As `Channel.monitor`."""
        queue: asyncio.Queue[PvReading | None] = asyncio.Queue(MAX_QUEUE)

        subscription = self.speech.follow(self.name, lambda reading: put_latest(queue, reading))
        before = None
        try:
            while True:
                reading = await queue.get()
                # None before the first reading is no lost connection.
                if reading is not None or before is not None:
                    yield reading
                before = reading
        finally:
            subscription.close()

    async def _await_answer(self, answer: Awaitable[Any]) -> Any:
        try:
            async with asyncio.timeout(self.timeout):  # wait_for of 3.11 may lose a cancel
                return await answer
        except TimeoutError:
            found = f"no answer from '{plain(self.name)}' within {self.timeout:g} s"
            expected = "a variable within reach; is its IOC up, and EPICS_CA_ADDR_LIST right?"
            raise SilentError(found, expected) from None
        except Exception as error:  # refused, connection lost, or a record without a value
            said = plain(str(error) or type(error).__name__)[:150]
            found = f"'{plain(self.name)}' refuses: {said}"
            raise LostError(found, "a variable that does what it is asked") from None


def put_latest(queue: asyncio.Queue[T], one: T) -> None:
    """Put an item into a queue; a full queue drops its oldest item."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(one)


def _reading(found: Any) -> PvReading:
    """Convert a reading of a library; values that are not numbers become NaN."""
    value: Any = math.nan
    with suppress(TypeError, ValueError):
        value = np.asarray(found, float)
        value = value if value.ndim else float(value)
    return PvReading(value, float(found.timestamp), int(found.severity))


def _described(unit: object, low: float, high: float) -> Described:
    """Make unit and limits; equal limits mean none, as in EPICS."""
    low, high = (float(low), float(high)) if low < high else (-math.inf, math.inf)
    return Described(str(unit or "").strip(), low, high)


@lru_cache(maxsize=1)
def _channel_access() -> Protocols:
    import aioca

    async def get(name: str) -> PvReading:
        return _reading(await aioca.caget(name, format=aioca.FORMAT_TIME, timeout=None))

    async def describe(name: str) -> Described:
        found = await aioca.caget(name, format=aioca.FORMAT_CTRL, timeout=None)
        ends = (getattr(found, f"{end}_ctrl_limit", 0.0) for end in ("lower", "upper"))
        return _described(getattr(found, "units", ""), *ends)

    def follow(name: str, come: Callable[[PvReading | None], None]) -> Any:
        return aioca.camonitor(
            name, lambda found: come(_reading(found) if found.ok else None),
            format=aioca.FORMAT_TIME, notify_disconnect=True, all_updates=True,
        )  # fmt: skip

    def put(name: str, value: float) -> Awaitable[Any]:
        return aioca.caput(name, value, wait=True, timeout=None)

    return Protocols(get, put, describe, follow)


@lru_cache(maxsize=1)
def _pv_access() -> Protocols:
    from p4p.client.asyncio import Context

    def here() -> Context:
        loop = asyncio.get_running_loop()
        return CONTEXTS.get(loop) or CONTEXTS.setdefault(loop, Context("pva"))

    async def get(name: str) -> PvReading:
        return _reading(await here().get(name))

    async def describe(name: str) -> Described:
        found = (await here().get(name)).raw
        ends = (found.get(f"control.limit{end}", 0.0) for end in ("Low", "High"))
        return _described(found.get("display.units", ""), *ends)

    def follow(name: str, come: Callable[[PvReading | None], None]) -> Any:
        async def arrived(found: Any) -> None:
            come(None if isinstance(found, Exception) else _reading(found))

        return here().monitor(name, arrived, notify_disconnect=True)

    def put(name: str, value: float) -> Awaitable[Any]:
        return here().put(name, value, wait=True, get=False)

    return Protocols(get, put, describe, follow)
