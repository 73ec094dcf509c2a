"""What the emittance would be if something were a little different.

The systematics budget takes the exact derivative of the whole chain, transport and fit, by
each number of the line; the range table refits without some points.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import CurrentPolynomial, SlopeIntercept
from beamfit.optics.elements import Drift
from beamfit.optics.sections import Series
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.results import PlaneFit, Points
from beamfit.studies.scan.sigma import emittance_parts, fit_sizes
from beamfit.studies.scan.transport import (
    ScanRows,
    plane_input,
    scan_rows,
    scanned_line,
    transfer_rows,
)

__all__ = [
    "Change",
    "RangeRow",
    "budget_rows",
    "range_rows",
    "range_sensitivity",
    "systematics",
]


# Leaving out one of more points than this tells nothing.
MOST_POINTS = 50


class Change(NamedTuple):
    """What one small change of the line does to the emittance.

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


def systematics(fit: EmittanceFit, plane: str) -> list[Change]:
    """Change of the emittance for +1 % of each scanned magnet, +1 cm of each drift, +1 % energy.

    Parameters
    ----------
    fit : EmittanceFit
        A fit.
    plane : str
        "x" or "y".

    Returns
    -------
    list of Change
        Empty where the emittance is not determined. First order: exact
        derivatives (through transport, and through the minimum by the implicit function
        theorem) times the step.

    Examples
    --------
    >>> from beamfit.optics.beam import BeamMatrix
    >>> from beamfit.optics.elements import Quadrupole, Screen
    >>> from beamfit.studies.scan.emittance import fit_emittance
    >>> from beamfit.studies.scan.scans import QuadScan
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), energy=135.0)
    >>> k1 = np.linspace(-2.0, 12.0, 8)
    >>> sizes = [float(BeamMatrix.from_twiss(2e-9, 5.0, 0.0).transport(
    ...     line.matrix({"Q": k}).x).l11) for k in k1]
    >>> fit = fit_emittance(QuadScan({"Q": k1}, {"Q": "k1"}, {"x": sizes}), line)
    >>> [c.cause for c in systematics(fit, "x")]
    ['Q strength +1 %', 'drift D +1 cm', 'energy +1 %']
    """
    result = fit[plane]
    if result.emittance.error is None:
        return []
    scanned = scanned_line(fit.scan, fit.line)
    rows = scan_rows(fit.scan, scanned)
    magnets = tuple(n for n, v in fit.scan.settings.items() if np.ptp(v) > 0)
    upstream = fit.line.upto(result.screen.name).elements
    drifts = tuple(e.name for e in upstream if isinstance(e, Drift))
    matrices = transfer_rows(scanned, rows.settings, rows.energy, places=rows.places)
    given = plane_input(fit.scan, scanned, rows, matrices, plane)
    keep = np.flatnonzero(~np.isnan(fit.scan.size[plane]))
    by_r11, by_r12, by_known = _log_emittance_gradient(
        np.array([q.value for q in result.sigma]),
        given.r11,
        given.r12,
        given.known,
        given.size,
        result.points.error,
        method=result.method,
    )
    by_r16 = np.asarray(by_known) * 2.0 * given.r16 * given.energy_spread**2
    by_planes = np.zeros(matrices.planes.shape)
    by_planes[keep, "xy".index(plane), rows.which[keep], 0] = np.stack([by_r11, by_r12, by_r16], -1)
    relative = _relative_changes(scanned, rows, by_planes, magnets, len(drifts))
    # ln βγ rises by E²/(E² - m²) for each relative step of the energy.
    energy = given.energy.mean()
    stiffer = energy**2 / (energy**2 - fit.line.mass**2)
    causes = [f"{n} {_word(scanned, n)} +1 %" for n in magnets]
    causes += [f"drift {n} +1 cm" for n in drifts] + ["energy +1 %"]
    normalised = relative + np.append(np.zeros(len(relative) - 1), stiffer)
    return [
        Change(cause, 0.01 * float(e), 0.01 * float(n))
        for cause, e, n in zip(causes, relative, normalised, strict=True)
    ]


def _word(line: Beamline, magnet: str) -> str:
    calibration = line[magnet].calibration
    if isinstance(calibration, SlopeIntercept):
        return "slope"
    return "gradient" if calibration.unit in ("A", "kG") else "strength"


def _scaled(line: Beamline, magnet: str, factor: Array) -> Beamline:
    """Scale what a magnet's setting means: the slope of a line, else all of the strength."""
    element = line[magnet]
    c = element.calibration
    if isinstance(c, SlopeIntercept):
        c = replace(c, slope=c.slope * factor)
    elif isinstance(c, CurrentPolynomial):
        c = replace(c, coefficients=tuple(v * factor for v in c.coefficients))
    else:
        c = replace(c, scale=c.scale * factor)
    return line.with_element(replace(element, calibration=c))


def _relative_changes(
    line: Beamline, rows: ScanRows, by_planes: np.ndarray, magnets: tuple[str, ...], drifts: int
) -> np.ndarray:
    """Derivatives by the strength of each magnet, the length of each drift, and ln E.

    ``by_planes`` holds the derivatives by the matrices of all rows: one reverse pass carries them
    back to every number of the line, however long it is.
    """
    stored = line.stored_by_kind((*rows.settings, *rows.places))
    energy = rows.energy if np.ptp(rows.energy) > 0 else rows.energy[0]
    by_change, by_lengths = _slopes(
        stored, rows.settings, energy, by_planes, places=rows.places, magnets=magnets
    )
    by_length = np.concatenate([*by_lengths, np.zeros(0)])[:drifts]  # the rest lies downstream
    return np.concatenate([by_change[:-1], by_length, by_change[-1:]])


@partial(jax.jit, static_argnames=("places", "magnets"))
def _slopes(line, settings, energy, by_planes, *, places, magnets):
    """Derivatives by each magnet's strength and ln E, and by the lengths of drifts."""

    def total(change: Array, lengths: list[Array]) -> Array:
        moved = _with_lengths(line, lengths)
        for i, name in enumerate(magnets):
            moved = _scaled(moved, name, 1.0 + change[i])
        rows = transfer_rows(moved, settings, energy * (1.0 + change[-1]), places)
        return jnp.vdot(by_planes, rows.planes)

    series = [s for s in line.elements if isinstance(s, Series)]
    lengths = [k.length for s in series for k in s.kinds if isinstance(k, Drift)]
    return jax.grad(total, (0, 1))(jnp.zeros(len(magnets) + 1), lengths)


def _with_lengths(line: Beamline, lengths: list[Array]) -> Beamline:
    """Give the drifts of a line that is stored by kind other lengths."""
    left = iter(lengths)
    elements = []
    for part in line.elements:
        if isinstance(part, Series):
            kinds = (Drift("", next(left)) if isinstance(k, Drift) else k for k in part.kinds)
            part = replace(part, kinds=tuple(kinds))
        elements.append(part)
    return replace(line, elements=tuple(elements))


@partial(jax.jit, static_argnames="method")
def _log_emittance_gradient(sigma, r11, r12, known, size, error, *, method):
    """Gradient of ln ε of the fit by R11, R12 and the known part, each of shape (n,).

    At the minimum the slope F(σ, rows) of χ² is zero, so dσ = -(∂F/∂σ)⁻¹ ∂F/∂rows: exact for
    either residual, without differentiating the solver.
    """
    unit = jnp.abs(sigma)

    def chi2(relative: Array, rows: tuple[Array, Array, Array]) -> Array:
        a, b, extra = rows
        design = jnp.stack([a**2, 2.0 * a * b, b**2], -1)
        squared = design @ (relative * unit) + extra
        if method == "size":
            return jnp.sum(((jnp.sqrt(squared) - size) / error) ** 2)
        return jnp.sum(((squared - size**2) / (2.0 * size * error)) ** 2)

    rows, here = (r11, r12, known), sigma / unit
    slope = jax.grad(chi2)
    curvature = jax.jacfwd(slope)(here, rows)
    by_sigma = jax.grad(lambda s: jnp.log(emittance_parts(s * unit)[0]))(here)
    weights = jnp.linalg.solve(curvature, by_sigma)
    return jax.grad(lambda rows: -weights @ slope(here, rows))(rows)


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
    # One at a time: a batch of another shape would be compiled for this table alone.
    fits = [
        fit_sizes(p.r11, p.r12, p.size, np.where(k, p.error, np.inf), p.known, method=plane.method)
        for _, k in rows
    ]
    emittance = [math.sqrt(f.determinant) if f.positive else math.nan for f in fits]
    factor = (
        plane.normalized_emittance.value / plane.emittance.value if plane.emittance.value else 0
    )
    error = plane.emittance.error
    return [
        RangeRow(
            name,
            float(e * factor),
            float((e - plane.emittance.value) / error) if error else float("nan"),
        )
        for (name, _), e in zip(rows, emittance, strict=True)
    ]


def _place(points: Points, i: int) -> str:
    """Name a point by its screen, where there are several, and the settings that vary."""
    varied = [
        f"{n} = {v[i]:.4g} {points.units[n]}" for n, v in points.settings.items() if np.ptp(v) > 0
    ]
    screen = [points.screen[i]] if len(set(points.screen)) > 1 else []
    return ", ".join(screen + varied)


def budget_rows(fit: EmittanceFit) -> list[tuple[str, list[str]]]:
    """Cause and one cell per plane: the change of the normalised emittance."""
    columns = [{c.cause: c for c in systematics(fit, p.plane)} for p in fit.planes]
    causes = dict.fromkeys(cause for column in columns for cause in column)
    return [
        (
            cause,
            [
                f"{100 * column[cause].normalized_emittance:+.2f} %" if cause in column else "-"
                for column in columns
            ],
        )
        for cause in causes
    ]


def range_rows(fit: EmittanceFit) -> list[tuple[str, list[str]]]:
    """What was left out and one cell per plane: the normalised emittance and its shift."""
    columns = [{r.left_out: r for r in range_sensitivity(p)} for p in fit.planes]
    names = dict.fromkeys(name for column in columns for name in column)
    return [(name, [_range_cell(column.get(name)) for column in columns]) for name in names]


def _range_cell(row: RangeRow | None) -> str:
    if row is None or math.isnan(row.normalized_emittance):
        return "-" if row is None else "none"
    shift = "" if math.isnan(row.shift) else f" ({row.shift:+.1f})"
    return f"{row.normalized_emittance * 1e6:.3f} µm{shift}"
