"""Fits in which more than the beam is unknown: state the problem, train, judge.

Reached through `beamfit.fit_emittance` with ``scenario=...``.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from beamfit.greybox import problem as greybox
from beamfit.greybox.fit import Fit
from beamfit.greybox.many_starts import descend_all
from beamfit.greybox.problem import Problem
from beamfit.greybox.solve import solve, starting_points
from beamfit.optics.beamline import Beamline
from beamfit.status import Status
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.calibration import calibration_problem
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.focusing_network import focusing_problem
from beamfit.studies.scan.scans import QuadScan
from beamfit.studies.scan.scenario_data import Seen, see
from beamfit.studies.scan.scenario_judged import judged
from beamfit.studies.scan.scenario_result import result_of
from beamfit.studies.scan.transport_network import transport_problem

__all__ = ["fit_scenario", "scenario_problem", "train"]

# Steps of the search from many starts; what is left is for the polish.
STEPS, POLISH = 300, 300
# How many of the best ends may be polished.
POLISHED = 4


def scenario_problem(seen: Seen, scenario: str, told: Assumptions) -> Problem:
    """State the problem of a scenario.

    Parameters
    ----------
    seen : Seen
        The scan through its line.
    scenario : str
        Any but "known", which needs no general problem.
    told : Assumptions
        Priors, bounds, anchor, sizes of networks.

    Returns
    -------
    Problem
    """
    state = {
        "calibration": calibration_problem,
        "transport-network": transport_problem,
        "focusing-network": focusing_problem,
    }
    return state[scenario](seen, told)


def train(problem: Problem, starts: int, seed: int = 0) -> Fit:
    """Search from many starts at once, then polish and judge the best end point.

    Parameters
    ----------
    problem : Problem
        Least squares with bounds alone.
    starts : int
        The problem's own start first, then random ones.
    seed : int
        Of the random starts.

    Returns
    -------
    Fit
        From the cheapest start; KKT residual, states and multipliers as of `solve`.
    """
    if starts == 1:
        return solve(problem, iterations=POLISH)
    points = jnp.asarray(np.array(starting_points(problem, starts, seed)))
    lower, upper = jnp.asarray(problem.lower), jnp.asarray(problem.upper)
    found = descend_all(greybox.residual, problem.core, points, lower, upper, STEPS)
    cost = np.where(np.isfinite(found.cost), found.cost, np.inf)
    ends = np.asarray(found.theta)[np.argsort(cost, kind="stable")[:POLISHED]]
    fits = []
    for end in ends:
        fits.append(solve(replace(problem, model=problem.model_at(end)), iterations=POLISH))
        # The cheapest end that comes to rest is the answer; most often it is the first.
        if np.isfinite(fits[-1].chi2) and judged(fits[-1]).settled:
            return fits[-1]
    return min(fits, key=lambda fit: fit.cost if np.isfinite(fit.cost) else np.inf)


def fit_scenario(
    scan: QuadScan,
    line: Beamline,
    scenario: str,
    told: Assumptions,
    planes: tuple[str, ...] | None = None,
    method: str = "size_squared",
) -> EmittanceFit:
    """Fit a scan with more than the beam unknown.

    Parameters
    ----------
    scan, line, planes, method
        As for `beamfit.fit_emittance`.
    scenario : str
        "transport-network", "calibration" or "focusing-network".
    told : Assumptions
        What is known besides the data.

    Returns
    -------
    EmittanceFit

    Raises
    ------
    InputError
        If names or options do not fit the scan, the line or the scenario.

    Notes
    -----
    The planes of a scan are fitted together: calibration and networks are theirs in common.
    """
    told.check_scenario(scenario)
    seen = see(scan, line, planes, method)
    problem = scenario_problem(seen, scenario, told)
    network = scenario.endswith("network")
    fit = train(problem, told.starts if network else 1, told.seed)
    if not network and _stranded(fit):
        fit = train(problem, told.starts, told.seed)
    return result_of(seen, scenario, told, problem, fit)


def _stranded(fit: Fit) -> bool:
    """Whether a search ended where one start may have led it astray.

    A beam of no emittance is a stationary point of every fit in its Cholesky factor, so a start
    near it (the known-transport fit with a wrong calibration, say) may never leave it.
    """
    flat = any(v.name.endswith(".l22") and v.state == "lower" for v in fit.variables)
    return flat or (fit.status is not Status.converged and fit.chi2 > 2.0 * max(fit.dof, 1))
