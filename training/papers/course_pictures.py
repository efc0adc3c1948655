"""Pictures of the progress of trainings and calibrations: energies, errors at every point, RMSE over iterations."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from pisigma.files.errors import RecipeError
from pisigma.reporting.figures import save_figure
from published import Convergence
from stored_results import Result

STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
MARKERS = ("o", "s", "^", "v", "D", "P")

_LEAST = 1e-32
"""Value at which 0 is drawn on a logarithmic axis."""


def draw_energies(ways: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draw energy curves (Jeong et al. 1998, Figs 5 and 8), with a separate line style and marker per joint.

    Args:
        ways: `energies` of each method's result, by the name of the method.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    for axes, (title, energies) in zip(figure.subplots(1, len(ways)), ways.items(), strict=True):
        epochs = energies["epoch"]
        for place, (joint, values) in enumerate((k, v) for k, v in energies.items() if k != "epoch"):
            axes.plot(
                epochs,
                np.maximum(values, _LEAST),
                linestyle=STYLES[place],
                marker=MARKERS[place],
                markersize=4,
                markevery=(3 * place, 16),
                linewidth=1.4,
                label=f"{joint}: {values[-1]:.1e} at the end",
            )
        axes.set(xscale="log", yscale="log", xlabel="epoch", ylabel="energy E (scaled, no unit)")
        axes.set_title(f"{title}: {epochs[-1]} epochs", fontsize=10)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="upper right")
    save_figure(figure, path)


def draw_errors_on_grid(points: Mapping[str, Any], path: Path) -> None:
    """Draw the error at every point of a polar grid, before and after, with the value in every cell (Figs 4 and 6).

    Args:
        points: `points` of a result.
        path: The PNG file to write.

    Raises:
        RecipeError: The points do not form a polar grid.
    """
    x, y = np.array(points["x_mm"]), np.array(points["y_mm"])
    radius, row = np.unique(np.hypot(x, y).round(1), return_inverse=True)
    angle, column = np.unique(np.rad2deg(np.arctan2(y, x)).round(2), return_inverse=True)
    if len(radius) * len(angle) != len(x):
        raise RecipeError(expected="training points on a polar grid", value=f"{len(x)} points that are not")
    joints = points["errors"]
    figure = Figure(figsize=(11.4, 4.9 * len(joints)), layout="constrained")
    grid = figure.subplots(len(joints), 2, squeeze=False)
    for panels, (joint, errors) in zip(grid, joints.items(), strict=True):
        for axes, when in zip(panels, ("before", "after"), strict=True):
            values = np.full((len(radius), len(angle)), np.nan)
            values[row, column] = errors[f"{when}_deg"]
            _cells(axes, values, 2 if when == "before" else 3)
            size = np.abs(values)
            axes.set_title(
                f"{joint}, {when} [deg]: average |error| {size.mean():.4f}, maximum {size.max():.4f}",
                fontsize=10,
            )
            axes.set_xticks(range(len(angle)), [f"{value:.1f}" for value in angle], fontsize=8)
            axes.set_yticks(range(len(radius)), [f"{value:.0f}" for value in radius], fontsize=8)
            axes.set_xlabel("angle [deg]", fontsize=9)
            axes.set_ylabel("radius [mm]", fontsize=9)
    save_figure(figure, path)


def _cells(axes: Axes, values: np.ndarray, decimals: int) -> None:
    """Draw cells with a shade and a value according to the error."""
    size = np.abs(values)
    top = float(size.max()) or 1.0
    axes.imshow(size, cmap="Greys", vmin=0.0, vmax=1.6 * top, origin="lower", aspect="auto")
    for row, column in np.ndindex(values.shape):
        text = f"{values[row, column]:+.{decimals}f}".replace("0.", ".", 1)
        shade = "white" if size[row, column] > 0.85 * top else "black"
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=shade)


def draw_rmse(robots: Mapping[str, tuple[Convergence, Result]], path: Path) -> None:
    """Draw the RMSE over iterations, ours and the paper's (Park et al. 2022, Figs 10 and 11).

    Args:
        robots: Published convergence and our result, by the name of the robot.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    for axes, (title, (published, result)) in zip(
        figure.subplots(1, len(robots)), robots.items(), strict=True
    ):
        cases = result["elimination_cases"]
        for place, case in enumerate(cases):
            values, name = case["rmse_mm"], f"case {place + 1}" if case["removed"] else "none eliminated"
            label = f"ours, {name} ({case['parameters']} parameters): {len(values) - 1} steps"
            axes.plot(
                range(len(values)),
                values,
                linestyle=STYLES[place],
                marker=MARKERS[place],
                markersize=5,
                label=label,
            )
        paper = [row[-1] for row in published.rmse_mm]
        axes.plot(
            published.iterations, paper, "k:", marker="x", label="paper, none eliminated (cases are similar)"
        )
        axes.set_xscale("symlog", linthresh=10, linscale=1.2)
        axes.set_xticks(
            [0, 2, 4, 6, 8, 10, 100, 300, 1000], ["0", "2", "4", "6", "8", "10", "100", "300", "1000"]
        )
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set(
            yscale="log",
            xlabel="iteration (linear up to 10, then logarithmic)",
            ylabel="RMSE [mm]",
            ylim=(3e-14, 200),
        )
        axes.set_title(
            f"{title}: from {cases[0]['rmse_mm'][0]:.1f} mm (paper: {paper[0]:.1f} mm)", fontsize=10
        )
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="upper right")
    save_figure(figure, path)
