"""Read rings from a TOML file, a Twiss table (CSV or TFS) or a pyAT lattice.

Files are checked before JAX is imported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.columns import Sheet
from beamfit.io.table import read_sheet
from beamfit.io.toml import NUMBERS, REQUIRED, TABLE, TEXT, Key, Section, read_toml

if TYPE_CHECKING:
    import at

    from beamfit.lifetime.ring import MeasuredLength, Operation, Optics, Ring

# Columns of the optics -> names in a TFS file. The vertical dispersion is optional.
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
OPTIONAL_COLUMNS = {"dispersion_y_m", "dispersion_slope_y"}
ACCEPTANCE_COLUMNS = ("delta_plus", "delta_minus")
# Ranges of the columns, by the first word of their name.
RANGES = {
    "beta": (1e-6, 1e6, "a positive beta function"),
    "alpha": (-1e4, 1e4, "a Twiss alpha"),
    "dispersion": (-1e3, 1e3, "a dispersion of metres"),
    "s": (-1e6, 1e6, "a position in m"),
}
INFINITE = math.inf
SHARE_TEXT = "a positive number that is a share: up to 1, 0.03 for 3 %"
FILL_TEXT = "the number of equal bunches, or a list with the charge of each, in any unit"
LENGTH_TEXT = (
    "a number, or one for each of rising bunch currents: bunch_length_mm, bunch_current_mA"
)
PRESSURE_TEXT = "a positive number, or zero, below 1 Pa"
TABLES = {
    name: Key(kind=TABLE, default=None) for name in ("ring", "acceptance", "optics", "operation")
}


def _positive_key(
    field: str, low: float, high: float, factor: float = 1.0, default: Any = REQUIRED
) -> Key:
    """Key of a positive number in an open interval, in the unit of the file."""
    interval = f"below {high:.6g}" if low == 0 else f"between {low:.6g} and {high:.6g}"
    return Key(field, factor, default, low, high, f"a positive number {interval}")


RING_KEYS = {
    "name": Key(kind=TEXT, default=""),
    "energy_GeV": _positive_key("energy", 0.01, 1e4, 1e9),
    "circumference_m": _positive_key("circumference", 1.0, 1e6),
    "harmonic_number": _positive_key("harmonic", 0.99, 1e7),
    "momentum_compaction": _positive_key("momentum_compaction", 1e-9, 1.0),
    "energy_loss_keV": _positive_key("energy_loss", 1e-9, 1e8, 1e3),
    "energy_spread": _positive_key("energy_spread", 1e-7, 0.1),
    "emittance_x_nm": _positive_key("emittance_x", 1e-9, 1e6, 1e-9),
    "emittance_y_nm": _positive_key("emittance_y", 1e-9, 1e6, 1e-9, None),
    "coupling": Key("coupling", 1.0, None, 1e-9, np.nextafter(1.0, 2.0), SHARE_TEXT),
    "damping_time_y_ms": _positive_key("damping_time_y", 1e-6, 1e9, 1e-3, INFINITE),
    "damping_time_z_ms": _positive_key("damping_time_z", 1e-6, 1e9, 1e-3, INFINITE),
    "impedance_ohm": _positive_key("impedance", 0.0, 1e4, 1.0, 0.0),
}
ACCEPTANCE_KEYS = {
    "momentum": Key("momentum_acceptance", 1.0, INFINITE, 1e-9, 1.0, SHARE_TEXT),
    "momentum_table": Key(kind=TEXT, default=None),
    "vertical_mm_mrad": _positive_key("acceptance_y", 1e-9, 1e9, 1e-6, INFINITE),
    "horizontal_mm_mrad": _positive_key("acceptance_x", 1e-9, 1e9, 1e-6, INFINITE),
    "scraper_beta_y_m": _positive_key("scraper_beta_y", 1e-6, 1e6, 1.0, 1.0),
}


def _average_key(name: str) -> Key:
    """Key of a ring average, of the same name as its column in a table."""
    field = name.removesuffix("_m").replace("dispersion_slope", "slope")
    kind = name.split("_")[0]
    return Key(field, 1.0, REQUIRED if kind == "beta" else 0.0, *RANGES[kind])


OPTICS_KEYS = {name: _average_key(name) for name in COLUMNS if name != "s_m"}
OPERATION_KEYS = {
    "rf_voltage_kV": _positive_key("rf_voltage", 1e-3, 1e8, 1e3),
    "bunches": Key("bunches", kind=NUMBERS, low=-1e-300, high=1e9, expected=FILL_TEXT),
    "bunch_length_mm": Key("length", 1e-3, None, 1e-3, 1e4, LENGTH_TEXT, NUMBERS),
    "bunch_current_mA": Key("current", 1.0, 0.0, -1e-300, 1e4, LENGTH_TEXT, NUMBERS),
    "bunch_length_exponent": Key("exponent", 1.0, 0.0, -1e-300, 1.0, "a power between 0 and 1"),
    "harmonic_cavity": Key(kind=TABLE, default=None),
    "scraper_y_mm": _positive_key("scraper_y", 1e-3, 1e4, 1e-3, INFINITE),
    "pressure_base_Pa": Key("pressure_base", 1.0, REQUIRED, -1e-300, 1.0, PRESSURE_TEXT),
    "pressure_slope_Pa_per_mA": Key("pressure_slope", 1.0, 0.0, -1e-300, 1.0, PRESSURE_TEXT),
    "temperature_K": _positive_key("temperature", 1.0, 1e4, 1.0, 300.0),
    "gas": Key("gas", kind=TABLE, default={"N2": 1.0}),
}
CAVITY_KEYS = {
    "number": _positive_key("number", 1.0, 100.0),
    "voltage_kV": Key("voltage", 1e3, REQUIRED, -1e-300, 1e8, "a voltage of zero or more"),
    "phase_deg": Key("phase", math.pi / 180, REQUIRED, -361.0, 361.0, "an angle in degrees"),
}
STRETCH_KEYS = {"stretch": _positive_key("stretch", 0.1, 100.0)}


def read_ring(path: str | PathLike[str]) -> Ring:
    """Read a storage ring.

    Parameters
    ----------
    path : str or path
        TOML file with the tables `[ring]`, `[acceptance]` and `[optics]`; see docs/lifetime.md.
        `[optics]` holds ring averages, or `twiss`, the path of a CSV or TFS file; `momentum_table`
        of `[acceptance]` is the path of a table of the momentum acceptance.

    Returns
    -------
    Ring
        In SI units.

    Raises
    ------
    InputError
        If a key is missing, unknown or out of range, or a table is not usable.

    Examples
    --------
    >>> ring = read_ring("lattices/spear3_2003.toml")
    >>> print(f"{ring.emittance_y:.3e} m rad at {ring.optics.beta_y.size} points")
    3.610e-11 m rad at 761 points
    """
    top = _read_ring_file(path)
    section, acceptance = top.section("ring"), top.section("acceptance")
    ring_values = section.values(RING_KEYS)
    section.one_of(("emittance_y_nm", "coupling"))
    if (coupling := ring_values.pop("coupling")) is not None:
        ring_values["emittance_y"] = ring_values["emittance_x"] * coupling
    if ring_values["energy_loss"] >= ring_values["energy"]:
        found = f"{ring_values['energy_loss'] / 1e3:.6g} keV a turn"
        expected = f"less than the energy of {ring_values['energy'] / 1e9:.6g} GeV"
        raise section.error(found, expected, "energy_loss_keV")
    aperture, table = acceptance.values(ACCEPTANCE_KEYS), acceptance.table.get("momentum_table")
    if table is not None:
        acceptance.one_of(("momentum", "momentum_table"))
        table = Path(path).parent / table
    averages = _optics_source(top.section("optics"))
    optics, acceptance_sides = read_ring_tables(ring_values["circumference"], averages, table)
    aperture |= {} if acceptance_sides is None else {"momentum_acceptance": acceptance_sides}
    from beamfit.lifetime.ring import Ring

    return Ring(**ring_values, **aperture, optics=optics)


def _read_ring_file(path: str | PathLike[str]) -> Section:
    top = read_toml(path, "a ring")
    top.values(TABLES)
    return top


def _optics_source(section: Section) -> dict[str, float] | Path:
    """Ring averages, or the path of the Twiss table."""
    if "twiss" not in section.table:
        return section.values(OPTICS_KEYS)
    if len(section.table) > 1:
        raise section.error("averages beside a table", "one of them", "twiss")
    section.values({"twiss": Key(kind=TEXT)})
    return Path(section.path).parent / section.table["twiss"]


def read_operation(path: str | PathLike[str]) -> Operation:
    """Read settings and vacuum from the `[operation]` table of a ring file.

    Parameters
    ----------
    path : str or path
        TOML file, the same as for `read_ring`.

    Returns
    -------
    Operation
        In SI units, the pressure rise per mA.

    Raises
    ------
    InputError
        If a key is missing, unknown or out of range, the gas is unknown, or the RF voltage does
        not exceed the energy loss per turn.

    Examples
    --------
    >>> read_operation("lattices/spear3_2003.toml").rf_voltage
    3200000.0
    """
    top = _read_ring_file(path)
    section, ring = top.section("operation"), top.section("ring").values(RING_KEYS)
    values = section.values(OPERATION_KEYS)
    values |= _equal_bunches(section, values["bunches"], ring["harmonic"]) | _cavity(section)
    values["bunch_length"] = _bunch_length(section, values)
    if values["bunch_length"] is not None and ring["impedance"] > 0:
        expected = "one of them: a given bunch length is taken as it is"
        raise section.error("a bunch length beside impedance_ohm", expected, "bunch_length_mm")
    from beamfit.lifetime.ring import Operation, gas_mixture, required_voltage  # JAX from here on

    try:
        gas = gas_mixture(**values.pop("gas"))
    except (TypeError, ValueError) as error:
        raise section.error(str(error), "partial pressures by molecule", "gas") from error
    operation = Operation(**values, gas=gas)
    if expected := required_voltage(operation, ring["energy_loss"], ring["energy"]):
        found = f"{operation.rf_voltage / 1e3:.6g} kV"
        raise section.error(found, expected, "rf_voltage_kV")
    return operation


def _equal_bunches(section: Section, given: float | list[float], buckets: float) -> dict[str, Any]:
    """Number of equal bunches with the same loss, and the charges relative to one of them."""
    charge = np.array(given, float, ndmin=1)
    if isinstance(given, list):
        charge = charge[charge > 0]
        found = f"{len(given)} bunches, {charge.size} filled"
        count = len(given)
    else:
        found, count = f"{given:g} bunches", given
    if not (charge.size and 1 <= count <= buckets):
        expected = f"1 to {buckets:g}, the harmonic number"
        raise section.error(found, expected, "bunches")
    if not isinstance(given, list):
        return {"bunches": given}
    from beamfit.lifetime.ring import equal_bunches

    bunches = float(equal_bunches(charge))
    return {"bunches": bunches, "fill": charge / charge.sum() * bunches}


def _cavity(section: Section) -> dict[str, Any]:
    """Harmonic cavity, or the bunch lengthening it causes."""
    if "harmonic_cavity" not in section.table:
        return {}
    cavity = section.section("harmonic_cavity")
    if "stretch" in cavity.table:
        return cavity.values(STRETCH_KEYS)
    from beamfit.lifetime.ring import HarmonicCavity

    return {"harmonic_cavity": HarmonicCavity(**cavity.values(CAVITY_KEYS))}


def _bunch_length(section: Section, values: dict[str, Any]) -> MeasuredLength | None:
    """Measured bunch length by bunch current; None if it is not given."""
    measured = {key: values.pop(key) for key in ("length", "current", "exponent")}
    if measured["length"] is None:
        for key in ("bunch_current_mA", "bunch_length_exponent"):
            if key in section.table:
                raise section.error(f"{key} without bunch_length_mm", LENGTH_TEXT, key)
        return None
    if "stretch" in values:
        expected = "one of them: the length is taken as is"
        raise section.error("a bunch length beside a stretch", expected, "bunch_length_mm")
    current, length = (np.array(measured[key], float, ndmin=1) for key in ("current", "length"))
    if current.shape != length.shape or (np.diff(current) <= 0).any():
        found = f"{length.size} lengths at {current.size} bunch currents"
        raise section.error(found, f"{LENGTH_TEXT}, as many", "bunch_length_mm")
    if measured["exponent"] > 0 and not current[-1] > 0:
        expected = "bunch_current_mA, above which the bunch grows with that power"
        raise section.error("an exponent without a current", expected, "bunch_length_exponent")
    from beamfit.lifetime.ring import MeasuredLength

    return MeasuredLength(current, length, measured["exponent"], values["rf_voltage"])


def ring_from_pyat(
    lattice: at.Lattice,
    coupling: float,
    momentum_acceptance: float = INFINITE,
    acceptance_y: float = INFINITE,
    scraper_beta_y: float = 1.0,
    impedance: float = 0.0,
    acceptance_x: float = INFINITE,
) -> Ring:
    """Make a ring from a pyAT lattice: optics at every element, and equilibrium beam.

    Parameters
    ----------
    lattice : at.Lattice
        With an RF cavity. Slice it first (`lattice.slice(size=0.1)`): an element's optics are
        those at its entrance, as in pyAT's own Touschek lifetime.
    coupling : float
        Vertical over horizontal emittance.
    momentum_acceptance, acceptance_y, scraper_beta_y, impedance, acceptance_x : float, optional
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
        *data.dispersion.T[[0, 2, 1, 3]],  # both dispersions before both slopes
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
        acceptance_x=acceptance_x,
    )


def read_ring_tables(
    circumference: float, optics: Mapping[str, float] | Path, apertures: Path | None
) -> tuple[Optics, np.ndarray | None]:
    """Read optics and momentum acceptance along the ring.

    Parameters
    ----------
    circumference : float
        Circumference of the ring, m.
    optics : mapping of str to float, or path
        Ring averages by field of `Optics`, in that order; or CSV with the columns `s_m, beta_x_m,
        beta_y_m, alpha_x, alpha_y, dispersion_x_m, dispersion_slope_x` (and optionally the
        vertical dispersion), or MAD-X TFS. The table covers the whole ring, or one of its equal
        (or mirror-symmetric) parts. Points should be close, also inside magnets: averages are taken
        by the trapezoidal rule.
    apertures : path or None
        A table with `s_m, delta_plus, delta_minus`: relative momentum acceptance of the lattice
        (with either sign), over the same part of the ring as the optics.

    Returns
    -------
    Optics
        At the points of its table; averages at those of the acceptance.
    array, shape (2, n), or None
        Momentum acceptance, positive and negative, at these points by linear interpolation.

    Raises
    ------
    InputError
        With file, line and column, if a column is missing, a cell is not a number, a Twiss beta
        is not positive, an acceptance is not between 0 and 1, or a table does not cover the ring.

    Examples
    --------
    >>> optics, _ = read_ring_tables(234.144, Path("lattices/spear3_2003_twiss.csv"), None)
    >>> print(f"mean beta_y {optics.average(optics.beta_y):.3f} m")
    mean beta_y 8.785 m
    """
    if isinstance(optics, Path):
        sheet = read_sheet(optics, "s_m,beta_x_m,beta_y_m")
        s, *values = (_column(sheet, name) for name in COLUMNS)
        weight = _ring_shares(sheet, s, circumference)
    else:
        s, weight, values = None, np.ones(1), np.array(list(optics.values()))[:, None]
    acceptance = None
    if apertures is not None:
        sheet = read_sheet(apertures, "s_m,delta_plus,delta_minus")
        positions, *acceptance = (_column(sheet, name) for name in ("s_m", *ACCEPTANCE_COLUMNS))
        shares = _ring_shares(sheet, positions, circumference)
        if s is None:
            weight, values = shares, np.broadcast_to(values, (len(values), positions.size))
        elif max(abs(positions[0] - s[0]), abs(positions[-1] - s[-1])) > 1e-3 * circumference:
            found = f"s from {positions[0]:.6g} to {positions[-1]:.6g} m"
            expected = f"that of the optics, {s[0]:.6g} to {s[-1]:.6g} m"
            raise sheet.header_error(found, expected, "s_m")
        else:
            acceptance = [np.interp(s, positions, side) for side in acceptance]
    from beamfit.lifetime.ring import Optics  # JAX from here on: the tables are in order

    return Optics(weight, *values), None if acceptance is None else np.stack(acceptance)


def _column(sheet: Sheet, name: str) -> np.ndarray:
    """Checked column, under its own name or that of a TFS file; optional ones default to 0."""
    header = next((h for h in (name, COLUMNS.get(name)) if h in sheet.names), None)
    if header is None:
        if name in OPTIONAL_COLUMNS:
            return np.zeros(len(sheet))
        nearest_names = nearest(name, list(sheet.names))
        raise sheet.header_error(f"no column '{name}', but {nearest_names}", f"'{name}'")
    values = sheet.numbers(header)
    if name in ACCEPTANCE_COLUMNS:
        values = np.abs(values)
        wrong, expected = (values == 0) | (values >= 1), "a share between 0 and 1, 0.03 for 3 %"
    else:
        low, high, expected = RANGES[name.split("_")[0]]
        wrong = ~((low < values) & (values < high))
    sheet.refuse(header, wrong, expected, "{:g}", values)
    return values


def _ring_shares(sheet: Sheet, s: np.ndarray, circumference: float) -> np.ndarray:
    """Share of the ring at each point (trapezoidal rule); a table covers the ring or 1/k of it."""
    steps = np.diff(s)
    if np.any(steps < 0):
        raise sheet.error("s falls", "positions that rise", int(np.argmin(steps)) + 1, "s_m")
    span = s[-1] - s[0] if s.size else 0.0
    parts = circumference / span if span > 0 else 0.0
    if abs(parts - max(1, round(parts))) > 1e-3 * parts:
        found = f"a table over {span:.6g} m"
        expected = f"the circumference of {circumference:.6g} m or a whole fraction of it"
        raise sheet.header_error(found, expected, "s_m")
    weight = (np.r_[steps, 0.0] + np.r_[0.0, steps]) / 2
    return weight / span
