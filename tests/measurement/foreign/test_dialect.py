"""Separators and decimal signs are told from the cells."""

import pytest

from pisigma.errors import MeasurementError
from pisigma.measurement.foreign.dialect import sniff


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
    dialect = sniff(lines, "a.csv")
    assert (dialect.separator, dialect.numbers.decimal) == (separator, decimal)


def test_a_stated_sign_counts():
    assert sniff(["1,250;2,125"], "a.csv", ".").numbers.decimal == "."


def test_commas_that_may_set_thousands_apart_are_refused_where_they_separate_cells():
    lines = ["q1,x", '10,"1,234"', '11,"-2,345"']
    with pytest.raises(MeasurementError, match="state --decimal point or --decimal comma"):
        sniff(lines, "a.csv")
    assert sniff(lines, "a.csv", ".").numbers.text("1,234") == "1234"
    assert sniff([*lines, '12,"0,345"'], "a.csv").numbers.text("1,234") == "1.234"


@pytest.mark.parametrize("lines", [[], ["only words here", "and here"], ["1.5", "2.5"]])
def test_no_table_is_refused(lines: list[str]):
    with pytest.raises(MeasurementError, match="table with one measurement per line"):
        sniff(lines, "a.csv")
