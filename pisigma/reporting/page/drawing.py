"""Figures as SVG and PNG: many dots as pixels, no dates inside, names shown as they are."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

SIZE = (5.2, 3.1)
"""Of a panel [inch]."""
MANY_DOTS = 200
"""From so many on, dots are drawn as pixels."""
PIXELS = 130
"""Of dots, per inch."""
BEFORE, AFTER, OTHER = "#b35806", "#1f5fa8", "#4d4d4d"
"""Colours that are told apart by people who see no red or no green, too."""
_STYLE: dict[Any, Any] = {
    "text.parse_math": False,
    "svg.hashsalt": "pisigma",
    "svg.fonttype": "none",
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 9.0,
}


@dataclass(frozen=True, eq=False)
class Drawing:
    """A figure of the report.

    Attributes:
        key: its file name without ending.
        title: for the page.
        alt: what is to be seen, for people who do not see it.
        figure: the figure.
    """

    key: str
    title: str
    alt: str
    figure: Figure

    def svg(self) -> str:
        """The figure as SVG, the same text for the same figure."""
        stream = io.BytesIO()
        with drawing_style():
            FigureCanvasSVG(self.figure)
            self.figure.savefig(stream, format="svg", dpi=PIXELS, metadata={"Date": None, "Creator": None})
        return stream.getvalue().decode()

    def png(self) -> bytes:
        """The figure as PNG."""
        stream = io.BytesIO()
        with drawing_style():
            FigureCanvasAgg(self.figure)
            self.figure.savefig(stream, format="png", dpi=160, metadata={"Software": None})
        return stream.getvalue()


@contextmanager
def drawing_style() -> Iterator[None]:
    """The style of all figures; characters that no font has are no reason to complain."""
    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield
