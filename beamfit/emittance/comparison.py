"""Is there a beam, and how sure is its emittance? One posterior for every answer of a scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from beamfit.emittance.beam_draws import (
    FURTHEST,
    BeamDraws,
    Coordinates,
    coordinates,
    draw_beams,
    flat_evidence,
)
from beamfit.emittance.model import coefficients
from beamfit.noise.model import LN_2PI, Noise
from beamfit.noise.sizes import (
    LONG,
    NoiseKind,
    Scales,
    averaged,
    bad_density,
    kinds_of,
    log_likelihood,
    of_one_share,
    scales_of,
    variance_of,
    wide_scales,
)

BEAM, FLAT = "beam", "beam of no emittance"
CONSTANT, RANDOM, DRIFTING = "one constant size", "sizes at random", "sizes that drift"
CURVE = "a smooth curve that is no beam's"
# What scans turn out to be, before their sizes are seen: most are scans of a beam.
MODELS = {BEAM: 0.85, FLAT: 0.03, CONSTANT: 0.03, RANDOM: 0.04, DRIFTING: 0.02, CURVE: 0.03}
# Of rows that moved no magnet only a beam and sizes at random are possible.
UNMOVED = {BEAM: 0.9, FLAT: 0.05, RANDOM: 0.05}
# Models are told apart by at most so many points, evenly among all: the beam by every one.
COMPARED = LONG
# Planes that are looked at in one call, and rounds of the best fit and when it rests.
TOGETHER, ROUNDS, REST = 16, 40, 1e-11
# Steps of ln size of sizes at random or in a drift; bends of a curve as shares of the mean size,
# and over which share of the scan it bends.
STEPS = np.geomspace(0.05, 1.0, 6)
BENDS, LENGTHS = np.array([0.2, 0.4, 0.7, 1.2]), (0.25, 0.5)
# Amplitudes of a smooth departure from a beam's sizes, as shares of the size; over which share of
# the scan it bends; and the part of the chance of "a smooth curve" that it has: with it one scan in
# a thousand departs, so that a departure which the noise would hide refuses no good scan.
DEPARTURES, SMOOTH, NEAR = np.array([0.1, 0.2, 0.4]), 0.7, 1 / 30
# Standard deviation of ln of a constant size.
LEVEL = 1.0
# Quantiles of a posterior: an error is half of the central 68 %, an interval the central 95 %.
AT = (0.025, 0.1587, 0.5, 0.8413, 0.975)


def _bends(w: np.ndarray, length: float) -> np.ndarray:
    """Covariance of a smooth curve of the setting, shape (..., n, n): Matérn 3/2 in its rank."""
    n = w.shape[-2]
    with np.errstate(divide="ignore", invalid="ignore"):
        rank = np.argsort(np.argsort(w[..., 0] / w[..., 1], axis=-1), axis=-1)
    far = np.abs(rank[..., :, None] - rank[..., None, :]) / n / length
    return (1.0 + far) * np.exp(-far)


def curve_evidences(u: np.ndarray, c: Coordinates, kind: NoiseKind, noise: Noise) -> np.ndarray:
    """Log evidences of one size, sizes at random, a drift, a smooth curve; shape (4, ...).

    Parameters
    ----------
    u : ndarray
        Shape (..., n, 2): R11 and R12.
    c, kind, noise
        As for `draw_beams`.

    Notes
    -----
    Gaussian processes about a constant mean, in ln of the size (of a curve in the size): C. E.
    Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. 2.30 and
    sect. 2.7. With the covariance a²C + D of n points the eigenvalues of D^-½ C D^-½ give all
    amplitudes a at once.
    """
    n = c.size.shape[-1]
    x = np.log(c.size)
    # In ln size the noise of one size for all is a share of it.
    own = kind
    if not kind.power:
        own = replace(kind, floor=kind.floor / c.size, unit=kind.unit / c.size)
    flat = replace(own, power=0)
    mean = x.mean(-1)
    levels = np.linspace(-4.0, 4.0, 65)
    spread = np.maximum(x.std(-1, ddof=1), 0.02)[..., None] / math.sqrt(n) * 2.5
    mu = mean[..., None] + levels * spread
    off = x[..., None, :] - mu[..., None]

    def at_levels(scale: np.ndarray) -> np.ndarray:
        return log_likelihood(off, off, flat, scale, noise)

    scales = scales_of(flat, c.unit.shape, at_levels)
    here = averaged(at_levels(scales.scale), scales.log_weight[..., None, :])
    prior = -0.5 * (mu / LEVEL) ** 2 - 0.5 * LN_2PI - math.log(LEVEL)
    constant = averaged(here + prior, np.log(8.0 / 64 * spread))
    wide = wide_scales(flat, c.unit.shape)
    variance = variance_of(flat, wide.scale)
    same = np.broadcast_to(np.eye(n), (*c.unit.shape, n, n))
    random = _process(x, same, STEPS, variance, wide, noise)
    # The covariance of a walk over the rows in the order of the file.
    walk = np.broadcast_to(np.minimum.outer(np.arange(n), np.arange(n)), same.shape)
    drift = _process(x, walk, STEPS, variance, wide, noise)
    by_size, own = variance * c.size[..., None, :] ** 2, c.size - 1.0
    curves = [_process(own, _bends(u, each), BENDS, by_size, wide, noise) for each in LENGTHS]
    curve = np.logaddexp(*curves) - math.log(2.0) + x.sum(-1)
    return np.stack([constant, random, drift, curve]) + kind.log_weight


def _process(
    x: np.ndarray, kernel: np.ndarray, amplitudes: np.ndarray, variance: np.ndarray,
    scales: Scales, noise: Noise,
) -> np.ndarray:  # fmt: skip
    """Log evidence of a Gaussian process about a constant, amplitudes and noise averaged over."""
    n = x.shape[-1]
    root = np.sqrt(variance)
    values, vectors = np.linalg.eigh(
        kernel[..., None, :, :] / root[..., :, None] / root[..., None, :]
    )
    turned = np.swapaxes(vectors, -1, -2)
    q = (turned @ (x[..., None, :] / root)[..., None])[..., None, :, 0]
    one = (turned @ (LEVEL / root)[..., None])[..., None, :, 0]
    grown = 1.0 + amplitudes[:, None] ** 2 * np.maximum(values, 0.0)[..., None, :]
    qq, qo, oo = (np.sum(v / grown, axis=-1) for v in (q * q, q * one, one * one))
    log_det = np.log(grown).sum(-1) + np.log1p(oo) + np.log(variance).sum(-1)[..., None]
    log = -0.5 * (qq - qo**2 / (1.0 + oo) + log_det + n * LN_2PI)
    q, one = q / grown @ turned, one / grown @ turned
    off = q - one * (qo / (1.0 + oo))[..., None]
    precision = 1.0 / grown @ turned**2 - one**2 / (1.0 + oo)[..., None]
    log = averaged(log + log_gain_of_one_bad(off, precision, noise), -math.log(len(amplitudes)))
    return averaged(log, scales.log_weight)


def log_gain_of_one_bad(off: np.ndarray, precision: np.ndarray, noise: Noise) -> np.ndarray:
    """Log of how much likelier readings are if one of them may be bad, shape (..., n) to (...).

    Parameters
    ----------
    off, precision : ndarray
        Shape (..., n): K⁻¹y and the diagonal of K⁻¹, for readings y of covariance K in units of
        their noise.
    noise : Noise
        Of bad readings.

    Notes
    -----
    What the others say of a reading is normal, with the variance 1/(K⁻¹)ᵢᵢ about
    yᵢ - (K⁻¹y)ᵢ/(K⁻¹)ᵢᵢ (Rasmussen and Williams, eq. 5.12); a bad one has its width beside that.
    """
    precision = np.maximum(precision, 1e-12)
    wide = noise.width**2 + 1.0 / precision - 1.0
    bad = math.log(noise.bad / (1.0 - noise.bad)) + 0.5 * math.log(2.0 / math.pi)
    bad = bad - 0.5 * np.log(wide * precision) - np.log1p((off / precision) ** 2 / wide)
    bad = np.logaddexp.reduce(bad + 0.5 * off**2 / precision, axis=-1)
    return np.logaddexp(0.0, bad) + off.shape[-1] * math.log1p(-noise.bad)


def departure_odds(
    x: np.ndarray, u: np.ndarray, c: Coordinates, kind: NoiseKind, noise: Noise
) -> np.ndarray:
    """Log odds of a smooth departure beside a beam against a beam alone, shape (...,).

    Parameters
    ----------
    x : ndarray
        Shape (..., 3): T, T p_1, T p_2 of a beam near the best.
    u, c, kind, noise
        As for `curve_evidences`.

    Notes
    -----
    Both in linear approximation about the beam, whose three numbers are integrated out with a flat
    prior: D. A. Harville, Biometrika 61 (1974) 383. The departure is a Gaussian process of the
    setting, as of `curve_evidences`.
    """
    n = c.size.shape[-1]
    if n < 5:
        return np.full(c.unit.shape, -np.inf)
    model = _model(x, c)
    wide = wide_scales(kind, c.unit.shape)
    root = np.sqrt(variance_of(kind, wide.scale)) * model[..., None, :] ** kind.power
    rows = c.rows[..., None, :, :] / (2.0 * model)[..., None, :, None] / root[..., None]
    basis, triangle = np.linalg.qr(rows, mode="complete")
    left = np.swapaxes(basis[..., 3:], -1, -2)
    q = (left @ ((c.size - model)[..., None, :] / root)[..., None])[..., 0]
    shares = model[..., None, :] / root
    kernel = _bends(u, SMOOTH)[..., None, :, :] * shares[..., None] * shares[..., None, :]
    values, vectors = np.linalg.eigh(left @ kernel @ np.swapaxes(left, -1, -2))
    turned = np.swapaxes(vectors, -1, -2)
    q, seen = (turned @ q[..., None])[..., None, :, 0], turned @ left
    # The first is a beam alone.
    amplitudes = np.append(0.0, DEPARTURES)
    grown = 1.0 + amplitudes[:, None] ** 2 * np.maximum(values, 0.0)[..., None, :]
    log = -0.5 * np.sum(q**2 / grown + np.log(grown), axis=-1)
    log = log + log_gain_of_one_bad(q / grown @ seen, 1.0 / grown @ seen**2, noise)
    spans = np.log(np.abs(np.einsum("...ii->...i", triangle[..., :3, :]))).sum(-1)
    log = np.swapaxes(log - (np.log(root).sum(-1) + spans)[..., None], -1, -2)
    log = averaged(log, wide.log_weight[..., None, :])
    odds = averaged(log[..., 1:], -math.log(len(DEPARTURES))) - log[..., 0]
    # Settings that do not separate the beam's numbers show no departure from them.
    return np.where(c.seen & np.isfinite(odds), odds, -np.inf)


class PlaneSizes(NamedTuple):
    """The sizes of one plane and how they were seen, arrays of shape (n,).

    Attributes
    ----------
    r11, r12, known : ndarray
        Transfer-matrix elements (R12 in m), and size² that is not due to the beam, m².
    size : ndarray
        m.
    error : ndarray or None
        Stated errors, or those of means of shots, m.
    of_shots : bool
        Whether they are the latter.
    moved : bool
        Whether a magnet was.
    """

    r11: np.ndarray
    r12: np.ndarray
    known: np.ndarray
    size: np.ndarray
    error: np.ndarray | None
    of_shots: bool
    moved: bool

    def thinned(self, number: int) -> PlaneSizes:
        """So many points, evenly among all."""
        at = np.linspace(0, len(self.size) - 1, number).astype(int)
        rows = [None if v is None else v[at] for v in self[:5]]
        return PlaneSizes(*rows, self.of_shots, self.moved)

    def kinds_under(self, unit: float, noise: Noise) -> tuple[NoiseKind, ...]:
        """Kinds of noise under some priors, in some unit of the sizes, m."""
        error = None if self.error is None else self.error / unit
        return kinds_of(noise, self.size / unit, error, self.of_shots)

    @property
    def likeness(self) -> tuple:
        """Key of the planes that can be compared in one call: points, errors, moved magnets."""
        if self.error is None:
            return len(self.size), "none", self.moved
        same = "share" if of_one_share(self.error, self.size) else "stated"
        word = "shots" if self.of_shots else same
        return len(self.size), word, self.moved


class PlanePosterior(NamedTuple):
    """The posterior of a plane's beam, the noise averaged over.

    Attributes
    ----------
    probability : dict of str to float
        Of a beam and of its rivals.
    sigma, weight : ndarray
        Draws of σ11, σ12, σ22 in SI, shape (d, 3), and their positive weights, which sum to 1.
    best : ndarray
        Shape (3,): σ that fits best, or the mean of the draws where that is no beam.
    positive : bool
        Whether the best one is a beam.
    covariance, stated : ndarray
        Shape (3, 3): of the best σ by linear theory, with the errors found and with those stated
        (NaN without); NaN where the settings do not separate the three numbers.
    model, error, bad : ndarray
        Shape (n,): fitted sizes and the errors found, m, and the probability of a bad reading.
    noise : {"stated", "share", "beyond", "shots", "none"}
        What was known of it, or "beyond" if settings scatter beyond their stated errors.
    scale : ndarray
        Shape (3,): median and central 68 % of the scale of the noise.
    relative : float
        Probability that errors are shares of the size.
    chi2 : float
        By the stated errors; NaN without.
    seen : bool
        Whether the settings separate the numbers of the beam.
    kinds, scales : tuple
        Kinds of noise and their nodes, in units of ``unit``.
    by_scale : tuple of ndarray
        Log evidence of a beam at every node of each kind.
    unit : float
        The mean size, m.
    trace : ndarray
        Shape (3,): T of the prior is ``trace @ sigma``.
    """

    probability: dict[str, float]
    sigma: np.ndarray
    weight: np.ndarray
    best: np.ndarray
    positive: bool
    covariance: np.ndarray
    stated: np.ndarray
    model: np.ndarray
    error: np.ndarray
    bad: np.ndarray
    noise: str
    scale: np.ndarray
    relative: float
    chi2: float
    seen: bool
    kinds: tuple[NoiseKind, ...]
    scales: tuple[Scales, ...]
    by_scale: tuple[np.ndarray, ...]
    unit: float
    trace: np.ndarray

    @property
    def cause(self) -> str:
        """The likeliest model."""
        return max(self.probability, key=self.probability.__getitem__)

    @property
    def worth(self) -> float:
        """Number of independent draws that these are worth."""
        return float(1.0 / np.sum(self.weight**2))

    @property
    def flat(self) -> float:
        """Probability that a beam has no emittance."""
        none, some = self.probability[FLAT], self.probability[BEAM]
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
        Those that are alike are looked at in one call.
    noise : Noise
        Priors of the noise.
    method : {"size_squared", "size"}
        Which residual the best fit makes small.
    weights : {"model", "measured"}
        Whose size its errors are taken at.

    Returns
    -------
    list of PlanePosterior

    Notes
    -----
    Evidences are integrals of the likelihood over the prior; their ratios times the priors' are
    the odds of the models (D. J. C. MacKay, Information Theory, Inference, and Learning Algorithms
    (2003), eq. 28.4). All models share the noise.
    """
    alike: dict[tuple, list[int]] = {}
    for i, plane in enumerate(planes):
        alike.setdefault(plane.likeness, []).append(i)
    found = {}
    for (count, *_), members in alike.items():
        for start in range(0, len(members), TOGETHER):
            own = members[start : start + TOGETHER]
            several = _compared([planes[i] for i in own], noise.of_points(count), method, weights)
            found |= dict(zip(own, several, strict=True))
    return [found[i] for i in range(len(planes))]


class _Stack(NamedTuple):
    """Planes that are alike, in their own coordinates: arrays begin with the planes."""

    c: Coordinates
    u: np.ndarray
    kinds: tuple[NoiseKind, ...]


def _stacked(planes: Sequence[PlaneSizes], noise: Noise, alike: bool | None = None) -> _Stack:
    r11, r12, known, size = (np.stack([p[i] for p in planes]) for i in range(4))
    c = coordinates(r11, r12, size, known)
    first, error = planes[0], None
    if first.error is not None:
        error = np.stack([p.error for p in planes]) / c.unit[:, None]
    kinds = kinds_of(noise, c.size, error, first.of_shots, alike)
    return _Stack(c, np.stack([r11, r12], -1), kinds)


def _compared(
    planes: Sequence[PlaneSizes], noise: Noise, method: str, weights: str
) -> list[PlanePosterior]:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s = _stacked(planes, noise)
        draws = [draw_beams(s.c, kind, noise) for kind in s.kinds]
        few, own = s, draws
        if s.c.size.shape[-1] > COMPARED:
            # Few of errors that differ may be alike: the noise is that of all.
            alike = planes[0].likeness[1] == "share"
            few = _stacked([p.thinned(COMPARED) for p in planes], noise, alike)
            own = [draw_beams(few.c, kind, noise) for kind in few.kinds]
        evidence = np.array([_evidences(few, i, d, noise) for i, d in enumerate(own)])
        of_kind = np.logaddexp.reduce(evidence, axis=-1)
        of_kind = np.exp(of_kind - np.logaddexp.reduce(of_kind, axis=0))
        best = _best(s, draws, of_kind, noise, method, weights)
    every = np.logaddexp.reduce(evidence, axis=0)
    prior = MODELS if planes[0].moved else UNMOVED
    log = every + np.log([prior.get(name, 1e-300) for name in MODELS])
    log = np.where(np.isfinite(log), log, -1e300)
    probability = np.exp(log - np.logaddexp.reduce(log, axis=-1)[:, None])
    return [
        _posterior(plane, i, s, draws, of_kind[:, i], probability[i], best, weights)
        for i, plane in enumerate(planes)
    ]


def _evidences(s: _Stack, i: int, draws: BeamDraws, noise: Noise) -> np.ndarray:
    """Log evidences of all models under one kind of noise, as densities of ln size."""
    kind = s.kinds[i]
    beam = averaged(draws.log_weight, 0.0)
    flat = np.full_like(beam, -np.inf)
    if not kind.power:
        flat = flat_evidence(s.c, kind, noise)
    elif all(k.power for k in s.kinds):
        # A share of such a beam's size would vanish where it does: of the likeliest beam's. Not of
        # what was measured, of which slow noise as large would leave one size and no noise.
        size = _model(draws.best, s.c)
        own = replace(kind, power=0, floor=kind.floor * size, unit=kind.unit * size)
        flat = flat_evidence(s.c, own, noise)
    jacobian = np.log(s.c.size).sum(-1)
    # Rivals of slow noise are slow themselves, or as random as without it.
    curves = curve_evidences(s.u, s.c, replace(kind, slow=False), noise)
    if not kind.slow:
        near = beam + jacobian + departure_odds(draws.best, s.u, s.c, kind, noise)
        curves[-1] = np.logaddexp(curves[-1] + math.log1p(-NEAR), near + math.log(NEAR))
    return np.stack([beam + jacobian, flat + jacobian, *curves], -1)


class _Best(NamedTuple):
    """The best fit of planes: T, T p, model, precision and doubt of their points."""

    x: np.ndarray
    model: np.ndarray
    precision: np.ndarray
    bad: np.ndarray


def _best(
    s: _Stack, draws: Sequence[BeamDraws], of_kind: np.ndarray, noise: Noise, method: str,
    weights: str,
) -> _Best:  # fmt: skip
    """Find the weighted least squares at the expected precision of every point.

    How large the noise is comes from its posterior, which of the points are bad from the last fit
    (expectation and maximisation; A. P. Dempster, N. M. Laird and D. B. Rubin, J. R. Stat. Soc. B
    39, 1 (1977)).
    """
    c, rows = s.c, s.c.rows
    top = np.array([d.best_log for d in draws]) + np.log(np.maximum(of_kind, 1e-300))
    first = np.argmax(top, axis=0)
    x = np.array([d.best for d in draws])[first, np.arange(len(first))]
    rests = np.zeros(len(x), bool)
    for _ in range(ROUNDS):
        model = _model(x, c)
        kinds = zip(s.kinds, draws, strict=True)
        parts = [_expected(model, c, kind, d, noise) for kind, d in kinds]
        precision = sum(w[:, None] * p for w, (p, _) in zip(of_kind, parts, strict=True))
        if method == "size_squared":
            target, at = c.size**2, model if weights == "model" else c.size
        else:  # size² that is as far from the model's as the size is, in first order
            target, at = model**2 + 2.0 * model * (c.size - model), model
        scale = np.sqrt(precision) / (2.0 * at)
        design = rows * scale[..., None]
        normal = np.swapaxes(design, -1, -2) @ design
        trace = np.trace(normal, axis1=-2, axis2=-1)[:, None, None]
        last = x
        right = np.swapaxes(design, -1, -2) @ ((target - c.known) * scale)[..., None]
        x = np.linalg.solve(normal + 1e-14 * trace * np.eye(3), right)[..., 0]
        # A plane that rests stays, whatever the others do.
        x = np.where(rests[:, None], last, x)
        rests |= np.abs(x - last).max(-1) < REST * np.abs(x).max(-1)
        if rests.all():
            break
    bad = sum(w[:, None] * b for w, (_, b) in zip(of_kind, parts, strict=True))
    return _Best(x, _model(x, c), precision, bad)


def _model(x: np.ndarray, c: Coordinates) -> np.ndarray:
    squared = (c.rows @ x[..., None])[..., 0] + c.known
    # No upper limit: where the setting slipped a beam may be a hundred times larger than any size.
    least = c.size.min(-1, keepdims=True)
    return np.sqrt(np.maximum(squared, (least / FURTHEST) ** 2))


def _expected(
    model: np.ndarray, c: Coordinates, kind: NoiseKind, draws: BeamDraws, noise: Noise
) -> tuple[np.ndarray, np.ndarray]:
    """Expected precision of each point's size, and probability that it is bad, by the model."""
    variance, share = variance_of(kind, draws.scales.scale), draws.scale_weight[..., None]
    pull = (((c.size - model) / model**kind.power) ** 2)[:, None, :] / variance
    bad = 1.0 / (1.0 + np.exp(-0.5 * pull) / bad_density(pull, noise))
    # A Cauchy distribution is a normal one of this mean precision.
    each = (1.0 - bad + bad * 2.0 / (noise.width**2 + pull)) / variance
    return (share * each).sum(1) / model ** (2 * kind.power), (share * bad).sum(1)


def _posterior(
    plane: PlaneSizes, i: int, s: _Stack, draws: Sequence[BeamDraws], of_kind: np.ndarray,
    probability: np.ndarray, best: _Best, weights: str,
) -> PlanePosterior:  # fmt: skip
    c = Coordinates(*(part[i] for part in s.c))
    log = np.concatenate([d.log_weight[i] for d in draws])
    weight = np.exp(log - log.max()) if np.isfinite(log.max()) else np.ones(len(log))
    weight /= weight.sum()
    sigma = c.sigma(np.concatenate([d.x[i] for d in draws]))[weight > 0.0]
    weight = weight[weight > 0.0]
    found, unit = c.sigma(best.x[i][None])[0], float(c.unit)
    positive = bool(found[0] > 0 and found[0] * found[2] > found[1] ** 2) and bool(c.seen)
    model = best.model[i] * unit
    error, likelier = unit / np.sqrt(best.precision[i]), int(np.argmax(of_kind))
    weighed = model if weights == "model" else plane.size
    rows = np.stack(coefficients(plane.r11, plane.r12), -1) / (2.0 * weighed)[:, None]
    none = np.full((3, 3), np.nan)
    stated, chi2 = none, math.nan
    if plane.error is not None:
        own = plane.error * (model / plane.size if plane.likeness[1] == "share" else 1.0)
        stated = _covariance(rows / own[:, None]) if c.seen else none
        chi2 = float(np.sum(((plane.size - model) / own) ** 2))
    turned = np.linalg.inv(c.back * unit)
    trace, own = turned.T @ turned, draws[likelier]
    beyond = np.any(s.kinds[likelier].floor) and not plane.of_shots
    return PlanePosterior(
        probability=dict(zip(MODELS, map(float, probability), strict=True)),
        sigma=sigma,
        weight=weight,
        best=found if positive else weight @ sigma,
        positive=positive,
        covariance=_covariance(rows / error[:, None]) if c.seen else none,
        stated=stated,
        model=model,
        error=error,
        bad=best.bad[i],
        noise="beyond" if beyond else plane.likeness[1],
        scale=weighted_quantiles(own.scales.scale[i], own.scale_weight[i], (AT[2], AT[1], AT[3])),
        relative=float(sum(w * k.power for w, k in zip(of_kind, s.kinds, strict=True))),
        chi2=chi2,
        seen=bool(c.seen),
        kinds=jax.tree.map(lambda part: part[i], s.kinds),
        scales=tuple(Scales(*(part[i] for part in d.scales)) for d in draws),
        by_scale=tuple(d.by_scale[i] for d in draws),
        unit=unit,
        trace=np.array([trace[0, 0], 2.0 * trace[0, 1], trace[1, 1]]),
    )


def _covariance(rows: np.ndarray) -> np.ndarray:
    """Inverse of rowsᵀrows, by QR with unit columns."""
    norm = np.linalg.norm(rows, axis=0)
    r = np.linalg.qr(rows / norm, mode="r")
    half = np.linalg.solve(r, np.eye(3)) / norm[:, None]
    return half @ half.T


def weighted_quantiles(values: np.ndarray, weight: np.ndarray, at: Sequence[float]) -> np.ndarray:
    """Quantiles of weighted draws, shape (d,).

    Examples
    --------
    >>> weighted_quantiles(np.array([3.0, 1.0, 2.0]), np.ones(3), (0.5,)).tolist()
    [2.0]
    """
    order = np.argsort(values)
    heap = np.cumsum(weight[order])
    return np.interp(np.asarray(at) * heap[-1], heap - 0.5 * weight[order], values[order])


def emittance_quantiles(
    emittance: np.ndarray, weight: np.ndarray, flat: float, at: Sequence[float]
) -> np.ndarray:
    """Quantiles of the emittances of draws, beside a probability of none at all.

    Examples
    --------
    >>> emittance_quantiles(np.array([3.0, 1.0, 2.0]), np.ones(3), 0.5, (0.4, 0.75)).tolist()
    [0.0, 2.0]
    """
    at = np.asarray(at)
    within = np.maximum((at - flat) / (1.0 - flat), 0.0) if flat < 1.0 else 0.0 * at
    return np.where(at > flat, weighted_quantiles(emittance, weight, within), 0.0)
