"""The statuses a fit may end in, one list for the whole package."""

from enum import StrEnum

__all__ = ["Status"]


class Status(StrEnum):
    """How a fit ended. Anything but ``converged`` is a warning with a sentence beside it.

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
