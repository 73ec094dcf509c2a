"""What commands and fits said, kept word for word and number for number.

A change of an expected file is a change of what users read: it stands in a commit of its own
that names the defect or the rule behind it. They are written anew by
``python -m tests.golden.test_golden NAME …``.
"""

import io
import json
import math
import os
import re
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from unittest import mock

import pytest

from beamfit.cli import main

ROOT = Path(__file__).resolve().parents[2]
EXPECTED = Path(__file__).parent / "expected"
DATA = "tests/golden/data"
GTF, LCLS = "--lattice lattices/gtf.toml", "--lattice lattices/lcls_otr2.toml"
CALIBRATION = "--scenario calibration --prior Q2.slope=167.23+-3.3446 --bounds Q2.intercept=0:90"

COMMANDS = {
    "lcls": f"emittance measurements/lcls_otr2.csv {LCLS}",
    "gtf": f"emittance measurements/gtf_simulated.csv {GTF}",
    "no_errors": f"emittance {DATA}/no_errors.csv {GTF}",
    "poor": f"emittance {DATA}/poor.csv {GTF}",
    "outlier": f"emittance {DATA}/outlier.csv {GTF}",
    "outlier_robust": f"emittance {DATA}/outlier.csv {GTF} --robust",
    "noise": f"emittance {DATA}/noise.csv {GTF}",
    "one_sided": f"emittance {DATA}/one_sided.csv {GTF}",
    "three_points": f"emittance {DATA}/three_points.csv {GTF}",
    "calibration": f"emittance measurements/gtf_simulated.csv {GTF} {CALIBRATION}",
    "two_screens": "emittance measurements/gtf_two_screens_simulated.csv "
    "--lattice lattices/gtf_two_screens.toml --scenario calibration",
    "transport_network": f"emittance measurements/gtf_simulated.csv {GTF} "
    "--scenario transport-network --anchor first-principles=2%",
    "aps": "lifetime measurements/aps_1999_decay.csv",
    "short_decay": f"lifetime {DATA}/short_decay.csv --law constant",
    "spear3": "lifetime measurements/spear3_shift_simulated.csv --ring lattices/spear3_2003.toml",
    "design": f"design measurements/gtf_simulated.csv {GTF}",
    "setpoint": f"setpoint {GTF} --sigma 2.6367971e-8,1.5738242e-8,1.4354411e-8 --vary Q2=0:10 "
    "--target size=200um --target divergence=140urad",
}
# What the first screen says of some of them.
FIRST = ("lcls", "noise", "one_sided", "aps")
REFUSED = {
    "bad_size": f"emittance {DATA}/negative_size.csv {GTF}",
    "bad_lattice": "emittance measurements/gtf_simulated.csv --lattice lattices/lcls_otr2.toml",
    "bad_prior": f"emittance measurements/gtf_simulated.csv {GTF} --prior Q2.slope=1+-1",
}
NUMBER = re.compile(r"(?<![A-Za-z_\d.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
# Shown to two or three digits, the last of which may turn with the machine's rounding.
SHOWN, COMPUTED = 0.02, 1e-5
# Rounding errors in themselves, or the way a search took.
IDLE = {"seconds", "kkt", "beamfit", "command", "iterations"}
# What is exactly zero is computed as a rounding error of this size.
ROUNDING = {
    "multiplier": 1e-6,
    "systematics": 1e-12,
    "rms_residual": 1e-15,
    "pull": 1e-9,
    "chi2": 1e-20,
}


def said(arguments):
    """Status, output and error line of a command."""
    out, error = io.StringIO(), io.StringIO()
    with (
        chdir(ROOT),
        mock.patch.dict(os.environ, COLUMNS="100"),
        mock.patch.object(sys, "argv", ["beamfit", *arguments.split()]),
        redirect_stdout(out),
        redirect_stderr(error),
        pytest.raises(SystemExit) as stop,
    ):
        main()
    return stop.value.code, out.getvalue(), error.getvalue()


@cache
def both(name):
    """What a command says as text and as JSON, where it answers."""
    command = COMMANDS[name]
    whole = " --full" * command.startswith(("emittance", "lifetime"))
    answers = [said(command + form) for form in (whole, " --json")]
    assert [status for status, _, _ in answers] == [0, 0], answers
    return dict(zip(("txt", "json"), (out for _, out, _ in answers), strict=True))


def said_at_first(name):
    """What the first screen says."""
    status, out, _ = said(COMMANDS[name])
    assert status == 0
    return out


def split(text):
    """The words and the numbers of a text."""
    return NUMBER.sub("#", " ".join(text.split())), [float(n) for n in NUMBER.findall(text)]


def alike(found, expected, tolerance):
    return all(
        math.isclose(a, b, rel_tol=tolerance, abs_tol=1e-12)
        for a, b in zip(found, expected, strict=True)
    )


def differences(found, expected, place="results", small=1e-30):
    """Paths at which two objects of JSON differ; numbers may differ by rounding."""
    match found, expected:
        case (dict(), dict()):
            for key in (expected.keys() | found.keys()) - IDLE:
                if key in found and key in expected:
                    least = ROUNDING.get(key, small)
                    yield from differences(found[key], expected[key], f"{place}.{key}", least)
                else:
                    yield f"{place}.{key} only in {'found' if key in found else 'expected'}"
        case (list(), list()) if len(found) == len(expected):
            for i, (a, b) in enumerate(zip(found, expected, strict=True)):
                yield from differences(a, b, f"{place}[{i}]", small)
        case _:
            if not same(found, expected, small):
                yield f"{place}: {found} for {expected}"


def same(found, expected, small):
    """Whether two values are the same up to rounding."""
    match found, expected:
        case (str(), str()):
            (words, numbers), (other, others) = split(found), split(expected)
            return words == other and alike(numbers, others, SHOWN)
        case (int() | float(), float()):
            return math.isclose(found, expected, rel_tol=COMPUTED, abs_tol=small)
        case _:
            return found == expected


@pytest.mark.parametrize("name", COMMANDS)
def test_text(name):
    words, numbers = split(both(name)["txt"])
    expected, others = split((EXPECTED / f"{name}.txt").read_text())
    assert words == expected
    assert alike(numbers, others, SHOWN)


@pytest.mark.parametrize("name", FIRST)
def test_first_screen(name):
    """At most 24 lines, the verdict before the numbers."""
    text = said_at_first(name)
    words, numbers = split(text)
    expected, others = split((EXPECTED / f"{name}_first.txt").read_text())
    assert words == expected
    assert alike(numbers, others, SHOWN)
    assert text.count("\n") <= 24


@pytest.mark.parametrize("name", COMMANDS)
def test_json(name):
    expected = json.loads((EXPECTED / f"{name}.json").read_text())
    assert list(differences(json.loads(both(name)["json"]), expected, name)) == []


@pytest.mark.parametrize("name", REFUSED)
def test_refusal(name):
    status, out, error = said(REFUSED[name])
    assert (status, out) == (2, "")
    assert error == (EXPECTED / f"{name}.txt").read_text()


def write(names):
    """Write what is said now as what is expected."""
    for name in COMMANDS:
        if not names or name in names:
            for form, out in both(name).items():
                (EXPECTED / f"{name}.{form}").write_text(out)
    for name in FIRST:
        if not names or name in names:
            (EXPECTED / f"{name}_first.txt").write_text(said_at_first(name))
    for name, command in REFUSED.items():
        if not names or name in names:
            (EXPECTED / f"{name}.txt").write_text(said(command)[2])


if __name__ == "__main__":
    write(sys.argv[1:])
