"""Newton steps of one arm for many poses at once, each entry a vector over the poses."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.inverse.damped_steps import DampedSteps
from pisigma.kinematics.components import (
    Columns,
    Frame,
    as_tensors,
    compose,
    constant_frame,
    frame_of,
    map_scalars,
)
from pisigma.kinematics.forward import Geometry
from pisigma.kinematics.jacobian import motion_components
from pisigma.kinematics.matrix_chain import FEW, matrix_chain
from pisigma.kinematics.normal_equations import NormalSolution, dot, solve_normal
from pisigma.kinematics.singularity import characteristic_length
from pisigma.robot.description import Robot
from pisigma.se3 import invert, transform_from_xyzrpy

BLOCK = 5
"""Damped steps between looks at which poses are still worth it."""

BY_MATRICES = 800
"""Fewer poses than this take damped steps by matrices."""


@dataclass(frozen=True, eq=False)
class Step:
    """One Newton step.

    Attributes:
        q: joint values after it [rad].
        square: squared error before it [reach or rad].
        least: bound from below on the smallest singular value of the Jacobian in characteristic lengths.
    """

    q: Float64[Tensor, "dof poses"]
    square: Float64[Tensor, " poses"]
    least: Float64[Tensor, " poses"]


class MovingArm:
    """An arm of six revolute joints without its base and tool, which are taken off the wanted poses instead.

    Joint values are `(dof, poses)`, wanted poses frames on components, in the first row's frame; see `wanted`.

    Attributes:
        robot: the whole arm.
    """

    def __init__(self, robot: Robot) -> None:
        """Prepare the geometry of an arm."""
        none = np.zeros(6)
        self.robot = robot
        self._robot = robot.with_geometry(base=none, tool=none)
        self._geometry = Geometry.of(self._robot)
        base, tool = (transform_from_xyzrpy(torch.from_numpy(end.copy())) for end in (robot.base, robot.tool))
        self._first, self._last = constant_frame(invert(base)), constant_frame(invert(tool))
        self._length = characteristic_length(robot)
        self._few = DampedSteps(matrix_chain(self._robot), self._length)
        self._lever = 1.0 + float(np.linalg.norm(robot.tool[:3]))

    def wanted(self, T_base_tool: Frame) -> Columns:
        """Poses of the last row's frame in the first row's, for poses T_base_tool."""
        return as_tensors(compose(compose(self._first, T_base_tool), self._last))

    def step(self, wanted: Columns, q: Float64[Tensor, "dof poses"]) -> Step:
        """One Newton step towards the poses, damped a little: by a tenth of the squared error."""
        A, error = self._look(wanted, q)
        square = dot(error, error)
        solution: NormalSolution = solve_normal(A, error, 0.1 * square + 1e-15)
        return Step(q + torch.stack(solution.step), square, solution.least_singular_value())

    def approach(
        self, wanted: Columns, q: Float64[Tensor, "dof poses"], rounds: int, target: float
    ) -> Float64[Tensor, "dof poses"]:
        """Damped steps, as `kinematics.numeric.solve_numeric` makes them, until all residuals are below a target.

        Args:
            wanted: the poses.
            q: joint values to begin with [rad].
            rounds: steps at most; poses that come no nearer in `BLOCK` of them are given up.
            target: residual to come below [reach or rad].
        """
        q, factor = q.clone(), torch.full_like(q[0], 0.1)
        before = torch.full_like(factor, torch.inf)
        active = torch.arange(q.shape[1])
        poses = torch.stack([torch.stack(axis, -1) for axis in wanted], -1)
        for _ in range(-(-rounds // BLOCK)):
            if len(active) < BY_MATRICES:
                found, left, factor = self._few.take(poses[active], q[:, active].T, factor, BLOCK)
                q[:, active] = found.T
            else:
                part = select_rows(wanted, active)
                q[:, active], left, factor = self._damped(part, q[:, active], factor)
            kept = ((left > target**2) & (left < 0.99 * before)).nonzero()[:, 0]
            if not len(kept):
                break
            active, before, factor = active[kept], left[kept], factor[kept]
        return q

    def _damped(self, wanted: Columns, q: Tensor, factor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`BLOCK` damped steps; joint values, squared residuals, and factors of the damping."""
        A, error = self._look(wanted, q)
        square = dot(error, error)
        for _ in range(BLOCK):
            trial = q + torch.stack(solve_normal(A, error, factor * square + 1e-15).step)
            A_trial, error_trial = self._look(wanted, trial)
            left = dot(error_trial, error_trial)
            better = left < square
            q, square = torch.where(better, trial, q), torch.where(better, left, square)
            error = [torch.where(better, new, old) for new, old in zip(error_trial, error, strict=True)]
            A = [
                [torch.where(better, new, old) for new, old in zip(row_trial, row, strict=True)]
                for row_trial, row in zip(A_trial, A, strict=True)
            ]
            factor = (factor * torch.where(better, 0.2, 8.0)).clamp(min=1e-6)
        return q, square, factor

    def _look(self, wanted: Columns, q: Tensor) -> tuple[list[list[Tensor]], list[Tensor]]:
        """Jacobian and what is left to the poses, both with lengths in characteristic lengths."""
        if q.shape[1] < FEW:
            T, J = matrix_chain(self._robot).motion(q.T)
            columns = _columns(frame_of(T), q[0])
            A = [list(row.unbind()) for row in J.movedim(0, -1).contiguous()]
        else:
            frame, rows = motion_components(self._robot, self._geometry, q.unbind(0))
            columns = _columns(frame, q[0])
            A = [[_spread(value, q[0]) for value in row] for row in rows]
        A[:3] = [[value / self._length for value in row] for row in A[:3]]
        error = _error(wanted, columns)
        return A, [e / self._length for e in error[:3]] + error[3:]

    def residual(self, wanted: Columns, q: Float64[Tensor, "dof poses"]) -> Float[Tensor, " poses"]:
        """A bound on the distance [m] and on the angle [rad] of the tool from poses."""
        if q.shape[1] < FEW:
            frame = frame_of(matrix_chain(self._robot).motion(q.T)[0])
        else:
            frame, _ = motion_components(self._robot, self._geometry, q.unbind(0))
        error = _error(wanted, _columns(frame, q[0]))
        return dot(error[:3], error[:3]).sqrt() + self._lever * dot(error[3:], error[3:]).sqrt()


def _error(wanted: Columns, actual: Columns) -> list[Tensor]:
    """Translation [m], and axis times sine of the angle: half the sum of the cross products of the axes.

    Beyond a quarter turn, where the sine falls again, 2 less the sine.
    """
    turn = [torch.zeros_like(actual[3][0]) for _ in range(3)]
    cosine = torch.full_like(turn[0], -1.0)
    for u, v in zip(actual[:3], wanted[:3], strict=True):
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            turn[i].addcmul_(u[j], v[k], value=0.5).addcmul_(u[k], v[j], value=-0.5)
            cosine.addcmul_(u[i], v[i])
    if bool((cosine < 0).any()):
        sine = dot(turn, turn).sqrt().clamp(min=1e-9)
        factor = torch.where(cosine < 0, (2 - sine) / sine, 1.0)
        turn = [value * factor for value in turn]
    return [w - p for w, p in zip(wanted[3], actual[3], strict=True)] + turn


def select_rows(frame: Frame, rows: Tensor) -> Columns:
    """Some of the poses of a frame all whose scalars are tensors."""
    return map_scalars(lambda value: value[rows], frame)  # type: ignore[index]


def _columns(frame: Frame, like: Tensor) -> Columns:
    return map_scalars(lambda value: _spread(value, like), frame)


def _spread(value: float | Tensor, like: Tensor) -> Tensor:
    """A tensor of one entry a pose."""
    return value if isinstance(value, Tensor) else torch.full_like(like, value)
