"""Figures of a report as files."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from pisigma.errors import OutputError
from pisigma.reporting.page.drawing import Drawing


def check_figures(folder: Path) -> None:
    """Make sure that figures may be written into a folder: before the work, not after it.

    Raises:
        OutputError: it is a file, or it cannot be made or written to.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; choose another folder for --figures.")
    if not folder.exists() and not folder.parent.is_dir():
        raise OutputError(
            f"{folder}: there is no folder {folder.parent}; make it or choose another --figures."
        )
    if not os.access(folder if folder.exists() else folder.parent, os.W_OK):
        raise OutputError(f"{folder}: cannot be written to; choose another --figures.")


def write_figures(drawings: Sequence[Drawing], folder: Path) -> list[Path]:
    """Write every figure as PNG and SVG.

    Args:
        drawings: to write; names that no file can have are changed.
        folder: made where missing.

    Raises:
        OutputError: a file cannot be written.
    """
    written: list[Path] = []
    try:
        folder.mkdir(exist_ok=True)
        for drawing in drawings:
            stem = folder / (re.sub(r"[^\w.-]", "_", drawing.key) or "figure")
            svg, png = Path(f"{stem}.svg"), Path(f"{stem}.png")
            svg.write_text(drawing.svg(), encoding="utf-8")
            png.write_bytes(drawing.png())
            written += [png, svg]
    except OSError as problem:
        raise OutputError(
            f"{folder}: cannot be written ({problem.strerror}); choose another --figures."
        ) from None
    return written
