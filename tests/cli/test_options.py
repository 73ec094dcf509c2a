"""What commands share: help with an example, the same options, a library scripts can call."""

import json
import subprocess
import sys

import pytest

from beamfit.cli import cli
from beamfit.cli.option_text import anchor_of, bounds_of, limits_of, priors_of, target_of
from beamfit.errors import InputError
from beamfit.io.line import read_lattice
from beamfit.io.result import results_text
from beamfit.io.scan import read_quad_scan
from beamfit.quantity import Quantity

# Help of every command in one process, which may have loaded nothing heavy in the end.
LIGHT = """
import sys
from beamfit.cli import main
for command in sys.argv[1:]:
    print("\\f", end="")
    sys.argv = ["beamfit", command, "--help"]
    try:
        main()
    except SystemExit as stop:
        assert stop.code == 0, command
heavy = {"jax", "matplotlib", "h5py", "rich", "scipy.optimize"} & set(sys.modules)
sys.stderr.write(",".join(sorted(heavy)))
"""


def test_help_shows_an_example_and_loads_nothing_heavy():
    commands = sorted(cli.commands)
    done = subprocess.run([sys.executable, "-c", LIGHT, *commands], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    for command, said in zip(commands, done.stdout.split("\f")[1:], strict=True):
        assert f"beamfit {command} " in said.split("Examples:")[1]


def test_an_option_means_the_same_in_every_command():
    said = {}
    for command in cli.commands.values():
        for option in command.params:
            # The goal of a scan is an error, that of tuning a quantity.
            if hasattr(option, "help") and option.name not in ("plane", "goal"):
                text = (option.opts, option.metavar, option.default)
                # What a prior or a gain is of goes with the command.
                text += (option.help,) * (option.name not in ("priors", "gains"))
                assert said.setdefault(option.name, text) == text


def test_a_script_reads_what_people_type():
    assert priors_of(["Q.slope=100±2%"]) == {"Q.slope": (100.0, 2.0)}
    assert bounds_of(["Q.slope=-1e2:3"]) == {"Q.slope": (-100.0, 3.0)}
    assert limits_of([]) == {}
    assert anchor_of(["determinant"]).determinant
    assert target_of("match_y=5:-1") == ("match", "y", (5.0, -1.0))
    for wrong in ("=1+-2", "Q", "Q=1", "Q=1+-2+-3", "Q=+-", "Q=1+-x"):
        with pytest.raises(InputError, match="NAME=MEAN"):
            priors_of([wrong])
    with pytest.raises(InputError, match="given twice"):
        limits_of(["Q=0:1", " Q =0:2"])


def test_a_script_checks_names_and_writes_the_document(root):
    scan = read_quad_scan(root / "measurements/gtf_simulated.csv")
    lattice = read_lattice(root / "lattices/gtf.toml")
    lattice.check_scan(scan)
    lattice.check_magnets(["Q2"])
    lattice.check_energies([25.0])
    with pytest.raises(InputError, match="did you mean Q525"):
        read_lattice(root / "lattices/lcls_otr2.toml").check_scan(scan)
    with pytest.raises(InputError, match="10 TeV"):
        lattice.check_energies([25.0, 0.1])
    inputs = {"scan": scan.sha256, "lattice": lattice.sha256}
    text = results_text([{"size": Quantity(1e-4, float("nan"), "m")}], inputs, "me", more=[1.0])
    document = json.loads(text)
    assert list(document) == ["beamfit", "command", "inputs", "results", "more"]
    assert document["results"][0]["size"]["error"] is None
    assert [len(sha256) for sha256 in document["inputs"].values()] == [64, 64]


@pytest.mark.parametrize(("flags", "shown"), [([], False), (["-W", "default"], True)])
def test_warnings_of_libraries_are_not_shown_unless_asked_for(flags, shown):
    work = """import logging, sys, warnings
from beamfit.cli import main
sys.argv = ["beamfit", "--version"]
try: main()
except SystemExit: pass
logging.getLogger("library").warning("a library's log")
warnings.warn("a library's warning")"""
    done = subprocess.run(
        [sys.executable, *flags, "-c", work], capture_output=True, text=True, check=True
    )
    assert ("a library's warning" in done.stderr) is shown
    assert "a library's log" not in done.stderr
