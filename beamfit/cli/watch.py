"""`beamfit watch`: follow the lifetime of a running machine, without writing to it."""

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
    "--port", "Port of the page; 0 for any free one.", type=click.IntRange(0, 65535), default=8050
)
@option(
    "--bind ADDRESS",
    "Address to listen on; on an address other than this computer anybody can read the page and "
    "the served variables.",
    default="127.0.0.1",
)
@options("json")
def watch(machine: str, seconds: float | None, port: int, bind: str, output: Output) -> int:
    """Follow the lifetime of a stored beam: its value, a and b, and what changed since when.

    MACHINE is a TOML file (docs/live.md) that names the variables of the ring: its current, and
    optionally RF voltage, pressure, bunches, scraper and bunch length. Nothing is written to it.
    The answer is shown here, on a page (--port), and served by PV Access. Needs beamfit[live].
    """
    described = read_watch_machine(machine)

    from beamfit.live.channel import run

    last, number = run(_run_watch(described, seconds, bind, port, output.as_json))
    inputs = {
        str(path): digest(path) for path in (described.path, described.ring) if path is not None
    }
    output.answer(_results(last), inputs, lambda terminal: terminal.table(_table(last)))
    if number:
        click.echo("beamfit: interrupted", err=True)
    return 128 + number if number else 0


async def _run_watch(
    machine: WatchMachine, seconds: float | None, bind: str, port: int, quiet: bool
) -> tuple[WatchView, int]:
    """Check that the variables answer, then serve and watch."""
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
            sinks.append(stack.enter_context(_live_table()))
        return await watch(machine, plan, lambda view: [sink(view) for sink in sinks], seconds)


@contextmanager
def _live_table() -> Iterator[Callable[[WatchView], None]]:
    """Yield a function that updates a live table, or prints one line per fit without a terminal."""
    from rich.live import Live

    from beamfit.cli.show import Terminal, rich_table

    terminal, last_fit = Terminal(), [0.0]
    if terminal.console.is_terminal:
        with Live(console=terminal.console, auto_refresh=False, transient=True) as live:
            yield lambda view: live.update(rich_table(_table(view)), refresh=True)
        return

    def line(view: WatchView) -> None:
        answer = view.state.answer
        if answer is not None and answer.time != last_fit[0]:
            last_fit[0] = answer.time
            terminal.line(f"{_clock(answer.time)}  {cell(answer.lifetime)}  {view.headline[1]}")

    yield line


def _clock(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _table(view: WatchView) -> Table:
    """Make a table of the present state of the watch."""
    state, answer = view.state, view.state.answer
    fit = answer and answer.window.fit
    counts = state.counts
    left_out = (
        f"{counts.readings}; left out {counts.bad} without a number, {counts.late} late or "
        f"repeated; {counts.gaps} gaps, {counts.clock} times the clock was set back"
    )
    rows = [
        ("now", view.headline[1]),
        ("last reading", f"{_clock(state.last - state.shift)} UTC" if state.last else "-"),
        ("newest fitted", "-" if view.age is None else f"{view.age:.0f} s ago"),
        ("current", f"{state.rows[-1].current:.6g} mA" if state.rows else "-"),
        ("lifetime", cell(answer and answer.lifetime)),
        ("at", f"{fit.mean_current:.4g} mA, the mean of the window" if fit else "-"),
        *((name, cell(answer and getattr(answer, name))) for name in ("a", "b", "normalised")),
        ("fit", answer.message if answer else "-"),
        ("alarm", state.alarm_text()),
        ("readings", left_out),
    ]
    return Table(view.plan.name, [], rows)


def _results(view: WatchView) -> list[dict[str, Any]]:
    """Make results in the form of `beamfit lifetime --json`, with alarms and counts."""
    from beamfit.lifetime.watch import empty_answer

    state = view.state
    answer = state.answer or empty_answer(state)
    more = {"alarm": {"moved": state.alarmed, "text": state.alarm_text()}, "alarms": state.alarms}
    more |= {"events": state.events, "counts": state.counts, "lost": view.lost}
    return [{"record": view.plan.name} | answer.to_json() | more]
