"""The posterior in the report page."""

from __future__ import annotations

import numpy as np
import pytest

import beamfit
from beamfit.lifetime.fit import fit_decay
from beamfit.lifetime.record import DecayRecord
from beamfit.report.posterior import draw_pairs


@pytest.fixture(scope="module")
def decay():
    return fit_decay(beamfit.read_decay_record("measurements/aps_1999_decay.csv"))


@pytest.fixture(scope="module")
def posterior(decay):
    return decay.sample(seed=1, target_ess=1000)


def test_write_report_with_a_posterior(tmp_path, decay, posterior, well_shown):
    page = tmp_path / "aps.html"
    beamfit.write_report(page, decay, posterior)
    html = page.read_text()
    assert "posterior sampled" in html
    assert "current expected of aps_1999_decay.csv" in html
    assert "a, 1e-8 1/(mA s)" in html
    assert html.count("<img") == 4
    assert well_shown(page, 4) == []
    # a and b: nearly one number, shown with the digits that say how nearly.
    assert "-0.999" in html


def test_a_posterior_that_was_not_sampled_says_why(tmp_path):
    fit = fit_decay(DecayRecord([0, 60, 120, 180, 240], [100.0] * 5, name="flat"))
    page = tmp_path / "flat.html"
    beamfit.write_report(page, fit, fit.sample())
    html = page.read_text()
    assert "posterior not sampled" in html
    assert "neither decay nor noise" in html
    assert ">nan<" not in html
    assert "Correlations" not in html


def test_pairs_are_drawn_with_every_number(posterior):
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    draw_pairs(figure, posterior, ("lifetime_mean", "a", "b"))
    shown = [axes for axes in figure.axes if axes.axison]
    assert len(shown) == 6
    labels = [axes.get_xlabel() for axes in figure.axes if axes.get_xlabel()]
    assert labels == ["lifetime mean\nh", "a\n1e-8 1/(mA s)", "b\n1e-6 1/s"]
    a, b = (posterior.values(name) for name in "ab")
    dots = next(axes for axes in shown if axes.lines and len(axes.lines[0].get_xdata()) == 2000)
    np.testing.assert_allclose(dots.lines[0].get_xdata(), a[:2000] * 1e8)
    np.testing.assert_allclose(dots.lines[0].get_ydata(), b[:2000] * 1e6)
