"""Arguments of another type than is meant: one line that says which, and what to give."""

import numpy as np
import pytest

import beamfit
from beamfit.errors import InputError

K, SIZES = [-1.0, 1.5, 4.0, 6.5, 9.0], np.array([3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4])
ERROR = 0.02 * SIZES


def scan_of(size=SIZES, **more):
    return beamfit.QuadScan({"Q": K}, {"Q": "k1"}, {"x": size}, **more)


@pytest.fixture(scope="module")
def line():
    parts = beamfit.Quadrupole("Q", 0.1), beamfit.Drift("D", 2.0), beamfit.Screen("S")
    return beamfit.Beamline(parts, 135.0)


@pytest.fixture(scope="module")
def fit(line):
    return beamfit.fit_emittance(scan_of(error={"x": ERROR}), line)


TARGET = [beamfit.Target("size", "x", 1e-4)]
CALLS = {
    "a scenario": (lambda fit: again(fit, scenario=None), "scenario 'None'; expected one of known"),
    "hidden": (lambda fit: again(fit, hidden=2.5), "hidden 2.5; expected an integer of at least 1"),
    "seed": (lambda fit: again(fit, seed=-1), "seed -1; expected an integer of at least 0"),
    "a prior": (lambda fit: again(fit, priors={"energy": ("1", "1%")}), "a pair of numbers"),
    "an anchor at": (lambda _: beamfit.Anchor(at={"Q": 0.0}), "a tuple of them"),
    "an anchor's deviation": (lambda _: beamfit.Anchor(deviation="2%"), "a positive relative"),
    "a noise": (lambda _: beamfit.Noise(scatter=0.05), "scatter = 0.05; expected two positive"),
    "screens": (lambda _: scan_of(screen=["S"]), "one length for all columns"),
    "errors": (lambda _: scan_of(error={"y": ERROR}), "errors in y without sizes"),
    "settings": (lambda fit: fit.predict({"Q": "a"}), "a number for each magnet"),
    "a beam": (lambda fit: setpoint(fit, {"x": fit.x.beam}), "a BeamMatrix; expected a Beam"),
    "beams": (lambda fit: setpoint(fit, fit), "an EmittanceFit; expected a Mapping"),
    "a target": (lambda fit: setpoint(fit, {}, TARGET[0]), "a str, 'size'; expected a Target"),
    "a fit": (lambda fit: beamfit.design(fit.scan), "a QuadScan; expected an EmittanceFit"),
    "a result": (lambda fit: beamfit.write_report("a.html", fit.scan), "a report of a QuadScan"),
}


def again(fit, **told):
    return beamfit.fit_emittance(fit.scan, fit.line, **told)


def setpoint(fit, beams, targets=TARGET):
    return beamfit.find_setpoint(fit.line, beams, {"Q": (0.0, 9.0)}, targets)


@pytest.mark.parametrize(("call", "words"), CALLS.values(), ids=CALLS)
def test_it_is_refused_in_words(call, words, fit):
    with pytest.raises(InputError) as refused:
        call(fit)
    assert words in str(refused.value)


def test_a_masked_size_was_not_measured():
    sizes = np.ma.array(SIZES, mask=[0, 0, 1, 0, 0])
    assert len(scan_of(sizes).rows("x").size) == 4
