"""Posterior of a beam and probabilities of its rivals, from the measured sizes of a plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from beamfit.emittance.beam_draws import (
    MAX_SIZE_RATIO,
    BeamDraws,
    Coordinates,
    coordinates,
    draw_beams,
    zero_emittance_evidence,
)
from beamfit.emittance.model import coefficients
from beamfit.noise.model import LN_2PI, Noise
from beamfit.noise.sizes import (
    LONG_SCAN,
    NoiseKind,
    Scales,
    bad_density,
    is_share_of_size,
    kinds_of,
    log_average,
    log_likelihood,
    posterior_scales,
    prior_scales,
    variance_of,
)

BEAM, ZERO_EMITTANCE = "beam", "beam of no emittance"
CONSTANT, RANDOM, DRIFTING = "one constant size", "sizes at random", "sizes that drift"
CURVE = "a smooth curve that is no beam's"
# Prior probabilities of what a scan measured: most are scans of a beam (docs/verdict.md).
MODELS = {
    BEAM: 0.85,
    ZERO_EMITTANCE: 0.03,
    CONSTANT: 0.03,
    RANDOM: 0.04,
    DRIFTING: 0.02,
    CURVE: 0.03,
}
# The same where no magnet moved: a constant size, a drift or a curve cannot be distinguished.
UNMOVED = {BEAM: 0.9, ZERO_EMITTANCE: 0.05, RANDOM: 0.05}
# Rivals are compared on at most this many points, spread over the scan; the beam is fitted to all.
MAX_COMPARED = LONG_SCAN
# Planes in one call, for memory; iterations of the best fit; relative change at which it stops.
MAX_PLANES_PER_CALL, MAX_ITERATIONS, CONVERGENCE_TOLERANCE = 16, 40, 1e-11
# Standard deviations of ln size, of sizes at random and per row of a drift.
AMPLITUDES = np.geomspace(0.05, 1.0, 6)
# Amplitudes of a smooth curve as shares of the mean size, and its correlation lengths as shares of
# the scan.
CURVE_AMPLITUDES, CURVE_LENGTHS = np.array([0.2, 0.4, 0.7, 1.2]), (0.25, 0.5)
# Amplitudes of a smooth departure from a beam, as shares of the size, and its correlation length as
# a share of the scan.
DEPARTURE_AMPLITUDES, DEPARTURE_LENGTH = np.array([0.1, 0.2, 0.4]), 0.7
# Share of departures in the probability of a smooth curve: one scan in a thousand departs, so that
# a departure hidden in the noise rejects no good scan.
DEPARTURE_SHARE = 1 / 30
# Prior standard deviation of ln of a constant size: any value near the sizes.
LN_SIZE_SPREAD = 1.0
# Quantiles of a posterior: an error is half of the central 68 %, an interval the central 95 %.
QUANTILES = (0.025, 0.1587, 0.5, 0.8413, 0.975)


def _curve_covariance(w: np.ndarray, length: float) -> np.ndarray:
    """Matérn 3/2 covariance of a curve in the rank of R11/R12, shape (..., n, n)."""
    n = w.shape[-2]
    with np.errstate(divide="ignore", invalid="ignore"):
        rank = np.argsort(np.argsort(w[..., 0] / w[..., 1], axis=-1), axis=-1)
    distance = np.abs(rank[..., :, None] - rank[..., None, :]) / n / length
    return (1.0 + distance) * np.exp(-distance)


def curve_evidences(u: np.ndarray, c: Coordinates, kind: NoiseKind, noise: Noise) -> np.ndarray:
    """Log evidences of a constant size, random sizes, a drift and a smooth curve; shape (4, ...).

    Parameters
    ----------
    u : ndarray
        Shape (..., n, 2): R11 and R12.
    c, kind, noise
        As for `draw_beams`.

    Notes
    -----
    Gaussian processes about a constant mean, in ln of the size (for the curve, in the size): C. E.
    Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. 2.30 and
    sect. 2.7. The covariance of n points is a²C + D; the eigenvalues of D^-½ C D^-½ give all
    amplitudes a at once.
    """
    n = c.size.shape[-1]
    x = np.log(c.size)
    # In ln size, noise that is the same at every size is divided by the size.
    ln_kind = kind
    if not kind.power:
        ln_kind = replace(kind, floor=kind.floor / c.size, unit=kind.unit / c.size)
    level_kind = replace(ln_kind, power=0)
    mean = x.mean(-1)
    levels = np.linspace(-4.0, 4.0, 65)
    spread = np.maximum(x.std(-1, ddof=1), 0.02)[..., None] / math.sqrt(n) * 2.5
    mu = mean[..., None] + levels * spread
    residual = x[..., None, :] - mu[..., None]

    def at_levels(scale: np.ndarray) -> np.ndarray:
        return log_likelihood(residual, residual, level_kind, scale, noise)

    scales = posterior_scales(level_kind, c.unit.shape, at_levels)
    at_level = log_average(at_levels(scales.scale), scales.log_weight[..., None, :])
    prior = -0.5 * (mu / LN_SIZE_SPREAD) ** 2 - 0.5 * LN_2PI - math.log(LN_SIZE_SPREAD)
    constant = log_average(at_level + prior, np.log(8.0 / 64 * spread))
    wide = prior_scales(level_kind, c.unit.shape)
    variance = variance_of(level_kind, wide.scale)
    unit_matrix = np.broadcast_to(np.eye(n), (*c.unit.shape, n, n))
    random = _process_evidence(x, unit_matrix, AMPLITUDES, variance, wide, noise)
    # Covariance of a random walk over the rows in the order of the file.
    walk = np.broadcast_to(np.minimum.outer(np.arange(n), np.arange(n)), unit_matrix.shape)
    drift = _process_evidence(x, walk, AMPLITUDES, variance, wide, noise)
    by_size, deviation = variance * c.size[..., None, :] ** 2, c.size - 1.0
    curves = [
        _process_evidence(
            deviation, _curve_covariance(u, each), CURVE_AMPLITUDES, by_size, wide, noise
        )
        for each in CURVE_LENGTHS
    ]
    curve = np.logaddexp(*curves) - math.log(2.0) + x.sum(-1)
    return np.stack([constant, random, drift, curve]) + kind.log_weight


def _process_evidence(
    x: np.ndarray, kernel: np.ndarray, amplitudes: np.ndarray, variance: np.ndarray,
    scales: Scales, noise: Noise,
) -> np.ndarray:  # fmt: skip
    """Log evidence of a Gaussian process about a constant, averaged over amplitudes and noise."""
    n = x.shape[-1]
    root = np.sqrt(variance)
    values, vectors = np.linalg.eigh(
        kernel[..., None, :, :] / root[..., :, None] / root[..., None, :]
    )
    transposed = np.swapaxes(vectors, -1, -2)
    q = (transposed @ (x[..., None, :] / root)[..., None])[..., None, :, 0]
    one = (transposed @ (LN_SIZE_SPREAD / root)[..., None])[..., None, :, 0]
    ratio = 1.0 + amplitudes[:, None] ** 2 * np.maximum(values, 0.0)[..., None, :]
    qq, qo, oo = (np.sum(v / ratio, axis=-1) for v in (q * q, q * one, one * one))
    log_det = np.log(ratio).sum(-1) + np.log1p(oo) + np.log(variance).sum(-1)[..., None]
    log = -0.5 * (qq - qo**2 / (1.0 + oo) + log_det + n * LN_2PI)
    q, one = q / ratio @ transposed, one / ratio @ transposed
    weighted = q - one * (qo / (1.0 + oo))[..., None]
    precision = 1.0 / ratio @ transposed**2 - one**2 / (1.0 + oo)[..., None]
    log = log_average(
        log + bad_reading_gain(weighted, precision, noise), -math.log(len(amplitudes))
    )
    return log_average(log, scales.log_weight)


def bad_reading_gain(weighted: np.ndarray, precision: np.ndarray, noise: Noise) -> np.ndarray:
    """Log of the factor by which one bad reading may raise a likelihood, shape (..., n) to (...).

    Parameters
    ----------
    weighted, precision : ndarray
        Shape (..., n): K⁻¹y and the diagonal of K⁻¹, for readings y of covariance K in units of
        their noise level.
    noise : Noise
        Prior of bad readings.

    Notes
    -----
    Given the other readings, reading i is normal with variance 1/(K⁻¹)ᵢᵢ about
    yᵢ - (K⁻¹y)ᵢ/(K⁻¹)ᵢᵢ (Rasmussen and Williams, eq. 5.12); the width of a bad one adds to that.
    """
    precision = np.maximum(precision, 1e-12)
    variance = noise.width**2 + 1.0 / precision - 1.0
    bad = math.log(noise.bad / (1.0 - noise.bad)) + 0.5 * math.log(2.0 / math.pi)
    bad = (
        bad - 0.5 * np.log(variance * precision) - np.log1p((weighted / precision) ** 2 / variance)
    )
    bad = np.logaddexp.reduce(bad + 0.5 * weighted**2 / precision, axis=-1)
    return np.logaddexp(0.0, bad) + weighted.shape[-1] * math.log1p(-noise.bad)


def departure_odds(
    x: np.ndarray, u: np.ndarray, c: Coordinates, kind: NoiseKind, noise: Noise
) -> np.ndarray:
    """Log odds of a beam with a smooth departure against a beam alone, shape (...,).

    Parameters
    ----------
    x : ndarray
        Shape (..., 3): T, T p_1, T p_2 of a beam near the best fit.
    u, c, kind, noise
        As for `curve_evidences`.

    Notes
    -----
    Both models are linear about the beam, whose three numbers are integrated out with a flat
    prior: D. A. Harville, Biometrika 61 (1974) 383. The departure is a Gaussian process of the
    setting, as the smooth curve of `curve_evidences`.
    """
    n = c.size.shape[-1]
    if n < 5:
        return np.full(c.unit.shape, -np.inf)
    model = _fitted_sizes(x, c)
    scales = prior_scales(kind, c.unit.shape)
    root = np.sqrt(variance_of(kind, scales.scale)) * model[..., None, :] ** kind.power
    rows = c.rows[..., None, :, :] / (2.0 * model)[..., None, :, None] / root[..., None]
    basis, triangle = np.linalg.qr(rows, mode="complete")
    complement = np.swapaxes(basis[..., 3:], -1, -2)
    q = (complement @ ((c.size - model)[..., None, :] / root)[..., None])[..., 0]
    shares = model[..., None, :] / root
    kernel = (
        _curve_covariance(u, DEPARTURE_LENGTH)[..., None, :, :]
        * shares[..., None]
        * shares[..., None, :]
    )
    values, vectors = np.linalg.eigh(complement @ kernel @ np.swapaxes(complement, -1, -2))
    transposed = np.swapaxes(vectors, -1, -2)
    q, projection = (transposed @ q[..., None])[..., None, :, 0], transposed @ complement
    # Amplitude 0 is the beam alone.
    amplitudes = np.append(0.0, DEPARTURE_AMPLITUDES)
    variance = 1.0 + amplitudes[:, None] ** 2 * np.maximum(values, 0.0)[..., None, :]
    log = -0.5 * np.sum(q**2 / variance + np.log(variance), axis=-1)
    log = log + bad_reading_gain(q / variance @ projection, 1.0 / variance @ projection**2, noise)
    log_volume = np.log(np.abs(np.einsum("...ii->...i", triangle[..., :3, :]))).sum(-1)
    log = np.swapaxes(log - (np.log(root).sum(-1) + log_volume)[..., None], -1, -2)
    log = log_average(log, scales.log_weight[..., None, :])
    odds = log_average(log[..., 1:], -math.log(len(DEPARTURE_AMPLITUDES))) - log[..., 0]
    # Settings that do not separate the beam's numbers cannot show a departure.
    return np.where(c.separable & np.isfinite(odds), odds, -np.inf)


class PlaneSizes(NamedTuple):
    """Measured sizes of one plane with their transfer-matrix elements, arrays of shape (n,).

    Attributes
    ----------
    r11, r12, known : ndarray
        Transfer-matrix elements (R12 in m), and size² not due to the beam, m².
    size : ndarray
        m.
    error : ndarray or None
        Stated errors, or the errors of means of shots, m.
    of_shots : bool
        Whether the errors are those of means of shots.
    moved : bool
        Whether a magnet moved.
    """

    r11: np.ndarray
    r12: np.ndarray
    known: np.ndarray
    size: np.ndarray
    error: np.ndarray | None
    of_shots: bool
    moved: bool

    def subset(self, number: int) -> PlaneSizes:
        """Select this number of points, evenly spread over the rows."""
        at = np.linspace(0, len(self.size) - 1, number).astype(int)
        rows = [None if v is None else v[at] for v in self[:5]]
        return PlaneSizes(*rows, self.of_shots, self.moved)

    def kinds_under(self, unit: float, noise: Noise) -> tuple[NoiseKind, ...]:
        """Kinds of noise under some priors, in units of `unit` (m)."""
        error = None if self.error is None else self.error / unit
        return kinds_of(noise, self.size / unit, error, self.of_shots)

    @property
    def comparison_key(self) -> tuple:
        """Key of planes that one call can compare: points, kind of errors, moved magnets."""
        if self.error is None:
            return len(self.size), "none", self.moved
        kind = "share" if is_share_of_size(self.error, self.size) else "stated"
        word = "shots" if self.of_shots else kind
        return len(self.size), word, self.moved


class PlanePosterior(NamedTuple):
    """Posterior of a plane's beam, averaged over the noise.

    Attributes
    ----------
    probability : dict of str to float
        Of a beam and each of its rivals.
    sigma, weight : ndarray
        Draws of σ11, σ12, σ22 in SI, shape (d, 3), and their positive weights, which sum to 1.
    best : ndarray
        Shape (3,): σ of the best fit, or the mean of the draws where that is not positive definite.
    positive : bool
        Whether the σ of the best fit is positive definite.
    covariance, stated_covariance : ndarray
        Shape (3, 3): linear covariance of ``best`` with the errors found, and with the stated
        errors (NaN without); NaN where the settings do not separate the three numbers.
    model, error, bad : ndarray
        Shape (n,): fitted sizes and the errors found, m, and the probability of a bad reading.
    noise : {"stated", "share", "beyond", "shots", "none"}
        Kind of errors given, or "beyond" if settings scatter beyond their stated errors.
    scale : ndarray
        Shape (3,): median and central 68 % of the noise scale.
    relative : float
        Probability that errors are a share of the size.
    chi2 : float
        With the stated errors; NaN without.
    seen : bool
        Whether the settings separate the three numbers of the beam.
    kinds, scales : tuple
        Kinds of noise and their nodes, in units of ``unit``.
    scale_log_evidence : tuple of ndarray
        Log evidence of a beam at each node of each kind.
    unit : float
        The mean size, m.
    trace : ndarray
        Shape (3,): the T of the prior (see `beam_draws`) is ``trace @ sigma``.
    """

    probability: dict[str, float]
    sigma: np.ndarray
    weight: np.ndarray
    best: np.ndarray
    positive: bool
    covariance: np.ndarray
    stated_covariance: np.ndarray
    model: np.ndarray
    error: np.ndarray
    bad: np.ndarray
    noise: str
    scale: np.ndarray
    relative: float
    chi2: float
    separable: bool
    kinds: tuple[NoiseKind, ...]
    scales: tuple[Scales, ...]
    scale_log_evidence: tuple[np.ndarray, ...]
    unit: float
    trace: np.ndarray

    @property
    def cause(self) -> str:
        """The most probable model."""
        return max(self.probability, key=self.probability.__getitem__)

    @property
    def effective_draws(self) -> float:
        """Effective sample size of the draws."""
        return float(1.0 / np.sum(self.weight**2))

    @property
    def zero_emittance_probability(self) -> float:
        """Probability of a zero-emittance beam, given that it is a beam."""
        none, some = self.probability[ZERO_EMITTANCE], self.probability[BEAM]
        return none / max(none + some, 1e-300)


def compare(
    planes: Sequence[PlaneSizes],
    noise: Noise,
    method: str = "size_squared",
    weights: str = "model",
) -> list[PlanePosterior]:
    """Compare a beam with its rivals in each of many planes.

    Parameters
    ----------
    planes : sequence of PlaneSizes
        Planes with the same `comparison_key` are compared in one call.
    noise : Noise
        Priors of the noise.
    method : {"size_squared", "size"}
        Residual that the best fit minimises.
    weights : {"model", "measured"}
        Size at which its errors are taken.

    Returns
    -------
    list of PlanePosterior

    Notes
    -----
    An evidence is the integral of the likelihood over the prior. Ratios of evidences times those of
    the priors are the odds of the models (D. J. C. MacKay, Information Theory, Inference, and
    Learning Algorithms (2003), eq. 28.4). All models share the noise.
    """
    alike: dict[tuple, list[int]] = {}
    for i, plane in enumerate(planes):
        alike.setdefault(plane.comparison_key, []).append(i)
    found = {}
    for (count, *_), members in alike.items():
        for start in range(0, len(members), MAX_PLANES_PER_CALL):
            own = members[start : start + MAX_PLANES_PER_CALL]
            compared = _compare_alike(
                [planes[i] for i in own], noise.of_points(count), method, weights
            )
            found |= dict(zip(own, compared, strict=True))
    return [found[i] for i in range(len(planes))]


class _Stack(NamedTuple):
    """Planes with one comparison key in normalised coordinates; arrays begin with the planes."""

    c: Coordinates
    u: np.ndarray
    kinds: tuple[NoiseKind, ...]


def _stack(planes: Sequence[PlaneSizes], noise: Noise, alike: bool | None = None) -> _Stack:
    """Stack planes in normalised coordinates, with their kinds of noise."""
    r11, r12, known, size = (np.stack([p[i] for p in planes]) for i in range(4))
    c = coordinates(r11, r12, size, known)
    first, error = planes[0], None
    if first.error is not None:
        error = np.stack([p.error for p in planes]) / c.unit[:, None]
    kinds = kinds_of(noise, c.size, error, first.of_shots, alike)
    return _Stack(c, np.stack([r11, r12], -1), kinds)


def _compare_alike(
    planes: Sequence[PlaneSizes], noise: Noise, method: str, weights: str
) -> list[PlanePosterior]:
    """Compare planes that share a comparison key."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s = _stack(planes, noise)
        draws = [draw_beams(s.c, kind, noise) for kind in s.kinds]
        compared, compared_draws = s, draws
        if s.c.size.shape[-1] > MAX_COMPARED:
            # A few errors may be one share of the size by chance: the kind is that of all points.
            alike = planes[0].comparison_key[1] == "share"
            compared = _stack([p.subset(MAX_COMPARED) for p in planes], noise, alike)
            compared_draws = [draw_beams(compared.c, kind, noise) for kind in compared.kinds]
        evidence = np.array(
            [_model_evidences(compared, i, d, noise) for i, d in enumerate(compared_draws)]
        )
        of_kind = np.logaddexp.reduce(evidence, axis=-1)
        of_kind = np.exp(of_kind - np.logaddexp.reduce(of_kind, axis=0))
        best = _best_fit(s, draws, of_kind, noise, method, weights)
    total = np.logaddexp.reduce(evidence, axis=0)
    prior = MODELS if planes[0].moved else UNMOVED
    log = total + np.log([prior.get(name, 1e-300) for name in MODELS])
    log = np.where(np.isfinite(log), log, -1e300)
    probability = np.exp(log - np.logaddexp.reduce(log, axis=-1)[:, None])
    return [
        _plane_posterior(plane, i, s, draws, of_kind[:, i], probability[i], best, weights)
        for i, plane in enumerate(planes)
    ]


def _model_evidences(s: _Stack, i: int, draws: BeamDraws, noise: Noise) -> np.ndarray:
    """Log evidences of all models under one kind of noise, as densities in ln size."""
    kind = s.kinds[i]
    beam = log_average(draws.log_weight, 0.0)
    zero_emittance = np.full_like(beam, -np.inf)
    if not kind.power:
        zero_emittance = zero_emittance_evidence(s.c, kind, noise)
    elif all(k.power for k in s.kinds):
        # Noise that is a share of a zero-emittance beam's size would vanish with it. The share is
        # taken of the best beam's size instead. A share of the measured sizes would let large slow
        # noise explain sizes that are all alike.
        size = _fitted_sizes(draws.best, s.c)
        noise_kind = replace(kind, power=0, floor=kind.floor * size, unit=kind.unit * size)
        zero_emittance = zero_emittance_evidence(s.c, noise_kind, noise)
    jacobian = np.log(s.c.size).sum(-1)
    # A rival under slow noise is evaluated with uncorrelated noise: it has a drift of its own.
    curves = curve_evidences(s.u, s.c, replace(kind, slow=False), noise)
    if not kind.slow:
        departure = beam + jacobian + departure_odds(draws.best, s.u, s.c, kind, noise)
        curves[-1] = np.logaddexp(
            curves[-1] + math.log1p(-DEPARTURE_SHARE), departure + math.log(DEPARTURE_SHARE)
        )
    return np.stack([beam + jacobian, zero_emittance + jacobian, *curves], -1)


class _BestFit(NamedTuple):
    """Best fit of planes: T, T p, model sizes, precisions and probabilities of bad readings."""

    x: np.ndarray
    model: np.ndarray
    precision: np.ndarray
    bad: np.ndarray


def _best_fit(
    s: _Stack, draws: Sequence[BeamDraws], of_kind: np.ndarray, noise: Noise, method: str,
    weights: str,
) -> _BestFit:  # fmt: skip
    """Fit by weighted least squares, with the expected precision of each point as its weight.

    The noise scale comes from its posterior, the probability of a bad reading from the previous fit
    (expectation and maximisation; A. P. Dempster, N. M. Laird and D. B. Rubin, J. R. Stat. Soc. B
    39, 1 (1977)).
    """
    c, rows = s.c, s.c.rows
    top = np.array([d.best_log_likelihood for d in draws]) + np.log(np.maximum(of_kind, 1e-300))
    first = np.argmax(top, axis=0)
    x = np.array([d.best for d in draws])[first, np.arange(len(first))]
    converged = np.zeros(len(x), bool)
    for _ in range(MAX_ITERATIONS):
        model = _fitted_sizes(x, c)
        kinds = zip(s.kinds, draws, strict=True)
        parts = [_expected_precision(model, c, kind, d, noise) for kind, d in kinds]
        precision = sum(w[:, None] * p for w, (p, _) in zip(of_kind, parts, strict=True))
        if method == "size_squared":
            target, at = c.size**2, model if weights == "model" else c.size
        else:  # size² linearised about the model, so that the residual is that of the size
            target, at = model**2 + 2.0 * model * (c.size - model), model
        scale = np.sqrt(precision) / (2.0 * at)
        design = rows * scale[..., None]
        normal = np.swapaxes(design, -1, -2) @ design
        trace = np.trace(normal, axis1=-2, axis2=-1)[:, None, None]
        last = x
        projected = np.swapaxes(design, -1, -2) @ ((target - c.known) * scale)[..., None]
        x = np.linalg.solve(normal + 1e-14 * trace * np.eye(3), projected)[..., 0]
        # A converged plane stays as it is, independent of the others in the call.
        x = np.where(converged[:, None], last, x)
        converged |= np.abs(x - last).max(-1) < CONVERGENCE_TOLERANCE * np.abs(x).max(-1)
        if converged.all():
            break
    bad = sum(w[:, None] * b for w, (_, b) in zip(of_kind, parts, strict=True))
    return _BestFit(x, _fitted_sizes(x, c), precision, bad)


def _fitted_sizes(x: np.ndarray, c: Coordinates) -> np.ndarray:
    """Sizes of the best fit, kept away from zero; shape (planes, n)."""
    squared = (c.rows @ x[..., None])[..., 0] + c.known
    # No upper limit: a wrong setting may make the model a hundred times larger than any size.
    smallest = c.size.min(-1, keepdims=True)
    return np.sqrt(np.maximum(squared, (smallest / MAX_SIZE_RATIO) ** 2))


def _expected_precision(
    model: np.ndarray, c: Coordinates, kind: NoiseKind, draws: BeamDraws, noise: Noise
) -> tuple[np.ndarray, np.ndarray]:
    """Expected precision of each point's size, and the probability that the reading is bad."""
    variance, share = variance_of(kind, draws.scales.scale), draws.scale_weight[..., None]
    pull = (((c.size - model) / model**kind.power) ** 2)[:, None, :] / variance
    bad = 1.0 / (1.0 + np.exp(-0.5 * pull) / bad_density(pull, noise))
    # A Cauchy distribution is a scale mixture of normal ones; this is their mean precision.
    precision = (1.0 - bad + bad * 2.0 / (noise.width**2 + pull)) / variance
    return (share * precision).sum(1) / model ** (2 * kind.power), (share * bad).sum(1)


def _plane_posterior(
    plane: PlaneSizes, i: int, s: _Stack, draws: Sequence[BeamDraws], of_kind: np.ndarray,
    probability: np.ndarray, best: _BestFit, weights: str,
) -> PlanePosterior:  # fmt: skip
    """Posterior of plane ``i`` in SI, from its draws under all kinds of noise."""
    c = Coordinates(*(part[i] for part in s.c))
    log = np.concatenate([d.log_weight[i] for d in draws])
    weight = np.exp(log - log.max()) if np.isfinite(log.max()) else np.ones(len(log))
    weight /= weight.sum()
    sigma = c.sigma(np.concatenate([d.x[i] for d in draws]))[weight > 0.0]
    weight = weight[weight > 0.0]
    found, unit = c.sigma(best.x[i][None])[0], float(c.unit)
    positive = bool(found[0] > 0 and found[0] * found[2] > found[1] ** 2) and bool(c.separable)
    model = best.model[i] * unit
    error, likeliest = unit / np.sqrt(best.precision[i]), int(np.argmax(of_kind))
    weighed = model if weights == "model" else plane.size
    rows = np.stack(coefficients(plane.r11, plane.r12), -1) / (2.0 * weighed)[:, None]
    none = np.full((3, 3), np.nan)
    stated_covariance, chi2 = none, math.nan
    if plane.error is not None:
        stated_error = plane.error * (
            model / plane.size if plane.comparison_key[1] == "share" else 1.0
        )
        stated_covariance = _covariance(rows / stated_error[:, None]) if c.separable else none
        chi2 = float(np.sum(((plane.size - model) / stated_error) ** 2))
    normalise = np.linalg.inv(c.back * unit)
    trace, noise_draws = normalise.T @ normalise, draws[likeliest]
    beyond = np.any(s.kinds[likeliest].floor) and not plane.of_shots
    return PlanePosterior(
        probability=dict(zip(MODELS, map(float, probability), strict=True)),
        sigma=sigma,
        weight=weight,
        best=found if positive else weight @ sigma,
        positive=positive,
        covariance=_covariance(rows / error[:, None]) if c.separable else none,
        stated_covariance=stated_covariance,
        model=model,
        error=error,
        bad=best.bad[i],
        noise="beyond" if beyond else plane.comparison_key[1],
        scale=weighted_quantiles(
            noise_draws.scales.scale[i],
            noise_draws.scale_weight[i],
            (QUANTILES[2], QUANTILES[1], QUANTILES[3]),
        ),
        relative=float(sum(w * k.power for w, k in zip(of_kind, s.kinds, strict=True))),
        chi2=chi2,
        separable=bool(c.separable),
        kinds=jax.tree.map(lambda part: part[i], s.kinds),
        scales=tuple(Scales(*(part[i] for part in d.scales)) for d in draws),
        scale_log_evidence=tuple(d.scale_log_evidence[i] for d in draws),
        unit=unit,
        trace=np.array([trace[0, 0], 2.0 * trace[0, 1], trace[1, 1]]),
    )


def _covariance(rows: np.ndarray) -> np.ndarray:
    """Invert rowsᵀ rows, by QR with unit columns."""
    norm = np.linalg.norm(rows, axis=0)
    r = np.linalg.qr(rows / norm, mode="r")
    root = np.linalg.solve(r, np.eye(3)) / norm[:, None]
    return root @ root.T


def weighted_quantiles(values: np.ndarray, weight: np.ndarray, at: Sequence[float]) -> np.ndarray:
    """Quantiles of weighted draws, shape (d,).

    Examples
    --------
    >>> weighted_quantiles(np.array([3.0, 1.0, 2.0]), np.ones(3), (0.5,)).tolist()
    [2.0]
    """
    order = np.argsort(values)
    cumulated = np.cumsum(weight[order])
    return np.interp(np.asarray(at) * cumulated[-1], cumulated - 0.5 * weight[order], values[order])


def emittance_quantiles(
    emittance: np.ndarray, weight: np.ndarray, none: float, at: Sequence[float]
) -> np.ndarray:
    """Quantiles of the emittance, with a probability ``none`` that it is zero.

    Examples
    --------
    >>> emittance_quantiles(np.array([3.0, 1.0, 2.0]), np.ones(3), 0.5, (0.4, 0.75)).tolist()
    [0.0, 2.0]
    """
    at = np.asarray(at)
    within = np.maximum((at - none) / (1.0 - none), 0.0) if none < 1.0 else 0.0 * at
    return np.where(at > none, weighted_quantiles(emittance, weight, within), 0.0)
