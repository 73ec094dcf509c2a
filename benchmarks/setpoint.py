"""Lowest objectives of the hard set points of the tests by a dense search, beside the package's.

python -m benchmarks.setpoint
"""

import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import beamfit
from beamfit.emittance.setpoint import Beam, find_setpoint
from tests.emittance.test_hard_setpoints import REQUESTS, objective

STEPS, CARRIED_ON = 31, 12


def dense(request):
    """The lowest objective from the best points of a grid, by two methods one after the other."""
    low, high = np.array([*request.limits.values()]).T
    axes = [np.linspace(0.0, 1.0, STEPS)] * 3
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    values = objective(low + (high - low) * grid, request)
    kept = []
    for i in np.argsort(np.where(np.isfinite(values), values, np.inf)):
        if all(np.abs(grid[i] - k).max() > 2.5 / STEPS for k in kept):
            kept.append(grid[i])
        if len(kept) == CARRIED_ON:
            break

    def at(x):
        return float(objective(low + (high - low) * x, request))

    ends = []
    for start in kept:
        box = [(0.0, 1.0)] * 3
        near = minimize(at, start, method="L-BFGS-B", bounds=box).x
        options = {"xatol": 1e-9, "fatol": 1e-10, "maxiter": 600}
        ends.append(minimize(at, near, method="Nelder-Mead", bounds=box, options=options).fun)
    return min(ends)


def main():
    """Print one line a request."""
    line = beamfit.load_lattice(Path(__file__).parents[1] / "lattices/three_quads.toml")
    for name, request in REQUESTS.items():
        began = time.perf_counter()
        lowest = dense(request)
        between = time.perf_counter()
        beams = {plane: Beam(sigma) for plane, sigma in request.beams.items()}
        found = find_setpoint(line, beams, request.limits, request.targets)
        ended = time.perf_counter()
        print(
            f"{name:30s} {lowest:12.6g} in {between - began:5.1f} s, here "
            f"{found.best.objective:12.6g} in {ended - between:5.1f} s, {found.status}"
        )


if __name__ == "__main__":
    main()
