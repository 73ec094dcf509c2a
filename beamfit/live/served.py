"""Results of a watch as read-only variables of the control system, by PV Access."""

from __future__ import annotations

import math
import os
from asyncio import gather
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from beamfit.answer import cell
from beamfit.errors import InputError, plain
from beamfit.live.channel import LostError, open_channel
from beamfit.live.watch import WatchView

# Severities of EPICS.
NONE, MINOR, MAJOR, INVALID = range(4)
NUMBERS = {
    "LIFETIME": ("lifetime", "h"), "A": ("a", "1/(mA s)"), "B": ("b", "1/s"),
    "NORMALISED": ("normalised", "mA h"),
}  # fmt: skip
TEXTS = ("STATUS", "MESSAGE", "ALARM", "ALARM:TEXT")
PLAIN = {"CURRENT": "mA", "SINCE": "s", "AGE": "s", "READINGS": ""}
UNITS = {
    n + part: u for n, (_, u) in NUMBERS.items() for part in ("", ":ERROR", ":LOW", ":HIGH")
} | PLAIN
# Within which somebody else who serves a variable answers, s.
ANSWERED = 1.0


def values_of(told: WatchView) -> dict[str, tuple[Any, int]]:
    """The value and the severity of each variable; NaN of what the readings do not determine.

    Parameters
    ----------
    told : WatchView
        What is known.

    Returns
    -------
    dict of str to (value, int)
        Names without the prefix.
    """
    state, answer = told.state, told.state.answer
    old = NONE if told.sound and not told.lost else INVALID
    found: dict[str, tuple[Any, int]] = {}
    for name, (quantity, _) in NUMBERS.items():
        known = getattr(answer, quantity, None)
        low, high = (known and known.interval_95) or (math.nan, math.nan)
        parts = {
            "": known.value if known else math.nan, ":ERROR": known.error if known else math.nan,
            ":LOW": low, ":HIGH": high,
        }  # fmt: skip
        severity = old if known else INVALID
        found |= {name + part: (value, severity) for part, value in parts.items()}
    moved = max(MAJOR if state.alarmed else NONE, old)
    verdict = {"green": NONE, "yellow": MINOR, "red": MAJOR}[
        answer.status.colour if answer else "red"
    ]
    since = state.alarms[-1].since if state.alarms else math.nan
    current = state.rows[-1].current if state.rows else math.nan
    return found | {
        "CURRENT": (current, old if state.rows else INVALID),
        "SINCE": (since, moved if state.alarms else INVALID),
        "AGE": (math.nan if told.age is None else told.age, old),
        "READINGS": (float(state.counts.readings), old),
        "STATUS": (cell(answer.status) if answer else "", max(verdict, old)),
        "MESSAGE": (told.headline[1], max(verdict, moved)),
        "ALARM": (state.alarmed, moved),
        "ALARM:TEXT": (state.alarm_text(), moved),
    }


async def check_unserved(prefix: str) -> None:
    """See that nobody serves such variables: clients would read from one or the other.

    Raises
    ------
    InputError
        If somebody does, the machine itself it may be.
    """

    async def answering(name: str) -> str:
        with suppress(LostError):
            await open_channel(f"pva://{prefix}{name}", ANSWERED).get()
            return name
        return ""

    if found := next(filter(None, await gather(*map(answering, (*UNITS, *TEXTS)))), ""):
        expected = "another prefix in the machine file; does a watch run already?"
        raise InputError(f"'{plain(prefix + found)}', which somebody serves", expected)


@contextmanager
def served(prefix: str, address: str) -> Iterator[Callable[[WatchView], None]]:
    """Serve variables while the block lasts.

    Parameters
    ----------
    prefix : str
        Of their names.
    address : str
        Of the network interface that is listened on; 127.0.0.1 is this computer alone.

    Yields
    ------
    callable
        To be given what is known. The ports are those of EPICS_PVAS_SERVER_PORT and so on.

    Raises
    ------
    InputError
        If nobody can listen there, or p4p is not installed.
    """
    try:
        from p4p.nt import NTScalar
        from p4p.server import Server
        from p4p.server.raw import SharedPV
    except ImportError:
        raise InputError("no package p4p, which serves", "pip install 'beamfit[live]'") from None

    kinds = {name: NTScalar("d", display=True) for name in UNITS}
    kinds |= {name: NTScalar("s") for name in TEXTS}
    start = {n: {"value": math.nan, "display.units": u} for n, u in UNITS.items()}
    start |= {name: {"value": ""} for name in TEXTS}
    variables = {name: SharedPV(nt=kinds[name], initial=start[name]) for name in kinds}

    def show(told: WatchView) -> None:
        state = told.state
        time = state.last - state.shift if state.last else 0.0
        for name, (value, severity) in values_of(told).items():
            variables[name].post(value, timestamp=time, severity=severity)

    ports = {
        n: v for n, v in os.environ.items() if n.startswith("EPICS_PVA") and n.endswith("PORT")
    }
    here = {
        "EPICS_PVAS_INTF_ADDR_LIST": address, "EPICS_PVAS_BEACON_ADDR_LIST": address,
        "EPICS_PVAS_AUTO_BEACON_ADDR_LIST": "NO",
    }  # fmt: skip
    try:
        server = Server(
            [{prefix + n: pv for n, pv in variables.items()}], conf=ports | here, useenv=False
        )
    except (RuntimeError, ValueError) as error:
        found = f"variables that cannot be served on {address} ({error})"
        raise InputError(found, "an address of this computer after --bind") from None
    with server:
        yield show
