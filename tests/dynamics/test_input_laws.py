"""Laws of an input as alternatives: what they hand on, their weights, what errors contain."""

import re

import jax
import numpy as np
import pytest

from beamfit.dynamics.alternatives import (
    HIGHER,
    NO_DEPARTURE,
    Alternatives,
    alternatives_of,
)
from beamfit.dynamics.checks import fuller_model_slopes
from beamfit.dynamics.fit import identify
from beamfit.dynamics.input_laws import apply_law, laws_between
from beamfit.dynamics.paths import Path, Paths, inputs_with_levels
from beamfit.dynamics.record import Run, Way, gain_error_share, levels_of
from beamfit.dynamics.response import FIRST_ORDER, SECOND_ORDER, simulate
from beamfit.dynamics.search import ResponseSearch
from beamfit.errors import Status
from tests.simulations import simulations

UP_AND_DOWN = np.array([0.0, 1.0, 2.0, 2.0, 1.5, 1.0, 0.0, -1.0])


@pytest.mark.parametrize(
    ("law", "width", "wanted"),
    [
        # By hand: the play's right edge pushes from 0.5 on, its left one from 1.0 down.
        ("play", 0.5, [0.0, 0.5, 1.5, 1.5, 1.5, 1.5, 0.5, -0.5]),
        ("stop", 0.8, [0.0, 1.0, 2.0, 2.0, 2.0, 1.0, 0.0, -1.0]),
        ("dead zone", 0.5, [0.0, 0.5, 1.5, 1.5, 1.0, 0.5, 0.0, -0.5]),
        ("shift", 0.5, [0.0, 0.5, 1.5, 1.5, 2.0, 1.5, 0.5, -0.5]),
        ("saturation", 0.8, [0.0, 0.8, 0.8, 0.8, 0.8, 0.8, 0.0, -0.8]),
        ("rate limit", 0.75, [0.0, 0.75, 1.5, 2.0, 1.5, 1.0, 0.25, -0.5]),
        ("square law", 2.0, [0.0, 1.5, 4.0, 4.0, 2.625, 1.5, 0.0, -0.5]),
    ],
)
def test_what_a_law_hands_on(law, width, wanted):
    assert apply_law(UP_AND_DOWN, law, width).tolist() == wanted


def test_a_hysteresis_is_the_mean_of_plays():
    plays = [apply_law(UP_AND_DOWN, "play", share * 0.3) for share in (0, 0.4, 0.8, 1.2, 1.6, 2)]
    np.testing.assert_allclose(apply_law(UP_AND_DOWN, "hysteresis", 0.3), np.mean(plays, axis=0))


def test_an_error_is_that_of_the_mixture_about_the_value_of_the_answer():
    """Beside draws from the mixture."""
    random = np.random.default_rng(0)
    shift, covariance = np.array([[2.0, 1.0], [0.0, -3.0]]), np.stack([np.diag([1.0, 0.5])] * 2)
    own, weight = Path(None, Way(), 0.0), np.array([0.3, 0.2])
    found = Alternatives(own, 0.0, 0.0, NO_DEPARTURE, weight, shift, covariance)
    slope = np.array([1.0, 0.5])
    which = random.choice(3, 200_000, p=[0.5, 0.3, 0.2])
    laws = [random.multivariate_normal(s, c, 200_000) @ slope
            for s, c in zip(shift, covariance, strict=True)]  # fmt: skip
    drawn = np.choose(which, [0.7 * random.normal(size=200_000), *laws])
    assert found.error(slope, np.array(0.7)) == pytest.approx(np.sqrt(np.mean(drawn**2)), rel=0.01)


def response(u, moves, noise, random, tau=3.0):
    """A first order of gain 2 behind what moves, read every 0.5 s with noise, SIMULATED."""
    kept, y = np.exp(-0.5 / tau), 2.0 * np.asarray(moves)
    for k in range(1, len(u)):
        y[k] = 2.0 * moves[k - 1] + (y[k - 1] - 2.0 * moves[k - 1]) * kept
    y = y + noise * y.std() * random.normal(size=len(u))
    return Run(0.5 * np.arange(len(u)), {"valve": np.asarray(u)}, {"level": y})


def plays(u, half):
    """A play written as a loop."""
    at, found = u[0], []
    for now in u:
        at = min(max(at, now - half), now + half)
        found.append(at)
    return np.array(found)


FAMILIES = {
    "a play, steps": lambda u: plays(u, 0.08),
    "a hysteresis": lambda u: np.mean([plays(u, h) for h in np.linspace(0, 0.3, 7)], axis=0),
    "a dead zone": lambda u: 1.5 + np.sign(u - 1.5) * np.maximum(np.abs(u - 1.5) - 0.1, 0.0),
    "a shift by the direction": lambda u: u - 0.1 * np.sign(np.diff(u, prepend=u[0])),
}
SEEDS = (1, pytest.param(12, marks=pytest.mark.calibrate))


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("count", SEEDS)
def test_no_gain_behind_a_law_is_sure_and_wrong(family, count):
    """Up to 9 errors off without the laws' part of the error."""
    for seed in range(count):
        random = np.random.default_rng([seed, 3])
        u = np.repeat(random.uniform(0, 3, 15), 20)
        noise = random.choice([0.03, 0.1])
        fit = identify(response(u, FAMILIES[family](u), noise, random), delay=0)
        gain = fit.quantities["K"]
        assert fit.status is not Status.converged or abs(gain.value - 2) < 3 * gain.error, seed


def test_a_play_is_found_where_the_delay_is_no_whole_number_of_samples():
    """Half a sample: searches that made steps between samples negative passed for perfect fits."""
    random = np.random.default_rng(1)
    u = np.repeat(random.uniform(0, 3, 30), 10)
    moves = np.repeat(plays(u, 0.1), 2)
    fine = response(moves, np.append(moves[0], moves[:-1]), 0.0, random, tau=6.0)
    level = fine.outputs["level"][::2]
    level = level + 0.01 * level.std() * random.normal(size=300)
    fit = identify(Run(0.5 * np.arange(300), {"valve": u}, {"level": level}))
    assert fit.status is Status.poor_fit
    assert fit.checks.law.startswith("a play of valve"), fit.message


BENDS = {
    "a dead zone of valve by ±": lambda u: u - np.clip(u - 1.4, -0.35, 0.35),
    "a saturation of valve above 2.": lambda u: np.minimum(u, 2.2),
    "a square law of valve (gain 0.": lambda u: u**2 / 3.0 + 0.3 * u,
}


@pytest.mark.parametrize("words", BENDS)
def test_a_bend_of_the_gain_is_named_for_what_it_is(words):
    """All of them were called a dead zone, a square law what the model lacks."""
    for seed in (3, 4):
        random = np.random.default_rng(seed)
        u = np.repeat(random.uniform(0, 3, 25), 12)
        fit = identify(response(u, BENDS[words](u), 0.03, random), delay=0)
        assert fit.status is Status.poor_fit
        assert fit.checks.law.startswith(words), fit.checks.law
        assert "--map network" in fit.message


def test_a_dead_zone_of_a_range_with_zero_may_lie_elsewhere():
    """About 0 alone it was none, and the gain 6 errors off."""
    random = np.random.default_rng(7)
    u = np.repeat(random.uniform(-1, 1, 30), 12)
    fit = identify(response(u, u - np.clip(u - 0.3, -0.2, 0.2), 0.2, random), delay=0)
    gain = fit.quantities["K"]
    assert fit.status is Status.poor_fit or abs(gain.value - 2) < 3 * gain.error
    assert fit.checks.law.startswith("a dead zone of valve by ±"), fit.message
    assert {law.place for law in laws_between("valve", -1.0, 1.0) if law.kind == "dead zone"} > {
        0.0
    }


def test_what_is_all_but_impossible_is_in_no_error():
    """A dead zone that hands on a sliver of the input had a gain of 1e13 and P = 2e-17."""
    random = np.random.default_rng(1)
    u = np.repeat([0.0, 1.0, -0.95, 0.1], 20)
    fit = identify(response(u, u, 0.05, random, tau=300.0), delay=0)
    slope = fit.quantities["K/tau"]
    assert abs(slope.value - 2 / 300) < 4 * slope.error < 0.003


def test_ramps_do_not_stand_at_levels():
    u = np.interp(np.arange(160), [0, 40, 70, 120, 159], [0.0, 1.0, 0.3, 0.9, 0.2])
    most = Paths.of([Run(np.arange(160.0), {"valve": u}, {"level": u})], None, False).movable
    assert most.moving == ("valve",)
    assert not most.standing


def test_a_few_values_of_an_input_leave_several_bends_possible():
    """What only the highest of four values feels is a saturation or a dead zone below it."""
    random = np.random.default_rng(5)
    u = np.repeat(random.integers(0, 4, 40) * 1.0, 8)
    fit = identify(response(u, np.minimum(u, 2.5), 0.03, random), delay=0)
    assert "a saturation of valve above 2." in fit.checks.law
    assert " or a dead zone of valve by ±" in fit.checks.law


def test_two_values_of_an_input_do_not_tell_a_dead_zone():
    """The gain between them is what is measured: no law makes its error larger."""
    random = np.random.default_rng(2)
    u = np.repeat(random.integers(0, 2, 40) * 3.0, 6)
    fit = identify(response(u, u, 0.1, random), delay=0)
    assert fit.status is Status.converged
    assert fit.quantities["K"].error < 0.1
    assert abs(fit.quantities["K"].value - 2) < 3 * fit.quantities["K"].error


@pytest.mark.parametrize("few", [True, False])
def test_levels_of_a_readback_are_those_that_were_set(few):
    """Of a few settings all readings tell each; twelve tell one of many."""
    random, off, squares = np.random.default_rng(4), [], []
    for _ in range(8):
        set_to = random.choice([0.0, 1.0, 2.5], 40) if few else random.uniform(-1, 1, 40)
        u = np.repeat(set_to, 12)
        found = levels_of(u + 0.02 * random.normal(size=u.size))
        off.append(np.sqrt(np.mean((found.at - u) ** 2)))
        squares.append((found.at - u) ** 2 / found.variance)
    assert np.median(off) < (0.0025 if few else 0.008)
    assert 0.7 < np.sqrt(np.mean(squares)) < 1.5
    assert np.array_equal(levels_of(u).at, u)


def test_inputs_without_steps_have_no_levels():
    random, t = np.random.default_rng(5), np.arange(300.0)
    smooth = {"walk": np.cumsum(random.normal(size=300)), "sine": np.sin(t / 10)}
    smooth |= {"white": random.normal(size=300), "set": np.repeat(random.uniform(size=30), 10)}
    smooth["noisy sine"] = smooth["sine"] + 0.02 * random.normal(size=300)
    read = smooth["set"] + 0.01 * random.normal(size=300)
    assert inputs_with_levels([Run(t, {**smooth, "read": read}, {"level": t})]) == ("read",)


def test_a_gain_is_unsure_by_the_errors_of_levels():
    """Beside slopes of straight lines through points whose places are read with noise."""
    random = np.random.default_rng(6)
    u = np.repeat([0.0, 1.0, 3.0, 0.0, 3.0], 20)
    reads = [u + 0.2 * random.normal(size=100) for _ in range(400)]
    gains = [np.polyfit(levels_of(read).at, 2.0 * u, 1)[0] for read in reads]
    t, way = np.arange(100.0), Way(standing=("u",))
    own = np.mean(
        [gain_error_share([Run(t, {"u": u_read}, {"y": u})], way, "u") for u_read in reads[:40]]
    )
    assert np.std(gains) / 2.0 == pytest.approx(own, rel=0.25)
    assert abs(np.mean(gains) / 2.0 - 1) < 3 * np.std(gains) / 20


@pytest.mark.parametrize("count", SEEDS)
def test_a_readback_that_scatters_about_its_steps_is_no_law(count):
    """A saturation that hides the scatter of two values was beyond doubt."""
    for seed in range(count):
        random = np.random.default_rng([seed, 8])
        u = np.repeat(random.choice([-1.0, 1.0], 30), 10)
        run = response(u, u, 0.01, random)
        read = Run(run.time, {"valve": u + 0.03 * random.normal(size=300)}, run.outputs)
        fit = identify(read)
        assert fit.status is Status.converged, fit.message
        assert "Readings of valve scatter about levels" in fit.message
        gain = fit.quantities["K"]
        assert abs(gain.value - 2) < 3 * gain.error, seed
        # The levels are known to .03/sqrt(150): a law that only hides the scatter adds nothing.
        assert gain.error < 0.02, seed


@pytest.mark.parametrize("scatter", [0.005, 0.04])
def test_three_settings_leave_a_gain_whatever_their_errors_bend(scatter):
    """A dead zone about the middle one is a gain, but for errors of levels: K was 2 ± 4."""
    random = np.random.default_rng(3)
    u = np.repeat(random.choice([0.5, 1.5, 2.5], 30), 10)
    run = response(u, u, 0.01, random)
    read = {"valve": u + scatter * random.normal(size=300)}
    gain = identify(Run(run.time, read, run.outputs)).quantities["K"]
    assert abs(gain.value - 2) < 3 * gain.error < 0.1


def test_an_output_that_follows_the_scatter_is_driven_by_it():
    random = np.random.default_rng(9)
    u = np.repeat(random.choice([-1.0, 1.0], 30), 10) + 0.1 * random.normal(size=300)
    fit = identify(response(u, u, 0.01, random))
    assert fit.status is Status.converged, fit.message
    assert fit.checks.way.standing == ()


def test_a_supply_that_ramps_at_a_fixed_rate_is_said():
    """Its ramps were noise with a memory, and tau was 2 to 4 errors off."""
    random = np.random.default_rng(5)
    u, at, moves = np.repeat(random.uniform(0, 3, 20), 15), 0.0, []
    for now in u:
        at += np.clip(now - at, -0.25, 0.25)
        moves.append(at)
    fit = identify(response(u, moves, 0.03, random))
    assert fit.status is Status.poor_fit
    assert "The output follows a rate limit of valve" in fit.message, fit.message


def oscillation(seed, m):
    """A process of second order that is still before the run, of m inputs, SIMULATED."""
    random = np.random.default_rng([seed, 41])
    moves = np.stack([np.repeat(random.uniform(0, 3, 20), 12) for _ in range(m)], axis=1)
    time, damping = np.exp(random.uniform(np.log(1.5), np.log(8.0))), random.uniform(0.1, 0.9)
    p = np.array([time, damping, *random.uniform(0.5, 2.0, moves.shape[1])])
    start = np.array([moves[0] @ p[2:], 0.0])
    y = jax.jit(simulate, static_argnums=0)(
        SECOND_ORDER, np.tile(p, (240, 1)), moves, np.ones(240), start
    )
    y = y + random.choice([0.01, 0.03, 0.1]) * np.std(y) * random.normal(size=240)
    inputs = {f"u{k}": each for k, each in enumerate(moves.T)}
    return Run(np.arange(240.0), inputs, {"y": np.asarray(y)}), time, damping


@simulations(10, 60)
def test_a_second_order_is_no_law_of_an_input(count):
    """8 of 16 were a rate limit or a shift: no further lag oscillates, and laws had no rival."""
    told, named = 0, []
    for seed in range(count):
        run, *truth = oscillation(seed, 1 + seed // 10 % 2)
        fit = identify(run)
        told += "a higher order" in fit.message or fit.status is Status.converged
        if fit.checks.law_kind == HIGHER:
            assert fit.message.endswith("--model second-order."), fit.message
            about = re.search(r"T of about (\S+) s and zeta of about (\S+) \(p", fit.message)
            named.append(np.array(about.groups(), float) / truth)
    assert told >= 0.9 * count
    assert len(named) >= count / 2
    np.testing.assert_allclose(named, 1.0, atol=0.1)


def test_errors_take_a_second_order_as_a_first_with_the_sum_of_its_lags():
    run, time, damping = oscillation(1, 1)
    search = ResponseSearch("y", FIRST_ORDER, Paths.of((run,), None, False), True)
    found = search.identify((run,))
    slopes = fuller_model_slopes(found.prepared, found.fit)
    others = alternatives_of((run,), found, search, slopes, True)
    assert others.departure.kind == HIGHER
    numbers = [v.name for v in found.fit.variables]
    mean = found.fit.theta[: others.shift.shape[1]] + others.weight @ others.shift
    lags = np.exp(mean[numbers.index("map[0]")])
    assert abs(lags / (2.0 * damping * time) - 1.0) < 0.1, (lags, damping, time)
    error = others.error(np.eye(len(mean))[[numbers.index("map[0]")]], np.zeros(1))
    assert error > 0.9 * abs(np.log(lags) - found.fit.theta[numbers.index("map[0]")])


def test_readings_far_off_that_follow_the_inputs_are_no_bad_ones():
    """The first readings after steps went the other way: 17 were left out, and T was wrong."""
    random = np.random.default_rng(1)
    u = np.repeat(random.uniform(0, 3, 20), 15)
    run = response(u, u, 0.01, random)
    level = run.outputs["level"] - 1.5 * np.diff(u, prepend=u[0])
    fit = identify(Run(run.time, run.inputs, {"level": level}))
    assert fit.status is Status.poor_fit, fit.message
    assert not fit.left_out
