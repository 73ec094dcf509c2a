"""docs/extending.md, run as it stands: element, scenario, format, map; the mechanism's own test."""

import re
import sys
from types import ModuleType

import pytest

from beamfit.emittance.assumptions import SCENARIOS, Entry
from tests.lifetime.test_new_mechanism import FORMULA, LINE


@pytest.fixture
def page(root):
    return (root / "docs/extending.md").read_text()


def test_every_block_gives_what_stands_beside_it(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    names = {"print": lambda *words: said.append(" ".join(map(str, words)))}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
        if "SCENARIO = " in block:
            module = ModuleType("blurred_screen")
            module.SCENARIO = names["SCENARIO"]
            monkeypatch.setitem(sys.modules, "beamfit.emittance.blurred_screen", module)
            (entry,) = re.findall(r'`"blurred-screen": Entry\("(\w+)"\)`', page)
            monkeypatch.setitem(SCENARIOS, "blurred-screen", Entry(entry))
    shown = re.findall(r"^print\(.*\)  # (.*)$", page, re.MULTILINE)
    assert said == shown
    assert len(said) == 6


def test_the_mechanism_is_the_one_that_is_tested(page):
    assert FORMULA.strip() in page
    assert LINE.strip() in page
