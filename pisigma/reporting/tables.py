"""Numbers and tables as text."""

import math
from collections.abc import Mapping, Sequence

from pisigma.reporting.result_text import Table
from pisigma.validation.held_out.training_summary import JointFigures
from pisigma.validation.held_out.validation_figures import ErrorFigures, SocketDistances

_STATISTICS = ("average", "deviation", "maximum")
_SHOWN = {"rms": "RMS", "p95": "95 %", "max": "maximum"}


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table of given columns and rows."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number_text(value: float) -> str:
    """Return a figure with four decimals, or two digits and an exponent below 0.001; NaN as "unknown"."""
    if math.isnan(value):
        return "unknown"
    return f"{value:.4f}" if value == 0 or abs(value) >= 1e-3 else f"{value:.1e}"


def percent_text(share: float) -> str:
    """Return a share as a percentage, such as "less than 1 %" instead of "0 %"."""
    if share < 0.005:
        return "less than 1 %"
    return "more than 99 %" if share > 0.995 else f"{100 * share:.0f} %"


def p_text(probability: float) -> str:
    """Return a p value as text, such as "p = 0.02"."""
    return "p < 1e-12" if probability < 1e-12 else f"p = {probability:.2g}"


def joint_rows(joints: Sequence[JointFigures]) -> list[tuple[str, ...]]:
    """Return a line per joint and set of rows: joint, unit, rows, then mean, deviation, maximum before and after."""
    lines = []
    for joint in joints:
        for label, errors in (
            ("training", joint.training),
            ("held-out", joint.held_out),
            ("paper", joint.paper),
        ):
            if errors is not None:
                figures = (*errors.before.values, *errors.after.values)
                lines.append((joint.name, errors.before.unit, label, *map(number_text, figures)))
    return lines


def joint_table(joints: Sequence[JointFigures]) -> str:
    """Return a Markdown table of joint errors, before and after correction side by side."""
    figures = (f"{when}: {name}" for when in ("before", "after") for name in _STATISTICS)
    return markdown_table(("joint", "unit", "rows", *figures), joint_rows(joints))


def pose_rows(models: Mapping[str, ErrorFigures]) -> Table:
    """Return a table of pose errors: one column per model, one row per figure.

    Args:
        models: errors by the name of the model.
    """
    figures = [errors.figures_by_name for errors in models.values()]
    rows = [(*_with_unit(name), *(number_text(errors[name]) for errors in figures)) for name in figures[0]]
    return Table(("error", "unit", *models), tuple(rows))


def pose_table(models: Mapping[str, ErrorFigures]) -> str:
    """Return a Markdown table of pose errors; see `pose_rows`."""
    return markdown_table(*pose_rows(models))


def distance_table(distances: SocketDistances) -> Table:
    """Return a table of stated distances between sockets, and the errors of every model [mm]."""
    models = list(distances.each[0].errors_mm)
    rows = [
        (
            " to ".join(one.sockets),
            f"{one.stated_mm:.6g}",
            *(number_text(one.errors_mm[name]) for name in models),
        )
        for one in distances.each
    ]
    return Table(("sockets", "stated [mm]", *(f"{name}, error [mm]" for name in models)), tuple(rows))


def _with_unit(name: str) -> tuple[str, str]:
    statistic, unit = name.rsplit("_", 1)
    quantity = "position" if unit == "mm" else "orientation"
    return f"{quantity}, {_SHOWN.get(statistic, statistic)}", unit
