"""Numbers with points, commas and groups of thousands keep their digits."""

import pytest

from pisigma.measurement.foreign.dialect import NumberFormat, is_missing


@pytest.mark.parametrize(
    ("decimal", "cell", "text"),
    [
        (".", "-76.0480", "-76.0480"),
        (".", "+1.5e-3", "+1.5E-3"),
        (".", "1,234,567.80", "1234567.80"),
        (".", "1'234.5", "1234.5"),
        (".", "\u221212.5", "-12.5"),
        (".", ".5", ".5"),
        (".", "1.5D+02", "1.5E+02"),
        (",", "-76,0480", "-76.0480"),
        (",", "1.234,5", "1234.5"),
        (",", "1 234,5", "1234.5"),
        (",", "12", "12"),
        (",", "12.5", None),
        (".", "12,5", None),
        (".", "1,234'567", None),
        (".", "1_000", None),
        (".", "inf", None),
        (".", "", None),
        (".", "１２", None),
        (".", "-", None),
        (".", "12.5 mm", None),
        (".", "1.2.3", None),
    ],
)
def test_numbers(decimal: str, cell: str, text: str | None):
    assert NumberFormat(decimal).to_plain_number(cell) == text


def test_a_group_without_decimals_may_be_a_decimal():
    assert NumberFormat(".").certainty("1,234") < NumberFormat(",").certainty("1,234") == 1


def test_markers_of_missing_values():
    assert all(map(is_missing, ("", " ", "-", "---", "NaN", "n/a", "null")))
    assert not any(map(is_missing, ("0", "x", "-1")))
