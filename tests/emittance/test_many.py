"""Many scans in one call give what each gives alone."""

import math
from dataclasses import replace

import numpy as np
import pytest

import beamfit
from beamfit.emittance.fit import fit_many


def same(one, other, where=""):
    """Values equal to 1e-9, words to the letter."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, list):
        assert len(one) == len(other)
        for i, pair in enumerate(zip(one, other, strict=True)):
            same(*pair, f"{where}[{i}]")
    elif isinstance(one, float) and isinstance(other, float):
        assert math.isclose(one, other, rel_tol=1e-9), (where, one, other)
    else:
        assert one == other, where


@pytest.fixture(scope="module")
def line(root):
    return beamfit.load_lattice(root / "lattices/lcls_otr2.toml")


@pytest.fixture(scope="module")
def scans(root):
    """Errors of shots, none (of both kinds), sizes that are noise, another number of rows."""
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    bare = replace(scan, error={}, shots=None)
    rng, found = np.random.default_rng(3), []
    for of in (scan, bare, scan, bare):
        size = {p: v * (1 + 0.02 * rng.standard_normal(len(v))) for p, v in scan.size.items()}
        found.append(replace(of, size=size))
    found.append(replace(bare, size={"x": 1e-4 * (1 + 0.1 * rng.standard_normal(5))}))
    fine = np.linspace(-4.2, -1.0, 12)
    law = np.polyfit(scan.settings["Q525"], scan.size["x"] ** 2, 2)
    for absolute in (0.0, 2e-6):
        sizes = np.sqrt(np.polyval(law, fine)) * (1 + 0.02 * rng.standard_normal(12))
        sizes += absolute * rng.standard_normal(12)
        found.append(replace(bare, settings={"Q525": fine}, size={"x": sizes}))
    return found


def test_many_scans_together_are_each_alone(scans, line):
    for together, scan in zip(fit_many((scan, line) for scan in scans), scans, strict=True):
        alone = beamfit.fit_emittance(scan, line)
        same(together.to_json(), alone.to_json())
        assert together.notes == alone.notes


def test_a_scan_of_another_magnet_stops_no_other(scans, line):
    wrong = replace(scans[0], settings={"Q9": scans[0].settings["Q525"]}, units={"Q9": "kG"})
    found = fit_many([(wrong, line), (scans[0], line)])
    assert isinstance(found[0], beamfit.InputError)
    assert "Q9" in str(found[0])
    assert found[1].x.status.value == beamfit.fit_emittance(scans[0], line).x.status.value
