"""Two simulated UR5s that were measured in shared frames, or whose balls sat in the same sockets."""

from collections.abc import Sequence

import numpy as np
import torch
from testing.stored import stored

from pisigma.calibration.frames.shared_objects import ArmPosterior, Touches, uncertainty_of
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.estimation.loss import SquaredLoss
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform

UR5 = Robot.load("ur5")
FREE = ("theta_2", "theta_3", "theta_4", "theta_5")
"""Parameters of the arms that have errors: joint zeros."""
NOISE = 5e-5
TOOL = np.array([0.05, -0.03, 0.15, 0.0, 0.0, 0.0])
TIP = np.array([-0.02, 0.04, 0.12, 0.0, 0.0, 0.0])
BASES = (np.zeros(6), np.array([1.1, 0.1, 0.05, 2.8, 0.1, -0.2]))
"""Bases of the arms in the base of the first one."""
FRAMES = {"hall": np.array([0.6, -0.5, 0.0, 0.4, 0.0, 0.1]), "jig": np.array([0.5, 0.3, 0.2, -0.3, 0.1, 0.0])}
"""Poses of frames in the base of the first arm."""


def pose_of(xyz_zyx: np.ndarray) -> torch.Tensor:
    """Return a transform."""
    return transform_from_xyz_zyx(torch.from_numpy(xyz_zyx))


def true_arm(number: int, seed: int, frame: str = "") -> Robot:
    """Return an arm with errors of its free parameters and, in a frame, with its base there."""
    rng = np.random.default_rng([seed, number])
    values = UR5.dh.copy()
    for name in FREE:
        values[int(name[-1]) - 1, 0] += rng.normal(0, 5e-4)
    base = np.zeros(6)
    if frame:
        base = xyz_zyx_from_transform(invert(pose_of(FRAMES[frame])) @ pose_of(BASES[number])).numpy()
    return UR5.with_geometry(values, base=base, tool=TOOL)


def measured_positions(
    number: int, seed: int, frames: Sequence[str] = tuple(FRAMES), rows: int = 30
) -> Measurements:
    """Return measured positions of an arm, with the same number of rows in every frame."""
    rng = np.random.default_rng([seed, number, 1])
    q = torch.from_numpy(rng.uniform(-2.2, 2.2, (rows * len(frames), 6)))
    parts = [
        forward_kinematics(true_arm(number, seed, frame), part)[:, :3, 3]
        for frame, part in zip(frames, torch.split(q, rows), strict=True)
    ]
    position = torch.cat(parts) + torch.from_numpy(rng.normal(0, NOISE, (len(q), 3)))
    return Measurements(q=q, position=position, frame=tuple(f for f in frames for _ in range(rows)))


def socket_positions(count: int) -> torch.Tensor:
    """Return positions of sockets between the arms, in the base of the first one [m]."""
    corner = np.random.default_rng(5).uniform([0.4, -0.25, -0.1], [0.7, 0.3, 0.3], (count, 3))
    return torch.from_numpy(corner)


def reached(number: int, robot: Robot, wanted: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Return joint values of an arm whose tool is at points in the base of the first arm, with noise."""
    there = invert(pose_of(BASES[number]))
    wanted = wanted @ there[:3, :3].mT + there[:3, 3]
    q = torch.from_numpy(np.array([0, -1.5, 1.5, 0, 1.5, 0]) + rng.uniform(-1, 1, (len(wanted), 6)))
    noise = torch.from_numpy(rng.normal(0, NOISE, wanted.shape))
    q[:, 0] = torch.atan2(wanted[:, 1], wanted[:, 0]) + np.pi
    for _ in range(60):
        T, J = joint_jacobian(robot, q)
        step = torch.linalg.pinv(J[:, :3]) @ (wanted + noise - T[:, :3, 3])[..., None]
        q = q + step[..., 0].clamp(-0.3, 0.3)
    assert float((forward_kinematics(robot, q)[:, :3, 3] - wanted - noise).norm(dim=1).max()) < 1e-9
    return q


def socket_rows(number: int, seed: int, sockets: int = 6, touches: int = 8) -> Measurements:
    """Return joint values of an arm whose ball sits in sockets, each in several postures."""
    rng = np.random.default_rng([seed, number, 2])
    wanted = socket_positions(sockets).repeat_interleave(touches, 0)
    q = reached(number, true_arm(number, seed), wanted, rng)
    return Measurements(q=q, socket=tuple(f"plate/{k}" for k in range(sockets) for _ in range(touches)))


def touching_rows(number: int, seed: int, tip: str = "", touches: int = 20) -> Measurements:
    """Return the rows of an arm in which its tip touched that of the other arm.

    Args:
        number: the arm.
        seed: seed of the arms, as in `true_arm`.
        tip: name of the tip, which is at `TIP`; "" for the target of the other rows, at `TOOL`.
        touches: number of touches.
    """
    robot = true_arm(number, seed).with_geometry(tool=TIP if tip else TOOL)
    q = reached(number, robot, socket_positions(touches), np.random.default_rng([seed, number, 4]))
    return Measurements(
        q=q,
        socket=tuple(f"touch {k}" for k in range(touches)),
        target=(tip,) * touches,
        sigma_position=torch.full((touches,), NOISE, dtype=torch.float64),
    )


@stored
def own_fit(number: int, seed: int, sensor: str) -> CalibrationResult:
    """Return the calibration of one arm with its own rows: "frames", "hall" or "sockets"."""
    rows = (
        socket_rows(number, seed)
        if sensor == "sockets"
        else measured_positions(number, seed, tuple(FRAMES) if sensor == "frames" else (sensor,))
    )
    return GeometricCalibrator(UR5, free=FREE, prior=None, loss=SquaredLoss(), tool="position").fit(rows)


def posterior(name: str, fit: CalibrationResult, touching: Measurements | None = None) -> ArmPosterior:
    """Return the posterior of an arm."""
    touches = None if touching is None else Touches.from_measurements(touching, touching.q)
    return ArmPosterior(name, uncertainty_of(fit), touches)


def posteriors(seed: int, sensor: str) -> tuple[ArmPosterior, ArmPosterior]:
    """Return the posteriors of both arms."""
    left, right = (posterior(name, own_fit(k, seed, sensor)) for k, name in enumerate(("left", "right")))
    return left, right


def rows_now(number: int, seed: int, bump: torch.Tensor, body: str, rows: int = 8) -> Measurements:
    """Return new positions of an arm in the frame "hall", after a motion in the base of the first arm.

    Args:
        number: the arm.
        seed: seed of the arms, as in `true_arm`.
        bump: the motion, a transform.
        body: what moved: "left", "right" or "hall".
        rows: number of positions.
    """
    rng = np.random.default_rng([seed, number, 3])
    base, hall = pose_of(BASES[number]), pose_of(FRAMES["hall"])
    base = bump @ base if body == ("left", "right")[number] else base
    hall = bump @ hall if body == "hall" else hall
    moved = true_arm(number, seed).with_geometry(base=xyz_zyx_from_transform(invert(hall) @ base).numpy())
    q = torch.from_numpy(rng.uniform(-2.2, 2.2, (rows, 6)))
    position = forward_kinematics(moved, q)[:, :3, 3] + torch.from_numpy(rng.normal(0, NOISE, (rows, 3)))
    return Measurements(q=q, position=position, frame=("hall",) * rows)
