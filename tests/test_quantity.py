"""A number with its error and unit: how it is written, and how one goes on with it."""

import math

import pytest

from beamfit.errors import InputError
from beamfit.quantity import Quantity, percent


@pytest.mark.parametrize(
    ("value", "error", "unit", "wanted", "factor"),
    [
        (7e-7, 1e-8, "m", "µm", 1e6),
        (7e-7, 1e-8, "m", "nm", 1e9),
        (3e-9, 1e-10, "m rad", "mm mrad", 1e6),
        (4e-8, 1e-9, "m²", "mm^2", 1e6),
        (2e-7, 1e-8, "1/(mA s)", "1/(A h)", 3.6e6),
        (36.0, 0.5, "h", "d", 1 / 24),
        (135.0, 0.1, "MeV", "GeV", 1e-3),
        (2.0, 0.1, "output/input", "output/input", 1.0),
    ],
)
def test_units_scale_value_errors_and_interval(value, error, unit, wanted, factor):
    found = Quantity(value, error, unit, error / 2, (value - 3 * error, value + error)).to(wanted)
    assert found.unit == wanted
    assert found.value == pytest.approx(value * factor)
    assert found.error == pytest.approx(error * factor)
    assert found.error_raw == pytest.approx(error * factor / 2)
    ends = ((value - 3 * error) * factor, (value + error) * factor)
    assert found.interval_95 == pytest.approx(ends)


@pytest.mark.parametrize("unit", ["s", "m²", "furlong", ""])
def test_another_kind_of_unit_is_refused(unit):
    with pytest.raises(InputError, match="a unit of m"):
        Quantity(1.0, 0.1, "m").to(unit)


def test_what_is_not_determined_has_no_error_to_go_on_with():
    open_one = Quantity(2.0, None, "m")
    assert float(open_one) == open_one.nominal_value == 2.0
    assert math.isnan(open_one.std_dev)
    assert open_one.to("mm").error is None


@pytest.mark.parametrize(
    ("value", "error", "said"),
    [
        (23456.0, 12345.0, "(2.3 ± 1.2)e+04"),
        (-0.0, None, "0 (not determined)"),
        (-1e-9, 0.5, "0.00 ± 0.50"),
        (5419.0, 8100.0, "5419 ± 8100"),
    ],
)
def test_numbers_have_no_digits_that_say_nothing(value, error, said):
    assert str(Quantity(value, error, "1")) == said


def test_shares_are_no_powers_of_ten():
    assert [percent(s, sign="+") for s in (96.0, 0.5, -0.00123)] == ["+9600 %", "+50 %", "-0.12 %"]
