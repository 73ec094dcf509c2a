"""What a verdict rests on: what was done, and what the residuals tell of the free numbers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy import sparse

from beamfit.greybox import assess
from beamfit.greybox.assess import SearchState
from beamfit.greybox.conflict import Conflict
from beamfit.greybox.covariance import (
    MOST_SHARE,
    FactoredSpread,
    Group,
    Spread,
    groups_of,
    spread_of,
    triangle,
)
from beamfit.greybox.factors import Rows
from beamfit.greybox.fit import Attempt, FittedConstraint, FittedVariable
from beamfit.greybox.problem import Problem

# A search is settled if a further step lowers chi-square by less: a tenth of a standard error.
SETTLED = 0.01
EDGES = ("lower", "upper")


class Search(NamedTuple):
    """Record of a search: its starts, those moved onto bounds, the time limit if it cut.

    `exact` tells whether second derivatives could be asked for, `conflict` what kept the search
    from a feasible point.
    """

    attempts: tuple[Attempt, ...]
    moved: int = 0
    seconds: float | None = None
    cut: bool = False
    exact: bool = True
    conflict: Conflict | None = None

    @property
    def dropped(self) -> int:
        """Starts at which something was not finite."""
        return sum(bool(np.isnan(attempt.cost)) for attempt in self.attempts)

    @property
    def words(self) -> str:
        """Number of starts, in words."""
        return f"{len(self.attempts)} start{'s' if len(self.attempts) != 1 else ''}"


class Known(NamedTuple):
    """Information of a point's residuals: noise groups, spreads, undetermined directions, rank.

    `blind` tells which numbers would be open even if what is at a bound truly were there.
    """

    groups: tuple[Group, ...]
    spread: Spread | FactoredSpread
    raw: Spread | FactoredSpread
    unseen: np.ndarray
    rank: int
    blind: np.ndarray
    held: np.ndarray


class FitEvidence(NamedTuple):
    """Input of the verdict's rules; `chi2` and `dof` count residuals with errors only.

    `unseen` (n, k) are the directions that residuals do not see.
    """

    problem: Problem
    state: SearchState
    search: Search
    settled: bool
    variables: tuple[FittedVariable, ...]
    constraints: tuple[FittedConstraint, ...]
    blind: np.ndarray
    unseen: np.ndarray
    chi2: float
    dof: float


def known(p: Problem, s: SearchState) -> Known:
    """Tell what the residuals know, along the limits that hold.

    For the degrees of freedom a number at an active bound is held; its error and that of what
    hangs on it are those of a number that the bound only limits. Weights that nobody asks for
    stay on their bounds.
    """
    held, on = assess.holding(p, s, 1e-9)
    equations = s.at.jacobian[on]
    ends = np.cumsum([record.measured.size for record in p.records], dtype=int)
    parts = zip([0, *ends], [*ends, None], strict=True)
    blocks = [triangle(s.at.residual_jacobian[first:last]) for first, last in parts]
    nowhere = np.full(len(held), np.inf)
    seen = spread_of(_stacked(blocks), -nowhere, nowhere, held, None, equations)
    groups = groups_of(p.records, np.split(s.at.residual, ends)[:-1], blocks[:-1], seen)
    still = (np.isin(s.bounds.states(s.found.bounds), EDGES) & p.nuisance) | ~p.moving

    limited = np.isfinite(p.upper - p.lower) & p.moving & ~p.with_prior
    alike = np.array_equal(still, held) and not limited.any()

    def spread(factors, still):
        if alike and len({*factors, *[1.0] * bool(p.priors)}) <= 1:
            return seen.times(factors[0] if factors else 1.0)
        parts = [block / f for block, f in zip(blocks, [*factors, 1.0], strict=True)]
        return spread_of(_stacked(parts), p.lower, p.upper, still, p.with_prior, equations)

    factors = [group.factor for group in groups]
    scaled = spread(factors, still)
    plain = [1.0 if group.errors_given else group.factor for group in groups]
    raw = scaled if plain == factors else spread(plain, still)
    given_bounds = scaled if np.array_equal(still, held) else spread(factors, held)
    blind = (given_bounds.shares >= MOST_SHARE) & ~held
    unseen = seen.open / np.where((n := np.linalg.norm(seen.open, axis=0)) > 0, n, 1.0)
    return Known(groups, scaled, raw, unseen, seen.rank, blind, held)


def _stacked(blocks: list[Rows]) -> Rows:
    if any(map(sparse.issparse, blocks)):
        return sparse.csr_array(sparse.vstack(blocks))
    return np.vstack(blocks)


def settled(p: Problem, s: SearchState) -> bool:
    """True if the search ended at an optimum as far as the data can tell.

    The decrease of chi-square that a further Gauss-Newton step promises, noise being what the
    scatter says where no errors were given, is below `SETTLED`. Networks have flat valleys in which
    a strict optimum is never reached and nothing changes any more.
    """
    if p.objectives or not s.at.finite or not s.feasible:
        return False
    found = known(p, s)
    weight = np.ones(len(s.at.residual))
    for group in found.groups:
        weight[group.rows] = 1.0 if group.errors_given else group.factor**-2
    pull = s.at.residual_jacobian.T @ (weight * s.at.residual)
    outward = np.where(s.bounds.reached[0], pull > 0, s.bounds.reached[1] & (pull < 0))
    pull = np.where(outward | found.held, 0.0, pull)
    return bool(found.raw.size(pull) ** 2 < SETTLED)


def listed(names: Iterable[str]) -> str:
    """A few names for a sentence."""
    names = list(names)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
