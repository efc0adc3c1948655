"""Initial guess of bases, tools and unknowns of sensors, with the nominal arm."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.base_and_tool import (
    check_touched_base,
    check_touched_frames,
    fit_base_to_touches,
    guess_base_and_tool,
)
from pisigma.calibration.geometric.initial_guess.base_and_tool_closed_form import fit_base_to_points
from pisigma.calibration.geometric.initial_guess.tool_from_distances import (
    base_from_anchors,
    tools_from_distances,
)
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.files.errors import IdentificationError, Place, choice_remedy
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import SENSORS
from pisigma.measurement.sensors.sensor import distinct_names, indices_of_names
from pisigma.measurement.sensors.socket import group_means
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import (
    transform_from_xyz_zyx,
    zyx_from_rotation,
)

_GUESS_ROWS = 1_024
"""Largest number of rows used to guess base and tool."""
_MIN_POSITIONS = 9
"""Number of positions below which a frame's base is guessed with tools that were found in other frames."""
_MIN_POSITIONS_TOUCHED = 5
"""Number of positions in a touched frame that are sufficient for base and tool in closed form."""
MIN_TURN = 0.02
"""Singular value per row below which orientations in sockets do not determine a direction of the tool, which then
keeps its nominal value."""


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """Initial values of bases, tools and unknowns of sensors, in the user's coordinates.

    Attributes:
        bases: base in every frame: x, y, z [m], roll, pitch, yaw [rad].
        tools: tool of every target, in the same form.
        unknowns: unknowns of every owner in its frame, by group of the sensors' unknowns [m or rad].
        free_unknowns: mask of the unknowns to identify; the measurements state the others.
    """

    bases: Float64[np.ndarray, "frames 6"]
    tools: Float64[np.ndarray, "targets 6"]
    unknowns: Mapping[str, Float64[Tensor, "owners columns"]]
    free_unknowns: Mapping[str, Bool[Tensor, "owners columns"]]


def guess(
    space: ParameterSpace,
    measurements: Measurements,
    free_base: bool,
    free_tool: bool,
    free_rotation: bool,
    stated_bases: Mapping[str, tuple[float, ...]],
) -> InitialGuess:
    """Guess bases, tools and the sensors' unknowns with the nominal arm.

    Frames with positions get base and tool in closed form. Then sockets, wires and pairs determine the remaining tools;
    touches, and wires from anchors at stated positions, determine their frame with the tool; and the sensors guess
    their unknowns, such as sockets at the mean position of the tool and anchors by multilateration. A frame without
    any of these (only sockets and unknown anchors) does not determine the base, which starts at the robot's base.

    Args:
        space: names and robot.
        measurements: usable rows; those of pairs come first.
        free_base: whether to identify bases; otherwise stated bases, or the robot's base, are used.
        free_tool: whether to identify tools.
        free_rotation: whether to identify the rotations of tools.
        stated_bases: bases of frames that the user states.

    Raises:
        IdentificationError: there are too few measurements for a guess, or they are implausible.
    """
    _check_frame_names(stated_bases, space.frames, measurements.source)
    if free_base:
        check_touched_frames(measurements, space.frames)
    bases = {name: np.array(base, dtype=np.float64) for name, base in stated_bases.items()}
    bases, tools = _from_positions(space, measurements, free_base, free_tool, bases)
    touched = {} if not free_base else _touched_rows(space, measurements, bases)
    wired = [name for name in space.frames if free_base and name not in bases and name not in touched]
    for name in space.frames:
        if name not in bases and name not in touched:
            bases[name] = space.robot.base
    poses_alone = measurements.kinds <= {"pose", "position", "rotation"}
    if not poses_alone:
        arm = space.robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
        T_flange = forward_kinematics(arm, measurements.q.cpu())
        if free_tool:
            tools = _from_sockets(space, measurements, T_flange, tools)
        tools = tools_from_distances(space, measurements, T_flange, tools, free_tool)
    if not free_rotation:
        tools = {name: np.concatenate([tool[:3], space.robot.tool[3:]]) for name, tool in tools.items()}
    all_tools = np.stack([tools.get(name, space.robot.tool) for name in space.targets])
    if poses_alone:
        return InitialGuess(np.stack([bases[name] for name in space.frames]), all_tools, {}, {})
    target = indices_of_names(measurements.target, space.targets, measurements.rows)
    T_tool = T_flange @ transform_from_xyz_zyx(torch.from_numpy(all_tools))[target]
    for name, rows in touched.items():
        bases[name] = _from_touches(space, measurements, name, rows, T_tool[:, :3, 3])
    for name in wired:
        bases[name] = base_from_anchors(measurements, name, T_tool[:, :3, 3], bases[name])
    all_bases = np.stack([bases[name] for name in space.frames])
    frame = indices_of_names(measurements.frame, space.frames, measurements.rows)
    T = transform_from_xyz_zyx(torch.from_numpy(all_bases))[frame] @ T_tool
    unknowns, free = {}, {}
    for sensor in SENSORS.values():
        group, own = sensor.unknowns(measurements), sensor.initial_guess(measurements, T, space.robot.reach)
        if group is not None and own is not None:
            unknowns[group.name], free[group.name] = own.values, own.free
    return InitialGuess(all_bases, all_tools, unknowns, free)


def _from_positions(
    space: ParameterSpace,
    measurements: Measurements,
    free_base: bool,
    free_tool: bool,
    stated: dict[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Guess bases and tools of frames with positions, starting with the frame with most positions."""
    bases, tools = dict(stated), dict[str, np.ndarray]()
    if measurements.position is None:
        return bases, tools
    positions = (measurements.is_measured("position") | measurements.is_measured("pose")).cpu()
    touches = measurements.is_measured("touch").cpu()
    frame = indices_of_names(measurements.frame, space.frames, measurements.rows)
    count = [int((positions & (frame == number)).sum()) for number in range(len(space.frames))]
    for number in sorted(range(len(space.frames)), key=lambda number: -count[number]):
        name, rows = space.frames[number], (positions & (frame == number)).nonzero()[:, 0]
        if len(rows) == 0 or (
            len(rows) < _MIN_POSITIONS_TOUCHED and bool((touches & (frame == number)).any())
        ):
            continue
        robot = space.robot if name not in stated else space.robot.with_geometry(base=stated[name])
        part = measurements
        if len(rows) < measurements.rows or len(rows) > _GUESS_ROWS:
            part = measurements.select(
                rows[randomly_chosen_rows(len(rows), _GUESS_ROWS)].to(measurements.q.device)
            )
        if part.pair is not None:
            part = replace(part, pair=None, distance=None)
        find_base = free_base and name not in stated
        turned = bool(part.is_measured("pose").any())
        if find_base and 3 <= len(rows) < _MIN_POSITIONS and not turned and set(part.target) <= set(tools):
            bases[name] = _base_by_tools(robot, part, tools)
            continue
        base, guessed = guess_base_and_tool(robot, part, find_base, free_tool)
        if free_base:
            bases[name] = base if find_base else robot.base
        if free_tool:
            tools = {**guessed, **tools}
    return bases, tools


def _base_by_tools(
    robot: Robot, measurements: Measurements, tools: Mapping[str, np.ndarray]
) -> Float64[np.ndarray, " 6"]:
    """Fit the base of a frame with few positions, with the tools of other frames."""
    assert measurements.position is not None
    arm = robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
    T = forward_kinematics(arm, measurements.q.cpu())
    tool = torch.from_numpy(np.stack([tools[name][:3] for name in measurements.target]))
    points = (T[:, :3, :3] @ tool[..., None])[..., 0] + T[:, :3, 3]
    R_base, place = fit_base_to_points(points, measurements.position.cpu())
    return torch.cat([place, zyx_from_rotation(R_base)]).numpy()


def randomly_chosen_rows(rows: int, max_rows: int) -> Int64[Tensor, " chosen"]:
    """Return all rows, or at most `max_rows` of them in a fixed random order."""
    if rows <= max_rows:
        return torch.arange(rows)
    return torch.randperm(rows, generator=torch.Generator().manual_seed(0))[:max_rows]


def _touched_rows(
    space: ParameterSpace, measurements: Measurements, bases: Mapping[str, np.ndarray]
) -> dict[str, Bool[Tensor, " rows"]]:
    """Return the touches of frames without a base."""
    if measurements.touch is None:
        return {}
    touches = measurements.is_measured("touch").cpu()
    frame = indices_of_names(measurements.frame, space.frames, measurements.rows)
    touched = {name: touches & (frame == number) for number, name in enumerate(space.frames)}
    return {name: rows for name, rows in touched.items() if bool(rows.any()) and name not in bases}


def _from_sockets(
    space: ParameterSpace,
    measurements: Measurements,
    T_flange: Float64[Tensor, "rows 4 4"],
    tools: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Add guesses of tools that have none, from the sockets in which their ball was measured."""
    tools = dict(tools)
    socket = indices_of_names(measurements.socket, distinct_names(measurements.socket), measurements.rows)
    target = indices_of_names(measurements.target, space.targets, measurements.rows)
    for number, name in enumerate(space.targets):
        rows = (socket >= 0) & (target == number)
        if name in tools or not bool(rows.any()):
            continue
        nominal_tool = space.robot.tool
        T = T_flange[rows]
        position = tool_from_sockets(
            T[:, :3, :3],
            T[:, :3, 3],
            torch.unique(socket[rows], return_inverse=True)[1],
            torch.from_numpy(nominal_tool[:3].copy()),
        )
        tools[name] = np.concatenate([position.numpy(), nominal_tool[3:]])
    return tools


def _from_touches(
    space: ParameterSpace,
    measurements: Measurements,
    name: str,
    rows: Bool[Tensor, " rows"],
    tip: Float64[Tensor, "rows 3"],
) -> np.ndarray:
    """Guess the base of one frame from its touches."""
    assert measurements.touch is not None
    part = measurements.select(rows.nonzero()[:, 0].to(measurements.q.device))
    axis = indices_of_names(part.touch_axis, ("x", "y", "z"), part.rows)
    assert part.touch is not None
    base, rms = fit_base_to_touches(
        tip[rows], axis, part.touch.cpu(), torch.from_numpy(space.robot.base.copy())
    )
    check_touched_base(part, name, rms, space.robot.reach)
    guessed: np.ndarray = base.numpy()
    return guessed


def tool_from_sockets(
    R: Float64[Tensor, "rows 3 3"],
    p: Float64[Tensor, "rows 3"],
    socket: Int64[Tensor, " rows"],
    guess: Float64[Tensor, " 3"],
) -> Float64[Tensor, " 3"]:
    """Compute the position of a ball on the flange at which the rows of every socket agree best.

    `R · ball + p - socket = 0` is linear in ball and socket; subtracting the means over the rows of every socket
    eliminates the sockets. Directions that the orientations hardly determine keep their guess.

    Args:
        R: orientations of the flange in the rows of one target.
        p: positions of the flange [m].
        socket: index of every row's socket.
        guess: nominal position of the ball [m].
    """
    turn = _centred(R.flatten(1), socket).view(-1, 3, 3).flatten(0, 1)
    off = -_centred(p + (R @ guess), socket).flatten()
    rtol = MIN_TURN * len(R) ** 0.5 / max(float(torch.linalg.matrix_norm(turn, 2)), 1e-12)
    ball: Tensor = guess + torch.linalg.pinv(turn, rtol=min(rtol, 1.0)) @ off
    return ball


def _centred(values: Tensor, group: Tensor) -> Tensor:
    return values - group_means(values, group, int(group.max()) + 1)[group]


def _check_frame_names(stated: Mapping[str, object], frames: tuple[str, ...], source: str) -> None:
    """Refuse guesses of frames without measurements.

    Raises:
        IdentificationError: no row was measured in a frame with a guess.
    """
    for name in stated:
        if name not in frames:
            raise IdentificationError(
                f"no row is in the frame '{name}'",
                option="base_guesses",
                value=name,
                at=Place(source),
                remedy=choice_remedy(name, frames),
            )
