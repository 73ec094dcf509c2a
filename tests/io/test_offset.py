"""The monitor's offset, from readings of no beam or stated."""

from dataclasses import replace

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.decay_record import offset_of, read_decay_record
from beamfit.lifetime.fit import fit_decay


@pytest.fixture(scope="module")
def shifted(tmp_path_factory):
    """Half an hour without beam, eight hours of decay, ten minutes after the dump; 0.1 mA off."""
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 9.0 * 3600, 30.0)
    a, b, since = 2e-8, 1e-6, time - 1800
    beam = 500 * np.exp(-b * since) / (1 + a / b * 500 * -np.expm1(-b * since))
    beam = np.where((since < 0) | (time > 8.8 * 3600), 0.0, beam)
    reading = beam + 0.1 + 2e-3 * rng.normal(size=time.size) - 0.1 * (time == 1e4)
    path = tmp_path_factory.mktemp("offset") / "shifted.csv"
    np.savetxt(path, np.column_stack([time, reading]), fmt="%.6f", delimiter=",", comments="",
               header="time_s,beam_current_mA")  # fmt: skip
    return path


def test_readings_without_beam_give_the_offset(shifted):
    record = read_decay_record(shifted, offset="zero-beam")
    [note] = record.notes
    assert "83 readings without beam" in note
    assert record.monitor.offset == pytest.approx(2e-3 / np.sqrt(83), rel=0.7)
    assert record.current.min() > 300
    off, plain = fit_decay(record), fit_decay(read_decay_record(shifted, offset="0:mA"))
    assert off.b.value == pytest.approx(1e-6, abs=3 * off.b.error)
    # dI/dt = -a (I - o)² - b (I - o): b is 2 a o less, and the rest is nearly constant.
    assert off.b.value - plain.b.value == pytest.approx(2 * 2e-8 * 0.1, rel=0.2)
    stated = fit_decay(read_decay_record(shifted, offset="100:uA"))
    assert stated.b.value == pytest.approx(off.b.value, rel=1e-4)
    assert stated.readings.monitor is None
    # The error of the offset is part of that of b.
    doubtful = replace(record, monitor=record.monitor._replace(offset=10.0))
    assert fit_decay(doubtful).b.error > 1.1 * stated.b.error


def test_noise_with_a_memory_has_a_larger_error():
    rng, noise = np.random.default_rng(3), np.zeros(2000)
    for k in range(1, 2000):
        noise[k] = 0.95 * noise[k - 1] + np.sqrt(1 - 0.95**2) * rng.normal()
    found = offset_of("zero-beam", np.r_[0.3 + 1e-2 * noise, np.full(100, 200.0)])
    # sqrt((1 + c)/(1 - c)) = 6.2 times that of independent readings.
    assert 3 < found.error / (1e-2 / np.sqrt(2000)) < 12
    assert abs(found.value - 0.3) < 3 * found.error


@pytest.mark.parametrize(
    ("said", "current", "words"),
    [
        ("zero-beam", np.full(100, 300.0), "no readings without beam"),
        ("zero-beam", np.r_[np.full(3, 0.1), np.full(100, 300.0)], "no readings without beam"),
        ("zero-beam", np.geomspace(300, 1e-3, 500), "scatter by"),
        ("much", np.full(100, 300.0), "a current such as 0.12mA"),
        ("0.1", np.full(100, 300.0), "a current such as 0.12mA"),
    ],
)
def test_what_gives_no_offset_is_refused(said, current, words):
    with pytest.raises(InputError, match=words):
        offset_of(said, current)


def test_an_offset_above_the_readings_is_not_called_a_wrong_sign(shifted):
    with pytest.raises(InputError, match="--offset below the readings: 600 mA leaves most"):
        read_decay_record(shifted, offset="600mA")


def test_ignored_columns_are_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,SR:I,BPM1,Ring temp\n0,100,1,20\n1,99,1,20\n")
    record = read_decay_record(path, columns="t=time_s, SR:I=beam_current_mA")
    assert record.notes == ("Ignored: BPM1, Ring temp.",)
