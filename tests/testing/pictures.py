"""Blank figures, for tests of other subjects: drawing takes half the time of a calibration."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 4 3"/>'


def save_blank(figure: Figure, path: Path) -> None:
    """Write a PNG of a pixel instead of the figure."""
    Image.new("RGB", (1, 1)).save(path)


@contextmanager
def no_pictures() -> Iterator[None]:
    """Compose the figures of calibrations, trainings and reports, and write blank ones."""
    from pisigma.reporting import calibration_figures, figures
    from pisigma.reporting.page.drawing import Drawing

    with pytest.MonkeyPatch.context() as patch:
        for module in (calibration_figures, figures):
            patch.setattr(module, "save_figure", save_blank)
        patch.setattr(Drawing, "svg", lambda self: SVG)
        yield
