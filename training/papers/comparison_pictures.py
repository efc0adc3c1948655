"""Pictures that compare errors: joints before and after, jigs, numbers of training rows."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from pisigma.reporting.figures import save_figure
from stored_results import Result

BARS = (("0.85", ""), ("0.65", "////"), ("0.95", "...."), ("0.4", ""))
"""Shade and hatch of adjacent bars."""
MODELS = (("nominal", ":", "o"), ("geometric", "--", "s"), ("hybrid", "-", "^"))

_JIG_BARS = {"nominal": "nominal", "jig_1": "jig 1 alone", "jig_2": "jig 2 alone", "both": "both jigs"}


def draw_joint_errors(
    robots: Mapping[str, tuple[Sequence[dict[str, Any]], Sequence[dict[str, Any]]]], path: Path
) -> None:
    """Draw the average joint errors before and after, the paper's and ours.

    Args:
        robots: By name, `joints` of the results of the paper's method and of the default.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(12.4, 4.8), layout="constrained")
    counts = [len(paper) for paper, _ in robots.values()]
    panels = figure.subplots(1, len(robots), width_ratios=counts, sharey=True)
    for axes, (title, (paper, default)) in zip(panels, robots.items(), strict=True):
        averages = {
            "before": [joint["training"]["before"]["average_deg"] for joint in paper],
            "after, paper": [joint["paper"]["after"]["average_deg"] for joint in paper],
            "after, ours, method of the paper": [
                joint["training"]["after"]["average_deg"] for joint in paper
            ],
            "after, ours, default": [joint["training"]["after"]["average_deg"] for joint in default],
        }
        _bars(axes, averages, [joint["name"] for joint in paper], "{:.2g}", rotation=90.0)
        axes.set(yscale="log", ylim=(3e-6, 200))
        axes.set_title(title, fontsize=10)
    panels[0].set_ylabel("average |error| at the training points [deg]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    save_figure(figure, path)


def draw_jigs(result: Result, path: Path) -> None:
    """Draw RMS error and deviation at the test points, ours over the seeds and the paper's.

    Args:
        result: Result of the recipe of jigs.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(11.4, 4.6), layout="constrained")
    published, seeds = result["paper"]["absolute_error_mm"], result["seeds"]
    seen = [value for name, value in published.items() if name.startswith("both_seen_from")]
    for axes, name in zip(figure.subplots(1, 2), ("rms", "deviation"), strict=True):
        alone = [published[setup][name] for setup in _JIG_BARS if setup in published]
        bars = {
            "paper": [*alone, float(np.mean([value[name] for value in seen]))],
            f"ours, mean of {seeds['count']} seeds": [seeds["averages"][s][f"{name}_mm"] for s in _JIG_BARS],
        }
        spreads = [None, [seeds["spreads"][setup][f"{name}_mm"] for setup in _JIG_BARS]]
        _bars(axes, bars, list(_JIG_BARS.values()), "{:.2f}", spreads=spreads)
        axes.set(
            yscale="log", ylim=(0.04, 20), ylabel=f"{'RMS error' if name == 'rms' else name} at P1 to P4 [mm]"
        )
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.legend(fontsize=9, loc="upper right")
    save_figure(figure, path)


def draw_learning_curves(robots: Mapping[str, Result], path: Path) -> None:
    """Draw the position errors of held-out rows against the number of training rows.

    Args:
        robots: Results of hybrid recipes, by title.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(12.4, 4.2), layout="constrained")
    panels = figure.subplots(1, len(robots))
    for axes, (title, result) in zip(panels, robots.items(), strict=True):
        curve = result["learning_curve"]
        rows = [point["rows"] for point in curve]
        for name, style, mark in MODELS:
            values = [point[name]["rms_mm"] for point in curve]
            axes.plot(rows, values, linestyle=style, marker=mark, color="black", markersize=5, label=name)
            for row, value in zip(rows, values, strict=True):
                axes.annotate(
                    f"{value:.3f}", (row, value), (0, 6), textcoords="offset points", ha="center", fontsize=7
                )
        axes.set(xscale="log", yscale="log", xlabel="training rows")
        axes.margins(0.09)
        axes.set_xticks(rows, [str(row) for row in rows])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_title(title, fontsize=10)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("position error of held-out rows, RMS [mm]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    save_figure(figure, path)


def _bars(
    axes: Axes,
    groups: Mapping[str, Sequence[float]],
    names: Sequence[str],
    form: str,
    *,
    rotation: float = 0.0,
    spreads: Sequence[Sequence[float] | None] | None = None,
) -> None:
    """Draw adjacent bars with their values above them."""
    width = 0.84 / len(groups)
    fills = BARS if len(groups) > 2 else BARS[:2]
    for place, ((label, values), (shade, hatch)) in enumerate(zip(groups.items(), fills, strict=False)):
        at = np.arange(len(values)) + width * (place - (len(groups) - 1) / 2)
        spread = None if spreads is None else spreads[place]
        axes.bar(at, values, width, color=shade, hatch=hatch, edgecolor="black", linewidth=0.7, label=label)
        tops = np.array(values)
        if spread is not None:
            axes.errorbar(at, values, yerr=spread, fmt="none", ecolor="black", capsize=3)
            tops = tops + np.array(spread)
        for x, top, value in zip(at, tops, values, strict=True):
            text = form.format(value)
            axes.annotate(
                text,
                (x, top),
                (0, 3),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=8,
                rotation=rotation,
            )
    axes.set_xticks(range(len(names)), names)
    axes.grid(alpha=0.3, axis="y")
