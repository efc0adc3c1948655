"""Poses from which a camera sees the whole board: tests of given poses, and random poses."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.camera.pattern import board_sheet
from pisigma.planning.board_sight import BoardSight
from pisigma.planning.surroundings.arm_in_surroundings import POSES_PER_CHUNK, ArmInSurroundings
from pisigma.planning.surroundings.surroundings import ViewSection
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.se3 import invert, rotation_from_zyx, transform

_FULL_POSE_DOF = 6
"""Number of joints of an arm that reaches any pose in its workspace, so that a closed form can be used."""
_CENTRE_SHARE = 0.5
"""Share of the image's width and height in which the centre of a random board lies."""
MAX_ITERATIONS = 30
"""Largest number of iterations of the numeric inverse kinematics."""
_MAX_DEPTH_RATIO = 8.0
"""Largest depth of random boards, as a multiple of the depth at which they fill the image."""
_SIGHT_LINE_SHARES = (0.1, 0.8)
"""Start and end of the checked part of a line of sight, as shares of the distance from the camera to the board, because
camera and board may be mounted on a box."""


@dataclass(frozen=True, eq=False)
class ViewConditions:
    """Conditions under which a camera sees a whole board, sharply and not too obliquely.

    Attributes:
        sight: camera and board.
        T_cell_frame: pose of the measuring frame (the board, or the fixed camera) in the frame of the nominal base [m].
        min_depth: smallest depth of a corner in front of the camera [m].
        max_depth: largest depth of a corner [m].
        max_incidence_angle: largest angle between the normal of the board and the line of sight to its centre [rad].
        margin_px: distance that the board keeps from the edge of the image [px].
    """

    sight: BoardSight
    T_cell_frame: Float64[Tensor, "4 4"]
    min_depth: float
    max_depth: float
    max_incidence_angle: float
    margin_px: float

    @staticmethod
    def from_sight(
        sight: BoardSight, T_cell_frame: Float64[Tensor, "4 4"], view: ViewSection
    ) -> "ViewConditions":
        """Read the conditions from the section `view` of the surroundings."""
        nearest, farthest = view.sharp_depths(sight.camera.fx)
        return ViewConditions(
            sight, T_cell_frame, nearest, farthest, math.radians(view.oblique_deg), view.margin_px
        )

    def draw(
        self, arm: ArmInSurroundings, count: int, generator: torch.Generator
    ) -> Float64[Tensor, "count dof"]:
        """Draw joint values [rad or m] of random views, each in a random branch; NaN if a view is not reached.

        Depth, obliqueness, its direction, the rotation about the line of sight and the position in the image are
        uniformly distributed. For an arm without closed-form inverse kinematics, or with fewer than six joints, the
        poses are those nearest to a view that numeric inverse kinematics finds from random joint values.
        """
        T_board = self._sampled_boards(count, generator)
        T_frame_target = T_board if self.sight.is_fixed else invert(T_board)
        T = self.T_cell_frame @ T_frame_target
        solver = closed_form_solver(arm.robot) if arm.robot.dof == _FULL_POSE_DOF else None
        if solver is None:
            limits = torch.from_numpy(arm.robot.limits).nan_to_num(posinf=math.pi, neginf=-math.pi)
            start = torch.rand(count, len(limits), generator=generator, dtype=T.dtype)
            start = limits[:, 0] + (limits[:, 1] - limits[:, 0]) * start
            return solve_numeric(arm.robot, T, start, max_iterations=MAX_ITERATIONS).q
        branches = solver.solve(T).q
        rank = torch.rand(branches.shape[:2], generator=generator, dtype=T.dtype)
        values, (lower, upper) = arm.robot.to_controller(branches), arm.limits.t()
        rank += ((values >= lower) & (values <= upper)).all(-1)  # branches within the limits come first
        rank = torch.where(branches.isfinite().all(-1), rank, -1.0)
        chosen: Tensor = branches[torch.arange(count), rank.argmax(1)]
        return chosen

    def faults(
        self, arm: ArmInSurroundings, q: Float64[Tensor, "poses dof"]
    ) -> dict[str, Bool[Tensor, " poses"]]:
        """Return the masks of poses that fail, by reason."""
        chunks = [self._faults(arm, chunk) for chunk in torch.split(q, POSES_PER_CHUNK)]
        return {reason: torch.cat([chunk[reason] for chunk in chunks]) for reason in chunks[0]}

    def incidence_angles(
        self, arm: ArmInSurroundings, q: Float64[Tensor, "poses dof"]
    ) -> Float64[Tensor, " poses"]:
        """Compute the angle of the board's normal to the line of sight to its centre [rad]; > π / 2 from behind."""
        return self._obliqueness(self._boards(arm, q)[0])

    def board_shift_margin(
        self, arm: ArmInSurroundings, q: Float64[Tensor, "poses dof"]
    ) -> Float64[Tensor, " poses"]:
        """Compute how far the board may be from its stated position before it leaves the image [m]."""
        points, pixels, _ = self._shown(self._boards(arm, q)[0])
        edge = pixels.new_tensor([self.sight.camera.width, self.sight.camera.height])
        room = torch.minimum(pixels, edge - pixels).amin(-1) * points[..., 2] / self.sight.camera.fx
        return room.amin(1)

    def _sampled_boards(self, count: int, generator: torch.Generator) -> Float64[Tensor, "count 4 4"]:
        """Return T_camera_board of random views [m]."""
        camera = self.sight.camera
        draws = torch.rand(count, 6, generator=generator, dtype=torch.float64)
        size = draws.new_tensor([camera.width, camera.height])
        pixels = size * (0.5 + _CENTRE_SHARE * (draws[:, :2] - 0.5))
        rays = torch.from_numpy(camera.undistort(pixels.numpy()))
        left, top, right, bottom = board_sheet(self.sight.board)
        fills = camera.fx * min(right - left, bottom - top) / min(camera.width, camera.height)
        least, most = max(self.min_depth, fills), min(self.max_depth, _MAX_DEPTH_RATIO * fills)
        # Depths from where the board fills the image to where it is too small, within the stated distances.
        depth = least + (most - least) * draws[:, 2:3]
        middle = depth * torch.cat([rays, torch.ones_like(depth)], 1)
        direction, turn = 2 * math.pi * draws[:, 3:5].t()
        nothing = torch.zeros_like(turn)
        # Roll is the direction of the tilt and pitch its size; the board is then rotated in its own plane.
        R = rotation_from_zyx(torch.stack([direction, self.max_incidence_angle * draws[:, 5], nothing], 1))
        R = R @ rotation_from_zyx(torch.stack([turn, nothing, nothing], 1))
        return transform(R, middle - R @ self._middle)

    def _faults(
        self, arm: ArmInSurroundings, q: Float64[Tensor, "poses dof"]
    ) -> dict[str, Bool[Tensor, " poses"]]:
        T, T_cell_board = self._boards(arm, q)
        points, pixels, is_regular = self._shown(T)
        camera, oblique = self.sight.camera, self._obliqueness(T)
        edge = pixels.new_tensor([camera.width, camera.height]) - self.margin_px
        inside = ((pixels >= self.margin_px) & (pixels <= edge)).all(-1) & is_regular & (points[..., 2] > 0)
        faults = {
            "the camera is behind the board": oblique > math.pi / 2,
            "the board is not completely in the image": ~inside.all(1),
            "a part of the board is too near to be sharp": points[..., 2].amin(1) < self.min_depth,
            "a part of the board is too far away to be sharp": points[..., 2].amax(1) > self.max_depth,
            "the board is seen too obliquely": oblique > self.max_incidence_angle,
        }
        corners = self._sheet @ T_cell_board[:, :3, :3].mT + T_cell_board[:, None, :3, 3]
        T_cell_camera = T_cell_board @ invert(T)
        eye = T_cell_camera[:, None, :3, 3]
        lines = torch.stack([eye + share * (corners - eye) for share in _SIGHT_LINE_SHARES], -2)
        return faults | arm.blocked_lines_of_sight(q, lines, "the board from the camera")

    def _boards(
        self, arm: ArmInSurroundings, q: Float64[Tensor, "poses dof"]
    ) -> tuple[Float64[Tensor, "poses 4 4"], Float64[Tensor, "poses 4 4"]]:
        """Return T_camera_board and T_cell_board [m]."""
        T_cell_target = forward_kinematics(arm.robot, q)
        T = self.sight.board_in_camera(invert(self.T_cell_frame) @ T_cell_target)
        return T, T_cell_target if self.sight.is_fixed else self.T_cell_frame.expand_as(T)

    def _shown(
        self, T_camera_board: Float64[Tensor, "poses 4 4"]
    ) -> tuple[
        Float64[Tensor, "poses points 3"], Float64[Tensor, "poses points 2"], Bool[Tensor, "poses points"]
    ]:
        """Return points of the sheet in the camera's frame [m], their pixels, and whether the projection is regular.

        Far outside the image, the polynomials of a distortion model fold back, so a pixel corresponds to several
        points.
        """
        points = self._sheet @ T_camera_board[:, :3, :3].mT + T_camera_board[:, None, :3, 3]
        in_front = points.clone()
        in_front[..., 2] = points[..., 2].clamp(min=1e-3)
        pixels, point_jacobian = map(torch.from_numpy, self.sight.camera.project(in_front.numpy()))
        across = point_jacobian[..., :2]
        is_regular = (torch.linalg.det(across) > 0) & (across.diagonal(dim1=-2, dim2=-1).sum(-1) > 0)
        return points, pixels, is_regular

    def _obliqueness(self, T_camera_board: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, " poses"]:
        R, t = T_camera_board[:, :3, :3], T_camera_board[:, :3, 3]
        sight = torch.nn.functional.normalize(R @ self._middle + t, dim=1)
        return (R[:, :, 2] * sight).sum(1).clamp(-1, 1).acos()

    @property
    def _sheet(self) -> Float64[Tensor, "9 3"]:
        """Corners, edge centres and centre of the printed sheet in the board's frame [m].

        Links are too thick to fit between the lines of sight to these points.
        """
        left, top, right, bottom = board_sheet(self.sight.board)
        x, y = (np.linspace(*ends, 3) for ends in ((left, right), (top, bottom)))
        return torch.from_numpy(np.stack([*np.meshgrid(x, y), np.zeros((3, 3))], -1).reshape(9, 3))

    @property
    def _middle(self) -> Float64[Tensor, " 3"]:
        return self._sheet[4]
