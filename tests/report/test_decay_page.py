"""The report page of decay records."""

import base64
import re

import numpy as np
import pytest
from scipy.stats import chi2

import beamfit
from beamfit import figures
from beamfit.io.ring import read_operation, read_ring
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import Machine, study_record


@pytest.fixture(scope="module")
def studies(root):
    ring = root / "lattices/spear3_2003.toml"
    machine = Machine(read_ring(ring), read_operation(ring))
    record = beamfit.read_decay_record(root / "measurements/aps_1999_decay.csv")
    return (study_record(record, machine),)


def pictures_of(page):
    return re.findall(r"data:image/svg\+xml;base64,([^\"]+)", page)


def test_everything_a_colleague_asks_for_is_there(studies, tmp_path):
    path = tmp_path / "aps.html"
    beamfit.write_report(path, studies, command="beamfit lifetime ...", inputs={"a": "f" * 64})
    page = path.read_text().replace("<span>", "").replace("</span>", "")  # of unbroken words
    for words in (
        "39.149 ± 0.016 h", "(7.01 ± 0.11)e-08 1/(mA s)", "share of a in the loss",
        "a, Touschek", "b, measured", "Provenance", "f" * 64, "beamfit lifetime ...",
        "Advanced Photon Source", beamfit.__version__,
    ):  # fmt: skip
        assert words in page, words
    pictures = pictures_of(page)
    assert len(pictures) == 3
    for picture in pictures:
        assert b"</svg>" in base64.b64decode(picture)
    assert not re.search(r"(src|href)=[\"'](?!data:)", page)


def test_pdf_is_whole(studies, tmp_path):
    beamfit.write_report(tmp_path / "aps.pdf", studies)
    content = (tmp_path / "aps.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert content.rstrip().endswith(b"%%EOF")


def test_a_that_is_at_its_limit_still_has_a_page(tmp_path):
    """SIMULATED: in a ring of protons the best a is often zero, and a shift is no part of it."""
    time = np.linspace(0.0, 8 * 3600.0, 200)
    noise = 0.05 * np.random.default_rng(2).normal(size=200)
    study = study_record(DecayRecord(time, 200 * np.exp(-time / 36000) + noise))
    assert study.decays[0].fit.a.value == 0
    beamfit.write_report(tmp_path / "protons.html", (study,))


def test_a_record_that_says_nothing_still_has_a_page(tmp_path):
    study = study_record(DecayRecord(np.arange(20.0), np.full(20, 100.0), name="<flat>"))
    for suffix in ("html", "pdf"):
        beamfit.write_report(tmp_path / f"flat.{suffix}", (study,))
    page = (tmp_path / "flat.html").read_text()
    assert "lifetime not determined" in page
    assert "&lt;flat&gt;" in page
    assert len(pictures_of(page)) == 2


def test_refills_are_listed(tmp_path):
    time = np.arange(0.0, 8000.0, 10.0)
    saw = 100 * np.exp(-(time % 2000) / 6000)
    beamfit.write_report(tmp_path / "saw.html", (study_record(DecayRecord(time, saw)),))
    page = (tmp_path / "saw.html").read_text()
    assert page.count("<td>refill</td>") == 3
    assert "record#4" in page


def test_many_decays_have_a_row_each_and_alike_verdicts_are_said_once(tmp_path):
    time = np.arange(0.0, 12000.0, 10.0)
    saw = 100 * np.exp(-(time % 2000) / 6000) + 1e-3 * np.sin(time)
    errors = np.full(time.size, 1e-3)
    study = study_record(DecayRecord(time, saw, errors))
    assert len(study.decays) == 6
    for suffix in ("html", "pdf"):
        beamfit.write_report(tmp_path / f"many.{suffix}", (study,))
    page = (tmp_path / "many.html").read_text()
    assert "<td>#6</td>" in page
    assert page.count('<div class="verdict') - len(study.pooled) < 6


def test_of_many_cycles_some_are_drawn_one_by_one():
    """Cycles of 180 s for six hours: all of them would be a block of colour."""
    time = np.arange(0.0, 6 * 3600.0, 10.0)
    noise = 1e-3 * np.random.default_rng(1).normal(size=time.size)
    study = study_record(DecayRecord(time, 300 * np.exp(-(time % 180) / 36000) + noise))
    above, below = figures.decay(study).axes
    assert above.get_title(loc="left") == "beam current, 12 of 120 cycles"
    low, high = above.get_xlim()
    assert high - low == pytest.approx(12 * 180 / 3600, rel=0.01)
    assert below.get_xlim()[1] > 5.9


def test_the_lifetimes_of_cycles_are_those_at_the_mean_current():
    """At their own currents, which refills scatter by 1 %, they lay far beside the fit."""
    rng = np.random.default_rng(1)
    time, start = np.arange(0.0, 300.0, 10.0), 300 * (1 + 0.01 * rng.normal(size=40))
    cycles = start[:, None] / (1 + 1e-7 * start[:, None] * time)
    beam = cycles.ravel() + 1e-3 * rng.normal(size=cycles.size)
    study = study_record(DecayRecord(10.0 * np.arange(beam.size), beam))
    (points, _, (bars,)), *_ = figures.lifetime(study).axes[0].containers
    error = [0.5 * np.ptp(bar[:, 1]) for bar in bars.get_segments()]
    pulls = (points.get_ydata() - study.pooled[0].fit.lifetime_mean.value) / error
    assert np.mean(pulls**2) < chi2.ppf(0.999, pulls.size) / pulls.size


def test_a_spike_does_not_flatten_the_decay():
    """SIMULATED: a reading of 999 mA and a dump leave the axes to the 18 mA that were fitted."""
    time = np.arange(0.0, 7200.0, 20.0)
    noise = 0.01 * np.random.default_rng(1).normal(size=time.size)
    current = 100 * np.exp(-time / 36000) + noise
    current[100], current[340:] = 999.0, 0.0
    above = figures.decay(study_record(DecayRecord(time, current))).axes[0]
    low, high = above.get_ylim()
    assert 75 < low < 85 < 100 < high < 105
    words = [text.get_text() for text in above.get_legend().get_texts()]
    assert "left out, 21 beyond the axes" in words


def test_headings_of_several_tables_name_their_decays(tmp_path):
    """Tables of two decays each had one heading: nobody saw which of them to unfold."""
    time = np.arange(0.0, 6000.0, 10.0)
    saw = 100 * np.exp(-(time % 2000) / 6000) + 1e-3 * np.random.default_rng(1).normal(size=600)
    beamfit.write_report(tmp_path / "saw.html", (study_record(DecayRecord(time, saw)),))
    page = (tmp_path / "saw.html").read_text().replace("<span>", "").replace("</span>", "")
    headings = re.findall("<h2>(.*?)</h2>", page)
    assert len(set(headings)) == len(headings)
    assert {"All numbers: record#1, record#2", "All numbers: record#3"} < set(headings)
