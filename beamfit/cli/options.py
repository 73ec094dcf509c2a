"""The options that several commands share, declared once, and what becomes of them."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import click

from beamfit.errors import InputError
from beamfit.particles import REST_ENERGY
from beamfit.report import kind_of
from beamfit.studies.scan.assumptions import SCENARIOS
from beamfit.studies.scan.typed import anchor_of, bounds_of, gains_of, limits_of, priors_of
from beamfit.writing import check_place


def _parsed(read: Callable[[Any], Any]) -> Callable[..., Any]:
    """Have click give a command what a reader of the library makes of the text."""
    return lambda context, parameter, value: None if value is None else read(value)


def _report(path: str) -> str:
    """Find out before anything is computed whether the report could be written."""
    kind_of(path)
    check_place(path)
    return path


LATTICE = "Lattice: TOML, MAD-X (.madx, .seq), MAD-8 (.mad8) or elegant (.lte)."
SHARED: dict[str, Callable[..., Any]] = {
    "scan": click.argument("scan"),
    "ignore": click.option(
        "--ignore",
        multiple=True,
        metavar="COLUMN",
        help="A column of the scan to leave unread; * and ? stand for any letters.",
    ),
    "skip-bad": click.option(
        "--skip-bad",
        is_flag=True,
        help="Leave out rows of the scan with something wrong in them; they are counted and named.",
    ),
    "lattice": click.option("--lattice", required=True, metavar="FILE", help=LATTICE),
    "maybe-lattice": click.option("--lattice", metavar="FILE", help=LATTICE),
    "size-method": click.option(
        "--size-method",
        metavar="NAME",
        help="Which sizes of a .mat file of emittance_gui; RMS unless said.",
    ),
    "weights": click.option(
        "--weights",
        type=click.Choice(["model", "measured"]),
        default="model",
        show_default=True,
        help="Whose size the error of size squared is taken at; measured sizes bias the answer.",
    ),
    "particle": click.option(
        "--particle",
        type=click.Choice(list(REST_ENERGY)),
        help="Of a scan without a lattice; electrons unless said.",
    ),
    "use": click.option(
        "--use", metavar="NAME", help="Line or sequence of a lattice with several."
    ),
    "from": click.option(
        "--from", "first", metavar="NAME", help="Element with which the line begins."
    ),
    "to": click.option("--to", "last", metavar="NAME", help="Element with which the line ends."),
    "screen": click.option(
        "--screen",
        metavar="NAME",
        help="Screen or marker at which sizes are measured or wanted; the last screen unless said.",
    ),
    "energy": click.option(
        "--energy",
        type=float,
        metavar="MEV",
        help="Total energy, instead of the lattice's own; elegant files and scans without a "
        "lattice have none.",
    ),
    "scenario": click.option(
        "--scenario",
        type=click.Choice(list(SCENARIOS)),
        default="known",
        show_default=True,
        help="What is unknown besides the beam: nothing, R11 and R12, the magnets' calibration, "
        "or k1 as a function of the current.",
    ),
    "time": click.option(
        "--time",
        metavar="COLUMN[:UNIT]",
        help="Header of the time, a date or a number in s, min, h, d or ms.",
    ),
    "current": click.option(
        "--current",
        metavar="COLUMN:UNIT",
        help="Header of the beam current and its unit, mA, A or uA, after the last colon, such "
        "as SR:DCCT:CURRENT:mA. With --time or --current other columns of unknown names are left "
        "aside.",
    ),
    "prior": click.option(
        "--prior",
        "priors",
        multiple=True,
        metavar="NAME=MEAN+-SD",
        callback=_parsed(priors_of),
        help="What is known of a number: calibration, Q2.slope=167.23+-3.3446 (or ±); a study of "
        "lifetimes, its scales, and rf_voltage=1+-1% for the calibration of that reading.",
    ),
    "bounds": click.option(
        "--bounds",
        multiple=True,
        metavar="NAME=LOW:HIGH",
        callback=_parsed(bounds_of),
        help="Calibration: bounds of a number; ± 12 % of the slope unless given. Transport "
        "network: of the beam, x.sigma11=2e-8:3e-8 (SI), or of a setting the gains are held over.",
    ),
    "gain": click.option(
        "--gain",
        "gains",
        multiple=True,
        metavar="NAME=LOW:HIGH",
        callback=_parsed(gains_of),
        help="Transport network: limits of a gain such as dA_x/dQ2=:-0.0083, in place of signs. "
        "Responses: limits that a parameter keeps for certain, K=1:3 or dK/dvalve=0:.",
    ),
    "anchor": click.option(
        "--anchor",
        multiple=True,
        metavar="ANCHOR",
        callback=_parsed(anchor_of),
        help="Networks: what ties them to the lattice: first-principles=2%, a setting such as "
        "Q2=0, or determinant.",
    ),
    "hidden": click.option(
        "--hidden", default=5, show_default=True, help="Networks: hidden nodes."
    ),
    "vary": click.option(
        "--vary",
        "limits",
        multiple=True,
        metavar="MAGNET=LOW:HIGH",
        callback=_parsed(limits_of),
        help="A magnet and its limits, in the unit of its calibration.",
    ),
    "model": click.option(
        "--model",
        type=click.Choice(["first-order", "second-order", "arx", "state-space", "fed-batch"]),
        default="first-order",
        show_default=True,
        help="tau y' + y = K u; T² y'' + 2 zeta T y' + y = K u; y(k) = -a1 y(k-1) - a2 y(k-2) + "
        "b1 u(k-1) + b2 u(k-2); x+ = A x + B u, y = C x + D u of all outputs together; or mass "
        "balances of biomass, substrate and volume with rates by a network.",
    ),
    "order": click.option(
        "--order",
        type=click.IntRange(1, 50),
        metavar="STATES",
        help="State space: its states; found by an information criterion unless said.",
    ),
    "map": click.option(
        "--map",
        type=click.Choice(["constant", "network"]),
        default="constant",
        show_default=True,
        help="Parameters are numbers, or change with the inputs by a network.",
    ),
    "input": click.option(
        "--input", "inputs", multiple=True, metavar="COLUMN", help="An input of any name."
    ),
    "output": click.option(
        "--output", "outputs", multiple=True, metavar="COLUMN", help="An output of any name."
    ),
    "step": click.option(
        "--step", type=float, metavar="SECONDS", help="Distance of rows without a time."
    ),
    "delay": click.option(
        "--delay", type=click.IntRange(0), metavar="SAMPLES", help="Known delay; found unless said."
    ),
    "no-offset": click.option(
        "--no-offset", is_flag=True, help="The output at rest is 0, and not estimated."
    ),
    "report": click.option(
        "--report",
        metavar="FILE.html|.pdf|.png|.svg",
        callback=_parsed(_report),
        help="Write a report page, or (.png, .svg) its pictures one by one.",
    ),
    "sample": click.option(
        "--sample",
        is_flag=True,
        help="Draw from the posterior: credible intervals, correlations, predictions.",
    ),
    "store": click.option(
        "--store",
        metavar="FILE.h5",
        help="Keep the draws of --sample (emcee's HDF5 layout); goes on from an earlier run.",
    ),
    "seed": click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=1,
        show_default=True,
        help="Of all random numbers: draws, starts of networks.",
    ),
    "json": click.option(
        "--json", "as_json", is_flag=True, help="Print one JSON object and nothing else."
    ),
}


def options(names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add shared options to a command, in the order of their names."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for name in reversed(names.split()):
            command = SHARED[name](command)
        return command

    return add


class Sampling(NamedTuple):
    """What --sample, --store and --seed say."""

    wanted: bool
    store: str | None
    seed: int

    def check(self) -> None:
        """Find out before anything is computed whether the store could be written."""
        if self.store is not None:
            if not self.wanted:
                raise InputError("--store without --sample", "--sample, which fills the store")
            check_place(self.store)

    def check_one(self, fits: int) -> None:
        """Refuse to keep the draws of several fits in one store."""
        if self.store is not None and fits > 1:
            found = f"--store for {fits} decays"
            raise InputError(found, "a record of one decay, or no --store")

    def arguments(self, inputs: Mapping[str, str | None], *, quiet: bool) -> dict[str, Any]:
        """Arguments for the `sample` of a fit."""
        from beamfit.sampling.store import Provenance

        source = Provenance(command_line(), dict(inputs))
        return {
            "seed": self.seed,
            "store": self.store,
            "provenance": source,
            "progress": not quiet,
        }


def command_line() -> str:
    """The command as it was typed, quoted for a shell."""
    return shlex.join(["beamfit", *sys.argv[1:]])
