"""Geometric approximation of a model: the robot with a few free parameters that approximates the model best."""

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
    transform_from_xyz_zyx,
    xyz_zyx_from_transform,
)

MAX_ITERATIONS = 50
_UNOBSERVABLE = 1e-6
"""Share of the column of a parameter outside the span of base and tool below which the parameter is unobservable."""
_NO_EFFECT = 1e-4
"""Smallest effect of a direction of the unknowns, relative to the largest, with which it is changed; others would move
base and tool far without a benefit."""
_CONVERGENCE_TOLERANCE = 1e-12
POSES = 1_000
"""Number of poses for the fit, and number of other poses for its evaluation."""


def joint_offset_indices(robot: Robot) -> tuple[int, ...]:
    """Return the indices into the flattened `Robot.dh` of theta of revolute and d of prismatic joints."""
    columns = (0 if joint.type == "revolute" else 1 for joint in robot.joints)
    return tuple(
        len(DH_COLUMNS) * row + column for row, column in zip(robot.joint_rows, columns, strict=True)
    )


def all_parameter_indices(robot: Robot) -> tuple[int, ...]:
    """Return the indices into the flattened `Robot.dh` of all parameters."""
    return tuple(range(robot.dh.size))


@dataclass(frozen=True, eq=False)
class ApproximationProblem:
    """Least-squares fit of some parameters, base and tool of a robot to poses.

    Attributes:
        robot: initial robot.
        q: joint values [rad or m] of the poses.
        T: target poses of the tool at these joint values.
        parameters: indices into the flattened `Robot.dh` of the free parameters.
    """

    robot: Robot
    q: Float64[Tensor, "poses dof"]
    T: Float64[Tensor, "poses 4 4"]
    parameters: Sequence[int]

    @property
    def length_scale(self) -> float:
        """Length [m] that converts angles [rad] to distances: half the reach."""
        return self.robot.reach / 2

    def residual(self, robot: Robot) -> tuple[Float64[Tensor, " values"], Float64[Tensor, "values unknowns"]]:
        """Compute the residual [m] and its derivatives with respect to parameters, base and tool [m or rad].

        Base and tool change by small translations and rotations: the base in the frame of the poses, the tool in the
        tool frame.
        """
        T, J = identification_jacobian(robot, self.q)
        J = J[..., list(self.parameters)]
        R, p = T[:, :3, :3], T[:, :3, 3]
        eye, none = torch.eye(3).to(R).expand_as(R), torch.zeros_like(R)
        translations = torch.cat([J[:, :3], eye, -skew(p), R, none], -1)
        rotations = self.length_scale * torch.cat([J[:, 3:], none, eye, none, R], -1)
        missing = pose_error(self.T, T)
        missing = torch.cat([missing[:, :3], self.length_scale * missing[:, 3:]], -1)
        return missing.flatten(), torch.cat([translations, rotations], 1).flatten(0, 1)

    def apply_step(self, robot: Robot, step: Float64[Tensor, " unknowns"]) -> Robot:
        """Return the robot with parameters, base and tool changed by a step."""
        count = len(self.parameters)
        dh = robot.dh.copy()
        dh.reshape(-1)[list(self.parameters)] += step[:count].numpy()
        base, tool = (transform_from_xyz_zyx(torch.from_numpy(f.copy())) for f in (robot.base, robot.tool))
        base, tool = _small(step[count : count + 6]) @ base, tool @ _small(step[count + 6 :])
        return robot.with_geometry(
            dh, xyz_zyx_from_transform(base).numpy(), xyz_zyx_from_transform(tool).numpy()
        )


def solve_approximation(problem: ApproximationProblem) -> tuple[Robot, tuple[bool, ...]]:
    """Minimise the sum of squares from the initial robot by Levenberg-Marquardt steps.

    Returns:
        The robot, and for every parameter whether it is observable together with base, tool and the preceding
        parameters; unobservable parameters are not changed.
    """
    robot = problem.robot
    missing, J = problem.residual(robot)
    observable = _observable(J, len(problem.parameters))
    free = torch.tensor([*observable, *[True] * 12])
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        step = torch.zeros(len(free), dtype=torch.float64)
        step[free] = _step(J[:, free], missing, damping)
        there = problem.apply_step(robot, step)
        left, J_there = problem.residual(there)
        if left @ left < missing @ missing:
            converged = float(step.abs().max()) < _CONVERGENCE_TOLERANCE
            robot, missing, J, damping = there, left, J_there, damping / 10
            if converged:
                break
        elif damping > 1e6 or float(step.abs().max()) < _CONVERGENCE_TOLERANCE:
            break
        else:
            damping *= 10
    return robot, observable


def _step(
    J: Float64[Tensor, "values _free"], missing: Float64[Tensor, " values"], damping: float
) -> Float64[Tensor, " _free"]:
    """Compute a damped step from the singular values of the column-scaled Jacobian."""
    scale = J.norm(dim=0).clamp(min=1e-12)
    U, s, V = torch.linalg.svd(J / scale, full_matrices=False)
    gain = torch.where(s > _NO_EFFECT * s[0], s / (s.square() + damping * s[0].square()), 0.0)
    step: Tensor = V.mT @ (gain * (U.mT @ missing)) / scale
    return step


def _observable(J: Float64[Tensor, "values unknowns"], count: int) -> tuple[bool, ...]:
    """Return whether each parameter's column is independent of base, tool and the preceding parameters."""
    basis = _basis(J[:, count:])
    observable = []
    for column in J[:, :count].unbind(1):
        column = column / column.norm().clamp(min=1e-12)
        residual = column - basis @ (basis.mT @ column)
        observable.append(bool(residual.norm() > _UNOBSERVABLE))
        if observable[-1]:
            basis = torch.cat([basis, (residual / residual.norm())[:, None]], 1)
    return tuple(observable)


def _basis(columns: Float64[Tensor, "values columns"]) -> Float64[Tensor, "values rank"]:
    """Return an orthonormal basis of the span of columns, regardless of their norms."""
    U, s, _ = torch.linalg.svd(columns / columns.norm(dim=0).clamp(min=1e-12), full_matrices=False)
    basis: Tensor = U[:, s > _UNOBSERVABLE * s[0]]
    return basis


def _small(step: Float64[Tensor, " 6"]) -> Float64[Tensor, "4 4"]:
    return transform(rotation_from_vector(step[3:]), step[:3])


@dataclass(frozen=True)
class ToolDeviation:
    """Deviation of a robot's tool from the tool of the whole model.

    Attributes:
        mean_mm: mean distance [mm].
        p95_mm: 95 % quantile of the distances [mm].
        max_mm: largest distance [mm].
        mean_mrad: mean angle between the rotations [mrad].
    """

    mean_mm: float
    p95_mm: float
    max_mm: float
    mean_mrad: float


@dataclass(frozen=True, eq=False)
class GeometricApproximation:
    """Robot that approximates a model best, and held-out poses for its evaluation.

    Attributes:
        robot: robot with fitted parameters, base and tool.
        observable: whether each free parameter is observable together with base, tool and the preceding parameters.
        q: held-out joint values [rad or m].
        T: poses of the model's tool at these joint values.
    """

    robot: Robot
    observable: tuple[bool, ...]
    q: Float64[Tensor, "poses dof"]
    T: Float64[Tensor, "poses 4 4"]

    def deviation_of(self, robot: Robot) -> ToolDeviation:
        """Compute the deviation of a robot from the model."""
        T = forward_kinematics(robot, self.q)
        distance = (T[:, :3, 3] - self.T[:, :3, 3]).norm(dim=-1)
        angle = rotation_vector(T[:, :3, :3].mT @ self.T[:, :3, :3]).norm(dim=-1)
        return ToolDeviation(
            mean_mm=float(distance.mean()) * 1e3,
            p95_mm=float(distance.quantile(0.95)) * 1e3,
            max_mm=float(distance.max()) * 1e3,
            mean_mrad=float(angle.mean()) * 1e3,
        )


def departure_from_nominal(robot: Robot, nominal: Robot) -> ToolDeviation:
    """Compute the deviation of a robot's tool from that of another robot, each with its base and tool.

    It is evaluated at random joint values within the limits of `nominal` and within ±180 deg (±3 m).
    """
    low, high = torch.from_numpy(nominal.limits.clip(-torch.pi, torch.pi)).unbind(1)
    share = torch.rand((POSES, nominal.dof), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = low + share * (high - low)
    return GeometricApproximation(robot, (), q, forward_kinematics(robot, q)).deviation_of(nominal)


def approximate_model(
    model: CalibratedModel, start: Robot, parameters: Sequence[int], seed: int = 0
) -> GeometricApproximation:
    """Fit parameters, base and tool of a robot to a model by least squares.

    Angles are weighted by half the robot's reach. The poses are predictions of the model in its calibrated region, at
    random joint values between pairs of stored joint values.

    Args:
        model: model to approximate.
        start: initial robot, whose other parameters do not change.
        parameters: indices into the flattened `Robot.dh` of the free parameters.
        seed: random seed of the joint values.

    Raises:
        ModelError: the model has no stored joint values, or no predictions at them.
    """
    generator = torch.Generator().manual_seed(seed)
    problem = ApproximationProblem(start, *_poses(model, generator), parameters)
    return GeometricApproximation(*solve_approximation(problem), *_poses(model, generator))


def _poses(
    model: CalibratedModel, generator: torch.Generator
) -> tuple[Float64[Tensor, "poses dof"], Float64[Tensor, "poses 4 4"]]:
    """Draw joint values in the calibrated region; return these and the predicted poses."""
    starts = model.starts
    if not len(starts):
        raise ModelError(
            f"model '{model.name}' has no stored joint values, so its calibrated region is not known",
            value=0,
            remedy="train it again",
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
            f"model '{model.name}' has no predictions between its stored joint values",
            value=len(q),
            remedy="train it again",
        )
    return q[usable], T[usable]
