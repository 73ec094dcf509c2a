"""The tuning fit on SIMULATED machines of known minimum, and its next row."""

from dataclasses import replace

import numpy as np
import pytest
from jax import numpy as jnp
from scipy.stats import binom

from beamfit.emittance.scan import QuadScan
from beamfit.errors import InputError, Status
from beamfit.noise.model import Noise
from beamfit.particles import beta_gamma
from beamfit.tuning.fit import fit_tuning
from beamfit.tuning.knob_map import _covariance, _linearise, log_emittance, orders_of
from beamfit.tuning.knobs import EmittanceTable, knobs_of
from beamfit.tuning.minimum import _information, next_row
from beamfit.tuning.readings import emittance_readings
from tests.tuning.machines import (
    EMITTANCE,
    LINE,
    SCATTER,
    SHOT,
    Machine,
    limits_of,
    machine_of,
    scan_of,
    size_of,
)

BOOST = float(beta_gamma(135.0))
MACHINE = Machine(np.array([0.3, -0.4]), np.array([0.7, 0.9]), np.array([[0.4, 0.1], [-0.3, 0.5]]))


def fitted(machine, seed=0, count=32, **noise):
    scan = scan_of(machine, np.random.default_rng(seed), count, **noise)
    return fit_tuning(scan, LINE, limits_of(machine), seed=seed)


@pytest.fixture(scope="module")
def fit():
    return fitted(MACHINE)


def test_an_exact_table_gives_the_known_beam():
    found = fitted(MACHINE, scatter=0.0, shot=1e-4)
    for i, q in enumerate(found.place.values()):
        assert q.value == pytest.approx(MACHINE.place[i], abs=0.05)
    assert found.minimum.value == pytest.approx(BOOST * EMITTANCE, rel=0.02)
    emittance, beta, alpha = MACHINE.numbers(np.array([[0.5, 0.5]]))
    there = found.beam({"K0": 0.5, "K1": 0.5})["x"]
    assert there["normalized_emittance"].value == pytest.approx(BOOST * emittance, rel=0.03)
    assert there["beta"].value == pytest.approx(beta, rel=0.03)
    assert there["alpha"].value == pytest.approx(alpha, abs=0.05)


def test_a_minimum_inside_is_found_with_its_interval(fit):
    assert fit.status is Status.converged
    for i, q in enumerate(fit.place.values()):
        assert abs(q.value - MACHINE.place[i]) < 3.0 * q.error
        assert 0.01 < q.error < 0.4
        assert q.interval_95[0] < q.value < q.interval_95[1]
    assert abs(fit.minimum.value - BOOST * EMITTANCE) < 3.0 * fit.minimum.error


def test_a_table_in_other_units_of_the_knobs_says_the_same(fit):
    scan = fit.scan
    settings = scan.settings | {"K0": 200.0 + 10.0 * scan.settings["K0"]}
    other = fit_tuning(
        replace(scan, settings=settings), LINE, {"K0": (190, 210), "K1": (-1, 1)}, seed=0
    )
    assert (other.place["K0"].value - 200.0) / 10.0 == pytest.approx(fit.place["K0"].value)
    assert other.minimum.value == pytest.approx(fit.minimum.value)


def test_the_order_of_rows_says_nothing(fit):
    order = np.random.default_rng(0).permutation(len(fit.scan))
    other = fit_tuning(
        replace(fit.scan, **fit.scan.columns_at(order)), LINE, limits_of(MACHINE)
    )  # draws differ, since readings have other random numbers
    assert other.place["K0"].value == pytest.approx(fit.place["K0"].value, abs=0.1)
    assert other.minimum.value == pytest.approx(fit.minimum.value, rel=0.1)


def test_of_two_planes_the_geometric_mean_is_made_small(fit):
    scan = replace(fit.scan, size={"x": fit.scan.size["x"], "y": fit.scan.size["x"]})
    scan = replace(scan, error={p: SHOT * scan.size[p] for p in "xy"})
    both = fit_tuning(scan, LINE, limits_of(MACHINE))
    assert list(both.maps) == ["x", "y"]
    at = both.beam({"K0": [0.0], "K1": [0.0]})
    x, y = (at[p]["normalized_emittance"].value for p in "xy")
    assert at["goal"]["normalized_emittance"].value == pytest.approx(np.sqrt(x * y), rel=0.03)
    one = fit_tuning(scan, LINE, limits_of(MACHINE), goal="emittance_x", seed=0)
    assert list(one.maps) == ["x"]
    assert one.minimum.value == pytest.approx(fit.minimum.value)


def test_a_minimum_beyond_a_limit_is_not_inside():
    found = fitted(MACHINE._replace(place=np.array([2.0, 0.0])))
    assert found.status is Status.at_limit
    assert found.edge["K0"] > 0.9 > 0.5 > found.edge["K1"]
    assert "No minimum inside" in found.message


def test_a_flat_machine_has_no_minimum_and_a_known_emittance():
    found = fitted(machine_of(np.random.default_rng(1), 2, flat=True))
    assert found.status is Status.unidentified
    assert found.flat > 0.05
    assert not found.done
    assert not any(q.determined for q in found.place.values())
    assert abs(found.emittance.value - BOOST * EMITTANCE) < 3.0 * found.emittance.error
    assert found.emittance.error < 0.1 * BOOST * EMITTANCE


def table_of(machine, seed, count=32, share=0.05):
    """Finished emittances of a machine at settings that fill the box, errors stated."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (count, len(machine.place)))
    value = machine.numbers(x)[0] * np.exp(share * rng.normal(size=count))
    settings = {f"K{i}": column for i, column in enumerate(x.T)}
    return EmittanceTable(settings, {"x": value}, {"x": share * value}, normalized=False)


def test_a_table_of_emittances_says_the_minimum_without_optics():
    table = table_of(MACHINE, 1)
    found = fit_tuning(table, None, limits_of(MACHINE))
    assert found.status is Status.converged
    for i, q in enumerate(found.place.values()):
        assert abs(q.value - MACHINE.place[i]) < 3.0 * q.error
    assert abs(found.minimum.value - EMITTANCE) < 3.0 * found.minimum.error
    assert found.minimum.error < 0.1 * EMITTANCE
    assert set(found.beam(found.settings)["x"]) == {"emittance"} <= set(found.to_json())
    assert set(found.next.settings) == {"K0", "K1"}
    assert found.headline.startswith("converged: emittance ")
    with pytest.raises(InputError, match="a line beside finished emittances"):
        fit_tuning(table, LINE, limits_of(MACHINE))


def test_emittances_are_those_of_gaussian_regression():
    """Rasmussen and Williams, eq. 2.25: the fitted values, with the scales of the best map."""
    table = table_of(MACHINE, 2, count=16)
    readings = emittance_readings(table, "x", knobs_of(table, limits_of(MACHINE)), Noise())
    data, scales = readings.readings, np.log([1.2, 1.2, 0.5, 0.6, 0.6, 1.0])
    by = _linearise(data, np.zeros((len(data.y), 4)), jnp.ones(len(data.y)), jnp.ones(()))
    there = data.present > 0
    bend = (log_emittance(0.0, 1e-5) - log_emittance(0.0, -1e-5)) / 2e-5
    assert np.allclose(by.slope[there], [0.5, bend / 2, 0.0, 0.0])
    far = ((data.x[there][:, None] - data.x[there][None]) / 1.2) ** 2
    expected = 0.25 * (9.0 + 0.25 * float(bend) ** 2 * np.exp(-0.5 * far.sum(-1)))
    expected += np.diag(data.floor[there] ** 2 + data.unit[there] ** 2)
    found = np.asarray(_covariance(jnp.asarray(scales), by, orders_of(2)))[there][:, there]
    assert np.allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize("seed", [3, 4, 5])
@pytest.mark.parametrize(("stated", "scatter"), [(SHOT, SCATTER), (0.01, 0.0)])
def test_wrong_sizes_are_named_and_move_nothing(seed, stated, scatter):
    """Two of 24 sizes a factor of three off, up or down; errors of shots, and right stated ones."""
    rng = np.random.default_rng(seed)
    machine = machine_of(rng, 2)
    scan = scan_of(machine, rng, 32, scatter=scatter)
    few = np.sort(rng.choice(32, 24, replace=False))
    scan = replace(scan, **scan.columns_at(few))
    wrong = np.sort(rng.choice(24, 2, replace=False))
    size = scan.size["x"].copy()
    size[wrong] *= 3.0 ** rng.choice([-1.0, 1.0], 2)
    shots = scan.shots if scatter else None
    scan = replace(scan, size={"x": size}, error={"x": stated * size}, shots=shots)
    found = fit_tuning(scan, LINE, limits_of(machine))
    low, high = found.minimum.interval_95
    assert low < BOOST * EMITTANCE < high
    assert abs(found.minimum.value / (BOOST * EMITTANCE) - 1.0) < 0.35
    bad = np.flatnonzero(np.asarray(found.maps["x"].posterior.bad)[:24] > 0.5)
    assert set(wrong) <= set(bad)
    assert len(bad) <= 3


@pytest.mark.parametrize("spread", [0.1, 0.5])
@pytest.mark.parametrize("count", [16, 32])
def test_sizes_at_random_are_of_no_beam_and_open_everything(count, spread):
    """Of 16 sizes that scatter by a half a beam has 4 %, summed by importance over maps and scales;
    a search that stops short of the likeliest noise says 0.2 %. The three others have less."""
    rng = np.random.default_rng(count)
    size = 5e-5 * np.exp(spread * rng.normal(size=count))
    scan = scan_of(MACHINE, rng, count)
    found = fit_tuning(
        replace(scan, size={"x": size}, error={"x": 0.01 * size}), LINE, limits_of(MACHINE)
    )
    assert found.of_a_beam < 0.1
    assert found.status is Status.unidentified
    assert "of no beam" in found.message
    assert not any(q.determined for q in (*found.place.values(), found.minimum, found.emittance))
    assert not found.done


def test_an_answer_in_every_form(fit):
    assert "K0" in str(fit)
    assert fit["settings.K0"].value == fit.settings["K0"]
    entry = fit.to_json()
    assert entry["status"] == "converged"
    assert entry["settings"]["K1"]["interval_95"][0] < MACHINE.place[1]


def scan_with(**change):
    return replace(scan_of(MACHINE, np.random.default_rng(0), 8), **change)


@pytest.mark.parametrize(
    ("knobs", "goal", "said"),
    [
        ({}, "emittance", "no knob"),
        ({"K7": (0, 1)}, "emittance", "no knob 'K7'"),
        ({"K0": (1, 0)}, "emittance", "limits 1:0 of K0"),
        ({"K0": (5, 9)}, "emittance", "which was set from"),
        ({"K0": (-1, 1), "K1": (-1, 1)}, "emittance_y", "nothing measured in plane y"),
        ({"K0": (-1, 1), "K1": (-1, 1)}, "size", "goal 'size'"),
        ({"K0": (-1, 1)}, "emittance", "no magnet 'K1' in the lattice"),
    ],
)
def test_what_does_not_fit_is_refused(knobs, goal, said):
    with pytest.raises(InputError, match=said):
        fit_tuning(scan_with(), LINE, knobs, goal=goal)


def test_rows_at_one_quadrupole_setting_are_refused():
    with pytest.raises(InputError, match="1 distinct setting "):
        fit_tuning(scan_with(settings=scan_with().settings | {"Q": np.ones(8)}), LINE, {
            "K0": (-1, 1), "K1": (-1, 1)})  # fmt: skip


def test_information_is_that_of_normal_numbers():
    """T. M. Cover and J. A. Thomas, Elements of Information Theory (2006), example 8.5.1."""
    rng, rho, error = np.random.default_rng(0), 0.8, 0.5
    goal = rng.normal(size=(20000, 1))
    seen = rho * goal + np.sqrt(1 - rho**2) * rng.normal(size=goal.shape)
    joint = np.array([[1.0, rho], [rho, 1.0 + error**2]])
    expected = -0.5 * np.log(np.linalg.det(joint) / (1.0 + error**2))
    assert _information(seen, goal, error)[0] == pytest.approx(expected, rel=0.05)


def test_the_next_row_is_within_limits_and_tells_more_than_others(fit):
    row = next_row(fit, {"Q": (-0.5, 1.5)})
    assert set(row.settings) == {"K0", "K1", "Q"}
    assert all(abs(row.settings[k]) <= 1.0 for k in ("K0", "K1"))
    assert -0.5 <= row.settings["Q"] <= 1.5
    assert row.information > 0.01


def with_row(scan, machine, row, rng):
    x, strength = np.array([[row[k] for k in limits_of(machine)]]), np.array([row["Q"]])
    noise = np.hypot(SCATTER, SHOT) * rng.normal(size=1)
    size = np.append(scan.size["x"], size_of(machine, x, strength) * np.exp(noise))
    settings = {k: np.append(v, row[k]) for k, v in scan.settings.items()}
    return QuadScan(settings, scan.units, {"x": size}, {"x": SHOT * size}, shots=10)


def loop(machine, seed, most=40, begin=8):
    """Rows until the fit says to stop, and how far above the minimum its setting then is."""
    rng = np.random.default_rng(seed)
    scan = scan_of(machine, rng, begin)
    while True:
        fit = fit_tuning(scan, LINE, limits_of(machine), seed=len(scan))
        if fit.done or len(scan) == most:
            break
        scan = with_row(scan, machine, next_row(fit, {"Q": (-0.5, 1.5)}).settings, rng)
    best = np.array([list(fit.settings.values())])
    return len(scan), float(machine.numbers(best)[0][0] / EMITTANCE - 1.0), fit


def test_rows_that_are_chosen_come_to_the_minimum():
    count, excess, fit = loop(MACHINE, 1, begin=16)
    assert count < 40
    assert excess < 0.05
    assert fit.done


@pytest.mark.calibrate
@pytest.mark.parametrize("knobs", [1, 2, 3])
def test_intervals_hold_the_truth_as_often_as_they_say(knobs):
    """Machines drawn anew; of several knobs each counts as a share of a machine."""
    seeds, held = 120, {0.68: np.zeros(2), 0.95: np.zeros(2)}
    for seed in range(seeds):
        machine = machine_of(np.random.default_rng(1000 + seed), knobs)
        found = fitted(machine, seed)
        places = found.knobs.settings(found.minima.place)
        values = found.unit * np.exp(found.minima.value)
        for share, count in held.items():
            ends = (0.5 - share / 2, 0.5 + share / 2)
            low, high = np.quantile(places, ends, axis=0)
            count[0] += ((low <= machine.place) & (machine.place <= high)).mean()
            low, high = np.quantile(values, ends)
            count[1] += low <= BOOST * EMITTANCE <= high
    for share, count in held.items():
        assert np.all(count >= binom.ppf(0.005, seeds, share)), (share, count / seeds)


@pytest.mark.calibrate
def test_a_flat_machine_keeps_its_emittance_and_is_claimed_no_minimum():
    """At most two claims of a hundred; the emittance in 68 and 95 % within binomial limits."""
    seeds, held, claims = 150, np.zeros(2), 0
    for seed in range(seeds):
        found = fitted(machine_of(np.random.default_rng(2000 + seed), 2, flat=True), seed)
        claims += found.status is not Status.unidentified
        q, far = found.emittance, abs(found.emittance.value - BOOST * EMITTANCE)
        held += far <= q.error, q.interval_95[0] <= BOOST * EMITTANCE <= q.interval_95[1]
    assert claims <= 0.02 * seeds
    assert np.all(held >= binom.ppf(0.005, seeds, [0.68, 0.95])), held / seeds


@pytest.mark.calibrate
def test_a_search_that_stops_is_within_its_goal():
    found = [loop(machine_of(np.random.default_rng(s), 2), s, 60) for s in range(30)]
    stopped = [excess for _, excess, fit in found if fit.done]
    assert len(stopped) >= 20
    within = sum(excess <= 0.05 for excess in stopped)
    assert within >= binom.ppf(0.005, len(stopped), 0.95)
