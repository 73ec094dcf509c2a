"""A sliding window of readings: one a and one b of its last decays, and the usual loss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import json_of
from beamfit.errors import InputError
from beamfit.lifetime import alarm
from beamfit.lifetime.course import reference_of
from beamfit.lifetime.cycles import alike, cut_at_refills, joined, usual_cycle
from beamfit.lifetime.departures import Law
from beamfit.lifetime.evidence import UNITS
from beamfit.lifetime.fit import DecayFit, bare, fit_decay, fit_pieces
from beamfit.lifetime.mechanisms import added, loss_coefficients, terms_of
from beamfit.lifetime.pieces import FEWEST
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.lifetime.study import (
    CHANGED,
    Decay,
    Machine,
    at_settings,
    budget,
    operation_during,
    seen_through,
)
from beamfit.quantity import HOUR, Quantity, Status


class WindowRow(NamedTuple):
    """The mean of some neighbouring readings.

    Attributes
    ----------
    piece : int
        Rises by one at every gap and step of the clock.
    time, current : float
        s and mA.
    settings : Conditions
        In SI; NaN of what has not been read yet.
    """

    piece: int
    time: float
    current: float
    settings: Conditions


class Window(NamedTuple):
    """A fit to the last decays of a window.

    Attributes
    ----------
    fit : DecayFit or None
        One a, one b; None where nothing can be fitted.
    readings : DecayRecord or None
        Of those decays.
    pieces : int
        How many decays they are.
    why : str
        Why there is no fit.
    """

    fit: DecayFit | None
    readings: DecayRecord | None
    pieces: int
    why: str = ""


class Answer(NamedTuple):
    """Answer of the window.

    Attributes
    ----------
    time, current : float
        Of the last reading, s and mA.
    window : Window
        The fit.
    status, message : Status, str
        Of the fit, or why there is none.
    lifetime, a, b, normalised : Quantity or None
        At the mean current, h; 1/(mA s); 1/s; current times lifetime, mA h, by the ring at the
        reference current and its usual settings. None where the readings do not determine it.
    """

    time: float
    current: float
    window: Window
    status: Status
    message: str
    lifetime: Quantity | None = None
    a: Quantity | None = None
    b: Quantity | None = None
    normalised: Quantity | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as `beamfit lifetime --json` does a decay, with what is normalised."""
        unknown = dict.fromkeys(("chi2", "dof", "identifiability"))
        unknown |= {name: bare(None, unit) for name, unit in UNITS.items()}
        fit = unknown if self.window.fit is None else self.window.fit.to_json()
        named = {
            "status": self.status,
            "message": self.message,
            "current": bare(self.current, "mA"),
        }
        more = {"normalised": self.normalised or bare(None, "mA h"), "decays": self.window.pieces}
        return fit | json_of(named | more)


def fit_window(rows: Sequence[WindowRow], name: str) -> Window:
    """Cut a window at refills and changes of setting, and fit what is as it is now.

    Parameters
    ----------
    rows : sequence of WindowRow
        In order of time.
    name : str
        What to call the result.

    Returns
    -------
    Window
        Decays at the settings of the last one together, each with a current of its own at its
        start; a pressure that does not follow the current is a setting, too.

    Examples
    --------
    >>> settings = Conditions(*[np.nan] * 5)
    >>> times = np.arange(0.0, 3600.0, 10.0)
    >>> rows = [WindowRow(0, t, 500 * np.exp(-t / 36000), settings) for t in times]
    >>> found = fit_window(rows, "ring")
    >>> found.pieces, f"{found.fit.lifetime_mean.value:.3f} h"
    (1, '10.000 h')
    """
    decays = [
        decay
        for piece in _pieces(rows, name)
        for section in at_settings(piece)
        for decay in cut_at_refills(section).segments
    ]
    if not decays:
        return Window(None, None, 0, f"fewer than {FEWEST} readings in a row of a stored beam")
    group = _at_last(decays)
    one = group[0] if len(group) == 1 else joined(group, name)
    if len(one) < FEWEST:
        return Window(None, one, len(group), f"{len(one)} readings since the last change")
    try:
        fit = _fitted(group, name)
    except InputError as error:  # a current that rises
        return Window(None, one, len(group), error.found)
    return Window(fit, one, len(group))


def normalised(window: Window, machine: Machine | None, current: float | None) -> Quantity | None:
    """Current times lifetime, mA h, as of `trend`; None where the readings do not tell it.

    Raises
    ------
    InputError
        If the ring stores no beam at the settings of the window.
    """
    lifetime, mean = window.fit.lifetime_mean, window.fit.mean_current
    if lifetime.error is None:
        return None
    if machine is None:
        by = mean
    else:
        current = current or mean
        usual = loss_coefficients(machine.ring, machine.operation, current)
        expected = budget(window.readings, machine).lifetime * HOUR
        by = current / expected / float(usual.a * current + usual.b)
    return Quantity(by * lifetime.value, by * lifetime.error, "mA h")


def _fitted(group: list[DecayRecord], name: str) -> DecayFit:
    if len(group) == 1:
        return fit_decay(replace(group[0], name=name), law=Law.constant)
    fit = fit_pieces(group, name)
    return seen_through(fit, *usual_cycle(group)) if len(group) > 2 else fit


def _pieces(rows: Sequence[WindowRow], name: str) -> list[DecayRecord]:
    """Records without gaps; before it was first read a setting is taken as it was then."""
    if not rows:
        return []
    piece, time, current = np.array([row[:3] for row in rows]).T
    settings = np.array([row.settings for row in rows])
    known = [column[np.isfinite(column)] for column in settings.T]
    filled = [
        np.where(np.isfinite(column), column, seen[0]) if seen.size else None
        for column, seen in zip(settings.T, known, strict=True)
    ]
    parts = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(piece)) + 1)
    return [
        DecayRecord(
            time[part], current[part], None, name, time[part[0]],
            Conditions(*(None if column is None else column[part] for column in filled)),
        )
        for part in parts if part.size >= FEWEST
    ]  # fmt: skip


def _at_last(decays: list[DecayRecord]) -> list[DecayRecord]:
    """Those at the settings of the last, and its pressure if that does not follow the beam."""
    compared = decays
    if joined(decays, "").gauge is None:
        compared = [replace(d, conditions=d.conditions._replace(pressure=None)) for d in decays]
    starts = next(
        {decay.start for decay in group} for group in alike(compared) if compared[-1] in group
    )
    return [decay for decay in decays if decay.start in starts]


# a and b so well known are the usual ones; errors half as large replace them before an alarm.
KNOWN = 0.05
# What the ring is expected to lose follows its settings over so long, s, and steps at once.
SMOOTH = 300.0


class Terms(NamedTuple):
    """A ring's terms, the settings they are for, and the a and b they make."""

    place: np.ndarray
    parts: tuple[Any, ...]
    losses: np.ndarray


class Alarmed(NamedTuple):
    """The alarm at work: the usual loss, what the ring loses now and lost where that was found,
    what is expected now over then, and since when an alarm is raised.
    """

    usual: alarm.Reference
    state: alarm.AlarmState
    ring: Terms | None = None
    losses: np.ndarray | None = None
    expected: tuple[float, float] = (1.0, 1.0)
    raised: float | None = None


def learnt(
    before: Alarmed | None, window: Window, rows: Sequence[WindowRow], machine: Machine | None
) -> Alarmed | None:
    """The usual loss, where a fit is the first to tell it, or tells it twice as well.

    Parameters
    ----------
    before : Alarmed or None
        What is known; an alarm that is raised keeps it.
    window : Window
        The fit, of these rows.
    rows : sequence of WindowRow
    machine : Machine or None
        The ring: where the fit does not tell a from b, they have its shares.

    Returns
    -------
    Alarmed or None
        None where nothing is learnt.
    """
    fit = window.fit
    # Where the gauge does not follow the current a is without gas, and b of no moment.
    if fit is None or window.readings.gauge is not None or (before and before.raised is not None):
        return None
    usual = _usual(window, machine)
    if usual is None:
        return None
    if before and not np.trace(usual.covariance) < np.trace(before.usual.covariance) / 4:
        return None
    known = Alarmed(usual, alarm.started(usual))
    if machine is None:
        return known
    ring = _terms(machine, None, rows[-1])  # what the gauge shows now
    return known._replace(ring=ring, losses=ring.losses)


def _usual(window: Window, machine: Machine | None) -> alarm.Reference | None:
    """The loss of a fit that knows a and b, or the loss rate and a ring their ratio."""
    fit, ring = window.fit, None
    decay = Decay(window.readings, 0.0, fit, None)
    if fit.status is Status.converged:
        known = (fit.a, fit.b)
    elif fit.status is Status.unidentified and machine is not None:
        known = (fit.lifetime_mean,)
        try:
            ring = budget(window.readings, machine).losses
        except InputError:
            return None
    else:
        return None
    if not all(one.error and abs(one.relative) < KNOWN for one in known):
        return None
    return reference_of((decay,), np.ones(1), np.ones(1), ring)


def _terms(machine: Machine, before: Terms | None, row: WindowRow) -> Terms:
    """Losses of the ring at the settings of a row; anew but for the pressure if they moved."""
    at = Conditions(*(None if math.isnan(value) else [value, value] for value in row.settings))
    moment = DecayRecord([0.0, 1.0], row.current * np.array([1.0, 1 - 1e-6]), conditions=at)
    operation = operation_during(moment, machine)
    place = np.array([row.current, *row.settings._replace(pressure=0.0)])
    if before and np.allclose(place, before.place, rtol=CHANGED, atol=0.0, equal_nan=True):
        place, parts = before.place, before.parts
    else:
        parts = terms_of(machine.ring, operation, row.current)
    losses = added(parts, operation.pressure_base, operation.pressure_slope)
    return Terms(place, parts, np.array([losses.a, losses.b], float))


def followed(known: Alarmed, row: WindowRow, apart: float, machine: Machine | None) -> Alarmed:
    """Follow the expected loss at the settings of a row, smoothed: noise of a gauge would bend it.

    Parameters
    ----------
    known : Alarmed
        As it was at the row before.
    row : WindowRow
    apart : float
        Time between the two, s.
    machine : Machine or None
        The ring; without one the expected loss stays.

    Returns
    -------
    Alarmed
    """
    if machine is None:
        return known
    try:
        ring = _terms(machine, known.ring, row)
    except InputError:  # settings at which the ring stores no beam are none
        return known
    new, old = ring.losses / known.losses, np.array(known.expected)
    share = 1.0 if np.abs(new / old - 1).max() > alarm.SET else min(apart / SMOOTH, 1.0)
    a, b = old + share * (new - old)
    return known._replace(ring=ring, expected=(float(a), float(b)))
