"""Tables as control rooms export them: each is read as meant, or one line says what to do."""

import pytest

from beamfit.errors import InputError
from beamfit.io.cells import BLANK
from beamfit.io.check import file_summary
from beamfit.io.decay_record import read_decay_record
from beamfit.io.scan import read_quad_scan

Q, X = [-4.0, -3.0, -1.0, 0.0], [1115.5, 600.25, 104.0, 2180.0]
COMMAS = ["-4,0;1.115,5", "-3,0;600,25", "-1,0;104,0", "0,0;2.180,0"]
POINTS = [f"{q},{x}" for q, x in zip(Q, X, strict=True)]
# Header and rows of one scan, as laboratories write it.
SCANS = {
    "Elettra": ("Q1 [A];size x [um]", COMMAS),
    "PSI": ("Q1 [A];size x [µm]", [row.replace(".", "'") for row in COMMAS]),
    "DESY": ("Q1_A;sigma_x [µm]", [row.replace(".", "\u202f") for row in COMMAS]),
    "SOLEIL": ("Q1 (A);rms x (µm)", [row.replace(".", "\xa0") for row in COMMAS]),
    "thousands": (
        "Q1_A,size_x_um",
        [f'{q},"{x:,.2f}"'.replace("-", "−") for q, x in zip(Q, X, strict=True)],
    ),
    "Fortran": (
        "No. Q1_A size_x_um",
        [f"{i} {q:E} {x:.4E}".replace("E", "D") for i, (q, x) in enumerate(zip(Q, X, strict=True))],
    ),
    "index": ("index,Q1_A,size_x_um", [f"{i},{row}" for i, row in enumerate(POINTS)]),
    "elapsed": ("time_s,Q1_A,size_x_um", [f"{10 * i},{row}" for i, row in enumerate(POINTS)]),
    "dates": ("time,Q1_A,size_x_um", [f"01.03.2024 12:0{i},{r}" for i, r in enumerate(POINTS)]),
    "put together": ("Q1_A,size_x_um", [*POINTS[:2], "Q1_A,size_x_um", *POINTS[2:]]),
    "ISO 80000": ("Q1/A,size_x/um", POINTS),
    "in words": ("Q1 in A,size x in µm", POINTS),
    "with commas": ('"Q1, A","size x, um"', POINTS),
    "unit twice": ("Q1_A [A],size_x_um [um]", POINTS),
}


def written(path, header, rows):
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize("style", SCANS)
def test_one_scan_in_every_style(style, tmp_path):
    scan = read_quad_scan(written(tmp_path / "a.csv", *SCANS[style]))
    assert (scan.units, scan.settings["Q1"].tolist()) == ({"Q1": "A"}, Q)
    assert scan.size["x"].tolist() == pytest.approx([1e-6 * x for x in X], rel=1e-12)


@pytest.mark.parametrize("blank", sorted(BLANK))
def test_every_way_to_say_that_there_is_no_number(blank, tmp_path):
    rows = [f"{row},{7 * row.count('1')}" for row in ["-4,11", "-3,21", "-2,31"]]
    path = written(tmp_path / "a.csv", "Q1_A,size_x_um,size_y_um", [*rows, f"0,{blank.upper()},9"])
    scan = read_quad_scan(path)
    assert (len(scan.rows("x").size), len(scan.rows("y").size)) == (3, 4)


# What nobody can read without a guess, and the words that say what to do.
REFUSED = {
    "thousands or decimals": ("Q1_A;size_x_um", ["-4;1,115", "-3;600", "0;2"], ":2: .*decimal poi"),
    "errors behind": ("Q1_A,size_x_um", ["-4,11 ± 2", "-3,9 +- 1"], ":2: .*a column of its own"),
    "two tables": ("Q1_A,size_x_um", [*POINTS, "Q1_A,size_y_um", *POINTS], ":6: a second header"),
    "a summary": ("Q1_A,size_x_um", [*POINTS, "4 points"], ":6: 1 cells; .*--skip-bad"),
    "other separators": ("Q1_A;size_x_um", POINTS, ":2: 1 cells; expected 2, .*with semicolons"),
    "no unit": ("Q1_A,size_x", POINTS, ":1: column 'size_x': a size without a unit"),
    "on its side": ("I_A,-4,-3,-1", ["size_x_um,11,6,10"], ":1: a table on its side"),
    "shots in a row": (
        "Q1_A,size_x_um,size_x_um",
        ["0,1,2"],
        "size_x twice or more under one name.* each shot",
    ),
    "another unit below": ("Q1_A,size_x_um", ["A,mm", "0,1"], ":2: column 'size_x_um': 'mm' below"),
    "planes in rows": ("plane,Q1_A,size_um", ["x,0,1", "y,0,1"], "a column for each plane"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_could_mean_two_things_says_what_to_do(case, tmp_path):
    header, rows, words = REFUSED[case]
    with pytest.raises(InputError, match=words) as error:
        read_quad_scan(written(tmp_path / "a.csv", header, rows))
    assert "leaves this one unread" not in str(error.value)


def test_of_a_setting_and_its_reading_one_is_left_out(tmp_path):
    rows = [f"{q},{q + 0.01:.2f},{x}" for q, x in zip(Q, X, strict=True)]
    path = written(tmp_path / "a.csv", "Q1_set_A,Q1_rb_A,size_x_um", rows)
    with pytest.raises(InputError, match="--ignore 'Q1_rb_A' leaves this one unread"):
        read_quad_scan(path)
    assert read_quad_scan(path, ignore=["*_rb_A"]).settings["Q1"].tolist() == Q


DAY = "01.03.2024"
# Header and rows of one record: three readings, a minute apart.
RECORDS = {
    "a German clock": ("Time;I [mA]", [f"{DAY} 12:0{k}:00;{200 - k},5" for k in range(3)]),
    "a French one": ("Date;Time;I (mA)", [f"{DAY};12:0{k};{200 - k},5" for k in range(3)]),
    "Italian": ("t [s];current [mA]", [f"{60 * k},0;{200 - k},5" for k in range(3)]),
    "the epoch": ("epoch,current_mA", [f"{1709294400 + 60 * k},{200.5 - k}" for k in range(3)]),
    "a zone": ("Time (UTC),I [mA]", [f"2024-03-01 12:0{k}Z,{200.5 - k}" for k in range(3)]),
    "an index": ("No,time_s,beam_current_mA", [f"{k},{60 * k},{200.5 - k}" for k in range(3)]),
    "units below": ("Time\tCurrent", ["[s]\t[mA]", *[f"{60 * k}\t{200.5 - k}" for k in range(3)]]),
    "units behind": ("time_s;current_mA", [f"{60 * k} s;{200.5 - k} mA" for k in range(3)]),
}


WORDS = ["Zeit;Strom [mA]", "Heure;Courant (mA)", "Tempo [s];Corrente [mA]"]


@pytest.mark.parametrize("header", WORDS)
def test_words_of_other_languages_are_said_by_columns(header, tmp_path):
    rows = [f"{DAY} 12:0{k}:00;{200 - k},5" for k in range(3)]
    if "[s]" in header:
        rows = [f"{60 * k};{200 - k},5" for k in range(3)]
    path = written(tmp_path / "a.csv", header, rows)
    with pytest.raises(InputError, match="--columns"):
        read_decay_record(path)
    time, current = header.split(";")
    names = {time: "time_s" if "[s]" in header else "time", current: "beam_current_mA"}
    assert read_decay_record(path, columns=names).current.tolist() == [200.5, 199.5, 198.5]


@pytest.mark.parametrize("style", RECORDS)
def test_one_record_in_every_style(style, tmp_path):
    path = written(tmp_path / "a.csv", *RECORDS[style])
    record = read_decay_record(path)
    assert (record.time - record.time[0]).tolist() == [0, 60, 120]
    assert record.current.tolist() == [200.5, 199.5, 198.5]
    assert file_summary(path).kind == "record"
