from pathlib import Path

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.ring import read_operation, read_ring, read_ring_tables, ring_from_pyat
from beamfit.lifetime.mechanisms import loss_coefficients

SPEAR3 = Path("lattices/spear3_2003.toml")
CIRCUMFERENCE = 234.1440122400003


def changed(folder, old, new):
    text = SPEAR3.read_text().replace(
        "spear3_2003_twiss.csv", str(SPEAR3.absolute().parent) + "/spear3_2003_twiss.csv"
    )
    assert old in text
    path = folder / "ring.toml"
    path.write_text(text.replace(old, new))
    return path


def test_spear3_in_si():
    ring, operation = read_ring(SPEAR3), read_operation(SPEAR3)
    assert (ring.energy, ring.harmonic) == (3e9, 372)
    assert ring.energy_loss == pytest.approx(877974.1210795)
    assert ring.emittance_y == pytest.approx(3.6104833635e-11)
    assert float(ring.optics.average(ring.optics.beta_y)) == pytest.approx(8.784466831, rel=1e-4)
    assert ring.optics.beta_y.max() == pytest.approx(18.8863, rel=1e-3)
    assert ring.optics.weight.sum() == pytest.approx(1)
    assert (operation.scraper_y, operation.bunches) == (6e-3, 280)
    assert operation.pressure_slope == 1.6e-10


def test_averages_stand_for_a_table(tmp_path):
    # A lifetime from averages is rough: within a third of that from the table.
    averages = "beta_x_m = 5.7\nbeta_y_m = 8.78\ndispersion_x_m = 0.057"
    path = changed(
        tmp_path, f'twiss = "{SPEAR3.absolute().parent}/spear3_2003_twiss.csv"', averages
    )
    rates = [
        float(loss_coefficients(read_ring(ring), read_operation(SPEAR3), 500.0).a_touschek)
        for ring in (path, SPEAR3)
    ]
    assert rates[0] == pytest.approx(rates[1], rel=0.33)


@pytest.mark.parametrize(
    ("old", "new", "column", "words"),
    [
        ("energy_GeV = 3.0\n", "", "energy_GeV", "the key is missing"),
        ("energy_GeV", "energie_GeV", "energie_GeV", "did you mean energy_GeV?"),
        ("coupling = 0.002", 'coupling = "low"', "coupling", "'low'; expected a number"),
        ("coupling = 0.002", "coupling = -1", "coupling", "a positive number"),
        ("coupling = 0.002\n", "", "coupling", "neither of emittance_y_nm and coupling"),
        ("coupling = 0.002", "coupling = 0.002\nemittance_y_nm = 1", "coupling", "both of"),
        ("rf_voltage_kV = 3200.0", "rf_voltage_kV = 800", "rf_voltage_kV", "no beam is stored"),
        ("N2 = 1.0", "Xe = 1.0", "gas", "unknown gas Xe"),
        ("N2 = 1.0", "N2 = -1.0", "gas", "must not be negative"),
        ("[optics]\n", "[optics]\nbeta_x_m = 3\n", "twiss", "averages beside a table"),
        ("circumference_m = 234", "circumference_m = 250", "s_m", "a whole fraction of it"),
        ("[ring]", "[ring", None, "a ring file in TOML"),
        ("[acceptance]", "[aceptance]", "aceptance", "did you mean acceptance?"),
        ("energy_spread = 0.0009", "energy_spread = nan #", "energy_spread", "toml:11:"),
        ("gas]\nN2 = 1.0", "gas.x]\nN2 = 1.0", "gas", "partial pressures"),
        ("N2 = 1.0", "Xe = 1.0", "gas", "toml:32:"),
    ],
)
def test_bad_rings_are_named_by_key(tmp_path, old, new, column, words):
    path = changed(tmp_path, old, new)
    with pytest.raises(InputError) as caught:
        loss_coefficients(read_ring(path), read_operation(path), 500.0)
    assert words in str(caught.value)
    assert caught.value.column == column
    assert str(caught.value.path).endswith(("ring.toml", ".csv"))


def test_a_missing_ring_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_ring(tmp_path / "none.toml")


def test_csv_and_tfs_hold_the_same_optics(tmp_path):
    optics = read_ring_tables(CIRCUMFERENCE, Path("lattices/spear3_2003_twiss.csv"), None)[0]
    table = np.loadtxt("lattices/spear3_2003_twiss.csv", delimiter=",", skiprows=3)
    names = "S BETX BETY ALFX ALFY DX DPX"
    rows = "\n".join('"D" ' + " ".join(f"{value:.9e}" for value in row) for row in table)
    tfs = tmp_path / "ring.tfs"
    tfs.write_text(f'@ NAME %05s "TWISS"\n* NAME {names}\n$ %s{" %le" * 7}\n{rows}\n')
    for ours, other in zip(optics, read_ring_tables(CIRCUMFERENCE, tfs, None)[0], strict=True):
        np.testing.assert_allclose(other, ours, rtol=1e-8, atol=1e-15)


@pytest.mark.parametrize(
    ("row", "value", "line", "words"),
    [
        (5, "1.0,-1,1,0,0,0,0", 6, "-1"),
        (4, "0,x,1,0,0,0,0", 5, "'x'"),
        (3, "9,1,1,0,0,0,0", 5, "s falls"),
    ],
)
def test_bad_tables_are_named_by_line(tmp_path, row, value, line, words):
    text = Path("lattices/spear3_2003_twiss.csv").read_text().splitlines()
    text[row] = value
    path = tmp_path / "twiss.csv"
    path.write_text("\n".join(text))
    with pytest.raises(InputError) as caught:
        read_ring_tables(CIRCUMFERENCE, path, None)
    assert words in str(caught.value)
    assert caught.value.line == line


def test_a_table_without_a_column(tmp_path):
    path = tmp_path / "twiss.csv"
    path.write_text("s_m,beta_x_m\n0,1\n")
    with pytest.raises(InputError, match="'beta_y_m'"):
        read_ring_tables(CIRCUMFERENCE, path, None)


def test_a_pyat_lattice_without_enough_voltage():
    at = pytest.importorskip("at")
    bend = at.Dipole("B", 1.0, 2 * np.pi / 8, 0.0)
    cell = [at.Quadrupole("F", 0.3, 1.2), bend, at.Quadrupole("D", 0.3, -1.2), bend]
    cavity = at.RFCavity("RF", 0.0, 1e3, 3.5e8, 12, 3e9)
    with pytest.raises(InputError, match="no beam is stored"):
        ring_from_pyat(at.Lattice([*4 * cell, cavity], energy=3e9), coupling=0.01)
