"""The command line. Imports here stay light: help and errors come before JAX."""

from __future__ import annotations

import io
import logging
import os
import sys
import warnings

import click

from beamfit import __version__
from beamfit.cli.batch import batch
from beamfit.cli.check import check
from beamfit.cli.control import control
from beamfit.cli.density import density
from beamfit.cli.design import design
from beamfit.cli.emittance import emittance
from beamfit.cli.example import example
from beamfit.cli.identify import identify
from beamfit.cli.lifetime import lifetime
from beamfit.cli.scan import scan
from beamfit.cli.setpoint import setpoint
from beamfit.cli.solve import solve
from beamfit.cli.tune import tune
from beamfit.cli.watch import watch
from beamfit.errors import MAX_MESSAGE, InputError, plain, short


class _Commands(click.Group):
    """Command group that lists the descriptions of commands without truncation."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one paragraph per command."""
        rows = [(name, self.commands[name].get_short_help_str(500)) for name in self.commands]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: beamfit emittance scan.csv --lattice line.toml --report scan.html",
)
@click.version_option(__version__, prog_name="beamfit")
def cli() -> None:
    """Beam emittance and lifetime from scans and decays, with errors you can defend."""


for command in (emittance, density, lifetime, setpoint, design, tune, example, check):
    cli.add_command(command)
for command in (solve, identify, control, batch, watch, scan):
    cli.add_command(command)


def main() -> None:
    """Run the command line: exit 0 when answered, 2 with one line on unusable input."""
    _replace_unknown_characters()
    _silence_libraries()
    try:
        status = cli.main(prog_name="beamfit", standalone_mode=False) or 0
        if sys.stdout is not None:  # None where it was closed before we began
            sys.stdout.flush()
        sys.exit(status)
    except SystemExit as stop:  # 1 if the reader of a pipe, such as `head`, has closed it
        sys.exit(0 if stop.code == 1 else stop.code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        sys.exit(0)
    except click.ClickException as error:
        _fail(error.format_message())
    except click.exceptions.Abort:
        click.echo("beamfit: interrupted", err=True)
        sys.exit(130)
    except InputError as error:
        _fail(str(error))
    except BrokenPipeError:  # a closed pipe, too
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        sys.stdout = None  # drop the rest of its buffer
        _fail(f"output that cannot be written ({error.strerror}); expected room for it")


def _silence_libraries() -> None:
    """Suppress warnings of libraries in this process and its children; ``python -W`` shows them.

    Problems of input or answer are reported by beamfit itself.
    """
    logging.getLogger().addHandler(logging.NullHandler())
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        warnings.filterwarnings("default", message=".*chmod 700")  # beamfit's own
        os.environ.setdefault("PYTHONWARNINGS", "ignore")


def _replace_unknown_characters() -> None:
    """Print a replacement for characters that the terminal does not have, such as µ."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _fail(message: str) -> None:
    """Print one line on standard error and exit with status 2."""
    click.echo("beamfit: " + short(plain(" ".join(message.split())), MAX_MESSAGE), err=True)
    sys.exit(2)
