"""The page and picture of a table of lifetimes."""

import numpy as np
import pytest

import beamfit
from beamfit.lifetime.record import LifetimeTable
from beamfit.report.lifetime_table import fitted_lifetime

CURRENT = np.linspace(50, 500, 14)


def table(exponent=0.0, slip=1.0):
    rate = 0.02 * (CURRENT / 250) ** (1 + exponent) + 0.01
    lifetime = 1 / rate
    lifetime[5] *= slip
    return LifetimeTable(CURRENT, lifetime, 0.01 / rate, "table.csv", notes=("A note.",))


@pytest.mark.parametrize("law", ["free", "constant"])
@pytest.mark.parametrize("exponent", [0.0, 0.9])
def test_the_curve_is_the_quoted_law(exponent, law):
    fit = beamfit.fit_lifetimes(table(exponent), law)
    curve = fitted_lifetime(fit, CURRENT)
    np.testing.assert_allclose(curve, table(exponent).lifetime, rtol=0.01)
    quoted = fit.lifetime_start.value, fit.lifetime_end.value
    np.testing.assert_allclose(curve[[-1, 0]], quoted, rtol=0.002)


def test_a_point_that_was_left_out_is_marked(tmp_path):
    fit = beamfit.fit_lifetimes(table(slip=10.0))
    figure = fit.plot()
    labels = figure.axes[0].get_legend_handles_labels()[1]
    assert "left out, 1 beyond the axes" in labels
    lifetimes, _ = figure.axes[1].containers[0].lines[0].get_data()
    assert len(lifetimes) == CURRENT.size - 1
    beamfit.write_report(tmp_path / "page.html", fit)
    page = (tmp_path / "page.html").read_text()
    assert "Beam lifetime of table.csv" in page
    assert "A note." in page
    assert "Left out as outliers: point 6" in page
