"""`beamfit density`: emittance against charge from the profiles of a scan."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from beamfit.cli.options import Command, Output, options
from beamfit.errors import InputError
from beamfit.io.line import build_line, read_inputs
from beamfit.io.priors import read_noise

EXAMPLE = """\b
Examples:
  beamfit density Emittance-scan-OTRS_IN20_571.mat --report density.html
  beamfit density measurements/profiles_simulated.csv --lattice lattices/lcls_otr2.toml
  beamfit density profiles.h5 --lattice line.toml --json
"""


@click.command(cls=Command, epilog=EXAMPLE)
@options(
    "scan columns ignore skip-bad size-method maybe-lattice use from to screen energy particle"
)
@options("noise seed report json")
def density(scan: str, noise: str | None, seed: int, output: Output, **given: Any) -> None:
    """Find the density of a beam in phase space, and its emittance against charge, with errors.

    SCAN is a .mat file of SLAC's emittance_gui, or a CSV or HDF5 table with a line for each bin of
    each profile: Q2_A, shot, position_um, counts_x, counts_y; or with a line for each image: Q2_A,
    image, pixel_um.
    """
    read = read_inputs(scan, **given)
    if not read.scan.profiles:
        expected = "columns position_um and counts_x, or image and pixel_um, or a file of "
        expected += "emittance_gui"
        raise InputError("sizes and no profiles", expected, scan)
    own = None if noise is None else read_noise(noise)
    line = build_line(read.lattice)  # JAX from here on

    from beamfit.density.fit import fit_density

    fit = fit_density(read.scan, line, noise=own, seed=seed)
    fit = fit if read.gui is None else replace(fit, stored=read.gui.stored)
    output.write(fit, read.digests)
    output.answer([fit], read.digests)
