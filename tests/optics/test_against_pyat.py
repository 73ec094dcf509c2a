"""Cross-code: whole lines against pyAT's own tracking-derived matrices."""

import numpy as np
import pytest

from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Quadrupole, Screen, SectorDipole

at = pytest.importorskip("at", reason="accelerator-toolbox is not installed")


def pyat_matrix(elements):
    ring = at.Lattice(elements, energy=1e9, periodicity=1)
    matrix, _ = at.find_m66(ring, orbit=np.zeros(6))
    return matrix


def beamfit_matrix(elements):
    r = Beamline((*elements, Screen("S")), energy=1000.0).matrix()
    return np.asarray(r.x), np.asarray(r.y)


@pytest.mark.parametrize("k1", [-12.0, -0.5, 0.5, 12.0])
def test_quadrupole_line(k1):
    theirs = pyat_matrix([at.Quadrupole("Q", 0.2, k1, NumIntSteps=200), at.Drift("D", 1.7)])
    x, y = beamfit_matrix([Quadrupole("Q", 0.2, k1), Drift("D", 1.7)])
    np.testing.assert_allclose(x[:2, :2], theirs[:2, :2], atol=2e-7)
    np.testing.assert_allclose(y[:2, :2], theirs[2:4, 2:4], atol=2e-7)


@pytest.mark.parametrize("k1", [0.0, 1.3])
@pytest.mark.parametrize("edges", [(0.0, 0.0), (0.05, 0.21)])
def test_dipole_with_edges_gradient_and_dispersion(edges, k1):
    length, angle = 0.6, 0.35
    bend = at.Dipole(
        "B", length, angle, k1, EntranceAngle=edges[0], ExitAngle=edges[1], NumIntSteps=200
    )
    theirs = pyat_matrix([bend, at.Drift("D", 0.9)])
    x, y = beamfit_matrix(
        [SectorDipole("B", length / angle, angle, *edges, k1=k1), Drift("D", 0.9)]
    )
    np.testing.assert_allclose(x[:2, :2], theirs[:2, :2], atol=1e-6)
    np.testing.assert_allclose(y[:2, :2], theirs[2:4, 2:4], atol=1e-6)
    np.testing.assert_allclose(x[:2, 2], theirs[:2, 4], atol=1e-6)
