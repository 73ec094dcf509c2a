"""Advice on what to measure next: one adviser for the sentence of a fit, a plan, and a live scan.

Every candidate is one more measured size of each plane, with the relative error the scan has. Where
nothing but the beam is unknown it is judged by the draws of the posterior, else by derivatives of
the scenario's problem, so that the advice holds for calibrations and networks as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from beamfit.emittance.comparison import AT, BEAM, FLAT, PlaneSizes, compare, emittance_quantiles
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

# Candidates reach half the scanned range beyond either end.
REACH, COUNT = 0.5, 41
# A setting below this share of the range is the rounding of zero.
ROUNDING = 1e-9
# A further size is known no better than this share of itself.
SHARPEST = 1e-4
# The error of ln ε whose 95 % interval spans the factor within which an emittance is of use.
NARROW = float(np.log(USEFUL)) / (2.0 * NORMAL_REACH)


class Candidate(NamedTuple):
    """A further measurement: settings of the magnets, screen, and energy in MeV."""

    settings: dict[str, float]
    screen: str
    energy: float
    words: str


class Further(NamedTuple):
    """Further sizes of each plane: predicted, m, shape (planes, m), and their rows of a Jacobian.

    ``rows`` has the derivatives by the free numbers over the sizes' errors, (planes, m, n).
    """

    size: np.ndarray
    rows: np.ndarray


# Further sizes on a line, at settings, on a screen, at energies (MeV).
Predict = Callable[[Beamline, Mapping[str, np.ndarray], str, np.ndarray], Further]
# Which planes are determined, by what is known and by what is measured further.
Judge = Callable[[Information, Sequence[Candidate]], dict[str, bool]]


class Adviser(NamedTuple):
    """Information on the emittances of a scan, to which further sizes add.

    Attributes
    ----------
    seen : PreparedScan
        The scan through its line.
    information : Information
        Of their emittances.
    predict : callable
        Further sizes, with their rows for the information.
    determined : callable
        Which planes are determined, by what is known and what is measured further.
    """

    seen: PreparedScan
    information: Information
    predict: Predict
    determined: Judge

    def errors(self, known: Information) -> dict[str, float]:
        """Relative error of each plane's emittance."""
        return dict(zip(self.seen.planes, map(float, known.relative_error), strict=True))

    def candidates(
        self,
        limits: Mapping[str, tuple[float, float]] | None,
        screens: Iterable[str],
        energies: Iterable[float] = (),
    ) -> tuple[list[Candidate], np.ndarray]:
        """List single further measurements with their rows, of shape (candidates, planes, n).

        Where no limits are given, those in which no size exceeds the largest measured one of
        either plane, if there are any: screens have edges. Bad readings, and sizes that are no
        beam's, are none.
        """
        found, rows, screens = [], [], tuple(screens)
        largest = max(_largest(self.seen, plane) for plane in self.seen.planes)
        for table in candidate_settings(self.seen.scan.settings, limits).values():
            rows_of_table = zip(*table.values(), strict=True)
            points = [dict(zip(table, map(float, row), strict=True)) for row in rows_of_table]
            for screen, energy in product(screens, (self.seen.energy, *energies)):
                further = self.predict(self.seen.scanned, table, screen, np.full(COUNT, energy))
                usable = (further.size <= largest).all(axis=0)
                usable |= limits is not None or not usable.any()
                rows += list(further.rows.swapaxes(0, 1)[usable])
                where = f" on {screen}" if len(screens) > 1 else ""
                where += f" at {energy:g} MeV" if energy != self.seen.energy else ""
                for i in np.flatnonzero(usable):
                    words = settings_in_words(self.seen, points[i]) + where
                    found.append(Candidate(points[i], screen, float(energy), words))
        return found, np.array(rows)


def _largest(seen: PreparedScan, plane: str) -> float:
    """The largest size of a plane's beam that its screens have shown, m."""
    p, likely = seen.solutions[plane].points, seen.solutions[plane].posterior.probability
    beams = likely[BEAM] + likely[FLAT] > 0.5
    good = p.size[p.outlier_probability <= 0.5]
    return float(np.max(good, initial=0.0)) if beams else np.inf


def settings_in_words(seen: PreparedScan, settings: Mapping[str, float], digits: int = 4) -> str:
    """Settings with the units of the scan."""
    return in_words(settings, setting_units(seen.scanned, settings), digits)


def candidate_settings(
    settings: Mapping[str, np.ndarray],
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, dict[str, np.ndarray]]:
    """Settings to consider: one magnet after the other over its range, the others held.

    Parameters
    ----------
    settings : mapping of str to ndarray
        The settings already measured.
    limits : mapping of str to (float, float), optional
        Magnets and their ranges; each scanned one, half its range beyond either end if None.

    Returns
    -------
    dict of str to dict
        For each magnet the settings of all, each of shape (41,). The others stay at their median.

    Examples
    --------
    >>> tables = candidate_settings({"Q": np.array([0.0, 2.0])})
    >>> list(tables), tables["Q"]["Q"][[0, -1]].tolist()
    (['Q'], [-1.0, 3.0])
    """
    if limits is None:
        spans = {n: (v.min(), v.max(), REACH * np.ptp(v)) for n, v in settings.items()}
        limits = {n: (low - far, high + far) for n, (low, high, far) in spans.items() if far > 0}
    held = {n: np.full(COUNT, np.median(v)) for n, v in settings.items()}
    found = {}
    for name, (low, high) in limits.items():
        values = np.linspace(low, high, COUNT)
        values[np.abs(values) < ROUNDING * (high - low)] = 0.0
        found[name] = held | {name: values}
    return found


class BeamSpread(NamedTuple):
    """Draws of σ, shape (d, 3), how far off their mean in units of each, weights, covariance."""

    sigma: np.ndarray
    off: np.ndarray
    weight: np.ndarray
    covariance: np.ndarray

    def slope(self, values: np.ndarray) -> np.ndarray:
        """Derivatives by σ of what draws give, shape (..., d) to (..., 3): the regression on it."""
        middle = values @ self.weight
        across = (values - middle[..., None]) * self.weight @ self.off
        return np.linalg.solve(self.covariance, across.T).T


def spread_of(seen: PreparedScan, plane: str) -> BeamSpread:
    """Draws of a plane's beam about their mean."""
    post = seen.solutions[plane].posterior
    sigma, weight = post.sigma, post.weight
    # In units of each number, so that a covariance can be solved with.
    unit = np.sqrt(weight @ sigma**2)
    off = (sigma - weight @ sigma) / unit
    covariance = (weight[:, None] * off).T @ off
    return BeamSpread(sigma, off, weight, covariance + 1e-12 * np.trace(covariance) * np.eye(3))


def drawn_adviser(seen: PreparedScan, fitted: Sequence[PlaneFit] = ()) -> Adviser:
    """Advise by the draws of the beams, where nothing else is unknown.

    Parameters
    ----------
    seen : PreparedScan
        The scan through its line.
    fitted : sequence of PlaneFit
        Its planes with the errors that are quoted; those of the draws count if none are given.

    Notes
    -----
    A number that goes with others is known as far as its regression on them says (C. E. Rasmussen
    and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. A.6): the derivatives
    of ε and of sizes are those of the regression over the draws.
    """
    now = {p.plane: p.identifiability.determined for p in fitted}
    quoted = {p.plane: p.emittance.relative for p in fitted if p.emittance.error}
    beams = {plane: spread_of(seen, plane) for plane in seen.planes}
    count, roots, slopes = len(beams), [], []
    for plane, s in beams.items():
        drawn = emittances(s.sigma)
        slope = s.slope(drawn / (drawn @ s.weight))
        own = float(np.sqrt(slope @ s.covariance @ slope))
        slopes.append(slope * quoted.get(plane, own) / own)
        roots.append(rows_of(s.covariance))
    free = np.full(3 * count, np.inf)
    known = block_diag(*roots), np.ones(count), block_diag(*slopes)

    def predict(line, table, screen, energy) -> Further:
        every = elements_at(seen, line, table, screen, energy)
        sizes, rows = [], []
        for i, (plane, s) in enumerate(beams.items()):
            r11, r12, further = (v[:, None] for v in every["xy".index(plane)])
            drawn = np.sqrt(size_squared(s.sigma.T, r11, r12, further))
            size = drawn @ s.weight
            error = relative_error(seen, plane) * size
            own = np.zeros((len(size), count, 3))
            own[:, i] = s.slope(drawn) / error[:, None]
            sizes.append(size)
            rows.append(own.reshape(len(size), -1))
        return Further(np.array(sizes), np.array(rows))

    def determined(_: Information, further: Sequence[Candidate]) -> dict[str, bool]:
        if not further or all(now.values()):
            return now
        rows = []
        for c in further:
            table = {name: np.array([v]) for name, v in c.settings.items()}
            rows.append(elements_at(seen, seen.scanned, table, c.screen, np.array([c.energy])))
        every = np.concatenate(rows, axis=-1)
        own = {plane: every["xy".index(plane)] for plane in now}
        return {plane: sure or simulated(seen, plane, *own[plane]) for plane, sure in now.items()}

    information = Information(*known, free > 0, -free, free)
    return Adviser(seen, information, predict, determined)


def emittances(sigma: np.ndarray) -> np.ndarray:
    """Emittances of σ11, σ12, σ22, shape (d, 3) to (d,); zero where they are no beam's."""
    return np.sqrt(np.maximum(sigma[:, 0] * sigma[:, 2] - sigma[:, 1] ** 2, 0.0))


def relative_error(seen: PreparedScan, plane: str) -> float:
    """The relative error that a further size of a plane is expected to have: the scan's."""
    p = seen.solutions[plane].points
    return max(float(np.median(p.error / p.size)), SHARPEST)


def elements_at(
    seen: PreparedScan,
    line: Beamline,
    table: Mapping[str, np.ndarray],
    screen: str,
    energy: np.ndarray,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """R11, R12 and known size² of both planes at settings nobody need have measured."""
    settings = {n: jnp.asarray(v) for n, v in table.items()}
    rows = seen.rows_at(line, "x", screen, settings, energy)
    return [rows.known(r) for r in np.asarray(rows.both(line, jnp.asarray(energy)))]


def simulated(
    seen: PreparedScan, plane: str, r11: np.ndarray, r12: np.ndarray, known: np.ndarray
) -> bool:
    """Simulate further sizes, and tell if they determine the emittance of a plane.

    They are those that the draws predict in the mean, off by one error up and down in turn.
    """
    work = seen.solutions[plane]
    old, post, n = work.sizes, work.posterior, len(r11)
    size = np.sqrt(size_squared(post.weight @ post.sigma, r11, r12, known))
    off = relative_error(seen, plane) * size
    size = size + off * (-1.0) ** np.arange(n)
    rows = [np.append(v, w) for v, w in zip(old[:4], (r11, r12, known, size), strict=True)]
    error = None if old.error is None else np.append(old.error, off)
    sizes = PlaneSizes(*rows, error, old.of_shots, old.moved)
    [found] = compare([sizes], seen.noise)
    drawn = emittances(found.sigma)
    low, high = emittance_quantiles(drawn, found.weight, found.flat, (AT[0], AT[-1]))
    return PlaneEvidence(found, sizes, low, high).determined


def next_measurement(seen: PreparedScan, plane: str) -> str | None:
    """Say which further setting would help the emittance of a plane most, if one can be named."""
    varied, screen = varied_magnets(seen.scan), seen.rows.places[-1]
    if not varied or not seen.solutions[plane].posterior.seen:
        return None
    adviser, i = drawn_adviser(seen), seen.planes.index(plane)
    candidates, rows = adviser.candidates(None, (screen,))
    every = adviser.information
    alone = every._replace(value=every.value[[i]], slope=every.slope[[i]])
    best = candidates[next(greedy(alone, rows)).index].settings
    held = {name: np.median(v) for name, v in seen.scan.settings.items()}
    magnet = next((name for name in varied if best[name] != held[name]), varied[0])
    measured = seen.scan.settings[magnet]
    inside = measured.min() <= best[magnet] <= measured.max()
    others = settings_in_words(seen, {name: v for name, v in held.items() if name != magnet}, 3)
    return (
        f"Measure next near {settings_in_words(seen, {magnet: best[magnet]}, 3)}, "
        f"{'inside' if inside else 'beyond'} the scanned range"
        f"{f', with {others} at {screen}' if others else ''}: this single point reduces the error "
        "most."
    )


def linear_adviser(fit: Scanned) -> Adviser:
    """Advise by derivatives of a scenario's problem.

    Numbers that the data do not determine end anywhere; what a measurement would tell is then
    asked of the line and the beam one started from.
    """
    seen, solved, p = fit.seen, fit.solved, fit.solved.problem
    theta, held = solved.theta, p.lower == p.upper
    if all(plane.identifiability.determined for plane in fit.planes):
        edge = np.array([v.state in ("lower", "upper") for v in solved.variables])
        held = held | (edge & p.nuisance)
    else:
        stated = fit.statement.state(seen, fit.told)
        theta = np.clip(stated.start, stated.lower, stated.upper)
    information = Information(
        assess.slopes(p, theta).residual_jacobian,
        *value_and_slope(p, _emittances, theta),
        ~p.nuisance & ~held,
        p.lower,
        p.upper,
        held,
        np.isin(np.array(p.names), [prior.name for prior in p.priors]),
    )
    rows_at_settings = _line_rows if fit.statement.whole_map else _network_rows

    def predict(line, table, screen, energy) -> Further:
        sizes, rows = [], []
        for plane in seen.planes:
            data = rows_at_settings(fit, line, plane, table, screen, energy)
            size, slope = value_and_slope(p, predict_sizes, theta, data)
            rows.append(slope / (relative_error(seen, plane) * size)[:, None])
            sizes.append(1e-6 * size)
        return Further(np.array(sizes), np.array(rows))

    return Adviser(seen, information, predict, lambda known, _: determined_by(seen, known))


def determined_by(seen: PreparedScan, known: Information) -> dict[str, bool]:
    """Tell of each plane if its emittance rests on data and priors, within a factor of use."""
    clear = (known.relative_error <= NARROW) & (known.share < MOST_SHARE)
    return dict(zip(seen.planes, map(bool, clear), strict=True))


def _emittances(model, data):
    return jnp.stack([emittance_parts(sigma_of(beam))[0] for beam in model["beam"].values()])


def _line_rows(fit: Scanned, line, plane, table, screen, energy) -> Rows:
    measured = size_records(fit.solved.problem)[plane].data
    shapes = {n: np.ndim(v) for n, v in measured.settings.items()}
    # Where a magnet has branches, a further point is measured on the rising one.
    settings = {
        n: jnp.stack([v, jnp.ones(len(v))], -1) if shapes.get(n) == 2 else jnp.asarray(v)
        for n, v in table.items()
    }
    return fit.seen.rows_at(line, plane, screen, settings, np.asarray(energy))


def _network_rows(fit: Scanned, line, plane, table, screen, energy) -> NetworkRows:
    measured, seen, count = size_records(fit.solved.problem)[plane].data, fit.seen, len(energy)
    place = seen.rows.places.index(screen)
    which = next(i for i in seen.measured(plane) if seen.rows.which[i] == place)
    inputs = [table.get(n, np.full(count, seen.energy)) for n in fit.solved.model["map"].inputs]
    known = jnp.full(count, float(np.median(np.asarray(measured.known))))
    columns, damping = jnp.tile(measured.columns[which], (count, 1)), jnp.ones(count)
    return NetworkRows(plane, False, jnp.asarray(np.stack(inputs, -1)), columns, known, damping)


def adviser_of(fit: Scanned) -> Adviser:
    """Give the adviser of a fit, in any scenario."""
    return drawn_adviser(fit.seen, fit.planes) if fit.solved is None else linear_adviser(fit)
