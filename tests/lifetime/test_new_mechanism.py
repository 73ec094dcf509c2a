"""A loss mechanism is its formula and one line of a tuple: everything else follows."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import beamfit

FORMULA = '''

def horizontal_loss(ring, operation, current):
    """SIMULATED: a tenth of the elastic loss, for each pascal."""
    return 0.1 * elastic_loss(ring, operation, current)
'''
LINE = (
    '    Mechanism("horizontal", "horizontal gas", horizontal_loss, True, True, "the pressure"),\n'
)
SCRIPT = """
import json
from beamfit.io.ring import read_operation, read_ring
from beamfit.lifetime.mechanisms import SCALES
from beamfit.lifetime.study import Machine, budget
from beamfit.lifetime.record import DecayRecord
path = "lattices/spear3_2003.toml"
machine = Machine(read_ring(path), read_operation(path))
found = budget(DecayRecord([0, 60], [500.0, 499.9]), machine)
print(json.dumps([found.to_json(), found.rates, list(SCALES)]))
"""


def test_a_new_mechanism_touches_one_file(tmp_path, root):
    package = Path(beamfit.__file__).parent
    shutil.copytree(package, tmp_path / "beamfit", ignore=shutil.ignore_patterns("__pycache__"))
    losses = tmp_path / "beamfit/lifetime/mechanisms.py"
    text = losses.read_text().replace("\n\nclass Mechanism", FORMULA + "\n\nclass Mechanism", 1)
    losses.write_text(text.replace('    Mechanism("quantum"', LINE + '    Mechanism("quantum"'))
    done = subprocess.run(
        [sys.executable, "-P", "-c", SCRIPT],
        capture_output=True,
        text=True,
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        check=True,
    )
    budget, rates, scales = json.loads(done.stdout)
    for kind in "ab":
        part, elastic = (budget[f"{kind}_{name}"]["value"] for name in ("horizontal", "elastic"))
        assert abs(part / elastic - 0.1) < 1e-12
    assert abs(sum(rates.values()) * budget["lifetime_mean"]["value"] - 1) < 1e-12
    assert "horizontal gas" in rates
    assert scales == ["touschek", "bremsstrahlung", "elastic", "horizontal", "desorption"]
