"""What `beamfit watch` needs of a machine file: a ring's variables, and how to watch them."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from beamfit.errors import InputError, plain
from beamfit.io.headers import known_unit
from beamfit.io.machine import POSITIVE, read_machine
from beamfit.io.record_columns import QUANTITIES
from beamfit.io.sheet import UNITS
from beamfit.io.toml import TEXT, Key, Section
from beamfit.studies.decay.record import Conditions

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
        known = UNITS_OF[self.quantity]
        if not given or not self.unit or (found := known_unit(given)) == self.unit:
            return None
        if found in known and known[found] == self.factor:
            return None
        said = f"unit '{plain(given)}' of '{plain(self.variable)}'"
        if found in known:
            raise InputError(said, f"{self.unit}, as in the machine file")
        return f"{said} is not understood: taken as {self.unit}"


@dataclass(frozen=True)
class WatchMachine:
    """What `beamfit watch` needs to know of a machine.

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
    """Read what a watch needs of a machine file.

    Parameters
    ----------
    path : str or path
        TOML, format "beamfit-machine-1" (docs/live.md); paths in it are beside it.

    Returns
    -------
    WatchMachine

    Raises
    ------
    InputError
        If it cannot be used, naming line and key.

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
    name = said["name"] or Path(path).stem
    beside = None if file is None else Path(path).parent / file
    return WatchMachine(
        name, str(path), top.sha256, variables, beside, timeout=said["timeout"], **watch
    )


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
