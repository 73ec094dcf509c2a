"""Slices of a beam in a spectrometer that stays, against transport written out by hand.

The scans are SIMULATED by measurements/make_gtf_slices.py, which has no beamfit in it.
"""

import importlib.util
import json
from dataclasses import replace

import numpy as np
import pytest

import beamfit
from beamfit.emittance.slices import fit_slices
from beamfit.emittance.transport import scanned_line
from beamfit.errors import InputError
from beamfit.io.result import read_fitted_beams, results_text
from beamfit.optics.elements import Drift, Quadrupole, Screen
from beamfit.particles import rigidity
from beamfit.report.page import write_report


@pytest.fixture(scope="module")
def made(root):
    path = root / "measurements/make_gtf_slices.py"
    spec = importlib.util.spec_from_file_location("make_gtf_slices", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scan(root):
    return beamfit.read_quad_scan(root / "measurements/gtf_slices_simulated.csv")


@pytest.fixture(scope="module")
def line(root):
    return beamfit.load_lattice(root / "lattices/gtf.toml")


@pytest.fixture(scope="module")
def fits(scan, line):
    return fit_slices(scan, line)


def truth(made, name):
    if name != "projected":
        return made.SLICES[name][2:]
    s = made.projected_beam()
    geometric = np.sqrt(np.linalg.det(s))
    factor = np.sqrt(made.E_PROJ**2 - made.MASS**2) / made.MASS
    return factor * geometric, s[0, 0] / geometric, -s[0, 1] / geometric


def test_the_files_are_what_the_generator_makes(made, root):
    for name, rows in (("slices", made.slice_rows()), ("phase", made.phase_rows())):
        text = (root / f"measurements/gtf_{name}_simulated.csv").read_text()
        assert text.splitlines()[-len(rows) :] == rows
        assert text.startswith("# SIMULATED")


@pytest.mark.parametrize("name", ["1", "2", "3", "4", "5", "projected"])
def test_every_slice_is_recovered_within_its_errors(name, fits, made):
    found = fits[name].x
    assert found.status.value == "converged"
    numbers = (found.normalized_emittance, found.beta, found.alpha)
    for quantity, true in zip(numbers, truth(made, name), strict=True):
        assert abs(quantity.value - true) < 3.0 * quantity.error
    assert found.normalized_emittance.relative < 0.02


def test_slices_of_different_emittance_are_told_apart(fits):
    outer, inner = fits["1"].x.normalized_emittance, fits["3"].x.normalized_emittance
    assert outer.value - inner.value > 10.0 * np.hypot(outer.error, inner.error)


@pytest.mark.parametrize("name", ["1", "4"])
def test_exact_sizes_give_the_exact_slice(name, scan, line, made):
    part = scan.of_slice(name)
    sizes = np.sqrt([made.size_squared(i, name) for i in part.settings["Q2"]])
    fit = beamfit.fit_emittance(replace(part, size={"x": sizes}), line)
    numbers = (fit.x.normalized_emittance, fit.x.beta, fit.x.alpha)
    np.testing.assert_allclose([q.value for q in numbers], truth(made, name), rtol=1e-7)
    rows = [made.transport(i, made.SLICES[name][1])[0] for i in part.settings["Q2"]]
    found = np.stack([fit.x.points.r11, fit.x.points.r12], -1)
    np.testing.assert_allclose(found, rows, rtol=0, atol=1e-12)
    # Where the bend follows the beam, as without the column, it is another transport.
    follows = beamfit.fit_emittance(replace(part, size={"x": sizes}, slice=None), line)
    assert np.abs(follows.x.points.r12 - found[:, 1]).max() > 1e-3


def test_the_projected_beam_is_blurred_by_its_energies_less_than_by_noise(scan, line, made, fits):
    """A fit of the whole beam takes one energy for all: what that does is far below its error."""
    part = scan.of_slice("projected")
    charge = sum(of[0] for of in made.SLICES.values())
    squared = [
        sum(of[0] * made.size_squared(i, name) for name, of in made.SLICES.items()) / charge
        for i in part.settings["Q2"]
    ]
    found = beamfit.fit_emittance(replace(part, size={"x": np.sqrt(squared)}), line)
    off = found.x.normalized_emittance.value - truth(made, "projected")[0]
    assert 0.0 < abs(off) < 0.3 * fits.projected.x.normalized_emittance.error


def test_magnets_given_by_k1_stay_too():
    magnet = Quadrupole("Q", 0.1, 4.0)
    line = beamfit.Beamline((Drift("A", 1.0), magnet, Drift("B", 2.0), Screen("S")), 30.0)
    k1 = np.linspace(-4.0, 20.0, 7)
    scan = beamfit.QuadScan(
        {"Q": k1}, {"Q": "k1"}, {"x": np.full(7, 2e-4)}, energy=np.full(7, 30.3), slice=["a"] * 7
    )
    held = scanned_line(scan, line)
    assert (held.energy, held["Q"].setting) == (30.3, 4.0)
    strength = held["Q"].k1(k1, energy=30.3)
    np.testing.assert_allclose(strength, k1 * rigidity(30.0) / rigidity(30.3), rtol=1e-14)
    np.testing.assert_allclose(held["Q"].k1(k1, energy=30.0), k1, rtol=1e-14)
    again = scanned_line(scan, held)
    np.testing.assert_array_equal(again["Q"].k1(k1, energy=30.3), strength)


def test_slices_without_energies_are_of_the_lines(line):
    currents = np.linspace(0.0, 3.9, 8)
    scan = beamfit.QuadScan(
        {"Q2": np.tile(currents, 2)},
        {"Q2": "A"},
        {"x": 1e-4 * np.tile([3.5, 3.0, 2.4, 1.7, 1.2, 1.5, 2.1, 2.9], 2)},
        slice=["early"] * 8 + ["late"] * 8,
    )
    fits = fit_slices(scan, line)
    early, late = fits
    assert early.x.emittance == late.x.emittance
    alone = beamfit.fit_emittance(replace(scan.of_slice("early"), slice=None), line)
    assert early.x.emittance == alone.x.emittance


def test_the_longitudinal_beam_of_a_phase_scan(made, root):
    """Report figure 15: energies behind the spectrometer against linac phase."""
    scan = beamfit.read_quad_scan(root / "measurements/gtf_phase_simulated.csv")
    fit = beamfit.fit_emittance(replace(scan, energy=np.full(len(scan), 30.5)))
    s = made.longitudinal_beam()
    true = (*s[np.triu_indices(2)], np.sqrt(np.linalg.det(s)))
    for quantity, value in zip((*fit.y.sigma, fit.y.emittance), true, strict=True):
        assert abs(quantity.value - value) < 3.0 * quantity.error
    assert fit.y.status.value == "converged"


def test_the_dispersion_of_the_example_is_the_lattices(made, root, line):
    r16 = beamfit.read_quad_scan(root / "measurements/gtf_phase_simulated.csv").transfer["y"][0, 1]
    assert r16 == pytest.approx(float(line.matrix().y[0, 2]), abs=1e-8)


CSV = "slice,energy_MeV,Q2_A,size_x_um\n" + "".join(
    f"{name},{energy},{current},{size}\n"
    for name, energy in (("a", 30.4), ("", 30.5))
    for current, size in ((0, 348), (1, 219), (2, 120), (3, 186), (3.9, 295))
)


@pytest.fixture
def write(tmp_path):
    def to_file(text):
        path = tmp_path / "slices.csv"
        path.write_text(text)
        return path

    return to_file


def test_a_blank_slice_is_the_projected_beam(write):
    scan = beamfit.read_quad_scan(write(CSV))
    assert scan.slices == ("a", "projected")
    assert len(scan.of_slice("projected")) == 5
    assert scan.of_slice("a").energy.tolist() == [30.4] * 5
    again = beamfit.read_quad_scan(write(scan.to_frame().to_csv(index=False)))
    assert again.slice == scan.slice


def test_shots_of_one_slice_are_averaged_and_not_those_of_two(write):
    text = "slice,Q2_A,size_x_um,shot\n" + "".join(
        f"{name},{current},{size + shot},{shot}\n"
        for name, size in (("a", 100), ("b", 300))
        for current in (0, 1, 2)
        for shot in (0, 1, 2)
    )
    scan = beamfit.read_quad_scan(write(text))
    assert scan.slice == ("a",) * 3 + ("b",) * 3
    np.testing.assert_allclose(scan.size["x"], [101e-6] * 3 + [301e-6] * 3)


def test_what_cannot_be_used_is_named(write, line):
    few = CSV.replace("a,30.4,1,219\na,30.4,2,120\na,30.4,3,186\n", "")
    with pytest.raises(InputError, match="2 distinct settings of slice a in plane x"):
        beamfit.read_quad_scan(write(few))
    scan = beamfit.read_quad_scan(write(CSV))
    with pytest.raises(InputError, match=r"no slice 'projetced'.*did you mean projected"):
        scan.of_slice("projetced")
    with pytest.raises(InputError, match="2 slices"):
        beamfit.fit_emittance(scan, line)
    with pytest.raises(InputError, match="a scan without slices"):
        fit_slices(replace(scan.of_slice("a"), slice=None), line)
    with pytest.raises(InputError, match="no sizes in plane y"):
        fit_slices(scan, line, planes=("y",))
    with pytest.raises(InputError, match="lengths"):
        replace(scan, slice=("a",) * 3)


def test_a_slice_may_be_measured_in_one_plane(write, line):
    lines = CSV.splitlines()
    rows = [f"{row},{'' if i < 5 else 200 + 20 * i}" for i, row in enumerate(lines[1:])]
    scan = beamfit.read_quad_scan(write("\n".join([lines[0] + ",size_y_um", *rows]) + "\n"))
    fits = fit_slices(scan, line)
    assert [p.plane for p in fits["a"].planes] == ["x"]
    assert [p.plane for p in fits.projected.planes] == ["x", "y"]
    assert [len(table.rows) for table in fits.tables()] == [2, 1]


def test_what_is_shown_names_every_slice(fits, tmp_path):
    entries = fits.to_json()
    assert [e["slice"] for e in entries] == list(fits.slices)
    assert fits.slices[-1] == "projected"
    assert all(f"\n{name} " in str(fits) for name in fits.slices)
    page = tmp_path / "slices.html"
    write_report(page, fits)
    text = page.read_text()
    # All are determined alike, and so told together.
    assert f"slices {', '.join(fits.slices)}, x: normalised emittance" in text
    assert "SIMULATED" in text
    file = tmp_path / "fit.json"
    file.write_text(results_text(entries, {}))
    beam = read_fitted_beams(file, 0.511)["x"]
    assert beam.sigma[0] == fits.projected.x.sigma[0].value
    file.write_text(json.dumps({"results": entries[:2]}))
    with pytest.raises(InputError, match="no result of the whole beam"):
        read_fitted_beams(file, 0.511)
