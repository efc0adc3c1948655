"""Where everything but the arm starts: bases, tools, sockets and anchors."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.identification.initial_guess.base_and_tool import find_base_and_tool
from pisigma.identification.initial_guess.base_and_tool_closed_form import base_by_points
from pisigma.identification.initial_guess.frames import (
    check_frame_names,
    check_frame_values,
    check_touched_base,
    touched_base,
)
from pisigma.identification.initial_guess.points import (
    anchor_from_distances,
    check_pairs,
    check_sockets,
    check_wire,
    means,
    tool_from_sockets,
)
from pisigma.identification.problem.parameters import ParameterSpace
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.se3 import rpy_from_rotation, transform_from_xyzrpy
from pisigma.sensors.building import names_of, numbers_of

START_ROWS = 1_024
"""Rows that base and tool start from."""
START_STEPS = 2
"""Steps by which their closed-form start is polished."""
FEW = 9
"""Positions below which a frame's base starts from tools that other frames told, not from tools of its own."""
ENOUGH = 5
"""Positions in a touched frame from which base and tool are found in closed form."""


@dataclass(frozen=True, eq=False)
class Start:
    """Starting values in the user's coordinates.

    Attributes:
        bases: per frame, x, y, z [m], roll, pitch, yaw [rad].
        tools: per target, the same.
        sockets: per socket, its place in its frame [m].
        anchors: per anchor, its place in its frame and its zero [m].
        places_known: per anchor, whether the measurements tell its place.
    """

    bases: Float64[np.ndarray, "frames 6"]
    tools: Float64[np.ndarray, "targets 6"]
    sockets: Float64[np.ndarray, "sockets 3"]
    anchors: Float64[np.ndarray, "anchors 4"]
    places_known: tuple[bool, ...]


def find_start(
    space: ParameterSpace,
    measurements: Measurements,
    free_base: bool,
    free_tool: bool,
    turn_tool: bool,
    given: Mapping[str, tuple[float, ...]],
) -> Start:
    """Find where everything starts, the arm being taken as drawn.

    Frames with positions get base and tool in closed form; then sockets tell the tools that are not known yet;
    touches tell their frame by the tool; sockets start at the mean of the tool's places, anchors by
    multilateration. A frame without any of these (sockets and unknown anchors only) starts at the robot's own
    base, which it cannot tell.

    Args:
        space: names and robot.
        measurements: usable rows.
        free_base: whether bases are to be found; else they are as given, or the robot's.
        free_tool: whether tools are.
        turn_tool: whether their rotations are.
        given: bases of frames, where the user gives them.

    Raises:
        IdentificationError: too little was measured for a start, or something that cannot be.
    """
    check_frame_names(dict(given), space.frames, measurements.source)
    if free_base:
        check_frame_values(measurements, space.frames)
    bases = {name: np.array(base, dtype=np.float64) for name, base in given.items()}
    bases, tools = _from_positions(space, measurements, free_base, free_tool, bases)
    touched = {} if not free_base else _touched_rows(space, measurements, bases)
    for name in space.frames:
        if name not in bases and name not in touched:
            bases[name] = space.robot.base
    T_flange = None
    if any(part is not None for part in (measurements.touch, measurements.socket, measurements.distance)):
        arm = space.robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
        T_flange = forward_kinematics(arm, measurements.q.cpu())
    if free_tool and T_flange is not None:
        tools = _from_sockets(space, measurements, T_flange, bases, tools)
    if not turn_tool:
        tools = {name: np.concatenate([tool[:3], space.robot.tool[3:]]) for name, tool in tools.items()}
    all_tools = np.stack([tools.get(name, space.robot.tool) for name in space.targets])
    if T_flange is None:  # nothing but poses: nothing else has to start
        all_bases = np.stack([bases[name] for name in space.frames])
        return Start(all_bases, all_tools, np.zeros((0, 3)), np.zeros((0, 4)), ())
    target = numbers_of(measurements.target, space.targets, measurements.rows)
    T_tool = T_flange @ transform_from_xyzrpy(torch.from_numpy(all_tools))[target]
    for name, rows in touched.items():
        bases[name] = _from_touches(space, measurements, name, rows, T_tool[:, :3, 3])
    all_bases = np.stack([bases[name] for name in space.frames])
    frame = numbers_of(measurements.frame, space.frames, measurements.rows)
    points = (transform_from_xyzrpy(torch.from_numpy(all_bases))[frame] @ T_tool)[:, :3, 3]
    sockets = numbers_of(measurements.socket, space.sockets, measurements.rows)
    seen = sockets >= 0
    check_sockets(measurements, sockets, points, space.robot.reach)
    anchors, known = _anchors(space, measurements, points)
    return Start(
        bases=all_bases,
        tools=all_tools,
        sockets=means(points[seen], sockets[seen], len(space.sockets)).numpy(),
        anchors=anchors,
        places_known=known,
    )


def _from_positions(
    space: ParameterSpace,
    measurements: Measurements,
    free_base: bool,
    free_tool: bool,
    given: dict[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Bases and tools of frames with positions."""
    bases, tools = dict(given), dict[str, np.ndarray]()
    if measurements.position is None:
        return bases, tools
    positions = (measurements.measured("position") | measurements.measured("pose")).cpu()
    touches = measurements.measured("touch").cpu()
    frame = numbers_of(measurements.frame, space.frames, measurements.rows)
    count = [int((positions & (frame == number)).sum()) for number in range(len(space.frames))]
    for number in sorted(range(len(space.frames)), key=lambda number: -count[number]):
        name, rows = space.frames[number], (positions & (frame == number)).nonzero()[:, 0]
        if len(rows) == 0 or (len(rows) < ENOUGH and bool((touches & (frame == number)).any())):
            continue
        robot = space.robot if name not in given else space.robot.with_geometry(base=given[name])
        part = measurements
        if len(rows) < measurements.rows or len(rows) > START_ROWS:
            part = measurements.select(rows[chosen_rows(len(rows), START_ROWS)].to(measurements.q.device))
        if part.pair is not None:
            part = replace(part, pair=None, distance=None)
        find_base = free_base and name not in given
        turned = bool(part.measured("pose").any())
        if find_base and 3 <= len(rows) < FEW and not turned and set(part.target) <= set(tools):
            bases[name] = _base_by_tools(robot, part, tools)
            continue
        base, found = find_base_and_tool(robot, part, find_base, free_tool, START_STEPS)
        if free_base:
            bases[name] = base if find_base else robot.base
        if free_tool:
            tools = {**found, **tools}
    return bases, tools


def _base_by_tools(
    robot: Robot, measurements: Measurements, tools: Mapping[str, np.ndarray]
) -> Float64[np.ndarray, " 6"]:
    """The base of a frame with few positions, by tools that other frames told."""
    assert measurements.position is not None
    arm = robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
    T = forward_kinematics(arm, measurements.q.cpu())
    tool = torch.from_numpy(np.stack([tools[name][:3] for name in measurements.target]))
    points = (T[:, :3, :3] @ tool[..., None])[..., 0] + T[:, :3, 3]
    R_base, place = base_by_points(points, measurements.position.cpu())
    return torch.cat([place, rpy_from_rotation(R_base)]).numpy()


def chosen_rows(rows: int, most: int) -> Int64[Tensor, " chosen"]:
    """All rows, or so many of them in a random order that is always the same."""
    if rows <= most:
        return torch.arange(rows)
    return torch.randperm(rows, generator=torch.Generator().manual_seed(0))[:most]


def _touched_rows(
    space: ParameterSpace, measurements: Measurements, bases: Mapping[str, np.ndarray]
) -> dict[str, Bool[Tensor, " rows"]]:
    """The touches of frames whose base is not known yet."""
    if measurements.touch is None:
        return {}
    touches = measurements.measured("touch").cpu()
    frame = numbers_of(measurements.frame, space.frames, measurements.rows)
    found = {name: touches & (frame == number) for number, name in enumerate(space.frames)}
    return {name: rows for name, rows in found.items() if bool(rows.any()) and name not in bases}


def _from_sockets(
    space: ParameterSpace,
    measurements: Measurements,
    T_flange: Float64[Tensor, "rows 4 4"],
    bases: Mapping[str, np.ndarray],
    tools: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Tools that are not known yet, by the sockets that their ball sat in."""
    found = dict(tools)
    socket = numbers_of(measurements.socket, names_of(measurements.socket), measurements.rows)
    target = numbers_of(measurements.target, space.targets, measurements.rows)
    for number, name in enumerate(space.targets):
        rows = (socket >= 0) & (target == number)
        if name in found or not bool(rows.any()):
            continue
        own = space.robot.tool
        guess = torch.from_numpy(own[:3].copy())
        T = T_flange[rows]
        place = tool_from_sockets(
            T[:, :3, :3], T[:, :3, 3], torch.unique(socket[rows], return_inverse=True)[1], guess
        )
        found[name] = np.concatenate([place.numpy(), own[3:]])
    return found


def _from_touches(
    space: ParameterSpace,
    measurements: Measurements,
    name: str,
    rows: Bool[Tensor, " rows"],
    tip: Float64[Tensor, "rows 3"],
) -> np.ndarray:
    """The base of one frame by its touches."""
    assert measurements.touch is not None
    part = measurements.select(rows.nonzero()[:, 0].to(measurements.q.device))
    axis = numbers_of(part.touch_axis, ("x", "y", "z"), part.rows)
    assert part.touch is not None
    base, rms = touched_base(tip[rows], axis, part.touch.cpu(), torch.from_numpy(space.robot.base.copy()))
    check_touched_base(part, name, rms, space.robot.reach)
    found: np.ndarray = base.numpy()
    return found


def _anchors(
    space: ParameterSpace, measurements: Measurements, points: Float64[Tensor, "rows 3"]
) -> tuple[np.ndarray, tuple[bool, ...]]:
    """Places and zeros of the anchors, and which places are known; distances that cannot be are refused."""
    found, known = np.zeros((len(space.anchors), 4)), []
    number = numbers_of(measurements.anchor, space.anchors, measurements.rows)
    for k, name in enumerate(space.anchors):
        assert measurements.distance is not None
        rows = (number == k).nonzero()[:, 0]
        distance = measurements.distance.cpu()[rows]
        check_wire(measurements, name, rows, points[rows], distance, space.robot.reach)
        place = None if measurements.anchor_place is None else measurements.anchor_place.cpu()[rows[0]]
        known.append(place is not None and bool(torch.isfinite(place).all()))
        if place is not None and known[-1]:
            zero = (distance - (points[rows] - place).norm(dim=-1)).median()
            found[k] = np.concatenate([place.numpy(), [float(zero)]])
        else:
            found[k] = anchor_from_distances(points[rows], distance).numpy()
    if measurements.pair is not None and measurements.distance is not None:
        first = torch.arange(0, 2 * len(names_of(measurements.pair)), 2)
        apart = (points[first] - points[first + 1]).norm(dim=-1)
        check_pairs(measurements, first, apart, measurements.distance.cpu()[first], space.robot.reach)
    return found, tuple(known)
