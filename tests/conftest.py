"""Where the reference numbers are, and the two real lines every test may use."""

from pathlib import Path

import pytest
from hypothesis import settings

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
