"""Public figures, and the pages they stand on: told apart, whole, and not half empty."""

import re
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

import beamfit
import beamfit.figures
from beamfit.errors import InputError
from beamfit.report.document import day_of, with_provenance
from beamfit.report.emittance import emittance_page
from beamfit.report.lifetime import decay_page, study_of
from beamfit.report.pdf import HEIGHT, pages_of


def fitted(root, scan, lattice):
    line = beamfit.load_lattice(root / f"lattices/{lattice}.toml")
    return beamfit.fit_emittance(beamfit.read_quad_scan(root / scan), line)


@pytest.fixture(scope="module")
def two(root):
    return fitted(root, "measurements/gtf_two_screens_simulated.csv", "gtf_two_screens")


@pytest.fixture(scope="module")
def otr(root):
    return fitted(root, "measurements/lcls_otr2.csv", "lcls_otr2")


@pytest.fixture(scope="module")
def noise(root):
    return fitted(root, "tests/golden/data/noise.csv", "gtf")


@pytest.fixture(scope="module")
def decay(root):
    return beamfit.fit_decay(beamfit.read_decay_record(root / "measurements/aps_1999_decay.csv"))


def test_each_is_a_figure(otr, decay):
    posterior = decay.sample(seed=1, target_ess=100)
    drawn = [
        beamfit.figures.scan(otr, "y"),
        beamfit.figures.residuals(otr),
        beamfit.figures.phase_space(otr),
        beamfit.figures.decay(decay),
        beamfit.figures.lifetime(decay),
        beamfit.figures.pairs(posterior, ["a", "b"]),
    ]
    for figure in drawn:
        assert isinstance(figure, Figure)
        FigureCanvasAgg(figure).draw()
        assert any(axes.has_data() for axes in figure.axes)


def test_each_picture_of_a_page_says_where_it_comes_from(otr, decay):
    pages = emittance_page(otr), decay_page((study_of(decay),))
    for page, words in zip(pages, ("2020-06-22, line LCLS OTR2", "1999-02-11"), strict=True):
        assert all(words in picture.source for picture in page.pictures)
    scans = [p for p in pages[0].pictures if p.alt.startswith("scan")]
    assert [re.search(r"[xy]: χ²/dof \S+", p.source)[0] for p in scans] == [
        f"{p.plane}: χ²/dof {p.chi2:.3g}/{p.dof}" for p in otr.planes
    ]
    drawn = beamfit.figures.scan(otr, "x")
    assert drawn.get_suptitle() == scans[0].source


def test_a_day_is_said_only_where_the_file_states_one():
    assert day_of("OTRS-2021-02-18-124043.mat", ()) == "2021-02-18"
    assert day_of("scan.csv", ("taken 22 June 2020",)) == "2020-06-22"
    assert day_of("scan.csv", ("taken 22 June 2020, calibrated 2019-03-01",)) == ""
    assert day_of("scan-20210299.csv", ("2021-02-31",)) == ""


def test_a_curve_goes_through_what_was_fitted(otr):
    above = beamfit.figures.scan(otr, "x").axes[0]
    curve = next(line for line in above.lines if line.get_label() == "fit")
    at = otr.x.points.settings["Q525"]
    order = np.argsort(curve.get_xdata())
    drawn = np.interp(at, curve.get_xdata()[order], curve.get_ydata()[order])
    np.testing.assert_allclose(drawn, 1e6 * otr.x.points.model, rtol=2e-3)


def test_a_bad_reading_is_hollow_and_has_no_bar(root):
    scan = beamfit.read_quad_scan(root / "tests/golden/data/outlier.csv")
    fit = beamfit.fit_emittance(scan, beamfit.load_lattice(root / "lattices/gtf.toml"))
    above, below = beamfit.figures.scan(fit, "x").axes
    bars = {c.get_label(): c for c in above.containers}
    assert bars["measured"].has_yerr
    assert not bars["probably bad"].has_yerr
    hollow = [line for line in below.lines if line.get_mfc() == "white"]
    assert sum(len(line.get_xdata()) for line in hollow) == 1


def test_two_screens_are_told_apart(two):
    above, below = beamfit.figures.scan(two, "x").axes
    labels = [text.get_text() for text in above.get_legend().get_texts()]
    screens = ("SCREEN", "PRE")
    assert sorted(labels) == sorted(f"{w} at {s}" for w in ("measured", "fit") for s in screens)
    points = [bars.lines[0] for bars in above.containers]
    curves = [line for line in above.lines if str(line.get_label()).startswith("fit")]
    residuals = [line for line in below.lines if line.get_marker() in "os"]
    for drawn in (points, curves, residuals):
        assert len({to_rgb(line.get_color()) for line in drawn}) == 2
    assert len({line.get_marker() for line in points}) == 2
    assert len({line.get_linestyle() for line in curves}) == 2


def test_what_is_not_determined_has_no_ellipse(noise, otr):
    with pytest.raises(InputError, match="without phase ellipses"):
        beamfit.figures.phase_space(noise)
    assert not any("ellipse" in p.alt for p in emittance_page(noise).pictures)
    # One plane with β and α, the other without: one ellipse at each place.
    open_ = replace(otr.y, beta=replace(otr.y.beta, error=None, interval_95=None))
    half = replace(otr, planes=(otr.x, open_))
    start, screen = beamfit.figures.phase_space(half).axes
    for axes in (start, screen):
        assert [line.get_label() for line in axes.lines if line.get_label() in "xy"] == ["x"]


def test_what_cannot_be_drawn_is_said(otr):
    with pytest.raises(InputError, match="no fit of plane 'z'"):
        beamfit.figures.scan(otr, "z")


def test_matplotlib_is_loaded_when_something_is_drawn():
    check = "import beamfit.figures, sys; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.fixture(scope="module")
def pages(otr, two, noise, decay):
    """Drawn pages of a PDF, once for each fit."""

    @cache
    def of(name):
        if name == "decay":
            found = pages_of(with_provenance(decay_page((study_of(decay),))))
        else:
            fit = {"otr": otr, "two": two, "noise": noise}[name]
            if name == "otr":  # names as long as people make them
                scan = replace(fit.scan, name="a_scan_with_a_name_" * 9, provenance=("W" * 300,))
                fit = replace(fit, scan=scan)
            said = "beamfit emittance " + "/a/long/path" * 30
            found = pages_of(with_provenance(emittance_page(fit), said))
        for page in found:
            FigureCanvasAgg(page).draw()
        return found

    return of


@pytest.mark.parametrize("name", ["otr", "two", "noise", "decay"])
def test_pages_have_numbers_and_nothing_is_cut_off(pages, name):
    found = pages(name)
    for number, page in enumerate(found, 1):
        texts = [text for text in page.texts if text.get_text()]
        assert f"page {number} of {len(found)}" in [text.get_text() for text in texts]
        for drawn in [*texts, *(axes for part in page.subfigs for axes in part.axes)]:
            box = drawn.get_tightbbox(page.canvas.get_renderer())
            assert page.bbox.x0 <= box.x0 < box.x1 <= page.bbox.x1
            assert page.bbox.y0 <= box.y0 < box.y1 <= page.bbox.y1


@pytest.mark.parametrize("name", ["otr", "two", "decay"])
def test_no_page_but_the_last_is_half_empty(pages, name):
    for page in pages(name)[:-1]:
        feet = [text.get_position()[1] for text in page.texts if text.get_position()[1] > 0.05]
        feet += [part.bbox.y0 / page.bbox.height for part in page.subfigs]
        assert min(feet) < 0.45, HEIGHT


def test_columns_of_a_page_give_way_to_a_small_screen(otr, tmp_path):
    beamfit.write_report(tmp_path / "otr.html", otr)
    style = (tmp_path / "otr.html").read_text().split("</style>")[0]
    for least in re.findall(r"minmax\((.*?), 1fr\)", style):
        assert least.startswith("min(100%,")
    assert "width=device-width" in style


def test_pictures_do_not_hang_on_the_matplotlibrc_of_the_user(tmp_path):
    """TeX, which is not installed everywhere, wide lines, black paper."""
    fit = beamfit.fit_decay("measurements/aps_1999_decay.csv")
    own = {"text.usetex": True, "lines.linewidth": 9, "axes.facecolor": "black", "font.size": 30}
    with rc_context(own):
        beamfit.write_report(tmp_path / "own.png", fit)
        shown = fit.plot()._repr_png_()
    beamfit.write_report(tmp_path / "usual.png", fit)
    assert (tmp_path / "own.png").read_bytes() == (tmp_path / "usual.png").read_bytes()
    assert shown == fit.plot()._repr_png_()
