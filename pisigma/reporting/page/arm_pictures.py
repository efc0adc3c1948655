"""Pictures of the nominal and the calibrated arm, drawn over images of the arm."""

import numpy as np
from matplotlib.axes import Axes

from pisigma.reporting.page.figures import Drawing, drawing_style
from pisigma.reporting.page.images import draw_photo
from pisigma.validation.report.arm_in_images import ArmInImage, ArmInImages, PredictedArm

NOMINAL, CALIBRATED, MEASURED = "#d62728", "#2ca02c", "#ffd700"
"""Colours of the nominal arm (dashed), of the calibrated arm, and of the measured corners."""
_MOST = 6
"""Largest number of pictures on a page."""


def arm_pictures(arm: ArmInImages) -> tuple[Drawing, ...]:
    """Draw images from the largest to the smallest error of the nominal arm, evenly spaced."""
    order = sorted(arm.images, key=lambda one: -one.nominal_error)
    chosen = np.linspace(0, len(order) - 1, min(len(order), _MOST)).round().astype(int)
    return tuple(_picture(order[number]) for number in chosen)


def _picture(one: ArmInImage) -> Drawing:
    with drawing_style():
        figure, axes = draw_photo(one.file, one.size)
        _draw(axes, one.nominal, NOMINAL, "--")
        _draw(axes, one.calibrated, CALIBRATED, "-")
        axes.plot(*one.measured.T, ".", color=MEASURED, markersize=3)
    alt = (
        f"The nominal arm (red, dashed) is {one.nominal_error * 1e3:.1f} mm off, the calibrated arm (green) "
        f"{one.calibrated_error * 1e3:.1f} mm; yellow dots are measured corners."
    )
    return Drawing(f"arm {one.name}", one.name, alt, figure)


def _draw(axes: Axes, arm: PredictedArm, color: str, style: str) -> None:
    axes.plot(*arm.links.T, style, color=color, linewidth=2.0, marker="o", markersize=4)
    axes.plot(*arm.corners.T, "o", color=color, markersize=4, fillstyle="none")
