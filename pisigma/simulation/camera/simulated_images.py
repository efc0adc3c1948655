"""The part of a recipe that states which images a camera takes on the true robot."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from pydantic import Field
from torch import Tensor

from pisigma.files.yaml_file import Section, Seed
from pisigma.measurement.camera.board import BoardDocument
from pisigma.measurement.camera.camera import Camera, CameraDocument, IntrinsicsSection
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.simulation.camera.images import ImageNoise, draw_board_poses, simulate_images
from pisigma.simulation.camera.rendering import Exposure, render_image
from pisigma.simulation.camera.true_board import TrueBoard
from pisigma.simulation.camera.views import RandomViews
from pisigma.simulation.true_robot import TrueRobot


class CornerNoise(Section):
    """Normal deviations of corners, and of the robot's pose from image to image.

    Attributes:
        corner_px: standard deviation of u and v of every corner [px].
        repeatability_mm: of the robot's position, per axis [mm].
        repeatability_deg: of its orientation, about each axis [deg].
        seed: of the generator.
    """

    corner_px: float = Field(default=0.3, ge=0)
    repeatability_mm: float = Field(default=0.02, ge=0)
    repeatability_deg: float = Field(default=0.01, ge=0)
    seed: Seed

    @property
    def repeatability(self) -> Repeatability:
        """Of the robot, in SI units."""
        return Repeatability(self.repeatability_mm / 1e3, float(np.deg2rad(self.repeatability_deg)))


class BoardErrors(Section):
    """By how much a board differs from what is stated of it.

    Attributes:
        scale_percent: by how much all of its lengths are larger [%].
        bow_mm: by how much its farthest corners stand out of the plane at its middle [mm].
    """

    scale_percent: float = Field(default=0.0, gt=-100)
    bow_mm: float = 0.0


class LateJoints(Section):
    """Joint values of a moving arm that are read after the image was taken.

    Attributes:
        delay_ms: from the image to the reading [ms].
        speed_deg_per_s: standard deviation of the speed of every joint, which is revolute [deg/s].
    """

    delay_ms: float
    speed_deg_per_s: float = Field(ge=0)


class SimulatedImages(Section):
    """The part of a recipe that states what a camera sees of a board.

    The base of the true robot (an error of the recipe) leads from the board to the robot, and its tool from the flange
    to the camera; of a fixed camera, from the camera to the robot and from the flange to the board. Joints with play
    stop in its middle.

    Attributes:
        kind: "images".
        poses: from where the camera looks at the board.
        camera: as its file would state it.
        board: as its file would state it.
        noise: of corners and robot.
        camera_errors: true minus stated intrinsics.
        board_errors: of size and flatness.
        late_joints: joint values that are read late; left out, they are those of the image.
    """

    kind: Literal["images"]
    poses: RandomViews
    camera: CameraDocument
    board: BoardDocument
    noise: CornerNoise
    camera_errors: IntrinsicsSection = IntrinsicsSection()
    board_errors: BoardErrors = BoardErrors()
    late_joints: LateJoints | None = None

    @property
    def frame(self) -> str:
        """In which the rows are."""
        return self.camera.name if self.camera.is_fixed else self.board.name

    @property
    def target(self) -> str:
        """Whose poses the rows are."""
        return self.board.name if self.camera.is_fixed else self.camera.name

    def measure(self, robot: TrueRobot) -> Measurements:
        """Simulate the corners of all images, the same at every call; see `image_measurements`."""
        q, is_fixed = self._joints(robot), self.camera.is_fixed
        noise = ImageNoise(self.noise.corner_px, self.noise.repeatability)
        actual = robot.actual_joints(q)
        images = simulate_images(robot.geometry, actual, *self._true(), noise, self._generator(), is_fixed)
        stated = self.camera.camera(), self.board.board()
        images = replace(images, q=self._read(q), source=f"simulation of {robot.nominal.name}")
        return image_measurements(images, *stated, is_fixed, self.noise.repeatability)

    def joints_read(self, robot: TrueRobot) -> Float64[Tensor, "images dof"]:
        """Joint values that are read for the images [rad or m]."""
        return self._read(self._joints(robot))

    def rendered(self, robot: TrueRobot) -> Iterator[UInt8[np.ndarray, "height width"]]:
        """Draw the images pixel by pixel, the same at every call; corners have what noise their detection leaves."""
        camera, board = self._true()
        q, rng = robot.actual_joints(self._joints(robot)), np.random.default_rng(self.noise.seed)
        poses = draw_board_poses(
            robot.geometry, q, self.noise.repeatability, self._generator(), self.camera.is_fixed
        )
        for pose in poses.numpy():
            yield render_image(camera, board, pose, Exposure(), rng)

    def _generator(self) -> torch.Generator:
        return torch.Generator().manual_seed(self.noise.seed)

    def _joints(self, robot: TrueRobot) -> Float64[Tensor, "images dof"]:
        nominal, true = robot.nominal, robot.geometry
        aimed = nominal.with_geometry(nominal.dh, true.base, true.tool)
        return self.poses.joints(aimed, self.camera.camera(), self.board.board(), self.camera.is_fixed)

    def _read(self, q: Tensor) -> Tensor:
        if self.late_joints is None:
            return q
        generator = torch.Generator().manual_seed(self.noise.seed + 1)
        late = float(np.deg2rad(self.late_joints.speed_deg_per_s)) * self.late_joints.delay_ms / 1e3
        return q + late * torch.randn(q.shape, generator=generator, dtype=torch.float64)

    def _true(self) -> tuple[Camera, TrueBoard]:
        """The camera and the board as they really are."""
        stated = self.camera.camera()
        camera = stated.with_intrinsics(stated.intrinsics + np.array(self.camera_errors.numbers))
        errors = self.board_errors
        return camera, TrueBoard(self.board.board(), 1 + errors.scale_percent / 100, errors.bow_mm / 1e3)
