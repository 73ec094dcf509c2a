"""Loops of simulated cover: few simulations with all tests, many by `make calibrate`."""

import math

import pytest


def simulations(few, many):
    """Give a test its ``count`` of simulations."""
    return pytest.mark.parametrize("count", [few, pytest.param(many, marks=pytest.mark.calibrate)])


def widened(reach, many, count):
    """What ``many`` simulations may be off by, for ``count`` of them."""
    return reach * math.sqrt(many / count)
