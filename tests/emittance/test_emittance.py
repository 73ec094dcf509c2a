"""The fit with known transport against truth, other programs' routines and limits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

import beamfit
from beamfit.errors import InputError
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Quadrupole, Screen, SectorDipole, ThinLens
from beamfit.particles import beta_gamma
from beamfit.quantity import Status
from tests.emittance.conftest import TABLE_2, design, scan_of
from tests.noise.reference import log_stated

TRUE_EMITTANCE = float(np.sqrt(TABLE_2[0] * TABLE_2[2] - TABLE_2[1] ** 2))


@pytest.mark.parametrize("method", ["size_squared", "size"])
def test_exact_sizes_give_the_beam_back(gtf, gtf_sizes, method):
    currents, _, sizes = gtf_sizes
    fit = beamfit.fit_emittance(scan_of("Q2", "A", currents, sizes), gtf, method=method).x
    np.testing.assert_allclose([q.value for q in fit.sigma], TABLE_2, rtol=1e-9)
    assert fit.emittance.value == pytest.approx(TRUE_EMITTANCE, rel=1e-9)
    assert fit.status is Status.converged


def test_errors_of_the_report_line_at_two_percent(gtf, gtf_sizes):
    """physics.md: σ11, σ12, σ22 to 2.0, 2.2, 1.6 % from 14 sizes at 2 %, if these are right."""
    currents, _, sizes = gtf_sizes
    fit = beamfit.fit_emittance(scan_of("Q2", "A", currents, sizes), gtf).x
    assert [round(100 * q.error_raw / abs(q.value), 1) for q in fit.sigma] == [2.0, 2.2, 1.6]
    # Errors as stated may be too small, or go on from row to row: of the first perfect sizes show
    # no sign, and they are the more like the second.
    swift = beamfit.Noise(slow=1e-9)
    fit = beamfit.fit_emittance(scan_of("Q2", "A", currents, sizes), gtf, noise=swift).x
    assert all(q.error_raw < 1.02 * q.error < 1.15 * q.error_raw for q in fit.sigma)
    fit = beamfit.fit_emittance(scan_of("Q2", "A", currents, sizes, seed=2), gtf).x
    assert all(q.error_raw < 1.02 * q.error < 1.15 * q.error_raw for q in fit.sigma)


def test_covariance_is_the_textbook_inverse_and_propagates(gtf, gtf_sizes):
    """By the errors as stated: what is found besides of the noise is in the error, not here."""
    currents, rows, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=3)
    fit = beamfit.fit_emittance(scan, gtf).x
    weighted = rows / (2 * fit.points.weighed * scan.error["x"])[:, None]
    covariance = np.linalg.inv(weighted.T @ weighted)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-6)
    s11, s12, s22 = (q.value for q in fit.sigma)
    e = fit.emittance.value

    def numbers(s):
        emittance = np.sqrt(s[0] * s[2] - s[1] ** 2)
        return np.array([emittance, s[0] / emittance, -s[1] / emittance])

    step = 1e-6 * np.diag([s11, abs(s12), s22])
    centre = np.array([s11, s12, s22])
    gradient = np.array([(numbers(centre + h) - numbers(centre - h)) / (2 * h.sum()) for h in step])
    errors = np.sqrt(np.diag(gradient.T @ covariance @ gradient))
    got = [q.error_raw for q in (fit.emittance, fit.beta, fit.alpha)]
    np.testing.assert_allclose(got, errors, rtol=1e-5)
    assert fit.normalized_emittance.value / e == pytest.approx(59.678, abs=1e-3)  # βγ at 30.5 MeV


def test_errors_cover_the_truth_as_often_as_they_say():
    """2000 simulated scans: 68.3 % and 95.4 % within 1 and 2 standard errors (binomial, 4 σ)."""
    r11, r12 = np.linspace(0.7, -2.5, 14), np.linspace(2.1, 1.37, 14)
    true = np.sqrt(np.stack([r11**2, 2 * r11 * r12, r12**2], 1) @ TABLE_2)
    noise = np.random.default_rng(2).normal(size=(2000, 14))
    fits = beamfit.fit_sizes(
        r11, r12, true * (1 + 0.01 * noise), np.broadcast_to(0.01 * true, noise.shape)
    )
    determinant = np.asarray(fits.determinant)
    off = np.abs(determinant - TRUE_EMITTANCE**2) / np.asarray(fits.determinant_error)
    for within, expected in ((1.0, 0.6827), (2.0, 0.9545)):
        spread = 4 * np.sqrt(expected * (1 - expected) / 2000)
        assert np.mean(off < within) == pytest.approx(expected, abs=spread)


def test_size_fit_is_where_scipy_finds_the_largest_likelihood(gtf, gtf_sizes):
    """Averaged over the size of the noise and over which readings are bad, in plain NumPy.

    Noise that goes on from row to row has a part in errors alone: weights are those of the others.
    """
    currents, rows, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=7)
    swift = beamfit.Noise(slow=1e-9)
    fit = beamfit.fit_emittance(scan, gtf, method="size", noise=swift).x
    size, error = scan.size["x"], scan.error["x"]

    def unlikely(s):
        return -log_stated(size, np.sqrt(rows @ (s * 1e-8)), error, swift)

    found = minimize(unlikely, TABLE_2 * 1e8, method="Nelder-Mead",
                     options={"xatol": 1e-7, "fatol": 1e-11, "maxfev": 4000})  # fmt: skip
    own = [q.value for q in fit.sigma]
    np.testing.assert_allclose(own, found.x * 1e-8, rtol=2e-4)
    assert unlikely(np.array(own) * 1e8) < found.fun + 1e-4
    off = (size - np.sqrt(rows @ own)) / error
    assert fit.chi2 == pytest.approx(float(off @ off), rel=1e-9)


@pytest.mark.parametrize("method", ["size_squared", "size"])
def test_with_stated_errors_and_no_bad_reading_it_is_weighted_least_squares(gtf, gtf_sizes, method):
    """No reading may be bad, and errors are right; a scatter beside them would even out weights."""
    currents, _, sizes = gtf_sizes
    size = sizes * (1.0 + 0.015 * np.resize([1.0, -1.0, -1.0, 1.0], 14))
    error = 0.02 * sizes
    scan = beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": size}, {"x": error})
    sure = beamfit.Noise(bad=1e-12, right=1 - 1e-9)
    fit = beamfit.fit_emittance(scan, gtf, method=method, noise=sure).x
    r11, r12 = fit.points.r11, fit.points.r12
    same = np.asarray(beamfit.fit_sizes(r11, r12, size, error).sigma)
    if method == "size":
        rows = np.stack([r11**2, 2 * r11 * r12, r12**2], -1)

        def residual(factors):
            return (np.sqrt(rows @ (factors * same)) - size) / error

        found = least_squares(residual, np.ones(3), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        same = found.x * same
    np.testing.assert_allclose([q.value for q in fit.sigma], same, rtol=1e-7)


def test_many_scans_in_one_call_are_the_same_as_one_by_one(gtf_sizes):
    _, rows, sizes = gtf_sizes
    r11 = np.sqrt(rows[:, 0]) * np.where(np.arange(14) < 3, 1, -1)
    r12 = np.sqrt(rows[:, 2])
    many = sizes * (1 + 0.005 * np.random.default_rng(0).normal(size=(5, 14)))
    batch = beamfit.fit_sizes(r11, r12, many, 0.02 * many)
    for i in range(5):
        one = beamfit.fit_sizes(r11, r12, many[i], 0.02 * many[i])
        np.testing.assert_allclose(batch.sigma[i], one.sigma, rtol=1e-9)


@pytest.mark.parametrize("kind", ["share", "same"])
def test_without_errors_the_noise_is_inferred_and_said(gtf, gtf_sizes, kind):
    """Thirty points of known noise: its size is found to its own statistics, 13 %, three times."""
    currents = np.linspace(0.0, 3.9, 30)
    sizes = np.sqrt(design(gtf, {"Q2": currents}) @ TABLE_2)
    deviation = 0.03 * sizes if kind == "share" else np.full(30, 8e-6)
    size = sizes + deviation * np.random.default_rng(5).normal(size=30)
    fit = beamfit.fit_emittance(scan_of("Q2", "A", currents, size, errors=False), gtf).x
    assert fit.status is Status.converged
    assert fit.chi2 is None
    assert fit.emittance.error_raw is None
    assert fit.error_scale == 1.0
    unit = "% of size" if kind == "share" else "µm"
    assert fit.noise.startswith("inferred, ")
    assert fit.noise.endswith(unit)
    np.testing.assert_allclose(fit.points.error, deviation, rtol=0.4)
    # The error is what repeated scans of that noise scatter by, by linear theory.
    p = fit.points
    known = beamfit.fit_sizes(p.r11, p.r12, sizes, deviation)
    linear = float(known.determinant_error / (2.0 * np.sqrt(known.determinant)))
    assert fit.emittance.error == pytest.approx(linear, rel=0.4)


def test_several_magnets_screens_planes_and_resolution(three_quads):
    rng = np.random.default_rng(1)
    beams = {
        "x": BeamMatrix.from_twiss(3e-9, 8.0, 1.0),
        "y": BeamMatrix.from_twiss(2e-9, 5.0, -0.5),
    }
    settings = {"QA": [], "QC": []}
    screens, sizes = [], {"x": [], "y": []}
    for qa in np.linspace(-8, 8, 5):
        for qc in (-3.0, 0.0, 3.0):
            for screen in ("YAG1", "YAG2"):
                matrix = three_quads.upto(screen).matrix({"QA": qa, "QC": qc})
                settings["QA"].append(qa)
                settings["QC"].append(qc)
                screens.append(screen)
                for plane, beam in beams.items():
                    clean = float(beam.transport(getattr(matrix, plane)).l11)
                    seen = np.hypot(clean, 8e-6)  # the lattice's screen resolution
                    sizes[plane].append(seen * (1 + 1e-4 * rng.normal()))
    scan = beamfit.QuadScan(
        settings,
        {"QA": "kG", "QC": "k1"},
        sizes,
        {p: 1e-4 * np.array(v) for p, v in sizes.items()},
        screen=tuple(screens),
    )
    fit = beamfit.fit_emittance(scan, three_quads)
    for plane, beam in beams.items():
        got = fit[plane].emittance
        assert abs(got.value - float(beam.emittance)) < 5 * got.error
        assert got.relative < 1e-3
        assert fit[plane].identifiability.waist_bracketed is None


def test_a_current_calibrated_magnet_may_be_scanned_by_gradient(three_quads):
    """QB has a polynomial in A; a scan of it in kG must use the gradient as it is."""
    kg = np.linspace(-6, 6, 9)
    length = float(three_quads["QB"].length)
    strength = 0.1 * kg / (np.sqrt(250.0**2 - 0.51099895069**2) / 299.792458) / length
    by_k1 = three_quads.with_element(Quadrupole("QB", length))
    sizes = np.sqrt(design(by_k1, {"QB": strength}) @ [4e-8, 1e-9, 1e-9])
    bare = three_quads.with_element(Screen("YAG1")).with_element(Screen("YAG2"))
    fit = beamfit.fit_emittance(scan_of("QB", "kG", kg, sizes), bare).x
    np.testing.assert_allclose([q.value for q in fit.sigma], [4e-8, 1e-9, 1e-9], rtol=1e-8)


def test_energies_row_by_row(gtf):
    """The same normalised beam seen at two energies, each row with its own transport."""
    currents, energies = np.tile(np.linspace(0, 3.9, 6), 2), np.repeat([28.0, 33.0], 6)
    sizes = []
    for current, energy in zip(currents, energies, strict=True):
        r = np.asarray(gtf.matrix({"Q2": current}, energy=energy).x)[0]
        damped = TABLE_2 * beta_gamma(30.5, gtf.mass) / beta_gamma(energy, gtf.mass)
        sizes.append(np.sqrt(damped @ [r[0] ** 2, 2 * r[0] * r[1], r[1] ** 2]))
    scan = beamfit.QuadScan(
        {"Q2": currents}, {"Q2": "A"}, {"x": sizes}, {"x": 0.02 * np.array(sizes)}, energy=energies
    )
    result = beamfit.fit_emittance(scan, gtf)
    assert result.to_json()[0]["energy"]["value"] == 30.5
    fit = result.x
    np.testing.assert_allclose([q.value for q in fit.sigma], TABLE_2, rtol=1e-9)
    gamma = 30.5 / 0.51099895069
    assert fit.normalized_emittance.value / fit.emittance.value == pytest.approx(
        np.sqrt(gamma**2 - 1), rel=1e-12
    )


def test_dispersion_and_energy_spread_are_taken_out():
    line = Beamline(
        (
            Quadrupole("Q", 0.2),
            Drift("D", 1.0),
            SectorDipole("B", 2.0, 0.4),
            Drift("E", 1.0),
            Screen("S", 2e-5),
        ),
        energy=200.0,
        energy_spread=5e-3,
    )
    k1 = np.linspace(-4, 8, 9)
    sigma = np.array([4e-8, -5e-9, 2e-9])
    r16 = float(line.matrix().x[0, 2])
    clean = design(line, {"Q": k1}) @ sigma
    assert (r16 * 5e-3) ** 2 > 10 * clean.max()  # it would swamp the fit
    sizes = np.sqrt(clean + (r16 * 5e-3) ** 2 + 2e-5**2)
    fit = beamfit.fit_emittance(scan_of("Q", "k1", k1, sizes, relative=1e-3), line).x
    np.testing.assert_allclose([q.value for q in fit.sigma], sigma, rtol=1e-6)


@pytest.mark.parametrize("errors", [True, False])
def test_three_points_fit_exactly_and_say_nothing_of_themselves(gtf, gtf_sizes, errors):
    """Any three sizes have an exact fit, noise too: the value is shown and not vouched for."""
    currents, _, sizes = gtf_sizes
    pick = [2, 7, 12]
    fit = beamfit.fit_emittance(
        scan_of("Q2", "A", currents[pick], sizes[pick], errors=errors), gtf
    ).x
    assert fit.dof == 0
    assert fit.emittance.value == pytest.approx(TRUE_EMITTANCE, rel=1e-8)
    assert fit.status is Status.unidentified
    assert fit.emittance.error is None
    assert "measure a fourth setting" in fit.message


def test_the_screen_reported_is_the_last_of_the_line_in_whatever_order_rows_come(three_quads):
    kg = np.repeat(np.linspace(-6, 6, 6), 2)
    screens = ("YAG2", "YAG1") * 6
    bare = three_quads.with_element(Screen("YAG1")).with_element(Screen("YAG2"))
    beam = BeamMatrix.from_twiss(3e-9, 8.0, 1.0)
    matrices = [bare.upto(s).matrix({"QA": q}).x for q, s in zip(kg, screens, strict=True)]
    sizes = np.array([float(beam.transport(r).l11) for r in matrices])
    for order in (slice(None), slice(None, None, -1)):
        scan = beamfit.QuadScan(
            {"QA": kg[order]},
            {"QA": "kG"},
            {"x": sizes[order]},
            {"x": 0.01 * sizes[order]},
            screen=screens[order],
        )
        fit = beamfit.fit_emittance(scan, bare)
        there = beam.transport(bare.matrix().x)
        assert fit.x.screen.name == "YAG2"
        assert fit.x.screen.beta.value == pytest.approx(float(there.twiss.beta), rel=1e-6)
        assert fit.x.screen.alpha.value == pytest.approx(float(there.twiss.alpha), rel=1e-6)
        assert fit.x.screen.size.value == pytest.approx(float(there.l11), rel=1e-6)
        causes = [c.cause for c in beamfit.systematics(fit, "x")]
        assert "drift DD +1 cm" in causes


def test_a_thin_lens_has_no_k1():
    line = Beamline((ThinLens("L"), Drift("D", 2.0), Screen("S")), energy=135.0)
    sizes = [3e-4, 2e-4, 1e-4, 2e-4]
    with pytest.raises(InputError, match="which has no length; expected a column L_k1l"):
        beamfit.fit_emittance(scan_of("L", "k1", [0.0, 0.2, 0.4, 0.6], sizes), line)


def test_a_proton_below_its_rest_energy(three_quads):
    line = replace(three_quads, mass=938.272, energy=2000.0)
    scan = beamfit.QuadScan(
        {"QA": [0.0, 1.0, 2.0, 3.0]}, {"QA": "kG"}, {"x": [3e-4, 2e-4, 1e-4, 2e-4]},
        energy=[2000.0, 2000.0, 500.0, 2000.0],
    )  # fmt: skip
    with pytest.raises(InputError, match="500 MeV; expected total energies above"):
        beamfit.fit_emittance(scan, line)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"method": "cubic"}, "method 'cubic'; expected size_squared or size"),
        ({"planes": ("y",)}, "no sizes in plane y"),
    ],
)
def test_options_that_do_not_exist(gtf, gtf_sizes, option, words):
    currents, _, sizes = gtf_sizes
    with pytest.raises(InputError, match=words):
        beamfit.fit_emittance(scan_of("Q2", "A", currents, sizes), gtf, **option)


def test_json_has_the_contract(gtf, gtf_sizes):
    currents, _, sizes = gtf_sizes
    [result] = beamfit.fit_emittance(scan_of("Q2", "A", currents, sizes), gtf).to_json()
    contract = {"plane", "status", "message", "emittance", "normalized_emittance", "beta", "alpha"}
    contract |= {"sigma11", "sigma12", "sigma22", "chi2", "dof", "rms_residual", "identifiability"}
    assert contract <= set(result)
    for name in ("emittance", "normalized_emittance", "beta", "alpha", "sigma11", "sigma22"):
        assert {"value", "error", "unit", "error_raw", "interval_95"} == set(result[name])
    assert result["emittance"]["unit"] == "m"
    assert result["status"] == "converged"


def test_a_gradient_is_the_integrated_gradient_over_the_length(otr2):
    """1 T/m over the magnet's length of 0.108 m is 1.08 kG."""
    settings, sizes = np.linspace(-4.0, -1.0, 6), np.array([111, 80, 60, 54, 70, 104]) * 1e-6
    fits = [
        beamfit.fit_emittance(scan_of("Q525", unit, values, sizes), otr2).x
        for unit, values in (("kG", settings), ("T_per_m", settings / 1.08))
    ]
    assert fits[1].emittance.value == pytest.approx(fits[0].emittance.value, rel=1e-12)
    assert fits[1].points.units == {"Q525": "T/m"}


@pytest.mark.parametrize(("kind", "number"), [("kinetic", 134.48900104931), ("total", 135.0)])
def test_an_energy_means_what_its_column_says(kind, number, otr2):
    settings, sizes = np.linspace(-4.0, -1.0, 6), np.array([111, 80, 60, 54, 70, 104]) * 1e-6
    scan = scan_of("Q525", "kG", settings, sizes)
    own = replace(scan, energy=np.full(6, number), energy_kind=kind)
    fit = beamfit.fit_emittance(own, otr2)
    expected = beamfit.fit_emittance(scan, otr2).x.normalized_emittance.value
    assert fit.x.normalized_emittance.value == pytest.approx(expected, rel=1e-12)
    assert fit.to_json()[0]["energy"]["value"] == pytest.approx(135.0, rel=1e-14)


def test_units_that_no_beam_or_magnet_explains_are_refused_or_questioned(otr2):
    settings, sizes = np.linspace(-4.0, -1.0, 6), np.array([111, 80, 60, 54, 70, 104]) * 1e-6
    with pytest.raises(InputError, match="um or mm"):
        scan_of("Q525", "kG", settings, 1e6 * sizes)
    with pytest.raises(InputError, match="T/m"):
        beamfit.fit_emittance(scan_of("Q525", "kG", 1e4 * settings, sizes), otr2)
    assert beamfit.fit_emittance(scan_of("Q525", "kG", settings, sizes), otr2).notes == ()
    odd = scan_of("Q525", "kG", 200.0 * settings, 1e3 * sizes)
    fit = beamfit.fit_emittance(odd, otr2)
    assert ["sizes" in note.lower() for note in fit.notes] == [True, False]
    assert "T/m" in fit.notes[1]
    assert fit.notes[0] in str(fit)
    assert fit.notes[0] in fit.to_json()[0]["notes"]
    np.testing.assert_array_equal(fit.scan.size["x"], 1e3 * sizes)


@pytest.mark.parametrize("mass", [None, 938.272])
def test_rows_of_different_energy_share_the_normalised_emittance(otr2, mass):
    """±5 % of energy: what is constant from row to row is ε βγ (χ²/dof was 3.4 with σ itself)."""
    line = otr2 if mass is None else replace(otr2, mass=mass, energy=1000.0)
    mean = float(line.energy)
    energy = mean * np.linspace(0.95, 1.05, 9)
    settings = np.linspace(-4.5, -1.0, 9)
    sizes = []
    for e, q in zip(energy, settings, strict=True):
        own = beamfit.BeamMatrix.from_twiss(1e-6 / beta_gamma(e, line.mass), 5.5, 5.3)
        sizes.append(float(own.transport(replace(line, energy=float(e)).matrix({"Q525": q}).x).l11))
    sizes = np.array(sizes)
    scan = beamfit.QuadScan(
        {"Q525": settings}, {"Q525": "kG"}, {"x": sizes}, {"x": 0.01 * sizes}, energy
    )
    fit = beamfit.fit_emittance(scan, line).x
    assert fit.chi2 == pytest.approx(0.0, abs=1e-6)
    assert fit.normalized_emittance.value == pytest.approx(1e-6, rel=1e-9)
    assert fit.emittance.value == pytest.approx(1e-6 / beta_gamma(mean, line.mass), rel=1e-9)


def test_a_plane_takes_no_size_from_rows_in_which_the_other_alone_was_measured():
    """With x in the first rows and y in the last, y was fitted to the first sizes of x as well."""
    line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    k1, beam = np.linspace(-8.0, 12.0, 12), BeamMatrix.from_twiss(2e-9, 5.0, 0.0)
    matrices = [line.matrix({"Q": k}) for k in k1]
    sizes = {p: np.array([beam.transport(getattr(r, p)).l11 for r in matrices]) for p in "xy"}
    sizes["x"][8:], sizes["y"][:4] = np.nan, np.nan
    errors = {p: 0.02 * size for p, size in sizes.items()}
    fit = beamfit.fit_emittance(beamfit.QuadScan({"Q": k1}, {"Q": "k1"}, sizes, errors), line)
    for plane in fit.planes:
        assert plane.emittance.value == pytest.approx(2e-9, rel=1e-6)
        assert plane.chi2 < 1e-9
