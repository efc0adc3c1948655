"""Drawings of pages as SVG and PNG, and the values that they show as CSV; files contain no dates.

The values are read from the figure, so that both agree.
"""

import csv
import datetime
import io
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import StepPatch
from matplotlib.quiver import Quiver

from pisigma.files.conflicts import Input, check_conflicts
from pisigma.files.errors import OutputError, Phrase, Place
from pisigma.files.output_file import write_atomically
from pisigma.reporting.rendering import file_name

_PIXELS = 130
"""Resolution of rasterised dots [pixels per inch]."""
BEFORE, AFTER, OTHER = "#b35806", "#1f5fa8", "#4d4d4d"
"""Colours that people with colour blindness can distinguish."""
_STYLE: dict[Any, Any] = {
    "text.parse_math": False,
    "svg.hashsalt": "pisigma",
    "svg.fonttype": "none",
    "font.size": 10.0,
    "axes.facecolor": "none",  # pages invert their charts in the dark
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 9.0,
}
_SVG_METADATA: dict[str, Any] = {"Date": None, "Creator": None}


@dataclass(frozen=True, eq=False)
class Drawing:
    """A figure of the report.

    Attributes:
        key: file name without suffix.
        title: title on the page.
        alt: text alternative of the image.
        figure: the figure.
    """

    key: str
    title: str
    alt: str
    figure: Figure

    def svg(self) -> str:
        """Return the figure as SVG; the same figure always gives the same text."""
        stream = io.BytesIO()
        with drawing_style():
            FigureCanvasSVG(self.figure)
            self.figure.savefig(stream, format="svg", dpi=_PIXELS, facecolor="none", metadata=_SVG_METADATA)
        return stream.getvalue().decode()

    def png(self) -> bytes:
        """Return the figure as PNG."""
        stream = io.BytesIO()
        with drawing_style():
            FigureCanvasAgg(self.figure)
            self.figure.savefig(stream, format="png", dpi=160, metadata={"Software": None})
        return stream.getvalue()

    def csv(self) -> str:
        """Return the values that the figure shows as CSV."""
        return csv_of(self.figure)


@contextmanager
def drawing_style() -> Iterator[None]:
    """Apply the style of all figures, without warnings about characters that no font has."""
    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def check_figures_writable(folder: Path, inputs: Iterable[Input] = ()) -> None:
    """Check in advance that figures can be written into a folder.

    Raises:
        OutputError: the folder is a file, is inside a model folder or an input, or cannot be created or written to.
    """
    check_conflicts(folder / "figure.png", inputs, "--figures")
    if folder.exists() and not folder.is_dir():
        raise OutputError(expected="a folder", value=Phrase("a file"), at=Place(folder), option="--figures")
    if not folder.exists() and not folder.parent.is_dir():
        raise OutputError(
            f"there is no folder {folder.parent}",
            at=Place(folder),
            option="--figures",
            remedy="create it or choose another folder",
        )
    if not os.access(folder if folder.exists() else folder.parent, os.W_OK):
        raise OutputError(
            "the folder is not writable", at=Place(folder), option="--figures", remedy="choose another folder"
        )


def write_figures(drawings: Sequence[Drawing], folder: Path) -> list[Path]:
    """Write every figure as PNG and SVG, and the values that it shows as CSV.

    Args:
        drawings: drawings to write; characters that file names cannot have are replaced.
        folder: folder, created if it is missing.

    Raises:
        OutputError: a file cannot be written.
    """
    written: list[Path] = []
    try:
        folder.mkdir(exist_ok=True)
        for drawing in drawings:
            stem = folder / file_name(drawing.key)
            for suffix, content in (("png", drawing.png()), ("svg", drawing.svg()), ("csv", drawing.csv())):
                written.append(Path(f"{stem}.{suffix}"))
                write_atomically(written[-1], content)
    except OSError as problem:
        raise OutputError(
            f"the folder cannot be written to: {problem.strerror}",
            at=Place(folder),
            option="--figures",
            remedy="choose another folder",
        ) from None
    return written


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
