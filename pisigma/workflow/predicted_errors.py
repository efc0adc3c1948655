"""Position errors that a model predicts over its workspace."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.planning.expected_accuracy import p95_by_pose
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.validation.held_out.judged_rows import tool_positions
from pisigma.validation.report.error_map import samples_of_workspace

_POSES_PER_CHUNK = 500
"""Number of poses whose derivatives are in memory at a time."""


@dataclass(frozen=True, eq=False)
class PredictedErrors:
    """Predicted position errors of a model at samples of its workspace.

    Attributes:
        position: position of the tool in the robot's base frame [m].
        p95: 95 % quantile of the position error at each pose [m].
    """

    position: Float64[Tensor, "samples 3"]
    p95: Float64[Tensor, " samples"]


def predicted_errors(model: CalibratedModel) -> PredictedErrors:
    """Predict the position errors of a model, as `plan` predicts them over a task.

    The samples are those of the report: joint values that the model stores, and random ones within their ranges.

    Raises:
        IdentificationError: the model stores no posterior.
    """
    posterior, (q, _) = RobotPosterior.from_model(model), samples_of_workspace(model)
    p95 = [p95_by_pose(posterior.tool_derivatives(some)) for some in torch.split(q, _POSES_PER_CHUNK)]
    return PredictedErrors(tool_positions(model, q), torch.cat(p95))
