"""Seconds that a command has worked for, on a terminal whose reader waits."""

from __future__ import annotations

import sys
import time
from threading import Event, Thread

import click

# Seconds after which a reader wonders if anything goes on, and between two looks at the clock.
QUIET, EVERY = 3.0, 0.5


class Waiting:
    """A line on standard error that counts seconds, until `end`; none where nobody looks.

    A step of JAX or a search tells no share of its work: what can be told honestly is the time.
    """

    def __init__(self, name: str) -> None:
        self.name, self.over, self.thread = name, Event(), None
        if sys.stderr is not None and sys.stderr.isatty():
            self.thread = Thread(target=self._count, daemon=True)
            self.thread.start()

    def _count(self) -> None:
        began, shown = time.monotonic(), False
        while not self.over.wait(EVERY):
            if (seconds := time.monotonic() - began) > QUIET:
                click.echo(f"\r{self.name}: {seconds:.0f} s ...\033[K", err=True, nl=False)
                shown = True
        if shown:
            click.echo("\r\033[K", err=True, nl=False)

    def end(self) -> None:
        """Take the line away: an answer, an error or another progress bar comes."""
        self.over.set()
        if self.thread is not None:
            self.thread.join()


def ended() -> None:
    """End the wait of the running command, if it has one."""
    context = click.get_current_context(silent=True)
    if context is not None and isinstance(context.obj, Waiting):
        context.obj.end()
