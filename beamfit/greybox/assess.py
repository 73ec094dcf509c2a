"""From a point to a verdict: optimum or not, what the data determine, what holds the answer."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify

from beamfit.greybox import kkt, problem
from beamfit.greybox.covariance import (
    MOST_SHARE,
    Group,
    Spread,
    directions,
    groups_of,
    spread_of,
    triangle,
)
from beamfit.greybox.fit import Attempt, Fit, Limited, Status, Variable
from beamfit.greybox.implicit import Implicit
from beamfit.greybox.kkt import TOLERANCE
from beamfit.greybox.problem import Problem
from beamfit.greybox.verdict import Evidence, judge

__all__ = [
    "Slopes",
    "State",
    "conclude",
    "constraint_slopes",
    "first_order",
    "refused",
    "slopes",
    "state",
]


class Slopes(NamedTuple):
    """Everything of first order at a point."""

    residual: np.ndarray
    residual_jacobian: np.ndarray
    cost: float
    gradient: np.ndarray
    constraints: np.ndarray
    jacobian: np.ndarray


class State(NamedTuple):
    """A point with its multipliers and its distance from an optimum."""

    theta: np.ndarray
    at: Slopes
    found: kkt.Multipliers
    kkt: kkt.KKT


def first_order(core, theta):
    """The parts of `Slopes`, compiled once for each structure of problem."""
    r, r_jacobian = problem.residual(core, theta), jax.jacfwd(problem.residual, 1)(core, theta)
    cost, gradient = jax.value_and_grad(problem.cost, 1)(core, theta)
    c = problem.constraints(core, theta)
    return r, r_jacobian, cost, gradient, c, constraint_slopes(core, theta)


def constraint_slopes(core, theta):
    """Jacobian of the constraints, by as few sweeps as there are variables or constraints."""
    few = jax.eval_shape(problem.constraints, core, theta).shape < theta.shape
    return (jax.jacrev if few else jax.jacfwd)(problem.constraints, 1)(core, theta)


def slopes(p: Problem, theta: np.ndarray) -> Slopes:
    """Evaluate values and first derivatives at a point."""
    parts = p.compiled(first_order)(np.asarray(theta, float))
    return Slopes(*(np.asarray(part) for part in parts))


def _gradient_scale(p: Problem, theta: np.ndarray, at: Slopes) -> np.ndarray:
    """Size of a gradient component that matters.

    A residual vector moved by one standard deviation, or by 1e-6 of the measured values where the
    errors are unknown, is the least that counts; for further objectives, the cost over the value.
    """
    if p.errors_known or not p.records:
        least = 1.0
    else:
        least = 1e-6 * np.sqrt(sum(float(jnp.sum(rec.measured**2)) for rec in p.records))
    size = max(np.linalg.norm(at.residual), least)
    scale = np.linalg.norm(at.residual_jacobian, axis=0) * size
    if p.objectives:
        scale = scale + max(1.0, abs(at.cost)) / np.maximum(1.0, np.abs(theta))
    return np.maximum(scale, max(1e-12 * np.max(scale), 1e-100))


def state(p: Problem, theta: np.ndarray) -> State:
    """Find the multipliers at a point and measure how far it is from an optimum.

    Parameters
    ----------
    p : Problem
        The problem.
    theta : array, shape (n,)
        The point.

    Returns
    -------
    State
        With an infinite residual where something is not finite.
    """
    at = slopes(p, theta)
    if not all(np.all(np.isfinite(part)) for part in at):
        none = kkt.Multipliers(np.zeros(len(theta)), np.zeros(len(at.constraints)))
        return State(theta, at, none, kkt.KKT(np.inf, np.inf, np.inf))
    scale = _gradient_scale(p, theta, at)
    bounds = kkt.Limits(theta, p.lower, p.upper)
    limits = kkt.Limits(at.constraints, p.constraint_lower, p.constraint_upper)
    found = kkt.multipliers(at.gradient, at.jacobian, bounds, limits, scale, TOLERANCE)
    size = at.cost if p.objectives else 0.5 * scale.size
    distance = kkt.residual(at.gradient, at.jacobian, bounds, limits, scale, found, size)
    return State(theta, at, found, distance)


class _Known(NamedTuple):
    """What a point's residuals tell: groups of noise, spreads, directions not seen, rank.

    `blind` tells which numbers would be open even if what is at a bound truly were there.
    """

    groups: tuple[Group, ...]
    spread: Spread
    raw: Spread
    unseen: np.ndarray
    rank: int
    blind: np.ndarray


def _known(p: Problem, s: State, held: np.ndarray, edge: np.ndarray) -> _Known:
    """Tell what the residuals know, along the limits that hold.

    For the degrees of freedom a number at an active bound is held; its error and that of what
    hangs on it are those of a number that the bound only limits. Weights that nobody asks for
    stay on their bounds.
    """
    scale = _gradient_scale(p, s.theta, s.at)
    equal = p.constraint_lower == p.constraint_upper
    pulls = np.abs(s.found.constraints) * np.linalg.norm(s.at.jacobian / scale, axis=1)
    equations = s.at.jacobian[equal | (pulls > 1e-9)]
    ends = np.cumsum([record.measured.size for record in p.records], dtype=int)
    blocks = [triangle(part) for part in np.split(s.at.residual_jacobian, ends)]
    half, unseen, _ = directions(np.vstack(blocks), np.vstack([np.eye(len(held))[held], equations]))
    groups = groups_of(
        [(record.name, record.error is not None) for record in p.records],
        np.split(s.at.residual, ends)[:-1],
        [int(record.used.sum()) for record in p.records],
        blocks[:-1],
        half,
    )
    still = (edge & p.nuisance) | (p.lower == p.upper)

    def spread(factors, still):
        parts = [block / f for block, f in zip(blocks, [*factors, 1.0], strict=True)]
        return spread_of(np.vstack(parts), p.lower, p.upper, still, p.with_prior, equations)

    factors = [group.factor for group in groups]
    scaled = spread(factors, still)
    raw = spread([1.0 if group.errors_given else group.factor for group in groups], still)
    given_bounds = scaled if np.array_equal(still, held) else spread(factors, held)
    blind = (given_bounds.share(np.eye(len(held))) >= MOST_SHARE) & ~held
    unseen = unseen / np.where((n := np.linalg.norm(unseen, axis=0)) > 0, n, 1.0)
    return _Known(groups, scaled, raw, unseen, half.shape[1], blind)


def _inner_failure(p: Problem, theta: np.ndarray) -> str | None:
    """What an implicit map inside the model says of its own convergence at the answer."""
    parts = jax.tree_util.tree_leaves(p.core, is_leaf=lambda part: isinstance(part, Implicit))
    if not any(isinstance(part, Implicit) for part in parts):
        return None
    look = checkify.checkify(
        jax.jit(lambda core, t: (problem.cost(core, t), problem.constraints(core, t))),
        errors=checkify.user_checks,
    )
    said = look(p.core, jnp.asarray(theta, float))[0].get()
    return None if said is None else said.removesuffix(" (`check` failed)")


def conclude(p: Problem, s: State, attempts: tuple[Attempt, ...], seconds: float) -> Fit:
    """Judge the best point of a search.

    Parameters
    ----------
    p : Problem
        The problem.
    s : State
        The best point.
    attempts : tuple of Attempt
        Every start.
    seconds : float
        Time taken.

    Returns
    -------
    Fit
    """
    failure = _inner_failure(p, s.theta)
    if not np.isfinite(s.kkt.worst) and not failure:
        said = (
            "the cost or a derivative is not finite at the end of the search; bound the free "
            "numbers away from there, or use a parametrisation that stays defined."
        )
        return refused(p, Status.not_finite, said, seconds, s.theta, attempts)
    if failure:
        said = (
            f"{failure} at the end of the search; start it nearer to its root, or bound the free "
            "numbers to where a root exists."
        )
        return refused(p, Status.not_converged, said, seconds, s.theta, attempts)
    fixed = p.lower == p.upper
    bounds = kkt.Limits(s.theta, p.lower, p.upper)
    edge = np.array(_states(s.found.bounds, bounds))
    at_edge = np.isin(edge, ("lower", "upper"))
    held = fixed | (np.abs(s.found.bounds) > 1e-9 * _gradient_scale(p, s.theta, s.at))
    known = _known(p, s, held, at_edge)
    chi2 = float(s.at.residual @ s.at.residual)
    priors = len(s.at.residual) - sum(record.measured.size for record in p.records)
    dof = sum(group.count for group in known.groups) + priors - known.rank
    ratio = chi2 / dof if dof > 0 else np.nan
    judged = p.errors_known or not p.records
    scale = (np.sqrt(max(1.0, ratio)) if dof > 0 else 1.0) if judged else np.sqrt(ratio)
    one = np.eye(len(s.theta))
    nothing = (known.spread.share(one) >= MOST_SHARE) | held
    nothing |= any(group.unknown for group in known.groups)
    errors = (np.where(nothing, np.nan, part.error(one)) for part in (known.spread, known.raw))
    variables = tuple(
        Variable(name, *map(float, numbers), state, float(gradient))
        for name, *numbers, state, gradient in zip(
            p.names, s.theta, *errors, p.lower, p.upper, edge, s.found.bounds, strict=True
        )
    )
    limits = kkt.Limits(s.at.constraints, p.constraint_lower, p.constraint_upper)
    constraints = tuple(
        Limited(name, *map(float, numbers), state, float(y))
        for name, *numbers, state, y in zip(
            p.constraint_names, *limits, _states(s.found.constraints, limits), s.found.constraints,
            strict=True,
        )
    )  # fmt: skip
    # What has no errors cannot speak for or against the model.
    silent = [group for group in known.groups if not group.errors_given]
    spoken = chi2 - sum(g.chi2 for g in silent), dof - sum(g.dof for g in silent)
    evidence = Evidence(
        p, s.kkt, float(s.at.cost), attempts, variables, constraints, known.blind, *spoken, judged
    )
    status, message = judge(evidence)
    return Fit(
        p, s.theta, status, message, float(s.at.cost), chi2, dof, known.groups, s.kkt, variables,
        constraints, known.spread, known.raw, known.unseen, float(scale), attempts, seconds,
    )  # fmt: skip


def _states(multiplier: np.ndarray, limits: kkt.Limits) -> list[str]:
    """Whether each value is free, at its lower or upper limit, or fixed."""
    low, high = limits.reached(TOLERANCE)
    fixed = limits.lower == limits.upper
    cases = [fixed, low & ((multiplier > 0) | ~high), high]
    return np.select(cases, ["fixed", "lower", "upper"], "free").tolist()


def refused(
    p: Problem,
    status: Status,
    message: str,
    seconds: float,
    theta: np.ndarray | None = None,
    attempts: tuple[Attempt, ...] = (),
) -> Fit:
    """A fit without an answer: where it stopped, and nothing determined."""
    theta = p.start if theta is None else theta
    n, nan, inf = len(theta), np.nan, np.inf
    variables = tuple(
        Variable(name, float(v), nan, nan, float(a), float(b), "free", nan)
        for name, v, a, b in zip(p.names, theta, p.lower, p.upper, strict=True)
    )
    limits = zip(p.constraint_names, p.constraint_lower, p.constraint_upper, strict=True)
    lost = Spread(np.full((n, n), nan), np.eye(n), np.ones(n), np.zeros(n))
    constraints = tuple(
        Limited(name, nan, float(a), float(b), "free", nan) for name, a, b in limits
    )
    return Fit(
        p, theta, status, message, nan, nan, 0, (), kkt.KKT(inf, inf, inf), variables,
        constraints, lost, lost, np.eye(n), nan, attempts, seconds,
    )  # fmt: skip
