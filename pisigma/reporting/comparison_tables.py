"""Comparisons of models as tables."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from pisigma.reporting.result_text import Block, Table, table_block
from pisigma.reporting.tables import distance_table
from pisigma.reporting.verdict import rounded_text
from pisigma.validation.held_out.model_comparison import (
    Difference,
    Interval,
    ModelComparison,
    ModelFigures,
    QuantityErrors,
)

_SHOWN = {"rms": "RMS", "mean": "mean", "p95": "95 %", "max": "largest"}
_NONE = "-"


_Lines = list[tuple[str, Sequence[str]]]
"""Label of each line of a table, and one cell per model."""


def comparison_tables(
    comparison: ModelComparison, rows_name: str, width: int, full: bool = True
) -> list[tuple[str, Table]]:
    """Return titled tables of the errors of every model, and of the differences to the first model.

    The tables have one column per model. If the models do not fit the width, there are several tables.

    Args:
        comparison: comparison of one model or more.
        rows_name: name of the rows.
        width: width of the screen [characters].
        full: show all figures; otherwise only RMS, 95 % quantile and maximum, and the mean difference.
    """
    names = [model.name for model in comparison.models]
    rows = f"{comparison.rows} rows ({comparison.configurations} configurations) of {rows_name}"
    tables = [(f"Errors of {rows}", names, _error_lines(comparison, full))]
    if len(names) > 1:
        title = f"Differences from {names[0]} on the same rows, negative is better"
        tables.append((title, names[1:], _difference_lines(comparison, full)))
    return [(title, one) for title, heads, lines in tables for one in _fitting(heads, lines, width)]


def model_rms_text(figures: ModelFigures, rows: int) -> str:
    """Return the RMS errors of a model as text."""
    errors = (figures.position, figures.orientation)
    return " and ".join(
        f"{rounded_text(one.statistics['rms'], rows)} {one.unit}" for one in errors if one is not None
    )


def comparison_blocks(
    comparison: ModelComparison, rows_name: str, width: int, verbose: bool
) -> tuple[list[Block], list[Block]]:
    """Return the errors of models on rows as text; unless `verbose`, remarks state which figures are omitted."""

    def blocks(full: bool) -> list[Block]:
        tables = comparison_tables(comparison, Path(rows_name).name, width, full)
        return [
            table_block(title, *cells, "all statistics" if full else title.split()[0].lower())
            for title, cells in tables
        ]

    shown = blocks(full=verbose)
    if comparison.socket_distance is not None:
        shown.append(
            table_block("stated distances between sockets", *distance_table(comparison.socket_distance))
        )
    return shown, [] if verbose else blocks(full=True)


def _fitting(heads: Sequence[str], lines: _Lines, width: int) -> list[Table]:
    """Divide the models among tables that fit the width, at least one model each."""
    label = max(len(line) for line, _ in lines)
    widths = [max(len(head), *(len(cells[k]) for _, cells in lines)) for k, head in enumerate(heads)]
    blocks: list[list[int]] = [[]]
    for k, size in enumerate(widths):
        if blocks[-1] and label + sum(widths[other] + 2 for other in blocks[-1]) + size + 4 > width:
            blocks.append([])
        blocks[-1].append(k)
    return [
        Table(
            ("", *(heads[k] for k in block)),
            tuple((line, *(cells[k] for k in block)) for line, cells in lines),
        )
        for block in blocks
    ]


def _error_lines(comparison: ModelComparison, full: bool) -> _Lines:
    """Return errors with confidence intervals, per axis, and inside and outside the domain."""
    shown = _SHOWN if full else {key: text for key, text in _SHOWN.items() if key != "mean"}
    models = comparison.models
    lines: _Lines = []
    for quantity, first in models[0].quantities.items():
        errors = [model.quantities[quantity] for model in models]
        lines += _statistic_lines(comparison, f"{quantity}, {{}} [{first.unit}]", shown, errors)
        word = "along" if quantity == "position" else "about"
        for axis in first.axes if full else ():
            values = [rounded_text(one.axes[axis]["rms"], comparison.rows) for one in errors]
            lines.append((f"{quantity}, RMS {word} {axis} [{first.unit}]", values))
    if any(model.rows_outside_domain for model in models):
        for quantity, first in models[0].quantities.items():
            for where in ("inside", "outside"):
                cells = [
                    _domain(
                        getattr(model.quantities[quantity], f"{where}_statistics"),
                        getattr(model, f"rows_{where}_domain"),
                    )
                    for model in models
                ]
                lines.append((f"{quantity}, RMS {where} its domain [{first.unit}]", cells))
    return lines


def _statistic_lines(
    comparison: ModelComparison,
    label: str,
    shown: Mapping[str, str],
    errors: Sequence[QuantityErrors | Difference],
) -> _Lines:
    """Return statistics of every model, each followed by confidence intervals if there are any."""
    lines: _Lines = []
    for key, statistic in shown.items():
        lines.append(
            (label.format(statistic), [rounded_text(one.statistics[key], comparison.rows) for one in errors])
        )
        if errors[0].intervals.get(key) is not None:
            confidence = f"  {100 * comparison.bootstrap.confidence:.0f} % confidence"
            lines.append((confidence, [_interval(one.intervals[key]) for one in errors]))
    return lines


def _difference_lines(comparison: ModelComparison, full: bool) -> _Lines:
    """Return the differences of the other models to the first, with intervals and Wilcoxon's p."""
    first, *others = comparison.models
    lines: _Lines = []
    for quantity, errors in first.quantities.items():
        differences = [_difference(model.quantities[quantity]) for model in others]
        label = f"{quantity}, {{}} [{errors.unit}]"
        statistics = {"mean": "mean", "rms": "RMS"} if full else {"mean": "mean"}
        lines += _statistic_lines(comparison, label, statistics, differences)
        if not full:
            continue
        shares = [f"{100 * one.better_share:.0f} %" for one in differences]
        lines.append((f"{quantity}, better in", shares))
        lines.append((f"{quantity}, Wilcoxon's p", [_p(one.test.p) for one in differences]))
    return lines


def _difference(errors: QuantityErrors) -> Difference:
    assert errors.difference is not None  # only the first model has no differences
    return errors.difference


def _domain(statistics: Mapping[str, float], rows: int | None) -> str:
    return f"{rounded_text(statistics['rms'], rows or 0)} ({rows} rows)" if statistics else _NONE


def _interval(interval: Interval | None) -> str:
    if interval is None:
        return _NONE
    return f"[{', '.join(rounded_text(end, 0) for end in interval)}]"


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"
