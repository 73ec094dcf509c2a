"""What a ring file says of bunches and apertures, each against an independent reference."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import gamma

from beamfit.errors import InputError
from beamfit.io.decay_record import read_decay_record
from beamfit.io.ring import read_operation, read_ring
from beamfit.lifetime.mechanisms import elastic_cross_section, loss_coefficients, piwinski_rate
from beamfit.lifetime.ring import (
    HarmonicCavity,
    bunch_in_bucket,
    length_and_height,
    population,
    stored_bunch,
)
from beamfit.lifetime.study import Machine, budget, operation_during
from tests.lifetime.test_mechanisms import spear3_cells

SPEAR3 = Path("lattices/spear3_2003.toml")


@pytest.fixture(scope="module")
def ring():
    return read_ring(SPEAR3)


@pytest.fixture(scope="module")
def operation():
    return read_operation(SPEAR3)


def averages(**changed):
    """A ring file of averages: quick. Keys of any table may be changed; None leaves one out."""
    text = SPEAR3.read_text().replace(
        'twiss = "spear3_2003_twiss.csv"',
        "beta_x_m = 5.7\nbeta_y_m = 8.78\ndispersion_x_m = 0.057",
    )
    lines = text.splitlines()
    for key, value in changed.items():
        [at] = [n for n, line in enumerate(lines) if line.startswith(f"{key} ")]
        lines[at] = "" if value is None else f"{key} = {value}"
    return "\n".join(lines)


def written(folder, text):
    path = folder / "ring.toml"
    path.write_text(text)
    return path


def by_quadrature(ring, voltage, cavity):
    """Rms length and bucket height from the force and two integrals of scipy."""
    number, other, phase = cavity
    main = np.pi - np.arcsin((ring.energy_loss - other * np.sin(phase)) / voltage)
    unit = ring.momentum_compaction * ring.energy_spread**2 * ring.energy
    unit *= 2 * np.pi * ring.harmonic

    def force(x):
        gain = voltage * np.sin(main + x) + other * np.sin(number * x + phase)
        return (gain - ring.energy_loss) / unit

    left = brentq(force, -1.2 * (2 * main - np.pi), -0.5)
    grid = np.linspace(left, 2.0, 400)
    well = {x: quad(force, 0, x, epsabs=1e-13)[0] for x in (left, *grid)}
    right = brentq(lambda x: quad(force, 0, x)[0] - well[left], 0.3, 3.0)
    top = max(well.values())
    moments = [
        quad(
            lambda x, k=k: x**k * np.exp(quad(force, 0, x, epsabs=1e-13)[0] - top),
            max(left, -0.9), min(right, 0.9), points=[0], epsabs=1e-12,
        )[0]
        for k in range(3)
    ]  # fmt: skip
    mean = moments[1] / moments[0]
    rms = np.sqrt(moments[2] / moments[0] - mean**2)
    length = rms * ring.circumference / (2 * np.pi * ring.harmonic)
    return length, ring.energy_spread * np.sqrt(2 * (top - well[left]))


@pytest.mark.parametrize("cavity", [(3, 0.0, 0.0), (3, 0.6e6, -0.2), (4, 0.5e6, np.pi)])
def test_a_second_rf_system_against_quadrature(ring, cavity):
    length, height = by_quadrature(ring, 3.2e6, cavity)
    found = length_and_height(ring, 3.2e6, HarmonicCavity(*cavity))
    assert [float(part) for part in found] == pytest.approx([length, height], rel=1e-5)


def test_without_voltage_a_second_system_is_none(ring):
    cold = ring._replace(energy_spread=1e-2 * ring.energy_spread, momentum_acceptance=np.inf)
    none = length_and_height(cold, 3.2e6, HarmonicCavity(3, 0.0, 0.0))
    np.testing.assert_allclose(none, bunch_in_bucket(cold, 3.2e6, 0.0), rtol=1e-5)


def test_the_flat_potential_is_a_quartic(ring):
    """Force and its slope zero at the bunch: Hofmann and Myers' ideal phases and voltage."""
    number, voltage = 3, 3.2e6
    cold = ring._replace(energy_spread=1e-2 * ring.energy_spread)
    sine = number**2 / (number**2 - 1) * ring.energy_loss / voltage
    slope = voltage * np.sqrt(1 - sine**2)
    along, across = slope / number, -ring.energy_loss / (number**2 - 1)
    ideal = HarmonicCavity(number, np.hypot(along, across), np.arctan2(across, along))
    found = float(length_and_height(cold, voltage, ideal)[0])
    turn = 2 * np.pi * cold.harmonic
    spread2 = turn * cold.momentum_compaction * cold.energy_spread**2 * cold.energy / slope
    quartic = np.sqrt(24 * spread2 / (number**2 - 1))
    expected = np.sqrt(quartic * gamma(0.75) / gamma(0.25)) * cold.circumference / turn
    assert found == pytest.approx(expected, rel=2e-3)


def test_every_bunch_of_a_fill_pattern_counts_by_its_own_length(ring, tmp_path):
    charges = [1.0] * 60 + [0.0] * 20 + [12.0, 3.0]
    text = averages(bunches=charges).replace("[acceptance]", "impedance_ohm = 0.4\n[acceptance]")
    path = written(tmp_path, text)
    ring, operation = read_ring(path), read_operation(path)
    share = np.array(charges)[np.array(charges) > 0] / np.sum(charges)
    assert float(operation.bunches) == pytest.approx(1 / np.sum(share**2))
    lost = 0.0
    for part in share:
        bunch = bunch_in_bucket(ring, 3.2e6, 500.0 * part)
        rate = piwinski_rate(ring, population(ring, 500.0 * part), bunch.length, bunch.acceptance)
        lost += part * float(rate)
    assert float(loss_coefficients(ring, operation, 500.0).a_touschek) * 500 == pytest.approx(lost)


def test_lengths_that_are_given(ring, operation, tmp_path):
    def length(keys, current=500.0, **changed):
        text = averages().replace("bunches = 280", f"bunches = 280\n{keys}")
        path = written(tmp_path, text)
        return 1e3 * float(
            stored_bunch(read_ring(path), read_operation(path)._replace(**changed), current).length
        )

    table = "bunch_length_mm = [5, 6, 8]\nbunch_current_mA = [0, 1, 2]"
    assert length("bunch_length_mm = 6.5") == pytest.approx(6.5)
    assert [length(table, 280.0 * i) for i in (0, 0.5, 1, 1.5, 3)] == pytest.approx(
        [5, 5.5, 6, 7, 8]
    )
    law = "bunch_length_mm = 6\nbunch_current_mA = 0.5\nbunch_length_exponent = 0.333"
    assert length(law, 100.0) == pytest.approx(6)
    assert length(law, 280.0 * 4) == pytest.approx(6 * 8**0.333)
    shorter = float(bunch_in_bucket(ring, 2e6, 0.0).length / bunch_in_bucket(ring, 3.2e6, 0).length)
    assert length("bunch_length_mm = 6.5", rf_voltage=2e6) == pytest.approx(6.5 * shorter)
    stretched = "[operation.harmonic_cavity]\nstretch = 2.0\n[operation.gas]"
    path = written(tmp_path, averages().replace("[operation.gas]", stretched))
    plain = stored_bunch(ring, operation, 500.0).length
    assert stored_bunch(read_ring(path), read_operation(path), 500.0).length == 2 * plain


def test_a_harmonic_cavity_of_a_file_prolongs_the_lifetime(ring, operation, tmp_path):
    cavity = "[operation.harmonic_cavity]\nnumber = 3\nvoltage_kV = 600\nphase_deg = -6\n"
    path = written(tmp_path, averages().replace("[operation.gas]", f"{cavity}[operation.gas]"))
    with_it, without = read_operation(path), read_operation(written(tmp_path, averages()))
    assert with_it.harmonic_cavity.phase == pytest.approx(-np.pi / 30)
    machine = read_ring(path)
    longer = (
        stored_bunch(machine, with_it, 500.0).length / stored_bunch(machine, without, 1.0).length
    )
    rates = [float(loss_coefficients(machine, o, 500.0).a_touschek) for o in (with_it, without)]
    assert rates[1] / rates[0] == pytest.approx(float(longer), rel=1e-9)
    assert longer > 1.3

    def length(v):
        return stored_bunch(machine, with_it._replace(rf_voltage=v), 1.0).length

    up = float(jax.jit(jax.grad(length))(3.2e6))
    pair = [length(v) for v in (3.21e6, 3.19e6)]
    assert up == pytest.approx(float(pair[0] - pair[1]) / 2e4, rel=1e-3)


def test_a_record_brings_its_bunch_length(ring, operation, tmp_path):
    found = []
    for column, value in (("bunch_length_mm", 7.5), ("bunch_length_ps", 25.017307)):
        path = tmp_path / "decay.csv"
        rows = "".join(f"{t},{500 - t * 1e-3},{value}\n" for t in range(0, 60, 10))
        path.write_text(f"time_s,beam_current_mA,{column}\n{rows}")
        record = read_decay_record(path)
        said = operation_during(record, Machine(ring, operation))
        assert float(stored_bunch(ring, said, 500.0).length) == pytest.approx(7.5e-3, rel=1e-6)
        found.append(budget(record, Machine(ring, operation)).bunch_length)
    assert found == pytest.approx([7.5e-3] * 2)
    path.write_text(path.read_text().replace("bunch_length_ps", "bunch_length_m"))
    with pytest.raises(InputError, match="check the unit"):
        read_decay_record(path)


def test_apertures_that_differ_up_and_down_against_pyat():
    at = pytest.importorskip("at")
    from beamfit.io.ring import ring_from_pyat

    lattice = spear3_cells(at)
    ring = ring_from_pyat(lattice, coupling=0.002)
    flat = lattice.disable_6d(copy=True)
    cell = np.flatnonzero([element.Length > 0 for element in flat])[:15]
    names = {"emitx": ring.emittance_x, "sigs": 5e-3, "sigp": ring.energy_spread}
    up, down = np.linspace(0.02, 0.03, 15), np.linspace(0.018, 0.012, 15)
    seconds, _, _ = at.get_lifetime(
        flat, ring.emittance_y, 1e-3, momap=np.stack([up, -down], axis=1), refpts=cell,
        interpolate=False, **names,
    )  # fmt: skip
    share = ring.optics.weight[:15] / ring.optics.weight[:15].sum()
    first = ring.optics._make(values[:15] for values in ring.optics)._replace(weight=share)
    rate = piwinski_rate(
        ring._replace(optics=first), population(ring, 1.0), 5e-3, np.stack([up, down])
    )
    assert 1 / float(rate) == pytest.approx(seconds, rel=3e-5)


def test_apertures_of_a_table_and_of_one_number_are_the_same(ring, operation, tmp_path):
    """Whatever the sign of the lower one; photons see the lower one alone."""
    table = tmp_path / "apertures.csv"
    name = f'twiss = "{SPEAR3.absolute().parent}/spear3_2003_twiss.csv"'
    text = SPEAR3.read_text().replace('twiss = "spear3_2003_twiss.csv"', name)
    text = text.replace("momentum = 0.03", 'momentum_table = "apertures.csv"')
    path = written(tmp_path, text)
    plain = [
        loss_coefficients(ring._replace(momentum_acceptance=limit), operation, 500.0)
        for limit in (0.03, 0.02)
    ]
    end = 234.1440122400003 / 4
    for down in (-0.03, -0.02):
        table.write_text(
            f"s_m,delta_plus,delta_minus\n0,0.03,{down}\n20,0.03,{down}\n{end},0.03,{down}\n"
        )
        found = loss_coefficients(read_ring(path), operation, 500.0)
        lower = plain[0 if down == -0.03 else 1]
        both = (plain[0].a_touschek + lower.a_touschek) / 2
        assert float(found.a_touschek) == pytest.approx(float(both), rel=1e-12)
        assert float(found.b_bremsstrahlung) == pytest.approx(float(lower.b_bremsstrahlung))
    for rows, words in (
        (f"0,0.03,-3\n{end},0.03,-3", "a share between 0 and 1"),
        (f"0,0.03,-0.03\n{2 * end},0.03,-0.03", "that of the optics"),
    ):
        table.write_text(f"s_m,delta_plus,delta_minus\n{rows}\n")
        with pytest.raises(InputError, match=words) as caught:
            read_ring(path)
        assert str(caught.value.path).endswith("apertures.csv")


@pytest.mark.parametrize("ratio", [1e-6, 0.3, 1.0, 5.0])
def test_electrons_leave_one_plane_or_the_other(ratio):
    """Rutherford's law integrated over azimuth and angle beyond the nearer limit."""
    limit_y = 1e-4
    limit_x = limit_y / np.sqrt(ratio)

    def beyond(azimuth):
        nearer = max(abs(np.cos(azimuth)) / limit_x, abs(np.sin(azimuth)) / limit_y)
        return nearer**2 / 2

    corner = np.arctan(limit_y / limit_x)
    azimuths = 4 * quad(beyond, 0, np.pi / 2, points=[corner])[0]
    one = float(elastic_cross_section(7, 5870.85, 1.0, limit_y**2))
    both = float(elastic_cross_section(7, 5870.85, 1.0, limit_y**2, 1.0, limit_x**2))
    assert both / one == pytest.approx(azimuths / (np.pi / 2 / limit_y**2), rel=1e-9)
    if ratio == 1.0:
        assert both / one == pytest.approx((np.pi + 2) / np.pi, rel=1e-12)


def test_a_horizontal_acceptance_is_read_and_shortens_the_lifetime(ring, operation, tmp_path):
    path = written(tmp_path, averages().replace("momentum = 0.03", "horizontal_mm_mrad = 3.6"))
    narrow = read_ring(path)
    assert narrow.acceptance_x == pytest.approx(3.6e-6)
    wide = narrow._replace(acceptance_x=np.inf)
    rates = [float(loss_coefficients(r, operation, 500.0).b_elastic) for r in (narrow, wide)]
    assert 1.1 < rates[0] / rates[1] < 1 + 5.7 / 8.78 * 1.0001
    slope = jax.jit(
        jax.grad(lambda y: loss_coefficients(wide, operation._replace(scraper_y=y), 5.0).b_elastic)
    )
    assert float(slope(6e-3)) == pytest.approx(-2 * rates[1] / 6e-3, rel=1e-6)


@pytest.mark.parametrize(
    ("changed", "column", "words"),
    [
        ({"momentum": 3}, "momentum", "a share: up to 1, 0.03 for 3 %"),
        ({"momentum_compaction": -1e-3}, "momentum_compaction", "a positive number between"),
        ({"emittance_x_nm": 0}, "emittance_x_nm", "a positive number"),
        ({"emittance_x_nm": -18}, "emittance_x_nm", "a positive number"),
        ({"coupling": 1.2}, "coupling", "a share"),
        ({"energy_spread": 0}, "energy_spread", "a positive number"),
        ({"energy_loss_keV": 4e6}, "energy_loss_keV", "less than the energy"),
        ({"rf_voltage_kV": 3.2e6}, "rf_voltage_kV", "more|less than the beam's energy"),
        ({"bunches": 400}, "bunches", "1 to 372, the harmonic number"),
        ({"bunches": "[0, 0]"}, "bunches", "2 bunches, 0 filled"),
        ({"bunches": "[1, -1]"}, "bunches", "the charge of each"),
        ({"bunches": '"many"'}, "bunches", "a number or a list of numbers"),
        ({"temperature_K": 0}, "temperature_K", "a positive number"),
        ({"bunches": "280\nbunch_length_mm = [1, 2]"}, "bunch_length_mm", "2 lengths at 1 bunch"),
        ({"bunches": "280\nbunch_current_mA = 1"}, "bunch_current_mA", "without bunch_length_mm"),
        (
            {"bunches": "280\nbunch_length_mm = 5\nbunch_length_exponent = 0.3"},
            "bunch_length_exponent",
            "without a current",
        ),
        (
            {"coupling": "0.002\nimpedance_ohm = 0.4", "bunches": "280\nbunch_length_mm = 5"},
            "bunch_length_mm",
            "beside impedance_ohm",
        ),
    ],
)
def test_what_no_ring_has_is_refused_by_key(tmp_path, changed, column, words):
    path = written(tmp_path, averages(**changed))
    with pytest.raises(InputError, match=words) as caught:
        read_ring(path), read_operation(path)
    assert caught.value.column == column
    assert column in path.read_text().splitlines()[caught.value.line - 1]


BARE = averages().replace("momentum = 0.03", "").replace("scraper_y_mm = 6.0", "")
NUMBERS = [line.split(" = ")[0] for line in BARE.splitlines() if " = " in line][1:-1]


@given(
    key=st.sampled_from(NUMBERS),
    value=st.one_of(st.floats(), st.floats(-9, 9).map(lambda x: 10.0**x), st.integers(-2, 9)),
    bare=st.booleans(),
)
@example(key="bunches", value=280, bare=True)
@settings(deadline=None, max_examples=300, derandomize=True)
def test_a_ring_with_a_key_changed_is_refused_or_has_losses(tmp_path_factory, key, value, bare):
    text = re.sub(rf"(?m)^{key} = .*", f"{key} = {value}", BARE if bare else averages())
    path = written(tmp_path_factory.getbasetemp(), text)
    try:
        ring, operation = read_ring(path), read_operation(path)
    except InputError:
        return
    losses = loss_coefficients(ring, operation, 500.0)
    assert np.isfinite(list(losses)).all(), losses
    assert min(losses) >= 0, losses
