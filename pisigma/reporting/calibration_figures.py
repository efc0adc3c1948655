"""Figures of a calibration: residuals, held-out errors, correlations."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from pisigma.identification.identifiability.pairwise import CorrelationTable
from pisigma.reporting.figures import save_figure

RESIDUALS_PNG = "residuals.png"
HELD_OUT_PNG = "held_out_errors.png"
CORRELATION_PNG = "correlation.png"

_UNITS = {"position": ("mm", 1e3), "rotation": ("deg", float(np.rad2deg(1.0)))}
_REDUNDANT = 1 - 1e-6


def draw_residuals(
    residuals: Mapping[str, Float64[np.ndarray, "rows 3"]], path: Path, under: str = ""
) -> None:
    """Draw the residuals per coordinate over the rows.

    Args:
        residuals: by sensor, measured minus predicted of the calibration rows [m or rad], NaN where nothing
            was measured.
        path: the PNG to write.
        under: which calibration the residuals are of, for the title.
    """
    shown = [name for name in _UNITS if name in residuals]
    count = max(len(shown), 1)
    figure = Figure(figsize=(7.6, 3.3 * count), layout="constrained")
    panels = figure.subplots(count, 1, squeeze=False)[:, 0]
    for axes, name in zip(panels, shown, strict=False):
        _draw_over_rows(axes, name, residuals[name], under)
    save_figure(figure, path)


def _draw_over_rows(axes: Axes, name: str, residuals: np.ndarray, under: str) -> None:
    unit, factor = _UNITS[name]
    size = 5 if len(residuals) <= 200 else 3 if len(residuals) <= 1000 else 2
    for column, (label, mark) in enumerate((("x", "o"), ("y", "s"), ("z", "^"))):
        values = residuals[:, column] * factor
        axes.plot(np.arange(1, len(values) + 1), values, mark, markersize=size, label=label, alpha=0.6)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set(xlabel="row", ylabel=f"residual [{unit}]")
    axes.set_title(f"measured minus predicted {name}, calibration rows{under}", loc="left", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(ncols=3, loc="lower right", bbox_to_anchor=(1, 1), frameon=False, markerscale=2)


def draw_held_out(held_out: Mapping[str, Float64[np.ndarray, " held"]], path: Path) -> None:
    """Draw how the errors of rows that the calibration did not see are spread, one line for every model.

    Args:
        held_out: by model, lengths of the position errors [m].
        path: the PNG to write.
    """
    figure = Figure(figsize=(7.6, 3.8), layout="constrained")
    axes = figure.subplots()
    for (name, lengths), style in zip(held_out.items(), ("--", "-", "-.", ":"), strict=False):
        known = np.maximum(np.sort(lengths[np.isfinite(lengths)]) * 1e3, 1e-15)
        share = np.arange(1, len(known) + 1) / len(known) * 100
        rms, largest = np.sqrt((known**2).mean()), known.max(initial=0.0)
        axes.plot(known, share, style, label=f"{name}: RMS {rms:.3g} mm, largest {largest:.3g} mm")
    axes.set(xlabel="position error [mm]", ylabel="share of rows below [%]", xscale="log", ylim=(0, 100))
    axes.set_title("rows that the calibration did not see", loc="left", fontsize=10)
    low, high = axes.get_xlim()
    if low > 0 and high < 1e4 * low:  # narrow enough for plain numbers at 1, 2 and 5
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=9, frameon=False)
    save_figure(figure, path)


def draw_correlations(tables: Sequence[CorrelationTable], path: Path) -> None:
    """Draw the correlation tables of length and angle parameters.

    +1 and -1 beside the diagonal mean redundant and bear a sign; parameters without effect are grey.

    Args:
        tables: of lengths and of angles.
        path: the PNG to write.
    """
    largest = max(len(table.names) for table in tables)
    side = float(np.clip(0.27 * largest + 1.2, 4.0, 12.0))
    figure = Figure(figsize=(side * len(tables) + 0.9, side + 0.3), layout="constrained")
    grid = figure.subplots(1, len(tables), squeeze=False)[0]
    for axes, table, title in zip(grid, tables, ("lengths", "angles"), strict=True):
        shown = axes.imshow(table.values, cmap="RdBu", vmin=-1, vmax=1, interpolation="nearest")
        axes.set_facecolor("0.85")
        axes.set_xticks(range(len(table.names)), table.names, rotation=90, fontsize=8)
        axes.set_yticks(range(len(table.names)), table.names, fontsize=8)
        axes.set_title(title, fontsize=11)
        apart = ~np.eye(len(table.names), dtype=bool)
        for sign, mark in ((1, "$+$"), (-1, "$-$")):
            row, column = np.nonzero((sign * np.nan_to_num(table.values) > _REDUNDANT) & apart)
            axes.scatter(column, row, marker=mark, color="white", s=60)
    bar = figure.colorbar(shown, ax=list(grid), shrink=0.8)
    bar.set_label("Pearson correlation")
    figure.supxlabel(
        "white + or -: redundant (|r| = 1);  grey: without effect on what was measured", fontsize=10
    )
    save_figure(figure, path)
