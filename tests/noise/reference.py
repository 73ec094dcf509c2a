"""What averaging over the noise means, written out in plain NumPy: no nodes, no narrowing.

Integrals over the scale of the noise are sums over a grid so fine and wide that it does not matter;
likelihoods are products over readings. Nothing here is taken from the package but the priors.
"""

import math

import numpy as np
from scipy.stats import multivariate_t, norm

GRID = 80


def log_normal(off, deviation):
    return -0.5 * (off / deviation) ** 2 - np.log(deviation) - 0.5 * math.log(2.0 * math.pi)


def log_cauchy(off, scale):
    return -np.log(math.pi * scale * (1.0 + (off / scale) ** 2))


def log_sum(log, axis=-1):
    return np.logaddexp.reduce(log, axis=axis)


def lognormal_grid(prior, least=0.0, reach=6.0):
    """Values of a number known within a factor, and the probability of each."""
    middle, spread = math.log(prior[0]), prior[1]
    low = middle - reach * spread
    if least > 0.0:
        low = max(low, math.log(least))
    log = np.linspace(low, middle + reach * spread, GRID)
    weight = norm.pdf(log, middle, spread)
    weight[0] *= 0.5
    weight[-1] *= 0.5
    return np.exp(log), weight / weight.sum()


def stated_scales(noise, size, error):
    """Factors of stated errors, 1 or more than 1: with them they are what settings scatter."""
    factor, weight = lognormal_grid(noise.factor, least=1.0)
    factor = np.append(1.0, factor)
    weight = np.append(noise.right, (1.0 - noise.right) * weight)
    true = np.log(np.median(error / size) * factor)
    weight *= norm.pdf(true, math.log(noise.scatter.middle), noise.scatter.spread)
    return factor, weight / weight.sum()


def shot_scales(noise):
    """What settings scatter beyond their shots: nothing, or a share of the size."""
    scatter, weight = lognormal_grid(noise.scatter)
    return np.append(0.0, scatter), np.append(noise.even, (1.0 - noise.even) * weight)


def unstated_scales(noise):
    return lognormal_grid(noise.unstated)


def log_readings(off, deviation, noise):
    """Log density of readings of shape (..., n), each good or bad."""
    good = log_normal(off, deviation)
    wide = log_cauchy(off, noise.width * deviation)
    either = np.logaddexp(math.log(1.0 - noise.bad) + good, math.log(noise.bad) + wide)
    return either.sum(-1)


def log_averaged(log_of, deviations, weights):
    """Log density averaged over deviations of the readings."""
    parts = [
        math.log(w) + log_of(deviation)
        for deviation, w in zip(deviations, weights, strict=True)
        if w > 0.0
    ]
    return log_sum(np.array(parts), 0)


def log_slow(off, slow, own, noise):
    """Log density of readings of shape (..., n), none bad, part of whose noise goes on.

    ``slow`` (..., n) is the deviation of that, ``own`` of what is new at each reading.
    """
    n = off.shape[-1]
    apart = np.abs(np.arange(n)[:, None] - np.arange(n))
    correlation = 0.2 * np.eye(n) + 0.8 * np.exp(-apart / (n / 4))
    slow, own = (np.broadcast_to(v, off.shape) for v in (slow, own))
    covariance = slow[..., :, None] * slow[..., None, :] * correlation
    covariance = covariance + own[..., None, :] ** 2 * np.eye(n)
    pull = np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0], -1)
    log = -0.5 * (pull + np.linalg.slogdet(covariance)[1] + n * math.log(2.0 * math.pi))
    return n * math.log(1.0 - noise.bad) + log


def either_way(swift, slow, noise):
    """Noise that is new at each reading, or goes on from row to row."""
    return np.logaddexp(math.log(1.0 - noise.slow) + swift, math.log(noise.slow) + slow)


def log_stated(size, model, error, noise, share=None, unit=None):
    """Sizes with stated errors: right, too small by one factor, or by what settings scatter."""
    factor, weight = stated_scales(noise, size, error if share is None else share * size)
    unit = size if unit is None else unit
    right = weight[0]
    scatter, further = lognormal_grid(noise.scatter)
    weight[1:] *= 0.5
    deviations = [s * error for s in factor] + [np.hypot(error, s * unit) for s in scatter]
    weights = np.append(weight, 0.5 * (1.0 - right) * further)
    off = size - model
    swift = log_averaged(lambda d: log_readings(off, d, noise), deviations, weights)
    return either_way(swift, math.log(right) + log_slow(off, error, 0.0, noise), noise)


def log_share(size, model, share, noise):
    """The same of errors that are one share of the size, and so of the beam's own."""
    return log_stated(size, model, share * model, noise, share, model)


def log_of_shots(size, model, floor, noise):
    """Means of shots, whose settings scatter beyond by a share of the size measured."""
    scales, weight = shot_scales(noise)
    off, beyond = size - model, [s * size for s in scales]
    swift = log_averaged(lambda d: log_readings(off, np.hypot(floor, d), noise), beyond, weight)
    slow = log_averaged(lambda d: log_slow(off, d, floor, noise), beyond, weight)
    return either_way(swift, slow, noise)


def log_same(size, model, noise, share=False):
    """Sizes without errors, whose noise is the same everywhere, or else a share of the beam's."""
    unit = model if share else np.median(size)
    scales, weight = unstated_scales(noise)
    off, deviations = size - model, [s * unit for s in scales]
    swift = log_averaged(lambda d: log_readings(off, d, noise), deviations, weight)
    swift = swift + math.log(noise.share if share else 1.0 - noise.share)
    if not share:
        return math.log(1.0 - noise.slow) + swift
    slow = log_averaged(lambda d: log_slow(off, d, 0.0, noise), deviations, weight)
    return either_way(swift, slow, noise)


def log_unstated(size, model, noise):
    """Sizes without errors: noise of either kind."""
    return np.logaddexp(log_same(size, model, noise), log_same(size, model, noise, share=True))


def log_of_all(off, covariance):
    """Log density of a multivariate normal distribution."""
    _, log_determinant = np.linalg.slogdet(covariance)
    pull = off @ np.linalg.solve(covariance, off)
    return -0.5 * (pull + log_determinant + len(off) * math.log(2.0 * math.pi))


def log_of_one_bad(off, covariance, deviation, noise):
    """The same where one of the readings may be bad: about what the others say of it.

    That is uncertain itself, by what their covariance leaves beside the reading's own noise.
    """
    n, good = len(off), math.log(1.0 - noise.bad)
    found = [n * good + log_of_all(off, covariance)]
    for i, sd in enumerate(deviation):
        rest = np.arange(n) != i
        pull = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[rest, i])
        left = covariance[i, i] - pull @ covariance[rest, i] - sd**2
        scale = math.hypot(noise.width * sd, math.sqrt(max(left, 0)))
        bad = log_cauchy(off[i] - pull @ off[rest], scale)
        others = log_of_all(off[rest], covariance[np.ix_(rest, rest)])
        found.append((n - 1) * good + math.log(noise.bad) + others + bad)
    return log_sum(np.array(found))


def log_process(x, kernels, deviation, weight, noise):
    """Evidence of a Gaussian process about a constant known to a factor e, by dense matrices.

    Kernels are averaged with equal weights; ``deviation`` (k, n) and ``weight`` (k) are those of
    the noise.
    """
    found = []
    for kernel in kernels:
        each = [log_of_one_bad(x, kernel + np.diag(sd**2) + 1.0, sd, noise) for sd in deviation]
        found.append(each + np.log(np.maximum(weight, 1e-300) / len(kernels)))
    return log_sum(np.concatenate(found))


def log_prior(rows, size, sigma):
    """Of beams, shape (d, 3): even in the emittance, as far as the mean square leaves it room.

    The mean of what the beam adds to size² over size² itself is T = tr(M σ), known within a factor
    e; given T the emittance is at most T/2 det(M)^-½. In the coordinates in which M is 1, σ has
    three numbers T, T p, and an even emittance is a density 1/(2π ε/ε_max) of p.
    """
    m11, m12, m22 = (rows / [1.0, 2.0, 1.0] / size[:, None] ** 2).mean(0)
    t = sigma @ [m11, 2.0 * m12, m22]
    left = 4.0 * (sigma[:, 0] * sigma[:, 2] - sigma[:, 1] ** 2) * (m11 * m22 - m12**2) / t**2
    beam = (t > 0) & (sigma[:, 0] > 0) & (left > 0)
    log = np.log(np.where(beam, t, 1.0))
    even = -math.log(2.0 * math.pi) - 0.5 * np.log(np.where(beam, left, 1.0))
    return np.where(beam, norm.logpdf(log) + even - 3.0 * log, -np.inf)


def weighted_beams(rows, size, known, log_likelihood, centre, covariance, number=16_000, seed=1):
    """Beams and their weights in the posterior: drawn widely about a centre, and weighed.

    ``rows`` (n, 3) give size² - ``known`` of σ; ``log_likelihood`` takes models of shape (d, n).
    """
    root, wide = np.linalg.cholesky(covariance), multivariate_t(np.zeros(3), np.eye(3), df=4)
    z = wide.rvs(number, random_state=np.random.default_rng(seed))
    sigma = centre + z @ root.T
    squared = np.maximum(sigma @ rows.T + known, 1e-30)
    prior = log_prior(rows, size, sigma)
    log = log_likelihood(np.sqrt(squared)) + prior - wide.logpdf(z)
    weight = np.exp(log - log.max())
    return sigma, weight / weight.sum()


def quantiles(values, weight, at):
    order = np.argsort(values)
    heap = np.cumsum(weight[order]) - 0.5 * weight[order]
    return np.interp(at, heap, values[order])


def coordinates_of(rows2, size):
    """A turn A of phase space after which the scan looks evenly: the mean of w wᵀ/size² is 1."""
    metric = np.einsum("ni,nj,n->ij", rows2, rows2, 1.0 / size**2) / len(size)
    return np.linalg.inv(np.linalg.cholesky(metric)).T


def log_evidence_of_beam(rows, size, known, log_likelihood, centre, covariance, turn, **options):
    """Of sizes as densities of their logarithms, the prior normalised; by the same draws."""
    number = options.get("number", 30_000)
    root, wide = np.linalg.cholesky(covariance), multivariate_t(np.zeros(3), np.eye(3), df=4)
    z = wide.rvs(number, random_state=np.random.default_rng(options.get("seed", 1)))
    sigma = centre + z @ root.T
    squared = np.maximum(sigma @ rows.T + known, 1e-30)
    prior = log_prior(rows, size, sigma)
    # From T, T p to σ in its own coordinates, and from these by A σ Aᵀ to those of the line.
    prior += math.log(4.0) - 3.0 * math.log(abs(np.linalg.det(turn)))
    drawn = wide.logpdf(z) - math.log(abs(np.linalg.det(root)))
    log = log_likelihood(np.sqrt(squared)) + prior - drawn
    return log_sum(log) - math.log(number) + np.log(size).sum()


def log_evidence_of_flat_beam(rows2, size, known, log_likelihood, turn, side=100):
    """A line in phase space, by sums over its direction and the logarithm of its length²."""
    angle = (np.arange(side) + 0.5) * math.pi / side
    level = np.linspace(-4.0, 3.0, side)
    weight = norm.pdf(level)
    v = np.stack([np.cos(angle), np.sin(angle)], -1)[:, None] * np.exp(0.5 * level)[:, None]
    seen = (v.reshape(-1, 2) @ (rows2 @ turn).T) ** 2
    model = np.sqrt(np.maximum(seen + known, 1e-8 * size.mean() ** 2))
    log = log_likelihood(model).reshape(side, side) + np.log(weight / weight.sum())
    return log_sum(log.ravel()) - math.log(side) + np.log(size).sum()


def log_evidence_of_constant(size, deviation, weight, noise):
    """One size for all, known to a factor e: sums over it and over the noise, in ln size."""
    x = np.log(size / np.exp(np.log(size).mean()))
    level, step = np.linspace(-1.5, 1.5, 601, retstep=True)
    parts = [
        math.log(w) + log_readings(x - level[:, None], sd, noise)
        for sd, w in zip(deviation, weight, strict=True)
        if w > 1e-12
    ]
    return log_sum(log_sum(np.array(parts), 0) + norm.logpdf(level)) + math.log(step)
