"""Scans with a known answer."""

import numpy as np
import pytest

import beamfit

TABLE_2 = np.array([2.62035, 1.55237, 1.40828]) * 1e-8  # report, table 2, first row, SI


def design(line, settings, plane="x", screen=None):
    """Coefficients of σ11, σ12, σ22, one row a setting, by calls outside the fit's own code."""
    part = line.upto(screen) if screen else line
    rows = []
    for i in range(len(next(iter(settings.values())))):
        r = np.asarray(getattr(part.matrix({n: v[i] for n, v in settings.items()}), plane))
        rows.append([r[0, 0] ** 2, 2 * r[0, 0] * r[0, 1], r[0, 1] ** 2])
    return np.array(rows)


@pytest.fixture(scope="session")
def gtf(root):
    return beamfit.load_lattice(root / "lattices/gtf.toml")


@pytest.fixture(scope="session")
def otr2(root):
    return beamfit.load_lattice(root / "lattices/lcls_otr2.toml")


@pytest.fixture(scope="session")
def three_quads(root):
    return beamfit.load_lattice(root / "lattices/three_quads.toml")


@pytest.fixture(scope="session")
def gtf_sizes(gtf):
    """Currents, design rows and exact sizes of the report's beam at its 14 currents."""
    currents = np.linspace(0.0, 3.9, 14)
    rows = design(gtf, {"Q2": currents})
    return currents, rows, np.sqrt(rows @ TABLE_2)


def scan_of(magnet, unit, settings, sizes, relative=0.02, seed=None, errors=True):
    """A scan of one magnet in plane x, with normal noise if a seed is given."""
    true = np.asarray(sizes)
    noise = 0.0 if seed is None else np.random.default_rng(seed).normal(size=len(true))
    measured = true * (1.0 + relative * noise)
    error = {"x": relative * true} if errors else {}
    return beamfit.QuadScan({magnet: settings}, {magnet: unit}, {"x": measured}, error)
