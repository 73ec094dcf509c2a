"""The command line. Imports here stay light: help and errors come before JAX."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import click

from beamfit import __version__
from beamfit.cli.design import design
from beamfit.cli.emittance import emittance
from beamfit.cli.lifetime import lifetime
from beamfit.cli.setpoint import setpoint
from beamfit.errors import InputError

__all__ = ["cli", "main"]


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: beamfit emittance scan.csv --lattice line.toml --report scan.html",
)
@click.version_option(__version__, prog_name="beamfit")
def cli() -> None:
    """Beam emittance and lifetime from scans and decays, with errors you can defend."""


cli.add_command(emittance)
cli.add_command(lifetime)
cli.add_command(setpoint)
cli.add_command(design)


def main() -> None:
    """Run the command line: exit 0 when answered, 2 with one line on unusable input."""
    _compile_quickly()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without µ shows a mark instead
            stream.reconfigure(errors="replace")
    try:
        status = cli.main(prog_name="beamfit", standalone_mode=False) or 0
        sys.stdout.flush()
        sys.exit(status)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        sys.exit(0)
    except click.ClickException as error:
        _fail(error.format_message())
    except click.exceptions.Abort:
        sys.exit(130)
    except InputError as error:
        _fail(str(error))
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        sys.stdout = None  # what is left in its buffer has nowhere to go
        _fail(f"output that cannot be written ({error.strerror}); expected room for it")


def _compile_quickly() -> None:
    """Tell JAX, before it is imported, that each function runs a few times at most.

    Compiling is most of a command's time: keep what was compiled for the next command, and
    do not optimise code that runs for microseconds. Both only where the user has not chosen.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "beamfit"
    try:
        cache.mkdir(parents=True, exist_ok=True)
        usable = os.access(cache, os.W_OK)
    except OSError:
        usable = False
    if usable:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")


def _fail(message: str) -> None:
    """Say it on one line of standard error."""
    click.echo("beamfit: " + " ".join(message.split()), err=True)
    sys.exit(2)
