"""From measurements to a calibration problem with a start: nothing is guessed by the user."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.identification.base_and_tool import BaseToolFit, fit_base_and_tool
from pisigma.identification.loss import AbstractLoss
from pisigma.identification.noise import renumbered
from pisigma.identification.parameters import ParameterSpace, Prior
from pisigma.identification.problem import CalibrationProblem
from pisigma.identification.sensors import AbstractSensor, PositionSensor, RotationSensor
from pisigma.identification.sufficiency import check_poses
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.se3 import invert, rotation_from_rpy, transform_from_xyzrpy

START_ROWS = 1_024
"""Rows that base and tool start from."""
START_STEPS = 2
"""Steps by which their closed-form start is polished."""


@dataclass(frozen=True, eq=False)
class Anchors:
    """Where base and tool started; parameters are changes from there, so no angle nears its singularity.

    Attributes:
        bases: per frame, what stands before the base of the problem: `base = anchor · base_of_problem`.
        tools: per target, what stands behind the tool's rotation: `R_tool = R_of_problem · anchor`.
    """

    bases: Float64[Tensor, "frames 4 4"]
    tools: Float64[Tensor, "targets 3 3"]


@dataclass(frozen=True, eq=False)
class CalibrationSetup:
    """A problem ready to be solved.

    Attributes:
        problem: with no parameter free yet.
        start: values of all parameters.
        anchors: what base and tool are relative to.
        rows: which rows of the measurements the problem has.
    """

    problem: CalibrationProblem
    start: Float64[Tensor, " parameters"]
    anchors: Anchors
    rows: Tensor


def build_setup(
    robot: Robot,
    measurements: Measurements,
    free_base: bool,
    free_tool: bool,
    prior: Prior | None,
    loss: AbstractLoss,
) -> CalibrationSetup:
    """Fit base and tool, and state the problem relative to them.

    Raises:
        IdentificationError: nothing usable was measured, or too little for base and tool.
        PoseError: the joint values do not fit the robot.
    """
    robot.check_joint_count(measurements.q.shape[1])
    rows, measurements = _usable(measurements)
    frames = tuple(dict.fromkeys(measurements.frame))
    targets = tuple(dict.fromkeys(measurements.target))
    space = ParameterSpace(robot, frames, targets)
    frame, target = _numbers(measurements.frame, frames), _numbers(measurements.target, targets)
    fits = {
        name: fit_base_and_tool(
            robot, _part(measurements, frame == number), free_base, free_tool, START_STEPS
        )
        for number, name in enumerate(frames)
    }
    anchors, start = _start(space, fits, free_base, free_tool)
    start = start.to(measurements.q.device)
    problem = CalibrationProblem(
        space=space,
        q=measurements.q,
        frame=frame.to(start.device),
        target=target.to(start.device),
        sensors=_sensors(measurements, anchors, frame, target),
        loss=loss,
        nominal=start,
        precision=torch.from_numpy(space.precision(prior)).to(start.device),
        active=torch.zeros(0, dtype=torch.int64, device=start.device),
        pose=repeated_poses(measurements.q, frame.to(start.device), target.to(start.device)),
    )
    return CalibrationSetup(problem, start, anchors, rows)


def _usable(measurements: Measurements) -> tuple[Tensor, Measurements]:
    """The rows in which something was seen."""
    if measurements.position is None:
        raise IdentificationError(
            f"{measurements.source}: measured positions or poses were wanted, but there are none; "
            "give the columns x_mm, y_mm, z_mm."
        )
    seen = torch.isfinite(measurements.position).all(-1)
    if measurements.rotation is not None:
        seen = seen | torch.isfinite(measurements.rotation).flatten(1).all(-1)
    rows = seen.nonzero()[:, 0]
    if len(rows) == 0:
        raise IdentificationError(
            f"{measurements.source}: none of its {len(seen)} rows has a measured value; measure positions "
            "or poses."
        )
    chosen = measurements.select(rows) if len(rows) < len(seen) else measurements
    check_poses(chosen)
    return rows, chosen


def _numbers(names: tuple[str, ...], order: tuple[str, ...]) -> Tensor:
    numbers = {name: number for number, name in enumerate(order)}
    return torch.tensor([numbers[name] for name in names], dtype=torch.int64)


def chosen_rows(rows: int, most: int) -> Int64[Tensor, " chosen"]:
    """All rows, or so many of them in a random order that is always the same."""
    if rows <= most:
        return torch.arange(rows)
    return torch.randperm(rows, generator=torch.Generator().manual_seed(0))[:most]


def _part(measurements: Measurements, chosen: Tensor) -> Measurements:
    """The chosen rows, or enough of them for a start."""
    if bool(chosen.all()) and len(chosen) <= START_ROWS:
        return measurements
    rows = chosen.nonzero()[:, 0]
    return measurements.select(rows[chosen_rows(len(rows), START_ROWS).to(rows.device)])


def repeated_poses(q: Tensor, frame: Tensor, target: Tensor) -> Tensor | None:
    """Number every row's pose (joint values to 1e-9, frame, target); None where none is repeated."""
    keys = torch.stack([*(q * 1e9).round().long().unbind(1), frame, target])
    mixed = torch.zeros_like(frame)
    for key in keys:  # integers wrap around, so equal rows mix equally
        mixed = mixed * 6_364_136_223_846_793_005 + key * 1_442_695_040_888_963_407
    found = renumbered(mixed)
    return None if int(found.max()) + 1 == len(q) else found


def _start(
    space: ParameterSpace, fits: dict[str, BaseToolFit], free_base: bool, free_tool: bool
) -> tuple[Anchors, Float64[Tensor, " parameters"]]:
    """Bases start at their anchor, tools at their place, turned like their anchor; what is fixed has none."""
    robot = space.robot
    bases, tools = np.tile(robot.base, (len(space.frames), 1)), np.tile(robot.tool, (len(space.targets), 1))
    anchors = Anchors(
        torch.eye(4).double().repeat(len(bases), 1, 1), torch.eye(3).double().repeat(len(tools), 1, 1)
    )
    if free_base:
        found = np.stack([fits[name].robot.base for name in space.frames])
        anchors = Anchors(transform_from_xyzrpy(torch.from_numpy(found)), anchors.tools)
        bases = np.zeros_like(bases)
    if free_tool:
        known = {name: tool for fit in reversed(fits.values()) for name, tool in fit.tools.items()}
        tools = np.stack([known.get(name, robot.tool) for name in space.targets])
        anchors = Anchors(anchors.bases, rotation_from_rpy(torch.from_numpy(tools[:, 3:])))
        tools[:, 3:] = 0
    return anchors, space.values(bases, tools)


def _sensors(
    measurements: Measurements, anchors: Anchors, frame: Tensor, target: Tensor
) -> tuple[AbstractSensor, ...]:
    """The measured values, seen from the bases' anchors and freed of the tools' anchors."""
    assert measurements.position is not None
    Ts = invert(anchors.bases).to(measurements.q.device)[frame]
    R_anchor = Ts[:, :3, :3]
    position = (R_anchor @ measurements.position[..., None])[..., 0] + Ts[:, :3, 3]
    seen = torch.isfinite(position).all(-1)
    sigma = _sigma(measurements, measurements.sigma_position, seen, "sigma_mm")
    sensors: list[AbstractSensor] = [
        PositionSensor(torch.where(seen, position.t(), 0.0).contiguous(), seen, sigma)
    ]
    if measurements.rotation is not None:
        rotation = R_anchor @ measurements.rotation @ anchors.tools.to(R_anchor.device)[target].mT
        seen = torch.isfinite(rotation).flatten(1).all(-1)
        eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        rotation = torch.where(seen[:, None, None], rotation, eye).permute(1, 2, 0).contiguous()
        sigma = _sigma(measurements, measurements.sigma_rotation, seen, "sigma_deg")
        if bool(seen.any()):
            sensors.append(RotationSensor(rotation, seen, sigma))
    return tuple(sensors)


def _sigma(measurements: Measurements, sigma: Tensor | None, seen: Tensor, column: str) -> Tensor | None:
    """Standard deviations of the rows, all or none."""
    if sigma is None or not bool(torch.isfinite(sigma[seen]).any()):
        return None
    lacking = seen & ~torch.isfinite(sigma)
    if bool(lacking.any()):
        row = int(lacking.nonzero()[0, 0])
        raise IdentificationError(
            f"{measurements.source}: {column} is given in some rows but not in {measurements.place(row)}; "
            "give it in every row or in none, then it is estimated."
        )
    return sigma
