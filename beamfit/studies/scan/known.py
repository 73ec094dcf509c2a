"""Known transport: the fit in closed form, from which every scenario starts and which judges it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import SELDOM
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS
from beamfit.statistics import chi2_probability
from beamfit.studies.scan.model import numbers_of, size_squared
from beamfit.studies.scan.names import check_names
from beamfit.studies.scan.noise import ENOUGH_POINTS, Noise, constant_noise, noise_of, unlikely
from beamfit.studies.scan.outliers import Doubted, Influence, fit_robust, influence_of
from beamfit.studies.scan.questions import check_gradients
from beamfit.studies.scan.results import Points
from beamfit.studies.scan.scans import QuadScan
from beamfit.studies.scan.sigma import SOLVE, SigmaFit, SizeData
from beamfit.studies.scan.statement import Scenario, Seen, Work, asked_of, beam_problem
from beamfit.studies.scan.transport import (
    Look,
    Rows,
    look_through,
    names_of,
    rows_line,
    scan_rows,
    scanned_line,
)
from beamfit.studies.scan.verdict import Evidence, one_magnet, waist_bracketed

# The residual: the report's ``error_linear`` or ``error_nonlinear``.
METHODS = ("size_squared", "size")
# Whose size errors are taken at.
WEIGHTS = ("model", "measured")
# What a plain fit doubts.
NONE: Mapping[str, Doubted] = MappingProxyType({})


def see(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = "size_squared",
    robust: bool = False,
    weights: str = "model",
    at_once: bool = False,
) -> Seen:
    """Look at a scan through its line, and fit it with the line as it is.

    Parameters
    ----------
    scan, line, planes, method, robust, weights
        As for `beamfit.fit_emittance`.
    at_once : bool
        Whether the fit is all that is wanted: it is then one compiled call with the look, where a
        scenario can use the two of a call each again.

    Returns
    -------
    Seen

    Raises
    ------
    InputError
        If the line lacks a magnet or screen of the scan, or a plane was not measured.
    """
    seen = unfitted(scan, line, planes, method, robust, weights)
    # Noise that is inferred is fitted in two ways, by the same program.
    if at_once and not robust and all(noise.known for noise in seen.noises.values()):
        given = [(seen.rows, sizes_of(seen))]
        [(look, found)] = one_by_one(_look_and_fit, given, method, weights)
        return fitted(seen._replace(look=look), found)
    return looked_through([seen])[0]


def prepared(
    scan: QuadScan, line: Beamline | None, scenario: str = "known"
) -> tuple[QuadScan, Beamline]:
    """A scan of one beam with total energies, and its line.

    Raises
    ------
    InputError
        If it is of several slices, or its matrices are both given and unknown.
    """
    if len(scan.slices) > 1:
        found = f"a scan of {len(scan.slices)} slices of the beam"
        raise scan.unusable(found, "rows of one, as scan.of_slice(name) gives")
    line = rows_line(scan) if line is None else line
    _check_own(scan, line, scenario)
    return scan.of_particle(line.mass), line


def _check_own(scan: QuadScan, line: Beamline, scenario: str) -> None:
    """Refuse to have the matrices of rows both given and unknown, or given twice."""
    if scan.transfer is None:
        return
    if line.magnets or float(line.length) > 0.0:
        raise scan.unusable("rows with matrices of their own and a line", "one of the two")
    if scenario != "known":
        expected = "scenario known, or settings and a lattice"
        raise scan.unusable(f"scenario {scenario} for rows with matrices of their own", expected)


def unfitted(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = METHODS[0],
    robust: bool = False,
    weights: str = WEIGHTS[0],
) -> Seen:
    """The scan and its line as `see` takes them, checked, without the look and the fits."""
    check_names(scan, *names_of(line))
    asked = planes or scan.planes
    for plane in asked:
        scan.rows(plane)  # says so if it was not measured
    scanned = scanned_line(scan, line)
    check_gradients(scan, scanned)
    rows = scan_rows(scan, scanned, method == METHODS[0])
    # A plane that is not asked for still testifies to the settings and the optics.
    noises = {plane: noise_of(scan, plane) for plane in dict.fromkeys((*asked, *scan.planes))}
    return Seen(scan, line, scanned, asked, method, robust, weights, rows, noises, None, {})


def one_by_one(function: Callable[..., Any], given: Iterable[tuple], *static: str) -> list[Any]:
    """What a function gives of each, as NumPy arrays."""
    return [jax.tree.map(np.asarray, _compiled(function, each, static)) for each in given]


@partial(jax.jit, static_argnums=(0, 2), compiler_options=SELDOM)
def _compiled(function: Callable[..., Any], given: tuple, static: tuple[str, ...]) -> Any:
    return function(*given, *static)


def looked_through(begun: Sequence[Seen], together: Callable = one_by_one) -> list[Seen]:
    """Look at scans through their lines and fit them, those of inferred noise in two ways."""
    looks = together(look_through, [(seen.rows,) for seen in begun])
    begun = [seen._replace(look=look) for seen, look in zip(begun, looks, strict=True)]
    every = in_closed_form(begun, together)
    others = {i: other for i, seen in enumerate(every) if (other := of_other_kind(seen))}
    for i, other in zip(others, in_closed_form(list(others.values()), together), strict=True):
        every[i] = likelier(every[i], other)
    return every


def in_closed_form(begun: Sequence[Seen], together: Callable = one_by_one) -> list[Seen]:
    """Fit every plane that has a noise, given what is seen of it; all in the same way."""
    if not begun:
        return []
    doubts = [{p: _doubt(seen, p) for p in seen.noises} if seen.robust else {} for seen in begun]
    given = [(seen.look, sizes_of(seen, doubt)) for seen, doubt in zip(begun, doubts, strict=True)]
    found = together(fit_look, given, begun[0].method, begun[0].weights)
    return list(map(fitted, begun, found, doubts))


def _doubt(seen: Seen, plane: str) -> Doubted:
    at, i = seen.measured(plane), "xy".index(plane)
    r11, r12, known = (part[i, at] for part in seen.look[:3])
    return fit_robust(r11, r12, seen.scan.size[plane][at], seen.noises[plane], known, seen.weights)


def fitted(seen: Seen, found: ClosedForm, doubts: Mapping[str, Doubted] = NONE) -> Seen:
    """The same with the closed form of every plane that has a noise, in their order."""
    works = {p: _work(seen, p, found, i, doubts.get(p)) for i, p in enumerate(seen.noises)}
    return seen._replace(works=works)


def of_other_kind(seen: Seen) -> Seen | None:
    """Where noise is inferred, the planes with the same µm at every point; None if there are none.

    ``noises`` and ``works`` are of those planes alone.
    """
    planes = [p for p, noise in seen.noises.items() if not noise.known]
    planes = [p for p in planes if len(seen.measured(p)) >= ENOUGH_POINTS]
    noises = {p: constant_noise(seen.works[p].points.size) for p in planes}
    return seen._replace(noises=noises, works={}) if planes else None


def likelier(seen: Seen, other: Seen) -> Seen:
    """Take of the two kinds of noise the likelier."""
    better = [p for p in other.works if _unlikely(other, p) < _unlikely(seen, p)]
    noises = {p: other.noises[p] for p in better}
    works = {p: other.works[p] for p in better}
    return seen._replace(noises=seen.noises | noises, works=seen.works | works)


def _unlikely(seen: Seen, plane: str) -> float:
    """How unlikely the sizes are by a fit, points that it doubts left out."""
    p = seen.works[plane].points
    kept = np.ones(len(p.size), bool)
    if p.outlier_probability is not None:
        kept = p.outlier_probability < 0.5
    shape = p.weighed ** seen.noises[plane].relative
    return unlikely((p.size - p.model)[kept], shape[kept])


class ClosedForm(NamedTuple):
    """Planes in closed form: the fit, `numbers_of` it, and their errors, not scaled."""

    fit: SigmaFit
    value: Array
    error: Array


class _Sizes(NamedTuple):
    """What `fit_look` needs besides the look; where one plane was measured, it is both."""

    which: np.ndarray
    size: np.ndarray
    error: np.ndarray
    relative: np.ndarray
    factor: np.ndarray
    design: np.ndarray


def sizes_of(seen: Seen, doubts: Mapping[str, Doubted] = NONE) -> _Sizes:
    """The planes that have a noise, with its errors, or those of a robust fit."""
    noises = seen.noises.items()
    planes = [_sizes(seen, plane, doubts.get(plane, noise).error) for plane, noise in noises]
    return _Sizes(*map(np.stack, zip(planes[0], planes[-1], strict=True)))


def _sizes(seen: Seen, plane: str, errors: np.ndarray) -> _Sizes:
    """One plane; the error of a row that has no size of it, as of padding, is infinite."""
    at, asked, count = seen.measured(plane), asked_of(seen, plane), len(seen.rows.energy)
    size, error = np.full(count, 1e-4), np.full(count, np.inf)
    size[at], error[at] = seen.scan.size[plane][at], errors
    relative, own = seen.noises[plane].relative, "xy".index(plane)
    return _Sizes(own, size, error, relative, asked.factor, asked.design)


def fit_look(look: Look, sizes: _Sizes, method: str, weights: str) -> ClosedForm:
    """Fit the planes of a look, and carry σ and its covariance to everything people quote.

    Errors are those of linear propagation, sqrt(∇f C ∇f).
    """
    r11, r12, known, *places = (part[sizes.which] for part in look)

    def one(plane: SizeData, *at: Array) -> ClosedForm:
        fit = SOLVE[method](plane, weights)

        def numbers(sigma: Array) -> Array:
            return numbers_of(sigma, *at)

        slope = jax.jacfwd(numbers)(fit.sigma)
        error = jnp.sqrt(jnp.sum((slope @ fit.covariance) * slope, axis=1))
        return ClosedForm(fit, numbers(fit.sigma), error)

    rows = SizeData(r11, r12, known, sizes.size, sizes.error, sizes.relative)
    return jax.vmap(one)(rows, sizes.factor, *places, sizes.design)


def _look_and_fit(rows: Rows, sizes: _Sizes, method: str, weights: str) -> tuple[Look, ClosedForm]:
    look = look_through(rows)
    return look, fit_look(look, sizes, method, weights)


def _work(seen: Seen, plane: str, found: ClosedForm, i: int, doubt: Doubted | None) -> Work:
    scan, at, noise = seen.scan, seen.measured(plane), seen.noises[plane]
    fit = SigmaFit(*(part[i] for part in found.fit))
    probability = None if doubt is None else doubt.outlier_probability
    lost = 0 if doubt is None else int(np.sum(probability > 0.5))
    size = scan.size[plane][at]
    r11, r12, known = (part["xy".index(plane), at] for part in seen.look[:3])
    dof = max(len(size) - lost - 3, 0)
    unit, chi2 = 1.0, float(fit.chi2)
    if not noise.known:
        unit = math.sqrt((noise.dof + chi2) / (noise.dof + dof))
        chi2 = float(dof)
    scale = math.sqrt(max(1.0, chi2 / dof)) if dof > 0 else 1.0
    model = np.sqrt(np.maximum(size_squared(fit.sigma, r11, r12, known), 0.0))
    points = Points(
        settings={name: v[at] for name, v in scan.settings.items()},
        units={name: SETTING_UNITS[scan.units[name]] for name in scan.settings},
        screen=tuple(seen.rows.places[j] for j in seen.rows.which[at]),
        size=size,
        error=fit.error[at] * unit,
        weighed=fit.weighed[at],
        relative=noise.relative if seen.weights == WEIGHTS[0] else 0.0,
        model=model,
        pull=np.zeros(len(at)),
        outlier_probability=probability,
        r11=r11,
        r12=r12,
        known=known,
    )
    points = points._replace(pull=pulls(points, seen.rows.squared))
    error, covariance = found.error[i] * unit, fit.covariance * unit**2
    evidence = _evidence(fit, points, chi2, dof, noise, scale, unit)
    return Work(points, fit, found.value[i], error, covariance, scale, evidence)


def pulls(p: Points, squared: bool) -> np.ndarray:
    """Residual of the quantity that was fitted, over its error."""
    if squared:
        return (p.size**2 - p.model**2) / (2.0 * p.weighed * p.error)
    return (p.size - p.model) / p.error


def _evidence(
    fit: SigmaFit, p: Points, chi2: float, dof: int, noise: Noise, scale: float, unit: float
) -> Evidence:
    """Gather what the verdict rests on; ``scale * unit`` is the factor on the fit's own errors."""
    factor, doubt = scale * unit, p.outlier_probability
    with np.errstate(invalid="ignore", divide="ignore"):
        determinant = float(fit.determinant / fit.determinant_error / factor)
        zero = math.sqrt(max(float(fit.chi2_zero - fit.chi2), 0.0)) / factor
        error = 0.5 * factor * float(fit.determinant_error / np.sqrt(fit.determinant))
    weight = np.ones(len(p.size)) if doubt is None else 1.0 - doubt
    relative = (p.model - p.size) / p.size
    alone = doubt is None and dof > 1 and bool(fit.positive)
    one = one_magnet(p.settings, p.screen)
    return Evidence(
        full_rank=bool(fit.full_rank),
        positive=bool(fit.positive),
        converged=bool(fit.converged),
        chi2=chi2,
        dof=dof,
        noise_known=noise.known,
        probability=noise.probability(chi2, dof),
        # A robust fit's noise rests on its own judgement.
        rests_on=noise.rests_on(chi2, dof) if doubt is None or not noise.known else float(dof),
        determinant_distance=0.0 if math.isnan(determinant) else determinant,
        zero_distance=0.0 if math.isnan(zero) else zero,
        misfit=float(np.sqrt(np.sum(weight * relative**2) / max(dof, 1))),
        bracketed=waist_bracketed(p.settings, p.screen, p.size, p.error),
        smallest_at_end=one is not None and one[np.argmin(p.size)] in (one.min(), one.max()),
        swamped=bool((p.known > (p.size + 2.0 * p.error) ** 2)[weight > 0.5].any()),
        outliers=0.0 if doubt is None else float(np.mean(doubt > 0.5)),
        robust=doubt is not None,
        influence=influence_of(p, noise, fit.sigma, error) if alone else Influence(),
        constant=None if one is None or dof == 0 else _constant(p, noise),
        scanned=any(np.ptp(v) > 0 for v in p.settings.values()) or len(set(p.screen)) < 3,
    )


def _constant(p: Points, noise: Noise) -> float:
    """How often noise alone makes constant sizes differ as much as these do."""
    weight = p.error**-2.0
    mean = float(weight @ p.size / weight.sum())
    off = float(weight @ (p.size - mean) ** 2)
    dof = len(p.size) - 1
    return chi2_probability(off, dof, math.inf if noise.known else noise.dof + dof - 2)


# The closed form as a problem, starting from its answer, for those who want more than that.
SCENARIO = Scenario("known", lambda seen, _told: beam_problem(seen), closed=True)
