"""Pages in headless Chromium. Each kind is looked at where it is made, by `well_shown`:

emittance here, slices, lifetime, identify, control and solve in tests/cli, trends in
tests/lifetime.
"""

import re

import pytest

import beamfit
from tests.report.browser import NAME, WIDTHS

pytestmark = pytest.mark.skipif(NAME is None, reason="no Chromium here: apt-get install chromium")


def test_an_emittance_is_well_shown_and_printed(root, tmp_path, browser, well_shown):
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    fit = beamfit.fit_emittance(scan, beamfit.load_lattice(root / "lattices/lcls_otr2.toml"))
    page = tmp_path / "otr2.html"
    command = "beamfit emittance lcls_otr2.csv --lattice lcls_otr2.toml --report otr2.html"
    beamfit.write_report(page, fit, command=command, inputs={"a/" + 40 * "long_": "f" * 64})
    assert well_shown(page, 3) == []
    assert 3 <= len(re.findall(rb"/Type ?/Page\b", browser.printed())) <= 6
    browser.screen(page)
    assert 300 < browser.foot() < 800


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("<p style='width:5000px'>wide", "to scroll sideways"),
        ("<script>console.error('no')</script>", "console"),
        ("<script>throw new Error('no')</script>", "console"),
        ("<img src='data:image/png;base64,AAAA'>", "0 of 1 pictures"),
        ("<link rel='stylesheet' href='missing.css'>", "asked for"),
        (
            "<div class='wide' style='width:90px;overflow:auto'><p style='width:200px'>wide",
            "cut off",
        ),
    ],
)
def test_what_is_wrong_is_found(tmp_path, browser, body, said):
    page = tmp_path / "bad.html"
    page.write_text(f"<!DOCTYPE html><html><body>{body}</body></html>")
    found = browser.faults(page, "screen", pictures=body.count("<img"))
    assert any(said in fault for fault in found), found
    assert set(WIDTHS) == {"phone", "screen", "print"}
