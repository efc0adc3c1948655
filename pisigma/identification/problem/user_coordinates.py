"""Parameters of a calibration problem in the user's coordinates: bases, tools, places and zeros as they are told."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.identification.problem.parameters import ParameterSpace
from pisigma.identification.problem.problem import CalibrationProblem
from pisigma.identification.problem.setup import CalibrationSetup
from pisigma.robot.description import Robot
from pisigma.se3 import rotation_from_rpy, rpy_from_rotation


@dataclass(frozen=True, eq=False)
class UserCoordinates:
    """Parameters in the user's coordinates.

    Attributes:
        bases: per frame, in its own coordinates.
        tools: per target.
        sockets: places of the sockets in their frames [m].
        anchors: places of the anchors in their frames, and their zeros [m].
        change: d(user's parameters) / d(problem's parameters).
    """

    bases: Float64[Tensor, "frames 6"]
    tools: Float64[Tensor, "targets 6"]
    sockets: Float64[Tensor, "sockets 3"]
    anchors: Float64[Tensor, "anchors 4"]
    change: Float64[Tensor, "parameters parameters"]


@dataclass(frozen=True, eq=False)
class IdentifiedGeometry:
    """A robot, where it stood, what it carried and what its sensors did not know of themselves.

    Attributes:
        robot: with the base of the first frame and the tool of the first target.
        bases: per frame x, y, z [m], roll, pitch, yaw [rad].
        tools: the same per target.
        sockets: per socket its place in its frame [m].
        anchors: per anchor its place in its frame [m].
        zeros: per anchor what its sensor shows at no distance [m].
        change: d(all parameters in these coordinates) / d(the problem's).
    """

    robot: Robot
    bases: dict[str, Float64[np.ndarray, " 6"]]
    tools: dict[str, Float64[np.ndarray, " 6"]]
    sockets: dict[str, Float64[np.ndarray, " 3"]]
    anchors: dict[str, Float64[np.ndarray, " 3"]]
    zeros: dict[str, float]
    change: Float64[Tensor, "parameters parameters"]


def identified_geometry(setup: CalibrationSetup, point: Float64[Tensor, " parameters"]) -> IdentifiedGeometry:
    """A point of the problem in the user's coordinates."""
    space = setup.problem.space
    return named_geometry(space, point.cpu(), user_coordinates(setup, point.cpu(), setup.problem))


def named_geometry(space: ParameterSpace, point: Tensor, estimate: UserCoordinates) -> IdentifiedGeometry:
    """The same by the names of frames, targets, sockets and anchors."""
    bases, tools = estimate.bases.numpy(), estimate.tools.numpy()
    dh = space.split(point)[0].numpy()
    return IdentifiedGeometry(
        robot=space.robot.with_geometry(dh=dh, base=bases[0], tool=tools[0]),
        bases=dict(zip(space.frames, bases, strict=True)),
        tools=dict(zip(space.targets, tools, strict=True)),
        sockets=dict(zip(space.sockets, estimate.sockets.numpy(), strict=True)),
        anchors={name: end[:3].numpy() for name, end in zip(space.anchors, estimate.anchors, strict=True)},
        zeros={name: float(end[3]) for name, end in zip(space.anchors, estimate.anchors, strict=True)},
        change=estimate.change,
    )


def user_coordinates(setup: CalibrationSetup, point: Tensor, problem: CalibrationProblem) -> UserCoordinates:
    """Put the anchors back; as rotation vectors, small turns mean the same with and without them."""
    space = problem.space
    _, bases, tools = (part.clone() for part in space.split(point))
    change = torch.eye(len(point), dtype=point.dtype)
    anchors = setup.anchors
    for k, anchor in enumerate(anchors.bases.cpu()):
        axes = turning_axes(bases[k, 3:])
        place = space.arm_size + 6 * k
        bases[k, :3] = anchor[:3, :3] @ bases[k, :3] + anchor[:3, 3]
        bases[k, 3:] = rpy_from_rotation(anchor[:3, :3] @ rotation_from_rpy(bases[k, 3:]))
        change[place : place + 3, place : place + 3] = anchor[:3, :3]
        back = torch.linalg.pinv(turning_axes(bases[k, 3:]), rtol=1e-9)
        change[place + 3 : place + 6, place + 3 : place + 6] = back @ anchor[:3, :3] @ axes
    for k, R_anchor in enumerate(anchors.tools.cpu()):
        axes = turning_axes(tools[k, 3:])
        place = space.arm_size + 6 * (len(space.frames) + k) + 3
        tools[k, 3:] = rpy_from_rotation(rotation_from_rpy(tools[k, 3:]) @ R_anchor)
        back = torch.linalg.pinv(turning_axes(tools[k, 3:]), rtol=1e-9)
        change[place : place + 3, place : place + 3] = back @ axes
    for numbers, group, size in ((setup.socket_frame, "socket", 3), (setup.anchor_frame, "anchor", 4)):
        for k, number in enumerate(numbers.tolist()):
            place = space.of(group).start + size * k
            change[place : place + 3, place : place + 3] = anchors.bases[number, :3, :3].cpu()
    return UserCoordinates(bases, tools, *own_places(setup, point, space), change)


def own_places(setup: CalibrationSetup, point: Tensor, space: ParameterSpace) -> tuple[Tensor, Tensor]:
    """Sockets and anchors in their frames."""
    own = space.own(point)
    found = []
    for places, numbers in ((own.sockets.t(), setup.socket_frame), (own.anchors.t(), setup.anchor_frame)):
        T = setup.anchors.bases.cpu()[numbers]
        seen = (T[:, :3, :3] @ places[:, :3, None])[..., 0] + T[:, :3, 3]
        found.append(torch.cat([seen, places[:, 3:]], 1))
    return found[0], found[1]


def turning_axes(rpy: Float64[Tensor, " 3"]) -> Float64[Tensor, "3 3"]:
    """The axes that roll, pitch and yaw turn about, as columns: `RotZ(roll) · RotY(pitch) · RotX(yaw)`."""
    roll, pitch, _ = rpy.tolist()
    (cr, cp), (sr, sp) = ((turn(roll), turn(pitch)) for turn in (math.cos, math.sin))
    return rpy.new_tensor([[0.0, -sr, cr * cp], [0.0, cr, sr * cp], [1.0, 0.0, -sp]])
