"""Magnets moved to a setting from the side that is asked for, and put back whatever happens."""

from __future__ import annotations

import asyncio
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress

from beamfit.errors import InputError
from beamfit.io.machine import Magnet, moved
from beamfit.live.channel import LostError
from beamfit.live.devices import Device, NotSettledError
from beamfit.live.journal import Journal, named

# Signals that end a scan; what they find is restored.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Seconds between two attempts to reach an IOC, and attempts to settle a magnet.
PAUSE, ATTEMPTS = 0.5, 2


class NotRestoredError(InputError):
    """A magnet that could not be put back, or is not seen to be back."""


async def reach(magnet: Magnet, device: Device, value: float) -> float:
    """Move a magnet to a setting, from below or above where that is asked for.

    Parameters
    ----------
    magnet : Magnet
        Its limits and the side.
    device : Device
        What moves it.
    value : float
        The setting, in the magnet's unit.

    Returns
    -------
    float
        What is read back.

    Raises
    ------
    InputError
        If the setting is outside the limits (nothing is written then), or is not reached.
    """
    value = moved(magnet, value)
    return await _sent(magnet, device, value, await device.get())


async def _sent(magnet: Magnet, device: Device, value: float, present: float) -> float:
    """Move a magnet from a setting to another; from NaN it passes by, whichever side it is on."""
    by = magnet.approach_by
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
    until, failed = time.monotonic() + journal.patience, []
    for magnet, value in journal.before:
        if error := await _restored(magnet, magnets[magnet.name], value, until):
            failed.append((magnet, value, error))
    if not failed:
        journal.done()
        return
    settings = named((magnet, value) for magnet, value, _ in failed)
    found = f"{settings} not seen to be restored ({failed[0][2].found})"
    expected = f"beamfit scan --recover {journal.path}, or by hand"
    with suppress(InputError, OSError):  # somebody may have removed it
        journal.write()
    raise NotRestoredError(found, expected)


async def _restored(
    magnet: Magnet, device: Device, value: float, until: float
) -> InputError | None:
    attempts = 0
    while True:
        try:
            await _put_back(magnet, device, value)
            return None
        except LostError as error:
            if time.monotonic() > until:
                return error
        except NotSettledError as error:
            attempts += 1
            if attempts >= ATTEMPTS:
                return error
        except InputError as error:
            return error
        await asyncio.sleep(PAUSE)


async def _put_back(magnet: Magnet, device: Device, value: float) -> None:
    """Move a magnet back, also where its set point is undefined: an IOC may return like that."""
    present = math.nan
    with suppress(LostError):
        present = await device.get()
    await _sent(magnet, device, moved(magnet, value), present)


@contextmanager
def ended_by_signals(task: asyncio.Future, tell: Callable[[str], None]) -> Iterator[list[int]]:
    """Have the first signal cancel a task, and any more only say that all is being restored.

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
