"""What first principles say of a record's a and b, mechanism by mechanism."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.lifetime.decay import HOUR
from beamfit.lifetime.losses import MECHANISMS, Losses, loss_coefficients
from beamfit.lifetime.ring import Operation, Ring
from beamfit.quantity import Quantity
from beamfit.studies.decay.record import DecayRecord
from beamfit.table import json_of

__all__ = ["Budget", "Machine", "budget", "operation_during", "settings_json"]


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
    """

    operation: Operation
    losses: Losses
    current: float

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
        parts = {"a": self.losses.a, "b": self.losses.b}
        units = dict.fromkeys(parts, "1/(mA s)") | {"b": "1/s"}
        of_mechanisms = zip(self.losses._asdict().items(), self.losses.units, strict=True)
        rows = {name: Quantity(value, None, unit) for (name, value), unit in of_mechanisms}
        rows |= {name: Quantity(value, None, units[name]) for name, value in parts.items()}
        rows["lifetime_mean"] = Quantity(self.lifetime, None, "h")
        pressure = {
            "pressure_base_Pa": float(self.operation.pressure_base),
            "pressure_slope_Pa_per_mA": float(self.operation.pressure_slope),
        }
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
        two apart.

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
    said = {
        name: float(np.median(values))
        for name, values in record.conditions._asdict().items()
        if values is not None
    }
    for name, value in said.items():
        if not value > 0:
            raise InputError(f"{name} {value:g}", "above zero", path=record.name, column=name)
    loss = float(machine.ring.energy_loss)
    if said.get("rf_voltage", np.inf) <= loss:
        expected = f"more than the loss of {loss / 1e3:.6g} kV a turn, or no beam is stored"
        found = f"{said['rf_voltage'] / 1e3:.6g} kV"
        raise InputError(found, expected, path=record.name, column="rf_voltage_kV")
    energy = float(machine.ring.energy)
    if said.get("rf_voltage", 0.0) > energy:
        found = f"{said['rf_voltage'] / 1e3:.6g} kV"
        expected = f"less than the beam's energy, {energy / 1e6:.6g} MeV; check the unit"
        raise InputError(found, expected, path=record.name, column="rf_voltage_kV")
    if "pressure" in said:
        read = said.pop("pressure")
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
    return Budget(operation, Losses(*(float(part) for part in losses)), current)
