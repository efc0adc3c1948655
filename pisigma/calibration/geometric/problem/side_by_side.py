"""Problems of several robots of one type as one problem."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch

from pisigma.calibration.geometric.problem.motion import MotionMemory
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.measurement.sensors.pose import PositionSensor, RotationSensor
from pisigma.measurement.sensors.sensor import AbstractSensor
from pisigma.robot.kinematics.parameter_jacobian import JACOBIAN_CHUNK

MOST_ROWS = 28_672
"""Rows of robots that stand side by side. The derivatives of a position by the parameters of six joints take 1.1 kB a
row and are kept from step to step; what a tensor of up to 32 MB gives back, glibc keeps for the next one."""


def batches(robots: Sequence[int], rows: int) -> Iterator[Sequence[int]]:
    """Split robots with so many rows each into those that stand side by side."""
    most = max(MOST_ROWS // max(rows, 1), 1)
    for first in range(0, len(robots), most):
        yield robots[first : first + most]


def pattern_of(problem: CalibrationProblem) -> tuple[object, ...] | None:
    """Return what problems of robots of one type agree in that may stand side by side; None where none may."""
    poses = all(isinstance(sensor, PositionSensor | RotationSensor) for sensor in problem.sensors)
    if problem.space.unknowns or problem.pairs or not poses or problem.rows > JACOBIAN_CHUNK:
        return None
    kinds = [(one.name, one.sigma is None, tuple(one.present.tolist())) for one in problem.sensors]
    repeats = (problem.pose is None, problem.configuration is None)
    return (problem.space.frames, problem.space.targets, problem.rows, *repeats, *kinds, problem.q.device)


def side_by_side(problems: Sequence[CalibrationProblem]) -> CalibrationProblem:
    """Return the problem of several robots, of problems with one pattern and the same free parameters."""
    first = problems[0]
    rows: dict[str, Any] = {}
    for name in ("q", "frame", "target", "pose", "configuration"):
        if getattr(first, name) is not None:
            rows[name] = torch.cat([getattr(problem, name) for problem in problems])
    of_sensors = zip(*(problem.sensors for problem in problems), strict=True)
    return replace(
        first,
        **rows,
        sensors=tuple(AbstractSensor.joined(sensors) for sensors in of_sensors),
        nominal=torch.stack([problem.nominal for problem in problems]),
        stated={},
        memory=MotionMemory(),
    )
