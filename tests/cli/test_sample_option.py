"""--sample, --store and --seed of both commands."""

from __future__ import annotations

import json

import emcee
import pytest

SCAN = ["emittance", "measurements/gtf_simulated.csv", "--lattice", "lattices/gtf.toml"]
DECAY = ["lifetime", "measurements/aps_1999_decay.csv"]


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")


def quantity(posterior, name):
    return next(q for q in posterior["quantities"] if q["name"] == name)


def test_an_emittance_with_its_posterior(run, tmp_path):
    store, page = tmp_path / "gtf.h5", tmp_path / "gtf.html"
    sampled = (*SCAN, "--sample", "--store", store)
    status, out, err = run(*sampled, "--seed", 3, "--report", page, "--json")
    assert (status, err) == (0, "")
    document = json.loads(out)
    fit, found = document["results"][0], document["posterior"]
    assert found["status"] == "converged"
    assert found["diagnostics"]["seed"] == 3
    drawn = quantity(found, "x.normalized_emittance")
    assert drawn["value"] == pytest.approx(fit["normalized_emittance"]["value"], rel=0.01)
    assert drawn["error"] == pytest.approx(fit["normalized_emittance"]["error_raw"], rel=0.15)
    assert drawn["unit"] == "m"
    low, high = drawn["interval_68"]
    assert low < drawn["median"] < high
    backend = emcee.backends.HDFBackend(str(store), read_only=True)
    assert backend.get_chain().shape[1:] == (64, 3)
    html = page.read_text()
    for heading in ("Posterior", "Correlations of the posterior", "How the posterior was sampled"):
        assert f"<h2>{heading}</h2>" in html
    assert 'alt="numbers of the x plane in pairs"' in html
    assert 'alt="sizes expected in the x plane"' in html
    # The same command goes on from the store, which is finished: the same numbers.
    _, again, _ = run(*sampled, "--seed", 3, "--json")
    assert json.loads(again)["posterior"]["quantities"] == found["quantities"]
    status, _, err = run(*sampled, "--seed", 4, "--json")
    assert status == 2
    assert "a chain begun with seed 3; expected seed 4" in err


def test_a_lifetime_with_its_posterior(run, tmp_path):
    page = tmp_path / "aps.pdf"
    status, out, err = run(*DECAY, "--sample", "--report", page)
    assert status == 0, err
    assert "Posterior of aps_1999_decay.csv" in out
    assert "lifetime mean, h" in out
    assert "The walkers agree" in " ".join(out.split())
    assert page.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (["--store", "gtf.h5"], "--store without --sample"),
        (["--sample", "--store", "no/such/gtf.h5"], "no folder 'no/such'"),
        (["--sample", "--seed", "-1"], "--seed"),
    ],
)
def test_options_that_cannot_be_met(run, extra, said):
    status, out, err = run(*SCAN, *extra)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert said in err


def test_a_store_of_something_else_is_left(run, tmp_path):
    store = tmp_path / "scan.h5"
    store.write_bytes(b"not a store")
    status, _, err = run(*SCAN, "--sample", "--store", store)
    assert status == 2
    assert "a file that is no store" in err
    assert store.read_bytes() == b"not a store"


def test_one_store_holds_one_decay(run, tmp_path):
    record = tmp_path / "two.csv"
    rows = [f"{t},{100 * 0.9999 ** (t % 600)}" for t in range(0, 1200, 10)]
    record.write_text("time_s,beam_current_mA\n" + "\n".join(rows) + "\n")
    status, _, err = run("lifetime", record, "--sample", "--store", tmp_path / "two.h5")
    assert status == 2
    assert "--store for 2 decays" in err
