"""Targets at a screen, the beams to reach them, and checks of both."""

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
# Energies within this share count as equal: settings of magnets are known no better.
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
        Target value; None for a match to the lattice's own design.

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
        Shape (3, 3), with errors scaled as those of the fit; None if unknown.
    calibration : mapping of str to float
        Calibration parameters fitted together with the beam, such as "Q2.slope".
    energy : float or None
        Total energy of the measurement, MeV; None for the line's.
    doubt : str or None
        Reason why a fit does not determine the beam; None if it does.
    line : str or None
        Digest of the line of the fit (`Beamline.digest`), to be compared with that of the search.

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


def common_energy(beams: Mapping[str, Beam], energy: float | None = None) -> float | None:
    """Energy at which the beams were measured, MeV; None if they have none.

    A beam matrix in geometric units is valid at its own energy only.

    Raises
    ------
    InputError
        If they, or the given energy, differ by more than 0.1 %.

    Examples
    --------
    >>> common_energy({"x": Beam(np.array([1e-8, 0.0, 1e-8]), energy=25.0)})
    25.0
    """
    found = {f"plane {p}": b.energy for p, b in beams.items() if b.energy is not None}
    given = found if energy is None else found | {"--energy": energy}
    if found and max(given.values()) - min(given.values()) > SAME_ENERGY * min(given.values()):
        listed = ", ".join(f"{e:g} MeV ({name})" for name, e in given.items())
        raise InputError(f"energies {listed}", "one energy for beam and line")
    return next(iter(found.values()), None)


def resolve_targets(
    line: Beamline, targets: Sequence[Target], screen: str | None
) -> tuple[tuple[Target, ...], str | None]:
    """Replace matches without a value by the line's design, and choose the place of the targets.

    The place is that of the design if all targets are such matches and no screen is given.

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
    """Design β (m) and α of a line in one plane."""
    twiss = getattr(line.design, plane, None)
    if twiss is None:
        raise InputError(
            f"--target match in plane {plane} of a lattice without design Twiss",
            "match=BETA_M:ALPHA, or a table [design] in the lattice",
        )
    return twiss


def check_targets(
    line: Beamline,
    beams: Mapping[str, Beam],
    vary: Mapping[str, tuple[float, float]],
    targets: Sequence[Target],
    screen: str | None,
) -> str:
    """Check names, limits, targets and beams; return the given screen or the line's last.

    Raises
    ------
    InputError
        If one of them cannot be used.
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
    downstream = [n for n in vary if names.index(line.members(n)[0]) > names.index(place)]
    if downstream:
        raise InputError(
            f"{downstream[0]}, downstream of {place}", "magnets between start and screen"
        )
    for target in targets:
        _check_target(beams, target)
    for plane, beam in beams.items():
        check_beam(plane, beam.sigma)
        if beam.line not in (None, line.digest):
            raise InputError(
                f"a beam in plane {plane} that was fitted in another line than '{line.name}'",
                "the lattice of that fit, or a fit in this one: a beam holds where its line begins",
            )
    return place


def check_limits(line: Beamline, limits: Mapping[str, tuple[float, float]]) -> None:
    """Raise an error for unknown magnets, and for limits that are not finite or not in order."""
    for name, (low, high) in limits.items():
        if name not in line.magnets:
            raise InputError(f"no magnet '{name}' in the line", nearest(name, list(line.magnets)))
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f"limits {low:g}:{high:g} of {name}", "finite limits, lower first")


def _check_target(beams: Mapping[str, Beam], target: Target) -> None:
    """Raise an error for an unknown kind or plane, and for an impossible value."""
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
        found = f"target match with alpha = {alpha[0]:g} in plane {target.plane}"
        raise InputError(found, "a finite alpha")


def check_beam(plane: str, sigma: np.ndarray) -> None:
    """Raise an error for a matrix that is not positive definite, or not in SI units."""
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
