"""Sizes at several monitors, and rows that bring their own transfer matrices."""

import json

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

import beamfit
from beamfit.cli import main
from beamfit.emittance.design import plan_measurements
from beamfit.errors import InputError
from beamfit.noise.model import Noise
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Quadrupole, Screen
from tests.noise.reference import lognormal_grid, stated_scales
from tests.simulations import simulations

# A focusing cell with five wires; nothing moves.
FODO = """format = "beamfit-lattice-1"
energy_MeV = 135.0
""" + "".join(
    f'[[element]]\ntype = "quadrupole"\nname = "Q{i}"\nlength_m = 0.1\nk1_per_m2 = {k}\n'
    f'[[element]]\ntype = "drift"\nlength_m = 0.9\n[[element]]\ntype = "screen"\nname = "W{i}"\n'
    for i, k in enumerate((8.0, -8.0, 8.0, -8.0, 8.0))
)

WIRES = ("W0", "W1", "W2", "W3", "W4")
TRUE = BeamMatrix.from_twiss(2e-9, 3.0, -0.5)


def fodo():
    parts = []
    for i, k in enumerate((8.0, -8.0, 8.0, -8.0, 8.0)):
        parts += [Quadrupole(f"Q{i}", 0.1, k), Drift(f"D{i}", 0.9), Screen(f"W{i}")]
    return Beamline(tuple(parts), 135.0)


def seen_from(line, wires):
    """R11, R12 of each wire and plane."""
    found = line.matrices(wires)
    return {p: np.array([np.asarray(getattr(found[w], p))[0, :2] for w in wires]) for p in "xy"}


def sizes_at(r):
    s11, s12 = float(TRUE.l11**2), float(TRUE.l11 * TRUE.l21)
    s22 = float(TRUE.l21**2 + TRUE.l22**2)
    return {
        p: np.sqrt(s11 * a**2 + 2 * s12 * a * b + s22 * b**2)
        for p, (a, b) in ((p, m.T) for p, m in r.items())
    }


def wire_scan(wires, noise=0.0, seed=3, stated=0.01, **more):
    rng = np.random.default_rng(seed)
    size = {p: v * (1 + noise * rng.normal(size=len(v))) for p, v in
            sizes_at(seen_from(fodo(), wires)).items()}  # fmt: skip
    error = {p: max(noise, stated) * v for p, v in size.items()}
    return beamfit.QuadScan({}, {}, size, error, screen=wires, **more)


@pytest.mark.parametrize("plane", ["x", "y"])
def test_sizes_at_five_wires_give_the_beam(plane):
    fit = beamfit.fit_emittance(wire_scan(WIRES, stated=0.001), fodo())[plane]
    assert fit.emittance.value == pytest.approx(2e-9, rel=1e-9)
    assert fit.beta.value == pytest.approx(3.0, rel=1e-9)
    assert fit.status.value == "converged"
    assert fit.points.screen == WIRES


def test_a_row_may_bring_its_matrix_in_place_of_a_lattice():
    """The same numbers as with the lattice, whatever the noise, and at the same place."""
    whole = beamfit.fit_emittance(wire_scan(WIRES, 0.001, stated=0.001), fodo())
    own = wire_scan(
        WIRES, 0.001, stated=0.001, transfer=seen_from(fodo(), WIRES), energy=np.full(5, 135.0)
    )
    alone = beamfit.fit_emittance(own)
    for plane in "xy":
        for name in ("emittance", "normalized_emittance", "beta", "alpha"):
            found, expected = (getattr(fit[plane], name) for fit in (alone, whole))
            assert found.value == pytest.approx(expected.value, rel=1e-9)
            assert found.error == pytest.approx(expected.error, rel=1e-9)
    assert alone.x.screen.beta.value == pytest.approx(alone.x.beta.value, rel=1e-12)


def test_dispersion_of_a_row_is_taken_from_its_matrix():
    r = seen_from(fodo(), WIRES)
    widened = {p: np.column_stack([m, np.full(5, 0.3)]) for p, m in r.items()}
    size = {p: np.hypot(v, 0.3 * 1e-4) for p, v in sizes_at(r).items()}
    scan = beamfit.QuadScan(
        {}, {}, size, {p: 0.01 * v for p, v in size.items()}, screen=WIRES, transfer=widened,
        energy=np.full(5, 135.0), energy_spread=np.full(5, 1e-4)
    )  # fmt: skip
    assert beamfit.fit_emittance(scan).y.emittance.value == pytest.approx(2e-9, rel=1e-9)


def test_what_rows_with_matrices_cannot_be_asked():
    own = wire_scan(WIRES, 0.005, transfer=seen_from(fodo(), WIRES), energy=np.full(5, 135.0))
    for scenario in ("calibration", "transport-network", "focusing-network"):
        with pytest.raises(InputError, match="matrices of their own"):
            beamfit.fit_emittance(own, scenario=scenario)
    with pytest.raises(InputError, match="one of the two"):
        beamfit.fit_emittance(own, fodo())
    with pytest.raises(InputError, match="no beam energy"):
        beamfit.fit_emittance(wire_scan(WIRES, transfer=seen_from(fodo(), WIRES)))
    with pytest.raises(InputError, match="a lattice"):
        beamfit.fit_emittance(wire_scan(WIRES))
    with pytest.raises(InputError, match="2 distinct screens"):
        wire_scan(WIRES[:2])


def rows_of(scan, r=None):
    columns = {"screen": scan.screen}
    for plane in "xy":
        columns[f"rms_{plane}_mm"] = (1e3 * scan.size[plane]).tolist()
        columns[f"rms_{plane}_sd_mm"] = (1e3 * scan.error[plane]).tolist()
    if r is not None:
        columns |= {"r11": r["x"][:, 0], "r12_x": r["x"][:, 1], "R33": r["y"][:, 0]}
        columns |= {"r12_y_m": r["y"][:, 1]}
    cells = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(map(str, row)) for row in cells)])


@pytest.fixture
def answer(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["beamfit", *arguments])
        with pytest.raises(SystemExit) as stopped:
            main()
        return stopped.value.code, *capsys.readouterr()

    return call


def test_the_command_needs_no_magnet_column_and_no_lattice(answer, tmp_path):
    scan, r = wire_scan(WIRES, 0.005), seen_from(fodo(), WIRES)
    (tmp_path / "wires.csv").write_text(rows_of(scan))
    (tmp_path / "line.toml").write_text(FODO)
    (tmp_path / "own.csv").write_text(rows_of(scan, r))
    by_line = answer("emittance", "wires.csv", "--lattice", "line.toml", "--report", "a.html")
    by_rows = answer("emittance", "own.csv", "--energy", "135", "--report", "b.pdf")
    assert (by_line[0], by_rows[0]) == (0, 0)
    for word in ("normalised emittance", "beta at the start", "chi2/dof"):
        lines = [next(t for t in out.splitlines() if t.startswith(word)) for _, out, _ in
                 (by_line, by_rows)]  # fmt: skip
        assert lines[0].split() == lines[1].split()
    protons = answer("emittance", "own.csv", "--energy", "1000", "--particle", "proton", "--json")
    found = json.loads(protons[1])["results"][0]
    ratio = found["normalized_emittance"]["value"] / found["emittance"]["value"]
    assert ratio == pytest.approx(np.sqrt((1000.0 / 938.27208943) ** 2 - 1), rel=1e-9)
    for arguments, word in (
        (["wires.csv"], "--lattice FILE"),
        (["own.csv"], "energy_MeV"),
        (["own.csv", "--energy", "0.135"], "GeV"),
        (["own.csv", "--lattice", "line.toml"], "no --lattice"),
        (["wires.csv", "--lattice", "line.toml", "--particle", "proton"], "--particle"),
    ):
        code, out, err = answer("emittance", *arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert word in err


def test_elements_that_are_missing_are_named(answer, tmp_path):
    text = rows_of(wire_scan(WIRES), seen_from(fodo(), WIRES))
    (tmp_path / "own.csv").write_text(text.replace("R33", "note_R33"))
    code, _, err = answer("emittance", "own.csv", "--energy", "135")
    assert code == 2
    assert "r11_y" in err


THREE = ("W0", "W1", "W4")


def test_three_monitors_give_values_and_say_that_nothing_tests_them():
    scan = wire_scan(THREE, 0.01)
    fit = beamfit.fit_emittance(scan, fodo()).x
    assert (fit.status.value, fit.dof) == ("converged", 0)
    assert "not testable" in fit.message
    # Linear propagation from the sizes, by differences of the exact solution.
    r = seen_from(fodo(), THREE)["x"]
    design = np.stack([r[:, 0] ** 2, 2 * r[:, 0] * r[:, 1], r[:, 1] ** 2], -1)

    def emittance(size):
        s11, s12, s22 = np.linalg.solve(design, size**2)
        return np.sqrt(s11 * s22 - s12**2)

    size, error = scan.size["x"], scan.error["x"]
    step = 1e-5 * size
    slopes = [(emittance(size + d) - emittance(size - d)) / (2 * d.sum()) for d in np.diag(step)]
    assert fit.emittance.value == pytest.approx(emittance(size), rel=1e-9)
    linear = np.hypot.reduce(slopes * error)
    assert fit.emittance.error_raw == pytest.approx(linear, rel=1e-6)
    # Nothing tests the errors: half of the central 68 % of the mixture that their prior says.
    factor, weight = stated_scales(Noise(), size, error)
    scatter, further = lognormal_grid(Noise().scatter)
    wider = np.append(factor, np.hypot(1.0, scatter / 0.01))
    weight = np.concatenate([weight[:1], 0.5 * weight[1:], 0.5 * (1.0 - weight[0]) * further])
    inside = brentq(lambda x: weight @ (2.0 * norm.cdf(x / wider) - 1.0) - 0.6827, 0.1, 30.0)
    assert fit.emittance.error == pytest.approx(inside * linear, rel=0.1)


def test_three_monitors_without_errors_and_three_settings_of_a_magnet_are_refused():
    scan = wire_scan(THREE, 0.01)
    bare = beamfit.QuadScan({}, {}, scan.size, screen=THREE)
    assert beamfit.fit_emittance(bare, fodo()).x.status.value == "unidentified"
    moved = beamfit.QuadScan(
        {"Q0": [8.0, 8.5, 9.0]}, {"Q0": "k1"}, scan.size, scan.error, screen=THREE
    )
    assert beamfit.fit_emittance(moved, fodo()).x.status.value == "unidentified"


@simulations(50, 200)
def test_errors_of_three_monitors_cover(count):
    """95 % of intervals of the answers that are given hold the truth, within binomial limits."""
    r, truth = {"x": seen_from(fodo(), THREE)["x"]}, 2e-9
    true, rng, line = sizes_at(r)["x"], np.random.default_rng(12), fodo()
    held = []
    for _ in range(count):
        size = true * (1 + 0.02 * rng.normal(size=3))
        scan = beamfit.QuadScan({}, {}, {"x": size}, {"x": 0.02 * true}, screen=THREE)
        found = beamfit.fit_emittance(scan, line).x.emittance
        if found.error is not None:
            low, high = found.interval_95
            held.append(low < truth < high)
    assert len(held) > 0.75 * count
    assert abs(np.mean(held) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / len(held))


def test_advice_where_no_magnet_moved_needs_limits():
    fit = beamfit.fit_emittance(wire_scan(WIRES, 0.005), fodo())
    with pytest.raises(InputError, match="--vary"):
        plan_measurements(fit)
    advice = plan_measurements(fit, limits={"Q0": (5.0, 9.0)}, count=1)
    assert 5.0 <= advice.steps[0].candidate.settings["Q0"] <= 9.0
    own = wire_scan(WIRES, 0.005, transfer=seen_from(fodo(), WIRES), energy=np.full(5, 135.0))
    with pytest.raises(InputError, match="a lattice"):
        plan_measurements(beamfit.fit_emittance(own), limits={"Q0": (5.0, 9.0)})


def test_a_transport_network_needs_something_that_changes():
    with pytest.raises(
        InputError, match="no magnet and no energy changes; expected scenario known"
    ):
        beamfit.fit_emittance(wire_scan(WIRES[:4]), fodo(), scenario="transport-network")


def test_one_number_holds_for_all_rows():
    for name in ("shots", "energy", "resolution", "energy_spread"):
        scan = wire_scan(WIRES, **{name: 5})
        assert getattr(scan, name).tolist() == [5] * len(WIRES)
    for name, wrong in (("shots", 0), ("shots", [5, 5]), ("energy", "135 MeV"), ("energy", [1.0])):
        with pytest.raises(InputError, match=f"column '{name}'"):
            wire_scan(WIRES, **{name: wrong})


def test_what_keeps_a_beam_from_being_sure_is_named():
    """Sizes at random are a likelier rival of four monitors than a beam of no emittance."""
    drifts = [part for i in range(4) for part in (Drift(f"D{i}", 0.312755), Screen(f"W{i}"))]
    size = np.array([3.457, 2.689, 2.437, 2.884]) * 1e-5
    scan = beamfit.QuadScan({}, {}, {"x": size}, {"x": 0.035 * size}, screen=WIRES[:4])
    fit = beamfit.fit_emittance(scan, Beamline(tuple(drifts), 785.9)).x
    probability = fit.identifiability.probability
    assert probability["beam"] < 0.99 < probability["beam"] + probability["beam of no emittance"]
    assert "a beam's (P = 0.9898, and 0.99 is needed), or else sizes at random" in fit.message
