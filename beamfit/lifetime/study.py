"""A record from file to verdicts: cut into decays, each fitted, with its loss budget."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import answer, json_of, shown
from beamfit.errors import InputError, expect
from beamfit.lifetime.cycles import group_by_settings, join_cycles
from beamfit.lifetime.evidence import SEPARABLE
from beamfit.lifetime.fit import (
    MIN_FITTED_READINGS,
    DecayFit,
    bare,
    fit_cycles,
    fit_decay,
    fit_pieces,
)
from beamfit.lifetime.free_law import DRIFT, Law
from beamfit.lifetime.mechanisms import MECHANISMS, Losses, loss_coefficients
from beamfit.lifetime.pieces import (
    MIN_CYCLE_READINGS,
    MIN_CYCLES,
    Event,
    Split,
    beam_readings,
    event_of,
    is_refilled,
    split_record,
)
from beamfit.lifetime.readings import (
    MIN_READINGS,
    MIN_STAIR_READINGS,
    noise_of,
    on_edges,
    thinned,
    without_repeats,
    without_summer_time,
)
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.ring import MeasuredLength, Operation, Ring, stored_bunch, unstored
from beamfit.lifetime.systematics import (
    OneLifetime,
    Systematic,
    log_linear,
    single_exponential,
    systematics,
)
from beamfit.quantity import HOUR, Quantity, Status

# A setting that moves by more than this share between two readings was changed by somebody.
CHANGED = 0.01
SETTINGS = ("rf_voltage", "scraper_y", "bunches")
# Noise with a memory is taken for so many times what neighbouring readings scatter by.
OWN = 3.0
# Answers of cycles for which one law does not hold.
REFUTED = (Status.poor_fit, Status.infeasible)
# Errors of the time of a change within which readings are of neither side.
NEITHER = 2.0
# Times in which gas is pumped away to less than a hundredth.
SETTLED = 5.0
# Cycles that make a point of a course at least.
FEWEST_IN_PART = 10


@shown
class Machine(NamedTuple):
    """A ring and the settings and vacuum that hold where a record does not say otherwise.

    Examples
    --------
    >>> from beamfit.io.ring import read_operation, read_ring
    >>> path = "lattices/spear3_2003.toml"
    >>> round(float(Machine(read_ring(path), read_operation(path)).ring.circumference))
    234
    """

    ring: Ring
    operation: Operation


class Budget(NamedTuple):
    """Losses from first principles during a record.

    Attributes
    ----------
    operation : Operation
        The settings and the vacuum they were computed for.
    losses : Losses
        Coefficients by mechanism, 1/(mA s) and 1/s, as plain numbers.
    current : float
        Mean current of the record, mA.
    bunch_length : float
        Rms length of the bunches, m, computed or given.
    emittances : tuple of float
        Horizontal and vertical, m rad, as given: intrabeam scattering is not computed.
    filed_pressure : float or None
        Pressure at the mean current by the ring file, Pa, where the record's own gauge, which the
        losses are computed for, contradicts it by more than gauges are read to.
    """

    operation: Operation
    losses: Losses
    current: float
    bunch_length: float
    emittances: tuple[float, float]
    filed_pressure: float | None = None

    @property
    def pressure(self) -> float:
        """Pressure at the mean current that the losses are computed for, Pa."""
        return pressure_at(self.operation, self.current)

    @property
    def rates(self) -> dict[str, float]:
        """Loss rate at the mean current by cause, 1/h."""
        rates = self.losses.rates(self.current)
        return {m.label: HOUR * rates[m.name] for m in MECHANISMS}

    @property
    def lifetime(self) -> float:
        """Lifetime at the mean current, h."""
        return 1 / sum(self.rates.values())

    def to_json(self) -> dict[str, Any]:
        """Return the coefficients as quantities without errors, and the settings in SI."""
        losses = self.losses
        names = (*losses._fields, "a", "b", "lifetime_mean")
        values = (*losses, losses.a, losses.b, self.lifetime)
        units = (*losses.units, "1/(mA s)", "1/s", "h")
        pressure = {
            "pressure_base_Pa": float(self.operation.pressure_base),
            "pressure_slope_Pa_per_mA": float(self.operation.pressure_slope),
        }
        rows = zip(names, values, units, strict=True)
        rows = {name: Quantity(value, None, unit) for name, value, unit in rows}
        return json_of(rows | {"operation": settings_json(self.operation) | pressure})


def settings_json(operation: Operation) -> dict[str, float]:
    """The settings of an operation, with their units."""
    return {
        "rf_voltage_V": float(operation.rf_voltage),
        "scraper_y_m": float(operation.scraper_y),
        "bunches": float(operation.bunches),
    }


def pressure_at(operation: Operation, current: float) -> float:
    """Pressure at a current, Pa.

    Examples
    --------
    >>> from beamfit.io.ring import read_operation
    >>> print(f"{pressure_at(read_operation('lattices/spear3_2003.toml'), 500.0):.2g}")
    1e-07
    """
    return float(operation.pressure_base + operation.pressure_slope * current)


def operation_during(record: DecayRecord, machine: Machine) -> Operation:
    """Settings and vacuum during a record: its own where it gives them, else the machine's.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    machine : Machine
        The ring and its usual operation.

    Returns
    -------
    Operation
        With medians over the record. A pressure reading scales the machine's base pressure and
        its rise with current by one factor: a single decay spans too little current to tell the
        two apart. One that does not follow the current enters the fit as it is, and stands here
        by its mean.

    Raises
    ------
    InputError
        If the record's RF voltage stores no beam, or its scraper, bunches or pressure are zero.

    Examples
    --------
    >>> from beamfit.io.ring import read_operation, read_ring
    >>> from beamfit.lifetime.record import Conditions
    >>> path = "lattices/spear3_2003.toml"
    >>> scan = Conditions(rf_voltage=[2.4e6, 2.4e6])
    >>> record = DecayRecord([0, 60], [100, 99.9], conditions=scan)
    >>> operation_during(record, Machine(read_ring(path), read_operation(path))).rf_voltage
    2400000.0
    """
    usual = machine.operation
    said = {name: float(np.median(values)) for name, values in record.conditions.given.items()}
    for name, value in said.items():
        if not value > 0:
            raise InputError(f"{name} {value:g}", "above zero", path=record.name, column=name)
    if "rf_voltage" in said:
        usual = usual._replace(rf_voltage=said["rf_voltage"])
        expected = unstored(usual, machine.ring.energy_loss, machine.ring.energy)
        if expected is not None:
            found = f"{said['rf_voltage'] / 1e3:.6g} kV"
            raise InputError(found, expected, path=record.name, column="rf_voltage_kV")
    if "bunch_length" in said:
        length = np.array([said.pop("bunch_length")])
        said["bunch_length"] = MeasuredLength(np.zeros(1), length, 0.0, usual.rf_voltage)
    if "pressure" in said:
        read = said.pop("pressure")
        if record.gauge is not None:
            # The fit has the gauge's own course: b is the gas at its mean, and a is without gas.
            mean = record.integral(record.conditions.pressure)[-1] / record.span
            return usual._replace(**said, pressure_base=mean, pressure_slope=0.0)
        mean = usual.pressure_base + usual.pressure_slope * record.mean_current
        if not mean > 0:
            usual, mean = usual._replace(pressure_base=1.0, pressure_slope=0.0), 1.0
        said["pressure_base"] = usual.pressure_base * read / mean
        said["pressure_slope"] = usual.pressure_slope * read / mean
    return usual._replace(**said)


def budget(record: DecayRecord, machine: Machine) -> Budget:
    """Compute the losses during a record from first principles.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    machine : Machine
        The ring and its usual operation.

    Returns
    -------
    Budget
        At the record's mean current.

    Raises
    ------
    InputError
        As for `operation_during`.

    Examples
    --------
    >>> from beamfit.io.ring import read_operation, read_ring
    >>> path = "lattices/spear3_2003.toml"
    >>> machine = Machine(read_ring(path), read_operation(path))
    >>> found = budget(DecayRecord([0, 60], [500.0, 499.9]), machine)
    >>> print(f"{found.lifetime:.1f} h, Touschek alone {1 / found.rates['Touschek']:.1f} h")
    18.4 h, Touschek alone 30.4 h
    """
    operation = operation_during(record, machine)
    current = record.mean_current
    losses = loss_coefficients(machine.ring, operation, current)
    ring, parts = machine.ring, Losses(*(float(part) for part in losses))
    length = float(stored_bunch(ring, operation, current).length)
    emittances = float(ring.emittance_x), float(ring.emittance_y)
    filed = pressure_at(machine.operation, current)
    contradicted = abs(pressure_at(operation, current) - filed) > DRIFT * filed > 0
    return Budget(operation, parts, current, length, emittances, filed if contradicted else None)


def standing_alone(
    cycles: Sequence[DecayRecord], together: DecayRecord, fit: DecayFit
) -> list[DecayRecord]:
    """Cycles that by themselves would separate a and b, by the bend of their decay and the noise
    that all cycles show together, or neighbouring readings, where one law does not hold for all.
    """
    # Of very many readings the fit has means of neighbours.
    intervals = (np.median(np.diff(record.time)) for record in (fit.readings, together))
    averaged = math.sqrt(max(np.divide(*intervals), 1.0))
    rounding = (cycles[0].resolution or 0.0) / 12**0.5
    own = OWN * max(noise_of(together.time, together.current), rounding)
    own = min(fit.rms_residual * fit.inflation * averaged, own)

    def separates(cycle: DecayRecord) -> bool:
        loss = math.log(cycle.current[0] / cycle.current[-1])
        # The parabola t²/2 scatters about its line by its length squared over 24 sqrt(5).
        bend = float(cycle.current.mean()) * loss**2 / 24 * math.sqrt(len(cycle) / 5)
        return own < SEPARABLE * bend

    return [cycle for cycle in cycles if len(cycle) >= MIN_READINGS and separates(cycle)]


@dataclass(frozen=True, eq=False)
class Decay:
    """One decay of a record, or many cycles of it together.

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

    @classmethod
    def of(
        cls, segment: DecayRecord, offset: float, fit: DecayFit, machine: Machine | None
    ) -> Decay:
        """Add the losses of a ring, if there is one."""
        return cls(segment, offset, fit, None if machine is None else budget(segment, machine))

    def placed(self, name: str, start: float | None, machine: Machine | None) -> Decay:
        """The same under a name, in a record that begins at a time, with the losses of a ring."""
        start = None if start is None else start + self.segment.start
        segment = replace(self.segment, name=name, start=start)
        fit = replace(self.fit, record=name, readings=segment)
        return Decay.of(segment, self.offset, fit, machine)

    def parts(self, number: int, machine: Machine | None) -> list[Decay]:
        """The cycles of top-up as so many decays at most, each of some cycles and a fit of its own;
        a single decay as it is.
        """
        fit, first = self.fit, self.fit.first
        count = 1 if first is None else min(number, first.size // FEWEST_IN_PART)
        if count < 2:
            return [self]
        ends, found = [*first, len(fit.readings)], []
        every = [fit.readings.select(slice(*pair)) for pair in pairwise(ends)]
        for k, group in enumerate(np.array_split(np.arange(first.size), count), 1):
            cycles, name = [every[place] for place in group], f"{fit.record}#{k}"
            rows = [cycles[0].start, cycles[-1].start + cycles[-1].span] - np.array(self.offset)
            within = slice(*np.searchsorted(self.segment.time, rows))
            segment = self.segment.select(within, name)
            own = fit_pieces(cycles, name, found=self.segment.mean is None)
            found.append(Decay.of(segment, cycles[0].start, own, machine))
        return found

    @cached_property
    def checks(self) -> dict[str, OneLifetime | None]:
        """Simpler analyses by name, None where a current is zero; none of them if nothing decays,
        and for many cycles.
        """
        record, fit = self.segment, self.fit
        if fit.first is not None or np.ptp(record.current) == 0:
            return {}
        line = log_linear(record, fit) if record.current.min() > 0 else None
        return {"single_exponential": single_exponential(record, fit), "log_linear": line}

    @cached_property
    def systematics(self) -> tuple[Systematic, ...]:
        """Systematic errors, which no residual shows."""
        return systematics(self.fit)

    def to_json(self) -> dict[str, Any]:
        """Give one entry of the ``results`` list of the JSON contract."""
        more = {"start": bare(self.offset, "s"), **self.checks, "systematics": self.systematics}
        more |= {"notes": self.segment.notes} if self.segment.notes else {}
        more |= {} if self.budget is None else {"budget": self.budget}
        return self.fit.to_json() | json_of(more)


def settings_of(decays: Sequence[Decay], machine: Machine) -> list[tuple[Operation, float]]:
    """Settings and vacuum of each decay, and its mean current, mA."""
    return [(operation_during(d.segment, machine), d.fit.mean_current) for d in decays]


@answer
@dataclass(frozen=True, eq=False)
class RecordStudy:
    """A record with its decays and what lies between them.

    Parameters
    ----------
    record : DecayRecord
        The whole record.
    decays : tuple of Decay
        In order of time; of many cycles those that tell a from b by themselves.
    events : tuple of Event
        Refills, losses, dropouts and what else was cut away.
    pooled : tuple of Decay
        Cycles at the same settings fitted together, as of top-up.
    """

    record: DecayRecord
    decays: tuple[Decay, ...]
    events: tuple[Event, ...]
    pooled: tuple[Decay, ...] = ()

    @property
    def answers(self) -> tuple[Decay, ...]:
        """Quoted answers of the record: cycles together, then single decays; at least one."""
        return self.pooled + self.decays

    @property
    def headline(self) -> str:
        """Lifetimes of the first answers, and how many more there are."""
        said = [decay.fit.headline for decay in self.answers[:3]]
        more = len(self.answers) - len(said)
        return "; ".join(said + [f"{more} more"] * (more > 0))

    def to_json(self) -> list[dict[str, Any]]:
        """Give the ``results`` list of the JSON contract."""
        return [decay.to_json() for decay in self.answers]


def _steps(record: DecayRecord) -> dict[str, np.ndarray]:
    """After which readings somebody changed each setting."""
    given = {name: v for name, v in record.conditions.given.items() if name in SETTINGS}
    return {n: np.abs(np.diff(v)) > CHANGED * np.maximum(v[1:], v[:-1]) for n, v in given.items()}


def at_settings(segment: DecayRecord) -> list[DecayRecord]:
    """Cut where somebody changed a setting."""
    moved = np.any(list(_steps(segment).values()), axis=0)
    if not moved.any():
        return [segment] if len(segment) >= MIN_READINGS else []
    pieces = np.split(np.arange(len(segment)), np.flatnonzero(moved) + 1)
    return [segment.select(rows) for rows in pieces if len(rows) >= MIN_READINGS]


def _pooled(
    cycles: Sequence[DecayRecord], name: str, machine: Machine | None, law: Law
) -> tuple[list[Decay], list[DecayRecord]]:
    """Cycles at the same settings together, and those of them that also stand alone."""
    groups, pooled, alone = group_by_settings(cycles), [], []
    many = sum(len(group) >= MIN_CYCLES for group in groups)
    for group in groups:
        if len(group) < MIN_CYCLES:
            alone += [cycle for cycle in group if len(cycle) >= MIN_READINGS]
            continue
        called = name if many == 1 else f"{name}@{len(pooled) + 1}"
        group = _on_edges(group)
        # A refill between the edges of a staircase would show as a step.
        fit = fit_cycles(group, called, law, found=group[0].mean is None)
        segment = join_cycles(group, called)
        own = standing_alone(group, segment, fit)
        alone += own
        known = fit.status not in REFUTED and fit.lifetime_mean.error is not None
        if not known and len(own) == len(group):  # fills of no one law
            continue
        pooled.append(Decay.of(segment, segment.start, fit, machine))
    return pooled, alone


def _on_edges(cycles: list[DecayRecord]) -> list[DecayRecord]:
    """The edges of cycles, of those that have enough, where most are staircases of digits.

    Their steps last twice as long: a few edges are off by as much again in every cycle.
    """
    edges = [
        (cycle, on_edges(cycle, MIN_CYCLE_READINGS, 2 * MIN_STAIR_READINGS)) for cycle in cycles
    ]
    stairs = [found for cycle, found in edges if found is not cycle]
    return stairs if len(stairs) >= max(MIN_CYCLES, len(cycles) / 2) else cycles


def _decays(record: DecayRecord) -> tuple[Split, bool]:
    """Clean decays at constant settings, the events between them, and if refills hold the beam."""
    if len(record) < MIN_READINGS:
        return Split((record,), ()), False
    sections = at_settings(record)
    splits = [split_record(section) for section in sections]
    placed = zip(splits, sections, strict=True)
    events = [one._replace(time=one.time + s.start) for split, s in placed for one in split.events]
    pieces = [piece for split in splits for piece in split.segments]
    refilled = any(map(is_refilled, splits))
    if len(sections) != 1 and not refilled:  # a fill may begin where a setting is changed
        pieces, events = split_record(record)
        pieces = [part for piece in pieces for part in at_settings(piece)]
    if pieces:
        return Split(tuple(pieces), tuple(events)), refilled
    kinds = {event.kind for event in events}
    if kinds == {"spike"} and (kept := beam_readings(record)[0]).size >= MIN_FITTED_READINGS:
        return Split((record.select(kept),), tuple(events)), False
    moving = [name for name, steps in _steps(record).items() if steps.any()]
    if moving or "short" not in kinds:
        changes = f"changes of {', '.join(moving)} by more than {100 * CHANGED:g} %"
        found = ", ".join(sorted(kinds)) or changes
        expected = f"at least {MIN_READINGS} readings in a row of a stored beam"
        expected += "; leave out a setting that only scatters with --ignore" if moving else ""
        raise InputError(f"no decay between {found}", expected, record.name, column="current")
    return Split((), tuple(events)), False


def _rise_between_steps(split: Split) -> bool:
    """True where the current rises between losses: refills that the record does not resolve."""
    risen = sum(event.change for event in split.events if event.kind == "short")
    lost = (float(piece.current[0] - piece.current[-1]) for piece in split.segments)
    return risen > sum(fall for fall in lost if fall > 0)  # what rises is a slow refill


def _fitted(
    pieces: Sequence[DecayRecord], law: Law, whole: bool
) -> tuple[list[Decay], list[Event]]:
    """Fit every piece; one that cannot be is a slow refill between others."""
    decays, events = [], []
    for piece in pieces:
        try:
            found, lost = _parts(piece, law, whole)
        except InputError:
            change = float(piece.current[-1] - piece.current[0])
            found, lost = [], [Event("slow refill", piece.start, piece.span, change)]
        decays += found
        events += lost
    return decays, events


def _parts(piece: DecayRecord, law: Law, whole: bool) -> tuple[list[Decay], list[Event]]:
    """Fit a decay or, unless as a whole, its parts where current was lost at once, the loss rate
    changed, though no reading shows it, or the gas of a fill was gone.
    """
    segment = thinned(on_edges(piece))
    fit = fit_decay(segment, law=law)
    if not whole and (cut := _cut(segment, fit)) is not None:
        event, within = cut
        at = segment.start - piece.start + event.time
        # Of means of neighbours the time is anywhere within one.
        within += float(np.median(np.diff(segment.time))) * (len(segment) < len(piece))
        sides = piece.time < at - within, piece.time > at + within
        long = [piece.select(rows) for rows in sides if np.sum(rows) >= MIN_READINGS]
        if long and max(map(len, long)) < len(piece):
            decays, events = _fitted(long, law, whole)
            short = [event_of(piece, "short", *np.flatnonzero(rows)[[0, -1]]) for rows in sides
                     if 0 < np.sum(rows) < MIN_READINGS]  # fmt: skip
            here = [one._replace(time=piece.start + one.time) for one in short]
            return decays, [*events, *here, event._replace(time=piece.start + at)]
    return [Decay(segment, segment.start, fit, None)], []


def _cut(segment: DecayRecord, fit: DecayFit) -> tuple[Event, float] | None:
    """The event at which a decay ends within a segment, and the error of its time, s."""
    if (loss := fit.loss) is not None:
        change = -loss.current.value
        return Event("refill" if change > 0 else "loss", loss.time, 0.0, change), 0.0
    if fit.change is not None:  # of two the larger: its parts tell if there was another
        change = max(filter(None, (fit.change, fit.change.then)), key=lambda one: one.size)
        return Event("loss rate changes", change.time, 0.0, 0.0), NEITHER * change.error
    if fit.outgassing is not None and fit.status is Status.poor_fit:
        settled = SETTLED * fit.outgassing.time_constant.value * HOUR
        return Event("gas is pumped away", settled, 0.0, 0.0), 0.0
    return None


def study_record(
    record: DecayRecord, machine: Machine | None = None, law: Law | str = Law.free
) -> RecordStudy:
    """Cut a record into decays, fit each, and say what first principles expect.

    Parameters
    ----------
    record : DecayRecord
        Any record: one decay, fills with refills between them, or top-up. It is also cut where
        RF voltage, scraper or bunches change by more than 1 %.
    machine : Machine, optional
        Ring and usual operation, for the loss budget; with them a and b are constant.
    law : {"free", "constant"}
        As for `fit_decay`.

    Returns
    -------
    RecordStudy
        At least one decay. Pieces between events in which the current rises (a slow refill) are
        listed as events.

    Raises
    ------
    InputError
        If the record has fewer than five readings, holds no decay, or only rises; and as for
        `budget`.

    Examples
    --------
    >>> t = np.arange(0.0, 4000.0, 10.0)
    >>> saw = 100 * np.exp(-(t % 2000) / 36000)
    >>> study = study_record(DecayRecord(t, saw))
    >>> [f"{decay.fit.lifetime_mean.value:.3f} h" for decay in study.decays]
    ['10.000 h', '10.000 h']
    """
    expect(record, DecayRecord, "beamfit.read_decay_record(path)")
    record = without_repeats(without_summer_time(record))
    law = Law(law) if machine is None else Law.constant
    # Segments move `start` with them: counted from zero it is their place in the record.
    placed = replace(record, start=0.0)
    split, refilled = _decays(placed)
    events, pieces, pooled = split.events, split.segments, []
    if refilled:
        pooled, pieces = _pooled(pieces, record.name, machine, law)
    elif _rise_between_steps(split):
        pieces = ()
    del split  # of 1e7 readings 160 MB
    # A record that does nothing but rise is an error; a slow refill within one is not.
    only = len(pieces) == 1 and not pooled
    found, more = _parts(pieces[0], law, False) if only else _fitted(pieces, law, bool(pooled))
    if not found and not pooled:  # of refills that are not resolved pieces rise, or are short
        events, (found, more) = (), _parts(placed, law, True)
    decays = [
        decay.placed(f"{record.name}#{k}" if len(found) > 1 else record.name, record.start, machine)
        for k, decay in enumerate(sorted(found, key=lambda decay: decay.offset), 1)
    ]
    shown = thinned(record)
    shown = replace(shown, notes=record.notes) if pooled else shown
    in_order = sorted((*events, *more), key=lambda event: event.time)
    return RecordStudy(shown, tuple(decays), tuple(in_order), tuple(pooled))
