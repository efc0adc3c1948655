"""Constant offsets of joint zeros."""

from typing import Literal

import numpy as np
import torch
from pydantic import Field

from pisigma.robot.description import Robot
from pisigma.simulation.errors.source import AbstractJointSource, JointErrorFunction, value_per_joint


class JointOffset(AbstractJointSource):
    """Constant errors of the joints' zeros.

    `e_j = offset_j`, added to the controller's joint value.

    Source: Whitney, Lozinski and Rourke, "Industrial robot forward calibration method and results", ASME
    Journal of Dynamic Systems, Measurement, and Control 108(1), 1986, 1-8.

    Attributes:
        kind: "joint_offset".
        offset_deg: offset by name of a revolute joint [deg].
        offset_mm: offset by name of a prismatic joint [mm].
    """

    kind: Literal["joint_offset"]
    offset_deg: dict[str, float] = Field(default_factory=dict)
    offset_mm: dict[str, float] = Field(default_factory=dict)

    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the offsets as a function of the joint values; see `AbstractJointSource.bind`."""
        stated = value_per_joint(
            robot, self.offset_deg, self.offset_mm, ("offset_deg", "offset_mm"), place_in_recipe
        )
        offset = torch.from_numpy(np.where(robot.revolute, np.deg2rad(stated), stated / 1e3))
        return lambda q: torch.zeros_like(q) + offset.to(q)
