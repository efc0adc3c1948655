"""Displacement of the tool between two models, over the workspace or along a program."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import ModelError
from pisigma.lifetime.comparison.model_pair import ModelPair, frames_of
from pisigma.robot.description import Robot
from pisigma.robot.se3 import invert
from pisigma.validation.held_out.pose_statistics import PoseErrors


@dataclass(frozen=True, eq=False)
class Displacement:
    """Distances between the poses that two models predict for the same joint values.

    Attributes:
        source: description of the poses.
        q: joint values of poses that both models predict [rad or m].
        number: number of every pose among all of the source, from 1.
        place: position of the tool in the robot's base frame under the first model [m].
        errors: distance [m] and angle [rad] between the poses of both models.
        not_predicted: number of poses that are left out because a model does not predict them.
    """

    source: str
    q: Float64[Tensor, "poses dof"]
    number: Int64[Tensor, " poses"]
    place: Float64[Tensor, "poses 3"]
    errors: PoseErrors
    not_predicted: int

    @staticmethod
    def from_pair(pair: ModelPair, q: Float64[Tensor, "poses dof"], source: str) -> "Displacement":
        """Compare a pair of models at joint values.

        Args:
            pair: the models.
            q: joint values [rad or m].
            source: description of the joint values, such as a file.

        Raises:
            ModelError: there is no pose that both models predict.
        """
        by = pair.displacement(q)
        there = torch.isfinite(by).all(1)
        if not bool(there.any()):
            raise ModelError(
                f"{pair.first.name} and {pair.second.name} predict no pose of {source}",
                value=source,
                remedy="give poses that the robot reaches",
            )
        base = frames_of(pair.first, pair.frame_names[0])[0]
        place = (invert(base) @ pair.poses(q[there])[0])[:, :3, 3]
        errors = PoseErrors(by[there, :3].norm(dim=-1), by[there, 3:].norm(dim=-1))
        number = there.nonzero()[:, 0]
        return Displacement(source, q[there], number + 1, place, errors, len(q) - len(number))

    @property
    def largest(self) -> int:
        """Index of the pose with the largest distance."""
        return int(self.errors.position.argmax())

    def to_json(self, robot: Robot) -> dict[str, Any]:
        """Return plain values: statistics in mm and deg, and where the largest distance is.

        Args:
            robot: robot by which joint values are converted to those of the controller.
        """
        values = robot.to_controller(self.q[self.largest].numpy()).tolist()
        return {
            "source": self.source,
            "poses": len(self.q),
            "poses_not_predicted": self.not_predicted,
            **self.errors.figures.by_name,
            "largest_at_pose": int(self.number[self.largest]),
            "largest_at_mm": (self.place[self.largest] * 1e3).tolist(),
            "largest_at_joints": [
                axis.in_file_unit(value) for axis, value in zip(robot.axes, values, strict=True)
            ],
        }
