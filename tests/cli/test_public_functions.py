"""Commands say what the public functions give: `--json` is `to_dict` of the same result."""

import json

import pytest

import beamfit

SCAN, LATTICE = "measurements/lcls_otr2.csv", "lattices/lcls_otr2.toml"
RUN = "measurements/valve_level_simulated.csv"
SAME = {
    "design": (
        ("design", SCAN, "--lattice", LATTICE, "--count", 1),
        lambda: [beamfit.design(beamfit.fit_emittance(SCAN, LATTICE), count=1)],
    ),
    "solve": (
        ("solve", "formulations/appendix_d.bf", "--start", 2),
        lambda: [beamfit.solve("formulations/appendix_d.bf", starts=2)],
    ),
    "identify": (
        ("identify", RUN, "--delay", 2, "--seed", 3),
        lambda: beamfit.identify(RUN, delay=2, seed=3),
    ),
    "control": (
        ("control", RUN, "--delay", 2, "--set", "level=5@10", "--limit", "level=:9"),
        lambda: [
            beamfit.control(
                RUN, [("level", 5.0, 10.0)], limits={"level": (float("-inf"), 9.0)}, delay=2
            )
        ],
    ),
    "lifetime": (
        ("lifetime", "measurements/aps_1999_decay.csv"),
        lambda: beamfit.study("measurements/aps_1999_decay.csv").answers,
    ),
    "check": (("check", SCAN), lambda: [beamfit.check(SCAN)]),
}


@pytest.mark.parametrize("command", SAME)
def test_a_command_and_its_function_agree(run, command):
    arguments, function = SAME[command]
    status, out, _ = run(*arguments, "--json")
    assert status == 0
    results = json.loads(out)["results"]
    found = [r.to_dict() if hasattr(r, "to_dict") else r.to_json() for r in function()]
    assert json.loads(json.dumps(found)) == results
