"""Find rows that summarise other rows, such as "Mean" and "StdDev", and are not measurements."""

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
"""Names of means in instruments and spreadsheets, in lower case and without spaces, points and dashes."""
_OTHERS = frozenset(_CALLED_OTHERWISE.split())
"""Names of other statistics."""

_MAX_SHARE = 0.25
"""Largest share of rows named as means that are treated as summaries without a check of their values."""
_MIN_ROWS = 4
"""Smallest number of rows whose mean can be recognised in a row without a name."""
_LAST_ROWS = 6
"""Number of rows at the end of a file that are compared with statistics of the preceding rows."""
_MIN_RANGE = 100.0
"""Range of a column's values relative to their rounding above which it distinguishes a mean from a measurement."""


def summary_rows(records: Sequence[Sequence[str]], number_format: NumberFormat) -> dict[int, str]:
    """Find rows that summarise other rows.

    A row is a summary if one of its cells names a statistic, or if it precedes or follows all other rows and contains
    their mean or other statistics in every column. If many rows are named as means and none of them is the mean of the
    preceding rows, they are measurements that the instrument averaged.

    Args:
        records: cells of the rows.
        number_format: format of numbers.

    Returns:
        The reason why a row is a summary, by row index.
    """
    named = named_statistics(records)
    is_mode = len(named) == len(records) or (
        set(named.values()) <= _AVERAGES
        and len(named) > max(1.0, _MAX_SHARE * len(records))
        and not _holds_means(records, number_format, named)
    )
    named = {} if is_mode else named
    found = {
        row: f"'{next(cell for cell in records[row] if statistic_name(cell) == name)}' names a summary of other rows"
        for row, name in named.items()
    }
    unnamed = [row for row in range(len(records)) if row not in named]
    texts = [[number_format.to_plain_number(cell) for cell in records[row]] for row in unnamed]
    after = _count_statistics(texts)
    before = 0 if after else _count_statistics(texts[::-1])
    why = "the row is the mean, or another statistic, of the rows"
    found |= dict.fromkeys(unnamed[len(unnamed) - after :], f"{why} before it")
    return found | dict.fromkeys(unnamed[:before], f"{why} after it")


def named_statistics(records: Sequence[Sequence[str]]) -> dict[int, str]:
    """Return the statistics that cells name, by row index, using the last such cell of a row."""
    return {
        row: name
        for row, record in enumerate(records)
        for cell in record
        if (name := statistic_name(cell)) in _AVERAGES or name in _OTHERS
    }


def statistic_name(cell: str) -> str:
    """Return the name of a statistic in a cell, without spaces, signs, multiples ("3σ") and quantity ("mean of X")."""
    text = re.sub(r"^\d+\s*[x*]?\s*(?=σ|sigma)|\(.*?\)|\[.*?\]|\s(?:of|von)\s.*", "", cell.casefold().strip())
    return re.sub(r"[\W_]+|values?$|wert$", "", text) if text[:1].isalpha() else ""


def _holds_means(records: Sequence[Sequence[str]], numbers: NumberFormat, named: Mapping[int, str]) -> bool:
    """Return whether any row that is named as a mean is the mean of the rows since the previous such row."""
    group: list[list[str | None]] = []
    for row, record in enumerate(records):
        texts = [numbers.to_plain_number(cell) for cell in record]
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


def _count_statistics(texts: Sequence[Sequence[str | None]]) -> int:
    """Return the number of last rows that are statistics, including the mean, of all rows before them."""
    if len(texts) <= _MIN_ROWS:
        return 0
    width = min(map(len, texts))
    columns = [k for k in range(width) if all(row[k] is not None for row in texts)]
    values = np.array([[float(row[k] or "nan") for k in columns] for row in texts])
    rounding = np.array([[_rounding(row[k] or "") for k in columns] for row in texts])
    for count in range(1, min(_LAST_ROWS, len(texts) - _MIN_ROWS) + 1):
        if _are_statistics(values[:-count], values[-count:], rounding):
            return count
    return 0


def _are_statistics(
    rows: Float64[np.ndarray, "rows columns"],
    last: Float64[np.ndarray, "last columns"],
    rounding: Float64[np.ndarray, "all columns"],
) -> bool:
    """Return whether all of the last rows are statistics of the rows, and one of them is their mean.

    A calculated mean is rounded or has more digits than the rows; a central commanded value is neither.
    """
    finest = rounding[: len(rows)].min(0)
    clear = np.ptp(rows, axis=0) > _MIN_RANGE * rounding[len(rows) :].max(0)
    clear &= ~np.all(np.diff(rows, axis=0) == 1, axis=0)  # a column with the numbers of the points
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
    """Return half a unit of the last digit of a number."""
    mantissa, _, exponent = number.partition("E")
    decimals = len(mantissa.partition(".")[2])
    return 0.5 * 10.0 ** (int(exponent or 0) - decimals)
