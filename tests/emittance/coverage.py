"""How often an interval holds the truth: many simulated scans of one scenario, fitted at once.

Sizes, anchors and prior means are drawn about the truth with their own errors, as measurements
are; each simulated scan is fitted as the package fits a real one (the same residuals, the same
bounded least squares, the same covariance), from the true numbers as start.
"""

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.emittance.model import emittance_parts, predict_sizes, sigma_of
from beamfit.greybox import problem as greybox
from beamfit.greybox import tree
from beamfit.greybox.covariance import MOST_SHARE, spread_of
from beamfit.greybox.descend import descend_all


def drawn(problem, theta, key):
    """The problem's core with everything measured drawn about the truth at theta."""
    core, parts = problem.core, []
    model = problem.model_at(theta)
    keys = jax.random.split(key, len(core.records) + len(core.priors))
    for record, k in zip(core.records, keys, strict=False):
        true = record.predict(model, record.data)
        if record.predict is predict_sizes and record.data.squared:
            size = jnp.sqrt(true)
            sd = record.error / (2.0 * jnp.sqrt(record.measured))
            size = size + sd * jax.random.normal(k, size.shape)
            parts.append(_with(record, size**2, 2.0 * size * sd))
        else:
            noise = jax.random.normal(k, true.shape) * record.error
            parts.append(_with(record, true + noise, record.error))
    priors = []
    for prior, k in zip(core.priors, keys[len(core.records) :], strict=True):
        true = tree.read(model, tree.find_leaves(model, prior.name))
        mean = true + prior.sd * jax.random.normal(k, true.shape)
        priors.append(_built(greybox.Prior, prior, mean=mean))
    return _built(greybox.Core, core, records=tuple(parts), priors=tuple(priors))


def _built(kind, old, **changes):
    """Rebuild a node without its checks, which traced numbers would not pass."""
    new = object.__new__(kind)
    for name in old.__dataclass_fields__:
        object.__setattr__(new, name, changes.get(name, getattr(old, name)))
    return new


def _with(record, measured, error):
    return _built(greybox.Record, record, measured=measured, error=error)


def deviations(problem, theta, plane="x", number=500, seed=0, iterations=300):
    """(emittance - truth)/error of every simulated scan, and which say it is determined."""
    theta = jnp.asarray(theta)

    def emittance(core, t):
        model = tree.replace(core.model, core.chosen, t)
        return emittance_parts(sigma_of(model["beam"][plane]))[0]

    @jax.jit
    @jax.vmap
    def judged(core, end):
        value, slope = jax.value_and_grad(emittance, 1)(core, end)
        return value, slope, jax.jacfwd(greybox.residual, 1)(core, end)

    keys = jax.random.split(jax.random.key(seed), number)
    cores = jax.jit(jax.vmap(lambda key: drawn(problem, theta, key)))(keys)
    starts = np.tile(theta, (number, 1))
    bounds = problem.lower, problem.upper
    ends = descend_all(greybox.residual, cores, starts, *bounds, iterations, own=True).theta
    found = [ends, *map(np.asarray, judged(cores, ends))]
    with_prior = np.isin(np.array(problem.names), [p.name for p in problem.priors])
    true, pulls, known = float(emittance(problem.core, theta)), [], []
    for end, value, slope, jacobian in zip(*found, strict=True):
        at_edge = (end <= problem.lower) | (end >= problem.upper)
        held = (at_edge & problem.nuisance) | (problem.lower == problem.upper)
        spread = spread_of(jacobian, problem.lower, problem.upper, held, with_prior)
        pulls.append((value - true) / float(spread.error(slope)))
        known.append(float(spread.share(slope)) < MOST_SHARE)
    return np.array(pulls), np.array(known)


def coverage(pulls):
    """Share of intervals of 68.27 % and 95.45 % that hold the truth."""
    return np.mean(np.abs(pulls) <= 1.0), np.mean(np.abs(pulls) <= 2.0)


def binomial_limits(number, share, reach=3.0):
    """The range a share of so many trials keeps to, by chance, within ``reach`` deviations."""
    sd = np.sqrt(share * (1.0 - share) / number)
    return share - reach * sd, share + reach * sd
