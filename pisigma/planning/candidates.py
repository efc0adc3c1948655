"""Candidate poses for a measurement, drawn within the joint limits or read from a file."""

import math
import os
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import PlanningError
from pisigma.measurement.csv.reading import read_joints
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.planning.board_views import ViewConditions
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings, Faults
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.joint_limits import nearest_turn
from pisigma.robot.se3 import wrap_to_pi

_MAX_DRAWS = 40
"""Largest number of blocks of random poses, each with the requested number of candidates."""
_KERNEL_WIDTH, _RARE_SHARE = 0.25, 0.5
"""Width of the kernel for the density of joint angles [rad], and the share of the mean density below which an angle
is rare."""
_MIN_VIEWS = 100
"""Number of views of a board that are drawn together, because a robot reaches few of them."""
_OUTSIDE_WORKSPACE = "the reflector is outside the box of the workspace"
_REPEATED = "an earlier row has the same joint values"
_UNREACHED = "the robot does not reach a view of the board"

Workspace = Float64[Tensor, "2 3"]
"""Lowest and highest x, y, z of the reflector in the robot's base frame [m]."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses from which a plan is selected.

    Attributes:
        q: joint values [rad or m].
        number: number of every candidate in the file, or among the drawn poses, from 1.
        considered: number of poses that were drawn or read.
        refused: number of refused poses by reason.
        workspace_q: joint values at which the robot must be accurate, and which may be waypoints [rad or m]. These are
            the candidates or, with a camera, which sees its board only from a small part of the workspace, poses that
            the surroundings allow.
    """

    q: Float64[Tensor, "candidates dof"]
    number: Int64[Tensor, " candidates"]
    considered: int
    refused: Counter[str]
    workspace_q: Float64[Tensor, "poses dof"]

    @property
    def sentence(self) -> str:
        """Sentence with the number of allowed poses, and of refused poses by reason."""
        reasons = "; ".join(f"{count:,}: {reason}" for reason, count in self.refused.most_common())
        return f"{len(self.q):,} of {self.considered:,} poses are allowed" + (
            f" ({reasons})." if reasons else "."
        )

    def check_count(self, count: int) -> None:
        """Refuse a number of poses that exceeds the number of candidates.

        Raises:
            PlanningError: there are fewer candidates; the message states why poses were refused.
        """
        if len(self.q) < count:
            raise PlanningError(
                f"expected {count:,} candidates or more, but {self.sentence.removesuffix('.')}",
                expected=f"{count:,} candidates or more",
                value=len(self.q),
                remedy="plan fewer poses, give more candidates or relax the limits of the surroundings",
            )


def draw_candidates(
    arm: ArmInSurroundings,
    count: int,
    seed: int,
    workspace: Workspace | None = None,
    views: ViewConditions | None = None,
) -> Candidates:
    """Draw candidates until enough are allowed or too many were refused.

    Candidates are uniform in the joint values. Joints with a range of more than one revolution are drawn within half a
    revolution of the centre of their range, or of 0 without limits, and then unwrapped (`with_workspace`). If a camera
    must see a board, views are drawn instead.

    Args:
        arm: the robot in its surroundings.
        count: number of candidates.
        seed: random seed.
        workspace: box in which the reflector must be; None for anywhere.
        views: conditions under which the camera sees its board; None without a camera.

    Raises:
        PlanningError: a prismatic joint has no limits.
    """
    generator = torch.Generator().manual_seed(seed)
    limits = None if views is not None else _sampled_range(arm)
    blocks: list[tuple[Tensor, Faults]] = []
    while len(blocks) < _MAX_DRAWS and sum(int(faults.allowed.sum()) for _, faults in blocks) < count:
        if views is not None:
            q = views.draw(arm, max(count, _MIN_VIEWS), generator)
        else:
            assert limits is not None
            draws = torch.rand(count, len(limits), generator=generator, dtype=torch.float64)
            q = arm.robot.to_dh(limits[:, 0] + (limits[:, 1] - limits[:, 0]) * draws)
        blocks.append((q, _faults(arm, q, workspace, views)))
    q = torch.cat([sampled for sampled, _ in blocks])
    faults = Faults(blocks[0][1].reasons, torch.cat([one.failed for _, one in blocks]))
    enough = int((faults.allowed.cumsum(0) < count).sum()) + 1  # poses up to the last one that is needed
    candidates = _allowed(q[:enough], replace(faults, failed=faults.failed[:enough]))
    return candidates if views is not None else with_workspace(arm, candidates, candidates)


def with_workspace(
    arm: ArmInSurroundings, candidates: Candidates, workspace_candidates: Candidates
) -> Candidates:
    """Add the whole workspace to candidates that cover part of it, and unwrap the joint values of both.

    A joint that is rarely free at some angles, such as a shoulder above a floor, is unwrapped about the centre of the
    other angles, because there would be no free motion between values on both sides of ±180 deg.

    Args:
        arm: the robot in its surroundings.
        candidates: candidates.
        workspace_candidates: poses in the whole workspace.
    """
    angles = torch.arange(-180, 180, 5).to(workspace_candidates.q).deg2rad()
    density = (
        ((workspace_candidates.q[:, None] - angles[:, None]).cos() / _KERNEL_WIDTH**2).softmax(1).mean(0)
    )
    rarest = density.min(0)
    middle = torch.where(
        rarest.values < _RARE_SHARE / len(angles), wrap_to_pi(angles[rarest.indices] + math.pi), 0.0
    )

    def unwrapped(q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses dof"]:
        near = nearest_turn(arm.robot, q, middle, within_limits=True)
        values, (lower, upper) = arm.robot.to_controller(near), arm.limits.t()
        return torch.where(((values >= lower) & (values <= upper)).all(1, keepdim=True), near, q)

    return replace(candidates, q=unwrapped(candidates.q), workspace_q=unwrapped(workspace_candidates.q))


def read_candidates(
    arm: ArmInSurroundings,
    path: str | os.PathLike[str],
    workspace: Workspace | None = None,
    views: ViewConditions | None = None,
) -> Candidates:
    """Return candidates from the joint values in a file; repeated joint values count once.

    Args:
        arm: the robot in its surroundings.
        path: CSV file with joint values, with or without measurements.
        workspace: box in which the reflector must be; None for anywhere.
        views: conditions under which the camera sees its board; None without a camera.

    Raises:
        MeasurementError: the file or a joint's cell cannot be used; the message names file, line and column.
    """
    q = read_joints(path, arm.robot)
    faults = _faults(arm, q, workspace, views)
    failed = torch.cat([_repeats(q)[:, None], faults.failed], 1)
    return _allowed(q, Faults((_REPEATED, *faults.reasons), failed))


def _repeats(q: Float64[Tensor, "poses dof"]) -> Bool[Tensor, " poses"]:
    """Return the mask of poses that equal an earlier pose and would be planned twice."""
    group = groups_of_equal_joints(q)  # numbered by their first row
    return group.cummax(0).values.diff(prepend=group.new_tensor([-1])) == 0


def select_spread_poses(
    arm: ArmInSurroundings, q: Float64[Tensor, "poses dof"], count: int, others: Float64[Tensor, "others dof"]
) -> Int64[Tensor, " chosen"]:
    """Select poses spread over the workspace, each time the pose farthest from all selected and given poses.

    Distances combine the reflector's positions and the joint values, each divided by its standard deviation (Kennard
    and Stone 1969, Technometrics 11(1)).

    Args:
        arm: the robot.
        q: joint values [rad or m] to select from.
        count: number of poses to select.
        others: joint values of poses that are already planned [rad or m].
    """
    both = torch.cat([q, others])
    position = forward_kinematics(arm.robot, both)[:, :3, 3]
    groups = [values / values.std(0).norm().clamp(min=1e-9) for values in (position, both)]
    features = torch.cat(groups, 1)
    points, given = features[: len(q)], features[len(q) :]
    nearest = (
        torch.cdist(points, given).min(1).values if len(given) else (points - points.mean(0)).norm(dim=1)
    )
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (points - points[chosen[-1]]).norm(dim=1))
        nearest[chosen] = -1.0
    return torch.tensor(chosen, dtype=torch.int64)


def _faults(
    arm: ArmInSurroundings,
    q: Float64[Tensor, "poses dof"],
    workspace: Workspace | None,
    views: ViewConditions | None,
) -> Faults:
    """Return the faults of poses with respect to surroundings, workspace and camera."""
    failed = {} if views is None else {_UNREACHED: q.isnan().any(1)}
    q = q.nan_to_num()
    faults = arm.faults(q)
    failed |= dict(zip(faults.reasons, faults.failed.unbind(1), strict=True))
    if workspace is not None:
        reflector = forward_kinematics(arm.robot, q)[:, :3, 3]
        failed[_OUTSIDE_WORKSPACE] = ((reflector < workspace[0]) | (reflector > workspace[1])).any(1)
    if views is not None:
        failed |= views.faults(arm, q)
    return Faults(tuple(failed), torch.stack([*failed.values()], 1))


def _allowed(q: Float64[Tensor, "poses dof"], faults: Faults) -> Candidates:
    """Return the poses without faults."""
    allowed = q[faults.allowed]
    return Candidates(allowed, faults.allowed.nonzero()[:, 0] + 1, len(q), faults.counts(), allowed)


def _sampled_range(arm: ArmInSurroundings) -> Float64[Tensor, "axes 2"]:
    """Return the range from which the controller's values are drawn [rad or m]."""
    limits = arm.limits.clone()
    for index, (joint, (lower, upper)) in enumerate(zip(arm.robot.axes, arm.limits.tolist(), strict=True)):
        if joint.type == "revolute" and upper - lower > 2 * np.pi:
            middle = (lower + upper) / 2 if np.isfinite([lower, upper]).all() else 0.0
            limits[index] = torch.tensor([max(lower, middle - np.pi), min(upper, middle + np.pi)])
        elif not np.isfinite([lower, upper]).all():
            raise PlanningError(
                f"prismatic joint '{joint.name}' of robot '{arm.robot.name}' has no limits",
                value=joint.name,
                remedy="state them in the surroundings (joints: limits_mm), or give candidates in a file",
            )
    return limits
