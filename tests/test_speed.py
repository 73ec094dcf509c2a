"""The page of speed on its smallest works; all of it is `make bench`. No clock is judged."""

import pytest

from benchmarks import speed


@pytest.mark.parametrize("name", ["Scans, fit alone", "Elements of a line", "Slices of a ring"])
def test_a_work_is_done_by_every_tool_and_told_as_ratios(name):
    work = next(w for w in speed.WORK if w.name == name)
    work = work._replace(sizes=(min(work.sizes[0], 10),))
    rows = list(speed.measured(work, repeats=1))
    tools = rows[0][1]
    assert all(seconds >= 0 for seconds in tools.values())
    shown = speed.table(work, [(work.sizes[0], {tool: 1e-3 for tool in tools})])
    assert shown.splitlines()[-1] == f"| {work.sizes[0]} | 1 |" + " 1 |" * (len(tools) - 1)


def test_growth_is_the_power_between_the_last_two_sizes():
    rows = [(1, {"beamfit": 1.0}), (10, {"beamfit": 2.0}), (100, {"beamfit": 200.0})]
    assert speed.growth(rows, "beamfit") == "2"
    assert speed.growth(rows[:1], "beamfit") == "–"


def test_by_hand_and_beamfit_agree():
    """The peer of numpy does the same work: σ of the same 20 scans, errors 2 x dx."""
    tools = speed.bare(20)
    _, covariance = tools["numpy by hand"]()
    assert tools["beamfit"]() == pytest.approx(covariance, rel=1e-6)


def test_a_process_is_timed_and_one_that_fails_is_said():
    assert speed.command("-c", "sum(range(10**6))") > 0
    with pytest.raises(RuntimeError, match="ended with 3"):
        speed.command("-c", "raise SystemExit(3)")


def test_a_missing_peer_stops_the_run_in_one_line(monkeypatch):
    monkeypatch.setattr(speed, "PEERS", ("a_peer_nobody_has",))
    with pytest.raises(SystemExit, match="a_peer_nobody_has is not installed"):
        speed.refuse_if_missing()


def test_targets_say_what_is_missed_and_by_how_much():
    """Every figure at its target is reached; a command of twice its time is not."""
    first = {name: 1.3 for name in ("a script with one fit, kept", "beamfit emittance, kept")}
    first |= {f"beamfit {name}, cold": 3.0 for name in ("emittance", "lifetime")}
    every = {"first": first, "many": {"files": 150.0, "workers": 1.7}}
    for name, size, ms in (("Scans, fit alone", 10_000, 0.004), ("Scans, judged", 128, 0.5),
                           ("Decays at once", 10, 0.5)):  # fmt: skip
        every[name] = [(size, {"beamfit": size * ms / 1e3 * (1 - 1e-9)})]
    for name in ("scan", "decay"):
        told = {"beamfit": 1.0, "emcee": 300.0, "emcee, vectorised": 10.0, "NUTS, compiled": 2.0}
        every[f"Effective samples of a {name}"] = [(1, told)]
    rows = speed.targets(every).splitlines()[-len(speed.TARGETS) :]
    assert all(row.endswith("| reached |") for row in rows)
    first["beamfit emittance, kept"] = 3.0
    assert "| 3 × import | ≤ 1.5 | missed by a factor 2: " in speed.targets(every)
