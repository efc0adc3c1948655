"""A model projected on what a file can say: the robot with few free parameters that comes nearest to it."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import ModelError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.robot.row import DH_COLUMNS
from pisigma.robot.se3 import (
    pose_error,
    rotation_from_vector,
    rotation_vector,
    skew,
    transform,
    transform_from_xyzrpy,
    xyzrpy_from_transform,
)

ITERATIONS = 50
UNOBSERVABLE = 1e-6
"""A parameter's column whose share outside those of base and tool is smaller determines nothing."""
NO_EFFECT = 1e-4
"""Directions of the unknowns whose effect is smaller than this share of the largest are not moved along: base and
tool would run away for next to nothing."""
SETTLED = 1e-12
POSES = 1_000
"""Poses that a robot is fitted to, and as many others that it is judged by."""


def joint_offsets(robot: Robot) -> tuple[int, ...]:
    """Indices into the flattened `Robot.dh` of theta of turning and d of sliding joints."""
    columns = (0 if joint.type == "revolute" else 1 for joint in robot.joints)
    return tuple(
        len(DH_COLUMNS) * row + column for row, column in zip(robot.joint_rows, columns, strict=True)
    )


def whole_geometry(robot: Robot) -> tuple[int, ...]:
    """Indices into the flattened `Robot.dh` of all parameters."""
    return tuple(range(robot.dh.size))


@dataclass(frozen=True, eq=False)
class ProjectionProblem:
    """Bring a robot to poses by moving some of its parameters, its base and its tool.

    Attributes:
        robot: the robot to begin with.
        q: joint values [rad or m] of the poses.
        T: where the tool shall be then.
        parameters: indices into the flattened `Robot.dh` of those that are free.
    """

    robot: Robot
    q: Float64[Tensor, "poses dof"]
    T: Float64[Tensor, "poses 4 4"]
    parameters: Sequence[int]

    @property
    def lever(self) -> float:
        """Length [m] that makes an angle [rad] count as much as a distance: half a reach."""
        return self.robot.reach / 2

    def residual(self, robot: Robot) -> tuple[Float64[Tensor, " values"], Float64[Tensor, "values unknowns"]]:
        """What is missing [m], and its derivative by the parameters [rad or m], base and tool [m, rad].

        Base and tool count as small shifts and turns, of the base in the frame that poses are given in, of the
        tool in its own.
        """
        T, J = identification_jacobian(robot, self.q)
        J = J[..., list(self.parameters)]
        R, p = T[:, :3, :3], T[:, :3, 3]
        eye, none = torch.eye(3).to(R).expand_as(R), torch.zeros_like(R)
        shifts = torch.cat([J[:, :3], eye, -skew(p), R, none], -1)
        turns = self.lever * torch.cat([J[:, 3:], none, eye, none, R], -1)
        missing = pose_error(self.T, T)
        missing = torch.cat([missing[:, :3], self.lever * missing[:, 3:]], -1)
        return missing.flatten(), torch.cat([shifts, turns], 1).flatten(0, 1)

    def moved(self, robot: Robot, step: Float64[Tensor, " unknowns"]) -> Robot:
        """The robot with its parameters, base and tool changed by a step."""
        count = len(self.parameters)
        dh = robot.dh.copy()
        dh.reshape(-1)[list(self.parameters)] += step[:count].numpy()
        base, tool = (transform_from_xyzrpy(torch.from_numpy(f.copy())) for f in (robot.base, robot.tool))
        base, tool = _small(step[count : count + 6]) @ base, tool @ _small(step[count + 6 :])
        return robot.with_geometry(
            dh, xyzrpy_from_transform(base).numpy(), xyzrpy_from_transform(tool).numpy()
        )


def solve_projection(problem: ProjectionProblem) -> tuple[Robot, tuple[bool, ...]]:
    """Minimise the sum of squares by damped Gauss-Newton steps (Levenberg-Marquardt) from the robot as it is.

    Returns:
        The robot, and for every parameter whether it can be determined beside base, tool and the parameters before
        it; else it is left as it is.
    """
    robot = problem.robot
    missing, J = problem.residual(robot)
    observable = _observable(J, len(problem.parameters))
    free = torch.tensor([*observable, *[True] * 12])
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
    return robot, observable


def _step(
    J: Float64[Tensor, "values _free"], missing: Float64[Tensor, " values"], damping: float
) -> Float64[Tensor, " _free"]:
    """Damped step by the singular values of the column-scaled derivative."""
    scale = J.norm(dim=0).clamp(min=1e-12)
    U, s, V = torch.linalg.svd(J / scale, full_matrices=False)
    gain = torch.where(s > NO_EFFECT * s[0], s / (s.square() + damping * s[0].square()), 0.0)
    step: Tensor = V.mT @ (gain * (U.mT @ missing)) / scale
    return step


def _observable(J: Float64[Tensor, "values unknowns"], count: int) -> tuple[bool, ...]:
    """For every parameter whether its column is no combination of those of base, tool and the parameters before."""
    basis = _basis(J[:, count:])
    observable = []
    for column in J[:, :count].unbind(1):
        column = column / column.norm().clamp(min=1e-12)
        rest = column - basis @ (basis.mT @ column)
        observable.append(bool(rest.norm() > UNOBSERVABLE))
        if observable[-1]:
            basis = torch.cat([basis, (rest / rest.norm())[:, None]], 1)
    return tuple(observable)


def _basis(columns: Float64[Tensor, "values columns"]) -> Float64[Tensor, "values rank"]:
    """Orthonormal basis of what columns span, whatever their sizes."""
    U, s, _ = torch.linalg.svd(columns / columns.norm(dim=0).clamp(min=1e-12), full_matrices=False)
    basis: Tensor = U[:, s > UNOBSERVABLE * s[0]]
    return basis


def _small(step: Float64[Tensor, " 6"]) -> Float64[Tensor, "4 4"]:
    return transform(rotation_from_vector(step[3:]), step[:3])


@dataclass(frozen=True)
class Departure:
    """How far a robot's tool is from where the whole model has it.

    Attributes:
        mean_mm: of the distances [mm].
        p95_mm: their 95 % quantile [mm].
        max_mm: the largest [mm].
        mean_mrad: mean angle between the two rotations [mrad].
    """

    mean_mm: float
    p95_mm: float
    max_mm: float
    mean_mrad: float


@dataclass(frozen=True, eq=False)
class Projection:
    """A robot that comes nearest to a model, and the poses that it is judged by, which it was not fitted to.

    Attributes:
        robot: the robot, with base and tool fitted as well.
        observable: for every free parameter whether it can be determined beside base, tool and those before it.
        q: joint values [rad or m].
        T: where the model has the tool there.
    """

    robot: Robot
    observable: tuple[bool, ...]
    q: Float64[Tensor, "poses dof"]
    T: Float64[Tensor, "poses 4 4"]

    def departure(self, robot: Robot) -> Departure:
        """How far a robot is from the model."""
        T = forward_kinematics(robot, self.q)
        distance = (T[:, :3, 3] - self.T[:, :3, 3]).norm(dim=-1)
        angle = rotation_vector(T[:, :3, :3].mT @ self.T[:, :3, :3]).norm(dim=-1)
        return Departure(
            mean_mm=float(distance.mean()) * 1e3,
            p95_mm=float(distance.quantile(0.95)) * 1e3,
            max_mm=float(distance.max()) * 1e3,
            mean_mrad=float(angle.mean()) * 1e3,
        )


def departure_from_drawn(robot: Robot, drawn: Robot) -> Departure:
    """How far a robot's tool is from where the robot as drawn has it, on the bases and with the tools that they have.

    Judged at random joint values within the limits of the drawn robot, and within 180 deg (3 m).
    """
    low, high = torch.from_numpy(drawn.limits.clip(-torch.pi, torch.pi)).unbind(1)
    share = torch.rand((POSES, drawn.dof), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = low + share * (high - low)
    return Projection(robot, (), q, forward_kinematics(robot, q)).departure(drawn)


def project_model(
    model: CalibratedModel, start: Robot, parameters: Sequence[int], seed: int = 0
) -> Projection:
    """Fit parameters, base and tool of a robot to a model by least squares.

    An angle counts as much as the distance that it makes at half the robot's reach.

    The poses are those of the model over the region that it was calibrated in: at its stored joint values and
    between random two of them.

    Args:
        model: the model.
        start: the robot to begin with, whose other parameters stay.
        parameters: indices into the flattened `Robot.dh` of the free ones.
        seed: of the draw.

    Raises:
        ModelError: the model stores no joint values, or predicts none of their poses.
    """
    generator = torch.Generator().manual_seed(seed)
    problem = ProjectionProblem(start, *_poses(model, generator), parameters)
    return Projection(*solve_projection(problem), *_poses(model, generator))


def _poses(
    model: CalibratedModel, generator: torch.Generator
) -> tuple[Float64[Tensor, "poses dof"], Float64[Tensor, "poses 4 4"]]:
    """Joint values within the calibrated region, and where the model has the tool there."""
    starts = model.starts
    if not len(starts):
        raise ModelError(
            f"model {model.name} stores no joint values, so its region is not known; train it again."
        )
    pair = torch.randint(len(starts), (2, POSES), generator=generator)
    share = torch.rand((POSES, 1), generator=generator, dtype=torch.float64)
    q = starts[pair[0]] + share * (starts[pair[1]] - starts[pair[0]])
    T = model.forward(q)
    usable = torch.isfinite(T).flatten(1).all(-1)
    if model.network is not None and model.domain is not None:
        with torch.no_grad():
            usable &= model.domain.contains(model.network.scaled_inputs(T, q))
    if not usable.any():
        raise ModelError(
            f"model {model.name} predicts no pose between the joint values that it stores; train it again."
        )
    return q[usable], T[usable]
