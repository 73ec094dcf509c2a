"""A beam watched: truth within errors, what moved by its name, silence, clocks, gaps and dumps."""

import math

import numpy as np
import pytest

from beamfit.lifetime.mechanisms import loss_coefficients
from beamfit.lifetime.watch import (
    CURRENT,
    Plan,
    State,
    WindowRow,
    fit_window,
    learn_reference,
    stepped,
)
from tests.lifetime.test_alarm import beam_after

A, B, NOISE, START = 3.7e-8, 9.26e-6, 5e-4, 1.7e9
UNREAD = State().settings
PLAN = Plan(window=3600.0, every=600.0)


def decay(seconds, every=8.0, worse=(1.0, 1.0), moved=math.inf, low=0.0, seed=1):
    """SIMULATED: time since the start and current, refilled to 500 mA below a current."""
    random, beam = np.random.default_rng(seed), 500.0
    for time in np.arange(0.0, seconds, every):
        more = worse if time > moved else (1.0, 1.0)
        beam = beam_after(beam, every, A * more[0], B * more[1])
        beam = 500.0 if beam < low else beam
        yield time, beam + NOISE * random.normal()


def watch(readings, plan=PLAN, state=State(), start=START):  # noqa: B008
    for time, current in readings:
        state = stepped(plan, state, CURRENT, start + time, current)
    return state


@pytest.mark.parametrize(("which", "worse"), [("a", (1.15, 1.0)), ("b", (1.0, 1.15))])
def test_a_hidden_rise_is_named_and_the_lifetime_is_that_of_the_new_loss(which, worse):
    readings = list(decay(7600, worse=worse, moved=5000.0))
    before = watch(readings[:625])
    for name, truth in (("a", A), ("b", B)):
        exact = before.answer.window.fit.if_constant(name)
        assert exact.value == pytest.approx(truth, abs=4 * exact.error)
        assert exact.error < 0.01 * truth
        found = getattr(before.answer, name)
        assert found.value == pytest.approx(truth, abs=2 * found.error)
    assert (before.alarmed, before.answer.status) == ("", "converged")
    after = watch(readings[625:], state=before)
    [alarm] = after.alarms
    assert (alarm.moved, after.alarmed) == (which, which)
    assert abs(alarm.since - START - 5000) < 30
    assert alarm.told - alarm.since < 30 * 60
    assert f"{which} moved by +15" in after.alarm_text()
    # What was read before is no longer of the window.
    assert after.rows[0].time >= alarm.since
    rate = A * worse[0] * after.answer.window.fit.mean_current + B * worse[1]
    found = after.answer.lifetime
    assert found.value == pytest.approx(1 / rate / 3600, abs=4 * found.error)
    assert after.answer.status == "converged"


def test_a_vacuum_that_drifts_is_in_the_errors_of_a_and_b():
    """Constant a and b would have a off by 90 of their errors."""
    time, beam, readings = np.arange(0.0, 7200.0, 10.0), 500.0, []
    random = np.random.default_rng(3)
    for second in time:
        beam = beam_after(beam, 10.0, A, B * (1 - 0.05 * second / time[-1]))
        readings.append((second, beam + 0.01 * random.normal()))
    fit = watch(readings, Plan(window=8000.0, every=7000.0)).answer.window.fit
    low, high = fit.a.interval_95
    assert low < A < high
    exact = fit.if_constant("a")
    assert abs(exact.value - A) > 10 * exact.error


def test_a_day_of_nothing_but_trouble_is_no_alarm():
    """Refills, gaps, a clock set on and back, dropouts, what is no number, times that repeat."""
    random, state, clock, bad = np.random.default_rng(2), State(), START, 0
    plan = Plan(window=3600.0, every=3600.0)
    for k, (time, current) in enumerate(decay(86400, every=20.0, low=470.0, seed=3)):
        if time % 20_000 < 400 and time > 1000:
            continue  # four gaps
        clock += {1500: 500.0, 2500: -300.0}.get(k, 0.0)
        current = math.nan if k % 97 == 0 else 0.0 if k % 203 == 0 else current
        for _ in range(1 + (random.random() < 0.01)):
            state = stepped(plan, state, CURRENT, clock + time, current)
            bad += math.isnan(current)
    assert (state.alarms, state.alarmed) == ((), "")
    assert state.alarm is not None
    assert state.counts.bad == bad > 40
    assert state.counts.gaps == 5  # and one of the clock set on
    assert state.counts.clock == 1
    assert 30 < state.counts.late < 60
    assert [text for _, text in state.events if "set back" in text] != []
    assert len(state.rows) <= 362  # of a window, and what came since the last fit
    found = state.answer.lifetime
    truth = 1 / (A * state.answer.window.fit.mean_current + B) / 3600
    assert found.value == pytest.approx(truth, abs=4 * found.error)


def test_a_fast_monitor_needs_no_more_memory():
    """Ten readings a row; once the noise is known from a fit, too."""
    plan = Plan(window=4096.0, every=400.0)
    state = watch(decay(900, every=0.1, seed=4), plan)
    assert state.answer.window.fit.rms_residual == pytest.approx(NOISE / 10**0.5, rel=0.2)
    assert 700 < len(state.rows) < 1000
    assert len(state.course) == 2


def test_a_spike_of_the_monitor_hides_no_beam_and_an_impossible_reading_is_none():
    readings = list(decay(700, every=4.0))
    state = watch(readings[:60])
    for time, current in ((240.0, 65535.0), (241.0, 1e308), (1e18, 400.0)):
        state = stepped(PLAN, state, CURRENT, START + time, current)
    state = watch(readings[61:], state=state)
    assert (state.counts.bad, state.counts.late, state.piece) == (3, 0, 0)
    found = state.answer.lifetime
    rate = A * state.answer.window.fit.mean_current + B
    assert found.value == pytest.approx(1 / rate / 3600, abs=4 * found.error)
    # From nothing but noise a beam is believed all the same, once it stays.
    empty = watch([(4.0 * k, 1e-3) for k in range(9)])
    assert watch([(40.0 + time, beam) for time, beam in readings[:9]], state=empty).highest > 400


def test_without_a_beam_there_is_no_lifetime():
    state = watch(decay(2000))
    assert state.answer.lifetime.error < 0.01
    state = watch(((2000.0 + 8 * k, 0.01 * (-1) ** k) for k in range(200)), state=state)
    answer = state.answer.to_json()
    assert answer["message"] == "No lifetime: no beam."
    assert (answer["status"], answer["chi2"]) == ("unidentified", None)
    assert {answer[name]["value"] for name in ("lifetime_mean", "a", "b", "normalised")} == {None}
    assert [text for _, text in state.events] == ["the beam was lost"]
    # Two windows later it is back: nothing is left of the first.
    state = watch(((time + 9200, beam) for time, beam in decay(800, seed=7)), state=state)
    assert state.answer.lifetime.error < 0.01
    assert state.rows[0].time >= START + 9200
    assert state.alarm is not None
    assert [text for _, text in state.events][-1] == "beam again"


def test_the_noise_of_a_monitor_without_beam_is_none_whenever_the_window_ends():
    state, random = watch(decay(1000)), np.random.default_rng(9)
    state = watch(((1000.0 + 8 * k, 2e-3 * random.normal()) for k in range(900)), state=state)
    assert (state.rows, state.answer.message) == ((), "No lifetime: no beam.")
    assert [text for _, text in state.events] == ["the beam was lost"]
    state = watch(((time + 8200, beam - 480) for time, beam in decay(100, seed=7)), state=state)
    assert "beam again" in [text for _, text in state.events]


def test_a_pressure_that_the_gauge_shows_is_no_alarm_and_is_normalised(machine):
    """First principles themselves, with the pressure of the ring's file and twice as much."""
    ring, operation = machine
    plan = PLAN._replace(machine=machine, current=500.0, every=800.0)
    random, state, beam, found = np.random.default_rng(5), State(), 500.0, []
    for time in np.arange(0.0, 9_700.0, 10.0):
        gas = 2.0 if time > 5000 else 1.0
        worse = operation._replace(pressure_base=gas * 2e-8, pressure_slope=gas * 1.6e-10)
        if time in (0.0, 5010.0):
            loss = loss_coefficients(ring, worse, 480.0)
            losses = float(loss.a), float(loss.b)
        beam = float(beam_after(beam, 10.0, *losses))
        pressure = gas * (2e-8 + 1.6e-10 * beam) * (1 + 1e-3 * random.normal())
        state = stepped(plan, state, "pressure", START + time, pressure)
        state = stepped(plan, state, CURRENT, START + time, beam + NOISE * random.normal())
        if time in (4900.0, 9690.0):
            found.append((state.answer.lifetime.value, state.answer.normalised.value))
    assert (state.alarms, state.alarmed) == ((), "")
    (fresh, first), (gassy, second) = found
    assert gassy < 0.9 * fresh
    assert second == pytest.approx(first, rel=0.02)


def test_under_top_up_the_ring_shares_the_loss_and_without_it_nothing_is_usual(machine):
    """At one current readings tell the loss rate alone: 1.1 of what first principles say."""
    loss = loss_coefficients(*machine, 500.0)
    a, b = 1.1 * float(loss.a), 1.1 * float(loss.b)
    time, beam, random, rows = np.arange(0.0, 3600.0, 4.0), 500.0, np.random.default_rng(6), []
    for now in time:
        beam = 500.0 if now % 120 == 0 else float(beam_after(beam, 4.0, a, b))
        rows.append(WindowRow(0, START + now, beam + NOISE * random.normal(), UNREAD))
    window = fit_window(rows, "ring")
    assert window.fit.status == "unidentified"
    assert learn_reference(None, window, rows, None) is None
    usual = learn_reference(None, window, rows, machine).reference
    rate = a * 500 + b
    assert usual.a * 500 + usual.b == pytest.approx(rate, rel=2e-3)
    assert usual.a == pytest.approx(a, rel=2e-3)
    share = a * 500 / rate
    total, apart = np.array([share, 1 - share]), np.array([1.0, -1.0])
    assert total @ usual.covariance @ total < 0.01**2
    assert apart @ usual.covariance @ apart > 0.25**2
