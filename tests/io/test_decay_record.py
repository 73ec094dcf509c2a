import h5py
import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.decay_record import read_decay_record


def write(folder, text, name="run.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_columns_of_the_contract(tmp_path):
    path = write(
        tmp_path,
        "# BPM crate 3\n\ntime_s,beam_current_A,beam_current_error_mA,rf_voltage_kV,scraper_y_mm,"
        "pressure_Pa,bunches\n0,0.5,0.01,3200,6,2e-8,280\n60,0.4999,0.01,3200,6,2e-8,280\n",
    )
    record = read_decay_record(path)
    np.testing.assert_allclose(record.current, [500.0, 499.9])
    assert record.error.tolist() == [0.01, 0.01]
    assert record.conditions.rf_voltage.tolist() == [3.2e6, 3.2e6]
    assert record.conditions.scraper_y[0] == pytest.approx(6e-3)
    assert record.conditions.bunches[0] == 280
    assert record.comments == ("BPM crate 3",)
    assert (record.name, record.start) == ("run.csv", None)


def test_iso_and_unix_time_agree(tmp_path):
    iso = read_decay_record(
        write(
            tmp_path,
            "time,beam_current_mA\n1999-02-11T08:00:00Z,102\n1999-02-11T09:01:00.5+01:00,101\n",
        )
    )
    unix = read_decay_record(
        write(tmp_path, "time_s,beam_current_mA\n918720000,102\n918720060.5,101\n", "unix.csv")
    )
    assert iso.start == unix.start == 918720000.0
    assert iso.time.tolist() == unix.time.tolist() == [0.0, 60.5]


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_separators_and_units_do_not_matter(tmp_path, separator):
    text = "time_s,beam_current_uA,rf_voltage_MV\n0,102e3,3.2\n60,101e3,3.2\n"
    record = read_decay_record(write(tmp_path, text.replace(",", separator)))
    np.testing.assert_allclose(record.current, [102.0, 101.0])
    np.testing.assert_allclose(record.conditions.rf_voltage, 3.2e6)


def test_hdf5_is_the_same_record(tmp_path):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["time"] = ["1999-02-11T08:00:00", "1999-02-11T08:01:00"]
        file["beam_current_mA"] = [102.0, 101.9]
        file["pressure_Pa"] = [1e-7, 1e-7]
        file.attrs["ring"] = "APS"
    record = read_decay_record(path)
    assert record.time.tolist() == [0.0, 60.0]
    assert record.start == 918720000.0
    assert record.conditions.pressure.tolist() == [1e-7, 1e-7]
    assert record.comments == ("ring: APS",)


@pytest.mark.parametrize(
    ("text", "line", "column", "words"),
    [
        ("time_s,beam_current_mA\n0,5\n9,4\n9,3\n", 4, "time_s", "time 9 s after 9 s"),
        ("time_s,beam_current_mA\n0,5\n#\n9,-4\n", 4, "beam_current_mA", "a negative current"),
        ("time_s,beam_current_A\n0,.5\n1,.4\n2,nan\n", 4, "beam_current_A", "nan"),
        ("time_s,beam_current_mA\n0,5\n9,4;3\n", 3, "beam_current_mA", "'4;3'"),
        ("time_s,beam_current_mA\n0,5\n9,\n", 3, "beam_current_mA", "an empty cell"),
        ("time_s,beam_current_mA\n0,5\n9\n", 3, None, "1 cells; expected 2"),
        ("time,beam_current_mA\n12 May,5\n", 2, "time", "expected an ISO 8601 time"),
        ("time_s,beam_curent_mA\n0,5\n", 1, "beam_curent_mA", "did you mean beam_current_mA?"),
        ("time_s,beam_current_mA,beam_current_A\n0,5,5\n", 1, "beam_current_A", "in one unit"),
        ("time_s,time,beam_current_A\n0,5,5\n", 1, "time", "time also in column 'time_s'"),
        ("time_s,bunches\n0,5\n", 1, None, "no column of current"),
        ("time_s,beam_current_mA\n0,500\n1,499\n2,0.498\n3,0.497\n", 4, "beam_current_mA", "1000"),
        ("time_s,beam_current_mA,beam_current_error_mA\n0,5,1\n1,4,0\n", 3, None, "an error of 0"),
        ("time_s,beam_current_mA,pressure_Pa\n0,5,1e-8\n1,4,0\n", 3, "pressure_Pa", "--ignore"),
        ("Timestamp,I\n0,5\n1,4\n", 1, "Timestamp", "--columns 'Timestamp=NAME'"),
        ("time_s,beam_current_mA\n0,5\n", None, None, "1 readings"),
        ("# only words\n", None, None, "no header"),
    ],
)
def test_bad_files_are_named_by_line_and_column(tmp_path, text, line, column, words):
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_decay_record(path)
    error = caught.value
    assert words in str(error)
    assert str(error).startswith(str(path))
    assert error.line == line
    assert column is None or error.column == column


def test_readings_below_zero_that_are_left_out_speak_of_the_monitor(tmp_path):
    """With -0.5 mA without beam a lifetime of 12.02 h was 11.97415 ± 0.00024 h, without a word."""
    time, beam = np.arange(60.0), np.r_[np.linspace(200.0, 190.0, 50), np.zeros(10)]
    rows = "".join(f"{t},{i - 0.5}\n" for t, i in zip(time, beam, strict=True))
    path = write(tmp_path, "time_s,beam_current_mA\n" + rows)
    said = read_decay_record(path, skip_bad=True).notes[0]
    assert said.startswith("10 readings are below zero, -0.5 mA in the middle")
    assert "--offset zero-beam" in said
    for offset in ("zero-beam", None):  # what the monitor reads without beam is its zero
        read = read_decay_record(path, offset=offset)
        assert "offset of the monitor, -0.5 ± 0 mA, which is taken off" in read.notes[0]
        assert read.current.tolist() == pytest.approx(beam[:50])
    single = write(tmp_path, "time_s,beam_current_mA\n0,5\n1,4\n2,-1\n3,3\n", "single.csv")
    assert not any("below zero" in n for n in read_decay_record(single, skip_bad=True).notes)


def test_bad_hdf5_is_named_by_column(tmp_path):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["time_s"] = [0.0, 1.0]
        file["beam_current_mA"] = [5.0, 4.0, 3.0]
    with pytest.raises(InputError, match="3 readings; expected 2, as in 'time_s'"):
        read_decay_record(path)
    with h5py.File(path, "w") as file:
        file["time_s"] = [0.0, 2.0, 1.0]
        file["beam_current_mA"] = [5.0, 4.0, 3.0]
    with pytest.raises(InputError, match="reading 3: time 1 s after 2 s"):
        read_decay_record(path)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"no\.csv"):
        read_decay_record(tmp_path / "no.csv")
    with pytest.raises(InputError, match="an HDF5 file"):
        read_decay_record(write(tmp_path, "time_s", "fake.h5"))


def test_the_aps_figures_are_as_published():
    record = read_decay_record("measurements/aps_1999_decay.csv")
    assert len(record) == 27
    assert (record.time[-1], record.current[-1]) == (31899 - 173, 81.464)
    assert any("prjemian/spec2nexus" in comment for comment in record.comments)
