"""What to measure next: against brute force, and against what the measurement then does."""

import numpy as np
import pytest

import beamfit
from beamfit.emittance.advice import candidate_settings
from beamfit.emittance.design import plan_measurements
from beamfit.errors import InputError
from beamfit.quantity import Status
from tests.emittance.conftest import TABLE_2, design


@pytest.fixture(scope="module")
def scan(root):
    return beamfit.read_quad_scan(root / "measurements/gtf_simulated.csv")


@pytest.fixture(scope="module")
def known(scan, gtf):
    return beamfit.fit_emittance(scan, gtf)


@pytest.fixture(scope="module")
def free(scan, gtf):
    return beamfit.fit_emittance(scan, gtf, scenario="calibration")


def emittance_error(fit, rows, relative):
    """Relative emittance error after further rows, by inverting the normal matrix anew."""
    x = fit.x
    sigma = np.array([q.value for q in x.sigma])
    information = np.linalg.inv(x.covariance)
    for row in rows:
        information = information + np.outer(row, row) / (2 * relative * (row @ sigma)) ** 2
    gradient = np.array([sigma[2], -2 * sigma[1], sigma[0]]) / (2 * x.emittance.value)
    return np.sqrt(gradient @ np.linalg.inv(information) @ gradient) / x.emittance.value


def test_the_first_point_is_the_best_of_all(gtf, known):
    limits = {"Q2": (0.0, 5.0)}
    advice = plan_measurements(known, limits=limits, count=1)
    [step] = advice.steps
    currents = np.linspace(0.0, 5.0, 41)
    rows = design(gtf, {"Q2": currents})
    relative = float(np.median(known.x.points.error / known.x.points.size))
    errors = [emittance_error(known, [row], relative) for row in rows]
    # Draws of the posterior and linear theory at the best fit agree in what a point is worth.
    chosen = int(np.argmin(np.abs(currents - step.candidate.settings["Q2"])))
    assert errors[chosen] < 1.003 * min(errors)
    gain = errors[chosen] / emittance_error(known, [], relative)
    assert step.relative_error["x"] / advice.now["x"] == pytest.approx(gain, rel=1e-2)
    assert advice.now["x"] == pytest.approx(known.x.emittance.relative, rel=1e-4)


def test_d_optimal_is_best_in_volume(gtf, known):
    advice = plan_measurements(known, limits={"Q2": (0.0, 5.0)}, criterion="D", count=1)
    currents = np.linspace(0.0, 5.0, 41)
    rows = design(gtf, {"Q2": currents})
    sigma = np.array([q.value for q in known.x.sigma])
    relative = float(np.median(known.x.points.error / known.x.points.size))
    # det(A + r rT/v) = det A (1 + rT A^-1 r/v)
    gains = [row @ known.x.covariance @ row / (2 * relative * (row @ sigma)) ** 2 for row in rows]
    chosen = int(np.argmin(np.abs(currents - advice.steps[0].candidate.settings["Q2"])))
    assert gains[chosen] > 0.97 * max(gains)


def test_measuring_what_is_advised_does_what_was_promised(gtf, scan, known):
    advice = plan_measurements(known, limits={"Q2": (0.0, 5.0)}, count=4)
    more = np.array([s.candidate.settings["Q2"] for s in advice.steps])
    sizes = np.sqrt(design(gtf, {"Q2": more}) @ TABLE_2)
    together = beamfit.QuadScan(
        {"Q2": np.append(scan.settings["Q2"], more)},
        {"Q2": "A"},
        {"x": np.append(scan.size["x"], sizes)},
        {"x": np.append(scan.error["x"], 0.02 * sizes)},
    )
    after = beamfit.fit_emittance(together, gtf).x.emittance.relative
    assert after == pytest.approx(advice.steps[-1].relative_error["x"], rel=0.05)


def test_it_stops_at_the_goal_and_when_nothing_is_left_to_gain(known):
    near = plan_measurements(known, goal=0.0100, count=10)
    assert near.steps[-1].relative_error["x"] <= 0.0100 < near.steps[-2].relative_error["x"]
    assert near.stop.startswith("Stop")
    done = plan_measurements(known, goal=0.05)
    assert done.steps == ()
    long = plan_measurements(known, count=200)
    assert len(long.steps) < 100
    assert "repeat the scan instead" in long.stop


def test_an_open_calibration_is_told_which_measurement_closes_it(free):
    advice = plan_measurements(free)
    assert not advice.identified
    verdicts = {o.words: o.identified for o in advice.options}
    assert verdicts["the same scan on a new screen in the middle of D1"]
    assert verdicts["a prior of 2 % on Q2.slope"]
    assert not verdicts["the same scan at 38.12 MeV"]
    assert not any(s.identified for s in advice.steps)
    assert "It would be determined with" in advice.message


def test_each_plane_has_the_errors_of_its_own_fit(root, otr2):
    """The noise of y is no business of x, nor the other way round."""
    read = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    error = {"x": 0.02 * read.size["x"], "y": 0.04 * read.size["y"]}
    scan = beamfit.QuadScan(read.settings, read.units, read.size, error)
    fit = beamfit.fit_emittance(scan, otr2)
    assert fit.y.emittance.relative > 1.4 * fit.x.emittance.relative
    now = plan_measurements(fit, count=1).now
    for plane in fit.planes:
        assert now[plane.plane] == pytest.approx(plane.emittance.relative, rel=1e-3)


def test_the_status_is_one_of_all_statuses(known, free):
    assert plan_measurements(known, count=1).to_json()["status"] == Status.converged
    assert plan_measurements(free, count=1).to_json()["status"] == Status.unidentified


def test_and_that_measurement_closes_it(root):
    """The second screen of gtf_two_screens.toml is the advised kind."""
    scan = beamfit.read_quad_scan(root / "measurements/gtf_two_screens_simulated.csv")
    line = beamfit.load_lattice(root / "lattices/gtf_two_screens.toml")
    first = np.array(scan.screen) == "SCREEN"
    alone = beamfit.QuadScan(
        {"Q2": scan.settings["Q2"][first]}, {"Q2": "A"}, {"x": scan.size["x"][first]},
        {"x": scan.error["x"][first]}, screen=("SCREEN",) * 14,
    )  # fmt: skip
    before = beamfit.fit_emittance(alone, line, scenario="calibration")
    option = next(
        o for o in plan_measurements(before).options if o.words == "the same scan on screen PRE"
    )
    assert before.x.emittance.error is None
    assert option.identified
    after = beamfit.fit_emittance(scan, line, scenario="calibration")
    assert after.x.emittance.relative == pytest.approx(option.relative_error["x"], rel=0.2)


def test_settings_mean_what_their_column_says(gtf, scan, known):
    """The same scan in k1, of a lattice that is set in amperes."""
    magnet = gtf["Q2"]
    k1 = np.array([float(magnet.k1(i, gtf.energy)) for i in scan.settings["Q2"]])
    twin = beamfit.QuadScan({"Q2": k1}, {"Q2": "k1"}, scan.size, scan.error)
    steps = [plan_measurements(f, count=2).steps for f in (known, beamfit.fit_emittance(twin, gtf))]
    for own, other in zip(*steps, strict=True):
        assert other.relative_error["x"] == pytest.approx(own.relative_error["x"], rel=1e-9)
    assert "1/m²" in steps[1][0].candidate.words


def test_a_magnet_that_was_not_scanned_may_be_set(known):
    [step] = plan_measurements(known, limits={"Q1": (0.0, 1.0)}, count=1).steps
    assert set(step.candidate.settings) == {"Q1", "Q2"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"limits": {"Q9": (0.0, 1.0)}}, "Q9"),
        ({"limits": {"Q2": (1.0, 0.0)}}, "lower first"),
        ({"criterion": "A"}, "emittance or D"),
        ({"count": 0}, "a count of 0; expected at least one"),
        ({"goal": 0.0}, "a goal of 0.0; expected a relative error above 0"),
    ],
)
def test_bad_wishes_are_named(known, options, words):
    with pytest.raises(InputError, match=words):
        plan_measurements(known, **options)


def test_zero_is_not_listed_as_its_rounding(known):
    """linspace(-1.7, 1.7, 41) misses zero by 2.2e-16."""
    limits = {"Q2": (-1.7, 1.7)}
    tables = candidate_settings(known.scan.settings, limits)
    settings = tables["Q2"]["Q2"].tolist()
    assert 0.0 in settings
    assert min(abs(s) for s in settings if s) > 1e-3


def test_an_energy_that_no_electron_has_is_refused(known):
    with pytest.raises(InputError, match=r"of 0\.1 MeV"):
        plan_measurements(known, energies=(0.1,))


def test_a_scan_that_ends_before_the_waist_is_led_to_it():
    """It said that no measurement would help, above a list of some, as if they were sure to."""
    line = beamfit.Beamline(
        (beamfit.Quadrupole("Q", 0.108), beamfit.Drift("D", 2.2), beamfit.Screen("S")), 135.0
    )
    emittance, beta, alpha = 3e-9, 6.0, -1.0
    noise = 1 + 0.05 * np.random.default_rng(1).standard_normal(12)

    def size(setting):
        r11, r12 = np.asarray(line.matrix({"Q": setting}).x)[0, :2]
        squared = r11**2 * beta - 2 * r11 * r12 * alpha + r12**2 * (1 + alpha**2) / beta
        return np.sqrt(emittance * squared)

    def fitted(settings):
        sizes = noise[: len(settings)] * [size(s) for s in settings]
        scan = beamfit.QuadScan({"Q": settings}, {"Q": "k1"}, {"x": sizes}, {"x": 0.05 * sizes})
        return beamfit.fit_emittance(scan, line)

    settings = np.linspace(-6.0, -1.0, 6)
    advice = plan_measurements(fitted(settings), limits={"Q": (-6.0, 10.0)}, count=2)
    assert advice.message.endswith("1/m², then ask again.")
    assert "(5 %)" in str(advice)  # for a beam that is not known: in brackets
    for _ in range(6):  # what it says, done
        setting = advice.steps[0].candidate.settings["Q"]
        settings = np.append(settings, setting)
        fit = fitted(settings)
        if fit.planes[0].emittance.error is not None:
            break
        advice = plan_measurements(fit, limits={"Q": (-6.0, 10.0)}, count=2)
    assert abs(fit.planes[0].emittance.value - emittance) < 3 * fit.planes[0].emittance.error
