"""Simulated measurements of an arm with known errors, for tests."""

from dataclasses import dataclass

import numpy as np
import torch

from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector

BASE = np.array([0.4, -0.7, 0.3, 2.0, 0.5, -1.0])
TOOL = np.array([0.06, -0.04, 0.13, 0.4, -0.3, 0.8])


@dataclass(frozen=True, eq=False)
class SimulatedArm:
    """The nominal robot, the true one and its measurements."""

    nominal: Robot
    true: Robot
    measurements: Measurements


def draw_joints(robot: Robot, rows: int, rng: np.random.Generator) -> torch.Tensor:
    """Draw joint values [rad or m], uniform over the limits, at most one turn."""
    limits = np.clip(robot.limits, -np.pi, np.pi)
    return torch.from_numpy(rng.uniform(limits[:, 0], limits[:, 1], (rows, robot.dof)))


def dh_errors(robot: Robot, length: float, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Draw normal errors of all DH parameters, with standard deviations in m and rad."""
    return rng.normal(size=robot.dh.shape) * np.array([angle, length, length, angle, angle])


def simulate(
    name: str,
    seed: int = 0,
    rows: int = 100,
    noise: float = 0.0,
    turn_noise: float | None = None,
    length: float = 5e-4,
    angle: float = 1e-3,
    wrong: float = 0.0,
    offset: float = 0.0,
    base: np.ndarray = BASE,
    tool: np.ndarray = TOOL,
) -> SimulatedArm:
    """Measure random poses of a robot with random errors.

    Args:
        name: catalogue name.
        seed: random seed.
        rows: number of poses.
        noise: standard deviation of a measured coordinate [m].
        turn_noise: standard deviation of a measured angle [rad]; None for no rotations.
        length: standard deviation of the length errors [m].
        angle: standard deviation of the angle errors [rad].
        wrong: fraction of the rows with an additional error of 3 mm per axis.
        offset: additional error of every joint zero [rad], with random sign.
        base: base of the true robot.
        tool: tool of the true robot.
    """
    rng = np.random.default_rng(seed)
    nominal = Robot.load(name)
    dh = nominal.dh + dh_errors(nominal, length, angle, rng)
    dh[:, 0] += offset * np.random.default_rng([seed, 1]).choice([-1, 1], len(dh))
    true = nominal.with_geometry(dh=dh, base=base, tool=tool)
    q = draw_joints(nominal, rows, rng)
    T = forward_kinematics(true, q)
    position = T[:, :3, 3] + noise * torch.from_numpy(rng.normal(size=(rows, 3)))
    bad = rng.permutation(rows)[: round(wrong * rows)]
    position[bad] += 3e-3 * torch.from_numpy(rng.normal(size=(len(bad), 3)))
    rotation = None
    if turn_noise is not None:
        rotation = (
            rotation_from_vector(turn_noise * torch.from_numpy(rng.normal(size=(rows, 3)))) @ T[:, :3, :3]
        )
    return SimulatedArm(nominal, true, Measurements(q=q, position=position, rotation=rotation))


def mean_error(calibrated: Robot, true: Robot, rows: int = 2000, seed: int = 99) -> float:
    """Compute the mean distance of predicted and true positions at new random poses [m]."""
    q = draw_joints(true, rows, np.random.default_rng(seed))
    difference = forward_kinematics(calibrated, q) - forward_kinematics(true, q)
    return float(difference[:, :3, 3].norm(dim=-1).mean())
