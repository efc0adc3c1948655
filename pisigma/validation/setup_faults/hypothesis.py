"""A hypothesis of what is wrong with a setup, and the arm that predicts poses under it."""

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import MeasuredPoses, affine_error, best_base
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.setup_faults.cause import Cause

COLLAPSED = 0.25
"""Share of the errors that is left, at most, where a setup fault explains them."""
FEWEST_SPARE = 6
"""Measured numbers that must be left over beyond what is fitted."""
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
        if self.model is not None:
            return poses_of_rows(self.model, rows)
        return forward_kinematics(self.robot, rows.q)

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


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Predicted poses where something is taken to be wrong.

    Attributes:
        q: the joint values that the robot then had [rad or m].
        T: the poses.
        measured: measured poses, in the units that they then have.
        causes: what is wrong.
        fitted: numbers that were fitted.
    """

    q: Float64[Tensor, "rows dof"]
    T: Float64[Tensor, "rows 4 4"]
    measured: MeasuredPoses
    causes: tuple[Cause, ...] = ()
    fitted: int = 0

    @property
    def size(self) -> float:
        """How much is assumed; a frame and a tool together less than both alone, as a new set-up has both."""
        kinds = {cause.kind for cause in self.causes}
        return sum(cause.size for cause in self.causes) - (1 if {"frame", "tool"} <= kinds else 0)

    @property
    def error(self) -> float:
        """Root mean square of the errors [m], as if nothing had been fitted."""
        spare = self.measured.values - self.fitted
        if spare < FEWEST_SPARE:
            return float("inf")
        mean = float(self.measured.squares(self.T).mean()) * self.measured.values / spare
        return float(np.sqrt(mean)) if np.isfinite(mean) else float("inf")

    def rms(self) -> tuple[float, float]:
        """Root mean squares of positions [m] and, NaN where none was measured, of rotations [rad]."""
        position = float((self.measured.position - self.T[:, :3, 3]).square().sum(-1).mean().sqrt())
        R = (self.measured.rotation @ self.T[:, :3, :3].mT)[self.measured.has_rotation]
        return position, float(rotation_vector(R).square().sum(-1).mean().sqrt())

    def without(self, kinds: Set[str]) -> "Hypothesis":
        """Leave causes of some kinds unsaid."""
        return replace(self, causes=tuple(cause for cause in self.causes if cause.kind not in kinds))

    def with_cause(self, cause: Cause, T: Float64[Tensor, "rows 4 4"], fitted: int) -> "Hypothesis":
        """Add a cause, under which the predicted poses are others."""
        return replace(self, T=T, causes=(*self.causes, cause), fitted=self.fitted + fitted)
