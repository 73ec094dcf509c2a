"""Verdicts: the statuses, and rules as small functions of evidence, each with its sentence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import NamedTuple, TypeVar

Evidence = TypeVar("Evidence")


class Status(StrEnum):
    """Outcome of a fit or of a search for an optimum, always with a sentence beside it.

    Of a fit to data anything but ``converged`` is a warning. An objective without data is never
    ``converged``, ``unidentified``, ``at_limit`` or ``poor_fit``: it is ``optimal``,
    ``local_optimum`` (others were seen, or nobody looked), ``degenerate``, ``saddle``, or has no
    answer as a fit may have none.

    Examples
    --------
    >>> str(Status.poor_fit)
    'poor_fit'
    """

    converged = "converged"
    poor_fit = "poor_fit"
    unidentified = "unidentified"
    at_limit = "at_limit"
    infeasible = "infeasible"
    not_finite = "not_finite"
    not_converged = "not_converged"
    unbounded = "unbounded"
    contradictory_bounds = "contradictory_bounds"
    optimal = "optimal"
    local_optimum = "local_optimum"
    saddle = "saddle"
    degenerate = "degenerate"

    @property
    def colour(self) -> str:
        """Colour on screen: green, yellow or red."""
        good = (Status.converged, Status.optimal)
        doubtful = (Status.poor_fit, Status.local_optimum)
        return "green" if self in good else "yellow" if self in doubtful else "red"


class Finding(NamedTuple):
    """Finding of a rule: a status, the cause in words, and the remedy.

    `about` names what the finding speaks of.
    """

    status: Status
    cause: str
    remedy: str = ""
    about: tuple[str, ...] = ()

    @property
    def message(self) -> str:
        """Cause and remedy as one text."""
        return f"{self.cause} {self.remedy}".strip()


class Judged:
    """A result with a ``finding``: its status, and its message of cause and remedy."""

    finding: Finding

    @property
    def status(self) -> Status:
        """Status of the finding."""
        return self.finding.status

    @property
    def message(self) -> str:
        """Cause of the status, and what to do."""
        return self.finding.message


Rule = Callable[[Evidence], Finding | None]


def judge(evidence: Evidence, rules: Sequence[Rule[Evidence]]) -> Finding:
    """Give the finding of the first rule that has one: rules stand in order of gravity.

    Parameters
    ----------
    evidence
        What the rules look at.
    rules : sequence of callable
        Each takes the evidence and gives a `Finding` or None; the last one always finds something.

    Returns
    -------
    Finding

    Examples
    --------
    >>> def lost(points):
    ...     return Finding(Status.unidentified, "Too few points.") if points < 3 else None
    >>> def fine(points):
    ...     return Finding(Status.converged, "Enough points.")
    >>> judge(2, (lost, fine)).status.value, judge(9, (lost, fine)).status.value
    ('unidentified', 'converged')
    """
    return next(found for rule in rules if (found := rule(evidence)) is not None)
