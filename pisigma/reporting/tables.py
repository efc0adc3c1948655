"""Figures as text: numbers, and the Markdown tables of the cards."""

from collections.abc import Mapping, Sequence
from typing import Any

from pisigma.reporting.markdown import markdown_table

PARTS = (("training", "training"), ("held_out", "held-out"), ("paper", "paper"))
"""Keys of a joint's figures and what the tables call them."""

_STATISTICS = ("average", "deviation", "maximum")
_SHOWN = {"rms": "RMS", "p95": "95 %", "max": "maximum"}


def figure_text(value: float) -> str:
    """A figure with four decimals, or two digits and an exponent where these would say little."""
    return f"{value:.4f}" if value == 0 or abs(value) >= 1e-3 else f"{value:.1e}"


def joint_rows(joints: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Per joint and part: joint, unit, part, then average, deviation, maximum before and after.

    Args:
        joints: from `pisigma.reporting.training_report.report_joints`.
    """
    rows = []
    for joint in joints:
        for part, label in PARTS:
            if part in joint:
                unit = next(iter(joint[part]["before"])).rsplit("_", 1)[1]
                figures = [
                    figure_text(joint[part][when][f"{name}_{unit}"])
                    for when in ("before", "after")
                    for name in _STATISTICS
                ]
                rows.append((joint["name"], unit, label, *figures))
    return rows


def joint_table(joints: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table of the joint errors; one line per joint and part, before and after side by side."""
    head = [
        "joint",
        "unit",
        "rows",
        *(f"{when}: {name}" for when in ("before", "after") for name in _STATISTICS),
    ]
    return markdown_table(head, joint_rows(joints))


def pose_rows(models: Mapping[str, Mapping[str, float]]) -> tuple[list[str], list[tuple[str, ...]]]:
    """Names of the columns and the rows of pose errors: one column per model, one row per figure.

    Args:
        models: by name, the figures of `pisigma.judging.pose_statistics.PoseErrors.in_file_units`.
    """
    names = next(iter(models.values()))
    rows = [
        (*_with_unit(name), *(figure_text(figures[name]) for figures in models.values())) for name in names
    ]
    return ["error", "unit", *models], rows


def pose_table(models: Mapping[str, Mapping[str, float]]) -> str:
    """A Markdown table of pose errors, one column per model. See `pose_rows`."""
    return markdown_table(*pose_rows(models))


def _with_unit(name: str) -> tuple[str, str]:
    statistic, unit = name.rsplit("_", 1)
    quantity = "position" if unit == "mm" else "orientation"
    return f"{quantity}, {_SHOWN.get(statistic, statistic)}", unit
