"""Sampled posteriors in a report: verdict, intervals, correlations, diagnostics."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from matplotlib.ticker import MaxNLocator, NullLocator
from scipy.ndimage import gaussian_filter

from beamfit.answer import Table, plain_name
from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.posterior import expected_sizes
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.posterior import expected_current
from beamfit.quantity import HOUR
from beamfit.report.document import (
    BLUE,
    RASTER_POINTS,
    Picture,
    ReportPage,
    Verdict,
    contour_levels,
    legend_below,
)
from beamfit.report.scan_pictures import COLOUR, setting_axis, source_of
from beamfit.sampling.likelihood import noise_words
from beamfit.sampling.posterior import Expected, Posterior, in_unit

# Shares of the draws inside the contours of one and two standard deviations in two dimensions.
CONTOUR_SHARES = tuple(1 - math.exp(-0.5 * r**2) for r in (1, 2))
# Largest number of parameters in a corner plot; more would be too small to read.
MAX_NUMBERS = 5
# Quantile of the draws at which the axes end.
AXIS_QUANTILE = 0.01
# Correlation above which dots replace contours, because the bins are wider than the distribution.
MAX_CORRELATION = 0.95
INTERVALS = (
    "Central credible intervals of the sampled posterior. Where the prior or the bounds decide a "
    "number and not the data, none is given."
)
# Largest number of parameters in the table of correlations.
MAX_CORRELATED = 8


class ReportedPosterior(NamedTuple):
    """Posterior in a report: a label if there are several, and its pictures."""

    label: str
    posterior: Posterior
    pictures: list[Picture]


def with_posteriors(page: ReportPage, sampled: Sequence[ReportedPosterior]) -> ReportPage:
    """Add posteriors to a page: intervals after the first table, the rest at the end.

    Parameters
    ----------
    page : ReportPage
        Page of the fits.
    sampled : sequence of ReportedPosterior
        Results of `of_scan` or `of_decay`.

    Returns
    -------
    ReportPage
    """
    verdicts, intervals, further = [], [], []
    for label, found, _ in sampled:
        said = "sampled" if found.chain.size else "not sampled"
        verdicts.append(Verdict(found.status, f"{label}posterior {said}", found.message))
        intervals.append(found.table(f"{label}Posterior", INTERVALS))
        if found.chain.size:
            further.append(_correlations(f"{label}Correlations of the posterior", found))
            further.append(_sampling_table(f"{label}How the posterior was sampled", found))
    return page._replace(
        verdicts=page.verdicts + verdicts,
        tables=page.tables[:1] + intervals + page.tables[1:] + further,
        pictures=[*page.pictures, *(picture for each in sampled for picture in each.pictures)],
    )


def _correlations(title: str, found: Posterior) -> Table:
    names = [each for each in found.shown if not each.endswith(".emittance")]
    names = [each for each in names if "sigma" not in each][:MAX_CORRELATED] or names
    rows = []
    for i, row in enumerate(found.correlations(names).values):
        rows.append([f"{i + 1} {plain_name(names[i])}", *map(_coefficient, row[: i + 1])])
    return Table(title, ["", *(str(i + 1) for i in range(len(names)))], rows, numeric=True)


def _coefficient(value: float) -> str:
    """Write two digits, or four for a coefficient that would round to one."""
    nearly_one = 0.99 < abs(value) < 0.99995
    return f"{value:.4f}" if nearly_one else f"{value:.2f}".replace("-0.00", "0.00")


def _sampling_table(title: str, found: Posterior) -> Table:
    """Make a table of the sampling: noise, priors, draws, convergence."""
    d = found.diagnostics
    rows = [
        ["status", found.status.value.replace("_", " ")],
        ["errors of the points", noise_words(found.target.groups)],
        ["priors", "; ".join(f"{n}: {p}" for n, p in found.priors.items()) or "flat"],
    ]
    if d.steps:
        rows += [
            ["draws", f"{d.steps} steps of {d.walkers} walkers after {found.warmup} left out"],
            ["effective draws, fewest", f"{np.min(d.effective):.0f}"],
            ["autocorrelation time, longest", f"{np.max(d.autocorrelation):.1f} steps"],
            ["split R-hat, largest", f"{np.max(d.rhat):.4f}"],
            ["proposals accepted", f"{100 * found.acceptance:.0f} %"],
            ["seed", str(found.seed)],
            ["sampler", f"emcee {version('emcee')}"],
        ]
    return Table(title, [], rows)


def draw_pairs(
    figure: FigureBase,
    posterior: Posterior,
    names: Sequence[str],
    title: str = "",
    colour: str = BLUE,
) -> None:
    """Draw the distribution of each number and of each pair.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    posterior : Posterior
        Posterior with draws.
    names : sequence of str
        Parameters to draw.
    title : str
        Title of the figure.
    colour : str
        Colour of the draws.
    """
    scaled = [in_unit(posterior.values(name), posterior.unit(name)) for name in names]
    labels = [_label(name, unit) for name, (_, unit) in zip(names, scaled, strict=True)]
    values = [v for v, _ in scaled]
    n = len(names)
    if (engine := figure.get_layout_engine()) is not None and hasattr(figure, "savefig"):
        engine.set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)
    grid = figure.subplots(n, n, squeeze=False)
    for (row, column), axes in np.ndenumerate(grid):
        if column > row:
            axes.set_axis_off()
            continue
        if column == row:
            _histogram(axes, values[row], colour)
        else:
            _pair(axes, values[column], values[row], colour)
            axes.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
        axes.set_xlim(*_axis_limits(values[column]))
        axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
        axes.ticklabel_format(useOffset=False)
        axes.tick_params(labelsize=7, labelleft=column == 0)
        axes.tick_params(axis="x", rotation=40, labelbottom=row == n - 1)
        if column == 0 < row:
            axes.set_ylabel(labels[row], fontsize=8)
        if row == n - 1:
            axes.set_xlabel(labels[column], fontsize=8)
    figure.align_labels()
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")


def _label(name: str, unit: str) -> str:
    words = plain_name(name.rsplit(".", 1)[-1])
    short = words.replace("normalised emittance", "norm. emittance")
    return f"{short}\n{unit}".strip()


def _axis_limits(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, (AXIS_QUANTILE, 1 - AXIS_QUANTILE))
    margin = 0.05 * (high - low) or 1.0
    return float(low - margin), float(high + margin)


def _histogram(axes: Axes, values: np.ndarray, colour: str) -> None:
    low, high = _axis_limits(values)
    axes.hist(values, np.linspace(low, high, 41), color=colour, alpha=0.35, histtype="stepfilled")
    for place, style in zip(np.quantile(values, (0.16, 0.5, 0.84)), (":", "-", ":"), strict=True):
        axes.axvline(place, color=colour, lw=1.1, ls=style)
    axes.spines["left"].set_visible(False)
    axes.yaxis.set_major_locator(NullLocator())


def _pair(axes: Axes, x: np.ndarray, y: np.ndarray, colour: str) -> None:
    """Draw contours that contain 39 and 86 % of the draws, or dots if they lie on a line."""
    if abs(np.corrcoef(x, y)[0, 1]) > MAX_CORRELATION:
        axes.plot(x[:2000], y[:2000], "o", ms=1, color=colour, alpha=0.4, rasterized=True)
        axes.set_ylim(*_axis_limits(y))
        return
    (low, high), (bottom, top) = _axis_limits(x), _axis_limits(y)
    edges = np.linspace(low, high, 36), np.linspace(bottom, top, 36)
    count, _, _ = np.histogram2d(x, y, edges)
    # Smoothed, so that contours do not follow the counting noise of the bins.
    smooth = gaussian_filter(count, 1.0, mode="constant")
    levels = contour_levels(smooth, CONTOUR_SHARES)
    middles = [0.5 * (edge[1:] + edge[:-1]) for edge in edges]
    if len(levels) == 2 and levels[0] > 0:
        filled = [*levels, 1.01 * smooth.max()]
        axes.contourf(*middles, smooth.T, filled, colors=[colour, colour], alpha=0.3)
        axes.contour(*middles, smooth.T, levels, colors=colour, linewidths=0.9)
    else:
        axes.plot(x[:2000], y[:2000], ",", color=colour, rasterized=True)
    axes.set_ylim(bottom, top)


def _expectations(
    figure: FigureBase,
    title: str,
    labels: tuple[str, str],
    at: np.ndarray,
    measured: np.ndarray,
    error: np.ndarray | None,
    expect: Callable[[], Expected],
    unit: float,
    colour: str,
) -> None:
    """Draw readings minus the median model with the bands of the posterior.

    `unit` converts the values of `expect` to those of the axis.
    """
    axes, order, found = figure.subplots(), np.argsort(at, kind="stable"), expect()
    middle, many = unit * found.median, len(at) > RASTER_POINTS
    for ends, alpha, label in (
        (found.reading, 0.12, "95 % of further readings"),
        (found.model, 0.35, "68 % of models"),
    ):
        low, high = (unit * ends - middle)[:, order]
        axes.fill_between(at[order], low, high, color=colour, alpha=alpha, lw=0, label=label)
    axes.axhline(0, color="0.6", lw=0.8)
    style = {"fmt": "o", "color": "black", "ms": 2 if many else 4, "capsize": 0 if many else 2}
    axes.errorbar(at, measured - middle, error, lw=0.8, rasterized=many, label="readings", **style)
    reach = max(np.abs(unit * found.reading - middle).max(), np.abs(measured - middle).max())
    axes.set(title=f"{title}: what the posterior expects", xlabel=labels[0], ylabel=labels[1])
    axes.set_ylim(-1.15 * reach, 1.15 * reach)
    legend_below(figure, axes, 3)


def of_scan(fit: EmittanceFit, posterior: Posterior) -> ReportedPosterior:
    """Report the posterior of a scan, with two pictures per sampled plane."""
    expected, pairs = [], []
    for p in fit.planes:
        names = _of_plane(posterior, p.plane)
        if not (names and posterior.chain.size):
            continue
        at, words = setting_axis(p)
        draw = partial(
            _expectations,
            title=f"{p.plane} plane",
            labels=(words, "size - median model, µm"),
            at=at,
            measured=1e6 * p.points.size,
            error=1e6 * p.points.error,
            expect=partial(expected_sizes, posterior, p.plane),
            unit=1e6,
            colour=COLOUR[p.plane],
        )
        expected.append(
            Picture(f"sizes expected in the {p.plane} plane", 3.4, draw, source_of(fit))
        )
        words, of_plane = f"numbers of the {p.plane} plane in pairs", f"{p.plane} plane: posterior"
        pair = pairs_picture(posterior, names, of_plane, COLOUR[p.plane])
        pairs.append(pair._replace(alt=words, source=source_of(fit)))
    return ReportedPosterior("", posterior, expected + pairs)


def _of_plane(posterior: Posterior, plane: str) -> list[str]:
    candidates = ["normalized_emittance", "beta", "alpha", "error_factor", "outlier_fraction"]
    names = [f"{plane}.{name}" for name in candidates]
    # Other parameters of a scenario.
    names += [name for name in posterior.names if not name.startswith(("x.", "y."))]
    return [name for name in names if name in posterior.shown][:MAX_NUMBERS]


def of_decay(fit: DecayFit, posterior: Posterior, label: str = "") -> ReportedPosterior:
    """Report the posterior of a decay, with two pictures if it was sampled."""
    if not posterior.chain.size:
        return ReportedPosterior(label, posterior, [])
    candidates = ("lifetime_mean", "a", "b", "noise", "error_factor", "outlier_fraction")
    names = [name for name in candidates if name in posterior.shown][:MAX_NUMBERS]
    draw = partial(
        _expectations,
        title=fit.readings.name,
        labels=("time, h", "current - median model, mA"),
        at=fit.readings.time / HOUR,
        measured=fit.readings.current,
        error=fit.readings.error,
        expect=partial(expected_current, posterior, fit),
        unit=1.0,
        colour=BLUE,
    )
    pairs = pairs_picture(posterior, names, f"{fit.record}: posterior")
    pictures = [
        pairs._replace(alt=f"numbers of {fit.record} in pairs"),
        Picture(f"current expected of {fit.record}", 3.4, draw),
    ]
    return ReportedPosterior(label, posterior, pictures)


def pairs_picture(
    posterior: Posterior, names: Sequence[str], title: str = "posterior", colour: str = BLUE
) -> Picture:
    """Make the picture of some parameters of a posterior and of their pairs."""
    draw = partial(draw_pairs, posterior=posterior, names=names, title=title, colour=colour)
    return Picture("numbers in pairs", 1.0 + 1.15 * len(names), draw)
