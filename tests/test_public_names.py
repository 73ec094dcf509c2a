"""The public face: few names, each with a runnable example, loaded only when asked for."""

import inspect
import subprocess
import sys

import pytest

import beamfit

NAMES = [n for n in beamfit.__all__ if not n.startswith("_")]


def test_there_are_few():
    assert len(NAMES) <= 34


@pytest.mark.parametrize("name", NAMES)
def test_each_has_an_example(name):
    assert ">>>" in (inspect.getdoc(getattr(beamfit, name)) or "")


def test_importing_the_package_loads_neither_jax_nor_matplotlib():
    check = "import beamfit, sys; print({'jax', 'matplotlib', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_the_command_line_and_a_reader_need_numpy_alone():
    """Help and bad files are answered before anything heavy is loaded."""
    check = (
        "import beamfit, beamfit.cli, sys;"
        "scan = beamfit.read_quad_scan('measurements/gtf_simulated.csv');"
        "print({'jax', 'matplotlib', 'scipy', 'pandas'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_an_unknown_name_says_so():
    with pytest.raises(AttributeError, match="no attribute 'emitance'"):
        _ = beamfit.emitance
