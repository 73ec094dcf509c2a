"""Best magnet settings for a target beam at the screen (report Appendix D)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag
from scipy.stats import qmc

from beamfit.answer import Table, answer, cell, json_of
from beamfit.arrays import padded_length
from beamfit.compile_cache import SELDOM
from beamfit.emittance.calibration import with_numbers
from beamfit.emittance.results import in_words
from beamfit.emittance.scan import PLANES
from beamfit.emittance.targets import (
    KINDS,
    SAME_ENERGY,
    Beam,
    Target,
    check_targets,
    common_energy,
    resolve_targets,
)
from beamfit.emittance.transport import setting_units
from beamfit.errors import Finding, InputError, Status
from beamfit.greybox import tree
from beamfit.greybox.descend import Found, descend_all
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import TOLERANCE, Free, Problem, Record, residual
from beamfit.greybox.solve import search, solve
from beamfit.optics.beamline import Beamline
from beamfit.quantity import Quantity

# Starts of the search: enough for the minima of a few magnets. With more magnets than the last
# number, no number of starts covers the box, but targets can usually be met in many ways.
STARTS, MANY_MAGNET_STARTS, MANY_MAGNETS = 256, 64, 8
# Steps of each descent at most, and its tolerance; the lowest end point is then refined.
MAX_STEPS, STEP_TOLERANCE = 300, 1e-10
# Two end points are one minimum if all settings differ by less than this share of their range.
SETTING_TOLERANCE = 1e-3
MAX_MINIMA = 10
# A target is met within 2 %: the usual error of a measured size, or growth by a mismatch.
MAX_MISS = 0.02
# Objectives below this are zero but for rounding, in µm², µrad² or BMAG - 1.
ZERO_OBJECTIVE = 1e-9
# Factor and unit in which each predicted quantity is shown.
DISPLAY_UNITS = {
    "size": (1e6, " µm"),
    "divergence": (1e6, " µrad"),
    "beta": (1.0, " m"),
    "alpha": (1.0, ""),
}
CALIBRATION_NOTE = (
    "The beam was fitted together with the calibration, and only the beam's covariance is in the "
    "file: the two are correlated, and without that the errors here are too large, on the GTF line "
    "1.2 to 4.6 times."
)


class PlaneBeam(NamedTuple):
    """The beam predicted at the screen in one plane."""

    plane: str
    size: Quantity
    divergence: Quantity
    beta: Quantity
    alpha: Quantity


class Minimum(NamedTuple):
    """Settings at a local minimum of the objective, and its value."""

    settings: dict[str, float]
    objective: float


@answer
@dataclass(frozen=True)
class Setpoint:
    """Best settings found, the predicted beam, and its errors.

    Attributes
    ----------
    status : Status
        ``converged`` if the target is met; ``at_limit`` if a limit keeps it from being met better;
        ``infeasible`` if no setting near by comes closer; ``not_converged`` if the search found no
        optimum.
    message : str
        The beam reached, what limits it, and what to do.
    best : Minimum
        Settings of the lowest objective found.
    others : tuple of Minimum
        Further local minima, best first.
    setting_error : dict of str to float or None
        Change of the best setting by one standard deviation of the beam.
    limits : tuple of str
        Magnets whose setting is at a limit.
    screen : str
        Place of the targets.
    predicted : tuple of PlaneBeam
        The beam there, with the errors of the given beam propagated.
    targets : tuple of Target
        The targets.
    units : dict of str to str
        Units of the settings.
    energy : float
        Total energy of the beam, MeV.
    line : str
        Name of the line.
    notes : tuple of str
        Remarks on the beam and its errors.
    doubts : dict of str to str
        A warning for each plane whose beam the fit does not determine.
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
    line: str
    notes: tuple[str, ...]
    doubts: Mapping[str, str]

    @property
    def headline(self) -> str:
        """The settings found, in one line."""
        return f"{cell(self.status)}: {in_words(self.best.settings, self.units)}"

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract; size and so on of the first plane."""
        planes = {p.plane: {k: getattr(p, k) for k in DISPLAY_UNITS} for p in self.predicted}
        found = {
            "status": self.status,
            "message": " ".join([self.message, *self.notes, *self.doubts.values()]),
            "settings": self.best.settings,
            "units": self.units,
            "setting_errors": self.setting_error,
            "objective": self.best.objective,
            "screen": self.screen,
            "energy": Quantity(self.energy, None, "MeV"),
            **planes[self.targets[0].plane],
            "planes": planes,
            "targets": self.targets,
            "other_minima": self.others,
            "at_limit": self.limits,
            "beam_undetermined": list(self.doubts),
        }
        return json_of(found)

    def tables(self) -> tuple[Table, ...]:
        """Table of the settings and the predicted beam, and one of the other minima if any."""
        rows = []
        for name, value in self.best.settings.items():
            unit, error = self.units[name], self.setting_error[name]
            error_text = "-" if error is None else f"{error:.2g} {unit}"
            rows.append([name, f"{value:.6g} {unit}", error_text])
        rows.append(["objective", _objective_text(self.best.objective)])
        for p in self.predicted:
            rows += [
                [f"{key} {p.plane}", _quantity_text(key, getattr(p, key))] for key in DISPLAY_UNITS
            ]
        title = f"Best settings of {self.line} for the beam at {self.screen}"
        best = Table(title, ["", "setting", "± from the beam"], rows)
        others = [
            [f"  {in_words(m.settings, self.units, 5)}: objective {_objective_text(m.objective)}"]
            for m in self.others[:5]
        ]
        return (best, Table("Other minima", [], others)) if others else (best,)


def _objective_text(objective: float) -> str:
    """Write an objective; below the rounding error of the search it is zero."""
    return f"{objective:.6g}" if objective >= ZERO_OBJECTIVE else "0"


@tree.node("names")
class _TargetData:
    """Data of a search: magnets, line, targets and beams.

    Targets have `kinds`, `planes`, shape (targets,), `values` (targets, 2) and `weight` (targets,
    1), padded to a length that searches share. `middle` and `reach`, shape (magnets,), are middle
    and half width of the limits; `sigma` is (2, 3).
    """

    names: tuple[str, ...]
    line: Any
    kinds: Any
    planes: Any
    values: Any
    weight: Any
    middle: Any
    reach: Any
    sigma: Any


def find_setpoint(
    line: Beamline,
    beams: Mapping[str, Beam],
    vary: Mapping[str, tuple[float, float]],
    targets: Sequence[Target],
    *,
    screen: str | None = None,
    seed: int = 0,
) -> Setpoint:
    """Find the settings that bring the beam closest to the targets.

    Parameters
    ----------
    line : Beamline
        The line from the place of the beam matrix to the screen.
    beams : mapping of str to Beam
        Plane to beam at the start. A beam with an energy is transported at that energy, and a beam
        fitted with a calibration through the calibrated magnets.
    vary : mapping of str to (float, float)
        Magnet to its limits, in the unit of its calibration. Other magnets keep their settings.
    targets : sequence of Target
        The targets. The objective is the sum of (size - target)² in µm² and (divergence - target)²
        in µrad² (Appendix D), and of BMAG - 1 for a match.
    screen : str, optional
        Place of the targets; the line's last screen if None, or the place of its design for matches
        to that.
    seed : int
        Seed of the starts.

    Returns
    -------
    Setpoint
        The lowest of the minima found from 256 starts, or 64 for many magnets. Its status states
        whether the target is met, or else what prevents it.

    Raises
    ------
    InputError
        If a magnet, screen or plane is unknown, limits are reversed, there is no target, or beams
        have different energies.

    Notes
    -----
    The miss of a size is a vector: with R the transfer matrix, σ = L Lᵀ the beam at the start and v
    the first row of R L, the size is ``|v|`` and the miss ``(1 - target/|v|) v``. Its square is
    (size - target)². Where a target is out of reach, the linearised v still has the curvature that
    a linearised ``|v|`` lacks, so that Gauss-Newton converges there too.

    Errors of the predicted beam are those of the beam matrix at fixed settings. The best setting I
    for a beam σ has ∂f/∂I(I, σ) = 0, so a change dσ moves it by -(∂²f/∂I²)⁻¹ ∂²f/∂I∂σ dσ. This
    gives the setting errors.

    Examples
    --------
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), energy=135.0)
    >>> beam = Beam(np.array([4e-8, 0.0, 1e-10]))
    >>> found = find_setpoint(line, {"x": beam}, {"Q": (0.0, 20.0)}, [Target("size", "x", 1e-4)])
    >>> round(1e6 * found.predicted[0].size.value, 3), len(found.others)
    (100.0, 1)
    """
    targets, screen = resolve_targets(line, targets, screen)
    screen = check_targets(line, beams, vary, targets, screen)
    target_beams = {plane: beams[plane] for plane in dict.fromkeys(t.plane for t in targets)}
    energy = common_energy(target_beams)
    transport_line = line if energy is None else replace(line, energy=energy)
    for beam in beams.values():
        transport_line = with_numbers(transport_line, beam.calibration)
    transport_line = transport_line.upto(screen)
    condensed = transport_line.condensed((*vary, screen), transport_line.energy)
    data = _target_data(condensed, target_beams, vary, targets)
    minima, fit = _search(_problem_of(data), seed)
    units = setting_units(line, vary)
    found_minima = [Minimum(_settings(data, theta), value) for theta, value in minima]
    predicted = _predicted_beams(data, target_beams, fit.theta)
    misses = _relative_misses(data, targets, fit.theta)
    magnets = zip(vary, fit.variables, strict=True)
    # Magnets at a limit beyond which the objective would be lower.
    held_by_limit = [
        n for n, v in magnets if abs(v.value) == 1 and abs(v.reduced_gradient) > 1e-6 * fit.cost
    ]
    reached, optimum = _reached_sentence(targets, predicted, misses), fit.kkt.worst <= TOLERANCE
    verdict = _verdict(reached, misses, found_minima[0].objective, optimum, held_by_limit)
    return Setpoint(
        verdict.status,
        verdict.message + _next_sentence(found_minima, units),
        found_minima[0],
        tuple(found_minima[1:]),
        _setting_errors(data, target_beams, fit.theta),
        tuple(n for n, t in zip(vary, fit.theta, strict=True) if abs(t) == 1.0),
        screen,
        predicted,
        targets,
        units,
        float(transport_line.energy),
        line.name,
        _notes(target_beams, float(transport_line.energy), float(line.energy)),
        _doubts(target_beams),
    )


def _target_data(line, beams, vary, targets) -> _TargetData:
    """Collect the data of a search; `line` ends at the place of the targets."""
    low, high = np.array([*vary.values()], float).T
    size = padded_length(len(targets))
    padded = [*targets, *[targets[0]] * (size - len(targets))]
    other = next(iter(beams.values()))
    return _TargetData(
        tuple(vary),
        line,
        jnp.array([KINDS.index(t.kind) for t in padded]),
        jnp.array([PLANES.index(t.plane) for t in padded]),
        jnp.array([np.broadcast_to(t.value, 2) for t in padded], float),
        np.arange(size)[:, None] < len(targets),
        jnp.asarray(0.5 * (low + high)),
        jnp.asarray(0.5 * (high - low)),
        jnp.array([beams.get(plane, other).sigma for plane in PLANES], float),
    )


def _problem_of(data: _TargetData) -> Problem:
    """Problem of the search: settings scaled to -1 to 1, and misses with target zero."""
    zeros = np.zeros(data.values.shape)
    weight = np.broadcast_to(data.weight, zeros.shape)
    record = Record("targets", _misses, data, zeros, error=1.0, weight=weight)
    start = jnp.zeros(len(data.names))
    return Problem({"settings": start}, [Free("settings", -1.0, 1.0)], [record])


def _settings(data: _TargetData, theta) -> dict[str, float]:
    """Settings in the units of the magnets."""
    values = np.asarray(data.middle + data.reach * theta)
    return dict(zip(data.names, map(float, values), strict=True))


def _matrices(names: tuple[str, ...], line: Beamline, settings: Array) -> Array:
    """Transfer matrices of both planes, shape (2, 2, 2)."""
    return line.matrix(dict(zip(names, settings, strict=True))).planes[:, :2, :2]


# Derivatives of these eight numbers are taken in reverse mode, once for all directions. In forward
# mode they take three to five times as long with 31 magnets.
_matrices_reverse = jax.custom_jvp(_matrices, nondiff_argnums=(0,))


@_matrices_reverse.defjvp
def _matrices_slope(names, primals, tangents):
    line, settings = primals
    slope = jax.jacrev(_matrices, 2)(names, line, settings)
    return _matrices(names, line, settings), slope @ tangents[1]


def _transported_factor(data: _TargetData, theta: Array) -> Array:
    """R L of both planes, shape (2, 2, 2), with σ = L Lᵀ; rows are size and divergence."""
    matrix = _matrices_reverse if len(data.names) > MANY_MAGNETS else _matrices
    r = matrix(data.names, data.line, data.middle + data.reach * theta)
    l11 = jnp.sqrt(data.sigma[:, 0])
    l21 = data.sigma[:, 1] / l11
    l22 = jnp.sqrt(data.sigma[:, 2] - l21**2)
    columns = [jnp.stack([l11, l21], -1), jnp.stack([jnp.zeros_like(l22), l22], -1)]
    return r @ jnp.stack(columns, -1)


def _misses(model: Any, data: _TargetData) -> Array:
    """Miss of each target, shape (targets, 2); the objective is the sum of their squares.

    Misses of sizes (µm) and divergences (µrad) are vectors along their row of R L. Those of matches
    are two numbers, linear in R, whose squares add up to BMAG - 1. The order is that of KINDS.
    """
    rows = _transported_factor(data, model["settings"])

    def miss(kind, plane, value):
        vectors, (beta, alpha) = rows[plane], value
        along = 1e6 * (1.0 - beta / jnp.linalg.norm(vectors, axis=1))[:, None] * vectors
        # N = D⁻¹ R L/√ε is a rotation if the beam is matched; BMAG = |N|²/2 and det N = 1.
        inverse = jnp.array([[1.0, 0.0], [alpha, beta]]) / jnp.sqrt(beta)
        n = inverse @ vectors / jnp.sqrt(jnp.linalg.det(vectors))
        mismatch = jnp.stack([n[0, 0] - n[1, 1], n[0, 1] + n[1, 0]]) / math.sqrt(2.0)
        return jnp.concatenate([along, mismatch[None]])[kind]

    return jax.vmap(miss)(data.kinds, data.planes, data.values)


def _search(problem: Problem, seed: int) -> tuple[list[tuple[np.ndarray, float]], Fit]:
    """Descend from many starts that fill the box, then refine and assess the lowest minimum.

    Returns the minima, best first, and the fit of the best.
    """
    count = len(problem.names)
    starts = qmc.LatinHypercube(count, rng=seed).random(
        MANY_MAGNET_STARTS if count > MANY_MAGNETS else STARTS
    )
    found = descend_all(
        residual,
        problem.core,
        2.0 * starts - 1.0,
        problem.lower,
        problem.upper,
        MAX_STEPS,
        STEP_TOLERANCE,
    )
    found = Found(*map(np.asarray, found))
    ends, cost = found.theta, found.cost
    if not np.isfinite(cost).any():
        raise InputError("a beam that no setting within the limits can carry", "other limits")
    order = np.argsort(cost, kind="stable")
    fit = solve(replace(problem, model={"settings": ends[order[0]]}))
    minima = [(fit.theta, 2.0 * float(fit.cost))]
    for i in order[found.rested[order]]:
        if len(minima) == MAX_MINIMA:
            break
        if _is_new(ends[i], minima):
            _, end = search(problem, ends[i], MAX_STEPS)
            # End points of stuck searches are no minima; refined ones may be known already.
            if end.kkt.worst <= TOLERANCE and _is_new(end.theta, minima):
                minima.append((end.theta, 2.0 * end.cost))
    return minima, fit


def _is_new(theta: np.ndarray, minima: Sequence[tuple[np.ndarray, float]]) -> bool:
    """True if the settings differ from those of all minima found."""
    return all(np.abs(theta - other).max() > 2.0 * SETTING_TOLERANCE for other, _ in minima)


@partial(jax.jit, compiler_options=SELDOM)
def _numbers(data: _TargetData, theta: Array) -> tuple[Array, Array]:
    """Size, divergence, β and α of each plane, shape (planes, 4), and their derivatives by σ."""

    def numbers_of(sigma):
        v = _transported_factor(replace(data, sigma=sigma), theta)
        s = v @ jnp.swapaxes(v, -1, -2)
        s11, s12, s22, emittance = s[:, 0, 0], s[:, 0, 1], s[:, 1, 1], jnp.linalg.det(v)
        return jnp.stack([jnp.sqrt(s11), jnp.sqrt(s22), s11 / emittance, -s12 / emittance], -1)

    return numbers_of(data.sigma), jax.jacfwd(numbers_of)(data.sigma)


@partial(jax.jit, compiler_options=SELDOM)
def _curvature(data: _TargetData, theta: Array) -> Array:
    """Second derivatives of the objective with respect to settings and σ together."""
    size = len(data.names)

    def objective(settings_and_sigma):
        sigma = settings_and_sigma[size:].reshape(data.sigma.shape)
        misses = _misses({"settings": settings_and_sigma[:size]}, replace(data, sigma=sigma))
        return jnp.sum(data.weight * misses**2)

    settings_and_sigma = jnp.concatenate([theta, data.sigma.ravel()])
    return jax.jacfwd(jax.jacfwd(objective))(settings_and_sigma)


def _covariance(beam: Beam) -> np.ndarray | None:
    """Covariance of a beam, None if it is missing or not finite."""
    known = beam.covariance is not None and np.isfinite(beam.covariance).all()
    return beam.covariance if known else None


def _predicted_beams(
    data: _TargetData, beams: Mapping[str, Beam], theta: np.ndarray
) -> tuple[PlaneBeam, ...]:
    """Beam at the place of the targets, with its errors."""
    values, slopes = map(np.asarray, _numbers(data, jnp.asarray(theta)))
    found = []
    for plane, beam in beams.items():
        i, covariance = PLANES.index(plane), _covariance(beam)
        error: Sequence[float | None] = [None] * 4
        if covariance is not None:
            slope = slopes[i, :, i]
            error = np.sqrt(np.einsum("ij,jk,ik->i", slope, covariance, slope).clip(0)).tolist()
        parts = zip(values[i].tolist(), error, ("m", "rad", "m", "1"), strict=True)
        found.append(PlaneBeam(plane, *(Quantity(*part) for part in parts)))
    return tuple(found)


def _relative_misses(data: _TargetData, targets, theta: np.ndarray) -> tuple[float, ...]:
    """Relative miss of each target; BMAG - 1 of a match."""
    lengths = np.linalg.norm(_misses({"settings": jnp.asarray(theta)}, data), axis=1)
    pairs = zip(targets, lengths, strict=False)  # the rest is padding
    return tuple(float(m / (1e6 * t.value) if np.ndim(t.value) == 0 else m**2) for t, m in pairs)


def _setting_errors(
    data: _TargetData, beams: Mapping[str, Beam], theta: np.ndarray
) -> dict[str, float | None]:
    """Error of each best setting from that of the beam; None at a limit or without covariance."""
    errors: dict[str, float | None] = dict.fromkeys(data.names)
    covariances = [_covariance(beams[p]) if p in beams else np.zeros((3, 3)) for p in PLANES]
    free = np.flatnonzero(np.abs(theta) < 1.0)
    if any(c is None for c in covariances) or not free.size:
        return errors
    rows = np.asarray(_curvature(data, jnp.asarray(theta)))[free]
    second, mixed = rows[:, free], rows[:, len(theta) :]
    if np.linalg.cond(second) > 1e12:
        return errors
    slope = np.linalg.solve(second, mixed)
    variance = np.einsum("ij,jk,ik->i", slope, block_diag(*covariances), slope)
    found = np.sqrt(variance.clip(0)) * np.asarray(data.reach)[free]
    return errors | {data.names[i]: float(e) for i, e in zip(free, found, strict=True)}


def _verdict(
    reached: str,
    misses: Sequence[float],
    objective: float,
    optimum: bool,
    held_by_limit: Sequence[str],
) -> Finding:
    """Verdict from the reached beam in words, each miss, and the magnets held by a limit."""
    if objective < ZERO_OBJECTIVE:
        return Finding(Status.converged, reached)
    if not optimum:
        return Finding(
            Status.not_converged,
            f"{reached} That is the best point found, but the objective still falls there, or "
            "jumps as a magnet changes sign:",
            "narrow the limits around it, or search again with another seed.",
        )
    if held_by_limit:
        words = f"{reached} {', '.join(held_by_limit)} at a limit:"
        return Finding(Status.at_limit, words, "a wider one would do better.")
    if max(misses) <= MAX_MISS:
        return Finding(Status.converged, reached)
    why = "the targets contradict one another" if len(misses) > 1 else "the beam does not allow it"
    return Finding(
        Status.infeasible,
        f"{reached} That is the nearest found, and no limit holds it: {why}.",
        "Vary another magnet, or ask for less.",
    )


def _next_sentence(minima: Sequence[Minimum], units: Mapping[str, str]) -> str:
    """Sentence on the next minimum, if there is one."""
    if len(minima) < 2:
        return ""
    best, other = minima[:2]
    equal = other.objective - best.objective < 1e-6 * (1.0 + best.objective)
    lead = "Other settings do as well, such as" if equal else "The next local minimum is"
    at = in_words(other.settings, units)
    return f" {lead} {at} (objective {_objective_text(other.objective)})."


def _reached_sentence(
    targets: Sequence[Target], predicted: Sequence[PlaneBeam], misses: Sequence[float]
) -> str:
    """Sentence on each size and divergence reached, and on all matches together."""
    by_plane = {p.plane: p for p in predicted}
    is_size = [np.ndim(t.value) == 0 for t in targets]
    parts = [
        f"{t.kind} {t.plane} {_reached_text(t, getattr(by_plane[t.plane], t.kind))}"
        for t, single in zip(targets, is_size, strict=True)
        if single
    ]
    if not all(is_size):
        mismatch = sum(m for m, single in zip(misses, is_size, strict=True) if not single)
        parts.append(f"BMAG - 1 = {mismatch:.3g} over the planes asked for")
    words = "; ".join(parts)
    return words[0].upper() + words[1:] + "."


def _notes(beams: Mapping[str, Beam], energy: float, lattice: float) -> tuple[str, ...]:
    """Remarks on the beams, one sentence each.

    Parameters
    ----------
    beams : mapping of str to Beam
        Beams of the planes with targets.
    energy, lattice : float
        The energy used, and the line's own, MeV.
    """
    notes = []
    if abs(energy - lattice) > SAME_ENERGY * lattice:
        notes.append(f"At {energy:g} MeV, the energy of the scan; the lattice has {lattice:g} MeV.")
    if any(beam.calibration and beam.covariance is not None for beam in beams.values()):
        notes.append(CALIBRATION_NOTE)
    if all(beam.covariance is None and beam.doubt is None for beam in beams.values()):
        notes.append("No errors: pass --fit to include the beam's.")
    return tuple(notes)


def _doubts(beams: Mapping[str, Beam]) -> dict[str, str]:
    """Warnings on planes whose beam the fit does not determine."""
    return {
        plane: f"The fit does not determine the beam of plane {plane}: {beam.doubt.rstrip('.')}. "
        "The settings are for its numbers as they stand."
        for plane, beam in beams.items()
        if beam.doubt is not None
    }


def _reached_text(target: Target, quantity: Quantity) -> str:
    """Reached value, with its error, and target of a size or divergence."""
    factor, unit = DISPLAY_UNITS[target.kind]
    error = "" if quantity.error is None else f" ± {factor * quantity.error:.2g}"
    return f"{factor * quantity.value:.4g}{error}{unit} for {factor * target.value:.4g} wanted"


def _quantity_text(key: str, q: Quantity) -> str:
    """A predicted quantity in its display unit, with its error if there is one."""
    factor, unit = DISPLAY_UNITS[key]
    if q.error is None:
        return f"{factor * q.value:.5g}{unit}"
    return f"{Quantity(factor * q.value, factor * q.error, '1')}{unit}"
