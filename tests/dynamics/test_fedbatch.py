"""Fed-batch processes from SIMULATED batches: rates, titre, another feed and the best one."""

import re
import runpy
import sys
from unittest.mock import create_autospec

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import beamfit
from beamfit.dynamics import fedbatch
from beamfit.dynamics import feed as feeding
from beamfit.dynamics.balances import STATES, batch_bounds, predicted, rates_at, stretches_of
from beamfit.dynamics.fedbatch import (
    RULES,
    BatchEvidence,
    identify_batches,
    network_of,
    rank_inputs,
)
from beamfit.dynamics.feed import best_feed, predict
from beamfit.dynamics.record import Run
from beamfit.errors import InputError, Status, judge

FED = {"feed_substrate": 200.0}


@pytest.fixture(scope="module")
def made(root):
    return runpy.run_path(str(root / "measurements/make_fedbatch.py"))


@pytest.fixture(scope="module")
def runs(made):
    """Three short batches of different length; of air above 1.2 there are two rows only."""
    random, found = np.random.default_rng(3), []
    for name, rows, begin, of in (
        ("one", 46, (2.0, 8.0, 4.0, 0.2), lambda t: 0.02 * np.exp(0.09 * t)),
        ("two", 40, (1.5, 14.0, 5.0, 0.0), lambda t: 0.05 * (t > 6)),
        ("three", 43, (3.0, 3.0, 4.0, 0.1), lambda t: 0.05 + 0.05 * (t > 8)),
    ):
        wild = np.repeat(random.uniform(0.5, 1.5, 12), 4)[:rows]
        feed = of(0.5 * np.arange(rows)) * wild
        air = np.repeat(random.uniform(0.3, 1.2, 8), 6)[:rows]
        air[20:22] = 1.9 if name == "one" else air[20]
        states = made["plant"](begin, feed, air)
        outputs = made["measured"](random, air, states)
        for output in STATES:  # read at every row: the record is short
            noise = 0.003 if output == "volume" else 0.02
            true = states[:, STATES.index(output)]
            outputs[output] = true * (1 + noise * random.normal(size=rows))
        outputs["titre"] = states[:, 3] * (1 + 0.02 * random.normal(size=rows))
        inputs = {"feed": feed, "air": air, "feed_substrate": np.full(rows, 200.0)}
        found.append(Run(1800.0 * np.arange(rows), inputs, outputs, name=name))
    return found


@pytest.fixture(scope="module")
def fit(runs):
    return identify_batches(runs, hidden=3, held=[runs[0]])


def test_true_rates_are_found_within_their_bands_where_the_batches_were(fit, made):
    assert fit.status is Status.converged, fit.message
    assert 0.012 < fit.noise["biomass"].share < 0.025
    air = np.concatenate([run.inputs["air"] for run in fit.runs]).mean()
    substrate = np.concatenate([x[:, 1] for x in fit.courses]).mean()
    for curve in fit.curves:
        at = (curve.at, air) if curve.input == "substrate" else (substrate, curve.at)
        true = made["rates"](*at)[("mu_b", "mu_s").index(curve.parameter)]
        seen = curve.visited & (curve.at > 0.5 if curve.input == "substrate" else True)
        off = (curve.value - true)[seen]
        assert np.all(np.abs(off) < 0.1 * np.max(true)), curve
        assert np.sqrt(np.mean((off / curve.error[seen]) ** 2)) < 2.0, curve
    air = fit.curves[2]
    assert air.input == "air"
    far = air.at > 1.35
    assert not air.visited[far].any()
    assert air.quantity(int(np.flatnonzero(far)[0])).error is None


def test_rates_are_bounded_and_nothing_without_substrate(runs):
    b = batch_bounds(runs, [stretches_of(run) for run in runs], None)
    net = network_of(("substrate", "air"), np.array([[0.0, 0.5], [2.0, 1.0]]), "ab", 5, 0)
    model = {"rates": jax.tree_util.tree_map(lambda v: 30.0 * v, net), "half": 0.1}
    draw = np.random.default_rng(0).uniform(0, 2, (200, 3 + len(b.inputs)))
    x, u = draw[:, :3], draw[:, 3:]
    rates_of = jax.jit(jax.vmap(lambda x, u: rates_at(b, model, x, u)))
    rates = rates_of(x, u)
    assert jnp.all(rates >= b.ends[0])
    assert jnp.all(rates <= b.ends[1])
    assert jnp.any(rates > 0.9 * b.ends[1])
    starved = rates_of(np.tile([9.0, 0.0, 4.0], (200, 1)), u)[0]
    assert starved[0] <= 0.0
    assert starved[1] == 0.0


def test_another_feed_is_predicted_with_its_length_and_the_best_keeps_its_limits(fit, made):
    start, time = (3.0, 6.0, 4.0, 0.1), 0.5 * np.arange(40)
    feed, air = np.linspace(0.03, 0.12, 40), np.full(40, 1.0)
    course = predict(fit, time, FED | {"feed": feed, "air": 1.0}, start)
    true = made["plant"](start, feed, air)
    for k, name in enumerate(("biomass", "substrate", "volume", "titre")):
        band = 4 * course.error[name] + 0.003 * true[:, k]
        assert np.all(np.abs(course.value[name] - true[:, k]) < band), name
    length = course.length(1.2)
    assert abs(length.value - np.interp(1.2, true[:, 3], time)) < 3 * length.error
    assert 0 < length.error < 1.0
    assert course.length(99.0).error is None

    plan = best_feed(
        fit, start, FED | {"air": 1.0}, product=7.0, feed=(0.0, 0.3), volume=6.0,
        substrate=8.0, hours=(5.0, 20.0), pieces=3,
    )  # fmt: skip
    assert plan.status in (Status.optimal, Status.local_optimum), plan.message
    end = plan.course.time
    true = made["plant"](start, plan.course.feed, np.ones(len(end)), apart=end[1])
    assert true[-1, 2] * true[-1, 3] > 7.0
    assert true[:, 1].max() < 8.0
    assert true[-1, 2] < 6.0 + 1e-6
    steady = predict(fit, end, FED | {"feed": plan.course.feed.mean(), "air": 1.0}, start)
    assert steady.value["titre"][-1] < plan.course.value["titre"][-1]


def test_the_page_s_block_runs(root, fit, monkeypatch):
    """Its two searches, which take a minute, are answered by those of this file."""
    for module, name, answer in (
        (fedbatch, "identify_batches", fit),
        (feeding, "best_feed", None),
    ):
        known = create_autospec(getattr(module, name), return_value=answer)
        monkeypatch.setattr(module, name, known)
    monkeypatch.chdir(root)
    page = (root / "docs/fedbatch.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {}
    exec(block, names)
    assert [len(run) for run in names["runs"]] == [81, 69, 89, 77]
    assert names["course"].value["titre"].shape == (81,)


def test_what_a_titre_hangs_on_is_ranked(fit, monkeypatch):
    ranked = {each.name: each for each in rank_inputs(fit)}
    told = ranked["predicted biomass"].information
    assert told > 1.2 * max(ranked[name].information for name in ("air", "feed", "predicted mu_b"))
    one = ranked["total feed"]
    assert one.correlation == pytest.approx(np.sqrt(1 - np.exp(-2 * one.information)))
    monkeypatch.setitem(sys.modules, "sklearn.feature_selection", None)
    with pytest.raises(InputError, match=r"beamfit\[mutual\]"):
        rank_inputs(fit)


def test_residuals_that_follow_one_another_are_no_noise(fit):
    fitted = np.asarray(jax.jit(predicted)(fit.fit.model, fit.seen.batches))
    slow = 1.0 + 0.02 * np.sin(np.arange(fitted.shape[1]) / 4)[None, :, None]
    for factor, status in ((1.0, Status.converged), (slow, Status.poor_fit)):
        evidence = BatchEvidence(fit.fit, True, fit.seen, factor * fitted, fit.noise, fit.curves)
        assert judge(evidence, RULES).status is status


def test_what_is_left_of_an_output_read_seldom_is_poor_fit_and_said_before_what_is_open(fit):
    """A third of the biomass is not explained at every sixth row, and the curves are open."""
    fitted = np.array(jax.jit(predicted)(fit.fit.model, fit.seen.batches))
    read = fit.seen.read.copy()
    read[:, np.arange(read.shape[1]) % 6 > 0, 0] = False
    measured = fit.seen.measured.copy()
    measured[..., 0] += 0.35 * fitted[..., 0].max() * np.linspace(0, 1, read.shape[1])
    seen = fit.seen._replace(read=read, measured=measured)
    noise = fit.noise | {"biomass": fedbatch.ReadingNoise(0.2 * fitted[..., 0].max(), False)}
    curves = [c._replace(error=10.0 + c.value) for c in fit.curves]
    found = judge(BatchEvidence(fit.fit, True, seen, fitted, noise, curves), RULES)
    assert found.status is Status.poor_fit
    assert re.search(r"biomass: [\d.]+ of [\d.]+ is not explained", found.cause)


def test_a_batch_that_was_held_back_is_predicted_within_its_bands(fit):
    held = fit.held["one"]
    assert held.rest < 1.5
    assert set(held.inside) == {"biomass", "substrate", "volume", "titre"}
    assert min(held.inside.values()) > 0.85


def test_batches_that_cannot_be_used_are_refused(runs):
    run = runs[0]

    def without(kind, name):
        left = {k: v for k, v in getattr(run, kind).items() if k != name}
        parts = {"inputs": run.inputs, "outputs": run.outputs} | {kind: left}
        return Run(run.time, parts["inputs"], parts["outputs"])

    for bad, said in (
        (without("outputs", "substrate"), "y_substrate"),
        (without("inputs", "feed"), "u_feed"),
        (without("inputs", "air"), "inputs feed, feed_substrate"),
    ):
        with pytest.raises(InputError, match=said):
            identify_batches([run, bad])
    with pytest.raises(InputError, match="ait"):
        identify_batches(run, points=["ait"])
    dead = Run(run.time, run.inputs, run.outputs | {"biomass": np.linspace(2, 1, len(run))})
    with pytest.raises(InputError, match="never grows"):
        identify_batches(dead)


def test_the_report_has_batches_rates_and_titre(fit, tmp_path):
    beamfit.write_report(tmp_path / "batches.html", fit)
    page = (tmp_path / "batches.html").read_text()
    for words in ("predicted in three", "mu_s by air", "decay of titre", "batches differ in mu_b"):
        assert words in page, words
