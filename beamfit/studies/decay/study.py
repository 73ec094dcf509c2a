"""A record from file to verdicts: cut into decays, each fitted, with its loss budget."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from beamfit.errors import InputError
from beamfit.shown import shown
from beamfit.studies.decay.checks import DecayChecks, check_decay
from beamfit.studies.decay.fit import FEWEST, DecayFit, fit_decay
from beamfit.studies.decay.loss_budget import Budget, Machine, budget
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.decay.segments import Event, split_record

__all__ = ["Decay", "RecordStudy", "study_record"]

# A setting that moves by more than this share between two readings was changed by somebody.
CHANGED = 0.01
SETTINGS = ("rf_voltage", "scraper_y", "bunches")
# Decays shorter than this are pieces between two events.
SHORTEST = 8


@shown
@dataclass(frozen=True, eq=False)
class Decay:
    """One decay of a record.

    Parameters
    ----------
    segment : DecayRecord
        Its readings.
    offset : float
        Its first reading's time in the record, s.
    fit : DecayFit
        I0, a, b, lifetimes and verdict.
    budget : Budget or None
        Losses from first principles, where a ring was given.
    """

    segment: DecayRecord
    offset: float
    fit: DecayFit
    budget: Budget | None

    @cached_property
    def checks(self) -> DecayChecks | None:
        """What simpler analyses say of it, and whether a is constant; None if nothing decays."""
        return check_decay(self.segment)

    def to_json(self) -> dict[str, Any]:
        """Give one entry of the ``results`` list of the JSON contract."""
        start = {"value": self.offset, "error": None, "unit": "s"}
        checks = {} if self.checks is None else self.checks.to_json()
        shown = self.fit.to_json() | {"start": start} | checks
        return shown if self.budget is None else shown | {"budget": self.budget.to_json()}


@shown
@dataclass(frozen=True, eq=False)
class RecordStudy:
    """A record with its decays and what lies between them.

    Parameters
    ----------
    record : DecayRecord
        The whole record.
    decays : tuple of Decay
        In order of time; at least one.
    events : tuple of Event
        Refills, losses, dropouts and what else was cut away.
    """

    record: DecayRecord
    decays: tuple[Decay, ...]
    events: tuple[Event, ...]


def _at_settings(segment: DecayRecord) -> list[DecayRecord]:
    """Cut where somebody changed a setting."""
    moved = np.zeros(len(segment) - 1, bool)
    for name in SETTINGS:
        values = getattr(segment.conditions, name)
        if values is not None:
            moved |= np.abs(np.diff(values)) > CHANGED * np.maximum(values[1:], values[:-1])
    pieces = np.split(np.arange(len(segment)), np.flatnonzero(moved) + 1)
    return [segment.select(rows) for rows in pieces if len(rows) >= SHORTEST]


def _decays(record: DecayRecord) -> tuple[list[DecayRecord], tuple[Event, ...]]:
    """Clean decays at constant settings, and the events."""
    if len(record) < SHORTEST:
        return [record], ()
    split = split_record(record)
    pieces = [piece for segment in split.segments for piece in _at_settings(segment)]
    if not pieces:
        kinds = ", ".join(sorted({event.kind for event in split.events})) or "changes of setting"
        raise InputError(
            f"no decay between {kinds}",
            f"at least {SHORTEST} readings in a row of a stored beam",
            path=record.name,
            column="current",
        )
    if len(pieces) > 1:
        names = [f"{record.name}#{number + 1}" for number in range(len(pieces))]
        pieces = [replace(p, name=name) for p, name in zip(pieces, names, strict=True)]
    return pieces, split.events


def study_record(record: DecayRecord, machine: Machine | None = None) -> RecordStudy:
    """Cut a record into decays, fit each, and say what first principles expect.

    Parameters
    ----------
    record : DecayRecord
        Any record: one decay, fills with refills between them, or top-up. It is also cut where
        RF voltage, scraper or bunches change by more than 1 %.
    machine : Machine, optional
        Ring and usual operation, for the loss budget.

    Returns
    -------
    RecordStudy
        At least one decay. Pieces between events in which the current rises (a slow refill) are
        listed as events.

    Raises
    ------
    InputError
        If the record has fewer than five readings, holds no decay, or only rises; and as for
        `beamfit.studies.decay.loss_budget.budget`.

    Examples
    --------
    >>> t = np.arange(0.0, 4000.0, 10.0)
    >>> saw = 100 * np.exp(-(t % 2000) / 36000)
    >>> study = study_record(DecayRecord(t, saw))
    >>> [f"{decay.fit.lifetime_mean.value:.3f} h" for decay in study.decays]
    ['10.000 h', '10.000 h']
    """
    if len(record) < FEWEST:
        expected = f"{FEWEST} or more for a decay"
        raise InputError(f"{len(record)} readings", expected, path=record.name)
    # Segments move `start` with them: counted from zero it is their place in the record.
    placed = replace(record, start=0.0)
    pieces, events = _decays(placed)
    decays, rising = [], []
    for piece in pieces:
        offset = piece.start
        start = None if record.start is None else record.start + offset
        segment = replace(piece, start=start)
        try:
            fit = fit_decay(segment)
        except InputError:
            # A record that does nothing but rise is an error; a slow refill within one is not.
            if len(pieces) == 1:
                raise
            change = float(segment.current[-1] - segment.current[0])
            rising.append(Event("slow refill", offset, segment.span, change))
            continue
        losses = None if machine is None else budget(segment, machine)
        decays.append(Decay(segment, offset, fit, losses))
    if not decays:
        expected = "a decay between refills"
        raise InputError("a current that rises", expected, path=record.name, column="current")
    return RecordStudy(
        record, tuple(decays), tuple(sorted((*events, *rising), key=lambda event: event.time))
    )
