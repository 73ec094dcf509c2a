"""Report of a tuned machine: maps of pairs of knobs, and the progress of the best emittance."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.answer import Table
from beamfit.errors import InputError
from beamfit.quantity import Quantity, percent
from beamfit.report.document import BLUE, RED, Picture, ReportPage, Verdict
from beamfit.report.emittance import about_input, about_scan
from beamfit.tuning.fit import TuningFit, fit_tuning

# Points along each axis of a map, and largest number of maps drawn.
MAP_POINTS = 25
MAX_MAPS = 6
# Numbers of rows for which the progress is shown, and the smallest of them.
COURSE_POINTS = 5
FIRST_ROWS = 6


def tuning_page(fit: TuningFit) -> ReportPage:
    """Make the page of a tuning fit.

    Parameters
    ----------
    fit : TuningFit
        Result of `beamfit.fit_tuning`.

    Returns
    -------
    ReportPage
    """
    line = f" on line {fit.seen.line.name}, {float(fit.seen.energy):g} MeV" if fit.seen else ""
    source = f"{fit.scan.name}, {len(fit.scan)} rows{line}"
    names = fit.knobs.names
    pairs = list(combinations(range(len(names)), 2))[:MAX_MAPS] or [(0, 0)]
    pictures = [
        Picture(f"map of {names[i]} and {names[j]}", 3.2, partial(draw_map, fit=fit, i=i, j=j),
                source)
        for i, j in pairs
    ]  # fmt: skip
    draw = partial(draw_course, fit=fit)
    pictures.append(Picture("course of the best emittance", 2.8, draw, source))
    tables = [*fit.tables(), *_beam_table(fit), *about_input(fit.notes)]
    return ReportPage(
        title=f"Tuning by {fit.scan.name}",
        subtitle=f"{len(fit.scan)} rows of {', '.join(names)}{line}",
        verdicts=[Verdict(fit.status, fit.headline, f"{fit.message} {fit.next_words}".strip())],
        tables=tables,
        pictures=pictures,
        pictures_title="The emittance over the knobs",
        **about_scan(fit.scan),
    )


def _beam_table(fit: TuningFit) -> list[Table]:
    """Make the table of the beam at the best setting, with the fitted noise."""
    rows = []
    for plane, found in fit.beam(fit.settings).items():
        for name, band in found.items() if plane != "goal" else ():
            scale, unit = (1e6, " µm") if name == fit.kind else (1.0, "")
            unit = " m" if name == "beta" else unit
            each = [scale * float(part[0]) for part in band]
            label = f"{name.replace('_', ' ')} {plane}"
            ends = f"{each[3]:.3g} to {each[4]:.3g}{unit}"
            rows.append([label, f"{each[0]:.4g}{unit}", ends])
    # For finished emittances the root is fitted, so that relative errors double.
    what, factor = ("a size", 1.0) if fit.seen else ("an emittance", 2.0)
    noise = [
        [f"relative error of {what} in {plane}", percent(factor * m.noise), ""]
        for plane, m in fit.maps.items()
    ]
    head = ["", "value", "95 % interval"]
    return [Table("The beam at the best setting", head, rows + noise)]


def draw_map(figure: FigureBase, fit: TuningFit, i: int, j: int) -> None:
    """Draw the emittance over two knobs, the others at the best setting, and its relative error.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    fit : TuningFit
        The fit.
    i, j : int
        Indices of the knobs; for i = j a curve with its bands is drawn.
    """
    names, low, high = fit.knobs.names, fit.knobs.low, fit.knobs.high
    along = [np.linspace(low[k], high[k], MAP_POINTS) for k in (i, j)]
    if i == j:
        _draw_curve(figure, fit, along[0])
        return
    first, second = np.meshgrid(*along, indexing="ij")
    settings = fit.settings | {names[i]: first.ravel(), names[j]: second.ravel()}
    band = fit.beam(settings)["goal"][fit.kind]
    value = 1e6 * band.value.reshape(MAP_POINTS, MAP_POINTS)
    error = 50.0 * ((band.high - band.low) / band.value).reshape(MAP_POINTS, MAP_POINTS)
    titles = (_axis(fit), "its standard error, %")
    for axes, part, title in zip(figure.subplots(1, 2), (value, error), titles, strict=True):
        drawn = axes.contourf(*along, part.T, levels=12, cmap="viridis")
        figure.colorbar(drawn, ax=axes)
        axes.plot(fit.scan.settings[names[i]], fit.scan.settings[names[j]], "w.", ms=4, mec="0.3")
        best = [fit.place[names[k]] for k in (i, j)]
        axes.errorbar(*([q.value] for q in best), *([q.std_dev] for q in best[::-1]), fmt="*",
                      color=RED, ms=10)  # fmt: skip
        axes.set(xlabel=names[i], ylabel=names[j], xlim=(low[i], high[i]), ylim=(low[j], high[j]))
        axes.set_title(title)


def _draw_curve(figure: FigureBase, fit: TuningFit, at: np.ndarray) -> None:
    """Draw the emittance over a single knob with its 68 and 95 % bands."""
    axes, name = figure.subplots(), fit.knobs.names[0]
    band = fit.beam({name: at})["goal"][fit.kind]
    axes.fill_between(at, 1e6 * band.low_95, 1e6 * band.high_95, color=BLUE, alpha=0.15, lw=0)
    axes.fill_between(at, 1e6 * band.low, 1e6 * band.high, color=BLUE, alpha=0.3, lw=0)
    axes.plot(at, 1e6 * band.value, color=BLUE)
    bottom = axes.get_ylim()[0]
    axes.plot(fit.scan.settings[name], np.full(len(fit.scan), bottom), "k|", ms=8)
    axes.axvline(fit.settings[name], color=RED, lw=1.2, ls="--")
    axes.set(xlabel=name, ylabel=_axis(fit), xlim=(at[0], at[-1]))


def draw_course(figure: FigureBase, fit: TuningFit) -> None:
    """Draw the emittance at the best setting against the number of rows used.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    fit : TuningFit
        The fit.
    """
    axes, course = figure.subplots(), course_of(fit)
    rows = [count for count, _ in course]
    value, error = (
        np.array([1e6 * getattr(q, n) for _, q in course]) for n in ("value", "std_dev")
    )
    axes.errorbar(rows, value, error, fmt="o-", color=BLUE, ms=4, capsize=3, lw=1.0)
    axes.axhline(1e6 * fit.minimum.value, color="0.5", lw=1.0, ls="--")
    axes.set(xlabel="rows", ylabel="at the best setting:\n" + _axis(fit))


def _axis(fit: TuningFit) -> str:
    return f"{fit.kind.replace('ized_', 'ised ')}, µm"


def course_of(fit: TuningFit, points: int = COURSE_POINTS) -> list[tuple[int, Quantity]]:
    """Return the emittance at the best setting from the first rows of a table, and from all.

    Returns
    -------
    list of (int, Quantity)
        Number of rows, and the normalised emittance at the best setting from these rows. Numbers of
        rows with too few magnet settings, or without a row within the limits, are left out.
    """
    scan, found, line = fit.scan, [], fit.seen.line if fit.seen else None
    for count in np.unique(np.linspace(FIRST_ROWS, len(scan), points).astype(int))[:-1]:
        limits = dict(zip(fit.knobs.names, np.stack(fit.knobs[1:3], -1), strict=True))
        with suppress(InputError):
            part = replace(scan, **scan.columns_at(range(count)))
            own = fit_tuning(part, line, limits, goal=fit.goal, noise=fit.noise, room=len(scan))
            found.append((int(count), own.emittance))
    return [*found, (len(scan), fit.emittance)]
