"""What averaging over the noise means, written out in plain NumPy: no nodes, no narrowing.

Integrals over the scale of the noise are sums over a grid so fine and wide that it does not matter;
likelihoods are products over readings. Nothing here is taken from the package but the priors.
"""

import math

import numpy as np
from scipy.stats import multivariate_normal, norm

GRID = 200


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


def stated_scales(noise):
    """Factors of stated errors: 1, or more than 1."""
    factor, weight = lognormal_grid(noise.factor, least=1.0)
    return np.append(1.0, factor), np.append(noise.right, (1.0 - noise.right) * weight)


def shot_scales(noise):
    """What settings scatter beyond their shots: nothing, or a share of the size."""
    scatter, weight = lognormal_grid(noise.scatter)
    return np.append(0.0, scatter), np.append(noise.even, (1.0 - noise.even) * weight)


def unstated_scales(noise):
    return lognormal_grid(noise.unstated)


def usual_over_own(size, error):
    """How much larger most points' errors are than a point's own: what a wrong cell may be off."""
    share = error / size
    by_share, by_error = np.median(share) / share, np.median(error) / error
    return np.maximum(np.maximum(by_share, by_error), 1.0)


def log_readings(off, deviation, noise, usual=1.0):
    """Log density of readings of shape (..., n), each good or bad, the n//most likeliest bad."""
    n = off.shape[-1]
    good = norm.logpdf(off, 0.0, deviation)
    many = n // noise.most
    if not many:
        return good.sum(-1)
    wide = norm.logpdf(off, 0.0, noise.width * usual * deviation)
    either = np.logaddexp(math.log(1.0 - noise.bad) + good, math.log(noise.bad) + wide)
    sure = math.log(1.0 - noise.bad) + good
    if many >= 3:
        return either.sum(-1)
    rank = np.argsort(np.argsort(good - wide, axis=-1), axis=-1)
    return np.where(rank < many, either, sure).sum(-1)


def log_stated(size, model, error, noise):
    """Sizes with stated errors, that are right or all too small by one factor."""
    usual = usual_over_own(size, error)
    parts = [
        math.log(w) + log_readings(size - model, s * error, noise, usual)
        for s, w in zip(*stated_scales(noise), strict=True)
        if w > 0.0
    ]
    return log_sum(np.array(parts), 0)


def log_share(size, model, share, noise):
    """The same of errors that are one share of the size, and so of the beam's own."""
    usual = usual_over_own(size, share * size)
    parts = [
        math.log(w) + log_readings(size - model, s * share * model, noise, usual)
        for s, w in zip(*stated_scales(noise), strict=True)
        if w > 0.0
    ]
    return log_sum(np.array(parts), 0)


def log_of_shots(size, model, floor, noise):
    """Means of shots, whose settings scatter beyond by a share of the size measured."""
    parts = [
        math.log(w) + log_readings(size - model, np.hypot(floor, s * size), noise)
        for s, w in zip(*shot_scales(noise), strict=True)
        if w > 0.0
    ]
    return log_sum(np.array(parts), 0)


def log_unstated(size, model, noise):
    """Sizes without errors: noise that is a share of the size, or the same everywhere."""
    middle, kinds = np.median(size), []
    for share, chance in ((True, noise.share), (False, 1.0 - noise.share)):
        parts = [
            math.log(w) + log_readings(size - model, s * (model if share else middle), noise)
            for s, w in zip(*unstated_scales(noise), strict=True)
            if w > 0.0
        ]
        kinds.append(math.log(chance) + log_sum(np.array(parts), 0))
    return np.logaddexp(*kinds)


def log_process(x, kernels, deviation, weight):
    """Evidence of a Gaussian process about a constant known to a factor e, by dense matrices.

    Kernels are averaged with equal weights; ``deviation`` (k, n) and ``weight`` (k) are those of
    the noise.
    """
    n, found = len(x), []
    for kernel in kernels:
        for sd, w in zip(deviation, weight, strict=True):
            if w > 1e-12:
                covariance = kernel + np.diag(sd**2) + 1.0
                here = multivariate_normal.logpdf(x, np.zeros(n), covariance, allow_singular=True)
                found.append(math.log(w / len(kernels)) + here)
    return log_sum(np.array(found))
