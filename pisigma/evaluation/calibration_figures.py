"""Figures of a geometric calibration: residuals before and after, correlations, convergence."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from matplotlib.figure import Figure

from pisigma.evaluation.figures import save_figure
from pisigma.identification.pairwise import CorrelationTable

RESIDUALS_PNG = "residuals.png"
CORRELATION_PNG = "correlation.png"


def draw_residuals(
    residuals: Float64[np.ndarray, "rows 3"], held_out: dict[str, Float64[np.ndarray, " rows"]], path: Path
) -> None:
    """Draw the residuals per coordinate over the rows, and how the held-out errors are spread.

    Args:
        residuals: measured minus predicted position of the training rows [m], NaN where nothing was measured.
        held_out: by model, lengths of the held-out position errors [m]; may be empty.
        path: the PNG to write.
    """
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    axes = figure.subplots(2, 1)
    for column, (name, mark) in enumerate((("x", "o"), ("y", "s"), ("z", "^"))):
        axes[0].plot(
            residuals[:, column] * 1e3, mark, markersize=2.5, label=name, alpha=0.7, linestyle="none"
        )
    axes[0].axhline(0.0, color="black", linewidth=0.8)
    axes[0].set(xlabel="row", ylabel="residual [mm]", title="measured - predicted position, calibration rows")
    axes[0].legend(ncols=3)
    for (name, lengths), style in zip(held_out.items(), ("--", "-", "-.", ":"), strict=False):
        known = np.sort(lengths[np.isfinite(lengths)]) * 1e3
        share = np.arange(1, len(known) + 1) / len(known)
        axes[1].plot(known, share, style, label=f"{name}: RMS {np.sqrt((known**2).mean()):.3f} mm")
    axes[1].set(
        xlabel="position error of held-out rows [mm]", ylabel="share of rows below", xscale="log", ylim=(0, 1)
    )
    axes[1].grid(alpha=0.3)
    if held_out:
        axes[1].legend()
    save_figure(figure, path)


def draw_correlations(tables: Sequence[CorrelationTable], path: Path) -> None:
    """Draw the correlation tables of length and angle parameters; ±1 means redundant, crosses have no effect."""
    figure = Figure(figsize=(7.5 * len(tables), 6.8), layout="constrained")
    grid = figure.subplots(1, len(tables), squeeze=False)
    for axes, table in zip(grid[0], tables, strict=True):
        image = axes.imshow(table.values, cmap="RdBu", vmin=-1, vmax=1)
        axes.set_xticks(range(len(table.names)), table.names, rotation=90, fontsize=7)
        axes.set_yticks(range(len(table.names)), table.names, fontsize=7)
        for row, column in zip(*np.nonzero(np.isnan(table.values)), strict=True):
            axes.text(column, row, "x", ha="center", va="center", fontsize=5, color="gray")
        for row, column in zip(*np.nonzero(np.abs(table.values) > 1 - 1e-6), strict=True):
            if row != column:
                axes.text(
                    column,
                    row,
                    "+" if table.values[row, column] > 0 else "-",
                    ha="center",
                    va="center",
                    color="white",
                )
    figure.colorbar(image, ax=grid[0].tolist(), label="Pearson correlation")
    save_figure(figure, path)
