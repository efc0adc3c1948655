"""Images of boards with detected corners on a page of their own, and with the arm drawn over them in a report."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from pisigma.measurement.camera.detection.detected_boards import BoardImage, DetectedBoards, rms_of
from pisigma.measurement.camera.detection.detector import read_image
from pisigma.reporting.page.drawing import AFTER, BEFORE, Drawing, drawing_style
from pisigma.reporting.page.page import html_page
from pisigma.reporting.result_text import Table
from pisigma.validation.report.arm_in_images import ArmInImage, ArmInImages, PredictedArm

_WIDTH = 4.8
"""Width of a picture [inch]."""
_MAX_PIXELS = 480
"""Pixels of a picture along u; larger images are averaged."""
_GRAY_STEP = 16
"""Step of the gray values; finer noise would make the page ten times as large."""
_ARROW = 0.05
"""Length of the arrow of the 95 % quantile of the residuals, as a share of the image width."""


def images_page(
    title: str,
    detection: DetectedBoards,
    tables: Sequence[tuple[str, Table]],
    sentences_and_warnings: tuple[Sequence[str], Sequence[str]],
) -> str:
    """Render the page of images as HTML; texts are escaped.

    Args:
        title: title of the page.
        detection: boards in the images.
        tables: tables with their titles.
        sentences_and_warnings: sentences of the result, and warnings.
    """
    sentences, warnings = sentences_and_warnings
    scale = arrow_scale(detection)
    return html_page(
        "images.html.j2",
        title=title,
        sentences=sentences,
        warnings=warnings,
        tables=tables,
        scale=f"{scale:g}",
        pictures=[draw_image(one, detection, scale) for one in detection.images if one.is_readable],
    )


def arrow_scale(detection: DetectedBoards) -> float:
    """Compute the magnification of residuals in all pictures: 1, 2 or 5 times a power of ten."""
    lengths = np.linalg.norm(np.concatenate(list(detection.residuals.values())), axis=1)
    width = next(one.size[0] for one in detection.images if one.is_readable)
    largest = _ARROW * width / max(float(np.quantile(lengths, 0.95)), 1e-6)
    power = 10.0 ** np.floor(np.log10(largest))
    return float(power * max(step for step in (1, 2, 5) if step * power <= largest))


def draw_photo(file: Path, size: tuple[int, int]) -> tuple[Figure, Axes]:
    """Return a figure of an image with axes in its pixels.

    Args:
        file: file of the image.
        size: its width and height [px].
    """
    width, height = size
    figure = Figure(figsize=(_WIDTH, _WIDTH * height / width))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(_thumbnail(file), cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="antialiased")
    axes.set_axis_off()
    axes.set(xlim=extent[:2], ylim=extent[2:])
    return figure, axes


def draw_image(image: BoardImage, detection: DetectedBoards, scale: float) -> Drawing:
    """Return an image with magnified arrows from predicted to detected corners.

    Args:
        image: image to draw.
        detection: detected boards, with the residuals of corners if the image was used.
        scale: magnification of the arrows.
    """
    with drawing_style():
        figure, axes = draw_photo(Path(image.file), image.size)
        residual = detection.residuals.get(image.name)
        if residual is None:
            return Drawing(image.name, image.name, f"Left out: {detection.left_out[image.name]}.", figure)
        u, v = detection.predicted_pixels[image.name].T
        axes.scatter(u, v, s=9, color=AFTER, linewidths=0)
        tips = residual * scale
        axes.quiver(u, v, *tips.T, color=BEFORE, angles="xy", scale_units="xy", scale=1.0, width=0.006)
    largest = float(np.linalg.norm(residual, axis=1).max())
    alt = (
        f"{len(residual)} corners, RMS {rms_of(residual):.3f} px, largest residual {largest:.3f} px, blur "
        f"{image.blur:.2f} px; arrows are magnified {scale:g} times."
    )
    return Drawing(image.name, image.name, alt, figure)


def _thumbnail(file: Path) -> np.ndarray:
    """Return a copy of an image with few pixels and gray levels."""
    full = Image.fromarray(read_image(file))
    full.thumbnail((_MAX_PIXELS, _MAX_PIXELS), Image.Resampling.BOX)
    return np.asarray(full) // _GRAY_STEP * _GRAY_STEP + _GRAY_STEP // 2


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
        axes.plot(*one.measured_corners.T, ".", color=MEASURED, markersize=3)
    alt = (
        f"The nominal arm (red, dashed) is {one.nominal_error * 1e3:.1f} mm off, the calibrated arm (green) "
        f"{one.calibrated_error * 1e3:.1f} mm; yellow dots are measured corners."
    )
    return Drawing(f"arm {one.name}", one.name, alt, figure)


def _draw(axes: Axes, arm: PredictedArm, color: str, style: str) -> None:
    axes.plot(*arm.frame_pixels.T, style, color=color, linewidth=2.0, marker="o", markersize=4)
    axes.plot(*arm.corner_pixels.T, "o", color=color, markersize=4, fillstyle="none")
