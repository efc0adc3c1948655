"""Figures of a calibration: residuals, held-out errors, correlations, and the learned joint correction."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FixedFormatter, FixedLocator, LogLocator, NullFormatter
from torch import Tensor

from pisigma.calibration.geometric.identifiability.pairwise import CorrelationTable
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.reporting.figures import save_figure, set_margins
from pisigma.validation.held_out.pose_statistics import WITHIN, ErrorsWithPredictedSigma
from pisigma.validation.held_out.validation_figures import LearningPoint
from pisigma.validation.report.corrections import JOINT_UNITS

_UNITS = {"position": ("mm", 1e3), "rotation": ("deg", float(np.rad2deg(1.0)))}
_REDUNDANT = 1 - 1e-6
"""Absolute correlation above which two parameters are marked as redundant."""
_LETTER = 0.07
"""Width of a character of the names along tables [inch]."""
STYLES = {"nominal": (":", "s"), "geometric": ("--", "o"), "hybrid": ("-", "^")}
"""Line and marker of every model, so that models can be distinguished without colour."""
_POINTS = 1_000
"""Points of a curve: 9 per period of the 110th harmonic, 2 per pixel."""
_MAX_DOTS = 2_000
"""Largest number of dots in a panel; if there are more rows, an even selection of them is drawn."""
_LOG_RATIO = 5.0
"""Ratio of the largest to the smallest standard deviation above which axes are logarithmic."""
_BINS = 8
"""Bins with equal numbers of values in which predicted and actual spread are compared."""


def draw_residuals(
    residuals: Mapping[str, Float64[np.ndarray, "rows 3"]], path: Path, calibration: str = ""
) -> None:
    """Draw the residuals per coordinate over the rows.

    Args:
        residuals: measured minus predicted values of the calibration rows by sensor [m or rad]; NaN where nothing was
            measured.
        path: PNG file to write.
        calibration: calibration to which the residuals belong, for the title.
    """
    shown = [name for name in _UNITS if name in residuals]
    count = max(len(shown), 1)
    figure = Figure(figsize=(7.6, 3.3 * count))
    panels = figure.subplots(count, 1, squeeze=False)[:, 0]
    for axes, name in zip(panels, shown, strict=False):
        _draw_over_rows(axes, name, residuals[name], calibration)
    set_margins(figure, left=0.8, right=0.05, bottom=0.5, top=0.35, row_spacing=0.85)
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


def draw_held_out_errors(held_out: Mapping[str, Float64[np.ndarray, " held"]], path: Path) -> None:
    """Draw the cumulative distribution of held-out errors, one line per model.

    Args:
        held_out: lengths of the position errors of held-out rows by model [m].
        path: PNG file to write.
    """
    figure = Figure(figsize=(7.6, 3.8))
    axes = figure.subplots()
    for (name, lengths), style in zip(held_out.items(), ("--", "-", "-.", ":"), strict=False):
        errors = np.maximum(np.sort(lengths[np.isfinite(lengths)]) * 1e3, 1e-15)
        share = np.arange(1, len(errors) + 1) / len(errors) * 100
        rms, largest = np.sqrt((errors**2).mean()), errors.max(initial=0.0)
        axes.plot(errors, share, style, label=f"{name}: RMS {rms:.3g} mm, largest {largest:.3g} mm")
    axes.set(
        xlabel="position error [mm]",
        ylabel="share of rows with a smaller error [%]",
        xscale="log",
        ylim=(0, 100),
    )
    axes.set_title("held-out rows", loc="left", fontsize=10)
    low, high = axes.get_xlim()
    if low > 0 and high < 1e4 * low:  # few decades: plain numbers at 1, 2 and 5
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=9, frameon=False)
    set_margins(figure, left=0.65, right=0.05, bottom=0.95, top=0.3)
    save_figure(figure, path)


def draw_correlations(tables: Sequence[CorrelationTable], path: Path) -> None:
    """Draw the correlation matrices of length and angle parameters.

    Redundant pairs (+1 and -1 off the diagonal) are marked with a sign; parameters without effect are grey.

    Args:
        tables: correlations of lengths and of angles.
        path: PNG file to write.
    """
    largest = max(len(table.names) for table in tables)
    side = float(np.clip(0.27 * largest + 1.2, 4.0, 12.0))
    width = side * len(tables) + 0.9
    figure = Figure(figsize=(width, side + 0.3))
    grid = figure.subplots(1, len(tables), squeeze=False)[0]
    room = 0.15 + _LETTER * max(len(name) for table in tables for name in table.names)
    set_margins(figure, left=room, right=1.15, bottom=room + 0.35, top=0.35, column_spacing=room + 0.1)
    for axes, table, title in zip(grid, tables, ("lengths", "angles"), strict=True):
        shown = show_correlations(axes, table.names, table.values)
        axes.set_title(title, fontsize=11)
        apart = ~np.eye(len(table.names), dtype=bool)
        for sign, mark in ((1, "$+$"), (-1, "$-$")):
            row, column = np.nonzero((sign * np.nan_to_num(table.values) > _REDUNDANT) & apart)
            axes.scatter(column, row, marker=mark, color="white", s=60)
    bar = figure.colorbar(shown, cax=figure.add_axes((1 - 1.0 / width, 0.2, 0.2 / width, 0.65)))
    bar.set_label("Pearson correlation")
    figure.supxlabel(
        "white + or -: redundant (|r| = 1);  grey: without effect on what was measured", fontsize=10
    )
    save_figure(figure, path)


def show_correlations(
    axes: Axes, names: Sequence[str], values: Float64[np.ndarray, "_names _names"]
) -> AxesImage:
    """Show a correlation matrix as colours with the names along both axes; undefined values are grey."""
    axes.set_facecolor("0.85")
    shown = axes.imshow(values, cmap="RdBu", vmin=-1, vmax=1, interpolation="nearest")
    for axis in (axes.xaxis, axes.yaxis):  # unlike `set_xticks`, this makes no label before it is drawn
        axis.set_major_locator(FixedLocator(range(len(names))))
        axis.set_major_formatter(FixedFormatter(names))
    axes.tick_params(labelsize=8)
    axes.tick_params(axis="x", labelrotation=90)
    return shown


def draw_corrections(correction: JointCorrection, measurements: Measurements, path: Path) -> None:
    """Draw the correction of every joint against its value, and at the measured rows.

    Along the line, all other joints have their median values; the dots are at the measured joint values. Where the
    dots are off the line, the correction depends on other joints too.

    Args:
        correction: joint correction Δ.
        measurements: measured rows.
        path: PNG file to write.
    """
    joints, q = correction.robot.joints, measurements.q
    rows = (len(joints) + 1) // 2
    figure = Figure(figsize=(10.0, 2.3 * rows + 0.5))
    panels = figure.subplots(rows, 2, squeeze=False).flatten()
    set_margins(figure, left=0.7, right=0.05, bottom=0.7, top=0.25, column_spacing=0.75, row_spacing=0.7)
    with torch.no_grad():
        corrections = correction.for_rows(measurements).numpy()
    for j, (axes, joint) in enumerate(zip(panels, joints, strict=False)):
        unit, factor, small, scale = JOINT_UNITS[joint.type]
        values, line = _over_own_value(correction, q, j)
        step = max(len(q) // _MAX_DOTS, 1)
        axes.plot(
            q[::step, j].numpy() * factor, corrections[::step, j] * scale, ".", color="0.55", markersize=2.5
        )
        axes.plot(values * factor, line * scale, "-", color="black", linewidth=0.8)
        axes.axhline(0.0, color="black", linewidth=0.5, linestyle=":")
        axes.set_title(joint.name, loc="left", fontsize=10)
        axes.set_xlabel(f"joint value [{unit}]", fontsize=9)
        axes.set_ylabel(f"correction [{small}]", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.3)
    for axes in panels[len(joints) :]:
        axes.set_visible(False)
    figure.supxlabel("line: other joints at their medians;  dots: measured rows", fontsize=9)
    save_figure(figure, path)


def _over_own_value(
    correction: JointCorrection, q: Float64[Tensor, "rows dof"], joint: int
) -> tuple[Float64[np.ndarray, " points"], Float64[np.ndarray, " points"]]:
    """Return values of one joint over its measured range and its corrections, with other joints at their medians."""
    values = torch.linspace(float(q[:, joint].min()), float(q[:, joint].max()), _POINTS, dtype=torch.float64)
    at = q.median(0).values.repeat(_POINTS, 1)
    at[:, joint] = values
    with torch.no_grad():
        return values.numpy(), correction(at)[:, joint].numpy()


def draw_learning_curve(points: Sequence[LearningPoint], path: Path) -> None:
    """Draw the error on held-out rows against the number of training rows, with logarithmic axes.

    Args:
        points: errors by number of training rows, in ascending order.
        path: PNG file to write.
    """
    rows = [point.rows for point in points]
    names = [name for name in points[0].models if name != "nominal"]
    models = {name: [point.models[name].rms_mm or 0.0 for point in points] for name in names}
    figure = Figure(figsize=(6.8, 4.4))
    axes = figure.add_subplot()
    set_margins(figure, left=0.75, right=0.15, bottom=0.55, top=0.15)
    for name, errors in models.items():
        line, mark = STYLES.get(name, ("-.", "x"))
        axes.plot(rows, errors, line, marker=mark, label=name, linewidth=1.6, markersize=6)
        for count, error in zip(rows, errors, strict=True):
            axes.annotate(
                f"{error:.3f}", (count, error), (0, 6), textcoords="offset points", ha="center", fontsize=8
            )
    axes.set(xscale="log", yscale="log", xlabel="calibration rows", ylabel="RMS error of held-out rows [mm]")
    axes.set_xticks(rows, [str(count) for count in rows])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(0.06, 0.12)
    _plain_numbers(axes)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)
    save_figure(figure, path)


def draw_spread(spread: ErrorsWithPredictedSigma, path: Path) -> None:
    """Draw errors of held-out coordinates against their predicted standard deviations.

    The diamonds are the RMS errors of bins with equal numbers of values; they should be on the line.

    Args:
        spread: errors and predicted standard deviations, with at least one known value.
        path: PNG file to write.
    """
    judged = torch.isfinite(spread.error) & torch.isfinite(spread.sigma)
    sigma, error = spread.sigma[judged].numpy() * 1e3, np.abs(spread.error[judged].numpy()) * 1e3
    order = sigma.argsort(kind="stable")
    sigma, error = sigma[order], error[order]
    figure = Figure(figsize=(6.8, 5.2))
    axes = figure.add_subplot()
    set_margins(figure, left=0.75, right=0.15, bottom=0.55, top=0.35)
    step = max(len(sigma) // (3 * _MAX_DOTS), 1)
    axes.plot(sigma[::step], error[::step], ".", color="0.6", markersize=2, label="coordinate of a row")
    ends = np.array([sigma[0], sigma[-1]])
    axes.plot(ends, ends, "-", color="black", linewidth=1.0, label="as predicted")
    axes.plot(ends, WITHIN * ends, "--", color="black", linewidth=1.0, label="95 % should be below")
    parts = [part for part in np.array_split(np.arange(len(sigma)), _BINS) if len(part)]
    middle = [np.sqrt((sigma[part] ** 2).mean()) for part in parts]
    axes.plot(
        middle, [np.sqrt((error[part] ** 2).mean()) for part in parts], "D", color="tab:red",
        markeredgecolor="black", label="RMS error of a bin",
    )  # fmt: skip
    axes.set(xlabel="predicted standard deviation [mm]", ylabel="|error| [mm]")
    far = bool(ends[1] > _LOG_RATIO * ends[0])
    if far:
        axes.set(xscale="log", yscale="log", ylim=(float(np.quantile(error, 0.02)), None))
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_title(
        f"{spread.coverage * 100:.1f} % within 1.96 predicted standard deviations", loc="left", fontsize=10
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9, loc="upper left" if far else "upper right", framealpha=1.0)
    save_figure(figure, path)


def _plain_numbers(axes: Axes) -> None:
    """Label logarithmic axes with plain numbers such as 0.02, if they span few decades."""
    low, high = axes.get_ylim()
    if low > 0 and high < 1e3 * low:
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7) if high < 30 * low else (1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
