"""A progress bar on standard error: effective samples, acceptance, time to go."""

from __future__ import annotations

from types import TracebackType

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from beamfit.sampling.convergence import Diagnostics
from beamfit.sampling.store import Checkpoint

__all__ = ["Watch"]


class Watch:
    """Shows how far a run is; does nothing where nobody asked.

    Parameters
    ----------
    shown : bool
        Whether to show anything.
    target_ess : float
        Effective samples at which the run ends.
    before : int
        Steps that were there already.
    """

    def __init__(self, shown: bool, target_ess: float, before: int) -> None:
        self.target_ess, self.rate = target_ess, 0.0
        self.bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[said]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
            disable=not shown,
        )
        self.task = self.bar.add_task("warming up", total=None, said=f"{before} steps")

    def __enter__(self) -> Watch:
        self.bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.bar.stop()

    def show(self, state: Checkpoint, found: Diagnostics | None) -> None:
        """Show a chain; `found` is the latest judgement, if there is a new one."""
        steps = len(state.chain)
        kept = steps - state.began
        if found is not None:
            # Effective samples a step: what the time to go is estimated from.
            self.rate = float(np.min(found.effective)) / max(found.steps, 1)
        since = state.accepted - state.accepted_before
        taken = float(np.mean(since if kept else state.accepted)) / (kept or steps)
        said = f"{steps} steps, {100 * taken:.0f} % accepted"
        if not state.producing:
            self.bar.update(self.task, said=said)
            return
        reached = min(self.rate * kept, self.target_ess)
        total = self.target_ess if self.rate else None
        said += f", {reached:.0f} of {self.target_ess:.0f} effective draws" if self.rate else ""
        self.bar.update(
            self.task, description="sampling", completed=reached, total=total, said=said
        )
