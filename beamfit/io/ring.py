"""Rings from a TOML file, a Twiss table (CSV or TFS) or a pyAT lattice.

A file is checked before the values are built, for which alone JAX is imported.
"""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.table import Sheet, read_sheet
from beamfit.io.toml import REQUIRED, TABLE, TEXT, Key, Section, read_toml

if TYPE_CHECKING:
    import at

    from beamfit.lifetime.ring import Operation, Optics, Ring

__all__ = ["read_operation", "read_ring", "read_twiss", "ring_from_pyat"]

INFINITE = math.inf
TABLES = {
    name: Key(kind=TABLE, default=None) for name in ("ring", "acceptance", "optics", "operation")
}


def _positive(field: str, factor: float = 1.0, default: Any = REQUIRED) -> Key:
    return Key(field, factor, default, low=0.0, said="a positive number")


RING = {
    "name": Key(kind=TEXT, default=""),
    "energy_GeV": _positive("energy", 1e9),
    "circumference_m": _positive("circumference"),
    "harmonic_number": _positive("harmonic"),
    "momentum_compaction": Key("momentum_compaction"),
    "energy_loss_keV": _positive("energy_loss", 1e3),
    "energy_spread": _positive("energy_spread"),
    "emittance_x_nm": _positive("emittance_x", 1e-9),
    "emittance_y_nm": _positive("emittance_y", 1e-9, None),
    "coupling": _positive("coupling", 1.0, None),
    "damping_time_y_ms": _positive("damping_time_y", 1e-3, INFINITE),
    "damping_time_z_ms": _positive("damping_time_z", 1e-3, INFINITE),
    "impedance_ohm": _positive("impedance", 1.0, 0.0),
}
ACCEPTANCE = {
    "momentum": _positive("momentum_acceptance", 1.0, INFINITE),
    "vertical_mm_mrad": _positive("acceptance_y", 1e-6, INFINITE),
    "scraper_beta_y_m": _positive("scraper_beta_y", 1.0, 1.0),
}
OPTICS = {
    "beta_x_m": _positive("beta_x"),
    "beta_y_m": _positive("beta_y"),
    "alpha_x": Key("alpha_x", default=0.0),
    "alpha_y": Key("alpha_y", default=0.0),
    "dispersion_x_m": Key("dispersion_x", default=0.0),
    "dispersion_y_m": Key("dispersion_y", default=0.0),
    "dispersion_slope_x": Key("slope_x", default=0.0),
    "dispersion_slope_y": Key("slope_y", default=0.0),
}
OPERATION = {
    "rf_voltage_kV": _positive("rf_voltage", 1e3),
    "bunches": _positive("bunches"),
    "scraper_y_mm": _positive("scraper_y", 1e-3, INFINITE),
    "pressure_base_Pa": Key("pressure_base", low=-1e-300, said="a positive number, or zero"),
    "pressure_slope_Pa_per_mA": _positive("pressure_slope", 1.0, 0.0),
    "temperature_K": _positive("temperature", 1.0, 300.0),
    "gas": Key("gas", kind=TABLE, default={"N2": 1.0}),
}
# column here, and in a TFS file; the vertical dispersion may be missing
COLUMNS = {
    "s_m": "S",
    "beta_x_m": "BETX",
    "beta_y_m": "BETY",
    "alpha_x": "ALFX",
    "alpha_y": "ALFY",
    "dispersion_x_m": "DX",
    "dispersion_y_m": "DY",
    "dispersion_slope_x": "DPX",
    "dispersion_slope_y": "DPY",
}
MAY_BE_MISSING = {"dispersion_y_m", "dispersion_slope_y"}
POSITIVE = {"beta_x_m", "beta_y_m"}


def read_ring(path: str | PathLike[str]) -> Ring:
    """Read a storage ring.

    Parameters
    ----------
    path : str or path
        TOML file with the tables `[ring]`, `[acceptance]` and `[optics]`; see docs/lifetime.md.
        `[optics]` holds ring averages, or `twiss`, a CSV or TFS file beside it.

    Returns
    -------
    Ring
        In SI units.

    Raises
    ------
    InputError
        If a key is missing, unknown or not a usable number, or the Twiss table is not usable.

    Examples
    --------
    >>> ring = read_ring("lattices/spear3_2003.toml")
    >>> print(f"{ring.emittance_y:.3e} m rad at {ring.optics.beta_y.size} points")
    3.610e-11 m rad at 761 points
    """
    top = _top(path)
    section = top.section("ring")
    machine = section.values(RING)
    section.one_of(("emittance_y_nm", "coupling"))
    if (coupling := machine.pop("coupling")) is not None:
        machine["emittance_y"] = machine["emittance_x"] * coupling
    aperture = top.section("acceptance").values(ACCEPTANCE)
    optics = _optics(top.section("optics"), machine["circumference"])
    from beamfit.lifetime.ring import Ring

    return Ring(**machine, **aperture, optics=optics)


def _top(path: str | PathLike[str]) -> Section:
    top = read_toml(path, "a ring")
    top.values(TABLES)
    return top


def _optics(section: Section, circumference: float) -> Optics:
    """The ring's optics: a table beside the file, or averages as a ring of one point."""
    if "twiss" in section.table:
        if len(section.table) > 1:
            raise section.error("averages beside a table", "one of them", "twiss")
        section.values({"twiss": Key(kind=TEXT)})
        return read_twiss(Path(section.path).parent / section.table["twiss"], circumference)
    averages = section.values(OPTICS)
    from beamfit.lifetime.ring import Optics  # JAX from here on

    return Optics(np.ones(1), **{field: np.array([value]) for field, value in averages.items()})


def read_operation(path: str | PathLike[str]) -> Operation:
    """Read the settings and the vacuum from the `[operation]` table of a ring file.

    Parameters
    ----------
    path : str or path
        TOML file, the same as for `read_ring`.

    Returns
    -------
    Operation
        In SI units, pressure rise for each milliampere.

    Raises
    ------
    InputError
        If a key is missing, unknown or not a usable number, the gas is unknown, or the RF
        voltage in the file does not exceed the energy loss per turn given there.

    Examples
    --------
    >>> read_operation("lattices/spear3_2003.toml").rf_voltage
    3200000.0
    """
    top = _top(path)
    section = top.section("operation")
    values, loss = section.values(OPERATION), top.section("ring").values(RING)["energy_loss"]
    if values["rf_voltage"] <= loss:
        found = f"{values['rf_voltage'] / 1e3:.6g} kV"
        expected = f"more than the loss of {loss / 1e3:.6g} kV a turn, or no beam is stored"
        raise section.error(found, expected, "rf_voltage_kV")
    from beamfit.lifetime.ring import Operation, gas_mixture  # JAX from here on

    try:
        gas = gas_mixture(**values.pop("gas"))
    except (TypeError, ValueError) as error:
        raise section.error(str(error), "partial pressures by molecule", "gas") from error
    return Operation(**values, gas=gas)


def read_twiss(path: str | PathLike[str], circumference: float) -> Optics:
    """Read the optics along a ring.

    Parameters
    ----------
    path : str or path
        CSV with the columns `s_m, beta_x_m, beta_y_m, alpha_x, alpha_y, dispersion_x_m,
        dispersion_slope_x` (and optionally the vertical dispersion), or MAD-X TFS. The table
        covers the whole ring, or one of its equal (or mirror-symmetric) parts. Points close
        together, inside magnets too: averages are taken by the trapezoidal rule.
    circumference : float
        Circumference of the ring, m.

    Returns
    -------
    Optics
        One point for each row.

    Raises
    ------
    InputError
        With file, line and column, if a column is missing, a cell is not a number, a Twiss beta
        is not positive, or the table does not cover the ring.

    Examples
    --------
    >>> optics = read_twiss("lattices/spear3_2003_twiss.csv", 234.144)
    >>> print(f"mean beta_y {optics.average(optics.beta_y):.3f} m")
    mean beta_y 8.785 m
    """
    sheet = read_sheet(path, "s_m,beta_x_m,beta_y_m")
    columns = {name: _column(sheet, name) for name in COLUMNS}
    from beamfit.lifetime.ring import Optics  # JAX from here on: the table is in order

    weight = _weights(sheet, columns.pop("s_m"), circumference)
    return Optics(weight, *columns.values())


def _column(sheet: Sheet, name: str) -> np.ndarray:
    """A column under its own name or that of a TFS file."""
    header = next((h for h in (name, COLUMNS[name]) if h in sheet.names), None)
    if header is None:
        if name in MAY_BE_MISSING:
            return np.zeros(len(sheet))
        known = nearest(name, list(sheet.names))
        raise sheet.header_error(f"no column '{name}', but {known}", f"'{name}'")
    values = sheet.numbers(header)
    if name in POSITIVE and (values <= 0).any():
        row = int(np.argmax(values <= 0))
        raise sheet.error(f"{values[row]:g}", "a positive beta function", row, header)
    return values


def _weights(sheet: Sheet, s: np.ndarray, circumference: float) -> np.ndarray:
    """Share of the ring for each point (trapezoid); the table covers the ring or a part 1/k."""
    steps = np.diff(s)
    if s.size < 2 or np.any(steps < 0):
        row = int(np.argmin(steps)) + 1 if s.size > 1 else None
        raise sheet.error("s falls", "positions that rise", row, "s_m")
    span = s[-1] - s[0]
    parts = circumference / span if span > 0 else 0.0
    if abs(parts - max(1, round(parts))) > 1e-3 * parts:
        found = f"a table over {span:.6g} m"
        expected = f"the circumference of {circumference:.6g} m or a whole fraction of it"
        raise sheet.error(found, expected, None, "s_m")
    weight = (np.r_[steps, 0.0] + np.r_[0.0, steps]) / 2
    return weight / span


def ring_from_pyat(
    lattice: at.Lattice,
    coupling: float,
    momentum_acceptance: float = INFINITE,
    acceptance_y: float = INFINITE,
    scraper_beta_y: float = 1.0,
    impedance: float = 0.0,
) -> Ring:
    """Take a ring from a pyAT lattice: its optics at every element and its equilibrium beam.

    Parameters
    ----------
    lattice : at.Lattice
        With an RF cavity. Slice it first (`lattice.slice(size=0.1)`): an element's optics are
        those at its entrance, as in pyAT's own Touschek lifetime.
    coupling : float
        Vertical over horizontal emittance.
    momentum_acceptance, acceptance_y, scraper_beta_y, impedance : float, optional
        As in `Ring`, in SI units.

    Returns
    -------
    Ring
        The ring.

    Raises
    ------
    InputError
        If the lattice has no stored beam at its RF voltage.

    Examples
    --------
    >>> import at
    >>> bend = at.Dipole("B", 1.0, np.pi / 8)
    >>> cell = [at.Quadrupole("F", 0.3, 1.2), bend, at.Quadrupole("D", 0.3, -1.2), bend]
    >>> cavity = at.RFCavity("RF", 0.0, 5e5, 12 * 299792458 / 20.8, 12, 1e9)
    >>> ring = ring_from_pyat(at.Lattice([*8 * cell, cavity], energy=1e9), coupling=0.01)
    >>> print(f"{ring.energy_loss / 1e3:.1f} keV, {ring.optics.beta_x.size} points")
    34.7 keV, 32 points
    """
    from beamfit.lifetime.ring import Optics, Ring

    loss, voltage = lattice.get_energy_loss(), lattice.get_rf_voltage()
    if voltage <= loss:
        expected = f"more than the loss of {loss:.6g} V a turn, or no beam is stored"
        raise InputError(f"RF voltage {voltage:.6g} V", expected, column="rf_voltage")
    beam = lattice.enable_6d(copy=True).envelope_parameters()
    flat = lattice.disable_6d(copy=True)
    lengths = np.array([element.Length for element in flat])
    points = np.flatnonzero(lengths > 0)
    _, _, data = flat.get_optics(refpts=points)
    optics = Optics(
        lengths[points] / lengths.sum(),
        *data.beta.T,
        *data.alpha.T,
        data.dispersion[:, 0],
        data.dispersion[:, 2],
        data.dispersion[:, 1],
        data.dispersion[:, 3],
    )
    return Ring(
        energy=lattice.energy,
        circumference=lattice.circumference,
        harmonic=float(lattice.harmonic_number),
        momentum_compaction=flat.get_mcf(),
        energy_loss=loss,
        energy_spread=beam.sigma_e,
        emittance_x=beam.emittances[0],
        emittance_y=coupling * beam.emittances[0],
        momentum_acceptance=momentum_acceptance,
        acceptance_y=acceptance_y,
        scraper_beta_y=scraper_beta_y,
        damping_time_y=beam.Tau[1],
        damping_time_z=beam.Tau[2],
        impedance=impedance,
        optics=optics,
    )
