"""Section of a recipe for images of a board taken by a camera on the true robot."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from PIL import Image
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import RecipeError
from pisigma.files.output_folder import staged_folder
from pisigma.files.yaml_file import Count, Section, Seed
from pisigma.files.yaml_writing import yaml_text
from pisigma.measurement.camera.board import Board, BoardDocument
from pisigma.measurement.camera.camera import Camera, CameraDocument, IntrinsicDeviationsSection
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import Images, image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import AbstractClosedForm, closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import invert, rotation_from_vector, rotation_from_zyx, transform
from pisigma.simulation.camera.rendering import Exposure, TrueBoard, render_image
from pisigma.simulation.true_robot import TrueRobot

_CANDIDATES = 8
"""Number of candidates per view; candidates that are far apart in joint space are chosen."""
_MAX_ATTEMPTS = 100
"""Largest number of draws per candidate; some draws cannot be reached."""
_GIVEN_FILES = ("joints.csv", "camera.yaml", "board.yaml")


class RandomViews(Section):
    """Random views of a complete board on random branches, far apart in joint space.

    Every joint vector is the candidate that is farthest from all previous ones, measured in sines and cosines.

    Attributes:
        count: number of views.
        seed: random seed.
        distance_mm: smallest and largest distance of the camera from the centre of the board [mm].
        oblique_deg: largest angle between the axes of camera and board [deg].
    """

    count: Count
    seed: Seed
    distance_mm: tuple[float, float] = (300.0, 700.0)
    oblique_deg: float = Field(default=40.0, ge=0, lt=90)

    def joints(
        self, robot: Robot, camera: Camera, board: Board, is_fixed: bool = False
    ) -> Float64[Tensor, "count dof"]:
        """Return the joint values to command [rad or m]; every call returns the same values.

        Args:
            robot: the robot, with its base from the board to the base and its tool from the flange to the camera (for
                a fixed camera: from the camera to the base, and from the flange to the board).
            camera: the camera, in whose images the board is complete, with half a square around its corners.
            board: the board, seen from its printed side, with its z axis pointing away.
            is_fixed: whether the camera is fixed and the board is on the flange.

        Raises:
            RecipeError: the robot has no closed-form inverse kinematics, or reaches fewer views than requested.
        """
        solver, rng = self.closed_form(robot), np.random.default_rng(self.seed)
        chosen, needed = list[Tensor](), _CANDIDATES * self.count
        for _ in range(_MAX_ATTEMPTS * needed):
            T_board_camera = self._view(board, rng)
            T_camera_board = invert(T_board_camera)
            if not _is_whole(camera, board, T_camera_board.numpy()):
                continue
            branches = solver.solve(T_camera_board if is_fixed else T_board_camera)
            reached = branches.q[branches.status == Status.REACHED]
            if len(reached):
                chosen.append(reached[rng.integers(len(reached))])
            if len(chosen) == needed:
                return select_far_apart(torch.stack(chosen), self.count)
        raise RecipeError(
            option="poses",
            expected=f"at least {needed} of {_MAX_ATTEMPTS * needed} random views of the board within reach of robot "
            f"'{robot.name}'",
            value=len(chosen),
            remedy="check the positions of board and camera, and the distances",
        )

    def closed_form(self, robot: Robot) -> AbstractClosedForm:
        """Return the closed-form inverse kinematics for the views.

        Raises:
            RecipeError: the robot has no closed-form inverse kinematics.
        """
        solver = closed_form_solver(robot)
        if solver is None:
            raise RecipeError(
                option="poses",
                expected="a robot with closed-form inverse kinematics, for views of a board",
                value=robot.name,
                remedy="simulate a tracker with joints_random instead",
            )
        return solver

    def _view(self, board: Board, rng: np.random.Generator) -> Float64[Tensor, "4 4"]:
        """Draw T_board_camera: a direction, a tilt, a roll about the camera's axis, and a distance."""
        oblique, (near, far) = np.deg2rad(self.oblique_deg), self.distance_mm
        tilt, direction, roll, distance = rng.uniform((0, 0, 0, near), (oblique, 2 * np.pi, 2 * np.pi, far))
        angles = torch.tensor([[direction, tilt, 0.0], [roll, 0.0, 0.0]], dtype=torch.float64)
        around, about_axis = rotation_from_zyx(angles)
        middle = torch.from_numpy((board.corners.min(0) + board.corners.max(0)) / 2)
        return transform(around @ about_axis, middle - distance / 1e3 * around[:, 2])


def _is_whole(camera: Camera, board: Board, T_camera_board: Float64[np.ndarray, "4 4"]) -> bool:
    """Return whether the complete board is in view, with half a square around its corners."""
    corners = board.corners
    out = corners + board.square / 2 * np.sign(corners - corners.mean(0))
    pixels = camera.project(out @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])[0]
    return bool(((pixels > 0) & (pixels < (camera.width, camera.height))).all())


def select_far_apart(q: Float64[Tensor, "rows dof"], count: int) -> Float64[Tensor, "count dof"]:
    """Choose joint values [rad] by farthest-point sampling in sines and cosines, starting with the first row."""
    points = torch.cat([q.cos(), q.sin()], 1)
    chosen, distance = [0], (points - points[0]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[chosen[-1]]).norm(dim=1))
    return q[chosen]


class CornerNoise(Section):
    """Normally distributed noise of the corners, and of the robot's pose from image to image.

    Attributes:
        corner_px: standard deviation of u and v of every corner [px].
        repeatability_mm: standard deviation of the robot's position per axis [mm].
        repeatability_deg: standard deviation of the robot's orientation about each axis [deg].
        seed: random seed.
    """

    corner_px: float = Field(default=0.3, ge=0)
    repeatability_mm: float = Field(default=0.02, ge=0)
    repeatability_deg: float = Field(default=0.01, ge=0)
    seed: Seed

    @property
    def repeatability(self) -> Repeatability:
        """Repeatability of the robot in SI units."""
        return Repeatability(self.repeatability_mm / 1e3, float(np.deg2rad(self.repeatability_deg)))


class BoardErrors(Section):
    """Differences of the true board from its description.

    Attributes:
        scale_percent: relative error of all lengths of the board [%].
        bow_mm: height of the farthest corners above the plane at the centre of the board [mm].
    """

    scale_percent: float = Field(default=0.0, gt=-100)
    bow_mm: float = 0.0


class JointReadingDelay(Section):
    """Delay with which joint values of a moving arm are read after an image is taken.

    Attributes:
        delay_ms: delay from the image to the reading [ms].
        speed_deg_per_s: standard deviation of the speed of every joint, which is revolute [deg/s].
    """

    delay_ms: float
    speed_deg_per_s: float = Field(ge=0)


class SimulatedImages(Section):
    """Section of a recipe for a camera that takes images of a board.

    The base of the true robot (an error source of the recipe) is the transform from the board to the robot, and its
    tool is the transform from the flange to the camera; for a fixed camera, they are the transforms from the camera
    to the robot and from the flange to the board. Joints with backlash stop in the middle of their play.

    Attributes:
        kind: "images".
        poses: views of the board.
        camera: the camera as described in its file.
        board: the board as described in its file.
        noise: noise of corners and robot.
        camera_errors: true minus described intrinsics.
        board_errors: errors of size and flatness of the board.
        late_joints: delay of the joint values; by default they are read when the image is taken.
    """

    kind: Literal["images"]
    poses: RandomViews
    camera: CameraDocument
    board: BoardDocument
    noise: CornerNoise
    camera_errors: IntrinsicDeviationsSection = IntrinsicDeviationsSection()
    board_errors: BoardErrors = BoardErrors()
    late_joints: JointReadingDelay | None = None

    @property
    def frame(self) -> str:
        """Name of the frame of the rows."""
        return self.camera.name if self.camera.is_fixed else self.board.name

    @property
    def target(self) -> str:
        """Name of the target of the rows."""
        return self.board.name if self.camera.is_fixed else self.camera.name

    def measure(self, robot: TrueRobot) -> Measurements:
        """Simulate the corners of all images; every call returns the same values. See `image_measurements`."""
        q, is_fixed = self._joints(robot), self.camera.is_fixed
        noise = ImageNoise(self.noise.corner_px, self.noise.repeatability)
        actual = robot.actual_joints(q)
        images = simulate_images(
            robot.true_geometry, actual, *self._true(), noise, self._generator(), is_fixed
        )
        stated = self.camera.camera(), self.board.board()
        images = replace(images, q=self._read(q), source=f"simulation of {robot.nominal.name}")
        return image_measurements(images, *stated, is_fixed, self.noise.repeatability)

    def joint_readings(self, robot: TrueRobot) -> Float64[Tensor, "images dof"]:
        """Return the joint values that are read for the images [rad or m]."""
        return self._read(self._joints(robot))

    def render(self, robot: TrueRobot) -> Iterator[UInt8[np.ndarray, "height width"]]:
        """Render the images pixel by pixel, always the same; the noise of corners is that of their detection."""
        camera, board = self._true()
        q, rng = robot.actual_joints(self._joints(robot)), np.random.default_rng(self.noise.seed)
        poses = noisy_board_poses(
            robot.true_geometry, q, self.noise.repeatability, self._generator(), self.camera.is_fixed
        )
        for pose in poses.numpy():
            yield render_image(camera, board, pose, Exposure(), rng)

    def _generator(self) -> torch.Generator:
        return torch.Generator().manual_seed(self.noise.seed)

    def _joints(self, robot: TrueRobot) -> Float64[Tensor, "images dof"]:
        nominal, true = robot.nominal, robot.true_geometry
        aimed = nominal.with_geometry(nominal.dh, true.base, true.tool)
        return self.poses.joints(aimed, self.camera.camera(), self.board.board(), self.camera.is_fixed)

    def _read(self, q: Tensor) -> Tensor:
        if self.late_joints is None:
            return q
        generator = torch.Generator().manual_seed(self.noise.seed + 1)
        late = float(np.deg2rad(self.late_joints.speed_deg_per_s)) * self.late_joints.delay_ms / 1e3
        return q + late * torch.randn(q.shape, generator=generator, dtype=torch.float64)

    def _true(self) -> tuple[Camera, TrueBoard]:
        """Return the true camera and the true board, including their errors."""
        stated = self.camera.camera()
        camera = stated.with_intrinsics(stated.intrinsics + np.array(self.camera_errors.numbers))
        errors = self.board_errors
        return camera, TrueBoard(self.board.board(), 1 + errors.scale_percent / 100, errors.bow_mm / 1e3)


@dataclass(frozen=True)
class ImageNoise:
    """Noise of corners in images, and of the robot's pose.

    Attributes:
        corner: standard deviation of u and v of every corner [px].
        repeatability: repeatability of the robot's pose, which is common to all corners of an image.
    """

    corner: float = 0.3
    repeatability: Repeatability = field(default_factory=Repeatability)


def noisy_board_poses(
    robot: Robot,
    q: Float64[Tensor, "images dof"],
    repeatability: Repeatability,
    generator: torch.Generator,
    is_fixed: bool = False,
) -> Float64[Tensor, "images 4 4"]:
    """Return T_camera_board [m] of every image of a true robot, with random errors due to its repeatability.

    Args:
        robot: the true arm, with its base from the board to the base and its tool from the flange to the camera (for a
            fixed camera: from the camera to the base, and from the flange to the board).
        q: joint values of the images [rad or m].
        repeatability: repeatability of the robot.
        generator: random generator of the pose errors.
        is_fixed: whether the camera is fixed and the board is on the flange.
    """
    T = forward_kinematics(robot, q)
    vector, shift = (torch.randn((len(q), 3), generator=generator, dtype=torch.float64) for _ in range(2))
    R = rotation_from_vector(repeatability.angle * vector) @ T[:, :3, :3]
    T = transform(R, T[:, :3, 3] + repeatability.length * shift)
    return T if is_fixed else invert(T)


def project_corners(
    camera: Camera, board: Board | TrueBoard, T_camera_board: Float64[Tensor, "images 4 4"]
) -> tuple[Float64[np.ndarray, "images corners 2"], Bool[np.ndarray, "images corners"]]:
    """Return the pixels of corners [px], and the mask of corners in front of the camera and inside its images."""
    corners = torch.from_numpy(board.corners)
    points = (corners @ T_camera_board[:, :3, :3].mT + T_camera_board[:, None, :3, 3]).numpy()
    pixels = camera.project(points)[0]
    inside = (points[..., 2] > 0) & (pixels >= 0).all(-1) & (pixels < (camera.width, camera.height)).all(-1)
    return pixels, inside


def simulate_images(
    robot: Robot,
    q: Float64[Tensor, "images dof"],
    camera: Camera,
    board: Board | TrueBoard,
    noise: ImageNoise,
    generator: torch.Generator,
    is_fixed: bool = False,
) -> Images:
    """Project the corners of a board into the images of a camera.

    Args:
        robot: the true arm, see `noisy_board_poses`.
        q: joint values of the images [rad or m].
        camera: the camera.
        board: the board.
        noise: noise of corners and robot.
        generator: source of the noise.
        is_fixed: whether the camera is fixed and the board is on the flange.

    Returns:
        The images, with the corners that are in front of the camera and inside its images.
    """
    T_camera_board = noisy_board_poses(robot, q, noise.repeatability, generator, is_fixed)
    pixels, inside = project_corners(camera, board, T_camera_board)
    pixels += noise.corner * torch.randn(pixels.shape, generator=generator, dtype=torch.float64).numpy()
    return images_of(
        q, [np.flatnonzero(row) for row in inside], [at[row] for at, row in zip(pixels, inside, strict=True)]
    )


def images_of(
    q: Float64[Tensor, "images dof"], corner_numbers: Sequence[np.ndarray], pixels: Sequence[np.ndarray]
) -> Images:
    """Return simulated corners as images.

    Args:
        q: joint values of every image [rad or m].
        corner_numbers: numbers of the corners in every image.
        pixels: pixels of the corners in every image [px].
    """
    names = tuple(f"{number:04d}" for number in range(len(q)))
    return Images("simulated images", names, q, (0,) * len(q), tuple(corner_numbers), tuple(pixels))


def write_images(images: SimulatedImages, robot: TrueRobot, folder: str | os.PathLike[str]) -> int:
    """Render images as `0000.png` and so on, with the given `joints.csv`, `camera.yaml` and `board.yaml`.

    Args:
        images: section of a recipe that describes the images.
        robot: the true robot.
        folder: folder to write, completely or not at all; it must be empty or missing.

    Returns:
        The number of images.

    Raises:
        RecipeError: the robot does not reach the views.
        OutputError: the folder already exists, or cannot be written.
    """
    axes = robot.nominal.axes
    names = [f"q{joint + 1}_{axis.file_unit}" for joint, axis in enumerate(axes)]
    lines = [",".join(("image", *names))]
    files = [f"{number:04d}.png" for number in range(images.poses.count)]
    with staged_folder(folder, names=(*files, *_GIVEN_FILES)) as scratch:
        q = robot.nominal.to_controller(images.joint_readings(robot)).numpy()
        for file, joints, image in zip(files, q, images.render(robot), strict=True):
            Image.fromarray(image).save(scratch / file)
            shown = (axis.in_file_unit(float(value)) for axis, value in zip(axes, joints, strict=True))
            lines.append(",".join((file, *(f"{value:.9f}" for value in shown))))
        (scratch / _GIVEN_FILES[0]).write_text("\n".join(lines) + "\n", encoding="utf-8")
        for document, name in zip((images.camera, images.board), _GIVEN_FILES[1:], strict=True):
            stated = document.model_dump(mode="json", exclude_unset=True)
            (scratch / name).write_text(yaml_text(stated), encoding="utf-8")
    return len(q)
