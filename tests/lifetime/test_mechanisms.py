"""Loss mechanisms against pyAT, pyaccel, MAD-X and xfields on SPEAR3 2003.

The figures are those of cross-program runs on the deck sp3v81f: pyAT 0.9.0, pyaccel 3.19.0, MAD-X
5.09.03, xfields 0.27.5. The Twiss table in lattices/ is a later pyAT run with finer slices, whose
optics differ by 1e-4 in beta; tolerances say so.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.ring import read_operation, read_ring, ring_from_pyat
from beamfit.lifetime.mechanisms import (
    bremsstrahlung_cross_section,
    elastic_cross_section,
    gas_rate_coefficient,
    loss_coefficients,
    piwinski_rate,
    piwinski_shape,
    touschek_shape,
)
from beamfit.lifetime.ring import (
    bunch_in_bucket,
    equal_bunches,
    gas_mixture,
    lengthening,
    population,
    quantum_rate,
    vertical_acceptance,
)
from tests.lifetime.bruck import bruck_rate, bruck_shape

HOUR = 3600.0
SPEAR3 = "lattices/spear3_2003.toml"


@pytest.fixture(scope="module")
def ring():
    return read_ring(SPEAR3)


@pytest.fixture(scope="module")
def operation():
    return read_operation(SPEAR3)


def touschek_hours(ring, operation, current=500.0):
    return 1 / float(loss_coefficients(ring, operation, current).a_touschek * current) / HOUR


@pytest.mark.parametrize(
    ("voltage", "acceptance", "length", "hours"),
    [
        (1.2e6, 0.008754127919, 9.643097922e-3, 2.905434006),
        (1.6e6, 0.015003135394, 7.541138577e-3, 8.248289367),
        (2.0e6, 0.019812139442, 6.506191839e-3, 14.074674478),
        (2.4e6, 0.023845506001, 5.835692704e-3, 20.017240954),
        (2.8e6, 0.027376088155, 5.348811945e-3, 25.965672101),
        (3.2e6, 0.03, 4.971888996e-3, 30.445570348),
    ],
)
def test_rf_voltage_at_spear3(ring, operation, voltage, acceptance, length, hours):
    bunch = bunch_in_bucket(ring, voltage, 0.0)
    assert float(bunch.acceptance) == pytest.approx(acceptance, rel=1e-10)
    assert float(bunch.length) == pytest.approx(length, rel=1e-9)
    found = touschek_hours(ring, operation._replace(rf_voltage=voltage))
    assert found == pytest.approx(hours, rel=1e-4)


def test_more_voltage_than_the_lattice_can_use_costs_lifetime(ring, operation):
    narrow = ring._replace(momentum_acceptance=0.025)
    at_optimum, above = (
        touschek_hours(narrow, operation._replace(rf_voltage=v)) for v in (2.55e6, 3.2e6)
    )
    assert at_optimum == pytest.approx(21.768057611, rel=1e-4)
    assert above == pytest.approx(19.200473120, rel=1e-4)


@pytest.mark.parametrize(
    ("bunches", "hours"), [(76, 8.263797666), (140, 15.222785174), (372, 40.449114890)]
)
def test_bunch_number_at_spear3(ring, operation, bunches, hours):
    found = touschek_hours(ring, operation._replace(bunches=bunches))
    assert found == pytest.approx(hours, rel=1e-4)


@pytest.mark.parametrize(
    ("coupling", "hours"), [(0.0005, 15.302447317), (0.002, 30.445570348), (0.01, 66.137307050)]
)
def test_coupling_at_spear3(ring, operation, coupling, hours):
    coupled = ring._replace(emittance_y=coupling * ring.emittance_x)
    assert touschek_hours(coupled, operation) == pytest.approx(hours, rel=1e-4)


@pytest.mark.parametrize(
    ("current", "hours"), [(50, 307.940177429), (200, 79.437578616), (500, 33.511445624)]
)
def test_a_lengthening_bunch_lives_longer(ring, operation, current, hours):
    inductive = ring._replace(impedance=0.4)
    assert touschek_hours(inductive, operation, float(current)) == pytest.approx(hours, rel=1e-4)
    # pyAT's own lifetime without an impedance, scaled by the shape, must say the same.
    shape = float(touschek_shape(inductive, operation)(float(current)))
    assert touschek_hours(ring, operation, float(current)) / shape == pytest.approx(hours, rel=1e-4)


def test_lengthening_solves_its_cubic_and_its_slope_is_exact():
    strengths = jnp.array([0.0, 1e-12, 1e-3, 0.385, 1.0, 50.0, 1e6])
    ratio = jax.jit(jax.vmap(lengthening))(strengths)
    np.testing.assert_allclose(ratio**3 - ratio, strengths, rtol=1e-12, atol=1e-14)
    slope = jax.jit(jax.vmap(jax.grad(lengthening)))(strengths)
    np.testing.assert_allclose(slope, 1 / (3 * ratio**2 - 1), rtol=1e-10)


@pytest.mark.parametrize(
    ("impedance", "bunch_ampere", "length"),
    [(0.1, 0.00179, 5.1106973587e-3), (0.3, 0.005, 5.9072363115e-3), (0.5, 0.005, 6.361497452e-3)],
)
def test_lengthening_against_pyat(ring, impedance, bunch_ampere, length):
    bunch = bunch_in_bucket(ring._replace(impedance=impedance), 3.2e6, bunch_ampere * 1e3)
    # pyAT's tracked synchrotron tune differs from the formula by 1e-4.
    assert float(bunch.length) == pytest.approx(length, rel=1e-4)


@pytest.mark.parametrize(
    ("floor", "b1", "b2", "value"),
    [
        (0.0009, 10.0, 9.0, 7709.283992640405),
        (0.0004, 200.0, 150.0, 42033.839176097135),
        (0.0009, 3.0, 0.0, 7433.157143827057),
        (0.000625, 3.0, 1.5, 10687.526444394742),
    ],
)
def test_piwinski_integral_against_adaptive_quadrature(floor, b1, b2, value):
    for nodes, tolerance in ((32, 1e-5), (64, 2e-9)):
        found = float(piwinski_shape(floor, b1, b1**2 - b2**2, nodes))
        assert found == pytest.approx(value, rel=tolerance)


def test_more_nodes_change_nothing_on_the_whole_ring(ring):
    rates = [float(piwinski_rate(ring, 8.7e9, 5e-3, 0.03, nodes)) for nodes in (64, 160)]
    assert rates[0] == pytest.approx(rates[1], rel=2e-9)


def test_a_round_beam_has_a_rate_and_a_slope(ring):
    point = jax.tree.map(lambda _: jnp.zeros(1), ring.optics)
    point = point._replace(weight=jnp.ones(1), beta_x=jnp.full(1, 8.0), beta_y=jnp.full(1, 8.0))

    def rate(emittance):
        round_beam = ring._replace(emittance_x=emittance, emittance_y=emittance, optics=point)
        return piwinski_rate(round_beam, 8.7e9, 5e-3, 0.03)

    step = 1e-12
    difference = (rate(1e-9 + step) - rate(1e-9 - step)) / (2 * step)
    assert float(jax.jit(jax.grad(rate))(1e-9)) == pytest.approx(float(difference), rel=1e-5)


def test_bruck_is_the_limit_of_a_flat_slow_beam(ring):
    at_spear3 = float(bruck_rate(ring, 1.0, 1.0, 0.03) / piwinski_rate(ring, 1.0, 1.0, 0.03))
    assert 1 / 1.175 < at_spear3 < 1 / 1.165
    shrink = 1e-4
    slow = ring._replace(
        emittance_x=shrink * ring.emittance_x,
        emittance_y=1e-3 * shrink * ring.emittance_y,
        energy_spread=np.sqrt(shrink) * ring.energy_spread,
    )
    acceptance = 0.03 * np.sqrt(shrink)
    limit = bruck_rate(slow, 1.0, 1.0, acceptance) / piwinski_rate(slow, 1.0, 1.0, acceptance)
    assert float(limit) == pytest.approx(1, abs=5e-5)


def test_bruck_against_pyaccel(ring):
    electrons = population(ring, 500 / 280)
    found = 1 / float(bruck_rate(ring, electrons, 4.971812253e-3, 0.03)) / HOUR
    assert found == pytest.approx(35.664055677, rel=1e-4)
    for xi, value in ((1e-5, 0.029839890536), (0.01, 0.265804721120), (1.0, 0.045562272840)):
        assert float(bruck_shape(xi)[0]) == pytest.approx(value, rel=1e-10)


def test_touschek_against_pyat_now_on_one_ring():
    at = pytest.importorskip("at")
    lattice = spear3_cells(at)
    ring = ring_from_pyat(lattice, coupling=0.002)
    flat = lattice.disable_6d(copy=True)
    cell = np.flatnonzero([element.Length > 0 for element in flat])[:15]
    names = {"emitx": ring.emittance_x, "sigs": 5e-3, "sigp": ring.energy_spread}
    momenta = np.tile([0.03, -0.03], (cell.size, 1))
    seconds, _, _ = at.get_lifetime(
        flat, ring.emittance_y, 1e-3, momap=momenta, refpts=cell, interpolate=False, **names
    )
    share = ring.optics.weight[:15] / ring.optics.weight[:15].sum()
    first = ring.optics._make(values[:15] for values in ring.optics)._replace(weight=share)
    electrons = population(ring, 1.0)
    rate = piwinski_rate(ring._replace(optics=first), electrons, 5e-3, 0.03)
    # 2e-5 is pyAT's Bessel function replaced by its asymptote above 500.
    assert 1 / float(rate) == pytest.approx(seconds, rel=3e-5)


def spear3_cells(at):
    """A ring of seventeen of SPEAR3's standard cells."""
    half = [
        at.Drift("D1", 1.52997525),
        at.Quadrupole("QF", 0.3533895, 1.768672904054),
        at.Drift("D2", 0.3815757),
        at.Quadrupole("QD", 0.1634591, -1.542474230359),
        at.Drift("D3", 0.21690312),
        at.Dipole("B", 1.5048, 2 * np.pi / 34, -0.31537858, EntranceAngle=0.0924, ExitAngle=0.0924),
        at.Drift("D4", 1.43941452),
    ]
    cell = [*half, at.Quadrupole("QFC", 0.5123803, 1.748640831069), *half[::-1]]
    length = 17 * sum(element.Length for element in cell)
    cavity = at.RFCavity("RF", 0.0, 3.2e6, 330 * 299792458 / length, 330, 3e9)
    return at.Lattice(17 * cell + [cavity], energy=3e9)


def test_the_gas_budget_of_spear3(ring, operation):
    losses = loss_coefficients(ring, operation, 500.0)
    assert float(losses.a_elastic) == pytest.approx(4.0088156857e-9, rel=1e-4)
    assert float(losses.b_elastic) == pytest.approx(5.0110196071e-7, rel=1e-4)
    # Nuclei alone would give 4.657e-9 and 5.821e-7; electrons add 20.02 % for nitrogen.
    assert float(losses.a_bremsstrahlung) == pytest.approx(4.657047702e-9 * 1.2001696, rel=1e-6)
    assert float(losses.b_bremsstrahlung) == pytest.approx(5.821309628e-7 * 1.2001696, rel=1e-6)
    closer = loss_coefficients(ring, operation._replace(scraper_y=3e-3), 500.0)
    assert float(closer.b_elastic) == pytest.approx(4 * float(losses.b_elastic), rel=1e-12)
    assert float(losses.a) == pytest.approx(float(sum(losses[:3])))


@pytest.mark.parametrize(("scraper", "hours"), [(3e-3, 27.716692366), (6e-3, 110.866769464)])
def test_elastic_lifetime_at_a_nanobar_of_nitrogen(scraper, hours):
    acceptance = vertical_acceptance(np.inf, scraper, 10.0)
    section = elastic_cross_section(7, 5870.853550678, 8.784466831, acceptance)
    rate = 1e-7 * gas_rate_coefficient(section, gas_mixture(N2=1), 300.0)
    # 5e-9: another year's recommended constants.
    assert 1 / float(rate) / HOUR == pytest.approx(hours, rel=1e-8)


def test_the_narrower_of_chamber_and_scraper_counts():
    assert float(vertical_acceptance(1e-6, 1e-2, 10.0)) == 1e-6


@pytest.mark.parametrize(
    ("charge", "acceptance", "section"),
    [
        (1, 0.02, 1.1856791178e-29),
        (1, 0.03, 1.0435878549e-29),
        (2, 0.03, 2.7744034042e-29),
        (6, 0.02, 2.0912878435e-28),
        (7, 0.03, 2.4131658892e-28),
        (8, 0.03, 3.0590439003e-28),
    ],
)
def test_bremsstrahlung_against_the_tsai_form(charge, acceptance, section):
    assert float(bremsstrahlung_cross_section(charge, acceptance)) == pytest.approx(
        section, rel=1e-8
    )


def test_bremsstrahlung_gives_back_the_radiation_length():
    # Energy lost in a thin layer, the integral of the cross section over the acceptance, is
    # 1/X0 (PDG's 37.99 g/cm² for nitrogen) within the 1 % by which the tip of the spectrum differs.
    acceptance = np.linspace(1e-6, 1, 200001)
    section = np.asarray(bremsstrahlung_cross_section(7, acceptance))
    stopping = np.trapezoid(section, acceptance)
    assert 14.007 / 6.02214076e23 / (stopping * 1e4) == pytest.approx(37.99, rel=0.012)


def test_gas_is_counted_by_atoms():
    gas = gas_mixture(CO=1, H2=1)
    assert dict(zip(gas.charge.tolist(), gas.atoms.tolist(), strict=True)) == {
        1.0: 1.0,
        6.0: 0.5,
        8.0: 0.5,
    }
    with pytest.raises(ValueError, match="unknown gas Xe"):
        gas_mixture(Xe=1)
    with pytest.raises(ValueError, match="not all zero"):
        gas_mixture(N2=0)


def test_quantum_loss_closes_the_budget_when_the_scraper_does(ring, operation):
    # xi = (0.2 mm)²/(10 m)/(2 · 36.1 pm) = 55.4: Sands' formula by hand.
    xi = 0.2e-3**2 / 10 / (2 * ring.emittance_y)
    by_hand = 2 * xi * np.exp(-xi) / 5.3375567706e-3
    losses = loss_coefficients(ring, operation._replace(scraper_y=0.2e-3), 500.0)
    assert float(losses.b_quantum) == pytest.approx(by_hand, rel=1e-9)
    assert float(quantum_rate(1.0, 1.0, np.inf)) == 0


def test_no_beam_below_the_energy_loss(ring, operation):
    with pytest.raises(InputError, match="no beam is stored") as caught:
        loss_coefficients(ring, operation._replace(rf_voltage=8e5), 500.0)
    assert caught.value.column == "rf_voltage_kV"
    traced = jax.jit(lambda v: loss_coefficients(ring, operation._replace(rf_voltage=v), 1.0).a)
    assert np.isnan(float(traced(8e5)))


def test_derivatives_by_every_setting(ring, operation):
    inductive = ring._replace(impedance=0.4)

    @jax.jit
    def rate(settings):
        changed = operation._replace(**settings)
        losses = loss_coefficients(inductive, changed, 300.0)
        return losses.a * 300 + losses.b

    names = ("scraper_y", "bunches", "pressure_base", "pressure_slope", "temperature")
    settings = {name: float(getattr(operation, name)) for name in names} | {"rf_voltage": 2.3e6}
    slopes = jax.jit(jax.grad(rate))(settings)
    for name, value in settings.items():
        up, down = (rate(settings | {name: value * factor}) for factor in (1.0001, 0.9999))
        assert float(slopes[name]) == pytest.approx(float(up - down) / (2e-4 * value), rel=1e-5)


def test_a_fill_pattern_loses_as_its_number_of_equal_bunches():
    """Bunch by bunch, dI_k/dt = -k I_k², against the one equation for the ring."""
    currents = np.array([2.0] * 240 + [20.0] + [0.0] * 131)
    by_bunch = np.sum(1e-6 * currents**2)
    total = currents.sum()
    assert 1e-6 / equal_bunches(currents) * total**2 == pytest.approx(by_bunch, rel=1e-14)
    assert equal_bunches(np.full(280, 0.3)) == pytest.approx(280)
