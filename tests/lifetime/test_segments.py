import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from beamfit.errors import InputError
from beamfit.lifetime.fit import fit_decays
from beamfit.lifetime.pieces import split_record
from beamfit.lifetime.readings import noise_of
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.lifetime.study import study_record


def decay(time, i0=100.0, lifetime=36000.0, noise=1e-3, seed=1):
    exact = i0 * np.exp(-time / lifetime)
    return exact + noise * np.random.default_rng(seed).normal(size=time.size)


TIME = np.arange(0.0, 6000.0, 10.0)


def kinds(split):
    return [event.kind for event in split.events]


def test_a_clean_decay_is_left_alone():
    split = split_record(DecayRecord(TIME, decay(TIME), name="clean"))
    assert kinds(split) == []
    assert [len(part) for part in split.segments] == [600]
    assert split.segments[0].name == "clean"


def test_no_false_alarm_in_noise_of_any_size():
    for seed in range(40):
        noise = 10.0 ** (seed % 5 - 4)
        split = split_record(DecayRecord(TIME, decay(TIME, noise=noise, seed=seed)))
        assert kinds(split) == []


def test_top_up_is_cut_at_every_refill():
    saw = decay(TIME % 500, noise=1e-3)
    split = split_record(DecayRecord(TIME, saw, name="top-up"))
    assert kinds(split) == ["refill"] * 11
    assert [event.time for event in split.events] == [500.0 * k for k in range(1, 12)]
    assert [len(part) for part in split.segments] == [50] * 12
    assert split.segments[3].name == "top-up#4"
    fits = fit_decays(split.segments)
    assert all(
        fit.lifetime_mean.value == pytest.approx(10, abs=4 * fit.lifetime_mean.error)
        for fit in fits
    )


def test_a_loss_step_ends_a_decay():
    current = decay(TIME)
    current[300:] -= 0.5
    split = split_record(DecayRecord(TIME, current))
    assert kinds(split) == ["loss"]
    assert split.events[0].time == 3000.0
    assert split.events[0].change == pytest.approx(-0.53, abs=0.02)
    assert [len(part) for part in split.segments] == [300, 300]
    assert split.segments[1].time[0] == 0


def test_dropouts_and_spikes_are_dropped_and_the_decay_goes_on():
    current = decay(TIME)
    current[100:140] = 0.0
    current[400] += 3.0
    split = split_record(DecayRecord(TIME, current))
    assert kinds(split) == ["dropout", "spike"]
    assert split.events[0].duration == pytest.approx(390.0)
    assert [len(part) for part in split.segments] == [559]


def test_a_beam_that_is_lost_does_not_come_back():
    current = decay(TIME)
    current[500:] = 0.0
    split = split_record(DecayRecord(TIME, current))
    assert kinds(split) == ["loss"]
    assert split.events[0].change == pytest.approx(-87, abs=1)
    assert [len(part) for part in split.segments] == [500]


def test_a_decay_over_many_lifetimes_is_no_dropout():
    time = np.arange(0.0, 6000.0, 10.0)
    split = split_record(DecayRecord(time, np.abs(decay(time, lifetime=600.0, noise=1e-4))))
    assert [len(part) for part in split.segments] == [600]


def test_saturated_readings_are_dropped():
    current = np.minimum(decay(TIME), 98.0)
    split = split_record(DecayRecord(TIME, current))
    assert kinds(split) == ["saturated"]
    assert split.segments[0].current.max() < 98.0
    assert len(split.segments[0]) == pytest.approx(527, abs=2)


def test_quantised_readings_are_not_steps():
    record = DecayRecord(TIME, np.round(decay(TIME), 1))
    assert record.resolution == pytest.approx(0.1)
    split = split_record(record)
    assert kinds(split) == []
    assert [len(part) for part in split.segments] == [600]


@pytest.mark.parametrize("digits", [6, 2])
def test_readings_that_are_held_are_those_of_a_slow_monitor(digits):
    """Repeats lie half a step too high, and are no digits of the monitor."""
    time = np.arange(0.0, 7200.0)
    exact = 500 * np.exp(-time / 36000)
    noise = 0.01 * np.random.default_rng(3).normal(size=time.size)
    held = np.round(exact + noise, digits)[(time // 5 * 5).astype(int)]
    study = study_record(DecayRecord(time, held, start=0.0))
    assert len(study.record) == 1440
    assert "5760 of 7200 readings repeat" in study.record.notes[0]
    (fit,) = (decay.fit for decay in study.decays)
    assert "quantised" not in fit.message or digits == 2
    assert abs(fit.i0.value - 500) < 3 * fit.i0.error < 0.01
    assert abs(fit.lifetime_mean.value - 10) < 3 * fit.lifetime_mean.error < 0.01


def test_repeats_of_a_coarse_monitor_are_kept():
    assert len(study_record(DecayRecord(TIME, np.round(decay(TIME), 1))).record) == TIME.size


def test_a_gap_is_noted_and_a_refill_in_it_found():
    kept = (TIME < 2000) | (TIME > 4000)
    smooth = split_record(DecayRecord(TIME[kept], decay(TIME)[kept]))
    assert kinds(smooth) == ["gap"]
    assert [len(part) for part in smooth.segments] == [int(kept.sum())]
    refilled = decay(TIME)[kept]
    refilled[200:] += 10
    cut = split_record(DecayRecord(TIME[kept], refilled))
    assert sorted(kinds(cut)) == ["gap", "refill"]
    assert [len(part) for part in cut.segments] == [200, int(kept.sum()) - 200]


def test_pieces_too_short_to_fit_are_named():
    current = decay(TIME)
    current[590:] += 5
    current[595:] += 5
    split = split_record(DecayRecord(TIME, current))
    assert kinds(split).count("short") == 2
    assert [len(part) for part in split.segments] == [590]


def test_the_noise_of_uneven_readings():
    rng = np.random.default_rng(3)
    time = np.sort(rng.uniform(0, 6000, 2000))
    current = 100 * np.exp(-time / 36000) + 0.02 * rng.normal(size=2000)
    assert noise_of(time, current) == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("time", "current", "column", "words"),
    [
        ([0, 1, 1, 2], [4, 3, 2, 1], "time", "reading 3: time 1 s after 1 s"),
        ([0, 1, 2, 3], [4, 3, -2, 1], "current", "reading 3: a negative current, -2 mA"),
        ([0, 1, 2, 3], [4, np.nan, 2, 1], "current", "reading 2: nan"),
        ([0, 1, 2, 3, 4], [99, 98, 0.097, 0.096, 0.095], "current", "a factor of 1000"),
        ([0, 1, 2, 3, 4], [99, 98, 0.098, 0.098, 0.098], "current", "a factor of 1000"),
    ],
)
def test_what_no_beam_can_do(time, current, column, words):
    with pytest.raises(InputError, match=words) as caught:
        DecayRecord(time, current)
    assert caught.value.column == column


@pytest.mark.parametrize("after", [[0.0982], [0.0982, 0.031, 0.12], [0.0982, 0.0, 0.098]])
def test_what_is_left_after_a_dump_is_no_change_of_unit(after):
    current = np.array([99.0, 98.5, 98.2, *after])
    assert DecayRecord(np.arange(current.size), current).current.size == current.size


def test_an_injection_after_readings_of_one_digit_is_no_change_of_unit():
    current = np.array([0.0, 0.01, 0.01, 9.98, 9.97, 9.97, 9.96])
    assert DecayRecord(np.arange(7), current).current.size == 7


def test_errors_and_conditions_are_checked():
    with pytest.raises(InputError, match="reading 2: an error of 0 mA"):
        DecayRecord([0, 1], [2, 1], [0.1, 0.0])
    with pytest.raises(InputError, match="a negative pressure"):
        DecayRecord([0, 1], [2, 1], conditions=Conditions(pressure=[1e-8, -1e-8]))
    with pytest.raises(InputError, match=r"current of shape \(3,\); expected 2 readings"):
        DecayRecord([0, 1], [3, 2, 1])
    with pytest.raises(InputError, match="1 readings; expected two or more"):
        DecayRecord([0], [3])


def test_a_record_cannot_be_changed():
    source = np.array([3.0, 2.0, 1.0])
    record = DecayRecord([5, 6, 7], source, conditions=Conditions(bunches=[280, 280, 280]))
    source[0] = 9.0
    assert record.current[0] == 3.0
    assert record.time.tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        record.current[0] = 4.0
    assert record.select([0, 2]).conditions.bunches.tolist() == [280.0, 280.0]


def test_a_dead_first_reading_is_a_dropout_and_not_a_refill():
    time = np.arange(0.0, 6000.0, 10.0)
    noise = 5e-3 * np.random.default_rng(8).normal(size=time.size)
    current = 200.0 / (1 + 1e-5 * time) + noise
    dead = current.copy()
    dead[:2] = 0.0
    found = split_record(DecayRecord(time, dead))
    assert [event.kind for event in found.events] == ["dropout"]
    assert len(found.segments) == 1
    np.testing.assert_array_equal(found.segments[0].current, current[2:])


@pytest.mark.parametrize("kind", ["linear", "small", "smooth"])
@pytest.mark.parametrize("noise", [0.002, 0.1])
def test_a_ramp_of_injection_at_the_head_is_cut(kind, noise):
    ramp = np.clip(TIME / 300, 0, 1)
    lacking = {
        "linear": 50 * (1 - ramp),
        "small": 1 - ramp,
        "smooth": 30 * np.exp(-TIME / 50),
    }[kind]
    split = split_record(DecayRecord(TIME, decay(TIME, lifetime=31 * 3600, noise=noise) - lacking))
    assert kinds(split) == ["ramp"]
    [found] = fit_decays(split.segments)
    off = found.lifetime_mean.value - 31
    assert abs(off) < 3 * found.lifetime_mean.error < 0.02 * 31
    assert len(split.segments[0]) > 500


def test_noise_with_a_memory_is_no_ramp():
    for seed in range(40):
        memory = (0.5, 0.9, 0.97, 0.99)[seed % 4]
        fresh = np.random.default_rng(seed).normal(size=1600)
        noise = lfilter([np.sqrt(1 - memory**2)], [1, -memory], fresh)[-600:]
        split = split_record(DecayRecord(TIME, decay(TIME) + 10.0 ** -(seed % 3) * noise))
        assert "ramp" not in kinds(split)


def test_a_setting_that_only_scatters_is_named_with_its_remedy():
    volts = 3.2e6 * (1 + 0.02 * np.random.default_rng(1).normal(size=TIME.size))
    record = DecayRecord(TIME, decay(TIME), conditions=Conditions(rf_voltage=volts))
    with pytest.raises(InputError, match=r"changes of rf_voltage by more than 1 %; .* --ignore"):
        study_record(record)


def test_a_current_that_rises_is_no_decay():
    time = np.arange(500.0)
    noise = 5e-3 * np.random.default_rng(1).normal(size=time.size)
    with pytest.raises(InputError, match="a current that rises"):
        study_record(DecayRecord(time, 100 + time / 100 + noise))


def test_refills_of_many_readings_are_cut_and_drifts_are_not():
    for ramp in (60.0, 300.0):  # s
        phase = TIME % 2000
        low = 100 * np.exp(-(2000 - ramp) / 36000)
        fill = np.where(phase < ramp, low + (100 - low) * phase / ramp, decay(phase - ramp))
        split = split_record(DecayRecord(TIME, fill))
        assert kinds(split) == ["ramp"] * 3
        assert [part.current[0] > 99 for part in split.segments] == [True] * 3
        for part in split.segments:
            assert np.polyfit(part.time, np.log(part.current), 1)[0] == pytest.approx(
                -1 / 36000, 1e-2
            )
    drift = decay(TIME) * (1 + 0.02 * np.sin(TIME / 500))
    assert kinds(split_record(DecayRecord(TIME, drift))) == []


@pytest.mark.parametrize("lasts", [5, 10, 20])
@pytest.mark.parametrize("change", [-0.3, -0.03, 0.05, 0.3])
def test_losses_and_refills_of_many_readings_are_cut(lasts, change):
    share = np.clip((np.arange(TIME.size) - 250) / lasts, 0, 1)
    beam = 100 * np.exp(-TIME / 36000) * (1 + change * share)
    noise = 1e-2 * np.random.default_rng(lasts).normal(size=TIME.size)
    study = study_record(DecayRecord(TIME, beam + noise))
    assert [event.kind for event in study.events] == ["ramp" if change > 0 else "loss"]
    assert sum(len(decay.segment) for decay in study.decays) > TIME.size - 6 * lasts
    for decay in study.decays:
        found = decay.fit.lifetime_mean
        assert abs(found.value - 10) < 3.5 * found.error < 0.2


@pytest.mark.parametrize("lasts", [3, 10])
@pytest.mark.parametrize("dead", [0, 100])
def test_a_beam_that_is_dumped_over_some_readings_is_answered(lasts, dead):
    """What the monitor shows of no beam afterwards is none that comes back."""
    time = np.arange(0.0, 10.0 * (600 + lasts + dead), 10.0)
    left = np.clip(1 - (np.arange(time.size) - 599) / lasts, 0, 1)
    noise = 0.1 * np.random.default_rng(dead + lasts).normal(size=time.size)
    beam = np.maximum(100 * np.exp(-time / 36000) * left + noise, 0)
    study = study_record(DecayRecord(time, beam))
    assert {event.kind for event in study.events} <= {"loss", "short"}
    [decay] = study.decays
    assert 570 < len(decay.segment) <= 600
    assert abs(decay.fit.lifetime_mean.value - 10) < 3.5 * decay.fit.lifetime_mean.error


def test_a_dump_to_what_the_monitor_shows_without_beam_ends_the_decay():
    time = 30.0 * np.arange(1000)
    beam = 100 * np.exp(-time / 36000)
    beam[800:805], beam[805:] = beam[799] * np.array([0.5, 0.2, 0.07, 0.02, 0.004]), 0.2
    noise = 1e-3 * np.random.default_rng(1).normal(size=time.size)
    [decay] = study_record(DecayRecord(time, beam + noise)).decays
    assert len(decay.segment) == 800
    assert abs(decay.fit.lifetime_mean.value - 10) < 3 * decay.fit.lifetime_mean.error


def test_noise_before_the_beam_is_no_decay():
    time = 30.0 * np.arange(4000)
    beam = np.where(time < 90000, 0.0, 100 * np.exp(-(time - 90000) / 36000))
    noise = 0.01 * np.random.default_rng(1).normal(size=time.size)
    study = study_record(DecayRecord(time, np.maximum(beam + noise, 0)))
    assert [len(decay.segment) for decay in study.decays] == [1000]
    assert kinds(study) == ["dropout"]


@pytest.mark.parametrize("ramp", [0, 12])
@pytest.mark.parametrize("hours", [(30, 4, 30), (5, 2.5, 5), (2, 8, 30, 5)])
def test_fills_of_other_lifetimes_are_answered_each(hours, ramp):
    """Fresh beam that decays faster is no loss, and fills of no one law have no common answer."""
    parts, since = [], 10.0 * np.arange(800)
    for life in hours:
        rise = np.linspace(parts[-1][-1], 100, ramp + 2)[1:-1] if parts else []
        parts += [rise, 100 * np.exp(-since / 3600 / life)]
    beam = np.concatenate(parts)
    noise = 1e-3 * np.random.default_rng(1).normal(size=beam.size)
    study = study_record(DecayRecord(10.0 * np.arange(beam.size), beam + noise))
    assert not study.pooled
    for decay, life in zip(study.decays, hours, strict=True):
        assert len(decay.segment) > 770
        found = decay.fit.lifetime_mean
        assert abs(found.value - life) < 4 * found.error < 1e-3 * life


def test_fills_of_very_different_lifetimes_are_not_cut_finer():
    """One law does not hold for all of them: what it leaves is no refill."""
    time, parts = 10.0 * np.arange(2000), []
    for life in (1.3, 30.0, 4.0, 11.0):
        parts.append(100 * np.exp(-time / 3600 / life))
    noise = 0.01 * np.random.default_rng(4).normal(size=8000)
    study = study_record(DecayRecord(10.0 * np.arange(8000), np.concatenate(parts) + noise))
    assert [len(decay.segment) for decay in study.decays] == [2000] * 4


def test_a_law_that_bends_fast_has_no_steps():
    time = np.linspace(0.0, 1.0, 800)
    for beam in (np.exp(-8 * time), 1 / (1 + 30 * time), np.exp(-2 * time) + np.exp(-30 * time)):
        noise = 1e-4 * np.random.default_rng(1).normal(size=time.size)
        assert kinds(split_record(DecayRecord(3600 * time, 100 * np.abs(beam + noise)))) == []


def test_a_gap_between_uneven_readings_is_no_step():
    """What is lost in a long gap has the error of the loss rate near it."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        time = np.sort(rng.uniform(0.0, 36000.0, 400))
        time = time[(time < 12000) | (time > 18000)] - time[0]
        noisy = 300 * np.exp(-time / 36000) + 0.3 * rng.normal(size=time.size)
        assert len(split_record(DecayRecord(time, noisy)).segments) == 1


def test_noise_that_grows_for_a_while_is_neither_steps_nor_spikes():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        noise = np.where((TIME > 2000) & (TIME < 3000), 0.5, 0.05) * rng.normal(size=TIME.size)
        split = split_record(DecayRecord(TIME, decay(TIME) + noise))
        assert [len(part) >= TIME.size - 10 for part in split.segments] == [True]


def test_the_first_reading_of_a_fill_is_no_spike():
    """The loss rate is another after each refill, and readings have little noise."""
    time = np.arange(0.0, 6000.0, 60.0)
    fills = [500 * np.exp(-time / (3600 * hours)) for hours in (16, 10, 6, 3, 12)]
    noise = 1e-3 * np.random.default_rng(1).normal(size=(5, time.size))
    record = DecayRecord(60.0 * np.arange(5 * time.size), np.ravel(fills + noise))
    split = split_record(record)
    assert kinds(split) == ["refill"] * 4
    assert [len(part) for part in split.segments] == [time.size] * 5


@pytest.mark.parametrize("readings", [300, 1000])
def test_the_digit_of_readings_that_seldom_repeat(readings):
    time = np.linspace(0.0, 36000.0, readings)
    shown = np.round(300 * np.exp(-time / 30000) / 0.4) * 0.4
    record = DecayRecord(time, shown)
    assert record.resolution == pytest.approx(0.4)
    assert DecayRecord(time, 300 * np.exp(-time / 30000)).resolution is None
    [decay] = study_record(record).decays
    assert abs(decay.fit.lifetime_mean.value - 30000 / 3600) < 2 * decay.fit.lifetime_mean.error


def test_a_staircase_quotes_its_lifetime_at_the_mean_of_its_readings():
    """Edges lie evenly in the current, readings in time."""
    time = np.linspace(0.0, 72000.0, 4000)
    record = DecayRecord(time, np.round(300 / (1 + time / 20000)))
    [decay] = study_record(record).decays
    mean = record.current.mean()
    assert decay.fit.mean_current == pytest.approx(mean)
    found = decay.fit.lifetime_mean
    assert abs(found.value - 20000 * 300 / mean / 3600) < 2 * found.error


def test_readings_between_overlapping_steps_are_of_neither_side():
    """A loss in two strokes, one beside the other."""
    time = 10.0 * np.arange(3000)
    share = np.clip((np.arange(3000) - 1500) / 12, 0, 1) + np.clip(
        (np.arange(3000) - 1520) / 100, 0, 1
    )
    beam = 100 * np.exp(-time / 36000) * (1 - 0.2 * share)
    noise = 1e-3 * np.random.default_rng(1).normal(size=3000)
    split = split_record(DecayRecord(time, beam + noise))
    ends = [event.time + event.duration for event in split.events]
    assert all(e.time >= before for e, before in zip(split.events[1:], ends, strict=False))
    assert len(split.segments) == 2
    for part in split.segments:
        slope = np.polyfit(part.time, np.log(part.current), 1)[0]
        assert slope == pytest.approx(-1 / 36000, rel=1e-3)


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("count", [1500, 70001])
def test_a_gap_in_a_long_record_bends_no_mean(count, stated):
    """SIMULATED: of many readings means are fitted; one across the gap is on no curve."""
    a, b, noise = 2e-7, 4e-5, 2e-3
    time = np.linspace(0.0, 12000.0, count)
    time[count // 3 | 1 :] += 20000.0
    beam = 100 * b / ((a * 100 + b) * np.exp(b * time) - a * 100)
    beam += noise * np.random.default_rng(3).normal(size=count)
    error = np.full(count, noise) if stated else None
    [decay] = study_record(DecayRecord(time, beam, error)).answers
    found = decay.fit.lifetime_mean
    assert decay.fit.status.value == "converged"
    assert "wanders" not in decay.fit.message
    truth = 1 / (a * decay.fit.mean_current + b) / 3600
    assert abs(found.value - truth) < 3 * found.error < 0.01 * truth


def test_a_step_beside_readings_of_no_known_level_warns_of_nothing():
    """SIMULATED: four fills of 3000 readings, two gaps in each."""
    rng = np.random.default_rng([9, 12])
    first, lifetime, share = rng.uniform(50, 300), 3600 * 10 ** rng.uniform(0.2, 1), rng.random()
    a, b = (0.2 + 0.6 * share) / lifetime / first, (0.8 - 0.6 * share) / lifetime
    time, beam, begin, count = [], [], 0.0, rng.choice([3000, 20000])
    for _ in range(4):
        since = np.linspace(0, lifetime * 0.8, count)
        for _ in range(2):
            gap = int(count * rng.uniform(0.1, 0.9)) | 1
            since[gap:] += lifetime * 10 ** rng.uniform(-1.5, -0.5)
        i0 = first * rng.uniform(0.8, 1)
        time.append(begin + since)
        beam.append(i0 * b / ((a * i0 + b) * np.exp(b * since) - a * i0))
        begin += since[-1] + since[1]
    beam = np.concatenate(beam)
    beam += first * 10 ** rng.uniform(-4.5, -3.3) * rng.normal(size=beam.size)
    events = split_record(DecayRecord(np.concatenate(time), beam)).events
    assert sum(event.kind == "refill" and event.change > 10 for event in events) == 3


def test_a_few_readings_of_a_decay_behind_a_slow_fill_are_fitted():
    """SIMULATED: 20 readings of injection, in even steps, and 30 of a decay."""
    a, b, since = 2.5e-7, 7.5e-5, 370.0 * np.arange(30)
    beam = 262 * b / ((a * 262 + b) * np.exp(b * since) - a * 262)
    beam += 0.1 * np.random.default_rng(1).normal(size=30)
    record = DecayRecord(370.0 * np.arange(50), np.r_[np.linspace(0.0, 249.0, 20), beam])
    [decay] = (study := study_record(record)).answers
    assert "slow refill" in [event.kind for event in study.events]
    found = decay.fit.lifetime_mean
    assert abs(found.value - 1 / (a * decay.fit.mean_current + b) / 3600) < 3 * found.error < 0.2


@pytest.mark.parametrize("clock", [1e-6, 1e-3, 0.2])
def test_digits_of_readings_by_a_clock_that_is_not_exact_are_no_steps(clock):
    """SIMULATED: the beam loses about a digit from reading to reading."""
    rng = np.random.default_rng(4)
    time = 20.3066 * np.arange(400)
    time += clock * rng.uniform(-0.5, 0.5, 400)
    beam = 400 / (1.2 * np.exp(time / 18000) - 0.2) + 0.02 * rng.normal(size=400)
    [decay] = (study := study_record(DecayRecord(time - time[0], np.round(beam)))).answers
    found = decay.fit.lifetime_mean
    assert (study.events, len(decay.fit.readings)) == ((), 400)
    share = 0.2 * decay.fit.mean_current / 400
    assert abs(found.value - 5 / (1 + share)) < 3 * found.error < 0.2


def test_digits_of_two_detectors_are_no_steps():
    """SIMULATED: one shows the upper half of three fills to 0.1 mA, the other to 1 µA."""
    beam = 300 * np.exp(-(10.0 * np.arange(1200) % 4000) / 36000)
    beam += 0.01 * np.random.default_rng(1).normal(size=beam.size)
    shown = np.where(beam > np.median(beam), np.round(beam, 1), np.round(beam, 3))
    split = split_record(DecayRecord(10.0 * np.arange(1200), shown))
    assert [len(part) for part in split.segments] == [400] * 3
    assert kinds(split) == ["refill"] * 2


def test_top_up_with_a_gap_dropouts_and_spikes_is_cut_at_its_refills():
    """SIMULATED: cycles of 40 readings; the refills of 5 h are within a gap."""
    rng, time = np.random.default_rng(2), 5.0 * np.arange(4000)
    beam = 300 * np.exp(-(time % 200) / 36000) + 0.01 * rng.normal(size=time.size)
    for first in (330, 1290, 3470):
        beam[first : first + 10] = 0.0
    beam[[555, 556, 2222, 3010]] *= 1.01
    time[2025:] += 5 * 3600.0
    study = study_record(DecayRecord(time, beam))
    [pooled] = study.pooled
    assert abs(pooled.fit.first.size - 101) <= 1
    assert abs(pooled.fit.lifetime_mean.value - 10) < 3 * pooled.fit.lifetime_mean.error < 0.1
    assert {"gap", "dropout", "spike"} <= set(kinds(study))


@pytest.mark.parametrize("power", [-1 / 3, 0.3])
def test_fills_whose_a_goes_with_the_current_are_not_cut(power):
    """One a and one b for all fills bend what is left by more than a small noise: no steps."""
    for seed in range(4):
        rng, fills = np.random.default_rng(seed), []
        for hours in rng.uniform(5.6, 10.4, 6):
            t = np.arange(0, hours * 3600, 60.0)
            found = solve_ivp(
                lambda t, i: -(0.6 * (i / 300) ** (1 + power) + 0.4) / 36000 * i,
                (0, t[-1]), [300.0], t_eval=t, rtol=1e-11, atol=1e-9,
            )  # fmt: skip
            fills.append(found.y[0])
        beam = np.concatenate(fills)
        beam += 0.005 * rng.normal(size=beam.size)
        split = split_record(DecayRecord(60.0 * np.arange(beam.size), beam))
        assert [len(s) for s in split.segments] == [len(fill) for fill in fills]


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_a_monitor_that_wanders_beside_refills_is_not_cut(power):
    """SIMULATED: clear refills; noise of 1/f^power goes up and down by itself."""
    time = 2.0 * np.arange(3600)
    beam = 500 * np.exp(-(time % 2500) / 25000)
    for seed in range(8):
        spectrum = np.fft.rfft(np.random.default_rng(seed).normal(size=8192))
        spectrum[1:] *= np.arange(1, spectrum.size) ** (-power / 2)
        slow = np.fft.irfft(spectrum)[: time.size]
        split = split_record(DecayRecord(time, beam + 0.01 * slow / np.std(slow)))
        assert [len(part) for part in split.segments] == [1250, 1250, 1100]


def test_pieces_keep_the_digit_of_the_record():
    """SIMULATED: each piece loses exactly one digit at each reading, and lies on a line."""
    time = np.arange(90) * 60.0
    exact = 500.03 - time / 600 - np.repeat([0.0, 7.04, 10.35], 30)
    study = study_record(DecayRecord(time, np.round(exact, 1)))
    assert [len(decay.segment) for decay in study.decays] == [30, 30, 30]
    for decay in study.decays:  # a loss of 29 digits is one of 28 to 30
        lifetime = decay.fit.lifetime_mean
        assert 0.3 / 29 < lifetime.error / lifetime.value < 1 / 29


def test_regular_stairs_are_no_exact_line():
    """SIMULATED: each step lasts six readings, and their first ones lie on a line."""
    time = np.arange(400) * 10.0
    study = study_record(DecayRecord(time, np.round(500.03 - time / 600, 1)))
    lifetime = study.decays[0].fit.lifetime_mean
    true = study.decays[0].fit.mean_current / 6
    assert abs(lifetime.value - true) < 3 * lifetime.error
    assert 1e-4 < lifetime.error / true < 0.02


def test_refills_are_found_where_a_beam_loses_one_digit_at_each_reading():
    time = np.arange(200) * 60.0
    exact = np.concatenate([(100.03 + 0.01 * k) * np.exp(-time[:40] / 6e4) for k in range(5)])
    split = split_record(DecayRecord(time, np.round(exact, 1)))
    assert [len(piece) for piece in split.segments] == 5 * [40]


@pytest.mark.parametrize("digits", [2, 9])
def test_a_stuck_monitor_is_left_out(digits):
    time = np.arange(300) * 60.0
    current = decay(time, 200.0, noise=0.05)
    current[100:110] = current[100]
    split = split_record(DecayRecord(time, np.round(current, digits)))
    assert kinds(split) == ["stuck"]
    assert [len(piece) for piece in split.segments] == [291]


def test_readings_that_repeat_by_their_digits_are_not_stuck():
    time = np.arange(3000) * 10.0
    current = np.round(decay(time, 100.0, lifetime=1e6, noise=0.02), 1)
    assert kinds(split_record(DecayRecord(time, current))) == []


@pytest.mark.filterwarnings("error")
def test_levels_that_are_equal_but_for_rounding_are_split_in_silence():
    time = np.arange(400) * 10.0
    current = 100 * np.exp(-(time % 90) / 1e15)
    current[200:] *= 51
    split_record(DecayRecord(time, current))


def test_cycles_of_a_coarse_monitor_have_one_answer():
    """SIMULATED: one of the five was answered alone, 227 errors off."""
    time, cycle = np.arange(500) * 10.0, np.arange(500) // 100
    level = 300.2 + np.random.default_rng(2).uniform(-0.5, 0.5, 5)
    study = study_record(DecayRecord(time, np.round(level[cycle] * np.exp(-(time % 1000) / 3e4))))
    [answer] = study.answers
    lifetime = answer.fit.lifetime_mean
    assert abs(lifetime.value - 3e4 / 3600) < 3 * lifetime.error < 0.01 * lifetime.value


def test_a_digit_out_of_place_is_no_refill():
    """Of a beam that loses .95 digits at each reading every twentieth stands: it was cut there, as
    if a refill of a digit had come, into lines that lose one digit exactly."""
    time = 60.0 * np.arange(90)
    true = 200.0 - 0.95e-2 * np.arange(90)
    found = study_record(DecayRecord(time, np.round(true, 2)))
    assert [len(decay.segment) for decay in found.decays] == [90]
    low, high = found.decays[0].fit.lifetime_mean.interval_95
    assert low < np.mean(true) / (0.95e-2 / 60.0) / 3600.0 < high


def test_cycles_that_are_rounded_alike_tell_no_more_than_one():
    """Every cycle loses a digit in two readings, from the same current: the error of rounding is
    that of all, and was divided by their number."""
    since = np.tile(10.0 * np.arange(26), 10)
    true = 217.2 * np.exp(-since / 4320.0)
    record = DecayRecord(10.0 * np.arange(since.size), np.round(true))
    fit = study_record(record).answers[0].fit
    assert fit.first.size > 8
    assert abs(fit.lifetime_mean.value - 1.2) < 3 * fit.lifetime_mean.error
    assert fit.lifetime_mean.relative > 0.01
