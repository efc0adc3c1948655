"""Rows that summarise others, such as "Mean" and "StdDev": they are no measurements."""

import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from pisigma.measurement.foreign.dialect import NumberFormat

_CALLED_AVERAGES = """
mean average avg ave median ø mittel mittelwert durchschnitt moyenne médiane media mediana promedio
"""
_CALLED_OTHERWISE = """
stddev std stdev stdv stddeviation stderror sd sigma σ standarddeviation variance var rms rmse
min minimum max maximum range span sum total count
standardabweichung standardabw stdabweichung stdabw stabw varianz summe anzahl spannweite streuung
ecarttype écarttype somme devstd deviazionestandard scartotipo
desviación desviaciónestándar desviacionestandar desvestándar desvestandar desvest desvstd suma
"""
_AVERAGES = frozenset(_CALLED_AVERAGES.split())
"""What instruments and spreadsheets call means, in small letters and without blanks, points and dashes."""
_OTHERS = frozenset(_CALLED_OTHERWISE.split())
"""What they call other statistics, which no measurement is called."""

_LARGEST_SHARE = 0.25
"""Share of rows called means that are summaries without a look at their values."""
_FEWEST = 4
"""Rows that a row without a name must be the mean of."""
_LAST = 6
"""Rows at the end of a file that are compared with statistics of those before them."""
_CLEAR = 100.0
"""A column tells a mean from a measurement where its values differ by more than so many times their rounding."""


def summary_rows(records: Sequence[Sequence[str]], numbers: NumberFormat) -> dict[int, str]:
    """Find rows that summarise others.

    A row is a summary where one of its cells names a statistic, or where it follows or precedes all other rows and
    holds their mean and other statistics in every column. Rows that are called means and nothing else are measurements
    where they are many and none is the mean of the rows before it: that is how they were measured.

    Args:
        records: cells of the rows.
        numbers: how numbers are written.

    Returns:
        By row, why it is a summary.
    """
    named = named_statistics(records)
    is_mode = len(named) == len(records) or (
        set(named.values()) <= _AVERAGES
        and len(named) > max(1.0, _LARGEST_SHARE * len(records))
        and not _holds_means(records, numbers, named)
    )
    named = {} if is_mode else named
    found = {
        row: f"'{next(cell for cell in records[row] if statistic(cell) == name)}' names a summary of other rows"
        for row, name in named.items()
    }
    rest = [row for row in range(len(records)) if row not in named]
    texts = [[numbers.text(cell) for cell in records[row]] for row in rest]
    behind = _statistics_behind(texts)
    before = 0 if behind else _statistics_behind(texts[::-1])
    why = "it holds the mean, or another statistic, of the rows"
    found |= dict.fromkeys(rest[len(rest) - behind :], f"{why} before it")
    return found | dict.fromkeys(rest[:before], f"{why} after it")


def named_statistics(records: Sequence[Sequence[str]]) -> dict[int, str]:
    """Give the rows in which a cell names a statistic, and which; the last such cell of a row counts."""
    return {
        row: name
        for row, record in enumerate(records)
        for cell in record
        if (name := statistic(cell)) in _AVERAGES or name in _OTHERS
    }


def statistic(cell: str) -> str:
    """A cell without blanks and signs; what it is of, "value", and how many times it is taken say nothing."""
    text = re.sub(r"^\d+\s*[x*]?\s*(?=σ|sigma)|\(.*?\)|\[.*?\]|\s(?:of|von)\s.*", "", cell.casefold().strip())
    return re.sub(r"[\W_]+|values?$|wert$", "", text) if text[:1].isalpha() else ""


def _holds_means(records: Sequence[Sequence[str]], numbers: NumberFormat, named: Mapping[int, str]) -> bool:
    """Whether a row that is called a mean is that of the rows since the one before that is called so."""
    group: list[list[str | None]] = []
    for row, record in enumerate(records):
        texts = [numbers.text(cell) for cell in record]
        if row not in named:
            group.append(texts)
            continue
        columns = [k for k, text in enumerate(texts) if text and group and all(one[k] for one in group)]
        values = np.array([[float(one[k] or "nan") for k in columns] for one in group])
        mean = np.array([float(texts[k] or "nan") for k in columns])
        rounding = np.array([_rounding(texts[k] or "") for k in columns])
        if len(columns) >= 3 and bool((np.abs(values.mean(0) - mean) <= 1.01 * rounding).all()):
            return True
        group = []
    return False


def _statistics_behind(texts: Sequence[Sequence[str | None]]) -> int:
    """How many rows at the end hold statistics of all rows before them, among them the mean; 0 for none."""
    if len(texts) <= _FEWEST:
        return 0
    width = min(map(len, texts))
    columns = [k for k in range(width) if all(row[k] is not None for row in texts)]
    values = np.array([[float(row[k] or "nan") for k in columns] for row in texts])
    rounding = np.array([[_rounding(row[k] or "") for k in columns] for row in texts])
    for count in range(1, min(_LAST, len(texts) - _FEWEST) + 1):
        if _are_statistics(values[:-count], values[-count:], rounding):
            return count
    return 0


def _are_statistics(
    rows: Float64[np.ndarray, "rows columns"],
    last: Float64[np.ndarray, "last columns"],
    rounding: Float64[np.ndarray, "all columns"],
) -> bool:
    """Whether all of the last rows are statistics of the rows, and one of them is their mean.

    A mean that was calculated was rounded, or has more digits than the rows; the middle of commanded values is neither.
    """
    finest = rounding[: len(rows)].min(0)
    clear = np.ptp(rows, axis=0) > _CLEAR * rounding[len(rows) :].max(0)
    clear &= ~np.all(np.diff(rows, axis=0) == 1, axis=0)  # numbers of the points
    if clear.sum() < 3:
        return False
    rows, last, rounding = rows[:, clear], last[:, clear], rounding[len(rows) :, clear]
    mean = rows.mean(0)
    statistics = np.array(
        [
            mean,
            np.median(rows, 0),
            rows.std(0),
            rows.std(0, ddof=1),
            rows.min(0),
            rows.max(0),
            np.ptp(rows, 0),
            rows.sum(0),
        ]
    )
    near = np.abs(last[:, None] - statistics) <= 1.01 * rounding[:, None] + 1e-12 * np.abs(statistics)
    fits = near.all(2)
    is_computed = (np.abs(last - mean) > 1e-9) | (rounding < 0.5 * finest[clear])
    return bool((fits[:, 0] & is_computed.any(1)).any() and fits.any(1).all())


def _rounding(number: str) -> float:
    """Half a unit of the last digit of a number."""
    mantissa, _, exponent = number.partition("E")
    decimals = len(mantissa.partition(".")[2])
    return 0.5 * 10.0 ** (int(exponent or 0) - decimals)
