"""A progress bar on standard error: effective samples, acceptance, time to go."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from beamfit.sampling.convergence import Diagnostics
from beamfit.sampling.store import Checkpoint

__all__ = ["Watch"]


class Watch(Progress):
    """Shows how far a run is; does nothing where nobody asked.

    Parameters
    ----------
    shown : bool
        Whether to show anything.
    target_ess : float
        Effective samples at which the run ends.
    """

    def __init__(self, shown: bool, target_ess: float) -> None:
        words = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"))
        place = Console(stderr=True)
        super().__init__(
            *words, TimeRemainingColumn(), console=place, transient=True, disable=not shown
        )
        self.target_ess, self.rate = target_ess, 0.0
        self.bar = self.add_task("warming up", total=None, said="")

    def show(self, state: Checkpoint, found: Diagnostics | None) -> None:
        """Show a chain; `found` is the latest judgement, if there is a new one."""
        if self.disable:
            return
        if found is not None:
            # Effective samples a step: what the time to go is estimated from.
            self.rate = float(np.min(found.effective)) / max(found.steps, 1)
        said = f"{len(state.chain)} steps, {100 * state.acceptance:.0f} % accepted"
        reached = min(self.rate * len(state.counting), self.target_ess)
        if self.rate:
            said += f", {reached:.0f} of {self.target_ess:.0f} effective draws"
        word = "sampling" if state.producing else "warming up"
        total = self.target_ess if self.rate else None
        self.update(self.bar, description=word, completed=reached, total=total, said=said)
