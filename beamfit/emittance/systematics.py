"""Systematic errors of screen, beam and line: a budget of single causes, and free parameters.

The budget has exact derivatives of the whole chain, transport and fit, with respect to each number
of the line. The range table shows refits without some points. In a scenario the same numbers are
free within their priors: the error of the emittance then includes statistics and systematics.
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
from beamfit.emittance.sigma import error_at, size_for_weights
from beamfit.emittance.statement import WEIGHTS, PreparedScan, Scanned, Scenario, varied_magnets
from beamfit.emittance.transport import Rows
from beamfit.errors import InputError, nearest
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem
from beamfit.optics.beamline import Beamline, transfer_rows
from beamfit.optics.calibration import SlopeIntercept, scaled
from beamfit.optics.elements import Drift, Element, Marker, Quadrupole, SectorDipole, ThinLens
from beamfit.optics.sections import ElementSeries

# Bounds of a free parameter, in standard deviations of its prior from the mean.
PRIOR_REACH = 6.0
# Unit and nominal value of the parameters that apply to the whole scan; None: taken from the scan.
UNITS = {
    "size_scale": ("1", 1.0),
    "resolution": ("m", None),
    "wire": ("m", None),
    "energy": ("1", 1.0),
    "dispersion": ("m", 0.0),
    "dispersion_slope": ("1", 0.0),
}
# Range of the mean of a relative prior; a value outside is in another unit.
PRIOR_MEAN_RANGE = (0.8, 1.25)
POSITIVE_TERMS = ("size_scale", "resolution", "wire", "energy")
# Refits without single points are listed up to this number of points: of more, one changes little.
MAX_POINTS = 50
# Relative changes of the emittance below this are rounding errors.
ROUNDING_TOLERANCE = 1e-12
# Total and kinetic energy are both named from this share of rest energy on.
MIN_REST_SHARE = 0.1
# Largest number of causes listed in a budget, and the smallest change listed on its own.
MAX_CAUSES, MIN_CHANGE = 30, 5e-4
# Changes of the budget: resolution and dispersion in m, and the momentum spread if none is given.
RESOLUTION_STEP, DISPERSION_STEP, DEFAULT_SPREAD = 10e-6, 0.01, 1e-3
# Excess of the smallest size by saturation, space charge or a pedestal. The size² that it adds is
# added to all points.
WAIST_EXCESS = 0.05
# Roll of a scanned magnet about the beam axis.
ROLL_ANGLE = math.radians(1.0)
# Changes within a scan: relative rise of the energy from the first row to the last, and the share
# of each step by which the field of a magnet lags.
ENERGY_RISE, LAG = 0.01, 0.1


class Term(NamedTuple):
    """A parameter with a prior: user's name, path, mean, standard deviation, bounds, unit."""

    name: str
    path: str
    mean: float
    sd: float
    lower: float
    upper: float
    unit: str


def with_systematics(scenario: Scenario) -> Scenario:
    """Add free parameters with priors for screen, beam and line to a scenario.

    Parameters
    ----------
    scenario : Scenario
        Any scenario.

    Returns
    -------
    Scenario
        Takes priors on ``size_scale``, ``resolution`` and ``wire`` (the rms of a round wire is a
        quarter of its diameter), ``energy``, ``dispersion`` and ``dispersion_slope`` of the
        incoming beam, ``NAME.gradient`` of magnets and ``NAME.length`` of drifts.
    """

    def state(prepared: PreparedScan, assumptions: Assumptions) -> Problem:
        terms = _terms(prepared, assumptions)
        magnets = [t.name.rpartition(".")[0] for t in terms if "." in t.name]
        prepared = prepared.with_variable(
            magnets, variable_energy="energy" in assumptions.systematics
        )
        problem = scenario.state(prepared, assumptions)
        return replace(
            problem,
            model=problem.model | {"systematics": _numbers(terms)},
            free=[*problem.free, *(Free(t.path, t.lower, t.upper) for t in terms)],
            priors=[*problem.priors, *(Prior(t.path, t.mean, t.sd) for t in terms)],
        )

    def parameters(
        prepared: PreparedScan, assumptions: Assumptions, fit: Fit
    ) -> Iterator[Parameter]:
        yield from scenario.parameters(prepared, assumptions, fit)
        for term in _terms(prepared, assumptions):
            prior = term.mean, term.sd
            yield Parameter.of(term.name, fit[term.path], term.unit, prior)

    return replace(scenario, state=state, parameters=parameters, closed=False)


def _numbers(terms: list[Term]) -> dict[str, Any]:
    """Model of the parameters at the means of their priors."""
    model: dict[str, Any] = {}
    for term in terms:
        *path, last = term.path.split(".")[1:]
        part = model.setdefault(path[0], {}) if path else model
        part[last] = term.mean
    return model


def _terms(prepared: PreparedScan, assumptions: Assumptions) -> list[Term]:
    """Parameters of a scan and its line for which priors were given."""
    return [_term(prepared, name, *prior) for name, prior in assumptions.systematics.items()]


def _term(prepared: PreparedScan, name: str, mean: float | None, sd: float) -> Term:
    """Parameter of a name, with the prior mean and standard deviation in its unit."""
    element, _, kind = name.rpartition(".")
    if element:
        given_value, unit = _element_value(prepared, element, kind)
        path, positive = f"systematics.{kind}.{element}", kind == "length"
    else:
        (unit, given_value), path, positive = (
            UNITS[name],
            f"systematics.{name}",
            name in POSITIVE_TERMS,
        )
        if name == "resolution":
            given_value = float(np.sqrt(np.mean(np.square(prepared.rows.resolution))))
        if name == "wire" and mean is None:
            raise InputError("a wire without its diameter", "wire=DIAMETER+-SD, in metres")
        if name.startswith("dispersion") and not np.any(prepared.rows.spread):
            expected = "energy_spread in the lattice or the scan"
            raise InputError(f"a prior on {name} without a momentum spread", expected)
    mean = given_value if mean is None else mean
    if name == "energy" and not PRIOR_MEAN_RANGE[0] <= mean <= PRIOR_MEAN_RANGE[1]:
        # An energy in MeV, such as 135+-1: the parameter is relative to the scan's.
        mean, sd = mean / prepared.energy, sd / prepared.energy
    if (
        unit == "1"
        and given_value == 1.0
        and not PRIOR_MEAN_RANGE[0] <= mean <= PRIOR_MEAN_RANGE[1]
    ):
        expected = f"{name}=1+-0.02: relative to what line and scan say, within 20 %"
        raise InputError(f"a prior {name} = {mean:.4g} ± {sd:.3g}", expected)
    low = mean - PRIOR_REACH * sd
    return Term(
        name, path, mean, sd, max(low, 0.0) if positive else low, mean + PRIOR_REACH * sd, unit
    )


def _element_value(prepared: PreparedScan, name: str, kind: str) -> tuple[float, str]:
    """Nominal value and unit of a parameter of an element: its gradient or length."""
    kinds = {"gradient": (Quadrupole, ThinLens), "length": (Drift,)}[kind]
    known = [e.name for e in prepared.scanned.elements if isinstance(e, kinds)]
    if name not in known:
        raise InputError(f"a prior on {name}.{kind}", f"{nearest(name, known)}, with .{kind}")
    return (1.0, "1") if kind == "gradient" else (float(prepared.scanned[name].length), "m")


def effect_words(fit: Fit, assumptions: Assumptions, emittance: float, slope: np.ndarray) -> str:
    """Sentence on the statistical part of an emittance error and its largest systematic part.

    Parameters
    ----------
    fit : Fit
        Fit of a problem from `with_systematics`.
    assumptions : Assumptions
        Assumptions with the priors.
    emittance, slope : float and ndarray
        The emittance and its derivatives with respect to the free parameters.

    Returns
    -------
    str
        Empty if there are no such parameters.

    Notes
    -----
    With the covariance C of all free parameters, a parameter s contributes cov(ε, s)/sd(s). The
    statistical variance is the Schur complement C_εε - C_εs C_ss⁻¹ C_sε of all s.
    """
    positions = {
        user_name(name): i
        for i, name in enumerate(fit.problem.names)
        if user_name(name) in assumptions.priors
    }
    if not assumptions.systematics or not emittance > 0:
        return ""
    covariance, indices = fit.covariance, list(positions.values())
    variance, cross_covariance = float(slope @ covariance @ slope), covariance[indices] @ slope
    prior_covariance = covariance[np.ix_(indices, indices)]
    sd = np.sqrt(np.maximum(np.diag(prior_covariance), 1e-300))
    rest = max(
        variance
        - float(
            cross_covariance @ np.linalg.pinv(prior_covariance, hermitian=True) @ cross_covariance
        ),
        0.0,
    )
    largest, name = max(zip((np.abs(cross_covariance) / sd).tolist(), positions, strict=True))
    parts = math.sqrt(max(variance, 0.0)), math.sqrt(rest), largest
    total, statistical, largest = (100 * part / emittance for part in parts)
    return (
        f" Of its error of {total:.2g} % statistics makes {statistical:.2g} %; the largest "
        f"systematic is {name} with {largest:.2g} %."
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
        Description of the points.
    normalized_emittance : float
        In m; NaN if the other points have no positive solution.
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
        The largest change first; empty if the emittance is not determined. Changes are +1 % of each
        magnet, scanned or not, of the angle of each bend, of the energy and of the screen's scale;
        +1 cm of each drift; 10 µm more resolution, and 1 cm more dispersion of the incoming beam
        (with the line's momentum spread, or 0.1 % if it has none); the size² that saturation, space
        charge or a pedestal add at the waist; an energy that rises by 1 % from the first row to the
        last; fields that lag by a tenth of each step from row to row; and a roll of each scanned
        magnet by a degree if both planes have a beam, which is exact. The others are first order:
        exact derivatives (through transport, and through the minimum by the implicit function
        theorem) times the change.

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
    rows, p, measured_rows = fit.seen.rows, result.points, fit.seen.measured(plane)
    # Use, size, error and weight of each row; other rows have no weight.
    points = np.vstack([np.zeros(len(rows.energy)), np.ones((3, len(rows.energy)))])
    points[:, measured_rows] = np.ones(len(measured_rows)), p.size, p.error, p.weighed
    sigma = np.array([q.value for q in result.sigma])
    line = fit.seen.scanned.stored_by_kind((*rows.settings, *rows.places))
    arguments = points, sigma, np.array(plane == "y"), np.array(p.relative)
    slopes = _slopes(replace(rows, line=line), *arguments, fit.seen.weights == WEIGHTS[0])
    part_slopes, energy_slope, *row_slopes, known_slope = slopes
    changes = {_magnet_cause(fit, name): 0.0 for name in rows.settings}
    upstream = {e.name for e in fit.seen.scanned.upto(result.screen.name).elements}
    for element, slope in _element_slopes(fit.seen.scanned, line, part_slopes):
        cause, step = _element_change(fit, element)
        if cause and (cause in changes or element.name in upstream):
            changes[cause] = changes.get(cause, 0.0) + step * float(slope)
    energy, mass = fit.seen.energy, fit.line.mass
    changes[energy_cause := _energy_cause(energy, mass)] = 0.01 * float(energy_slope)
    changes |= _drift_changes(rows, len(fit.seen.scan), measured_rows, *row_slopes)
    blurred = np.asarray(rows.resolution)[measured_rows]
    changes |= _screen_changes(fit, p, blurred, np.asarray(known_slope)[measured_rows])
    changes |= _roll_changes(fit, plane, np.asarray(known_slope))
    # ln βγ rises by E²/(E² - m²) for each relative step of the energy.
    stiffer = 0.01 * energy**2 / (energy**2 - mass**2)
    # Changes within rounding errors are zero, and so sort stably.
    rounded = {cause: d if abs(d) > ROUNDING_TOLERANCE else 0.0 for cause, d in changes.items()}
    found = [BudgetChange(c, d, d + stiffer * (c == energy_cause)) for c, d in rounded.items()]
    return sorted(found, key=lambda change: -abs(change.normalized_emittance))


def _drift_changes(
    rows: Rows,
    count: int,
    measured_rows: np.ndarray,
    energy_slope: Array,
    setting_slopes: dict[str, Array],
) -> dict[str, float]:
    """Changes by a drift of the energy from row to row, and by magnets whose fields lag.

    Steps are those between the plane's own rows: between the sweeps of two planes a magnet has time
    to settle.
    """
    # Padded rows have no weight.
    energy_change = float(np.asarray(energy_slope)[:count] @ np.linspace(-0.5, 0.5, count))
    found = {"energy rises by 1 % within the scan": ENERGY_RISE * energy_change}
    for name, slope in setting_slopes.items():
        setting = np.asarray(rows.settings[name])[measured_rows]
        lag = LAG * np.diff(setting, axis=0, prepend=setting[:1])
        if lag.any():
            change = -float(np.sum(np.asarray(slope)[measured_rows] * lag))
            found[f"{name} late by 10 % of each step, row by row"] = change
    return found


def _energy_cause(energy: float, mass: float) -> str:
    """A step of the energy in words, with the kinetic energy if the rest energy matters."""
    if mass < MIN_REST_SHARE * energy:
        return "energy +1 %"
    return f"total energy +1 % (kinetic +{energy / (energy - mass):.2g} %)"


def _element_slopes(
    line: Beamline, stored: Beamline, part_slopes: list[Array]
) -> Iterator[tuple[Element, float]]:
    """Elements of a line without markers, each with the slope with respect to its change."""
    rest, slopes = (e for e in line.elements if not isinstance(e, Marker)), iter(part_slopes)
    for part in stored.elements:
        if isinstance(part, ElementSeries):
            # `order` is the position of each element among all kinds, counted kind after kind.
            members = np.empty(len(part.order), object)
            members[part.order] = list(islice(rest, len(part.order)))
            part_slope = np.concatenate([np.atleast_1d(next(slopes)) for _ in part.kinds])
            yield from zip(members, part_slope, strict=True)
        elif not isinstance(part, Marker):
            yield next(rest), next(slopes)


def _with_changes(line: Beamline, changes: Iterator[Array]) -> Beamline:
    """Change all elements but markers of a line stored by kind, as `_element_change` describes."""

    def with_change(part: Element | ElementSeries) -> Element | ElementSeries:
        if isinstance(part, Marker):
            return part
        if isinstance(part, ElementSeries):
            return replace(part, kinds=tuple(map(with_change, part.kinds)))
        change = next(changes)
        if isinstance(part, Drift):
            return replace(part, length=part.length + change)
        if isinstance(part, SectorDipole):
            return replace(part, angle=part.angle * (1.0 + change))
        if hasattr(part, "calibration"):
            return replace(part, calibration=scaled(part.calibration, 1.0 + change))
        return part

    return replace(line, elements=tuple(map(with_change, line.elements)))


def _element_change(fit: Scanned, element: Element) -> tuple[str, float]:
    """Name and size of the change of an element."""
    if isinstance(element, Drift):
        return f"drift {element.name} +1 cm", 0.01
    if isinstance(element, SectorDipole):
        return f"bend {element.name} angle +1 %", 0.01
    if hasattr(element, "calibration"):
        # A change of a supply acts on all its magnets at once.
        supplies = fit.seen.scanned.supplies
        name = next((s for s, members in supplies if element.name in members), element.name)
        return _magnet_cause(fit, name), 0.01
    return "", 0.0


def _magnet_cause(fit: Scanned, name: str) -> str:
    """Name of the change of a magnet, or of a supply."""
    calibration = fit.seen.scanned[name].calibration
    word = "gradient" if calibration.unit in ("A", "kG", "T_per_m") else "strength"
    word = "slope" if isinstance(calibration, SlopeIntercept) else word
    return f"{name} {word} +1 %" + ", not scanned" * (name not in varied_magnets(fit.seen.scan))


def _screen_changes(
    fit: Scanned, p: Points, resolution: np.ndarray, known_slope: np.ndarray
) -> dict[str, float]:
    """Changes by scale and resolution of the screen, and by dispersion of the incoming beam."""
    spread = float(fit.seen.scanned.energy_spread) or DEFAULT_SPREAD
    if fit.seen.scan.energy_spread is not None:
        spread = float(np.mean(fit.seen.scan.energy_spread)) or DEFAULT_SPREAD
    # A scale of the sizes scales σ, and with it the emittance, except for the known size².
    scale = 2.0 * (1.0 - float(known_slope @ p.known))
    dispersion_change = float(known_slope @ (p.r11 * DISPERSION_STEP * spread) ** 2)
    smallest = float(np.min(p.size))
    blur_change = (resolution + RESOLUTION_STEP) ** 2 - resolution**2
    return {
        "screen scale +1 %": 0.01 * scale,
        "smallest size 5 % too large (saturation, space charge)": float(known_slope.sum())
        * ((1.0 + WAIST_EXCESS) ** 2 - 1.0)
        * smallest**2,
        "screen resolution 10 µm larger": float(known_slope @ blur_change),
        f"dispersion 1 cm larger (spread {100 * spread:.2g} %)": dispersion_change,
    }


def _roll_changes(fit: Scanned, plane: str, known_slope: np.ndarray) -> dict[str, float]:
    """Changes by a roll of each scanned magnet, which couples the planes, if both have a beam.

    A magnet M rolled by φ is T(-φ) M T(φ), where T rotates (x, y) and their slopes alike (K. L.
    Brown et al., TRANSPORT, SLAC-91 (1977), type code 20). With blocks A and B of the two planes,
    it has A + sin²φ (B - A) within the plane, and sin φ cos φ (A - B) from the other one.
    """
    rows, line, found = fit.seen.rows, fit.seen.scanned, {}
    beams = [[q.value for q in p.sigma] for p in fit.planes if p.sigma[0].error is not None]
    names = [m for name in varied_magnets(fit.seen.scan) for m in line.members(name)]
    order = [e.name for e in line.elements]
    for name in names if len(beams) == 2 else ():
        position = order.index(name)
        places = (*order[max(position - 1, 0) : position], name, *rows.places)
        downstream = np.array([order.index(place) > position for place in rows.places])[
            rows.screen_index
        ]
        planes = np.asarray(transfer_rows(line, rows.settings, rows.energy, places).planes)
        r = np.moveaxis(planes[..., :2, :2], 1, 0)[:: -1 if plane == "y" else 1]
        before = r[:, :, 0] if position else np.broadcast_to(np.eye(2), r[:, :, 0].shape)
        after_magnet = r[:, :, min(position, 1)]
        to_screen = r[
            0, np.arange(len(rows.screen_index)), rows.screen_index + len(places) - len(rows.places)
        ][:, :1]
        same_plane, other_plane = after_magnet @ np.linalg.inv(before)
        from_magnet = to_screen @ np.linalg.inv(after_magnet[0])
        sin, cos = math.sin(ROLL_ANGLE), math.cos(ROLL_ANGLE)
        own_beam = from_magnet @ (same_plane + sin**2 * (other_plane - same_plane)) @ before[0]
        other_beam = sin * cos * from_magnet @ (same_plane - other_plane) @ before[1]
        contributions = zip((1, 1, -1), (own_beam, other_beam, to_screen), (0, 1, 0), strict=True)
        both = beams[:: -1 if plane == "y" else 1]
        added = sum(k * size_squared(both[i], *v[:, 0].T, 0.0) for k, v, i in contributions)
        found[f"{name} rolled by 1 degree"] = float(
            known_slope @ (downstream * rows.damping**2 * added)
        )
    return found


@partial(jax.jit, static_argnames="by_model", compiler_options=SELDOM)
def _slopes(
    rows: Rows, points: Array, sigma: Array, upright: Array, relative: Array, by_model: bool
) -> tuple[list[Array], Array, Array, dict[str, Array], Array]:
    """Derivatives of ln ε with respect to the parts of the line and ln E, and for each row with
    respect to ln E, the settings and the known size².

    At the answer the weighted residuals F = Σ f(m²) ∂m²/∂σ vanish, so dσ = -(∂F/∂σ)⁻¹ dF. This is
    exact for either residual, includes weights at the model size, and does not differentiate the
    solver. One reverse pass gives the derivatives for all numbers of a line of any length.
    """

    def residuals(
        sigma: Array, changes: list[Array], factor: Array, drift: Array,
        settings: dict[str, Array], further: Array,
    ) -> Array:  # fmt: skip
        row_energy, mass = rows.energy * (1.0 + drift), rows.line.mass
        # Adiabatic damping: the normalised emittance of the rows is one number.
        damping = ((rows.energy**2 - mass**2) / (row_energy**2 - mass**2)) ** 0.25
        changed_rows = replace(rows, settings=settings, damping=rows.damping * damping)
        x, y = changed_rows.both_planes(
            _with_changes(rows.line, iter(changes)), row_energy * factor
        )
        # One compiled program for both planes.
        r11, r12, known = changed_rows.screen_elements(jnp.where(upright, y, x))
        design = jnp.stack(coefficients(r11, r12), -1)
        return pulls(design @ sigma + known + further) @ design

    def pulls(m2: Array) -> Array:
        """Weight of ∂m²/∂σ of each point; their weighted sum vanishes at the answer."""
        used, size, error, weighed = points
        if not rows.squared:
            return used * (1.0 - size / jnp.sqrt(m2)) / error**2
        at = size_for_weights(size, m2) if by_model else weighed
        return used * (m2 - size**2) / (at * error_at(at, weighed, error, relative)) ** 2

    kinds = (
        k for e in rows.line.elements for k in (e.kinds if isinstance(e, ElementSeries) else (e,))
    )
    # Shape of the elements stored together; () for a single one.
    shapes = (
        max(map(np.shape, jax.tree.leaves(kind)), key=len, default=())
        for kind in kinds
        if not isinstance(kind, Marker)
    )
    changes = list(map(jnp.zeros, shapes))
    none = jnp.zeros(len(rows.energy))
    unchanged = changes, jnp.ones(()), none, rows.settings, none
    unit = jnp.abs(sigma)
    by_sigma = jax.jacobian(residuals)(sigma, *unchanged) * unit[:, None] * unit
    slope = unit * jax.grad(lambda s: 0.5 * jnp.log(s[0] * s[2] - s[1] ** 2))(sigma)
    adjoint = -unit * jnp.linalg.solve(by_sigma.T, slope)
    return jax.grad(lambda unchanged: adjoint @ residuals(sigma, *unchanged))(unchanged)


def range_sensitivity(plane: PlaneFit) -> list[RangeRow]:
    """Refit without each point in turn, and without the points far from the waist.

    Parameters
    ----------
    plane : PlaneFit
        A fitted plane.

    Returns
    -------
    list of RangeRow
        One for each point left out, up to 50 points, and one for sizes within twice the smallest if
        that leaves enough. Shifts of more than about one standard error, repeatedly in one
        direction, show that the fit range decides the answer.
    """
    p = plane.points
    n = len(p.size)
    testable = 4 <= n <= MAX_POINTS
    rows = [(f"without {_place(p, i)}", np.arange(n) != i) for i in range(n if testable else 0)]
    near = p.size <= 2.0 * p.size.min()
    if 4 <= near.sum() < n:
        rows.append(("only sizes within 2 x the smallest", near))
    full, found = plane.emittance, []
    factor = plane.normalized_emittance.value / full.value if full.value else 0.0
    for name, used in rows:
        emittance = _emittance_without(plane, ~used)
        shift = (emittance - full.value) / full.error if full.error else math.nan
        found.append(RangeRow(name, emittance * factor, shift))
    return found


def _emittance_without(plane: PlaneFit, left_out: np.ndarray) -> float:
    """Emittance without some points, at the weights of the fit; NaN if the others give none."""
    p = plane.points
    scale = np.where(left_out, 0.0, 0.5 / (p.weighed * p.error))
    rows = np.stack(coefficients(p.r11, p.r12), -1) * scale[:, None]
    norm = np.linalg.norm(rows, axis=0)
    sigma = np.linalg.lstsq(rows / norm, (p.size**2 - p.known) * scale, rcond=None)[0] / norm
    determinant = sigma[0] * sigma[2] - sigma[1] ** 2
    return math.sqrt(determinant) if sigma[0] > 0 and determinant > 0 else math.nan


def _place(points: Points, i: int) -> str:
    """Name a point by its screen, if there are several, and by the settings that vary."""
    varied = {n: v[i] for n, v in points.settings.items() if np.ptp(v) > 0}
    screen = points.screen[i] if len(set(points.screen)) > 1 else ""
    return ", ".join(filter(None, (screen, in_words(varied, points.units))))


def budget_rows(fit: Scanned) -> list[tuple[str, list[str]]]:
    """Cause and one cell per plane: the change of the normalised emittance, the largest first.

    Changes below 0.05 % share one line.
    """
    columns = [
        {c.cause: c.normalized_emittance for c in systematics(fit, p.plane)} for p in fit.planes
    ]
    causes = dict.fromkeys(cause for column in columns for cause in column)
    largest = {cause: max(abs(c.get(cause, 0.0)) for c in columns) for cause in causes}
    ranked = sorted(largest, key=largest.__getitem__, reverse=True)
    shown = [cause for cause in ranked if largest[cause] >= MIN_CHANGE][:MAX_CAUSES]
    rows = [
        (cause, [f"{100 * c[cause]:+.2f} %" if cause in c else "-" for c in columns])
        for cause in shown
    ]
    if others := ranked[len(shown) :]:
        cells = [f"±{100 * largest[others[0]]:.2g} % at most" for _ in columns]
        rows.append((f"{len(others)} other cause{'s, each' * (len(others) > 1)}", cells))
    return rows


def range_rows(fit: Scanned) -> list[tuple[str, list[str]]]:
    """Points left out, and one cell per plane: the normalised emittance and its shift."""
    columns = [{r.left_out: r for r in range_sensitivity(p)} for p in fit.planes]
    names = dict.fromkeys(name for column in columns for name in column)
    return [(name, [_range_cell(column.get(name)) for column in columns]) for name in names]


def _range_cell(row: RangeRow | None) -> str:
    """Normalised emittance without some points, with its shift in standard errors."""
    if row is None or math.isnan(row.normalized_emittance):
        return "-" if row is None else "none"
    shift = "" if math.isnan(row.shift) else f" ({row.shift:+z.1f})"
    return f"{row.normalized_emittance * 1e6:.3f} µm{shift}"
