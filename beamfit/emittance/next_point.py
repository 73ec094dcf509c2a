"""Expected information of a further size, from the posterior draws of a scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from beamfit.emittance.comparison import PlaneSizes, compare, emittance_quantiles
from beamfit.emittance.model import size_squared
from beamfit.emittance.results import in_words
from beamfit.emittance.statement import Seen
from beamfit.emittance.transport import Rows, rows_at
from beamfit.emittance.verdict import PlaneEvidence
from beamfit.greybox.design import Information, greedy, rows_of
from beamfit.optics.beamline import Beamline
from beamfit.optics.rows import transfer_rows

# Candidates reach half the scanned range beyond either end.
REACH, COUNT = 0.5, 41
# A setting below this share of the range is the rounding of zero.
ROUNDING = 1e-9
# A further size is known no better than this share of itself.
SHARPEST = 1e-4


class Further(NamedTuple):
    """Further sizes of each plane: predicted, m, shape (planes, m), and their rows of a Jacobian.

    ``rows`` has the derivatives by the free numbers over the sizes' errors, (planes, m, n).
    """

    size: np.ndarray
    rows: np.ndarray


# Further sizes on a line, at settings, on a screen, at energies (MeV).
Predict = Callable[[Beamline, Mapping[str, np.ndarray], str, np.ndarray], Further]


def candidate_settings(
    settings: Mapping[str, np.ndarray],
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """Settings to consider: one magnet after the other over its range, the others held.

    Parameters
    ----------
    settings : mapping of str to ndarray
        The settings already measured.
    limits : mapping of str to (float, float), optional
        Magnets and their ranges; each scanned one, half its range beyond either end if None.

    Returns
    -------
    list of (str, dict)
        For each magnet the settings of all, each of shape (41,). The others stay at their median.

    Examples
    --------
    >>> [(name, table)] = candidate_settings({"Q": np.array([0.0, 2.0])})
    >>> name, table["Q"][[0, -1]].tolist()
    ('Q', [-1.0, 3.0])
    """
    if limits is None:
        spans = {n: (v.min(), v.max(), REACH * np.ptp(v)) for n, v in settings.items()}
        limits = {n: (low - far, high + far) for n, (low, high, far) in spans.items() if far > 0}
    held = {n: np.full(COUNT, np.median(v)) for n, v in settings.items()}
    found = []
    for name, (low, high) in limits.items():
        values = np.linspace(low, high, COUNT)
        values[np.abs(values) < ROUNDING * (high - low)] = 0.0
        found.append((name, held | {name: values}))
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


def spread_of(seen: Seen, plane: str) -> BeamSpread:
    """Draws of a plane's beam about their mean."""
    post = seen.works[plane].posterior
    kept = post.weight > 0.0
    sigma, weight = post.sigma[kept], post.weight[kept]
    # In units of each number, so that a covariance can be solved with.
    unit = np.sqrt(weight @ sigma**2)
    off = (sigma - weight @ sigma) / unit
    covariance = (weight[:, None] * off).T @ off
    return BeamSpread(sigma, off, weight, covariance + 1e-12 * np.trace(covariance) * np.eye(3))


def beam_information(beams: Sequence[BeamSpread], error: Sequence[float]) -> Information:
    """Information of the posterior on the emittances of some planes.

    Parameters
    ----------
    beams : sequence of BeamSpread
        One a plane, each with three numbers.
    error : sequence of float
        Relative errors of the emittances as quoted; NaN to take those of the draws.

    Notes
    -----
    A number that goes with others is known as far as its regression on them says (C. E. Rasmussen
    and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. A.6): the derivatives
    of ε and of sizes are those of the regression over the draws.
    """
    roots, slopes = [], []
    for s, quoted in zip(beams, error, strict=True):
        drawn = emittances(s.sigma)
        slope = s.slope(drawn / (drawn @ s.weight))
        own = float(np.sqrt(slope @ s.covariance @ slope))
        slopes.append(slope * (1.0 if np.isnan(quoted) else quoted / own))
        roots.append(rows_of(s.covariance))
    n = 3 * len(slopes)
    free = np.full(n, np.inf)
    one = np.ones(len(slopes))
    return Information(block_diag(*roots), one, block_diag(*slopes), free > 0, -free, free)


def beam_sizes(seen: Seen, beams: Mapping[str, BeamSpread]) -> Predict:
    """Give the prediction of further sizes by draws, with the scan's own relative error."""

    def predict(line, table, screen, energy) -> Further:
        every = elements_at(seen, line, table, screen, energy)
        sizes, rows = [], []
        for i, (plane, s) in enumerate(beams.items()):
            r11, r12, known = every["xy".index(plane)]
            drawn = np.sqrt(size_squared(s.sigma.T, *(v[:, None] for v in (r11, r12, known))))
            size = drawn @ s.weight
            own = np.zeros((len(size), 3 * len(beams)))
            error = relative_error(seen, plane) * size
            own[:, 3 * i : 3 * i + 3] = s.slope(drawn) / error[:, None]
            sizes.append(size)
            rows.append(own)
        return Further(np.array(sizes), np.array(rows))

    return predict


def emittances(sigma: np.ndarray) -> np.ndarray:
    """Emittances of σ11, σ12, σ22, shape (d, 3) to (d,); zero where they are no beam's."""
    return np.sqrt(np.maximum(sigma[:, 0] * sigma[:, 2] - sigma[:, 1] ** 2, 0.0))


def relative_error(seen: Seen, plane: str) -> float:
    """The relative error that a further size of a plane is expected to have: the scan's."""
    p = seen.works[plane].points
    return max(float(np.median(p.error / p.size)), SHARPEST)


def elements_at(
    seen: Seen, line: Beamline, table: Mapping[str, np.ndarray], screen: str, energy: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """R11, R12 and known size² of both planes at settings nobody need have measured."""
    settings = {n: jnp.asarray(v) for n, v in table.items()}
    rows: Rows = rows_at(line, "x", screen, settings, energy, *seen.known_at(line, screen))
    planes = np.asarray(transfer_rows(line, settings, jnp.asarray(energy), (screen,)).planes)
    return [rows.known(r) for r in np.moveaxis(planes[:, :, 0, 0], 1, 0)]


def next_measurement(seen: Seen, plane: str) -> str | None:
    """Say which further setting would help the emittance of a plane most, if one can be named."""
    work = seen.works[plane]
    p, screen = work.points, seen.rows.places[-1]
    if seen.scan.transfer or not work.posterior.seen:
        return None
    beams = {name: spread_of(seen, name) for name in seen.works}
    every, predict, tried, rows = list(beams), beam_sizes(seen, beams), [], []
    for name, table in candidate_settings(p.settings):
        found = predict(seen.scanned, table, screen, np.full(COUNT, seen.energy))
        usable = on_screen(seen, every, found.size)
        tried += [(name, setting) for setting in table[name][usable]]
        i = every.index(plane)
        rows.append(found.rows[i, usable][:, None, 3 * i : 3 * i + 3])
    if not tried:
        return None
    known = beam_information((beams[plane],), (np.nan,))
    magnet, setting = tried[next(greedy(known, np.concatenate(rows))).index]
    values = p.settings[magnet]
    inside = values.min() <= setting <= values.max()
    held = {name: np.median(v) for name, v in p.settings.items() if name != magnet}
    others = f", with {in_words(held, p.units, 3)} at {screen}" if held else ""
    return (
        f"Measure next near {magnet} = {setting:.3g} {p.units[magnet]}, "
        f"{'inside' if inside else 'beyond'} the scanned range{others}: this single point reduces "
        "the error most."
    )


def on_screen(seen: Seen, planes: Sequence[str], size: np.ndarray) -> np.ndarray:
    """Rows in which no plane's size exceeds those measured: screens have edges; shape (m,)."""
    largest = np.array([np.nanmax(seen.scan.size[plane]) for plane in planes])
    return (size <= largest[:, None]).all(axis=0)


def simulated(seen: Seen, plane: str, r11: np.ndarray, r12: np.ndarray, known: np.ndarray) -> bool:
    """Simulate further sizes, and tell if they determine the emittance of a plane.

    They are those that the draws predict in the mean, off by one error up and down in turn.
    """
    work = seen.works[plane]
    old, post, n = work.sizes, work.posterior, len(r11)
    size = np.sqrt(size_squared(post.weight @ post.sigma, r11, r12, known))
    off = relative_error(seen, plane) * size
    size = size + off * (-1.0) ** np.arange(n)
    rows = [np.append(v, w) for v, w in zip(old[:4], (r11, r12, known, size), strict=True)]
    error = None if old.error is None else np.append(old.error, off)
    [found] = compare([PlaneSizes(*rows, error, old.of_shots, old.moved)], seen.noise)
    drawn = emittances(found.sigma)
    low, high = emittance_quantiles(drawn, found.weight, found.flat, (0.025, 0.975))
    given = len(rows[0]), old.moved, error is not None
    return PlaneEvidence(found.probability, found.seen, *given, low, high, None).determined
