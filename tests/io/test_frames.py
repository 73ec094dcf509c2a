"""pandas in the place of files, and out of results."""

import sys

import numpy as np
import pytest

import beamfit
from beamfit.errors import InputError

pandas = pytest.importorskip("pandas")

FRAME = {"Q2_A": [0.0, 1.0, 2.0, 3.0], "size_x_um": [200, 120, 150, 260.0]}


@pytest.mark.parametrize("name", ["gtf_two_screens_simulated", "lcls_otr2"])
def test_a_frame_is_read_as_its_file(root, name):
    path = root / f"measurements/{name}.csv"
    frame = pandas.read_csv(path, comment="#")
    frame.attrs["name"] = name
    found, file = beamfit.read_quad_scan(frame), beamfit.read_quad_scan(path)
    assert found.name == file.name
    again = beamfit.read_quad_scan(found.to_frame())
    for plane in file.planes:
        for scan in (found, again):
            a, b = scan.rows(plane), file.rows(plane)
            np.testing.assert_allclose(a.size, b.size, rtol=1e-14)
            np.testing.assert_allclose(a.error, b.error, rtol=1e-14)
            assert a.screen == b.screen
            for magnet, values in b.settings.items():
                np.testing.assert_array_equal(a.settings[magnet], values)


def test_blank_and_bad_cells_are_those_of_a_file():
    half = pandas.DataFrame(FRAME | {"size_y_um": [100.0, None, 120.0, 90.0]})
    assert np.isnan(beamfit.read_quad_scan(half).size["y"][1])
    bad = pandas.DataFrame(FRAME | {"size_x_um": [200, "x", 150, 260]})
    with pytest.raises(InputError, match=r"frame: column 'size_x_um': reading 2: 'x'"):
        beamfit.read_quad_scan(bad)
    assert len(beamfit.read_quad_scan(bad, skip_bad=True)) == 3
    with pytest.raises(InputError, match="columns without names"):
        beamfit.read_quad_scan(pandas.DataFrame([[1.0, 2.0]]))
    with pytest.raises(InputError, match="without columns"):
        beamfit.read_quad_scan(pandas.DataFrame())
    few = pandas.DataFrame(FRAME).iloc[:2]
    with pytest.raises(InputError, match="2 distinct settings"):
        beamfit.read_quad_scan(few)


def test_a_record_goes_to_a_frame_and_back(root):
    record = beamfit.read_decay_record(root / "measurements/spear3_shift_simulated.csv")
    again = beamfit.read_decay_record(record.to_frame())
    np.testing.assert_allclose(again.current, record.current)
    np.testing.assert_allclose(again.time, record.time)
    np.testing.assert_allclose(again.conditions.rf_voltage, record.conditions.rf_voltage)


def test_numbers_of_fits(root):
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    fit = beamfit.fit_emittance(scan, beamfit.load_lattice(root / "lattices/lcls_otr2.toml"))
    frame = fit.to_frame()
    assert frame.loc[("y", "emittance"), "value"] == fit.y.emittance.value
    assert frame.loc[("x", "screen_beta"), "error"] == fit.x.screen.beta.error
    assert frame.loc[("x", "beta"), "low_95"] == fit.x.beta.interval_95[0]
    assert np.isnan(frame.loc[("x", "rms_residual"), "error"])
    assert frame.loc[("x", "sigma11"), "unit"] == "m^2"
    decay = beamfit.fit_decay(beamfit.read_decay_record(root / "measurements/aps_1999_decay.csv"))
    assert decay.to_frame().loc[("aps_1999_decay.csv", "a"), "error"] == decay.a.error
    draws = decay.sample(seed=1, target_ess=50)
    assert draws.to_frame()["lifetime_mean"].median() == pytest.approx(draws["lifetime_mean"].value)


def test_without_pandas_it_is_said(monkeypatch):
    scan = beamfit.QuadScan({"Q": [0, 1, 2.0]}, {"Q": "k1"}, {"x": [1e-4, 2e-4, 3e-4]})
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match=r"pip install 'beamfit\[pandas\]'"):
        scan.to_frame()
