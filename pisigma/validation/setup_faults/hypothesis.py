"""A hypothesis of what is wrong with a setup, the arm that predicts poses under it, and joint values under it."""

from collections.abc import Iterator, Set
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import (
    LEVER_SHARE,
    MeasuredPoses,
    affine_error,
    base_and_tool_step,
    best_base,
    best_base_and_tool,
    moved_base_and_tool,
)
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.setup_faults.cause import Cause

COLLAPSED = 0.25
"""Share of the errors that is left, at most, where a setup fault explains them."""
FEWEST_SPARE = 6
"""Measured numbers that must be left over beyond what is fitted."""
_MOST_POSES = 2**17
SHIFTS = (1, -1, 2, -2)
"""Rows by which joint values may be shifted against what was measured."""
MARGIN = max(SHIFTS)
ENDS = 3
"""Base and tool are fitted to the first and to the last third of the rows where a row may have been lost between."""
_ADVICE = "look for a row that was lost or written twice on one side, and put both sides together again"
ROUNDS = 30
TRIED, HOPELESS = 8, 0.25
"""After so many rounds the search is given up where this share of the cost is left."""
SETTLED = 1e-3
"""The search ends when a step lowers the cost by less than this share."""
STILL = 1e-3
"""A joint that moves less [rad or m] is constant."""
EQUAL = 1e-6
"""Columns that differ by less [rad or m] are equal."""


@dataclass(frozen=True, eq=False)
class PredictingArm:
    """Predicts the poses of rows under hypotheses.

    Attributes:
        robot: as drawn.
        model: whose base and tool count; None: the robot as drawn, whose base and tool are fitted to the rows under
            every hypothesis.
    """

    robot: Robot
    model: CalibratedModel | None = None

    def poses(self, rows: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Predict the poses of rows."""
        if self.model is not None:
            return poses_of_rows(self.model, rows)
        return forward_kinematics(self.robot, rows.q)

    def screened_errors(
        self, rows: Measurements, q: Float64[Tensor, "maps rows dof"], measured: MeasuredPoses
    ) -> Float64[Tensor, "modes maps"]:
        """Compute mean squared errors [m²] under hypotheses of the joint values, with the geometry alone.

        Args:
            rows: of one frame and target.
            q: joint values that they may have had [rad or m].
            measured: their poses.

        Returns:
            See `errors_in_frames`.
        """
        chunks = torch.split(q, max(1, _MOST_POSES // rows.rows))
        return torch.cat([self._screened(rows, chunk, measured) for chunk in chunks], 1)

    def errors_in_frames(
        self, T: Float64[Tensor, "*#batch rows 4 4"], measured: MeasuredPoses
    ) -> Float64[Tensor, "modes *#batch"]:
        """Compute the mean squared errors [m²] of predicted poses.

        Returns:
            Errors in the frame as it is, in one that is fitted, and, by a lower bound, with base and tool fitted;
            the last alone where there is no model.
        """
        bound = affine_error(T, measured)
        if self.model is None:
            return bound[None]
        fitted = best_base(T, measured)[..., None, :, :] @ T
        return torch.stack([measured.squares(T).mean(-1), measured.squares(fitted).mean(-1), bound])

    def _screened(self, rows: Measurements, q: Tensor, measured: MeasuredPoses) -> Tensor:
        if self.model is None:
            return self.errors_in_frames(forward_kinematics(self.robot, q), measured)
        count = len(q)
        repeated = Measurements(q=q.flatten(0, 1), frame=rows.frame * count, target=rows.target * count)
        T = poses_of_rows(replace(self.model, hybrid=None, network=None), repeated)
        return self.errors_in_frames(T.reshape(*q.shape[:2], 4, 4), measured)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Predicted poses where something is taken to be wrong.

    Attributes:
        q: the joint values that the robot then had [rad or m].
        T: the poses.
        measured: measured poses, in the units that they then have.
        causes: what is wrong.
        fitted: numbers that were fitted.
    """

    q: Float64[Tensor, "rows dof"]
    T: Float64[Tensor, "rows 4 4"]
    measured: MeasuredPoses
    causes: tuple[Cause, ...] = ()
    fitted: int = 0

    @property
    def size(self) -> float:
        """How much is assumed; a frame and a tool together less than both alone, as a new set-up has both."""
        kinds = {cause.kind for cause in self.causes}
        return sum(cause.size for cause in self.causes) - (1 if {"frame", "tool"} <= kinds else 0)

    @property
    def error(self) -> float:
        """Root mean square of the errors [m], as if nothing had been fitted."""
        spare = self.measured.values - self.fitted
        if spare < FEWEST_SPARE:
            return float("inf")
        mean = float(self.measured.squares(self.T).mean()) * self.measured.values / spare
        return float(np.sqrt(mean)) if np.isfinite(mean) else float("inf")

    def rms(self) -> tuple[float, float]:
        """Root mean squares of positions [m] and, NaN where none was measured, of rotations [rad]."""
        position = float((self.measured.position - self.T[:, :3, 3]).square().sum(-1).mean().sqrt())
        R = (self.measured.rotation @ self.T[:, :3, :3].mT)[self.measured.has_rotation]
        return position, float(rotation_vector(R).square().sum(-1).mean().sqrt())

    def without(self, kinds: Set[str]) -> "Hypothesis":
        """Leave causes of some kinds unsaid."""
        return replace(self, causes=tuple(cause for cause in self.causes if cause.kind not in kinds))

    def with_cause(self, cause: Cause, T: Float64[Tensor, "rows 4 4"], fitted: int) -> "Hypothesis":
        """Add a cause, under which the predicted poses are others."""
        return replace(self, T=T, causes=(*self.causes, cause), fitted=self.fitted + fitted)


def shifted_rows(
    arm: PredictingArm, rows: Measurements, chosen: Int64[Tensor, " chosen"], measured: MeasuredPoses
) -> Iterator[tuple[Float64[Tensor, "chosen dof"], MeasuredPoses, Cause]]:
    """Go through joint values or orientations of a row before or behind, in all rows or from one on.

    Args:
        arm: with which is predicted.
        rows: in the order of the file.
        chosen: those to judge, `MARGIN` or more from both ends.
        measured: their poses.
    """
    q = rows.q[chosen]
    for shift in SHIFTS:
        cause = Cause(
            "rows", f"the joint values are shifted by {_count(shift)} against the measurements", _ADVICE, 1.0
        )
        yield rows.q[chosen + shift], measured, cause
        if bool(measured.has_rotation.any()):
            assert rows.rotation is not None
            other = rows.rotation[chosen + shift]
            there = torch.isfinite(other).flatten(1).all(1)
            rotations = replace(measured, rotation=torch.where(there[:, None, None], other, 0.0))
            rotations = replace(rotations, has_rotation=there & measured.has_rotation)
            clause = f"the orientations are shifted by {_count(shift)} against the positions"
            yield q, rotations, Cause("rows", clause, _ADVICE, 1.0)
    yield from _shifted_from_a_row(arm, rows, chosen)


def _shifted_from_a_row(
    arm: PredictingArm, rows: Measurements, chosen: Int64[Tensor, " chosen"]
) -> Iterator[tuple[Float64[Tensor, "chosen dof"], MeasuredPoses, Cause]]:
    """Find the row from which on, or up to which, a shift explains most; base and tool are fitted beyond it.

    The rows about it are left out, as what was lost there stands nowhere.
    """
    inner = torch.arange(MARGIN, rows.rows - MARGIN)
    among = rows.select(inner)
    measured = MeasuredPoses.of(among.position, among.rotation, LEVER_SHARE * arm.robot.reach)
    T = {shift: arm.poses(replace(rows, q=rows.q.roll(-shift, 0)))[inner] for shift in (0, *SHIFTS)}
    third = len(chosen) // ENDS
    for at_start, end in ((True, chosen[:third] - MARGIN), (False, chosen[-third:] - MARGIN)):
        base, tool = best_base_and_tool(T[0][end], measured.select(end))
        errors = {shift: measured.squares(base @ poses @ tool) for shift, poses in T.items()}
        for shift in SHIFTS:
            gain = errors[0] - errors[shift] if at_start else errors[shift] - errors[0]
            change = int(gain.flip(0).cumsum(0).flip(0).argmax())
            place = rows.place(int(inner[change]))
            where = f"from about {place} on" if at_start else f"up to about {place}"
            clause = f"{where} the joint values are shifted by {_count(shift)} against the measurements"
            kept = chosen[(chosen - inner[change] + 0.5).abs() > abs(shift)]
            behind = kept >= inner[change]
            q = torch.where((behind == at_start)[:, None], rows.q[kept + shift], rows.q[kept])
            yield q, measured.select(kept - MARGIN), Cause("rows", clause, _ADVICE, 1.5)


def _count(shift: int) -> str:
    """Write by how many rows joint values are shifted."""
    return "one row" if abs(shift) == 1 else f"{abs(shift)} rows"


def freed_joints(
    arm: PredictingArm, rows: Measurements, measured: MeasuredPoses
) -> list[tuple[Float64[Tensor, "rows dof"], Cause]]:
    """Find for every joint that turns the values that it must have had, the others being as logged.

    In turn, every row's value is the one that brings the tool nearest to what was measured there, in closed form: a
    target's position and axes move on circles about the joint's axis; then base and tool are fitted. Of positions two
    numbers a row are left to be explained, of poses five.

    Args:
        arm: with which is predicted.
        rows: rows with positions, of one frame and target.
        measured: their poses.
    """
    return [
        (_freed(arm, rows, measured, joint), _cause(arm.robot, rows.q, joint))
        for joint, revolute in enumerate(arm.robot.revolute)
        if revolute
    ]


def _freed(
    arm: PredictingArm, rows: Measurements, measured: MeasuredPoses, joint: int
) -> Float64[Tensor, "rows dof"]:
    """Find the values of one joint together with base and tool, by Levenberg and Marquardt's method."""
    q = rows.q.clone()
    if _copied(q, joint) is not None:
        q[:, joint] = q[:, joint].median()
    frames = best_base_and_tool(arm.poses(replace(rows, q=q)), measured)
    cost, damping = torch.tensor(torch.inf).double(), torch.tensor(1e-3).double()
    tried, first = (q, frames), cost
    for number in range(ROUNDS):
        turned, free = _turned(arm, rows, joint, tried[0], tried[1], measured)
        T = arm.poses(replace(rows, q=turned))
        error = measured.squares(tried[1][0] @ T @ tried[1][1]).sum()
        if error < cost:
            settled = bool(cost - error < SETTLED * cost)
            first = error if number == 0 else first
            q, frames, cost, damping = turned, tried[1], error, damping / 10
            here = T, free
            if settled:
                break
        else:
            damping = damping * 10
        if number >= TRIED and cost > HOPELESS * first:
            break
        step = base_and_tool_step(here[0], measured, *frames, damping, here[1])
        tried = q, moved_base_and_tool(*frames, step)
    return q


def _turned(
    arm: PredictingArm,
    rows: Measurements,
    joint: int,
    q: Float64[Tensor, "rows dof"],
    frames: tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]],
    measured: MeasuredPoses,
) -> tuple[Float64[Tensor, "rows dof"], Float64[Tensor, "rows 6"]]:
    """Turn a joint so that the tool is nearest to every measured pose, in closed form.

    With `a` a vector of the tool from the joint's axis and `b` what was measured of it, both across the axis `z`, the
    angle is `atan2(Σ w z·(a × b), Σ w a·b)`, over the target's position and the columns of its rotation.

    Returns:
        The joint values, and the motion of the target by the joint: shift [m] and turn [rad] in the measuring frame.
    """
    base, tool = frames
    T = arm.poses(replace(rows, q=q))
    J = joint_jacobian(arm.robot, q)[1]
    axis = J[:, 3:, joint]
    foot = T[:, :3, 3] + torch.linalg.cross(axis, J[:, :3, joint])
    tip, R = T @ tool, base[:3, :3]
    position = (measured.position - base[:3, 3]) @ R
    pairs = [(tip[:, :3, 3] - foot, position - foot, torch.ones(len(q)).double())]
    weight = measured.has_rotation * measured.lever**2 / 2
    pairs += [(tip[:, :3, k], measured.rotation[:, :, k] @ R, weight) for k in range(3)]
    sine, cosine = torch.zeros(2, len(q)).double()
    for a, b, w in pairs:
        sine = sine + w * (axis * torch.linalg.cross(a, b)).sum(-1)
        cosine = cosine + w * ((a * b).sum(-1) - (axis * a).sum(-1) * (axis * b).sum(-1))
    turned = q.clone()
    turned[:, joint] += torch.atan2(sine, cosine)
    shift = torch.linalg.cross(axis, position - foot)
    return turned, torch.cat([shift @ R.mT, axis @ R.mT], 1)


def _copied(q: Float64[Tensor, "rows dof"], joint: int) -> int | None:
    """Find another joint whose column is the same."""
    same = (q - q[:, joint : joint + 1]).abs().amax(0) < EQUAL
    same[joint] = False
    return int(same.nonzero()[0, 0]) if bool(same.any()) else None


def _cause(robot: Robot, q: Float64[Tensor, "rows dof"], joint: int) -> Cause:
    name, other = f"joint {joint + 1}", _copied(q, joint)
    if float(q[:, joint].max() - q[:, joint].min()) < STILL:
        clause = f"{name} is logged as constant ({torch.rad2deg(q[0, joint]):.4g} deg in all rows), though it moved"
    elif other is not None:
        clause = f"the column of {name} holds the values of joint {other + 1}"
    else:
        clause = f"the values of {name} are not those that it had, while the other joints' are"
    return Cause("joint_values", clause, f"check what was logged for {name}", 3.0, (joint,))
