"""Every public value in one line at a prompt, and as a table in a notebook."""

from collections import namedtuple
from html.parser import HTMLParser

import jax
import numpy as np
import pytest

import beamfit
from beamfit.answer import brief
from beamfit.emittance.design import plan_measurements
from beamfit.emittance.targets import Beam, Target
from beamfit.quantity import Quantity

HOSTILE = "<i>&Q\n1"


class Balance(HTMLParser):
    """Which elements are open, and the text."""

    def __init__(self):
        super().__init__()
        self.open, self.text = [], ""

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def values(root):
    scan = beamfit.read_quad_scan(root / "measurements/gtf_simulated.csv")
    line = beamfit.load_lattice(root / "lattices/gtf.toml")
    fit = beamfit.fit_emittance(scan, line)
    record = beamfit.read_decay_record(root / "measurements/aps_1999_decay.csv")
    ring = beamfit.read_ring(root / "lattices/spear3_2003.toml")
    operation = beamfit.read_operation(root / "lattices/spear3_2003.toml")
    beam = Beam(np.array([q.value for q in fit.x.sigma]))
    wish = [Target("size", "x", 2e-4)]
    decay = beamfit.fit_decay(record)
    posterior = decay.sample(seed=1, target_ess=100)
    return {
        "gtf_simulated": scan,
        "GTF": line,
        "0.6799 ± 0.0077 µm": fit,
        "x converged": fit.x,
        "14 values": fit.x.points,
        "SCREEN": fit.x.screen,
        "determined": fit.x.identifiability,
        "l11": fit.x.beam,
        "Q1": line["Q1"],
        "27 readings": record,
        "39.149 ± 0.037 h": decay,
        "separable": decay.identifiability,
        "234.144": ring,
        "761 values": ring.optics,
        "rf_voltage": operation,
        "a_touschek": beamfit.loss_coefficients(ring, operation, 500.0),
        "aps_1999": beamfit.split_record(record),
        "19 values": beamfit.moving_lifetime(record, 9000.0),
        "constant a": beamfit.constant_a_test(record),
        "sd": beamfit.Anchor(),
        "2.341 ± 0.045 m": fit.x.beta,
        "Q2": beamfit.find_setpoint(line, {"x": beam}, {"Q2": (0, 10)}, wish),
        "Measure next": plan_measurements(fit, count=1),
        "i0": posterior,
        "lifetime": posterior.correlations(),
    }


def test_each_is_one_short_line(values):
    for said, value in values.items():
        assert said in repr(value)
        assert "\n" not in repr(value)
        assert len(repr(value)) <= 200
        assert type(value).__name__ in repr(value)


def test_each_is_a_table_in_a_notebook(values):
    for value in values.values():
        page = Balance()
        page.feed(value._repr_html_())
        assert page.open == []
        assert page.text.strip()
    page = Balance()
    page.feed(values["0.6799 ± 0.0077 µm"]._repr_html_())
    assert "0.6799 ± 0.0077 µm" in page.text


def test_a_long_line_or_record_shows_its_first_rows():
    time = np.arange(1000.0)
    shown = beamfit.DecayRecord(time, 100 - 1e-3 * time)._repr_html_()
    assert shown.count("<tr>") == 41
    assert "first 40 of 1000" in shown


def test_names_are_never_markup():
    sizes = [3e-4, 1e-4, 3e-4]
    scan = beamfit.QuadScan({HOSTILE: [0, 1, 2.0]}, {HOSTILE: "k1"}, {"x": sizes}, name=HOSTILE)
    line = beamfit.Beamline((beamfit.Quadrupole(HOSTILE, 0.1), beamfit.Screen("S")), 100.0)
    for value in (scan, line, line[HOSTILE]):
        assert "<i>" not in value._repr_html_()
        assert "\n" not in repr(value)


def test_what_jax_traces_can_be_shown():
    said = []

    @jax.jit
    def look(strength):
        said.append(repr(beamfit.Quadrupole("Q", 0.1, strength)))
        return strength

    look(1.0)
    assert "setting=traced" in said[0]


def test_numbers_of_any_kind():
    assert brief(np.array([np.nan, np.nan] * 3)) == "6 values"
    assert brief(np.float64(0.25)) == "0.25"
    assert brief(np.array([1, 2])) == "(1, 2)"
    assert brief([[1.0] * 3] * 9) == "(9 of (1, 1, 1), ...)"
    Curve = namedtuple("Curve", "shape size")  # a record whose field has the name of an array's
    assert brief(Curve((2, 1), 0.5)) == "Curve((2, 1), 0.5)"
    assert repr(Quantity(1.0, None, "m")) == "<Quantity 1 m (not determined)>"
