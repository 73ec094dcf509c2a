"""What the columns of a file are, as a person says it: --columns and layouts."""

import json
import sys

import numpy as np
import pytest

import beamfit
from beamfit.cli import main
from beamfit.errors import InputError
from beamfit.io.columns import layout_of, standard_header
from beamfit.io.decay_record import read_lifetimes
from beamfit.io.run import read_run

SCAN = "QUAD:BACT,xrms,err,foo\n0,200,2,9\n1,120,1,9\n2,180,2,9\n3,230,2,9\n"
SAID = "xrms=size_x_um, QUAD:BACT=Q525_kG, err=size_x_error_um"
RECORD = (
    "When,PV 12,x\n03/01/2024 12:00:00,200,1\n03/01/2024 12:01:00,199,1\n"
    "03/01/2024 12:02:00,198,1\n"
)
LAYOUT = """format = "beamfit-layout-1"
ignore = ["fo*"]
dates = "day-month-year"
[columns]
"xr*" = "size_x_um"
"QUAD:BACT" = "Q525_kG"
"err" = "size_x_error_um"
"not there" = "size_y_um"
"When" = "time"
"PV ?2" = "beam_current_mA"
"""


@pytest.fixture
def file(tmp_path):
    def write(text, name="a.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["beamfit", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    return stopped.value.code, *capsys.readouterr()


def told(scan):
    lengths = (1e6 * scan.size["x"], 1e6 * scan.error["x"])
    return scan.settings["Q525"].tolist(), *(v.round(9).tolist() for v in lengths)


def test_any_header_becomes_a_quantity_with_a_unit(file):
    path = file(SCAN)
    said = beamfit.read_quad_scan(path, columns=SAID)
    assert told(said) == ([0, 1, 2, 3], [200, 120, 180, 230], [2, 1, 2, 2])
    assert said.notes == ("Ignored: foo.",)
    mapping = dict(part.strip().split("=") for part in SAID.split(","))
    layout = file(LAYOUT, "lcls.toml")
    for columns in (mapping, layout, str(layout), layout_of(layout)):
        assert told(beamfit.read_quad_scan(path, columns=columns)) == told(said)
    assert beamfit.read_quad_scan(path, columns=layout).notes == ()  # foo is ignored there


def test_what_is_said_is_believed_and_nothing_guessed_against_it(file):
    text = "Q_A,size_x_mm,best\n" + "".join(f"{i},9,{100 + i}\n" for i in range(4))
    scan = beamfit.read_quad_scan(file(text), columns="best=size_x_um")
    np.testing.assert_allclose(scan.size["x"], [1e-4, 1.01e-4, 1.02e-4, 1.03e-4])
    assert scan.notes == ("Ignored: size_x_mm.",)
    other = beamfit.read_quad_scan(file(text.replace("mm", "um")), columns="best=size_x_um")
    np.testing.assert_allclose(other.size["x"], scan.size["x"])
    wide = beamfit.read_quad_scan(file(SCAN), columns=SAID.replace("size_x_um", "fwhm_x_um")
                                  .replace("size_x_error", "fwhm_x_error"))  # fmt: skip
    np.testing.assert_allclose(wide.size["x"] * 2.354820045, [2e-4, 1.2e-4, 1.8e-4, 2.3e-4])


def test_a_record_and_the_order_of_its_dates(file):
    path = file(RECORD)
    said = "When=time, PV 12=beam_current_mA"
    with pytest.raises(InputError, match=r"column 'When'.*--columns day-month-year"):
        beamfit.read_decay_record(path, columns=said)
    january, march = (
        beamfit.read_decay_record(path, columns=f"{order}, {said}").start
        for order in ("day-month-year", "month-day-year")
    )
    assert (march - january) / 86400 == 31 + 29 - 2
    assert beamfit.read_decay_record(path, columns=file(LAYOUT, "l.toml")).start == january
    by_frame = pytest.importorskip("pandas").DataFrame({"n": [0, 60, 120], "I": [3.0, 2.0, 1.0]})
    record = beamfit.read_decay_record(by_frame, columns={"n": "time_s", "I": "beam_current_mA"})
    assert record.current.tolist() == [3.0, 2.0, 1.0]


def test_runs_and_lifetimes(file):
    text = "t,valve position,level\n" + "".join(f"{k},{int(k > 2)},{k / 9}\n" for k in range(10))
    columns = "t=time_s, valve position=u_valve, level=y_level"
    assert list(read_run(file(text), columns=columns).inputs) == ["valve"]
    table = "I,life\n100,50\n200,33\n300,25\n400,20\n"
    found = read_lifetimes(file(table), columns="I=beam_current_mA, life=tau_h")
    assert found.lifetime.tolist() == [50, 33, 25, 20]


def test_units_below_and_items_with_commas(file):
    scan = beamfit.read_quad_scan(
        file("Q,x\nkG,um\n0,200\n1,120\n2,180\n"), columns="Q=Q5_kG, x=size_x_um"
    )
    assert scan.units == {"Q5": "kG"}
    text = 't,"I, A"\n0,3\n60,2\n120,1\n'
    record = beamfit.read_decay_record(file(text), columns='t=time_s, "I, A=beam_current_mA"')
    assert record.current.tolist() == [3.0, 2.0, 1.0]


def test_a_deviation_beside_a_number_of_shots_is_that_of_the_shots(file):
    text = "Q_A,size_x_um,{0},shots\n" + "".join(f"{i},{100 + i},6,9\n" for i in range(4))
    scan = beamfit.read_quad_scan(file(text.format("size_x_std_um")))
    np.testing.assert_allclose(scan.error["x"], 2e-6)
    assert "'size_x_std_um' beside 'shots' is taken for the deviation" in scan.notes[0]
    scan = beamfit.read_quad_scan(file(text.format("size_x_error_um")))
    np.testing.assert_allclose(scan.error["x"], 6e-6)
    said = {"size_x_std_um": "size_x_error_um"}  # that it is an error is believed
    scan = beamfit.read_quad_scan(file(text.format("size_x_std_um")), columns=said)
    np.testing.assert_allclose(scan.error["x"], 6e-6)
    assert scan.notes == ()


LOGS = {
    "camonitor": "SR:DCCT  2024-03-01 12:00:0{0}.123456 {1}  \n",
    "caget": "2024-03-01T12:00:0{0}+00:00 SR:DCCT {1}\n",
    "timber": "2024-03-01 12:00:0{0}.123,{1}\n",
    "hdb": "2024-03-01 12:00:0{0}.123,{1},0\n",
    "bluesky": "{0},170929440{0}.5,{1}\n",
}
HEADS = {
    "timber": "VARIABLE: BCTDC\nTimestamp (UTC_TIME),Value\n",
    "hdb": "data_time,value_r,quality\n",
    "bluesky": "seq_num,time,dcct\n",
}
VALUES = {"hdb": "value_r", "bluesky": "dcct", "timber": "Value"}


@pytest.mark.parametrize("name", LOGS)
def test_layouts_that_come_along(name, file):
    rows = "".join(LOGS[name].format(k, 200 - k) for k in range(5))
    value = VALUES.get(name, "value")
    path = file(HEADS.get(name, "") + rows)
    record = beamfit.read_decay_record(path, columns=f"{name}, {value}=beam_current_mA")
    assert record.current.tolist() == [200.0, 199.0, 198.0, 197.0, 196.0]
    assert record.span == pytest.approx(4.0)
    assert record.start == pytest.approx(1709294400, abs=1)


def test_alarms_behind_a_value_are_not_read(file):
    text = LOGS["camonitor"].format(0, 200) + LOGS["camonitor"].format(1, "199 HIGH MINOR")
    record = beamfit.read_decay_record(file(text), columns="camonitor, value=beam_current_mA")
    assert record.current.tolist() == [200.0, 199.0]


WRONG = {
    "no unit": ("xrms=size_x", "column 'xrms': a size without a unit"),
    "unknown unit": ("xrms=size_x_furlong", "says that it is size_x_furlong"),
    "no such column": ("xrm=size_x_um", "did you mean xrms"),
    "no name": ("xrms=", "HEADER=NAME"),
    "no layout": ("camonitr", "did you mean camonitor"),
    "no file": ("none.toml", "none.toml: no such file"),
    "twice": (f"{SAID},foo=size_x_um", "foo for size_x_um"),
    "two units": (f"{SAID},foo=size_x_mm", "column 'foo': size_x also in column 'xrms'"),
    "metres": (SAID.replace("um", "m"), "column 'xrms': sizes around 190 m"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_told_by_the_header_of_the_file(case, file):
    columns, said = WRONG[case]
    with pytest.raises(InputError) as raised:
        beamfit.read_quad_scan(file(SCAN), columns=columns)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (("layout-1", "lattice-1"), ":1: column 'format'"),
        (('["fo*"]', '"fo*"'), ":2: column 'ignore'"),
        (('["fo*"]', "[3]"), ":2: column 'ignore'"),
        (("day-month-year", "us"), ":3: column 'dates'"),
        (('"Q525_kG"', "3"), "'QUAD:BACT' = 3"),
        (("[columns]", "[colums]"), "column 'colums'"),
        (('"xr*"', '"[x"'), "xrms"),
    ],
)
def test_layouts_that_cannot_be_used(changed, said, file):
    layout = file(LAYOUT.replace(*changed), "l.toml")
    with pytest.raises(InputError) as raised:
        beamfit.read_quad_scan(file(SCAN), columns=layout)
    assert said in str(raised.value)


def test_a_wrong_cell_is_named_by_the_header_of_the_file(file):
    with pytest.raises(InputError, match=r"a.csv:3: column 'xrms': 'lost'"):
        beamfit.read_quad_scan(file(SCAN.replace("120", "lost")), columns=SAID)
    with pytest.raises(InputError, match=r"a.csv:3: column 'PV 12': 'x'"):
        beamfit.read_decay_record(
            file(RECORD.replace("199", "x")),
            columns="month-day-year, When=time, PV 12=beam_current_mA",
        )


def test_check_proposes_a_layout_that_then_reads_the_file(file, monkeypatch, capsys):
    path = file(SCAN)
    code, out, err = run(monkeypatch, capsys, "check", path)
    assert (code, err.count("\n")) == (2, 1)
    assert '"xrms" = "size_x_um"' in out
    assert '# "foo" = ""' in out
    layout = file(out.replace('# "err" = ""', '"err" = "size_x_error_um"'), "l.toml")
    code, out, err = run(monkeypatch, capsys, "check", path, "--columns", layout, "--json")
    assert (code, err) == (0, "")
    document = json.loads(out)["results"][0]
    assert document["kind"] == "scan"
    assert document["notes"] == ["Ignored: foo."]


def test_check_proposes_the_unit_that_the_cells_say(file, monkeypatch, capsys):
    path = file("when,beam_current\n" + "".join(f"{t},{200 - t} mA\n" for t in range(9)))
    _, out, _ = run(monkeypatch, capsys, "check", path)
    assert '"beam_current" = "beam_current_mA"  # 200 mA' in out
    layout = file(out.replace('# "when" = ""', '"when" = "time_s"'), "l.toml")
    assert beamfit.read_decay_record(path, columns=layout).current[0] == 200


def test_every_command_takes_it(file, root, monkeypatch, capsys):
    source = (root / "measurements/lcls_otr2.csv").read_text()
    header = next(line for line in source.splitlines() if line.startswith("Q525_kG"))
    path = file(source.replace("Q525_kG", "quad").replace("size_x_um", "horizontal"), "scan.csv")
    assert header.startswith("Q525_kG")
    lattice = root / "lattices/lcls_otr2.toml"
    said = ("--columns", "quad=Q525_kG, horizontal=size_x_um")
    _, whole, _ = run(monkeypatch, capsys, "emittance", root / "measurements/lcls_otr2.csv",
                      "--lattice", lattice, "--json")  # fmt: skip
    code, out, err = run(
        monkeypatch, capsys, "emittance", path, "--lattice", lattice, *said, "--json"
    )
    assert (code, err) == (0, "")
    ours, theirs = (json.loads(text)["results"][0] for text in (out, whole))
    assert ours["emittance"] == theirs["emittance"]
    table = path.parent / "year.csv"
    code, _, err = run(monkeypatch, capsys, "batch", path, "--kind", "emittance", "--lattice",
                       lattice, "--out", table, *said, "--json")  # fmt: skip
    assert code == 0
    assert "converged" in table.read_text()
    code, out, err = run(monkeypatch, capsys, "emittance", path, "--lattice", lattice)
    assert (code, out) == (2, "")
    assert "--columns" in err


def test_a_slash_within_brackets_is_of_the_unit():
    assert standard_header("Q1 [G/cm]") == "Q1 [G/cm]"
    assert standard_header("Q1 [T/m]") == "Q1_T_per_m"
