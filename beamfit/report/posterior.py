"""What a report says of a sampled posterior: verdict, intervals, correlations, diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from importlib.metadata import version

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from matplotlib.ticker import MaxNLocator, NullLocator

from beamfit.report.document import BLUE, MANY, Page, Picture, Verdict
from beamfit.report.emittance import COLOUR
from beamfit.sampling.likelihood import noise_words
from beamfit.sampling.posterior import Expected, Posterior
from beamfit.sampling.summary import in_unit, plain_name
from beamfit.studies.decay.fit import DecayFit
from beamfit.studies.decay.posterior import expected_current
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.posterior import expected_sizes
from beamfit.table import Table

__all__ = ["draw_pairs", "with_beam_posterior", "with_decay_posteriors"]

# Shares of the draws inside the contours of one and two standard deviations in two dimensions.
INSIDE = (0.393, 0.865)
MOST_NUMBERS = 5
# Draws beyond these quantiles are outside the axes.
EDGE = 0.01
# Beyond this correlation the bins of a histogram are wider than the distribution.
ON_A_LINE = 0.95
INTERVALS = (
    "Central credible intervals of the sampled posterior. Where the prior or the bounds decide a "
    "number and not the data, none is given."
)
MOST_CORRELATED = 8


def with_beam_posterior(page: Page, fit: EmittanceFit, posterior: Posterior) -> Page:
    """Add a posterior to the page of an emittance fit.

    Parameters
    ----------
    page : Page
        Of the fit.
    fit : EmittanceFit
        The fit.
    posterior : Posterior
        Of its `sample`.

    Returns
    -------
    Page
    """
    return _added(page, [("", posterior)], _beam_pictures(fit, posterior))


def with_decay_posteriors(page: Page, pairs: Sequence[tuple[DecayFit, Posterior]]) -> Page:
    """Add the posteriors of decays to their page."""
    pictures = [picture for fit, found in pairs for picture in _decay_pictures(fit, found)]
    names = [(f"{fit.record}: " if len(pairs) > 1 else "", found) for fit, found in pairs]
    return _added(page, names, pictures)


def _added(page: Page, named: Sequence[tuple[str, Posterior]], pictures: list[Picture]) -> Page:
    verdicts = [
        Verdict(found.status, f"{name}posterior {_headline(found)}", found.message)
        for name, found in named
    ]
    intervals = [found.table(f"{name}Posterior", INTERVALS) for name, found in named]
    further = [
        table
        for name, found in named
        if found.chain.size
        for table in (
            _correlations(name, found),
            _how_sampled(f"{name}How the posterior was sampled", found),
        )
    ]
    return page._replace(
        verdicts=page.verdicts + verdicts,
        tables=page.tables[:1] + intervals + page.tables[1:] + further,
        pictures=page.pictures + pictures,
    )


def _headline(found: Posterior) -> str:
    return "sampled" if found.chain.size else "not sampled"


def _correlations(name: str, found: Posterior) -> Table:
    names = [each for each in found.shown if not each.endswith(".emittance")]
    names = [each for each in names if "sigma" not in each][:MOST_CORRELATED] or names
    values = found.correlations(names).values
    count = len(names)
    rows = [
        [
            f"{i + 1} {plain_name(each)}",
            *(_coefficient(v) for v in row[: i + 1]),
            *[""] * (count - i - 1),
        ]
        for i, (each, row) in enumerate(zip(names, values, strict=True))
    ]
    title = f"{name}Correlations of the posterior"
    return Table(title, ["", *(str(i + 1) for i in range(count))], rows, numeric=True)


def _coefficient(value: float) -> str:
    """Two digits, and more where one and nearly one would look the same."""
    nearly_one = 0.99 < abs(value) < 0.99995
    return f"{value:.4f}" if nearly_one else f"{value:.2f}".replace("-0.00", "0.00")


def _how_sampled(title: str, found: Posterior) -> Table:
    """How the draws were made and what they are worth."""
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
        Where to.
    posterior : Posterior
        With draws.
    names : sequence of str
        Numbers.
    title : str
        Of the whole.
    colour : str
        Of the draws.
    """
    scaled = [in_unit(posterior.values(name), posterior.unit(name)) for name in names]
    labels = [_label(name, unit) for name, (_, unit) in zip(names, scaled, strict=True)]
    values = [v for v, _ in scaled]
    n = len(names)
    if (engine := figure.get_layout_engine()) is not None and hasattr(figure, "savefig"):
        engine.set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)
    grid = figure.subplots(n, n, squeeze=False)
    for row in range(n):
        for column in range(n):
            axes: Axes = grid[row, column]
            if column > row:
                axes.set_axis_off()
                continue
            if column == row:
                _single(axes, values[row], colour)
            else:
                _pair(axes, values[column], values[row], colour)
            axes.set_xlim(*_ends(values[column]))
            axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
            axes.yaxis.set_major_locator(
                NullLocator() if column == row else MaxNLocator(3, prune="both")
            )
            axes.tick_params(labelsize=7)
            axes.ticklabel_format(useOffset=False)
            axes.tick_params(axis="x", rotation=40, labelbottom=row == n - 1)
            if column == 0 and row > 0:
                axes.set_ylabel(labels[row], fontsize=8)
            elif column != row:
                axes.tick_params(axis="y", labelleft=False)
            if row == n - 1:
                axes.set_xlabel(labels[column], fontsize=8)
    figure.align_labels()
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")


def _label(name: str, unit: str) -> str:
    words = plain_name(name.rsplit(".", 1)[-1])
    short = words.replace("normalised emittance", "norm. emittance")
    return f"{short}\n{unit}".strip()


def _ends(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, (EDGE, 1 - EDGE))
    margin = 0.05 * (high - low) or 1.0
    return float(low - margin), float(high + margin)


def _single(axes: Axes, values: np.ndarray, colour: str) -> None:
    low, high = _ends(values)
    axes.hist(values, np.linspace(low, high, 41), color=colour, alpha=0.35, histtype="stepfilled")
    for place, style in zip(np.quantile(values, (0.16, 0.5, 0.84)), (":", "-", ":"), strict=True):
        axes.axvline(place, color=colour, lw=1.1, ls=style)
    axes.spines["left"].set_visible(False)


def _pair(axes: Axes, x: np.ndarray, y: np.ndarray, colour: str) -> None:
    """Contours that hold 39 and 86 % of the draws; dots where they lie on a line."""
    if abs(np.corrcoef(x, y)[0, 1]) > ON_A_LINE:
        axes.plot(x[:2000], y[:2000], "o", ms=1, color=colour, alpha=0.4, rasterized=True)
        axes.set_ylim(*_ends(y))
        return
    (low, high), (bottom, top) = _ends(x), _ends(y)
    edges = np.linspace(low, high, 36), np.linspace(bottom, top, 36)
    count, _, _ = np.histogram2d(x, y, edges)
    smooth = _smoothed(count)
    ordered = np.sort(smooth.ravel())[::-1]
    share = np.cumsum(ordered) / ordered.sum()
    levels = sorted({float(ordered[np.searchsorted(share, inside)]) for inside in INSIDE})
    middles = [0.5 * (edge[1:] + edge[:-1]) for edge in edges]
    if len(levels) == 2 and levels[0] > 0:
        filled = [*levels, 1.01 * ordered[0]]
        axes.contourf(*middles, smooth.T, filled, colors=[colour, colour], alpha=0.3)
        axes.contour(*middles, smooth.T, levels, colors=colour, linewidths=0.9)
    else:
        axes.plot(x[:2000], y[:2000], ",", color=colour, rasterized=True)
    axes.set_ylim(bottom, top)


def _smoothed(count: np.ndarray) -> np.ndarray:
    """Each bin shared with its neighbours: contours follow the shape and not the counting noise."""
    kernel = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    for axis in (0, 1):
        count = np.apply_along_axis(np.convolve, axis, count, kernel, mode="same")
    return count


def draw_expected_sizes(
    figure: FigureBase, fit: EmittanceFit, posterior: Posterior, plane: str
) -> None:
    """Draw measured sizes less the median model, in the posterior's bands.

    Parameters
    ----------
    figure : Figure or SubFigure
        Where to.
    fit : EmittanceFit
        The fit.
    posterior : Posterior
        Of its `sample`.
    plane : str
        "x" or "y".
    """
    p, found = fit[plane].points, expected_sizes(posterior, plane)
    varied = [n for n, v in p.settings.items() if np.ptp(v) > 0]
    if len(varied) == 1:
        at, label = p.settings[varied[0]], f"{varied[0]}, {p.units[varied[0]]}"
    else:
        at, label = np.arange(1, len(p.size) + 1), "measurement"
    axes: Axes = figure.subplots()
    _bands(axes, at, 1e6 * p.size, 1e6 * p.error, found, 1e6, COLOUR[plane])
    axes.set_xlabel(label)
    axes.set_ylabel("size - median model, µm")
    axes.set_title(f"{plane} plane: what the posterior expects")


def draw_expected_current(figure: FigureBase, fit: DecayFit, posterior: Posterior) -> None:
    """Draw readings less the median model, in the posterior's bands."""
    record = fit.readings
    axes: Axes = figure.subplots()
    found, hours = expected_current(posterior), record.time / 3600.0
    _bands(axes, hours, record.current, record.error, found, 1.0, BLUE)
    axes.set_xlabel("time, h")
    axes.set_ylabel("current - median model, mA")
    axes.set_title(f"{record.name}: what the posterior expects")


def _bands(
    axes: Axes,
    at: np.ndarray,
    measured: np.ndarray,
    error: np.ndarray | None,
    found: Expected,
    unit: float,
    colour: str,
) -> None:
    order = np.argsort(at, kind="stable")
    middle = unit * found.median
    many = len(at) > MANY
    for ends, alpha, label in (
        (found.reading, 0.12, "95 % of further readings"),
        (found.model, 0.35, "68 % of models"),
    ):
        low, high = (unit * ends - middle)[:, order]
        axes.fill_between(at[order], low, high, color=colour, alpha=alpha, lw=0, label=label)
    axes.axhline(0, color="0.6", lw=0.8)
    style = {"fmt": "o", "color": "black", "ms": 2 if many else 4, "capsize": 0 if many else 2}
    axes.errorbar(at, measured - middle, error, lw=0.8, rasterized=many, label="readings", **style)
    inside = unit * found.reading - middle
    reach = 1.15 * max(np.max(np.abs(inside)), np.max(np.abs(measured - middle)))
    axes.set_ylim(-reach, reach)
    axes.figure.legend(frameon=False, loc="outside lower center", ncols=3)


def _beam_pictures(fit: EmittanceFit, posterior: Posterior) -> list[Picture]:
    """Two pictures a sampled plane."""
    if not posterior.chain.size:
        return []
    sampled = [(p.plane, names) for p in fit.planes if (names := _of_plane(posterior, p.plane))]
    expected = [
        Picture(
            f"sizes expected in the {plane} plane",
            3.4,
            partial(draw_expected_sizes, fit=fit, posterior=posterior, plane=plane),
        )
        for plane, _ in sampled
    ]
    pairs = [
        Picture(
            f"numbers of the {plane} plane in pairs",
            _height(names),
            partial(
                draw_pairs,
                posterior=posterior,
                names=names,
                title=f"{plane} plane: posterior",
                colour=COLOUR[plane],
            ),
        )
        for plane, names in sampled
    ]
    return expected + pairs


def _of_plane(posterior: Posterior, plane: str) -> list[str]:
    wanted = ["normalized_emittance", "beta", "alpha", "error_factor", "outlier_fraction"]
    names = [f"{plane}.{name}" for name in wanted]
    # What was fitted besides the beam, in a scenario.
    names += [name for name in posterior.names if not name.startswith(("x.", "y.", "beam."))]
    return [name for name in names if name in posterior.shown][:MOST_NUMBERS]


def _decay_pictures(fit: DecayFit, posterior: Posterior) -> list[Picture]:
    """Two pictures a sampled decay."""
    if not posterior.chain.size:
        return []
    wanted = ("lifetime_mean", "a", "b", "noise", "error_factor", "outlier_fraction")
    names = [name for name in wanted if name in posterior.shown][:MOST_NUMBERS]
    return [
        Picture(
            f"numbers of {fit.record} in pairs",
            _height(names),
            partial(draw_pairs, posterior=posterior, names=names, title=f"{fit.record}: posterior"),
        ),
        Picture(
            f"current expected of {fit.record}",
            3.4,
            partial(draw_expected_current, fit=fit, posterior=posterior),
        ),
    ]


def _height(names: Sequence[str]) -> float:
    return 1.0 + 1.15 * len(names)
