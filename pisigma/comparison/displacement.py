"""By how much one of two models has the tool elsewhere than the other, over the workspace or along a program."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.comparison.model_pair import ModelPair, frames_of
from pisigma.errors import ModelError
from pisigma.judging.pose_statistics import PoseErrors
from pisigma.se3 import invert


@dataclass(frozen=True, eq=False)
class Displacement:
    """Distances between the poses that two models predict for the same joint values.

    Attributes:
        q: joint values [rad or m], of poses that both models predict.
        place: position of the tool in the robot's base under the first model [m].
        errors: length [m] and angle [rad] from the first model's pose to the second's.
        not_predicted: how many poses were left out because a model predicts nothing there.
    """

    q: Float64[Tensor, "poses dof"]
    place: Float64[Tensor, "poses 3"]
    errors: PoseErrors
    not_predicted: int

    @staticmethod
    def at(pair: ModelPair, q: Float64[Tensor, "poses dof"], what: str) -> "Displacement":
        """Compare a pair at joint values.

        Args:
            pair: the models.
            q: joint values [rad or m]; those that are not finite count as not predicted.
            what: the joint values are, for messages.

        Raises:
            ModelError: there is no pose that both models predict.
        """
        usable = torch.isfinite(q).all(1)
        by = pair.displacement(torch.where(usable[:, None], q, 0.0))
        there = usable & torch.isfinite(by).all(1)
        if not bool(there.any()):
            raise ModelError(
                f"{pair.first.name} and {pair.second.name} predict no pose of {what}; give poses that the robot "
                "reaches."
            )
        base = frames_of(pair.first, pair.owner[0])[0]
        place = (invert(base) @ pair.poses(q[there])[0])[:, :3, 3]
        errors = PoseErrors(by[there, :3].norm(dim=-1), by[there, 3:].norm(dim=-1))
        return Displacement(q[there], place, errors, int((~there).sum()))

    @property
    def largest(self) -> int:
        """Number of the pose with the largest distance."""
        return int(self.errors.position.argmax())

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values: statistics in mm and deg, and where the largest distance is."""
        return {
            "poses": len(self.q),
            "poses_not_predicted": self.not_predicted,
            **self.errors.figures.by_name,
            "largest_at_mm": (self.place[self.largest] * 1e3).tolist(),
        }

    def joints(self, revolute: tuple[bool, ...]) -> Float64[np.ndarray, "poses dof"]:
        """Joint values in deg or mm."""
        joints: np.ndarray = self.q.numpy() * np.where(revolute, np.rad2deg(1.0), 1e3)
        return joints
