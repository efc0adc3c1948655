"""Figures of a training: energy curves, and joint errors over the workspace before and after correction."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

_MIN_ENERGY = 1e-32
"""Value at which 0 is drawn on a logarithmic axis."""


def write_energy_csv(joints: Sequence[str], energies: Float64[Tensor, "epochs joints"], path: Path) -> None:
    """Write the energy of every joint in every epoch as CSV, in scaled units (Jeong et al. 1998, Figs 5 and 8)."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["epoch", *(f"energy_{joint}" for joint in joints)])
        writer.writerows([epoch, *row] for epoch, row in enumerate(energies.tolist(), start=1))


def draw_energy(joints: Sequence[str], energies: Float64[Tensor, "epochs joints"], path: Path) -> None:
    """Draw the energy curves on logarithmic axes, with different line styles."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    epochs = np.arange(1, len(energies) + 1)
    styles = ("-", "--", "-.", ":")
    for index, (joint, curve) in enumerate(zip(joints, energies.t().tolist(), strict=True)):
        drawn = np.maximum(curve, _MIN_ENERGY)
        axes.plot(epochs, drawn, styles[index % 4], label=joint, linewidth=1.6)
    axes.set(xlabel="epoch", ylabel="energy E (scaled, no unit)", xscale="log", yscale="log")
    axes.set_title("training energy of every joint", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)
    save_figure(figure, path)


def draw_errors_over_workspace(
    joints: Sequence[str],
    units: Sequence[str],
    position: Float64[Tensor, "rows 3"],
    before: Float64[Tensor, "rows joints"],
    after: Float64[Tensor, "rows joints"],
    path: Path,
) -> None:
    """Draw the absolute joint error at every pose from above, before and after correction (paper's Fig. 6).

    Args:
        joints: names of the corrected joints.
        units: unit of each joint's errors, "deg" or "mm".
        position: tool positions [m].
        before: joint errors without correction, in the units of `units`.
        after: joint errors with correction, in the units of `units`.
        path: PNG file to write.
    """
    x, y = (position[:, axis].numpy() * 1e3 for axis in (0, 1))
    figure = Figure(figsize=(8.6, _row_height(x, y) * len(joints) + 0.6), layout="compressed")
    grid = figure.subplots(len(joints), 2, squeeze=False, sharex=True, sharey=True)
    for row, (joint, unit) in enumerate(zip(joints, units, strict=True)):
        for column, (errors, when) in enumerate(((before, "before"), (after, "after"))):
            axes = grid[row][column]
            values = errors[:, row].abs().numpy()
            top = max(float(values.max()), 1e-12)
            dots = axes.scatter(x, y, c=values, s=8, linewidths=0, cmap="viridis", vmin=0.0, vmax=top)
            bar = figure.colorbar(dots, ax=axes, format="%.2g")
            bar.set_label(f"|error| [{unit}]", fontsize=9)
            bar.ax.tick_params(labelsize=8)
            title = f"{joint}, {when}: mean {values.mean():.2g}, max {values.max():.2g} {unit}"
            axes.set_title(title, fontsize=9)
            axes.set_aspect("equal")
            axes.tick_params(labelsize=8)
    for axes in grid[-1]:
        axes.set_xlabel("x [mm]", fontsize=9)
    for row in range(len(joints)):
        grid[row][0].set_ylabel("y [mm]", fontsize=9)
    save_figure(figure, path)


def _row_height(x: Float64[np.ndarray, " rows"], y: Float64[np.ndarray, " rows"]) -> float:
    """Return the height [inch] of axes of 3.1 inch width with equal scales."""
    width, height = max(float(np.ptp(x)), 1.0), max(float(np.ptp(y)), 1.0)
    return float(np.clip(3.1 * height / width, 1.2, 5.0)) + 0.4


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a small PNG of 64 colours, without changing matplotlib's global state."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(120)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    image = Image.fromarray(pixels).convert("RGB")
    image.quantize(64).save(path, optimize=True)


def set_margins(
    figure: Figure,
    left: float,
    right: float,
    bottom: float,
    top: float,
    column_spacing: float = 0.0,
    row_spacing: float = 0.0,
) -> None:
    """Set margins around and between axes [inch]; measuring all texts instead would double the drawing time.

    Args:
        figure: figure of subplots.
        left: margin left of the first column.
        right: margin right of the last column.
        bottom: margin below the last row.
        top: margin above the first row.
        column_spacing: space between two columns.
        row_spacing: space between two rows.
    """
    width, height = figure.get_size_inches()
    grid = figure.axes[0].get_gridspec()
    assert grid is not None, "only figures of subplots have margins"
    rows, columns = grid.get_geometry()
    panel = (width - left - right - (columns - 1) * column_spacing) / columns
    storey = (height - bottom - top - (rows - 1) * row_spacing) / rows
    figure.subplots_adjust(
        left / width,
        bottom / height,
        1 - right / width,
        1 - top / height,
        column_spacing / panel,
        row_spacing / storey,
    )
