"""Errors of screen, beam and line: a budget of each alone, and parameters with priors.

The budget takes the exact derivative of the whole chain, transport and fit, by each number of the
line; the range table refits without some points. In a scenario the same numbers are free, within
what is known of them: the error of the emittance then holds statistics and systematics, and says
which of them it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import SELDOM
from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.model import coefficients, size_squared, user_name
from beamfit.emittance.results import Parameter, PlaneFit, Points, in_words
from beamfit.emittance.sigma import error_at, weighed_size
from beamfit.emittance.statement import WEIGHTS, PreparedScan, Scanned, Scenario, varied_magnets
from beamfit.emittance.transport import Rows
from beamfit.errors import InputError, nearest
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem
from beamfit.optics.beamline import Beamline, transfer_rows
from beamfit.optics.calibration import SlopeIntercept, scaled
from beamfit.optics.elements import Drift, Element, Marker, Quadrupole, SectorDipole, ThinLens
from beamfit.optics.sections import ElementSeries

# Free numbers end so many standard deviations of their prior away.
REACH = 6.0
# Units of the numbers that are one for all elements, and what they are where nobody says.
UNITS = {
    "size_scale": ("1", 1.0),
    "resolution": ("m", None),
    "wire": ("m", None),
    "energy": ("1", 1.0),
    "dispersion": ("m", 0.0),
    "dispersion_slope": ("1", 0.0),
}
# How far the mean of a relative prior may be from what line and scan say.
NEAR = (0.8, 1.25)
POSITIVE = ("size_scale", "resolution", "wire", "energy")
# Leaving out one of more points than this tells nothing.
MOST_POINTS = 50
# A relative change of an emittance below this is rounding.
ROUNDING = 1e-12
# From this share of rest energy on, total and kinetic energy are told apart.
SLOW = 0.1
# Nobody reads a budget of more causes than this, nor of smaller changes.
MOST_CAUSES, SMALLEST = 30, 5e-4
# Steps of the budget: resolution and dispersion in m, and a momentum spread where none is stated.
RESOLUTION, DISPERSION, SPREAD = 10e-6, 0.01, 1e-3
# What saturation, space charge or a pedestal add to every size², told at the smallest size.
AT_WAIST = 0.05
# Roll of a scanned magnet about the beam.
ROLL = math.radians(1.0)
# What moves within a scan unseen: the energy from the first row to the last, and by how much of
# each step a field is late.
DRIFT, LATE = 0.01, 0.1


class Term(NamedTuple):
    """A number with a prior: as users call it, where it stands, mean, deviation, bounds, unit."""

    name: str
    path: str
    mean: float
    sd: float
    lower: float
    upper: float
    unit: str


def with_systematics(scenario: Scenario) -> Scenario:
    """Free the numbers of screen, beam and line that have priors, besides a scenario's own.

    Parameters
    ----------
    scenario : Scenario
        Any.

    Returns
    -------
    Scenario
        For priors on ``size_scale``, ``resolution`` and ``wire`` (the rms of a round wire is a
        quarter of its diameter), ``energy``, ``dispersion`` and ``dispersion_slope`` of the
        incoming beam, ``NAME.gradient`` of magnets and ``NAME.length`` of drifts.
    """

    def state(seen: PreparedScan, told: Assumptions) -> Problem:
        terms = _terms(seen, told)
        magnets = [t.name.rpartition(".")[0] for t in terms if "." in t.name]
        seen = seen.with_variable(magnets, variable_energy="energy" in told.systematics)
        problem = scenario.state(seen, told)
        return replace(
            problem,
            model=problem.model | {"systematics": _numbers(terms)},
            free=[*problem.free, *(Free(t.path, t.lower, t.upper) for t in terms)],
            priors=[*problem.priors, *(Prior(t.path, t.mean, t.sd) for t in terms)],
        )

    def parameters(seen: PreparedScan, told: Assumptions, fit: Fit) -> Iterator[Parameter]:
        yield from scenario.parameters(seen, told, fit)
        for term in _terms(seen, told):
            prior = term.mean, term.sd
            yield Parameter.of(term.name, fit[term.path], term.unit, prior)

    return replace(scenario, state=state, parameters=parameters, closed=False)


def _numbers(terms: list[Term]) -> dict[str, Any]:
    """The part of a model that has them, at their means."""
    model: dict[str, Any] = {}
    for term in terms:
        *path, last = term.path.split(".")[1:]
        part = model.setdefault(path[0], {}) if path else model
        part[last] = term.mean
    return model


def _terms(seen: PreparedScan, told: Assumptions) -> list[Term]:
    """The numbers of a scan and its line that priors were given for."""
    return [_term(seen, name, *prior) for name, prior in told.systematics.items()]


def _term(seen: PreparedScan, name: str, mean: float | None, sd: float) -> Term:
    element, _, what = name.rpartition(".")
    if element:
        own, unit = _of_element(seen, element, what)
        path, positive = f"systematics.{what}.{element}", what == "length"
    else:
        (unit, own), path, positive = UNITS[name], f"systematics.{name}", name in POSITIVE
        if name == "resolution":
            own = float(np.sqrt(np.mean(np.square(seen.rows.resolution))))
        if name == "wire" and mean is None:
            raise InputError("a wire without its diameter", "wire=DIAMETER+-SD, in metres")
        if name.startswith("dispersion") and not np.any(seen.rows.spread):
            expected = "energy_spread in the lattice or the scan"
            raise InputError(f"a prior on {name} without a momentum spread", expected)
    mean = own if mean is None else mean
    if name == "energy" and not NEAR[0] <= mean <= NEAR[1]:
        # 135+-1 is an energy in MeV, where a share of the line's is meant.
        mean, sd = mean / seen.energy, sd / seen.energy
    if unit == "1" and own == 1.0 and not NEAR[0] <= mean <= NEAR[1]:
        expected = f"{name}=1+-0.02: relative to what line and scan say, within 20 %"
        raise InputError(f"a prior {name} = {mean:.4g} ± {sd:.3g}", expected)
    low = mean - REACH * sd
    return Term(name, path, mean, sd, max(low, 0.0) if positive else low, mean + REACH * sd, unit)


def _of_element(seen: PreparedScan, name: str, what: str) -> tuple[float, str]:
    kinds = {"gradient": (Quadrupole, ThinLens), "length": (Drift,)}[what]
    known = [e.name for e in seen.scanned.elements if isinstance(e, kinds)]
    if name not in known:
        raise InputError(f"a prior on {name}.{what}", f"{nearest(name, known)}, with .{what}")
    return (1.0, "1") if what == "gradient" else (float(seen.scanned[name].length), "m")


def effect_words(fit: Fit, told: Assumptions, emittance: float, slope: np.ndarray) -> str:
    """Take the error of an emittance apart, and name its largest part.

    Parameters
    ----------
    fit : Fit
        Of a problem from `with_systematics`.
    told : Assumptions
        With the priors.
    emittance, slope : float and ndarray
        The emittance and its derivatives by the free numbers.

    Returns
    -------
    str
        Empty where no such number is free.

    Notes
    -----
    With the covariance C of all free numbers a number s moves the emittance by cov(ε, s)/sd(s);
    what is left with all s known is the Schur complement C_εε - C_εs C_ss⁻¹ C_sε.
    """
    places = {
        user_name(name): i
        for i, name in enumerate(fit.problem.names)
        if user_name(name) in told.priors
    }
    if not told.systematics or not emittance > 0:
        return ""
    covariance, at = fit.covariance, list(places.values())
    variance, across = float(slope @ covariance @ slope), covariance[at] @ slope
    own = covariance[np.ix_(at, at)]
    sd = np.sqrt(np.maximum(np.diag(own), 1e-300))
    rest = max(variance - float(across @ np.linalg.pinv(own, hermitian=True) @ across), 0.0)
    most, name = max(zip((np.abs(across) / sd).tolist(), places, strict=True))
    parts = math.sqrt(max(variance, 0.0)), math.sqrt(rest), most
    total, statistical, most = (100 * part / emittance for part in parts)
    return (
        f" Of its error of {total:.2g} % statistics makes {statistical:.2g} %; the largest "
        f"systematic is {name} with {most:.2g} %."
    )


class BudgetChange(NamedTuple):
    """Change of the emittance by one small change of the line.

    Attributes
    ----------
    cause : str
        For example "Q2 slope +1 %" or "drift D1 +1 cm".
    emittance : float
        Relative change of the geometric emittance.
    normalized_emittance : float
        Relative change of the normalised emittance.
    """

    cause: str
    emittance: float
    normalized_emittance: float


class RangeRow(NamedTuple):
    """The emittance without some points.

    Attributes
    ----------
    left_out : str
        Which.
    normalized_emittance : float
        In m; NaN where the rest has no positive solution.
    shift : float
        Its change from the full fit, in standard errors of the full fit.
    """

    left_out: str
    normalized_emittance: float
    shift: float


def systematics(fit: Scanned, plane: str) -> list[BudgetChange]:
    """Change of the emittance for small changes of the line, the energy, the screen and the beam.

    Parameters
    ----------
    fit : EmittanceFit
        A fit.
    plane : str
        "x" or "y".

    Returns
    -------
    list of BudgetChange
        The largest change first; empty where the emittance is not determined. For +1 % of each
        magnet, scanned or not, of the angle of each bend, of the energy and of the screen's scale;
        for +1 cm of each drift; for 10 µm of resolution and 1 cm of dispersion of the incoming beam
        (of the line's momentum spread, or 0.1 % where it has none) that were not thought of; for
        what saturation, space charge or a pedestal add to size² at the waist; for an energy that
        rises by 1 % from the first row to the last, and magnets whose fields are late by a tenth
        of each step from row to row; and for each scanned magnet rolled by a degree, where both
        planes have a beam, exactly. First order: exact derivatives (through transport, and through
        the minimum by the implicit function theorem) times the step.

    Examples
    --------
    >>> from beamfit.optics.beam import BeamMatrix
    >>> from beamfit.optics.elements import Quadrupole, Screen
    >>> from beamfit.emittance.fit import fit_emittance
    >>> from beamfit.emittance.scan import QuadScan
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), energy=135.0)
    >>> k1 = np.linspace(-2.0, 12.0, 8)
    >>> sizes = [float(BeamMatrix.from_twiss(2e-9, 5.0, 0.0).transport(
    ...     line.matrix({"Q": k}).x).l11) for k in k1]
    >>> fit = fit_emittance(QuadScan({"Q": k1}, {"Q": "k1"}, {"x": sizes}), line)
    >>> [c.cause for c in systematics(fit, "x")][:2]
    ['smallest size 5 % too large (saturation, space charge)', 'screen resolution 10 µm larger']
    """
    result = fit[plane]
    if result.emittance.error is None:
        return []
    rows, p, keep = fit.seen.rows, result.points, fit.seen.measured(plane)
    # Used, size, error and weight of each row; those of other rows count for nothing.
    points = np.vstack([np.zeros(len(rows.energy)), np.ones((3, len(rows.energy)))])
    points[:, keep] = np.ones(len(keep)), p.size, p.error, p.weighed
    sigma = np.array([q.value for q in result.sigma])
    line = fit.seen.scanned.stored_by_kind((*rows.settings, *rows.places))
    given = points, sigma, np.array(plane == "y"), np.array(p.relative)
    slopes = _slopes(replace(rows, line=line), *given, fit.seen.weights == WEIGHTS[0])
    by_parts, by_energy, *by_row, by_known = slopes
    changes = {_magnet_cause(fit, name): 0.0 for name in rows.settings}
    upstream = {e.name for e in fit.seen.scanned.upto(result.screen.name).elements}
    for element, slope in _by_element(fit.seen.scanned, line, by_parts):
        cause, step = _cause(fit, element)
        if cause and (cause in changes or element.name in upstream):
            changes[cause] = changes.get(cause, 0.0) + step * float(slope)
    energy, mass = fit.seen.energy, fit.line.mass
    changes[of_energy := _energy_cause(energy, mass)] = 0.01 * float(by_energy)
    changes |= _within_scan(rows, len(fit.seen.scan), keep, *by_row)
    blurred = np.asarray(rows.resolution)[keep]
    changes |= _of_screen(fit, p, blurred, np.asarray(by_known)[keep])
    changes |= _of_rolls(fit, plane, np.asarray(by_known))
    # ln βγ rises by E²/(E² - m²) for each relative step of the energy.
    stiffer = 0.01 * energy**2 / (energy**2 - mass**2)
    # What is zero but for rounding is zero, and keeps its place.
    whole = {cause: d if abs(d) > ROUNDING else 0.0 for cause, d in changes.items()}
    found = [BudgetChange(c, d, d + stiffer * (c == of_energy)) for c, d in whole.items()]
    return sorted(found, key=lambda change: -abs(change.normalized_emittance))


def _within_scan(
    rows: Rows, count: int, own: np.ndarray, by_energy: Array, by_setting: dict[str, Array]
) -> dict[str, float]:
    """Changes by what moves from row to row: a drift of the energy, and magnets that are late.

    Steps are those between the plane's own rows: from one plane's sweep back to the start of the
    other's a magnet has time.
    """
    # Rows beyond the scan's are of no weight.
    rises = float(np.asarray(by_energy)[:count] @ np.linspace(-0.5, 0.5, count))
    found = {"energy rises by 1 % within the scan": DRIFT * rises}
    for name, slope in by_setting.items():
        setting = np.asarray(rows.settings[name])[own]
        behind = LATE * np.diff(setting, axis=0, prepend=setting[:1])
        if behind.any():
            late = -float(np.sum(np.asarray(slope)[own] * behind))
            found[f"{name} late by 10 % of each step, row by row"] = late
    return found


def _energy_cause(energy: float, mass: float) -> str:
    """A step of the energy in words: of slow particles whose energies are called kinetic, both."""
    if mass < SLOW * energy:
        return "energy +1 %"
    return f"total energy +1 % (kinetic +{energy / (energy - mass):.2g} %)"


def _by_element(
    line: Beamline, stored: Beamline, by_parts: list[Array]
) -> Iterator[tuple[Element, float]]:
    """Each element of a line, but for mere places, with the slope by its small change."""
    left, slopes = (e for e in line.elements if not isinstance(e, Marker)), iter(by_parts)
    for part in stored.elements:
        if isinstance(part, ElementSeries):
            # An element stands at `order` among those of all kinds, counted kind after kind.
            elements = np.empty(len(part.order), object)
            elements[part.order] = list(islice(left, len(part.order)))
            each = np.concatenate([np.atleast_1d(next(slopes)) for _ in part.kinds])
            yield from zip(elements, each, strict=True)
        elif not isinstance(part, Marker):
            yield next(left), next(slopes)


def _moved(line: Beamline, changes: Iterator[Array]) -> Beamline:
    """A line stored by kind with small changes, those of `_cause`, of all but mere places."""

    def changed(part: Element | ElementSeries) -> Element | ElementSeries:
        if isinstance(part, Marker):
            return part
        if isinstance(part, ElementSeries):
            return replace(part, kinds=tuple(map(changed, part.kinds)))
        change = next(changes)
        if isinstance(part, Drift):
            return replace(part, length=part.length + change)
        if isinstance(part, SectorDipole):
            return replace(part, angle=part.angle * (1.0 + change))
        if hasattr(part, "calibration"):
            return replace(part, calibration=scaled(part.calibration, 1.0 + change))
        return part

    return replace(line, elements=tuple(map(changed, line.elements)))


def _cause(fit: Scanned, element: Element) -> tuple[str, float]:
    """Name and size of the small change of an element."""
    if isinstance(element, Drift):
        return f"drift {element.name} +1 cm", 0.01
    if isinstance(element, SectorDipole):
        return f"bend {element.name} angle +1 %", 0.01
    if hasattr(element, "calibration"):
        # What a supply does to its magnets is one cause.
        supplies = fit.seen.scanned.supplies
        name = next((s for s, members in supplies if element.name in members), element.name)
        return _magnet_cause(fit, name), 0.01
    return "", 0.0


def _magnet_cause(fit: Scanned, name: str) -> str:
    calibration = fit.seen.scanned[name].calibration
    word = "gradient" if calibration.unit in ("A", "kG", "T_per_m") else "strength"
    word = "slope" if isinstance(calibration, SlopeIntercept) else word
    return f"{name} {word} +1 %" + ", not scanned" * (name not in varied_magnets(fit.seen.scan))


def _of_screen(
    fit: Scanned, p: Points, resolution: np.ndarray, by_known: np.ndarray
) -> dict[str, float]:
    """Changes by the screen's scale and resolution, and by dispersion of the incoming beam."""
    spread = float(fit.seen.scanned.energy_spread) or SPREAD
    if fit.seen.scan.energy_spread is not None:
        spread = float(np.mean(fit.seen.scan.energy_spread)) or SPREAD
    # A scale on sizes is one on what is known of them and on σ, whose emittance goes with it.
    scale = 2.0 * (1.0 - float(by_known @ p.known))
    dispersed = float(by_known @ (p.r11 * DISPERSION * spread) ** 2)
    smallest = float(np.min(p.size))
    larger = (resolution + RESOLUTION) ** 2 - resolution**2
    return {
        "screen scale +1 %": 0.01 * scale,
        "smallest size 5 % too large (saturation, space charge)": float(by_known.sum())
        * ((1.0 + AT_WAIST) ** 2 - 1.0)
        * smallest**2,
        "screen resolution 10 µm larger": float(by_known @ larger),
        f"dispersion 1 cm larger (spread {100 * spread:.2g} %)": dispersed,
    }


def _of_rolls(fit: Scanned, plane: str, by_known: np.ndarray) -> dict[str, float]:
    """Changes by a roll of each scanned magnet, which shows a plane's screen the other's beam.

    Where both planes have one. A magnet M rolled by φ is T(-φ) M T(φ), where T turns (x, y) and
    their slopes alike (K. L. Brown et al., TRANSPORT, SLAC-91 (1977), type code 20): of blocks A
    and B it has A + sin²φ (B - A) in the plane, and sin φ cos φ (A - B) from the other one.
    """
    rows, line, found = fit.seen.rows, fit.seen.scanned, {}
    beams = [[q.value for q in p.sigma] for p in fit.planes if p.sigma[0].error is not None]
    names = [m for name in varied_magnets(fit.seen.scan) for m in line.members(name)]
    order = [e.name for e in line.elements]
    for name in names if len(beams) == 2 else ():
        at = order.index(name)
        places = (*order[max(at - 1, 0) : at], name, *rows.places)
        reached = np.array([order.index(place) > at for place in rows.places])[rows.which]
        planes = np.asarray(transfer_rows(line, rows.settings, rows.energy, places).planes)
        r = np.moveaxis(planes[..., :2, :2], 1, 0)[:: -1 if plane == "y" else 1]
        before = r[:, :, 0] if at else np.broadcast_to(np.eye(2), r[:, :, 0].shape)
        exit_ = r[:, :, min(at, 1)]
        seen = r[0, np.arange(len(rows.which)), rows.which + len(places) - len(rows.places)][:, :1]
        own, other = exit_ @ np.linalg.inv(before)
        after = seen @ np.linalg.inv(exit_[0])
        sin, cos = math.sin(ROLL), math.cos(ROLL)
        turned = after @ (own + sin**2 * (other - own)) @ before[0]
        across = sin * cos * after @ (own - other) @ before[1]
        ways = zip((1, 1, -1), (turned, across, seen), (0, 1, 0), strict=True)
        both = beams[:: -1 if plane == "y" else 1]
        added = sum(k * size_squared(both[i], *v[:, 0].T, 0.0) for k, v, i in ways)
        found[f"{name} rolled by 1 degree"] = float(by_known @ (reached * rows.damping**2 * added))
    return found


@partial(jax.jit, static_argnames="follows", compiler_options=SELDOM)
def _slopes(
    rows: Rows, points: Array, sigma: Array, upright: Array, relative: Array, follows: bool
) -> tuple[list[Array], Array, Array, dict[str, Array], Array]:
    """Derivatives of ln ε of the fit by the parts of the line and ln E, and by ln E, the settings
    and the known size² of every row.

    At the answer the weighted residuals F = Σ f(m²) ∂m²/∂σ vanish, so dσ = -(∂F/∂σ)⁻¹ dF: exact
    for either residual, without differentiating the solver, weights that follow the model included.
    One reverse pass carries them back to every number of the line, however long it is.
    """

    def residuals(
        sigma: Array, changes: list[Array], factor: Array, drift: Array,
        settings: dict[str, Array], further: Array,
    ) -> Array:  # fmt: skip
        own, mass = rows.energy * (1.0 + drift), rows.line.mass
        # A row of higher energy has a smaller beam: its normalised emittance is the scan's.
        smaller = ((rows.energy**2 - mass**2) / (own**2 - mass**2)) ** 0.25
        moved = replace(rows, settings=settings, damping=rows.damping * smaller)
        x, y = moved.both(_moved(rows.line, iter(changes)), own * factor)
        # Either plane in one program, which is compiled once.
        r11, r12, known = moved.known(jnp.where(upright, y, x))
        design = jnp.stack(coefficients(r11, r12), -1)
        return pulls(design @ sigma + known + further) @ design

    def pulls(m2: Array) -> Array:
        """Multiples of ∂m²/∂σ of each point that add to zero at the answer."""
        used, size, error, weighed = points
        if not rows.squared:
            return used * (1.0 - size / jnp.sqrt(m2)) / error**2
        at = weighed_size(size, m2) if follows else weighed
        return used * (m2 - size**2) / (at * error_at(at, weighed, error, relative)) ** 2

    kinds = (
        k for e in rows.line.elements for k in (e.kinds if isinstance(e, ElementSeries) else (e,))
    )
    # The shape of elements stored together; () of one that stands alone.
    shapes = (
        max(map(np.shape, jax.tree.leaves(kind)), key=len, default=())
        for kind in kinds
        if not isinstance(kind, Marker)
    )
    changes = list(map(jnp.zeros, shapes))
    none = jnp.zeros(len(rows.energy))
    still = changes, jnp.ones(()), none, rows.settings, none
    unit = jnp.abs(sigma)
    by_sigma = jax.jacobian(residuals)(sigma, *still) * unit[:, None] * unit
    slope = unit * jax.grad(lambda s: 0.5 * jnp.log(s[0] * s[2] - s[1] ** 2))(sigma)
    back = -unit * jnp.linalg.solve(by_sigma.T, slope)
    return jax.grad(lambda still: back @ residuals(sigma, *still))(still)


def range_sensitivity(plane: PlaneFit) -> list[RangeRow]:
    """Refit without each point in turn, and without the points far from the waist.

    Parameters
    ----------
    plane : PlaneFit
        A fitted plane.

    Returns
    -------
    list of RangeRow
        One a point left out (of at most 50: of more, one says nothing), and one for sizes
        within twice the smallest if that leaves enough. A shift of more than about one
        standard error, again and again in one direction, says that the fit range decides the
        answer.
    """
    p = plane.points
    n = len(p.size)
    few = 4 <= n <= MOST_POINTS
    rows = [(f"without {_place(p, i)}", np.arange(n) != i) for i in range(n if few else 0)]
    near = p.size <= 2.0 * p.size.min()
    if 4 <= near.sum() < n:
        rows.append(("only sizes within 2 x the smallest", near))
    whole, found = plane.emittance, []
    factor = plane.normalized_emittance.value / whole.value if whole.value else 0.0
    for name, kept in rows:
        rest = _without(plane, ~kept)
        shift = (rest - whole.value) / whole.error if whole.error else math.nan
        found.append(RangeRow(name, rest * factor, shift))
    return found


def _without(plane: PlaneFit, left_out: np.ndarray) -> float:
    """The emittance without some points, at the weights of the fit; NaN where the rest has none."""
    p = plane.points
    scale = np.where(left_out, 0.0, 0.5 / (p.weighed * p.error))
    rows = np.stack(coefficients(p.r11, p.r12), -1) * scale[:, None]
    norm = np.linalg.norm(rows, axis=0)
    sigma = np.linalg.lstsq(rows / norm, (p.size**2 - p.known) * scale, rcond=None)[0] / norm
    determinant = sigma[0] * sigma[2] - sigma[1] ** 2
    return math.sqrt(determinant) if sigma[0] > 0 and determinant > 0 else math.nan


def _place(points: Points, i: int) -> str:
    """Name a point by its screen, where there are several, and the settings that vary."""
    varied = {n: v[i] for n, v in points.settings.items() if np.ptp(v) > 0}
    screen = points.screen[i] if len(set(points.screen)) > 1 else ""
    return ", ".join(filter(None, (screen, in_words(varied, points.units))))


def budget_rows(fit: Scanned) -> list[tuple[str, list[str]]]:
    """Cause and one cell per plane: the change of the normalised emittance, the largest first.

    Those below 0.05 % share one line.
    """
    columns = [
        {c.cause: c.normalized_emittance for c in systematics(fit, p.plane)} for p in fit.planes
    ]
    causes = dict.fromkeys(cause for column in columns for cause in column)
    largest = {cause: max(abs(c.get(cause, 0.0)) for c in columns) for cause in causes}
    ranked = sorted(largest, key=largest.__getitem__, reverse=True)
    shown = [cause for cause in ranked if largest[cause] >= SMALLEST][:MOST_CAUSES]
    rows = [
        (cause, [f"{100 * c[cause]:+.2f} %" if cause in c else "-" for c in columns])
        for cause in shown
    ]
    if others := ranked[len(shown) :]:
        most = [f"±{100 * largest[others[0]]:.2g} % at most" for _ in columns]
        rows.append((f"{len(others)} other cause{'s, each' * (len(others) > 1)}", most))
    return rows


def range_rows(fit: Scanned) -> list[tuple[str, list[str]]]:
    """Points left out, and one cell per plane: the normalised emittance and its shift."""
    columns = [{r.left_out: r for r in range_sensitivity(p)} for p in fit.planes]
    names = dict.fromkeys(name for column in columns for name in column)
    return [(name, [_range_cell(column.get(name)) for column in columns]) for name in names]


def _range_cell(row: RangeRow | None) -> str:
    if row is None or math.isnan(row.normalized_emittance):
        return "-" if row is None else "none"
    shift = "" if math.isnan(row.shift) else f" ({row.shift:+z.1f})"
    return f"{row.normalized_emittance * 1e6:.3f} µm{shift}"
