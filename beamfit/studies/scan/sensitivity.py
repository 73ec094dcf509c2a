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
from beamfit.studies.scan.known import WEIGHTS
from beamfit.studies.scan.model import emittance_parts, size_squared
from beamfit.studies.scan.results import PlaneFit, Points
from beamfit.studies.scan.sigma import error_at, fit_sizes, weighed_size
from beamfit.studies.scan.statement import varied_magnets
from beamfit.studies.scan.transport import Rows, padded

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
# Nobody reads a budget of more causes than this.
MOST_CAUSES = 30


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
    >>> from beamfit.studies.scan.fit import fit_emittance
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
    rows, p = fit.seen.of_plane(plane), result.points
    magnets = varied_magnets(fit.scan)
    upstream = fit.line.upto(result.screen.name).elements
    drifts = tuple(e.name for e in upstream if isinstance(e, Drift))
    keep = fit.seen.measured(plane)
    size, weighed, sharp = np.ones((3, len(rows.energy))) * [[1.0], [1.0], [0.0]]
    size[keep], weighed[keep], sharp[keep] = p.size, p.weighed, 1.0 / p.error
    follows = fit.seen.weights == WEIGHTS[0]
    noise = _Weighing(weighed, sharp, np.array(p.relative), np.array(float(follows)))
    sigma = np.array([q.value for q in result.sigma])
    stored = replace(rows, line=fit.seen.scanned.stored_by_kind((*rows.settings, *rows.places)))
    by_change, by_lengths = _changes(stored, sigma, size, noise, magnets=magnets)
    by_length = np.concatenate([*by_lengths, np.zeros(0)])[: len(drifts)]  # the rest is downstream
    relative = np.concatenate([by_change[:-1], by_length, by_change[-1:]])
    # ln βγ rises by E²/(E² - m²) for each relative step of the energy.
    energy = fit.seen.energy
    stiffer = energy**2 / (energy**2 - fit.line.mass**2)
    causes = [f"{n} {_word(fit.seen.scanned, n)} +1 %" for n in magnets]
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
    return "gradient" if calibration.unit in ("A", "kG", "T_per_m") else "strength"


def _scaled(line: Beamline, magnet: str, factor: Array) -> Beamline:
    """Scale what a magnet's setting means: the slope of a line, else all of the strength."""
    for member in line.members(magnet):
        element = line[member]
        c = element.calibration
        if isinstance(c, SlopeIntercept):
            c = replace(c, slope=c.slope * factor)
        elif isinstance(c, CurrentPolynomial):
            c = replace(c, coefficients=tuple(v * factor for v in c.coefficients))
        else:
            c = replace(c, scale=c.scale * factor)
        line = line.with_element(replace(element, calibration=c))
    return line


class _Weighing(NamedTuple):
    """Sizes that weights are taken at, 1/error there, and whether each follows the model's size."""

    weighed: Array
    sharp: Array
    relative: Array
    follows: Array


@partial(jax.jit, static_argnames="magnets")
def _changes(rows: Rows, sigma: Array, size: Array, noise: _Weighing, *, magnets):
    """Derivatives of ln ε of the fit by each magnet's strength and ln E, and by lengths of drifts.

    At the answer the weighted residuals F(σ, rows) = Σ w ∂m²/∂σ (m² - size²) vanish, so dσ =
    -(∂F/∂σ)⁻¹ ∂F/∂rows: exact for either residual, without differentiating the solver, weights
    that follow the model included. One reverse pass carries that back to every number of the line,
    however long it is.
    """
    unit = jnp.abs(sigma)

    def elements(change: Array, lengths: list[Array]) -> tuple[Array, ...]:
        moved = _with_lengths(rows.line, lengths)
        for i, name in enumerate(magnets):
            moved = _scaled(moved, name, 1.0 + change[i])
        energy = rows.energy * (1.0 + change[-1])
        return replace(rows, line=moved, energy=energy).elements({})

    def slope(relative: Array, seen: tuple[Array, ...]) -> Array:
        def squared_of(r: Array) -> Array:
            return size_squared(r * unit, *seen)

        squared, back = jax.vjp(squared_of, relative)
        if not rows.squared:
            return back((jnp.sqrt(squared) - size) * noise.sharp**2 / jnp.sqrt(squared))[0]
        at = noise.weighed + noise.follows * (weighed_size(size, squared) - noise.weighed)
        grown = error_at(at, noise.weighed, 1.0, noise.relative)
        return back((squared - size**2) * (noise.sharp / (at * grown)) ** 2)[0]

    series = [s for s in rows.line.elements if isinstance(s, Series)]
    lengths = [k.length for s in series for k in s.kinds if isinstance(k, Drift)]
    none, here = jnp.zeros(len(magnets) + 1), sigma / unit
    seen = elements(none, lengths)
    by_sigma = jax.grad(lambda s: jnp.log(emittance_parts(s * unit)[0]))(here)
    weights = jnp.linalg.solve(jax.jacfwd(slope)(here, seen), by_sigma)

    def moved_emittance(change: Array, lengths: list[Array]) -> Array:
        return -weights @ slope(here, elements(change, lengths))

    return jax.grad(moved_emittance, (0, 1))(none, lengths)


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
    emittance = [_without(plane, ~k) for _, k in rows]
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


def _without(plane: PlaneFit, left_out: np.ndarray) -> float:
    """The emittance without some points; NaN where the rest has none."""
    p = plane.points
    error = error_at(p.size, p.weighed, p.error, p.relative)
    rows = (p.r11, p.r12, p.size, np.where(left_out, np.inf, error), p.known)
    full = [padded(v) for v in rows]
    full[3][len(p.size) :] = np.inf
    # One at a time: a batch of another shape would be compiled for this table alone.
    fit = fit_sizes(*full, method=plane.method, relative=p.relative, weights=plane.weights)
    return math.sqrt(fit.determinant) if fit.positive else math.nan


def _place(points: Points, i: int) -> str:
    """Name a point by its screen, where there are several, and the settings that vary."""
    varied = [
        f"{n} = {v[i]:.4g} {points.units[n]}" for n, v in points.settings.items() if np.ptp(v) > 0
    ]
    screen = [points.screen[i]] if len(set(points.screen)) > 1 else []
    return ", ".join(screen + varied)


def budget_rows(fit: EmittanceFit) -> list[tuple[str, list[str]]]:
    """Cause and one cell per plane: the change of the normalised emittance.

    Of a long line the largest changes, and how large the others are at most.
    """
    columns = [{c.cause: c for c in systematics(fit, p.plane)} for p in fit.planes]
    largest: dict[str, float] = {}
    for change in (c for column in columns for c in column.values()):
        size = abs(change.normalized_emittance)
        largest[change.cause] = max(size, largest.get(change.cause, 0.0))
    ranked = sorted(largest, key=largest.__getitem__, reverse=True)
    shown, others = frozenset(ranked[:MOST_CAUSES]), ranked[MOST_CAUSES:]
    rows = [
        (
            cause,
            [
                f"{100 * column[cause].normalized_emittance:+.2f} %" if cause in column else "-"
                for column in columns
            ],
        )
        for cause in largest
        if cause in shown
    ]
    if others:
        most = [f"±{100 * largest[others[0]]:.2g} % at most" for _ in columns]
        rows.append((f"{len(others)} other causes, each", most))
    return rows


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
