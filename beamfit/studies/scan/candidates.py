"""What further measurements would tell: settings within limits, other screens, other energies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.greybox import assess
from beamfit.greybox.covariance import MOST_SHARE
from beamfit.greybox.design import Information
from beamfit.greybox.fit import value_and_slope
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Screen
from beamfit.studies.scan.calibration import Kind, numbers_of_magnets
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.model import emittance_parts, predict_sizes, sigma_of, spoken
from beamfit.studies.scan.next_point import candidate_settings
from beamfit.studies.scan.results import in_words
from beamfit.studies.scan.statement import size_records, varied_magnets
from beamfit.studies.scan.transport import NetworkRows, Rows, rows_at, setting_units
from beamfit.studies.scan.verdict import USEFUL

# The error of ln ε whose 95 % interval spans the factor within which an emittance is of use.
NARROW = float(np.log(USEFUL)) / 3.92


def by_plane(fit: EmittanceFit, known: Information) -> dict[str, float]:
    """Relative error of each plane's emittance."""
    error = map(float, known.relative_error)
    return dict(zip((p.plane for p in fit.planes), error, strict=True))


def determined_by(fit: EmittanceFit, known: Information) -> dict[str, bool]:
    """Whether each plane's emittance rests on data and priors, within a factor that is of use."""
    clear = (known.relative_error <= NARROW) & (known.share < MOST_SHARE)
    return dict(zip((p.plane for p in fit.planes), map(bool, clear), strict=True))


def information_of(fit: EmittanceFit) -> Information:
    """Gather the information of a fit in any scenario.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.

    Returns
    -------
    Information
    """
    p, theta = fit.problem, linearised_at(fit)
    jacobian = assess.slopes(p, theta).residual_jacobian
    if fit.solved is None:
        jacobian = jacobian / _beyond_linear(fit)[:, None]
    held = p.lower == p.upper
    if fit.solved is not None and _determined(fit):
        edge = np.array([v.state in ("lower", "upper") for v in fit.fit.variables])
        held = held | (edge & p.nuisance)
    return Information(
        jacobian,
        *value_and_slope(p, _emittances, theta),
        ~p.nuisance & ~held,
        p.lower,
        p.upper,
        held,
        np.isin(np.array(p.names), [prior.name for prior in p.priors]),
    )


def _beyond_linear(fit: EmittanceFit) -> np.ndarray:
    """The error that a fit quotes over that of linear theory, for each row of known transport."""
    factors = []
    for record in fit.problem.records:
        plane = fit[record.data.plane]
        post, factor = fit.seen.works[plane.plane].posterior, 1.0
        if plane.emittance.error is not None:
            s11, s12, s22 = post.best
            slope = np.array([s22, -2.0 * s12, s11]) / (2.0 * np.sqrt(s11 * s22 - s12**2))
            linear = float(np.sqrt(slope @ post.covariance @ slope))
            factor = plane.emittance.error / linear
        factors.append(np.full(record.measured.size, factor))
    return np.concatenate(factors)


def linearised_at(fit: EmittanceFit) -> np.ndarray:
    """Where to take derivatives: at the answer, or at first principles where there is none.

    Numbers that the data do not determine end anywhere; what a measurement would tell is then
    asked of the line and the beam one started from.
    """
    if fit.solved is None:
        return fit.problem.start
    if _determined(fit):
        return fit.fit.theta
    return np.clip(fit.stated.start, fit.stated.lower, fit.stated.upper)


def _determined(fit: EmittanceFit) -> bool:
    return all(plane.identifiability.determined for plane in fit.planes)


def _emittances(model, data):
    return jnp.stack([emittance_parts(sigma_of(beam))[0] for beam in model["beam"].values()])


# Other energies to consider where none is named: what a linac can usually do.
USUAL_ENERGIES = (0.8, 1.25)


class Candidate(NamedTuple):
    """A further measurement: settings of the magnets, screen, and energy in MeV."""

    settings: dict[str, float]
    screen: str
    energy: float
    words: str


def candidate_rows(
    fit: EmittanceFit,
    limits: Mapping[str, tuple[float, float]] | None,
    energies: tuple[float, ...],
) -> tuple[list[Candidate], np.ndarray]:
    """List single further measurements with their rows of the Jacobian.

    Parameters
    ----------
    fit : EmittanceFit
        What is measured already.
    limits : mapping of str to (float, float), or None
        Magnets that may be set, each in turn over 41 settings, the others at their median.
    energies : tuple of float
        Further energies, MeV.

    Returns
    -------
    list of Candidate and ndarray
        At every screen of the line, and every energy; rows of shape (candidates, planes, n).

    Raises
    ------
    InputError
        If limits name no magnet of the line, or are reversed.
    """
    own, screens, found, rows = fit.seen.energy, _screens(fit), [], []
    for name, table in candidate_settings(fit.scan.settings, _checked(fit, limits)):
        points = [{n: float(v[i]) for n, v in table.items()} for i in range(len(table[name]))]
        for screen, energy in product(screens, (own, *energies)):
            every = _rows(fit, fit.seen.scanned, table, screen, np.full(len(points), energy))
            rows += list(every.swapaxes(0, 1))
            there = f" on {screen}" if len(screens) > 1 else ""
            there += f" at {energy:g} MeV" if energy != own else ""
            for settings in points:
                words = _in_words(fit, settings) + there
                found.append(Candidate(settings, screen, float(energy), words))
    return found, np.array(rows)


def _checked(fit: EmittanceFit, limits):
    """Limits of magnets that can be set, refused if they cannot be used, or if none can be told."""
    if fit.scan.transfer:
        found = "advice on rows with matrices of their own"
        raise fit.scan.unusable(found, "a lattice in which other settings can be tried")
    if not limits and not varied_magnets(fit.scan):
        found = "advice on a scan that moved no magnet"
        raise fit.scan.unusable(found, "limits of a magnet, such as --vary Q1=LOW:HIGH")
    for name, (low, high) in (limits or {}).items():
        if name not in fit.seen.scanned.magnets:
            raise InputError(
                f"limits of '{name}'", nearest(name, list(fit.seen.scanned.magnets)) + ", a magnet"
            )
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"limits {low:g}:{high:g} of {name}", "finite limits, lower first")
        if not fit.statement.whole_map and name not in varied_magnets(fit.scan):
            raise InputError(f"limits of '{name}', which was not scanned", "a scanned magnet")
    return limits


def _screens(fit: EmittanceFit) -> tuple[str, ...]:
    """Screens to measure at: all of the line, downstream of a scanned magnet."""
    measured = fit.seen.rows.places
    if not fit.statement.whole_map:  # another screen has another network
        return measured
    names, magnets = _along(fit)
    later = [s for s in fit.seen.scanned.screens if names.index(s) > min(magnets)]
    return tuple(dict.fromkeys((*measured, *later)))


def _along(fit: EmittanceFit) -> tuple[list[str], list[int]]:
    """Names along the line, and where in them the scanned magnets stand."""
    line = fit.seen.scanned
    names = [e.name for e in line.elements]
    magnets = [m for name in varied_magnets(fit.scan) for m in line.members(name)]
    return names, [names.index(m) for m in magnets] or [-1]


def _in_words(fit: EmittanceFit, settings: Mapping[str, float]) -> str:
    """Settings with the units of the scan."""
    return in_words(settings, setting_units(fit.seen.scanned, settings))


def _rows(
    fit: EmittanceFit,
    line: Beamline,
    table: Mapping[str, np.ndarray],
    screen: str,
    energy: np.ndarray,
) -> np.ndarray:
    """Derivatives of sizes by the free numbers over their errors, shape (planes, m, n)."""
    problem, theta = fit.problem, linearised_at(fit)
    found = []
    for plane in fit.planes:
        relative = np.median(plane.points.error / plane.points.size)
        if fit.statement.whole_map:
            data = _line_rows(fit, line, plane.plane, table, screen, energy)
        else:
            data = _network_rows(fit, plane.plane, table, screen)
        size, slope = value_and_slope(problem, predict_sizes, theta, data)
        found.append(slope / (max(float(relative), 1e-4) * size)[:, None])
    return np.array(found)


def _line_rows(fit, line, plane, table, screen, energy) -> Rows:
    count = len(energy)
    measured = size_records(fit.problem)[plane].data
    shapes = {n: np.ndim(v) for n, v in measured.settings.items()}
    # Where a magnet has branches, a further point is measured on the rising one.
    settings = {
        n: jnp.stack([v, jnp.ones(count)], -1) if shapes.get(n) == 2 else jnp.asarray(v)
        for n, v in table.items()
    }
    known = fit.seen.known_at(line, screen)
    return rows_at(line, plane, screen, settings, np.asarray(energy), *known)


def _network_rows(fit, plane, table, screen) -> NetworkRows:
    measured, seen = size_records(fit.problem)[plane].data, fit.seen
    place = seen.rows.places.index(screen)
    which = next(i for i in seen.measured(plane) if seen.rows.which[i] == place)
    count = len(next(iter(table.values())))
    names = fit.fit.model["map"].inputs
    inputs = [table.get(n, np.full(count, fit.seen.energy)) for n in names]
    return NetworkRows(
        plane,
        False,
        jnp.asarray(np.stack(inputs, -1)),
        jnp.tile(measured.columns[which], (count, 1)),
        jnp.full(count, float(np.median(np.asarray(measured.known)))),
        jnp.ones(count),
    )


def further_options(
    fit: EmittanceFit, base: Information, energies: tuple[float, ...]
) -> Iterator[tuple[str, np.ndarray]]:
    """Kinds of measurement that might identify a scenario, each with its rows.

    A single size at every other screen, the same scan at it; the same scan at other energies;
    and, where the line has no second screen, at screens one could put into its drifts.

    Parameters
    ----------
    fit : EmittanceFit
        What is measured already.
    base : Information
        Its information.
    energies : tuple of float
        Energies to consider, MeV; 20 % below and 25 % above if empty.

    Yields
    ------
    tuple of str and ndarray
        Words, and rows of shape (m, n).
    """
    table = {n: np.asarray(v) for n, v in fit.scan.settings.items()}
    own = fit.seen.energy
    energy = np.full(len(fit.scan), own) if fit.scan.energy is None else fit.scan.energy
    if fit.statement.whole_map:
        for line, screen, words in _other_screens(fit):
            rows = _rows(fit, line, table, screen, energy)
            best = min(range(rows.shape[1]), key=lambda i: _worst(base.with_rows(rows[:, i])))
            at = _in_words(fit, {n: float(v[best]) for n, v in table.items()})
            yield f"one size on {words} ({at})", rows[:, best]
            yield f"the same scan on {words}", rows.reshape(-1, rows.shape[-1])
        for factor in energies or tuple(own * f for f in USUAL_ENERGIES):
            screen = (fit.scan.screen or fit.seen.rows.places)[-1]
            rows = _rows(fit, fit.seen.scanned, table, screen, np.full(len(fit.scan), factor))
            yield f"the same scan at {factor:.4g} MeV", rows.reshape(-1, rows.shape[-1])
    yield from _priors(fit)


def _worst(after: Information) -> float:
    """Relative error that counts bounds as nothing: large while they decide."""
    return float(after.relative_error.max() / max(1.0 - after.share.max(), 1e-6))


def _other_screens(fit: EmittanceFit) -> list[tuple[Beamline, str, str]]:
    """Screens that were not used, or else places for one in the drifts after the magnets."""
    line = fit.seen.scanned
    unused = [s for s in _screens(fit) if s not in fit.seen.rows.places]
    if unused:
        return [(line, s, f"screen {s}") for s in unused]
    _, magnets = _along(fit)
    found = []
    for i, element in enumerate(line.elements):
        if i > max(magnets) and isinstance(element, Drift) and element.length > 0.3:
            half = replace(element, length=0.5 * element.length)
            elements = (*line.elements[:i], half, Screen("NEW"), half, *line.elements[i + 1 :])
            words = f"a new screen in the middle of {element.name}"
            found.append((replace(line, elements=elements), "NEW", words))
    return found


def _priors(fit: EmittanceFit) -> Iterator[tuple[str, np.ndarray]]:
    """A 2 % measurement of each slope, as from a field map of the magnet."""
    slopes = {
        f"magnets.{name}": number.value
        for name, number in numbers_of_magnets(fit.seen.scanned).items()
        if number.kind is Kind.slope
    }
    for i, name in enumerate(fit.problem.names):
        if name in slopes:
            row = np.zeros((1, len(fit.problem.names)))
            row[0, i] = 1.0 / (0.02 * abs(slopes[name]))
            yield f"a prior of 2 % on {spoken(name)}", row
