"""Targets at a screen, the beams they are for, and what a search needs of both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.errors import InputError, expect, nearest

if TYPE_CHECKING:
    from beamfit.optics.beamline import Beamline

KINDS = ("size", "divergence", "match")
# Energies that differ by less than this share are one: a magnet's setting is known no better.
SAME_ENERGY = 1e-3


class Target(NamedTuple):
    """A target for the beam at the screen in one plane.

    Attributes
    ----------
    kind : str
        "size" (value in m), "divergence" (rad), or "match" to a design (β in m, α).
    plane : str
        "x" or "y".
    value : float, tuple of float, or None
        The wanted value; None for a match to the lattice's own design.

    Examples
    --------
    >>> Target("size", "x", 200e-6).value
    0.0002
    """

    kind: str
    plane: str
    value: Any = None


class Beam(NamedTuple):
    """The beam of a plane at the start of the line.

    Attributes
    ----------
    sigma : ndarray
        σ11 (m²), σ12 (m rad), σ22 (rad²).
    covariance : ndarray or None
        Shape (3, 3), scaled as the errors are; None where there is none.
    calibration : mapping of str to float
        Calibration numbers fitted together with it, such as "Q2.slope".
    energy : float or None
        Total energy at which it was measured, MeV; None for the line's.
    doubt : str or None
        Why a fit does not determine it; None if it does.
    line : str or None
        Digest of the line that it was fitted in (`Beamline.digest`), to be held against another.

    Examples
    --------
    >>> Beam(np.array([1e-8, 0.0, 1e-8]), energy=135.0).energy
    135.0
    """

    sigma: np.ndarray
    covariance: np.ndarray | None = None
    calibration: Mapping[str, float] = MappingProxyType({})
    energy: float | None = None
    doubt: str | None = None
    line: str | None = None


def common_energy(beams: Mapping[str, Beam], asked: float | None = None) -> float | None:
    """Give the energy the beams were measured at, MeV; None where they do not say.

    A beam matrix in geometric units holds at its own energy only.

    Raises
    ------
    InputError
        If they, or the energy asked for, differ by more than 0.1 %.

    Examples
    --------
    >>> common_energy({"x": Beam(np.array([1e-8, 0.0, 1e-8]), energy=25.0)})
    25.0
    """
    found = {f"plane {p}": b.energy for p, b in beams.items() if b.energy is not None}
    given = found if asked is None else found | {"--energy": asked}
    if found and max(given.values()) - min(given.values()) > SAME_ENERGY * min(given.values()):
        listed = ", ".join(f"{e:g} MeV ({name})" for name, e in given.items())
        raise InputError(f"energies {listed}", "one energy for beam and line")
    return next(iter(found.values()), None)


def resolved(
    line: Beamline, targets: Sequence[Target], screen: str | None
) -> tuple[tuple[Target, ...], str | None]:
    """Put the line's design into matches that name none, and its place where nothing else is asked.

    Raises
    ------
    InputError
        If the line has no design Twiss for such a match.
    """
    for target in targets:
        expect(target, Target, 'beamfit.Target("size", "x", 1e-4)')
    if screen is None and line.design and targets and all(t.value is None for t in targets):
        screen = line.design.at
    found = tuple(
        t._replace(value=_design(line, t.plane)) if t.kind == "match" and t.value is None else t
        for t in targets
    )
    return found, screen


def _design(line: Beamline, plane: str) -> tuple[float, float]:
    twiss = getattr(line.design, plane, None)
    if twiss is None:
        raise InputError(
            f"--target match in plane {plane} of a lattice without design Twiss",
            "match=BETA_M:ALPHA, or a table [design] in the lattice",
        )
    return twiss


def checked_place(
    line: Beamline,
    beams: Mapping[str, Beam],
    vary: Mapping[str, tuple[float, float]],
    targets: Sequence[Target],
    screen: str | None,
) -> str:
    """Refuse names and ranges that cannot be used; give the screen asked for, or the line's last.

    Raises
    ------
    InputError
        If something cannot be used.
    """
    expect(beams, Mapping, '{"x": beamfit.Beam(sigma)}')
    for beam in beams.values():
        expect(beam, Beam, "beamfit.Beam(sigma)")
    if not targets:
        raise InputError("no target", "a size, a divergence or a match")
    if not vary:
        raise InputError("no magnet to vary", f"some of {', '.join(line.magnets)}")
    check_limits(line, vary)
    if screen is None and not line.screens:
        raise InputError("a line without a screen", "a screen where the beam is wanted")
    place = line.screens[-1] if screen is None else screen
    names = [e.name for e in line.elements]
    if place not in names:
        raise InputError(f"no place '{place}' in the line", nearest(place, names))
    late = [n for n in vary if names.index(line.members(n)[0]) > names.index(place)]
    if late:
        raise InputError(f"{late[0]}, downstream of {place}", "magnets between start and screen")
    for target in targets:
        _check_target(beams, target)
    for plane, beam in beams.items():
        _check_beam(plane, beam.sigma)
        if beam.line not in (None, line.digest):
            raise InputError(
                f"a beam in plane {plane} that was fitted in another line than '{line.name}'",
                "the lattice of that fit, or a fit in this one: a beam holds where its line begins",
            )
    return place


def check_limits(line: Beamline, limits: Mapping[str, tuple[float, float]]) -> None:
    """Refuse limits of what is no magnet of the line, and such as no setting is within."""
    for name, (low, high) in limits.items():
        if name not in line.magnets:
            raise InputError(f"no magnet '{name}' in the line", nearest(name, list(line.magnets)))
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f"limits {low:g}:{high:g} of {name}", "finite limits, lower first")


def _check_target(beams: Mapping[str, Beam], target: Target) -> None:
    if target.kind not in KINDS:
        raise InputError(f"target '{target.kind}'", nearest(target.kind, list(KINDS)))
    if target.plane not in beams:
        raise InputError(
            f"a target in plane {target.plane}, whose beam is not given", "a beam matrix of it"
        )
    positive, *alpha = np.ravel(target.value)
    if not (math.isfinite(positive) and positive > 0):
        expected = "a positive number; no beam gets to zero, so ask for the smallest of use"
        raise InputError(f"target {target.kind} {positive:g}", expected)
    if not np.isfinite(alpha).all():
        said = f"target match with alpha = {alpha[0]:g} in plane {target.plane}"
        raise InputError(said, "a finite alpha")


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
