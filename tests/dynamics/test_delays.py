"""Delays anywhere between samples, and inputs that ramp, beside closed forms of a first order."""

import numpy as np
import pytest

from beamfit.dynamics.fit import identify
from beamfit.dynamics.paths import moving_inputs, usable_rows
from beamfit.dynamics.record import Run, Way, interpolate_inputs
from beamfit.errors import InputError, Status

TAU, GAIN = 4.0, 2.0


def swung(late, rng, n=250):
    """Sines that were there before the record, and the output that follows them late."""
    t, w = np.arange(n) * 1.0, 2 * np.pi / rng.uniform(10.0, 60.0, 4)
    turned = rng.uniform(0.3, 1.0, 4) * np.exp(2j * np.pi * rng.random(4))
    waves = np.exp(1j * np.outer(t, w)) * turned
    return t, waves.sum(1).real, (waves @ (GAIN * np.exp(-1j * w * late) / (1 + 1j * w * TAU))).real


def ramped(late, rng, n=250):
    """Set points that a supply goes to in ramps of three samples, and the output, first at rest."""
    t, begin = np.arange(n) * 1.0, np.arange(5.0, n, 20.0)
    slope = rng.uniform(-1.0, 1.0, len(begin)) / 3.0
    since = np.maximum(np.subtract.outer(t, np.concatenate([begin, begin + 3.0])), 0.0)
    follows = np.maximum(since - late, 0.0)
    follows = follows - TAU * -np.expm1(-follows / TAU)
    each = np.concatenate([slope, -slope])
    return t, since @ each, GAIN * follows @ each


def held(late, rng, n=250):
    """Steps at samples, and the output, first at rest."""
    t, begin = np.arange(n) * 1.0, np.arange(5.0, n, 12.0)
    step = rng.uniform(-1.0, 1.0, len(begin))
    since = np.subtract.outer(t, begin)
    return t, (since >= 0) @ step, GAIN * -np.expm1(-np.maximum(since - late, 0.0) / TAU) @ step


@pytest.mark.parametrize(
    ("kind", "late", "said"),
    [
        (swung, 0.0, "to move between samples"),
        (swung, 2.3, "to move between samples"),
        (ramped, 0.0, "to move in straight lines"),
        (ramped, 1.6, "to move in straight lines"),
        (held, 0.43, ""),
    ],
)
def test_a_delay_anywhere_in_a_sample_moves_nothing(kind, late, said):
    """A ramp was refused as clocks that differ; of sines 2.3 samples late half were refused, and
    of the others every fifth time constant was wrong."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        t, u, y = kind(late, rng)
        read = y + 0.01 * y.std() * rng.normal(size=len(t))
        fit = identify(Run(t, {"valve": u}, {"level": read}))
        assert fit.status is Status.converged, (seed, fit.message)
        assert said in fit.message
        q = fit.quantities
        for name, truth in (("tau", TAU), ("K", GAIN)):
            assert abs(q[name].value - truth) < 4 * q[name].error, (seed, name, q[name])
            assert q[name].error < 0.1 * abs(truth)
        apart = q["delay"].error if "delay" in q else 1e-9
        assert abs(fit.delay - late) < 4 * apart + 1e-9, (seed, fit.delay)


def test_readings_hear_the_record_from_the_delay_on():
    y = np.ones(20)
    y[5] = np.nan
    run = Run(np.arange(20.0), {"u": np.arange(20.0)}, {"y": y})
    assert usable_rows(run, "y", 0.0).tolist() == [*range(5), *range(6, 20)]
    assert usable_rows(run, "y", 2.4)[0] == 3
    assert usable_rows(run, "y", -1.5)[-1] == 18


def test_what_was_before_the_record_moves_no_number():
    """The input was far off until just before the first row: two samples later it is heard."""
    rng = np.random.default_rng(3)
    t, u, y = held(2.0, rng)
    y[2:] += 30.0 * np.exp(-(t[2:] - 2.0) / TAU) + 40.0 * (t[2:] < 0)
    y[:2] = [-17.0, 23.0]
    fit = identify(Run(t, {"valve": u}, {"level": y + 0.02 * rng.normal(size=len(t))}), delay=2)
    assert fit.status is Status.converged, fit.message
    for name, truth in (("tau", TAU), ("K", GAIN)):
        q = fit.quantities[name]
        assert abs(q.value - truth) < 4 * q.error


@pytest.mark.parametrize(
    ("name", "u", "expected"),
    [
        ("steps", np.repeat([0.0, 1.0, 0.0, 2.0], 10), ()),
        ("ramps", np.interp(np.arange(40), [0, 9, 12, 25, 28, 39], [0, 0, 1, 1, 3, 3]), ("u",)),
        ("set between rows", np.repeat([0.0, 0.4, 1.0, 1.0], [10, 1, 9, 20]), ("u",)),
        ("noise", np.random.default_rng(1).normal(size=40), ()),
    ],
)
def test_inputs_that_rest_or_go_straight_on_may_ramp(name, u, expected):
    assert moving_inputs([Run(np.arange(40.0), {"u": u}, {"y": u})])[1] == expected


def test_ways_between_samples_are_lines_and_sines():
    """Beside NumPy's interpolation, and a sine at the middles of parts."""
    t = np.arange(64.0)
    middles = np.add.outer(t, (np.arange(4) + 0.5) / 4).ravel()
    u = np.random.default_rng(2).normal(size=64)
    run = Run(t, {"u": u}, {"y": t})
    rows = interpolate_inputs(run, Way(ramping=("u",)), 4)[:, 0]
    assert rows[:252] == pytest.approx(np.interp(middles, t, u)[:252])
    w = 2 * np.pi / 9.0
    run = Run(t, {"u": np.sin(w * t)}, {"y": t})
    rows = interpolate_inputs(run, Way(smooth=("u",)), 4)[:, 0]
    assert rows[20:220] == pytest.approx(np.sin(w * middles)[20:220], abs=2e-3)


def test_a_held_back_run_shorter_than_the_delay_is_named():
    t, u, y = held(12.0, np.random.default_rng(4))
    short = Run(t[:12], {"valve": u[:12]}, {"level": y[:12]}, "friday")
    with pytest.raises(InputError) as found:
        identify(Run(t, {"valve": u}, {"level": y}), delay=12, held=[short])
    assert str(found.value) == (
        "friday: 0 readings of level after a delay of 12 samples; expected a longer run"
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_lag_that_is_never_quite_zero_puts_no_output_before_its_inputs(seed):
    """SIMULATED: a first order, exact to 3e-5, asked for as a second one."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.normal(size=40), 4)
    output, kept = np.zeros(u.size), np.exp(-1 / 60)
    for k in range(1, u.size):
        output[k] = kept * output[k - 1] + (1 - kept) * 0.7 * u[k - 1]
    output += 3e-5 * output.std() * random.normal(size=u.size)
    found = identify(Run(np.arange(u.size) * 1.0, {"u": u}, {"y": output}), model="second-order")
    assert "before its inputs" not in found.message


def test_held_numbers_are_no_freedom_of_a_model():
    """SIMULATED, tau a thirtieth of a sample: directions of no length broke the judgement."""
    random = np.random.default_rng([6, 5])
    n, dt = int(random.integers(20, 200)), 10 ** random.uniform(-2, 2)
    u = np.repeat(random.normal(size=n), int(random.integers(1, 8)))[:n]
    u *= 10 ** random.uniform(-3, 3)
    kept = np.exp(-1 / 10 ** random.uniform(-1.5, 4))
    gain, output = random.normal() * 10 ** random.uniform(-2, 2), np.zeros(n)
    for k in range(1, n):
        output[k] = kept * output[k - 1] + (1 - kept) * gain * u[k - 1]
    output += output.std() * 10 ** random.uniform(-5, 0.5) * random.normal(size=n)
    output += random.choice([0, 5])
    with np.errstate(over="ignore"):  # of slopes at places where the model grows without end
        found = identify(Run(np.arange(n) * dt, {"u": u}, {"y": output}), model="second-order")
    assert found.status in ("poor_fit", "unidentified", "converged")
