"""Machine files (TOML): variables of a control system for a scan or a watch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from beamfit.errors import InputError, nearest, plain
from beamfit.io.columns import SETTINGS, UNIT_SPELLINGS, UNITS, known_unit
from beamfit.io.decay_record import QUANTITIES
from beamfit.io.lattice import LatticeFile
from beamfit.io.line import part_of, read_lattice
from beamfit.io.toml import LIST, TABLE, TEXT, WHOLE, Key, Section, is_number, key_field, read_toml
from beamfit.lifetime.record import Conditions

FORMAT = "beamfit-machine-1"
# Default limits: settings of a scan, rows of a tuning.
MAX_POINTS, MAX_TUNING_ROWS = 15, 60
APPROACHES = ("either", "below", "above")
# Spelling of a unit in lower case, as control systems write it -> unit of a setting.
SETTING_UNITS = {u.lower(): u for u in SETTINGS}
SETTING_UNITS |= {word.lower(): unit for word, unit in UNIT_SPELLINGS.items() if unit in SETTINGS}
# Units of beam sizes, to m.
LENGTHS = {"um": 1e-6, "mm": 1e-3, "m": 1.0}
# Ranges that several keys share.
POSITIVE_TIME = {"low": 0.0, "expected": "a time above zero"}
POSITIVE = {"low": 0.0, "expected": "a positive number"}
SCAN_KEYS = {
    "goal_percent": Key("goal", 1e-2, default=0.03, low=0.0, high=100.0, expected="0 to 100 %"),
    "points": Key("points", kind=WHOLE, default=None, low=3, high=201, expected="4 to 200 points"),
    "first": Key("first", kind=LIST, default=()),
    "restore_s": Key("restore", default=60.0, **POSITIVE_TIME),
}
TOP_KEYS = {
    "name": Key("name", kind=TEXT, default=""),
    "lattice": Key("lattice", kind=TEXT, default=None),
    "timeout_s": Key("timeout", default=5.0, **POSITIVE_TIME),
    **{name: Key(kind=LIST, default=()) for name in ("magnet", "knob")},
    **{name: Key(kind=TABLE, default=None) for name in ("screen", "beam", "scan", "ring", "watch")},
}


@dataclass(frozen=True)
class Magnet:
    """Magnet of a machine file, in the unit of the lattice's settings.

    Attributes
    ----------
    name, set, read, unit : str
        Name in the lattice, variables of setting and read-back, and their unit.
    low, high, tolerance : float
        Limits of settings, and largest deviation of the read-back, in either direction.
    settle, timeout : float
        Time for which the read-back must stay within the tolerance, and time after which the
        magnet is given up, s.
    approach : {"either", "below", "above"}
        Side from which a setting is approached. The magnet first goes beyond it by
        ``approach_by``, within the limits.
    degauss : tuple of float
        Settings visited before a scan.
    """

    name: str = key_field("name", kind=TEXT)
    set: str = key_field("set", kind=TEXT)
    read: str = key_field("read", kind=TEXT)
    unit: str = key_field("unit", kind=TEXT)
    low: float = key_field("low")
    high: float = key_field("high")
    tolerance: float = key_field("tolerance", **POSITIVE)
    settle: float = key_field("settle_s", low=-1e-9, high=3600.0, expected="a time of zero or more")
    timeout: float = key_field("timeout_s", 60.0, **POSITIVE_TIME)
    approach: str = key_field("approach", "either", kind=TEXT, among=APPROACHES)
    approach_by: float = key_field("approach_by", 0.0, low=-1e-12, expected="zero or more")
    degauss: tuple[float, ...] = key_field("degauss", (), kind=LIST)

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest setting that can be approached from the required side.

        Examples
        --------
        >>> Magnet("Q", "SET", "READ", "A", -1.0, 1.0, 0.01, 0.1, 60.0, "below", 0.5).span
        (-0.5, 1.0)
        """
        below, above = self.approach == "below", self.approach == "above"
        return self.low + below * self.approach_by, self.high - above * self.approach_by


@dataclass(frozen=True)
class Profiler:
    """Screen of a machine file: variables of rms sizes or of projections.

    Attributes
    ----------
    name : str
        Name in the lattice.
    x, y, profile_x, profile_y : str or None
        Variables; `sizes` and `profiles` give them by plane, and one of the two is empty.
    unit : str
        Unit of the sizes.
    pixel : float or None
        Pixel width of the projections, m.
    shots : int
        Number of shots at each setting.
    timeout : float
        Longest wait for a new time stamp, s.
    """

    name: str | None = key_field("name", None, kind=TEXT)
    x: str | None = key_field("x", None, kind=TEXT)
    y: str | None = key_field("y", None, kind=TEXT)
    profile_x: str | None = key_field("profile_x", None, kind=TEXT)
    profile_y: str | None = key_field("profile_y", None, kind=TEXT)
    unit: str = key_field("unit", "um", kind=TEXT, among=tuple(LENGTHS))
    pixel: float | None = key_field("pixel_um", None, factor=1e-6, **POSITIVE)
    shots: int = key_field("shots", 5, kind=WHOLE, low=1, high=1001, expected="2 to 1000 shots")
    timeout: float = key_field("timeout_s", 10.0, **POSITIVE_TIME)

    @property
    def sizes(self) -> dict[str, str]:
        """Variable of the rms size, by plane."""
        return {p: v for p, v in zip("xy", (self.x, self.y), strict=True) if v}

    @property
    def profiles(self) -> dict[str, str]:
        """Variable of the projection, by plane."""
        return {p: v for p, v in zip("xy", (self.profile_x, self.profile_y), strict=True) if v}


@dataclass(frozen=True)
class Guard:
    """Conditions for a valid shot: beam above, loss below a limit; None without a condition."""

    present: str | None = key_field("present", None, kind=TEXT)
    present_above: float | None = key_field("present_above", None)
    loss: str | None = key_field("loss", None, kind=TEXT)
    loss_below: float | None = key_field("loss_below", None)
    wait: float = key_field("wait_s", 60.0, **POSITIVE_TIME)


@dataclass(frozen=True)
class ScanMachine:
    """Machine for `beamfit scan`.

    Attributes
    ----------
    name, path, sha256 : str
        Name of the machine, its file, and the digest of the file.
    lattice : LatticeFile
        The line.
    magnets : tuple of Magnet
        Magnets to be scanned, then the knobs.
    screen : Profiler
    guard : Guard
    goal : float
        Relative error of the emittances at which the scan stops.
    points : int
        Largest number of settings.
    first : tuple of float
        First settings of the first magnet; if empty, spread over its limits.
    restore, timeout : float
        Time for which restoring is retried if an IOC does not answer, and time within which a
        variable must answer, s.
    knobs : tuple of str
        Names of the knobs to be tuned; empty in a scan for the emittance.
    """

    name: str
    path: str
    sha256: str
    lattice: LatticeFile
    magnets: tuple[Magnet, ...]
    screen: Profiler
    guard: Guard
    goal: float
    points: int
    first: tuple[float, ...]
    restore: float
    timeout: float
    knobs: tuple[str, ...] = ()


def read_scan_machine(path: str | PathLike[str]) -> ScanMachine:
    """Read a machine file for a scan, and its lattice.

    Parameters
    ----------
    path : str or path
        TOML, format "beamfit-machine-1" (docs/live.md); paths in it are relative to its folder.

    Returns
    -------
    ScanMachine

    Raises
    ------
    InputError
        If the file cannot be used, naming line and key.
    """
    top, top_level = read_machine(path)
    if top_level["lattice"] is None:
        raise top.error("no lattice", 'lattice = "FILE"', "lattice")
    lattice = read_lattice(Path(path).parent / top_level.pop("lattice"))
    if not top.table.get("magnet"):
        raise top.error("no magnet to scan", "tables [[magnet]]", "magnet")
    scanned = tuple(_read_magnet(section, lattice) for section in top.sections("magnet"))
    knobs = tuple(map(_read_magnet, top.sections("knob"))) if "knob" in top.table else ()
    magnets = scanned + knobs
    for unique in ({m.name for m in magnets}, {m.set.rpartition("://")[2] for m in magnets}):
        if len(unique) < len(magnets):
            found = "a magnet or the variable that sets it twice"
            raise top.error(found, "one [[magnet]] or [[knob]] for each", "magnet")
    scan_section = top.section("scan")
    plan = scan_section.values(SCAN_KEYS)
    first = _settings_within(scan_section, "first", plan.pop("first"), magnets[0].span)
    plan["points"] = plan["points"] or (MAX_TUNING_ROWS if knobs else MAX_POINTS)
    screen, guard = _read_screen(top.section("screen"), lattice), _read_guard(top.section("beam"))
    lattice = part_of(lattice, screen=screen.name)
    at = [e["name"] for e in lattice.elements].index(screen.name)
    upstream = {name for e in lattice.elements[:at] for name in (e["name"], e.get("supply"))}
    for magnet, section in zip(scanned, top.sections("magnet"), strict=True):
        if magnet.name not in upstream:
            found = f"{magnet.name} behind the screen {screen.name}"
            raise section.error(found, "a magnet that the beam passes before it", "name")
    for name in (screen.name, *(m.name for m in magnets)):
        if not name.isprintable():
            raise top.error(f"the name {name!r}", "one of letters that can be shown")
    name, own = top_level.pop("name"), (magnets, screen, guard)
    tuned = tuple(knob.name for knob in knobs)
    return ScanMachine(
        name, str(path), top.sha256, lattice, *own, first=first, knobs=tuned, **plan, **top_level
    )


def read_machine(path: str | PathLike[str]) -> tuple[Section, dict[str, Any]]:
    """Read a machine file and its top-level keys; the default name is that of the file."""
    top = read_toml(path, "a machine", FORMAT)
    values = top.values(TOP_KEYS)
    return top, values | {"name": plain(values["name"] or Path(path).stem)}


def unit_of(word: str) -> str | None:
    """Unit of settings that a word means; None if it is not one.

    Examples
    --------
    >>> unit_of("T/m"), unit_of("Amps"), unit_of("furlong")
    ('T_per_m', 'A', None)
    """
    return SETTING_UNITS.get(word.strip().lower())


def _read_magnet(section: Section, lattice: LatticeFile | None = None) -> Magnet:
    """Read a magnet of the lattice; without a lattice, a knob, which may have any unit."""
    magnet = section.read(Magnet)
    unit = unit_of(magnet.unit)
    if lattice is not None and magnet.name not in lattice.calibrations:
        expected = nearest(magnet.name, list(lattice.calibrations)) + f", of {lattice.path}"
        raise section.error(f"no magnet '{magnet.name}'", expected, "name")
    if lattice is not None and unit != (lattice_unit := lattice.calibrations[magnet.name]):
        raise section.error(f"unit '{magnet.unit}'", f"{lattice_unit}, as in the lattice", "unit")
    _check_movable(section, magnet)
    degauss = _settings_within(section, "degauss", magnet.degauss, (magnet.low, magnet.high))
    return replace(magnet, unit=unit or magnet.unit, degauss=degauss)


def _check_movable(section: Section, magnet: Magnet) -> None:
    """Check limits, tolerance and approach of a magnet or knob."""
    if not (is_number(magnet.low) and is_number(magnet.high) and magnet.low < magnet.high):
        found = f"limits {magnet.low:g} to {magnet.high:g}"
        raise section.error(found, "low below high, both numbers", "low")
    if not magnet.tolerance < 0.1 * (magnet.high - magnet.low):
        expected = "less than a tenth of the range; is it in the unit of the settings?"
        raise section.error(f"tolerance {magnet.tolerance:g}", expected, "tolerance")
    if magnet.approach != "either" and not magnet.approach_by > 0:
        expected = "how far beyond a setting to go first, in the unit of the settings"
        raise section.error(f"approach from {magnet.approach}", expected, "approach_by")
    if not magnet.span[1] - magnet.span[0] > 10 * magnet.tolerance:
        found = f"approach by {magnet.approach_by:g} within {magnet.low:g} to {magnet.high:g}"
        raise section.error(found, "room to scan besides", "approach_by")


def _settings_within(
    section: Section, key: str, values: Any, span: tuple[float, float]
) -> tuple[float, ...]:
    """Check that settings are numbers within a range."""
    for value in values:
        if not is_number(value) or not span[0] <= value <= span[1]:
            expected = f"numbers within {span[0]:g} and {span[1]:g}"
            raise section.error(f"{value!r}"[:80], expected, key)
    return tuple(map(float, values))


def _read_screen(section: Section, lattice: LatticeFile) -> Profiler:
    """Read and check [screen]."""
    screen = section.read(Profiler)
    if bool(screen.sizes) == bool(screen.profiles):
        found = "sizes and projections" if screen.sizes else "no sizes"
        raise section.error(found, "x and y, or profile_x and profile_y", "x")
    if screen.profiles and screen.pixel is None:
        raise section.error("projections without a scale", "pixel_um = ...", "pixel_um")
    screen = replace(screen, name=screen.name or lattice.default_screen)
    if screen.name not in lattice.places:
        expected = nearest(str(screen.name), lattice.places) + f", of {lattice.path}"
        raise section.error(f"no screen '{screen.name}'", expected, "name")
    return screen


def _read_guard(section: Section) -> Guard:
    """Read and check [beam]: each variable needs its limit."""
    guard = section.read(Guard)
    for variable, limit in (("present", "present_above"), ("loss", "loss_below")):
        name, value = getattr(guard, variable), getattr(guard, limit)
        if (name is None) != (value is None) or (value is not None and math.isnan(value)):
            key = limit if value is None else variable
            raise section.error(f"{variable} and no {key}", f"both {variable} and {limit}", key)
    return guard


def check_setting(magnet: Magnet, value: float) -> float:
    """Check a setting before it is written to a magnet.

    Raises
    ------
    InputError
        If it is not a number within the limits: such a value is never written.

    Examples
    --------
    >>> check_setting(Magnet("Q", "Q:SET", "Q:READ", "A", -1.0, 1.0, 0.01, 0.1), 1.5)
    Traceback (most recent call last):
        ...
    beamfit.errors.InputError: a setting of 1.5 for Q; expected within its limits, -1 to 1
    """
    if not magnet.low <= value <= magnet.high:
        expected = f"within its limits, {magnet.low:g} to {magnet.high:g}"
        raise InputError(f"a setting of {value:g} for {magnet.name}", expected)
    return float(value)


# Quantities of a watch, their units, and the keys of [ring]: named as columns of a decay record.
WATCHED_QUANTITIES = ("beam_current", *Conditions._fields)
QUANTITY_UNITS = {name: UNITS.get(QUANTITIES[name], {"": 1.0}) for name in WATCHED_QUANTITIES}
RING_VARIABLES = {
    f"{name}_{unit}".rstrip("_"): (name, unit, factor)
    for name, units in QUANTITY_UNITS.items()
    for unit, factor in units.items()
}
RING_KEYS = {"file": Key("file", kind=TEXT, default=None)} | {
    key: Key(key, kind=TEXT, default=None) for key in RING_VARIABLES
}
WINDOW_RANGE = "a time of 60 s to a week"
WATCH_KEYS = {
    "window_s": Key("window", default=7200.0, low=59.9, high=604801.0, expected=WINDOW_RANGE),
    "interval_s": Key("interval", default=10.0, low=0.99, high=3601.0, expected="1 s to an hour"),
    "reference_current_mA": Key("current", default=None, **POSITIVE),
    "prefix": Key("prefix", kind=TEXT, default=None),
}


class Watched(NamedTuple):
    """Watched quantity: its variable in the control system, unit, and factor to SI."""

    quantity: str
    variable: str
    unit: str
    factor: float

    def check(self, given: str) -> str | None:
        """Compare the unit with that of the control system; return a note if that is unknown.

        Raises
        ------
        InputError
            If the units differ.

        Examples
        --------
        >>> Watched("beam_current", "SR:I", "mA", 1.0).check("A")
        Traceback (most recent call last):
            ...
        beamfit.errors.InputError: unit 'A' of 'SR:I'; expected mA, as in the machine file
        """
        return check_unit(given, self.variable, self.unit, QUANTITY_UNITS[self.quantity])


def check_unit(given: str, variable: str, unit: str, factors: Mapping[str, float]) -> str | None:
    """Compare the unit of a variable in the control system with that of the machine file.

    Parameters
    ----------
    given, variable, unit : str
        Unit in the control system, name of the variable, and unit in the file.
    factors : mapping of str to float
        Factor of each possible unit.

    Returns
    -------
    str or None
        A note if the unit in the control system is unknown.

    Raises
    ------
    InputError
        If the units differ.

    Examples
    --------
    >>> check_unit("lp", "SCREEN:X", "um", {"um": 1e-6, "mm": 1e-3})
    "unit 'lp' of 'SCREEN:X' is not understood: taken as um"
    """
    if not given or not unit or (given_unit := known_unit(given)) == unit:
        return None
    if factors.get(given_unit or "") == factors[unit]:
        return None
    found = f"unit '{plain(given)}' of '{plain(variable)}'"
    if given_unit in factors:
        raise InputError(found, f"{unit}, as in the machine file")
    return f"{found} is not understood: taken as {unit}"


@dataclass(frozen=True)
class WatchMachine:
    """Machine for `beamfit watch`.

    Attributes
    ----------
    name, path, sha256 : str
        Name of the machine, its file, and the digest of the file.
    variables : tuple of Watched
        Watched variables, the beam current first.
    ring : Path or None
        Ring file.
    window, interval : float
        Length of the sliding window, and time between fits, s.
    current : float or None
        Reference current, mA; never None with a ring.
    prefix : str or None
        Prefix of the served variables; None serves none.
    timeout : float
        Time within which a variable must answer, s.
    """

    name: str
    path: str
    sha256: str
    variables: tuple[Watched, ...]
    ring: Path | None
    window: float
    interval: float
    current: float | None
    prefix: str | None
    timeout: float


def read_watch_machine(path: str | PathLike[str]) -> WatchMachine:
    """Read a machine file for a watch (docs/watch.md).

    Parameters
    ----------
    path : str or path
        TOML, as for `read_scan_machine`.

    Returns
    -------
    WatchMachine

    Raises
    ------
    InputError
        As `read_scan_machine`.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "ring.toml"
    >>> text = 'format = "beamfit-machine-1"\\n[ring]\\nbeam_current_mA = "pva://SR:CURRENT"\\n'
    >>> _ = file.write_text(text)
    >>> read_watch_machine(file).variables[0].variable
    'pva://SR:CURRENT'
    """
    top, top_values = read_machine(path)
    ring = top.section("ring")
    file = ring.values(RING_KEYS)["file"]
    variables = _watched_variables(ring)
    section = top.section("watch")
    watch = section.values(WATCH_KEYS)
    if file is not None and watch["current"] is None:
        expected = "reference_current_mA = ..., to which the ring scales lifetimes"
        raise section.error("a ring file without it", expected, "reference_current_mA")
    if watch["interval"] > watch["window"] / 3:
        found = f"interval {watch['interval']:g} s in a window of {watch['window']:g} s"
        raise section.error(found, "a third of the window, or less", "interval_s")
    ring_path = None if file is None else Path(path).parent / file
    name, timeout = top_values["name"], top_values["timeout"]
    return WatchMachine(name, str(path), top.sha256, variables, ring_path, timeout=timeout, **watch)


def _watched_variables(ring: Section) -> tuple[Watched, ...]:
    """Variables of [ring], the beam current first."""
    variables = {key: name for key, name in ring.table.items() if key in RING_VARIABLES}
    watched = []
    for key, text in variables.items():
        quantity, unit, factor = RING_VARIABLES[key]
        watched.append(Watched(quantity, text, unit, factor))
    for v in watched:
        keys = [key for key in variables if RING_VARIABLES[key][0] == v.quantity]
        if len(keys) > 1:
            raise ring.error(f"{' and '.join(keys)}", f"one {v.quantity}", keys[1])
    if not any(v.quantity == WATCHED_QUANTITIES[0] for v in watched):
        expected = 'beam_current_mA = "VARIABLE", or _A or _uA, in [ring]'
        raise ring.error("no beam current", expected, "beam_current_mA")
    return tuple(sorted(watched, key=lambda v: WATCHED_QUANTITIES.index(v.quantity)))
