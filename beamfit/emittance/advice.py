"""Advice on the next measurement, for the message of a fit, a plan, and a live scan.

A candidate is one more measured size in each plane, with the relative error of the scan. Where only
the beam is unknown, candidates are rated by the draws of its posterior. Otherwise they are rated by
derivatives of the scenario's problem, which covers calibrations and networks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from beamfit.emittance.comparison import (
    BEAM,
    QUANTILES,
    ZERO_EMITTANCE,
    PlaneSizes,
    compare,
    emittance_quantiles,
)
from beamfit.emittance.model import emittance_parts, predict_sizes, sigma_of, size_squared
from beamfit.emittance.results import PlaneFit, in_words
from beamfit.emittance.statement import PreparedScan, Scanned, size_records, varied_magnets
from beamfit.emittance.transport import NetworkRows, Rows, setting_units
from beamfit.emittance.verdict import PlaneEvidence
from beamfit.greybox import assess
from beamfit.greybox.covariance import MOST_SHARE
from beamfit.greybox.design import Information, greedy, rows_of
from beamfit.greybox.fit import value_and_slope
from beamfit.optics.beamline import Beamline
from beamfit.quantity import NORMAL_REACH
from beamfit.statistics import USEFUL

# Candidate settings: extension beyond either end as a share of the scanned range, and their number.
MAX_EXTENSION, CANDIDATES = 0.5, 41
# A candidate setting below this share of the range is zero but for rounding.
SETTING_TOLERANCE = 1e-9
# Smallest relative error assumed for a further size.
MIN_SIZE_ERROR = 1e-4
# Largest error of ln ε for which the 95 % interval spans no more than the useful factor.
USEFUL_ERROR = float(np.log(USEFUL)) / (2.0 * NORMAL_REACH)


class Candidate(NamedTuple):
    """A further measurement: settings of the magnets, screen, and energy in MeV."""

    settings: dict[str, float]
    screen: str
    energy: float
    words: str


class FurtherSizes(NamedTuple):
    """Predicted further sizes of each plane, m, shape (planes, m), and their Jacobian rows.

    ``rows`` holds derivatives with respect to the free parameters over the errors of the sizes,
    shape (planes, m, n).
    """

    size: np.ndarray
    rows: np.ndarray


# Predicts sizes on a line, at settings, on a screen, at energies (MeV).
Predict = Callable[[Beamline, Mapping[str, np.ndarray], str, np.ndarray], FurtherSizes]
# States which planes are determined, given the information and further measurements.
Determined = Callable[[Information, Sequence[Candidate]], dict[str, bool]]


class Adviser(NamedTuple):
    """Information on the emittances of a scan, and predictions of further sizes.

    Attributes
    ----------
    prepared : PreparedScan
        The scan through its line.
    information : Information
        Information on the emittances.
    predict : callable
        Predicts further sizes, with their rows for the information.
    determined : callable
        States which planes are determined, given the information and further measurements.
    """

    prepared: PreparedScan
    information: Information
    predict: Predict
    determined: Determined

    def errors(self, information: Information) -> dict[str, float]:
        """Relative error of each plane's emittance."""
        return dict(zip(self.prepared.planes, map(float, information.relative_error), strict=True))

    def candidates(
        self,
        limits: Mapping[str, tuple[float, float]] | None,
        screens: Iterable[str],
        energies: Iterable[float] = (),
    ) -> tuple[list[Candidate], np.ndarray]:
        """List single further measurements, and their rows of shape (candidates, planes, n).

        Without limits, candidates are restricted to sizes no larger than the largest measured one
        of either plane, because screens have edges; if none remains, all are listed. Bad readings
        and sizes of no beam do not count as measured.
        """
        found, rows, screens = [], [], tuple(screens)
        largest = max(_largest(self.prepared, plane) for plane in self.prepared.planes)
        for table in candidate_settings(self.prepared.scan.settings, limits).values():
            rows_of_table = zip(*table.values(), strict=True)
            points = [dict(zip(table, map(float, row), strict=True)) for row in rows_of_table]
            for screen, energy in product(screens, (self.prepared.energy, *energies)):
                further = self.predict(
                    self.prepared.scanned, table, screen, np.full(CANDIDATES, energy)
                )
                usable = (further.size <= largest).all(axis=0)
                usable |= limits is not None or not usable.any()
                rows += list(further.rows.swapaxes(0, 1)[usable])
                where = f" on {screen}" if len(screens) > 1 else ""
                where += f" at {energy:g} MeV" if energy != self.prepared.energy else ""
                for i in np.flatnonzero(usable):
                    words = settings_in_words(self.prepared, points[i]) + where
                    found.append(Candidate(points[i], screen, float(energy), words))
        return found, np.array(rows)


def _largest(prepared: PreparedScan, plane: str) -> float:
    """Largest good size of a plane, m; infinite if the sizes are not a beam's."""
    p, probability = (
        prepared.solutions[plane].points,
        prepared.solutions[plane].posterior.probability,
    )
    of_a_beam = probability[BEAM] + probability[ZERO_EMITTANCE] > 0.5
    good = p.size[p.outlier_probability <= 0.5]
    return float(np.max(good, initial=0.0)) if of_a_beam else np.inf


def settings_in_words(
    prepared: PreparedScan, settings: Mapping[str, float], digits: int = 4
) -> str:
    """Settings with the units of the scan."""
    return in_words(settings, setting_units(prepared.scanned, settings), digits)


def candidate_settings(
    settings: Mapping[str, np.ndarray],
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, dict[str, np.ndarray]]:
    """Candidate settings: each magnet over its range in turn, the others at their median.

    Parameters
    ----------
    settings : mapping of str to ndarray
        Measured settings.
    limits : mapping of str to (float, float), optional
        Magnets and their ranges; each scanned one, extended by half its range, if None.

    Returns
    -------
    dict of str to dict
        For each magnet the settings of all magnets, each of shape (41,).

    Examples
    --------
    >>> tables = candidate_settings({"Q": np.array([0.0, 2.0])})
    >>> list(tables), tables["Q"]["Q"][[0, -1]].tolist()
    (['Q'], [-1.0, 3.0])
    """
    if limits is None:
        spans = {n: (v.min(), v.max(), MAX_EXTENSION * np.ptp(v)) for n, v in settings.items()}
        limits = {
            n: (low - extension, high + extension)
            for n, (low, high, extension) in spans.items()
            if extension > 0
        }
    fixed = {n: np.full(CANDIDATES, np.median(v)) for n, v in settings.items()}
    found = {}
    for name, (low, high) in limits.items():
        values = np.linspace(low, high, CANDIDATES)
        values[np.abs(values) < SETTING_TOLERANCE * (high - low)] = 0.0
        found[name] = fixed | {name: values}
    return found


class BeamSpread(NamedTuple):
    """Draws of σ, shape (d, 3), normalised deviations from the mean, weights, and covariance."""

    sigma: np.ndarray
    deviation: np.ndarray
    weight: np.ndarray
    covariance: np.ndarray

    def slope(self, values: np.ndarray) -> np.ndarray:
        """Regress values of the draws, shape (..., d), on σ; slopes of shape (..., 3)."""
        middle = values @ self.weight
        covariances = (values - middle[..., None]) * self.weight @ self.deviation
        return np.linalg.solve(self.covariance, covariances.T).T


def beam_spread(prepared: PreparedScan, plane: str) -> BeamSpread:
    """Draws of a plane's beam, normalised about their mean."""
    post = prepared.solutions[plane].posterior
    sigma, weight = post.sigma, post.weight
    # Each number in units of its rms, so that the covariance is well conditioned.
    unit = np.sqrt(weight @ sigma**2)
    deviation = (sigma - weight @ sigma) / unit
    covariance = (weight[:, None] * deviation).T @ deviation
    return BeamSpread(
        sigma, deviation, weight, covariance + 1e-12 * np.trace(covariance) * np.eye(3)
    )


def draws_adviser(prepared: PreparedScan, fitted: Sequence[PlaneFit] = ()) -> Adviser:
    """Build an adviser from the draws of the beams, where nothing else is unknown.

    Parameters
    ----------
    prepared : PreparedScan
        The scan through its line.
    fitted : sequence of PlaneFit
        Planes with the errors quoted; without them the errors of the draws are used.

    Notes
    -----
    Derivatives of ε and of sizes are those of the linear regression over the draws (C. E. Rasmussen
    and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. A.6).
    """
    determined_now = {p.plane: p.identifiability.determined for p in fitted}
    quoted_errors = {p.plane: p.emittance.relative for p in fitted if p.emittance.error}
    beams = {plane: beam_spread(prepared, plane) for plane in prepared.planes}
    count, roots, slopes = len(beams), [], []
    for plane, s in beams.items():
        drawn = emittances(s.sigma)
        slope = s.slope(drawn / (drawn @ s.weight))
        draws_error = float(np.sqrt(slope @ s.covariance @ slope))
        slopes.append(slope * quoted_errors.get(plane, draws_error) / draws_error)
        roots.append(rows_of(s.covariance))
    free = np.full(3 * count, np.inf)
    arrays = block_diag(*roots), np.ones(count), block_diag(*slopes)

    def predict(line, table, screen, energy) -> FurtherSizes:
        elements = elements_at(prepared, line, table, screen, energy)
        sizes, rows = [], []
        for i, (plane, s) in enumerate(beams.items()):
            r11, r12, further = (v[:, None] for v in elements["xy".index(plane)])
            drawn = np.sqrt(size_squared(s.sigma.T, r11, r12, further))
            size = drawn @ s.weight
            error = relative_error(prepared, plane) * size
            plane_rows = np.zeros((len(size), count, 3))
            plane_rows[:, i] = s.slope(drawn) / error[:, None]
            sizes.append(size)
            rows.append(plane_rows.reshape(len(size), -1))
        return FurtherSizes(np.array(sizes), np.array(rows))

    def determined(_: Information, further: Sequence[Candidate]) -> dict[str, bool]:
        if not further or all(determined_now.values()):
            return determined_now
        rows = []
        for c in further:
            table = {name: np.array([v]) for name, v in c.settings.items()}
            rows.append(
                elements_at(prepared, prepared.scanned, table, c.screen, np.array([c.energy]))
            )
        elements = np.concatenate(rows, axis=-1)
        plane_elements = {plane: elements["xy".index(plane)] for plane in determined_now}
        return {
            plane: already or simulate_further(prepared, plane, *plane_elements[plane])
            for plane, already in determined_now.items()
        }

    information = Information(*arrays, free > 0, -free, free)
    return Adviser(prepared, information, predict, determined)


def emittances(sigma: np.ndarray) -> np.ndarray:
    """Emittances of σ11, σ12, σ22, shape (d, 3) to (d,); zero if σ is not positive definite."""
    return np.sqrt(np.maximum(sigma[:, 0] * sigma[:, 2] - sigma[:, 1] ** 2, 0.0))


def relative_error(prepared: PreparedScan, plane: str) -> float:
    """Relative error expected of a further size of a plane: the scan's median."""
    p = prepared.solutions[plane].points
    return max(float(np.median(p.error / p.size)), MIN_SIZE_ERROR)


def elements_at(
    prepared: PreparedScan,
    line: Beamline,
    table: Mapping[str, np.ndarray],
    screen: str,
    energy: np.ndarray,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """R11, R12 and known size² of both planes at given settings, measured or not."""
    settings = {n: jnp.asarray(v) for n, v in table.items()}
    rows = prepared.rows_at(line, "x", screen, settings, energy)
    return [
        rows.screen_elements(r) for r in np.asarray(rows.both_planes(line, jnp.asarray(energy)))
    ]


def simulate_further(
    prepared: PreparedScan, plane: str, r11: np.ndarray, r12: np.ndarray, known: np.ndarray
) -> bool:
    """Test whether simulated further sizes would determine the emittance of a plane.

    They are the sizes of the mean beam, changed by one error up and down in turn.
    """
    solution = prepared.solutions[plane]
    old, post, n = solution.sizes, solution.posterior, len(r11)
    size = np.sqrt(size_squared(post.weight @ post.sigma, r11, r12, known))
    further_error = relative_error(prepared, plane) * size
    size = size + further_error * (-1.0) ** np.arange(n)
    rows = [np.append(v, w) for v, w in zip(old[:4], (r11, r12, known, size), strict=True)]
    error = None if old.error is None else np.append(old.error, further_error)
    sizes = PlaneSizes(*rows, error, old.of_shots, old.moved)
    [found] = compare([sizes], prepared.noise)
    drawn, none = emittances(found.sigma), found.zero_emittance_probability
    low, high = emittance_quantiles(drawn, found.weight, none, (QUANTILES[0], QUANTILES[-1]))
    return PlaneEvidence(found, sizes, low, high).determined


def next_measurement(prepared: PreparedScan, plane: str) -> str | None:
    """Sentence on the setting that reduces the error of a plane's emittance most, if any."""
    varied, screen = varied_magnets(prepared.scan), prepared.rows.places[-1]
    if not varied or not prepared.solutions[plane].posterior.separable:
        return None
    adviser, i = draws_adviser(prepared), prepared.planes.index(plane)
    candidates, rows = adviser.candidates(None, (screen,))
    information = adviser.information
    plane_information = information._replace(
        value=information.value[[i]], slope=information.slope[[i]]
    )
    best = candidates[next(greedy(plane_information, rows)).index].settings
    median = {name: np.median(v) for name, v in prepared.scan.settings.items()}
    magnet = next((name for name in varied if best[name] != median[name]), varied[0])
    measured = prepared.scan.settings[magnet]
    inside = measured.min() <= best[magnet] <= measured.max()
    others = settings_in_words(
        prepared, {name: v for name, v in median.items() if name != magnet}, 3
    )
    return (
        f"Measure next near {settings_in_words(prepared, {magnet: best[magnet]}, 3)}, "
        f"{'inside' if inside else 'beyond'} the scanned range"
        f"{f', with {others} at {screen}' if others else ''}: this single point reduces the error "
        "most."
    )


def linear_adviser(fit: Scanned) -> Adviser:
    """Build an adviser from derivatives of a scenario's problem.

    Where the data do not determine the parameters, their fitted values are arbitrary. The
    derivatives are then taken at the start: the given line and the closed-form beam.
    """
    prepared, solved, p = fit.seen, fit.solved, fit.solved.problem
    theta, fixed = solved.theta, p.lower == p.upper
    if all(plane.identifiability.determined for plane in fit.planes):
        edge = np.array([v.state in ("lower", "upper") for v in solved.variables])
        fixed = fixed | (edge & p.nuisance)
    else:
        start_problem = fit.statement.state(prepared, fit.told)
        theta = np.clip(start_problem.start, start_problem.lower, start_problem.upper)
    information = Information(
        assess.slopes(p, theta).residual_jacobian,
        *value_and_slope(p, _emittances, theta),
        ~p.nuisance & ~fixed,
        p.lower,
        p.upper,
        fixed,
        np.isin(np.array(p.names), [prior.name for prior in p.priors]),
    )
    rows_at_settings = _line_rows if fit.statement.whole_map else _network_rows

    def predict(line, table, screen, energy) -> FurtherSizes:
        sizes, rows = [], []
        for plane in prepared.planes:
            data = rows_at_settings(fit, line, plane, table, screen, energy)
            size, slope = value_and_slope(p, predict_sizes, theta, data)
            rows.append(slope / (relative_error(prepared, plane) * size)[:, None])
            sizes.append(1e-6 * size)
        return FurtherSizes(np.array(sizes), np.array(rows))

    return Adviser(
        prepared, information, predict, lambda after, _: determined_planes(prepared, after)
    )


def determined_planes(prepared: PreparedScan, information: Information) -> dict[str, bool]:
    """State for each plane whether data and priors give its emittance to a useful precision."""
    determined = (information.relative_error <= USEFUL_ERROR) & (information.share < MOST_SHARE)
    return dict(zip(prepared.planes, map(bool, determined), strict=True))


def _emittances(model, data):
    """Emittance of each plane of a model."""
    return jnp.stack([emittance_parts(sigma_of(beam))[0] for beam in model["beam"].values()])


def _line_rows(fit: Scanned, line, plane, table, screen, energy) -> Rows:
    """Rows of a further size through the line."""
    measured = size_records(fit.solved.problem)[plane].data
    shapes = {n: np.ndim(v) for n, v in measured.settings.items()}
    # For a magnet with hysteresis, a further point is measured on the rising branch.
    settings = {
        n: jnp.stack([v, jnp.ones(len(v))], -1) if shapes.get(n) == 2 else jnp.asarray(v)
        for n, v in table.items()
    }
    return fit.seen.rows_at(line, plane, screen, settings, np.asarray(energy))


def _network_rows(fit: Scanned, line, plane, table, screen, energy) -> NetworkRows:
    """Rows of a further size through a transport network."""
    measured, prepared, count = size_records(fit.solved.problem)[plane].data, fit.seen, len(energy)
    place = prepared.rows.places.index(screen)
    row = next(i for i in prepared.measured(plane) if prepared.rows.screen_index[i] == place)
    inputs = [table.get(n, np.full(count, prepared.energy)) for n in fit.solved.model["map"].inputs]
    known = jnp.full(count, float(np.median(np.asarray(measured.known))))
    columns, damping = jnp.tile(measured.columns[row], (count, 1)), jnp.ones(count)
    return NetworkRows(plane, False, jnp.asarray(np.stack(inputs, -1)), columns, known, damping)


def adviser_of(fit: Scanned) -> Adviser:
    """Adviser of a fit, for any scenario."""
    return draws_adviser(fit.seen, fit.planes) if fit.solved is None else linear_adviser(fit)
