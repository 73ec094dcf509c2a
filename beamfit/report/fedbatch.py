"""The report of a fed-batch process: batches, rates, titre and planned feed (figs 31 to 36)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.dynamics.fedbatch import FedBatchFit, Ranked
from beamfit.dynamics.feed import FeedCourse, FeedPlan
from beamfit.report.document import BLUE, RED, Picture, ReportPage, Verdict
from beamfit.report.response import about_runs, draw_curve

NOTES = (
    "Errors and bands are one standard deviation. The balances run free from the start of each "
    "batch; the noise of each output is taken from its residuals.",
)
UNITS = {"biomass": "g/L", "substrate": "g/L", "volume": "L", "titre": "g/L"}


def fedbatch_page(rates: FedBatchFit) -> ReportPage:
    """Lay out batches and rates."""
    pictures = [
        Picture(
            f"Measured and predicted in {run.name}", 6.8, partial(draw_batch, rates, i), run.name
        )
        for i, run in enumerate(rates.runs)
    ]
    pictures += [
        Picture(
            f"{c.parameter} by {c.input} with its band",
            2.8,
            partial(draw_curve, rates, j),
            ", ".join(run.name for run in rates.runs),
        )
        for j, c in enumerate(rates.curves)
    ]
    return ReportPage(
        title="Fed-batch process",
        subtitle=f"identified from {', '.join(run.name for run in rates.runs)}",
        verdicts=[Verdict.of(rates)],
        tables=list(rates.tables()),
        pictures=pictures,
        pictures_title="Batches and rates",
        notes=NOTES,
        **about_runs(rates.runs),
    )


def feed_page(plan: FeedPlan) -> ReportPage:
    """Lay out a planned feed."""
    return ReportPage(
        title="Feed profile",
        subtitle="planned on the identified process",
        verdicts=[Verdict.of(plan)],
        tables=list(plan.tables()),
        pictures=[Picture("What comes of it", 6.8, partial(draw_course, plan.course))],
        pictures_title="The plan",
        notes=NOTES,
    )


def draw_batch(fit: FedBatchFit, i: int, figure: FigureBase) -> None:
    """Measured and predicted outputs of a batch, and its inputs below."""
    run, names = fit.runs[i], list(fit.noise)
    hours = (run.time - run.time[0]) / 3600.0
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


def draw_ranking(ranked: Sequence[Ranked], figure: FigureBase) -> None:
    """Draw the nonlinear correlation of an output with each input."""
    axes = figure.subplots()
    order = list(reversed(ranked))
    axes.barh([each.name for each in order], [each.correlation for each in order], color=BLUE)
    axes.set_xlabel("nonlinear correlation, sqrt(1 - exp(-2 I))")
