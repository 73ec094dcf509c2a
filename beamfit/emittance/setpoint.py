"""The best magnet settings for a wanted beam at the screen (report Appendix D)."""

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
    checked_place,
    common_energy,
    resolved,
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

# Starts of the search: enough for the minima that a few magnets have; no number fills the box of
# many magnets, whose targets can usually be met in many ways.
STARTS, FEW, MANY = 256, 64, 8
# Of each of them, and how sharp; the lowest goes on to the end.
STEPS, SHARP = 300, 1e-10
# Two end points are one minimum if they differ by less than this share of the range.
SAME = 1e-3
MOST_MINIMA = 10
# A target is met within the usual error of a measured size, or of the growth of a mismatch.
MET = 0.02
# What squares of a micrometre or a microradian, or BMAG - 1, come to by rounding.
EXACT = 1e-9
SHOWN = {
    "size": (1e6, " µm"),
    "divergence": (1e6, " µrad"),
    "beta": (1.0, " m"),
    "alpha": (1.0, ""),
}
CALIBRATED = (
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
    """Settings at which the objective has a minimum, and its value there."""

    settings: dict[str, float]
    objective: float


@answer
@dataclass(frozen=True)
class Setpoint:
    """The best settings found, what they give, and how sure that is.

    Attributes
    ----------
    status : Status
        ``converged`` where the target is met; ``at_limit`` where a limit keeps it from being met
        better; ``infeasible`` where no setting near by comes nearer; ``not_converged`` where the
        search came to no optimum.
    message : str
        What is reached, what holds it, and what to do.
    best : Minimum
        The best settings: always those of the lowest objective found.
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
    line : str
        Name of the line.
    notes : tuple of str
        What to know of the beam and its errors.
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
        """The settings found, in a line."""
        return f"{cell(self.status)}: {in_words(self.best.settings, self.units)}"

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract; size and so on of the first plane."""
        planes = {p.plane: {k: getattr(p, k) for k in SHOWN} for p in self.predicted}
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
        """Lay out the settings with what they give, and the other minima if there are any."""
        rows = []
        for name, value in self.best.settings.items():
            unit, error = self.units[name], self.setting_error[name]
            moved = "-" if error is None else f"{error:.2g} {unit}"
            rows.append([name, f"{value:.6g} {unit}", moved])
        rows.append(["objective", _written(self.best.objective)])
        for p in self.predicted:
            rows += [[f"{key} {p.plane}", _shown(key, getattr(p, key))] for key in SHOWN]
        title = f"Best settings of {self.line} for the beam at {self.screen}"
        best = Table(title, ["", "setting", "± from the beam"], rows)
        others = [
            [f"  {in_words(m.settings, self.units, 5)}: objective {_written(m.objective)}"]
            for m in self.others[:5]
        ]
        return (best, Table("Other minima", [], others)) if others else (best,)


def _written(objective: float) -> str:
    """Write an objective; below the rounding of the search all targets are met."""
    return f"{objective:.6g}" if objective >= EXACT else "0"


@tree.node("names")
class _Wanted:
    """The data of a search: magnets (by name), their line, the targets, the beams.

    Of the targets `kinds`, `planes`, shape (targets,), `values` (targets, 2), `weight` (targets,
    1), padded to a length that searches share; `middle` and `reach` (magnets,), `sigma` (2, 3).
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
    """Find the settings that bring the beam nearest to what is wanted.

    Parameters
    ----------
    line : Beamline
        From where the beam matrix is known to the screen.
    beams : mapping of str to Beam
        Plane to beam at the start. A beam that says at which energy it was measured is carried at
        that, and one that was fitted with a calibration meets it.
    vary : mapping of str to (float, float)
        Magnet to its limits, in the unit of its calibration. The others stay as the line has them.
    targets : sequence of Target
        What is wanted. The objective is the sum of (size - target)² in µm² and (divergence -
        target)² in µrad² (Appendix D), and of BMAG - 1 for a match.
    screen : str, optional
        Where; the line's last screen if None, or the place of its design for matches to that.
    seed : int
        Of the starts.

    Returns
    -------
    Setpoint
        The lowest of the minima found from 256 starts, of many magnets from 64. Its status says
        whether the target is met, and if not what keeps it from being met.

    Raises
    ------
    InputError
        If a magnet, screen or plane is unknown, limits are reversed, nothing is wanted, or beams
        are of different energies.

    Notes
    -----
    The miss of a size is stated as a vector: with R the transfer matrix, σ = L Lᵀ the beam at the
    start and v the first row of R L, the size is ``|v|`` and the miss ``(1 - target/|v|) v``. Its
    square is (size - target)², and where the target is out of reach the linear picture of v still
    has the curvature that that of ``|v|`` lacks, so that Gauss-Newton comes to rest there too.

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
    targets, screen = resolved(line, targets, screen)
    screen = checked_place(line, beams, vary, targets, screen)
    used = {plane: beams[plane] for plane in dict.fromkeys(t.plane for t in targets)}
    energy = common_energy(used)
    carrying = line if energy is None else replace(line, energy=energy)
    for beam in beams.values():
        carrying = with_numbers(carrying, beam.calibration)
    carrying = carrying.upto(screen)
    short = carrying.condensed((*vary, screen), carrying.energy)
    wanted = _wanted(short, used, vary, targets)
    minima, fit = _search(_stated(wanted), seed)
    units = setting_units(line, vary)
    listed = [Minimum(_settings(wanted, theta), value) for theta, value in minima]
    predicted = _predicted(wanted, used, fit.theta)
    misses = _relative_misses(wanted, targets, fit.theta)
    ends = zip(vary, fit.variables, strict=True)
    # A setting on its limit that would lower the objective by going on.
    held = [n for n, v in ends if abs(v.value) == 1 and abs(v.reduced_gradient) > 1e-6 * fit.cost]
    reached, optimum = _reached_words(targets, predicted, misses), fit.kkt.worst <= TOLERANCE
    found = _verdict(reached, misses, listed[0].objective, optimum, held)
    return Setpoint(
        found.status,
        found.message + _next_words(listed, units),
        listed[0],
        tuple(listed[1:]),
        _setting_errors(wanted, used, fit.theta),
        tuple(n for n, t in zip(vary, fit.theta, strict=True) if abs(t) == 1.0),
        screen,
        predicted,
        targets,
        units,
        float(carrying.energy),
        line.name,
        _notes_on(used, float(carrying.energy), float(line.energy)),
        _doubts_on(used),
    )


def _wanted(line, beams, vary, targets) -> _Wanted:
    """Gather the data of a search; `line` ends at the place."""
    low, high = np.array([*vary.values()], float).T
    size = padded_length(len(targets))
    padded = [*targets, *[targets[0]] * (size - len(targets))]
    other = next(iter(beams.values()))
    return _Wanted(
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


def _stated(wanted: _Wanted) -> Problem:
    """The search as a problem: settings from -1 to 1 between their limits, no miss "measured"."""
    none = np.zeros(wanted.values.shape)
    weight = np.broadcast_to(wanted.weight, none.shape)
    record = Record("targets", _misses, wanted, none, error=1.0, weight=weight)
    start = jnp.zeros(len(wanted.names))
    return Problem({"settings": start}, [Free("settings", -1.0, 1.0)], [record])


def _settings(wanted: _Wanted, theta) -> dict[str, float]:
    values = np.asarray(wanted.middle + wanted.reach * theta)
    return dict(zip(wanted.names, map(float, values), strict=True))


def _plain(names: tuple[str, ...], line: Beamline, settings: Array) -> Array:
    return line.matrix(dict(zip(names, settings, strict=True))).planes[:, :2, :2]


# The derivatives by many settings of these eight numbers are had backwards, and once for all
# directions: forwards they take three to five times as long with 31 magnets.
_through = jax.custom_jvp(_plain, nondiff_argnums=(0,))


@_through.defjvp
def _through_slope(names, primals, tangents):
    line, settings = primals
    slope = jax.jacrev(_plain, 2)(names, line, settings)
    return _plain(names, line, settings), slope @ tangents[1]


def _at_place(wanted: _Wanted, theta: Array) -> Array:
    """R L of both planes, shape (2, 2, 2), with σ = L Lᵀ: rows are size and divergence."""
    matrix = _through if len(wanted.names) > MANY else _plain
    r = matrix(wanted.names, wanted.line, wanted.middle + wanted.reach * theta)
    l11 = jnp.sqrt(wanted.sigma[:, 0])
    l21 = wanted.sigma[:, 1] / l11
    l22 = jnp.sqrt(wanted.sigma[:, 2] - l21**2)
    columns = [jnp.stack([l11, l21], -1), jnp.stack([jnp.zeros_like(l22), l22], -1)]
    return r @ jnp.stack(columns, -1)


def _misses(model: Any, wanted: _Wanted) -> Array:
    """Miss of every target, shape (targets, 2); the objective is the sum of their squares.

    Of sizes in µm and divergences in µrad, along the vector; of matches two numbers whose squares
    add to BMAG - 1, linear in R. In the order of KINDS.
    """
    at = _at_place(wanted, model["settings"])

    def miss(kind, plane, value):
        vectors, (beta, alpha) = at[plane], value
        far = 1e6 * (1.0 - beta / jnp.linalg.norm(vectors, axis=1))[:, None] * vectors
        # N = D⁻¹ R L/√ε is a rotation where the beam is matched; BMAG = |N|²/2 and det N = 1.
        inverse = jnp.array([[1.0, 0.0], [alpha, beta]]) / jnp.sqrt(beta)
        n = inverse @ vectors / jnp.sqrt(jnp.linalg.det(vectors))
        mismatch = jnp.stack([n[0, 0] - n[1, 1], n[0, 1] + n[1, 0]]) / math.sqrt(2.0)
        return jnp.concatenate([far, mismatch[None]])[kind]

    return jax.vmap(miss)(wanted.kinds, wanted.planes, wanted.values)


def _search(stated: Problem, seed: int) -> tuple[list[tuple[np.ndarray, float]], Fit]:
    """Descend from points that fill the box, and let the core go on from the lowest and judge it.

    Gives minima, best first, and the fit of the best.
    """
    count = len(stated.names)
    starts = qmc.LatinHypercube(count, rng=seed).random(FEW if count > MANY else STARTS)
    found = descend_all(
        residual, stated.core, 2.0 * starts - 1.0, stated.lower, stated.upper, STEPS, SHARP
    )
    found = Found(*map(np.asarray, found))
    ends, cost = found.theta, found.cost
    if not np.isfinite(cost).any():
        raise InputError("a beam that no setting within the limits can carry", "other limits")
    order = np.argsort(cost, kind="stable")
    fit = solve(replace(stated, model={"settings": ends[order[0]]}))
    minima = [(fit.theta, 2.0 * float(fit.cost))]
    for i in order[found.rested[order]]:
        if len(minima) == MOST_MINIMA:
            break
        if _apart(ends[i], minima):
            _, end = search(stated, ends[i], STEPS)
            # Where a search got stuck is no minimum, and one that it only now reaches may be known.
            if end.kkt.worst <= TOLERANCE and _apart(end.theta, minima):
                minima.append((end.theta, 2.0 * end.cost))
    return minima, fit


def _apart(theta: np.ndarray, minima: Sequence[tuple[np.ndarray, float]]) -> bool:
    """True if settings are none of those found."""
    return all(np.abs(theta - known).max() > 2.0 * SAME for known, _ in minima)


@partial(jax.jit, compiler_options=SELDOM)
def _numbers(wanted: _Wanted, theta: Array) -> tuple[Array, Array]:
    """Size, divergence, β and α of each plane, shape (planes, 4), and their slopes by σ."""

    def of_sigma(sigma):
        v = _at_place(replace(wanted, sigma=sigma), theta)
        s = v @ jnp.swapaxes(v, -1, -2)
        s11, s12, s22, emittance = s[:, 0, 0], s[:, 0, 1], s[:, 1, 1], jnp.linalg.det(v)
        return jnp.stack([jnp.sqrt(s11), jnp.sqrt(s22), s11 / emittance, -s12 / emittance], -1)

    return of_sigma(wanted.sigma), jax.jacfwd(of_sigma)(wanted.sigma)


@partial(jax.jit, compiler_options=SELDOM)
def _curvature(wanted: _Wanted, theta: Array) -> Array:
    """Second derivatives of the objective by settings and σ together."""
    size = len(wanted.names)

    def objective(both):
        sigma = both[size:].reshape(wanted.sigma.shape)
        misses = _misses({"settings": both[:size]}, replace(wanted, sigma=sigma))
        return jnp.sum(wanted.weight * misses**2)

    both = jnp.concatenate([theta, wanted.sigma.ravel()])
    return jax.jacfwd(jax.jacfwd(objective))(both)


def _covariance(beam: Beam) -> np.ndarray | None:
    known = beam.covariance is not None and np.isfinite(beam.covariance).all()
    return beam.covariance if known else None


def _predicted(
    wanted: _Wanted, beams: Mapping[str, Beam], theta: np.ndarray
) -> tuple[PlaneBeam, ...]:
    values, slopes = map(np.asarray, _numbers(wanted, jnp.asarray(theta)))
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


def _relative_misses(wanted: _Wanted, targets, theta: np.ndarray) -> tuple[float, ...]:
    """Distance of each target over what is wanted; BMAG - 1 of a match."""
    lengths = np.linalg.norm(_misses({"settings": jnp.asarray(theta)}, wanted), axis=1)
    pairs = zip(targets, lengths, strict=False)  # the rest is padding
    return tuple(float(m / (1e6 * t.value) if np.ndim(t.value) == 0 else m**2) for t, m in pairs)


def _setting_errors(
    wanted: _Wanted, beams: Mapping[str, Beam], theta: np.ndarray
) -> dict[str, float | None]:
    """Error of each best setting due to the beam; None at a limit or without a covariance."""
    errors: dict[str, float | None] = dict.fromkeys(wanted.names)
    covariances = [_covariance(beams[p]) if p in beams else np.zeros((3, 3)) for p in PLANES]
    loose = np.flatnonzero(np.abs(theta) < 1.0)
    if any(c is None for c in covariances) or not loose.size:
        return errors
    rows = np.asarray(_curvature(wanted, jnp.asarray(theta)))[loose]
    second, mixed = rows[:, loose], rows[:, len(theta) :]
    if np.linalg.cond(second) > 1e12:
        return errors
    moved = np.linalg.solve(second, mixed)
    variance = np.einsum("ij,jk,ik->i", moved, block_diag(*covariances), moved)
    found = np.sqrt(variance.clip(0)) * np.asarray(wanted.reach)[loose]
    return errors | {wanted.names[i]: float(e) for i, e in zip(loose, found, strict=True)}


def _verdict(
    reached: str, misses: Sequence[float], objective: float, optimum: bool, held: Sequence[str]
) -> Finding:
    """Judge the best point: what is reached in words, each miss, magnets that a limit holds."""
    if objective < EXACT:
        return Finding(Status.converged, reached)
    if not optimum:
        return Finding(
            Status.not_converged,
            f"{reached} That is the best point found, but the objective still falls there, or "
            "jumps as a magnet changes sign:",
            "narrow the limits around it, or search again with another seed.",
        )
    if held:
        said = f"{reached} {', '.join(held)} at a limit:"
        return Finding(Status.at_limit, said, "a wider one would do better.")
    if max(misses) <= MET:
        return Finding(Status.converged, reached)
    why = "the targets contradict one another" if len(misses) > 1 else "the beam does not allow it"
    return Finding(
        Status.infeasible,
        f"{reached} That is the nearest found, and no limit holds it: {why}.",
        "Vary another magnet, or ask for less.",
    )


def _next_words(minima: Sequence[Minimum], units: Mapping[str, str]) -> str:
    """Name the next minimum, if there is one."""
    if len(minima) < 2:
        return ""
    best, other = minima[:2]
    alike = other.objective - best.objective < 1e-6 * (1.0 + best.objective)
    lead = "Other settings do as well, such as" if alike else "The next local minimum is"
    at = in_words(other.settings, units)
    return f" {lead} {at} (objective {_written(other.objective)})."


def _reached_words(
    targets: Sequence[Target], predicted: Sequence[PlaneBeam], misses: Sequence[float]
) -> str:
    """Say what is reached of each size and divergence, and of the matches together."""
    by_plane = {p.plane: p for p in predicted}
    alone = [np.ndim(t.value) == 0 for t in targets]
    said = [
        f"{t.kind} {t.plane} {_micro(t, getattr(by_plane[t.plane], t.kind))}"
        for t, own in zip(targets, alone, strict=True)
        if own
    ]
    if not all(alone):
        mismatch = sum(m for m, own in zip(misses, alone, strict=True) if not own)
        said.append(f"BMAG - 1 = {mismatch:.3g} over the planes asked for")
    words = "; ".join(said)
    return words[0].upper() + words[1:] + "."


def _notes_on(beams: Mapping[str, Beam], energy: float, lattice: float) -> tuple[str, ...]:
    """Say what to know of the beams, one sentence each.

    Parameters
    ----------
    beams : mapping of str to Beam
        Those asked for.
    energy, lattice : float
        The energy used, and the line's own, MeV.
    """
    said = []
    if abs(energy - lattice) > SAME_ENERGY * lattice:
        said.append(f"At {energy:g} MeV, the energy of the scan; the lattice has {lattice:g} MeV.")
    if any(beam.calibration and beam.covariance is not None for beam in beams.values()):
        said.append(CALIBRATED)
    if all(beam.covariance is None and beam.doubt is None for beam in beams.values()):
        said.append("No errors: pass --fit to include the beam's.")
    return tuple(said)


def _doubts_on(beams: Mapping[str, Beam]) -> dict[str, str]:
    """Warn of every plane whose beam the fit does not determine."""
    return {
        plane: f"The fit does not determine the beam of plane {plane}: {beam.doubt.rstrip('.')}. "
        "The settings are for its numbers as they stand."
        for plane, beam in beams.items()
        if beam.doubt is not None
    }


def _micro(target: Target, got: Quantity) -> str:
    factor, unit = SHOWN[target.kind]
    error = "" if got.error is None else f" ± {factor * got.error:.2g}"
    return f"{factor * got.value:.4g}{error}{unit} for {factor * target.value:.4g} wanted"


def _shown(key: str, q: Quantity) -> str:
    """A predicted number; one without an error is a prediction all the same."""
    factor, unit = SHOWN[key]
    if q.error is None:
        return f"{factor * q.value:.5g}{unit}"
    return f"{Quantity(factor * q.value, factor * q.error, '1')}{unit}"
