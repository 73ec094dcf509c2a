"""Verdicts as rules: a list of small functions of evidence, each with its sentence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

from beamfit.status import Status

Evidence = TypeVar("Evidence")


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
