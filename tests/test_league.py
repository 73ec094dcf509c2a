"""The league's own judgement, on two traps and three draws; all of it is `make league`."""

import math

import numpy as np
import pytest
from scipy.stats import f

from beamfit.studies.decay.systematics import about_fit
from benchmarks.league.answers import Answer
from benchmarks.league.decay_tools import beamfit_fits, told
from benchmarks.league.honesty import drawn, measured
from benchmarks.league.scan_tools import beamfit_fit


@pytest.mark.parametrize(
    ("answer", "truth", "wrong"),
    [
        (Answer(1.2, 0.05), 1.0, True),  # 4 errors and 20 % off
        (Answer(1.09, 0.01), 1.0, False),  # 9 errors, but 9 %
        (Answer(1.2, 0.1), 1.0, False),  # 20 %, but 2 errors
        (Answer(1.2, None), 1.0, True),
        (Answer(1.2, 0.5), 0.0, False),  # noise that claims nothing
        (Answer(1.2, 0.3), 0.0, True),
        (Answer(20.0, 1.0), math.inf, True),  # a lifetime of no decay
        (Answer(20.0, 15.0), math.inf, False),
        (Answer(1.5, 0.01, 0.2), 1.0, False),  # its interval reaches down to the truth
        (Answer(1.5, 0.01, 0.2), 2.0, True),
    ],
)
def test_confident_and_wrong_is_beyond_three_errors_and_a_tenth(answer, truth, wrong):
    assert answer.wrong(truth) is wrong


def test_beamfit_refuses_traps_that_a_plain_least_squares_answers():
    hill = {
        tool: measured("scans", "traps", "rows mixed up", 3, tool)
        for tool in ("beamfit", "sddsemitproc's method")
    }
    step = {
        tool: measured("decays", "traps", "a loss of 2 mA", 3, tool)
        for tool in ("beamfit", "scipy curve_fit")
    }
    assert hill["beamfit"]["wrong"] == step["beamfit"]["wrong"] == 0
    assert hill["beamfit"]["refused"] == 3
    assert step["beamfit"]["refused"] == 0
    assert hill["sddsemitproc's method"]["wrong"] + step["scipy curve_fit"]["wrong"] >= 3


def test_one_side_of_the_waist_is_not_answered_by_its_own_scatter():
    """A draw the league found: 1.52 ± 0.12 µm of a beam of 1 µm, 5.1 errors from none."""
    fit = beamfit_fit(drawn("scans", "traps", "one side, 5 %, no errors", 28)).x
    assert fit.status == "unidentified"
    assert "on one side of the waist" in fit.message


def test_two_wild_neighbours_are_found_where_each_hides_the_other():
    """1.31 ± 0.09 µm of 1 µm; how likely, against fits of size² without each two of the points."""
    fit = beamfit_fit(drawn("scans", "traps", "two outliers of ten, no errors", 92))
    p = fit.x.points
    rows = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], 1) / (p.weighed * p.error)[:, None]
    squares = p.size**2 / (p.weighed * p.error)

    def chi2(left_out=()):
        kept = np.delete(np.arange(10), left_out)
        return np.linalg.lstsq(rows[kept], squares[kept], rcond=None)[1][0]

    least = min(chi2([i, i + 1]) for i in range(9))
    chance = 9 * f.sf((chi2() / least - 1) * 5 / 2, 2, 5)
    assert fit.x.status == "poor_fit"
    assert "Q = 6.492 1/m² and Q = 7.477 1/m²" in fit.x.message
    assert f"(probability {chance:.1g})" in fit.x.message
    assert fit.x.emittance.value > 1.25e-6 / 264.2  # what it would have said


def test_b_is_not_claimed_where_the_bunch_may_lengthen_unseen():
    """A third of a lifetime with a as I^-0.3: b comes out at 7.5e-6 ± 0.2 % 1/s, truth 5e-6."""
    for name, asked in (
        ("bunches lengthen, a third of a lifetime", True),
        ("6 h, 400 readings", False),
    ):
        kind = "hidden" if asked else "good"
        case = drawn("decays", kind, name, 3)
        fit = beamfit_fits(case)[0]
        about = about_fit(fit)  # of b for a bunch that lengthens as it can most
        reach = about.moved(-about.rows[:, 3] / 3).b
        low, high = fit.b.interval_95
        assert fit.status == "converged"
        assert ("which this record cannot tell" in fit.message) is asked
        assert fit.b.value - low == pytest.approx(high - fit.b.value + asked * reach)
        assert fit.b.error < 0.003 * fit.b.value
        assert not any(
            answer.wrong(case.b) for name, answer in told(case).items() if name[0] == "b"
        )
