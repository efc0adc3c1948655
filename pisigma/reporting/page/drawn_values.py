"""Values that are drawn in a figure, as CSV; they are read from the figure, so that both agree."""

import csv
import datetime
import io
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import StepPatch
from matplotlib.quiver import Quiver

MAX_POINTS = 5_000
"""Number of points of a series above which only every k-th is written, as the name of the series states."""

Point = dict[str, Any]


def csv_of(figure: Figure) -> str:
    """Return the values that a figure shows as CSV: panel, series, and a column for each axis and colour.

    Args:
        figure: lines, steps, dots, arrows and matrices; other artists are left out.
    """
    bars = {
        bar.ax
        for bar in (getattr(one, "colorbar", None) for axes in figure.axes for one in _coloured(axes))
        if bar
    }
    points: list[Point] = []
    for axes in figure.axes:
        if axes not in bars:
            points += _points_of(axes)
    # columns that are empty in all lines are left out
    columns = dict.fromkeys(name for one in points for name, text in one.items() if text)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(points)
    return stream.getvalue()


def _coloured(axes: Axes) -> Iterable[Any]:
    return (*axes.collections, *axes.images)


def _points_of(axes: Axes) -> Iterator[Point]:
    """Yield the points of one panel of a figure."""
    names = axes.get_xlabel() or "x", axes.get_ylabel() or "y"
    panel = axes.get_title(loc="left") or axes.get_title()
    for line in axes.lines:
        across: Any = line.get_xdata(orig=True)
        if line.get_transform() == axes.transData and len(across):
            first = "date" if isinstance(across[0], datetime.date) else names[0]
            drawn = {first: across, names[1]: line.get_ydata()}
            yield from _series(panel, line.get_label(), drawn.items())
    for steps in (one for one in axes.patches if isinstance(one, StepPatch)):
        values, edges, _ = steps.get_data()
        both = {f"{names[0]} from": edges[:-1], "to": edges[1:], names[1]: values}
        yield from _series(panel, steps.get_label(), both.items())
    for dots in axes.collections:
        if isinstance(dots, Quiver):
            arrows = {names[0]: dots.X, names[1]: dots.Y, "arrow x": dots.U, "arrow y": dots.V}
            yield from _series(panel, "arrows", arrows.items())
        elif isinstance(dots, PathCollection):
            at, colour = np.asarray(dots.get_offsets()), dots.get_array()
            both = dict(zip(names, at.T, strict=True)) | (
                {} if colour is None else {"value": np.asarray(colour)}
            )
            yield from _series(panel, dots.get_label(), both.items())
    for matrix in axes.images:
        yield from _entries(axes, panel, matrix)


def _series(panel: str, label: object, columns: Iterable[tuple[str, Any]]) -> Iterator[Point]:
    """Yield the points of one series, except points with values that are not finite."""
    names, values = zip(*columns, strict=True)
    count = len(values[0])
    step = -(-count // MAX_POINTS)
    name = str(label) if not str(label).startswith("_child") else ""
    name = name.removeprefix("_") + (f" (every {step}th of {count})" if step > 1 else "")
    for row in zip(*(one[::step] for one in values), strict=True):
        texts = [_text(one) for one in row]
        if all(texts):
            yield {"panel": panel, "series": name, **dict(zip(names, texts, strict=True))}


def _entries(axes: Axes, panel: str, matrix: AxesImage) -> Iterator[Point]:
    """Yield the entries of a matrix with names along both axes; nothing for other pictures."""
    across, down = (
        [one.get_text() for one in labels] for labels in (axes.get_xticklabels(), axes.get_yticklabels())
    )
    values = np.asarray(matrix.get_array())
    if values.shape == (len(down), len(across)):
        for (i, k), value in np.ndenumerate(values):
            yield {"panel": panel, "row": down[i], "column": across[k], "value": _text(value)}


def _text(value: Any) -> str:
    """Return a number with five digits, a day in ISO 8601, and "" for values that are not finite."""
    if isinstance(value, (float, np.floating)):
        return f"{value:.5g}" if np.isfinite(value) else ""
    return str(value)
