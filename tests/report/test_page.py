"""Report pages: whole, self-contained, and honest about what is not determined."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

import beamfit
from beamfit.errors import InputError
from beamfit.report.document import unbroken


@pytest.fixture(scope="module")
def fit(root):
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    return beamfit.fit_emittance(scan, beamfit.load_lattice(root / "lattices/lcls_otr2.toml"))


@pytest.fixture(scope="module")
def page(fit, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "otr2.html"
    beamfit.write_report(path, fit, command="beamfit emittance ...", inputs={"a.csv": "f" * 64})
    return path.read_text()


class Balanced(HTMLParser):
    """Fails on a tag that is closed and was not open."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_html_is_well_formed_and_needs_nothing_else(page):
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []
    assert not re.search(r"(src|href)=[\"'](?!data:)", page)
    assert "<script" not in page


def test_everything_a_colleague_asks_for_is_there(page):
    for words in (
        "beyond their shots, which the error includes",
        "P(beam)", "Points, x plane", "If the line were",
        "Q525 gradient",
        "If some points were left out", "Provenance", "f" * 64, "slaclab/lcls-tools",
        beamfit.__version__, "beamfit emittance ...", "jax",
    ):  # fmt: skip
        assert words in " ".join(page.split()), words
    assert re.search(r"0\.70\d ± 0\.0\d\d µm", page)


def test_other_tables_are_folded(page):
    first, _, rest = page.partition("<details>")
    assert first.count("<table") == 1
    assert "normalised emittance" in first
    assert rest.count("<summary>") == rest.count("</details>") == 6
    assert "All numbers" in rest


def test_numbers_with_errors_are_not_broken():
    assert unbroken("x: 0.70 ± 0.02 µm <at> -4.2 kG") == (
        "x: <span>0.70 ± 0.02 µm</span> &lt;at&gt; <span>-4.2</span> kG"
    )


def test_three_pictures_are_drawn(page):
    pictures = re.findall(r"data:image/svg\+xml;base64,([^\"]+)", page)
    assert len(pictures) == 3
    for picture in pictures:
        assert b"</svg>" in base64.b64decode(picture)


def test_pdf_is_whole(fit, tmp_path):
    beamfit.write_report(tmp_path / "otr2.pdf", fit)
    content = (tmp_path / "otr2.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert content.rstrip().endswith(b"%%EOF")
    assert len(re.findall(rb"/Type /Page\b", content)) >= 3
    assert [p.name for p in tmp_path.iterdir()] == ["otr2.pdf"]  # no temporary left


def test_a_scan_without_an_answer_still_has_a_page(root, tmp_path):
    line = beamfit.load_lattice(root / "lattices/gtf.toml")
    sizes = 1e-6 * np.random.default_rng(0).uniform(50, 200, 9)
    scan = beamfit.QuadScan({"Q2": np.linspace(0, 3, 9)}, {"Q2": "A"}, {"x": sizes}, name="<noise>")
    for suffix in ("html", "pdf"):
        beamfit.write_report(tmp_path / f"noise.{suffix}", beamfit.fit_emittance(scan, line))
    text = (tmp_path / "noise.html").read_text()
    assert "Not determined" in text
    assert "&lt;noise&gt;" in text


def test_several_screens_and_magnets_have_a_picture(three_lines, tmp_path):
    fit = three_lines
    beamfit.write_report(tmp_path / "many.html", fit)
    assert "YAG2" in (tmp_path / "many.html").read_text()


@pytest.fixture
def three_lines(root):
    line = beamfit.load_lattice(root / "lattices/three_quads.toml")
    kg = np.tile(np.linspace(-6, 6, 6), 2)
    screens = ("YAG1",) * 6 + ("YAG2",) * 6
    beam = beamfit.BeamMatrix.from_twiss(3e-9, 8.0, 1.0)
    sizes = [
        float(np.hypot(beam.transport(line.upto(s).matrix({"QA": q}).x).l11, 8e-6))
        for q, s in zip(kg, screens, strict=True)
    ]
    scan = beamfit.QuadScan({"QA": kg}, {"QA": "kG"}, {"x": sizes}, screen=screens)
    return beamfit.fit_emittance(scan, line)


def test_names_are_shown_as_they_are(root, tmp_path):
    line = beamfit.load_lattice(root / "lattices/lcls_otr2.toml")
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    odd = replace(scan, name="a $x_$ [red] & b")
    for suffix in ("html", "pdf"):
        fit = beamfit.fit_emittance(odd, replace(line, name="$L_$ [/b]"))
        beamfit.write_report(tmp_path / f"odd.{suffix}", fit)
    assert "a $x_$ [red] &amp; b" in (tmp_path / "odd.html").read_text()


def test_other_suffixes_and_places_are_refused(fit, tmp_path):
    with pytest.raises(InputError, match=r"\.html or \.pdf"):
        beamfit.write_report(tmp_path / "otr2.docx", fit)
    with pytest.raises(InputError, match="a folder that exists"):
        beamfit.write_report(tmp_path / "missing" / "otr2.html", fit)
    assert list(tmp_path.iterdir()) == []


def test_pictures_one_by_one(fit, tmp_path):
    for suffix, begins in (("png", b"\x89PNG"), ("svg", b"<?xml")):
        beamfit.write_report(tmp_path / f"otr2.{suffix}", fit)
        names = ["otr2", "otr2-2-scan-of-the-y-plane", "otr2-3-phase-ellipses"]
        made = sorted(tmp_path.glob(f"*.{suffix}"), key=lambda p: p.stem)
        assert [p.stem for p in made] == names
        assert all(p.read_bytes().startswith(begins) for p in made)
    assert len({p.read_bytes() for p in tmp_path.iterdir()}) == 6


def test_an_old_report_is_replaced_whole(fit, tmp_path):
    path = tmp_path / "otr2.html"
    path.write_text("old " * 1_000_000)
    beamfit.write_report(path, fit)
    assert "old old" not in path.read_text()
