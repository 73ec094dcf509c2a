"""One decay as control rooms export it: every file gives the same record."""

import json
from datetime import UTC, datetime, timedelta, timezone

import h5py
import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.check import file_summary
from beamfit.io.decay_record import read_decay_record, read_lifetime_input, read_lifetimes
from beamfit.io.scan import read_quad_scan
from beamfit.lifetime.record import LifetimeTable
from tests.io.forked import in_forks  # noqa: F401

START = 1709290800.25  # 2024-03-01T11:00:00.25 UTC
CURRENT = [200.0, 199.5, 199.1, 198.6]
TIMES = [0.0, 60.0, 120.0, 200.5]


def dates(form, zone=UTC):
    moments = (datetime.fromtimestamp(START + t, zone) for t in TIMES)
    return [moment.strftime(form) for moment in moments]


def table(header, times, values, separator=","):
    rows = [f"{t}{separator}{v}" for t, v in zip(times, values, strict=True)]
    return "\n".join([header.replace(",", separator), *rows]) + "\n"


BERLIN = timezone(timedelta(hours=1))
MILLI = [round(1000 * (START + t)) for t in TIMES]
SECONDS = [f"{START + t:.2f}" for t in TIMES]
AMPERE = [v / 1000 for v in CURRENT]
PV = "SR:DCCT:CURRENT"
EXPORTS = {
    "contract": (table("time_s,beam_current_mA", SECONDS, CURRENT), {}),
    "ampere": (table("time_s,beam_current_A", SECONDS, AMPERE), {}),
    "microampere": (table("time_s,beam_current_uA", SECONDS, [1000 * v for v in CURRENT]), {}),
    "semicolons": (table("time_s,beam_current_mA", SECONDS, CURRENT, ";"), {}),
    "milliseconds": (table("time_ms,beam_current_mA", MILLI, CURRENT), {}),
    "iso": (table("time,beam_current_mA", dates("%Y-%m-%dT%H:%M:%S.%fZ"), CURRENT), {}),
    "offset": (
        table("time,beam_current_mA", dates("%Y-%m-%d %H:%M:%S.%f+01:00", BERLIN), CURRENT), {},
    ),
    "zone": (
        table("Time,beam_current_mA", dates("%Y-%m-%d %H:%M:%S.%f Europe/Berlin", BERLIN), CURRENT),
        {},
    ),
    "matlab": (table("Date,I", dates("%d-%b-%Y %H:%M:%S.%f"), CURRENT),
               {"Date": "time", "I": "beam_current_mA"}),
    "german": (table("Zeit;Strom", dates("%d.%m.%Y %H:%M:%S.%f"), CURRENT, ";"),
               {"Zeit": "time", "Strom": "beam_current_mA"}),
    "slashes": (table(f"Timestamp,{PV}", dates("%Y/%m/%d %H:%M:%S.%f"), CURRENT),
                {"Timestamp": "time", PV: "beam_current_mA"}),
    "newest first": (table("time_s,beam_current_mA", SECONDS[::-1], CURRENT[::-1]), {}),
    "numpy.savetxt": ("# noon\n" + table("# time_s,beam_current_mA", SECONDS, CURRENT, " "), {}),
    "process variable": (table(f"time_s,{PV}", SECONDS, AMPERE), {PV: "beam_current_A"}),
    "archiver, no header": (
        "".join(f"{int(START + t)},{v},0,0,{round((START + t) % 1 * 1e9)}\n"
                for t, v in zip(TIMES, CURRENT, strict=True)),
        {"val": "beam_current_mA"},
    ),
    "archiver, with header": (
        "secs,nanos,val,severity,status\n"
        + "".join(f"{int(START + t)},{round((START + t) % 1 * 1e9)},{v},0,0\n"
                  for t, v in zip(TIMES, CURRENT, strict=True)),
        {"val": "beam_current_mA"},
    ),
    "further columns": (
        "time_s,beam_current_mA,SR:TUNE:X,operator\n"
        + "".join(f"{t},{v},0.22,A. N.\n" for t, v in zip(SECONDS, CURRENT, strict=True)),
        {"time_s": "time_s"},
    ),
    "a byte-order mark": ("\ufeff" + table("time_s,beam_current_mA", SECONDS, CURRENT), {}),
}  # fmt: skip


def check(record):
    np.testing.assert_allclose(record.current, CURRENT)
    np.testing.assert_allclose(record.time, TIMES, atol=1e-5)
    assert record.start == pytest.approx(START, abs=1e-5)


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_is_read(tmp_path, name):
    text, columns = EXPORTS[name]
    path = tmp_path / "export.csv"
    path.write_text(text, encoding="utf-8")
    check(read_decay_record(path, columns=columns or None))


def archive(unit):
    data = [
        {"secs": int(START + t), "val": v, "nanos": round((START + t) % 1 * 1e9), "severity": 0}
        for t, v in zip(TIMES, CURRENT, strict=True)
    ]
    return [{"meta": {"name": PV, "EGU": unit, "PREC": "3"}, "data": data}]


def test_json_of_the_archiver_appliance(tmp_path):
    path = tmp_path / "export.json"
    path.write_text(json.dumps(archive("mA")))
    record = read_decay_record(path)
    check(record)
    assert f"name: {PV}" in record.comments
    path.write_text(json.dumps(archive("")))
    with pytest.raises(
        InputError, match=r"no column of current.*--columns 'HEADER=beam_current_mA'"
    ):
        read_decay_record(path)
    check(read_decay_record(path, columns="val=beam_current_mA"))


def test_hdf5_of_process_variables(tmp_path):
    path = tmp_path / "export.h5"
    with h5py.File(path, "w") as file:
        file["timestamp"], file[PV] = START + np.array(TIMES), CURRENT
    columns = {"timestamp": "time_s", PV: "beam_current_mA"}
    check(read_decay_record(path, columns=columns))


@pytest.mark.parametrize(
    ("header", "times"),
    [("time_h", [t / 3600 for t in TIMES]), ("time_d", [t / 86400 for t in TIMES]),
     ("time_min", [t / 60 for t in TIMES])],
)  # fmt: skip
def test_times_in_other_units(tmp_path, header, times):
    path = tmp_path / "export.csv"
    path.write_text(table(f"{header},beam_current_mA", times, CURRENT))
    np.testing.assert_allclose(read_decay_record(path).time, TIMES, atol=1e-9)


def test_pressures_in_torr_and_mbar(tmp_path):
    path = tmp_path / "export.csv"
    for unit, factor in (("Torr", 133.32236842), ("mbar", 100.0)):
        path.write_text(f"time_s,beam_current_mA,pressure_{unit}\n0,5,1e-9\n60,4.9,1e-9\n")
        found = read_decay_record(path).conditions.pressure
        np.testing.assert_allclose(found, 1e-9 * factor, rtol=1e-9)


def test_bad_rows_are_left_out_counted_and_named(tmp_path):
    path = tmp_path / "export.csv"
    path.write_text(
        "time_s,beam_current_mA\n0,200\n60,NaN\n120,199\n120,199\n100,199.1\n180,Disconnected\n"
        "240,-0.1\n300,198\n360\n420,197\n"
    )
    record = read_decay_record(path, skip_bad=True)
    assert record.time.tolist() == [0, 120, 300, 420]
    [note] = record.notes
    assert "6 of 10 rows were left out" in note
    assert "'Disconnected'" in note or "more" in note
    assert "line 3" in note
    with pytest.raises(InputError, match="2, as in the header"):
        read_decay_record(path)


def test_milliseconds_called_seconds_are_questioned(tmp_path):
    path = tmp_path / "export.csv"
    path.write_text(table("time_s,beam_current_mA", MILLI, CURRENT))
    with pytest.raises(InputError, match=r"after the year 5000; expected .*time_ms"):
        read_decay_record(path)


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({PV: "beam_current"}, f"column '{PV}': .*says that it is beam_current"),
        ({"SR:DCCT": "beam_current_mA"}, f"no column 'SR:DCCT'; expected one of time_s, {PV}"),
        ({"when": "time", PV: "beam_current_mA"}, "no column 'when'"),
    ],
)
def test_a_wrong_name_is_answered_with_those_there_are(tmp_path, columns, words):
    path = tmp_path / "export.csv"
    path.write_text(table(f"time_s,{PV}", SECONDS, CURRENT))
    with pytest.raises(InputError, match=words):
        read_decay_record(path, columns=columns)


def test_an_unknown_zone_is_no_date(tmp_path):
    path = tmp_path / "export.csv"
    path.write_text("time,beam_current_mA\n2024-03-01 12:00:00 Europe/Atlantis,5\n")
    with pytest.raises(InputError, match="Atlantis"):
        read_decay_record(path)


@pytest.mark.parametrize(
    "text", ["{}", "[]", "[1]", "nonsense", '[{"data": []}]', '[{"data": [{"secs": 1}]}]']
)
def test_other_json_is_refused_in_a_line(tmp_path, text):
    path = tmp_path / "export.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"export\.json"):
        read_decay_record(path)


def test_several_channels_of_an_archive_are_told_as_such(tmp_path):
    path = tmp_path / "export.json"
    path.write_text(json.dumps(2 * archive("mA")))
    with pytest.raises(
        InputError, match=r"export\.json: 2 channels; expected one, of the beam curr"
    ):
        read_decay_record(path)


def test_a_table_of_lifetimes(tmp_path):
    path = tmp_path / "lifetimes.csv"
    rows = "1,20,1\n2,15,1\n3,12,0.5\n4,10,1\n"
    path.write_text(f"# IOTA\nbeam_current_mA,tau_min,tau_error_min\n{rows}")
    found = read_lifetimes(path)
    np.testing.assert_allclose(found.lifetime, np.array([20, 15, 12, 10]) / 60)
    np.testing.assert_allclose(found.error, np.array([1, 1, 0.5, 1]) / 60)
    assert found.comments == ("IOTA",)
    assert isinstance(read_lifetime_input(path), LifetimeTable)
    path.write_text(f"I [A];tau [min];err (%)\n{rows.replace(',', ';')}")
    found = read_lifetimes(path)
    assert found.current.tolist() == [1000, 2000, 3000, 4000]
    np.testing.assert_allclose(found.error, found.lifetime * [0.01, 0.01, 0.005, 0.01])
    assert "Column 'I [A]' is taken for the beam current." in found.notes
    path.write_text("I_A,tau_min,err_min,tau_error_min\n1,20,1,1\n")
    with pytest.raises(InputError, match="tau_error also in column 'err_min'"):
        read_lifetimes(path)
    path.write_text("beam_current_mA,tau_min\n1,20\n2,0\n3,12\n4,10\n5,9\n")
    with pytest.raises(InputError, match=r":3: column 'tau_min': 0 min; expected above zero"):
        read_lifetimes(path)
    kept = read_lifetimes(path, skip_bad=True)
    assert len(kept) == 4
    assert "1 of 5 rows was left out" in kept.notes[0]
    path.write_text("beam_current_mA,tau_min\n1,20\n2,5\n")
    with pytest.raises(InputError, match="2 lifetimes; expected 4 or more"):
        read_lifetimes(path)


def test_an_hour_that_a_zone_has_twice_is_told_by_order(tmp_path):
    hours = [("01:30", 200.0), ("02:30", 199.0), ("02:30", 198.0), ("03:30", 197.0)]
    rows = [f"2024-10-27 {hour}:00 Europe/Berlin,{current}" for hour, current in hours]
    path = tmp_path / "autumn.csv"
    path.write_text("\n".join(["time,beam_current_mA", *rows]))
    assert read_decay_record(path).time.tolist() == [0.0, 3600.0, 7200.0, 10800.0]
    path.write_text(path.read_text().replace(" Europe/Berlin", ""))
    with pytest.raises(InputError, match=r"02:30:00 after 2024-10-27 02:30:00; .* need their zone"):
        read_decay_record(path)
    assert "line 4, column 'time', time 2024" in read_decay_record(path, skip_bad=True).notes[0]


def test_a_reading_left_out_is_counted_as_it_stands(tmp_path):
    rows = [{"secs": k, "nanos": 0, "val": v} for k, v in enumerate([5.0, 4.0, "NaN", 3.0])]
    path = tmp_path / "channel.json"
    path.write_text(json.dumps([{"meta": {"EGU": "mA"}, "data": rows}]))
    assert "reading 3: 'NaN'" in read_decay_record(path, skip_bad=True).notes[0]
    with pytest.raises(InputError, match=r"'NaN'; .*--skip-bad leaves such rows out"):
        read_decay_record(path)


ROWS = {
    "columns": {"time_s": TIMES, "beam_current_mA": CURRENT},
    "rows": [{"time_s": t, "beam_current_mA": v} for t, v in zip(TIMES, CURRENT, strict=True)],
    "pandas": {
        "time_s": {str(i): t for i, t in enumerate(TIMES)},
        "beam_current_mA": {str(i): v for i, v in enumerate(CURRENT)},
    },
}


@pytest.mark.parametrize("form", ROWS)
def test_json_of_scripts(form, tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(ROWS[form]))
    assert read_decay_record(tmp_path / "a.json").current.tolist() == CURRENT
    assert file_summary(tmp_path / "a.json").kind == "record"


def test_json_of_a_scan_and_of_nothing(tmp_path):
    columns = {"Q_A": [0, 1, 2, 3], "size_x_um": [90.0, 60.0, 95.0, 99.0]}
    columns["size_y_um"] = [None, 70, 80, 90]
    (tmp_path / "a.json").write_text(json.dumps(columns))
    assert len(read_quad_scan(tmp_path / "a.json").rows("y").size) == 3
    assert file_summary(tmp_path / "a.json").kind == "scan"
    for wrong in ({"Q_A": [0, 1], "size_x_um": [1]}, {"Q_A": 1}, [], 3, "text"):
        (tmp_path / "a.json").write_text(json.dumps(wrong))
        with pytest.raises(InputError, match="another JSON file"):
            read_quad_scan(tmp_path / "a.json")


@pytest.mark.parametrize("group", ["", "run/"])
@pytest.mark.parametrize("shape", [(-1,), (-1, 1), (1, -1)])
def test_hdf5_of_columns_in_a_group_and_as_matrices(group, shape, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file[group + "time_s"] = np.reshape(TIMES, shape)
        file[group + "beam_current_mA"] = np.reshape(CURRENT, shape)
    assert read_decay_record(tmp_path / "a.h5").current.tolist() == CURRENT


def test_files_of_other_programs_say_how_to_write_a_table(tmp_path):
    two = [{"meta": {}, "data": []}] * 2
    for name, content, words in (
        ("a.dat", b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "writetable"),
        ("a.json", json.dumps(two).encode(), "a file for each"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=words):
            read_decay_record(tmp_path / name)
