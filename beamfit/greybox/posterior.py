"""Posterior of a problem about its optimum, as a target for the sampler; used by all studies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import null_space
from scipy.sparse.csgraph import connected_components

from beamfit.errors import Finding, InputError
from beamfit.greybox import tree
from beamfit.greybox.problem import Core, Prior, Problem, with_slope
from beamfit.sampling.likelihood import NoiseGroup
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.priors import Distribution, checked
from beamfit.sampling.target import PosteriorLaw, SamplingTarget, covariance_of, slopes_of

# A number belongs to an undetermined direction if its part exceeds this share of the largest.
MIN_PART = 0.05
# A further optimum is too far for the sampler to reach beyond this many standard errors.
MAX_DISTANCE = 6.0
OTHER_OPTIMUM = (
    "The search met another optimum of nearly the same cost far from this one: the intervals are "
    "those about one of them."
)


class Optimum(NamedTuple):
    """An optimum with results of the fit that the sampler starts from.

    Attributes
    ----------
    theta : array, shape (n,)
        The problem's free numbers.
    verdict : Finding
        Verdict on the fit.
    scales : sequence of float
        Factor on the errors of each record from its residuals; NaN where they do not determine it.
    given : sequence of bool
        True for each record with given errors.
    undetermined : array, shape (n, k), optional
        Directions that neither records nor priors determine.
    others : sequence of array
        Further optima of nearly the same cost.
    """

    theta: np.ndarray
    verdict: Finding
    scales: Sequence[float]
    given: Sequence[bool]
    undetermined: np.ndarray | None = None
    others: Sequence[np.ndarray] = ()


def unchanged(model: Any) -> Any:
    """Return the model itself: no change of variables."""
    return model


def _no_volume(model: Any, data: Any) -> jax.Array:
    return jnp.zeros(())


def _model_itself(model: Any, data: Any) -> Any:
    return model


class Statement(NamedTuple):
    """A study's additions to its problem for the sampler; by default none.

    The functions are defined at the top of modules, so that they are compiled once.

    Attributes
    ----------
    derived : mapping of str to str
        Names and units of the numbers that `derive` returns.
    derive : callable
        ``derive(model, data)``, shape (len(derived),).
    build : callable
        ``build(model, data)``, the argument of a user's functions of a draw.
    data : pytree
        Second argument of these functions.
    quoted, own : callable
        Change of variables to the numbers that are sampled, in which the prior is flat:
        ``quoted(model)`` replaces the problem's numbers by them, ``own(model)`` is the inverse, NaN
        outside its domain.
    renamed : mapping of str to str
        Names of the problem's numbers for users.
    log_volume : callable
        ``log_volume(model, data)``, added to the log density for a prior that is flat in other
        quantities than the sampled numbers.
    units : mapping of str to str
        Units of sampled numbers.
    lower : mapping of str to float
        Lower bounds of sampled numbers that replace the problem's.
    labels : mapping of str to str
        Label of a record in the names of its noise parameters. Default: empty if there is one
        record, else its name.
    averaged : sequence of str
        Records whose noise is averaged over in `log_volume`, so that their residuals are used only
        for the first shape of the proposals.
    trusted : sequence of str
        Records whose errors are right whatever the residuals are: anchors of a model.
    priors_own, hidden : sequence of str
        Numbers that the prior determines, and nuisance numbers.
    remark : str
        A further sentence for the result.
    nothing : str
        Reason for which there is no posterior; empty if there is one.
    """

    derived: Mapping[str, str] = {}
    derive: Callable[[Any, Any], jax.Array] = _model_itself
    build: Callable[[Any, Any], Any] = _model_itself
    data: Any = None
    quoted: Callable[[Any], Any] = unchanged
    own: Callable[[Any], Any] = unchanged
    renamed: Mapping[str, str] = {}
    log_volume: Callable[[Any, Any], jax.Array] = _no_volume
    units: Mapping[str, str] = {}
    lower: Mapping[str, float] = {}
    labels: Mapping[str, str] = {}
    averaged: Sequence[str] = ()
    trusted: Sequence[str] = ()
    priors_own: Sequence[str] = ()
    hidden: Sequence[str] = ()
    remark: str = ""
    nothing: str = ""


@tree.node()
class Sampled:
    """Data of the posterior's law: core, free numbers, indices sampled, bounds, a study's data."""

    core: Core
    theta: Any
    moving: Any
    ends: Any
    more: Any


class _Law(NamedTuple):
    """The law of a posterior from a study's functions, as in `Statement`."""

    own: Callable[[Any], Any]
    log_volume: Callable[[Any, Any], jax.Array]
    derive: Callable[[Any, Any], jax.Array]
    build: Callable[[Any, Any], Any]

    def model_at(self, data: Sampled, moved: jax.Array) -> Any:
        """Return the model at the sampled numbers."""
        theta = data.theta.at[data.moving].set(moved)
        return self.own(tree.replace(data.core.model, data.core.chosen, theta))

    def residual(self, data: Sampled, moved: jax.Array) -> tuple[jax.Array, ...]:
        """Residuals of the records without those of the priors, which have no noise factor."""
        model = self.model_at(data, moved)
        return tuple(record.residual(model) for record in data.core.records) or (jnp.zeros(0),)

    def with_priors(self, data: Sampled, moved: jax.Array) -> tuple[jax.Array, ...]:
        """Residuals that end with those of the priors."""
        model = self.model_at(data, moved)
        priors = [prior.residual(model) for prior in data.core.priors]
        return *self.residual(data, moved), jnp.concatenate([jnp.zeros(0), *priors])

    def log_prior(self, data: Sampled, moved: jax.Array) -> jax.Array:
        """Log density of priors and further objectives, -inf outside bounds and constraints."""
        model, core = self.model_at(data, moved), data.core
        value = self.log_volume(model, data.more)
        for prior in core.priors:
            value -= 0.5 * jnp.sum(prior.residual(model) ** 2)
        for objective in core.objectives:
            value -= jnp.sum(objective.weight * objective.function(model, objective.data))
        theta = tree.read(model, core.chosen)
        inside = jnp.all((theta >= data.ends[0]) & (theta <= data.ends[1]))
        for constraint in core.constraints:
            limited = constraint.function(model, constraint.data)
            inside &= jnp.all((limited >= constraint.lower) & (limited <= constraint.upper))
        return jnp.where(inside, value, -jnp.inf)

    def derived(self, data: Sampled, moved: jax.Array) -> jax.Array:
        """Derived numbers."""
        return self.derive(self.model_at(data, moved), data.more)

    def built(self, data: Sampled, moved: jax.Array) -> Any:
        """Return the study's object that a user's functions take."""
        return self.build(self.model_at(data, moved), data.more)


# One law for the same functions: JAX compiles anew for another one.
_law_of = lru_cache(maxsize=64)(_Law)


def target_of(
    problem: Problem,
    optimum: Optimum,
    stated: Statement | None = None,
    *,
    noise: str | None = None,
    outliers: bool = False,
    priors: Mapping[str, Distribution] | None = None,
) -> SamplingTarget:
    """State the posterior of a problem.

    Parameters
    ----------
    problem : Problem
        The problem that was fitted.
    optimum : Optimum
        Start of the sampler.
    stated : Statement, optional
        Additions of a study.
    noise : {"known", "inferred"} or None
        None: the noise of a record is inferred if it has no errors or the fit enlarged them.
    outliers : bool
        True if some points may be outliers.
    priors : mapping of str to distribution, or None
        Priors in addition to the problem's.

    Returns
    -------
    SamplingTarget
        Its prior is flat in the sampled numbers, apart from the problem's priors and `priors`.

    Raises
    ------
    InputError
        If a constraint is an equation, an option is not understood, or a prior's name is not that
        of a sampled number.
    """
    p, stated = problem, stated or Statement()
    if p.equations.any():
        name = p.constraint_names[int(np.argmax(p.equations))]
        expected = "limits that differ: nothing that is drawn at random meets an equation"
        raise InputError(f"the equation '{name}'", expected)
    moving = np.flatnonzero(p.moving)
    names = tuple(stated.renamed.get(p.names[i], p.names[i]) for i in moving)
    priors = checked(priors, names)
    lower, upper = p.lower[moving], p.upper[moving]
    lower = np.array([stated.lower.get(n, low) for n, low in zip(names, lower, strict=True)])
    theta, derivative = _to_sampled(p, stated, optimum.theta)
    own = _law_of(stated.own, stated.log_volume, stated.derive, stated.build)
    law = PosteriorLaw(own.residual, own.log_prior, own.derived, own.built)
    data = _data(p, theta, moving, stated)
    slopes = slopes_of(law._replace(residual=own.with_priors), data, theta[moving])
    noise_found = tuple(scale if scale > 0 else 1.0 for scale in optimum.scales) or (1.0,)
    # Half-width of the proposals for numbers that the data do not determine.
    box = np.where(np.isfinite(upper - lower), 0.5 * (upper - lower), np.inf)
    width = np.minimum(box, [float(priors[n].std()) if n in priors else np.inf for n in names])
    covariance = covariance_of(slopes, (*noise_found, 1.0), width)
    undetermined = (
        np.zeros((len(theta), 0)) if optimum.undetermined is None else optimum.undetermined
    )
    with_prior = np.array([name in priors for name in names])
    held, unlimited = _unlimited((derivative @ undetermined)[moving], names, with_prior, width)
    group_of, block_of = _connections(slopes, bool(p.constraints))
    return SamplingTarget(
        law=law,
        data=data,
        names=names,
        units=tuple(stated.units.get(name, "") for name in names),
        lower=lower,
        upper=upper,
        mode=theta[moving],
        covariance=covariance,
        groups=_groups(p, optimum, stated, noise, outliers),
        noise=noise_found,
        counts=tuple(record.used for record in p.records),
        priors=priors,
        derived=stated.derived,
        observed=_observed(p),
        remark=_remark(optimum, stated, derivative[moving], covariance),
        stated={prior.name: _describe(prior) for prior in p.priors},
        priors_own=(*held, *stated.priors_own),
        open_directions=stated.nothing or unlimited,
        verdict=optimum.verdict,
        hidden=(*(names[i] for i in np.flatnonzero(p.nuisance[moving])), *stated.hidden),
        group_of=group_of,
        block_of=block_of,
    )


def _remark(
    optimum: Optimum, stated: Statement, derivative: np.ndarray, covariance: np.ndarray
) -> str:
    """Join the study's remark and a warning of other optima that the sampler does not reach."""
    steps = [derivative @ (other - optimum.theta) for other in optimum.others]
    too_far = any(
        np.any(np.abs(step) > MAX_DISTANCE * np.sqrt(np.diag(covariance))) for step in steps
    )
    return " ".join(filter(None, (stated.remark, OTHER_OPTIMUM if too_far else "")))


class Predicted(NamedTuple):
    """Values of a record that have weight: draws of the prediction (m, n), data and errors (n,)."""

    draws: np.ndarray
    measured: np.ndarray
    error: np.ndarray


def predicted(posterior: Posterior, name: str) -> Predicted:
    """Predict a record by draws from the posterior of its problem.

    Parameters
    ----------
    posterior : Posterior
        Posterior of a target made by `target_of`.
    name : str
        Name of the record.

    Returns
    -------
    Predicted
        With errors of 1 if the record has none.
    """
    target = posterior.target
    records = target.data.core.records
    place = [record.name for record in records].index(name)
    record, used = records[place], records[place].used
    residual = target.each(target.law.residual, posterior.thinned())[place][:, used]
    error = np.ones(1) if record.error is None else record.error
    measured, error, weight = (
        np.broadcast_to(part, record.measured.shape).ravel()[used]
        for part in (record.measured, error, record.weight)
    )
    return Predicted(measured + residual * error / np.sqrt(weight), measured, error)


def _to_sampled(p: Problem, stated: Statement, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert the optimum to the sampled numbers, with derivatives by the problem's numbers."""
    if stated.quoted is unchanged:
        return np.array(theta), np.eye(len(theta))
    found, derivative = _with_slope(stated.quoted, p.core, jnp.asarray(theta))
    return np.array(found), np.asarray(derivative)


@partial(jax.jit, static_argnums=0)
def _with_slope(
    quoted: Callable[[Any], Any], core: Core, theta: jax.Array
) -> tuple[jax.Array, ...]:
    def sampled(own: jax.Array) -> jax.Array:
        return tree.read(quoted(tree.replace(core.model, core.chosen, own)), core.chosen)

    return with_slope(sampled, theta)


def _data(p: Problem, theta: np.ndarray, moving: np.ndarray, stated: Statement) -> Sampled:
    """Make the law's data; sampled numbers are zeroed, so that equal problems compare equal."""
    fixed = np.array(theta)
    fixed[moving] = 0.0
    core = replace(p.core, model=tree.replace(p.core.model, p.core.chosen, jnp.asarray(fixed)))
    equal = p.lower == p.upper
    ends = np.where(equal, -np.inf, p.lower), np.where(equal, np.inf, p.upper)
    return jax.tree.map(jnp.asarray, Sampled(core, fixed, moving, ends, stated.data))


def _groups(
    p: Problem, optimum: Optimum, stated: Statement, noise: str | None, outliers: bool
) -> tuple[NoiseGroup, ...]:
    """Choose the noise model of each record; a noise factor is free only if data determine it."""
    groups = []
    for record, scale, given in zip(p.records, optimum.scales, optimum.given, strict=True):
        label = stated.labels.get(record.name, record.name if len(p.records) > 1 else "")
        trusted = record.name in stated.trusted
        kind = noise or ("inferred" if scale > 1 or not given else "known")
        if trusted or (given and not scale > 0):
            kind = "known"
        if record.name in stated.averaged:
            kind = "averaged"
        may_have_outliers = outliers and not trusted and kind != "averaged"
        groups.append(NoiseGroup(label, kind, may_have_outliers, record.prior_freedom))
    return tuple(groups) or (NoiseGroup("", noise or "known", outliers),)


def _observed(p: Problem) -> dict[str, np.ndarray]:
    """Collect measured values and errors of all records by name, without padding."""
    found = {}
    for record in p.records:
        for field in ("measured", "error"):
            values = getattr(record, field)
            if values is not None:
                every = np.broadcast_to(values, record.measured.shape).ravel()
                found[f"{record.name} {field}"] = every[record.used]
    return found


def _connections(slopes: Sequence[np.ndarray], joined: bool) -> tuple[tuple[int, ...], ...]:
    """Find the record that determines each number best, and groups of numbers that are connected.

    Numbers are connected if they occur in the same record or prior; if the problem has constraints
    (`joined`), all are.
    """
    sizes = np.array([np.linalg.norm(part, axis=0) for part in slopes])
    together = (sizes.T @ sizes > 0) | joined
    blocks = connected_components(together, directed=False)[1]
    return tuple(map(int, np.argmax(sizes[:-1], axis=0))), tuple(map(int, blocks))


def _describe(prior: Prior) -> str:
    """Describe a normal prior; for several numbers only as normal."""
    if np.size(prior.mean) == np.size(prior.sd) == 1:
        return f"normal, {float(prior.mean):.6g} ± {float(prior.sd):.3g}"
    return "normal"


def _unlimited(
    undetermined: np.ndarray, names: tuple[str, ...], with_prior: np.ndarray, width: np.ndarray
) -> tuple[tuple[str, ...], str]:
    """Find numbers that only bounds limit, and a message if nothing limits some of them.

    A prior on a number limits every direction in which the number takes part.
    """
    beyond_priors = _unchanged_directions(undetermined, with_prior)
    beyond_bounds = _unchanged_directions(beyond_priors, np.isfinite(width))
    held, unlimited = (_names_along(part, names) for part in (beyond_priors, beyond_bounds))
    if not unlimited:
        return held, ""
    shown = ", ".join(unlimited[:6]) + (", ..." if len(unlimited) > 6 else "")
    return held, (
        f"the data do not determine {shown}, and neither bounds nor priors hold them, so that "
        "there is no posterior; bound them, give priors, or measure what tells them apart"
    )


def _unchanged_directions(directions: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Combine directions to those along which the chosen numbers do not change."""
    if not directions.shape[1] or not chosen.any():
        return directions
    return directions @ null_space(directions[chosen], rcond=MIN_PART)


def _names_along(directions: np.ndarray, names: tuple[str, ...]) -> tuple[str, ...]:
    """Name the numbers with more than a small part in some direction."""
    size = np.abs(directions)
    moved = np.any(size > MIN_PART * np.max(size, axis=0, initial=1e-300), axis=1)
    return tuple(name for name, m in zip(names, moved, strict=True) if m)
