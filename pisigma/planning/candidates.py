"""Poses that could be measured: drawn in the joint limits or read from a file, and allowed by the cell."""

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
from pisigma.planning.board_views import BoardViews
from pisigma.planning.surroundings.arm_in_cell import ArmInCell, Faults
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.joint_limits import nearest_turn
from pisigma.robot.se3 import wrap_to_pi

MOST_DRAWS = 40
"""So many times as many poses are drawn at most as candidates are wanted."""
WINDOW, SELDOM = 0.25, 0.5
"""[rad] Width in which angles of a joint are counted, and the share of their mean number that is few."""
LEAST_VIEWS = 100
"""Of a board are drawn together, as a robot reaches few of them."""
SAME = 1e-6
"""[rad or m] Rows of a file whose joint values differ by less are of one pose."""
OUTSIDE_WORKSPACE = "the reflector is outside the box of the workspace"
REPEATED = "an earlier row has the same joint values"
UNREACHED = "the robot does not reach a view of the board"

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
        workspace: where the robot is to be accurate, and by way of which it may go: the candidates, but with a camera,
            which sees its board from a small part of the workspace only, poses that the cell alone allows [rad or m].
    """

    q: Float64[Tensor, "candidates dof"]
    number: Int64[Tensor, " candidates"]
    looked_at: int
    refused: Counter[str]
    workspace: Float64[Tensor, "poses dof"]

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


def draw_candidates(
    arm: ArmInCell,
    count: int,
    seed: int,
    workspace: Workspace | None = None,
    views: BoardViews | None = None,
) -> Candidates:
    """Draw candidates until enough are allowed or too many were refused.

    They are uniform in the joint values: joints that turn by more than a full turn are drawn within half a turn of the
    middle of their limits, and of 0 where they have none, and then unwrapped (`with_workspace`). Where a camera has
    to see a board, views are drawn instead.

    Args:
        arm: the robot in its cell.
        count: of candidates.
        seed: of the generator.
        workspace: in which the reflector has to be; None for anywhere.
        views: from where a camera has to see its board; None without a camera.

    Raises:
        PlanningError: a joint that slides has no limits.
    """
    generator = torch.Generator().manual_seed(seed)
    limits = None if views is not None else _drawn_range(arm)
    blocks: list[tuple[Tensor, Faults]] = []
    while len(blocks) < MOST_DRAWS and sum(int(faults.allowed.sum()) for _, faults in blocks) < count:
        if views is not None:
            q = views.draw(arm, max(count, LEAST_VIEWS), generator)
        else:
            assert limits is not None
            draws = torch.rand(count, len(limits), generator=generator, dtype=torch.float64)
            q = arm.robot.to_dh(limits[:, 0] + (limits[:, 1] - limits[:, 0]) * draws)
        blocks.append((q, _faults(arm, q, workspace, views)))
    q = torch.cat([drawn for drawn, _ in blocks])
    faults = Faults(blocks[0][1].reasons, torch.cat([one.failed for _, one in blocks]))
    enough = (
        int((faults.allowed.cumsum(0) < count).sum()) + 1
    )  # poses, of which the last is the last that is needed
    candidates = _allowed(q[:enough], replace(faults, failed=faults.failed[:enough]))
    return candidates if views is not None else with_workspace(arm, candidates, candidates)


def with_workspace(arm: ArmInCell, candidates: Candidates, others: Candidates) -> Candidates:
    """Give candidates that lie in a small part of the workspace the rest of it.

    A joint that is seldom free at some angles, such as a shoulder above a floor, is unwrapped about the middle of the
    others: between values on both sides of half a turn there would be no free motion.

    Args:
        arm: the robot in its cell.
        candidates: in that part.
        others: in the whole workspace.
    """
    angles = torch.arange(-180, 180, 5).to(others.q).deg2rad()
    density = ((others.q[:, None] - angles[:, None]).cos() / WINDOW**2).softmax(1).mean(0)
    rarest = density.min(0)
    middle = torch.where(
        rarest.values < SELDOM / len(angles), wrap_to_pi(angles[rarest.indices] + math.pi), 0.0
    )

    def unwrapped(q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses dof"]:
        near = nearest_turn(arm.robot, q, middle, within_limits=True)
        values, (lower, upper) = arm.robot.to_controller(near), arm.limits.t()
        return torch.where(((values >= lower) & (values <= upper)).all(1, keepdim=True), near, q)

    return replace(candidates, q=unwrapped(candidates.q), workspace=unwrapped(others.q))


def read_candidates(
    arm: ArmInCell,
    path: str | os.PathLike[str],
    workspace: Workspace | None = None,
    views: BoardViews | None = None,
) -> Candidates:
    """Take candidates from the joint values of a file, of measurements or of others, those that repeat once.

    Args:
        arm: the robot in its cell.
        path: the CSV file.
        workspace: in which the reflector has to be; None for anywhere.
        views: from where a camera has to see its board; None without a camera.

    Raises:
        MeasurementError: the file or a joint's cell cannot be used; the message names file, line and column.
    """
    q = read_joints(path, arm.robot)
    faults = _faults(arm, q, workspace, views)
    failed = torch.cat([_repeats(q)[:, None], faults.failed], 1)
    return _allowed(q, Faults((REPEATED, *faults.reasons), failed))


def _repeats(q: Float64[Tensor, "poses dof"]) -> Bool[Tensor, " poses"]:
    """Poses that are the same as one before them, which would be planned twice, or checked where they are measured."""
    steps = (q / SAME).round().numpy()
    _, first, group = np.unique(steps, axis=0, return_index=True, return_inverse=True)
    return torch.from_numpy(first[group.reshape(-1)] < np.arange(len(q)))


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


def _faults(
    arm: ArmInCell, q: Float64[Tensor, "poses dof"], workspace: Workspace | None, views: BoardViews | None
) -> Faults:
    """Why poses are not allowed: by the cell, by the workspace, and by what a camera has to see."""
    failed = {} if views is None else {UNREACHED: q.isnan().any(1)}
    q = q.nan_to_num()
    faults = arm.faults(q)
    failed |= dict(zip(faults.reasons, faults.failed.unbind(1), strict=True))
    if workspace is not None:
        reflector = forward_kinematics(arm.robot, q)[:, :3, 3]
        failed[OUTSIDE_WORKSPACE] = ((reflector < workspace[0]) | (reflector > workspace[1])).any(1)
    if views is not None:
        failed |= views.faults(arm, q)
    return Faults(tuple(failed), torch.stack([*failed.values()], 1))


def _allowed(q: Float64[Tensor, "poses dof"], faults: Faults) -> Candidates:
    """Keep the poses that fail for nothing."""
    allowed = q[faults.allowed]
    return Candidates(allowed, faults.allowed.nonzero()[:, 0] + 1, len(q), faults.counts(), allowed)


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
