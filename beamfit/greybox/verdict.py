"""The verdict on a fit: a status, and a sentence of cause and remedy. The gravest one wins."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy import stats

from beamfit.greybox.fit import Attempt, Limited, Variable
from beamfit.greybox.kkt import KKT, TOLERANCE, Limits
from beamfit.greybox.problem import Problem
from beamfit.status import Status

__all__ = ["Evidence", "judge"]

_UNLIKELY = 1e-3  # chance of a chi-square below which a fit counts as poor


class Evidence(NamedTuple):
    """What a verdict rests on.

    `blind` tells which free numbers the data do not determine. `chi2` and `dof` are of what has
    errors, `errors_known` tells whether there is any.
    """

    problem: Problem
    kkt: KKT
    cost: float
    attempts: tuple[Attempt, ...]
    variables: tuple[Variable, ...]
    constraints: tuple[Limited, ...]
    blind: np.ndarray
    chi2: float
    dof: float
    errors_known: bool


def judge(e: Evidence) -> tuple[Status, str]:
    """Give the gravest verdict that applies.

    Parameters
    ----------
    e : Evidence
        Of the best point.

    Returns
    -------
    tuple of Status and str
    """
    checks = (
        (Status.infeasible, _crossed),
        (Status.unbounded, _endless),
        (Status.not_converged, _restless),
        (Status.unidentified, _undetermined),
        (Status.poor_fit, _poor),
        (Status.at_limit, _held),
    )
    for status, check in checks:
        if (said := check(e)) is not None:
            return status, said
    return Status.converged, (
        f"an optimum was reached from {_starts(e)} (KKT residual {e.kkt.worst:.1e})."
    )


def _crossed(e: Evidence) -> str | None:
    """Say which limit could not be kept."""
    if e.kkt.feasibility <= TOLERANCE:
        return None
    place = " bounds: outside"
    if e.constraints:
        limits = Limits(*np.array([c[1:4] for c in e.constraints], float).T)
        worst = e.constraints[int(np.argmax(limits.violation))]
        place = (
            f" '{worst.name}' ends at {worst.value:.4g}, outside"
            f" [{worst.lower:.4g}, {worst.upper:.4g}]"
        )
    return (
        f"no point within all constraints was found from {_starts(e)}:{place}; "
        "relax it, free more numbers, or start elsewhere."
    )


def _endless(e: Evidence) -> str | None:
    """Say that the cost has no least value."""
    if not e.problem.objectives or e.cost >= -1e15:
        return None
    return (
        f"the cost falls without end (down to {e.cost:.3g}); bound the free numbers, or "
        "check the sign of the objective."
    )


def _restless(e: Evidence) -> str | None:
    """Say that the search ended short of an optimum."""
    if e.kkt.worst <= TOLERANCE:
        return None
    return (
        f"no optimum was reached from {_starts(e)} (KKT residual {e.kkt.worst:.1e} "
        f"after {sum(a.iterations for a in e.attempts)} iterations); give more starts "
        "or iterations, or a better start."
    )


def _undetermined(e: Evidence) -> str | None:
    """Say what the data do not determine, of what is asked for."""
    open_ones = e.blind & ~e.problem.nuisance
    if not open_ones.any():
        return None
    names = _list(np.array(e.problem.names)[open_ones])
    return f"the data do not determine {names}; add data of another kind, a prior, or fix it."


def _poor(e: Evidence) -> str | None:
    """Say that the residuals are larger than the errors allow."""
    chance = stats.chi2.sf(e.chi2, e.dof) if e.dof > 0 else 1.0
    if not (e.errors_known and e.problem.records and chance < _UNLIKELY):
        return None
    return (
        f"chi2 = {e.chi2:.4g} for {e.dof:.4g} degrees of freedom happens by chance in {chance:.1e} "
        "of cases; the model misses something or the errors are too small."
    )


def _held(e: Evidence) -> str | None:
    """Say which numbers a bound decided."""
    pairs = zip(e.variables, e.problem.nuisance, strict=True)
    held = [v for v, nuisance in pairs if not nuisance and v.state in ("lower", "upper")]
    if not held:
        return None
    names = _list(f"{v.name} ({v.state})" for v in held)
    return (
        f"the best value lies at a bound: {names}; the bound decides it, not the data, so "
        "justify or widen it."
    )


def _list(names: Iterable[str]) -> str:
    """A few names for a sentence."""
    names = list(names)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _starts(e: Evidence) -> str:
    """How many starts there were."""
    return f"{len(e.attempts)} start{'s' if len(e.attempts) != 1 else ''}"
