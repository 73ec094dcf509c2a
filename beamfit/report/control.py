"""The report of a simulated loop."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.dynamics.control import Loop
from beamfit.report.document import BLUE, RED, Picture, ReportPage, Verdict
from beamfit.report.response import about_runs, unitless

DISTURBED = "#7b4fa3"

NOTES = (
    "SIMULATED: the process is the fitted model, with the noise of its residuals. Limits of inputs "
    "and of their rates hold by construction; those of outputs are held off by two standard "
    "deviations of noise and model, and are passed only where no inputs keep them.",
)


def control_page(loop: Loop) -> ReportPage:
    """Lay out a loop."""
    runs = loop.fits[0].runs
    tables = [*loop.tables(), *(table for fit in loop.fits for table in fit.tables()[:1])]
    return ReportPage(
        title=f"Control of {', '.join(r.name for r in loop.control.responses)}",
        subtitle=f"a loop simulated on models of {', '.join(r.name for r in runs)}",
        verdicts=[Verdict.of(each) for each in (loop, *loop.fits)],
        tables=tables,
        pictures=[
            Picture(
                "Outputs, targets and inputs of the loop",
                4.6,
                partial(_draw, loop),
                f"SIMULATED on the model of {', '.join(r.name for r in runs)}",
            )
        ],
        pictures_title="Closed loop",
        notes=NOTES,
        **about_runs(runs),
    )


def _draw(loop: Loop, figure: FigureBase) -> None:
    """A row for each output and each input, with their limits."""
    c, trace = loop.control, loop.trace
    outputs, inputs = len(c.responses), len(c.inputs)
    axes = figure.subplots(outputs + inputs, 1, sharex=True, squeeze=False,
                           height_ratios=[2] * outputs + [1] * inputs)[:, 0]  # fmt: skip
    for i, r in enumerate(c.responses):
        axes[i].plot(loop.time, trace.readings[:, i], ".", color="0.6", markersize=3, label="read")
        axes[i].plot(loop.time, trace.outputs[:, i], color=BLUE, label="output")
        axes[i].step(loop.time, loop.targets[:, i], where="post", color="0.2", linestyle="--",
                     linewidth=1, label="target")  # fmt: skip
        _limit(axes[i], c.limits.below[i], c.limits.above[i])
        axes[i].set_ylabel(unitless(r.name))
    for change in loop.changes:
        if change.disturbed:
            row = axes[[r.name for r in c.responses].index(change.output)]
            row.axvline(change.time, color=DISTURBED, linewidth=1, linestyle=":",
                        label=f"disturbed by {change.disturbed:.3g}")  # fmt: skip
    for row in axes[:outputs]:
        row.margins(y=0.25)
        row.legend(frameon=False, fontsize=8, ncols=5, loc="upper right")
    for i, name in enumerate(c.inputs):
        axes[outputs + i].step(loop.time, trace.inputs[:, i], where="post", color=BLUE)
        _limit(axes[outputs + i], c.limits.low[i], c.limits.high[i])
        axes[outputs + i].set_ylabel(name)
    axes[-1].set(xlabel="time, s")
    figure.align_ylabels()


def _limit(axes, low: float, high: float) -> None:
    label = "limit"
    for value in (low, high):
        if np.isfinite(value):
            axes.axhline(value, color=RED, linewidth=0.8, label=label)
            label = None
