"""Pictures of a fitted scan: sizes with the fit, residuals, profiles, phase ellipses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.results import PlaneFit
from beamfit.emittance.scan import Profile
from beamfit.report.document import BLUE, RASTER_POINTS, RED, Picture, day_of, legend_below, quality

# Profiles in a row of the picture.
PROFILES_PER_ROW = 3
COLOUR = {"x": BLUE, "y": RED}
# Colours of further screens; each screen also has its own marker and line style.
MORE_COLOURS = {"x": ("#0f8b8d", "#7b4fa3", "#5a6570"), "y": ("#c98a00", "#8a3b6b", "#5a6570")}
MARKERS, LINES = "os^D", ("-", "--", ":", "-.")
PROBABLY_BAD = "probably bad"


# Width of the picture of a scan in inches: one of two side by side (narrow, so that its text stays
# legible), and alone.
PAIR_WIDTH = 4.6
FULL_WIDTH = 6.4


def scan_picture(fit: EmittanceFit, plane: str, width: float = FULL_WIDTH) -> Picture:
    """Make the picture of the scan of one plane."""
    words = f"scan of the {plane} plane"
    draw = partial(draw_scan, fit=fit, plane=plane, letters=round(10 * width))
    return Picture(words, 0.54 * width + 1.15, draw, source_of(fit, plane), width)


def residual_picture(fit: EmittanceFit, plane: str) -> Picture:
    """Make the picture of the residuals of one plane."""
    draw = partial(draw_residuals, fit=fit, plane=plane)
    return Picture(f"residuals of the {plane} plane", 2.6, draw, source_of(fit, plane))


def ellipse_picture(fit: EmittanceFit) -> Picture:
    """Make the picture of the phase ellipses."""
    return Picture("phase ellipses", 3.4, partial(draw_ellipses, fit=fit), source_of(fit))


def source_of(fit: EmittanceFit, *planes: str) -> str:
    """Return file, slice, date, line, and the quality of the fit of some planes."""
    scan = fit.scan
    parts = [scan.name]  # includes the slice
    parts += [day_of(f"{scan.name} {scan.path or ''}", scan.provenance), f"line {fit.line.name}"]
    parts += [f"{p}: {quality(fit[p].chi2, fit[p].dof)}" for p in planes]
    return ", ".join(part for part in parts if part)


def draw_scan(figure: FigureBase, fit: EmittanceFit, plane: str, letters: int = 62) -> None:
    """Draw the sizes of one plane with the fit, and the residuals in standard errors below.

    With one varied magnet the fit is a curve against its setting; with several, points in order.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    fit : EmittanceFit
        The fit.
    plane : str
        "x" or "y".
    letters : int
        Characters per line of the title.
    """
    p = fit[plane]
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    at, _ = setting_axis(p)
    one = _varied(p) if fit.statement.whole_map and not fit.scan.transfer else []
    _points(above, p, at)
    if len(one) == 1 and not fit.told.hysteresis:
        _curves(above, fit, p, one[0])
    else:  # the fit is defined only at the measured settings
        style = {"ms": 14, "mew": 2, "color": COLOUR[plane], "alpha": 0.6}
        above.plot(at, 1e6 * p.points.model, "_", label="fit", **style)
    above.legend(frameon=False, loc="best", fontsize=8)
    title = f"{plane} plane: {p.words}"
    above.set_title(fill(title, letters), fontsize=9.5)
    above.set(ylabel="rms size, µm", ylim=(0.0, None))
    _residuals(below, p)


def draw_residuals(figure: FigureBase, fit: EmittanceFit, plane: str) -> None:
    """Draw the residuals of one plane in standard errors.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    fit : EmittanceFit
        The fit.
    plane : str
        "x" or "y".
    """
    axes: Axes = figure.subplots()
    _residuals(axes, fit[plane])
    axes.set_title(f"{plane} plane: residuals")


def _residuals(axes: Axes, p: PlaneFit) -> None:
    at, words = setting_axis(p)
    axes.axhspan(-1, 1, color="0.93")
    axes.axhline(0, color="0.6", lw=0.8)
    for rows, _, style in _groups(p):
        axes.errorbar(at[rows], p.points.pull[rows], **style)
    finite = np.abs(p.points.pull[np.isfinite(p.points.pull)])
    reach = max(3.0, 1.15 * float(finite.max(initial=0.0)))
    axes.set(xlabel=words, ylabel="residual,\nstd. errors", ylim=(-reach, reach))


def _varied(p: PlaneFit) -> list[str]:
    return [name for name, values in p.points.settings.items() if np.ptp(values) > 0]


def setting_axis(p: PlaneFit) -> tuple[np.ndarray, str]:
    """Return the axis of a scan: the setting of the only varied magnet, or the point number."""
    varied = _varied(p)
    if len(varied) != 1:
        return np.arange(1, len(p.points.size) + 1), "measurement"
    return p.points.settings[varied[0]], f"{varied[0]}, {p.points.units[varied[0]]}"


def _screens(p: PlaneFit) -> list[tuple[np.ndarray, str, str, str]]:
    """Return the rows of each screen, and its colour, marker and name."""
    colours = (COLOUR[p.plane], *MORE_COLOURS[p.plane])
    return [
        (np.array([s == name for s in p.points.screen]), colours[i % 4], MARKERS[i % 4], name)
        for i, name in enumerate(dict.fromkeys(p.points.screen))
    ]


def _curves(axes: Axes, fit: EmittanceFit, p: PlaneFit, magnet: str) -> None:
    """Draw one fitted curve per screen, with a band of one standard error if it has errors."""
    values = p.points.settings[magnet]
    margin = 0.04 * np.ptp(values)
    grid = np.linspace(values.min() - margin, values.max() + margin, 201)
    settings = {n: np.median(v) for n, v in p.points.settings.items()} | {magnet: grid}
    screens = _screens(p)
    for index, (_, colour, _, screen) in enumerate(screens):
        found = fit.predict(settings, p.plane, screen=screen)
        name = "fit" if len(screens) == 1 else f"fit at {screen}"
        axes.plot(grid, 1e6 * found.size, LINES[index % 4], color=colour, lw=1.6, label=name)
        if np.isfinite(found.error).all():
            low, high = found.size - found.error, found.size + found.error
            axes.fill_between(
                grid, 1e6 * np.maximum(low, 0), 1e6 * high, color=colour, alpha=0.15, lw=0
            )


def _points(axes: Axes, p: PlaneFit, at: np.ndarray) -> None:
    """Draw measured points; those that are probably bad are hollow and without error bars."""
    error, size = np.nan_to_num(1e6 * p.points.error), 1e6 * p.points.size
    for rows, label, style in _groups(p):
        bar = None if label == PROBABLY_BAD else error[rows]
        axes.errorbar(at[rows], size[rows], bar, capsize=3, label=label, **style)


def _groups(p: PlaneFit) -> Iterator[tuple[np.ndarray, str, dict[str, Any]]]:
    """Yield rows, label and style of the good and the probably bad points of each screen."""
    screens, bad = _screens(p), p.points.outlier_probability >= 0.5
    for rows, colour, marker, screen in screens:
        name = "measured" if len(screens) == 1 else f"measured at {screen}"
        for keep, face, label in ((rows & ~bad, colour, name), (rows & bad, "white", PROBABLY_BAD)):
            style = {"fmt": marker, "ms": 5, "color": colour, "mfc": face}
            if keep.any():
                yield keep, label, style | {"rasterized": len(rows) > RASTER_POINTS}


def draw_profiles(figure: FigureBase, profiles: list[Profile], fit: EmittanceFit) -> None:
    """Draw the projected profiles from which sizes of one plane were taken.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    profiles : list of Profile
        Profiles of one plane.
    fit : EmittanceFit
        Fit with the settings of their rows.
    """
    across = min(PROFILES_PER_ROW, len(profiles))
    every = figure.subplots(math.ceil(len(profiles) / across), across, squeeze=False).ravel()
    for axes, p in zip(every, profiles, strict=False):
        position = 1e3 * (p.position - np.average(p.position, weights=np.maximum(p.counts, 1e-300)))
        axes.step(position, p.counts, where="mid", color="0.6", lw=0.8)
        if p.curve is not None:
            axes.plot(position, p.curve, color=COLOUR[p.plane], lw=1.2)
        settings = [f"{n} = {v[p.row]:.4g}" for n, v in fit.scan.settings.items()]
        axes.set_title(", ".join(settings) or (fit.scan.screen or [""])[p.row], fontsize=7)
        axes.set_yticks([])
        axes.tick_params(labelsize=7)
    for axes in every[len(profiles) :]:
        axes.set_axis_off()
    figure.supxlabel(f"{profiles[0].plane}, mm from the centre of each profile", fontsize=9)


def has_ellipses(p: PlaneFit) -> bool:
    """Return True if the data determine β and α, at the start and at the screen."""
    numbers = (p.emittance, p.beta, p.alpha, p.screen.beta, p.screen.alpha)
    determined = all(q.error is not None and math.isfinite(q.value) for q in numbers)
    return determined and p.emittance.value > 0


def draw_ellipses(figure: FigureBase, fit: EmittanceFit) -> None:
    """Draw the one-sigma phase ellipses at the start of the line and at the screen.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    fit : EmittanceFit
        A fit that determines β and α of at least one plane.
    """
    drawn = [p for p in fit.planes if has_ellipses(p)]
    start, screen = figure.subplots(1, 2)
    for p in drawn:
        _ellipse(start, p, p.beta.value, p.alpha.value)
        _ellipse(screen, p, p.screen.beta.value, p.screen.alpha.value)
    start.set_title("phase ellipse at the start")
    screen.set_title(f"at {drawn[0].screen.name}")
    for axes in (start, screen):
        axes.set(xlabel="position, µm", ylabel="angle, µrad")
        axes.axhline(0, color="0.85", lw=0.8, zorder=0)
        axes.axvline(0, color="0.85", lw=0.8, zorder=0)
    legend_below(figure, start, 2)


def _ellipse(axes: Axes, p: PlaneFit, beta: float, alpha: float) -> None:
    """Draw the one-sigma ellipse u = sqrt(εβ) cos φ, u' = -sqrt(ε/β)(α cos φ + sin φ)."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    e = p.emittance.value
    u = np.sqrt(e * beta) * np.cos(turn)
    angle = -np.sqrt(e / beta) * (alpha * np.cos(turn) + np.sin(turn))
    axes.plot(1e6 * u, 1e6 * angle, color=COLOUR[p.plane], label=p.plane)
