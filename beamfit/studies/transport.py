"""A scan seen through a line: from settings to the numbers a fit of sizes needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.optics.beam import BeamMatrix
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import FocusingStrength, IntegratedGradient, IntegratedStrength
from beamfit.optics.elements import Marker, Screen
from beamfit.studies.scans import QuadScan
from beamfit.studies.sigma import SigmaFit, emittance_parts, fit_sizes

__all__ = [
    "Derived",
    "PlaneInput",
    "PlaneNumbers",
    "names_of",
    "plane_input",
    "plane_numbers",
    "scanned_line",
    "transfer_rows",
]


class PlaneInput(NamedTuple):
    """One plane of a scan with everything the transport needs; arrays of shape (n,).

    Attributes
    ----------
    settings : dict of str to ndarray
        Magnet name to setting.
    energy : ndarray
        Total energy, MeV.
    screens : tuple of str
        The screens, each once.
    which : ndarray
        Index into ``screens``.
    size : ndarray
        Rms size, m.
    error : ndarray or None
        Standard error, m.
    energy_spread, resolution : ndarray
        Relative, and m.
    """

    settings: dict[str, np.ndarray]
    energy: np.ndarray
    screens: tuple[str, ...]
    which: np.ndarray
    size: np.ndarray
    error: np.ndarray | None
    energy_spread: np.ndarray
    resolution: np.ndarray


class Derived(NamedTuple):
    """What people quote, with raw errors from the exact gradients.

    Attributes
    ----------
    start, start_error : Array
        Shape (3,): ε (m), β (m), α at the start.
    screen, screen_error : Array
        Shape (3,): β (m), α, rms size (m) at the last screen, magnets at their own settings.
    mismatch, mismatch_error : Array
        Shape (1,): BMAG to the design.
    """

    start: Array
    start_error: Array
    screen: Array
    screen_error: Array
    mismatch: Array
    mismatch_error: Array


class PlaneNumbers(NamedTuple):
    """All numbers of one plane, computed in one compiled call.

    Attributes
    ----------
    r11, r12 : Array
        Shape (n,), start to screen (R12 in m).
    known : Array
        Shape (n,), size² in m² due to dispersion and resolution.
    fit : SigmaFit
        The fitted beam matrix.
    model : Array
        Shape (n,), fitted sizes in m.
    derived : Derived
        Twiss and mismatch.
    """

    r11: Array
    r12: Array
    known: Array
    fit: SigmaFit
    model: Array
    derived: Derived


def names_of(line: Beamline) -> tuple[dict[str, str], list[str], str | None]:
    """Calibration units by magnet, places a screen may be, and the default screen.

    Examples
    --------
    >>> names_of(Beamline((Screen("S"),), energy=100.0))
    ({}, ['S'], 'S')
    """
    units = {n: line[n].calibration.unit for n in line.magnets}
    places = [e.name for e in line.elements if isinstance(e, Screen | Marker)]
    return units, places, line.screens[-1] if line.screens else None


def scanned_line(scan: QuadScan, line: Beamline) -> Beamline:
    """Give each scanned magnet the meaning its column's unit has.

    Examples
    --------
    >>> from beamfit.optics.elements import Quadrupole
    >>> line = Beamline((Quadrupole("Q", 0.1), Screen("S")), energy=100.0)
    >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "kG"}, {"x": [2e-4, 1e-4, 3e-4]})
    >>> scanned_line(scan, line)["Q"].calibration.unit
    'kG'
    """
    meanings = {
        "kG": IntegratedGradient(mass=line.mass),
        "k1": FocusingStrength(),
        "k1l": IntegratedStrength(),
    }
    for name, unit in scan.units.items():
        magnet = line[name]
        if unit != magnet.calibration.unit:
            line = line.with_element(replace(magnet, calibration=meanings[unit]))
    return line


def plane_input(scan: QuadScan, line: Beamline, plane: str) -> PlaneInput:
    """Collect what the fit of one plane needs, filling in what the line knows."""
    rows = scan.rows(plane)
    n = len(rows.size)
    named = rows.screen or (line.screens[-1],) * n
    screens = tuple(dict.fromkeys(named))
    which = np.array([screens.index(s) for s in named])
    own = np.array([float(getattr(line[s], "resolution", 0.0)) for s in screens])
    spread = np.full(n, float(line.energy_spread))
    return PlaneInput(
        settings=rows.settings,
        energy=np.full(n, float(line.energy)) if rows.energy is None else rows.energy,
        screens=screens,
        which=which,
        size=rows.size,
        error=rows.error,
        energy_spread=spread if rows.energy_spread is None else rows.energy_spread,
        resolution=own[which] if rows.resolution is None else rows.resolution,
    )


@partial(jax.jit, static_argnames=("plane", "screens"))
def transfer_rows(
    line: Beamline,
    settings: Mapping[str, Array],
    energy: Array,
    which: Array,
    plane: str,
    screens: tuple[str, ...],
) -> Array:
    """Transfer matrices of one plane from the start to the screen of each row.

    Parameters
    ----------
    line : Beamline
        The line.
    settings : mapping of str to Array
        Magnet name to settings, shape (n,).
    energy : Array
        MeV, shape (n,).
    which : Array
        Index into ``screens``, shape (n,).
    plane : str
        "x" or "y".
    screens : tuple of str
        The screens.

    Returns
    -------
    Array
        Shape (n, 3, 3).
    """

    def to(screen: str) -> Array:
        part = line.upto(screen)
        own = {n: v for n, v in settings.items() if n in part.magnets}
        return jax.vmap(lambda s, e: getattr(part.matrix(s, e), plane))(own, energy)

    every = jnp.stack([to(screen) for screen in screens])
    return every[which, jnp.arange(len(which))]


@partial(jax.jit, static_argnames=("plane", "screens", "method"))
def plane_numbers(
    scanned: Beamline,
    line: Beamline,
    settings: Mapping[str, Array],
    energy: Array,
    which: Array,
    size: Array,
    error: Array,
    energy_spread: Array,
    resolution: Array,
    plane: str,
    screens: tuple[str, ...],
    method: str,
) -> PlaneNumbers:
    """Transport, fit and propagation of one plane; arguments as in `PlaneInput`.

    ``scanned`` has the calibrations of the scan's columns, ``line`` its own: the beam at the
    screen is given for the latter's settings. Pure, so that it can be differentiated by every
    number of the line.
    """
    r = transfer_rows(scanned, settings, energy, which, plane, screens)
    r11, r12 = r[:, 0, 0], r[:, 0, 1]
    known = (r[:, 0, 2] * energy_spread) ** 2 + resolution**2
    fit = fit_sizes(r11, r12, size, error, known, method)
    design = jnp.stack([r11**2, 2.0 * r11 * r12, r12**2], axis=-1)
    return PlaneNumbers(
        r11=r11,
        r12=r12,
        known=known,
        fit=fit,
        model=jnp.sqrt(jnp.maximum(design @ fit.sigma + known, 0.0)),
        derived=_derive(fit.sigma, fit.covariance, line, plane, screens[-1]),
    )


def _derive(sigma: Array, covariance: Array, line: Beamline, plane: str, screen: str) -> Derived:
    """Propagate σ and its covariance to what people quote, by exact gradients."""
    to_screen = getattr(line.upto(screen).matrix(), plane)
    twiss = getattr(line.design, plane) if line.design else None

    def at_screen(s: Array) -> Array:
        beam = BeamMatrix.from_sigma(*s).transport(to_screen)
        return jnp.stack([beam.twiss.beta, beam.twiss.alpha, beam.l11])

    def mismatch(s: Array) -> Array:
        if twiss is None:
            return jnp.full(1, jnp.nan)
        there = getattr(line.upto(line.design.at).matrix(), plane)
        beam = BeamMatrix.from_sigma(*s).transport(there)
        return beam.mismatch(BeamMatrix.from_twiss(1.0, *twiss))[None]

    def with_error(function):
        gradient = jax.jacfwd(function)(sigma)
        return function(sigma), jnp.sqrt(jnp.diagonal(gradient @ covariance @ gradient.T))

    return Derived(*with_error(emittance_parts), *with_error(at_screen), *with_error(mismatch))
