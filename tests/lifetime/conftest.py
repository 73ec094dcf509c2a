"""A ring and its decays."""

import pytest

import beamfit
from beamfit.io.ring import read_operation, read_ring
from beamfit.lifetime.study import Machine, study_record


@pytest.fixture(scope="session")
def machine(root):
    path = root / "lattices/spear3_2003.toml"
    return Machine(read_ring(path), read_operation(path))


@pytest.fixture(scope="session")
def decays(root):
    record = beamfit.read_decay_record(root / "measurements/spear3_shift_simulated.csv")
    return study_record(record).decays


def values_of(rows):
    """Values of rows of a table by their labels."""
    return {row.label: row.values for row in rows}
