"""Measurements that a sensor would make on the true robot."""

from typing import Literal

import torch
from jaxtyping import Float64
from pydantic import model_validator
from torch import Tensor

from pisigma.errors import RecipeError
from pisigma.kinematics.joint_limits import turn_into_limits
from pisigma.measurement.dataset import Measurements
from pisigma.simulation.branch import BranchSection
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.poses import WhereToMeasure
from pisigma.simulation.random_joints import JointsRandom
from pisigma.simulation.true_robot import TrueRobot
from pisigma.yaml_file import Section


class SimulatedMeasurements(Section):
    """The part of a recipe that states what is measured on the true robot.

    Attributes:
        poses: wanted poses, or joint values to command.
        branch: on which branch wanted poses are reached; not for joint values.
        sensor: "pose" (position and orientation) or "position".
        noise: of the sensor; left out, it measures exactly.
    """

    poses: WhereToMeasure
    branch: BranchSection | None = None
    sensor: Literal["pose", "position"] = "pose"
    noise: MeasurementNoise | None = None

    @model_validator(mode="after")
    def _branch_for_poses(self) -> "SimulatedMeasurements":
        if isinstance(self.poses, JointsRandom) != (self.branch is None):
            raise ValueError(
                "wanted poses need a branch, but none is stated"
                if self.branch is None
                else "joints_random commands joint values and has no branch; remove it"
            )
        return self

    def measure(self, robot: TrueRobot) -> Measurements:
        """Simulate the measurements, the same at every call. See `simulate`."""
        if isinstance(self.poses, JointsRandom):
            q = self.poses.joints(robot.nominal)
        else:
            assert self.branch is not None  # the section's validator sees to it
            T = self.poses.transforms()
            q = joints_for_poses(robot, T, self.branch.start(robot.nominal, T))
        return simulate(robot, q, self.sensor, self.noise)


def joints_for_poses(
    robot: TrueRobot, T: Float64[Tensor, "poses 4 4"], start: Float64[Tensor, "poses dof"]
) -> Float64[Tensor, "poses dof"]:
    """Joint values to command so that the true robot takes wanted poses.

    Encoder steps are left out here: the joint values are those that would reach the poses exactly, and with
    an encoder the robot stops at the nearest pulse, so what is measured there is a little off the wanted
    pose.

    Args:
        robot: the true robot.
        T: T_base_tool wanted.
        start: joint values [rad or m] near the solution.

    Raises:
        UnreachablePoseError: the true robot does not reach a pose near its start.
        RecipeError: joint values would have to leave the limits of the robot.
    """
    q, inside = turn_into_limits(robot.nominal, robot.without_encoder().inverse(T, start))
    if not inside.all():
        outside = (~inside).nonzero()
        raise RecipeError(
            f"simulation: wanted pose {int(outside[0])} (counted from 0; {len(outside)} of {len(T)} poses) "
            f"needs joint values outside the limits of robot '{robot.nominal.name}'; "
            "change the region of the poses or the branch."
        )
    return q


def simulate(
    robot: TrueRobot,
    q: Float64[Tensor, "rows dof"],
    sensor: Literal["pose", "position"] = "pose",
    noise: MeasurementNoise | None = None,
) -> Measurements:
    """Command joint values and measure where the true robot takes its tool.

    Args:
        robot: the true robot.
        q: commanded joint values [rad or m], as the controller counts.
        sensor: whether the orientation is measured too. The sensor's frame is the robot's base frame.
        noise: of the sensor; None measures exactly.

    Returns:
        One row per commanded joint vector, with the standard deviations of the noise where there is any.

    Raises:
        PoseError: q has another number of columns than the robot has joints.
    """
    T = robot.forward(q)
    T = T if noise is None else noise.apply(T)
    pose = sensor == "pose"
    return Measurements(
        q=q,
        position=T[:, :3, 3].clone(),
        rotation=T[:, :3, :3].clone() if pose else None,
        sigma_position=_sigma(q, 0.0 if noise is None else noise.sigma_position),
        sigma_rotation=_sigma(q, noise.sigma_rotation if noise is not None and pose else 0.0),
        source=f"simulation of {robot.nominal.name}",
    )


def _sigma(q: Float64[Tensor, "rows dof"], sigma: float) -> Float64[Tensor, " rows"] | None:
    return torch.full((len(q),), sigma, dtype=q.dtype, device=q.device) if sigma else None
