"""Quantisation of encoders."""

from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.simulation.errors.source import AbstractJointSource, JointErrorFunction, value_per_joint


class EncoderQuantisation(AbstractJointSource):
    """Quantisation of joint values, because the servo can hold a joint only at whole pulses of its encoder.

    `e_j = step_j · round(q_j / step_j) - q_j` with `step_j = 360 deg / pulses_j`, so |e_j| <= step_j / 2.
    Halves are rounded to the nearest even multiple.

    Source: Jeong, Kim and Kwak 1998, J. KSPE, sections 4.1.2 and 4.2.2 (resolver of 2048, encoder of 2500
    pulses per revolution); servo errors also in Judd and Knasinski, "A technique to calibrate industrial
    robots with experimental verification", IEEE Transactions on Robotics and Automation 6(1), 1990,
    20-30.

    Attributes:
        kind: "encoder".
        pulses_per_revolution: pulses per revolution of the joint, by name of a revolute joint (for an encoder on the
            motor, its pulses times the gear ratio).
        step_mm: travel per pulse, by name of a prismatic joint [mm].
    """

    kind: Literal["encoder"]
    pulses_per_revolution: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    step_mm: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)

    @property
    def stepped_joints(self) -> frozenset[str]:
        """Names of the joints that have an encoder."""
        return frozenset(self.pulses_per_revolution) | frozenset(self.step_mm)

    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the quantisation error as a function of the joint values; see `AbstractJointSource.bind`."""
        fields = ("pulses_per_revolution", "step_mm")
        stated = value_per_joint(robot, self.pulses_per_revolution, self.step_mm, fields, place_in_recipe)
        quantised = torch.from_numpy(stated > 0)
        safe = np.where(stated > 0, stated, 1.0)
        step = torch.from_numpy(np.where(robot.revolute, 2 * np.pi / safe, safe / 1e3))

        def error(q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
            steps = step.to(q)
            return torch.where(quantised.to(q.device), steps * torch.round(q / steps) - q, 0.0)

        return error
