"""Shared options of the commands, and the output of reports and answers."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, NamedTuple

import click

import beamfit
from beamfit.cli.option_text import anchor_of, bounds_of, gains_of, goal_of, limits_of, priors_of
from beamfit.emittance.assumptions import SCENARIOS
from beamfit.errors import InputError
from beamfit.io.columns import layout_of
from beamfit.io.result import results_text
from beamfit.particles import REST_ENERGY
from beamfit.report import kind_of
from beamfit.writing import check_place

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.sampling.posterior import Posterior


# Commands that show their own progress, or answer at once.
WITH_PROGRESS = ("batch", "check", "scan", "watch")
# Seconds before the elapsed time is shown, and between its updates: chosen to be noticed by a user
# who would otherwise wonder whether the command still runs.
SHOW_AFTER = 3.0
UPDATE_EVERY = 0.5


class ElapsedTime:
    """Line on standard error that counts seconds until `end`; only on a terminal.

    Compilation and searches do not report their progress, so only the elapsed time is shown.
    """

    def __init__(self, name: str) -> None:
        self.name, self.over, self.thread = name, Event(), None
        if sys.stderr is not None and sys.stderr.isatty():
            self.thread = Thread(target=self._count, daemon=True)
            self.thread.start()

    def _count(self) -> None:
        began, shown = time.monotonic(), False
        while not self.over.wait(UPDATE_EVERY):
            if (seconds := time.monotonic() - began) > SHOW_AFTER:
                click.echo(f"\r{self.name}: {seconds:.0f} s ...\033[K", err=True, nl=False)
                shown = True
        if shown:
            click.echo("\r\033[K", err=True, nl=False)

    def end(self) -> None:
        """Remove the line before an answer, an error or another progress bar."""
        self.over.set()
        if self.thread is not None:
            self.thread.join()


def end_elapsed_time() -> None:
    """Remove the line with the elapsed time of the running command, if there is one."""
    context = click.get_current_context(silent=True)
    if context is not None and isinstance(context.obj, ElapsedTime):
        context.obj.end()


class _Option(click.Option):
    """Option listed under a heading of the help text."""

    def __init__(self, *names: Any, heading: str = "", **further: Any) -> None:
        super().__init__(*names, **further)
        self.heading = heading


class Command(click.Command):
    """Command whose help lists options under headings, in their order of appearance.

    Its function receives --json, --report and --full as one argument ``output``, an `Output`.
    """

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command and show the elapsed time if it takes long."""
        given = {n: ctx.params.pop(n) for n in Output._fields if n in ctx.params}
        ctx.params["output"] = Output(**given)
        ctx.obj = None if self.name in WITH_PROGRESS else ElapsedTime(f"beamfit {self.name}")
        try:
            return super().invoke(ctx)
        finally:
            end_elapsed_time()

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one section per heading."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for each in self.get_params(ctx):
            record = each.get_help_record(ctx)
            if record is not None and isinstance(each, click.Option):
                heading = getattr(each, "heading", "Output")
                sections.setdefault(heading or "Options", []).append(record)
        for heading, rows in sorted(sections.items(), key=lambda section: section[0] == "Output"):
            with formatter.section(heading):
                formatter.write_dl(rows)


def option(
    spelled: str,
    said: str,
    name: str = "",
    choices: Sequence[str] = (),
    heading: str = "",
    **further: Any,
) -> Callable[..., Any]:
    """Make an option from its text such as ``--store FILE.h5`` and its help; defaults are shown.

    `name` is the argument name of the command if it differs from the option, `heading` the section
    of the help text.
    """
    flag, _, metavar = spelled.partition(" ")
    further |= {"cls": _Option, "heading": heading or HEADINGS.get(flag, "")}
    further |= {"type": click.Choice(list(choices))} if choices else {}
    further |= {"metavar": metavar or None, "show_default": bool(further.get("default"))}
    return click.option(*filter(None, (flag, name)), help=said, **further)


def _parser(read: Callable[[Any], Any]) -> Callable[..., Any]:
    """Make a click callback that parses the text of an option with a function of the library."""
    return lambda context, parameter, value: None if value is None else read(value)


def _check_report(path: str) -> str:
    """Check before a calculation that the report can be written."""
    kind_of(path)
    check_place(path)
    return path


# Headings of the help text by option.
HEADINGS = {
    **dict.fromkeys(("--columns", "--ignore", "--skip-bad", "--size-method"), "Input"),
    **dict.fromkeys(("--lattice", "--use", "--from", "--to", "--screen", "--energy"), "Lattice"),
    **dict.fromkeys(("--particle", "--ring"), "Lattice"),
    **dict.fromkeys(("--noise", "--robust", "--weights", "--method"), "Noise and residual"),
    **dict.fromkeys(("--scenario", "--prior", "--bounds", "--gain", "--anchor"), "Unknowns"),
    **dict.fromkeys(("--hidden", "--starts", "--hysteresis", "--systematics"), "Unknowns"),
    **dict.fromkeys(("--sample", "--store", "--seed"), "Posterior"),
    **dict.fromkeys(("--report", "--full", "--json"), "Output"),
}
LATTICE = "Lattice: TOML, MAD-X (.madx, .seq), MAD-8 (.mad8) or elegant (.lte)."
SHARED: dict[str, Callable[..., Any]] = {
    "scan": click.argument("scan"),
    "columns": option(
        "--columns HEADER=NAME,...|LAYOUT.toml",
        "Meaning of columns with other headers, such as 'xrms=size_x_um, QUAD:BACT=Q525_kG'; or a "
        "file of such a layout; or day-month-year, for numeric dates. Other columns with unknown "
        "names are ignored.",
        callback=_parser(layout_of),
    ),
    "ignore": option(
        "--ignore COLUMN",
        "A column of the scan to leave unread; * and ? stand for any letters.",
        multiple=True,
    ),
    "skip-bad": option(
        "--skip-bad",
        "Leave out rows with an error; they are counted and named.",
        is_flag=True,
    ),
    "lattice": option("--lattice FILE", LATTICE, required=True),
    "maybe-lattice": option("--lattice FILE", LATTICE),
    "size-method": option(
        "--size-method NAME", "Sizes to take from a .mat file of emittance_gui; default: RMS."
    ),
    "noise": option(
        "--noise FILE",
        "TOML file of your own priors on the noise of sizes; `beamfit batch --learn-noise` writes "
        "one.",
    ),
    "weights": option(
        "--weights",
        "Error of size squared from the model or the measured size; the latter is biased.",
        choices=["model", "measured"],
        default="model",
    ),
    "particle": option(
        "--particle",
        "Particle of a scan without a lattice; default: electron.",
        choices=list(REST_ENERGY),
    ),
    "use": option("--use NAME", "Line or sequence of a lattice with several."),
    "from": option("--from NAME", "Element with which the line begins.", name="first"),
    "to": option("--to NAME", "Element with which the line ends.", name="last"),
    "screen": option(
        "--screen NAME",
        "Screen or marker at which sizes are measured or wanted; default: the last screen.",
    ),
    "energy": option(
        "--energy MEV",
        "Total energy, instead of that of the lattice; elegant files and scans without a lattice "
        "have none.",
        type=float,
    ),
    "scenario": option(
        "--scenario",
        "Unknown in addition to the beam: nothing, R11 and R12, the calibration of the magnets, "
        "or k1 as a function of the current.",
        choices=list(SCENARIOS),
        default="known",
    ),
    "prior": option(
        "--prior NAME=MEAN+-SD",
        "Prior of a parameter: of a calibration, Q2.slope=167.23+-3.3446 (or ±); of screen, beam "
        "and line, size_scale=1+-2%.",
        name="priors",
        multiple=True,
        callback=_parser(priors_of),
    ),
    "scale-prior": option(
        "--prior NAME=MEAN+-SD",
        "With --study: prior of a scale, or rf_voltage=1+-1% for the calibration of that reading.",
        name="priors",
        multiple=True,
        callback=_parser(priors_of),
    ),
    "bounds": option(
        "--bounds NAME=LOW:HIGH",
        "Calibration: bounds of a parameter; default: ± 12 % of the slope. Transport network: "
        "bounds of the beam, x.sigma11=2e-8:3e-8 (SI), or range of a setting for limits of gains.",
        multiple=True,
        callback=_parser(bounds_of),
    ),
    "gain": option(
        "--gain NAME=LOW:HIGH",
        "Transport network: limits of a gain such as dA_x/dQ2=:-0.0083, in place of signs.",
        name="gains",
        multiple=True,
        callback=_parser(gains_of),
    ),
    "anchor": option(
        "--anchor ANCHOR",
        "Networks: prior from the lattice: first-principles=2%, a setting such as Q2=0, or "
        "determinant.",
        multiple=True,
        callback=_parser(anchor_of),
    ),
    "hidden": option("--hidden", "Networks: hidden nodes.", default=5),
    "vary": option(
        "--vary NAME=LOW:HIGH",
        "A magnet or a knob and its limits, in the unit of its calibration or column.",
        name="limits",
        multiple=True,
        callback=_parser(limits_of),
    ),
    "model": option(
        "--model",
        "tau y' + y = K u; T² y'' + 2 zeta T y' + y = K u; y(k) = -a1 y(k-1) - a2 y(k-2) + "
        "b1 u(k-1) + b2 u(k-2); x+ = A x + B u, y = C x + D u of all outputs together; or mass "
        "balances of biomass, substrate and volume with rates by a network.",
        choices=["first-order", "second-order", "arx", "state-space", "fed-batch"],
        default="first-order",
    ),
    "order": option(
        "--order STATES",
        "Number of states of a state space; default: chosen by an information criterion.",
        type=click.IntRange(1, 50),
    ),
    "map": option(
        "--map",
        "Parameters are constants, or functions of the inputs given by a network.",
        choices=["constant", "network"],
        default="constant",
    ),
    "input": option("--input COLUMN", "Column of an input.", name="inputs", multiple=True),
    "output": option("--output COLUMN", "Column of an output.", name="outputs", multiple=True),
    "step": option("--step SECONDS", "Time between rows of a file without times.", type=float),
    "delay": option("--delay SAMPLES", "Known delay; default: fitted.", type=float),
    "no-offset": option("--no-offset", "Set the output at rest to 0.", is_flag=True),
    "goal": option(
        "--goal PERCENT", "Emittance error at which to stop.", callback=_parser(goal_of)
    ),
    "close": option(
        "--close PERCENT",
        "Stop when the best setting is this close to the minimum with 95 % probability.",
        callback=_parser(goal_of),
        default="5%",
    ),
    "report": option(
        "--report FILE.html|.pdf|.png|.svg",
        "Write a report page, or (.png, .svg) its pictures one by one.",
        callback=_parser(_check_report),
    ),
    "sample": option(
        "--sample",
        "Draw from the posterior: credible intervals, correlations, predictions.",
        is_flag=True,
    ),
    "store": option(
        "--store FILE.h5",
        "Keep the draws of --sample (HDF5 layout of emcee); continues an earlier run.",
    ),
    "seed": option(
        "--seed",
        "Seed of all random numbers: draws, starts of networks.",
        type=click.IntRange(0, 2**32 - 1),
        default=1,
    ),
    "full": option("--full", "Show every table, not only the first screen.", is_flag=True),
    "json": option(
        "--json", "Print one JSON object and nothing else.", name="as_json", is_flag=True
    ),
}


def options(names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add shared options to a command, in the given order."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for name in reversed(names.split()):
            command = SHARED[name](command)
        return command

    return add


class Sampling(NamedTuple):
    """Values of --sample, --store and --seed."""

    wanted: bool
    store: str | None
    seed: int

    def check(self) -> None:
        """Check before a calculation that the store can be written."""
        if self.store is not None:
            if not self.wanted:
                raise InputError("--store without --sample", "--sample, which fills the store")
            check_place(self.store)

    def sample_all(
        self, fits: Sequence[Any], inputs: Mapping[str, str | None], *, quiet: bool
    ) -> list[Posterior | None]:
        """Sample the posterior of each fit; None for each without ``--sample``."""
        if not self.wanted:
            return [None for _ in fits]
        if self.store is not None and len(fits) > 1:
            found = f"--store for {len(fits)} decays"
            raise InputError(found, "a record of one decay, or no --store")
        from beamfit.sampling.store import Provenance

        end_elapsed_time()  # sampling has its own progress bar

        source = Provenance(command_line(), dict(inputs))
        arguments = {"seed": self.seed, "store": self.store, "provenance": source}
        return [fit.sample(**arguments, progress=not quiet) for fit in fits]


class Output(NamedTuple):
    """Values of --json, --report and --full, the destinations of an answer."""

    as_json: bool
    report: str | None = None
    full: bool = True

    def write(self, result: Any, inputs: Mapping[str, str | None], **further: Any) -> None:
        """Write the report of a result if ``--report`` was given."""
        if self.report is not None:
            further |= {"command": command_line(), "inputs": inputs}
            beamfit.write_report(self.report, result, **further)

    def answer(
        self,
        results: Iterable[Any],
        inputs: Mapping[str, str | None],
        show: Callable[[Terminal], None] | None = None,
        **further: Any,
    ) -> None:
        """Print the JSON object of a command, or show the answer and the path of its report.

        Without ``show`` each result is shown by its own tables. `results` is evaluated only for
        JSON or without ``show``; ``further`` entries are added to the JSON object.
        """
        end_elapsed_time()
        if self.as_json:
            further = {name: found for name, found in further.items() if found is not None}
            click.echo(results_text(list(results), inputs, command_line(), **further))
            return
        from beamfit.cli.show import Terminal  # rich

        terminal = Terminal(self.full)
        if show is None:
            for each in results:
                terminal.result(each)
        else:
            show(terminal)
        terminal.report(self.report)


def command_line() -> str:
    """Return the command as typed, quoted for a shell."""
    return shlex.join(["beamfit", *sys.argv[1:]])
