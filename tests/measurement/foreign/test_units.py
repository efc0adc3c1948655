"""Units: spellings, exact conversion, and impossible values."""

import math

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.units import (
    is_unit_certain,
    parse_units,
    reason_to_doubt,
    stated_units,
    to_file_unit,
    unit_symbol,
)


@pytest.mark.parametrize(
    ("text", "symbol"),
    [
        ("[Millimeters]", "mm"),
        ("µm", "um"),
        ("°", "deg"),
        ('"', "in"),
        ("furlong", ""),
        ("", ""),
        ("gradians", "gon"),
        ("[Grad]", ""),
    ],
)
def test_spellings(text: str, symbol: str):
    assert unit_symbol(text) == symbol


@pytest.mark.parametrize(
    ("number", "symbol", "written"),
    [
        ("-76.0480", "deg", "-76.0480"),
        ("2.1039658", "m", "2103.9658"),
        ("1.10", "m", "1100"),
        ("10", "in", "254.0"),
        ("12345", "um", "12.345"),
        ("100", "gon", "90.0"),
        ("1.2e3", "m", "1200000"),
        ("1e300", "m", "1E+303"),
        ("12.5", "in", "317.50"),
        ("0.000", "m", "0"),
        ("10:31", "ms", "10:31"),
    ],
)
def test_numbers_are_scaled_exactly(number: str, symbol: str, written: str):
    assert to_file_unit(number, symbol) == written


@pytest.mark.parametrize(
    ("comment", "units"),
    [
        ("// units mm", {"length": "mm"}),
        ("# Units: Millimeters, degrees", {"length": "mm", "angle": "deg"}),
        ("% joints [rad], position in m", {"angle": "rad", "length": "m"}),
        ("position 3 m from the robot", {}),
        ("measured by tracker 7", {}),
    ],
)
def test_units_of_comments(comment: str, units: dict[str, str]):
    assert stated_units([comment]) == units


def test_stated_units():
    assert parse_units("mm,deg") == {"length": "mm", "angle": "deg"}
    with refused(MeasurementError, option="--unit", value="mn") as caught:
        parse_units("mn")
    assert "'m'" in caught.value.remedy
    with refused(MeasurementError, option="--unit", value="mm,m"):
        parse_units("mm,m")


def test_values_that_cannot_be_in_a_unit():
    assert "degrees" in reason_to_doubt("rad", 170.0, 20)
    assert "radians" in reason_to_doubt("deg", 3.1, 20)
    assert "lengths" in reason_to_doubt("deg", 2103.0, 20)
    assert "millimetres" in reason_to_doubt("m", 2103.0, 20)
    assert "metres" in reason_to_doubt("mm", 2.9, 20)
    assert not any(
        reason_to_doubt(*case, 20) for case in (("rad", 6.2), ("deg", 170.0), ("m", 2.9), ("mm", 2103.0))
    )
    assert is_unit_certain("deg", 170.0)
    assert not is_unit_certain("deg", math.pi)
    assert is_unit_certain("mm", 2103.0)
    assert not is_unit_certain("mm", 2.9)
