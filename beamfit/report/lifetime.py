"""Report of decay records, and of the trend of their lifetimes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from beamfit.answer import Table, labelled
from beamfit.errors import InputError
from beamfit.lifetime import tables
from beamfit.lifetime.alarm import time_label
from beamfit.lifetime.course import MAX_TREND_POINTS, Trend
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.ring_study import Shift
from beamfit.lifetime.study import Decay, RecordStudy
from beamfit.lifetime.systematics import moving_lifetime
from beamfit.quantity import HOUR
from beamfit.report.document import (
    BLUE,
    MAX_DRAWN,
    RASTER_POINTS,
    RED,
    Picture,
    ReportPage,
    Verdict,
    comment_notes,
    control_chart,
    date_axis,
    day_of,
    legend_below,
    quality,
)
from beamfit.report.network import network_pictures

COLOURS = (BLUE, "#c98a00", "#2c7a3f", "#7b4fa3", RED, "#4f9aa3", "0.5")

ERRORS = (
    "dI/dt = -a I² - b I. Errors are half of the central 68 % of the posterior. “Not determined” "
    "means the record puts no error on the value; it is not to be quoted."
)
CHECKS = (
    "Analyses that take the lifetime as constant, for comparison: their errors do not contain the "
    "bias stated. “Constant a” asks whether a power of the current describes the loss better."
)
BUDGET = (
    "Computed for the ring file and the record's own settings, nothing fitted. The percentages are "
    "shares of the computed loss at the mean current."
)
# Columns of a table of decays that fit the page.
TABLE_COLUMNS = 2
# Largest number of cycles that are all drawn, and number drawn of more.
MAX_CYCLES = 60
CYCLES_DRAWN = 12


def decay_page(
    studies: Sequence[RecordStudy], shift: Shift | None = None, trend: Trend | None = None
) -> ReportPage:
    """Make the page of decay records.

    Parameters
    ----------
    studies : sequence of RecordStudy
        At least one record.
    shift : Shift, optional
        The study of all decays together.
    trend : Trend, optional
        The trend of their lifetimes.

    Returns
    -------
    ReportPage
    """
    decays = [decay for study in studies for decay in study.decays]
    listed = []
    if shift is not None:
        found = shift.tables()
        listed += [found[0].quoted()._replace(title="Result", note="", header=[]), *found]
    listed += [] if trend is None else trend.tables()
    pooled = [decay for study in studies for decay in study.pooled]
    listed += _column_tables(pooled) + tables.course_tables(pooled) + _single_tables(decays)
    header = ["what", "at", "for", "change"]
    listed += [
        Table(f"Cut at or left out of {study.record.name}", header, tables.event_rows(study))
        for study in studies
        if study.events
    ]
    names = [study.record.name for study in studies]
    title = names[0] if len(names) == 1 else f"{len(names)} records"
    hours = sum(study.record.span for study in studies) / HOUR
    counts = {"cycle": sum(d.fit.first.size for d in pooled), "decay": len(decays)}
    count = ", ".join(f"{n} {what}" + "s" * (n > 1) for what, n in counts.items() if n)
    return ReportPage(
        title=f"Beam lifetime of {title}",
        subtitle=f"{count} in {hours:.3g} h of record",
        verdicts=[*_overall_verdicts(shift, trend), *map(_verdict, pooled), *_verdicts(decays)],
        tables=_unique_headings(listed),
        pictures=_overall_pictures(decays, shift, trend) + _pictures(studies),
        pictures_title="Lifetime along the record" if len(studies) == 1 else "Records and fits",
        notes=comment_notes([note for study in studies for note in study.record.comments]),
    )


def _unique_headings(listed: Sequence[Table]) -> list[Table]:
    """Add the column names to headings that occur more than once."""
    count = Counter(table.title for table in listed)
    return [
        t._replace(title=f"{t.title}: {', '.join(t.header[1:])}") if count[t.title] > 1 else t
        for t in listed
    ]


def _column_tables(decays: Sequence[Decay]) -> list[Table]:
    """Make tables with every number of a few decays, one column per decay."""
    groups = [decays[k : k + TABLE_COLUMNS] for k in range(0, len(decays), TABLE_COLUMNS)]
    parts = [
        ("All numbers", ERRORS, tables.decay_rows),
        ("What the records determine", "", tables.separability_rows),
        ("Simpler analyses, and whether a is constant", CHECKS, tables.check_rows),
        ("Losses from first principles", BUDGET, tables.budget_rows),
    ]
    every = [
        labelled(
            title, [decay.fit.record for decay in group], rows, note if group is groups[0] else ""
        )
        for title, note, rows_of in parts
        for group in groups
        if (rows := rows_of(group))
    ]
    first = [each.quoted()._replace(title="Result", note="") for each in every[: len(groups)]]
    return [*first, *every]


def _single_tables(decays: Sequence[Decay]) -> list[Table]:
    """Make tables of all numbers of a few decays, or of the main numbers of many."""
    if len(decays) > tables.MAX_FULL_DECAYS:
        result, *more = tables.overview(decays)
        return [result._replace(note=ERRORS), *more]
    listed = _column_tables(decays)
    for d in (d for d in decays if d.systematics):
        listed.append(tables.systematic_table(d, f"Systematics of {d.fit.record}"))
    return listed


def _verdicts(decays: Sequence[Decay]) -> list[Verdict]:
    """Return the verdict of each decay; for many decays one for each distinct message."""
    if len(decays) <= tables.MAX_FULL_DECAYS:
        return [_verdict(decay) for decay in decays]
    return [Verdict(*verdict) for verdict in tables.distinct_verdicts(decays)]


def _verdict(decay: Decay) -> Verdict:
    fit = decay.fit
    value = f"lifetime {fit.lifetime_mean} at {fit.mean_current:.4g} mA"
    headline = value if fit.lifetime_mean.error is not None else "lifetime not determined"
    return Verdict(fit.status, f"{fit.record}: {headline}", fit.message)


def _overall_verdicts(shift: Shift | None, trend: Trend | None) -> Iterator[Verdict]:
    """Yield the verdicts on all decays together."""
    if shift is not None:
        yield from (Verdict(status, name, said) for name, status, said in shift.verdicts)
    if trend is not None:
        yield Verdict(trend.status, "course of the lifetime", trend.message)


def study_of(result: DecayFit | RecordStudy) -> RecordStudy:
    """Wrap a single fit as the study of its record.

    Raises
    ------
    InputError
        If the fit does not contain its readings.
    """
    if isinstance(result, RecordStudy):
        return result
    if result.readings is None:
        raise InputError("a fit without its readings", "the result of fit_decay or fit_decays")
    return RecordStudy(result.readings, (Decay(result.readings, 0.0, result, None),), ())


def record_picture(study: RecordStudy) -> Picture:
    """Make the picture of a record with its fits."""
    draw = partial(draw_record, study=study)
    return Picture(f"current of {study.record.name}", 4.4, draw, _source(study))


def lifetime_picture(study: RecordStudy) -> Picture:
    """Make the picture of the momentary lifetime along a record."""
    draw = partial(draw_lifetime, study=study)
    return Picture(f"lifetime of {study.record.name}", 3.0, draw, _source(study))


def _source(study: RecordStudy) -> str:
    """Return file, day and quality of the fit of a record."""
    record, answers = study.record, study.answers
    day = day_of(record.name, record.comments)
    if record.start is not None:
        day = f"from {datetime.fromtimestamp(record.start, UTC):%Y-%m-%d %H:%M} UTC"
    parts = [record.name, day]
    if len(answers) == 1:
        fit = answers[0].fit
        parts.append(quality(None if fit.noise_inferred else fit.chi2, fit.dof))
    else:
        parts.append(f"{len(answers)} decays")
    return ", ".join(part for part in parts if part)


def draw_record(figure: FigureBase, study: RecordStudy) -> None:
    """Draw a record with the fit of each decay, and the residuals below.

    Of very many cycles, some are drawn with their fits, and the residuals of all.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    study : RecordStudy
        The record.
    """
    some = _some_cycles(study)
    above, below = figure.subplots(2, 1, sharex=some is None, height_ratios=(3, 1))
    record, scale, unit = study.record, *_time_unit(study.record.span)
    many = len(record) > RASTER_POINTS
    dots = partial(dict, marker="o", ls="", ms=2 if many else 5, rasterized=many)
    above.plot(record.time / scale, record.current, **dots(color="0.65", zorder=1))
    for decay in study.pooled:
        _draw_cycles(above, below, decay.fit, scale, dots)
    for decay in study.decays:
        at = (decay.offset + decay.segment.time) / scale
        above.plot(at, decay.segment.current, **dots(color=BLUE, zorder=2))
        grid = np.linspace(0, decay.segment.span, 200)
        law = decay.fit.curve(grid)
        above.plot((decay.offset + grid) / scale, law, color=RED, lw=1.3, zorder=3)
        below.plot(at, decay.fit.residuals, **dots(color=BLUE))
    above.plot([], [], "o", color=BLUE, ms=5, label="readings")
    above.plot([], [], color=RED, label="fit")
    fitted = [decay.segment.current for decay in study.pooled or study.decays]
    shown, title = np.concatenate(fitted), "beam current"
    if some is not None:
        shown = record.current[(record.time >= some[0]) & (record.time <= some[1])]
        title += f", {CYCLES_DRAWN} of {study.pooled[0].fit.first.size} cycles"
        above.set_xlim(some / scale)
    # The axis excludes spikes, dumps and injections, which would flatten the decay to a line.
    more = 0.1 * float(np.ptp(shown)) or 1.0
    low, high = float(shown.min()) - more, float(shown.max()) + more
    above.set(title=title, ylabel="beam current, mA", ylim=(low, high))
    if sum(map(len, fitted)) < len(record):
        beyond = int(np.sum((record.current < low) | (record.current > high)))
        label = "left out" + f", {beyond} beyond the axes" * (some is None and beyond > 0)
        above.plot([], [], "o", color="0.65", ms=5, label=label)
    above.legend(frameon=False, loc="best")
    below.axhline(0, color="0.6", lw=0.8)
    below.set(xlabel=f"time, {unit}", ylabel="fit - reading,\nmA")


def _some_cycles(study: RecordStudy) -> np.ndarray | None:
    """Return the time range of the drawn cycles in s if there are too many to draw all."""
    if study.decays or len(study.pooled) != 1:
        return None
    readings, first = study.pooled[0].fit.readings, study.pooled[0].fit.first
    if first.size <= MAX_CYCLES:
        return None
    middle = first[first.size // 2 + np.array([0, CYCLES_DRAWN])]
    return readings.start + readings.time[middle]


def _draw_cycles(above: Axes, below: Axes, fit: DecayFit, scale: float, dots: Callable) -> None:
    """Draw cycles that were fitted together, with a gap in the curve between them."""
    at = (fit.readings.start + fit.readings.time) / scale
    above.plot(at, fit.readings.current, **dots(color=BLUE, zorder=2))
    law = np.insert(fit.readings.current + fit.residuals, fit.first, np.nan)
    above.plot(np.insert(at, fit.first, np.nan), law, color=RED, lw=1.3, zorder=3)
    below.plot(at, fit.residuals, **dots(color=BLUE))


def _time_unit(span: float) -> tuple[float, str]:
    if span > 2 * HOUR:
        return HOUR, "h"
    return (60.0, "min") if span > 120 else (1.0, "s")


def draw_lifetime(figure: FigureBase, study: RecordStudy) -> None:
    """Draw the momentary lifetime in a moving window and that of the fit.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    study : RecordStudy
        The record.
    """
    axes: Axes = figure.subplots()
    scale, unit = _time_unit(study.record.span)
    tops = []
    for decay in () if study.decays else study.pooled:
        time, lifetime, error = _cycle_lifetimes(decay.fit)
        at = (decay.fit.readings.start + time) / scale
        axes.errorbar(at, lifetime, error, fmt="o", ms=3, lw=0.8, color=BLUE, zorder=2)
        fit, begin = decay.fit, decay.fit.readings.start
        whole = (at[0] * scale - begin, at[-1] * scale - begin, fit.lifetime_mean)
        for start, end, mean in fit.course or (whole,):
            ends = np.array([begin + start, begin + end]) / scale
            axes.plot(ends, 2 * [mean.value], color=RED, lw=1.5, zorder=3)
    for decay in study.decays:
        tops.append(_draw_windows(axes, decay, scale))
        grid = np.linspace(0, decay.segment.span, 100)
        rate = -np.gradient(np.log(decay.fit.curve(grid)), grid, edge_order=2) * HOUR
        # A rate of zero or less has no lifetime: leave a gap in the curve.
        inverse = 1 / np.where(rate > 0, rate, np.nan)
        axes.plot((decay.offset + grid) / scale, inverse, color=RED, lw=1.5, zorder=3)
    label = (
        "single cycles, or some together" if study.pooled else "straight lines over 1/8 of a decay"
    )
    axes.errorbar([], [], [], fmt="o", ms=3, color=BLUE, label=label)
    axes.plot([], [], color=RED, label="fit")
    finite = [top for top in tops if np.isfinite(top)]
    if finite:
        axes.set_ylim(0.6 * min(finite), 1.4 * max(finite))
    title = "momentary lifetime" if study.decays else "lifetime at the mean current"
    axes.set(title=title, xlabel=f"time, {unit}", ylabel="lifetime, h")
    legend_below(figure, axes, 2)


def _cycle_lifetimes(fit: DecayFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time in s, lifetime at the mean current and its error in h of up to 48 parts of a
    pooled fit.

    The deviation of the loss rate of a part is the slope of the residuals of its cycles.
    """
    record, first = fit.readings, fit.first
    lengths = np.diff(first, append=len(record))
    columns = np.column_stack([record.time, fit.residuals])
    mean = np.add.reduceat(columns, first) / lengths[:, None]
    since, residual = (columns - np.repeat(mean, lengths, axis=0)).T
    part = first[
        np.linspace(0, first.size, min(first.size, MAX_TREND_POINTS), endpoint=False).astype(int)
    ]
    count = np.diff(part, append=len(record))
    at, level = (np.add.reduceat(v, part) / count for v in (record.time, record.current))
    squares = np.add.reduceat(since**2, part)
    rate = np.add.reduceat(since * residual, part) / squares / level
    lifetimes = np.array([of.lifetime.value for of in fit.course] or [fit.lifetime_mean.value])
    which = np.searchsorted([of.start for of in fit.course][1:], at - record.time[0])
    rate += 1 / lifetimes[which] / HOUR
    error = fit.rms_residual / np.sqrt(squares) / level
    positive = rate > 0
    return at[positive], 1 / rate[positive] / HOUR, (error / rate**2)[positive] / HOUR


def _draw_windows(axes: Axes, decay: Decay, scale: float) -> float:
    """Draw about forty windows of one decay; return the median lifetime, for the axis."""
    segment = decay.segment
    interval = float(np.median(np.diff(segment.time)))
    try:
        trace = moving_lifetime(segment, max(segment.span / 8, 6 * interval))
    except InputError:
        return np.nan  # too few readings for any window
    every = slice(None, None, max(1, trace.time.size // 40))
    valid = np.isfinite(trace.lifetime[every]) & (trace.lifetime[every] > 0)
    if not valid.any():
        return np.nan
    time, lifetime, error = (
        part[every][valid] for part in (trace.time, trace.lifetime, trace.error)
    )
    at = (decay.offset + time) / scale
    axes.errorbar(at, lifetime, error, fmt="o", ms=3, lw=0.8, color=BLUE, zorder=2)
    return float(np.median(lifetime))


def draw_budget(figure: FigureBase, decays: Sequence[Decay]) -> None:
    """Draw the loss rate of each decay by mechanism, and the measured rate.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    decays : sequence of Decay
        Decays with budgets.
    """
    axes: Axes = figure.subplots()
    shown = decays[:MAX_DRAWN]
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
    names = tables.short_names(shown)
    axes.set_yticks(place, [names[decay.fit.record] for decay in shown])
    more = f", {MAX_DRAWN} of {len(decays)} decays" if len(decays) > MAX_DRAWN else ""
    axes.set(title=f"computed losses{more}", xlabel="loss rate at the mean current, 1/h")
    axes.set(xlim=(0, None), ylim=(-0.6, len(shown) - 0.4))
    legend_below(figure, axes, 5)


def _overall_pictures(
    decays: Sequence[Decay], shift: Shift | None, trend: Trend | None
) -> list[Picture]:
    """Make the pictures of all decays together."""
    listed = [] if trend is None else [trend_picture(trend)]
    has_network = shift is not None and shift.network is not None
    return listed + (network_pictures(shift, decays) if has_network else [])


def _pictures(studies: Sequence[RecordStudy]) -> list[Picture]:
    """Make two pictures for each record, and the loss budget if a ring was given."""
    listed = []
    for study in studies:
        listed += [record_picture(study), lifetime_picture(study)]
    decays = [decay for study in studies for decay in study.answers]
    if all(decay.budget is not None for decay in decays):
        height = 1.5 + 0.3 * min(len(decays), MAX_DRAWN)
        draw = partial(draw_budget, decays=decays)
        names = ", ".join(study.record.name for study in studies)
        listed.append(Picture("loss budget", height, draw, names))
    return listed


RELATIVE_LOSSES = ("a", "b")


def _has_relative(trend: Trend) -> bool:
    """Return True if some decay has an a or b relative to the reference."""
    return any(point.a is not None or point.b is not None for point in trend.points)


def trend_picture(trend: Trend) -> Picture:
    """Make the picture of a trend."""
    height = 5.4 if _has_relative(trend) else 2.6
    ends = [time_label(point.time, trend.dated) for point in trend.points[:1] + trend.points[-1:]]
    source = f"{len(trend.points)} decays, {' to '.join(ends)}"
    return Picture("course of the lifetime", height, partial(draw_trend, trend=trend), source)


def draw_trend(figure: FigureBase, trend: Trend) -> None:
    """Draw normalised lifetimes with control limits, and a and b over the reference below.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    trend : Trend
        The lifetimes; drawn against hours of the record if they have no dates.
    """
    rows = 3 if _has_relative(trend) else 1
    panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    at = np.array([_at(trend, point.time) for point in trend.points])
    _lifetimes(panels[0], trend, at)
    for axes, name in zip(panels[1:], RELATIVE_LOSSES, strict=False):
        found = [getattr(point, name) for point in trend.points]
        points = [(t, q.value, q.error) for t, q in zip(at, found, strict=True) if q is not None]
        if points:
            time, value, error = map(np.array, zip(*points, strict=True))
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
    """Return the time on the axis: a date, or hours."""
    return np.datetime64(round(1000 * time), "ms") if trend.dated else time / HOUR


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
