"""Results of a watch as read-only PV Access variables."""

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

# Alarm severities of EPICS.
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
# Longest time to an answer of another server of a variable, s.
ANSWER_WAIT = 1.0


def values_of(view: WatchView) -> dict[str, tuple[Any, int]]:
    """Return value and severity of each variable; NaN if the readings do not determine it.

    Parameters
    ----------
    view : WatchView
        Present view of the watch.

    Returns
    -------
    dict of str to (value, int)
        By name without the prefix.
    """
    state, answer = view.state, view.state.answer
    out_of_date = NONE if view.sound and not view.lost else INVALID
    found: dict[str, tuple[Any, int]] = {}
    for name, (quantity, _) in NUMBERS.items():
        q = getattr(answer, quantity, None)
        low, high = (q and q.interval_95) or (math.nan, math.nan)
        parts = {
            "": q.value if q else math.nan, ":ERROR": q.error if q else math.nan,
            ":LOW": low, ":HIGH": high,
        }  # fmt: skip
        severity = out_of_date if q else INVALID
        found |= {name + part: (value, severity) for part, value in parts.items()}
    moved = max(MAJOR if state.alarmed else NONE, out_of_date)
    verdict = {"green": NONE, "yellow": MINOR, "red": MAJOR}[
        answer.status.colour if answer else "red"
    ]
    since = state.alarms[-1].since if state.alarms else math.nan
    current = state.rows[-1].current if state.rows else math.nan
    return found | {
        "CURRENT": (current, out_of_date if state.rows else INVALID),
        "SINCE": (since, moved if state.alarms else INVALID),
        "AGE": (math.nan if view.age is None else view.age, out_of_date),
        "READINGS": (float(state.counts.readings), out_of_date),
        "STATUS": (cell(answer.status) if answer else "", max(verdict, out_of_date)),
        "MESSAGE": (view.headline[1], max(verdict, moved)),
        "ALARM": (state.alarmed, moved),
        "ALARM:TEXT": (state.alarm_text(), moved),
    }


async def check_unserved(prefix: str) -> None:
    """Check that nobody else serves such variables; clients would read either of them.

    Raises
    ------
    InputError
        If another server, possibly the machine itself, has one of them.
    """

    async def answering(name: str) -> str:
        with suppress(LostError):
            await open_channel(f"pva://{prefix}{name}", ANSWER_WAIT).get()
            return name
        return ""

    if found := next(filter(None, await gather(*map(answering, (*UNITS, *TEXTS)))), ""):
        expected = "another prefix in the machine file; does a watch run already?"
        raise InputError(f"'{plain(prefix + found)}', which somebody serves", expected)


@contextmanager
def served(prefix: str, address: str) -> Iterator[Callable[[WatchView], None]]:
    """Serve variables inside the context.

    Parameters
    ----------
    prefix : str
        Prefix of their names.
    address : str
        Address of the network interface to listen on; 127.0.0.1 is this computer only.

    Yields
    ------
    callable
        Function that takes the present view. The ports are those of EPICS_PVAS_SERVER_PORT etc.

    Raises
    ------
    InputError
        If the address cannot be used, or p4p is not installed.
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

    def show(view: WatchView) -> None:
        state = view.state
        time = state.last - state.shift if state.last else 0.0
        for name, (value, severity) in values_of(view).items():
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
