"""Tables with a line for each bin of each profile."""

import h5py
import numpy as np
import pytest
from PIL import Image

import beamfit

X = np.arange(-1000.0, 1001.0, 50.0)


def table(path, widths=(200.0, 120.0, 210.0), shots=2, bins=X, header="position_um,counts_x"):
    lines = [f"Q2_A,shot,{header}"]
    for q, width in enumerate(widths):
        for shot in range(shots):
            for x in bins:
                counts = 1000.0 * np.exp(-0.5 * (x / width) ** 2)
                lines.append(f"{q},{shot},{x:g},{counts:.2f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_shots_become_rows_with_sizes_and_profiles(tmp_path):
    scan = beamfit.read_quad_scan(table(tmp_path / "p.csv"))
    assert scan.size["x"] == pytest.approx([200e-6, 120e-6, 210e-6], rel=0.01)
    assert [p.row for p in scan.profiles] == [0, 0, 1, 1, 2, 2]
    assert scan.profiles[2].position == pytest.approx(1e-6 * X)
    assert scan.settings["Q2"].tolist() == [0, 1, 2]
    assert scan.shots.tolist() == [2, 2, 2]


def test_a_background_is_taken_off(tmp_path):
    path = table(tmp_path / "p.csv")
    head, *rows = path.read_text().splitlines()
    raised = [f"{head},background_x"]
    for row in rows:
        cells = row.split(",")
        ramp = 300.0 + 0.2 * float(cells[2])
        raised.append(",".join([*cells[:3], f"{float(cells[3]) + ramp:.3f}", f"{ramp:.3f}"]))
    path.write_text("\n".join(raised) + "\n")
    assert beamfit.read_quad_scan(path).size["x"] == pytest.approx([2e-4, 1.2e-4, 2.1e-4], rel=0.01)


def test_a_short_shot_is_named_with_its_line(tmp_path):
    with pytest.raises(beamfit.InputError) as error:
        beamfit.read_quad_scan(table(tmp_path / "p.csv", bins=X[:5]))
    assert error.value.line == 2
    assert "5 bins" in error.value.found


def test_counts_without_positions_are_refused(tmp_path):
    path = table(tmp_path / "p.csv", header="place,counts_x")
    with pytest.raises(beamfit.InputError, match="position"):
        beamfit.read_quad_scan(path)


def test_bins_at_one_place_are_named_with_their_line(tmp_path):
    path = table(tmp_path / "p.csv", shots=1)
    head, first, _, *rest = path.read_text().splitlines()
    path.write_text("\n".join([head, first, first, *rest]) + "\n")
    with pytest.raises(beamfit.InputError, match="a position twice") as error:
        beamfit.read_quad_scan(path)
    assert error.value.line == 2


def images(path, widths=((200.0, 90.0), (120.0, 100.0), (210.0, 110.0)), **changed):
    x, y = np.arange(120) * 25.0 - 1500.0, np.arange(80) * 25.0 - 1000.0
    stack = [np.exp(-0.5 * (x / a) ** 2) * np.exp(-0.5 * (y[:, None] / b) ** 2) for a, b in widths]
    found = {"images": 1000.0 * np.array(stack) + 5.0, "pixel_um": 25.0, "Q2_A": [0.0, 1.0, 2.0]}
    with h5py.File(path, "w") as store:
        for name, values in (found | changed).items():
            if values is not None:
                store[name] = values
    return path


def test_a_stack_of_images_gives_its_projections(tmp_path):
    scan = beamfit.read_quad_scan(images(tmp_path / "stack.h5"))
    assert scan.size["x"] == pytest.approx([200e-6, 120e-6, 210e-6], rel=0.02)
    assert scan.size["y"] == pytest.approx([90e-6, 100e-6, 110e-6], rel=0.02)
    assert len(scan.profiles) == 6


@pytest.mark.parametrize(
    ("changed", "found"),
    [({"pixel_um": None}, "no dataset pixel_um"), ({"Q2_A": [0.0, 1.0]}, "2 values"),
     ({"images": np.zeros((3, 40))}, "shape")],
)  # fmt: skip
def test_a_stack_that_lacks_something_is_refused(changed, found, tmp_path):
    with pytest.raises(beamfit.InputError, match=found):
        beamfit.read_quad_scan(images(tmp_path / "stack.h5", **changed))


def test_a_pixel_without_width_is_refused(tmp_path):
    with pytest.raises(beamfit.InputError, match="a pixel above zero"):
        beamfit.read_quad_scan(images(tmp_path / "stack.h5", pixel_um=0.0))


def pictures(folder, name="{}.png", pixel="pixel_um"):
    """A table of PNG images of 16 bits, beside it."""
    lines = [f"Q2_A,image,{pixel}"]
    x, y = np.arange(120) * 25.0 - 1500.0, np.arange(80) * 25.0 - 1000.0
    for q, (a, b) in enumerate(((200.0, 90.0), (120.0, 100.0), (210.0, 110.0))):
        seen = np.exp(-0.5 * (x / a) ** 2) * np.exp(-0.5 * (y[:, None] / b) ** 2)
        Image.fromarray((40000 * seen + 100).astype(np.uint16)).save(folder / f"{q}.png")
        lines.append(f"{q},{name.format(q)},25")
    path = folder / "scan.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_of_images_gives_their_projections(tmp_path):
    scan = beamfit.read_quad_scan(pictures(tmp_path))
    assert scan.size["x"] == pytest.approx([200e-6, 120e-6, 210e-6], rel=0.02)
    assert scan.size["y"] == pytest.approx([90e-6, 100e-6, 110e-6], rel=0.02)
    assert [p.row for p in scan.profiles if p.plane == "y"] == [0, 1, 2]


def test_images_that_are_none_are_refused_in_a_line(tmp_path):
    with pytest.raises(beamfit.InputError, match="column pixel_um"):
        beamfit.read_quad_scan(pictures(tmp_path, pixel="width"))
    with pytest.raises(beamfit.InputError, match=r"7\.png: no such file"):
        beamfit.read_quad_scan(pictures(tmp_path, name="7.png"))
    path = pictures(tmp_path)
    whole = (tmp_path / "1.png").read_bytes()
    for damaged in (b"text", whole[: len(whole) // 2], whole[:200] + b"?" * 40 + whole[240:]):
        (tmp_path / "1.png").write_bytes(damaged)
        with pytest.raises(beamfit.InputError, match=r"1\.png: no image, or a damaged one"):
            beamfit.read_quad_scan(path)


def noisy(path, planes):
    """A table of two shots at each of five settings, of which these planes show a beam."""
    random, lines = np.random.default_rng(3), ["Q2_A,shot,position_um,counts_x,counts_y"]
    for q, width in enumerate((200.0, 150.0, 120.0, 160.0, 210.0)):
        for shot in range(2):
            beam = 1000.0 * np.exp(-0.5 * (X / width) ** 2)
            noise = 20.0 * random.normal(size=(2, len(X)))
            counts = [beam + n if p in planes else n for p, n in zip("xy", noise, strict=True)]
            lines += [
                f"{q},{shot},{x:g},{a:.1f},{b:.1f}" for x, a, b in zip(X, *counts, strict=True)
            ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_plane_of_noise_is_left_out_and_said(tmp_path):
    scan = beamfit.read_quad_scan(noisy(tmp_path / "p.csv", "y"))
    assert scan.planes == ("y",)
    assert {p.plane for p in scan.profiles} == {"y"}
    assert any(note.startswith("Left out: x,") for note in scan.notes)


def test_noise_in_all_planes_is_no_beam(tmp_path):
    with pytest.raises(beamfit.InputError, match="shows a beam"):
        beamfit.read_quad_scan(noisy(tmp_path / "p.csv", ""))
