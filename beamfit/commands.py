"""Public functions of commands with several steps, and the reading of paths in calls."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from inspect import signature
from os import PathLike
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, TypeVar

from beamfit.compile_cache import usual_arithmetic
from beamfit.errors import InputError, nearest

if TYPE_CHECKING:
    import numpy as np

    from beamfit.dynamics.control import Loop
    from beamfit.dynamics.fedbatch import FedBatchFit
    from beamfit.dynamics.fit import ResponseFit
    from beamfit.dynamics.record import Run
    from beamfit.dynamics.state_fit import StatesFit
    from beamfit.io.machine import ScanMachine, WatchMachine
    from beamfit.language.compiled import Computed
    from beamfit.language.document import Document
    from beamfit.language.solution import ProblemSolution
    from beamfit.lifetime.watch import Plan
    from beamfit.live.scan import Outcome, ScanProgress
    from beamfit.live.watch import WatchView

F = TypeVar("F", bound=Callable[..., Any])
Limits = Mapping[str, tuple[float, float]]
Steps = Sequence[tuple[str, float, float]]
# Models of all outputs together; the other models have one output each.
STATES, FED_BATCH = "state-space", "fed-batch"
# Arguments that may be paths, and the functions that read them.
READERS = {
    "record": "beamfit.io.decay_record:read_decay_record",
    "records": "beamfit.io.decay_record:read_decay_record",
    "runs": "beamfit.io.run:read_run",
    "held": "beamfit.io.run:read_run",
    "table": "beamfit.io.decay_record:read_lifetime_input",
    "ring": "beamfit.io.ring:read_ring",
    "operation": "beamfit.io.ring:read_operation",
    "machine": "beamfit.commands:machine_of",
}


def is_path(value: object) -> bool:
    """Return True for a path, False for an object that was already read."""
    return isinstance(value, str | PathLike)


def with_paths(function: F, name: str) -> F:
    """Make a function accept paths in place of a scan, a line, a record, runs or a ring, and
    compute with `usual_arithmetic`.

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
        The same function, which reads arguments that are paths.

    Examples
    --------
    >>> def rows(record): return len(record.time)
    >>> with_paths(rows, "rows")("measurements/aps_1999_decay.csv")
    27
    """
    given = signature(function)

    @wraps(function)
    def opened(*args: Any, **named: Any) -> Any:
        bound = given.bind(*args, **named)
        bound.arguments |= _read_paths(bound.arguments)
        with usual_arithmetic():
            return function(*bound.args, **bound.kwargs)

    opened.__module__, opened.__name__, opened.__qualname__ = "beamfit", name, name
    return opened


def machine_of(path: str | PathLike[str]) -> Any:
    """Read a ring and its operating point from one file."""
    from beamfit.io.ring import read_operation, read_ring

    ring, operation = read_ring(path), read_operation(path)

    from beamfit.lifetime.study import Machine  # JAX from here on

    return Machine(ring, operation)


def _read_paths(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Read the arguments that are paths."""
    scan, line = arguments.get("scan"), arguments.get("line")
    if "knobs" in arguments:
        found = _knobs_and_line(scan, line, arguments["knobs"])
    else:
        found = _scan_and_line(scan, line)
    for name in arguments.keys() & READERS.keys():
        value, read = arguments[name], resolve_name(READERS[name])
        if is_path(value):
            found[name] = read(value)
        elif isinstance(value, list | tuple) and any(map(is_path, value)):
            found[name] = [read(one) if is_path(one) else one for one in value]
    return found


def _scan_and_line(scan: Any, line: Any) -> dict[str, Any]:
    """Read a scan and its line; if both are files, each is checked against the other.

    A file of emittance_gui, or rows with their own matrices, need no lattice.
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


def _knobs_and_line(scan: Any, line: Any, knobs: Mapping[str, Any]) -> dict[str, Any]:
    """Read a table of knobs and its line, and check the other settings against the line."""
    found = {}
    if is_path(scan):
        from beamfit.io.scan import read_tuning_scan

        found["scan"] = scan = read_tuning_scan(scan, knobs)
    if is_path(line):
        from beamfit.emittance.scan import QuadScan
        from beamfit.io.line import build_line, lattice_of, load_lattice

        is_scan = isinstance(scan, QuadScan)
        own = is_scan and build_line(lattice_of(scan.without_settings(knobs), line))
        found["line"] = own or load_lattice(line)
    return found


def identify(
    runs: Run | Sequence[Run],
    model: str = "first-order",
    map: str = "constant",
    *,
    order: int | None = None,
    delay: float | None = None,
    offset: bool = True,
    hidden: int = 5,
    seed: int = 1,
    held: Sequence[Run] = (),
) -> tuple[ResponseFit | StatesFit | FedBatchFit, ...]:
    """Identify how the outputs of a process respond to its inputs.

    Parameters
    ----------
    runs : Run, path, or sequence of them
        Records with the same inputs and outputs.
    model : {"first-order", "second-order", "arx", "state-space", "fed-batch"}
        As for `beamfit identify`.
    map : {"constant", "network"}
        Parameters are numbers, or change with the inputs by a network.
    order : int, optional
        States of a state space; chosen by an information criterion if None.
    delay : float, optional
        Delay of the outputs in samples, a whole number for a state space; fitted if None. Negative
        if the clocks of inputs and outputs differ.
    offset : bool
        Estimate the output at rest; otherwise it is 0.
    hidden, seed : int
        Hidden nodes of a network, seed of its weights.
    held : sequence of Run or path
        Runs that are only predicted.

    Returns
    -------
    tuple
        A fit for each output; one fit of all outputs for a state space or a fed-batch process.

    Raises
    ------
    InputError
        If the runs do not match, or an option does not belong to the model.

    Examples
    --------
    >>> import beamfit
    >>> (level,) = beamfit.identify("measurements/valve_level_simulated.csv")
    >>> list(level.quantities), level.status.value
    (['tau', 'K', 'offset', 'delay'], 'poor_fit')
    """
    check_model(model, map, order=order, delay=delay, offset=offset)
    from beamfit.dynamics.record import check_inputs, check_runs

    runs, held = check_runs(runs, held, even=False)
    if model != FED_BATCH:
        check_inputs(runs)

    # JAX from here on
    options: dict[str, Any] = {"hidden": hidden, "seed": seed, "held": held}
    if model == FED_BATCH:
        from beamfit.dynamics.fedbatch import identify_batches

        return (identify_batches(runs, **options),)
    if model == STATES:
        from beamfit.dynamics.linear import identify_states

        whole = None if delay is None else int(delay)
        return (identify_states(runs, order, map, delay=whole, offset=offset, **options),)
    from beamfit.dynamics.fit import identify as respond

    options |= {"delay": delay, "offset": offset}
    return tuple(respond(runs, model, map, output=name, **options) for name in runs[0].outputs)


def check_model(
    model: str,
    map: str,
    *,
    order: int | None = None,
    delay: float | None = None,
    offset: bool = True,
) -> None:
    """Refuse options that do not belong to a model, named as on the command line.

    Raises
    ------
    InputError
        If an option does not belong to the model.
    """
    if order is not None and model != STATES:
        raise InputError(f"--order {order} with --model {model}", f"--model {STATES}")
    if model == STATES and delay and not float(delay).is_integer():
        raise InputError(f"--delay {delay:g} with --model {STATES}", "a whole number of samples")
    if model == FED_BATCH and (map != "network" or delay or not offset):
        expected = "--map network, without --delay or --no-offset: its rates are a network's"
        raise InputError(f"--model {FED_BATCH}", expected)


def control(
    runs: Run | Sequence[Run],
    targets: Steps,
    *,
    limits: Limits | None = None,
    rates: Mapping[str, float] | None = None,
    disturbances: Steps = (),
    model: str = "first-order",
    map: str = "constant",
    delay: float | None = None,
    offset: bool = True,
    hidden: int = 5,
    horizon: int | None = None,
    every: int | None = None,
    smooth: float = 0.1,
    duration: float | None = None,
    seed: int = 1,
) -> Loop:
    """Identify a process, plan its inputs within limits, and simulate the loop.

    Parameters
    ----------
    runs : Run, path, or sequence of them
        Records with the same inputs and outputs.
    targets, disturbances : sequence of (str, float, float)
        Output, value, and the time in s from which it is the target, or is added.
    limits : mapping of str to (float, float), optional
        Limits of inputs (default: the range of the runs) and of outputs.
    rates : mapping of str to float, optional
        Largest change of an input per second.
    horizon, every, smooth
        As for `beamfit.dynamics.control.controller`.
    model, map, delay, offset, hidden
        As for `identify`.
    duration : float, optional
        Time simulated, s; four horizons after the last change if None.
    seed : int
        Seed of the networks and the noise.

    Returns
    -------
    Loop
        Traces of inputs, outputs and targets, and a verdict.

    Raises
    ------
    InputError
        If a name is neither input nor output, and as for `identify` and `controller`.

    Examples
    --------
    >>> import beamfit
    >>> loop = beamfit.control("measurements/valve_level_simulated.csv", [("level", 5.0, 0.0)])
    >>> loop.headline
    'level by valve: poor_fit'
    """
    runs = [runs] if not isinstance(runs, list | tuple) else runs
    limits, inputs, outputs = dict(limits or {}), list(runs[0].inputs), list(runs[0].outputs)
    _check_names("limit", limits, inputs + outputs)
    _check_names("rate", rates or (), inputs)
    _check_names("set", [t[0] for t in targets], outputs)
    _check_names("disturb", [t[0] for t in disturbances], outputs)

    from beamfit.dynamics.control import controller, simulate_loop
    from beamfit.dynamics.fit import identify as respond

    options = {"delay": delay, "offset": offset, "hidden": hidden, "seed": seed}
    wanted = [name for name in outputs if name in {t[0] for t in targets} | set(limits)]
    fits = [respond(runs, model, map, output=name, **options) for name in wanted or outputs]
    made = controller(
        fits,
        inputs={n: v for n, v in limits.items() if n in inputs},
        rates=rates,
        outputs={n: v for n, v in limits.items() if n in outputs},
        horizon=horizon,
        every=every,
        smooth=smooth,
    )
    return simulate_loop(
        fits, made, targets, disturbances=disturbances, duration=duration, seed=seed
    )


def _check_names(option: str, names: Iterable[str], known: list[str]) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"--{option} of '{name}'", nearest(name, known))


def solve(
    document: Document | str | PathLike[str],
    data: Mapping[str, np.ndarray] | None = None,
    *,
    starts: int = 1,
    values: Mapping[str, Sequence[float]] | None = None,
    derivatives: Iterable[str] = (),
    **options: Any,
) -> ProblemSolution | Computed:
    """Solve a formulation, or evaluate its outputs if it has no objective.

    Parameters
    ----------
    document : Document or path
        Result of `read_formulation`, or a file; data tables are searched next to the file.
    data : mapping of str to array, optional
        Tables by name; for a file also paths, which replace those named in it.
    starts : int
        Number of searches: the first from the seeds of the document, others from random points.
    values : mapping of str to sequence of float, optional
        Values of inputs; for a variable the start of the search.
    derivatives : iterable of str
        Gains to calculate, such as "dy/dx".
    **options
        ``solver``, ``tolerance`` and ``seconds`` of `beamfit.language.solution.solve_document`.

    Returns
    -------
    ProblemSolution or Computed

    Raises
    ------
    InputError
        With file, line and column, if the document or its data cannot be used.

    Examples
    --------
    >>> import beamfit
    >>> print(beamfit.solve("formulations/appendix_d.bf").headline)
    obj = 2.113778016, local optimum
    """
    from beamfit.io.formulation import read_formulation, read_tables, solve_formulation

    if not is_path(document):
        found = data or {}
        return solve_formulation(document, None, found, starts, values, derivatives, **options)
    read, given = read_formulation(document), dict(data or {})
    files = {name: str(one) for name, one in given.items() if is_path(one)}
    tables, _ = read_tables(read, document, files)
    tables |= {name: one for name, one in given.items() if name not in files}
    return solve_formulation(read, document, tables, starts, values, derivatives, **options)


def scan_machine(
    machine: ScanMachine | str | PathLike[str],
    save: str | PathLike[str],
    *,
    journal: str | None = None,
    goal: float | None = None,
    points: int | None = None,
    tell: Callable[[ScanProgress], None] = lambda progress: None,
    note: Callable[[str], None] = lambda text: None,
) -> Outcome:
    """Scan the quadrupoles of a running machine, and restore the magnets in every case.

    Parameters
    ----------
    machine : ScanMachine or path
        The TOML file of docs/live.md, read or not.
    save : str or path
        File of the scan, written after every point; it must not exist.
    journal : str, optional
        File with the settings to restore; next to the machine file if None.
    goal : float, optional
        Relative error of the emittances at which to stop; from the machine file if None.
    points : int, optional
        Largest number of settings; from the machine file if None.
    tell, note : callable
        Called with the progress after each point, and with notes about the machine.

    Returns
    -------
    Outcome
        Points, fit, the reason for the end, and errors.

    Raises
    ------
    InputError
        If the scan could not begin: the file exists, a variable does not answer, a journal is left.

    Examples
    --------
    >>> import beamfit
    >>> beamfit.scan_machine("machine.toml", "README.md")
    Traceback (most recent call last):
    beamfit.errors.InputError: machine.toml: no such file; expected a readable file
    """
    from beamfit.io.machine import read_scan_machine
    from beamfit.live.channel import run
    from beamfit.live.restore import journal_of
    from beamfit.writing import check_place

    options = {k: v for k, v in {"goal": goal, "points": points}.items() if v}
    plan = replace(read_scan_machine(machine) if is_path(machine) else machine, **options)
    journal_path, target = journal_of(plan, journal), Path(save)
    for path in (target, journal_path):
        check_place(path)
    if target.exists():
        raise InputError("a file that exists", "another name; no scan is written over", target)
    return run(_scan(plan, journal_path, target, tell, note))


async def _scan(
    machine: ScanMachine,
    journal: Path,
    out: Path,
    tell: Callable[[ScanProgress], None],
    note: Callable[[str], None],
) -> Outcome:
    from beamfit.io.line import build_line
    from beamfit.live.devices import connect
    from beamfit.live.points import scan_text
    from beamfit.live.scan import scan
    from beamfit.writing import write_atomically

    line = build_line(machine.lattice)
    at = await connect(machine)
    for each in at.notes:
        note(each)

    def keep(points: Any, before: Mapping[str, float]) -> None:
        write_atomically(out, scan_text(points, at.machine, before).encode())

    return await scan(at, line, journal, keep=keep, tell=tell)


def watch(
    machine: WatchMachine | str | PathLike[str],
    seconds: float | None = None,
    *,
    show: Callable[[WatchView], None] = lambda view: None,
) -> WatchView:
    """Follow the lifetime of a stored beam; nothing is written to the machine.

    Parameters
    ----------
    machine : WatchMachine or path
        The TOML file of docs/live.md, read or not.
    seconds : float, optional
        Duration; until Ctrl-C if None.
    show : callable
        Called every second with the present view.

    Returns
    -------
    WatchView
        View at the end.

    Raises
    ------
    InputError
        If a variable does not answer.

    Examples
    --------
    >>> import beamfit
    >>> beamfit.watch("ring.toml", seconds=60.0)
    Traceback (most recent call last):
    beamfit.errors.InputError: ring.toml: no such file; expected a readable file
    """
    from beamfit.io.machine import read_watch_machine
    from beamfit.live.channel import run
    from beamfit.live.watch import connect
    from beamfit.live.watch import watch as follow

    plan = read_watch_machine(machine) if is_path(machine) else machine

    async def connect_and_follow() -> tuple[WatchView, int]:
        await connect(plan)
        return await follow(plan, watch_plan(plan), show, seconds)

    return run(connect_and_follow())[0]


def watch_plan(machine: WatchMachine) -> Plan:
    """Make the plan of a watch: window, interval, ring and reference current."""
    from beamfit.lifetime.watch import Plan

    ring = machine.ring and machine_of(machine.ring)
    return Plan(machine.name, machine.window, machine.interval, ring, machine.current)
