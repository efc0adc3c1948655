"""How a board is bent, by all images that one camera took of it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import POSE, SMALLEST_NOISE, BoardPose, linearised, triangle
from pisigma.measurement.camera.camera import Camera

SHAPES = 3


def shapes(board: Board) -> Float64[np.ndarray, "corners 3"]:
    """Return by how much three low shapes stand out of the board's plane at its corners, 1 at most.

    They are the squares and the product of the two coordinates in the plane, without what a plane explains of them, so
    that the pose of the board stays that of its mean plane; they have no unit.
    """
    corners = board.corners[:, :2]
    x, y = ((corners - corners.mean(0)) / np.ptp(corners, axis=0)).T
    plane, bent = np.stack([np.ones(len(x)), x, y], -1), np.stack([x * x, x * y, y * y], -1)
    bent -= plane @ np.linalg.lstsq(plane, bent, rcond=None)[0]
    shape: np.ndarray = bent / np.abs(bent).max(0)
    return shape


def bent_further(
    bend: Float64[np.ndarray, " 3"],
    board: Board,
    camera: Camera,
    numbers: Sequence[np.ndarray],
    pixels: Sequence[Float64[np.ndarray, "_corners 2"]],
    sigma: Sequence[Float64[np.ndarray, " _corners"]],
    poses: Sequence[BoardPose],
    noise: float,
) -> Float64[np.ndarray, " 3"]:
    """Return the heights of the shapes [m] that all images together show, by one Gauss-Newton step.

    Every image's pose is eliminated by orthogonal triangularisation, as in `solve_board_pose`; a height is 0 with half
    the board's flatness as its standard deviation before the images are looked at.

    Args:
        bend: the heights that the poses were solved with [m].
        board: with its flatness.
        camera: that took the images.
        numbers: of the corners in every image.
        pixels: where it shows them [px].
        sigma: standard deviation of every corner over the usual one.
        poses: of the board in every image.
        noise: standard deviation of u and v of a usual corner [px].
    """
    of_corner, corners = shapes(board), bent_corners(board, bend)
    prior = max(noise, SMALLEST_NOISE) / (board.flatness / 2)
    rows = [np.concatenate([prior * np.eye(SHAPES), -prior * bend[:, None]], 1)]
    for number, at, deviation, pose in zip(numbers, pixels, sigma, poses, strict=True):
        residual, J, by_point = linearised(camera, corners[number], at, deviation, pose.R, pose.t)
        by_height = (by_point @ pose.R[:, 2])[..., None] * of_corner[number][:, None]
        columns = np.concatenate([J, by_height, residual[..., None]], -1)
        weighted = np.sqrt(pose.weight)[:, None, None] * columns
        rows.append(triangle(weighted.reshape(-1, columns.shape[-1]))[POSE:-1, POSE:])
    stacked = np.concatenate(rows)
    heights: np.ndarray = bend + np.linalg.lstsq(stacked[:, :-1], stacked[:, -1], rcond=None)[0]
    return heights


def bent_corners(board: Board, bend: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "corners 3"]:
    """Return where the corners of a bent board are in its frame [m], by the heights of its shapes [m]."""
    height = shapes(board) @ bend
    corners: np.ndarray = board.corners + height[:, None] * [0.0, 0.0, 1.0]
    return corners
