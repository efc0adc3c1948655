"""A camera that sees a board, and the covariance of a pose from an image before the image is taken."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.robot.se3 import invert, skew


@dataclass(frozen=True, eq=False)
class BoardSight:
    """A camera and the board that it sees: one is on the flange (the target), the other is the measuring frame.

    Attributes:
        camera: camera with known intrinsics.
        board: board, of which every image shows all corners.
        is_fixed: whether the camera is fixed and the board is on the flange; otherwise the camera is on the flange.
        corner_noise: standard deviation of u and v of a corner [px].
        repeatability: repeatability of the robot.
    """

    camera: Camera
    board: Board
    is_fixed: bool
    corner_noise: float
    repeatability: Repeatability

    def board_in_camera(self, T_frame_target: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses 4 4"]:
        """Return T_camera_board for T_frame_target [m]."""
        return T_frame_target if self.is_fixed else invert(T_frame_target)

    def whitening_matrix(self, T_frame_target: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses 6 6"]:
        """Compute the lower triangular W for which `W^T W` is the inverse covariance of poses measured with images.

        The covariance is that of (translation [m], rotation vector [rad]) of the target in the axes of the measuring
        frame: `(Σ J^T J)^-1 noise²` over all corners plus the repeatability, as in `CornerSensor` for measured corners.
        For a small motion (δ, ω) of the target at t, a corner X moves in the camera by `F (δ + ω × (X - t))`, where
        F rotates from the axes of the frame to the axes of the camera; the sign is reversed if the camera is the
        target.
        """
        T = self.board_in_camera(T_frame_target)
        corners = torch.from_numpy(self.board.corners).to(T)
        in_camera = corners @ T[:, :3, :3].mT + T[:, None, :3, 3]
        point_jacobian = torch.from_numpy(self.camera.project(in_camera.numpy())[1])
        origin = T_frame_target[:, None, :3, 3]
        # A camera on the flange moves relative to the board, so the sign and the axes change.
        if self.is_fixed:
            shift_jacobian, lever = point_jacobian, in_camera - origin
        else:
            shift_jacobian, lever = -point_jacobian @ T[:, None, :3, :3], corners - origin
        J = torch.cat([shift_jacobian, -shift_jacobian @ skew(lever)], -1)
        # Cramér-Rao bound of the pose from all corners; the repeatability of the robot is independent of it.
        covariance = self.corner_noise**2 * torch.linalg.inv(torch.einsum("ncki,nckj->nij", J, J))
        variances = [self.repeatability.length**2] * 3 + [self.repeatability.angle**2] * 3
        lower = torch.linalg.cholesky(covariance + torch.diag(covariance.new_tensor(variances)))
        weight: Tensor = torch.linalg.solve_triangular(lower, torch.eye(6).to(lower), upper=False)
        return weight
