"""Columns of a record under the names that loggers and archives give them."""

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.check import file_summary
from beamfit.io.decay_record import read_decay_record, read_lifetime_input
from beamfit.lifetime.record import DecayRecord, LifetimeTable

CURRENT = [200.0, 199.5, 199.1, 198.6]


def write(folder, header, *columns):
    rows = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    (folder / "a.csv").write_text("\n".join([header, *rows]) + "\n")
    return folder / "a.csv"


@pytest.mark.parametrize(
    "name",
    [
        "current_mA",
        "I (mA)",
        "Current (A)",
        "DCCT [mA]",
        "SR:DCCT:CURRENT [mA]",
        "stored_current_mA",
        "Beam [mA]",
    ],
)
@pytest.mark.parametrize("time", ["time_s", "t [s]", "Time / s", "Epoch (s)"])
def test_a_current_by_its_word_and_unit(name, time, tmp_path):
    path = write(
        tmp_path, f"{time},{name}", range(4), np.divide(CURRENT, 1e3 if "(A)" in name else 1)
    )
    record = read_decay_record(path)
    np.testing.assert_allclose(record.current, CURRENT)
    assert record.notes == (f"Column '{name}' is taken for the beam current.",)
    assert file_summary(path).kind == "record"


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("time_s,Q2_current_A", "Q2_current_A"),  # in A that of a magnet
        ("time_s,I_set_mA", "I_set_mA"),
        ("time_s,DCCT1_mA,DCCT2_mA", "also in column"),
        ("time_s,beam_current_mA,I_mA", "--ignore leaves it unread"),
        ("timestamp,DCCT_mA", "timestamp"),  # a number of what?
    ],
)
def test_what_could_be_another_current_is_refused(header, words, tmp_path):
    values = [CURRENT] * header.count(",")
    with pytest.raises(InputError, match=words):
        read_decay_record(write(tmp_path, header, range(4), *values))


def test_a_lifetime_beside_the_current_is_not_read(tmp_path):
    path = write(tmp_path, "time_s,beam_current_mA,Lifetime [h]", range(4), CURRENT, [9] * 4)
    assert isinstance(read_lifetime_input(path), DecayRecord)
    record = read_decay_record(path)
    assert record.current.tolist() == CURRENT
    assert "Column 'Lifetime [h]' is not used" in record.notes[0]
    assert "--ignore 'time_s'" in record.notes[0]
    assert isinstance(read_lifetime_input(path, ignore=["time_s"]), LifetimeTable)


def test_a_unit_in_the_header_is_said_once_more(tmp_path):
    path = write(tmp_path, "Zeit,Wert [A]", ["2024-03-01 12:00", "2024-03-01 12:01"], [0.2, 0.1])
    record = read_decay_record(path, columns="Zeit=time, Wert [A]=beam_current_A")
    np.testing.assert_allclose(record.current, [200, 100])


TIMES = {
    "two columns": (
        "Date,Time",
        ["2024-03-01,23:59:58", "2024-03-01,23:59:59", "2024-03-02,0:00:01"],
    ),
    "of the clock": ("time", ["23:59:58", "23:59:59.0", "00:00:01"]),
    "months first": ("time", [f"02/29/2024 12:00:{s:02d}" for s in (0, 1, 3)]),
    "days first": ("time", ["29/02/2024 12:00:00", "29-02-2024 12:00:01", "29.02.2024 12:00:03"]),
    "a short year": ("time", [f"01.03.24 12:00:{s:02d}" for s in (0, 1, 3)]),
    "noon": ("time", ["13/3/2024 11:59:58 AM", "13/3/2024 11:59:59 AM", "13/3/2024 12:00:01 PM"]),
    "the C library": ("timestamp", [f"Fri Mar  1 12:00:{s:02d} 2024" for s in (0, 1, 3)]),
    "summer": ("Datetime", [f"2024-07-01 12:00:{s:02d} CEST" for s in (0, 1, 3)]),
    "nanoseconds": ("time_ns", [f"{1709290800 + s}000000000" for s in (0, 1, 3)]),
    "microseconds": ("time_us", [f"{1709290800 + s}000000" for s in (0, 1, 3)]),
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_of_every_kind(kind, tmp_path):
    header, cells = TIMES[kind]
    record = read_decay_record(write(tmp_path, f"{header},beam_current_mA", cells, CURRENT[:3]))
    np.testing.assert_allclose(record.time, [0, 1, 3], atol=1e-5)


@pytest.mark.parametrize("cell", ["03/01/2024 12:00:00", "3-1-2024 12:00", "25:00:00", "12:61"])
def test_what_may_be_two_days_or_none_is_no_date(cell, tmp_path):
    with pytest.raises(InputError, match=r":2: column 'time'"):
        read_decay_record(write(tmp_path, "time,beam_current_mA", [cell, cell], [2, 1]))


@pytest.mark.parametrize(
    ("header", "times", "currents", "words"),
    [
        ("time", [3792132000, 3792132001], [2, 1], "time_s, time_ms, time_d"),
        ("time", ["03/01/2024 1:00", "03/01/2024 2:00"], [2, 1], "cannot be exchanged"),
        ("time_s", [0, 0], [2, 2], "--skip-bad"),
        ("time_s", [0, 1], [-2, -1], "the other sign"),
    ],
)
def test_a_refusal_says_what_to_do(header, times, currents, words, tmp_path):
    with pytest.raises(InputError, match=words):
        read_decay_record(write(tmp_path, f"{header},beam_current_mA", times, currents))
