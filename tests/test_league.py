"""The league's own judgement, on two traps and three draws; all of it is `make league`."""

import math

import numpy as np
import pytest

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


def test_one_side_of_the_waist_has_an_interval_that_reaches_to_the_truth():
    """A draw the league found: 1.52 ± 0.12 µm of a beam of 1 µm, 5.1 errors from none."""
    fit = beamfit_fit(drawn("scans", "traps", "one side, 5 %, no errors", 28)).x
    low, high = fit.normalized_emittance.interval_95
    assert low < 1e-6 < high
    assert "the waist is not bracketed" in fit.message


def test_two_wild_neighbours_that_hide_each_other_are_in_the_interval():
    """1.31 ± 0.09 µm of 1 µm once: none is surely bad, and the interval holds both answers."""
    fit = beamfit_fit(drawn("scans", "traps", "two outliers of ten, no errors", 92)).x
    low, high = fit.normalized_emittance.interval_95
    assert low < 1e-6 < high
    assert np.argmax(fit.points.outlier_probability) in (5, 6)


def test_b_is_not_claimed_where_the_bunch_may_lengthen_unseen():
    """A third of a lifetime with a as I^-0.3: b comes out at 7.5e-6 ± 0.2 % 1/s, truth 5e-6."""
    for kind, name in (
        ("hidden", "bunches lengthen, a third of a lifetime"),
        ("good", "6 h, 400 readings"),
    ):
        case = drawn("decays", kind, name, 3)
        fit = beamfit_fits(case)[0]
        low, high = fit.b.interval_95
        assert fit.status == "converged"
        assert low < case.b < high
        assert fit.b.error > 0.2 * fit.b.value
        assert not any(
            answer.wrong(case.b) for name, answer in told(case).items() if name[0] == "b"
        )
