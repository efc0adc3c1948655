"""How far a robot is from measurements that it was not fitted to."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError, nearest_choice
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.se3 import rotation_vector, transform_from_xyzrpy
from pisigma.sensors.building import names_of, numbers_of


def predicted_poses(
    robot: Robot,
    bases: dict[str, Float64[np.ndarray, " 6"]],
    tools: dict[str, Float64[np.ndarray, " 6"]],
    measurements: Measurements,
) -> Float64[Tensor, "rows 4 4"]:
    """Where a robot says that the targets were, each in the frame of its row.

    Args:
        robot: its rows are used, its base and tool are not.
        bases: per frame x, y, z [m], roll, pitch, yaw [rad].
        tools: the same per target.
        measurements: joint values, frames and targets.

    Raises:
        IdentificationError: a row has a frame or a target that is not known.
        PoseError: the joint values do not fit the robot.
    """
    T_arm = forward_kinematics(robot.with_geometry(base=np.zeros(6), tool=np.zeros(6)), measurements.q)
    T_base = _of_rows(bases, measurements.frame, "frame", measurements)
    T_tool = _of_rows(tools, measurements.target, "target", measurements)
    return T_base @ T_arm @ T_tool


def prediction_errors(
    robot: Robot,
    bases: dict[str, Float64[np.ndarray, " 6"]],
    tools: dict[str, Float64[np.ndarray, " 6"]],
    measurements: Measurements,
    sockets: Mapping[str, Float64[np.ndarray, " 3"]] = MappingProxyType({}),
    anchors: Mapping[str, Float64[np.ndarray, " 3"]] = MappingProxyType({}),
    zeros: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Float64[Tensor, "rows components"]]:
    """Measured minus predicted, NaN where nothing was measured; see `predicted_poses`.

    Args:
        robot: see `predicted_poses`, as for bases, tools and measurements.
        bases: per frame.
        tools: per target.
        measurements: what was measured.
        sockets: per socket its place in its frame [m]; others are where their own rows meet on average.
        anchors: per anchor its place in its frame [m]; that of a row counts where it is not here.
        zeros: per anchor what is shown at no distance [m]; 0 where it is not here.

    Returns:
        "position" [m] and "rotation" (rotation vectors [rad]), both in the frame of the row, "touch", "distance"
        and "pair" (in both rows) [m], one value a row, and "socket" (place minus predicted) [m]; what was not
        measured in any row is left out.

    Raises:
        IdentificationError: a row has a frame or a target that is not known, or an anchor whose place is not.
    """
    T = predicted_poses(robot, bases, tools, measurements)
    return errors_of_poses(T, measurements, sockets, anchors, zeros)


def errors_of_poses(
    T: Float64[Tensor, "rows 4 4"],
    measurements: Measurements,
    sockets: Mapping[str, Float64[np.ndarray, " 3"]] = MappingProxyType({}),
    anchors: Mapping[str, Float64[np.ndarray, " 3"]] = MappingProxyType({}),
    zeros: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Float64[Tensor, "rows components"]]:
    """Measured minus predicted for poses that some model predicts, each in the frame of its row.

    For arguments, results and errors see `prediction_errors`.
    """
    point = T[:, :3, 3]
    found = {}
    if measurements.position is not None:
        found["position"] = measurements.position - point
    if measurements.rotation is not None:
        seen = torch.isfinite(measurements.rotation).flatten(1).all(-1)
        rotation = torch.where(seen[:, None, None], measurements.rotation, T[:, :3, :3])
        turn = rotation_vector(rotation @ T[:, :3, :3].mT)
        found["rotation"] = torch.where(seen[:, None], turn, torch.nan)
    if measurements.touch is not None:
        axis = numbers_of(measurements.touch_axis, ("x", "y", "z"), measurements.rows).to(point.device)
        predicted = point.gather(1, axis.clamp(min=0)[:, None])
        found["touch"] = measurements.touch[:, None] - predicted
    if measurements.socket is not None:
        found["socket"] = _socket_errors(measurements, point, sockets)
    if measurements.distance is not None:
        found.update(_distance_errors(measurements, point, anchors, zeros))
    return found


def _socket_errors(
    measurements: Measurements, point: Float64[Tensor, "rows 3"], sockets: Mapping[str, np.ndarray]
) -> Float64[Tensor, "rows 3"]:
    found = torch.full_like(point, torch.nan)
    for name in names_of(measurements.socket):
        rows = numbers_of(measurements.socket, (name,), measurements.rows).to(point.device) == 0
        place = torch.from_numpy(sockets[name].copy()).to(point) if name in sockets else point[rows].mean(0)
        found[rows] = place - point[rows]
    return found


def _distance_errors(
    measurements: Measurements,
    point: Float64[Tensor, "rows 3"],
    anchors: Mapping[str, np.ndarray],
    zeros: Mapping[str, float],
) -> dict[str, Float64[Tensor, "rows 1"]]:
    assert measurements.distance is not None
    found = {}
    for kind, names in (("distance", measurements.anchor), ("pair", measurements.pair)):
        if names is None:
            continue
        found[kind] = torch.full_like(point[:, :1], torch.nan)
        for name in names_of(names):
            rows = (numbers_of(names, (name,), measurements.rows) == 0).nonzero()[:, 0].to(point.device)
            zero = zeros.get(name, 0.0) if kind == "distance" else 0.0
            end = point[rows.flip(0)]
            if kind == "distance":
                end = _anchor_place(measurements, name, int(rows[0]), anchors).to(point)
            predicted = (point[rows] - end).norm(dim=-1) + zero
            found[kind][rows, 0] = measurements.distance[rows] - predicted
    return found


def _anchor_place(
    measurements: Measurements, name: str, row: int, anchors: Mapping[str, np.ndarray]
) -> Float64[Tensor, " 3"]:
    if name in anchors:
        return torch.from_numpy(anchors[name].copy())
    place = measurements.anchor_place
    if place is not None and bool(torch.isfinite(place[row]).all()):
        return place[row]
    raise IdentificationError(
        f"{measurements.place(row)}: anchor '{name}' was not calibrated and its place is not given; "
        f"{nearest_choice(name, tuple(anchors))}"
    )


def _of_rows(
    known: dict[str, Float64[np.ndarray, " 6"]], names: tuple[str, ...], what: str, measurements: Measurements
) -> Float64[Tensor, "rows 4 4"]:
    order = tuple(known)
    for name in dict.fromkeys(names):
        if name not in known:
            row = names.index(name)
            raise IdentificationError(
                f"{measurements.place(row)}: {what} '{name}' was not calibrated; "
                f"{nearest_choice(name, order)}"
            )
    frames = transform_from_xyzrpy(torch.from_numpy(np.stack([known[name] for name in order])))
    index = torch.tensor([order.index(name) for name in names], dtype=torch.int64)
    return frames[index].to(measurements.q.device)
