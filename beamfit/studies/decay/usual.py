"""The usual loss of a beam that is watched: learnt from fits, expected by a ring's settings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.lifetime.losses import added, terms_of
from beamfit.quantity import Status
from beamfit.studies.decay import alarm
from beamfit.studies.decay.budget import Machine, budget, operation_during
from beamfit.studies.decay.conditions import Conditions
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.decay.trend import BEST_MONITOR, WANDER, alike_over
from beamfit.studies.decay.window import Row, Window

# a and b so well known are the usual ones; errors half as large replace them before an alarm.
KNOWN = 0.05
# Where readings do not tell a from b, the ring's own shares of them are trusted to this.
SHARES = 0.3
# Settings, and the current, that moved by more than this share are given to the ring anew.
MOVED = 0.01
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
    state: alarm.State
    ring: Terms | None = None
    losses: np.ndarray | None = None
    expected: tuple[float, float] = (1.0, 1.0)
    raised: float | None = None


def learnt(
    before: Alarmed | None, window: Window, rows: Sequence[Row], machine: Machine | None
) -> Alarmed | None:
    """The usual loss, where a fit is the first to tell it, or tells it twice as well.

    Parameters
    ----------
    before : Alarmed or None
        What is known; an alarm that is raised keeps it.
    window : Window
        The fit, of these rows.
    rows : sequence of Row
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
    if fit.status is Status.converged:
        found = _told(window)
    else:
        shared = machine is not None and fit.status is Status.unidentified
        found = _shared(window, machine) if shared else None
    if found is None:
        return None
    a, b, covariance = found
    covariance = covariance + WANDER**2 * np.eye(2)
    if before and not np.trace(covariance) < np.trace(before.usual.covariance) / 4:
        return None
    noise = max(fit.noise, BEST_MONITOR * fit.mean_current)
    apart = float(np.median(np.diff([row.time for row in rows])))
    usual = alarm.Reference(a, b, noise, alike_over(fit), apart, covariance)
    known = Alarmed(usual, alarm.started(usual))
    if machine is None:
        return known
    ring = _terms(machine, None, rows[-1])  # what the gauge shows now
    return known._replace(ring=ring, losses=ring.losses)


def _told(window: Window) -> tuple[float, float, np.ndarray] | None:
    """a and b of a fit that knows both well, with their relative covariance."""
    a, b = window.fit.a, window.fit.b
    if not (a.value > 0 and b.value > 0 and a.error and b.error):
        return None
    errors = np.array([a.relative, b.relative])
    correlation = window.fit.identifiability.correlation or 0.0
    covariance = np.outer(errors, errors) * [[1.0, correlation], [correlation, 1.0]]
    return (a.value, b.value, covariance) if errors.max() < KNOWN else None


def _shared(window: Window, machine: Machine) -> tuple[float, float, np.ndarray] | None:
    """The loss rate of a fit by the ring's shares of a and b, which may be off together."""
    lifetime = window.fit.lifetime_mean
    if lifetime.error is None or not lifetime.relative < KNOWN:
        return None
    try:
        expected = budget(window.readings, machine)
    except InputError:
        return None
    by = expected.lifetime / lifetime.value
    a, b = (by * float(part) for part in (expected.losses.a, expected.losses.b))
    share = a * expected.current / (a * expected.current + b)
    apart = SHARES * np.array([1 - share, -share])
    return a, b, np.outer(apart, apart) + lifetime.relative**2 * np.eye(2)


def _terms(machine: Machine, before: Terms | None, row: Row) -> Terms:
    """What the ring loses at the settings of a row; anew but for the pressure if they moved."""
    at = Conditions(*(None if math.isnan(value) else [value, value] for value in row.settings))
    moment = DecayRecord([0.0, 1.0], row.current * np.array([1.0, 1 - 1e-6]), conditions=at)
    operation = operation_during(moment, machine)
    place = np.array([row.current, *row.settings._replace(pressure=0.0)])
    if before and np.allclose(place, before.place, rtol=MOVED, atol=0.0, equal_nan=True):
        place, parts = before.place, before.parts
    else:
        parts = terms_of(machine.ring, operation, row.current)
    losses = added(parts, operation.pressure_base, operation.pressure_slope)
    return Terms(place, parts, np.array([losses.a, losses.b], float))


def followed(known: Alarmed, row: Row, apart: float, machine: Machine | None) -> Alarmed:
    """What is expected at the settings of a row, smoothed: the noise of a gauge would bend it.

    Parameters
    ----------
    known : Alarmed
        As it was at the row before.
    row : Row
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
