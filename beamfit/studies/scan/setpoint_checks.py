"""Whether a wish for a set point can be searched for at all."""

from __future__ import annotations

import math

import numpy as np

from beamfit.errors import InputError, nearest

__all__ = ["checked_place"]

KINDS = ("size", "divergence", "match")


def checked_place(line, beams, vary, targets, screen) -> str:
    """Refuse names and ranges of a set point that cannot be used, and name the screen.

    Parameters
    ----------
    line, beams, vary, targets, screen
        As for `beamfit.studies.scan.setpoint.find_setpoint`.

    Returns
    -------
    str
        The screen asked for, or the line's last.

    Raises
    ------
    InputError
        If something cannot be used.
    """
    if not targets:
        raise InputError("no target", "a size, a divergence or a match")
    if not vary:
        raise InputError("no magnet to vary", f"some of {', '.join(line.magnets)}")
    for name, (low, high) in vary.items():
        if name not in line.magnets:
            raise InputError(f"no magnet '{name}' in the line", nearest(name, list(line.magnets)))
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f"limits {low:g}:{high:g} of {name}", "finite limits, lower first")
    if screen is None and not line.screens:
        raise InputError("a line without a screen", "a screen where the beam is wanted")
    place = line.screens[-1] if screen is None else screen
    names = [e.name for e in line.elements]
    if place not in names:
        raise InputError(f"no place '{place}' in the line", nearest(place, names))
    late = [n for n in vary if names.index(n) > names.index(place)]
    if late:
        raise InputError(f"{late[0]}, downstream of {place}", "magnets between start and screen")
    _check_targets(beams, targets)
    for plane, beam in beams.items():
        _check_beam(plane, beam.sigma)
    return place


def _check_targets(beams, targets) -> None:
    for target in targets:
        if target.kind not in KINDS:
            raise InputError(f"target '{target.kind}'", nearest(target.kind, list(KINDS)))
        if target.plane not in beams:
            raise InputError(
                f"a target in plane {target.plane}, whose beam is not given", "a beam matrix of it"
            )
        positive = target.value[0] if target.kind == "match" else target.value
        if not (math.isfinite(positive) and positive > 0):
            raise InputError(f"target {target.kind} {positive:g}", "a positive number")
        if target.kind == "match" and not math.isfinite(target.value[1]):
            raise InputError(
                f"target match with alpha = {target.value[1]:g} in plane {target.plane}",
                "a finite alpha",
            )


def _check_beam(plane: str, sigma: np.ndarray) -> None:
    s11, s12, s22 = sigma
    if not (s11 > 0 and s11 * s22 > s12**2):
        raise InputError(
            f"sigma = {s11:g}, {s12:g}, {s22:g} in plane {plane}",
            "sigma11 > 0 and sigma11*sigma22 > sigma12**2: a positive definite matrix in SI",
        )
    if s11 > 1.0:
        raise InputError(
            f"sigma11 = {s11:g} m^2 in plane {plane}, a beam of {math.sqrt(s11):.2g} m",
            "SI units, such as 2.6e-8",
        )
