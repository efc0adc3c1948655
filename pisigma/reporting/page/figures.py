"""Figures of a report: many dots are rasterised, and names are shown verbatim."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator

from pisigma.reporting.calibration_figures import STYLES, show_correlations
from pisigma.reporting.page.content import ReportContent
from pisigma.reporting.page.drawing import AFTER, BEFORE, OTHER, Drawing, drawing_style
from pisigma.reporting.page.wording import LAYER_LABELS, curve_text, dependence_text
from pisigma.validation.held_out.validation_figures import LearningPoint
from pisigma.validation.report.corrections import CorrectionCurve, Correlations
from pisigma.validation.report.dependence import Dependence, bin_errors
from pisigma.validation.report.error_map import Layer

SIZE = (5.2, 3.1)
"""Width and height of a panel [inch]."""
_MANY_DOTS = 200
"""Number of dots above which they are rasterised."""
_MAX_MAP_DOTS = 1_500
"""Number of rows with the largest errors of which the flat map has dots, and largest number of other dots; of other
rows, every fourth has a dot."""
_COLORS = {"nominal": BEFORE, "geometric": OTHER, "hybrid": AFTER}


@dataclass(frozen=True, eq=False)
class ReportFigures:
    """Drawings of a report.

    Attributes:
        map: error map from above and from the side.
        dependences: errors against joint values, order, payload and temperature.
        correlations: correlations of lengths and of angles.
        corrections: corrections of the joints.
        learning_curve: learning curve; empty if there is none.
        images: images with the nominal and the calibrated arm; see `arm_pictures`.
    """

    map: Drawing
    dependences: tuple[Drawing, ...]
    correlations: tuple[Drawing, ...]
    corrections: tuple[Drawing, ...]
    learning_curve: tuple[Drawing, ...]
    images: tuple[Drawing, ...] = ()

    @property
    def all(self) -> tuple[Drawing, ...]:
        """All drawings."""
        charts = (*self.dependences, *self.correlations, *self.corrections, *self.learning_curve)
        return (self.map, *charts, *self.images)


def draw_figures(content: ReportContent) -> ReportFigures:
    """Draw the figures of a report."""
    points = (content.summary.learning_curve if content.summary else None) or ()
    return ReportFigures(
        map=draw_map(
            "error_map", "map", "Errors over the workspace", content.map.position_mm, content.map.layers[:3]
        ),
        dependences=tuple(map(draw_dependence, content.dependences)),
        correlations=draw_correlations(content.correlations.tables),
        corrections=tuple(map(draw_correction, content.curves)),
        learning_curve=(draw_learning_curve(points),) if len(points) > 1 else (),
    )


def draw_dependence(dependence: Dependence) -> Drawing:
    """Draw errors over one quantity: a dot for every row, and RMS errors of bins."""
    with drawing_style():
        figure, axes = make_panel()
        if "before" in dependence.errors:
            _lengths(axes, dependence)
        else:
            _signed(axes, dependence)
        unit = f" [{dependence.unit}]" if dependence.unit else ""
        axes.set_xlabel(f"{dependence.title}{unit}")
    return Drawing(f"residual_{dependence.key}", dependence.title, dependence_text(dependence), figure)


def draw_correction(curve: CorrectionCurve) -> Drawing:
    """Draw the correction of a joint against its value, with the measured range shaded."""
    with drawing_style():
        figure, axes = make_panel()
        for low, high in _stretches(curve.values, curve.measured):
            axes.axvspan(low, high, color="0.92", linewidth=0)
        dots = axes.plot(
            curve.row_values, curve.row_corrections, ".", color=OTHER, alpha=0.5, markersize=3, label="_rows"
        )
        dots[0].set_rasterized(len(curve.row_corrections) > _MANY_DOTS)
        for where, line, label in (
            (curve.measured, "-", "_measured"),
            (~curve.measured, "--", "_extrapolated"),
        ):
            shown = np.where(where, curve.correction, np.nan)
            axes.plot(curve.values, shown, line, color=AFTER, linewidth=1.3, label=label)
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.set(xlabel=f"{curve.joint} [{curve.unit}]", ylabel=f"correction [{curve.correction_unit}]")
    return Drawing(f"correction_{curve.joint}", curve.joint, curve_text(curve), figure)


def draw_correlations(tables: Sequence[Correlations]) -> tuple[Drawing, ...]:
    """Draw correlations of lengths and of angles; redundant pairs are marked with the sign of their correlation."""
    named = zip(("lengths", "angles"), tables, strict=False)
    return tuple(_correlations(title, table) for title, table in named if table[0])


def _correlations(title: str, table: Correlations) -> Drawing:
    names, values = table
    with drawing_style():
        side = float(np.clip(0.25 * len(names) + 1.3, 3.4, 9.0))
        figure = Figure(figsize=(side + 0.9, side), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(False)
        shown = show_correlations(axes, names, values)
        for (i, k), value in np.ndenumerate(np.nan_to_num(values)):
            if i != k and abs(value) >= 0.5:
                sign = "+" if value > 0 else "−"
                text = sign if abs(value) > 1 - 1e-6 else f"{10 * abs(value):.0f}"
                color = "white" if abs(value) > 0.7 else "black"
                axes.text(k, i, text, ha="center", va="center", fontsize=6.5, color=color)
        figure.colorbar(shown, ax=axes, shrink=0.8).set_label("Pearson correlation")
    alt = f"Correlations of {len(names)} {title}; the strongest pairs are listed in the text."
    return Drawing(f"correlation_{title}", title, alt, figure)


def draw_learning_curve(points: Sequence[LearningPoint]) -> Drawing:
    """Draw errors of held-out rows against the number of calibration rows, with logarithmic axes."""
    with drawing_style():
        figure, axes = make_panel()
        rows = [point.rows for point in points]
        for name in points[0].models:
            line, mark = STYLES[name]
            errors = [point.models[name].rms_mm for point in points]
            axes.plot(rows, errors, line, marker=mark, label=name, color=_COLORS[name])  # type: ignore[arg-type]
        axes.set(
            xscale="log", yscale="log", xlabel="calibration rows", ylabel="RMS error of held-out rows [mm]"
        )
        axes.set_xticks(rows, [str(count) for count in rows])
        axes.xaxis.set_minor_formatter(NullFormatter())
        _plain_log(axes)
        axes.legend()
    alt = "RMS error of held-out rows against the number of calibration rows."
    return Drawing("learning_curve", "learning curve", alt, figure)


def draw_map(
    key: str, title: str, subject: str, position: Float64[np.ndarray, "points 3"], layers: Sequence[Layer]
) -> Drawing:
    """Draw quantities at points in space from above and from the side, for printing and without JavaScript.

    Args:
        key: key of the drawing.
        title: title of the drawing.
        subject: subject of the drawing, at the start of its text alternative.
        position: position of every point [mm].
        layers: quantities, drawn side by side.
    """
    with drawing_style():
        figure = Figure(figsize=(3.9 * len(layers), 5.8), layout="constrained")
        grid = figure.subplots(2, len(layers), squeeze=False)
        for column, layer in enumerate(layers):
            finite = np.isfinite(layer.values)
            order = np.argsort(layer.values[finite], kind="stable")
            order = np.concatenate([order[:-_MAX_MAP_DOTS:4], order[-_MAX_MAP_DOTS:]])[-2 * _MAX_MAP_DOTS :]
            values, at = layer.values[finite][order], position[finite][order]
            top = max(float(values.max(initial=0.0)), 1e-12)
            count = (
                "" if len(values) == (of := finite.sum()) else f" ({len(values)} of {of}, largest included)"
            )
            series = f"_{LAYER_LABELS[layer.key]} [{layer.unit}]{count}"  # in the CSV only
            for axes, (a, b) in zip(grid[:, column], ((0, 1), (0, 2)), strict=True):
                dots = axes.scatter(
                    at[:, a], at[:, b], c=values, s=2 + 16 * values / top, cmap="cividis_r", vmin=0.0, vmax=top,
                    label=series, linewidths=0, rasterized=len(values) > _MANY_DOTS,
                )  # fmt: skip
                axes.set_aspect("equal", "datalim")
                axes.set(xlabel=f"{'xyz'[a]} [mm]", ylabel=f"{'xyz'[b]} [mm]")
            grid[0, column].set_title(f"{LAYER_LABELS[layer.key]}, largest {top:.3g} {layer.unit}")
            bar = figure.colorbar(dots, ax=list(grid[:, column]), orientation="horizontal", format="%.2g")
            bar.set_label(layer.unit)
    return Drawing(key, title, f"{subject} from above and from the side.", figure)


def make_panel() -> tuple[Figure, Axes]:
    """Return a panel with fixed margins, because computing the margins would take as long as drawing."""
    figure = Figure(figsize=SIZE)
    figure.subplots_adjust(left=0.155, right=0.985, bottom=0.165, top=0.9)
    axes = figure.add_subplot()
    axes.xaxis.set_major_locator(MaxNLocator(6))
    return figure, axes


def _lengths(axes: Axes, dependence: Dependence) -> None:
    """Draw lengths on a logarithmic axis: dots after, and RMS before and after."""
    after = dependence.errors["after"]
    floor = max(float(np.quantile(after, 0.01)) / 2, 1e-9) if len(after) else 1e-9
    _dots(axes, dependence.values, np.maximum(after, floor), AFTER, "rows, after")
    for name, color, line in (("before", BEFORE, "--"), ("after", AFTER, "-")):
        lengths = dependence.errors[name]
        finite = np.isfinite(lengths)
        if finite.sum() < 3:
            continue
        bins = bin_errors(dependence.values[finite], lengths[finite])
        style = {"color": color, "linestyle": line, "linewidth": 2, "label": f"RMS {name}"}
        axes.stairs(bins.rms, bins.edges, baseline=None, **style)  # type: ignore[arg-type]
    axes.set(yscale="log", ylabel=f"error [{dependence.error_unit}]")
    _plain_log(axes)
    if axes.get_legend_handles_labels()[0]:  # panels without bins have no lines
        axes.legend(ncols=2, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.1)


def _signed(axes: Axes, dependence: Dependence) -> None:
    """Draw signed errors, with means of consecutive rows."""
    styles = {"x": (AFTER, "-", "o"), "y": (BEFORE, "--", "s"), "z": (OTHER, ":", "^")}
    number = dependence.values
    for name, (color, line, mark) in styles.items():
        errors = dependence.errors[name]
        _dots(axes, number, errors, color, f"rows, {name}")
        stretches = np.array_split(np.arange(len(errors)), min(20, max(len(errors) // 8, 1)))
        middle, mean = ([values[rows].mean() for rows in stretches] for values in (number, errors))
        style = {"marker": mark, "markersize": 3.5, "color": color, "label": f"mean {name}", "linewidth": 1.8}
        axes.plot(middle, mean, line, **style)  # type: ignore[arg-type]
    largest = max(float(np.quantile(np.abs(dependence.errors[name]), 0.995)) for name in styles)
    limit = 1.15 * largest + 1e-12
    axes.set(ylabel=f"error [{dependence.error_unit}]", ylim=(-limit, limit))
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.1)


def _dots(axes: Axes, x: np.ndarray, y: np.ndarray, color: str, series: str) -> None:
    """Draw a dot per row; `series` is named in the CSV only."""
    opacity = float(np.clip(800 / max(len(x), 1), 0.15, 0.6))
    size = 3.6 if len(x) < 3_000 else 2.0
    look: dict[str, Any] = {"color": color, "alpha": opacity, "markersize": size, "markeredgewidth": 0}
    drawn = axes.plot(x, y, ".", label=f"_{series}", **look)
    drawn[0].set_rasterized(len(x) > _MANY_DOTS)


def _plain_log(axes: Axes) -> None:
    """Label a logarithmic axis with plain numbers such as 0.02; few ticks, because each takes a millisecond."""
    low, high = axes.get_ylim()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if low > 0 and high < 300 * low else (1,)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())


def _stretches(values: np.ndarray, inside: np.ndarray) -> list[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    return [(float(values[a]), float(values[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
