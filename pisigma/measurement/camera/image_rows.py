"""Convert images of boards to measurements: one row per image, with the pose of the board and its covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.estimation.loss import AbstractLoss, HampelLoss
from pisigma.files.errors import MeasurementError, Place
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import (
    MIN_NOISE,
    POSE,
    BoardPose,
    linearise_pixels,
    solve_board_pose,
    triangular_factor,
)
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import IntrinsicsChoice, Repeatability
from pisigma.measurement.camera.solved_images import (
    SolvedImages,
    corner_noise,
    prior_sigmas,
    solve_images,
)
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import WEIGHT_COLUMN, weight_text
from pisigma.measurement.sensors.intrinsics import (
    CAMERA_COLUMN,
    INTRINSICS_COLUMN,
    NOISE_COLUMN,
    SCALE_COLUMN,
)
from pisigma.robot.se3 import skew

_MAX_BEND_ITERATIONS = 4
"""Largest number of iterations of the board's shape for given intrinsics; the second step is usually near rounding."""
_BEND_TOLERANCE = 1e-6
"""Change of the board's shape [m] below which the iteration ends."""
MAX_MEDIAN_RESIDUAL = 10.0
"""Median residual of an image's corners [px] above which they cannot be corners of the board."""
_SHAPES = 3
"""Number of shapes of a bent board, see `bend_shapes`."""


@dataclass(frozen=True, eq=False)
class Images:
    """Corners in the images that one camera took of one board.

    Attributes:
        source: the file that contains the corners.
        names: names of the images, in the file's order.
        q: joint values of every image [rad or m].
        lines: line number of the first corner of every image.
        corner_numbers: numbers of the corners in every image.
        pixels: pixels of the corners in every image [px].
        sigma: standard deviation of every corner, up to a common factor that is estimated; empty if all are equal.
    """

    source: str
    names: tuple[str, ...]
    q: Float64[torch.Tensor, "images dof"]
    lines: tuple[int, ...]
    corner_numbers: tuple[np.ndarray, ...]
    pixels: tuple[Float64[np.ndarray, "_corners 2"], ...]
    sigma: tuple[Float64[np.ndarray, " _corners"], ...] = ()

    @property
    def relative_sigma(self) -> tuple[Float64[np.ndarray, " _corners"], ...]:
        """Standard deviations of the corners relative to their median."""
        if not self.sigma:
            return tuple(np.ones(len(corners)) for corners in self.corner_numbers)
        usual = np.median(np.concatenate(self.sigma))
        return tuple(of_image / usual for of_image in self.sigma)


def image_measurements(
    images: Images,
    camera: Camera,
    board: Board,
    is_fixed: bool,
    repeatability: Repeatability,
    intrinsics: IntrinsicsChoice = "prior",
) -> Measurements:
    """Solve the pose of the board in every image.

    Args:
        images: images of one camera and one board.
        camera: the camera.
        board: the board, with its numbering of the corners.
        is_fixed: whether the camera is fixed and the board is on the flange.
        repeatability: repeatability of the robot.
        intrinsics: whether the camera's intrinsics are fixed, have their prior, or are free; see `prior_sigmas`.

    Returns:
        One row per image, in the frame of the board with the camera as target (the other way round for a fixed camera),
        with the weights of `CornerSensor`.

    Raises:
        MeasurementError: the corners of an image do not fit the board.
    """
    loss, bend = HampelLoss(), np.zeros(_SHAPES)

    def solve(present: Camera) -> list[BoardPose]:
        nonlocal bend
        poses, bend = _board_poses(images, present, board, bend, loss)
        return poses

    solved = solve_images(camera, prior_sigmas(camera, intrinsics), solve, loss, images.source)
    rotations, positions, changes = zip(*(_target_pose(pose, is_fixed) for pose in solved.poses), strict=True)
    count, names = len(rotations), (board.name, camera.name)
    frame, target = reversed(names) if is_fixed else names
    return Measurements(
        q=images.q,
        position=torch.from_numpy(np.stack(positions)),
        rotation=torch.from_numpy(np.stack(rotations)),
        frame=(frame,) * count,
        target=(target,) * count,
        readings=_readings(solved, changes, board, repeatability),
        image=images.names,
        line=images.lines,
        source=images.source,
    )


def _readings(
    solved: SolvedImages, changes: Sequence[np.ndarray], board: Board, repeatability: Repeatability
) -> dict[str, torch.Tensor | tuple[str, ...]]:
    """Return the columns of `CornerSensor`; `changes` are derivatives of target poses with respect to board poses."""
    at_board = solved.noise / solved.prior_camera.fx * float(np.median([pose.t[2] for pose in solved.poses]))
    of_robot = np.diag([repeatability.length**2] * 3 + [repeatability.angle**2] * 3)
    of_corners = [
        solved.noise**2 * change @ pose.cofactor @ change.T
        for pose, change in zip(solved.poses, changes, strict=True)
    ]
    count = len(changes)
    readings: dict[str, torch.Tensor | tuple[str, ...]] = {
        NOISE_COLUMN: torch.full((count,), at_board, dtype=torch.float64),
        WEIGHT_COLUMN: tuple(weight_text(_inverse_root(one + of_robot)) for one in of_corners),
        CAMERA_COLUMN: (solved.prior_camera.name,) * count,
    }
    if solved.sigma.any():
        J = np.stack(changes) @ solved.intrinsics.pose_jacobian
        readings[INTRINSICS_COLUMN] = replace(solved.intrinsics, pose_jacobian=J).csv_cells
    if board.scale_sigma is not None:
        readings[SCALE_COLUMN] = (f"{board.scale_sigma:.17g}",) * count
    return readings


def _board_poses(
    images: Images, camera: Camera, board: Board, bend: Float64[np.ndarray, " 3"], loss: AbstractLoss
) -> tuple[list[BoardPose], Float64[np.ndarray, " 3"]]:
    """Solve the poses of a board for given intrinsics, together with its shape if it need not be flat.

    Returns:
        The poses, and the heights of the board's shapes [m].

    Raises:
        MeasurementError: the corners of an image do not fit the board.
    """
    observed = images.corner_numbers, images.pixels, images.relative_sigma
    for _ in range(_MAX_BEND_ITERATIONS):
        corners = bent_corners(board, bend)
        poses = [
            solve_board_pose(camera, corners[number], pixels, loss, sigma)
            for number, pixels, sigma in zip(*observed, strict=True)
        ]
        _refuse_other_boards(images, board, poses)
        if not board.flatness:
            break
        before, noise = bend, corner_noise(poses, loss)
        bend = update_bend(bend, board, camera, *observed, poses, noise)
        if np.abs(bend - before).max() < _BEND_TOLERANCE:
            break
    return poses, bend


def _refuse_other_boards(images: Images, board: Board, poses: Sequence[BoardPose]) -> None:
    """Refuse images whose corners do not fit the board, and images in which the board is mirrored.

    Raises:
        MeasurementError: an image does not fit the board or shows it mirrored.
    """
    for name, line, pose in zip(images.names, images.lines, poses, strict=True):
        residual = float(np.median(pose.residual_length))
        if not residual < MAX_MEDIAN_RESIDUAL:
            raise MeasurementError(
                f"the corners of image '{name}' do not fit a board of {board.rows} x {board.columns} corners: their "
                f"median residual is {residual:.3g} px",
                expected=f"corners of image '{name}'",
                value=residual,
                at=Place(images.source, line),
                remedy="check the numbers of the corners, the board and the camera, or remove the image",
            )
    from_front = np.array([pose.R[:, 2] @ pose.t > 0 for pose in poses])
    if from_front.any() and not from_front.all():
        fewer = np.flatnonzero(from_front == (2 * from_front.sum() < len(from_front)))
        name = images.names[fewer[0]]
        raise MeasurementError(
            f"image '{name}' shows the board mirrored compared with {len(poses) - len(fewer)} of {len(poses)} images",
            value=name,
            at=Place(images.source, images.lines[fewer[0]]),
            remedy="check whether it is mirrored, and whether its corners are numbered as in the others",
        )


def _target_pose(pose: BoardPose, is_fixed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pose of the target, and its derivative with respect to the board's pose, in the axes of the frame.

    For a shift and a rotation vector of the board's pose, the position `-R^T t` of the inverse pose changes by
    `-R^T (shift + t × rotation)`, and its rotation by `-R^T rotation`.
    """
    if is_fixed:
        return pose.R, pose.t, np.eye(POSE)
    back = pose.R.T
    change = np.zeros((POSE, POSE))
    change[:3, :3] = change[3:, 3:] = -back
    change[:3, 3:] = -back @ skew(torch.from_numpy(pose.t)).numpy()
    return back, -back @ pose.t, change


def _inverse_root(covariance: np.ndarray) -> np.ndarray:
    """Return the lower triangular W with `W^T W` = inverse of a covariance."""
    # scaled to unit variances first, because the square root of a mix of metres and radians is ill-conditioned
    scale = np.sqrt(covariance.diagonal())
    root: np.ndarray = np.linalg.inv(np.linalg.cholesky(covariance / scale / scale[:, None])) / scale
    return root


def bend_shapes(board: Board) -> Float64[np.ndarray, "corners 3"]:
    """Return the relative heights, at most 1, of three smooth shapes above the board's plane at its corners.

    They are the squares and the product of the two coordinates in the plane, minus their best-fitting plane, so that
    the pose of the board remains that of its mean plane.
    """
    corners = board.corners[:, :2]
    x, y = ((corners - corners.mean(0)) / np.ptp(corners, axis=0)).T
    plane, bent = np.stack([np.ones(len(x)), x, y], -1), np.stack([x * x, x * y, y * y], -1)
    bent -= plane @ np.linalg.lstsq(plane, bent, rcond=None)[0]
    shape: np.ndarray = bent / np.abs(bent).max(0)
    return shape


def update_bend(
    bend: Float64[np.ndarray, " 3"],
    board: Board,
    camera: Camera,
    corner_numbers: Sequence[np.ndarray],
    pixels: Sequence[Float64[np.ndarray, "_corners 2"]],
    relative_sigma: Sequence[Float64[np.ndarray, " _corners"]],
    poses: Sequence[BoardPose],
    noise: float,
) -> Float64[np.ndarray, " 3"]:
    """Return the heights of the board's shapes [m] after one Gauss-Newton step over all images.

    The pose of every image is eliminated by orthogonal triangularisation, as in `solve_board_pose`. The prior of a
    height is 0 with half the board's flatness as standard deviation.

    Args:
        bend: heights with which the poses were solved [m].
        board: the board, with its flatness.
        camera: the camera.
        corner_numbers: numbers of the corners in every image.
        pixels: pixels of the corners in every image [px].
        relative_sigma: standard deviation of every corner relative to the median.
        poses: poses of the board in every image.
        noise: standard deviation of u and v of a corner of median deviation [px].
    """
    of_corner, corners = bend_shapes(board), bent_corners(board, bend)
    prior = max(noise, MIN_NOISE) / (board.flatness / 2)
    rows = [np.concatenate([prior * np.eye(_SHAPES), -prior * bend[:, None]], 1)]
    for number, at, deviation, pose in zip(corner_numbers, pixels, relative_sigma, poses, strict=True):
        residual, J, point_jacobian = linearise_pixels(camera, corners[number], at, deviation, pose.R, pose.t)
        height_jacobian = (point_jacobian @ pose.R[:, 2])[..., None] * of_corner[number][:, None]
        columns = np.concatenate([J, height_jacobian, residual[..., None]], -1)
        weighted = np.sqrt(pose.robust_weight)[:, None, None] * columns
        rows.append(triangular_factor(weighted.reshape(-1, columns.shape[-1]))[POSE:-1, POSE:])
    stacked = np.concatenate(rows)
    heights: np.ndarray = bend + np.linalg.lstsq(stacked[:, :-1], stacked[:, -1], rcond=None)[0]
    return heights


def bent_corners(board: Board, bend: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "corners 3"]:
    """Return the corners of a bent board in its frame [m], given the heights of its shapes [m]."""
    height = bend_shapes(board) @ bend
    corners: np.ndarray = board.corners + height[:, None] * [0.0, 0.0, 1.0]
    return corners
