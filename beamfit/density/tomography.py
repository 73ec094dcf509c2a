"""Phase-space tomography by a Gaussian process, with every error of the profiles averaged over.

The frame is the reference beam: points u = (q, p) in which it is round with unit rms. Profile k
is the projection of the density on its direction, its position in units of its size there.

The density is the reference Gaussian plus two Gaussian processes under Gaussian envelopes: a core
and a tail (J. Svensson, EFDA-JET-PR(11)24, 2011; D. Li et al., Rev. Sci. Instrum. 84, 083506
(2013), eqs. 5 to 9). All profiles are linear in it, so that its posterior is exact for given
amplitudes; background, charge and centre of each profile are further columns. Settings scatter:
each profile is stretched by a share of its own, to which the model is linearised anew until it
stands. Densities may be negative where noise leaves that open: sums over many points are unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from beamfit.density.profiles import MeanProfile
from beamfit.noise.model import Noise

# The grid, in rms sizes, the rms of what stands at each point, and the least width of a bin.
STEP, EDGE, BIN = 0.36, 10.8, 0.36
POINT = 0.8 * STEP
AXIS = np.arange(-EDGE, EDGE + STEP / 2, STEP)
GRID = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), -1).reshape(-1, 2)
# Lengths over which the core changes with its envelope, equally likely; those of the tail; and
# those that the frame is found with. In rms sizes; no core is longer than its envelope.
CORES = ((0.4, 1.3), (0.6, 1.3), (0.9, 1.3), (0.4, 1.9), (0.6, 1.9), (0.9, 1.9), (1.4, 1.9))
TAIL, ROUGH = (3.0, 4.0), (0.6, 1.9)
# Peak of the projected reference Gaussian: shares of the peak are shares of this.
PEAK = 1.0 / math.sqrt(2.0 * math.pi)
# Priors, standard deviations: background as a share of the peak, charge, centre in sizes, and sizes
# of the beam about the reference.
BACKGROUND, CHARGE, CENTRE, FRAME = 0.1, 0.05, 0.1, 0.3
# Priors of ln: amplitude of core and tail over the reference's peak, noise of a bin and its part
# that grows with the root of the charge, as shares of the peak. Scatter of settings: `Noise`.
PRIORS = ((math.log(0.5), 1.0), (math.log(0.02), 1.2), (math.log(0.005), 1.5),
          (math.log(0.02), 1.2))  # fmt: skip
# Departures of a profile of its own: share of the peak, and length, in sizes.
OWN, OWN_LENGTH = 0.1, 0.5
# Linearisations, at which of them amplitudes are sought, and the most a step may change a size.
ROUNDS, SOUGHT, MOST = 6, (2, 4), 0.3
# Kernels less likely than this share have no draws; draws that share their amplitudes. Proposals
# for each of these, and how much wider than by Laplace's method they are.
LEAST, SHARED, PROPOSED, WIDER = 0.01, 8, 8, 1.5
# Standard deviations of their priors within which amplitudes are sought; added to the diagonal of
# correlations of the grid; share of the largest mode below which one is rounding.
REACH, JITTER, ROUNDING = 6.0, 1e-9, 1e-12


class Bins(NamedTuple):
    """Bins of all profiles as the frame sees them.

    Attributes
    ----------
    profile : ndarray
        Shape (n,): number of the profile.
    position, charge : ndarray
        Shape (n,): in sizes, and share of the charge per size.
    look, slope : ndarray
        Shape (n, g): what each point of the grid adds to each bin, and its derivative.
    direction : ndarray
        Shape (k, 2): unit vectors of the profiles.
    """

    profile: np.ndarray
    position: np.ndarray
    charge: np.ndarray
    look: np.ndarray
    slope: np.ndarray
    direction: np.ndarray

    @property
    def own(self) -> np.ndarray:
        """1 where a bin is of a profile, shape (n, k)."""
        return (self.profile[:, None] == np.arange(len(self.direction))).astype(float)


class Densities(NamedTuple):
    """Draws of the density.

    Attributes
    ----------
    values : ndarray
        Shape (d, g): charge at the points of `GRID`, each of rms `POINT`, in the frame.
    frame : ndarray
        Shape (2, 2): from the frame to position (m) and angle; its determinant is the emittance.
    growth : ndarray
        Shape (d,): emittance of a draw's frame over that.
    bins : Bins
        As fitted last.
    fitted, error : ndarray
        Shape (n,): charge of each bin by the mean density with what each profile has of its own,
        and the noise of a bin.
    stretch : ndarray
        Shape (k,): sizes over those of the density, less one.
    worst : int
        The profile with the largest departures of its own.
    scatter : float
        What settings scatter, as a share of a size.
    """

    values: np.ndarray
    frame: np.ndarray
    growth: np.ndarray
    bins: Bins
    fitted: np.ndarray
    error: np.ndarray
    stretch: np.ndarray
    worst: int
    scatter: float


def tomography(
    profiles: Sequence[MeanProfile],
    rows: np.ndarray,
    frame: np.ndarray,
    *,
    resolution: np.ndarray,
    noise: Noise,
    draws: int,
    seed: int,
) -> Densities:
    """Draw densities that may have given the profiles.

    Parameters
    ----------
    profiles : sequence of MeanProfile
        k of them.
    rows : ndarray
        Shape (k, 2): R11 and R12 (m) of each.
    frame : ndarray
        Shape (2, 2): lower root of a beam matrix to begin with.
    resolution : ndarray
        Shape (k,): rms of what is not the beam's, m.
    noise : Noise
        For the scatter of settings.
    draws, seed : int
        How many, and the seed of their random numbers.

    Returns
    -------
    Densities

    Raises
    ------
    numpy.linalg.LinAlgError
        If the profiles lead to no beam.
    """
    prior = np.array([*PRIORS, (math.log(noise.scatter.middle), noise.scatter.spread)])
    density, stretch, numbers = _gaussian(), np.zeros(len(profiles)), prior[:, 0]
    for i in range(ROUNDS):
        bins = bins_of(profiles, rows, frame, stretch, resolution)
        near = _Posterior.of(bins, density, stretch, _kernels(bins, [ROUGH])[0], prior)
        if i in SOUGHT:
            numbers = near.best(numbers)[1]
        density, change, stretch = near.mean(numbers)
        change = np.eye(2) + np.clip(change, -MOST, MOST)
        frame = np.linalg.cholesky(frame @ change @ change.T @ frame.T)
        stretch = np.clip(stretch, -MOST, MOST)
    bins = bins_of(profiles, rows, frame, stretch, resolution)
    each = [_Posterior.of(bins, density, stretch, k, prior) for k in _kernels(bins, CORES)]
    found = [p.best(numbers) for p in each]
    logs = np.array([log for log, _ in found])
    weight = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    random, parts = np.random.default_rng(seed), []
    for p, (_, at), share in zip(each, found, weight, strict=True):
        if share > LEAST:
            parts.append(p.draws(at, max(1, round(share * draws)), random))
    likeliest = int(np.argmax(weight))
    best, at = each[likeliest], found[likeliest][1]
    values, changes = (np.concatenate(part) for part in zip(*parts, strict=True))
    growth = np.linalg.det(np.eye(2) + changes)
    return Densities(
        values, frame, growth, bins, best.fitted(at), best.bin_error(at), stretch,
        best.worst(at), float(math.exp(at[-1])),
    )  # fmt: skip


def bins_of(
    profiles: Sequence[MeanProfile],
    rows: np.ndarray,
    frame: np.ndarray,
    stretch: np.ndarray,
    resolution: np.ndarray,
) -> Bins:
    """See the profiles through a frame, neighbouring bins taken together up to a width."""
    seen = rows @ frame
    unit = np.hypot(*seen.T)
    direction, size = seen / unit[:, None], unit * (1.0 + stretch)
    parts = []
    for k, p in enumerate(profiles):
        count = max(1, int(BIN * size[k] / p.step))
        whole = len(p.position) // count * count
        x, charge = (v[:whole].reshape(-1, count).mean(1) for v in (p.position, p.charge))
        inside = np.abs(x) < EDGE * size[k]
        width = count * p.step / size[k]
        charge = charge[inside] / (charge[inside].sum() * width)
        # Bins are points, as of a wire; what a pixel adds is the resolution's.
        together = width**2 * (1.0 - 1.0 / count**2) / 12.0
        parts.append((np.full(len(charge), k), x[inside] / size[k], charge,
                      np.full(len(charge), together)))  # fmt: skip
    profile, position, charge, together = (np.concatenate(v) for v in zip(*parts, strict=True))
    width = np.sqrt(POINT**2 + together + (resolution / size)[profile] ** 2)[:, None]
    away = (position[:, None] - direction[profile] @ GRID.T) / width
    look = PEAK / width * np.exp(-0.5 * away**2)
    return Bins(profile, position, charge, look, -away / width * look, direction)


class _Kernel(NamedTuple):
    """Process of given length and envelope, with what the bins see of it.

    ``seen`` is the covariance of bins and grid, shape (n, g), and ``of_bins`` that of bins.
    """

    length: float
    envelope: float
    seen: np.ndarray
    of_bins: np.ndarray


def _kernel(bins: Bins, length: float, envelope: float) -> _Kernel:
    modes, n = STEP / math.sqrt(2.0 * math.pi) * _modes(length, envelope), len(AXIS)
    part = modes.T @ (bins.look.reshape(-1, n) @ modes).reshape(len(bins.look), n, -1)
    seen = (modes @ part @ modes.T).reshape(-1, n * n)
    part = part.reshape(len(part), -1)
    return _Kernel(length, envelope, seen, part @ part.T)


@cache
def _modes(length: float, envelope: float) -> np.ndarray:
    """Root of the covariance along an axis, shape (m, modes), without modes that are rounding.

    The covariance of the grid is a product of the two axes', so that bins see it through these.
    """
    fall = np.exp(-0.5 * (AXIS / envelope) ** 2)
    values, vectors = np.linalg.eigh(fall[:, None] * _correlation(length) * fall)
    kept = values > ROUNDING * values[-1]
    return vectors[:, kept] * np.sqrt(values[kept])


def _kernels(bins: Bins, likely: Sequence[tuple[float, float]]) -> list[tuple[_Kernel, _Kernel]]:
    """Core, for each length and envelope, and tail."""
    tail = _kernel(bins, *TAIL)
    return [(_kernel(bins, *core), tail) for core in likely]


@cache
def _correlation(length: float) -> np.ndarray:
    return np.exp(-0.5 * ((AXIS[:, None] - AXIS) / length) ** 2)


@cache
def _root(length: float) -> np.ndarray:
    return np.linalg.cholesky(_correlation(length) + JITTER * np.eye(len(AXIS)))


@cache
def _envelope(rms: float) -> np.ndarray:
    """Charge at each point of a Gaussian with the reference's peak."""
    return STEP**2 / (2.0 * math.pi) * np.exp(-0.5 * np.sum(GRID**2, axis=1) / rms**2)


@cache
def _gaussian() -> np.ndarray:
    """The reference: with the width of a point its rms is one."""
    rms = math.sqrt(1.0 - POINT**2)
    return _envelope(rms) / rms**2


class _Posterior(NamedTuple):
    """Posterior of the density for one kernel, linear about a density and stretches.

    ``free`` are columns with unit priors: backgrounds, charges, centres, and three of the frame;
    ``stretching`` those of the stretches. ``residual`` is what the reference leaves, ``known`` the
    covariance of the free columns, and ``parts`` are those whose amplitudes are the numbers; of
    noise they are diagonals.
    """

    bins: Bins
    kernels: tuple[_Kernel, _Kernel]
    prior: np.ndarray
    residual: np.ndarray
    free: np.ndarray
    stretching: np.ndarray
    known: np.ndarray
    parts: tuple[np.ndarray, ...]

    @classmethod
    def of(
        cls,
        bins: Bins,
        density: np.ndarray,
        stretch: np.ndarray,
        kernels: tuple[_Kernel, _Kernel],
        prior: np.ndarray,
    ) -> _Posterior:
        expected, slope, own = bins.look @ density, bins.slope @ density, bins.own
        stretching = -own * (expected + bins.position * slope)[:, None]
        c, s = bins.direction.T
        frame = stretching @ (FRAME * np.column_stack([c * c, s * s, math.sqrt(2.0) * c * s]))
        each = BACKGROUND * PEAK * np.ones_like(slope), CHARGE * expected, CENTRE * slope
        free = np.hstack([*(own * column[:, None] for column in each), frame])
        # The bins stand where these stretches put them: what is left of them has a mean.
        residual = bins.charge - bins.look @ _gaussian() + stretching @ stretch
        flat, grown = np.full_like(residual, PEAK**2), PEAK * np.maximum(expected, 0.0)
        parts = (*(k.of_bins for k in kernels), flat, grown, stretching @ stretching.T)
        return cls(bins, kernels, prior, residual, free, stretching, free @ free.T, parts)

    def _own_departures(self) -> np.ndarray:
        position, profile = self.bins.position, self.bins.profile
        apart = (position[:, None] - position) / OWN_LENGTH
        high = np.exp(-0.5 * (position / ROUGH[1]) ** 2)
        same = (OWN * PEAK) ** 2 * (profile[:, None] == profile)
        return same * np.outer(high, high) * np.exp(-0.5 * apart**2)

    def covariance(self, numbers: np.ndarray) -> np.ndarray:
        """Covariance of the bins, at ln of the amplitudes."""
        total = self.known.copy()
        diagonal = np.einsum("ii->i", total)
        for square, part in zip(np.exp(2.0 * numbers), self.parts, strict=True):
            (total if part.ndim == 2 else diagonal)[:] += square * part
        return total

    def bin_error(self, numbers: np.ndarray) -> np.ndarray:
        """Noise of each bin."""
        _, _, flat, grown, _ = self.parts
        square = np.exp(2.0 * numbers)
        return np.sqrt(square[2] * flat + square[3] * grown)

    def _factored(self, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        """Cholesky root of the covariance, and minus ln of evidence and prior."""
        root = cholesky(self.covariance(numbers), lower=True, overwrite_a=True, check_finite=False)
        z = (numbers - self.prior[:, 0]) / self.prior[:, 1]
        own = solve_triangular(root, self.residual, lower=True, check_finite=False)
        return root, float(0.5 * own @ own + np.log(np.diag(root)).sum() + 0.5 * z @ z)

    def _loss(self, numbers: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus ln of evidence and prior, and its slope (Rasmussen and Williams, 2006, eq. 5.9)."""
        try:
            root, loss = self._factored(numbers)
        except np.linalg.LinAlgError:
            return 1e10, np.zeros(len(numbers))
        lower = np.tril(dpotri(root, lower=1)[0])
        inverse = lower + np.tril(lower, -1).T
        pull, slope = inverse @ self.residual, []
        for square, part in zip(np.exp(2.0 * numbers), self.parts, strict=True):
            if part.ndim == 2:
                change = np.vdot(inverse, part) - pull @ part @ pull
            else:
                change = np.diag(inverse) @ part - pull**2 @ part
            slope.append(square * change)
        z = (numbers - self.prior[:, 0]) / self.prior[:, 1]
        return loss, np.array(slope) + z / self.prior[:, 1]

    def best(self, start: np.ndarray) -> tuple[float, np.ndarray]:
        """Ln of the evidence at the likeliest amplitudes, and ln of these."""
        middle, spread = self.prior.T
        within = list(zip(middle - REACH * spread, middle + REACH * spread, strict=True))
        found = minimize(self._loss, start, jac=True, method="L-BFGS-B", bounds=within,
                         options={"maxiter": 30})  # fmt: skip
        return -float(found.fun), found.x

    def _pull(self, numbers: np.ndarray, residual: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self.covariance(numbers), residual)

    def _answer(self, numbers: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Answer of the density to pulls on the bins."""
        return sum(
            square * pull.T @ kernel.seen
            for square, kernel in zip(np.exp(2.0 * numbers), self.kernels, strict=False)
        )

    def mean(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean density, change of the frame, and stretches."""
        pull = self._pull(numbers, self.residual)
        density = _gaussian() + self._answer(numbers, pull)
        stretch = math.exp(2.0 * numbers[-1]) * (self.stretching.T @ pull)
        return density, _symmetric(self.free.T @ pull), stretch

    def fitted(self, numbers: np.ndarray) -> np.ndarray:
        """The bins without their noise."""
        pull, error = self._pull(numbers, self.residual), self.bin_error(numbers)
        return self.bins.charge - error**2 * pull

    def worst(self, numbers: np.ndarray) -> int:
        """The profile that departs most from every density, if each may have a part of its own."""
        own = self._own_departures()
        part = own @ np.linalg.solve(self.covariance(numbers) + own, self.residual)
        return int(np.argmax(self.bins.own.T @ part**2))

    def draws(
        self, numbers: np.ndarray, count: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Densities and changes of the frame, amplitudes drawn by their importance.

        Each is a draw of the prior moved by what the bins say of it (A. G. Journel and C. J.
        Huijbregts, Mining Geostatistics, 1978, ch. VII). Amplitudes are proposed by Laplace's
        method, wider than it says, and resampled evenly over what settings scatter, which is skew
        (G. Kitagawa, J. Comput. Graph. Stat. 5, 1 (1996), sec. 2.3).
        """
        step, each = 0.1, np.eye(len(numbers))
        curved = np.array([(self._loss(numbers + step * u)[1] - self._loss(numbers - step * u)[1])
                           / (2.0 * step) for u in each])  # fmt: skip
        values, vectors = np.linalg.eigh(0.5 * (curved + curved.T))
        # The prior alone curves by 1/1.5²: less is rounding.
        width = vectors / np.sqrt(np.maximum(values, 1.0 / self.prior[:, 1].max() ** 2))
        wanted = max(1, count // SHARED)
        z = WIDER * random.normal(size=(PROPOSED * wanted, len(numbers)))
        z = z[np.argsort(z @ width[-1])]
        proposed = numbers + z @ width.T
        log = 0.5 * np.sum(z**2, axis=1) / WIDER**2 - [self._factored(at)[1] for at in proposed]
        weight = np.exp(log - log.max())
        up_to = np.cumsum(weight)
        even = (np.arange(wanted) + random.uniform()) / wanted * up_to[-1]
        chosen = np.searchsorted(up_to, even)
        parts = [
            self._draws_at(proposed[i], len(some), random)
            for i, some in zip(chosen, np.array_split(np.arange(count), wanted), strict=True)
        ]
        densities, changes = zip(*parts, strict=True)
        return np.concatenate(densities), np.concatenate(changes)

    def _draws_at(
        self, numbers: np.ndarray, count: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        amplitude, n, density = np.exp(numbers), len(AXIS), np.zeros((count, len(GRID)))
        for size, kernel in zip(amplitude, self.kernels, strict=False):
            root = _root(kernel.length)
            wave = root @ random.normal(size=(count, n, n)) @ root.T
            density += size * _envelope(kernel.envelope) * wave.reshape(count, -1)
        free = random.normal(size=(count, self.free.shape[1]))
        stretch = amplitude[-1] * random.normal(size=(count, self.stretching.shape[1]))
        noise = self.bin_error(numbers) * random.normal(size=(count, len(self.residual)))
        seen = density @ self.bins.look.T + free @ self.free.T + stretch @ self.stretching.T
        pull = self._pull(numbers, (self.residual - seen - noise).T)
        found = _gaussian() + density + self._answer(numbers, pull)
        moved = free + pull.T @ self.free
        return found, np.array([_symmetric(row) for row in moved])


def _symmetric(free: np.ndarray) -> np.ndarray:
    """Change of the frame of the last three of the columns."""
    a, b, c = FRAME * free[-3:]
    return np.array([[a, c / math.sqrt(2.0)], [c / math.sqrt(2.0), b]])
