"""The errors of every scenario hold what they claim, on simulated scans.

Fast here; `make calibrate` does 500 scans of each.
"""

import numpy as np
import pytest

import beamfit
from beamfit.emittance.assumptions import Anchor, Assumptions
from beamfit.emittance.fit import scenario_of
from beamfit.emittance.statement import prepare
from tests.emittance.coverage import binomial_limits, coverage, deviations

# Case: scan, scenario, what is told, simulated scans with all tests.
CASES = {
    "known": ("one", "known", Assumptions(), 500),
    "calibration with a prior": (
        "one", "calibration", Assumptions(priors={"Q2.slope": (167.23, 3.3446)}), 200,
    ),
    "calibration from two screens": ("two", "calibration", Assumptions(), 120),
    "transport network with an anchor": (
        "one", "transport-network", Assumptions(anchor=Anchor(deviation=0.02)), 60,
    ),
    "focusing network with an anchor": (
        "one", "focusing-network", Assumptions(anchor=Anchor(deviation=0.02)), 40,
    ),
    "focusing network from two screens": ("two", "focusing-network", Assumptions(), 40),
}  # fmt: skip


@pytest.fixture(scope="module")
def seen(root):
    pairs = {"one": ("gtf_simulated", "gtf"), "two": ("gtf_two_screens_simulated",
                                                      "gtf_two_screens")}  # fmt: skip
    found = {}
    for key, (scan, lattice) in pairs.items():
        scan = beamfit.read_quad_scan(root / f"measurements/{scan}.csv")
        line = beamfit.load_lattice(root / f"lattices/{lattice}.toml")
        found[key] = prepare(scan, line)
    return found


@pytest.mark.parametrize("number", [None, pytest.param(500, marks=pytest.mark.calibrate)])
@pytest.mark.parametrize("case", CASES)
def test_intervals_hold_the_truth_as_often_as_they_say(seen, case, number):
    scan, scenario, told, few = CASES[case]
    number = number or few
    problem = scenario_of(scenario).state(seen[scan], told)
    pulls, known = deviations(problem, problem.start, number=number, seed=3)
    assert known.all()
    one, two = coverage(pulls)
    for share, nominal in ((one, 0.6827), (two, 0.9545)):
        low, high = binomial_limits(number, nominal)
        assert low <= share <= high, f"{share:.3f} outside {low:.3f} to {high:.3f}"
    assert abs(np.mean(pulls)) < 4.0 / np.sqrt(number) + 0.1


def test_the_check_sees_errors_that_are_a_third_too_small(seen):
    problem = scenario_of("known").state(seen["one"], Assumptions())
    pulls, _ = deviations(problem, problem.start, number=500, seed=3)
    one, _ = coverage(1.5 * pulls)
    assert one < binomial_limits(500, 0.6827)[0]
