"""Reports of processes: identified responses, fed-batch processes and feeds, control loops."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.answer import Table
from beamfit.dynamics.answer import Curve
from beamfit.dynamics.control import Loop
from beamfit.dynamics.fedbatch import FedBatchFit
from beamfit.dynamics.feed import FeedCourse, FeedPlan
from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.record import Run
from beamfit.dynamics.state_fit import StatesFit, StateSpaceOutput
from beamfit.quantity import HOUR
from beamfit.report.document import BLUE, RED, Picture, ReportPage, Verdict, day_of

RESPONSE = (
    "Errors are one standard deviation. The model runs free from the start of each run: measured "
    "outputs enter through their residuals only. Bands are one standard deviation; where they are "
    "missing the data put none on the curve, or were never there.",
)
# Largest number of points drawn of a run, and of runs drawn.
MAX_POINTS = 4000
MAX_RUNS = 6


def response_page(fits: Sequence[ResponseFit | StatesFit]) -> ReportPage:
    """Make the page of the responses of some outputs."""
    runs = fits[0].runs
    return ReportPage(
        title=f"Response of {', '.join(fit.output for fit in fits)}",
        subtitle=f"identified from {', '.join(run.name for run in runs)}",
        verdicts=[Verdict.of(fit) for fit in fits],
        tables=[table for fit in fits for table in _tables(fit)],
        pictures=[picture for fit in fits for part in fit.parts for picture in _pictures(part)],
        pictures_title="Runs and residuals",
        notes=RESPONSE,
        **about_runs(runs),
    )


def _tables(fit: ResponseFit | StatesFit) -> list[Table]:
    """Return the tables of a fit, with the range of each parameter curve added to the first."""
    first, *others = fit.tables()
    ranges = []
    for curve in (c for part in fit.parts for c in part.curves if c.visited.any()):
        visited = curve.value[curve.visited]
        words = f"{visited.min():.4g} to {visited.max():.4g} {curve.unit}, by {curve.input}"
        ranges.append([curve.parameter, words])
    return [first._replace(rows=[*ranges, *first.rows]), *others]


def source_of(run: Run, fit: ResponseFit | StateSpaceOutput) -> str:
    """Return file, day and quality of a fitted run."""
    parts = [run.name, day_of(run.name, run.provenance)]
    parts.append(f"free run explains {fit.checks.free_run_percent:.4g} %")
    return ", ".join(part for part in parts if part)


def unitless(name: str) -> str:
    """Label a column whose unit the file does not give."""
    return f"{name}, as in the file"


def about_runs(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the inputs of a page on some runs, and the remarks on them."""
    return {
        "inputs": {run.path or run.name: run.sha256 or None for run in runs},
        "remarks": [(f"said in {run.name}", line) for run in runs for line in run.provenance],
    }


def _pictures(fit: ResponseFit | StateSpaceOutput) -> list[Picture]:
    runs = range(min(len(fit.runs), MAX_RUNS))
    found = [
        Picture(f"{fit.output} measured and simulated in {fit.runs[i].name}", 4.2,
                partial(_draw_run, fit, i), source_of(fit.runs[i], fit))
        for i in runs
    ]  # fmt: skip
    every = ", ".join(run.name for run in fit.runs)
    words = f"Correlations of the residuals of {fit.output}"
    last = Picture(words, 2.8, partial(_draw_correlations, fit), every)
    return [*found, *_curves(fit, "against", f"{fit.output} in {every}"), last]


def _curves(
    fit: ResponseFit | StateSpaceOutput | FedBatchFit, by: str, source: str
) -> list[Picture]:
    """Make the picture of each parameter curve."""
    return [
        Picture(f"{c.parameter} {by} {c.input} with its band", 2.8, partial(draw_curve, c), source)
        for c in fit.curves
    ]


def _draw_run(fit: ResponseFit | StateSpaceOutput, i: int, figure: FigureBase) -> None:
    """Draw measured and simulated output, their difference, and the inputs."""
    run, time, y = fit.runs[i], fit.seen.time[i], fit.seen.measured[i]
    simulated = fit.fitted[i]
    thin = slice(None, None, max(1, len(time) // MAX_POINTS))
    above, middle, below = figure.subplots(3, 1, sharex=True, height_ratios=(3, 1, 1))
    above.plot(time[thin], y[thin], ".", color="0.6", markersize=3, label="measured")
    above.plot(time[thin], simulated[thin], color=BLUE, label="simulated")
    above.set(title=f"{fit.output}: measured and simulated", ylabel=unitless(fit.output))
    above.legend(frameon=False, loc="upper right", fontsize=8, ncols=2)
    above.margins(y=0.2)
    middle.plot(time[thin], (y - simulated)[thin], ".", color=RED, markersize=2)
    middle.axhline(0.0, color="0.7", linewidth=0.8)
    middle.set_ylabel("residual")
    for name, values in run.inputs.items():
        style = "default" if name in fit.checks.way.moving else "steps-post"
        since = run.time[thin] - run.time[0]
        below.plot(since, values[thin], drawstyle=style, label=name)
    names = list(run.inputs)
    below.set(xlabel="time, s", ylabel="inputs" if len(names) > 1 else names[0])
    if len(names) > 1:
        below.legend(frameon=False, fontsize=8, ncols=len(names))
    figure.align_ylabels()


def draw_curve(c: Curve, figure: FigureBase) -> None:
    """Draw a parameter against the operating point, dashed outside the visited range."""
    axes = figure.subplots()
    has_band = c.visited & np.isfinite(c.error)
    axes.plot(c.at, c.value, "--", color="0.6", linewidth=1)
    axes.plot(c.at, np.where(c.visited, c.value, np.nan), color=BLUE)
    low, high = (np.where(has_band, c.value + s * c.error, np.nan) for s in (-1, 1))
    axes.fill_between(c.at, low, high, color=BLUE, alpha=0.25, linewidth=0)
    axes.set(title=f"{c.parameter} by {c.input}", xlabel=unitless(c.input))
    axes.set_ylabel(f"{c.parameter}, {c.unit}")
    if c.visited.any():  # limit the axis to the band in the visited range
        inside = np.concatenate([low[has_band], high[has_band], c.value[c.visited]])
        edge = 0.15 * max(float(np.ptp(inside)), 1e-12)
        axes.set_ylim(inside.min() - edge, inside.max() + edge)


def _draw_correlations(fit: ResponseFit | StateSpaceOutput, figure: FigureBase) -> None:
    """Draw correlations of residuals with themselves and with past inputs, with a 99 % band."""
    own, others = figure.subplots(1, 2)
    rest = [y - s for y, s in zip(fit.seen.measured, fit.fitted, strict=True)]
    count, lags = sum(map(len, rest)), np.arange(1, 21)
    limit = 2.58 / np.sqrt(count)
    squares = sum(float(r @ r) for r in rest)
    own.bar(lags, [sum(float(r[k:] @ r[:-k]) for r in rest) / squares for k in lags], color=BLUE)
    for j, name in enumerate(fit.seen.inputs):
        u = [(np.asarray(d.u)[d.read, j] - fit.seen.mean_u[j]) for d in fit.seen.runs]
        size = np.sqrt(squares * sum(float(v @ v) for v in u)) or 1.0
        found = [sum(float(r[k:] @ v[:-k]) for r, v in zip(rest, u, strict=True)) for k in lags]
        others.plot(lags, np.array(found) / size, "o-", markersize=3, label=name)
    for axes, what in ((own, "with themselves"), (others, "with past inputs")):
        axes.axhspan(-limit, limit, color="0.9", zorder=0)
        axes.set(title=f"Residuals {what}", xlabel="samples later")
    if len(fit.seen.inputs) > 1:
        others.legend(frameon=False, fontsize=8)


BATCHES = (
    "Errors and bands are one standard deviation. The balances run free from the start of each "
    "batch; the noise of each output is taken from its residuals.",
)
UNITS = {"biomass": "g/L", "substrate": "g/L", "volume": "L", "titre": "g/L"}


def fedbatch_page(rates: FedBatchFit) -> ReportPage:
    """Make the page of batches and rates."""
    pictures = [
        Picture(
            f"Measured and predicted in {run.name}", 6.8, partial(draw_batch, rates, i), run.name
        )
        for i, run in enumerate(rates.runs)
    ]
    every = ", ".join(run.name for run in rates.runs)
    pictures += _curves(rates, "by", every)
    return ReportPage(
        title="Fed-batch process",
        subtitle=f"identified from {every}",
        verdicts=[Verdict.of(rates)],
        tables=list(rates.tables()),
        pictures=pictures,
        pictures_title="Batches and rates",
        notes=BATCHES,
        **about_runs(rates.runs),
    )


def feed_page(plan: FeedPlan) -> ReportPage:
    """Make the page of a planned feed."""
    return ReportPage(
        title="Feed profile",
        subtitle="planned on the identified process",
        verdicts=[Verdict.of(plan)],
        tables=list(plan.tables()),
        pictures=[Picture("What comes of it", 6.8, partial(draw_course, plan.course))],
        pictures_title="The plan",
        notes=BATCHES,
    )


def draw_batch(fit: FedBatchFit, i: int, figure: FigureBase) -> None:
    """Draw measured and predicted outputs of a batch, and its inputs below."""
    run, names = fit.runs[i], list(fit.noise)
    hours = (run.time - run.time[0]) / HOUR
    axes = figure.subplots(len(names) + 1, 1, sharex=True)
    for axis, name, predicted in zip(axes, names, fit.courses[i].T, strict=False):
        axis.plot(hours, run.outputs[name], ".", color="0.6", markersize=4, label="measured")
        axis.plot(hours, predicted, color=BLUE, label="predicted")
        axis.set_ylabel(f"{name}, {UNITS[name]}")
    axes[0].legend(frameon=False, fontsize=8)
    axes[0].set_title(run.name)
    for name, values in run.inputs.items():
        if np.ptp(values) > 0:
            axes[-1].step(hours, values, where="post", label=name)
    axes[-1].legend(frameon=False, fontsize=8)
    axes[-1].set(xlabel="time, h", ylabel="inputs")
    figure.align_ylabels(axes)


def draw_course(course: FeedCourse, figure: FigureBase) -> None:
    """Draw the predicted course of a feed profile, with error bands, and the feed below."""
    axes = figure.subplots(len(course.value) + 1, 1, sharex=True)
    for axis, (name, value) in zip(axes, course.value.items(), strict=False):
        axis.plot(course.time, value, color=BLUE)
        error = course.error[name]
        axis.fill_between(course.time, value - error, value + error, color=BLUE, alpha=0.25, lw=0)
        axis.set_ylabel(f"{name}, {UNITS[name]}")
    axes[-1].step(course.time, course.feed, where="post", color=RED)
    axes[-1].set(xlabel="time, h", ylabel="feed, L/h")
    figure.align_ylabels(axes)


DISTURBANCE_COLOUR = "#7b4fa3"

SIMULATED = (
    "SIMULATED: the process is the fitted model, with the noise of its residuals. Limits of inputs "
    "and of their rates hold by construction; those of outputs are held off by two standard "
    "deviations of noise and model, and are passed only where no inputs keep them.",
)


def control_page(loop: Loop) -> ReportPage:
    """Make the page of a control loop."""
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
        notes=SIMULATED,
        **about_runs(runs),
    )


def _draw(loop: Loop, figure: FigureBase) -> None:
    """Draw each output and each input with its limits."""
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
            row.axvline(change.time, color=DISTURBANCE_COLOUR, linewidth=1, linestyle=":",
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
