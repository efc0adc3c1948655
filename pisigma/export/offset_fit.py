"""Least squares of joint offsets, base and tool against wanted poses, with exact data and no noise in them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.kinematics.jacobian import joint_jacobian
from pisigma.robot.description import Robot
from pisigma.se3 import (
    pose_error,
    rotation_from_vector,
    skew,
    transform,
    transform_from_xyzrpy,
    xyzrpy_from_transform,
)

ITERATIONS = 50
UNSEEN = 1e-6
"""A joint's column whose part outside those of base and tool is a smaller share of it tells nothing."""
NO_EFFECT = 1e-4
"""Directions of the unknowns whose effect is smaller than this share of the largest are not moved along: base and
tool would run away for next to nothing."""
SETTLED = 1e-12


@dataclass(frozen=True, eq=False)
class OffsetProblem:
    """Bring a robot to poses by moving its joints' zero positions, its base and its tool.

    Attributes:
        robot: the robot to begin with.
        q: joint values [rad or m] of the poses.
        T: where the tool shall be then.
    """

    robot: Robot
    q: Float64[Tensor, "poses dof"]
    T: Float64[Tensor, "poses 4 4"]

    @property
    def lever(self) -> float:
        """Length [m] that makes an angle [rad] count as much as a distance: half a reach."""
        return self.robot.reach / 2

    def residual(self, robot: Robot) -> tuple[Float64[Tensor, " values"], Float64[Tensor, "values unknowns"]]:
        """What is missing [m], and its derivative by joints [rad or m], base and tool [m, rad].

        Base and tool count as small shifts and turns, of the base in the frame that poses are given in, of the
        tool in its own.
        """
        T, J = joint_jacobian(robot, self.q)
        R, p = T[:, :3, :3], T[:, :3, 3]
        eye, none = torch.eye(3).to(R).expand_as(R), torch.zeros_like(R)
        shifts = torch.cat([J[:, :3], eye, -skew(p), R, none], -1)
        turns = self.lever * torch.cat([J[:, 3:], none, eye, none, R], -1)
        missing = pose_error(self.T, T)
        missing = torch.cat([missing[:, :3], self.lever * missing[:, 3:]], -1)
        return missing.flatten(), torch.cat([shifts, turns], 1).flatten(0, 1)

    def moved(self, robot: Robot, step: Float64[Tensor, " unknowns"]) -> Robot:
        """The robot with joint offsets, base and tool changed by a step."""
        dof = robot.dof
        dh = robot.dh.copy()
        for joint, row, change in zip(robot.joints, robot.joint_rows, step[:dof].tolist(), strict=True):
            dh[row, 0 if joint.type == "revolute" else 1] += joint.direction * change
        base, tool = (transform_from_xyzrpy(torch.from_numpy(f.copy())) for f in (robot.base, robot.tool))
        base, tool = _small(step[dof : dof + 6]) @ base, tool @ _small(step[dof + 6 :])
        return robot.with_geometry(
            dh, xyzrpy_from_transform(base).numpy(), xyzrpy_from_transform(tool).numpy()
        )


def solve_offsets(problem: OffsetProblem) -> tuple[Robot, tuple[bool, ...]]:
    """Minimise the sum of squares by damped Gauss-Newton steps (Levenberg-Marquardt) from the robot as it is.

    Returns:
        The robot, and for every joint whether its offset could be told from base and tool; else it is left 0.
    """
    robot = problem.robot
    missing, J = problem.residual(robot)
    seen = _seen(J, robot.dof)
    free = torch.tensor([*seen, *[True] * 12])
    damping = 1e-3
    for _ in range(ITERATIONS):
        step = torch.zeros(len(free), dtype=torch.float64)
        step[free] = _step(J[:, free], missing, damping)
        there = problem.moved(robot, step)
        left, J_there = problem.residual(there)
        if left @ left < missing @ missing:
            settled = float(step.abs().max()) < SETTLED
            robot, missing, J, damping = there, left, J_there, damping / 10
            if settled:
                break
        elif damping > 1e6 or float(step.abs().max()) < SETTLED:
            break
        else:
            damping *= 10
    return robot, seen


def _step(
    J: Float64[Tensor, "values _free"], missing: Float64[Tensor, " values"], damping: float
) -> Float64[Tensor, " _free"]:
    """Damped step by the singular values of the column-scaled derivative."""
    scale = J.norm(dim=0).clamp(min=1e-12)
    U, s, V = torch.linalg.svd(J / scale, full_matrices=False)
    gain = torch.where(s > NO_EFFECT * s[0], s / (s.square() + damping * s[0].square()), 0.0)
    step: Tensor = V.mT @ (gain * (U.mT @ missing)) / scale
    return step


def _seen(J: Float64[Tensor, "values unknowns"], dof: int) -> tuple[bool, ...]:
    """For every joint whether its column is no combination of those of base, tool and the joints before."""
    known, found = J[:, dof:] / J[:, dof:].norm(dim=0).clamp(min=1e-12), []
    for column in J[:, :dof].unbind(1):
        column = column / column.norm()
        U, s, _ = torch.linalg.svd(known, full_matrices=False)
        basis = U[:, s > UNSEEN * s[0]]
        found.append(bool((column - basis @ (basis.mT @ column)).norm() > UNSEEN))
        if found[-1]:
            known = torch.cat([known, column[:, None]], 1)
    return tuple(found)


def _small(step: Float64[Tensor, " 6"]) -> Float64[Tensor, "4 4"]:
    return transform(rotation_from_vector(step[3:]), step[:3])
