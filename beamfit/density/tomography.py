"""Phase-space tomography by a Gaussian process, averaged over all errors of the profiles.

The frame is the reference beam: points u = (q, p) in which it is round with unit rms. Profile k is
the projection of the density on its direction, its position in units of its size there.

The density is the reference Gaussian plus two Gaussian processes under Gaussian envelopes: a core
and a tail (J. Svensson, EFDA-JET-PR(11)24, 2011; D. Li et al., Rev. Sci. Instrum. 84, 083506
(2013), eqs. 5 to 9). All profiles are linear in it, so that its posterior is exact for given
amplitudes; background, charge and centre of each profile are further columns. Settings scatter:
each profile is stretched by a share of its own, and the model is linearised again until the
stretches no longer change. Densities may be negative where noise allows it: sums over many points
are then unbiased.
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

# Step and edge of the grid, and width up to which neighbouring bins are merged, in rms sizes.
STEP = 0.36
EDGE = 10.8
MAX_BIN = 0.36
# Rms of the charge at each point of the grid.
POINT = 0.8 * STEP
AXIS = np.arange(-EDGE, EDGE + STEP / 2, STEP)
GRID = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), -1).reshape(-1, 2)
# Correlation length and envelope of the core, in rms sizes, all equally probable beforehand. No
# core is longer than its envelope.
CORES = ((0.4, 1.3), (0.6, 1.3), (0.9, 1.3), (0.4, 1.9), (0.6, 1.9), (0.9, 1.9), (1.4, 1.9))
# Length and envelope of the tail, and of the core that the frame is found with, in rms sizes.
TAIL = (3.0, 4.0)
FRAME_CORE = (0.6, 1.9)
# Peak of the projected reference Gaussian; shares of the peak refer to it.
PEAK = 1.0 / math.sqrt(2.0 * math.pi)
# Standard deviations of the priors: background as a share of the peak, relative charge, centre in
# sizes, and relative size of the beam about the reference. Chosen.
BACKGROUND = 0.1
CHARGE = 0.05
CENTRE = 0.1
FRAME = 0.3
# Mean and standard deviation of ln of: amplitudes of core and tail over the reference's peak, noise
# of a bin, and noise that grows with the root of the charge, as shares of the peak. The scatter of
# settings has the prior of `Noise`.
PRIORS = ((math.log(0.5), 1.0), (math.log(0.02), 1.2), (math.log(0.005), 1.5),
          (math.log(0.02), 1.2))  # fmt: skip
# Error of a single profile that no density gives: share of the peak, and correlation length, in
# sizes. Chosen.
PROFILE_ERROR = 0.1
PROFILE_ERROR_LENGTH = 0.5
# Number of linearisations, those at which amplitudes are fitted, and largest relative change of a
# size in one.
LINEARISATIONS = 6
AMPLITUDE_ROUNDS = (2, 4)
MAX_CHANGE = 0.3
# Kernels below this probability are not drawn from.
MIN_KERNEL_PROBABILITY = 0.01
# Draws of the density that share one draw of the amplitudes, and proposals for each of these.
DRAWS_PER_AMPLITUDES = 8
PROPOSALS_PER_AMPLITUDES = 8
# Width of the proposals over that of Laplace's method.
PROPOSAL_SCALE = 1.5
# Range of the amplitudes, in standard deviations of their priors.
AMPLITUDE_RANGE = 6.0
# Number added to the diagonal of correlations on the grid.
JITTER = 1e-9
# Modes below this share of the largest are rounding.
ROUNDING = 1e-12


class Bins(NamedTuple):
    """Bins of all profiles in the frame.

    Attributes
    ----------
    profile : ndarray
        Number of the profile, shape (n,).
    position, charge : ndarray
        Position in sizes, and share of the charge per size, shape (n,).
    projection, slope : ndarray
        Contribution of each grid point to each bin, and its derivative by position, shape (n, g).
    direction : ndarray
        Unit vectors of the profiles, shape (k, 2).
    """

    profile: np.ndarray
    position: np.ndarray
    charge: np.ndarray
    projection: np.ndarray
    slope: np.ndarray
    direction: np.ndarray

    @property
    def membership(self) -> np.ndarray:
        """1 where a bin belongs to a profile, else 0, shape (n, k)."""
        return (self.profile[:, None] == np.arange(len(self.direction))).astype(float)


class Densities(NamedTuple):
    """Draws of the density.

    Attributes
    ----------
    values : ndarray
        Charge at the points of `GRID`, each of rms `POINT`, in the frame, shape (d, g).
    frame : ndarray
        Matrix from the frame to position (m) and angle, shape (2, 2); its determinant is the
        emittance.
    growth : ndarray
        Emittance of each draw's frame over that, shape (d,).
    bins : Bins
        Bins of the last linearisation.
    fitted, error : ndarray
        Charge of each bin by the mean density with the profile's own background, charge, centre and
        stretch, and the noise of a bin, shape (n,).
    stretch : ndarray
        Sizes of the profiles over those of the density, less one, shape (k,).
    worst : int
        Index of the profile with the largest error of its own.
    scatter : float
        Relative scatter of settings.
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
    """Draw densities from their posterior, given the profiles.

    Parameters
    ----------
    profiles : sequence of MeanProfile
        The k profiles.
    rows : ndarray
        R11 and R12 (m) of each profile, shape (k, 2).
    frame : ndarray
        Cholesky factor of the beam matrix to start with, shape (2, 2).
    resolution : ndarray
        Rms of each profile that is not the beam's, m, shape (k,).
    noise : Noise
        Noise model, of which the scatter of settings is used.
    draws, seed : int
        Number of draws, and seed of their random numbers.

    Returns
    -------
    Densities

    Raises
    ------
    numpy.linalg.LinAlgError
        If no beam fits the profiles.
    """
    prior = np.array([*PRIORS, (math.log(noise.scatter.middle), noise.scatter.spread)])
    density, stretch, numbers = _gaussian(), np.zeros(len(profiles)), prior[:, 0]
    for i in range(LINEARISATIONS):
        bins = bins_of(profiles, rows, frame, stretch, resolution)
        posterior = _Posterior.build(bins, density, stretch, _kernels(bins, [FRAME_CORE])[0], prior)
        if i in AMPLITUDE_ROUNDS:
            numbers = posterior.best(numbers)[1]
        density, change, stretch = posterior.mean(numbers)
        change = np.eye(2) + np.clip(change, -MAX_CHANGE, MAX_CHANGE)
        frame = np.linalg.cholesky(frame @ change @ change.T @ frame.T)
        stretch = np.clip(stretch, -MAX_CHANGE, MAX_CHANGE)
    bins = bins_of(profiles, rows, frame, stretch, resolution)
    posteriors = [_Posterior.build(bins, density, stretch, k, prior) for k in _kernels(bins, CORES)]
    optima = [p.best(numbers) for p in posteriors]
    logs = np.array([log for log, _ in optima])
    probabilities = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    random, parts = np.random.default_rng(seed), []
    for p, (_, amplitudes), probability in zip(posteriors, optima, probabilities, strict=True):
        if probability > MIN_KERNEL_PROBABILITY:
            parts.append(p.draws(amplitudes, max(1, round(probability * draws)), random))
    best_index = int(np.argmax(probabilities))
    best, amplitudes = posteriors[best_index], optima[best_index][1]
    values, changes = (np.concatenate(part) for part in zip(*parts, strict=True))
    growth = np.linalg.det(np.eye(2) + changes)
    return Densities(
        values, frame, growth, bins, best.fitted(amplitudes), best.bin_error(amplitudes), stretch,
        best.worst(amplitudes), float(math.exp(amplitudes[-1])),
    )  # fmt: skip


def bins_of(
    profiles: Sequence[MeanProfile],
    rows: np.ndarray,
    frame: np.ndarray,
    stretch: np.ndarray,
    resolution: np.ndarray,
) -> Bins:
    """Project the bins of the profiles into a frame, merging neighbouring bins up to `MAX_BIN`."""
    in_frame = rows @ frame
    unit = np.hypot(*in_frame.T)
    direction, size = in_frame / unit[:, None], unit * (1.0 + stretch)
    parts = []
    for k, p in enumerate(profiles):
        count = max(1, int(MAX_BIN * size[k] / p.step))
        used = len(p.position) // count * count
        x, charge = (v[:used].reshape(-1, count).mean(1) for v in (p.position, p.charge))
        inside = np.abs(x) < EDGE * size[k]
        width = count * p.step / size[k]
        charge = charge[inside] / (charge[inside].sum() * width)
        # Bins are points, as of a wire; the width of a pixel belongs to the resolution.
        merged = width**2 * (1.0 - 1.0 / count**2) / 12.0
        parts.append((np.full(len(charge), k), x[inside] / size[k], charge,
                      np.full(len(charge), merged)))  # fmt: skip
    profile, position, charge, merged = (np.concatenate(v) for v in zip(*parts, strict=True))
    width = np.sqrt(POINT**2 + merged + (resolution / size)[profile] ** 2)[:, None]
    distance = (position[:, None] - direction[profile] @ GRID.T) / width
    projection = PEAK / width * np.exp(-0.5 * distance**2)
    return Bins(profile, position, charge, projection, -distance / width * projection, direction)


class _Kernel(NamedTuple):
    """Gaussian process of a given length and envelope.

    ``bin_grid`` is the covariance of bins and grid points, shape (n, g), ``bin_covariance`` that of
    the bins.
    """

    length: float
    envelope: float
    bin_grid: np.ndarray
    bin_covariance: np.ndarray


def _kernel(bins: Bins, length: float, envelope: float) -> _Kernel:
    modes, n = STEP / math.sqrt(2.0 * math.pi) * _modes(length, envelope), len(AXIS)
    part = modes.T @ (bins.projection.reshape(-1, n) @ modes).reshape(len(bins.projection), n, -1)
    bin_grid = (modes @ part @ modes.T).reshape(-1, n * n)
    part = part.reshape(len(part), -1)
    return _Kernel(length, envelope, bin_grid, part @ part.T)


@cache
def _modes(length: float, envelope: float) -> np.ndarray:
    """Square root of the covariance along one axis, shape (m, modes), without modes that are
    rounding.

    The covariance on the grid is a product over the two axes, so that these modes give all of it.
    """
    envelope_values = np.exp(-0.5 * (AXIS / envelope) ** 2)
    values, vectors = np.linalg.eigh(
        envelope_values[:, None] * _correlation(length) * envelope_values
    )
    kept = values > ROUNDING * values[-1]
    return vectors[:, kept] * np.sqrt(values[kept])


def _kernels(bins: Bins, cores: Sequence[tuple[float, float]]) -> list[tuple[_Kernel, _Kernel]]:
    """List a core for each length and envelope, with the tail."""
    tail = _kernel(bins, *TAIL)
    return [(_kernel(bins, *core), tail) for core in cores]


@cache
def _correlation(length: float) -> np.ndarray:
    return np.exp(-0.5 * ((AXIS[:, None] - AXIS) / length) ** 2)


@cache
def _root(length: float) -> np.ndarray:
    return np.linalg.cholesky(_correlation(length) + JITTER * np.eye(len(AXIS)))


@cache
def _envelope(rms: float) -> np.ndarray:
    """Charge at each grid point of a Gaussian with the reference's peak."""
    return STEP**2 / (2.0 * math.pi) * np.exp(-0.5 * np.sum(GRID**2, axis=1) / rms**2)


@cache
def _gaussian() -> np.ndarray:
    """Reference Gaussian, of unit rms with the width of a grid point included."""
    rms = math.sqrt(1.0 - POINT**2)
    return _envelope(rms) / rms**2


class _Posterior(NamedTuple):
    """Posterior of the density for one kernel, linearised about a density and stretches.

    ``free`` are columns with unit priors: backgrounds, charges, centres, and three of the frame;
    ``stretching`` the columns of the stretches. ``residual`` are the bins less the reference,
    ``free_covariance`` is the covariance by the free columns, and ``parts`` are the covariances
    that scale with the squared amplitudes, as diagonals for noise. Numbers are ln of the
    amplitudes.
    """

    bins: Bins
    kernels: tuple[_Kernel, _Kernel]
    prior: np.ndarray
    residual: np.ndarray
    free: np.ndarray
    stretching: np.ndarray
    free_covariance: np.ndarray
    parts: tuple[np.ndarray, ...]

    @classmethod
    def build(
        cls,
        bins: Bins,
        density: np.ndarray,
        stretch: np.ndarray,
        kernels: tuple[_Kernel, _Kernel],
        prior: np.ndarray,
    ) -> _Posterior:
        expected, slope = bins.projection @ density, bins.slope @ density
        membership = bins.membership
        stretching = -membership * (expected + bins.position * slope)[:, None]
        c, s = bins.direction.T
        frame = stretching @ (FRAME * np.column_stack([c * c, s * s, math.sqrt(2.0) * c * s]))
        each = BACKGROUND * PEAK * np.ones_like(slope), CHARGE * expected, CENTRE * slope
        free = np.hstack([*(membership * column[:, None] for column in each), frame])
        # Bins are at the positions of these stretches, so the remaining stretches have a mean.
        residual = bins.charge - bins.projection @ _gaussian() + stretching @ stretch
        flat, by_charge = np.full_like(residual, PEAK**2), PEAK * np.maximum(expected, 0.0)
        parts = (*(k.bin_covariance for k in kernels), flat, by_charge, stretching @ stretching.T)
        return cls(bins, kernels, prior, residual, free, stretching, free @ free.T, parts)

    def _profile_errors(self) -> np.ndarray:
        """Covariance of errors of single profiles that no density gives."""
        position, profile = self.bins.position, self.bins.profile
        distance = (position[:, None] - position) / PROFILE_ERROR_LENGTH
        high = np.exp(-0.5 * (position / FRAME_CORE[1]) ** 2)
        variance = (PROFILE_ERROR * PEAK) ** 2 * (profile[:, None] == profile)
        return variance * np.outer(high, high) * np.exp(-0.5 * distance**2)

    def covariance(self, numbers: np.ndarray) -> np.ndarray:
        """Covariance of the bins at given amplitudes."""
        total = self.free_covariance.copy()
        diagonal = np.einsum("ii->i", total)
        for square, part in zip(np.exp(2.0 * numbers), self.parts, strict=True):
            (total if part.ndim == 2 else diagonal)[:] += square * part
        return total

    def bin_error(self, numbers: np.ndarray) -> np.ndarray:
        """Noise of each bin."""
        _, _, flat, by_charge, _ = self.parts
        square = np.exp(2.0 * numbers)
        return np.sqrt(square[2] * flat + square[3] * by_charge)

    def _factorise(self, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        """Give the Cholesky factor of the covariance, and minus ln of evidence times prior."""
        root = cholesky(self.covariance(numbers), lower=True, overwrite_a=True, check_finite=False)
        z = (numbers - self.prior[:, 0]) / self.prior[:, 1]
        white = solve_triangular(root, self.residual, lower=True, check_finite=False)
        return root, float(0.5 * white @ white + np.log(np.diag(root)).sum() + 0.5 * z @ z)

    def _loss(self, numbers: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus ln of evidence times prior, and its gradient (Rasmussen and Williams, 2006, eq.
        5.9).
        """
        try:
            root, loss = self._factorise(numbers)
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
        """Fit the amplitudes; return ln of the evidence and ln of the amplitudes."""
        middle, spread = self.prior.T
        bounds = list(
            zip(middle - AMPLITUDE_RANGE * spread, middle + AMPLITUDE_RANGE * spread, strict=True)
        )
        found = minimize(self._loss, start, jac=True, method="L-BFGS-B", bounds=bounds,
                         options={"maxiter": 30})  # fmt: skip
        return -float(found.fun), found.x

    def _pull(self, numbers: np.ndarray, residual: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self.covariance(numbers), residual)

    def _answer(self, numbers: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Change of the density for weighted residuals of the bins."""
        return sum(
            square * pull.T @ kernel.bin_grid
            for square, kernel in zip(np.exp(2.0 * numbers), self.kernels, strict=False)
        )

    def mean(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Give the mean density, the change of the frame, and the stretches."""
        pull = self._pull(numbers, self.residual)
        density = _gaussian() + self._answer(numbers, pull)
        stretch = math.exp(2.0 * numbers[-1]) * (self.stretching.T @ pull)
        return density, _symmetric(self.free.T @ pull), stretch

    def fitted(self, numbers: np.ndarray) -> np.ndarray:
        """Fitted bins, without their noise."""
        pull, error = self._pull(numbers, self.residual), self.bin_error(numbers)
        return self.bins.charge - error**2 * pull

    def worst(self, numbers: np.ndarray) -> int:
        """Index of the profile with the largest error of its own, if each may have one."""
        errors = self._profile_errors()
        part = errors @ np.linalg.solve(self.covariance(numbers) + errors, self.residual)
        return int(np.argmax(self.bins.membership.T @ part**2))

    def draws(
        self, numbers: np.ndarray, count: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw densities and changes of the frame, with amplitudes by importance sampling.

        Each is a draw of the prior corrected by the bins (A. G. Journel and C. J. Huijbregts,
        Mining Geostatistics, 1978, ch. VII). Amplitudes are proposed by Laplace's method with
        `PROPOSAL_SCALE` times its width, and resampled systematically along the scatter of
        settings, which is skew (G. Kitagawa, J. Comput. Graph. Stat. 5, 1 (1996), sec. 2.3).
        """
        step, unit = 0.1, np.eye(len(numbers))
        slopes = [[self._loss(numbers + sign * step * u)[1] for sign in (1.0, -1.0)] for u in unit]
        curvature = np.array([(above - below) / (2.0 * step) for above, below in slopes])
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        # The prior alone has at least this curvature: less is rounding.
        width = vectors / np.sqrt(np.maximum(values, 1.0 / self.prior[:, 1].max() ** 2))
        count_of_amplitudes = max(1, count // DRAWS_PER_AMPLITUDES)
        z = PROPOSAL_SCALE * random.normal(
            size=(PROPOSALS_PER_AMPLITUDES * count_of_amplitudes, len(numbers))
        )
        z = z[np.argsort(z @ width[-1])]
        proposed = numbers + z @ width.T
        log = 0.5 * np.sum(z**2, axis=1) / PROPOSAL_SCALE**2 - [
            self._factorise(at)[1] for at in proposed
        ]
        weight = np.exp(log - log.max())
        cumulative = np.cumsum(weight)
        targets = (
            (np.arange(count_of_amplitudes) + random.uniform())
            / count_of_amplitudes
            * cumulative[-1]
        )
        chosen = np.searchsorted(cumulative, targets)
        parts = [
            self._draws_at(proposed[i], len(share), random)
            for i, share in zip(
                chosen, np.array_split(np.arange(count), count_of_amplitudes), strict=True
            )
        ]
        densities, changes = zip(*parts, strict=True)
        return np.concatenate(densities), np.concatenate(changes)

    def _draws_at(
        self, numbers: np.ndarray, count: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        amplitude, n, density = np.exp(numbers), len(AXIS), np.zeros((count, len(GRID)))
        for scale, kernel in zip(amplitude, self.kernels, strict=False):
            root = _root(kernel.length)
            sample = root @ random.normal(size=(count, n, n)) @ root.T
            density += scale * _envelope(kernel.envelope) * sample.reshape(count, -1)
        free = random.normal(size=(count, self.free.shape[1]))
        stretch = amplitude[-1] * random.normal(size=(count, self.stretching.shape[1]))
        noise = self.bin_error(numbers) * random.normal(size=(count, len(self.residual)))
        simulated = (
            density @ self.bins.projection.T + free @ self.free.T + stretch @ self.stretching.T
        )
        pull = self._pull(numbers, (self.residual - simulated - noise).T)
        densities = _gaussian() + density + self._answer(numbers, pull)
        corrected = free + pull.T @ self.free
        return densities, np.array([_symmetric(row) for row in corrected])


def _symmetric(free: np.ndarray) -> np.ndarray:
    """Change of the frame from the last three of the free columns."""
    a, b, c = FRAME * free[-3:]
    return np.array([[a, c / math.sqrt(2.0)], [c / math.sqrt(2.0), b]])
