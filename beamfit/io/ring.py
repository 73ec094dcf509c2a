"""Rings from a TOML file, a Twiss table (CSV or TFS) or a pyAT lattice.

A file is checked before the values are built, for which alone JAX is imported.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.files import read_text
from beamfit.io.twiss import read_twiss

if TYPE_CHECKING:
    import at

    from beamfit.lifetime.ring import Gas, Operation, Optics, Ring

__all__ = ["read_operation", "read_ring", "ring_from_pyat"]

INFINITE = math.inf
# key of the file: (field of the value, SI value of one unit, default; None: it must be there)
RING_KEYS = {
    "energy_GeV": ("energy", 1e9, None),
    "circumference_m": ("circumference", 1.0, None),
    "harmonic_number": ("harmonic", 1.0, None),
    "momentum_compaction": ("momentum_compaction", 1.0, None),
    "energy_loss_keV": ("energy_loss", 1e3, None),
    "energy_spread": ("energy_spread", 1.0, None),
    "emittance_x_nm": ("emittance_x", 1e-9, None),
    "emittance_y_nm": ("emittance_y", 1e-9, math.nan),
    "coupling": ("coupling", 1.0, math.nan),
    "damping_time_y_ms": ("damping_time_y", 1e-3, INFINITE),
    "damping_time_z_ms": ("damping_time_z", 1e-3, INFINITE),
    "impedance_ohm": ("impedance", 1.0, 0.0),
}
ACCEPTANCE_KEYS = {
    "momentum": ("momentum_acceptance", 1.0, INFINITE),
    "vertical_mm_mrad": ("acceptance_y", 1e-6, INFINITE),
    "scraper_beta_y_m": ("scraper_beta_y", 1.0, 1.0),
}
OPTICS_KEYS = {
    "beta_x_m": ("beta_x", 1.0, None),
    "beta_y_m": ("beta_y", 1.0, None),
    "alpha_x": ("alpha_x", 1.0, 0.0),
    "alpha_y": ("alpha_y", 1.0, 0.0),
    "dispersion_x_m": ("dispersion_x", 1.0, 0.0),
    "dispersion_y_m": ("dispersion_y", 1.0, 0.0),
    "dispersion_slope_x": ("slope_x", 1.0, 0.0),
    "dispersion_slope_y": ("slope_y", 1.0, 0.0),
}
OPERATION_KEYS = {
    "rf_voltage_kV": ("rf_voltage", 1e3, None),
    "bunches": ("bunches", 1.0, None),
    "scraper_y_mm": ("scraper_y", 1e-3, INFINITE),
    "pressure_base_Pa": ("pressure_base", 1.0, None),
    "pressure_slope_Pa_per_mA": ("pressure_slope", 1.0, 0.0),
    "temperature_K": ("temperature", 1.0, 300.0),
}
MAY_BE_ZERO = {"impedance_ohm", "pressure_base_Pa", "pressure_slope_Pa_per_mA"}
ANY_SIGN = {name for name in OPTICS_KEYS if not name.startswith("beta")} | {"momentum_compaction"}


def _document(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(error), "a ring file in TOML", path=path) from error


def _table(document: dict[str, Any], name: str, path: Path) -> dict[str, Any]:
    table = document.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"{name} = {table!r}", f"a table [{name}]", path=path, column=name)
    return table


def _number(
    table: dict[str, Any], key: str, unit: float, default: float | None, path: Path
) -> float:
    """One value in SI, its type and sign checked."""
    if key not in table:
        if default is None:
            raise InputError("the key is missing", "a number", path=path, column=key)
        return default
    value = table[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise InputError(f"{value!r}", "a number", path=path, column=key)
    if key not in ANY_SIGN and (value < 0 or (value == 0 and key not in MAY_BE_ZERO)):
        raise InputError(f"{value!r}", "a positive number", path=path, column=key)
    return value * unit


def _numbers(
    table: dict[str, Any],
    keys: dict[str, tuple[str, float, float | None]],
    path: Path,
    also: tuple[str, ...] = (),
) -> dict[str, float]:
    """Values of a table by field; a key that the table does not know is an error."""
    for key in table:
        if key not in keys and key not in also:
            raise InputError("an unknown key", nearest(key, list(keys)), path=path, column=key)
    return {
        field: _number(table, key, unit, default, path)
        for key, (field, unit, default) in keys.items()
    }


def _vertical_emittance(machine: dict[str, float], path: Path) -> float:
    """From the emittance itself or the coupling, whichever the file gives."""
    coupling, emittance_y = machine["coupling"], machine["emittance_y"]
    if math.isnan(emittance_y) == math.isnan(coupling):
        amount = "neither" if math.isnan(coupling) else "both"
        found = f"{amount} of emittance_y_nm and coupling"
        raise InputError(found, "one of them", path=path, column="coupling")
    return machine["emittance_x"] * coupling if math.isnan(emittance_y) else emittance_y


def _optics(table: dict[str, Any], circumference: float, path: Path) -> Optics:
    """The ring's optics: a table beside the file, or averages as a ring of one point."""
    if "twiss" not in table:
        averages = _numbers(table, OPTICS_KEYS, path)
        from beamfit.lifetime.ring import Optics  # JAX from here on

        points = {field: np.array([value]) for field, value in averages.items()}
        return Optics(weight=np.ones(1), **points)
    if len(table) > 1:
        raise InputError("averages beside a table", "one of them", path=path, column="twiss")
    return read_twiss(path.parent / str(table["twiss"]), circumference)


def read_ring(path: str | Path) -> Ring:
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
    path = Path(path)
    document = _document(path)
    machine = _numbers(_table(document, "ring", path), RING_KEYS, path, also=("name",))
    machine["emittance_y"] = _vertical_emittance(machine, path)
    del machine["coupling"]
    aperture = _numbers(_table(document, "acceptance", path), ACCEPTANCE_KEYS, path)
    optics = _optics(_table(document, "optics", path), machine["circumference"], path)
    from beamfit.lifetime.ring import Ring

    return Ring(**machine, **aperture, optics=optics)


def read_operation(path: str | Path) -> Operation:
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
    path = Path(path)
    document = _document(path)
    table = _table(document, "operation", path)
    values = _numbers(table, OPERATION_KEYS, path, also=("gas",))
    ring = _table(document, "ring", path)
    loss = _number(ring, "energy_loss_keV", 1e3, None, path)
    if values["rf_voltage"] <= loss:
        raise InputError(
            f"{values['rf_voltage'] / 1e3:.6g} kV",
            f"more than the loss of {loss / 1e3:.6g} kV a turn, or no beam is stored",
            path=path,
            column="rf_voltage_kV",
        )
    from beamfit.lifetime.ring import Operation  # JAX from here on

    return Operation(**values, gas=_gas(table.get("gas", {"N2": 1.0}), path))


def _gas(fractions: dict[str, float], path: Path) -> Gas:
    from beamfit.lifetime.ring import gas_mixture

    try:
        return gas_mixture(**fractions)
    except (TypeError, ValueError) as error:
        raise InputError(
            str(error), "partial pressures by molecule", path=path, column="gas"
        ) from error


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
