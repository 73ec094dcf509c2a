"""`beamfit lifetime` as a person and as a script use it."""

import functools
import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest

import beamfit
from beamfit.lifetime import ring_study

APS = "measurements/aps_1999_decay.csv"
RING = "lattices/spear3_2003.toml"


def write_record(path, time, current, **columns):
    """A record file with any further columns."""
    table = {"time_s": time, "beam_current_mA": current, **columns}
    rows = zip(*(np.broadcast_to(values, len(time)) for values in table.values()), strict=True)
    lines = [",".join(f"{value:.10g}" for value in row) for row in rows]
    path.write_text("\n".join([",".join(table), *lines]) + "\n")
    return path


def decay(time, i0=500.0, a=2e-8, b=1e-6):
    """Equation 44, by its own words."""
    return i0 * np.exp(-b * time) / (1 + a / b * i0 * -np.expm1(-b * time))


def test_json_follows_the_contract(run, root):
    status, out, err = run("lifetime", APS, "--json")
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert list(document) == ["beamfit", "command", "inputs", "results"]
    assert document["command"] == f"beamfit lifetime {APS} --json"
    assert document["inputs"] == {APS: hashlib.sha256((root / APS).read_bytes()).hexdigest()}
    [result] = document["results"]
    assert {
        "record", "status", "message", "a", "b", "i0", "lifetime_start", "lifetime_end",
        "lifetime_mean", "chi2", "dof", "identifiability",
    } <= set(result)  # fmt: skip
    assert (result["record"], result["status"]) == ("aps_1999_decay.csv", "converged")
    # The whole record of 529 readings gives 6.996(30)e-8 and 7.17(27)e-7.
    assert result["a"]["value"] == pytest.approx(6.996e-8, abs=3 * result["a"]["error"])
    assert result["b"]["value"] == pytest.approx(7.17e-7, abs=3 * result["b"]["error"])
    assert result["a"]["unit"] == "1/(mA s)"
    assert "budget" not in result


def test_the_budget_adds_up_beside_the_measured_values(run):
    status, out, _ = run("lifetime", APS, "--ring", RING, "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    budget = {k: v["value"] for k, v in result["budget"].items() if k != "operation"}
    parts = [budget[f"a_{cause}"] for cause in ("touschek", "bremsstrahlung", "elastic")]
    assert budget["a"] == pytest.approx(sum(parts), rel=1e-12)
    mean = result["mean_current"]["value"]
    rate = budget["a"] * mean + budget["b"]
    assert 1 / rate / 3600 == pytest.approx(budget["lifetime_mean"], rel=1e-12)
    # 30.4 h at 500 mA in 280 bunches (reference/spear3_lifetime.json), all else linear.
    assert 1 / (500 * 3600 * budget["a_touschek"]) == pytest.approx(30.4, abs=0.06)


def test_fills_at_two_voltages_are_cut_and_each_has_its_own_budget(run, tmp_path):
    time = np.arange(0.0, 7200.0, 10.0)
    second = time >= 3600
    current = decay(time % 3600)
    voltage = np.where(second, 1600.0, 3200.0)
    path = write_record(tmp_path / "two.csv", time, current, rf_voltage_kV=voltage)
    status, out, _ = run("lifetime", path, "--ring", RING, "--json")
    assert status == 0
    first, other = json.loads(out)["results"]
    assert (first["record"], other["record"]) == ("two.csv#1", "two.csv#2")
    assert other["start"]["value"] == 3600
    assert other["a"]["value"] == pytest.approx(2e-8, rel=1e-4)
    touschek = [1 / (500 * 3600 * r["budget"]["a_touschek"]["value"]) for r in (first, other)]
    assert touschek == pytest.approx([30.4, 8.2], abs=0.06)


def test_a_change_of_setting_without_a_refill_also_cuts(run, tmp_path):
    time = np.arange(0.0, 7200.0, 10.0)
    scraper = np.where(time >= 3600, 3.0, 6.0)
    path = write_record(tmp_path / "scraped.csv", time, decay(time), scraper_y_mm=scraper)
    status, out, _ = run("lifetime", path, "--json")
    assert status == 0
    assert [r["dof"] for r in json.loads(out)["results"]] == [357, 357]


def test_a_slow_refill_is_an_event_and_not_an_error(run, tmp_path):
    time = np.arange(0.0, 9000.0, 10.0)
    filling = (time >= 3600) & (time < 5000)
    current = np.where(time < 3600, decay(time), decay(time - 5000))
    current = np.where(filling, current[359] - 300 + 0.2 * (time - 3600), current)
    path = write_record(tmp_path / "slow.csv", time, current)
    status, out, _ = run("lifetime", path, "--full")
    assert status == 0
    assert "ramp at 3600 s (+278 mA)" in out
    assert sum(line.split() == ["status", "converged"] for line in out.splitlines()) == 2


def test_a_record_too_short_has_a_lifetime_and_null_errors_of_a_and_b(run, tmp_path):
    time = np.linspace(0, 60, 1000)
    noise = 1e-3 * np.random.default_rng(1).normal(size=time.size)
    error = np.full(time.size, 1e-3)
    path = write_record(
        tmp_path / "minute.csv", time, decay(time) + noise, beam_current_error_mA=error
    )
    status, out, _ = run("lifetime", path, "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    assert result["status"] == "unidentified"
    assert result["a"]["error"] is None
    assert result["b"]["error"] is None
    tau = 1 / (2e-8 * 500 + 1e-6) / 3600
    found = result["lifetime_mean"]
    assert found["value"] == pytest.approx(tau, abs=4 * found["error"])


def test_tables_and_report(run, tmp_path, well_shown):
    report = tmp_path / "aps.html"
    status, out, err = run("lifetime", APS, "--ring", RING, "--report", report, "--full")
    assert (status, err) == (0, "")
    for words in ("converged", "lifetime at the mean current", "a, Touschek", "b, measured"):
        assert words in out
    assert report.read_text().startswith("<!DOCTYPE html>")
    assert well_shown(report, 3) == []


def test_help_has_examples(run):
    status, out, _ = run("lifetime", "--help")
    assert status == 0
    assert "beamfit lifetime fill1.csv fill2.h5 --ring" in out


TIME = np.arange(0.0, 600.0, 10.0)
BAD = {
    "time": (np.r_[TIME[:30], TIME[29:-1]], decay(TIME), {}, "times that increase"),
    "negative": (TIME, np.r_[decay(TIME)[:-1], -1.0], {}, "a current of zero or more"),
    "rising": (TIME, 100 + TIME / 100, {}, "a decay; cut out refills"),
    "units": (TIME, np.r_[decay(TIME)[:30], decay(TIME)[30:] / 1e3], {}, "one unit throughout"),
    "short": (TIME[:3], decay(TIME)[:3], {}, "5 or more"),
    "no beam": (TIME, np.r_[decay(TIME)[:3], 0 * TIME[3:]], {}, "a stored beam"),
    "voltage": (TIME, decay(TIME), {"rf_voltage_kV": 800.0}, "more than the loss of 877.974 kV"),
    "scraper": (TIME, decay(TIME), {"scraper_y_mm": 0.0}, "above zero"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_and_status_2(run, tmp_path, name):
    time, current, columns, words = BAD[name]
    path = write_record(tmp_path / "bad.csv", time, current, **columns)
    status, out, err = run("lifetime", path, "--ring", RING)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith("beamfit: ")
    assert "bad.csv" in err
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("missing.csv",), "missing.csv: no such file"),
        ((APS, APS), "a record given twice"),
        ((APS, "--ring", "missing.toml"), "missing.toml: no such file"),
        ((APS, "--report", "page.doc"), "a name ending in .html or .pdf"),
        ((), "Missing argument"),
    ],
)
def test_bad_arguments(run, arguments, words):
    status, out, err = run("lifetime", *arguments)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert words in err


def test_a_gap_is_no_error(run, tmp_path):
    time = np.r_[TIME, TIME + 3600]
    path = write_record(tmp_path / "gap.csv", time, decay(time))
    status, out, _ = run("lifetime", path, "--full")
    assert status == 0
    assert "gap at" in out
    assert "120 over" in out


def test_bad_files_are_answered_without_jax(root, tmp_path):
    ring = tmp_path / "ring.toml"
    ring.write_text((root / RING).read_text().replace("energy_GeV", "energy_TeV"))
    bad = write_record(tmp_path / "bad.csv", TIME, -decay(TIME))
    script = (
        "import sys\n"
        "from beamfit.cli import main\n"
        "try:\n    main()\n"
        "except SystemExit as stop:\n    print(stop.code, 'jax' in sys.modules)\n"
    )
    for arguments in ([bad], [APS, "--ring", ring]):
        done = subprocess.run(
            [sys.executable, "-c", script, "lifetime", *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=root,
            check=True,
            env={**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(beamfit.__file__))},
        )
        assert done.stdout == "2 False\n"
        assert done.stderr.count("\n") == 1


def test_a_study_of_a_shift_and_a_network_of_the_losses(run, monkeypatch):
    """Where first principles describe the shift, a correction of them changes little and obeys."""
    one = functools.partial(ring_study.fit_loss_network, starts=1)
    monkeypatch.setattr(ring_study, "fit_loss_network", one)
    path = "measurements/spear3_shift_simulated.csv"
    options = ("--ring", RING, "--study", "--network")
    status, out, err = run("lifetime", path, *options, "--json")
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert len(document["results"]) == 30
    study = document["study"]
    assert study["scales"]["status"] == "converged"
    true = {"touschek": 1.12, "bremsstrahlung": 1.30, "elastic": 0.85, "desorption": 1.25}
    for name, value in true.items():
        scale = study["scales"][name]
        assert scale["value"] == pytest.approx(value, abs=3 * scale["error"])
    assert study["anomaly"]["moved"] == []
    assert study["best"]["lifetime"]["value"] >= study["best"]["usual"]["value"]
    assert study["next"][0]["information"] >= study["next"][-1]["information"] > 0
    network = study["network"]
    assert network["certificate"]["holds"] is True
    assert network["single_maximum"] is True
    assert network["lifetime"]["value"] == pytest.approx(study["best"]["usual"]["value"], rel=0.03)
    status, out, err = run("lifetime", path, "--network")
    assert (status, out) == (2, "")
    assert "--study" in err


def test_the_command_takes_a_stability(run, root):
    status, out, err = run("lifetime", APS, "--monitor-drift", "5uA/h", "--json")
    assert (status, err) == (0, "")
    [result] = json.loads(out)["results"]
    plain = beamfit.fit_decay(beamfit.read_decay_record(root / APS))
    exact = result["if_a_and_b_are_constant"]["b"]
    assert exact["error"] > 1.1 * plain.exact["b"].error
    assert result["b"]["error"] > plain.b.error
    assert result["b"]["error_raw"] == pytest.approx(plain.b.error_raw)
    assert "drifts by 5 µA/h" in result["message"]
    status, out, err = run("lifetime", APS, "--monitor-drift", "5uA")
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1


def test_what_is_known_of_scales_needs_a_study(run):
    status, out, err = run("lifetime", APS, "--prior", "rf_voltage=1+-1%")
    assert (status, out) == (2, "")
    assert "--prior without a study" in err
    status, out, err = run("lifetime", APS, "--ring", RING, "--study", "--prior", "voltage=1+-1%")
    assert (status, out) == (2, "")
    assert "rf_voltage" in err


def test_a_study_needs_a_ring(run):
    status, out, err = run("lifetime", APS, "--study")
    assert (status, out) == (2, "")
    assert "--ring" in err


def test_simpler_analyses_stand_beside_with_their_bias(run):
    """The real record leaves a single exponential ten times the residual of (a, b)."""
    _, out, _ = run("lifetime", APS, "--json")
    [result] = json.loads(out)["results"]
    for name in ("single_exponential", "log_linear"):
        simple = result[name]
        start = result["lifetime_start"]["value"]
        assert simple["bias_start"] == pytest.approx(simple["lifetime"]["value"] / start - 1)
        assert simple["bias_start"] == pytest.approx(0.11, abs=0.01)
        assert simple["rms_residual"]["value"] > 10 * result["rms_residual"]["value"]
    assert result["constant_a"]["status"] == "unidentified"
    assert result["constant_a"]["exponent"]["error"] is None
    _, shown, _ = run("lifetime", APS, "--full")
    assert "single exponential" in shown
    assert "not testable with this record" in shown


def test_a_lengthening_bunch_is_not_taken_for_gas(run, tmp_path):
    """SIMULATED: a falls as I^-0.2; a constant a invents a gas loss, and the command says so."""
    time = np.arange(0.0, 12 * 3600, 60.0)
    step, beam = 60.0, [500.0]
    for _ in time[1:]:
        rate = 4e-8 * (beam[-1] / 500) ** -0.2 * beam[-1]
        middle = beam[-1] * np.exp(-rate * step / 2)
        beam.append(beam[-1] * np.exp(-4e-8 * (middle / 500) ** -0.2 * middle * step))
    noise = 1e-3 * np.random.default_rng(2).normal(size=time.size)
    path = write_record(tmp_path / "long.csv", time, np.array(beam) + noise)
    status, out, _ = run("lifetime", str(path), "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    checked = result["constant_a"]
    assert checked["status"] == "poor_fit"
    assert checked["exponent"]["value"] == pytest.approx(-0.2, abs=4 * checked["exponent"]["error"])
    assert result["b"]["interval_95"][0] < 1e-8
    _, shown, _ = run("lifetime", str(path), "--law", "constant")
    assert "not a gas loss" in " ".join(shown.split())


def test_a_constant_record_is_an_answer_not_an_error(run, tmp_path):
    path = write_record(tmp_path / "flat.csv", np.arange(0.0, 600.0, 10.0), 100.0)
    status, out, err = run("lifetime", str(path), "--json")
    assert (status, err) == (0, "")
    [result] = json.loads(out)["results"]
    assert result["status"] == "unidentified"
    assert result["a"]["error"] is result["b"]["error"] is None
    assert result["lifetime_mean"]["error"] is None
    assert "more digits" in result["message"]


def test_many_decays_are_a_row_each_and_nothing_is_cut_short(run, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    time = np.arange(0.0, 10000.0, 10.0)
    noise = 1e-3 * np.random.default_rng(3).normal(size=time.size)
    saw = 100 * np.exp(-(time % 2000) / 6000) + noise
    path = write_record(tmp_path / "a_rather_long_name_of_a_topup_record.csv", time, saw)
    _, shown, _ = run("lifetime", str(path), "--ring", RING, "--full")
    assert "…" not in shown
    for number in range(1, 6):
        assert len([row for row in shown.splitlines() if row.startswith(f"#{number} ")]) == 3
    two = write_record(tmp_path / "two.csv", time[:400], saw[:400])
    _, shown, _ = run("lifetime", str(two), "--ring", RING, "--full")
    assert "…" not in shown
    assert shown.count("lifetime at the mean current ") == 2
    assert shown.count("a, Touschek ") == 2


def test_top_up_is_one_answer_in_terminal_json_and_page(run, tmp_path):
    time = np.arange(0.0, 7200.0, 10.0)
    noise = 0.01 * np.random.default_rng(3).normal(size=time.size)
    path = write_record(tmp_path / "topup.csv", time, decay(time % 180) + noise)
    page = tmp_path / "topup.html"
    status, out, _ = run("lifetime", path, "--json", "--report", page)
    [result] = json.loads(out)["results"]
    assert (status, result["cycles"], result["record"]) == (0, 40, "topup.csv")
    truth = 1 / (2e-8 * result["mean_current"]["value"] + 1e-6) / 3600
    found = result["lifetime_mean"]
    assert abs(found["value"] - truth) < 2 * found["error"] < 0.02 * truth
    assert "40 cycles in 2 h of record" in page.read_text()
    _, shown, _ = run("lifetime", path)
    assert "refill 39 times" in shown
    assert shown.count("\nlifetime at the mean current ") == 1


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("rf_voltage_kV", 3.2e6, "beam's energy"),
        ("scraper_y_mm", 0.006, "check the unit"),
        ("pressure_Pa", 1e5, "check the unit"),
    ],
)
def test_a_setting_in_another_unit_is_refused(run, tmp_path, column, value, said):
    time = np.arange(0.0, 3600.0, 60.0)
    path = write_record(tmp_path / "slip.csv", time, decay(time), **{column: value})
    status, out, err = run("lifetime", str(path), "--ring", RING)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "slip.csv" in err
    assert column in err
    assert said in err


def test_a_decimal_comma_between_semicolons_is_told_so(run, tmp_path):
    path = tmp_path / "semi.csv"
    path.write_text("time_s;beam_current_mA\n0;100\n10;99,9\n")
    status, out, err = run("lifetime", str(path))
    assert (status, out) == (2, "")
    assert "semi.csv:3" in err
    assert "'99,9'" in err
    assert "a decimal point" in err


def test_a_table_of_lifetimes_is_judged_like_a_decay(run, tmp_path):
    path = tmp_path / "lifetimes.csv"
    current = np.linspace(100, 500, 12)
    rows = [f"{i:g},{1 / (1e-4 * i + 0.01):.6f},0.1" for i in current]
    path.write_text("\n".join(["beam_current_mA,tau_h,tau_error_h", *rows]) + "\n")
    status, out, err = run("lifetime", str(path), "--json")
    assert (status, err) == (0, "")
    [result] = json.loads(out)["results"]
    assert result["status"] == "converged"
    assert result["a"]["value"] * 3600 == pytest.approx(1e-4, rel=1e-4)
    page = tmp_path / "page.html"
    status, out, _ = run("lifetime", str(path), "--report", str(page))
    assert status == 0
    assert "12 lifetimes at 100 to 500 mA" in out
    assert "lifetimes of lifetimes.csv" in page.read_text()
    status, out, err = run("lifetime", str(path), "--sample")
    assert (status, out) == (2, "")
    assert "tables of lifetimes by themselves" in err


def test_columns_of_an_archive_are_named_on_request(run, tmp_path):
    time = np.arange(0, 20000, 40)
    path = tmp_path / "export.csv"
    rows = [f"{t},{i / 1000:.9f},0.2" for t, i in zip(time, decay(time), strict=True)]
    rows.insert(7, "270,Disconnected,0.2")
    path.write_text("\n".join(["Seconds,SR:DCCT:CURRENT,SR:TUNE", *rows]) + "\n")
    named = ("--columns", "Seconds=time_s, SR:DCCT:CURRENT=beam_current_A")
    status, out, err = run("lifetime", str(path), *named)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert f"{path}:9: column 'SR:DCCT:CURRENT': 'Disconnected'; expected a number" in err
    status, out, _ = run("lifetime", str(path), *named, "--skip-bad", "--json")
    assert status == 0
    [result] = json.loads(out)["results"]
    assert result["a"]["value"] == pytest.approx(2e-8, rel=1e-3)
    assert "1 of 501 rows was left out" in result["notes"][0]


def test_a_clock_in_milliseconds_is_questioned(run, tmp_path):
    time = np.arange(0, 36000, 60)
    path = write_record(tmp_path / "ms.csv", 1000 * time, decay(time))
    status, out, _ = run("lifetime", str(path), "--json")
    assert status == 0
    assert "milliseconds taken for seconds" in json.loads(out)["results"][0]["message"]
