"""Boards that are not flat: their shape is estimated from images."""

from dataclasses import replace

import numpy as np
from testing.camera_cell import BOARD, CAMERA, CameraCell, camera_cell
from testing.closeness import assert_close

from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import Images, bend_shapes, bent_corners, image_measurements
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert
from pisigma.simulation.camera.simulated_images import ImageNoise

NONE = Repeatability(0.0, 0.0)
BENT = np.array([3e-4, -1e-4, 2e-4])


def bent_images(cell: CameraCell, noise: float) -> Images:
    """Return images of the same board, bent."""
    corners, rng = bent_corners(BOARD, BENT), np.random.default_rng(0)
    T = invert(forward_kinematics(cell.true, cell.images.q)).numpy()
    pixels = []
    for pose, number in zip(T, cell.images.corner_numbers, strict=True):
        exact = CAMERA.project(corners[number] @ pose[:3, :3].T + pose[:3, 3])[0]
        pixels.append(exact + noise * rng.standard_normal(exact.shape))
    return replace(cell.images, pixels=tuple(pixels))


def test_shapes_leave_the_plane_of_the_board_where_it_is() -> None:
    of_corner, corners = bend_shapes(BOARD), BOARD.corners
    plane = np.concatenate([np.ones((54, 1)), corners[:, :2]], 1)
    assert_close(plane.T @ of_corner, np.zeros((3, 3)), atol=1e-12)
    assert_close(np.abs(of_corner).max(0), np.ones(3), atol=1e-12)


def test_exact_images_of_a_bent_board_give_exact_poses() -> None:
    cell = camera_cell(8, 0, ImageNoise(0.0, NONE))
    images, off = bent_images(cell, 0.0), []
    for board in (BOARD, replace(BOARD, flatness=3e-4)):
        rows = image_measurements(images, CAMERA, board, False, NONE, "fixed")
        off.append(float((rows.T - forward_kinematics(cell.true, images.q)).abs().max()))
    assert off[0] > 1e-4
    assert off[1] < 1e-6


def test_noise_does_not_bend_the_board() -> None:
    cell = camera_cell(20, 1)
    rows, flat = (
        image_measurements(cell.images, CAMERA, board, False, Repeatability(), "fixed")
        for board in (replace(BOARD, flatness=1e-3), BOARD)
    )
    assert rows.position is not None
    assert flat.position is not None
    assert (
        float((rows.position - flat.position).norm(dim=1).max()) < 1e-4
    )  # of 5e-4 by the noise of one image
