"""Several magnets on one supply: a knob is scanned, advised and limited as a magnet is."""

import numpy as np
import pytest

import beamfit
from beamfit.emittance.design import plan_measurements
from beamfit.emittance.systematics import systematics
from beamfit.emittance.targets import Target
from beamfit.errors import InputError
from beamfit.io.line import build_line, read_lattice
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.elements import Drift, Quadrupole, Screen

# A doublet fed in series: the magnets differ in length, calibration and sign.
PAIR = """format = "beamfit-lattice-1"
energy_MeV = 135.0
[[element]]
type = "quadrupole"
name = "QF"
supply = "QS"
length_m = 0.1
current_A = 2.0
slope = 500.0
intercept = 5.0
[[element]]
type = "drift"
length_m = 0.3
[[element]]
type = "quadrupole"
name = "QD"
supply = "QS"
length_m = 0.15
current_A = 2.0
gradient_polynomial_T_per_m = [0.0, -0.6]
[[element]]
type = "drift"
length_m = 2.0
[[element]]
type = "screen"
name = "S"
"""
TRUE = BeamMatrix.from_twiss(2e-9, 8.0, 0.5)
CURRENTS = np.linspace(-1.0, 9.0, 11)


def strengths(current):
    """k1 of both, from the numbers above."""
    rigidity = np.sqrt(135.0**2 - 0.51099895069**2) / 299.792458
    return (500.0 * current + 5.0) / 135.0, -0.6 * current / rigidity


def by_hand(current):
    """The transfer matrix of the pair with each magnet set by itself."""
    one, two = strengths(current)
    parts = (Quadrupole("QF", 0.1, one), Drift("D", 0.3), Quadrupole("QD", 0.15, two))
    return beamfit.Beamline((*parts, Drift("E", 2.0), Screen("S")), 135.0).matrix()


@pytest.fixture
def pair(tmp_path):
    path = tmp_path / "pair.toml"
    path.write_text(PAIR)
    return build_line(read_lattice(path))


def knob_scan(noise=0.0):
    size = {}
    for plane in "xy":
        true = [float(TRUE.transport(getattr(by_hand(i), plane)).l11) for i in CURRENTS]
        factor = 1 + noise * np.random.default_rng(8).normal(size=len(CURRENTS))
        size[plane] = np.array(true) * factor
    error = {p: 0.02 * v for p, v in size.items()}
    return beamfit.QuadScan({"QS": CURRENTS}, {"QS": "A"}, size, error)


def test_the_supply_sets_each_magnet_by_its_own_calibration(pair):
    assert pair.magnets == ("QS",)
    for current in (-1.0, 0.0, 3.7):
        for plane in "xy":
            found = getattr(pair.matrix({"QS": current}), plane)
            np.testing.assert_allclose(found, getattr(by_hand(current), plane), rtol=1e-12)
    np.testing.assert_allclose(pair.matrix().x, by_hand(2.0).x, rtol=1e-12)


def test_a_scan_of_the_knob_gives_the_beam_and_its_waist(pair):
    fit = beamfit.fit_emittance(knob_scan(), pair)
    for plane in "xy":
        assert fit[plane].emittance.value == pytest.approx(2e-9, rel=1e-9)
    assert fit.y.identifiability.waist_bracketed is not None
    assert fit.x.points.settings["QS"].tolist() == CURRENTS.tolist()


def test_one_per_cent_of_the_supply_is_one_per_cent_of_all_its_magnets(pair):
    """The budget's exact derivative against fits of sizes seen through other magnets."""
    fit = beamfit.fit_emittance(knob_scan(), pair)
    changes = [c for c in systematics(fit, "x") if c.cause.startswith("QS")]
    [change] = [c for c in changes if "late" not in c.cause]
    moved = []
    for factor in (1.001, 0.999):
        text = PAIR.replace("slope = 500.0", f"slope = {500.0 * factor}")
        text = text.replace("[0.0, -0.6]", f"[0.0, {-0.6 * factor}]")
        moved.append(_fit_of(text).emittance.value)
    assert change.emittance == pytest.approx(0.01 * (moved[0] - moved[1]) / 0.002 / 2e-9, rel=1e-3)


def _fit_of(text, scan=None):
    import tempfile

    with tempfile.NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(text)
        file.flush()
        line = build_line(read_lattice(file.name))
    return beamfit.fit_emittance(scan or knob_scan(), line).x


def test_advice_and_set_points_move_the_knob(pair):
    fit = beamfit.fit_emittance(knob_scan(0.02), pair)
    advice = plan_measurements(fit, limits={"QS": (0.0, 5.0)}, count=2)
    assert advice.steps
    assert all(0.0 <= step.candidate.settings["QS"] <= 5.0 for step in advice.steps)
    beam = {"x": beamfit.emittance.targets.Beam(np.array([1.6e-8, -1e-9, 3.1e-10]))}
    found = beamfit.find_setpoint(pair, beam, {"QS": (0.0, 8.0)}, [Target("size", "x", 1e-4)])
    assert set(found.to_json()["settings"]) == {"QS"}


def test_what_a_supply_cannot_be_asked(pair, tmp_path):
    size = knob_scan().size
    with pytest.raises(InputError, match="one of QS"):
        beamfit.fit_emittance(beamfit.QuadScan({"QF": CURRENTS}, {"QF": "A"}, size), pair)
    for scenario in ("calibration", "focusing-network"):
        with pytest.raises(InputError, match="feeds several magnets"):
            beamfit.fit_emittance(knob_scan(), pair, scenario=scenario)
    for old, new, words in (
        ("current_A = 2.0\ngrad", "current_A = 2.5\ngrad", "current_A = 2, as above"),
        ('supply = "QS"\nlength_m = 0.15', 'supply = "QF"\nlength_m = 0.15', "an element has it"),
    ):
        path = tmp_path / "wrong.toml"
        path.write_text(PAIR.replace(old, new))
        with pytest.raises(InputError, match=words):
            read_lattice(path)


def test_currents_beyond_the_measured_table_are_questioned(tmp_path):
    path = tmp_path / "table.toml"
    old = "current_A = 2.0\nslope = 500.0\nintercept = 5.0"
    table = [[i, (500.0 * i + 5.0) / 299.792458] for i in (-2.0, 4.0, 12.0)]
    path.write_text(PAIR.replace(old, f"current_A = 2.0\ngradient_table = {table}"))
    fit = beamfit.fit_emittance(knob_scan(), build_line(read_lattice(path)))
    # k1 = G/(Bρ), and p is 1e-5 below E: the table says what the line did.
    assert fit.x.emittance.value == pytest.approx(2e-9, rel=1e-3)
    assert fit.notes == ()
    path.write_text(PAIR.replace(old, f"current_A = 2.0\ngradient_table = {table[:2]}"))
    [note] = beamfit.fit_emittance(knob_scan(), build_line(read_lattice(path))).notes
    assert note.startswith("5 of 11 currents of QS lie beyond the measured -2 to 4 A of QF")
