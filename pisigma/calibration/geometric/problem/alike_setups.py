"""The calibration problems of robots of one type with positions of one target each, worked out side by side."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.base_and_tool import CLEAR_FIT
from pisigma.calibration.geometric.initial_guess.base_and_tool_closed_form import (
    LINEAR_ROWS,
    start_from_products,
)
from pisigma.calibration.geometric.initial_guess.initial_guess import GUESS_ROWS
from pisigma.calibration.geometric.problem.motion import MotionMemory
from pisigma.calibration.geometric.problem.parameters import ParameterSpace, Prior
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import (
    Anchors,
    CalibrationSetup,
    SetupOptions,
    build_setup,
    mixed_keys,
)
from pisigma.estimation.loss import AbstractLoss
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.pose import PositionSensor
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.parameter_jacobian import flange_frames
from pisigma.robot.se3 import rotation_from_rpy, transform

TOGETHER = 32
"""Robots that are worked on together, so that their flange poses stay in the processor's cache."""
POSITIONS = frozenset({"q", "position", "sigma_position", "frame", "target", "split", "date"})
"""Fields of rows that hold positions and nothing that rows could repeat one pose under."""


def build_setups(
    robot: Robot,
    data: Sequence[Measurements],
    options: SetupOptions,
    prior: Prior | None,
    loss: AbstractLoss,
) -> list[CalibrationSetup]:
    """State the problems of several robots of one type; see `build_setup` of each.

    Those of robots that were measured in equally many positions, base and tool being looked for, take no longer
    together than a few do apart.

    Args:
        robot: as drawn.
        data: rows of every robot.
        options: what is identified beside the arm, and how.
        prior: of the arm's parameters; None for none.
        loss: how rows count that are far from their prediction.

    Raises:
        IdentificationError: the rows of a robot do not determine what has to be identified.
        PoseError: joint values do not fit the robot.
    """
    setups: dict[int, CalibrationSetup] = {}
    alike: dict[object, list[int]] = {}
    for number, measurements in enumerate(data):
        kind = _kind(measurements, options)
        if kind is not None:
            alike.setdefault(kind, []).append(number)
    for numbers in alike.values():
        robot.check_joint_count(data[numbers[0]].dof)
        for first in range(0, len(numbers), TOGETHER):
            some = numbers[first : first + TOGETHER]
            of_each = _setups_of_positions(robot, [data[number] for number in some], options, prior, loss)
            setups |= {number: one for number, one in zip(some, of_each, strict=True) if one is not None}
    for number, measurements in enumerate(data):
        if number not in setups:
            setups[number] = build_setup(robot, measurements, options, prior, loss)
    return [setups[number] for number in range(len(data))]


@lru_cache(maxsize=16)
def _space_and_tool(robot: Robot, frame: str, target: str) -> tuple[ParameterSpace, Float64[Tensor, "1 3 3"]]:
    """The parameters of a robot and how its tool is turned; remembered, as every fit of its type asks for them."""
    return ParameterSpace(robot, (frame,), (target,)), rotation_from_rpy(torch.tensor(robot.tool[None, 3:]))


def _kind(measurements: Measurements, options: SetupOptions) -> tuple[object, ...] | None:
    """What data sets agree in whose problems can be stated side by side; None of all others."""
    fields = measurements.as_fields()
    names = {*fields.numbers, *fields.texts}
    frames, targets = set(measurements.frame), set(measurements.target)
    plain = names <= POSITIONS and len(frames) == len(targets) == 1
    free = options.free_base and options.free_tool and not options.frames and not options.socket_distances
    if not plain or not free or not LINEAR_ROWS <= measurements.rows <= GUESS_ROWS:
        return None
    values = (measurements.position, measurements.sigma_position)
    if values[0] is None or not all(one is None or math.isfinite(float(one.sum())) for one in values):
        return None
    return (measurements.rows, measurements.dof, *frames, *targets, measurements.q.device)


def _setups_of_positions(
    robot: Robot,
    data: Sequence[Measurements],
    options: SetupOptions,
    prior: Prior | None,
    loss: AbstractLoss,
) -> list[CalibrationSetup | None]:
    """State the problems of robots with one kind of data; None of those that must be looked at one by one.

    That is where poses are repeated, or the closed form does not meet the positions clearly.
    """
    first, like = data[0], data[0].q
    T_base, point, measured, clear = _bases_and_points(robot, data)
    arms = torch.cat([like.new_tensor(robot.dh).flatten(), like.new_zeros(6)]).expand(len(data), -1)
    start = torch.cat([arms, point, torch.zeros_like(point)], 1)
    space, R_tool = _space_and_tool(robot, first.frame[0], first.target[0])
    rows = torch.arange(first.rows, device=like.device)
    common = CalibrationProblem(
        space=space,
        q=like,
        frame=torch.zeros_like(rows),
        target=torch.zeros_like(rows),
        sensors=(),
        loss=loss,
        nominal=start[0],
        precision=torch.from_numpy(space.precision(prior)).to(like.device),
        active=rows[:0],
        prior_sizes=options.prior_sizes,
    )
    everywhere, bases = torch.ones_like(rows, dtype=torch.bool), T_base.cpu()

    def setup(number: int) -> CalibrationSetup:
        """The problem of one robot."""
        rows_of_robot, point = data[number], start[number]
        sensor = PositionSensor(measured[number], everywhere, rows_of_robot.sigma_position)
        problem = replace(common, q=rows_of_robot.q, sensors=(sensor,), nominal=point, memory=MotionMemory())
        anchors = Anchors(bases[number : number + 1], R_tool)
        return CalibrationSetup(problem, point, anchors, rows, {}, [], rows_of_robot)

    return [setup(number) if good else None for number, good in enumerate(clear.tolist())]


def _bases_and_points(
    robot: Robot, data: Sequence[Measurements]
) -> tuple[
    Float64[Tensor, "robots 4 4"],
    Float64[Tensor, "robots 3"],
    Float64[Tensor, "robots 3 rows"],
    Bool[Tensor, " robots"],
]:
    """Find where robots as drawn stand and carry their targets.

    Returns:
        T_frame_base; the point behind the last row [m]; the positions as seen from the base [m]; and for which robots
        the closed form meets the positions clearly and no pose is repeated.
    """
    q = torch.stack([one.q for one in data])
    position = torch.cat([one.position for one in data if one.position is not None]).view(len(data), -1, 3)
    flat = flange_frames(robot, q.view(-1, robot.dof))
    R_flange, p_flange = (torch.unflatten(values, 0, q.shape[:2]) for values in flat)
    R_base, p_base, point = start_from_products(R_flange, p_flange, position)
    arm = p_flange + (R_flange @ point[:, None, :, None])[..., 0]
    missed = (position - (arm @ R_base.mT + p_base[:, None])).square().sum(-1).mean(-1).sqrt()
    repeats = (mixed_keys(q).sort(-1).values.diff(dim=-1) == 0).any(-1)
    measured = ((position - p_base[:, None]) @ R_base).mT.contiguous()
    return transform(R_base, p_base), point, measured, (missed < CLEAR_FIT * robot.reach) & ~repeats
