"""A unit behind a number may be that of its column, which the header or --columns says."""

import pytest

from beamfit.errors import InputError
from beamfit.io.scan import read_quad_scan

SIZES = ["111.5 um", "60.5 µm", "72.5um", "104"]


def scan(path, sizes, magnet="Q_A", size="size_x_um", **options):
    rows = [f"{k} A,{cell},2A" for k, cell in enumerate(sizes)]
    path.write_text("\n".join([f"{magnet},{size},screen", *rows]) + "\n")
    return read_quad_scan(path, **options)


@pytest.mark.parametrize(
    ("magnet", "size", "columns"),
    [
        ("Q_A", "size_x_um", None),
        ("Q [A]", "Size X (µm)", None),
        ("current", "width", "current=Q_A, width=size_x_um"),
    ],
)
def test_the_unit_of_the_column_may_stand_behind_numbers(magnet, size, columns, tmp_path):
    found = scan(tmp_path / "a.csv", SIZES, magnet, size, columns=columns)
    assert found.units == {"Q": "A"}
    assert found.settings["Q"].tolist() == [0, 1, 2, 3]
    assert found.size["x"].round(9).tolist() == [1.115e-4, 6.05e-5, 7.25e-5, 1.04e-4]
    assert found.screen == ("2A",) * 4  # which is a name


def test_another_unit_is_named_in_its_line_and_can_be_left_out(tmp_path):
    sizes = [*SIZES[:2], "0.0725 mm", SIZES[3]]
    with pytest.raises(InputError, match=r":4: column 'size_x_um': '0.0725 mm'.* unit of the col"):
        scan(tmp_path / "a.csv", sizes)
    assert len(scan(tmp_path / "a.csv", sizes, skip_bad=True)) == 3


def test_a_unit_in_cells_alone_is_to_be_said(tmp_path):
    with pytest.raises(InputError, match=r"column 'size_x': a size without a unit.*--columns"):
        scan(tmp_path / "a.csv", SIZES, size="size_x")
