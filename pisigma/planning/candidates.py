"""Poses that could be measured: drawn in the joint limits or read from a file, and allowed by the cell."""

import os
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import PlanningError
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.csv.reading import read_joints
from pisigma.planning.cell.arm_in_cell import ArmInCell, Faults

MOST_DRAWS = 40
"""So many times as many poses are drawn at most as candidates are wanted."""
OUTSIDE_WORKSPACE = "the reflector is outside the box of the workspace"

Workspace = Float64[Tensor, "2 3"]
"""Lowest and highest x, y, z of the reflector in the robot's base frame [m]."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses of which some are chosen.

    Attributes:
        q: joint values [rad or m].
        number: which row of the file each of them is, or which of the poses that were drawn; from 1.
        looked_at: how many poses were drawn or read.
        refused: how many of them were refused for what.
    """

    q: Float64[Tensor, "candidates dof"]
    number: Int64[Tensor, " candidates"]
    looked_at: int
    refused: Counter[str]

    @property
    def sentence(self) -> str:
        """How many poses were refused for what."""
        reasons = "; ".join(f"{count:,}: {reason}" for reason, count in self.refused.most_common())
        return f"{len(self.q):,} of {self.looked_at:,} poses are allowed" + (
            f" ({reasons})." if reasons else "."
        )

    def check_count(self, wanted: int) -> None:
        """Refuse to choose more poses than there are.

        Raises:
            PlanningError: there are not as many; the message says what poses were refused for.
        """
        if len(self.q) < wanted:
            raise PlanningError(
                f"{wanted:,} poses were wanted, but {self.sentence} Ask for fewer, give more candidates or make the "
                "cell wider."
            )


def draw_candidates(arm: ArmInCell, count: int, seed: int, workspace: Workspace | None = None) -> Candidates:
    """Draw candidates, uniform in the joint values, until enough are allowed or too many were refused.

    Joints that turn by more than a full turn are drawn within half a turn of the middle of their limits, and of 0
    where they have none.

    Args:
        arm: the robot in its cell.
        count: of candidates.
        seed: of the generator.
        workspace: in which the reflector has to be; None for anywhere.

    Raises:
        PlanningError: a joint that slides has no limits.
    """
    limits = _drawn_range(arm)
    generator = torch.Generator().manual_seed(seed)
    q = limits.new_zeros((0, arm.robot.dof))
    faults = _faults(arm, q, workspace)
    while len(q) < MOST_DRAWS * count and int(faults.allowed.sum()) < count:
        draws = torch.rand(count, len(limits), generator=generator, dtype=torch.float64)
        drawn = arm.robot.to_dh(limits[:, 0] + (limits[:, 1] - limits[:, 0]) * draws)
        q = torch.cat([q, drawn])
        faults = replace(faults, failed=torch.cat([faults.failed, _faults(arm, drawn, workspace).failed]))
    enough = (
        int((faults.allowed.cumsum(0) < count).sum()) + 1
    )  # poses, of which the last is the last that is needed
    return _allowed(q[:enough], replace(faults, failed=faults.failed[:enough]))


def read_candidates(
    arm: ArmInCell, path: str | os.PathLike[str], workspace: Workspace | None = None
) -> Candidates:
    """Take candidates from the joint values of a file, of measurements or of others.

    Args:
        arm: the robot in its cell.
        path: the CSV file.
        workspace: in which the reflector has to be; None for anywhere.

    Raises:
        MeasurementError: the file or a joint's cell cannot be used; the message names file, line and column.
    """
    q = read_joints(path, arm.robot)
    return _allowed(q, _faults(arm, q, workspace))


def spread(
    arm: ArmInCell, q: Float64[Tensor, "poses dof"], count: int, beside: Float64[Tensor, "others dof"]
) -> Int64[Tensor, " chosen"]:
    """Choose poses that are spread over the workspace: always the one farthest from those chosen and the others.

    Distances are those of the reflector's positions and of the joint values, each over its standard deviation (Kennard
    and Stone 1969, Technometrics 11(1)).

    Args:
        arm: the robot.
        q: joint values [rad or m] to choose from.
        count: how many.
        beside: poses that are measured besides.
    """
    both = torch.cat([q, beside])
    position = forward_kinematics(arm.robot, both)[:, :3, 3]
    groups = [values / values.std(0).norm().clamp(min=1e-9) for values in (position, both)]
    features = torch.cat(groups, 1)
    points, others = features[: len(q)], features[len(q) :]
    nearest = (
        torch.cdist(points, others).min(1).values if len(others) else (points - points.mean(0)).norm(dim=1)
    )
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (points - points[chosen[-1]]).norm(dim=1))
        nearest[chosen] = -1.0
    return torch.tensor(chosen, dtype=torch.int64)


def _faults(arm: ArmInCell, q: Float64[Tensor, "poses dof"], workspace: Workspace | None) -> Faults:
    """Why the cell and the workspace do not allow poses."""
    faults = arm.faults(q)
    if workspace is None:
        return faults
    reflector = forward_kinematics(arm.robot, q)[:, :3, 3]
    outside = ((reflector < workspace[0]) | (reflector > workspace[1])).any(1, keepdim=True)
    return Faults((*faults.reasons, OUTSIDE_WORKSPACE), torch.cat([faults.failed, outside], 1))


def _allowed(q: Float64[Tensor, "poses dof"], faults: Faults) -> Candidates:
    """Keep the poses that fail for nothing."""
    return Candidates(q[faults.allowed], faults.allowed.nonzero()[:, 0] + 1, len(q), faults.counts())


def _drawn_range(arm: ArmInCell) -> Float64[Tensor, "axes 2"]:
    """Lowest and highest of the controller's values that are drawn [rad or m]."""
    limits = arm.limits.clone()
    for index, (joint, (lower, upper)) in enumerate(zip(arm.robot.axes, arm.limits.tolist(), strict=True)):
        if joint.type == "revolute" and upper - lower > 2 * np.pi:
            middle = (lower + upper) / 2 if np.isfinite([lower, upper]).all() else 0.0
            limits[index] = torch.tensor([max(lower, middle - np.pi), min(upper, middle + np.pi)])
        elif not np.isfinite([lower, upper]).all():
            raise PlanningError(
                f"joint '{joint.name}' of robot '{arm.robot.name}' slides without limits; state them in the cell "
                "(joints: limits_mm), or give candidates in a file."
            )
    return limits
