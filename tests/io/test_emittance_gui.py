"""Files of SLAC's emittance_gui: a real one where it lies beside the checkout, and made ones."""

import json
import struct
import zlib

import numpy as np
import pytest
import scipy.io

import beamfit
from beamfit.cli import main
from beamfit.emittance.size_methods import compare_size_methods
from beamfit.io.emittance_gui import read_emittance_gui
from beamfit.io.isolated import matlab_variables
from beamfit.io.line import build_line, read_inputs
from beamfit.optics.elements import Drift, Quadrupole, Screen
from tests.io.forked import in_forks  # noqa: F401

METHODS = ["Gaussian", "RMS", "RMS floor"]
WIDER = {"Gaussian": 1.0, "RMS": 1.1, "RMS floor": 1.05}
# How many emittances each of the files has stored: it has none where its own fit found no beam.
GUI_FILES = {
    "541-2022-01-23-014733": 9,
    "541-2022-01-25-055404": 14,
    "571-2020-06-21-165108": 14,
    "571-2021-02-11-193249": 12,
    "571-2021-02-18-124043": 14,
    "571-2021-02-18-124301": 14,
    "571-2021-05-01-175521": 14,
    "571-2021-06-01-163449": 14,
    "571-2021-06-08-173424": 14,
}
KG = np.array([-4.2, -3.6, -3.1, -2.6, -2.1, -1.6, -1.0])
LINE = beamfit.Beamline(
    (Quadrupole("Q", 0.108, -2.9, beamfit.optics.calibration.IntegratedGradient()),
     Drift("D", 2.2), Screen("S")), 135.0
)  # fmt: skip


@pytest.fixture
def real(shared):
    return shared / "data/lcls_otr2/test_scan2.mat"


def matrices():
    """R(setting) R(nominal)⁻¹, 6 × 6."""
    nominal = LINE.matrix()
    found = []
    for setting in KG:
        r = np.eye(6)
        now = LINE.matrix({"Q": setting})
        for at, plane in ((0, "x"), (2, "y")):
            a, b = (np.asarray(getattr(m, plane))[:2, :2] for m in (now, nominal))
            r[at : at + 2, at : at + 2] = a @ np.linalg.inv(b)
        found.append(r)
    return found


def record(plane_sizes, method):
    position = np.linspace(-500.0, 500.0, 41)
    found = {"method": method, "stats": np.array([1.0, 2.0, *plane_sizes, 0.0, 1e4])}
    for plane, size in zip("xy", plane_sizes, strict=True):
        counts = np.exp(-0.5 * (position / size) ** 2)
        found[f"prof{plane}"] = np.array([position, counts, counts])
    return found


def gui_data(noise=0.01, shots=5, sigma=(3.4e-9, 2e-10, 2.1e-9), **changed):
    """What emittance_gui saves, of a beam that is the same in both planes at the screen."""
    rng, cells = np.random.default_rng(5), matrices()
    beams = np.empty((len(KG), shots, len(METHODS)), object)
    for i, r in enumerate(cells):
        for j in range(shots):
            for k, method in enumerate(METHODS):
                sizes = []
                for at in (0, 2):
                    a, b = r[at, at : at + 2]
                    true = np.sqrt(sigma[0] * a**2 + 2 * sigma[1] * a * b + sigma[2] * b**2)
                    sizes.append(1e6 * WIDER[method] * true * (1 + noise * rng.normal()))
                beams[i, j, k] = record(sizes, method)

    def structs(values):
        kinds = [(name, object) for name in ("method", "stats", "profx", "profy")]
        found = np.empty(values.shape, kinds)
        for place, value in np.ndenumerate(values):
            found[place] = tuple(value[name] for name, _ in kinds)
        return found

    def of_shots(statistic):
        found = np.empty((len(KG), len(METHODS)), object)
        for i, k in np.ndindex(found.shape):
            each = np.array([beam["stats"] for beam in beams[i, :, k]])
            found[i, k] = beams[i, 0, k] | {"stats": statistic(each)}
        return structs(found)

    def standard_error(each):
        return each.std(axis=0, ddof=1 if len(each) > 1 else 0) / np.sqrt(len(each))

    transfer = np.empty((1, len(cells)), object)
    transfer[0] = cells
    data = {
        "type": "scan",
        "name": "OTRS:TEST:1",
        "quadName": "QUAD:TEST:1",
        "quadVal": KG,
        "status": np.ones((len(KG), 1), np.uint8),
        "use": np.ones((len(KG), 1), np.uint8),
        "ts": 737963.3606896,
        "beam": of_shots(lambda each: each.mean(axis=0)),
        "beamStd": of_shots(standard_error),
        "beamList": structs(beams),
        "charge": 0.25,
        "rMatrix": transfer,
        "twiss0": np.array([[1e-6, 1e-6], [1.2, 1.2], [-0.1, -0.1]]),
        "energy": 0.135,
        "twiss": np.ones((4, 2, len(METHODS))) * 1e-6,
        "twissstd": np.ones((4, 2, len(METHODS))) * 1e-8,
    } | changed
    return {k: v for k, v in data.items() if v is not None}


@pytest.fixture
def save(tmp_path):
    def to_file(do_compression=True, **changed):
        path = tmp_path / "scan.mat"
        scipy.io.savemat(path, {"data": gui_data(**changed)}, do_compression=do_compression)
        return path

    return to_file


def test_the_real_file_gives_its_own_fourteen_emittances(real):
    """To four digits, and their errors to one per cent, by the file's own method."""
    gui = read_emittance_gui(real)
    assert len(gui.scans) == 7
    found = compare_size_methods(gui.scans, build_line(gui.lattice), gui.stored, gui.means)
    rows = [row for plane in found for row in plane.rows]
    assert len(rows) == 14
    for row in rows:
        assert row.measured_weights.value == pytest.approx(row.stored.value, rel=5e-5)
        assert row.measured_weights.error == pytest.approx(row.stored.error, rel=1e-2)
    for plane in found:
        low, high = plane.covering.interval_95
        values = [row.emittance.value for row in plane.rows]
        assert low < min(values) < max(values) < high
        assert plane.covering.error > np.std(values, ddof=1)


@pytest.mark.parametrize("name", GUI_FILES)
def test_every_stored_emittance_follows_from_the_means_of_its_file(name, shared):
    gui = read_emittance_gui(shared / "data/lcls_gui" / f"Emittance-scan-OTRS_IN20_{name}.mat")
    found = compare_size_methods(gui.scans, build_line(gui.lattice), gui.stored, gui.means)
    rows = [row for plane in found for row in plane.rows]
    stored = [row for row in rows if row.stored]
    assert len(rows) == 14
    assert len(stored) == GUI_FILES[name] == sum(map(len, gui.stored.values()))
    for row in stored:
        assert row.measured_weights.value == pytest.approx(row.stored.value, rel=2e-5)
    for row in rows:  # where the file has none, there is none
        assert row.stored or np.isnan(row.measured_weights.value)


def test_missed_pulses_are_left_out_and_named(shared):
    """Shots with a thousandth of the light, which the program left out of its own means too."""
    gui = read_emittance_gui(
        shared / "data/lcls_gui/Emittance-scan-OTRS_IN20_541-2022-01-25-055404.mat"
    )
    scan = gui.scan()
    assert scan.shots.tolist() == [5, 4, 5, 5]
    assert 1e6 * scan.size["y"][1] == pytest.approx(np.mean([60.7, 61.3, 60.4, 61.3]), abs=0.05)
    [note] = scan.notes
    assert "shot 4 at -1.6667 kG" in note
    for plane in "xy":
        np.testing.assert_allclose(scan.size[plane], gui.means["RMS"].size[plane], rtol=1e-12)
        np.testing.assert_allclose(scan.error[plane], gui.means["RMS"].error[plane], rtol=1e-9)
    fit = beamfit.fit_emittance(scan, build_line(gui.lattice))
    assert 1e6 * fit.y.normalized_emittance.value == pytest.approx(0.757, rel=0.02)


def test_a_scan_that_was_stopped_early(shared, monkeypatch, capsys):
    path = shared / "data/lcls_gui/Emittance-scan-OTRS_IN20_571-2021-02-18-181634.mat"
    code, out, err = run(monkeypatch, capsys, path)
    assert (code, out) == (2, "")
    assert "1 of 6 settings taken and in use; expected at least three" in err


def test_weights_of_measured_sizes_are_an_option_that_is_named(real):
    gui = read_emittance_gui(real)
    fit = beamfit.fit_emittance(gui.scan("RMS"), build_line(gui.lattice), weights="measured")
    assert "measured sizes" in " ".join(fit.notes)
    assert fit.x.weights == "measured"


def test_the_real_scan_is_the_one_that_comes_along(real, root):
    own = beamfit.read_quad_scan(real)
    published = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    for plane in "xy":
        np.testing.assert_allclose(own.size[plane], published.size[plane], atol=6e-13)
        np.testing.assert_allclose(own.error[plane], published.error[plane], atol=6e-13)
    assert own.shots.tolist() == [5] * 5
    assert "2020-06-21 08:39:23" in own.provenance


def test_a_made_file_gives_the_beam_it_was_made_of(save):
    gui = read_emittance_gui(save(noise=1e-5))
    line = build_line(gui.lattice)
    true = np.sqrt(3.4e-9 * 2.1e-9 - 2e-10**2)
    for method, wider in WIDER.items():
        fit = beamfit.fit_emittance(gui.scan(method), line)
        for plane in "xy":
            assert fit[plane].emittance.value == pytest.approx(true * wider**2, rel=1e-3)
    # The design Twiss parameters hold at the screen at the nominal setting, where R begins.
    gamma = (1 + 0.1**2) / 1.2
    bmag = 0.5 * (3.4e-9 * gamma + 2 * 2e-10 * -0.1 + 2.1e-9 * 1.2) / true
    assert fit.x.mismatch.value == pytest.approx(bmag, rel=1e-2)
    # Five shots of each setting in both planes.
    assert len(gui.scan().profiles) == 2 * 5 * len(KG)


@pytest.mark.parametrize("compressed", [True, False])
def test_both_ways_of_saving_and_what_scipy_reads(compressed, save):
    path = save(do_compression=compressed)
    ours, theirs = matlab_variables(path, "data")["data"], scipy.io.loadmat(path)["data"]
    assert ours.dtype.names == theirs.dtype.names
    for name in ("quadVal", "twiss", "energy", "status"):
        np.testing.assert_array_equal(ours[name][0, 0], theirs[name][0, 0])
    for name in ("stats", "profx"):
        ours_shots, theirs_shots = ours["beamList"][0, 0][name], theirs["beamList"][0, 0][name]
        assert ours_shots.shape == theirs_shots.shape
        for a, b in zip(ours_shots.ravel(), theirs_shots.ravel(), strict=True):
            np.testing.assert_array_equal(a, b)
    assert ours["type"][0, 0].tolist() == theirs["type"][0, 0].tolist() == ["scan"]


def test_settings_and_shots_that_failed_are_left_out(save):
    use = np.ones((len(KG), 1), np.uint8)
    use[2] = 0
    data = gui_data()
    data["beamList"][0, 1, 1]["stats"] = np.full(6, np.nan)
    data["beamList"][3, 0, 1]["stats"] = np.zeros((0, 0))
    scan = read_emittance_gui(save(use=use, beamList=data["beamList"])).scan("RMS")
    assert scan.settings["QUAD:TEST:1"].tolist() == np.delete(KG, 2).tolist()
    assert scan.shots.tolist() == [4, 5, 4, 5, 5, 5]
    each = [data["beamList"][0, j, 1]["stats"][2] for j in (0, 2, 3, 4)]
    assert scan.size["x"][0] == pytest.approx(1e-6 * np.mean(each))
    assert scan.error["x"][0] == pytest.approx(1e-6 * np.std(each, ddof=1) / 2)
    taken_out, lost, *means = scan.notes
    assert taken_out == "1 of 7 settings failed or were not taken or used (status, use)."
    assert lost.endswith(
        "in x and y, without a size a beam can have: shot 2 at -4.2 kG, shot 1 at -2.6 kG."
    )
    for note, plane in zip(means, "xy", strict=True):
        assert note.startswith(f"The file's means in {plane} are not those of these shots")


def test_what_is_absurd_does_not_spoil_the_rest(save):
    data = gui_data()
    shots = data["beamList"]
    at = METHODS.index("Gaussian")
    shots[1, 2, at]["stats"][2] = 1e7  # 10 m
    for i, j in np.ndindex(5, 5):
        shots[i, j, at]["stats"][3] = -1.0  # leaves two settings in y
        shots[i, j, METHODS.index("RMS floor")]["stats"][2:4] = np.nan
    gui = read_emittance_gui(save(beamList=shots))
    assert list(gui.scans) == ["Gaussian", "RMS"]
    assert (gui.scans["Gaussian"].planes, gui.scan().planes) == (("x",), ("x", "y"))
    assert gui.scans["Gaussian"].shots.tolist() == [5, 4, 5, 5, 5, 5, 5]
    said = " ".join(gui.scans["Gaussian"].notes)
    for words in ("shot 3 at -3.6 kG", "plane y, with sizes at 2 of 7", "No RMS floor sizes"):
        assert words in said
    clean = read_emittance_gui(save())
    np.testing.assert_array_equal(gui.scan().size["x"], clean.scan().size["x"])
    with pytest.raises(beamfit.InputError, match="RMS floor sizes with 2 settings in x"):
        gui.scan("RMS floor")
    x, y = compare_size_methods(gui.scans, build_line(gui.lattice), gui.stored, gui.means)
    assert [len(x.rows), len(y.rows)] == [2, 1]


def test_settings_that_were_not_taken(save):
    data = gui_data()
    status = (np.arange(len(KG)) < 5).astype(np.uint8)[:, None]
    short = {k: data[k][:5] for k in ("beam", "beamStd", "beamList")}
    gui = read_emittance_gui(save(status=status, rMatrix=data["rMatrix"][:, :5], **short))
    assert gui.scan().settings["QUAD:TEST:1"].tolist() == KG[:5].tolist()
    assert gui.scan().notes[0].startswith("2 of 7 settings")


def test_a_shot_without_light_is_none_of_the_beam(save):
    data = gui_data()
    for k in range(len(METHODS)):
        data["beamList"][2, 3, k]["stats"][[2, 3, 5]] = 300.0, 20.0, 12.0
    scan = read_emittance_gui(save(beamList=data["beamList"])).scan()
    assert scan.shots.tolist() == [5, 5, 4, 5, 5, 5, 5]
    assert scan.notes[0].endswith("so no beam: shot 4 at -3.1 kG.")
    assert "means in x are not those" in scan.notes[1]  # the made file has the mean of all five


def test_a_file_of_single_shots_has_the_errors_it_states(save):
    data = gui_data()
    gui = read_emittance_gui(save(beamList=None))
    assert gui.scan().error["x"][2] == pytest.approx(1e-6 * data["beamStd"][2, 1]["stats"][2])
    without = read_emittance_gui(save(beamList=None, beamStd=None)).scan()
    assert without.error == {}
    assert without.error_source == "none given"


def test_four_wires(save, monkeypatch, capsys):
    """A wire is shot once; its name stands in a cell, its matrix begins at the start."""
    names, four = np.empty((1, 4), object), [0, 2, 4, 6]
    names[0] = [f"WIRE:{i}" for i in range(4)]
    data = gui_data()
    part = {k: data[k][four] for k in ("beam", "beamStd", "status", "use")}
    part |= {"beamList": data["beamList"][four][:, :1], "rMatrix": data["rMatrix"][:, four]}
    path = save(type="multi", name=names, quadName=None, quadVal=None, **part)
    gui = read_emittance_gui(path)
    assert gui.scan().screen == tuple(names[0])
    assert len(gui.scan().error["x"]) == 4
    code, out, err = run(monkeypatch, capsys, path, "--full")
    assert (code, err) == (0, "")
    assert "in x, µm, by size method" in out


def test_several_monitors(save):
    names = np.empty((1, len(KG)), object)
    names[0] = [f"WIRE:{i}" for i in range(len(KG))]
    path = save(type="multi", name=names, quadName=None, quadVal=None, posVal=np.arange(7.0))
    gui = read_emittance_gui(path)
    assert gui.scan().screen == tuple(f"WIRE:{i}" for i in range(7))
    fit = beamfit.fit_emittance(gui.scan(), build_line(gui.lattice))
    assert fit.x.emittance.value == pytest.approx(2.66e-9 * 1.1**2, rel=0.1)
    assert fit.x.points.screen == gui.scan().screen


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["beamfit", "emittance", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    return stopped.value.code, *capsys.readouterr()


def test_the_command_needs_nothing_but_the_file(save, monkeypatch, capsys, tmp_path):
    path, page = save(), tmp_path / "page.html"
    code, out, err = run(monkeypatch, capsys, path, "--report", page, "--json")
    assert (code, err) == (0, "")
    document = json.loads(out)
    assert list(document["inputs"]) == [str(path)]
    x = document["results"][0]
    assert [m["method"] for m in x["size_methods"]["methods"]] == METHODS
    assert x["size_methods"]["methods"][0]["stored"]["value"] == 1e-6
    assert x["size_methods"]["normalized_emittance"]["error"] > 0
    text = page.read_text()
    for words in ("profiles of the x plane", "profiles of the y plane", "over all methods"):
        assert words in text
    code, out, _ = run(monkeypatch, capsys, path, "--size-method", "Gaussian", "--plane", "y")
    assert (code, "Gaussian sizes" in out, "in x, µm" in out) == (0, True, False)
    code, out, _ = run(monkeypatch, capsys, path, "--weights", "measured", "--json")
    document = json.loads(out)["results"][0]
    assert (code, document["weights"]) == (0, "measured")
    assert "measured sizes" in document["notes"][0]


def test_a_lattice_replaces_the_matrices_of_the_file(save, tmp_path):
    lattice = tmp_path / "line.toml"
    lattice.write_text(
        'format = "beamfit-lattice-1"\nenergy_MeV = 135.0\n[[element]]\ntype = "quadrupole"\n'
        'name = "QUAD:TEST:1"\nlength_m = 0.108\nintegrated_gradient_kG = -2.9\n[[element]]\n'
        'type = "drift"\nlength_m = 2.2\n[[element]]\ntype = "screen"\nname = "S"\n'
    )
    path = save()
    inputs = read_inputs(str(path), str(lattice))
    by_lattice = beamfit.fit_emittance(inputs.scan, build_line(inputs.lattice))
    own = read_inputs(str(path))
    by_file = beamfit.fit_emittance(own.scan, build_line(own.lattice))
    assert by_lattice.x.emittance.value == pytest.approx(by_file.x.emittance.value, rel=1e-9)
    assert "lattice's matrices" in by_lattice.notes[0]


WRONG = {
    "no sizes": ({"beamList": None, "beam": None}, "beam"),
    "no matrices": ({"rMatrix": None}, "rMatrix"),
    "fewer matrices": ({"rMatrix": np.full((1, 3), 1.0, object)}, "rMatrix"),
    "matrices of numbers": ({"rMatrix": np.ones((1, 7))}, "rMatrix"),
    "no settings": ({"quadVal": None}, "quadVal"),
    "fewer settings": ({"quadVal": KG[:3]}, "quadVal"),
    "settings in words": ({"quadVal": "many"}, "quadVal"),
    "energy in MeV": ({"energy": 135000.0}, "energy"),
    "slices": ({"beamList": gui_data()["beamList"][..., None].repeat(2, -1)}, "slices"),
    "nothing used": ({"use": np.zeros((7, 1))}, "0 of 7 settings"),
    "two settings used": ({"use": np.array([1, 1, 0, 0, 0, 0, 0])}, "2 of 7 settings"),
}


@pytest.mark.parametrize("case", WRONG)
def test_files_that_cannot_be_used(case, save, monkeypatch, capsys):
    changed, word = WRONG[case]
    path = save(**changed)
    code, out, err = run(monkeypatch, capsys, path)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert word in err
    assert str(path) in err


def test_files_that_are_something_else(tmp_path, monkeypatch, capsys, save):
    old = tmp_path / "old.mat"
    scipy.io.savemat(old, {"data": np.ones(3)}, format="4")
    other = tmp_path / "other.mat"
    scipy.io.savemat(other, {"scan": gui_data()})
    plain = tmp_path / "plain.mat"
    scipy.io.savemat(plain, {"data": np.ones(3)})
    newer = tmp_path / "newer.mat"
    newer.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(500))
    bomb = tmp_path / "bomb.mat"
    packed = zlib.compress(bytes(600_000_000), 9)
    bomb.write_bytes(old_header() + struct.pack("<II", 15, len(packed)) + packed)
    for path, words in (
        (old, "version 5 to 7"),
        (other, "no variable 'data'"),
        (plain, "no struct"),
        (newer, "version 7.3"),
        (bomb, "is damaged"),
        (tmp_path / "none.mat", "no such file"),
    ):
        code, _, err = run(monkeypatch, capsys, path)
        assert (code, err.count("\n")) == (2, 1)
        assert words in err
    for arguments, words in (
        (["--size-method", "Gauss"], "did you mean Gaussian"),
        (["--energy", "140"], "--energy"),
        (["--skip-bad"], "--skip-bad"),
        (["--scenario", "calibration"], "matrices of their own"),
    ):
        code, _, err = run(monkeypatch, capsys, save(), *arguments)
        assert (code, err.count("\n")) == (2, 1)
        assert words in err


def old_header():
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
