"""Hypotheses of setup faults, the arm that predicts poses under them, and the joint values under them."""

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, geometric_poses, poses_of_rows
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import (
    LEVER_SHARE,
    MeasuredPoses,
    affine_squared_error,
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
"""Largest share of the errors that may remain if a setup fault explains them."""
_MIN_FREEDOM = 6
"""Smallest number of degrees of freedom that must remain after a fit."""
_MAX_POSES = 2**13
"""Number of poses that are compared together, so that the arrays stay in the processor's cache."""
FittedFrames = Literal["none", "base", "base and tool"]
"""Frames that are fitted to the rows under a hypothesis."""
_SHIFTS = (1, -1, 2, -2)
"""Numbers of rows by which joint values may be shifted relative to the measurements."""
MARGIN = max(_SHIFTS)
_ENDS = 3
"""Shares of the rows at both ends to which base and tool are fitted if a row may have been lost in between."""
_ADVICE = "look for a joint vector or a measurement that was lost or written twice, and match them again"
MAX_ITERATIONS = 30
_TRIED, _HOPELESS = 8, 0.25
"""Number of iterations after which the search is abandoned if more than a certain share of the cost remains, and this
share."""
_CONVERGENCE_TOLERANCE = 1e-3
"""Relative decrease of the cost per step at convergence."""
_STILL = 1e-3
"""Range below which a joint value is treated as constant [rad or m]."""
_EQUAL = 1e-6
"""Difference below which two columns are treated as equal [rad or m]."""


@dataclass(frozen=True, eq=False)
class PredictingArm:
    """Arm that predicts the poses of rows under a hypothesis.

    Attributes:
        robot: the nominal robot.
        model: the model, with its base and tool; None to use the nominal robot, with base and tool fitted to the rows
            under every hypothesis.
    """

    robot: Robot
    model: CalibratedModel | None = None

    def poses(self, rows: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Predict the poses of rows."""
        if self.model is not None:
            return poses_of_rows(self.model, rows)
        return forward_kinematics(self.robot, rows.q)

    def poses_at(
        self, q: Float64[Tensor, "maps rows dof"], rows: Measurements
    ) -> Float64[Tensor, "maps rows 4 4"]:
        """Predict the poses of rows at other joint values [rad or m]."""
        repeated = rows.select(torch.arange(rows.rows).repeat(len(q)))
        return self.poses(replace(repeated, q=q.flatten(0, 1))).reshape(*q.shape[:2], 4, 4)

    @property
    def fits_of_frames(self) -> tuple[FittedFrames, ...]:
        """Frames that are fitted to compare hypotheses; without a model, these are always base and tool."""
        return ("base and tool",) if self.model is None else ("none", "base", "base and tool")

    def mean_squared_errors(
        self,
        rows: Measurements,
        q: Float64[Tensor, "maps rows dof"],
        measured: MeasuredPoses,
        modes: Sequence[FittedFrames],
    ) -> Float64[Tensor, "modes maps"]:
        """Compute mean squared errors [m²] under hypotheses of the joint values, with the geometry alone.

        Args:
            rows: rows of one frame and target.
            q: hypothetical joint values [rad or m].
            measured: measured poses.
            modes: frames that are fitted.

        Returns:
            The mean squared error of every hypothesis, see `mean_squared_error`.
        """
        chunks = [
            forward_kinematics(self.robot, some)
            if self.model is None
            else geometric_poses(self.model, some, rows)
            for some in torch.split(q, max(1, _MAX_POSES // rows.rows))
        ]
        return torch.stack(
            [torch.cat([mean_squared_error(mode, T, measured) for T in chunks]) for mode in modes]
        )


def mean_squared_error(
    mode: FittedFrames, T: Float64[Tensor, "*#batch rows 4 4"], measured: MeasuredPoses
) -> Float64[Tensor, "*#batch"]:
    """Compute the mean squared error [m²] of predicted poses, either unchanged or with frames fitted.

    With base and tool fitted, the result is the lower bound that `affine_squared_error` computes.
    """
    if mode == "base and tool":
        return affine_squared_error(T, measured)
    if mode == "base":
        T = best_base(T, measured)[..., None, :, :] @ T
    error: Tensor = measured.squared_errors(T).mean(-1)
    return error


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Joint values, predicted poses and measured poses under the assumption of a fault.

    Attributes:
        q: joint values under the hypothesis [rad or m].
        T: predicted poses under the hypothesis.
        measured: measured poses under the hypothesis, for example in other units.
        causes: the assumed faults; empty for no fault.
        fitted_parameters: number of parameters that were fitted.
    """

    q: Float64[Tensor, "rows dof"]
    T: Float64[Tensor, "rows 4 4"]
    measured: MeasuredPoses
    causes: tuple[Cause, ...] = ()
    fitted_parameters: int = 0

    @property
    def complexity(self) -> float:
        """Complexity of the causes; frame and tool together count less, because a new setup changes both."""
        kinds = {cause.kind for cause in self.causes}
        return sum(cause.complexity for cause in self.causes) - (1 if {"frame", "tool"} <= kinds else 0)

    @property
    def tool_value_count(self) -> int:
        """Number of parameters of a tool: 6 with orientations, otherwise 3."""
        return 6 if bool(self.measured.has_rotation.any()) else 3

    @cached_property
    def error(self) -> float:
        """RMS error [m], corrected for the degrees of freedom."""
        spare = self.measured.value_count - self.fitted_parameters
        if spare < _MIN_FREEDOM:
            return float("inf")
        mean = float(self.measured.squared_errors(self.T).mean()) * self.measured.value_count / spare
        return float(np.sqrt(mean)) if np.isfinite(mean) else float("inf")

    def rms(self) -> tuple[float, float]:
        """Compute the RMS errors of positions [m] and of rotations [rad]; NaN if none was measured."""
        position = float((self.measured.position - self.T[:, :3, 3]).square().sum(-1).mean().sqrt())
        R = (self.measured.rotation @ self.T[:, :3, :3].mT)[self.measured.has_rotation]
        return position, float(rotation_vector(R).square().sum(-1).mean().sqrt())

    def without_causes(self, kinds: Set[str]) -> "Hypothesis":
        """Return the hypothesis without the causes of given kinds, which are not reported."""
        return replace(self, causes=tuple(cause for cause in self.causes if cause.kind not in kinds))

    def with_cause(
        self, cause: Cause, T: Float64[Tensor, "rows 4 4"], fitted_parameters: int
    ) -> "Hypothesis":
        """Return the hypothesis with a further cause and the poses predicted under it."""
        return replace(
            self,
            T=T,
            causes=(*self.causes, cause),
            fitted_parameters=self.fitted_parameters + fitted_parameters,
        )


def shifted_rows(
    robot: Robot, rows: Measurements, row_indices: Int64[Tensor, " chosen"], measured: MeasuredPoses
) -> Iterator[tuple[Float64[Tensor, "chosen dof"], MeasuredPoses, Cause]]:
    """Yield hypotheses that joint values or orientations are shifted by rows, everywhere or only on one side of a row.

    Args:
        robot: the nominal robot.
        rows: rows in the order of the file.
        row_indices: indices of the rows to evaluate, at least `MARGIN` rows from both ends.
        measured: measured poses of these rows.
    """
    q = rows.q[row_indices]
    for shift in _SHIFTS:
        cause = Cause(
            "rows",
            f"the joint values are shifted by {_count(shift)} relative to the measurements",
            _ADVICE,
            1.0,
        )
        yield rows.q[row_indices + shift], measured, cause
        if bool(measured.has_rotation.any()):
            assert rows.rotation is not None
            other = rows.rotation[row_indices + shift]
            there = torch.isfinite(other).flatten(1).all(1)
            rotations = replace(measured, rotation=torch.where(there[:, None, None], other, 0.0))
            rotations = replace(rotations, has_rotation=there & measured.has_rotation)
            clause = f"the orientations are shifted by {_count(shift)} relative to the positions"
            yield q, rotations, Cause("rows", clause, _ADVICE, 1.0)
    yield from _shifted_from_a_row(robot, rows, row_indices)


def _shifted_from_a_row(
    robot: Robot, rows: Measurements, chosen: Int64[Tensor, " chosen"]
) -> Iterator[tuple[Float64[Tensor, "chosen dof"], MeasuredPoses, Cause]]:
    """Find the row after (or before) which a shift explains the most, with base and tool fitted to the other side.

    The neighbouring rows are left out, because the lost values are unknown.
    """
    inner = torch.arange(MARGIN, rows.rows - MARGIN)
    among = rows.select(inner)
    measured = MeasuredPoses.from_tensors(among.position, among.rotation, LEVER_SHARE * robot.reach)
    T = {shift: forward_kinematics(robot, rows.q.roll(-shift, 0))[inner] for shift in (0, *_SHIFTS)}
    third = len(chosen) // _ENDS
    for at_start, end in ((True, chosen[:third] - MARGIN), (False, chosen[-third:] - MARGIN)):
        base, tool = best_base_and_tool(T[0][end], measured.select(end))
        errors = {shift: measured.squared_errors(base @ poses @ tool) for shift, poses in T.items()}
        # Errors on both sides add up: the best change has the largest sum of gains from it to the end.
        # With base and tool of the last rows, the rows before the change are shifted, so the sign reverses.
        for shift in _SHIFTS:
            gain = errors[0] - errors[shift] if at_start else errors[shift] - errors[0]
            change = int(gain.flip(0).cumsum(0).flip(0).argmax())
            place = rows.place(int(inner[change]))
            where = f"after about {place}" if at_start else f"before about {place}"
            clause = f"{where} the joint values are shifted by {_count(shift)} relative to the measurements"
            # The change lies between two rows, hence the half.
            kept = chosen[(chosen - inner[change] + 0.5).abs() > abs(shift)]
            behind = kept >= inner[change]
            q = torch.where((behind == at_start)[:, None], rows.q[kept + shift], rows.q[kept])
            # More complex than a shift of all rows (1.0), which is chosen if both explain as much.
            yield q, measured.select(kept - MARGIN), Cause("rows", clause, _ADVICE, 1.5)


def _count(shift: int) -> str:
    """Return a text with the number of rows of a shift."""
    return "one row" if abs(shift) == 1 else f"{abs(shift)} rows"


def estimate_joint_values(
    robot: Robot, rows: Measurements, measured: MeasuredPoses
) -> list[tuple[Float64[Tensor, "rows dof"], Cause]]:
    """Yield hypotheses in which the values of one revolute joint are estimated and those of other joints are as logged.

    Every row's value is the one that brings the tool nearest to the measured pose, in closed form, because a target's
    position and axes move on circles about the joint axis. This alternates with fits of base and tool. Two values per
    position, or five per pose, remain as a test of the hypothesis.

    Args:
        robot: the nominal robot.
        rows: rows with positions, of one frame and target.
        measured: measured poses of these rows.
    """
    return [
        (_freed(robot, rows, measured, joint), _cause(robot, rows.q, joint))
        for joint, revolute in enumerate(robot.revolute)
        if revolute
    ]


def _freed(
    robot: Robot, rows: Measurements, measured: MeasuredPoses, joint: int
) -> Float64[Tensor, "rows dof"]:
    """Estimate the values of one joint together with base and tool by the Levenberg-Marquardt method."""
    q = rows.q.clone()
    if _copied(q, joint) is not None:
        q[:, joint] = q[:, joint].median()
    frames = best_base_and_tool(forward_kinematics(robot, q), measured)
    cost, damping = torch.tensor(torch.inf).double(), torch.tensor(1e-3).double()
    tried, first = (q, frames), cost
    for number in range(MAX_ITERATIONS):
        turned, free = _turned(robot, rows, joint, tried[0], tried[1], measured)
        T = forward_kinematics(robot, turned)
        error = measured.squared_errors(tried[1][0] @ T @ tried[1][1]).sum()
        if error < cost:
            settled = bool(cost - error < _CONVERGENCE_TOLERANCE * cost)
            first = error if number == 0 else first
            q, frames, cost, damping = turned, tried[1], error, damping / 10
            here = T, free
            if settled:
                break
        else:
            damping = damping * 10
        if number >= _TRIED and cost > _HOPELESS * first:
            break
        step = base_and_tool_step(here[0], measured, *frames, damping, here[1])
        tried = q, moved_base_and_tool(*frames, step)
    return q


def _turned(
    robot: Robot,
    rows: Measurements,
    joint: int,
    q: Float64[Tensor, "rows dof"],
    frames: tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]],
    measured: MeasuredPoses,
) -> tuple[Float64[Tensor, "rows dof"], Float64[Tensor, "rows 6"]]:
    """Rotate a joint so that the tool is nearest to every measured pose, in closed form.

    With a vector `a` from the joint axis to the tool and the corresponding measured vector `b`, both perpendicular to
    the axis `z`, the angle is `atan2(Σ w z·(a × b), Σ w a·b)`, summed over the target's position and the columns of its
    rotation.

    Returns:
        The joint values, and the derivative of the target's pose with respect to the joint: shift [m] and rotation
        [rad] in the measuring frame.
    """
    base, tool = frames
    T = forward_kinematics(robot, q)
    J = joint_jacobian(robot, q)[1]
    axis = J[:, 3:, joint]
    # axis × (axis × lever) is minus the component of the lever normal to the axis; foot is the point on the axis
    # nearest to the flange.
    foot = T[:, :3, 3] + torch.linalg.cross(axis, J[:, :3, joint])
    tip, R = T @ tool, base[:3, :3]
    position = (measured.position - base[:3, 3]) @ R
    pairs = [(tip[:, :3, 3] - foot, position - foot, torch.ones(len(q)).double())]
    # `squared_errors` uses |dR|² / 2, about the angle squared, so every column has the weight lever² / 2.
    weight = measured.has_rotation * measured.lever**2 / 2
    pairs += [(tip[:, :3, k], measured.rotation[:, :, k] @ R, weight) for k in range(3)]
    sine, cosine = torch.zeros(2, len(q)).double()
    for a, b, w in pairs:
        sine = sine + w * (axis * torch.linalg.cross(a, b)).sum(-1)
        cosine = cosine + w * ((a * b).sum(-1) - (axis * a).sum(-1) * (axis * b).sum(-1))
    turned = q.clone()
    turned[:, joint] += torch.atan2(sine, cosine)
    # For positions, the tip's lever is parallel to the measured one after the rotation, and only its direction is used.
    shift = torch.linalg.cross(axis, position - foot)
    return turned, torch.cat([shift @ R.mT, axis @ R.mT], 1)


def _copied(q: Float64[Tensor, "rows dof"], joint: int) -> int | None:
    """Return another joint with an equal column; None if there is none."""
    same = (q - q[:, joint : joint + 1]).abs().amax(0) < _EQUAL
    same[joint] = False
    return int(same.nonzero()[0, 0]) if bool(same.any()) else None


def _cause(robot: Robot, q: Float64[Tensor, "rows dof"], joint: int) -> Cause:
    name, other = f"joint {joint + 1}", _copied(q, joint)
    if float(q[:, joint].max() - q[:, joint].min()) < _STILL:
        clause = f"{name} is logged as constant ({torch.rad2deg(q[0, joint]):.4g} deg in all rows), though it moved"
    elif other is not None:
        clause = f"the column of {name} contains the values of joint {other + 1}"
    else:
        clause = f"the logged values of {name} are wrong, while those of the other joints are correct"
    return Cause("joint_values", clause, f"check the log of {name}", 3.0, (joint,))
