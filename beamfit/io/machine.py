"""Machine files: the variables of a control system for a scan or a watch, checked TOML."""

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
from beamfit.io.toml import LIST, TABLE, TEXT, WHOLE, Key, Section, is_number, keyed, read_toml
from beamfit.lifetime.record import Conditions

FORMAT = "beamfit-machine-1"
# Most settings of a scan, and rows of a tuning.
POINTS, ROWS = 15, 60
APPROACHES = ("either", "below", "above")
# Units of settings as control systems write them, in capitals or small letters.
SPELLINGS = {u.lower(): u for u in SETTINGS}
SPELLINGS |= {word.lower(): unit for word, unit in UNIT_SPELLINGS.items() if unit in SETTINGS}
LENGTHS = {"um": 1e-6, "mm": 1e-3, "m": 1.0}
# Bounds that several keys share.
WAIT = {"low": 0.0, "said": "a time above zero"}
POSITIVE = {"low": 0.0, "said": "a positive number"}
SCAN = {
    "goal_percent": Key("goal", 1e-2, default=0.03, low=0.0, high=100.0, said="0 to 100 %"),
    "points": Key("points", kind=WHOLE, default=None, low=3, high=201, said="4 to 200 points"),
    "first": Key("first", kind=LIST, default=()),
    "restore_s": Key("restore", default=60.0, **WAIT),
}
TOP = {
    "name": Key("name", kind=TEXT, default=""),
    "lattice": Key("lattice", kind=TEXT, default=None),
    "timeout_s": Key("timeout", default=5.0, **WAIT),
    **{name: Key(kind=LIST, default=()) for name in ("magnet", "knob")},
    **{name: Key(kind=TABLE, default=None) for name in ("screen", "beam", "scan", "ring", "watch")},
}


@dataclass(frozen=True)
class Magnet:
    """A magnet of a machine file, in the unit of the lattice's settings.

    Attributes
    ----------
    name, set, read, unit : str
        Its name in the lattice, its variables, and the unit of both.
    low, high, tolerance : float
        Limits of what may be written, and how far the read-back may be off, either way.
    settle, timeout : float
        How long the read-back has to stay there, and after how long it is given up, s.
    approach : {"either", "below", "above"}
        From which side a setting is reached, by passing it by ``approach_by``, which is within
        the limits too.
    degauss : tuple of float
        Settings gone through before a scan.
    """

    name: str = keyed("name", kind=TEXT)
    set: str = keyed("set", kind=TEXT)
    read: str = keyed("read", kind=TEXT)
    unit: str = keyed("unit", kind=TEXT)
    low: float = keyed("low")
    high: float = keyed("high")
    tolerance: float = keyed("tolerance", **POSITIVE)
    settle: float = keyed("settle_s", low=-1e-9, high=3600.0, said="a time of zero or more")
    timeout: float = keyed("timeout_s", 60.0, **WAIT)
    approach: str = keyed("approach", "either", kind=TEXT, among=APPROACHES)
    approach_by: float = keyed("approach_by", 0.0, low=-1e-12, said="zero or more")
    degauss: tuple[float, ...] = keyed("degauss", (), kind=LIST)

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest setting that can be reached from the side that is asked for.

        Examples
        --------
        >>> Magnet("Q", "SET", "READ", "A", -1.0, 1.0, 0.01, 0.1, 60.0, "below", 0.5).span
        (-0.5, 1.0)
        """
        below, above = self.approach == "below", self.approach == "above"
        return self.low + below * self.approach_by, self.high - above * self.approach_by


@dataclass(frozen=True)
class Profiler:
    """The screen of a machine file: variables of rms sizes, or of projections, by plane.

    Attributes
    ----------
    name : str
        Its name in the lattice.
    x, y, profile_x, profile_y : str or None
        The variables; `sizes` and `profiles` have them by plane, one of the two is empty.
    unit : str
        Of the sizes.
    pixel : float or None
        Of the projections, m.
    shots : int
        Of each setting.
    timeout : float
        How long a new time stamp is waited for, s.
    """

    name: str | None = keyed("name", None, kind=TEXT)
    x: str | None = keyed("x", None, kind=TEXT)
    y: str | None = keyed("y", None, kind=TEXT)
    profile_x: str | None = keyed("profile_x", None, kind=TEXT)
    profile_y: str | None = keyed("profile_y", None, kind=TEXT)
    unit: str = keyed("unit", "um", kind=TEXT, among=tuple(LENGTHS))
    pixel: float | None = keyed("pixel_um", None, factor=1e-6, **POSITIVE)
    shots: int = keyed("shots", 5, kind=WHOLE, low=1, high=1001, said="2 to 1000 shots")
    timeout: float = keyed("timeout_s", 10.0, **WAIT)

    @property
    def sizes(self) -> dict[str, str]:
        """Plane to the variable of its rms size."""
        return {p: v for p, v in zip("xy", (self.x, self.y), strict=True) if v}

    @property
    def profiles(self) -> dict[str, str]:
        """Plane to the variable of its projection."""
        return {p: v for p, v in zip("xy", (self.profile_x, self.profile_y), strict=True) if v}


@dataclass(frozen=True)
class Guard:
    """Conditions of a shot that counts: beam above, loss below. Limits are None without one."""

    present: str | None = keyed("present", None, kind=TEXT)
    present_above: float | None = keyed("present_above", None)
    loss: str | None = keyed("loss", None, kind=TEXT)
    loss_below: float | None = keyed("loss_below", None)
    wait: float = keyed("wait_s", 60.0, **WAIT)


@dataclass(frozen=True)
class ScanMachine:
    """Machine as `beamfit scan` needs it.

    Attributes
    ----------
    name, path, sha256 : str
        Of the machine and its file.
    lattice : LatticeFile
        The line.
    magnets : tuple of Magnet
        Those to be scanned, and behind them the knobs.
    screen : Profiler
    guard : Guard
    goal : float
        Relative error of the emittances at which to stop.
    points : int
        Most settings.
    first : tuple of float
        Settings of the first magnet to begin with; chosen over its limits if empty.
    restore, timeout : float
        For how long an IOC that does not answer is asked again to restore, and within which a
        variable has to answer, s.
    knobs : tuple of str
        Names of the knobs to be tuned; a scan for the emittance has none.
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
    """Read what a scan needs of a machine file, and its lattice.

    Parameters
    ----------
    path : str or path
        TOML, format "beamfit-machine-1" (docs/live.md); paths in it are beside it.

    Returns
    -------
    ScanMachine

    Raises
    ------
    InputError
        If it cannot be used, naming line and key.
    """
    top, said = read_machine(path)
    if said["lattice"] is None:
        raise top.error("no lattice", 'lattice = "FILE"', "lattice")
    lattice = read_lattice(Path(path).parent / said.pop("lattice"))
    if not top.table.get("magnet"):
        raise top.error("no magnet to scan", "tables [[magnet]]", "magnet")
    scanned = tuple(_magnet(section, lattice) for section in top.sections("magnet"))
    knobs = tuple(map(_magnet, top.sections("knob"))) if "knob" in top.table else ()
    magnets = scanned + knobs
    for said_once in ({m.name for m in magnets}, {m.set.rpartition("://")[2] for m in magnets}):
        if len(said_once) < len(magnets):
            found = "a magnet or the variable that sets it twice"
            raise top.error(found, "one [[magnet]] or [[knob]] for each", "magnet")
    wanted = top.section("scan")
    plan = wanted.values(SCAN)
    first = _numbers(wanted, "first", plan.pop("first"), magnets[0].span)
    plan["points"] = plan["points"] or (ROWS if knobs else POINTS)
    screen, guard = _screen(top.section("screen"), lattice), _guard(top.section("beam"))
    lattice = part_of(lattice, screen=screen.name)
    at = [e["name"] for e in lattice.elements].index(screen.name)
    before = {name for e in lattice.elements[:at] for name in (e["name"], e.get("supply"))}
    for magnet, section in zip(scanned, top.sections("magnet"), strict=True):
        if magnet.name not in before:
            found = f"{magnet.name} behind the screen {screen.name}"
            raise section.error(found, "a magnet that the beam passes before it", "name")
    for name in (screen.name, *(m.name for m in magnets)):
        if not name.isprintable():
            raise top.error(f"the name {name!r}", "one of letters that can be shown")
    name, own = said.pop("name"), (magnets, screen, guard)
    tuned = tuple(knob.name for knob in knobs)
    return ScanMachine(
        name, str(path), top.sha256, lattice, *own, first=first, knobs=tuned, **plan, **said
    )


def read_machine(path: str | PathLike[str]) -> tuple[Section, dict[str, Any]]:
    """A machine file, and what stands at its top; a name is that of the file unless it is given."""
    top = read_toml(path, "a machine", FORMAT)
    said = top.values(TOP)
    return top, said | {"name": plain(said["name"] or Path(path).stem)}


def unit_of(word: str) -> str | None:
    """The unit of settings that a word means, None if it means none.

    Examples
    --------
    >>> unit_of("T/m"), unit_of("Amps"), unit_of("furlong")
    ('T_per_m', 'A', None)
    """
    return SPELLINGS.get(word.strip().lower())


def _magnet(section: Section, lattice: LatticeFile | None = None) -> Magnet:
    """A magnet of the lattice; or without one a knob of the machine, in whatever unit it has."""
    magnet = section.read(Magnet)
    unit = unit_of(magnet.unit)
    if lattice is not None and magnet.name not in lattice.calibrations:
        expected = nearest(magnet.name, list(lattice.calibrations)) + f", of {lattice.path}"
        raise section.error(f"no magnet '{magnet.name}'", expected, "name")
    if lattice is not None and unit != (wanted := lattice.calibrations[magnet.name]):
        raise section.error(f"unit '{magnet.unit}'", f"{wanted}, as in the lattice", "unit")
    _check_movable(section, magnet)
    degauss = _numbers(section, "degauss", magnet.degauss, (magnet.low, magnet.high))
    return replace(magnet, unit=unit or magnet.unit, degauss=degauss)


def _check_movable(section: Section, magnet: Magnet) -> None:
    """Check that the limits leave room to move a magnet or a knob."""
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


def _numbers(
    section: Section, key: str, values: Any, span: tuple[float, float]
) -> tuple[float, ...]:
    """Settings that a magnet can have."""
    for value in values:
        if not is_number(value) or not span[0] <= value <= span[1]:
            expected = f"numbers within {span[0]:g} and {span[1]:g}"
            raise section.error(f"{value!r}"[:80], expected, key)
    return tuple(map(float, values))


def _screen(section: Section, lattice: LatticeFile) -> Profiler:
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


def _guard(section: Section) -> Guard:
    guard = section.read(Guard)
    for variable, limit in (("present", "present_above"), ("loss", "loss_below")):
        name, value = getattr(guard, variable), getattr(guard, limit)
        if (name is None) != (value is None) or (value is not None and math.isnan(value)):
            key = limit if value is None else variable
            raise section.error(f"{variable} and no {key}", f"both {variable} and {limit}", key)
    return guard


def moved(magnet: Magnet, value: float) -> float:
    """A setting that may be written to a magnet, or none.

    Raises
    ------
    InputError
        If it is no number or lies outside the limits: nothing is ever written there.

    Examples
    --------
    >>> moved(Magnet("Q", "Q:SET", "Q:READ", "A", -1.0, 1.0, 0.01, 0.1), 1.5)
    Traceback (most recent call last):
        ...
    beamfit.errors.InputError: a setting of 1.5 for Q; expected within its limits, -1 to 1
    """
    if not magnet.low <= value <= magnet.high:
        expected = f"within its limits, {magnet.low:g} to {magnet.high:g}"
        raise InputError(f"a setting of {value:g} for {magnet.name}", expected)
    return float(value)


# Keys are named as the columns of a decay record are.
NAMES = ("beam_current", *Conditions._fields)
UNITS_OF = {name: UNITS.get(QUANTITIES[name], {"": 1.0}) for name in NAMES}
KEYS = {
    f"{name}_{unit}".rstrip("_"): (name, unit, factor)
    for name, units in UNITS_OF.items()
    for unit, factor in units.items()
}
RING = {"file": Key("file", kind=TEXT, default=None)} | {
    key: Key(key, kind=TEXT, default=None) for key in KEYS
}
LONG = "a time of 60 s to a week"
WATCH = {
    "window_s": Key("window", default=7200.0, low=59.9, high=604801.0, said=LONG),
    "interval_s": Key("interval", default=10.0, low=0.99, high=3601.0, said="1 s to an hour"),
    "reference_current_mA": Key("current", default=None, **POSITIVE),
    "prefix": Key("prefix", kind=TEXT, default=None),
}


class Watched(NamedTuple):
    """A variable that is watched: what it is, its name in the control system, its unit to SI."""

    quantity: str
    variable: str
    unit: str
    factor: float

    def check(self, given: str) -> str | None:
        """Compare with the unit that the control system gives; a note if nobody knows that one.

        Raises
        ------
        InputError
            If it is another one.

        Examples
        --------
        >>> Watched("beam_current", "SR:I", "mA", 1.0).check("A")
        Traceback (most recent call last):
            ...
        beamfit.errors.InputError: unit 'A' of 'SR:I'; expected mA, as in the machine file
        """
        return check_unit(given, self.variable, self.unit, UNITS_OF[self.quantity])


def check_unit(given: str, variable: str, unit: str, known: Mapping[str, float]) -> str | None:
    """Compare the unit that the control system gives with that of the machine file.

    Parameters
    ----------
    given, variable, unit : str
        Unit that the control system gives to a variable, its name, and the unit of the file.
    known : mapping of str to float
        Factors of all units that there are.

    Returns
    -------
    str or None
        A note if nobody knows the unit that is given.

    Raises
    ------
    InputError
        If it is another one.

    Examples
    --------
    >>> check_unit("lp", "SCREEN:X", "um", {"um": 1e-6, "mm": 1e-3})
    "unit 'lp' of 'SCREEN:X' is not understood: taken as um"
    """
    if not given or not unit or (found := known_unit(given)) == unit:
        return None
    if known.get(found or "") == known[unit]:
        return None
    said = f"unit '{plain(given)}' of '{plain(variable)}'"
    if found in known:
        raise InputError(said, f"{unit}, as in the machine file")
    return f"{said} is not understood: taken as {unit}"


@dataclass(frozen=True)
class WatchMachine:
    """Machine as `beamfit watch` needs it.

    Attributes
    ----------
    name, path, sha256 : str
        Of the machine and its file.
    variables : tuple of Watched
        The current first.
    ring : Path or None
        The ring's own file.
    window, interval : float
        Of the sliding window, and from fit to fit, s.
    current : float or None
        Reference current, mA; never None with a ring.
    prefix : str or None
        Of the variables that are served; None serves none.
    timeout : float
        Within which a variable has to answer, s.
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
    """Read what a watch needs of a machine file (docs/watch.md).

    Parameters
    ----------
    path : str or path
        Of TOML as `read_scan_machine` takes it.

    Returns
    -------
    WatchMachine

    Raises
    ------
    InputError
        As by `read_scan_machine`.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "ring.toml"
    >>> text = 'format = "beamfit-machine-1"\\n[ring]\\nbeam_current_mA = "pva://SR:CURRENT"\\n'
    >>> _ = file.write_text(text)
    >>> read_watch_machine(file).variables[0].variable
    'pva://SR:CURRENT'
    """
    top, said = read_machine(path)
    ring = top.section("ring")
    file = ring.values(RING)["file"]
    variables = _variables(ring)
    section = top.section("watch")
    watch = section.values(WATCH)
    if file is not None and watch["current"] is None:
        expected = "reference_current_mA = ..., to which the ring scales lifetimes"
        raise section.error("a ring file without it", expected, "reference_current_mA")
    if watch["interval"] > watch["window"] / 3:
        found = f"interval {watch['interval']:g} s in a window of {watch['window']:g} s"
        raise section.error(found, "a third of the window, or less", "interval_s")
    beside = None if file is None else Path(path).parent / file
    name, timeout = said["name"], said["timeout"]
    return WatchMachine(name, str(path), top.sha256, variables, beside, timeout=timeout, **watch)


def _variables(ring: Section) -> tuple[Watched, ...]:
    """The current, and the others by what they are."""
    given = {key: name for key, name in ring.table.items() if key in KEYS}
    found = [Watched(KEYS[key][0], text, *KEYS[key][1:]) for key, text in given.items()]
    for one in found:
        twice = [key for key in given if KEYS[key][0] == one.quantity]
        if len(twice) > 1:
            raise ring.error(f"{' and '.join(twice)}", f"one {one.quantity}", twice[1])
    if not any(one.quantity == NAMES[0] for one in found):
        expected = 'beam_current_mA = "VARIABLE", or _A or _uA, in [ring]'
        raise ring.error("no beam current", expected, "beam_current_mA")
    return tuple(sorted(found, key=lambda one: NAMES.index(one.quantity)))
