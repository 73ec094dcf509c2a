"""The report of an emittance fit: its tables, the scan with its residuals, the ellipses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from beamfit.report.document import (
    BLUE,
    MANY,
    RED,
    Page,
    Picture,
    Verdict,
    legend_below,
    provenance,
    written,
)
from beamfit.status import Status
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.results import (
    PlaneFit,
    identifiability_rows,
    parameter_rows,
    point_rows,
    result_rows,
)
from beamfit.studies.scan.scans import Profile
from beamfit.studies.scan.sensitivity import budget_rows, range_rows
from beamfit.studies.scan.size_methods import SizeMethods
from beamfit.table import Table, labelled

__all__ = [
    "COLOUR",
    "ERRORS",
    "draw_ellipses",
    "draw_profiles",
    "draw_scan",
    "emittance_page",
    "headline",
    "setting_axis",
]

# Profiles in a row of the picture, and in all.
PROFILES_ABREAST, MOST_PROFILES = 3, 12
COLOUR = {"x": BLUE, "y": RED}

ERRORS = (
    "Errors are one standard deviation, scaled by sqrt(χ²/dof) where that exceeds 1. "
    "“Not determined” means the data put no error on the value; it is not to be quoted."
)
METHODS = (
    "“Measured weights” is emittance_gui's own method, computed here. The error over all methods "
    "has the spread of the methods in it, as a systematic."
)


def emittance_page(
    fit: EmittanceFit,
    command: str | None,
    inputs: Mapping[str, str | None] | None,
    methods: tuple[SizeMethods, ...] = (),
) -> Page:
    """Lay out an emittance fit.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.
    command : str or None
        The command that made it.
    inputs : mapping of str to str, or None
        Input files and their SHA-256; the scan's own if None.
    methods : tuple of SizeMethods
        What other ways of taking the sizes say.

    Returns
    -------
    Page
    """
    scan, line = fit.scan, fit.line
    if inputs is None:
        inputs = {str(scan.path): scan.sha256} if scan.path else {}
    names = [p.plane for p in fit.planes]
    source = scan.error_source if scan.error else "none in the file; inferred"
    tables = [
        labelled("Result", names, result_rows(fit.planes), ERRORS),
        labelled("What the data determine", names, identifiability_rows(fit.planes)),
        *(_budgets(fit, names) if fit.statement.closed else _fitted_too(fit)),
        *(Table(f"Points, {p.plane} plane", *point_rows(p), numeric=True) for p in fit.planes),
    ]
    tables += [way.table()._replace(note=METHODS) for way in methods]
    if fit.notes:
        tables.append(Table("About the input", [], [[note] for note in fit.notes]))
    energy = f"{float(line.energy):g} MeV"
    if not fit.statement.closed:
        energy += f", scenario {fit.scenario}"
    return Page(
        title=f"Emittance of {scan.name}",
        subtitle=f"{len(scan)} settings on line {line.name}, {energy}; {written()}",
        verdicts=[Verdict(p.status, f"{p.plane}: {headline(p)}", p.message) for p in fit.planes],
        tables=tables,
        pictures=_pictures(fit),
        pictures_title="Scan and fit",
        provenance=provenance(inputs, [("errors of the sizes", source)], command),
        notes=scan.provenance,
    )


def _budgets(fit: EmittanceFit, names: list[str]) -> list[Table]:
    """What the emittance would be with another line or fewer points."""
    changed = "Relative change of the normalised emittance, from exact derivatives."
    shifted = "Normalised emittance, and its shift in standard errors of the full fit."
    title, other = "If the line were a little different", "If some points were left out"
    return [
        labelled(title, names, budget_rows(fit), changed, numeric=True),
        labelled(other, names, range_rows(fit), shifted),
    ]


def _fitted_too(fit: EmittanceFit) -> list[Table]:
    """What a scenario fitted besides the beam, and what the data leave open."""
    header, parts = ["fitted too", "value", "bounds", "prior", "state"], []
    rows = [[name, *cells] for name, cells in parameter_rows(fit.parameters)]
    if rows:
        # What ties a network to the lattice; a calibration has priors instead.
        anchor = f"Anchor: {fit.anchor}." if fit.statement.network else ""
        parts.append(Table(f"Scenario {fit.scenario}", header, rows, anchor))
    if fit.null_directions:
        listed = [[words + "."] for words in fit.null_directions]
        parts.append(Table("Left open by the data", [], listed))
    return parts


def headline(p: PlaneFit) -> str:
    """The emittance of a plane, or that it is not determined."""
    if p.status is Status.unidentified:
        return "emittance not determined"
    return f"normalised emittance {p.normalized_emittance}"


def draw_scan(figure: FigureBase, fit: EmittanceFit, plane: str) -> None:
    """Draw one plane's sizes with the fit, and the residuals in standard errors below.

    One varied magnet gives a curve against its setting; several give the points in order.

    Parameters
    ----------
    figure : Figure or SubFigure
        Where to.
    fit : EmittanceFit
        The fit.
    plane : str
        "x" or "y".
    """
    p = fit[plane]
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    at, words = setting_axis(p)
    one = _varied(p) if fit.statement.whole_map and not fit.scan.transfer else []
    if len(one) == 1:
        _curves(above, fit, p, one[0])
    else:  # known at the measured settings alone
        above.plot(at, 1e6 * p.points.model, "_", ms=14, mew=2, color=COLOUR[plane], alpha=0.6)
    _points(above, p, at)
    above.set(title=f"{plane} plane: {headline(p)}", ylabel="rms size, µm", ylim=(0.0, None))
    below.axhspan(-1, 1, color="0.93")
    below.axhline(0, color="0.6", lw=0.8)
    below.plot(at, p.points.pull, "o", color=COLOUR[plane], ms=5, rasterized=len(at) > MANY)
    finite = np.abs(p.points.pull[np.isfinite(p.points.pull)])
    reach = max(3.0, 1.15 * float(finite.max(initial=0.0)))
    below.set(xlabel=words, ylabel="residual,\nstd. errors", ylim=(-reach, reach))


def _varied(p: PlaneFit) -> list[str]:
    return [name for name, values in p.points.settings.items() if np.ptp(values) > 0]


def setting_axis(p: PlaneFit) -> tuple[np.ndarray, str]:
    """Against what points are drawn: the setting of the one varied magnet, or else their number."""
    varied = _varied(p)
    if len(varied) != 1:
        return np.arange(1, len(p.points.size) + 1), "measurement"
    return p.points.settings[varied[0]], f"{varied[0]}, {p.points.units[varied[0]]}"


def _curves(axes: Axes, fit: EmittanceFit, p: PlaneFit, magnet: str) -> None:
    """One fitted curve for each screen, with the one-sigma band where σ has errors."""
    values = p.points.settings[magnet]
    margin = 0.04 * np.ptp(values)
    grid = np.linspace(values.min() - margin, values.max() + margin, 201)
    settings = {n: np.median(v) for n, v in p.points.settings.items()} | {magnet: grid}
    screens = tuple(dict.fromkeys(p.points.screen))
    for index, screen in enumerate(screens):
        found = fit.predict(settings, p.plane, screen=screen)
        style = ["-", "--", ":", "-."][index % 4]
        name = "fit" if len(screens) == 1 else f"fit at {screen}"
        axes.plot(grid, 1e6 * found.size, style, color=COLOUR[p.plane], lw=1.6, label=name)
        if np.isfinite(found.error).all():
            low, high = found.size - found.error, found.size + found.error
            band = (1e6 * np.maximum(low, 0), 1e6 * high)
            axes.fill_between(grid, *band, color=COLOUR[p.plane], alpha=0.15, lw=0)
    axes.legend(frameon=False, loc="best")


def _points(axes: Axes, p: PlaneFit, at: np.ndarray) -> None:
    """Measured points; what the robust fit doubts is drawn hollow."""
    error = np.nan_to_num(1e6 * p.points.error)
    doubt = p.points.outlier_probability
    good = np.ones(len(at), bool) if doubt is None else doubt < 0.5
    for keep, face in ((good, COLOUR[p.plane]), (~good, "white")):
        if keep.any():
            style = {"fmt": "o", "ms": 5, "capsize": 3, "color": COLOUR[p.plane], "mfc": face}
            size = 1e6 * p.points.size[keep]
            axes.errorbar(at[keep], size, error[keep], rasterized=len(at) > MANY, **style)


def draw_profiles(figure: FigureBase, profiles: list[Profile], fit: EmittanceFit) -> None:
    """Draw the projected profiles from which sizes of one plane were taken.

    Parameters
    ----------
    figure : Figure or SubFigure
        Where to.
    profiles : list of Profile
        Of one plane.
    fit : EmittanceFit
        For the settings of their rows.
    """
    across = min(PROFILES_ABREAST, len(profiles))
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
    figure.suptitle(f"projected profiles in {profiles[0].plane}, mm from their centres", fontsize=9)


def draw_ellipses(figure: FigureBase, fit: EmittanceFit) -> None:
    """Draw the one-sigma phase ellipses at the start of the line and at the screen.

    Parameters
    ----------
    figure : Figure or SubFigure
        Where to.
    fit : EmittanceFit
        A fit with a positive emittance in at least one plane.
    """
    drawn = [p for p in fit.planes if _has_ellipses(p)]
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


def _pictures(fit: EmittanceFit) -> list[Picture]:
    listed = [
        Picture(f"scan of the {p.plane} plane", 4.6, partial(draw_scan, fit=fit, plane=p.plane))
        for p in fit.planes
    ]
    for p in fit.planes:
        if shown := [f for f in fit.scan.profiles if f.plane == p.plane][:MOST_PROFILES]:
            height = 0.6 + 1.3 * math.ceil(len(shown) / PROFILES_ABREAST)
            draw = partial(draw_profiles, profiles=shown, fit=fit)
            listed.append(Picture(f"profiles of the {p.plane} plane", height, draw))
    if any(_has_ellipses(p) for p in fit.planes):
        listed.append(Picture("phase ellipses", 3.4, partial(draw_ellipses, fit=fit)))
    return listed


def _has_ellipses(p: PlaneFit) -> bool:
    """Whether the beam has an area, and is known at the screen as well."""
    return p.emittance.value > 0 and bool(np.isfinite(p.screen.beta.value))


def _ellipse(axes: Axes, p: PlaneFit, beta: float, alpha: float) -> None:
    """The points (u, u') of one sigma: u = sqrt(εβ) cos φ, u' = -sqrt(ε/β)(α cos φ + sin φ)."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    e = p.emittance.value
    u = np.sqrt(e * beta) * np.cos(turn)
    angle = -np.sqrt(e / beta) * (alpha * np.cos(turn) + np.sin(turn))
    sure = p.status is not Status.unidentified
    label = p.plane if sure else f"{p.plane} (not determined)"
    axes.plot(1e6 * u, 1e6 * angle, "-" if sure else ":", color=COLOUR[p.plane], label=label)
