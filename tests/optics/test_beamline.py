"""Elements and lines: the GTF reference, invariants, derivatives, bad names."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamfit.errors import InputError
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import (
    CurrentPolynomial,
    FocusingStrength,
    IntegratedGradient,
    IntegratedStrength,
    SlopeIntercept,
    plain_meaning,
)
from beamfit.optics.elements import Drift, Marker, Quadrupole, Screen, SectorDipole, ThinLens
from beamfit.particles import beta_gamma, rigidity

# One case per element class: a new class without a case fails test_every_element_has_a_case.
CASES = {
    "drift": Drift("D", 0.7),
    "quadrupole": Quadrupole("Q", 0.3, setting=5.0),
    "quadrupole by current": Quadrupole("Q", 0.08, 1.1, SlopeIntercept(167.23, 43.17)),
    "quadrupole by polynomial": Quadrupole("Q", 0.1, -2.0, CurrentPolynomial((0.1, 2.0, -0.01))),
    "quadrupole by gradient": Quadrupole("Q", 0.108, -4.2, IntegratedGradient()),
    "dipole": SectorDipole("B", 0.4, 1.04, 0.04, 0.23, bend_plane="y", energy_offset=0.02),
    "dipole that stays": SectorDipole("B", 0.4, 1.04, 0.04, 0.23, energy=130.0),
    "combined dipole": SectorDipole("B", 3.0, 0.3, 0.1, 0.2, k1=1.5),
    "thin lens": ThinLens("L", 0.5),
    "marker": Marker("M"),
    "screen": Screen("S"),
}


@pytest.fixture(scope="module")
def gtf():
    """The GTF line of physics.md section 1, with the numbers of the report's appendix C."""
    length = 0.07677
    return Beamline(
        (
            Quadrupole("Q1", length, 0.0, SlopeIntercept(-160.87, -49.0)),
            Drift("D1", 0.11023),
            Quadrupole("Q2", length, 0.0, SlopeIntercept(167.23, 43.17)),
            Drift("D2", 1.834615),
            SectorDipole("SPEC", 0.4, np.pi / 3, np.radians(2.53), np.radians(13.49), "y"),
            Drift("D3", 0.4191),
            Screen("SCREEN"),
        ),
        energy=30.5,
    )


def test_every_element_class_has_a_case():
    from beamfit.optics.elements import Element

    assert {type(c) for c in CASES.values()} == set(Element.__args__)


@pytest.mark.parametrize("case", CASES)
def test_determinant_is_one_in_both_planes(case):
    r = CASES[case].matrix(energy=135.0)
    for plane in (r.x, r.y):
        assert np.linalg.det(plane[:2, :2]) == pytest.approx(1.0, abs=1e-14)


def test_gtf_reproduces_the_reference_at_14_currents(gtf, shared):
    reference = json.loads((shared / "reference/gtf.json").read_text())
    rows = reference["rows"]
    currents = jnp.array([row["I2_A"] for row in rows])
    r = jax.jit(jax.vmap(lambda i: gtf.matrix({"Q2": i}).x))(currents)
    for (i, j), key in {(0, 0): "A_T", (0, 1): "B_T_m", (1, 0): "C_T_per_m", (1, 1): "D_T"}.items():
        np.testing.assert_allclose(r[:, i, j], [row[key] for row in rows], rtol=0, atol=1e-9)


def test_gtf_spectrometer_is_the_appendix_matrix(gtf):
    """Report appendix C prints these four numbers with 12 digits."""
    printed = [[0.953728998305, 0.418879020479], [-0.682448955752, 0.748783408240]]
    np.testing.assert_allclose(gtf["SPEC"].matrix().x[:2, :2], printed, rtol=0, atol=5e-13)


def test_gtf_line_is_the_report_eqs_32_to_35(gtf):
    """The line's product against the report's expanded products at a current of our own."""
    quads = gtf.upto("Q2")
    a, b, c, d = np.asarray(quads.matrix({"Q2": 2.345}).x)[:2, :2].ravel()
    aq, bq, cq, dq = np.asarray(gtf["SPEC"].matrix().x)[:2, :2].ravel()
    l1, l2 = 1.834615, 0.4191
    expected = [
        [
            aq * (a + l1 * c) + bq * c + l2 * cq * (a + l1 * c) + l2 * dq * c,
            aq * (b + l1 * d) + bq * d + l2 * cq * (b + l1 * d) + l2 * dq * d,
        ],
        [cq * (a + l1 * c) + dq * c, cq * (b + l1 * d) + dq * d],
    ]
    np.testing.assert_allclose(gtf.matrix({"Q2": 2.345}).x[:2, :2], expected, rtol=1e-13)


def test_rounded_values_of_the_report_differ_by_0_009(gtf):
    """physics.md section 1: the rounded constants of eqs 20-29 move A_T, B_T by up to 0.009."""
    rounded = Beamline(
        (
            Quadrupole("Q1", 0.077, -(1.27**2)),
            Drift("D1", 0.110),
            Quadrupole("Q2", 0.077, 0.0, SlopeIntercept(167.23, 43.17)),
            Drift("D2", 1.835),
            gtf["SPEC"],
            Drift("D3", 0.419),
        ),
        energy=30.5,
    )
    currents = jnp.linspace(0.0, 3.9, 14)
    exact, coarse = (
        jax.vmap(lambda i, part=part: part.matrix({"Q2": i}).x)(currents) for part in (gtf, rounded)
    )
    assert round(float(np.abs(coarse - exact)[:, 0].max()), 3) == 0.009


@given(st.floats(-30, 30), st.floats(0.05, 0.95))
def test_two_parts_of_a_quadrupole_make_the_whole(k1, part):
    whole = Quadrupole("Q", 0.4, k1).matrix()
    pieces = (
        Quadrupole("B", 0.4 * (1 - part), k1).matrix() @ Quadrupole("A", 0.4 * part, k1).matrix()
    )
    for got, expected in ((pieces.x, whole.x), (pieces.y, whole.y)):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)


def test_two_halves_of_a_combined_dipole_make_the_whole():
    whole = SectorDipole("B", 3.0, 0.3, 0.1, 0.2, k1=1.5).matrix()
    first = SectorDipole("B1", 3.0, 0.15, 0.1, 0.0, k1=1.5).matrix()
    second = SectorDipole("B2", 3.0, 0.15, 0.0, 0.2, k1=1.5).matrix()
    np.testing.assert_allclose((second @ first).planes, whole.planes, rtol=1e-13, atol=1e-14)


def test_a_quadrupole_at_zero_is_a_drift_and_stays_differentiable():
    quadrupole = Quadrupole("Q", 0.4)
    np.testing.assert_array_equal(quadrupole.matrix(0.0).x, Drift("D", 0.4).matrix().x)
    slope = jax.jit(jax.jacfwd(lambda k: quadrupole.matrix(k).x))(0.0)
    # d/dk of the thin lens limit and the series: R21 = -k L, R11 = 1 - k L²/2, R12 = L - k L³/6
    np.testing.assert_allclose(slope[1, 0], -0.4, rtol=1e-14)
    np.testing.assert_allclose(slope[0, 0], -0.08, rtol=1e-14)
    np.testing.assert_allclose(slope[0, 1], -(0.4**3) / 6, rtol=1e-14)


def test_a_straight_dipole_is_a_drift():
    weak = SectorDipole("B", 1e7, 1e-7).matrix()
    np.testing.assert_allclose(weak.x, Drift("D", 1.0).matrix().x, atol=2e-7)


def test_a_short_quadrupole_is_a_thin_lens():
    short = Quadrupole("Q", 1e-6, 2e6 * 0.25).matrix()
    np.testing.assert_allclose(short.x, ThinLens("L", 0.5).matrix().x, atol=1e-6)


def test_parts_compose(gtf):
    start, rest = gtf.upto("D1"), gtf.between("D1", "SCREEN")
    settings = {"Q2": 1.7}
    whole, product = gtf.matrix(settings), rest.matrix(settings) @ start.matrix()
    np.testing.assert_allclose(product.x, whole.x, rtol=1e-13)
    np.testing.assert_allclose(product.y, whole.y, rtol=1e-13)


def test_derivative_by_the_current_agrees_with_a_finite_difference(gtf):
    exact = jax.jit(jax.jacfwd(lambda i: gtf.matrix({"Q2": i}).x))(1.3)
    h = 1e-5
    plus, minus = gtf.matrix({"Q2": 1.3 + h}).x, gtf.matrix({"Q2": 1.3 - h}).x
    np.testing.assert_allclose(exact, (plus - minus) / (2 * h), rtol=1e-8, atol=1e-9)


def test_derivative_by_every_number_of_the_line_exists(gtf):
    slopes = jax.jit(jax.grad(lambda line: line.matrix({"Q2": 1.3}).x[0, 1]))(gtf)
    h = 1e-6
    longer = gtf.with_element(Drift("D2", 1.834615 + h))
    change = (longer.matrix({"Q2": 1.3}).x[0, 1] - gtf.matrix({"Q2": 1.3}).x[0, 1]) / h
    assert slopes["D2"].length == pytest.approx(float(change), rel=1e-6)
    assert float(slopes["Q2"].calibration.slope) != 0.0
    assert float(slopes.energy) != 0.0


def test_jit_and_vmap_over_several_magnets_give_the_same_numbers(gtf):
    settings = {"Q1": jnp.array([0.0, 0.1]), "Q2": jnp.array([1.0, 2.0])}
    many = jax.jit(jax.vmap(gtf.matrix))(settings)
    for n in range(2):
        one = gtf.matrix({name: values[n] for name, values in settings.items()})
        np.testing.assert_allclose(many.y[n], one.y, rtol=1e-13)


def test_unknown_magnet_offers_the_nearest(gtf):
    with pytest.raises(InputError, match=r"setting for 'QZ2'; expected one of Q1, Q2 .*Q2"):
        gtf.matrix({"QZ2": 1.0})


def test_several_settings_at_once_are_refused(gtf):
    """An array would be taken for as many magnets in a row."""
    with pytest.raises(InputError, match=r"2 settings of 'Q2' at once.*vmap"):
        gtf.matrix({"Q2": np.array([1.0, 2.0])})


def test_magnets_of_one_name_share_a_setting():
    line = Beamline((Quadrupole("Q", 0.1), Drift("D", 1.0), Quadrupole("Q", 0.1)), energy=100.0)
    single = Quadrupole("Q", 0.1).matrix(3.0)
    expected = single @ Drift("D", 1.0).matrix() @ single
    np.testing.assert_allclose(line.matrix({"Q": 3.0}).x, expected.x, rtol=1e-14)
    assert line.magnets == ("Q",)


def test_calibrations_agree_where_they_mean_the_same_field():
    """One gradient of 3 T/m, said in four ways, at 135 MeV and 0.108 m."""
    length, energy, gradient = 0.108, 135.0, 3.0
    k1 = gradient / rigidity(energy)
    said = [
        CurrentPolynomial((0.0, 1.5)).k1l(2.0, length, energy),
        IntegratedGradient().k1l(10 * gradient * length, length, energy),
        FocusingStrength().k1l(k1, length, energy),
        SlopeIntercept(k1 * energy / 2, 0.0).k1l(2.0, length, energy),
        IntegratedStrength().k1l(k1 * length, 0.0, energy),
    ]
    np.testing.assert_allclose(said, k1 * length, rtol=1e-14)


def test_rigidity_of_known_particles():
    """Bρ of 1 GeV/c is 3.3356409 T m (the speed of light); βγ from cosh of the rapidity."""
    energy = np.hypot(1000.0, 0.51099895069)
    assert rigidity(energy) == pytest.approx(3.3356409519815204, rel=1e-12)
    rapidity = np.arccosh(135.0 / 0.51099895069)
    assert beta_gamma(135.0) == pytest.approx(np.sinh(rapidity), rel=1e-12)


def test_meanings_of_a_setting_with_the_same_fields_are_not_one_program_s():
    """Their structures were equal: now and then settings in T/m ran the program for kG."""
    meanings = [plain_meaning(unit, 0.511) for unit in ("kG", "T_per_m", "k1", "k1l")]
    structures = [jax.tree.structure(each) for each in meanings]
    assert [[a == b for b in structures] for a in structures] == np.eye(4).astype(bool).tolist()
