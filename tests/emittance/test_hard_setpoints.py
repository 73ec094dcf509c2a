"""Requests with three magnets that are hard to meet, against a dense search by code of its own.

Out of reach, held by limits, contradictory, with several minima, beside the jump of a calibration.
`benchmarks/setpoint.py` prints the lowest objectives: 31³ points, the best dozen of which L-BFGS-B
and Nelder-Mead carry on.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from beamfit.emittance.setpoint import Beam, Target, find_setpoint
from beamfit.particles import rigidity

WIDE = {"QA": (-40.0, 40.0), "QB": (-15.0, 15.0), "QC": (-12.0, 12.0)}
MIDDLE = {"QA": (-10.0, 10.0), "QB": (-5.0, 5.0), "QC": (-6.0, 6.0)}
NARROW = {"QA": (0.0, 8.0), "QB": (-3.0, -0.5), "QC": (0.0, 3.0)}
ASIDE = WIDE | {"QB": (-15.0, -14.0)}
FLAT = {"x": np.array([2e-8, 0.0, 2e-9]), "y": np.array([3e-8, 1e-8, 5e-9])}
ROUND = dict.fromkeys("xy", np.array([4e-8, -1e-8, 3e-9]))


class Request(NamedTuple):
    limits: dict
    beams: dict
    targets: tuple
    lowest: float
    status: str


def sizes(*values):
    return tuple(Target("size", p, v) for p, v in zip("xy", values, strict=False))


def angles(*values):
    return tuple(Target("divergence", p, v) for p, v in zip("xy", values, strict=False))


SHARP = (Target("match", "x", (0.05, 0.0)), Target("match", "y", (0.05, 0.0)))
REQUESTS = {
    "1 µm": Request(WIDE, FLAT, sizes(1e-6), 3.39794, "at_limit"),
    "1 µm, weaker magnets": Request(MIDDLE, FLAT, sizes(1e-6), 450.741, "at_limit"),
    "1 µm, hardly any room": Request(NARROW, FLAT, sizes(1e-6), 8730.13, "at_limit"),
    "1 µm in both": Request(WIDE, FLAT, sizes(1e-6, 1e-6), 2023.14, "at_limit"),
    "1 µm in both, weaker": Request(MIDDLE, FLAT, sizes(1e-6, 1e-6), 25870.1, "infeasible"),
    "1 µrad": Request(WIDE, FLAT, angles(1e-6), 0.00871521, "at_limit"),
    "1 µrad in both": Request(MIDDLE, FLAT, angles(1e-6, 1e-6), 2333.66, "infeasible"),
    "small and parallel": Request(
        MIDDLE, FLAT, (*sizes(5e-6), *angles(5e-5)), 5814.97, "infeasible"
    ),
    "four targets": Request(
        WIDE, FLAT, (*sizes(5e-5, 5e-5), *angles(1e-4, 1e-4)), 2386.98, "infeasible"
    ),
    "20 mm by 1 µm": Request(MIDDLE, FLAT, sizes(2e-2, 1e-6), 2.00805e8, "at_limit"),
    "20 mm": Request(NARROW, FLAT, sizes(2e-2), 3.68388e8, "at_limit"),
    # Lowest beside QB = 0, where its remanent field changes sign.
    "match at a jump": Request(MIDDLE, ROUND, SHARP, 40.3847, "not_converged"),
    "match and size": Request(
        WIDE, ROUND, (Target("match", "x", (0.01, 3.0)), Target("size", "y", 1e-6)), 111.825,
        "at_limit",
    ),
    "matches that differ": Request(
        NARROW,
        ROUND,
        (Target("match", "x", (50.0, -5.0)), Target("match", "y", (0.2, 4.0))),
        70.8539,
        "at_limit",
    ),
    "three targets that can be met": Request(
        WIDE, ROUND, (*sizes(3e-5, 2e-4), *angles(4e-4)), 0.0, "converged"
    ),
    "between two minima": Request(ASIDE, ROUND, sizes(1e-6, 1e-6), 107665.0, "at_limit"),
}  # fmt: skip


def quadrupole(k, length):
    root = np.sqrt(np.asarray(k, complex))
    sine = np.sinc(root * length / np.pi) * length
    rows = np.array([[np.cos(root * length), sine], [-k * sine, np.cos(root * length)]])
    return np.moveaxis(rows.real, (0, 1), (-2, -1))


def objective(settings, request):
    """Sum of squares at settings of shape (..., 3), three_quads.toml typed out."""
    a, b, c = np.moveaxis(np.asarray(settings, float), -1, 0)
    stiff = float(rigidity(250.0))
    gradient = 0.02 * np.sign(b) + 1.6 * b - 0.004 * b**2
    total = 0.0
    for kind, plane, value in request.targets:
        r = np.eye(2)
        sign = 1.0 if plane == "x" else -1.0
        for k, drift in ((a / 2.0 / stiff, 0.6), (gradient / stiff, 0.6), (c, 2.5)):
            r = np.array([[1.0, drift], [0.0, 1.0]]) @ quadrupole(sign * k, 0.2) @ r
        s11, s12, s22 = request.beams[plane]
        beam = r @ np.array([[s11, s12], [s12, s22]]) @ np.swapaxes(r, -1, -2)
        d11, d12, d22 = beam[..., 0, 0], beam[..., 0, 1], beam[..., 1, 1]
        if kind == "match":
            beta, alpha = value
            gamma = (1.0 + alpha**2) / beta
            growth = 0.5 * (gamma * d11 + 2.0 * alpha * d12 + beta * d22)
            total = total + growth / np.sqrt(s11 * s22 - s12**2) - 1.0
        else:
            total = total + (1e6 * (np.sqrt(d11 if kind == "size" else d22) - value)) ** 2
    return total


@pytest.fixture(scope="module")
def best(three_quads):
    """The answer to each request, searched once."""

    @cache
    def of(name):
        request = REQUESTS[name]
        beams = {plane: Beam(sigma) for plane, sigma in request.beams.items()}
        return find_setpoint(three_quads, beams, request.limits, request.targets)

    return of


@pytest.mark.parametrize("name", REQUESTS)
def test_the_best_point_is_found_and_called_what_it_is(best, name):
    request, found = REQUESTS[name], best(name)
    assert found.best.objective == pytest.approx(request.lowest, rel=1e-5, abs=1e-6)
    settings = np.array([*found.best.settings.values()])
    assert float(objective(settings, request)) == pytest.approx(
        found.best.objective, rel=1e-6, abs=1e-9
    )
    low, high = np.array([*request.limits.values()]).T
    assert ((low <= settings) & (settings <= high)).all()
    axes = [np.linspace(a, b, 25) for a, b in zip(low, high, strict=True)]
    grid = objective(np.stack(np.meshgrid(*axes), -1), request)
    assert found.best.objective <= grid.min() * (1.0 + 1e-6)
    assert found.status.value == request.status


def test_what_holds_an_unreachable_wish_is_said(best):
    for name, words in (
        ("1 µm", "QA, QB at a limit: a wider one would do better."),
        ("four targets", "the targets contradict one another"),
        ("match at a jump", "jumps as a magnet changes sign"),
        ("match and size", "BMAG - 1 = "),
    ):
        assert words in best(name).message
