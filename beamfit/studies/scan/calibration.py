"""The calibration scenario: what a magnet's setting means is free, within priors and bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax

from beamfit.errors import InputError, nearest
from beamfit.greybox.problem import Free, Prior, Problem
from beamfit.greybox.tree import leaves
from beamfit.optics.beamline import Beamline
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.scenario_data import (
    Seen,
    beam_free,
    beam_numbers,
    plane_rows,
    size_record,
    varied_magnets,
)

__all__ = ["WIDTH", "calibration_numbers", "calibration_problem", "usual_bounds", "with_numbers"]

# The report's bounds are 167.23 ± 20 for the slope and 43.17 ± 20 for the intercept (appendix C).
WIDTH = 20.0 / 167.23
OFFSETS = ("intercept", "coefficients.0")


def calibration_numbers(line: Beamline, magnet: str) -> dict[str, float]:
    """The numbers of a magnet's calibration by name.

    Parameters
    ----------
    line : Beamline
        The line.
    magnet : str
        A magnet of it.

    Returns
    -------
    dict of str to float
        Such as ``{"Q2.slope": 167.23, "Q2.intercept": 43.17}``.

    Examples
    --------
    >>> from beamfit.optics.elements import Quadrupole
    >>> calibration_numbers(Beamline((Quadrupole("Q", 0.1),), energy=100.0), "Q")
    {'Q.scale': 1.0}
    """
    calibration = line[magnet].calibration
    values = jax.tree_util.tree_leaves(calibration)
    return {
        f"{magnet}.{leaf.path}": float(value)
        for leaf, value in zip(leaves(calibration), values, strict=True)
    }


def usual_bounds(numbers: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Bounds of the numbers of one calibration that are free unless said otherwise.

    Slope (or scale, or gradient per ampere) and offset, as wide in proportion to the slope as the
    report's: ± 12 % of the slope, and for the offset ± 12 % of what one ampere gives.

    Examples
    --------
    >>> found = usual_bounds({"Q2.slope": 167.23, "Q2.intercept": 43.17})
    >>> {name: (round(a, 2), round(b, 2)) for name, (a, b) in found.items()}
    {'Q2.slope': (147.23, 187.23), 'Q2.intercept': (23.17, 63.17)}
    """
    words = {name.split(".", 1)[1] if "." in name else name: name for name in numbers}
    kinds = {name: _kind(name) for name in words.values()}
    steep = next((numbers[n] for n, k in kinds.items() if k == "slope"), 1.0)
    reach = WIDTH * abs(steep)
    return {n: (numbers[n] - reach, numbers[n] + reach) for n, k in kinds.items() if k != "higher"}


def _kind(name: str) -> str:
    """Whether a number is a slope, an offset or of higher order."""
    if name.endswith(OFFSETS):
        return "offset"
    return "slope" if name.endswith(("slope", "scale", "coefficients.1")) else "higher"


def calibration_problem(seen: Seen, told: Assumptions) -> Problem:
    """State the problem: beams and calibrations free, all planes together.

    Parameters
    ----------
    seen : Seen
        The scan.
    told : Assumptions
        Priors and bounds. Naming a number of a magnet that was not scanned frees it too.

    Returns
    -------
    Problem

    Raises
    ------
    InputError
        If a prior or bound names no calibration number of the line.
    """
    line = seen.scanned
    known = {n: v for m in line.magnets for n, v in calibration_numbers(line, m).items()}
    named = [*told.priors, *told.bounds]
    for name in named:
        if name not in known:
            raise InputError(f"a prior or bounds on '{name}'", nearest(name, list(known)))
    varied = varied_magnets(seen)
    usual: dict[str, tuple[float, float]] = {}
    for magnet in line.magnets:
        own = calibration_numbers(line, magnet)
        bounds = usual_bounds(own)
        usual |= {
            n: bounds.get(n, (v - WIDTH * abs(v) - 1e-3, v + WIDTH * abs(v) + 1e-3))
            for n, v in own.items()
            if (magnet in varied and n in bounds) or n in named
        }
    magnets = dict.fromkeys(_magnet_of(name, line) for name in usual)
    beams = beam_numbers(seen)
    free = beam_free(beams)
    for name, (low, high) in usual.items():
        if name in told.priors:
            mean, sd = told.priors[name]
            low, high = min(low, mean - 6 * sd), max(high, mean + 6 * sd)
        low, high = told.bounds.get(name, (low, high))
        free.append(Free(name, low, high))
    return Problem(
        {"beam": beams} | {name: line[name].calibration for name in magnets},
        free,
        [size_record(seen, plane, plane_rows(seen, plane)) for plane in seen.planes],
        [Prior(name, *told.priors[name]) for name in told.priors],
    )


def _magnet_of(name: str, line: Beamline) -> str:
    """The magnet a calibration number belongs to; names may hold dots themselves."""
    return next(m for m in line.magnets if name in calibration_numbers(line, m))


def with_numbers(line: Beamline, numbers: Mapping[str, float]) -> Beamline:
    """Put calibration numbers into a line.

    Parameters
    ----------
    line : Beamline
        The line.
    numbers : mapping of str to float
        Such as ``{"Q2.slope": 160.0}``.

    Returns
    -------
    Beamline

    Raises
    ------
    InputError
        If the line has no such number.

    Examples
    --------
    >>> from beamfit.optics.elements import Quadrupole
    >>> line = Beamline((Quadrupole("Q", 0.1),), energy=100.0)
    >>> float(with_numbers(line, {"Q.scale": 1.1})["Q"].calibration.scale)
    1.1
    """
    known = {n: v for m in line.magnets for n, v in calibration_numbers(line, m).items()}
    for name in numbers:
        if name not in known:
            raise InputError(f"a calibration number '{name}'", nearest(name, list(known)))
    for magnet in line.magnets:
        own = calibration_numbers(line, magnet)
        if set(own) & set(numbers):
            old = line[magnet]
            leaves_, structure = jax.tree_util.tree_flatten(old.calibration)
            values = [numbers.get(name, v) for name, v in zip(own, leaves_, strict=True)]
            new = jax.tree_util.tree_unflatten(structure, values)
            line = line.with_element(replace(old, calibration=new))
    return line
