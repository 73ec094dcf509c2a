"""Study of a record: split it into decays, fit each, compute its loss budget."""

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
    SHORT,
    Event,
    Split,
    beam_readings,
    event_of,
    is_refilled,
    split_record,
    usual_length,
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
from beamfit.lifetime.ring import MeasuredLength, Operation, Ring, required_voltage, stored_bunch
from beamfit.lifetime.systematics import (
    OneLifetime,
    Systematic,
    log_linear,
    single_exponential,
    systematics,
)
from beamfit.quantity import HOUR, Quantity, Status

# Settings that split a record, and the relative change between two readings at which they do:
# more than a read-back scatters, less than an operator's step.
SETTINGS = ("rf_voltage", "scraper_y", "bunches")
SETTING_STEP = 0.01
# Limit of the noise of pooled cycles, in units of the scatter of neighbouring readings: residuals
# beyond it come from a law that does not hold for all cycles, not from noise.
MAX_NOISE_RATIO = 3.0
# Verdicts that refute one law for all cycles.
REFUTING = (Status.poor_fit, Status.infeasible)
# Readings within this many standard errors of the time of a change belong to neither decay.
CHANGE_MARGIN = 2.0
# Time constants after which gas is pumped away: less than 1 % of it is left.
GAS_TIME_CONSTANTS = 5.0
# Smallest share of the current that a cycle of a common answer must lose to be also fitted alone,
# over the standard deviation of a drift of b: with less a drift may take the place of a.
OVER_DRIFT = 2.0
# Smallest number of cycles in a part of a top-up record: chosen, since fewer make a poor point
# of a trend.
MIN_CYCLES_IN_PART = 10


@shown
class Machine(NamedTuple):
    """A ring with its usual settings and vacuum, which hold where a record does not give its own.

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
    """Loss budget of a record from first principles.

    Attributes
    ----------
    operation : Operation
        Settings and vacuum of the computation.
    losses : Losses
        Coefficients of each mechanism, 1/(mA s) and 1/s, as plain numbers.
    current : float
        Mean current of the record, mA.
    bunch_length : float
        Rms bunch length, m, computed or given.
    emittances : tuple of float
        Horizontal and vertical, m rad, as given: intrabeam scattering is not computed.
    filed_pressure : float or None
        Pressure at the mean current by the ring file, Pa, if the record's gauge contradicts it by
        more than a gauge's error; the losses are computed for the gauge's pressure.
    """

    operation: Operation
    losses: Losses
    current: float
    bunch_length: float
    emittances: tuple[float, float]
    filed_pressure: float | None = None

    @property
    def pressure(self) -> float:
        """Pressure at the mean current, Pa, for which the losses are computed."""
        return pressure_at(self.operation, self.current)

    @property
    def rates(self) -> dict[str, float]:
        """Loss rate of each mechanism at the mean current, 1/h."""
        rates = self.losses.rates(self.current)
        return {m.label: HOUR * rates[m.name] for m in MECHANISMS}

    @property
    def lifetime(self) -> float:
        """Lifetime at the mean current, h."""
        return 1 / sum(self.rates.values())

    def to_json(self) -> dict[str, Any]:
        """Coefficients as quantities without errors, and the settings in SI units."""
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
    """Settings of an operation by name and SI unit."""
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
    """Settings and vacuum during a record: its own columns, else the machine's usual values.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    machine : Machine
        The ring and its usual operation.

    Returns
    -------
    Operation
        Medians over the record. A pressure reading scales the machine's base pressure and its
        rise with current by one factor, since a single decay spans too little current to separate
        the two. A pressure that does not follow the current enters the fit reading by reading;
        here its mean over time is the base pressure.

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
    operation = machine.operation
    medians = {name: float(np.median(values)) for name, values in record.conditions.given.items()}
    for name, value in medians.items():
        if not value > 0:
            raise InputError(f"{name} {value:g}", "above zero", path=record.name, column=name)
    if "rf_voltage" in medians:
        operation = operation._replace(rf_voltage=medians["rf_voltage"])
        expected = required_voltage(operation, machine.ring.energy_loss, machine.ring.energy)
        if expected is not None:
            found = f"{medians['rf_voltage'] / 1e3:.6g} kV"
            raise InputError(found, expected, path=record.name, column="rf_voltage_kV")
    if "bunch_length" in medians:
        length = np.array([medians.pop("bunch_length")])
        medians["bunch_length"] = MeasuredLength(np.zeros(1), length, 0.0, operation.rf_voltage)
    if "pressure" in medians:
        pressure = medians.pop("pressure")
        if record.gauge is not None:
            # The fit includes the pressure reading by reading: b is the gas loss at the mean
            # pressure, and no gas loss is part of a.
            mean = record.integral(record.conditions.pressure)[-1] / record.span
            return operation._replace(**medians, pressure_base=mean, pressure_slope=0.0)
        mean = operation.pressure_base + operation.pressure_slope * record.mean_current
        if not mean > 0:
            operation, mean = operation._replace(pressure_base=1.0, pressure_slope=0.0), 1.0
        medians["pressure_base"] = operation.pressure_base * pressure / mean
        medians["pressure_slope"] = operation.pressure_slope * pressure / mean
    return operation._replace(**medians)


def budget(record: DecayRecord, machine: Machine) -> Budget:
    """Compute the loss budget of a record from first principles.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    machine : Machine
        The ring and its usual operation.

    Returns
    -------
    Budget
        Losses at the record's mean current.

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


def _lost(cycle: DecayRecord) -> float:
    """Loss of current over a cycle: the logarithm of its first over its last reading."""
    return math.log(cycle.current[0] / cycle.current[-1])


def separable_cycles(
    cycles: Sequence[DecayRecord], together: DecayRecord, fit: DecayFit
) -> list[DecayRecord]:
    """Select the cycles that are long enough to separate a and b in a fit of their own.

    The curvature of the decay is compared with the noise: the residuals of the joint fit, or a
    few times the scatter of neighbouring readings where that is less (one law does not hold then).
    """
    # The joint fit averages neighbouring readings where there are very many.
    intervals = (np.median(np.diff(record.time)) for record in (fit.readings, together))
    noise_reduction = math.sqrt(max(np.divide(*intervals), 1.0))
    rounding = (cycles[0].resolution or 0.0) / 12**0.5
    noise = MAX_NOISE_RATIO * max(noise_of(together.time, together.current), rounding)
    noise = min(fit.rms_residual * fit.inflation * noise_reduction, noise)

    def separates(cycle: DecayRecord) -> bool:
        loss = _lost(cycle)
        # The parabola x²/2 over a length x deviates from its best straight line by
        # x²/(24 sqrt(5)) rms.
        bend = float(cycle.current.mean()) * loss**2 / 24 * math.sqrt(len(cycle) / 5)
        return noise < SEPARABLE * bend

    return [cycle for cycle in cycles if len(cycle) >= MIN_READINGS and separates(cycle)]


@dataclass(frozen=True, eq=False)
class Decay:
    """One decay of a record, or many cycles fitted together.

    Parameters
    ----------
    segment : DecayRecord
        Readings.
    offset : float
        Time of the first reading in the record, s.
    fit : DecayFit
        I0, a, b, lifetimes and verdict.
    budget : Budget or None
        Loss budget from first principles, if a ring was given.
    """

    segment: DecayRecord
    offset: float
    fit: DecayFit
    budget: Budget | None

    @classmethod
    def of(
        cls, segment: DecayRecord, offset: float, fit: DecayFit, machine: Machine | None
    ) -> Decay:
        """Decay with the loss budget of a ring, if there is one."""
        return cls(segment, offset, fit, None if machine is None else budget(segment, machine))

    def with_name(self, name: str, start: float | None, machine: Machine | None) -> Decay:
        """Copy with a name, a date and a loss budget; `start` is the Unix time of the record, s."""
        start = None if start is None else start + self.segment.start
        segment = replace(self.segment, name=name, start=start)
        fit = replace(self.fit, record=name, readings=segment)
        return Decay.of(segment, self.offset, fit, machine)

    def parts(self, number: int, machine: Machine | None) -> list[Decay]:
        """Divide the cycles of top-up into at most `number` parts, and fit each part.

        A single decay is returned as it is.
        """
        fit, cycle_starts = self.fit, self.fit.first
        count = 1 if cycle_starts is None else min(number, cycle_starts.size // MIN_CYCLES_IN_PART)
        if count < 2:
            return [self]
        ends, parts = [*cycle_starts, len(fit.readings)], []
        cycles_of_decay = [fit.readings.select(slice(*pair)) for pair in pairwise(ends)]
        for k, group in enumerate(np.array_split(np.arange(cycle_starts.size), count), 1):
            cycles, name = [cycles_of_decay[place] for place in group], f"{fit.record}#{k}"
            rows = [cycles[0].start, cycles[-1].start + cycles[-1].span] - np.array(self.offset)
            within = slice(*np.searchsorted(self.segment.time, rows))
            segment = self.segment.select(within, name)
            fit_of_part = fit_pieces(cycles, name, found=self.segment.mean is None)
            parts.append(Decay.of(segment, cycles[0].start, fit_of_part, machine))
        return parts

    @cached_property
    def checks(self) -> dict[str, OneLifetime | None]:
        """Simpler analyses by name: ln I is None if a current is zero.

        Empty if the current is constant, and for cycles fitted together.
        """
        record, fit = self.segment, self.fit
        if fit.first is not None or np.ptp(record.current) == 0:
            return {}
        line = log_linear(record, fit) if record.current.min() > 0 else None
        return {"single_exponential": single_exponential(record, fit), "log_linear": line}

    @cached_property
    def systematics(self) -> tuple[Systematic, ...]:
        """Systematic errors, which the residuals do not show."""
        return systematics(self.fit)

    def to_json(self) -> dict[str, Any]:
        """Entry of the ``results`` list of the JSON contract."""
        more = {"start": bare(self.offset, "s"), **self.checks, "systematics": self.systematics}
        more |= {"notes": self.segment.notes} if self.segment.notes else {}
        more |= {} if self.budget is None else {"budget": self.budget}
        return self.fit.to_json() | json_of(more)


def settings_of(decays: Sequence[Decay], machine: Machine) -> list[tuple[Operation, float]]:
    """Settings and vacuum, and mean current in mA, of each decay."""
    return [(operation_during(d.segment, machine), d.fit.mean_current) for d in decays]


@answer
@dataclass(frozen=True, eq=False)
class RecordStudy:
    """Decays of a record, and the events between them.

    Parameters
    ----------
    record : DecayRecord
        The whole record.
    decays : tuple of Decay
        Single decays in order of time; of many cycles, only those that separate a and b alone.
    events : tuple of Event
        Refills, losses, dropouts and other readings that were cut out.
    pooled : tuple of Decay
        Cycles at the same settings fitted together, as in top-up.
    """

    record: DecayRecord
    decays: tuple[Decay, ...]
    events: tuple[Event, ...]
    pooled: tuple[Decay, ...] = ()

    @property
    def answers(self) -> tuple[Decay, ...]:
        """Answers of the record, at least one: cycles fitted together, then single decays."""
        return self.pooled + self.decays

    @property
    def headline(self) -> str:
        """Lifetimes of the first three answers, and the number of the others."""
        headlines = [decay.fit.headline for decay in self.answers[:3]]
        others = len(self.answers) - len(headlines)
        return "; ".join(headlines + [f"{others} more"] * (others > 0))

    def to_json(self) -> list[dict[str, Any]]:
        """``results`` list of the JSON contract."""
        return [decay.to_json() for decay in self.answers]


def _setting_steps(record: DecayRecord) -> dict[str, np.ndarray]:
    """Mask of the readings after which each setting changes, shape (n - 1,)."""
    given = {name: v for name, v in record.conditions.given.items() if name in SETTINGS}
    return {
        n: np.abs(np.diff(v)) > SETTING_STEP * np.maximum(v[1:], v[:-1]) for n, v in given.items()
    }


def split_at_settings(segment: DecayRecord) -> list[DecayRecord]:
    """Split a segment where a setting changes."""
    moved = np.any(list(_setting_steps(segment).values()), axis=0)
    if not moved.any():
        return [segment] if len(segment) >= MIN_READINGS else []
    pieces = np.split(np.arange(len(segment)), np.flatnonzero(moved) + 1)
    return [segment.select(rows) for rows in pieces if len(rows) >= MIN_READINGS]


def _pool_cycles(
    cycles: Sequence[DecayRecord], name: str, machine: Machine | None, law: Law
) -> tuple[list[Decay], list[DecayRecord], list[Event]]:
    """Fit cycles at the same settings together; also return those to be fitted alone, and the
    events of those that are in neither.
    """
    groups, pooled, single, omitted = group_by_settings(cycles), [], [], []
    pooled_groups = sum(len(group) >= MIN_CYCLES for group in groups)
    for group in groups:
        if len(group) < MIN_CYCLES:
            single += [cycle for cycle in group if len(cycle) >= MIN_READINGS]
            continue
        group_name = name if pooled_groups == 1 else f"{name}@{len(pooled) + 1}"
        group = _edges_of_cycles(group)
        # With edges of digits (`mean` is set) no refill is missed: it would show as a step.
        fit = fit_cycles(group, group_name, law, found=group[0].mean is None)
        segment = join_cycles(group, group_name)
        alone = separable_cycles(group, segment, fit)
        answered = fit.status not in REFUTING and fit.lifetime_mean.error is not None
        if not answered and len(alone) == len(group):  # one law does not hold for these fills
            single += group
            continue
        if not answered and not _is_held(group):
            shortest = max(MIN_READINGS, SHORT * usual_length([len(cycle) for cycle in group]))
            single += [cycle for cycle in group if len(cycle) >= shortest]
            omitted += [_short(c, 0, len(c) - 1) for c in group if len(c) < shortest]
            continue
        single += [cycle for cycle in alone if _lost(cycle) > OVER_DRIFT * DRIFT]
        pooled.append(Decay.of(segment, segment.start, fit, machine))
    return pooled, single, omitted


def _short(piece: DecayRecord, first: int, last: int) -> Event:
    """List readings of a piece that are too few for a fit as an event of the record."""
    event = event_of(piece, "short", first, last)
    return event._replace(time=piece.start + event.time)


def _is_held(cycles: Sequence[DecayRecord]) -> bool:
    """Tell if refills hold one current: mean currents differ by less than a cycle loses."""
    current = np.array([cycle.mean_current for cycle in cycles])
    lost = np.median([np.ptp(cycle.current) for cycle in cycles])
    return bool(np.median(np.abs(current - np.median(current))) < lost)


def _edges_of_cycles(cycles: list[DecayRecord]) -> list[DecayRecord]:
    """Replace cycles that are staircases of digits by their edges, if at least half of them are.

    A step must last twice as many readings as in a single decay: a cycle has few edges, so the
    error of each counts more.
    """
    edges = [
        (cycle, on_edges(cycle, MIN_CYCLE_READINGS, 2 * MIN_STAIR_READINGS)) for cycle in cycles
    ]
    stairs = [found for cycle, found in edges if found is not cycle]
    return stairs if len(stairs) >= max(MIN_CYCLES, len(cycles) / 2) else cycles


def _split_at_changes(record: DecayRecord) -> tuple[Split, bool]:
    """Split a record into decays at constant settings; also return if refills hold the beam."""
    if len(record) < MIN_READINGS:
        return Split((record,), ()), False
    sections = split_at_settings(record)
    splits = [split_record(section) for section in sections]
    placed = zip(splits, sections, strict=True)
    events = [one._replace(time=one.time + s.start) for split, s in placed for one in split.events]
    pieces = [piece for split in splits for piece in split.segments]
    refilled = any(map(is_refilled, splits))
    if len(sections) != 1 and not refilled:  # a fill may begin where a setting changes
        pieces, events = split_record(record)
        pieces = [part for piece in pieces for part in split_at_settings(piece)]
    if pieces:
        return Split(tuple(pieces), tuple(events)), refilled
    kinds = {event.kind for event in events}
    if kinds == {"spike"} and (kept := beam_readings(record)[0]).size >= MIN_FITTED_READINGS:
        return Split((record.select(kept),), tuple(events)), False
    moving = [name for name, steps in _setting_steps(record).items() if steps.any()]
    if moving or "short" not in kinds:
        changes = f"changes of {', '.join(moving)} by more than {100 * SETTING_STEP:g} %"
        found = ", ".join(sorted(kinds)) or changes
        expected = f"at least {MIN_READINGS} readings in a row of a stored beam"
        expected += "; leave out a setting that only scatters with --ignore" if moving else ""
        raise InputError(f"no decay between {found}", expected, record.name, column="current")
    return Split((), tuple(events)), False


def _has_unresolved_refills(split: Split) -> bool:
    """Return True if steps up exceed the decays: refills that the record does not resolve."""
    risen = sum(event.change for event in split.events if event.kind == "short")
    lost = (float(piece.current[0] - piece.current[-1]) for piece in split.segments)
    return risen > sum(fall for fall in lost if fall > 0)  # a rising piece is a slow refill


def _fit_each(
    pieces: Sequence[DecayRecord], law: Law, undivided: bool
) -> tuple[list[Decay], list[Event]]:
    """Fit every piece; list a piece that cannot be fitted as a slow refill."""
    decays, events = [], []
    for piece in pieces:
        try:
            found, lost = _fit_piece(piece, law, undivided)
        except InputError:
            change = float(piece.current[-1] - piece.current[0])
            found, lost = [], [Event("slow refill", piece.start, piece.span, change)]
        decays += found
        events += lost
    return decays, events


def _fit_piece(piece: DecayRecord, law: Law, undivided: bool) -> tuple[list[Decay], list[Event]]:
    """Fit a piece; unless `undivided`, split it where the fit finds a change, and fit its parts.

    A change is a sudden loss of current, another loss rate, or the end of outgassing after a fill:
    the fit finds changes that no single reading shows.
    """
    segment = thinned(on_edges(piece))
    fit = fit_decay(segment, law=law)
    if not undivided and (cut := _dividing_event(segment, fit)) is not None:
        event, margin = cut
        at = segment.start - piece.start + event.time
        # Thinned readings are means of neighbours: the change is anywhere within one of them.
        margin += float(np.median(np.diff(segment.time))) * (len(segment) < len(piece))
        sides = piece.time < at - margin, piece.time > at + margin
        sides_to_fit = [piece.select(rows) for rows in sides if np.sum(rows) >= MIN_READINGS]
        if sides_to_fit and max(map(len, sides_to_fit)) < len(piece):
            decays, events = _fit_each(sides_to_fit, law, undivided)
            short = [rows for rows in sides if 0 < np.sum(rows) < MIN_READINGS]
            short = [_short(piece, *np.flatnonzero(rows)[[0, -1]]) for rows in short]
            return decays, [*events, *short, event._replace(time=piece.start + at)]
    return [Decay(segment, segment.start, fit, None)], []


def _dividing_event(segment: DecayRecord, fit: DecayFit) -> tuple[Event, float] | None:
    """Event that divides a segment, and the half width in s of the readings to leave out."""
    if (loss := fit.loss) is not None:
        change = -loss.current.value
        return Event("refill" if change > 0 else "loss", loss.time, 0.0, change), 0.0
    if fit.change is not None:  # of two the larger; the fits of the parts find the other
        change = max(filter(None, (fit.change, fit.change.then)), key=lambda one: one.size)
        return Event("loss rate changes", change.time, 0.0, 0.0), CHANGE_MARGIN * change.error
    if fit.outgassing is not None and fit.status is Status.poor_fit:
        settled = GAS_TIME_CONSTANTS * fit.outgassing.time_constant.value * HOUR
        return Event("gas is pumped away", settled, 0.0, 0.0), 0.0
    return None


def study_record(
    record: DecayRecord, machine: Machine | None = None, law: Law | str = Law.free
) -> RecordStudy:
    """Split a record into decays, fit each, and compute its loss budget from first principles.

    Parameters
    ----------
    record : DecayRecord
        Any record: one decay, fills with refills between them, or top-up. It is also split where
        RF voltage, scraper or bunches change by more than 1 %.
    machine : Machine, optional
        Ring and usual operation for the loss budget. With it a and b are constant.
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
    # Selecting rows moves `start`: with a start of zero it is the time within the record.
    undated = replace(record, start=0.0)
    split, refilled = _split_at_changes(undated)
    events, pieces, pooled = split.events, split.segments, []
    if refilled:
        pooled, pieces, omitted = _pool_cycles(pieces, record.name, machine, law)
        events = (*events, *omitted)
    elif _has_unresolved_refills(split):
        pieces = ()
    del split  # frees 160 MB for 1e7 readings
    # A record that only rises is an error; a slow refill within a record is an event.
    if len(pieces) == 1 and not pooled:
        single, more_events = _fit_piece(pieces[0], law, False)
    else:
        single, more_events = _fit_each(pieces, law, bool(pooled))
    if not single and not pooled:  # refills are not resolved: every piece rises or is short
        events, (single, more_events) = (), _fit_piece(undated, law, True)
    names = [f"{record.name}#{k}" for k in range(1, len(single) + 1)]
    names = names if len(single) > 1 else [record.name] * len(single)
    decays = [
        decay.with_name(name, record.start, machine)
        for name, decay in zip(names, sorted(single, key=lambda d: d.offset), strict=True)
    ]
    display = thinned(record)
    display = replace(display, notes=record.notes) if pooled else display
    all_events = sorted((*events, *more_events), key=lambda event: event.time)
    return RecordStudy(display, tuple(decays), tuple(all_events), tuple(pooled))
