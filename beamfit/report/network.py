"""Pictures of a network on first principles: figures 27 to 30 of the report, a and b by setting."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from beamfit.lifetime.decay_law import current
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.ring_study import Shift
from beamfit.lifetime.study import Decay, operation_during, pressure_at
from beamfit.quantity import HOUR
from beamfit.report.document import BLUE, RED, Picture, legend_below

# Points of a curve.
CURVE_POINTS = 33
# Number of decays drawn, as in the figures of the report.
DECAYS_DRAWN = 4
# Largest relative difference from the current of the curves for a decay drawn with them.
MAX_CURRENT_DIFFERENCE = 0.25
SETTINGS = {
    "rf_voltage": (1e6, "RF voltage, MV"),
    "scraper_y": (1e-3, "scraper, mm"),
    "bunches": (1.0, "bunches"),
}


def network_pictures(shift: Shift, decays: Sequence[Decay]) -> list[Picture]:
    """Make pictures of decays with the predictions, then of a, b and lifetime by each setting."""
    varied = (name for name, (low, high) in shift.limits._asdict().items() if high > 1.01 * low)
    return [decays_picture(shift, decays), *(setting_picture(shift, decays, n) for n in varied)]


def decays_picture(shift: Shift, decays: Sequence[Decay]) -> Picture:
    """Make the picture of four decays with the prediction of the network."""
    draw = partial(draw_decays, shift=shift, decays=decays)
    return Picture("decays by the network", 4.6, draw, _source(decays))


def setting_picture(shift: Shift, decays: Sequence[Decay], name: str) -> Picture:
    """Make the picture of a, b and lifetime against one setting."""
    draw = partial(draw_by_setting, shift=shift, decays=decays, name=name)
    return Picture(f"losses by {SETTINGS[name][1]}", 2.6, draw, _source(decays))


def _source(decays: Sequence[Decay]) -> str:
    return f"{len(decays)} decays, {decays[0].fit.record} to {decays[-1].fit.record}"


def draw_decays(figure: FigureBase, shift: Shift, decays: Sequence[Decay]) -> None:
    """Draw readings and predicted decays at their settings, like figures 27 to 30 of the report.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    shift : Shift
        Study with a network.
    decays : sequence of Decay
        Decays of the study; four of them are drawn.
    """
    network = shift.network
    rows = np.unique(np.linspace(0, len(decays) - 1, DECAYS_DRAWN).round().astype(int))
    panels = figure.subplots(2, 2, squeeze=False).ravel()
    for axes, row in zip(panels, rows, strict=False):
        decay = decays[row]
        segment, fit = decay.segment, decay.fit
        operation = operation_during(segment, shift.fit.machine)
        a, b, _ = network.predict(operation, fit.mean_current)
        hours = segment.time / HOUR
        law = np.asarray(current(segment.time, fit.i0.value, a.value, b.value))
        axes.plot(hours, segment.current, ".", color=BLUE, ms=3, label="readings")
        axes.plot(hours, law, color=RED, lw=1.3, label="network")
        axes.set_title(fit.record, fontsize="small")
        rows = (("a", fit.a.value, a.value), ("b", fit.b.value, b.value))
        said = "\n".join(
            f"{name} {own:.3e}, network {predicted:.3e}" for name, own, predicted in rows
        )
        axes.text(0.97, 0.95, said, transform=axes.transAxes, ha="right", va="top", fontsize=7)
    for axes in panels[2:]:
        axes.set_xlabel("time, h")
    for axes in panels[::2]:
        axes.set_ylabel("current, mA")
    legend_below(figure, panels[0], 2)


def draw_by_setting(figure: FigureBase, shift: Shift, decays: Sequence[Decay], name: str) -> None:
    """Draw a, b and the lifetime against one setting: network with its error, first principles.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    shift : Shift
        Study with a network.
    decays : sequence of Decay
        Decays with the other settings at the reference are drawn as points.
    name : str
        "rf_voltage", "scraper_y" or "bunches".
    """
    network = shift.network
    scale, label = SETTINGS[name]
    at = np.linspace(*getattr(shift.limits, name), CURVE_POINTS)
    reference = _settings_at_their_pressure(shift, decays)
    settings = [reference._replace(**{name: float(value)}) for value in at]
    predicted = [network.predict(one, shift.current) for one in settings]
    first = np.array([shift.fit.losses_at(one, shift.current) for one in settings])
    first = np.column_stack([first, 1 / (first @ [shift.current, 1.0]) / HOUR])
    points = _measured(shift, decays, name)
    units = ("a, 1/(mA s)", "b, 1/s", f"lifetime at {shift.current:.3g} mA, h")
    panels = figure.subplots(1, 3)
    for k, (axes, unit) in enumerate(zip(panels, units, strict=True)):
        value = np.array([one[k].value for one in predicted])
        error = np.array([np.nan if one[k].error is None else one[k].error for one in predicted])
        axes.fill_between(at / scale, value - error, value + error, color=RED, alpha=0.2, lw=0)
        axes.plot(at / scale, value, color=RED, label="network, one error")
        axes.plot(at / scale, first[:, k], color="0.5", ls="--", label="first principles")
        _points(axes, points, k, scale)
        axes.set(xlabel=label)
        axes.set_title(unit, fontsize="small")
    legend_below(figure, panels[0], 3)


def _settings_at_their_pressure(shift: Shift, decays: Sequence[Decay]) -> Operation:
    """Return the reference settings with the pressure of the decays near the current."""
    machine, current = shift.fit.machine, shift.current
    reference = machine.operation
    read = [
        pressure_at(operation_during(decay.segment, machine), current)
        for decay in decays
        if _is_near(decay, current)
    ]
    share = float(np.median(read)) / pressure_at(reference, current)
    base, slope = share * reference.pressure_base, share * reference.pressure_slope
    return reference._replace(pressure_base=base, pressure_slope=slope)


def _is_near(decay: Decay, current: float) -> bool:
    return abs(decay.fit.mean_current / current - 1) < MAX_CURRENT_DIFFERENCE


def _points(axes: Axes, points: list[tuple[float, list]], k: int, scale: float) -> None:
    measured = [(at, q[k]) for at, q in points if q[k].error is not None]
    if measured:
        at, value, error = zip(*((at / scale, q.value, q.error) for at, q in measured), strict=True)
        axes.errorbar(at, value, error, fmt="o", ms=4, color=BLUE, label="decays")


def _measured(shift: Shift, decays: Sequence[Decay], name: str) -> list[tuple[float, list]]:
    """Return value of one setting, a, b and lifetime of decays near the current and reference."""
    machine, found = shift.fit.machine, []
    reference = machine.operation
    others = [setting for setting in SETTINGS if setting != name]
    for decay in decays:
        at = operation_during(decay.segment, machine)
        near = _is_near(decay, shift.current)
        pairs = ((getattr(at, other), getattr(reference, other)) for other in others)
        if near and all(np.isclose(*pair, rtol=0.01) for pair in pairs):
            fit = decay.fit
            found.append((float(getattr(at, name)), [fit.a, fit.b, fit.lifetime_mean]))
    return found
