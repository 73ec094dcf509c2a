"""Report of a density in phase space: contours, profiles, emittance against charge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import FigureBase

from beamfit.answer import Table, cell
from beamfit.density.charge import FINE_AXIS
from beamfit.density.fit import SHARES, DensityFit, PlaneDensity
from beamfit.quantity import Quantity
from beamfit.report.document import BLUE, RED, Picture, ReportPage, Verdict, contour_levels
from beamfit.report.emittance import about_input, about_scan

# Profiles in a row of the picture.
PROFILES_PER_ROW = 4
# Shares of the charge inside the contours.
CONTOURS = (0.95, 0.9, 0.68, 0.5)
# Half-width of the drawn phase space, in rms sizes.
HALF_WIDTH = 4.0


def density_page(fit: DensityFit) -> ReportPage:
    """Make the page of a density fit.

    Parameters
    ----------
    fit : DensityFit
        Result of `beamfit.fit_density`.

    Returns
    -------
    ReportPage
    """
    pictures, source = [], f"{fit.scan.name}, {len(fit.scan)} settings"
    for p in fit.planes:
        if p.densities is None:
            continue
        rows = math.ceil(len(p.profiles) / PROFILES_PER_ROW)
        methods = [said[p.plane] for said in fit.stored.values() if p.plane in said]
        draw = partial(draw_density, plane=p, methods=methods)
        draw_all = partial(draw_profiles, plane=p)
        pictures.append(Picture(f"density in {p.plane}, emittance against charge", 3.2, draw,
                                source))  # fmt: skip
        pictures.append(Picture(f"profiles in {p.plane}", 0.6 + 1.9 * rows, draw_all, source))
    return ReportPage(
        title=f"Phase-space density of {fit.scan.name}",
        subtitle=f"{len(fit.scan)} settings, {len(fit.scan.profiles)} profiles",
        verdicts=[
            Verdict(p.status, f"{p.plane}: 90 % of the charge {p.emittance['90 %']}", p.message)
            for p in fit.planes
        ],
        tables=[
            *fit.tables(),
            *map(_profile_table, fit.planes),
            *_method_table(fit),
            *about_input(fit.notes),
        ],
        pictures=pictures,
        pictures_title="Phase space and profiles",
        leading=len(fit.planes),
        **about_scan(fit.scan),
    )


def _profile_table(plane: PlaneDensity) -> Table:
    """Make the table of profiles compared with the density."""
    d = plane.densities
    rows = []
    for k, (label, p) in enumerate(zip(plane.labels, plane.profiles, strict=True)):
        numbers = ["-", "-"]
        if d is not None:
            stretch, beyond = 100.0 * d.stretch[k], 100.0 * max(plane.beyond[k], 0.0)
            numbers = [f"{stretch:+.1f} %", f"{beyond:.1f} %"]
        rows.append([label, str(p.shots), f"{1e6 * p.size:.4g}", *numbers])
    head = ["setting", "shots", "rms, µm", "wider than the density", "beyond the window"]
    return Table(f"Profiles in {plane.plane}", head, rows)


def _method_table(fit: DensityFit) -> list[Table]:
    """Make the table of emittances stated in the file, by size method."""
    rows = [
        [name, *(cell(said.get(p.plane)) for p in fit.planes)] for name, said in fit.stored.items()
    ]
    header = ["size method", *(p.plane for p in fit.planes)]
    return [Table("Normalised emittances in the file, by size method", header, rows)] * bool(rows)


def draw_density(figure: FigureBase, plane: PlaneDensity, methods: Sequence[Quantity] = ()) -> None:
    """Draw the density with its contours, and emittance against charge with bands.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    plane : PlaneDensity
        Plane with a density.
    methods : sequence of Quantity
        Emittances by size methods, marked at the right edge.
    """
    axes, right = figure.subplots(1, 2)
    d, density = plane.densities, np.maximum(plane.density, 0.0)
    levels = contour_levels(density, CONTOURS)
    u = np.stack(np.meshgrid(FINE_AXIS, FINE_AXIS, indexing="ij"), -1) @ d.frame.T
    x, angle = 1e3 * u[..., 0], 1e3 * u[..., 1]
    axes.pcolormesh(x, angle, density, cmap="viridis", shading="gouraud", rasterized=True)
    axes.set_facecolor(colormaps["viridis"](0.0))
    axes.contour(x, angle, density, levels=levels, colors="w", linewidths=0.7)
    wide, high = 1e3 * HALF_WIDTH * np.hypot(*d.frame.T)
    axes.set(xlabel=f"{plane.plane}, mm", ylabel=f"{plane.plane}′, mrad")
    axes.set(xlim=(-wide, wide), ylim=(-high, high))
    axes.set_title("contours of 50, 68, 90 and 95 % of the charge", fontsize=7)
    share = 100.0 * np.array(SHARES)
    every = list(plane.emittance.values())
    has_error = [q.error is not None for q in every]
    value = 1e6 * np.array([q.value for q in every])
    for part, alpha in (("95", 0.15), ("68", 0.3)):
        low, high = _band(every, part)
        right.fill_between(share, low, high, where=has_error, color=BLUE, alpha=alpha, lw=0)
    right.plot(share, value, "o-", color=BLUE, ms=4, lw=1.0)
    open_ = [not k for k in has_error]
    right.plot(share[open_], value[open_], "o", color=RED, ms=5, mfc="w")
    said = ["○ not determined"] * any(open_) + ["– size methods"] * bool(methods)
    right.set(xlabel="share of the charge, %", ylabel="normalised emittance, µm")
    right.set_title("   ".join(said), fontsize=7)
    for q in methods:
        right.plot(101.5, 1e6 * q.value, marker="_", color="0.4", ms=7)
    right.set_ylim(bottom=0.0)


def _band(every: list, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of an interval of each emittance in µm; the value if there is none."""
    ends = []
    for q in every:
        if q.error is None:
            ends.append((q.value, q.value))
        elif part == "95":
            ends.append(q.interval_95)
        else:
            ends.append((q.value - q.error, q.value + q.error))
    return tuple(1e6 * np.array(ends).T)


def draw_profiles(figure: FigureBase, plane: PlaneDensity) -> None:
    """Draw each profile with the projection of the density, and the pulls below.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    plane : PlaneDensity
        Plane with a density.
    """
    d, bins = plane.densities, plane.densities.bins
    across = min(PROFILES_PER_ROW, len(plane.profiles))
    down = math.ceil(len(plane.profiles) / across)
    grid = figure.subplots(2 * down, across, squeeze=False, height_ratios=[3, 1] * down,
                           sharex=True)  # fmt: skip
    for axes in grid.ravel():
        axes.set_axis_off()
    for k, label in enumerate(plane.labels):
        at = bins.profile == k
        upper, lower = (grid[2 * (k // across) + i, k % across] for i in (0, 1))
        for axes in (upper, lower):
            axes.set_axis_on()
            axes.tick_params(labelsize=6)
        upper.step(bins.position[at], bins.charge[at], where="mid", color="0.6", lw=0.8)
        upper.plot(bins.position[at], d.fitted[at], color=BLUE, lw=1.0)
        upper.set_title(label.split(" = ")[-1] if label.count("=") == 1 else label, fontsize=7)
        upper.set_yticks([])
        pull = (bins.charge[at] - d.fitted[at]) / d.error[at]
        lower.bar(bins.position[at], pull, 0.2, color="0.5")
        lower.set_ylim(-4.0, 4.0)
    figure.supxlabel("position in rms sizes; below: residual in errors of a bin", fontsize=8)
