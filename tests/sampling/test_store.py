"""Stores: emcee's layout, resumption after SIGKILL, files that are not ours."""

from __future__ import annotations

import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import time
import types

import emcee
import h5py
import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.sampling import ensemble
from beamfit.sampling.ensemble import draw
from beamfit.sampling.priors import Normal
from beamfit.sampling.store import SEAL_BYTES, Provenance, add_seal, load, save
from beamfit.writing import alone
from tests.sampling.targets import banana, half_normal, target

OPTIONS = {"seed": 5, "target_ess": 1e9, "budget": 700, "walkers": 16}


@pytest.fixture(scope="module")
def whole():
    """The uninterrupted chain."""
    return draw(target(half_normal), **OPTIONS)


def stored_chain(path):
    return emcee.backends.HDFBackend(str(path), read_only=True)


def test_emcee_reads_the_store(tmp_path, whole):
    path = tmp_path / "chain.h5"
    posterior = draw(target(half_normal), store=path, **OPTIONS)
    backend = stored_chain(path)
    assert backend.iteration == 700
    assert backend.shape == (16, 2)
    kept = backend.get_chain(discard=posterior.warmup)
    np.testing.assert_array_equal(kept, posterior.chain)
    np.testing.assert_array_equal(
        backend.get_log_prob(discard=posterior.warmup), posterior.log_prob
    )
    assert backend.random_state[0] == "MT19937"
    np.testing.assert_array_equal(posterior.chain, whole.chain)


def test_groups_say_where_it_comes_from(tmp_path):
    path = tmp_path / "chain.h5"
    observed = {"size m": np.array([1.0, 2.0]), "screen": np.array(["A", "B"])}
    stated = target(half_normal, observed=observed)
    found = draw(
        stated,
        seed=3,
        store=path,
        target_ess=500,
        provenance=Provenance("beamfit x", {"scan.csv": "ab12"}),
    )
    with h5py.File(path, "r") as file:
        assert set(file) == {"mcmc", "observed", "fit", "posterior", "provenance"}
        np.testing.assert_array_equal(file["observed/size m"][:], [1.0, 2.0])
        assert [v.decode() for v in file["observed/screen"][:]] == ["A", "B"]
        np.testing.assert_array_equal(file["fit/mode"][:], stated.mode)
        source = dict(file["provenance"].attrs)
        assert source["seed"] == "3"
        assert source["command"] == "beamfit x"
        assert json.loads(source["inputs"]) == {"scan.csv": "ab12"}
        assert {"emcee", "jax", "numpy", "python", "beamfit"} <= set(json.loads(source["versions"]))
        assert file["posterior"].attrs["finished"] == "true"
        assert json.loads(file["posterior"].attrs["summary"]) == json.loads(
            json.dumps(found.to_json())
        )


def test_a_larger_target_goes_on_from_the_store(tmp_path):
    path = tmp_path / "chain.h5"
    first = draw(target(half_normal), seed=1, store=path, target_ess=1000)
    again = draw(target(half_normal), seed=1, store=path, target_ess=1000)
    np.testing.assert_array_equal(first.chain, again.chain)
    longer = draw(target(half_normal), seed=1, store=path, target_ess=20_000)
    straight = draw(target(half_normal), seed=1, target_ess=20_000)
    assert len(longer.chain) > len(first.chain)
    np.testing.assert_array_equal(longer.chain, straight.chain)


VICTIM = """
import sys
from tests.sampling.test_store import OPTIONS
from tests.sampling.targets import half_normal, target
from beamfit.sampling import ensemble
from beamfit.sampling.ensemble import draw
ensemble.MAX_WRITING_SHARE = 1e9  # a checkpoint after every block: as many moments to be killed at
advance = ensemble._sample_block

def asked(*arguments):
    print("block", flush=True)
    sys.stdin.readline()
    return advance(*arguments)

ensemble._sample_block = asked
draw(target(half_normal), store=sys.argv[1], **OPTIONS)
print("finished", flush=True)
"""


def interrupted(path, blocks, delay):
    """Let the victim go on by some blocks, and kill it within the next: True unless it finished."""
    process = subprocess.Popen(
        [sys.executable, "-c", VICTIM, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    with process:
        for _ in range(blocks + 1):
            if process.stdout.readline() == b"finished\n":
                return False
            process.stdin.write(b"\n")
            process.stdin.flush()
        time.sleep(delay)
        os.kill(process.pid, signal.SIGKILL)
    return True


def test_killed_at_any_moment_the_finished_chain_is_the_uninterrupted_one(tmp_path, whole):
    """SIGKILL before the first checkpoint, and at any moment within later blocks."""
    path = tmp_path / "chain.h5"
    random = np.random.default_rng(1)
    kills, seen = 0, set()
    while interrupted(path, kills, random.uniform(0.0, 0.1)):
        kills += 1
        if path.exists():
            backend = stored_chain(path)
            seen.add(backend.iteration)
            found = backend.get_chain()  # the file is whole
            assert np.isfinite(found).all()
    assert kills >= 3
    assert len(seen - {700}) >= 2  # it was interrupted at different places
    assert stored_chain(path).iteration == 700
    finished = draw(target(half_normal), store=path, **OPTIONS)
    np.testing.assert_array_equal(finished.chain, whole.chain)
    np.testing.assert_array_equal(finished.log_prob, whole.log_prob)
    assert finished.acceptance == whole.acceptance


def test_killed_while_writing_leaves_the_old_file(tmp_path):
    """The write itself is cut at every point: what is under the name stays whole."""
    path = tmp_path / "chain.h5"
    draw(target(half_normal), seed=1, store=path, target_ess=500)
    before = path.read_bytes()
    beside = tmp_path / ".chain.h5.partial"
    for cut in (0, 100, len(before) // 2):
        beside.write_bytes(before[:cut])  # what a process killed in the middle leaves
        again = draw(target(half_normal), seed=1, store=path, target_ess=500)
        assert path.read_bytes() == before
        assert len(again.chain) > 0


def refused(path, **changed):
    before = path.read_bytes()
    options = {"seed": 1, "target_ess": 500, "store": path} | changed
    stated = options.pop("stated", None) or target(half_normal)
    with pytest.raises(InputError) as error:
        draw(stated, **options)
    assert path.read_bytes() == before
    said = str(error.value)
    assert str(path) in said
    assert "name another file" in said
    return said


@pytest.fixture
def store(tmp_path):
    path = tmp_path / "chain.h5"
    draw(target(half_normal), seed=1, store=path, target_ess=500)
    return path


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.95])
def test_a_truncated_file_is_refused_and_left(store, share):
    whole = store.read_bytes()
    store.write_bytes(whole[: int(share * len(whole))])
    assert "is damaged" in refused(store)


def test_a_foreign_file_is_refused_and_left(tmp_path):
    path = tmp_path / "other.h5"
    path.write_text("Q2_A,size_x_um\n")
    assert "is no store" in refused(path)
    with h5py.File(path, "w") as file:
        file["size_x_um"] = np.arange(3.0)
    assert "beamfit did not write" in refused(path)


def test_a_chain_of_emcee_alone_is_foreign(tmp_path):
    path = tmp_path / "emcee.h5"
    backend = emcee.backends.HDFBackend(str(path))
    sampler = emcee.EnsembleSampler(8, 2, lambda x: -0.5 * x @ x, backend=backend)
    sampler.run_mcmc(np.random.default_rng(1).normal(size=(8, 2)), 5)
    assert "beamfit did not write" in refused(path)


def test_another_problem_is_refused_and_left(store):
    assert "seed 1" in refused(store, seed=2)
    assert "of 64 walkers" in refused(store, walkers=32)
    assert "other numbers, x, y" in refused(store, stated=target(half_normal, n=3))
    other = target(half_normal, observed={"size": np.ones(3)})
    assert "another problem" in refused(store, stated=other)
    prior = target(half_normal, priors={"x": Normal(0.0, 1.0)})
    assert "another problem" in refused(store, stated=prior)


def test_a_place_that_cannot_be_written_is_known_before_sampling(tmp_path, monkeypatch):
    monkeypatch.setattr(ensemble, "_sample_blocks", None)
    with pytest.raises(InputError, match="folder that exists"):
        draw(target(half_normal), store=tmp_path / "no" / "chain.h5")
    with pytest.raises(InputError, match="the name of a file"):
        draw(target(half_normal), store=tmp_path)


def test_checkpoints_are_spaced_by_what_they_cost(tmp_path, monkeypatch):
    """A clock that ticks once a look, and checkpoints that cost two ticks: forty between them."""
    ticks, saved = itertools.count(), []
    clock = types.SimpleNamespace(perf_counter=lambda: next(ticks))

    def save(*arguments):
        saved.append(clock.perf_counter())
        return 2.0

    monkeypatch.setattr(ensemble, "time", clock)
    monkeypatch.setattr(ensemble.disk, "save", save)
    draw(target(banana), store=tmp_path / "chain.h5", seed=1, target_ess=1e9, budget=6000)
    assert ensemble.MAX_WRITING_SHARE == 0.05
    assert np.all(np.diff(saved[:-1]) >= 2.0 / 0.05)  # the last one is the finished chain
    assert len(saved) >= 3


def test_stores_of_another_format_or_model_are_refused(store):
    """An old one by its number; one of another model by the density at its walkers."""
    store.write_bytes(store.read_bytes().replace(b"posterior-3", b"posterior-4", 1))
    assert "a posterior store of format 4" in refused(store)
    store.write_bytes(store.read_bytes().replace(b"posterior-4", b"posterior-3", 1))
    with h5py.File(store, "a") as file:
        half = len(file["mcmc/log_prob"]) // 2
        file["mcmc/log_prob"][half - half // 4 : half] += 0.1
    assert "was changed since" in refused(store)
    store.write_bytes(add_seal(store.read_bytes()[SEAL_BYTES:]))
    assert "another model" in refused(store)


def test_a_flipped_bit_anywhere_is_found_before_the_file_is_opened(store):
    whole, random = store.read_bytes(), np.random.default_rng(2)
    for place in [0, 40, SEAL_BYTES - 1, SEAL_BYTES, *random.integers(0, len(whole), 30)]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(random.integers(8))
        store.write_bytes(damaged)
        said = refused(store)
        assert "is damaged" in said or "of format" in said


def test_one_run_at_a_time_and_no_link_is_followed(store, tmp_path):
    before = store.read_bytes()
    with alone(store), pytest.raises(InputError, match="another run is writing"):
        draw(target(half_normal), seed=1, target_ess=500, store=store)
    victim = tmp_path / "victim"
    victim.write_text("mine")
    store.unlink()
    (tmp_path / ".chain.h5.partial").symlink_to(victim)
    draw(target(half_normal), seed=1, target_ess=500, store=store)
    assert victim.read_text() == "mine"
    assert store.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chain.h5", "victim"]


def test_a_full_disk_leaves_the_old_store(store, tmp_path):
    """A limit on the size of files stands for it: HDF5 itself ends in a segmentation fault."""
    before, limits = store.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    state = load(store, target(half_normal), 1, 64)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
    try:
        with pytest.raises(InputError, match="cannot be written"):
            save(store, target(half_normal), state, Provenance())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [before]


def test_a_store_does_not_know_names_of_functions(store):
    def renamed(data, theta):
        return half_normal(data, theta)

    before = store.read_bytes()
    draw(target(renamed), seed=1, target_ess=500, store=store)
    assert store.read_bytes() == before


def test_the_last_digits_do_not_make_another_problem(store):
    """A command compiles without optimisation: the same scan has other last digits there."""
    base = {"none": np.array([0.1, 3e-9])}
    one, other = (
        target(half_normal, data=base),
        target(half_normal, data={"none": base["none"] * (1 + 4e-16)}),
    )
    assert one.digest == other.digest
    assert one.digest != target(half_normal, data={"none": base["none"] * (1 + 1e-7)}).digest
