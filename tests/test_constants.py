"""docs/verdict_constants.md names every constant that the judgement of a scan rests on, and
docs/lifetime_study.md those of decays that scatter.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = [ROOT / "beamfit" / "noise" / f"{name}.py" for name in ("learn", "model", "sizes")] + [
    ROOT / "beamfit" / "emittance" / f"{name}.py"
    for name in ("advice", "answer", "beam_draws", "comparison", "statement", "verdict")
]


# The tables at the top of the page, and no choices.
TABLES = ("LN_2PI", "MODELS", "UNMOVED", "ROBUST", "SIGMA")


def numbers_of(path):
    """Names in capitals that a module sets to numbers."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign):
            values = ast.walk(node.value)
            if any(isinstance(v, ast.Constant) and type(v.value) in (int, float) for v in values):
                targets = [n for t in node.targets for n in ast.walk(t)]
                yield from (n.id for n in targets if isinstance(n, ast.Name) and n.id.isupper())


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_every_constant_has_a_row_with_its_reason(path):
    table = (ROOT / "docs" / "verdict_constants.md").read_text()
    for name in numbers_of(path):
        if name not in TABLES:
            assert f"`{name}`" in table, f"{name} of {path.name}"


def test_the_page_of_a_study_has_the_priors_of_its_noise():
    page = (ROOT / "docs" / "lifetime_study.md").read_text()
    for name in numbers_of(ROOT / "beamfit" / "lifetime" / "fill_noise.py"):
        assert f"`{name}`" in page, name


def test_the_priors_of_the_page_are_those_of_the_code():
    from beamfit.emittance.comparison import MODELS
    from beamfit.noise.model import Noise

    text, noise = (ROOT / "docs" / "verdict.md").read_text(), Noise()
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    for name, probability in MODELS.items():
        row = next(row for row in rows if name[:12] in row)
        assert f"{probability:g}".lstrip("0") in row
    assert f"about {noise.factor.middle:g}, ln ± .{10 * noise.factor.spread:g}" in text
    assert f"about {100 * noise.unstated.middle:g} %, ln ± .{10 * noise.unstated.spread:g}" in text
    assert f"about {100 * noise.scatter.middle:g} % of the size, ln ± .7" in text
