"""The posterior of a fitted problem, for the sampler."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import null_space

from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.greybox.problem import Core, Prior, Problem
from beamfit.sampling.likelihood import Group, Likelihood
from beamfit.sampling.priors import Distribution, checked
from beamfit.sampling.target import Law, Target, covariance_of

__all__ = ["LAW", "Mode", "Sampled", "target_of"]

# A number that is an undetermined direction's in less than this share is not part of it.
PART = 0.05


class Mode(NamedTuple):
    """Where a posterior is about: the numbers, (n,), the factor on errors that residuals show, and
    the directions, (n, k), that no residual sees; the verdict there, and a further remark.
    """

    theta: np.ndarray
    scale: float
    undetermined: np.ndarray
    verdict: tuple[str, str] = ("converged", "")
    remark: str = ""


@tree.node()
class Sampled:
    """A problem for the sampler: its core, all numbers, which move, the limits, padding apart.

    `rows` are the residuals that count, None for all.
    """

    core: Core
    theta: Any
    moving: Any
    lower: Any
    upper: Any
    rows: Any = None


def _model(data: Sampled, moved: jax.Array) -> Any:
    theta = data.theta.at[data.moving].set(moved)
    return tree.replace(data.core.model, data.core.chosen, theta)


def _residual(data: Sampled, moved: jax.Array) -> tuple[jax.Array]:
    """Residuals of the records; priors are no measurements and know no common noise."""
    model = _model(data, moved)
    parts = [record.residual(model) for record in data.core.records]
    whole = jnp.concatenate(parts) if parts else jnp.zeros(0)
    return (whole if data.rows is None else whole[data.rows],)


def _log_prior(data: Sampled, moved: jax.Array) -> jax.Array:
    """Priors and further objectives, and -inf where a constraint is broken."""
    model, core = _model(data, moved), data.core
    value = sum((-0.5 * jnp.sum(p.residual(model) ** 2) for p in core.priors), jnp.zeros(()))
    for objective in core.objectives:
        value -= jnp.sum(objective.weight * objective.function(model, objective.data))
    found = [jnp.ravel(c.function(model, c.data)) for c in core.constraints]
    if found:
        held = jnp.concatenate(found)
        inside = jnp.all((held >= data.lower) & (held <= data.upper))
        value = jnp.where(inside, value, -jnp.inf)
    return value


def _no_more(data: Sampled, moved: jax.Array) -> jax.Array:
    return moved[:0]


LAW = Law(_residual, _log_prior, _no_more, _model)


def target_of(
    p: Problem,
    at: Mode,
    noise: str | None,
    outliers: bool,
    priors: Mapping[str, Distribution] | None,
) -> Target:
    """State the posterior of a problem.

    Parameters
    ----------
    p : Problem
        The problem.
    at : Mode
        Where a fit ended.
    noise : {"known", "inferred"} or None
        None: inferred where no record has errors or the fit enlarged them, else known.
    outliers : bool
        Whether some points may be outliers.
    priors : mapping of str to distribution, or None
        In addition to the problem's own.

    Returns
    -------
    Target

    Raises
    ------
    InputError
        If a constraint is an equation, only some records have errors, an option is not understood,
        or a prior's name is not that of a free number.
    """
    equations = p.constraint_lower == p.constraint_upper
    if equations.any():
        name = p.constraint_names[int(np.argmax(equations))]
        expected = "limits that differ: nothing that is drawn at random meets an equation"
        raise InputError(f"the equation '{name}'", expected)
    if len({record.error is None for record in p.records}) > 1:
        expected = "errors for all records or for none: one factor on them is sampled"
        raise InputError("records with and without errors", expected)
    if noise is None:
        noise = "inferred" if not p.errors_known or at.scale > 1 else "known"
    moving = np.flatnonzero(p.lower < p.upper)
    names = tuple(p.names[i] for i in moving)
    priors = checked(priors, names)
    fixed = at.theta.copy()
    fixed[moving] = 0.0  # the solver's last digits do not make it another problem
    used = np.concatenate([np.zeros(0, bool), *(record.used for record in p.records)])
    rows = None if used.all() else np.flatnonzero(used)
    data = Sampled(p.core, fixed, moving, p.constraint_lower, p.constraint_upper, rows)
    lower, upper = p.lower[moving], p.upper[moving]
    data = jax.tree.map(jnp.asarray, data)
    width = np.where(np.isfinite(upper - lower), 0.5 * (upper - lower), np.inf)
    for name, prior in priors.items():
        width[names.index(name)] = min(width[names.index(name)], float(prior.std()))
    mode = at.theta[moving]
    with_prior = np.array([name in priors for name in names])
    held, loose = _open(at, moving, names, with_prior, width)
    extra = Law(_with_priors, _log_prior, _no_more, _model)
    return Target(
        law=LAW,
        data=data,
        names=names,
        units=("",) * len(names),
        lower=lower,
        upper=upper,
        mode=mode,
        covariance=covariance_of(extra, data, mode, width) * at.scale**2,
        likelihood=Likelihood((Group("", noise, outliers),)),
        noise=(at.scale,),
        noise_unit="1",
        priors=priors,
        observed={
            f"{record.name} {what}": np.asarray(getattr(record, what))
            for record in p.records
            for what in ("measured", "error")
            if getattr(record, what) is not None
        },
        remark=at.remark,
        stated={prior.name: _words(prior) for prior in p.priors},
        priors_own=held,
        open_directions=loose,
        verdict=at.verdict,
        hidden=tuple(names[i] for i in range(len(names)) if p.nuisance[moving[i]]),
    )


def _words(prior: Prior) -> str:
    """A normal prior in words; of many numbers only that it is one."""
    if np.size(prior.mean) == np.size(prior.sd) == 1:
        return f"normal, {float(prior.mean):.6g} ± {float(prior.sd):.3g}"
    return "normal"


def _with_priors(data: Sampled, moved: jax.Array) -> tuple[jax.Array]:
    model = _model(data, moved)
    parts = [part.residual(model) for part in (*data.core.records, *data.core.priors)]
    return (jnp.concatenate(parts) if parts else jnp.zeros(0),)


def _open(
    at: Mode, moving: np.ndarray, names: tuple[str, ...], with_prior: np.ndarray, width: np.ndarray
) -> tuple[tuple[str, ...], str]:
    """Numbers that bounds alone hold, and a sentence if nothing at all holds some of them.

    A prior on one number holds every direction along which it moves.
    """
    unseen = at.undetermined[moving] if at.undetermined.size else np.zeros((len(names), 0))
    beyond_priors = _not_moving(unseen, with_prior)
    beyond_bounds = _not_moving(beyond_priors, np.isfinite(width))
    held, loose = (_along(part, names) for part in (beyond_priors, beyond_bounds))
    if not loose:
        return held, ""
    shown = ", ".join(loose[:6]) + (", ..." if len(loose) > 6 else "")
    return held, (
        f"the data do not determine {shown}, and neither bounds nor priors hold them, so that "
        "there is no posterior; bound them, give priors, or measure what tells them apart"
    )


def _not_moving(directions: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The directions, combined, along which the chosen numbers stay where they are."""
    if not directions.shape[1] or not chosen.any():
        return directions
    return directions @ null_space(directions[chosen], rcond=PART)


def _along(directions: np.ndarray, names: tuple[str, ...]) -> tuple[str, ...]:
    """Numbers that move along some direction by more than a small part of the largest."""
    size = np.abs(directions)
    moved = np.any(size > PART * np.max(size, axis=0, initial=1e-300), axis=1)
    return tuple(name for name, m in zip(names, moved, strict=True) if m)
