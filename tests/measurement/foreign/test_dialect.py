"""Separators and decimal signs are recognised by the cells."""

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.dialect import Decimal, Dialect, detect_dialect


def sniffed(lines: list[str], decimal: Decimal | None = None) -> Dialect:
    return detect_dialect(list(enumerate(lines, start=1)), "a.csv", decimal)


@pytest.mark.parametrize(
    ("lines", "separator", "decimal"),
    [
        (["q1,x", "1.5,2.25", "3.5,4.25"], ",", "."),
        (["q1;x", "1,5;2,25", "3,5;4,25"], ";", ","),
        (["q1;x", "1,250;2,125", "3,500;4,250"], ";", ","),
        (["q1;x", "1.250;2.125", "3.500;4.250"], ";", "."),
        (["q1;x", "1.250,5;2,125", "3,500;1.000,25"], ";", ","),
        (["q1\tx", "1,5\t2,5"], "\t", ","),
        (["1,5 2,5", "3,5   4,5"], " ", ","),
        (["1.5, 2.5", "3.5, 4.5"], ",", "."),
        (["p1|1.5|2.5"], "|", "."),
        (['"1,5","2,5"', '"3,5","4,5"'], ",", ","),
        (["1,2,3", "4,5,6"], ",", "."),
        (["name\tx\ty", "point 1\t1.5\t2.5", "point 2\t3.5\t4.5"], "\t", "."),
        (["a note, with commas, in it", "1.5 2.5 3.5", "1.5 2.5 3.5"], " ", "."),
    ],
)
def test_separator_and_decimal_sign(lines: list[str], separator: str, decimal: str):
    dialect = sniffed(lines)
    assert (dialect.separator, dialect.number_format.decimal) == (separator, decimal)


def test_a_stated_sign_is_used():
    assert sniffed(["1,250;2,125"], ".").number_format.decimal == "."


def test_commas_that_may_separate_thousands_or_cells_are_refused():
    lines = ["q1,x", '10,"1,234"', '11,"-2,345"']
    with refused(MeasurementError, line=2, column=2, value="1,234"):
        sniffed(lines)
    assert sniffed(lines, ".").number_format.to_plain_number("1,234") == "1234"
    assert sniffed([*lines, '12,"0,345"']).number_format.to_plain_number("1,234") == "1.234"


@pytest.mark.parametrize("lines", [[], ["only words here", "and here"], ["1.5", "2.5"]])
def test_no_table_is_refused(lines: list[str]):
    with refused(MeasurementError, file="a.csv", line=None):
        sniffed(lines)


@pytest.mark.parametrize(
    ("lines", "column", "value"),
    [
        (["x;y", "2.104;12", "3.210;800", "951;1.200"], 1, "2.104"),
        (["x;y", "2,104;12", "3,210;800", "951;1,200"], 1, "2,104"),
        (["q1;x;y", "170;2.104;3.200", "30;1.950;1.100"], 2, "2.104"),
        (["q1;x;y", "170;22.104;300", "30;21.950;1100"], 2, "22.104"),
        (["q1;x;y", "17.5;1.104;300", "30.25;950;1100"], 2, "1.104"),
    ],
)
def test_groups_of_thousands_that_may_be_decimals_are_refused(lines: list[str], column: int, value: str):
    with refused(MeasurementError, file="a.csv", line=2, column=column, value=value):
        sniffed(lines)
    assert sniffed(lines, ".").number_format.decimal == "."


def test_numbers_of_points_do_not_make_three_decimals_ambiguous():
    assert sniffed(["n;x;y", "1;2.104;3.200", "2;1.950;1.100", "3;1.1;2.5"]).number_format.decimal == "."
    assert sniffed(["n;x;y", "7;2.104;3.200", "8;1.950;1.100"]).number_format.decimal == "."
