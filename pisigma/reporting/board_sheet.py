"""Sheets with calibration boards, to be printed at true size."""

import io
from dataclasses import replace

import numpy as np
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from pisigma.files.errors import OutputError
from pisigma.measurement.camera.board import RULER, Board
from pisigma.measurement.camera.pattern import Pattern, printed_pattern

_PAPERS = {
    "A4 or Letter": (210.0, 279.4),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
"""Widths and heights of papers [mm]; the first entry is the area that A4 and Letter have in common."""
_MARGIN = 8.0
"""Margin that printers leave blank along the edges of a sheet [mm]."""
_FOOT = 22.0
"""Height of the space below the board for its text and the ruler [mm]."""
MM = 1 / 25.4
"""One millimetre [inch]."""


def board_pdf(board: Board) -> tuple[str, bytes]:
    """Return a calibration board as PDF at true size; see `draw_board_sheet`.

    Returns:
        The paper size, such as "A4" or "A3 landscape", and the PDF.
    """
    paper, figure = draw_board_sheet(board)
    stream = io.BytesIO()
    metadata = {"Title": board.name, "CreationDate": None}
    FigureCanvasPdf(figure).print_pdf(stream, metadata=metadata)  # type: ignore[no-untyped-call]
    return paper, stream.getvalue()


def draw_board_sheet(board: Board) -> tuple[str, Figure]:
    """Draw a board at true size on the smallest sufficient paper, with its description and a ruler below.

    Raises:
        OutputError: the board does not fit on any paper.
        MeasurementError: the dictionary of the board has too few markers.
        ImportError: the markers need OpenCV, which is not installed.
    """
    wanted = replace(
        board,
        square=board.square / board.print_scale,
        marker=board.marker / board.print_scale,
        print_scale=1.0,
    )
    pattern = printed_pattern(wanted)
    across, down = 1e3 * (pattern.sheet_rectangle[2:] - pattern.sheet_rectangle[:2])
    paper, (width, height) = _paper(board, float(across), float(down))
    figure = Figure(figsize=(width * MM, height * MM))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    corner = np.array([(width - across) / 2, _MARGIN]) - 1e3 * pattern.sheet_rectangle[:2]
    axes.add_patch(PathPatch(_outline(pattern, corner), facecolor="black", edgecolor="none"))
    top = _MARGIN + down + 4
    start, end = (width - RULER) / 2, (width + RULER) / 2
    axes.plot(
        [start, start, start, end, end, end], [top, top + 4, top + 2, top + 2, top, top + 4], "k", lw=0.5
    )
    texts = (
        f"This line is {RULER:g} mm long; if not, print again at 100 %, or state its length (ruler_mm).",
        f"{board.name}: {_description(wanted)}. Paper: {paper}. x points right, y down; corner 0 is at the upper left.",
    )
    for number, text in enumerate(texts):
        axes.text(width / 2, top + 8 + 4 * number, text, ha="center", va="center", fontsize=6.5)
    return paper, figure


def _paper(board: Board, across: float, down: float) -> tuple[str, tuple[float, float]]:
    """Return the smallest paper for a board of given width and height [mm], portrait if both formats fit."""
    needs = max(across, RULER) + 2 * _MARGIN, down + _FOOT + 2 * _MARGIN
    for name, (width, height) in _PAPERS.items():
        for title, size in ((name, (width, height)), (f"{name} landscape", (height, width))):
            if needs[0] <= size[0] and needs[1] <= size[1]:
                return title, size
    raise OutputError(
        f"board '{board.name}' needs a sheet of {needs[0]:.0f} x {needs[1]:.0f} mm, larger than A0",
        value=board.name,
        remedy="use fewer or smaller squares",
    )


def _outline(pattern: Pattern, corner: np.ndarray) -> Outline:
    """Return one outline of all black rectangles [mm], without gaps between them."""
    left, top, right, bottom = (1e3 * pattern.black_rectangles + np.tile(corner, 2)).T
    ends = np.stack([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]).transpose(
        2, 0, 1
    )
    codes = [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY] * len(ends)
    return Outline(ends.reshape(-1, 2), codes)


def _description(board: Board) -> str:
    size = f"{board.rows} x {board.columns}"
    marker, square = f"{1e3 * board.marker:g} mm", f"{1e3 * board.square:g} mm"
    return {
        "checkerboard": f"checkerboard of {size} corners, squares of {square}",
        "charuco": f"ChArUco board of {size} corners, squares of {square}, markers {board.dictionary} of {marker}",
        "apriltag": f"{size} AprilTags {board.dictionary} of {marker}, {square} from tag to tag",
    }[board.kind]
