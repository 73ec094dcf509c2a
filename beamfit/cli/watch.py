"""`beamfit watch`: a machine in, a lifetime watched; shown, served, and nothing written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from beamfit.answer import Table, cell
from beamfit.cli.options import Command, Output, option, options
from beamfit.commands import watch_plan
from beamfit.errors import plain
from beamfit.io.files import digest
from beamfit.io.machine import WatchMachine, read_watch_machine

if TYPE_CHECKING:
    from beamfit.live.watch import WatchView

EXAMPLE = """\b
Examples:
  beamfit watch ring.toml
  beamfit watch ring.toml --seconds 3600 --json
  beamfit watch ring.toml --bind 0.0.0.0 --port 8050
"""


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("machine")
@option("--seconds", "Duration; default: until Ctrl-C.", type=click.FloatRange(0.0))
@option(
    "--port", "Of the page; 0 for any that is free.", type=click.IntRange(0, 65535), default=8050
)
@option(
    "--bind ADDRESS",
    "Address to listen on; beyond this computer anybody there can read the page and the "
    "served variables.",
    default="127.0.0.1",
)
@options("json")
def watch(machine: str, seconds: float | None, port: int, bind: str, output: Output) -> int:
    """Watch the lifetime of a stored beam: how long, a and b, what moved and since when.

    MACHINE is a TOML file (docs/live.md) that names the variables of the ring: its current, and
    optionally RF voltage, pressure, bunches, scraper and bunch length. Nothing is written to it.
    The answer is shown here, on a page (--port), and served by PV Access. Needs beamfit[live].
    """
    told = read_watch_machine(machine)

    from beamfit.live.channel import run

    last, number = run(_watched(told, seconds, bind, port, output.as_json))
    inputs = {str(path): digest(path) for path in (told.path, told.ring) if path is not None}
    output.answer(_results(last), inputs, lambda terminal: terminal.table(_table(last)))
    if number:
        click.echo("beamfit: interrupted", err=True)
    return 128 + number if number else 0


async def _watched(
    machine: WatchMachine, seconds: float | None, bind: str, port: int, quiet: bool
) -> tuple[WatchView, int]:
    """See that the variables answer, serve, and watch."""
    from beamfit.live.page import page
    from beamfit.live.served import check_unserved, served
    from beamfit.live.watch import connect, watch

    plan = watch_plan(machine)
    say: Callable[[str], None] = lambda text: click.echo(plain(text), err=True)  # noqa: E731
    for note in await connect(machine):
        say(f"Note: {note}.")
    if machine.prefix is not None:
        await check_unserved(machine.prefix)
    async with AsyncExitStack() as stack:
        where, tell = await stack.enter_async_context(page(bind, port))
        sinks = [tell]
        say(f"{machine.name}: {where}; Ctrl-C ends it. Nothing is written to the machine.")
        if machine.prefix is not None:
            sinks.append(stack.enter_context(served(machine.prefix, bind)))
        if not quiet:
            sinks.append(stack.enter_context(_terminal()))
        return await watch(machine, plan, lambda told: [sink(told) for sink in sinks], seconds)


@contextmanager
def _terminal() -> Iterator[Callable[[WatchView], None]]:
    """A table that lives, or where nobody looks a line for every fit."""
    from rich.live import Live

    from beamfit.cli.show import Terminal, laid_out

    terminal, seen = Terminal(), [0.0]
    if terminal.console.is_terminal:
        with Live(console=terminal.console, auto_refresh=False, transient=True) as live:
            yield lambda told: live.update(laid_out(_table(told)), refresh=True)
        return

    def line(told: WatchView) -> None:
        answer = told.state.answer
        if answer is not None and answer.time != seen[0]:
            seen[0] = answer.time
            terminal.line(f"{_clock(answer.time)}  {cell(answer.lifetime)}  {told.headline[1]}")

    yield line


def _clock(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _table(told: WatchView) -> Table:
    """Present state of the watch, a line for each quantity."""
    state, answer = told.state, told.state.answer
    fit = answer and answer.window.fit
    counts = state.counts
    left_out = (
        f"{counts.readings}; left out {counts.bad} without a number, {counts.late} late or "
        f"repeated; {counts.gaps} gaps, {counts.clock} times the clock was set back"
    )
    rows = [
        ("now", told.headline[1]),
        ("last reading", f"{_clock(state.last - state.shift)} UTC" if state.last else "-"),
        ("newest fitted", "-" if told.age is None else f"{told.age:.0f} s ago"),
        ("current", f"{state.rows[-1].current:.6g} mA" if state.rows else "-"),
        ("lifetime", cell(answer and answer.lifetime)),
        ("at", f"{fit.mean_current:.4g} mA, the mean of the window" if fit else "-"),
        *((name, cell(answer and getattr(answer, name))) for name in ("a", "b", "normalised")),
        ("fit", answer.message if answer else "-"),
        ("alarm", state.alarm_text()),
        ("readings", left_out),
    ]
    return Table(told.plan.name, [], rows)


def _results(told: WatchView) -> list[dict[str, Any]]:
    """Results in the form of `beamfit lifetime --json`, with alarms and counts."""
    from beamfit.lifetime.watch import empty_answer

    state = told.state
    answer = state.answer or empty_answer(state)
    more = {"alarm": {"moved": state.alarmed, "text": state.alarm_text()}, "alarms": state.alarms}
    more |= {"events": state.events, "counts": state.counts, "lost": told.lost}
    return [{"record": told.plan.name} | answer.to_json() | more]
