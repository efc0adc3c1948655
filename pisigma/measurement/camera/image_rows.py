"""Images of boards as measurements: one row an image, with the pose that its corners give and its covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.estimation.loss import AbstractLoss, HampelLoss
from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import (
    POSE,
    SMALLEST_NOISE,
    BoardPose,
    linearised,
    solve_board_pose,
    triangle,
)
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import IntrinsicsChoice, Repeatability
from pisigma.measurement.camera.solved_images import (
    SolvedImages,
    corner_noise,
    prior_deviations,
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

MOST_BENDS = 4
"""Steps by which a board is bent at one set of intrinsics; the second is near rounding, where no corner is wrong."""
SMALLEST_BEND = 1e-6
"""[m] A board is not bent further by less."""
LARGEST_MISS = 10.0
"""[px] Where half of the corners of an image miss their prediction by more, they are not of this board."""
SHAPES = 3


@dataclass(frozen=True, eq=False)
class Images:
    """The corners of images that one camera took of one board.

    Attributes:
        source: the file.
        names: of the images, in the order in which they come.
        q: joint values of every image [rad or m].
        lines: where the first corner of every image stands.
        corners: numbers of the corners that every image shows.
        pixels: where it shows them [px].
        sigma: standard deviation of every corner, whose common factor is estimated; nothing where all are alike.
    """

    source: str
    names: tuple[str, ...]
    q: Float64[torch.Tensor, "images dof"]
    lines: tuple[int, ...]
    corners: tuple[np.ndarray, ...]
    pixels: tuple[Float64[np.ndarray, "_corners 2"], ...]
    sigma: tuple[Float64[np.ndarray, " _corners"], ...] = ()

    @property
    def relative_sigma(self) -> tuple[Float64[np.ndarray, " _corners"], ...]:
        """Standard deviations over the usual one of all corners."""
        if not self.sigma:
            return tuple(np.ones(len(corners)) for corners in self.corners)
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
        images: of one camera and one board.
        camera: that took them.
        board: that they show; corners are numbered as there.
        is_fixed: whether the camera is fixed and the board on the flange.
        repeatability: of the robot.
        intrinsics: whether the camera's are held, under their prior, or free; see `prior_deviations`.

    Returns:
        One row an image, in the frame of the board with the camera as target (of a fixed camera the other way
        round), with the weights of `CornerSensor`.

    Raises:
        MeasurementError: the corners of an image are not of this board.
    """
    loss, bend = HampelLoss(), np.zeros(SHAPES)

    def solve(present: Camera) -> list[BoardPose]:
        nonlocal bend
        poses, bend = _board_poses(images, present, board, bend, loss)
        return poses

    solved = solve_images(camera, prior_deviations(camera, intrinsics), solve, loss, images.source)
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
    """Return the columns of `CornerSensor`, by how the pose of every row changes with that of its board."""
    at_board = solved.noise / solved.camera.fx * float(np.median([pose.t[2] for pose in solved.poses]))
    of_robot = np.diag([repeatability.length**2] * 3 + [repeatability.angle**2] * 3)
    of_corners = [
        solved.noise**2 * change @ pose.cofactor @ change.T
        for pose, change in zip(solved.poses, changes, strict=True)
    ]
    count = len(changes)
    readings: dict[str, torch.Tensor | tuple[str, ...]] = {
        NOISE_COLUMN: torch.full((count,), at_board, dtype=torch.float64),
        WEIGHT_COLUMN: tuple(weight_text(_inverse_root(one + of_robot)) for one in of_corners),
        CAMERA_COLUMN: (solved.camera.name,) * count,
    }
    if solved.sigma.any():
        by = np.stack(changes) @ solved.intrinsics.by
        readings[INTRINSICS_COLUMN] = replace(solved.intrinsics, by=by).texts
    if board.scale_deviation is not None:
        readings[SCALE_COLUMN] = (f"{board.scale_deviation:.17g}",) * count
    return readings


def _board_poses(
    images: Images, camera: Camera, board: Board, bend: Float64[np.ndarray, " 3"], loss: AbstractLoss
) -> tuple[list[BoardPose], Float64[np.ndarray, " 3"]]:
    """Solve the poses of a board at some intrinsics, bent as the images show it where it need not be flat.

    Returns:
        The poses, and the heights of the board's shapes [m].

    Raises:
        MeasurementError: the corners of an image are not of this board.
    """
    observed = images.corners, images.pixels, images.relative_sigma
    for _ in range(MOST_BENDS):
        corners = bent_corners(board, bend)
        poses = [
            solve_board_pose(camera, corners[number], pixels, loss, sigma)
            for number, pixels, sigma in zip(*observed, strict=True)
        ]
        _refuse_other_boards(images, board, poses)
        if not board.flatness:
            break
        before, noise = bend, corner_noise(poses, loss)
        bend = bent_further(bend, board, camera, *observed, poses, noise)
        if np.abs(bend - before).max() < SMALLEST_BEND:
            break
    return poses, bend


def _refuse_other_boards(images: Images, board: Board, poses: Sequence[BoardPose]) -> None:
    """Refuse images whose corners are not where a board of this kind has them.

    Raises:
        MeasurementError: see above.
    """
    for name, line, pose in zip(images.names, images.lines, poses, strict=True):
        miss = float(np.median(pose.distance))
        if not miss < LARGEST_MISS:
            raise MeasurementError(
                f"{images.source}, line {line}: half of the corners of image '{name}' are {miss:.3g} px or more from "
                f"where a board of {board.rows} x {board.columns} corners has them; check the numbers of the corners, "
                "the board and the camera, or remove the image."
            )
    from_front = np.array([pose.R[:, 2] @ pose.t > 0 for pose in poses])
    if from_front.any() and not from_front.all():
        fewer = np.flatnonzero(from_front == (2 * from_front.sum() < len(from_front)))
        raise MeasurementError(
            f"{images.source}, line {images.lines[fewer[0]]}: image '{images.names[fewer[0]]}' shows the board "
            f"mirrored against {len(poses) - len(fewer)} of the {len(poses)} images; check whether it is mirrored, "
            "and whether its corners are numbered as in the others."
        )


def _target_pose(pose: BoardPose, is_fixed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose of the target in its frame, and its change in the axes of the frame by that of the board's pose.

    Of the inverse pose, position `-R^T t` moves by `-R^T (shift + t × turn)`, and the rotation turns by `-R^T turn`.
    """
    if is_fixed:
        return pose.R, pose.t, np.eye(POSE)
    back = pose.R.T
    change = np.zeros((POSE, POSE))
    change[:3, :3] = change[3:, 3:] = -back
    change[:3, 3:] = -back @ skew(torch.from_numpy(pose.t)).numpy()
    return back, -back @ pose.t, change


def _inverse_root(covariance: np.ndarray) -> np.ndarray:
    """Lower triangular W with `W^T W` = inverse of a covariance, scaled first, as metres and radians differ."""
    scale = np.sqrt(covariance.diagonal())
    root: np.ndarray = np.linalg.inv(np.linalg.cholesky(covariance / scale / scale[:, None])) / scale
    return root


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
