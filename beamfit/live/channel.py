"""A variable of a control system: what it reads, and writing to it. EPICS, by CA or PVA.

Channel Access is spoken by aioca, PV Access by p4p; both come with ``beamfit[live]`` and are
imported by the first channel that needs them. Addresses and ports are those of EPICS's own
environment variables (EPICS_CA_ADDR_LIST, EPICS_PVA_ADDR_LIST, ...).
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
# From this severity on a reading is none: EPICS's INVALID_ALARM.
INVALID = 3
# Readings of a variable that wait to be taken; the oldest is dropped for the next.
WAITING = 100_000
# Connections by PV Access of each event loop.
CONTEXTS: dict[asyncio.AbstractEventLoop, Any] = {}


class PvReading(NamedTuple):
    """Reading of a variable.

    Attributes
    ----------
    value : float or array
        A number, NaN where the variable has none; an array of those of a waveform.
    time : float
        The time stamp of the control system, Unix time in s.
    severity : int
        Of its alarm: 0 none, 1 minor, 2 major, 3 invalid.
    """

    value: Any
    time: float
    severity: int = 0

    @property
    def good(self) -> bool:
        """Tell a finite number (or some) that the control system vouches for."""
        return self.severity < INVALID and bool(np.all(np.isfinite(self.value)))


class Described(NamedTuple):
    """The unit of a variable as the control system names it, and the limits of writing to it.

    Limits are infinite where it has none.
    """

    unit: str = ""
    low: float = -math.inf
    high: float = math.inf


class LostError(InputError):
    """A variable that does not answer, or refuses what is written to it."""


class SilentError(LostError):
    """A variable that does not answer in time."""


class Channel(Protocol):
    """A variable that can be read, written and followed."""

    name: str

    async def get(self) -> PvReading:
        """Read it."""

    async def put(self, value: float) -> None:
        """Write it, and return when the control system says that it is done."""

    async def describe(self) -> Described:
        """Ask for its unit and limits."""

    def monitor(self) -> AsyncIterator[PvReading | None]:
        """Each reading as it comes; None where the connection was lost."""


def open_channel(name: str, timeout: float = 5.0) -> Channel:
    """Open a variable by its name; ``pva://NAME`` is asked by PV Access, others by Channel Access.

    Parameters
    ----------
    name : str
        Of the process variable.
    timeout : float
        Time within which it has to answer, s.

    Returns
    -------
    Channel
        Nothing is connected before its first use.

    Raises
    ------
    InputError
        If the packages that speak to a control system are not installed.

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
    """Run to its end what uses channels, then close their connections.

    Parameters
    ----------
    work : coroutine
        What to run.

    Returns
    -------
    object
        What it returns.

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
            _closed()

    with _own_screen():
        return asyncio.run(closed_after())


@contextmanager
def _own_screen() -> Iterator[None]:
    """Leave standard error to what Python says: EPICS's libraries print there by themselves."""
    before, kept = sys.stderr, os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with open(os.dup(kept), "w", 1, "utf-8", "backslashreplace") as screen:
        with suppress(AttributeError, OSError, ValueError):  # a stream of somebody's own stays
            if before.fileno() == 2:
                before.flush()
                sys.stderr = screen
        os.dup2(nowhere, 2)
        os.close(nowhere)
        try:
            yield
        finally:
            sys.stderr = before
            os.dup2(kept, 2)
            os.close(kept)


def _closed() -> None:
    """Close what this event loop has opened; aioca and p4p do not notice that a loop ends."""
    if aioca := sys.modules.get("aioca"):
        aioca.purge_channel_caches()
    if context := CONTEXTS.pop(asyncio.get_running_loop(), None):
        context.close()


class Protocols(NamedTuple):
    """Protocol: its calls to read, write, describe and follow a variable."""

    get: Callable[[str], Awaitable[PvReading]]
    put: Callable[[str, float], Awaitable[Any]]
    describe: Callable[[str], Awaitable[Described]]
    follow: Callable[[str, Callable[[Any], None]], Any]


@dataclass(frozen=True)
class Variable:
    """A variable of EPICS, by either protocol."""

    name: str
    timeout: float
    speech: Protocols

    async def get(self) -> PvReading:
        """As `Channel.get`."""
        return await self._asked(self.speech.get(self.name))

    async def put(self, value: float) -> None:
        """As `Channel.put`."""
        await self._asked(self.speech.put(self.name, value))

    async def describe(self) -> Described:
        """As `Channel.describe`."""
        return await self._asked(self.speech.describe(self.name))

    async def monitor(self) -> AsyncIterator[PvReading | None]:
        """As `Channel.monitor`."""
        queue: asyncio.Queue[PvReading | None] = asyncio.Queue(WAITING)

        subscription = self.speech.follow(self.name, lambda reading: kept(queue, reading))
        before = None
        try:
            while True:
                reading = await queue.get()
                # A connection that is not there yet is not lost.
                if reading is not None or before is not None:
                    yield reading
                before = reading
        finally:
            subscription.close()

    async def _asked(self, answer: Awaitable[Any]) -> Any:
        try:
            async with asyncio.timeout(self.timeout):  # wait_for of 3.11 may lose a cancel
                return await answer
        except TimeoutError:
            found = f"no answer from '{plain(self.name)}' within {self.timeout:g} s"
            expected = "a variable within reach; is its IOC up, and EPICS_CA_ADDR_LIST right?"
            raise SilentError(found, expected) from None
        except Exception as error:  # a refusal, a lost connection, a record without a value
            said = plain(str(error) or type(error).__name__)[:150]
            found = f"'{plain(self.name)}' refuses: {said}"
            raise LostError(found, "a variable that does what it is asked") from None


def kept(queue: asyncio.Queue[T], one: T) -> None:
    """Put one into a queue; where it is full, the oldest goes."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(one)


def _reading(found: Any) -> PvReading:
    """NaN for what is no number."""
    value: Any = math.nan
    with suppress(TypeError, ValueError):
        value = np.asarray(found, float)
        value = value if value.ndim else float(value)
    return PvReading(value, float(found.timestamp), int(found.severity))


def _described(unit: object, low: float, high: float) -> Described:
    """Limits that are equal, as EPICS writes where there are none, are none."""
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
