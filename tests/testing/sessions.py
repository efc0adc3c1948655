"""States of a measuring session of a UR10 with a tracker, for tests."""

import math

import numpy as np
import torch

from pisigma.planning.session.state import (
    AccuracyPoint,
    Advice,
    Alarm,
    JointSpan,
    NextPose,
    RowsSoFar,
    SessionState,
)
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import Box, ReflectorSection, Surroundings, TrackerSection
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

POSES, JUDGED_FROM = 30, 8
"""In the plan; rows from which on base and tool can be worked out."""


def arm_with_tracker(robot: Robot | None = None) -> ArmInSurroundings:
    """Return a robot (default: a UR10) in a cell with all kinds of surroundings."""
    cabinet = Box(name="control <cabinet>", center_mm=(-900, 900, 380), size_mm=(500, 600, 800), yaw_deg=20)
    tracker = TrackerSection(x_mm=2200, y_mm=-1200, z_mm=1100)
    cell = Surroundings(floor_mm=-20, boxes=(cabinet,), tracker=tracker, reflector=ReflectorSection())
    return ArmInSurroundings.from_robot(robot or Robot.load("ur10"), cell)


def planned(arm: ArmInSurroundings) -> np.ndarray:
    """Return joint values `(POSES, dof)` [rad or m] of a plan."""
    return np.random.default_rng(1).uniform(-1.5, 1.5, (POSES, arm.robot.dof))


def session_state(arm: ArmInSurroundings, rows: int, wrong: int | None = None) -> SessionState:
    """Return a session after some rows, every sixth of which is a test row.

    Args:
        arm: the robot.
        rows: number of rows.
        wrong: index of a row that is 5 mm off.
    """
    plan, kept = planned(arm), JUDGED_FROM if rows < JUDGED_FROM else 0
    q = plan[:rows]
    position = forward_kinematics(arm.robot, torch.from_numpy(q))[:, :3, 3].numpy().copy()
    error = np.random.default_rng(2).normal(size=(POSES, 3))[:rows] * 1e-4
    position[:kept] = error[:kept] = math.nan
    alarmed = np.arange(rows) == (-1 if wrong is None else wrong)
    error[alarmed] = 0.003, -0.004, 0.0
    said = "the position is off by 5 mm where 0.3 mm is expected; measure it again."
    alarms = tuple(
        Alarm(row + 2, "off", f"line {row + 2}: {said}", True) for row in np.flatnonzero(alarmed).tolist()
    )
    more = NextPose(rows + 1, POSES, plan[rows], is_test_pose=rows % 6 == 5) if rows < POSES else None
    measure = Advice("measure", "Measure the next pose: the limit of 0.15 mm is not reached yet.")
    return SessionState(
        rows=RowsSoFar(tuple(range(2, rows + 2)), q, position, error, np.arange(rows) % 6 == 5, alarmed),
        alarms=alarms,
        next_pose=more,
        remaining=plan[rows:],
        coverage=tuple(JointSpan(joint.name, -1.0, 1.0, 0.7) for joint in arm.robot.joints) if rows else (),
        reached_accuracy=tuple(_point(poses) for poses in range(JUDGED_FROM, rows + 1, 4)),
        expected_accuracy=tuple(_point(poses, 1.5) for poses in range(max(rows, JUDGED_FROM), POSES + 1, 4)),
        advice=measure if more else Advice("stop", "Stop: the limit is reached."),
        revolute=arm.robot.revolute,
    )


def _point(poses: int, random: float = math.nan) -> AccuracyPoint:
    rms = 1e-3 / math.sqrt(poses)
    validated = 1.2 * rms if math.isnan(random) else math.nan
    return AccuracyPoint(poses, rms, 1.7 * rms, validated, 1.7 * validated, random * rms)
