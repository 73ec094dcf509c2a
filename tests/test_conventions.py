"""docs/conventions.md: each sign and unit, held against what is written out here."""

import numpy as np
import pytest

import beamfit
from beamfit.optics.calibration import IntegratedGradient, SlopeIntercept
from beamfit.optics.elements import Drift, Quadrupole, SectorDipole


def test_a_beam_of_positive_alpha_converges_and_twiss_are_those_of_the_page():
    beam = beamfit.BeamMatrix.from_twiss(emittance=2e-9, beta=3.0, alpha=0.7)
    l11, l21, l22 = (float(v) for v in (beam.l11, beam.l21, beam.l22))
    sigma = np.array([[l11**2, l11 * l21], [l11 * l21, l21**2 + l22**2]])
    gamma = (1 + 0.7**2) / 3.0
    np.testing.assert_allclose(sigma, 2e-9 * np.array([[3.0, -0.7], [-0.7, gamma]]), rtol=1e-12)
    later = beam.transport(Drift("D", 0.01).matrix().x)
    assert float(later.l11) < l11
    assert float(beam.mismatch(beam)) == pytest.approx(1.0)


def test_positive_settings_focus_x():
    momentum = np.sqrt(135.0**2 - 0.51099895**2)
    lens = Quadrupole("Q", 0.1, 1.0, IntegratedGradient()).matrix(energy=135.0)
    assert float(lens.x[1, 0]) < 0 < float(lens.y[1, 0])
    strength = float(IntegratedGradient().k1l(1.0, 0.1, 135.0))
    assert strength == pytest.approx(0.1 * 299.792458 / momentum, rel=1e-9)
    strength = float(SlopeIntercept(160.0, 40.0).k1l(2.0, 0.1, 30.0))
    assert strength == pytest.approx(0.1 * (160.0 * 2.0 + 40.0) / 30.0)


def test_a_positive_bend_disperses_to_positive_x_and_positive_edges_defocus_it():
    plain = SectorDipole("B", 2.0, 0.3).matrix()
    edged = SectorDipole("B", 2.0, 0.3, 0.1, 0.1).matrix()
    assert float(plain.x[0, 2]) > 0
    assert float(edged.x[1, 0]) > float(plain.x[1, 0])
    assert float(edged.y[1, 0]) < float(plain.y[1, 0])


def test_units_and_the_sign_of_a_pull(root):
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    fit = beamfit.fit_emittance(scan, beamfit.load_lattice(root / "lattices/lcls_otr2.toml"))
    said = fit.x.to_json()
    units = {name: said[name]["unit"] for name in ("emittance", "sigma11", "sigma12", "sigma22")}
    assert units == {"emittance": "m", "sigma11": "m^2", "sigma12": "m rad", "sigma22": "rad^2"}
    pulls = (fit.x.points.size - fit.x.points.model) / fit.x.points.error
    np.testing.assert_allclose(np.sign(fit.x.points.pull), np.sign(pulls))
    decay = beamfit.fit_decay(beamfit.read_decay_record(root / "measurements/aps_1999_decay.csv"))
    assert (decay.a.unit, decay.b.unit, decay.lifetime_mean.unit) == ("1/(mA s)", "1/s", "h")
    rate = decay.a.value * decay.mean_current + decay.b.value
    assert decay.lifetime_mean.value == pytest.approx(1 / rate / 3600)
