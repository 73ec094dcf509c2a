"""Fits kept in a file say the same when they are loaded, and damaged files say so."""

import json
import random
import re
from importlib import import_module

import numpy as np
import pytest

import beamfit
from beamfit.answer import json_of
from beamfit.emittance.results import PlaneFit
from beamfit.errors import InputError
from beamfit.io.result import MODULE_OF_CLASS
from beamfit.lifetime.fit import DecayFit


def of(root, scan, lattice, **options):
    measured = beamfit.read_quad_scan(root / scan)
    return beamfit.fit_emittance(measured, beamfit.load_lattice(root / lattice), **options)


def fits(root):
    data = "tests/golden/data"
    gtf = "lattices/gtf.toml"
    rng = np.random.default_rng(1)
    elements = np.stack([rng.normal(size=6), 2 + rng.normal(size=6)], axis=-1)
    sizes = (
        np.sqrt(elements[:, 0] ** 2 + elements[:, 1] ** 2) * 1e-4 * (1 + 0.01 * rng.normal(size=6))
    )
    rows = beamfit.QuadScan(
        {}, {}, {"x": sizes}, {"x": 0.01 * sizes}, np.full(6, 100.0), transfer={"x": elements}
    )
    time = np.linspace(0, 3e4, 50)
    record = beamfit.DecayRecord(time, 100 / (1 + 1e-5 * time) + 1e-2 * rng.normal(size=50))
    return {
        "planes": of(root, "measurements/lcls_otr2.csv", "lattices/lcls_otr2.toml"),
        "robust": of(root, f"{data}/outlier.csv", gtf, robust=True),
        "size": of(root, "measurements/gtf_simulated.csv", gtf, method="size"),
        "noise": of(root, f"{data}/noise.csv", gtf),
        "rows": beamfit.fit_emittance(rows),
        "decay": beamfit.fit_decay(record),
    }


@pytest.fixture(scope="module")
def every(root):
    return fits(root)


def told(fit, folder):
    """All that a fit says: text, JSON, and its report without the time and the pictures."""
    beamfit.write_report(folder / "fit.html", fit)
    page = (folder / "fit.html").read_text()
    page = re.sub(r"written [-\d :]+UTC|base64,[^\"]*", "", page)
    return str(fit), json.dumps(json_of(fit.to_json()), sort_keys=True), page


@pytest.mark.parametrize("name", ["planes", "robust", "size", "noise", "rows", "decay"])
def test_what_is_loaded_says_the_same(every, name, tmp_path):
    fit = every[name]
    beamfit.save_fit(tmp_path / "a.json", fit)
    again = beamfit.load_fit(tmp_path / "a.json")
    assert type(again) is type(fit)
    assert told(again, tmp_path) == told(fit, tmp_path)
    beamfit.save_fit(tmp_path / "b.json", again)
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()


def test_what_is_loaded_goes_on_as_the_fit(every, tmp_path):
    fit = every["planes"]
    beamfit.save_fit(tmp_path / "a.json", fit)
    again = beamfit.load_fit(tmp_path / "a.json")
    np.testing.assert_array_equal(
        again.predict({"Q525": [-3.0, -2.0]}).error, fit.predict({"Q525": [-3.0, -2.0]}).error
    )
    assert again.fit.chi2 == pytest.approx(fit.fit.chi2, rel=1e-12)


def test_a_scenario_is_refused_in_words(root, tmp_path):
    fit = of(
        root,
        "measurements/gtf_simulated.csv",
        "lattices/gtf.toml",
        scenario="calibration",
        priors={"Q2.slope": (167.23, 3.3446)},
    )
    with pytest.raises(InputError, match="a fit of scenario calibration"):
        beamfit.save_fit(tmp_path / "a.json", fit)
    assert list(tmp_path.iterdir()) == []


def test_another_value_is_refused_in_words(every, tmp_path):
    with pytest.raises(InputError, match="a PlaneFit; expected one fit"):
        beamfit.save_fit(tmp_path / "a.json", every["planes"].x)


def test_other_files_and_formats_are_refused_in_words(every, tmp_path):
    file = tmp_path / "a.json"
    for text in ("{}", "[1]", "no json", '{"format": "beamfit-fit-2"}', "null"):
        file.write_text(text)
        with pytest.raises(InputError, match=r"a\.json: no saved fit"):
            beamfit.load_fit(file)
    beamfit.save_fit(file, every["decay"])
    whole = file.read_text()
    file.write_text(whole.replace("beamfit-fit-2", "beamfit-fit-7"))
    with pytest.raises(InputError, match=r"format beamfit-fit-7, of beamfit .*expected format"):
        beamfit.load_fit(file)
    file.write_text(whole.replace('"DecayRecord"', '"Popen"'))
    with pytest.raises(InputError, match="a value of kind Popen"):
        beamfit.load_fit(file)
    file.write_text(whole.replace('"chi2"', '"chi3"'))
    with pytest.raises(InputError, match="cannot be read here"):
        beamfit.load_fit(file)


def test_a_scan_within_that_cannot_be_is_told_of_the_file(every, tmp_path):
    file = tmp_path / "a.json"
    beamfit.save_fit(file, every["planes"])
    content = json.loads(file.read_text())
    content["fit"]["scan"]["with"]["size"] = {"is": "dict", "of": []}
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match="no beam sizes") as told:
        beamfit.load_fit(file)
    assert told.value.path == file


def words_of(file):
    """Why a file is refused, if it is."""
    try:
        beamfit.load_fit(file)
    except InputError as error:
        return str(error)
    return None


def test_mutated_files_load_or_are_refused(every, tmp_path):
    file = tmp_path / "a.json"
    beamfit.save_fit(file, every["robust"])
    whole, rng, refused = file.read_text(), random.Random(1), 0
    for _ in range(150):
        at = rng.randrange(len(whole))
        cut = rng.choice(["", whole[: rng.randrange(40)], "9", "null", "[", '"'])
        file.write_text(whole[:at] + cut + whole[at + rng.randrange(30) :])
        said = words_of(file)
        refused += said is not None
        assert "\n" not in (said or "")
    assert refused > 100


def test_every_kind_of_value_is_where_the_list_says():
    for name, home in MODULE_OF_CLASS.items():
        assert getattr(import_module(home), name).__module__ == home


@pytest.mark.parametrize("cls", [DecayFit, PlaneFit, beamfit.QuadScan, beamfit.DecayRecord])
def test_whatever_a_fit_may_hold_can_be_kept(cls):
    """A decay with a relaxing gas loss could not: that kind of value was not on the list."""
    held = {name for kind in cls.__annotations__.values() for name in re.findall(r"[A-Z]\w+", kind)}
    assert held - {"Mapping", "PathLike", "None"} <= MODULE_OF_CLASS.keys()
