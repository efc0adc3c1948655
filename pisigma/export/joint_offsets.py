"""Joint offsets alone: the most that a controller can take which knows nothing but its zero positions."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import ModelError
from pisigma.export.offset_fit import OffsetProblem, solve_offsets
from pisigma.kinematics.forward import forward_kinematics
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.se3 import rotation_vector

POSES = 1_000
"""Poses that the offsets are fitted to, and as many others that they are judged by."""


@dataclass(frozen=True)
class Departure:
    """How far a robot's tool is from where the whole model has it.

    Attributes:
        mean: of the distances [m].
        p95: their 95 % quantile [m].
        maximum: the largest [m].
        mean_angle: mean angle between the two rotations [rad].
    """

    mean: float
    p95: float
    maximum: float
    mean_angle: float

    def in_file_units(self) -> dict[str, float]:
        """mean_mm, p95_mm, max_mm, mean_mrad."""
        return {
            "mean_mm": self.mean * 1e3,
            "p95_mm": self.p95 * 1e3,
            "max_mm": self.maximum * 1e3,
            "mean_mrad": self.mean_angle * 1e3,
        }


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """The robot as drawn with the joint offsets, base and tool that come nearest to a model.

    Attributes:
        robot: as drawn but for theta of turning and d of sliding joints, base and tool.
        values: per joint [rad or m], as the controller counts: the real robot commanded to q stands where the
            drawn one stands at q + offset.
        unobservable: joints whose offset is 0 because base or tool take the same in.
        lost: what is given up: departure from the whole model.
        nominal: the departure of the robot as drawn, with the model's base and tool, for comparison.
    """

    robot: Robot
    values: Float64[np.ndarray, " dof"]
    unobservable: tuple[str, ...]
    lost: Departure
    nominal: Departure


def fit_joint_offsets(model: CalibratedModel, seed: int = 0) -> JointOffsets:
    """Fit joint offsets, base and tool of the robot as drawn to a model by least squares.

    An angle counts as much as the distance that it makes at half the robot's reach.

    The poses are those of the model over the region that it was calibrated in: at its stored joint values and
    between random two of them. The figures are of other poses than were fitted.

    Args:
        model: the model.
        seed: of the draw.

    Raises:
        ModelError: the model stores no joint values, or predicts none of their poses.
    """
    generator = torch.Generator().manual_seed(seed)
    fitted, seen = solve_offsets(OffsetProblem(model.robot, *_poses(model, generator)))
    q, T = _poses(model, generator)
    return JointOffsets(
        robot=fitted,
        values=_offsets(model.robot, fitted),
        unobservable=tuple(j.name for j, known in zip(model.robot.joints, seen, strict=True) if not known),
        lost=_departure(forward_kinematics(fitted, q), T),
        nominal=_departure(forward_kinematics(model.robot, q), T),
    )


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
    known = torch.isfinite(T).flatten(1).all(-1)
    if model.network is not None and model.domain is not None:
        with torch.no_grad():
            known &= model.domain.contains(model.network.scaled_inputs(T, q))
    if not known.any():
        raise ModelError(
            f"model {model.name} predicts no pose between the joint values that it stores; train it again."
        )
    return q[known], T[known]


def _offsets(nominal: Robot, fitted: Robot) -> Float64[np.ndarray, " dof"]:
    found = [
        joint.direction * (fitted.dh[row] - nominal.dh[row])[0 if joint.type == "revolute" else 1]
        for joint, row in zip(nominal.joints, nominal.joint_rows, strict=True)
    ]
    return np.array(found)


def _departure(T: Float64[Tensor, "poses 4 4"], T_model: Float64[Tensor, "poses 4 4"]) -> Departure:
    distance = (T[:, :3, 3] - T_model[:, :3, 3]).norm(dim=-1)
    angle = rotation_vector(T[:, :3, :3].mT @ T_model[:, :3, :3]).norm(dim=-1)
    return Departure(
        mean=float(distance.mean()),
        p95=float(distance.quantile(0.95)),
        maximum=float(distance.max()),
        mean_angle=float(angle.mean()),
    )
