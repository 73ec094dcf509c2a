"""Set points: Appendix D, a dense search, exact derivatives, a match."""

import json
from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.emittance.setpoint import Beam, Target, find_setpoint
from beamfit.errors import InputError
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Quadrupole, Screen
from beamfit.particles import PROTON_MASS

# Appendix D, in SI.
SIGMA = np.array([2.6367971055566173, 1.5738242270790272, 1.435441121463094]) * 1e-8
TARGETS = [Target("size", "x", 200e-6), Target("divergence", "x", 140e-6)]


def objective(line, current, sigma=SIGMA):
    """Appendix D's objective by code of its own."""
    (a, b), (c, d) = np.asarray(line.matrix({"Q2": current}).x)[:2, :2]
    s11, s12, s22 = sigma
    size = 1e6 * np.sqrt(a * a * s11 + 2 * a * b * s12 + b * b * s22)
    angle = 1e6 * np.sqrt(c * c * s11 + 2 * c * d * s12 + d * d * s22)
    return (size - 200.0) ** 2 + (angle - 140.0) ** 2


def test_appendix_d_finds_the_global_minimum(gtf, shared):
    expected = json.loads((shared / "reference/gtf.json").read_text())["appendix_D"]
    found = find_setpoint(gtf, {"x": Beam(SIGMA)}, {"Q2": (0.0, 10.0)}, TARGETS)
    assert found.best.settings["Q2"] == pytest.approx(expected["global_minimum_I2_A"], abs=1e-8)
    assert found.best.objective == pytest.approx(expected["objective"], abs=1e-8)
    [x] = found.predicted
    assert 1e6 * x.size.value == pytest.approx(expected["size_um"], abs=1e-7)
    assert 1e6 * x.divergence.value == pytest.approx(expected["divergence_urad"], abs=1e-7)
    [other] = found.others
    assert other.settings["Q2"] == pytest.approx(2.97, abs=0.005)
    assert other.objective == pytest.approx(expected["other_objective"], abs=0.01)


def test_no_point_of_a_dense_search_is_better(gtf):
    found = find_setpoint(gtf, {"x": Beam(SIGMA)}, {"Q2": (0.0, 10.0)}, TARGETS)
    lowest = min(objective(gtf, c) for c in np.linspace(0.0, 10.0, 501))
    assert found.best.objective <= lowest
    assert found.best.objective == pytest.approx(
        objective(gtf, found.best.settings["Q2"]), rel=1e-9
    )


def test_a_limit_is_kept_and_said(gtf):
    found = find_setpoint(gtf, {"x": Beam(SIGMA)}, {"Q2": (0.0, 0.9)}, TARGETS)
    assert found.best.settings["Q2"] == 0.9
    assert (found.status.value, found.limits) == ("at_limit", ("Q2",))
    assert "Q2 at a limit" in found.message
    assert found.setting_error == {"Q2": None}


def test_a_minimum_on_a_limit_is_listed_once():
    """Searches end beside the limit until they are sharpened: it was named as its own rival."""
    quads = Quadrupole("QF", 0.25, 2.1), Drift("D1", 0.5), Quadrupole("QD", 0.25, -2.1)
    line = Beamline((*quads, Drift("D2", 3.0), Screen("W")), energy=1098.27, mass=PROTON_MASS)
    beam = Beam(np.array([2.913e-6, -2.463e-7, 1.046e-7]))
    limits = {"QF": (0.0, 5.25), "QD": (-5.25, 0.0)}
    found = find_setpoint(line, {"x": beam}, limits, [Target("match", "x", (5.0, 0.0))])
    assert found.best.settings["QD"] == 0.0
    listed = [list(each.settings.values()) for each in (found.best, *found.others)]
    gaps = [np.ptp([one, other], axis=0).max() for one, other in combinations(listed, 2)]
    assert all(gap > 1e-2 for gap in gaps)


def test_the_errors_are_those_of_moved_beams(gtf):
    """Each beam of the error ellipsoid's axes, searched again, moves by what the error says."""
    sd = np.array([0.02, 0.01, 0.015]) * SIGMA
    found = find_setpoint(gtf, {"x": Beam(SIGMA, np.diag(sd**2))}, {"Q2": (0.0, 10.0)}, TARGETS)
    moves = []
    for i in range(3):
        ends = []
        for sign in (-0.1, 0.1):
            moved = SIGMA.copy()
            moved[i] += sign * sd[i]
            best = find_setpoint(gtf, {"x": Beam(moved)}, {"Q2": (0.0, 10.0)}, TARGETS)
            ends.append(best.best.settings["Q2"])
        moves.append((ends[1] - ends[0]) / 0.2)
    assert found.setting_error["Q2"] == pytest.approx(np.linalg.norm(moves), rel=1e-3)
    [x] = found.predicted
    r = np.asarray(gtf.matrix(found.best.settings).x)[0, :2]
    slope = np.array([r[0] ** 2, 2 * r[0] * r[1], r[1] ** 2]) / (2.0 * x.size.value)
    assert x.size.error == pytest.approx(np.linalg.norm(slope * sd), rel=1e-9)


def test_a_match_reaches_the_design_and_its_objective_is_bmag_less_one(three_quads):
    start = BeamMatrix.from_twiss(2e-9, 6.0, -1.0)
    there = start.transport(three_quads.matrix({"QA": 5.0, "QB": -1.2}).x).twiss
    design = (float(there.beta), float(there.alpha))
    sigma = np.asarray(start.sigma)[[0, 0, 1], [0, 1, 1]]
    limits = {"QA": (0.0, 8.0), "QB": (-3.0, -0.5)}
    found = find_setpoint(three_quads, {"x": Beam(sigma)}, limits, [Target("match", "x", design)])
    assert found.best.objective < 1e-12
    off = find_setpoint(
        three_quads, {"x": Beam(sigma)}, {"QA": (0.0, 1.0)}, [Target("match", "x", design)]
    )
    here = start.transport(three_quads.matrix(off.best.settings).x)
    ideal = BeamMatrix.from_twiss(1e-9, *map(jnp.asarray, design))
    assert off.best.objective == pytest.approx(float(here.mismatch(ideal)) - 1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vary": {"Q3": (0.0, 1.0)}}, "no magnet 'Q3'"),
        ({"vary": {"Q2": (1.0, 0.0)}}, "lower first"),
        ({"vary": {}}, "no magnet to vary"),
        ({"targets": []}, "no target"),
        ({"targets": [Target("size", "y", 1e-4)]}, "plane y"),
        ({"targets": [Target("size", "x", -1e-4)]}, "positive"),
        ({"beams": {"x": Beam(np.array([1.0, 2.0, 1.0]) * 1e-8)}}, "positive definite"),
        ({"targets": [Target("match", "x", (5.0, np.inf))]}, "alpha = inf in plane x"),
        ({"beams": {"x": Beam(1e8 * SIGMA)}}, "SI units"),
    ],
)
def test_bad_input_is_named(gtf, change, words):
    given = {"beams": {"x": Beam(SIGMA)}, "vary": {"Q2": (0.0, 10.0)}, "targets": TARGETS} | change
    with pytest.raises(InputError, match=words):
        find_setpoint(gtf, given["beams"], given["vary"], given["targets"])


def test_the_json_has_units_and_the_energy_of_the_line(gtf):
    found = find_setpoint(gtf, {"x": Beam(SIGMA)}, {"Q2": (0.0, 10.0)}, TARGETS).to_json()
    assert found["units"] == {"Q2": "A"}
    assert (found["energy"]["value"], found["energy"]["unit"]) == (float(gtf.energy), "MeV")
