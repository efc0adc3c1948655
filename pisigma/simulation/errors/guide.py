"""Errors of a linear guide: joint errors that vary slowly along the travel of an axis."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.files.errors import RecipeError, choice_remedy
from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot
from pisigma.simulation.errors.source import AbstractJointSource, JointErrorFunction, amplitude_of


class GuideWave(Section):
    """One wave `amplitude · sin(harmonic · pi · q / travel + phase)` of one joint's error.

    Attributes:
        joint: joint with the error.
        amplitude_deg: amplitude of a revolute joint [deg].
        amplitude_mm: amplitude of a prismatic joint [mm].
        harmonic: number of half waves along the travel.
        phase_deg: phase [deg].
    """

    joint: str
    amplitude_deg: float | None = None
    amplitude_mm: float | None = None
    harmonic: int = Field(ge=1)
    phase_deg: float = 0.0

    @model_validator(mode="after")
    def _one_amplitude(self) -> "GuideWave":
        if (self.amplitude_deg is None) == (self.amplitude_mm is None):
            raise ValueError(
                "expected either amplitude_deg (revolute joint) or amplitude_mm (prismatic joint)"
            )
        return self


class Guide(AbstractJointSource):
    """Straightness and angular errors of a rail along its travel, as errors of the joints after the rail.

    `e_j = Σ A · sin(harmonic · pi · q / travel + phase)` with the controller's value q of the axis and the
    travel between the limits of the axis. In the robot's file, the joints with errors follow the rail and are coupled
    to it with the factor 0.

    Source: error motions of a linear axis of ISO 230-1:2012, 3.4 (straightness and angular error motions).

    Attributes:
        kind: "guide".
        along: name of the axis of the rail, which is prismatic and has limits.
        waves: waves of the joint errors.
    """

    kind: Literal["guide"]
    along: str
    waves: tuple[GuideWave, ...] = Field(min_length=1)

    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the joint errors as a function of the joint values; see `AbstractJointSource.bind`."""
        names = [axis.name for axis in robot.axes]
        if self.along not in names:
            raise RecipeError(
                f"robot '{robot.name}' has no axis '{self.along}'",
                option=place_in_recipe,
                value=self.along,
                remedy=choice_remedy(self.along, names),
            )
        index = names.index(self.along)
        travel = float(np.diff(robot.axis_limits[index])[0])
        if robot.axes[index].type != "prismatic" or not np.isfinite(travel):
            raise RecipeError(
                option=place_in_recipe, expected="the name of a prismatic axis with limits", value=self.along
            )
        amplitudes = [
            amplitude_of(robot, wave.joint, wave.amplitude_deg, wave.amplitude_mm, place_in_recipe)
            for wave in self.waves
        ]
        amplitude = torch.from_numpy(np.stack(amplitudes))
        harmonic = torch.tensor([wave.harmonic for wave in self.waves], dtype=torch.float64)
        phase = torch.deg2rad(torch.tensor([wave.phase_deg for wave in self.waves], dtype=torch.float64))

        def error(q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
            along = robot.to_controller(q)[..., index, None] * (np.pi / travel)
            return (torch.sin(along * harmonic.to(q) + phase.to(q))[..., None] * amplitude.to(q)).sum(-2)

        return error
