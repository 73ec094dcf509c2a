"""What a ring is expected to lose during a record: first principles at the record's settings."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.lifetime.bunch import stored_bunch
from beamfit.lifetime.decay import HOUR
from beamfit.lifetime.losses import MECHANISMS, Losses, loss_coefficients
from beamfit.lifetime.ring import MeasuredLength, Operation, Ring, unstored
from beamfit.quantity import Quantity
from beamfit.shown import shown
from beamfit.studies.decay.record import DecayRecord
from beamfit.table import json_of


@shown
class Machine(NamedTuple):
    """A ring and the settings and vacuum that hold where a record does not say otherwise."""

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
    """

    operation: Operation
    losses: Losses
    current: float
    bunch_length: float
    emittances: tuple[float, float]

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
    >>> from beamfit.studies.decay.record import Conditions
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
        mean = usual.pressure_base + usual.pressure_slope * float(record.current.mean())
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
    current = float(record.current.mean())
    losses = loss_coefficients(machine.ring, operation, current)
    ring, parts = machine.ring, Losses(*(float(part) for part in losses))
    length = float(stored_bunch(ring, operation, current).length)
    emittances = float(ring.emittance_x), float(ring.emittance_y)
    return Budget(operation, parts, current, length, emittances)
