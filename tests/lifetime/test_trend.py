"""Lifetimes over weeks: normalised, within limits, and what moved with its date."""

import json
import math

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.lifetime.course import _drift, _is_significant, trend_of
from beamfit.lifetime.mechanisms import loss_coefficients
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.lifetime.study import study_record
from beamfit.quantity import Quantity
from beamfit.statistics import control_limits
from tests.lifetime.test_alarm import beam_after

A, B, FILL, STEP = 3.7e-8, 9.26e-6, 8 * 3600.0, 60.0


def fills(count, moved=np.inf, factor=1.1, start=1.7e9, noise=2e-3, seed=0):
    """SIMULATED: fills of eight hours; b is larger from a time on."""
    random, beams = np.random.default_rng(seed), []
    time = np.arange(0.0, count * FILL, STEP)
    beam = 500.0
    for now in time:
        beam = (
            500.0
            if now % FILL == 0
            else beam_after(beam, STEP, A, B * (factor if now > moved else 1.0))
        )
        beams.append(beam)
    current = np.array(beams) + noise * random.normal(size=time.size)
    return DecayRecord(time, current, name="weeks", start=start)


@pytest.fixture(scope="module")
def leaking():
    return trend_of([study_record(fills(8, moved=5.5 * FILL))])


def test_a_change_is_found_dated_and_named(leaking):
    assert leaking.status == "poor_fit"
    [alarm] = leaking.alarms
    assert alarm.moved == "b"
    assert alarm.b.value == pytest.approx(0.1, abs=3 * alarm.b.error)
    assert abs(alarm.since - 1.7e9 - 5.5 * FILL) < 2 * STEP
    assert [point.beyond for point in leaking.points] == [0, 0, 0, 0, 0, -1, -1, -1]
    assert leaking.points[-1].b.value == pytest.approx(1.1, abs=4 * leaking.points[-1].b.error)
    assert leaking.points[5].b is None  # that decay refutes one a and b
    assert "Alarm: b moved by +10 ± " in leaking.message
    assert "2023-11-16 18:" in leaking.message
    assert json.loads(json.dumps(leaking.to_json()))["alarms"][0]["a"] is None


def bent(count, power=-1 / 3, wander=0.0, moved=math.inf, step=180.0):
    """SIMULATED: fills of eight hours of a ring whose a goes as a power of the current, and differs
    by `wander` from fill to fill as b does; b is larger by a tenth from a fill on.
    """
    random, studies = np.random.default_rng(3), []
    for fill in range(count):
        own, beams = 1 + wander * random.normal(size=2), [500.0]
        for k in range(int(FILL / step)):
            a = own[0] * A * (beams[-1] / 450) ** power
            b = own[1] * B * (1.1 if fill + k * step / FILL > moved else 1.0)
            beams.append(beam_after(beams[-1], step, a, b))
        read = np.array(beams) + 2e-3 * random.normal(size=len(beams))
        start = 1.7e9 + fill * (FILL + 2 * step)
        record = DecayRecord(step * np.arange(read.size), read, name=f"fill {fill}", start=start)
        studies.append(study_record(record))
    return trend_of(studies)


def test_a_ring_whose_a_goes_with_the_current_is_watched_by_that_law():
    found = bent(6, moved=4.5)
    assert found.reference.power == pytest.approx(-1 / 3, abs=0.01)
    assert found.reference.noise == pytest.approx(2e-3, rel=0.1)
    [alarm] = found.alarms
    assert 0.0 <= alarm.time - alarm.since < 1800.0
    assert alarm.since == pytest.approx(1.7e9 + 4.5 * FILL + 8 * 180.0, abs=600.0)
    assert alarm.b.value == pytest.approx(0.1, abs=2 * alarm.b.error)


def test_fills_that_differ_as_they_usually_do_are_no_alarm():
    """a and b differ by 2 %: a window over two fills took that for a change of one of them."""
    found = bent(10, power=0.0, wander=0.02)
    assert found.alarms == ()
    assert 0.01 < found.reference.wander < 0.04


def test_loss_rates_that_fall_as_no_bunch_makes_them_are_no_reference():
    found = bent(4, power=0.5)
    assert (found.reference, found.alarms) == (None, ())
    assert "Readings are not watched: the first decays tell no usual a and b" in found.message


def test_nothing_moves_and_nothing_is_said():
    quiet = trend_of([study_record(fills(4, seed=1))])
    assert (quiet.status, quiet.alarms) == ("converged", ())
    assert quiet.reference.a == pytest.approx(A, rel=1e-3)
    assert quiet.reference.noise == pytest.approx(2e-3, rel=0.1)
    few = trend_of([study_record(fills(1))])
    assert few.status == "unidentified"
    assert "1 lifetime;" in few.message


def test_limits_are_those_of_an_individuals_chart():
    """Of ten normal points the next lies outside in a share of some 0.27 %."""
    random, outside = np.random.default_rng(1), 0
    for _ in range(4000):
        *values, after = random.normal(size=11)
        centre, limit = control_limits(np.array(values))
        outside += abs(after - centre) > limit
    assert 2 <= outside <= 24
    # By hand: mean range 1, 1/1.128; a drift does not widen it, a step hardly.
    assert control_limits(np.arange(200.0))[1] == pytest.approx(3 / 1.128, rel=0.06)


def test_four_lifetimes_drift_no_oftener_than_chance_says():
    """Two degrees of freedom: three errors happen once in ten courses, 4.3 once in twenty."""
    random, time, inside, sure = np.random.default_rng(1), 86400.0 * np.arange(4), 0, 0
    for _ in range(3000):
        values = [Quantity(v, 0.1, "mA h") for v in 10 + 0.1 * random.normal(size=4)]
        found = _drift(time, values, 10.0)
        inside += found.interval_95[0] < 0 < found.interval_95[1]
        sure += _is_significant(abs(found.value) / found.error, 2)
    assert abs(inside / 3000 - 0.95) < 0.015
    assert sure / 3000 < 0.006


def test_the_ring_takes_settings_and_current_out(machine):
    """Four voltages and two currents, by first principles themselves: one normalised lifetime."""
    studies, time = [], np.arange(0.0, 7200.0, 60.0)
    for number, voltage in enumerate((3.2e6, 2.4e6, 2.8e6, 2.0e6, 3.2e6, 2.4e6)):
        operation = machine.operation._replace(rf_voltage=voltage)
        losses = loss_coefficients(machine.ring, operation, 500.0)
        top = (500.0, 300.0)[number % 2]
        beam = beam_after(top, time, float(losses.a), float(losses.b))
        shown = Conditions(rf_voltage=np.full(time.size, voltage))
        start = 1.7e9 + 1e4 * number
        record = DecayRecord(
            time, beam, np.full(time.size, 1e-3), f"f{number}", start, conditions=shown
        )
        studies.append(study_record(record, machine))
    trend = trend_of(studies, machine)
    values = np.array([point.normalised.value for point in trend.points])
    usual = loss_coefficients(machine.ring, machine.operation, trend.current)
    expected = trend.current / (usual.a * trend.current + usual.b) / 3600
    np.testing.assert_allclose(values, expected, rtol=1e-4)
    raw = np.array([point.current * point.lifetime.value for point in trend.points])
    assert np.ptp(raw) > 0.3 * raw.mean()
    with pytest.raises(InputError, match="times without a date"):
        trend_of([*studies, study_record(DecayRecord(time, beam), machine)], machine)


def test_the_command_and_its_page(tmp_path, well_shown):
    from click.testing import CliRunner

    from beamfit.cli import cli

    record = fills(6, moved=4.5 * FILL)
    rows = np.column_stack([record.time + record.start, record.current])
    path, page = tmp_path / "weeks.csv", tmp_path / "weeks.html"
    np.savetxt(path, rows, "%.4f", ",", header="time_s,beam_current_mA", comments="")
    done = CliRunner().invoke(cli, ["lifetime", str(path), "--trend", "--report", str(page)])
    assert done.exit_code == 0
    assert "Course of the lifetime" in done.output
    assert "Alarm: b moved by" in " ".join(done.output.split())
    assert "course of the lifetime" in page.read_text()
    assert well_shown(page, 3) == []


def test_top_up_is_a_course_of_many_points():
    """It was one point, whatever happened in it."""
    random, time = np.random.default_rng(1), 10.0 * np.arange(8000)
    loss = np.where(time > 50_000, 1 / 34_000, 1 / 36_000)
    lost = np.append(0.0, np.cumsum(10 * loss[:-1]))
    cycle = np.floor(time / 180.0)
    beam = 300 * np.exp(lost[np.searchsorted(cycle, cycle)] - lost)
    found = trend_of([study_record(DecayRecord(time, beam + 0.01 * random.normal(size=8000)))])
    assert found.status == "poor_fit"
    assert len(found.points) >= 40
    times, beyond = np.array([(point.time, point.beyond) for point in found.points]).T
    assert set(beyond[times > 50_000]) == {-1}
    assert np.sum(beyond[times < 47_000] != 0) <= 1
