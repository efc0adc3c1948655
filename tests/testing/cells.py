"""A cell with all kinds of obstacles, and a check of poses by points instead of distances between lines."""

import numpy as np

from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.robot import Robot
from pisigma.robot.urdf_frames import frame_of, row_frame

CELL = Surroundings.model_validate(
    {
        "clearance_mm": 20.0,
        "floor_mm": 0.0,
        "joints": {"margin_deg": 5.0},
        "boxes": [
            {
                "name": "table",
                "center_mm": (1300.0, 1000.0, 400.0),
                "size_mm": (900.0, 700.0, 800.0),
                "yaw_deg": 25.0,
            },
            {"name": "column", "center_mm": (1500.0, -1300.0, 900.0), "size_mm": (300.0, 300.0, 1800.0)},
        ],
        "tool": {"x_mm": 80.0, "y_mm": 40.0, "z_mm": 150.0},
        "tracker": {"x_mm": 4500.0, "y_mm": -1500.0, "z_mm": 1200.0},
        "reflector": {"axis": (1.0, 0.0, 1.0), "acceptance_deg": 60.0},
    }
)
"""For a robot of the size of the catalogue's fanuc_r2000."""

POINTS = np.linspace(0.0, 1.0, 30)
"""Number of points along every line."""


def lines_of(robot: Robot, q: np.ndarray) -> list[np.ndarray]:
    """Return points on the centre line of every link of an arm with revolute joints, `(points, 3)` [m]; tool last."""
    T, lines = frame_of(robot.base), []
    for row, (theta, d, a, alpha, beta), value in zip(robot.rows, robot.dh, q, strict=True):
        along_axis = T @ row_frame(0.0, d, 0.0, 0.0, 0.0)
        turned = T @ row_frame(theta + row.direction * value, d, a, 0.0, 0.0)
        corners = np.array([T[:3, 3], along_axis[:3, 3], turned[:3, 3]])
        lines.append(np.concatenate([_between(corners[0], corners[1]), _between(corners[1], corners[2])]))
        T = turned @ row_frame(0.0, 0.0, 0.0, alpha, beta)
    lines.append(_between(T[:3, 3], (T @ frame_of(robot.tool))[:3, 3]))
    return lines


def is_collision_free(robot: Robot, cell: Surroundings, q: np.ndarray, radius: np.ndarray) -> bool:
    """Whether all points of the links keep the clearance from floor, boxes and non-adjacent links.

    Args:
        robot: with its tool; links are compared from the third on with those before their neighbour.
        cell: with a floor.
        q: joint values of a pose [rad].
        radius: of every link and of the tool [m].
    """
    lines, room = lines_of(robot, q), cell.clearance_mm / 1e3
    assert cell.floor_mm is not None
    for number, (line, r) in enumerate(zip(lines, radius, strict=True)):
        moved = line if number else line[len(line) // 2 :]  # the base column stands on the floor
        heights = moved[:, 2] if number else moved[-1:, 2]
        if heights.min() - cell.floor_mm / 1e3 < r + room:
            return False
        if any(_box_distance(box, moved) < r + room for box in cell.boxes):
            return False
    far = [(one, other) for other in (3, 6) for one in range(other - 2)]
    return all(
        np.linalg.norm(lines[i][:, None] - lines[j][None], axis=-1).min() >= radius[i] + radius[j] + room / 2
        for i, j in far
    )


def is_visible(robot: Robot, cell: Surroundings, q: np.ndarray, radius: np.ndarray) -> bool:
    """Whether the beam from the tracker passes boxes and the links before the wrist, and meets the reflector's cone."""
    assert cell.tracker is not None
    assert cell.reflector is not None
    lines, room = lines_of(robot, q), cell.clearance_mm / 1e3
    tracker = np.array([cell.tracker.x_mm, cell.tracker.y_mm, cell.tracker.z_mm]) / 1e3
    reflector = lines[-1][-1]
    beam = tracker + np.linspace(0.0, 1.0, 400)[:, None] * (reflector - tracker)
    hidden = any(_box_distance(box, beam) < room for box in cell.boxes)
    for line, r in zip(lines[:4], radius[:4], strict=True):
        hidden |= bool(np.linalg.norm(beam[:, None] - line[None], axis=-1).min() < r + room)
    T = frame_of(robot.base)
    for row, (theta, d, a, alpha, beta), value in zip(robot.rows, robot.dh, q, strict=True):
        T = T @ row_frame(theta + row.direction * value, d, a, alpha, beta)
    axis = (T @ frame_of(robot.tool))[:3, :3] @ np.array(cell.reflector.axis)
    cosine = axis @ (tracker - reflector) / np.linalg.norm(axis) / np.linalg.norm(tracker - reflector)
    return not hidden and bool(np.degrees(np.arccos(cosine)) <= cell.reflector.acceptance_deg)


def _between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    points: np.ndarray = start + POINTS[:, None] * (end - start)
    return points


def _box_distance(box: object, points: np.ndarray) -> float:
    center, half = np.array(box.center_mm) / 1e3, np.array(box.size_mm) / 2e3  # type: ignore[attr-defined]
    yaw = np.deg2rad(box.yaw_deg)  # type: ignore[attr-defined]
    turned = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    outside = np.maximum(np.abs((points - center) @ turned.T) - half, 0.0)
    return float(np.linalg.norm(outside, axis=1).min())
