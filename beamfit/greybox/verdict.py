"""Verdict on the end of a search: what the data determine, the gravest rule that applies.

Numbers that move together without a change of any prediction, whatever the data, are told as a
freedom of the model.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify

from beamfit import verdict
from beamfit.greybox import assess, optimum, problem
from beamfit.greybox.assess import LOOKS, NEAR, SearchState
from beamfit.greybox.covariance import MOST_SHARE, Spread
from beamfit.greybox.equations import Implicit
from beamfit.greybox.fit import Attempt, Fit, FittedConstraint, FittedVariable
from beamfit.greybox.optimum import EDGES, FitEvidence, Known, Search, known, listed, settled
from beamfit.greybox.problem import Problem, compiled_at, sloped
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.status import Status
from beamfit.verdict import Finding

# A row is constant along a direction if it changes by less than this share of its terms.
STILL = 1e-7
# Numbers are tied if their part of the open directions exceeds this share of the largest.
TIED = 1e-3


class Gauge(NamedTuple):
    """Names of numbers that move together, and relative changes along one direction they may take.

    `free` tells in how many directions: as many of them must be fixed.
    """

    names: tuple[str, ...]
    changes: tuple[float, ...]
    free: int


def gauges(p: Problem, theta: np.ndarray, unseen: np.ndarray) -> tuple[Gauge, ...]:
    """Find symmetries among directions that the data do not see.

    A direction that residuals do not see at other settings either, made up at random, is none that
    further data could tell: it belongs to the model.

    Parameters
    ----------
    p : Problem
        The problem.
    theta : array, shape (n,)
        The point.
    unseen : array, shape (n, k)
        Directions that its residuals do not see there.

    Returns
    -------
    tuple of Gauge
        One for each set of at least two numbers that are tied.

    Examples
    --------
    >>> from beamfit.greybox.problem import Free, Record
    >>> def series(model, x):
    ...     return model["first"] * model["second"] * x
    >>> record = Record("r", series, np.arange(3.0), [0.0, 6.0, 12.0], 0.1)
    >>> p = Problem({"first": 2.0, "second": 3.0}, [Free("first"), Free("second")], [record])
    >>> at = np.array([2.0, 3.0])
    >>> gauges(p, at, np.array([[2.0], [-3.0]]))[0].names
    ('first', 'second')
    """
    open_ones = _still(p, theta, unseen)
    if not open_ones.shape[1]:
        return ()
    basis = np.linalg.qr(open_ones)[0]
    size = np.where(theta != 0, np.abs(theta), 1.0)
    together = np.abs(basis @ basis.T)
    part = np.sqrt(np.diag(together))
    tied = together > TIED * np.outer(part, part) + 1e-12
    found, left = [], set(np.flatnonzero(part > TIED**2).tolist())
    while left:
        group = _reached(tied, min(left))
        left -= group
        at = sorted(group)
        _, sizes, turned = np.linalg.svd(basis[at].T)
        free = int(np.sum(sizes > TIED * sizes[0]))
        change = turned[0] / size[at]
        names = tuple(p.names[i] for i in at)
        if len(at) > 1 and free < len(at):
            shares = change / np.max(np.abs(change)) * np.sign(change[0])
            found.append(Gauge(names, tuple(shares.tolist()), free))
    return tuple(found)


def _reached(tied: np.ndarray, first: int) -> set[int]:
    """Numbers connected to one number, directly or through others."""
    group, fresh = {first}, {first}
    while fresh:
        fresh = {j for i in fresh for j in np.flatnonzero(tied[i]).tolist()} - group
        group |= fresh
    return group


def _still(p: Problem, theta: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Combinations of directions along which rows change at no made-up settings."""
    random, size = np.random.default_rng(0), np.where(theta != 0, np.abs(theta), 1.0)
    rows = []
    for _ in range(LOOKS if unseen.shape[1] else 0):
        records = tuple(
            dataclasses.replace(r, data=jax.tree.map(lambda v: _moved(v, random), r.data))
            for r in p.core.records
        )
        core = dataclasses.replace(p.core, records=records)
        jacobian = np.asarray(compiled_at(sloped, core)(theta)[1])
        usable = np.all(np.isfinite(jacobian), axis=1)
        terms = np.linalg.norm(jacobian[usable] * size, axis=1, keepdims=True)
        rows.append(jacobian[usable] / np.where(terms > 0, terms, 1.0))
    if not rows:
        return unseen[:, :0]
    along = unseen / np.linalg.norm(unseen / size[:, None], axis=0)
    _, sizes, turned = np.linalg.svd(np.vstack(rows) @ along, full_matrices=True)
    return along @ turned[int(np.sum(sizes > STILL)) :].T


def _moved(value: Any, random: np.random.Generator) -> Any:
    """Settings that are other ones, whole numbers apart."""
    value = np.asarray(value)
    if not np.issubdtype(value.dtype, np.floating) or not value.size:
        return value
    spread = float(np.std(value)) or float(np.max(np.abs(value))) or 1.0
    factor, shift = (NEAR * random.normal(size=value.shape) for _ in range(2))
    return value * (1 + factor) + spread * shift


def _inner_failure(p: Problem, theta: np.ndarray) -> str | None:
    """Failure of an implicit map in the model to converge at the answer, or None."""
    if not p.has_part(Implicit):
        return None
    look = checkify.checkify(jax.jit(problem.values), errors=checkify.user_checks)
    said = look(p.core, jnp.asarray(theta, float))[0].get()
    return None if said is None else said.removesuffix(" (`check` failed)")


def conclude(p: Problem, s: SearchState, search: Search, seconds: float) -> Fit:
    """Judge the best point of a search.

    Parameters
    ----------
    p : Problem
        The problem.
    s : SearchState
        The best point.
    search : Search
        What was done.
    seconds : float
        Time taken.

    Returns
    -------
    Fit
    """
    failure = _inner_failure(p, s.theta)
    if failure or not s.at.finite:
        status, said = Status.not_finite, (
            "the cost or a derivative is not finite at the end of the search; bound the free "
            "numbers away from there, or use a parametrisation that stays defined."
        )  # fmt: skip
        if failure:
            status, said = Status.not_converged, (
                f"{failure} at the end of the search; start it nearer to its root, or bound the "
                "free numbers to where a root exists."
            )  # fmt: skip
        return refused(p, status, said, seconds, s.theta, search.attempts)
    found = known(p, s)
    variables, constraints = _variables(p, s, found), _constraints(p, s)
    chi2 = float(s.at.residual @ s.at.residual)
    priors = len(s.at.residual) - p.size
    dof = sum(group.count for group in found.groups) + priors - found.rank
    ratio = chi2 / dof if dof > 0 else np.nan
    judged = p.errors_known or not p.records
    scale = (np.sqrt(max(1.0, ratio)) if dof > 0 else 1.0) if judged else np.sqrt(ratio)
    # Records without errors cannot speak for or against the model.
    silent = [group for group in found.groups if not group.errors_given]
    spoken = chi2 - sum(g.chi2 for g in silent), dof - sum(g.dof for g in silent)
    rest = not s.optimal and settled(p, s)
    seen = (found.blind, found.unseen)
    evidence = FitEvidence(p, s, search, rest, variables, constraints, *seen, *spoken)
    finding = verdict.judge(evidence, RULES if p.has_data else WITHOUT_DATA)
    message = " ".join([finding.message, *_remarks(evidence)])
    return Fit(
        p, s.theta, finding.status, message, float(s.at.cost), chi2, dof, found.groups, s.kkt,
        variables, constraints, found.spread, found.raw, s.at.residual_jacobian, found.unseen,
        float(scale), search.attempts, seconds, finding.about,
    )  # fmt: skip


def _variables(p: Problem, s: SearchState, found: Known) -> tuple[FittedVariable, ...]:
    nothing = (found.spread.shares >= MOST_SHARE) | found.held
    nothing |= any(group.unknown for group in found.groups)
    errors = (np.where(nothing, np.nan, part.errors) for part in (found.spread, found.raw))
    columns = (s.theta, *errors, p.lower, p.upper, s.bounds.states(s.found.bounds), s.found.bounds)
    return _rows(FittedVariable, p.names, *columns)


def _constraints(p: Problem, s: SearchState) -> tuple[FittedConstraint, ...]:
    states = s.limits.states(s.found.constraints)
    return _rows(FittedConstraint, p.constraint_names, *s.limits[:3], states, s.found.constraints)


def _rows(kind: type, names: tuple[str, ...], *columns: np.ndarray) -> tuple:
    return tuple(map(kind, names, *(column.tolist() for column in columns)))


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
    n, nan = len(theta), np.nan
    lost = Spread(np.full((n, n), nan), np.eye(n), np.ones(n), np.zeros(n))
    none, free = np.full(n, nan), np.full(n, "free")
    variables = _rows(FittedVariable, p.names, theta, none, none, p.lower, p.upper, free, none)
    none = np.full(len(p.constraint_names), nan)
    ends, free = (p.constraint_lower, p.constraint_upper), np.full(len(none), "free")
    constraints = _rows(FittedConstraint, p.constraint_names, none, *ends, free, none)
    return Fit(
        p, theta, status, message, nan, nan, 0, (), assess.LOST, variables,
        constraints, lost, lost, np.zeros((p.size, n)), np.eye(n), nan, attempts, seconds,
    )  # fmt: skip


def _undetermined(e: FitEvidence) -> Finding | None:
    """Say what the data do not determine, of what is asked for."""
    open_ones = e.blind & ~e.problem.nuisance
    if not open_ones.any():
        return None
    names = np.array(e.problem.names)[open_ones]
    found = gauges(e.problem, e.state.theta, e.unseen)
    tied = [g for g in found if set(names.tolist()) & set(g.names)]
    if tied:
        return together(tied)
    cause = f"the data do not determine {listed(names)};"
    remedy = "add data of another kind, a prior, or fix it."
    return Finding(Status.unidentified, cause, remedy, tuple(names.tolist()))


def together(found: list[Gauge]) -> Finding:
    """Say which numbers move together whatever the data."""
    said = []
    for g in found:
        parts = [f"{n} {c:+.3g} %" for n, c in zip(g.names, g.changes, strict=True)]
        along = f" ({', '.join(parts[:4])})" if g.free == 1 else ""
        said.append(f"{listed(g.names)} move together{along}")
    cause = f"{'; '.join(said)}: no prediction changes, whatever the data, a freedom of the model;"
    count = sum(g.free for g in found)
    few = "one of them" if count == 1 else f"{count} of them"
    names = tuple(name for g in found for name in g.names)
    return Finding(Status.unidentified, cause, f"fix {few}, or give a prior.", names)


def _poor(e: FitEvidence) -> Finding | None:
    """Say that the residuals are larger than the errors allow."""
    chance = chi2_probability(e.chi2, e.dof) if e.dof > 0 else 1.0
    if not e.problem.errors_known or chance >= POOR_FIT:
        return None
    cause = (
        f"chi2 = {e.chi2:.4g} for {e.dof:.4g} degrees of freedom happens by chance in {chance:.1e} "
        "of cases;"
    )
    remedy = "the model misses something or the errors are too small."
    return Finding(Status.poor_fit, cause, remedy)


def _held(e: FitEvidence) -> Finding | None:
    """Say which numbers a bound decided, where data were to."""
    pairs = zip(e.variables, e.problem.nuisance, strict=True)
    held = [v for v, nuisance in pairs if not nuisance and v.state in EDGES]
    if not held:
        return None
    cause = f"the best value lies at a bound: {listed(f'{v.name} ({v.state})' for v in held)};"
    return Finding(
        Status.at_limit, cause, "the bound decides it, not the data, so justify or widen it."
    )


def _optimal(e: FitEvidence) -> Finding:
    """Say that nothing is wrong, and what kind of optimum it is."""
    worst = f"(KKT residual {e.state.kkt.worst:.1e})"
    if e.settled:
        cause = (
            f"the search from {e.search.words} has settled where nothing that matters to the data "
            f"changes any more {worst}."
        )
        return Finding(Status.converged, cause)
    higher = sum(count for _, count in optimum.others(e)) if e.problem.objectives else 0
    if higher:
        cause = (
            f"the best of several local optima was reached from {e.search.words} {worst}; {higher} "
            "of them ended on others of higher cost."
        )
        return Finding(Status.converged, cause)
    return Finding(Status.converged, f"an optimum was reached from {e.search.words} {worst}.")


RULES = (
    optimum.crossed, optimum.endless, optimum.restless, _undetermined, _poor, _held, _optimal
)  # fmt: skip
"""In order of gravity, for fits to data."""

WITHOUT_DATA = (
    optimum.crossed, optimum.endless, optimum.degenerate, optimum.saddle, optimum.restless,
    optimum.local, optimum.optimal,
)  # fmt: skip
"""The same for an objective alone."""


def _remarks(e: FitEvidence) -> list[str]:
    """Remarks on the starts and on the time limit."""
    search, said = e.search, []
    count = len(search.attempts)
    if search.dropped:
        said.append(f"{search.dropped} of {count} starts dropped: cost not finite there.")
    if search.moved:
        said.append(f"{search.moved} of {count} starts moved onto their bounds.")
    if search.cut:
        said.append(f"The limit of {search.seconds:g} s cut the search.")
    lost = e.problem.has_data and not e.state.optimal and not e.settled
    if lost and e.state.feasible and (found := optimum.degenerate(e)):
        said.append(found.message)
    return said
