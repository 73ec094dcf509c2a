"""Where the reference numbers are, and the two real lines every test may use."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Compiling is most of the tests' time: do it without optimisation, and keep it for the next run.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
_CACHE = Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# The first example of a test compiles JAX code: its time says nothing.
settings.register_profile("beamfit", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("beamfit")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def root():
    return ROOT


@pytest.fixture(scope="session")
def shared():
    """Reference numbers and measurements kept beside a checkout; not part of a clone."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("no ../shared beside this checkout")
    return folder
