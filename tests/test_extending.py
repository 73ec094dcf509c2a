"""docs/extending.md, run as it stands; the mechanism has a test of its own."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import beamfit
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
    assert len(said) == 7


def test_the_mechanism_is_the_one_that_is_tested(page):
    assert FORMULA.strip() in page
    assert LINE.strip() in page


LATTICE = """
format = "beamfit-lattice-1"
energy_MeV = 200.0
element = [
    { type = "plasma_lens", name = "PL", length_m = 0.02, k1_per_m2 = 0.0 },
    { type = "drift", length_m = 1.0 },
    { type = "screen", name = "S" },
]
"""
SCRIPT = """
import beamfit
planes = beamfit.load_lattice("line.toml").matrix({"PL": 10.0})
print(float(planes.x[0, 0]), float(planes.y[0, 0]))
"""


def test_the_element_stands_in_a_lattice_file(page, tmp_path):
    package = Path(beamfit.__file__).parent
    shutil.copytree(package, tmp_path / "beamfit", ignore=shutil.ignore_patterns("__pycache__"))
    (code,) = re.findall(r"^(@value.*?)```", page, re.DOTALL | re.MULTILINE)[:1]
    elements = tmp_path / "beamfit/optics/elements.py"
    elements.write_text(f"{elements.read_text()}\n\n{code}")
    keys, settings, case = re.findall(r"\n\n```\n(.*?)```\n", page, re.DOTALL)[:3]
    lattice = tmp_path / "beamfit/io/lattice.py"
    text = lattice.read_text().replace('    "marker": {', f'{keys}    "marker": {{', 1)
    text = re.sub(r"^    for kind in \(\"quad.*\n", settings, text, flags=re.MULTILINE)
    text = text.replace('        case "marker":', f'{case}        case "marker":', 1)
    lattice.write_text(text)
    (tmp_path / "line.toml").write_text(LATTICE)
    done = subprocess.run(
        [sys.executable, "-P", "-c", SCRIPT],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr
    x, y = done.stdout.split()
    assert x == y
    assert abs(float(x) - 0.8) < 0.01  # 1 - k1 · length · drift of a thin lens
