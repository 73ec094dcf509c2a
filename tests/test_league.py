"""The league's own judgement, on a few draws; all of it is `make league`."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

import beamfit
from benchmarks import verdict
from benchmarks.decay_families import Case, Decay, decay
from benchmarks.league import decay_tools, honesty, page
from benchmarks.league.answers import Answer, of_draws, of_sigma, score

RIGHT = Answer(1.05, 0.1, (0.85, 1.25))
FAMILIES = [(field, kind) for field in honesty.FIELDS for kind in honesty.KINDS]


@pytest.mark.parametrize(
    ("answer", "truth", "wrong"),
    [
        (Answer(1.2, 0.05, (1.1, 1.3)), 1.0, True),  # 3.9 errors
        (Answer(1.03, 0.005, (1.02, 1.04)), 1.0, True),  # whatever the size
        (Answer(1.2, 0.1, (1.0, 1.4)), 1.0, False),
        (Answer(1.2), 1.0, True),  # no error, and 20 % off
        (Answer(1.09), 1.0, False),
        (Answer(1.2, 0.3, (0.6, 1.8)), 0.0, True),  # nothing is there
        (Answer(1.2, 0.5, (0.2, 2.2)), 0.0, False),
        (Answer(1.5, 0.1, (1.1, 1.52)), 1.0, False),  # its interval reaches down
        (Answer(1.5, 0.1, (1.1, 1.52)), 2.0, True),
    ],
)
def test_wrong_is_beyond_three_errors_towards_the_truth(answer, truth, wrong):
    assert answer.wrong(truth) is wrong


def test_few_residuals_widen_an_interval_by_students_factor():
    """One residual to spare: Cauchy's tangent."""
    found = of_sigma(2.0, 0.1, 1)
    low, high = found.interval_95
    assert (high - low) / 2 == pytest.approx(0.1 * math.tan(0.475 * math.pi))
    assert found.error == pytest.approx(0.1 * math.tan(0.341345 * math.pi), rel=1e-4)
    assert not of_sigma(2.0, 0.1, 0).given


def test_a_sample_is_its_median_and_central_intervals():
    found = of_draws(np.linspace(0.0, 1.0, 10_001))
    assert found == (pytest.approx(0.5), pytest.approx(0.34), pytest.approx((0.025, 0.975)))


def test_scores_count_answers_cover_and_wrong_ones():
    far, none = Answer(3.0, 0.1, (2.8, 3.2)), Answer(0.1, 0.1, (-0.1, 0.3))
    found = score([1.0, 1.0, 1.0, 0.0], [RIGHT, far, None, none])
    assert found["draws"], found["answered"] == (4, 3)
    assert [found[k] for k in ("sure", "in_68", "in_95", "wrong")] == [2, 1, 1, 1]
    assert found["bias"] == pytest.approx((0.05 + 2.0) / 2)


def test_binomial_limits_are_those_of_no_hit_and_of_all():
    """Clopper-Pearson of none of n: 1 - (alpha/2)^(1/n)."""
    end = 100 * (1 - 0.025 ** (1 / 10))
    assert page.limits(0, 10) == f"0(0–{end:.0f})"
    assert page.limits(10, 10) == f"100({100 - end:.0f}–100)"


@pytest.mark.parametrize(("field", "kind"), FAMILIES)
def test_families_draw_anew_and_the_same_for_the_same_seed(field, kind):
    for name in honesty.cases(field, kind):
        one, again, other = (honesty.drawn(field, kind, name, 1, k) for k in (0, 0, 1))
        numbers = [
            np.ravel(c.size if field == "scans" else c.record.current) for c in (one, again, other)
        ]
        assert np.array_equal(numbers[0], numbers[1]), name
        assert not np.array_equal(numbers[0], numbers[2]), name


def test_lines_have_the_phases_that_were_asked_for():
    t = verdict.truth(np.random.default_rng(3), 8)
    r11, r12 = t.line.rows(t.k1).T
    phase = np.arctan2(t.beta * r11, r12)
    assert np.allclose(np.diff(phase), np.diff(phase)[0], atol=1e-3)
    line = verdict.beamline(t.line)
    matrix = np.array([np.asarray(line.matrix({"Q": k}).x)[0, :2] for k in t.k1])
    assert np.allclose(matrix, t.line.rows(t.k1), rtol=1e-9)


def test_the_true_lifetime_of_a_decay_is_that_of_its_law():
    """Constant a and b: between two currents the time is the integral of 1/(I (a I + b))."""
    case = decay(Decay(level=(-9.0, -8.9)), np.random.default_rng(2))
    a, _ = case.truth()
    time, current = case.record.time, case.record.current
    first, last = current[0], current[-1]

    def rate(i):
        return 1 / (3600 * case.truth(i)[1])

    spent, _ = quad(lambda i: 1 / (i * rate(i)), last, first)
    assert spent == pytest.approx(time[-1] - time[0], rel=1e-4)
    assert (rate(200.0) - rate(100.0)) / 100.0 == pytest.approx(a)


def test_beamfit_refuses_traps_that_a_script_answers():
    seed, draws = 5, 4
    hill = honesty.family("scans", "traps", "a hill", seed, draws)["tools"]
    assert hill["beamfit"]["emittance"]["answered"] == 0
    mixed = [honesty.drawn("scans", "traps", "a tent", seed, k) for k in range(draws)]
    peer = honesty.measured("scans", "sddsemitproc's method", mixed)["emittance"]
    assert peer["wrong"] >= 3
    flat = [honesty.drawn("decays", "traps", "no decay", seed, k) for k in range(draws)]
    assert honesty.measured("decays", "beamfit", flat)["loss"]["wrong"] == 0
    assert all(isinstance(one, Case) for one in flat)


def test_a_missing_peer_stops_the_run_in_one_line(monkeypatch):
    monkeypatch.setattr(honesty, "PEERS", ("a_peer_nobody_has",))
    with pytest.raises(SystemExit, match="a_peer_nobody_has is not installed"):
        honesty.refuse_if_missing()


# Quadrupole .108 m, 2.2094 m before the screen, of a simulated beam of 1 µm at 135 MeV.
LINE = verdict.Line(0.108, ((0.0, 2.2094),))


def plane(k1: list[float], micrometres: list[float]):
    scan = beamfit.QuadScan({"Q": k1}, {"Q": "k1"}, {"x": 1e-6 * np.array(micrometres)})
    return beamfit.fit_emittance(scan, replace(verdict.beamline(LINE), energy=135.0)).x


def test_one_side_of_the_waist_has_an_interval_that_reaches_to_the_truth():
    """A draw of the league: 1.52 ± 0.12 µm once of a beam of 1 µm, 5.1 errors from none."""
    k1 = [7.4772, 8.7434, 10.0096, 11.2758, 12.542, 13.8082, 15.0744, 16.3406]
    fit = plane(k1, [72.5, 92.32, 133.04, 178.9, 232.99, 287.68, 341.07, 363.73])
    low, high = fit.normalized_emittance.interval_95
    assert low < 1e-6 < high
    assert "the waist is not bracketed" in fit.message


def test_two_wild_neighbours_that_hide_each_other_are_in_the_interval():
    """1.31 ± 0.09 µm of 1 µm once: none is surely bad, and the interval holds both answers."""
    k1 = np.linspace(1.5683, 10.4317, 10)
    sizes = [202.54, 167.33, 126.77, 95.72, 63.77, 76.63, 102.41, 94.51, 126.57, 157.14]
    fit = plane(k1, sizes)
    low, high = fit.normalized_emittance.interval_95
    assert low < 1e-6 < high
    assert np.argmax(fit.points.outlier_probability) in (5, 6)


def test_a_is_not_claimed_where_the_bunch_may_lengthen_unseen():
    """A third of a lifetime, a as I^-1/3: the interval of a holds the truth and is wide."""
    case = decay(Decay(exponent=-1 / 3, span=(0.3, 0.35)), np.random.default_rng(3))
    fit = decay_tools.beamfit_fit(case)
    low, high = fit.a.interval_95
    assert low < case.truth(fit.mean_current)[0] < high
    assert fit.a.error > 0.1 * fit.a.value
