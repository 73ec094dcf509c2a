"""One scan and one record as programs export them: read right with at most one --columns.

Then the same tables in thousands of other spellings: every number is right, refused or asked about.
"""

import csv
import io
import json
import random

import h5py
import numpy as np
import pytest
import scipy.io

from beamfit.errors import InputError
from beamfit.io.decay_record import read_decay_record
from beamfit.io.scan import read_quad_scan
from tests.io.forked import in_forks  # noqa: F401
from tests.simulations import simulations

pandas = pytest.importorskip("pandas")

# kG; rms sizes and their standard errors, µm.
SCAN = {
    "quad": [-4.25, -3.5, -2.75, -2.0, -1.25],
    "x": [112.5, 71.25, 53.5, 66.75, 101.0],
    "dx": [1.125, 0.75, 0.625, 0.5, 1.25],
    "y": [63.25, 57.5, 74.75, 96.0, 158.5],
    "dy": [0.75, 0.5, 1.0, 0.875, 2.5],
}
# Seconds from 2024-03-01 12:00:00 UTC, and mA.
START, STEP = 1709294400, 60
CURRENT = [201.5, 200.75, 200.0, 199.25, 198.5, 197.75]


def table(columns, separator=",", convert=str, end="\n"):
    rows = [list(columns), *zip(*columns.values(), strict=True)]
    return end.join(separator.join(convert(cell) for cell in row) for row in rows) + end


def named():
    return dict(zip(NAMES, SCAN.values(), strict=True))


def comma(cell):
    return str(cell).replace(".", ",")


def scan_frame(*names):
    return pandas.DataFrame(dict(zip(names, SCAN.values(), strict=True)))


def gui(path):
    """A measuring program's own: a title, a row of units, tabs."""
    names = "Q525\tx_rms\tx_rms_err\ty_rms\ty_rms_err\nkG\tum\tum\tum\tum\n"
    rows = ["\t".join(map(str, row)) for row in zip(*SCAN.values(), strict=True)]
    path.write_text("Emittance measurement\nOperator: NN, 1 March 2024\n\n" + names
                    + "\n".join(rows) + "\n")  # fmt: skip


def numpy_text(path):
    data = np.array([*SCAN.values()]).T
    np.savetxt(path, data, header="quad_kG xrms_um xerr yrms_um yerr")


def store(path):
    with h5py.File(path, "w") as file:
        for name, values in zip(
            ("Q525", "sx", "sx_std", "sy", "sy_std"), SCAN.values(), strict=True
        ):
            unit = "kG" if name == "Q525" else "um"
            file.create_dataset(name, data=values).attrs["units"] = unit


def mat(path):
    names = ("quad", "sigx", "sigxerr", "sigy", "sigyerr")
    values = (np.array(v)[:, None] for v in SCAN.values())
    scipy.io.savemat(path, dict(zip(names, values, strict=True)))


PLAIN = "quad=Q525_kG, xrms=size_x_um, dx=size_x_error_um, yrms=size_y_um, dy=size_y_error_um"
NAMES = ("quad", "xrms", "dx", "yrms", "dy")
PV = ("QUAD:IN20:525:BACT (kG)", "OTRS:IN20:571:XRMS (um)", "OTRS:IN20:571:XRMS_ERR (um)",
      "OTRS:IN20:571:YRMS (um)", "OTRS:IN20:571:YRMS_ERR (um)")  # fmt: skip
PANDAS = ("Q525_kG", "sigma_x_mm", "sigma_x_err_mm", "sigma_y_mm", "sigma_y_err_mm")
SCANS = {
    "pandas, with its index": ("a.csv", lambda p: scan_frame(*NAMES).to_csv(p), PLAIN),
    "pandas, as JSON": ("a.json", lambda p: scan_frame(*NAMES).to_json(p), PLAIN),
    "pandas, JSON by rows": (
        "a.json",
        lambda p: scan_frame(*NAMES).to_json(p, orient="records", indent=1),
        PLAIN,
    ),
    "millimetres": (
        "a.csv",
        lambda p: (scan_frame(*PANDAS) * [1, *[1e-3] * 4]).to_csv(p, index=False),
        None,
    ),
    "MATLAB's writetable": ("a.csv", lambda p: p.write_text(table(named(), end="\r\n")), PLAIN),
    "MATLAB's vectors": (
        "a.mat",
        mat,
        "quad=Q525_kG, sigx=size_x_um, sigxerr=size_x_error_um, sigy=size_y_um, "
        "sigyerr=size_y_error_um",
    ),
    "HDF5 with units": (
        "a.h5",
        store,
        "sx=size_x_um, sx_std=size_x_error_um, sy=size_y_um, sy_std=size_y_error_um",
    ),
    "a German spreadsheet": (
        "a.csv",
        lambda p: p.write_bytes(b"\xef\xbb\xbf" + table(named(), ";", comma).encode()),
        PLAIN,
    ),
    "Unicode text of a spreadsheet": (
        "a.txt",
        lambda p: p.write_text(table(named(), "\t"), "utf-16"),
        PLAIN,
    ),
    "a measuring program": ("a.txt", gui, None),
    "numpy's savetxt": (
        "a.txt",
        numpy_text,
        "quad_kG=Q525_kG, xerr=size_x_error_um, yerr=size_y_error_um",
    ),
    "names of channels": (
        "a.csv",
        lambda p: scan_frame(*PV).to_csv(p, index=False),
        "QUAD:IN20:525:BACT (kG)=Q525_kG",
    ),
}  # fmt: skip


def particles(path, name):
    """Beams as openPMD-beamphysics stores them: a group each, what is the same for all beside."""
    with h5py.File(path, "w") as file:
        file.attrs.update({"openPMD": "2.0.0", "openPMDextension": "BeamPhysics;SpeciesType"})
        for i, (quad, x, y) in enumerate(zip(SCAN["quad"], SCAN["x"], SCAN["y"], strict=True)):
            beam = file.create_group(f"screen/{i}/electron")
            file[f"screen/{i}"].attrs.update({"Q525_kG": quad} if name is None else {})
            beam.attrs.update({} if name is None else {"latticeElementName": f"{name}{i}"})
            for key, numbers, unit in (
                ("position/x", [-1e-6 * x, 1e-6 * x, 5.0], 1.0),
                ("position/y", [1.0 + 1e-6 * y, 1.0 - 1e-6 * y, 9.0], 1.0),
                ("momentum/z", [135e6] * 3, 1.602176634e-19 / 299792458),
                ("weight", [2e-15, 2e-15, 0.0], 1.0),
            ):
                beam.create_dataset(key, data=numbers).attrs["unitSI"] = unit
            for key in ("momentum/x", "momentum/y"):
                beam.create_group(key).attrs.update({"value": 0.0, "shape": [3], "unitSI": 1.0})


def test_beams_of_openpmd_beamphysics(tmp_path):
    particles(tmp_path / "a.h5", None)
    scan = read_quad_scan(tmp_path / "a.h5")
    assert (scan.settings["Q525"].tolist(), scan.energy_kind) == (SCAN["quad"], "momentum")
    np.testing.assert_allclose(scan.energy, 135.0, rtol=1e-9)
    particles(tmp_path / "b.h5", "OTR")
    assert read_quad_scan(tmp_path / "b.h5").screen == tuple(f"OTR{i}" for i in range(5))
    for plane in "xy":
        np.testing.assert_allclose(1e6 * scan.size[plane], SCAN[plane], rtol=1e-9)


def planes(names):
    """Each plane with settings of its own, in m."""
    lists = {"x": slice(None), "y": slice(1, 4)}
    return {
        name.format(p): [factor * v for v in SCAN[key.format(p)][lists[p]]]
        for name, key, factor in names
        for p in "xy"
    }


def test_the_planes_of_pyemittance_have_settings_of_their_own(tmp_path):
    names = [
        ("quadvals{}", "quad", 1),
        ("beamsizes{}", "{}", 1e-6),
        ("beamsizeserr{}", "d{}", 1e-6),
    ]
    content = {"nemitx": 4.8e-08, "total_points_measured": None} | planes(names)
    (tmp_path / "a.json").write_text(json.dumps(content))
    scan = read_quad_scan(tmp_path / "a.json", columns="quadvals=Q525_kG")
    for plane, part in (("x", slice(None)), ("y", slice(1, 4))):
        rows = scan.rows(plane)
        np.testing.assert_allclose(rows.settings["Q525"], SCAN["quad"][part])
        np.testing.assert_allclose(1e6 * rows.size, SCAN[plane][part])
        np.testing.assert_allclose(1e6 * rows.error, SCAN[f"d{plane}"][part])
    with pytest.raises(InputError, match="--columns 'quadvals=NAME'"):
        read_quad_scan(tmp_path / "a.json")


@pytest.mark.parametrize("by_number", [False, True])
def test_the_result_of_lcls_tools(by_number, tmp_path):
    lists = [("quadrupole_pv_values", "quad", 1), ("rms_beamsizes", "{}", 1e-6)]
    content = {
        name: [[factor * v for v in SCAN[key.format(p)]] for p in "xy"]
        for name, key, factor in lists
    }
    if by_number:
        content = {k: {str(i): part for i, part in enumerate(v)} for k, v in content.items()}
    (tmp_path / "a.json").write_text(json.dumps(content | {"emittance": [1.0, 2.0], "info": {}}))
    scan = read_quad_scan(tmp_path / "a.json", columns="quadrupole_pv_values=Q525_kG")
    for plane in "xy":
        np.testing.assert_allclose(1e6 * scan.rows(plane).size, SCAN[plane])
    (tmp_path / "b.json").write_text(json.dumps(content | {"rms_beamsizes": 3}))
    with pytest.raises(InputError, match="another JSON file"):
        read_quad_scan(tmp_path / "b.json", columns="quadrupole_pv_values=Q525_kG")


@pytest.mark.parametrize("export", SCANS)
def test_one_scan_as_programs_export_it(export, tmp_path):
    name, write, columns = SCANS[export]
    write(tmp_path / name)
    check_scan(read_quad_scan(tmp_path / name, columns=columns))


def check_scan(scan):
    assert scan.units == {"Q525": "kG"}
    np.testing.assert_allclose(scan.settings["Q525"], SCAN["quad"], rtol=1e-12)
    for plane in "xy":
        np.testing.assert_allclose(1e6 * scan.size[plane], SCAN[plane], rtol=1e-12)
        np.testing.assert_allclose(1e6 * scan.error[plane], SCAN[f"d{plane}"], rtol=1e-12)


def clocks(form):
    moments = pandas.to_datetime([START + STEP * k for k in range(len(CURRENT))], unit="s")
    return moments.strftime(form)


def lines(form, *columns, head=""):
    return head + "".join(form.format(*row) + "\n" for row in zip(*columns, strict=True))


def archiver(path):
    data = [{"secs": START + STEP * k, "nanos": 0, "val": v, "severity": 0, "status": 0}
            for k, v in enumerate(CURRENT)]  # fmt: skip
    path.write_text(json.dumps([{"meta": {"name": "SR:DCCT", "EGU": "mA"}, "data": data}]))


def frame_record(path, **options):
    index = pandas.to_datetime(clocks("%Y-%m-%d %H:%M:%S"))
    pandas.DataFrame({"dcct": CURRENT}, index=index).to_csv(path, **options)


def record_store(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("t", data=START + STEP * np.arange(len(CURRENT))).attrs["units"] = "s"
        file.create_dataset("dcct", data=CURRENT).attrs["units"] = "mA"


SECONDS = [START + STEP * k for k in range(len(CURRENT))]
ISO, US = clocks("%Y-%m-%d %H:%M:%S"), clocks("%m/%d/%Y %I:%M:%S %p")
RECORDS = {
    "EPICS archiver, CSV": (lines("{},{},0,0,0", SECONDS, CURRENT), "val=beam_current_mA"),
    "EPICS archiver, JSON": (archiver, None),
    "Phoebus": (lines("{}.000000000\t{}", clocks("%Y/%m/%d %H:%M:%S"), CURRENT, head=(
        "# Created by the Data Browser\n# Version 4\n#\n# Time\tSR:DCCT [mA]\n")), None),
    "camonitor": (lines("SR:DCCT                        {}.000000 {}  ", ISO, CURRENT),
                  "camonitor, value=beam_current_mA"),
    "caget -a": (lines("SR:DCCT  {}.000000 {} NO_ALARM NO_ALARM", ISO, CURRENT),
                 "camonitor, value=beam_current_mA"),
    "caget in a loop": (lines("{}+00:00 SR:DCCT {}", clocks("%Y-%m-%dT%H:%M:%S"), CURRENT),
                        "caget, value=beam_current_mA"),
    "Grafana": (lines('"{}","{} mA"', ISO, CURRENT, head='"Time","SR:DCCT"\n'),
                "SR:DCCT=beam_current_mA"),
    "Grafana, milliseconds": (lines("{}000,{}", SECONDS, CURRENT, head="Time,SR:DCCT\n"),
                              "Time=time_ms, SR:DCCT=beam_current_mA"),
    "Timber": (lines("{}.000,{}", ISO, CURRENT,
                     head="VARIABLE: DCCT\nTimestamp (UTC_TIME),Value\n"),
               "timber, Value=beam_current_mA"),
    "HDB++": (lines("{},{},0", ISO, CURRENT, head="data_time,value_r,quality\n"),
              "hdb, value_r=beam_current_mA"),
    "bluesky": (lines("{},{}.0,{}", range(6), SECONDS, CURRENT, head="seq_num,time,dcct\n"),
                "bluesky, dcct=beam_current_mA"),
    "InfluxDB": (lines(",result,0,{}Z,{}", clocks("%Y-%m-%dT%H:%M:%S"), CURRENT,
                       head=",result,table,_time,_value\n"), "_time=time, _value=beam_current_mA"),
    "pandas": (lambda p: frame_record(p, index_label="when"), "when=time, dcct=beam_current_mA"),
    "pandas, as JSON": (lambda p: p.write_text(json.dumps({"t": SECONDS, "I": CURRENT})),
                        "t=time_s, I=beam_current_mA"),
    "MATLAB's datestr": (lines("{},{}", clocks("%d-%b-%Y %H:%M:%S"), CURRENT,
                                head="Date,I_mA\n"), None),
    "an American spreadsheet": (lines("{},{}", US, CURRENT, head="Date,DCCT (mA)\n"),
                                "month-day-year"),
    "a German spreadsheet": (lines("{};{}", clocks("%d.%m.%Y %H:%M:%S"), map(comma, CURRENT),
                                   head="Zeit;Strom\n"), "Zeit=time, Strom=beam_current_mA"),
    "a logger": (lines("{},{}", ISO, CURRENT, head="Date/Time,Beam Current (mA)\n"), None),
    "two columns for a moment": (lines("{},{},{}", clocks("%Y-%m-%d"), clocks("%H:%M:%S"), CURRENT,
                                       head="Date,Time,Beam current [mA]\n"), None),
    "ampere": (lines("{},{}", SECONDS, [1e-3 * v for v in CURRENT], head="epoch,DCCT [A]\n"), None),
    "HDF5 with units": (record_store, None),
    "newest first": (lines("{},{}", ISO[::-1], CURRENT[::-1], head="Timestamp,DCCT [mA]\n"), None),
}  # fmt: skip
ENDS = {"JSON": ".json", "HDF5": ".h5"}


@pytest.mark.parametrize("export", RECORDS)
def test_one_record_as_programs_export_it(export, tmp_path):
    content, columns = RECORDS[export]
    path = tmp_path / ("a" + next((end for word, end in ENDS.items() if word in export), ".csv"))
    content(path) if callable(content) else path.write_text(content)
    record = read_decay_record(path, columns=columns)
    np.testing.assert_allclose(record.current, CURRENT, rtol=1e-12)
    np.testing.assert_allclose(record.time, STEP * np.arange(len(CURRENT)), atol=1e-6)
    assert record.start == pytest.approx(START, abs=1e-3)


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("time_d", 739312.5, "MATLAB"),  # days from the year 0
        ("time_d", 45352.5, "Excel"),  # days from 1899
        ("time_d", 2460371.0, "^(?!.*time_ms).*Julian"),  # days from 4713 BC
        ("time_d", 1.7e12, "time_d=time_ms"),
        ("time_s", 3792139200, "LabVIEW"),  # seconds from 1904
        ("time_s", 1709294400000, "time_s=time_ms"),
    ],
)
def test_times_from_another_origin_are_no_dates(column, value, words, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        f"{column},beam_current_mA\n" + "".join(f"{value + k},{200 - k}\n" for k in range(3))
    )
    with pytest.raises(InputError, match=words):
        read_decay_record(path)


# Spellings of the tables: usual units and words, and others that nobody can be sure of.
LENGTHS = {"um": 1.0, "µm": 1.0, "mm": 1e-3, "m": 1e-6, "nm": 1e3, "microns": 1.0}
SETTINGS = {"kG": 1.0, "KG": 1.0, "A": 1.0}
ODD = {"pixels": 0.7, "T": 0.1, "G": 1e3, "mA": 1e3, "": 1.0, "inch": 3.9e-5}
MARKS = ("{}_{}", "{} [{}]", "{} ({})", "{}/{}", "{} in {}", "{} {}", "{}, {}", "{}-{}")
WORDS = {
    "x": ("size_x", "sigma_x", "xrms", "x_rms", "sig x", "SIZE_X", "size x", "sigmax", "σ_x"),
    "dx": ("size_x_error", "sigma_x_err", "xrms_err", "size_x_std", "sigmax_err", "delta_size_x"),
    "quad": ("Q525", "QUAD:525:BACT", "Q525 setpoint", "quad", "Q525_current"),
}
OTHER = ("width", "err", "dx", "x", "error of x", "sigma_sx", "current", "w", "spot")
AROUND = ("# a comment\n", "Title\n\n", "\ufeff", "sizes in mm\n", "# units: kG, um\n", "x,y\n")


def spelling(rng):
    """A table in some spelling, and whether a character of it was changed."""
    separator, decimal = rng.choice([(",", "."), (";", "."), ("\t", "."), (";", ","), ("\t", ",")])
    columns, bracket = {}, rng.choice(MARKS)
    for name in rng.sample(["quad", "x", "dx"], 3):
        usual = SETTINGS if name == "quad" else LENGTHS
        unit, factor = rng.choice([*(ODD if rng.random() < 0.05 else usual).items()])
        word = rng.choice(OTHER if rng.random() < 0.05 else WORDS[name])
        values = [f"{v * factor:.9g}".replace(".", decimal) for v in SCAN[name]]
        columns[bracket.format(word, unit)] = values
    if rng.random() < 0.2:
        columns[rng.choice(["n", "note_1", "time", "shot", "Unnamed: 0", "y"])] = list("12345")
    out = io.StringIO()
    style = csv.QUOTE_ALL if rng.random() < 0.2 else csv.QUOTE_MINIMAL
    writer = csv.writer(out, delimiter=separator, quoting=style, lineterminator="\n")
    writer.writerows([list(columns), *zip(*columns.values(), strict=True)])
    text, changed = out.getvalue(), rng.random() < 0.3
    if changed:
        at = rng.randrange(text.index("\n"), len(text))
        text = text[:at] + rng.choice(["", *' ,.e-"\n;_u0']) + text[at + 1 :]
    return (rng.choice(AROUND) if rng.random() < 0.2 else "") + text, changed


@simulations(1000, 6000)
def test_every_number_of_a_mutated_table_is_right_refused_or_asked(tmp_path, count):
    rng, path = random.Random(20261123), tmp_path / "a.csv"
    read = 0
    for _ in range(count):
        text, changed = spelling(rng)
        path.write_text(text, encoding="utf-8")
        try:
            scan = read_quad_scan(path)
        except InputError:
            continue
        read += 1
        if any(note.endswith("?") for note in scan.notes):
            continue
        [settings] = scan.settings.values()
        assert list(scan.size) == ["x"], text
        numbers = {"quad": settings, "x": 1e6 * scan.size["x"]}
        numbers |= {f"d{p}": 1e6 * values for p, values in scan.error.items()}
        for name, values in numbers.items():
            assert len(values) == len(SCAN[name]) or changed, text
            apart = [v for v in values if not np.isclose(v, SCAN[name], rtol=1e-6).any()]
            assert len(apart) <= changed, text  # the one number whose digits were changed
    assert read > count / 3
