"""The alarm on a loss: silent while nothing moves, quick, right about what moved, and exact."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from beamfit.lifetime.alarm import (
    NAMES,
    Reading,
    Reference,
    alarms_of,
    change_statistics,
    initial_state,
    watched,
)
from beamfit.lifetime.course import reference_of
from beamfit.lifetime.fit import fit_decay
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import Decay
from beamfit.statistics import CHANGE_WIDTHS, log_evidence_of_change

# Ten hours at 500 mA, two thirds of the loss from a; 1 µA a second.
USUAL = Reference(a=3.7e-8, b=9.26e-6, noise=1e-3)


def beam_after(beam, seconds, a=USUAL.a, b=USUAL.b):
    """Equation 44, by its own words."""
    gone = np.exp(-b * seconds)
    return beam * gone / (1 + a / b * beam * (1 - gone))


def watch(readings, usual=USUAL, shape=()):
    """Every reading that raised, and every one that named: time, what, change, beam."""
    state, raised, named = initial_state(usual, shape), [], []
    for time, current in readings:
        state, told = watched(usual, state, Reading(time, current))
        raised += [(np.max(time), *k) for k in np.argwhere(told.raised)]
        named += [
            (np.max(time), NAMES[told.moved[tuple(k)]], told.change[tuple(k)], *k)
            for k in np.argwhere(told.moved)
        ]
    return state, raised, named


def decays(beams, count, seed, worse=(1.0, 1.0), moved=np.inf, memory=0.0):
    """SIMULATED: readings of many beams, a second apart; a and b are worse from a time on."""
    random = np.random.default_rng(seed)
    beam, noise = random.uniform(450, 500, beams), random.normal(size=beams)
    for second in range(count):
        factors = worse if second >= moved else (1.0, 1.0)
        beam = beam_after(beam, 1.0, USUAL.a * factors[0], USUAL.b * factors[1])
        noise = memory * noise + np.sqrt(1 - memory**2) * random.normal(size=beams)
        yield np.full(beams, float(second)), beam + USUAL.noise * noise


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_it_is_silent_while_nothing_moves(memory):
    """Seventy thousand readings each; benchmarks/alarm.py takes a million of nine kinds."""
    usual = USUAL._replace(correlation_time=-1 / np.log(memory) if memory else 0.0)
    state, raised, _ = watch(decays(100, 700, 1, memory=memory), usual, (100,))
    assert raised == []
    # And it did look: the largest windows have seen what they should.
    assert state.age.max() == 699
    assert max(part.max() for part in change_statistics(state).squares) > 3


@pytest.mark.parametrize(("which", "worse"), [("a", (1.1, 1.0)), ("b", (1.0, 1.1))])
def test_a_step_of_ten_percent_is_seen_in_a_minute_and_named_in_fifteen(which, worse):
    beams = 20
    _, raised, named = watch(decays(beams, 1500, 2, worse, 600), shape=(beams,))
    assert len({beam for _, beam in raised}) == beams
    assert all(600 < time < 660 for time, _ in raised[:beams])
    in_time = [name for time, name, *_ in named if time < 1500]
    assert in_time.count(which) >= 0.9 * beams
    assert set(in_time) <= {which, "a and b"}
    found = [change["ab".index(which)] for _, name, change, _ in named if name == which]
    np.testing.assert_allclose(np.mean(found), 0.1, atol=0.005)


def test_after_an_alarm_the_new_loss_is_the_usual_one():
    rows = list(decays(1, 1500, 3, (1.2, 1.0), 600))
    found = alarms_of(USUAL, *np.array(rows)[:, :, 0].T)
    assert [alarm.moved for alarm in found] == ["a"]
    [alarm] = found
    assert alarm.b is None
    assert alarm.a.value == pytest.approx(0.2, abs=3 * alarm.a.error)
    assert abs(alarm.since - 600) < 5
    assert "a moved by +20 ± " in alarm.text(dated=False)
    assert alarm.text(dated=True).endswith(" since 1970-01-01 00:10")


def filled(every, factor):
    """The current is multiplied every so many seconds, and decays from there."""

    def made(time, beam):
        parts, level = [], 500.0
        for _ in range(int(np.ceil(time.size / every))):
            parts.append(beam_after(level, np.arange(every + 1.0)))
            level = factor * parts[-1][-1]
        ideal = np.concatenate([part[:-1] for part in parts])[: time.size]
        return time, ideal + beam - beam_after(500.0, time)

    return made


TROUBLE = {
    "refill": filled(700, 1.05),
    "top-up": filled(150, 1.004),
    "lost bunch": filled(700, 0.97),
    "gap": lambda time, beam: (time + 3000.0 * (time > 700), beam),
    "clock set back": lambda time, beam: (time - 500.0 * (time > 700), beam),
    "clock stands": lambda time, beam: (time - np.clip(time - 700, 0, 5), beam),
    "dropouts": lambda time, beam: (time, np.where(time % 97 == 0, np.nan, beam)),
    "beam off": lambda time, beam: (time, np.where((time > 700) & (time < 720), 0.0, beam)),
    "spikes": lambda time, beam: (time, beam + 3.0 * (time % 301 == 0)),
}


def test_what_befalls_a_record_is_no_change_of_the_loss():
    time = np.arange(0.0, 1300.0)
    beam = beam_after(500.0, time) + 1e-3 * np.random.default_rng(4).normal(size=time.size)
    made = [np.stack(np.broadcast_arrays(*happens(time, beam))) for happens in TROUBLE.values()]
    rows = np.moveaxis(made, 0, -1)
    state, raised, _ = watch(zip(*rows, strict=True), shape=(len(TROUBLE),))
    assert [list(TROUBLE)[row] for _, row in raised] == []
    # They were watched all the time: none is blind from its trouble on.
    assert (state.age.max(-1) > 1100).all()


@pytest.mark.parametrize("lasts", [10, 60])
def test_refills_of_many_readings_are_no_change_of_the_loss(lasts):
    beams, beam, random = [], 500.0, np.random.default_rng(0)
    for second in range(3000):
        left = lasts - second % 180
        rises = second >= 180 and left > 0
        beam = beam + (500 - beam) / left if rises else beam_after(beam, 1.0)
        beams.append(float(beam))
    read = np.array(beams) + 1e-3 * random.normal(size=3000)
    assert alarms_of(USUAL, np.arange(3000.0), read) == ()


def test_a_pressure_that_the_gauge_shows_is_no_alarm():
    time = np.arange(0.0, 900.0)
    beam = np.concatenate(
        [beam_after(500.0, time[:450]), beam_after(beam_after(500.0, 450.0), time[:450], b=2e-5)]
    )
    factor = np.where(time < 450, 1.0, 2e-5 / USUAL.b)
    assert alarms_of(USUAL, time, beam, 1.0, factor) == ()
    assert alarms_of(USUAL, time, beam) != ()


@pytest.mark.parametrize("white", [0.0, 0.6])
def test_the_tests_are_those_of_generalised_least_squares(white):
    """All windows that began with the record, against the dense matrices of the same statement."""
    covariance = np.array([[4e-4, -1e-4], [-1e-4, 9e-4]])
    # Stated larger than it is, so that the noise that is followed stays as stated.
    usual = Reference(3.7e-7, 9.26e-5, 1.5e-3, 4.0, covariance=covariance, white=white, wander=0.01)
    random, count = np.random.default_rng(5), 220
    time = np.cumsum(random.uniform(0.5, 1.5, count))
    pieces = np.split(np.arange(count), [120])
    worse = 1.2 * usual.a
    parts = [beam_after(50.0, time[rows] - time[rows[0]], worse, usual.b) for rows in pieces]
    beam = np.concatenate([parts[0], 1.0 + parts[1]])
    lag = (1 - white) * np.exp(-np.abs(time[:, None] - time) / 4.0) + white * np.eye(count)
    beam = beam + 1e-3 * np.linalg.cholesky(lag) @ random.normal(size=count)
    # A window forgets nothing but the ten seconds after a refill, which shows in two readings.
    looked = [pieces[0], pieces[1][time[pieces[1]] > time[121] + 10.0]]
    information, score = np.zeros((2, 2)), np.zeros(2)
    for rows in looked:
        integral = np.concatenate([[0], np.cumsum(np.diff(time) * (beam[1:] + beam[:-1]) / 2)])
        u, v = -usual.a * integral[rows], -usual.b * time[rows]
        y = np.log(beam[rows]) - u - v
        weight = np.linalg.inv(
            lag[np.ix_(rows, rows)] * 1.5e-3**2 / np.outer(beam[rows], beam[rows])
        )
        design = np.stack([np.ones_like(u), u, v], axis=1)
        full, right = design.T @ weight @ design, design.T @ weight @ y
        own = full[1:, 1:] - np.outer(full[1:, 0], full[0, 1:]) / full[0, 0]
        # Each piece has an a and a b of its own about those of all.
        alone = np.linalg.inv(np.eye(2) + own * 0.01**2)
        information += alone @ own
        score += alone @ (right[1:] - full[1:, 0] * right[0] / full[0, 0])
    inverse = np.linalg.inv(np.linalg.inv(information) + covariance)
    found = np.linalg.solve(information, score)
    expected = [(inverse @ found)[k] ** 2 / inverse[k, k] for k in (0, 1)]
    expected.append(found @ inverse @ found)
    state = initial_state(usual)
    for row in zip(time, beam, strict=True):
        state, told = watched(usual, state, Reading(*row))
        assert not told.raised
    [begun] = np.flatnonzero(state.age[:-1] == state.age[:-1].max())[-1:]
    a, b, beside = change_statistics(state).squares
    for name, part, wanted in zip("ab2", (a, b, a + beside), expected, strict=True):
        assert part[begun] == pytest.approx(wanted, rel=5e-3), name
    assert expected[2] > 3


def test_slow_noise_under_white_noise_is_learnt_and_is_no_change_of_the_loss():
    """SIMULATED: half of the variance wanders over five minutes; neighbours hardly show it."""
    random, beams, count = np.random.default_rng(8), 20, 3000
    time, slow, kept = 2.0 * np.arange(count), random.normal(size=beams), np.exp(-2 / 300)
    read = np.empty((count, beams))
    for k in range(count):
        slow = kept * slow + np.sqrt(1 - kept**2) * random.normal(size=beams)
        read[k] = beam_after(500.0, time[k]) + 2e-3 * (slow + random.normal(size=beams))
    fit = fit_decay(DecayRecord(time[:1800], read[:1800, 0]))
    usual = reference_of((Decay.of(fit.readings, 0.0, fit, None),), np.ones(1), np.ones(1))
    assert usual.correlation_time > 100  # a walk does as well for windows that are shorter
    assert usual.white * usual.noise**2 == pytest.approx(2e-3**2, rel=0.1)
    rows = zip(np.broadcast_to(time[:, None], read.shape), read, strict=True)
    assert watch(rows, usual, (beams,))[1] == []


def test_a_monitor_that_stands_still_has_lost_a_and_b():
    """A alone would have moved by -160 %, which no loss does."""
    time = np.arange(0.0, 3000.0)
    beam = beam_after(500.0, np.minimum(time, 1000.0))
    beam = beam + 1e-3 * np.random.default_rng(4).normal(size=time.size)
    first, *_ = alarms_of(USUAL, time, beam)
    assert first.moved == "a and b"
    for change in (first.a, first.b):
        assert change.value == pytest.approx(-1.0, abs=3 * change.error)


def test_many_beams_at_once_are_each_as_alone():
    rows = np.array(list(decays(3, 200, 6)))
    together, *_ = watch(zip(rows[:, 0], rows[:, 1], strict=True), shape=(3,))
    alone, *_ = watch(zip(rows[:, 0, 1], rows[:, 1, 1], strict=True))
    for many, one in zip(together, alone, strict=True):
        np.testing.assert_array_equal(many[1], one)


@pytest.mark.parametrize(("squares", "information"), [(0.0, 1e4), (9.0, 400.0), (40.0, 2e5)])
def test_the_evidence_of_a_change_is_an_integral_over_its_sizes(squares, information):
    error = information**-0.5
    seen, parts = math.sqrt(squares) * error, []
    for width in CHANGE_WIDTHS:
        spread = np.linspace(-12, 12, 20001) / math.hypot(1 / width, 1 / error)
        middle = seen * width**2 / (width**2 + error**2)
        sizes = middle + spread
        density = norm.pdf(sizes, scale=width) * norm.pdf(seen, sizes, error)
        parts.append(np.trapezoid(density, sizes) / norm.pdf(seen, scale=error))
    found = log_evidence_of_change(np.array(squares), np.array(information))
    assert found == pytest.approx(math.log(np.mean(parts)), abs=1e-6)
    # With many readings that tell the noise it is as good as known.
    many = log_evidence_of_change(np.array(squares), np.array(information), 1e7)
    assert many == pytest.approx(float(found), abs=1e-3)


def test_where_nothing_changes_the_evidence_seldom_grows():
    """Of 2000 records of 500 readings one in twenty may ever show twenty to one."""
    noise = np.random.default_rng(9).normal(size=(2000, 500))
    count = np.arange(1, 501)
    squares = np.cumsum(noise, axis=1) ** 2 / count
    evidence = log_evidence_of_change(squares, np.broadcast_to(25.0 * count, squares.shape))
    assert np.mean(evidence.max(axis=1) > math.log(20.0)) < 1 / 20
    assert np.mean(evidence.max(axis=1) > math.log(2.0)) > 0.01
