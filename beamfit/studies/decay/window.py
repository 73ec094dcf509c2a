"""What a window of readings says: one a and one b of its last decays at one setting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.lifetime.decay import HOUR
from beamfit.lifetime.losses import loss_coefficients
from beamfit.quantity import Quantity, Status
from beamfit.studies.decay.budget import Machine, budget
from beamfit.studies.decay.conditions import Conditions
from beamfit.studies.decay.cycles import alike, cut_at_refills, joined, usual_cycle
from beamfit.studies.decay.evidence import UNITS
from beamfit.studies.decay.fit import DecayFit, bare, fit_decay, fit_pieces
from beamfit.studies.decay.marginal import Law
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.decay.study import SHORTEST, at_settings, seen_through
from beamfit.table import json_of


class Row(NamedTuple):
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
    """What the window says.

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


def fit_window(rows: Sequence[Row], name: str) -> Window:
    """Cut a window at refills and changes of setting, and fit what is as it is now.

    Parameters
    ----------
    rows : sequence of Row
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
    >>> rows = [Row(0, t, 500 * np.exp(-t / 36000), settings) for t in np.arange(0.0, 3600.0, 10.0)]
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
        return Window(None, None, 0, f"fewer than {SHORTEST} readings in a row of a stored beam")
    group = _at_last(decays)
    one = group[0] if len(group) == 1 else joined(group, name)
    if len(one) < SHORTEST:
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


def _pieces(rows: Sequence[Row], name: str) -> list[DecayRecord]:
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
        for part in parts if part.size >= SHORTEST
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
