"""A comparison of models as tables for people."""

from collections.abc import Mapping
from dataclasses import dataclass

from pisigma.judging.model_comparison import Difference, Interval, ModelComparison, QuantityErrors
from pisigma.reporting.tables import figure_text

_SHOWN = (("rms", "RMS"), ("mean", "mean"), ("p95", "95 %"), ("max", "maximum"))
_NONE = "-"


@dataclass(frozen=True)
class ModelTable:
    """A table with one column per model.

    Attributes:
        title: what it shows.
        models: heads of the columns.
        lines: per line what it is, and a cell per model.
    """

    title: str
    models: tuple[str, ...]
    lines: tuple[tuple[str, tuple[str, ...]], ...]

    def fitting(self, width: int) -> list[tuple[list[str], list[tuple[str, ...]]]]:
        """Give heads and rows, as several tables one below the other where the models do not fit a width."""
        label = max(len(line) for line, _ in self.lines)
        cells = [
            max(map(len, column)) for column in zip(self.models, *(c for _, c in self.lines), strict=True)
        ]
        blocks: list[list[int]] = [[]]
        for number, size in enumerate(cells):
            if blocks[-1] and label + sum(cells[k] + 2 for k in blocks[-1]) + size + 4 > width:
                blocks.append([])
            blocks[-1].append(number)
        return [
            (
                ["", *(self.models[k] for k in block)],
                [(line, *(texts[k] for k in block)) for line, texts in self.lines],
            )
            for block in blocks
        ]


def error_table(comparison: ModelComparison) -> ModelTable:
    """Make a table of the errors of every model, with confidence intervals where there are some."""
    models = comparison.models
    lines: list[tuple[str, tuple[str, ...]]] = []
    confidence = _confidence(comparison)
    for quantity, first in models[0].quantities.items():
        errors = [model.quantities[quantity] for model in models]
        for key, shown in _SHOWN:
            values = tuple(figure_text(one.statistics[key]) for one in errors)
            lines.append((f"{quantity}, {shown} [{first.unit}]", values))
            if first.intervals.get(key) is not None:
                lines.append((confidence, tuple(_interval(one.intervals[key]) for one in errors)))
        word = "along" if quantity == "position" else "about"
        for axis in "xyz":
            values = tuple(figure_text(one.axes[axis]["rms"]) for one in errors)
            lines.append((f"{quantity}, RMS {word} {axis} [{first.unit}]", values))
    if any(model.rows_outside for model in models):
        for quantity, first in models[0].quantities.items():
            for where in ("inside", "outside"):
                cells = (
                    _domain(getattr(model.quantities[quantity], where), getattr(model, f"rows_{where}"))
                    for model in models
                )
                lines.append((f"{quantity}, RMS {where} its domain [{first.unit}]", tuple(cells)))
    title = f"Errors of {comparison.rows} rows ({comparison.configurations} configurations)"
    return ModelTable(title, tuple(model.name for model in models), tuple(lines))


def difference_table(comparison: ModelComparison) -> ModelTable:
    """Make a table of the differences of every later model to the first, with intervals and Wilcoxon's p."""
    first, *others = comparison.models
    lines: list[tuple[str, tuple[str, ...]]] = []
    confidence = _confidence(comparison)
    for quantity, errors in first.quantities.items():
        differences = [_difference(model.quantities[quantity]) for model in others]
        for key, shown in (("mean", "mean"), ("rms", "RMS")):
            values = tuple(figure_text(one.statistics[key]) for one in differences)
            lines.append((f"{quantity}, {shown} [{errors.unit}]", values))
            if differences[0].intervals[key] is not None:
                lines.append((confidence, tuple(_interval(one.intervals[key]) for one in differences)))
        shares = tuple(f"{100 * one.better_share:.0f} %" for one in differences)
        lines.append((f"{quantity}, better in", shares))
        lines.append((f"{quantity}, Wilcoxon's p", tuple(_p(one.test.p) for one in differences)))
    title = f"Differences to {first.name}, below 0 is better, on the same rows"
    return ModelTable(title, tuple(model.name for model in others), tuple(lines))


def _difference(errors: QuantityErrors) -> Difference:
    assert errors.difference is not None  # only the first model has none
    return errors.difference


def _confidence(comparison: ModelComparison) -> str:
    return f"  {100 * comparison.bootstrap.confidence:.0f} % confidence"


def _domain(statistics: Mapping[str, float], rows: int | None) -> str:
    return f"{figure_text(statistics['rms'])} ({rows} rows)" if statistics else _NONE


def _interval(interval: Interval | None) -> str:
    return _NONE if interval is None else f"[{interval[0]:.3g}, {interval[1]:.3g}]"


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"
