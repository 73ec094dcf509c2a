"""The statuses a fit may end in, one list for the whole package."""

from enum import StrEnum


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
