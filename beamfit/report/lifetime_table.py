"""Report of tables of lifetimes against current."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.errors import Status
from beamfit.lifetime.lifetime_table import LifetimeFit
from beamfit.report.document import (
    BLUE,
    RED,
    Picture,
    ReportPage,
    Verdict,
    comment_notes,
    day_of,
    quality,
)

CURVE_POINTS = 200


def lifetime_table_page(fits: Sequence[LifetimeFit]) -> ReportPage:
    """Make the page of fits to tables of lifetimes."""
    read = [fit.readings for fit in fits]
    return ReportPage(
        title=f"Beam lifetime of {', '.join(table.name for table in read)}",
        subtitle=f"{sum(map(len, read))} lifetimes",
        verdicts=[Verdict.of(fit) for fit in fits],
        tables=[
            table._replace(title="Result" + f" of {fit.record}" * (len(fits) > 1))
            for fit in fits
            for table in fit.tables()
        ],
        pictures=[lifetimes_picture(fit) for fit in fits],
        pictures_title="Lifetimes and fits",
        notes=comment_notes([text for table in read for text in table.comments]),
        remarks=[(table.name, note) for table in read for note in table.notes],
    )


def lifetimes_picture(fit: LifetimeFit) -> Picture:
    """Make the picture of a table of lifetimes with its fit."""
    table = fit.readings
    chi2 = None if fit.noise_inferred else fit.chi2
    parts = [table.name, day_of(table.name, table.comments), quality(chi2, fit.dof)]
    source = ", ".join(part for part in parts if part)
    return Picture(f"lifetimes of {table.name}", 4.4, partial(draw_lifetimes, fit=fit), source)


def fitted_exponent(fit: LifetimeFit) -> float:
    """Exponent of a in the law whose lifetimes are quoted; 0 if its a is constant."""
    free, law = fit.free_law, fit.lifetimes
    if free is None:
        return 0.0 if law is None else law.exponent.value
    is_free = free.is_preferred or fit.status is Status.unidentified
    return free.exponent.value if is_free else 0.0


def fitted_lifetime(fit: LifetimeFit, current: np.ndarray) -> np.ndarray:
    """Lifetime in h at currents in mA, by the law through the three quoted lifetimes.

    NaN where the loss rate is not positive.
    """
    known, power = fit.readings.current, 1 + fitted_exponent(fit)
    quoted = [fit.lifetime_start.value, fit.lifetime_mean.value, fit.lifetime_end.value]
    at = np.array([known.max(), fit.mean_current, known.min()])

    def columns(where: np.ndarray) -> np.ndarray:
        return np.stack([(where / fit.mean_current) ** power, np.ones_like(where)], axis=-1)

    rate = columns(current) @ np.linalg.lstsq(columns(at), 1 / np.array(quoted))[0]
    return 1 / np.where(rate > 0, rate, np.nan)


def draw_lifetimes(figure: FigureBase, fit: LifetimeFit) -> None:
    """Draw lifetimes against current with the fit, and the residuals below.

    Points that were left out and are far off stand at the edge of the axes.
    """
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    table, exponent = fit.readings, fitted_exponent(fit)
    left_out = np.isin(np.arange(len(table)), fit.outliers)
    current, lifetime = table.current[~left_out], table.lifetime[~left_out]
    error = None if table.error is None else table.error[~left_out]
    style = {"fmt": "o", "ms": 5, "color": BLUE}
    above.errorbar(current, lifetime, error, **style, label="lifetimes")
    below.errorbar(current, fitted_lifetime(fit, current) - lifetime, error, **style)
    grid = np.linspace(table.current.min(), table.current.max(), CURVE_POINTS)
    named = exponent and fit.status is not Status.unidentified
    label = "fit" + (f", a as I^{exponent:.3g}" if named else "")
    above.plot(grid, fitted_lifetime(fit, grid), color=RED, lw=1.3, label=label, zorder=3)
    limits = above.get_ylim()
    if left_out.any():
        far = table.lifetime[left_out]
        beyond = int(np.sum((far < limits[0]) | (far > limits[1])))
        label = "left out" + f", {beyond} beyond the axes" * (beyond > 0)
        at = table.current[left_out], np.clip(far, *limits)
        above.plot(*at, "x", color="0.5", label=label, clip_on=False)
    above.set(title="lifetime against current", ylabel="lifetime, h", ylim=limits)
    above.legend(frameon=False, loc="best")
    below.axhline(0, color="0.6", lw=0.8)
    below.set(xlabel="beam current, mA", ylabel="fit - reading,\nh")
