"""A unit behind a number is read where it is that of the column, and named where it is not."""

import pytest

from beamfit.errors import InputError
from beamfit.io.scan import read_quad_scan

SIZES = ["111.5 um", "60.5 µm", "72.5um", "104 um"]


def scan(path, sizes, magnet="Q_A", size="size_x", separator=",", **options):
    rows = [f"{k} A{separator}{cell}{separator}2A" for k, cell in enumerate(sizes)]
    path.write_text("\n".join([separator.join((magnet, size, "screen")), *rows]) + "\n")
    return read_quad_scan(path, **options)


@pytest.mark.parametrize("magnet", ["Q", "Q_A", "Q [A]"])
@pytest.mark.parametrize("size", ["size_x", "size_x_um", "Size X (µm)"])
@pytest.mark.parametrize("separator", [",", ";"])
def test_one_unit_behind_every_number_is_the_headers(magnet, size, separator, tmp_path):
    sizes = [cell.replace(".", "," if separator == ";" else ".") for cell in SIZES]
    found = scan(tmp_path / "a.csv", sizes, magnet, size, separator)
    assert found.units == {"Q": "A"}
    assert found.settings["Q"].tolist() == [0, 1, 2, 3]
    assert found.size["x"].round(9).tolist() == [1.115e-4, 6.05e-5, 7.25e-5, 1.04e-4]
    assert found.screen == ("2A",) * 4  # which is a name


@pytest.mark.parametrize("size", ["size_x", "size_x_um"])
def test_another_unit_is_named_in_its_line_and_can_be_left_out(size, tmp_path):
    sizes = [*SIZES[:2], "0.0725 mm", SIZES[3]]
    with pytest.raises(InputError, match=r":4: column 'size_x_um': '0.0725 mm'.* unit of the col"):
        scan(tmp_path / "a.csv", sizes, size=size)
    assert len(scan(tmp_path / "a.csv", sizes, size=size, skip_bad=True)) == 3


def test_a_number_without_a_unit_has_that_of_the_header_or_none(tmp_path):
    sizes = [*SIZES[:2], "72.5", SIZES[3]]
    assert len(scan(tmp_path / "a.csv", sizes, size="size_x_um")) == 4
    with pytest.raises(InputError, match=r":4: column 'size_x': '72.5' without a unit.*size_x_um"):
        scan(tmp_path / "a.csv", sizes)
