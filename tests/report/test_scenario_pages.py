"""Pages of the scenarios, and the page that sets the report's Table 2 beside this package."""

import importlib.util
import re

import pytest

import beamfit
from beamfit.emittance.assumptions import Anchor


@pytest.fixture(scope="module")
def script(root):
    """The script that writes the page, as a module."""
    place = root / "docs/gtf_reproduction.py"
    spec = importlib.util.spec_from_file_location("gtf_reproduction", place)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def inputs(root):
    scan = beamfit.read_quad_scan(root / "measurements/gtf_simulated.csv")
    return scan, beamfit.load_lattice(root / "lattices/gtf.toml")


@pytest.fixture(scope="module")
def found(script, inputs):
    return script.reproduce(*inputs, starts=3)


def test_the_first_beam_matrix_is_found_again(script, found):
    for got, true in zip(found.known.x.sigma, script.TABLE_2["known"][0], strict=True):
        assert abs(1e8 * got.value - true) < 3 * 1e8 * got.error


def test_beams_of_any_emittance_fit_when_the_transport_is_a_network(found):
    emittances = [h.emittance for h in found.held]
    assert max(emittances) > 3.9 * min(emittances)
    assert all(h.chi2 < 14.0 for h in found.held)


def test_the_published_calibration_is_two_bounds(script, found):
    assert script.BOUNDS["Q2.slope"][0] == 147.230
    assert script.BOUNDS["Q2.intercept"][1] == 63.170
    states = {p.name: p.state for p in found.calibration.parameters}
    assert set(states.values()) <= {"lower", "upper"}
    first, last = found.steep[0], found.steep[-1]
    assert abs(first.chi2 - last.chi2) < 0.5
    assert first.emittance / last.emittance == pytest.approx(last.slope / first.slope, rel=0.02)


def test_the_script_writes_the_page(script, tmp_path, monkeypatch, found):
    monkeypatch.setattr(script, "reproduce", lambda scan, line: found)
    page = tmp_path / "page.html"
    script.main(page)
    text = page.read_text()
    assert text.count("data:image/svg+xml") == 7
    assert "SIMULATED" in text
    assert "http://" not in re.sub(r"base64,[^\"]*", "", text)
    for words in ("not determined by data", "bounds, not measurements", "2.699999", "98.2730"):
        assert words in text


@pytest.mark.parametrize(
    "told",
    [
        {"scenario": "calibration"},
        {"scenario": "transport-network", "anchor": Anchor(deviation=0.02), "starts": 2},
    ],
)
@pytest.mark.parametrize("suffix", ["html", "pdf"])
def test_a_scenario_has_its_report(inputs, tmp_path, told, suffix):
    fit = beamfit.fit_emittance(*inputs, **told)
    page = tmp_path / f"page.{suffix}"
    beamfit.write_report(page, fit)
    assert page.stat().st_size > 10_000
    if suffix == "html":
        assert told["scenario"] in page.read_text()
