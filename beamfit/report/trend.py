"""The course of a lifetime over weeks, with its control limits and alarms."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from beamfit.lifetime.alarm import when
from beamfit.lifetime.course import Trend
from beamfit.report.document import BLUE, RED, Picture, control_chart, date_axis

RELATIVE = ("a", "b")


def trend_picture(trend: Trend) -> Picture:
    """The picture of a page."""
    height = 2.6 if trend.reference is None else 5.4
    ends = [when(point.time, trend.dated) for point in trend.points[:1] + trend.points[-1:]]
    source = f"{len(trend.points)} decays, {' to '.join(ends)}"
    return Picture("course of the lifetime", height, partial(draw_trend, trend=trend), source)


def draw_trend(figure: FigureBase, trend: Trend) -> None:
    """Draw normalised lifetimes with control limits; a and b over the usual ones below.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    trend : Trend
        The lifetimes. Hours of the record where they have no dates.
    """
    rows = 1 if trend.reference is None else 3
    panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    at = np.array([_at(trend, point.time) for point in trend.points])
    _lifetimes(panels[0], trend, at)
    for axes, name in zip(panels[1:], RELATIVE, strict=False):
        found = [getattr(point, name) for point in trend.points]
        known = [(t, q.value, q.error) for t, q in zip(at, found, strict=True) if q is not None]
        if known:
            time, value, error = map(np.array, zip(*known, strict=True))
            axes.errorbar(time, value, error, fmt="o", ms=4, color=BLUE)
        axes.axhline(1.0, color="0.6", lw=0.8)
        axes.set(ylabel=f"{name} over usual")
    for axes in panels:
        for alarm in trend.alarms:
            axes.axvline(_at(trend, alarm.since), color=RED, lw=1.2, ls="--")
    panels[-1].set(xlabel="UTC" if trend.dated else "time, h")
    if trend.dated:
        date_axis(panels[-1])


def _at(trend: Trend, time: float) -> np.datetime64 | float:
    """Time on the axis: a date, or hours."""
    return np.datetime64(round(1000 * time), "ms") if trend.dated else time / 3600


def _lifetimes(axes: Axes, trend: Trend, at: np.ndarray) -> None:
    value = np.array([point.normalised.value for point in trend.points])
    error = np.array([point.normalised.error for point in trend.points])
    beyond = np.array([point.beyond != 0 for point in trend.points])
    names = ("a decay", "beyond the limits")
    limits = trend.centre, trend.limit
    control_chart(axes, (at, value, error), beyond, limits, names, ms=4)
    if trend.alarms:
        axes.plot([], [], color=RED, lw=1.2, ls="--", label="a or b moved")
    axes.legend(frameon=False, fontsize="small", ncols=2)
    axes.set(title="normalised lifetime", ylabel="current x\nlifetime, mA h")
