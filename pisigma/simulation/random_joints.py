"""Where to measure: random joint values."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.errors import RecipeError
from pisigma.robot.description import Robot
from pisigma.simulation.joint_names import joint_index
from pisigma.yaml_file import Section

Range = tuple[float, float]
"""Smallest and largest value."""


class JointsRandom(Section):
    """Random joint values, uniform and independent, drawn as one (count, dof) block.

    Attributes:
        kind: "joints_random".
        count: how many.
        seed: of the generator.
        share: share of the range between the joint limits, about its middle, that is used.
        range_deg: by name of a revolute joint, smallest and largest value [deg]; takes the place of the
            share.
        range_mm: by name of a prismatic joint, smallest and largest value [mm].
    """

    kind: Literal["joints_random"]
    count: int = Field(ge=1)
    seed: int = Field(ge=0)
    share: float = Field(default=1.0, gt=0, le=1)
    range_deg: dict[str, Range] = Field(default_factory=dict)
    range_mm: dict[str, Range] = Field(default_factory=dict)

    def joints(self, robot: Robot) -> Float64[Tensor, "count dof"]:
        """Joint values to command [rad or m], as the controller counts; the same at every call.

        Raises:
            RecipeError: an unknown joint, a range in the wrong unit or outside the limits, or no limits at
                all.
        """
        bounds = torch.from_numpy(self._bounds(robot))
        generator = torch.Generator().manual_seed(self.seed)
        draws = torch.rand(self.count, robot.dof, generator=generator, dtype=torch.float64)
        return bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) * draws

    def _bounds(self, robot: Robot) -> Float64[np.ndarray, "dof 2"]:
        with np.errstate(invalid="ignore"):  # joints without limits are complained of below
            middle, half = robot.limits.mean(1, keepdims=True), np.diff(robot.limits) / 2
            bounds: np.ndarray = middle + self.share * half * np.array([-1.0, 1.0])
        for field, other, ranges, kind in (
            ("range_deg", "range_mm", self.range_deg, "revolute"),
            ("range_mm", "range_deg", self.range_mm, "prismatic"),
        ):
            for name, stated in ranges.items():
                index = joint_index(robot, name, "joints_random")
                if robot.joints[index].type != kind:
                    raise RecipeError(
                        f"joints_random: joint '{name}' is {robot.joints[index].type}, "
                        f"so state it in {other}, not in {field}."
                    )
                bounds[index] = np.deg2rad(stated) if kind == "revolute" else np.array(stated) / 1e3
        for joint, (lower, upper) in zip(robot.joints, bounds, strict=True):
            if not np.isfinite([lower, upper]).all():
                raise RecipeError(
                    f"joints_random: joint '{joint.name}' of robot '{robot.name}' has no limits; "
                    "state its range in range_deg or range_mm."
                )
            if not joint.lower - 1e-12 <= lower <= upper <= joint.upper + 1e-12:
                raise RecipeError(
                    f"joints_random: the range of joint '{joint.name}' is empty or leaves its limits "
                    f"({joint.lower:g} to {joint.upper:g} in rad or m); correct it."
                )
        return bounds
