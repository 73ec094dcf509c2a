"""Fitted beams read back: what is doubted, and the energy of the scan."""

import json

import numpy as np
import pytest

from beamfit.io.result import read_fitted_beams
from beamfit.particles import REST_ENERGY

REST = REST_ENERGY["electron"]
NUMBERS = {"sigma11": 2.6e-8, "sigma12": 1.5e-8, "sigma22": 1.4e-8}
ENTRY = {
    "plane": "x",
    "status": "converged",
    "message": "The waist is not bracketed.",
    **{name: {"value": v, "error": 1e-10} for name, v in NUMBERS.items()},
    "covariance": (1e-20 * np.eye(3)).tolist(),
}


@pytest.fixture
def read(tmp_path):
    def call(change):
        file = tmp_path / "fit.json"
        file.write_text(json.dumps({"results": [ENTRY | change]}))
        return read_fitted_beams(file, REST)["x"]

    return call


def test_a_determined_beam_is_not_doubted(read):
    assert read({}).doubt is None


def test_a_transport_network_tied_at_every_setting_is_good(read):
    tied = {"scenario": "transport-network", "anchor": "first principles to 2 %"}
    assert read(tied).doubt is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sigma12": {"value": 1.5e-8, "error": None}}, "sigma12 have no error"),
        ({"covariance": None}, "no covariance"),
        ({"status": "unidentified"}, "the emittance is open"),
    ],
)
def test_a_beam_without_errors_is_doubted_for_the_reason_of_the_fit(read, change, words):
    doubt = read(change).doubt
    assert words in doubt
    assert "The waist is not bracketed" in doubt


def test_the_covariance_is_scaled_as_the_errors_are(read):
    beam = read({"error_scale": 3.0})
    assert beam.covariance == pytest.approx(9e-20 * np.eye(3), rel=1e-12)


def test_the_energy_is_said_or_follows_from_the_emittances(read):
    assert read({}).energy is None
    assert read({"energy": {"value": 25.0}}).energy == 25.0
    ratio = np.sqrt((25.0 / REST) ** 2 - 1.0)
    emittances = {"emittance": {"value": 1e-8}, "normalized_emittance": {"value": 1e-8 * ratio}}
    assert read(emittances).energy == pytest.approx(25.0, rel=1e-12)
