"""Systematics against refits, range table against refits, outliers."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag

import beamfit
from beamfit.emittance.systematics import (
    MAX_CAUSES,
    budget_rows,
    range_sensitivity,
    systematics,
)
from beamfit.optics.beamline import transfer_rows
from beamfit.optics.elements import Drift, Quadrupole, Screen, SectorDipole
from beamfit.particles import PROTON_MASS
from tests.emittance.conftest import scan_of


@pytest.mark.parametrize("method", ["size_squared", "size"])
def test_budget_is_the_slope_of_a_refit(gtf, gtf_sizes, method):
    """Each exact derivative against a central difference of the whole fit."""
    currents, _, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=4)
    fit = beamfit.fit_emittance(scan, gtf, method=method)
    changes = {c.cause: c for c in systematics(fit, "x")}
    assert set(changes) == {
        "Q1 slope +1 %, not scanned",
        "Q2 slope +1 %",
        "bend SPEC angle +1 %",
        "drift D_QQ +1 cm",
        "drift D1 +1 cm",
        "drift D2 +1 cm",
        "energy +1 %",
        "screen scale +1 %",
        "screen resolution 10 µm larger",
        "dispersion 1 cm larger (spread 0.1 %)",
        "smallest size 5 % too large (saturation, space charge)",
        "energy rises by 1 % within the scan",
        "Q2 late by 10 % of each step, row by row",
    }
    sizes_of = [abs(c.normalized_emittance) for c in changes.values()]
    assert sizes_of == sorted(sizes_of, reverse=True)
    h = 1e-4

    def moved(cause, step):
        if cause == "energy":
            return replace(gtf, energy=gtf.energy * (1 + step))
        if cause in ("Q1", "Q2"):
            c = gtf[cause].calibration
            magnet = replace(gtf[cause], calibration=replace(c, slope=c.slope * (1 + step)))
            return gtf.with_element(magnet)
        return gtf.with_element(Drift(cause, gtf[cause].length + step))

    for cause, name in (
        ("Q1", "Q1 slope +1 %, not scanned"),
        ("Q2", "Q2 slope +1 %"),
        ("D1", "drift D1 +1 cm"),
        ("energy", "energy +1 %"),
    ):
        up, down = (beamfit.fit_emittance(scan, moved(cause, s), method=method).x for s in (h, -h))
        for got, attribute in (
            (changes[name].emittance, "emittance"),
            (changes[name].normalized_emittance, "normalized_emittance"),
        ):
            ends = [getattr(f, attribute).value for f in (up, down)]
            slope = np.log(ends[0] / ends[1]) / (2 * h)
            assert got == pytest.approx(0.01 * slope, rel=1e-5, abs=1e-9), (cause, attribute)


def test_what_moves_within_a_scan_is_the_slope_of_a_refit(gtf, gtf_sizes):
    """The energy of each row, and fields that lag behind; settings in no order."""
    currents, _, sizes = gtf_sizes
    order = np.random.default_rng(0).permutation(len(currents))
    scan = scan_of("Q2", "A", currents[order], sizes[order], seed=4)
    fit = beamfit.fit_emittance(scan, gtf)
    changes = {c.cause: c.emittance for c in systematics(fit, "x")}
    ramp, h = np.linspace(-0.5, 0.5, len(order)), 1e-3
    behind = 0.1 * np.diff(currents[order], prepend=currents[order][0])
    rising = (replace(scan, energy=gtf.energy * (1 + s * ramp)) for s in (h, -h))
    late = (replace(scan, settings={"Q2": currents[order] - s * behind}) for s in (h, -h))
    for cause, step, both in (
        ("energy rises by 1 % within the scan", 0.01, rising),
        ("Q2 late by 10 % of each step, row by row", 1.0, late),
    ):
        up, down = (beamfit.fit_emittance(one, gtf).x.emittance.value for one in both)
        # The weights of the points move with their residuals, by a little.
        assert changes[cause] == pytest.approx(step * np.log(up / down) / (2 * h), rel=0.02)


def test_a_magnet_has_time_between_the_sweeps_of_two_planes(root):
    """Sizes of x and then those of y: the magnet goes back between them."""
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    line = beamfit.load_lattice(root / "lattices/lcls_otr2.toml")
    gap = np.full(len(scan), np.nan)
    both = replace(
        scan,
        settings={name: np.tile(v, 2) for name, v in scan.settings.items()},
        size={"x": np.append(scan.size["x"], gap), "y": np.append(gap, scan.size["y"])},
        error={"x": np.append(scan.error["x"], gap), "y": np.append(gap, scan.error["y"])},
        shots=np.tile(scan.shots, 2),
    )
    for plane in "xy":
        one, other = (
            {c.cause: c.emittance for c in systematics(beamfit.fit_emittance(each, line), plane)}
            for each in (scan, both)
        )
        cause = "Q525 late by 10 % of each step, row by row"
        assert other[cause] == pytest.approx(one[cause], rel=1e-6)


def test_budget_of_a_drift_in_parts_is_that_of_the_whole(gtf, gtf_sizes):
    """1 cm more is 1 cm more in whichever of sixty parts; the table shows the largest."""
    currents, _, sizes = gtf_sizes
    parts = tuple(Drift(f"D2.{i}", gtf["D2"].length / 60) for i in range(60))
    at = gtf.elements.index(gtf["D2"])
    long = replace(gtf, elements=(*gtf.elements[:at], *parts, *gtf.elements[at + 1 :]))
    scan = scan_of("Q2", "A", currents, sizes, seed=4)
    fit = beamfit.fit_emittance(scan, long)
    short = {c.cause: c for c in systematics(beamfit.fit_emittance(scan, gtf), "x")}
    whole = short.pop("drift D2 +1 cm")
    changes = {c.cause: c for c in systematics(fit, "x")}
    for part in parts:
        change = changes.pop(f"drift {part.name} +1 cm")
        assert change.emittance == pytest.approx(whole.emittance, rel=1e-9)
    assert list(changes) == list(short)
    for cause, change in changes.items():
        assert change.emittance == pytest.approx(short[cause].emittance, rel=1e-9, abs=1e-15)
    *shown, others = budget_rows(fit)
    assert len(shown) == MAX_CAUSES
    assert others[0] == f"{len(short) + 60 - MAX_CAUSES} other causes, each"
    effects = [abs(float(row[0].split()[0])) for _, row in shown]
    assert effects == sorted(effects, reverse=True)


@pytest.mark.parametrize("weights", ["model", "measured"])
def test_the_screen_in_the_budget_is_the_slope_of_a_refit(gtf, gtf_sizes, weights):
    """Scale, resolution and dispersion: a screen that is a little another one.

    The refit finds its noise anew, of which sizes that are 1 % larger have another share: a
    hundred-thousandth of the slope.
    """
    currents, _, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=4)
    blurred = gtf.with_element(Screen("SCREEN", resolution=2e-5))
    fit = beamfit.fit_emittance(scan, blurred, weights=weights)
    changes = {c.cause: c.emittance for c in systematics(fit, "x")}

    def emittance(scan, line):
        return np.log(beamfit.fit_emittance(scan, line, weights=weights).x.emittance.value)

    def larger(step):
        return replace(scan, size={"x": scan.size["x"] * (1 + step)})

    h = 1e-4
    slope = (emittance(larger(h), blurred) - emittance(larger(-h), blurred)) / (2 * h)
    assert changes["screen scale +1 %"] == pytest.approx(0.01 * slope, rel=3e-5)
    added = 1e-13  # m²
    ends = [gtf.with_element(Screen("SCREEN", float(np.sqrt(4e-10 + s)))) for s in (added, -added)]
    slope = (emittance(scan, ends[0]) - emittance(scan, ends[1])) / (2 * added)
    assert changes["screen resolution 10 µm larger"] == pytest.approx(5e-10 * slope, rel=1e-5)
    # What makes the smallest size 5 % too large is in every size², as a resolution is.
    waist = changes["smallest size 5 % too large (saturation, space charge)"]
    at_waist = (1.05**2 - 1.0) * scan.size["x"].min() ** 2
    assert waist == pytest.approx(at_waist * slope, rel=1e-5)
    p = fit.x.points
    more = (p.r11 * 0.01 * 1e-3) ** 2
    h = 1e-3
    rows = [replace(scan, resolution=np.sqrt(4e-10 + s * more)) for s in (h, -h)]
    slope = (emittance(rows[0], blurred) - emittance(rows[1], blurred)) / (2 * h)
    cause = "dispersion 1 cm larger (spread 0.1 %)"
    assert changes[cause] == pytest.approx(slope, rel=1e-5)


def test_a_bend_in_the_budget_is_the_slope_of_a_refit():
    """Two kinds of elements before the screen that no row sets, in an order of their own."""
    magnet, bend = Quadrupole("Q", 0.1), SectorDipole("B", 0.5, 0.4)
    held = Quadrupole("H", 0.1, 3.0)
    parts = (Drift("A", 0.3), magnet, held, Drift("C", 0.5), bend, Drift("E", 0.7), Screen("S"))
    line = beamfit.Beamline(parts, 100.0)
    k1 = np.linspace(-8.0, 12.0, 9)
    beam = beamfit.BeamMatrix.from_twiss(5e-9, 4.0, 1.0)
    sizes = np.array([float(beam.transport(line.matrix({"Q": k}).x).l11) for k in k1])
    scan = scan_of("Q", "k1", k1, sizes, 0.005, seed=2)
    fit = beamfit.fit_emittance(scan, line)
    changes = {c.cause: c.emittance for c in systematics(fit, "x")}
    h = 1e-5
    for cause, name, field, value in (
        ("bend B angle +1 %", "B", "angle", 0.4),
        ("H strength +1 %, not scanned", "H", "setting", 3.0),
        ("drift C +1 cm", "C", "length", 0.5),
    ):
        step = h if field == "length" else h * value
        lines = [
            line.with_element(replace(line[name], **{field: value + s})) for s in (step, -step)
        ]
        up, down = (beamfit.fit_emittance(scan, each).x.emittance.value for each in lines)
        assert changes[cause] == pytest.approx(0.01 * np.log(up / down) / (2 * h), rel=1e-4), cause


def test_emittance_is_one_over_the_slope(gtf, gtf_sizes):
    """physics.md: from one scan the emittance goes as 1/slope, so +1 % gives about -1 %."""
    currents, _, sizes = gtf_sizes
    fit = beamfit.fit_emittance(scan_of("Q2", "A", currents, sizes), gtf)
    changes = {c.cause: c for c in systematics(fit, "x")}
    assert changes["Q2 slope +1 %"].emittance == pytest.approx(-0.01, abs=5e-4)


def test_an_undetermined_emittance_has_no_budget(gtf):
    scan = scan_of("Q2", "A", np.linspace(3, 3.9, 8), np.full(8, 1e-4), seed=1)
    fit = beamfit.fit_emittance(scan, gtf)
    assert systematics(fit, "x") == []


def test_range_rows_are_refits_without_the_point(gtf, gtf_sizes):
    currents, _, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=6)
    fit = beamfit.fit_emittance(scan, gtf)
    rows = range_sensitivity(fit.x)
    assert len(rows) == 15  # each of 14 left out, and the near half
    keep = np.arange(14) != 4
    # At the errors and weights of the fit, by hand.
    p = fit.x.points
    design = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
    scale = 1 / (2 * p.weighed * p.error)
    s11, s12, s22 = np.linalg.lstsq(
        (design * scale[:, None])[keep] * 1e-8, (p.size**2 * scale)[keep], rcond=None
    )[0] * 1e-8  # fmt: skip
    less = np.sqrt(s11 * s22 - s12**2)
    x = fit.x
    assert rows[4].left_out == "without Q2 = 1.2 A"
    assert rows[4].normalized_emittance == pytest.approx(
        less * x.normalized_emittance.value / x.emittance.value, rel=1e-8
    )
    assert rows[4].shift == pytest.approx((less - x.emittance.value) / x.emittance.error, rel=1e-5)
    # A fit that never saw it differs by what it finds of the noise, which is little.
    rest = beamfit.QuadScan(
        {"Q2": currents[keep]},
        {"Q2": "A"},
        {"x": scan.size["x"][keep]},
        {"x": scan.error["x"][keep]},
    )
    other = beamfit.fit_emittance(rest, gtf).x.emittance
    assert abs(less - other.value) < 0.1 * other.error


@pytest.mark.parametrize("robust", [False, True])
def test_an_outlier_gets_a_probability_not_a_cut(gtf, gtf_sizes, robust):
    """With the usual prior of bad readings as with the wider one of a robust fit."""
    currents, _, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=8)
    spoilt = scan.size["x"].copy()
    spoilt[3] *= 1.4
    bad = beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": spoilt}, scan.error)
    truth = beamfit.fit_emittance(scan, gtf).x.emittance
    fit = beamfit.fit_emittance(bad, gtf, robust=robust).x
    probability = fit.points.outlier_probability
    assert probability[3] > 0.99
    assert np.delete(probability, 3).max() < 0.3
    assert abs(fit.emittance.value - truth.value) < truth.error
    assert fit.emittance.error < 2.0 * truth.error
    # Least squares that take it as good are off by more than two errors.
    p = fit.points
    taken = beamfit.fit_sizes(p.r11, p.r12, spoilt, scan.error["x"])
    assert abs(np.sqrt(float(taken.determinant)) - truth.value) > 2 * truth.error
    assert "1 of 14 readings" in fit.message


def test_an_outlier_is_found_without_errors_too(gtf, gtf_sizes):
    currents, _, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=8, errors=False)
    spoilt = scan.size["x"].copy()
    spoilt[3] *= 1.4
    bad = beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": spoilt})
    truth = beamfit.fit_emittance(scan, gtf).x.emittance
    robust = beamfit.fit_emittance(bad, gtf, robust=True).x
    assert robust.points.outlier_probability[3] > 0.99
    assert abs(robust.emittance.value - truth.value) < truth.error
    assert robust.emittance.error < 2 * truth.error


def test_a_wild_point_with_a_tiny_error_is_set_aside(gtf, gtf_sizes):
    """One size and its error ten times too small: off by hundreds of its errors."""
    currents, _, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, seed=8)
    size, error = scan.size["x"].copy(), scan.error["x"].copy()
    size[4], error[4] = size[4] / 10, error[4] / 10
    bad = beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": size}, {"x": error})
    truth = beamfit.fit_emittance(scan, gtf).x.emittance
    robust = beamfit.fit_emittance(bad, gtf, robust=True).x
    assert robust.points.outlier_probability[4] > 0.999
    assert abs(robust.emittance.value - truth.value) < truth.error


def test_robust_fit_of_clean_data_is_the_plain_fit(gtf, gtf_sizes):
    currents, _, sizes = gtf_sizes
    scan = scan_of("Q2", "A", currents, sizes, relative=0.01)
    plain, robust = (beamfit.fit_emittance(scan, gtf, robust=r).x for r in (False, True))
    assert robust.emittance.value == pytest.approx(plain.emittance.value, rel=1e-9)
    assert robust.points.outlier_probability.max() < 0.01
    assert robust.emittance.error == pytest.approx(plain.emittance.error, rel=0.01)


def test_a_line_inside_a_users_trace_is_no_trace_of_it(otr2):
    """What is kept of a line is numbers, also where it was first seen inside a function of JAX."""
    settings = {"Q525": np.linspace(-4.0, -1.0, 3)}
    energy = np.full(3, 135.0)
    traced = jax.tree.map(jnp.asarray, otr2)  # a line whose numbers are JAX's own

    def size(k):
        return transfer_rows(traced, {"Q525": settings["Q525"] * k}, energy, ("OTR2",)).planes.sum()

    inside = jax.jit(size)(1.0)
    outside = transfer_rows(traced, settings, energy, ("OTR2",)).planes.sum()
    assert float(inside) == pytest.approx(float(outside), rel=1e-12)
    assert np.isfinite(jax.grad(size)(1.0))


def test_of_protons_a_step_of_the_energy_says_of_which():
    """At 160 MeV 1 % of the total energy is 6.9 % of the kinetic, as which it was read."""
    parts = Quadrupole("Q", 0.25), Drift("D", 3.0), Screen("S")
    line = beamfit.Beamline(parts, energy=PROTON_MASS + 160.0, mass=PROTON_MASS)
    k1, beam = np.linspace(-1.0, 3.0, 9), np.array([[4e-6, 0.0], [0.0, 1e-7]])
    rows = np.array([np.asarray(line.matrix({"Q": k}).x)[0, :2] for k in k1])
    sizes = np.sqrt(np.einsum("ni,ij,nj->n", rows, beam, rows))
    scan = beamfit.QuadScan({"Q": k1}, {"Q": "k1"}, {"x": sizes}, {"x": 0.02 * sizes})
    causes = [change.cause for change in systematics(beamfit.fit_emittance(scan, line), "x")]
    assert "total energy +1 % (kinetic +6.9 %)" in causes
    assert "energy +1 %" not in causes


def thick(k1, length=0.1):
    """A quadrupole of both planes, (4, 4), by a complex phase."""
    blocks = []
    for root in np.sqrt(np.array([k1, -k1], complex) + 1e-12):
        c, s = np.cos(root * length), np.sin(root * length)
        blocks.append(np.array([[c, s / root], [-root * s, c]]).real)
    return block_diag(*blocks)


def test_a_rolled_magnet_moves_the_emittance_as_the_budget_says():
    """Against fits of sizes behind 4x4 matrices; the change goes with the square of the roll.

    The last row is of a screen that the rolled magnet stands behind.
    """
    k1 = np.append(np.linspace(-8.0, 9.0, 14), 0.0)
    beam = block_diag([[5.0, -1.0], [-1.0, 1.0]], [[2.0, 1.5], [1.5, 2.0]]) * 1e-9
    parts = Quadrupole("F", 0.1, 1.5), Screen("B"), Drift("A", 0.5), Quadrupole("Q", 0.1)
    line = beamfit.Beamline((*parts, Drift("D", 2.0), Screen("S")), 135.0)
    drift_a, drift_d = (np.kron(np.eye(2), [[1.0, v], [0.0, 1.0]]) for v in (0.5, 2.0))

    def fit(roll):
        c, s = np.cos(roll), np.sin(roll)
        turn = np.kron([[c, s], [-s, c]], np.eye(2))
        through = [drift_d @ turn.T @ thick(k) @ turn @ drift_a @ thick(1.5) for k in k1[:-1]]
        size = np.sqrt([np.diag(m @ beam @ m.T)[[0, 2]] for m in (*through, thick(1.5))])
        size = dict(zip("xy", size.T, strict=True))
        error = {plane: 0.02 * v for plane, v in size.items()}
        scan = beamfit.QuadScan({"Q": k1}, {"Q": "k1"}, size, error, screen=(*14 * "S", "B"))
        return beamfit.fit_emittance(scan, line)

    straight, rolled = fit(0.0), fit(np.radians(0.2))
    for plane in "xy":
        moved = rolled[plane].emittance.value / straight[plane].emittance.value - 1.0
        budget = {c.cause: c.emittance for c in systematics(straight, plane)}
        assert budget["Q rolled by 1 degree"] * 0.2**2 == pytest.approx(-moved, rel=0.02)
