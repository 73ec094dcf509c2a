"""The public face: the names written here, each with a runnable example, loaded when asked for."""

import inspect
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest

import beamfit

NAMES = """
Anchor Beam BeamMatrix Beamline DecayFit DecayRecord DensityFit Drift EmittanceFit EmittanceTable
InputError Job Machine Monitor Noise Posterior QuadScan Quadrupole Quantity Run Screen
SectorDipole Status Target ThinLens TuningFit check constant_a_test control design find_setpoint
fit_decay fit_decays fit_density fit_emittance fit_lifetimes fit_sizes fit_slices fit_tuning
identify load_fit load_lattice loss_coefficients moving_lifetime read_decay_record
read_formulation read_noise read_operation read_quad_scan read_ring read_run read_tuning_scan
run_batch save_fit scan_machine solve split_record study study_shift systematics trend watch
write_report
"""
PUBLIC = NAMES.split()
# Every command and the function that answers as it does.
COMMANDS = {
    "batch": "run_batch",
    "check": "check",
    "control": "control",
    "density": "fit_density",
    "design": "design",
    "emittance": "fit_emittance",
    "identify": "identify",
    "lifetime": "study",
    "scan": "scan_machine",
    "setpoint": "find_setpoint",
    "solve": "solve",
    "tune": "fit_tuning",
    "watch": "watch",
}
# What a reader of `beamfit` gives, so that nobody has to make one: no public names.
READ = {"Document", "Decay", "LifetimeTable", "Operation", "RecordStudy", "Ring"}
READ |= {"ScanMachine", "ScanProgress", "WatchView", "WatchMachine", "Layout"}
# Words for what may be given in their place, or what a report is written of.
WORDS = {"Any", "Array", "ArrayLike", "Callable", "Columns", "DataFrame", "Iterable", "Law"}
WORDS |= {"Limits", "Mapping", "None", "PathLike", "Reported", "Scanned", "Sequence", "Steps"}
WORDS |= {"Network", "ResponseFit", "SizeMethods", "Shift", "Trend"}


def test_the_public_names_are_these():
    assert [n for n in beamfit.__all__ if not n.startswith("_")] == PUBLIC


def test_every_command_has_a_function():
    from beamfit.cli import cli

    assert sorted(COMMANDS) == sorted(cli.commands.keys() - {"example"})
    assert set(COMMANDS.values()) <= set(PUBLIC)


@pytest.mark.parametrize("name", PUBLIC)
def test_each_has_an_example(name):
    assert ">>>" in (inspect.getdoc(getattr(beamfit, name)) or "")


@pytest.mark.parametrize("name", [n for n in PUBLIC if n[0].islower()])
def test_arguments_are_of_public_types(name):
    given = inspect.signature(getattr(beamfit, name)).parameters.values()
    types = {word for p in given for word in re.findall(r"\b[A-Z]\w+", str(p.annotation))}
    assert types <= {*PUBLIC, *READ, *WORDS}


def test_paths_stand_for_what_is_read_from_them(root):
    scan, lattice = root / "measurements/lcls_otr2.csv", root / "lattices/lcls_otr2.toml"
    read, line = beamfit.read_quad_scan(scan), beamfit.load_lattice(lattice)
    wanted = beamfit.fit_emittance(read, line).x.emittance.value
    for given in ((scan, lattice), (str(scan), line), (read, lattice)):
        assert beamfit.fit_emittance(*given).x.emittance.value == wanted
    record = root / "measurements/aps_1999_decay.csv"
    read = beamfit.read_decay_record(record)
    assert str(beamfit.fit_decay(record)) == str(beamfit.fit_decay(read))
    assert len(beamfit.fit_decays([str(record), read])) == 2
    ring = root / "lattices/spear3_2003.toml"
    assert np.isfinite(float(beamfit.loss_coefficients(ring, ring, 500.0).a))


def test_a_function_that_takes_paths_can_be_sent_to_another_process():
    assert pickle.loads(pickle.dumps(beamfit.fit_emittance)) is beamfit.fit_emittance
    assert beamfit.design.__name__ == "design"


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
