"""Joint values at which a camera looks at a board from many sides, by all branches of the arm."""

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Count, Section, Seed
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import AbstractClosedForm, closed_form_solver
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import invert, rotation_from_rpy, transform

CANDIDATES = 8
"""For each view, of which those are taken that are far apart in joint space."""
ATTEMPTS = 100
"""For each candidate, of which some cannot be reached."""


class RandomViews(Section):
    """Random views of a whole board, by random branches, of which those are taken that are far apart.

    Of all candidates, each joint vector is the one farthest from those before it, in sines and cosines.

    Attributes:
        count: how many.
        seed: of the generator.
        distance_mm: nearest and farthest distance of the camera from the middle of the board [mm].
        oblique_deg: largest angle between the camera's axis and the board's [deg].
    """

    count: Count
    seed: Seed
    distance_mm: tuple[float, float] = (300.0, 700.0)
    oblique_deg: float = Field(default=40.0, ge=0, lt=90)

    def joints(
        self, robot: Robot, camera: Camera, board: Board, is_fixed: bool = False
    ) -> Float64[Tensor, "count dof"]:
        """Joint values to command [rad or m]; the same at every call.

        Args:
            robot: whose base and tool lead from the board to the base and from the flange to the camera (of a fixed
                camera: from the camera to the base, and from the flange to the board).
            camera: that has the whole board in view, with its squares' rim.
            board: that is looked at from its printed side, from which its z axis points away.
            is_fixed: whether the camera is fixed and the board on the flange.

        Raises:
            RecipeError: the robot has no closed form, or does not reach so many views.
        """
        solver, rng = self.check(robot), np.random.default_rng(self.seed)
        chosen, wanted = list[Tensor](), CANDIDATES * self.count
        for _ in range(ATTEMPTS * wanted):
            T_board_camera = self._view(board, rng)
            T_camera_board = invert(T_board_camera)
            if not _is_whole(camera, board, T_camera_board.numpy()):
                continue
            branches = solver.solve(T_camera_board if is_fixed else T_board_camera)
            reached = branches.q[branches.status == Status.REACHED]
            if len(reached):
                chosen.append(reached[rng.integers(len(reached))])
            if len(chosen) == wanted:
                return far_apart(torch.stack(chosen), self.count)
        raise RecipeError(
            f"views of a board: robot '{robot.name}' reaches {len(chosen)} of {ATTEMPTS * wanted} drawn views, but "
            f"{wanted} were wanted; check where board and camera are, and the distances."
        )

    def check(self, robot: Robot) -> AbstractClosedForm:
        """Return the closed form by which views are reached.

        Raises:
            RecipeError: the robot has none.
        """
        solver = closed_form_solver(robot)
        if solver is None:
            raise RecipeError(
                f"views of a board are for robots with a closed form, which robot '{robot.name}' does not have; "
                "simulate a tracker with joints_random instead."
            )
        return solver

    def _view(self, board: Board, rng: np.random.Generator) -> Float64[Tensor, "4 4"]:
        """Draw T_board_camera: a direction, a tilt, a roll about the camera's axis, and a distance."""
        oblique, (near, far) = np.deg2rad(self.oblique_deg), self.distance_mm
        tilt, direction, roll, distance = rng.uniform((0, 0, 0, near), (oblique, 2 * np.pi, 2 * np.pi, far))
        angles = torch.tensor([[direction, tilt, 0.0], [roll, 0.0, 0.0]], dtype=torch.float64)
        around, about_axis = rotation_from_rpy(angles)
        middle = torch.from_numpy((board.corners.min(0) + board.corners.max(0)) / 2)
        return transform(around @ about_axis, middle - distance / 1e3 * around[:, 2])


def _is_whole(camera: Camera, board: Board, T_camera_board: Float64[np.ndarray, "4 4"]) -> bool:
    """Whether all of a board is in view up to half a square beyond its corners."""
    corners = board.corners
    out = corners + board.square / 2 * np.sign(corners - corners.mean(0))
    pixels = camera.project(out @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])[0]
    return bool(((pixels > 0) & (pixels < (camera.width, camera.height))).all())


def far_apart(q: Float64[Tensor, "rows dof"], count: int) -> Float64[Tensor, "count dof"]:
    """Choose joint values [rad] by farthest-point sampling in sines and cosines, the first one first."""
    points = torch.cat([q.cos(), q.sin()], 1)
    chosen, distance = [0], (points - points[0]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[chosen[-1]]).norm(dim=1))
    return q[chosen]
