"""A comparison of models as tables for people."""

from collections.abc import Mapping, Sequence
from typing import Any

from pisigma.reporting.tables import figure_text

Table = tuple[list[str], list[tuple[str, ...]]]
"""Names of the columns, and rows."""

_QUANTITIES = (("position", "mm"), ("orientation", "deg"))
_SHOWN = (("rms", "RMS"), ("mean", "mean"), ("p95", "95 %"), ("max", "maximum"))
_NONE = "-"


def comparison_table(report: Mapping[str, Any]) -> Table:
    """One column per model, one row per figure, with the confidence interval where there is one.

    Args:
        report: from `pisigma.reporting.comparison_report.report_comparison`.
    """
    models = report["models"]
    rows = []
    for quantity, unit in _QUANTITIES:
        if f"rms_{unit}" in models[0]:
            for key, shown in _SHOWN:
                cells = (_with_interval(model, f"{key}_{unit}") for model in models)
                rows.append((f"{quantity}, {shown}", unit, *cells))
            word = "along" if quantity == "position" else "about"
            for axis in "xyz":
                cells = (figure_text(model["axes"][axis][f"rms_{unit}"]) for model in models)
                rows.append((f"{quantity}, RMS {word} {axis}", unit, *cells))
    rows += _domain_rows(models)
    return ["error", "unit", *(model["name"] for model in models)], rows


def difference_table(report: Mapping[str, Any]) -> Table:
    """One row per quantity and model from the second on: differences to the first, with intervals and Wilcoxon's p."""
    rows = []
    for model in report["models"][1:]:
        for quantity, unit in _QUANTITIES:
            found = model["difference_to_first"].get(quantity)
            if found is not None:
                cells = (
                    _figure_and_interval(found[f"{key}_{unit}"], found[f"{key}_{unit}_interval"])
                    for key in ("mean", "rms")
                )
                better = f"{100 * found['better_share']:.0f} %"
                rows.append((model["name"], quantity, unit, *cells, better, _p(found["wilcoxon"]["p"])))
    return ["model", "error", "unit", "mean", "RMS", "better in", "p"], rows


def _domain_rows(models: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """RMS inside and outside the domain, where a model has rows outside of it."""
    if all(model.get("outside_domain") is None for model in models):
        return []
    rows = []
    for quantity, unit in _QUANTITIES:
        if f"rms_{unit}" in models[0]:
            for key, shown in (("inside_domain", "inside"), ("outside_domain", "outside")):
                cells = (_part_text(model.get(key), f"rms_{unit}") for model in models)
                rows.append((f"{quantity}, RMS {shown} its domain", unit, *cells))
    return rows


def _part_text(part: Mapping[str, Any] | None, name: str) -> str:
    if part is None or name not in part:
        return _NONE
    return f"{figure_text(part[name])} ({part['rows']} rows)"


def _with_interval(model: Mapping[str, Any], name: str) -> str:
    return _figure_and_interval(model[name], model["intervals"].get(name))


def _figure_and_interval(value: float, interval: Sequence[float] | None) -> str:
    if interval is None:
        return figure_text(value)
    return f"{figure_text(value)} [{', '.join(f'{end:.3g}' for end in interval)}]"


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"
