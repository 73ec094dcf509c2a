"""The documentation builds without a warning, has every public name, and needs nothing else."""

import re
import subprocess
import sys

import pytest

import beamfit


@pytest.fixture(scope="module")
def site(root, tmp_path_factory):
    """The site without its notebooks' answers, which `test_notebooks` looks at."""
    place = tmp_path_factory.mktemp("site")
    call = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    # Pages of source code, which only `make docs` writes, are made by viewcode.
    parts = "myst_nb,sphinx.ext.autodoc,sphinx.ext.napoleon,sphinx_click"
    call += ["-D", "nb_execution_mode=off", "-D", f"extensions={parts}"]
    call += ["-d", place / "trees", root / "docs", place / "html"]
    done = subprocess.run(call, capture_output=True, text=True, cwd=root)
    assert (done.returncode, done.stderr) == (0, "")
    return place / "html"


def test_nothing_is_fetched_from_elsewhere(site):
    pages = [*site.rglob("*.html"), *site.rglob("*.css")]
    assert len(pages) > 20
    fetched = re.compile(r"""(?:<(?!a )[^>]+(?:src|href)=|url\()["']?(?:https?:)?//""")
    for page in pages:
        assert not fetched.search(page.read_text()), page


def test_every_public_name_is_in_the_reference(site):
    reference = (site / "api.html").read_text()
    missing = [name for name in beamfit._HOME if f'id="beamfit.{name}"' not in reference]
    assert missing == []


def test_pages_and_paragraphs_are_short(root):
    """A page has at most 2 000 words, a paragraph or an item of a list 90."""
    for page in (root / "docs").glob("*.md"):
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
        assert len(text.split()) <= 2000, page
        for block in re.split(r"\n\s*\n", text):
            for item in re.split(r"\n(?=[-*] |\d+\. )", block):
                # Tables and indented blocks are no prose.
                prose = not item.startswith(("|", "    ", "$$"))
                assert not prose or len(item.split()) <= 90, (page, item)


def test_every_picture_of_a_page_is_made_by_the_build(root):
    made = "".join(path.read_text() for path in (root / "docs").glob("*pictures.py"))
    pages = "".join(page.read_text() for page in (root / "docs").glob("*.md"))
    shown = set(re.findall(r"\(_static/(\w+)\.png\)", pages))
    assert shown == {path.stem for path in (root / "docs/_static").glob("*.png")}
    assert [name for name in shown if not re.search(rf"\b{name}\b", made)] == []
