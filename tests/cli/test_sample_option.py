"""--sample, --store and --seed of both commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import emcee
import pytest

SCAN = ["emittance", "measurements/gtf_simulated.csv", "--lattice", "lattices/gtf.toml"]
DECAY = ["lifetime", "measurements/aps_1999_decay.csv"]


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-c", "from beamfit.cli import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | {"COLUMNS": "100"},
    )


def quantity(posterior, name):
    return next(q for q in posterior["quantities"] if q["name"] == name)


def test_an_emittance_with_its_posterior(tmp_path):
    store, page = tmp_path / "gtf.h5", tmp_path / "gtf.html"
    done = run(*SCAN, "--sample", "--store", store, "--seed", 3, "--report", page, "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    document = json.loads(done.stdout)
    fit, found = document["results"][0], document["posterior"]
    assert found["status"] == "converged"
    assert found["diagnostics"]["seed"] == 3
    sampled = quantity(found, "x.normalized_emittance")
    assert sampled["value"] == pytest.approx(fit["normalized_emittance"]["value"], rel=0.01)
    assert sampled["error"] == pytest.approx(fit["normalized_emittance"]["error_raw"], rel=0.15)
    assert sampled["unit"] == "m"
    low, high = sampled["interval_68"]
    assert low < sampled["median"] < high
    backend = emcee.backends.HDFBackend(str(store), read_only=True)
    assert backend.get_chain().shape[1:] == (64, 3)
    html = page.read_text()
    for heading in ("Posterior", "Correlations of the posterior", "How the posterior was sampled"):
        assert f"<h2>{heading}</h2>" in html
    assert 'alt="numbers of the x plane in pairs"' in html
    assert 'alt="sizes expected in the x plane"' in html
    # The same command goes on from the store, which is finished: the same numbers.
    again = run(*SCAN, "--sample", "--store", store, "--seed", 3, "--json")
    assert json.loads(again.stdout)["posterior"]["quantities"] == found["quantities"]
    other = run(*SCAN, "--sample", "--store", store, "--seed", 4, "--json")
    assert other.returncode == 2
    assert "a chain begun with seed 3; expected seed 4" in other.stderr


def test_a_lifetime_with_its_posterior(tmp_path):
    page = tmp_path / "aps.pdf"
    done = run(*DECAY, "--sample", "--report", page)
    assert done.returncode == 0, done.stderr
    assert "Posterior of aps_1999_decay.csv" in done.stdout
    assert "lifetime mean, h" in done.stdout
    assert "The walkers agree" in " ".join(done.stdout.split())
    assert page.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (["--store", "gtf.h5"], "--store without --sample"),
        (["--sample", "--store", "no/such/gtf.h5"], "no folder 'no/such'"),
        (["--sample", "--seed", "-1"], "--seed"),
    ],
)
def test_options_that_cannot_be_met(extra, said):
    done = run(*SCAN, *extra)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


def test_a_store_of_something_else_is_left(tmp_path):
    store = tmp_path / "scan.h5"
    store.write_bytes(b"not a store")
    done = run(*SCAN, "--sample", "--store", store)
    assert done.returncode == 2
    assert "a file that is no store" in done.stderr
    assert store.read_bytes() == b"not a store"


def test_one_store_holds_one_decay(tmp_path):
    record = tmp_path / "two.csv"
    rows = [f"{t},{100 * 0.9999 ** (t % 600)}" for t in range(0, 1200, 10)]
    record.write_text("time_s,beam_current_mA\n" + "\n".join(rows) + "\n")
    done = run("lifetime", record, "--sample", "--store", tmp_path / "two.h5")
    assert done.returncode == 2
    assert "--store for 2 decays" in done.stderr


def test_without_sampling_nothing_of_it_is_loaded():
    code = (
        "import sys\n"
        f"sys.argv = ['beamfit', *{SCAN!r}]\n"
        "from beamfit.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "heavy = {'emcee', 'scipy.stats', 'matplotlib', 'beamfit.sampling.ensemble'}\n"
        "print(heavy & set(sys.modules), file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.strip() == "set()"
