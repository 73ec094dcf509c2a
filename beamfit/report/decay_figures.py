"""The pictures of decay records: current with fit, momentary lifetime, loss budget."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from beamfit.errors import InputError
from beamfit.lifetime.decay import current
from beamfit.report.document import Picture
from beamfit.studies.decay.checks import moving_lifetime
from beamfit.studies.decay.study import Decay, RecordStudy

__all__ = ["decay_pictures", "draw_budget", "draw_lifetime", "draw_record"]

HOUR = 3600.0
BLUE, RED = "#1f5fa8", "#b5421f"
COLOURS = ("#1f5fa8", "#c98a00", "#2c7a3f", "#7b4fa3", "#b5421f", "#4f9aa3", "0.5")
# More points than this are drawn as an image: as curves they would fill the page with bytes.
MANY = 500
# Decays shown in one budget; more have no room for their names.
MOST_BARS = 12


def draw_record(figure: FigureBase, study: RecordStudy) -> None:
    """Draw a record with the fit of each decay, and the residuals below.

    Parameters
    ----------
    figure : Figure or SubFigure
        Where to.
    study : RecordStudy
        The record.
    """
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    record, scale, unit = study.record, *_time_unit(study.record.span)
    many = len(record) > MANY
    size = 2 if many else 5
    above.plot(
        record.time / scale, record.current, "o", ms=size, color="0.65", rasterized=many, zorder=1
    )
    for decay in study.decays:
        at = (decay.offset + decay.segment.time) / scale
        above.plot(at, decay.segment.current, "o", ms=size, color=BLUE, rasterized=many, zorder=2)
        grid = np.linspace(0, decay.segment.span, 200)
        fit = decay.fit
        if np.isfinite(fit.a.value):
            law = np.asarray(current(grid, fit.i0.value, fit.a.value, fit.b.value))
            above.plot((decay.offset + grid) / scale, law, color=RED, lw=1.3, zorder=3)
        below.plot(at, fit.residuals, "o", ms=size, color=BLUE, rasterized=many)
    above.plot([], [], "o", color=BLUE, ms=5, label="readings")
    above.plot([], [], color=RED, label="fit")
    if sum(len(d.segment) for d in study.decays) < len(record):
        above.plot([], [], "o", color="0.65", ms=5, label="left out")
    above.legend(frameon=False, loc="best")
    above.set_ylabel("beam current, mA")
    above.set_title(record.name)
    below.axhline(0, color="0.6", lw=0.8)
    below.set_ylabel("fit - reading,\nmA")
    below.set_xlabel(f"time, {unit}")


def _time_unit(span: float) -> tuple[float, str]:
    if span > 2 * HOUR:
        return HOUR, "h"
    return (60.0, "min") if span > 120 else (1.0, "s")


def draw_lifetime(figure: FigureBase, study: RecordStudy) -> None:
    """Draw the momentary lifetime over a moving window beside that of the fit.

    Parameters
    ----------
    figure : Figure or SubFigure
        Where to.
    study : RecordStudy
        The record.
    """
    axes: Axes = figure.subplots()
    scale, unit = _time_unit(study.record.span)
    tops = []
    for decay in study.decays:
        tops.append(_momentary(axes, decay, scale))
        fit = decay.fit
        if np.isfinite(fit.a.value):
            grid = np.linspace(0, decay.segment.span, 100)
            level = current(grid, fit.i0.value, fit.a.value, fit.b.value)
            rate = np.asarray(fit.a.value * level + fit.b.value) * HOUR
            # A rate of zero or less is no lifetime: leave a hole in the curve.
            inverse = 1 / np.where(rate > 0, rate, np.nan)
            axes.plot((decay.offset + grid) / scale, inverse, color=RED, lw=1.5, zorder=3)
    axes.errorbar([], [], [], fmt="o", ms=3, color=BLUE, label="straight lines over 1/8 of a decay")
    axes.plot([], [], color=RED, label="fit, 1/(a I + b)")
    known = [top for top in tops if np.isfinite(top)]
    if known:
        axes.set_ylim(0.6 * min(known), 1.4 * max(known))
    axes.set_ylabel("lifetime, h")
    axes.set_xlabel(f"time, {unit}")
    axes.set_title("momentary lifetime")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, loc="outside lower center", ncols=2)


def _momentary(axes: Axes, decay: Decay, scale: float) -> float:
    """Draw about forty windows of one decay; its usual lifetime, for the axis."""
    segment = decay.segment
    usual = float(np.median(np.diff(segment.time)))
    try:
        trace = moving_lifetime(segment, max(segment.span / 8, 6 * usual))
    except InputError:
        return np.nan  # too few readings for any window: there is nothing to draw
    every = slice(None, None, max(1, trace.time.size // 40))
    seen = np.isfinite(trace.lifetime[every]) & (trace.lifetime[every] > 0)
    if not seen.any():
        return np.nan
    axes.errorbar(
        (decay.offset + trace.time[every][seen]) / scale,
        trace.lifetime[every][seen],
        trace.error[every][seen],
        fmt="o",
        ms=3,
        lw=0.8,
        color=BLUE,
        zorder=2,
    )
    return float(np.median(trace.lifetime[every][seen]))


def draw_budget(figure: FigureBase, decays: Sequence[Decay]) -> None:
    """Draw the loss rate of each decay by mechanism, with the measured rate beside it.

    Parameters
    ----------
    figure : Figure or SubFigure
        Where to.
    decays : sequence of Decay
        With budgets.
    """
    axes: Axes = figure.subplots()
    shown = decays[:MOST_BARS]
    place = np.arange(len(shown))[::-1]
    left = np.zeros(len(shown))
    for cause, colour in zip(decays[0].budget.rates, cycle(COLOURS), strict=False):
        width = np.array([decay.budget.rates[cause] for decay in shown])
        label = cause if width.max() > 1e-4 * left.max(initial=width.max()) else None
        axes.barh(place, width, 0.6, left, color=colour, label=label)
        left += width
    for y, decay in zip(place, shown, strict=True):
        found = decay.fit.lifetime_mean
        if np.isfinite(found.value):
            error = 0.0 if found.error is None else found.error / found.value**2
            hollow = "white" if found.error is None else "black"
            axes.errorbar(1 / found.value, y, xerr=error, fmt="D", color="black", mfc=hollow, ms=5)
    axes.errorbar([], [], fmt="D", color="black", ms=5, label="measured")
    axes.set_yticks(place, [decay.fit.record for decay in shown])
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_xlim(left=0)
    axes.set_xlabel("loss rate at the mean current, 1/h")
    more = f", {MOST_BARS} of {len(decays)} decays" if len(decays) > MOST_BARS else ""
    axes.set_title(f"computed losses{more}")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, loc="outside lower center", ncols=5)


def decay_pictures(studies: Sequence[RecordStudy]) -> list[Picture]:
    """List the pictures of decay records.

    Parameters
    ----------
    studies : sequence of RecordStudy
        The records.

    Returns
    -------
    list of Picture
        Two for each record, and the loss budget where a ring was given.
    """
    listed = []
    for study in studies:
        name = study.record.name
        listed.append(Picture(f"current of {name}", 4.4, partial(draw_record, study=study)))
        listed.append(Picture(f"lifetime of {name}", 3.0, partial(draw_lifetime, study=study)))
    decays = [decay for study in studies for decay in study.decays]
    if all(decay.budget is not None for decay in decays):
        height = 1.5 + 0.3 * min(len(decays), MOST_BARS)
        listed.append(Picture("loss budget", height, partial(draw_budget, decays=decays)))
    return listed
