"""A simulated torso with two arms of six joints, whose tools were measured in one frame."""

from pathlib import Path

import numpy as np
import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.estimation.loss import SquaredLoss
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

ARMS, TORSO = ("left", "right"), ("waist", "chest")
IN_HALL = np.array([0.4, -0.7, 0.1, 0.5, 0.05, -0.1])
"""Base of the torso in the frame "hall"."""
TOOL = np.array([0.05, -0.03, 0.12, 0.0, 0.0, 0.0])
NOISE = 5e-5
_LINKS = (("0 0 0", "0 0 1"), ("0 0.1 0.1", "0 1 0"), ("0 0 0.4", "0 1 0"), ("0 0 0.35", "0 1 0"))
_WRIST = (("0 0.1 0", "0 0 1"), ("0 0 0.1", "0 1 0"))


def torso_urdf(joints: int = 1) -> str:
    """Return a URDF tree: a waist that turns, with 2 joints a chest that bends, and a left and a right arm."""
    text, parent = '<robot name="torso"><link name="root"/>\n', "root"

    def joint(name: str, parent: str, xyz: str, rpy: str, axis: str) -> str:
        return (
            f'<link name="{name}_link"/><joint name="{name}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="{parent}"/><child link="{name}_link"/><axis xyz="{axis}"/>'
            '<limit lower="-3.2" upper="3.2" effort="1" velocity="1"/></joint>\n'
        )

    for name, xyz, axis in (("waist", "0 0 0.3", "0 0 1"), ("chest", "0.05 0 0.2", "0 1 0"))[:joints]:
        text += joint(name, parent, xyz, "0 0 0", axis)
        parent = f"{name}_link"
    for side, y, roll in (("left", 0.2, -0.9), ("right", -0.2, 0.9)):
        link = parent
        for number, (xyz, axis) in enumerate((*_LINKS, *_WRIST)):
            place = (f"0.02 {y} 0.3", f"{roll} 0.1 0") if number == 0 else (xyz, "0 0 0")
            text += joint(f"{side}_{number + 1}", link, *place, axis)
            link = f"{side}_{number + 1}_link"
    return text + "</robot>\n"


def nominal_arms(folder: Path, joints: int = 1) -> tuple[Robot, Robot]:
    """Return both arms, with their URDF file in a folder."""
    path = folder / "torso.urdf"
    path.write_text(torso_urdf(joints))
    left, right = (Robot.load(path, tip=f"{side}_6_link") for side in ARMS)
    return left, right


def true_arm(arms: tuple[Robot, Robot], number: int, seed: int, joints: int, zero: float = 0.0) -> Robot:
    """Return an arm with errors of 0.5 mm and 0.5 mrad of all DH parameters, equal before the last shared joint.

    Args:
        arms: nominal arms.
        number: index of the arm.
        seed: seed of the errors.
        joints: number of shared joints.
        zero: error of the zero of the waist [rad].
    """
    own, common = np.random.default_rng([seed, number]), np.random.default_rng([seed, 2])
    dh = arms[number].dh.copy()
    dh[:, :4] += own.normal(0, 5e-4, (len(dh), 4))
    dh[: joints - 1] = arms[0].dh[: joints - 1]
    dh[: joints - 1, :4] += common.normal(0, 5e-4, (joints - 1, 4))
    dh[0, 0] += zero
    return arms[number].with_geometry(dh, base=IN_HALL, tool=TOOL)


def measured_rows(robot: Robot, seed: int, rows: int = 60) -> Measurements:
    """Return measured positions of an arm in the frame "hall"."""
    rng = np.random.default_rng([seed, 3])
    q = torch.from_numpy(rng.uniform(-2.2, 2.2, (rows, robot.dof)))
    position = forward_kinematics(robot, q)[:, :3, 3] + torch.from_numpy(rng.normal(0, NOISE, (rows, 3)))
    return Measurements(q=q, position=position, frame=("hall",) * rows)


def own_fit(nominal: Robot, rows: Measurements) -> CalibrationResult:
    """Return the calibration of an arm with its own rows."""
    return GeometricCalibrator(nominal, prior=None, loss=SquaredLoss(), tool="position").fit(rows)
