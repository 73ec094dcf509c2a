"""Paths in calls: public functions take a file where they take what is read from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from os import PathLike
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def is_path(value: object) -> bool:
    """Tell a path from what is read from it."""
    return isinstance(value, str | PathLike)


def opening(function: F, name: str) -> F:
    """Have a function take paths in the place of a scan, a line, a record, runs or a ring.

    Parameters
    ----------
    function : callable
        With arguments ``scan``, ``line``, ``record``, ``records``, ``runs``, ``held``, ``table``,
        ``ring``, ``operation`` or ``machine``.
    name : str
        Its public name in `beamfit`.

    Returns
    -------
    callable
        The same function; what is no path it takes as before.

    Examples
    --------
    >>> def rows(record): return len(record.time)
    >>> opening(rows, "rows")("measurements/aps_1999_decay.csv")
    27
    """
    given = signature(function)

    @wraps(function)
    def opened(*args: Any, **named: Any) -> Any:
        bound = given.bind(*args, **named)
        bound.arguments |= _read(bound.arguments)
        return function(*bound.args, **bound.kwargs)

    opened.__module__, opened.__name__, opened.__qualname__ = "beamfit", name, name
    return opened


def machine_of(path: str | PathLike[str]) -> Any:
    """Read a ring and its usual operation from one file."""
    from beamfit.io.ring import read_operation, read_ring

    ring, operation = read_ring(path), read_operation(path)

    from beamfit.lifetime.study import Machine  # JAX from here on

    return Machine(ring, operation)


def _record(path: Any) -> Any:
    from beamfit.io.decay_record import read_decay_record

    return read_decay_record(path)


def _run(path: Any) -> Any:
    from beamfit.io.run import read_run

    return read_run(path)


def _ring(path: Any) -> Any:
    from beamfit.io.ring import read_ring

    return read_ring(path)


def _operation(path: Any) -> Any:
    from beamfit.io.ring import read_operation

    return read_operation(path)


def _table(path: Any) -> Any:
    from beamfit.io.decay_record import read_lifetime_input

    return read_lifetime_input(path)


_READERS: dict[str, Callable[[Any], Any]] = {
    "record": _record,
    "records": _record,
    "runs": _run,
    "held": _run,
    "table": _table,
    "ring": _ring,
    "operation": _operation,
    "machine": machine_of,
}


def _read(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Read the arguments that are paths."""
    given = arguments.get("scan"), arguments.get("line")
    found = _tuning(*given, arguments["knobs"]) if "knobs" in arguments else _scan_and_line(*given)
    for name in arguments.keys() & _READERS.keys():
        value, read = arguments[name], _READERS[name]
        if is_path(value):
            found[name] = read(value)
        elif isinstance(value, list | tuple) and any(map(is_path, value)):
            found[name] = [read(one) if is_path(one) else one for one in value]
    return found


def _scan_and_line(scan: Any, line: Any) -> dict[str, Any]:
    """A scan and its line, read together where both are files: each is checked against the other.

    A file of emittance_gui, or rows with matrices of their own, need no lattice beside them.
    """
    if not (is_path(scan) or is_path(line)):
        return {}
    from beamfit.io.line import build_line, lattice_of, load_lattice, read_inputs
    from beamfit.io.scan import read_quad_scan

    if is_path(scan) and (line is None or is_path(line)):
        read = read_inputs(str(scan), line)
        return {"scan": read.scan, "line": build_line(read.lattice)}
    if is_path(scan):
        return {"scan": read_quad_scan(scan)}
    return {"line": load_lattice(line) if scan is None else build_line(lattice_of(scan, line))}


def _tuning(scan: Any, line: Any, knobs: Mapping[str, Any]) -> dict[str, Any]:
    """A table of knobs, and the line that it is checked against without them."""
    found = {}
    if is_path(scan):
        from beamfit.io.tuning import read_tuning_scan

        found["scan"] = scan = read_tuning_scan(scan, knobs)
    if is_path(line):
        from beamfit.emittance.scan import QuadScan
        from beamfit.io.line import build_line, lattice_of, load_lattice

        is_scan = isinstance(scan, QuadScan)
        own = is_scan and build_line(lattice_of(scan.without_settings(knobs), line))
        found["line"] = own or load_lattice(line)
    return found
