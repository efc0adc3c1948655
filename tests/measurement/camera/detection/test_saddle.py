"""Corners fitted to gray values: exact under any light, and points that are not corners are not moved."""

import numpy as np
from scipy.special import erf
from testing.closeness import assert_close

from pisigma.measurement.camera.detection.detected_board import fit_saddles

CORNERS = np.array([[30.31, 34.77], [90.0, 31.5]])
AXES = np.array([[[40.0, 8.0], [6.0, 35.0]], [[30.0, -25.0], [25.0, 30.0]]])


def render_corners(slope: float) -> np.ndarray:
    """Return an image of two corners, one per half, blurred by 0.9 px under light with a gradient [1/px]."""
    y, x = np.mgrid[:64, :120].astype(float)
    gray = np.empty_like(x)
    for corner, axes, half in zip(CORNERS, AXES, (x < 60, x >= 60), strict=True):
        across = [(a[0] * (y - corner[1]) - a[1] * (x - corner[0])) / np.linalg.norm(a) / 0.9 for a in axes.T]
        saddle = erf(across[0] / np.sqrt(2)) * erf(across[1] / np.sqrt(2))
        gray[half] = (115 + 85 * saddle)[half]
    return gray * (1 + slope * (x - 60) - slope * (y - 32))


def test_corners_are_found_under_even_and_uneven_light() -> None:
    near = CORNERS + np.array([[0.2, -0.15], [-0.1, 0.25]])
    for slope in (0.0, 2e-3):
        assert_close(fit_saddles(render_corners(slope), near, AXES, 0.4), CORNERS, atol=1e-3)


def test_noise_moves_corners_by_some_thousandths_of_a_pixel() -> None:
    rng = np.random.default_rng(0)
    off = [
        fit_saddles(render_corners(0.0) + 2.0 * rng.standard_normal((64, 120)), CORNERS, AXES, 0.4) - CORNERS
        for _ in range(10)
    ]
    assert_close(np.sqrt(np.square(off).mean()), 0.004, rtol=0.5)


def test_points_that_are_not_corners_are_not_moved() -> None:
    gray = np.random.default_rng(0).uniform(0.0, 255.0, (64, 120))
    moved = np.abs(fit_saddles(gray, CORNERS, AXES, 0.4) - CORNERS)
    assert moved.max() <= 0.5
    assert_close(fit_saddles(np.full((64, 120), 90.0), CORNERS, AXES, 0.4), CORNERS, atol=1e-9)
