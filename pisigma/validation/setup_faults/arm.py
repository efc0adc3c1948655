"""What setup faults are judged with: a calibrated model, or the robot as drawn with base and tool fitted."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import poses_of_rows
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.held_out.frames.frame_fits import MeasuredPoses, affine_error, best_base

_MOST_POSES = 2**17


@dataclass(frozen=True, eq=False)
class PredictingArm:
    """Predicts the poses of rows under hypotheses.

    Attributes:
        robot: as drawn.
        model: whose base and tool count; None: the robot as drawn, whose base and tool are fitted to the rows under
            every hypothesis.
    """

    robot: Robot
    model: CalibratedModel | None = None

    def poses(self, rows: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Predict the poses of rows."""
        return (
            forward_kinematics(self.robot, rows.q) if self.model is None else poses_of_rows(self.model, rows)
        )

    def screened_errors(
        self, rows: Measurements, q: Float64[Tensor, "maps rows dof"], measured: MeasuredPoses
    ) -> Float64[Tensor, "modes maps"]:
        """Compute mean squared errors [m²] under hypotheses of the joint values, with the geometry alone.

        Args:
            rows: of one frame and target.
            q: joint values that they may have had [rad or m].
            measured: their poses.

        Returns:
            See `errors_in_frames`.
        """
        chunks = torch.split(q, max(1, _MOST_POSES // rows.rows))
        return torch.cat([self._screened(rows, chunk, measured) for chunk in chunks], 1)

    def errors_in_frames(
        self, T: Float64[Tensor, "*#batch rows 4 4"], measured: MeasuredPoses
    ) -> Float64[Tensor, "modes *#batch"]:
        """Compute the mean squared errors [m²] of predicted poses.

        Returns:
            Errors in the frame as it is, in one that is fitted, and, by a lower bound, with base and tool fitted;
            the last alone where there is no model.
        """
        bound = affine_error(T, measured)
        if self.model is None:
            return bound[None]
        fitted = best_base(T, measured)[..., None, :, :] @ T
        return torch.stack([measured.squares(T).mean(-1), measured.squares(fitted).mean(-1), bound])

    def _screened(self, rows: Measurements, q: Tensor, measured: MeasuredPoses) -> Tensor:
        if self.model is None:
            return self.errors_in_frames(forward_kinematics(self.robot, q), measured)
        count = len(q)
        repeated = Measurements(q=q.flatten(0, 1), frame=rows.frame * count, target=rows.target * count)
        T = poses_of_rows(replace(self.model, hybrid=None, network=None), repeated)
        return self.errors_in_frames(T.reshape(*q.shape[:2], 4, 4), measured)
