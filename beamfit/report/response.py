"""The report of an identified response."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.record import Run
from beamfit.dynamics.state_fit import StatesFit, StateSpaceOutput
from beamfit.report.document import BLUE, RED, Picture, ReportPage, Verdict, day_of
from beamfit.table import Table

NOTES = (
    "Errors are one standard deviation. The model runs free from the start of each run: measured "
    "outputs enter through their residuals only. Bands are one standard deviation; where they are "
    "missing the data put none on the curve, or were never there.",
)
# Most points drawn of a run, and most runs drawn.
MOST, RUNS = 4000, 6


def response_page(fits: Sequence[ResponseFit | StatesFit]) -> ReportPage:
    """Lay out the responses of some outputs."""
    runs = fits[0].runs
    return ReportPage(
        title=f"Response of {', '.join(fit.output for fit in fits)}",
        subtitle=f"identified from {', '.join(run.name for run in runs)}",
        verdicts=[Verdict.of(fit) for fit in fits],
        tables=[table for fit in fits for table in _tables(fit)],
        pictures=[picture for fit in fits for part in fit.parts for picture in _pictures(part)],
        pictures_title="Measured and simulated",
        notes=NOTES,
        **about_runs(runs),
    )


def _tables(fit: ResponseFit | StatesFit) -> list[Table]:
    """Those of a fit, the range of each parameter curve in the first."""
    first, *others = fit.tables()
    ranges = []
    for curve in (c for part in fit.parts for c in part.curves if c.visited.any()):
        seen = curve.value[curve.visited]
        words = f"{seen.min():.4g} to {seen.max():.4g} {curve.unit}, by {curve.input}"
        ranges.append([curve.parameter, words])
    return [first._replace(rows=[*ranges, *first.rows]), *others]


def source_of(run: Run, fit: ResponseFit | StateSpaceOutput) -> str:
    """File, day and quality of a fitted run."""
    parts = [run.name, day_of(run.name, run.provenance)]
    parts.append(f"free run explains {fit.checks.free_run_percent:.4g} %")
    return ", ".join(part for part in parts if part)


def unitless(name: str) -> str:
    """A label of a column whose unit the file leaves open."""
    return f"{name}, as in the file"


def about_runs(runs: Sequence[Run]) -> dict[str, Any]:
    """The inputs of a page on some runs, and the remarks on them."""
    return {
        "inputs": {run.path or run.name: run.sha256 or None for run in runs},
        "remarks": [(f"said in {run.name}", line) for run in runs for line in run.provenance],
    }


def _pictures(fit: ResponseFit | StateSpaceOutput) -> list[Picture]:
    runs = range(min(len(fit.runs), RUNS))
    found = [
        Picture(f"{fit.output} measured and simulated in {fit.runs[i].name}", 4.2,
                partial(_draw_run, fit, i), source_of(fit.runs[i], fit))
        for i in runs
    ]  # fmt: skip
    every = ", ".join(run.name for run in fit.runs)
    found += [
        Picture(f"{c.parameter} against {c.input} with its band", 2.8,
                partial(draw_curve, fit, j), f"{fit.output} in {every}")
        for j, c in enumerate(fit.curves)
    ]  # fmt: skip
    words = f"Correlations of the residuals of {fit.output}"
    return [*found, Picture(words, 2.8, partial(_draw_correlations, fit), every)]


def _draw_run(fit: ResponseFit | StateSpaceOutput, i: int, figure: FigureBase) -> None:
    """Measured and simulated output, their difference, and the inputs."""
    run, time, y = fit.runs[i], fit.seen.time[i], fit.seen.measured[i]
    simulated = fit.fitted[i]
    thin = slice(None, None, max(1, len(time) // MOST))
    above, middle, below = figure.subplots(3, 1, sharex=True, height_ratios=(3, 1, 1))
    above.plot(time[thin], y[thin], ".", color="0.6", markersize=3, label="measured")
    above.plot(time[thin], simulated[thin], color=BLUE, label="simulated")
    above.set(title=f"{fit.output}: measured and simulated", ylabel=unitless(fit.output))
    above.legend(frameon=False, loc="upper right", fontsize=8, ncols=2)
    above.margins(y=0.2)
    middle.plot(time[thin], (y - simulated)[thin], ".", color=RED, markersize=2)
    middle.axhline(0.0, color="0.7", linewidth=0.8)
    middle.set_ylabel("measured -\nsimulated")
    for name, values in run.inputs.items():
        below.step(run.time[thin], values[thin], where="post", label=name)
    names = list(run.inputs)
    below.set(xlabel="time, s", ylabel="inputs" if len(names) > 1 else names[0])
    if len(names) > 1:
        below.legend(frameon=False, fontsize=8, ncols=len(names))
    figure.align_ylabels()


def draw_curve(fit: ResponseFit | StateSpaceOutput, j: int, figure: FigureBase) -> None:
    """A parameter against the operating point, dashed where the runs never were."""
    c = fit.curves[j]
    axes = figure.subplots()
    known = c.visited & np.isfinite(c.error)
    axes.plot(c.at, c.value, "--", color="0.6", linewidth=1)
    axes.plot(c.at, np.where(c.visited, c.value, np.nan), color=BLUE)
    low, high = (np.where(known, c.value + s * c.error, np.nan) for s in (-1, 1))
    axes.fill_between(c.at, low, high, color=BLUE, alpha=0.25, linewidth=0)
    axes.set(title=f"{c.parameter} by {c.input}", xlabel=unitless(c.input))
    axes.set_ylabel(f"{c.parameter}, {c.unit}")
    if c.visited.any():  # the band where data were; a wild end elsewhere is cut off
        inside = np.concatenate([low[known], high[known], c.value[c.visited]])
        edge = 0.15 * max(float(np.ptp(inside)), 1e-12)
        axes.set_ylim(inside.min() - edge, inside.max() + edge)


def _draw_correlations(fit: ResponseFit | StateSpaceOutput, figure: FigureBase) -> None:
    """Correlation of residuals with themselves and with past inputs, with the 99 % band of none."""
    own, others = figure.subplots(1, 2)
    rest = [y - s for y, s in zip(fit.seen.measured, fit.fitted, strict=True)]
    count, lags = sum(map(len, rest)), np.arange(1, 21)
    limit = 2.58 / np.sqrt(count)
    squares = sum(float(r @ r) for r in rest)
    own.bar(lags, [sum(float(r[k:] @ r[:-k]) for r in rest) / squares for k in lags], color=BLUE)
    for j, name in enumerate(fit.seen.inputs):
        u = [(np.asarray(d.u)[np.asarray(d.index), j] - fit.seen.mean_u[j]) for d in fit.seen.runs]
        size = np.sqrt(squares * sum(float(v @ v) for v in u)) or 1.0
        found = [sum(float(r[k:] @ v[:-k]) for r, v in zip(rest, u, strict=True)) for k in lags]
        others.plot(lags, np.array(found) / size, "o-", markersize=3, label=name)
    for axes, what in ((own, "with themselves"), (others, "with past inputs")):
        axes.axhspan(-limit, limit, color="0.9", zorder=0)
        axes.set(title=f"Residuals {what}", xlabel="samples later")
    if len(fit.seen.inputs) > 1:
        others.legend(frameon=False, fontsize=8)
