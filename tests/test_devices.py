"""The same code where arrays lie on another device: XLA makes two of one processor."""

import os
import subprocess
import sys

import pytest

BEGIN = """
import jax, numpy as np
from beamfit import fit_sizes  # from here on arrays have 64 bits
other = jax.devices()[1]
def there(tree):
    arrays = (np.ndarray, jax.Array)
    return jax.tree.map(lambda a: jax.device_put(a, other) if isinstance(a, arrays) else a, tree)
"""
SCANS = """
k = np.linspace(-1, 1, 9)
size = 1e-4 * np.sqrt(1 + 8 * k**2) * np.ones((50, 1))
rows = k, np.full(9, 2.0), size, 0.02 * size
here, found = (fit_sizes(*given).covariance for given in (rows, there(rows)))
"""
TOUSCHEK = """
from beamfit.io.ring import read_ring
from beamfit.lifetime.mechanisms import piwinski_rate
ring = read_ring("lattices/spear3_2003.toml")
here, found = (piwinski_rate(r, 1e10, 5e-3, 0.03) for r in (ring, there(ring)))
"""
END = """
assert found.devices() == {other} and here.devices() == {jax.devices()[0]}
assert np.allclose(here, found, rtol=1e-12, atol=0)
"""


@pytest.mark.parametrize("work", [SCANS, TOUSCHEK], ids=["scans", "Touschek"])
def test_work_is_done_on_the_device_that_holds_the_arrays(root, work):
    env = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    subprocess.run([sys.executable, "-c", BEGIN + work + END], check=True, cwd=root, env=env)
