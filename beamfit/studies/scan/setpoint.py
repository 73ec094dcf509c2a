"""The best magnet settings for a wanted beam at the screen (report Appendix D)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.greybox.many_starts import descend_all
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS
from beamfit.quantity import Quantity, Status
from beamfit.studies.scan.setpoint_checks import checked_place

__all__ = ["Beam", "Minimum", "PlaneBeam", "Setpoint", "Target", "find_setpoint"]

# Starts of the search: enough for the handful of minima a few magnets have.
STARTS = 256
# Two end points are one minimum if they differ by less than this share of the range.
SAME = 1e-3


class Target(NamedTuple):
    """What is wanted at the screen in one plane.

    Attributes
    ----------
    kind : str
        "size" (value in m), "divergence" (rad), or "match" to a design (β in m, α).
    plane : str
        "x" or "y".
    value : float or tuple of float
        The wanted value.
    """

    kind: str
    plane: str
    value: Any


class Beam(NamedTuple):
    """σ11 (m²), σ12 (m rad), σ22 (rad²) of a plane at the start, and their covariance or None."""

    sigma: np.ndarray
    covariance: np.ndarray | None = None


class PlaneBeam(NamedTuple):
    """The beam predicted at the screen in one plane."""

    plane: str
    size: Quantity
    divergence: Quantity
    beta: Quantity
    alpha: Quantity


class Minimum(NamedTuple):
    """Settings at which the objective has a minimum, and its value there."""

    settings: dict[str, float]
    objective: float


@dataclass(frozen=True)
class Setpoint:
    """The best settings, what they give, and how sure that is.

    Attributes
    ----------
    status : Status
        ``converged``, or ``at_limit`` if a setting ends on a limit.
    message : str
        In a sentence or two.
    best : Minimum
        The best settings.
    others : tuple of Minimum
        Further local minima, best first.
    setting_error : dict of str to float or None
        How far the best setting moves with one standard deviation of the beam.
    limits : tuple of str
        Magnets whose setting ends on a limit.
    screen : str
        Where.
    predicted : tuple of PlaneBeam
        The beam there, with the beam's uncertainty carried along.
    targets : tuple of Target
        What was wanted.
    units : dict of str to str
        Of the settings.
    energy : float
        Total energy of the beam, MeV.
    """

    status: Status
    message: str
    best: Minimum
    others: tuple[Minimum, ...]
    setting_error: dict[str, float | None]
    limits: tuple[str, ...]
    screen: str
    predicted: tuple[PlaneBeam, ...]
    targets: tuple[Target, ...]
    units: dict[str, str]
    energy: float

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract; size and so on of the first plane."""
        planes = {p.plane: {k: getattr(p, k).to_json() for k in p._fields[1:]}
                  for p in self.predicted}  # fmt: skip
        return {
            "status": str(self.status),
            "message": self.message,
            "settings": self.best.settings,
            "units": self.units,
            "setting_errors": self.setting_error,
            "objective": self.best.objective,
            "screen": self.screen,
            "energy": Quantity(self.energy, None, "MeV").to_json(),
            **planes[self.targets[0].plane],
            "planes": planes,
            "targets": [t._asdict() for t in self.targets],
            "other_minima": [m._asdict() for m in self.others],
            "at_limit": list(self.limits),
        }


@tree.node("names", "place", "planes", "targets")
class _Search:
    """The data of a search: what is varied, where the beam is asked for, what is wanted."""

    names: tuple[str, ...]
    place: str
    planes: tuple[str, ...]
    targets: tuple[Target, ...]
    line: Any
    sigma: Any
    middle: Any
    reach: Any


def find_setpoint(
    line: Beamline,
    beams: Mapping[str, Beam],
    vary: Mapping[str, tuple[float, float]],
    targets: Sequence[Target],
    *,
    screen: str | None = None,
    seed: int = 0,
) -> Setpoint:
    """Find the settings that bring the beam nearest to what is wanted.

    Parameters
    ----------
    line : Beamline
        From where the beam matrix is known to the screen.
    beams : mapping of str to Beam
        Plane to beam at the start.
    vary : mapping of str to (float, float)
        Magnet to its limits, in the unit of its calibration. The others stay as the line has them.
    targets : sequence of Target
        What is wanted. The objective is the sum of (size - target)² in µm² and (divergence -
        target)² in µrad² (Appendix D), and of BMAG - 1 for a match.
    screen : str, optional
        Where; the line's last screen if None.
    seed : int
        Of the starts.

    Returns
    -------
    Setpoint
        The lowest of the minima found from 256 starts that fill the box.

    Raises
    ------
    InputError
        If a magnet, screen or plane is unknown, limits are reversed, or nothing is wanted.

    Notes
    -----
    The predicted beam has the error that the beam matrix gives it at fixed settings. The best
    setting I of a beam σ has ∂f/∂I(I, σ) = 0, so it moves by -(∂²f/∂I²)⁻¹ ∂²f/∂I∂σ dσ; that is its
    error.

    Examples
    --------
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), energy=135.0)
    >>> beam = Beam(np.array([4e-8, 0.0, 1e-10]))
    >>> found = find_setpoint(line, {"x": beam}, {"Q": (0.0, 20.0)}, [Target("size", "x", 1e-4)])
    >>> round(1e6 * found.predicted[0].size.value, 3), len(found.others)
    (100.0, 1)
    """
    screen = checked_place(line, beams, vary, targets, screen)
    low, high = (np.array([v[i] for v in vary.values()], float) for i in (0, 1))
    middle, reach = 0.5 * (low + high), 0.5 * (high - low)
    planes = tuple(dict.fromkeys(t.plane for t in targets))
    sigma = {p: jnp.asarray(beams[p].sigma, float) for p in planes}
    search = _Search(
        tuple(vary), screen, planes, tuple(targets), line.condensed((*vary, screen), line.energy),
        sigma, jnp.asarray(middle), jnp.asarray(reach),
    )  # fmt: skip
    one = jnp.ones(len(vary))
    found = descend_all(_residual, search, jnp.asarray(_starts(len(vary), seed)), -one, one)
    settled = np.where(np.asarray(found.rested), 2.0 * np.asarray(found.cost), np.inf)
    if not np.isfinite(settled).any():
        raise InputError("a beam that no setting within the limits can carry", "other limits")
    minima = _distinct(np.asarray(found.theta), settled)
    best = minima[0][0]
    listed = [
        Minimum(dict(zip(vary, map(float, middle + reach * t), strict=True)), f) for t, f in minima
    ]
    edge = np.abs(best) >= 1.0 - 1e-9
    limits = tuple(n for n, e in zip(vary, edge, strict=True) if e)
    predicted = tuple(_predicted(search, p, beams[p], best) for p in planes)
    status = Status.at_limit if limits else Status.converged
    errors = _setting_errors(search, beams, best, edge)
    units = {name: SETTING_UNITS[line[name].calibration.unit] for name in vary}
    words = _words(listed, limits, predicted, targets, units)
    return Setpoint(
        status, words, listed[0], tuple(listed[1:]), errors, limits, screen, predicted,
        tuple(targets), units, float(line.energy),
    )  # fmt: skip


def _starts(count: int, seed: int) -> np.ndarray:
    """Points that fill the box -1..1: evenly for one magnet, stratified for several."""
    even = (np.arange(STARTS) + 0.5) / STARTS * 2.0 - 1.0
    random = np.random.default_rng(seed)
    return np.stack([even, *(random.permutation(even) for _ in range(count - 1))], -1)


def _at_screen(search: _Search, theta: Array) -> dict[str, Array]:
    """σ11, σ12, σ22 at the place, by plane."""
    settings = dict(zip(search.names, search.middle + search.reach * theta, strict=True))
    matrix = search.line.matrices((search.place,), settings)[search.place]
    found = {}
    for plane in search.planes:
        r = getattr(matrix, plane)[:2, :2]
        s11, s12, s22 = search.sigma[plane]
        m = r @ jnp.stack([jnp.stack([s11, s12]), jnp.stack([s12, s22])]) @ r.T
        found[plane] = jnp.stack([m[0, 0], m[0, 1], m[1, 1]])
    return found


def _residual(search: _Search, theta: Array) -> Array:
    """Misses of the targets: µm, µrad, and the two whose squares add to BMAG - 1."""
    at, parts = _at_screen(search, theta), []
    for target in search.targets:
        s11, s12, s22 = at[target.plane]
        if target.kind == "size":
            parts.append(1e6 * (jnp.sqrt(s11) - target.value))
        elif target.kind == "divergence":
            parts.append(1e6 * (jnp.sqrt(s22) - target.value))
        else:
            beta, alpha = target.value
            emittance = jnp.sqrt(s11 * s22 - s12**2)
            ratio = jnp.sqrt(s11 / emittance / beta)
            parts.append((ratio - 1.0 / ratio) / math.sqrt(2.0))
            parts.append((ratio * alpha + s12 / emittance / ratio) / math.sqrt(2.0))
    return jnp.stack(parts)


def _distinct(theta: np.ndarray, objective: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """End points that are different minima, best first; wherever a search got stuck is dropped."""
    kept: list[tuple[np.ndarray, float]] = []
    for i in np.argsort(objective, kind="stable"):
        if not np.isfinite(objective[i]):
            continue
        if all(np.abs(theta[i] - t).max() > 2.0 * SAME for t, _ in kept):
            kept.append((theta[i], float(objective[i])))
        if len(kept) == 10:
            break
    return kept


@jax.jit
def _screen_numbers(search: _Search, theta: Array) -> Array:
    """Size, divergence, β, α at the place, one row a plane."""
    rows = []
    for s11, s12, s22 in _at_screen(search, theta).values():
        emittance = jnp.sqrt(s11 * s22 - s12**2)
        rows.append(jnp.stack([jnp.sqrt(s11), jnp.sqrt(s22), s11 / emittance, -s12 / emittance]))
    return jnp.stack(rows)


def _with_sigma(search: _Search, sigma: Any) -> _Search:
    return _Search(
        search.names, search.place, search.planes, search.targets, search.line, sigma,
        search.middle, search.reach,
    )  # fmt: skip


def _predicted(search: _Search, plane: str, beam: Beam, theta: np.ndarray) -> PlaneBeam:
    row = search.planes.index(plane)

    def of_sigma(s: Array) -> Array:
        return _screen_numbers(_with_sigma(search, {**search.sigma, plane: s}), theta)[row]

    value = np.asarray(of_sigma(search.sigma[plane]))
    error: list[float | None] = [None] * 4
    if beam.covariance is not None and np.isfinite(beam.covariance).all():
        slope = np.asarray(jax.jacfwd(of_sigma)(search.sigma[plane]))
        variance = np.einsum("ij,jk,ik->i", slope, beam.covariance, slope)
        error = [float(v) for v in np.sqrt(np.maximum(variance, 0.0))]
    units = ("m", "rad", "m", "1")
    return PlaneBeam(
        plane, *(Quantity(float(v), e, u) for v, e, u in zip(value, error, units, strict=True))
    )


@partial(jax.jit)
def _curvature(search: _Search, theta: Array) -> tuple[Array, Any]:
    """Second derivatives of the objective by settings, and by settings and beam."""

    def objective(t, sigma):
        r = _residual(_with_sigma(search, sigma), t)
        return r @ r

    slope = jax.grad(objective)
    return jax.jacfwd(slope)(theta, search.sigma), jax.jacfwd(slope, 1)(theta, search.sigma)


def _setting_errors(search, beams, theta, edge) -> dict[str, float | None]:
    """Error of each best setting due to the beam; None at a limit or without a covariance."""
    none = dict.fromkeys(search.names)
    known = all(
        beams[p].covariance is not None and np.isfinite(beams[p].covariance).all()
        for p in search.planes
    )
    if not known or edge.all():
        return none
    second, mixed = _curvature(search, jnp.asarray(theta))
    loose = np.flatnonzero(~edge)
    second = np.asarray(second)[np.ix_(loose, loose)]
    if np.linalg.cond(second) > 1e12:
        return none
    variance = np.zeros(len(loose))
    for plane in search.planes:
        moved = -np.linalg.solve(second, np.asarray(mixed[plane])[loose])
        variance += np.einsum("ij,jk,ik->i", moved, beams[plane].covariance, moved)
    found = np.sqrt(np.maximum(variance, 0.0)) * np.asarray(search.reach)[loose]
    return none | {search.names[i]: float(e) for i, e in zip(loose, found, strict=True)}


def _words(minima, limits, predicted, targets, units) -> str:
    """A sentence on how well the wish is met, one on limits, one on other minima."""
    by_plane = {p.plane: p for p in predicted}
    said = []
    for t in targets:
        if t.kind == "match":
            continue
        said.append(f"{t.kind} {t.plane} {_micro(t, getattr(by_plane[t.plane], t.kind))}")
    words = "; ".join(said) or f"BMAG - 1 = {minima[0].objective:.3g} over the planes asked for"
    words = words[0].upper() + words[1:] + "."
    if limits:
        words += f" {', '.join(limits)} at a limit: a wider one would do better."
    if len(minima) > 1:
        other = minima[1]
        at = ", ".join(f"{n} = {v:.4g} {units[n]}" for n, v in other.settings.items())
        alike = other.objective - minima[0].objective < 1e-6 * (1.0 + minima[0].objective)
        lead = "Other settings do as well, such as" if alike else "The next local minimum is"
        words += f" {lead} {at} (objective {other.objective:.6g})."
    return words


def _micro(target: Target, got: Quantity) -> str:
    unit = "µm" if target.kind == "size" else "µrad"
    error = "" if got.error is None else f" ± {1e6 * got.error:.2g}"
    return f"{1e6 * got.value:.4g}{error} {unit} for {1e6 * target.value:.4g} wanted"
