"""Inputs that contradict themselves, or mean something else than what is asked for."""

import h5py
import numpy as np
import pytest

import beamfit
from beamfit.errors import InputError
from beamfit.lifetime.lifetime_table import fit_lifetimes

SETTINGS, SIZES = {"Q": [0.0, 1.0, 2.0]}, {"x": [2e-4, 1e-4, 3e-4]}


@pytest.fixture
def store(tmp_path):
    def to_file(**columns):
        path = tmp_path / "scan.h5"
        with h5py.File(path, "w") as file:
            for name, (values, attributes) in columns.items():
                file.create_dataset(name, data=values).attrs.update(attributes)
        return path

    return to_file


def scan_with(attributes, name="size_x_um"):
    return {"Q2": ([0.0, 1.0, 2.0], {"units": "A"}), name: ([200.0, 120.0, 180.0], attributes)}


@pytest.mark.parametrize(
    ("name", "attributes"),
    [
        ("size_x_um", {}),
        ("size_x_um", {"units": "um"}),
        ("size_x_um", {"units": "µm", "scale_factor": 1.0, "add_offset": 0}),
        ("size_x", {"units": "micron"}),
        ("size_x", {"unit": b"um"}),
        ("size_x_um", {"units": ""}),
    ],
)
def test_units_of_datasets_are_those_of_their_attributes(name, attributes, store):
    scan = beamfit.read_quad_scan(store(**scan_with(attributes, name)))
    assert scan.units == {"Q2": "A"}
    np.testing.assert_allclose(scan.size["x"], [2e-4, 1.2e-4, 1.8e-4])


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"units": "mm"}, "units = 'mm'"),
        ({"units": "furlong"}, "units = 'furlong'"),
        ({"scale_factor": 1e-3}, "scale_factor = 0.001"),
        ({"add_offset": 5.0}, "add_offset = 5.0"),
    ],
)
def test_attributes_that_contradict_the_name_are_refused(attributes, said, store):
    with pytest.raises(InputError, match="column 'size_x_um'") as raised:
        beamfit.read_quad_scan(store(**scan_with(attributes)))
    assert said in str(raised.value)


def record_of(tmp_path, header, rows="0,200\n1,199\n2,198\n"):
    path = tmp_path / "record.csv"
    path.write_text(f"{header}\n{rows}")
    return beamfit.read_decay_record(path)


BEAM = ["I", "current", "Beam current", "DCCT", "SR:DCCT", "SR-DI-DCCT-01:SIGNAL", "ring current",
        "storage ring current", "total current", "beam", "stored current"]  # fmt: skip
OTHER = ["bunch current", "pump current", "ion pump current", "log current", "injected current",
         "magnet current", "I_A", "gun current", "log(I)", "bunch DCCT"]  # fmt: skip


@pytest.mark.parametrize("name", BEAM)
def test_a_beam_current_is_taken_by_its_name(name, tmp_path):
    assert record_of(tmp_path, f"time_s,{name} [mA]").current.tolist() == [200.0, 199.0, 198.0]


@pytest.mark.parametrize("name", OTHER)
def test_another_current_is_not_taken_for_the_beam(name, tmp_path):
    with pytest.raises(InputError, match="unknown column"):
        record_of(tmp_path, f"time_s,{name} [mA]")


def test_a_current_that_no_ring_has_stored(tmp_path):
    """Microampere under _A: 2e11 mA was a converged record."""
    with pytest.raises(InputError, match=r"record.csv:2: column 'beam_current_A'.*mA or µA"):
        record_of(tmp_path, "time_s,beam_current_A", "0,2e8\n1,1.9e8\n2,1.8e8\n")
    with pytest.raises(InputError, match="more than any ring has stored"):
        beamfit.DecayRecord([0, 1, 2], [2e8, 1.9e8, 1.8e8])


def test_midnight_may_be_the_start_of_a_clock_in_minutes(tmp_path):
    with pytest.raises(InputError, match="hours and minutes, or minutes and seconds"):
        record_of(tmp_path, "time,beam_current_mA", "00:00,200\n00:01,199\n00:02,198\n")
    whole = record_of(tmp_path, "time,beam_current_mA", "00:00:00,9\n00:01:00,8\n00:02:00,7\n")
    noon = record_of(tmp_path, "time,beam_current_mA", "12:00,9\n12:01,8\n12:02,7\n")
    assert whole.span == noon.span == 120.0


def write_scan(tmp_path, header, cell):
    path = tmp_path / "scan.csv"
    path.write_text(f"Q_A,size_x_um,{header}\n" + "".join(f"{i},10{i},{cell}\n" for i in range(4)))
    return path


@pytest.mark.parametrize(
    "digits", ["x" + "f" * 5000, "x" + "7" * 300, "o" + "7" * 5000, "b" + "1" * 5000]
)
@pytest.mark.parametrize("key", ["energy_MeV", "k1_per_m2"])
def test_integers_without_end_have_their_line(key, digits, root, tmp_path):
    text = (root / "lattices/lcls_otr2.toml").read_text().replace("energy_MeV = 135.0", "")
    path = tmp_path / "line.toml"
    path.write_text(f"# a line\n{key} = 0{digits}\n{text}")
    with pytest.raises(
        InputError, match=rf"line\.toml:2: .*an integer of {len(digits) - 1} digits"
    ):
        beamfit.load_lattice(path)


@pytest.mark.parametrize("cell", ["1_00", "1_0.5", "100_"])
def test_underscores_are_no_digits(cell, tmp_path):
    path = tmp_path / "scan.csv"
    path.write_text(f"Q_A,size_x_um\n0,{cell}\n1,200\n2,300\n")
    with pytest.raises(InputError, match=rf"scan\.csv:2: .*'{cell}'; expected a number"):
        beamfit.read_quad_scan(path)


@pytest.mark.parametrize("name", ["xy_um2", "cov_xy", "<xy>", "rho_xy", "tilt_deg", "size_xy_um"])
def test_coupled_beams_are_refused_as_such(name, tmp_path):
    path = write_scan(tmp_path, name, 3)
    with pytest.raises(InputError, match="coupled beams are not fitted"):
        beamfit.read_quad_scan(path)
    assert len(beamfit.read_quad_scan(path, ignore=[name])) == 4


WRONG = {
    "T/m": (lambda: beamfit.QuadScan(SETTINGS, {"Q": "T/m"}, SIZES), "did you mean T_per_m"),
    "Amp": (lambda: beamfit.QuadScan(SETTINGS, {"Q": "Amp"}, SIZES), "did you mean A"),
    "no unit": (lambda: beamfit.QuadScan(SETTINGS, {}, SIZES), "no unit for 'Q'"),
    "one unit": (lambda: beamfit.QuadScan(SETTINGS, "A", SIZES), "a str, 'A'"),
    "a list of sizes": (lambda: beamfit.QuadScan(SETTINGS, {"Q": "A"}, [1, 2, 3]), "a list"),
    "words": (lambda: beamfit.QuadScan(SETTINGS, {"Q": "A"}, {"x": "abc"}), "column 'x'"),
    "a number": (lambda: beamfit.QuadScan(SETTINGS, {"Q": "A"}, {"x": 2e-4}), "column 'x'"),
    "one screen": (
        lambda: beamfit.QuadScan(SETTINGS, {"Q": "A"}, SIZES, screen="OTR"),
        "a name for each row",
    ),
    "an energy's kind": (
        lambda: beamfit.QuadScan(SETTINGS, {"Q": "A"}, SIZES, energy=9.0, energy_kind="T"),
        "energy_kind 'T'",
    ),
    "a number for a scan": (lambda: beamfit.fit_emittance(5), "beamfit.read_quad_scan(path)"),
    "a number for a record": (lambda: beamfit.fit_decay(5), "beamfit.read_decay_record(path)"),
    "a number to cut": (lambda: beamfit.split_record(5), "a DecayRecord"),
    "no file of a scan": (lambda: beamfit.fit_emittance("a.csv"), "a.csv: no such file"),
    "no file of a record": (lambda: beamfit.fit_decay("a.csv"), "a.csv: no such file"),
    "a path of lifetimes": (lambda: fit_lifetimes("a.csv"), "a LifetimeTable"),
    "a number for a path": (lambda: beamfit.read_quad_scan(5), "an int; expected a path"),
    "nothing for a path": (lambda: beamfit.read_decay_record(None), "a NoneType"),
    "a number for a lattice": (lambda: beamfit.load_lattice(5), "an int"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_types_are_told_as_such(case):
    call, said = WRONG[case]
    with pytest.raises(InputError) as raised:
        call()
    assert said in str(raised.value)


def test_a_plane_that_was_not_fitted(root):
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    line = beamfit.load_lattice(root / "lattices/lcls_otr2.toml")
    with pytest.raises(InputError, match="an int; expected a Beamline"):
        beamfit.fit_emittance(scan, 5)
    fit = beamfit.fit_emittance(scan, line, planes=("x",))
    with pytest.raises(InputError, match="no fit of plane 'y'; expected x"):
        _ = fit.y
