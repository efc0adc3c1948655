"""Surfaces of revolution as triangles: capsules and cones."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

_AROUND = 24
"""Number of points around the axis of revolution."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh.

    Attributes:
        points: vertices [m].
        faces: indices of the vertices of every triangle, counterclockwise seen from outside.
    """

    points: Float64[np.ndarray, "points 3"]
    faces: Int64[np.ndarray, "faces 3"]

    def transformed(self, R: Float64[np.ndarray, "3 3"], t: Float64[np.ndarray, " 3"]) -> "Surface":
        """Return the surface after a rotation and a translation [m]."""
        return Surface(self.points @ R.T + t, self.faces)


def join_surfaces(surfaces: list[Surface]) -> Surface:
    """Return one surface that consists of several surfaces."""
    starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    faces = [surface.faces + start for surface, start in zip(surfaces, starts, strict=False)]
    return Surface(np.concatenate([surface.points for surface in surfaces]), np.concatenate(faces))


def revolve(radii: Float64[np.ndarray, " rings"], heights: Float64[np.ndarray, " rings"]) -> Surface:
    """Return a surface of revolution about the z axis.

    Args:
        radii: radii of the rings [m]; the surface is closed at radius 0.
        heights: heights of the rings along the axis, ascending [m].
    """
    angles = np.linspace(0.0, 2 * np.pi, _AROUND, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(_AROUND)], axis=1)
    points = radii[:, None, None] * circle + heights[:, None, None] * np.array([0.0, 0.0, 1.0])
    index = np.arange(points.shape[0] * _AROUND).reshape(-1, _AROUND)
    low, high = index[:-1], index[1:]
    right, above = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
    faces = np.concatenate([np.stack([low, right, above], -1), np.stack([low, above, high], -1)])
    return Surface(points.reshape(-1, 3), faces.reshape(-1, 3))


def capsule(start: Float64[np.ndarray, " 3"], end: Float64[np.ndarray, " 3"], radius: float) -> Surface:
    """Return a cylinder between two points with a hemisphere at either end [m]."""
    length = float(np.linalg.norm(end - start))
    angles = np.linspace(-np.pi / 2, np.pi / 2, 16)
    heights = radius * np.sin(angles) + np.where(angles > 0, length, 0.0)
    return revolve(radius * np.cos(angles), heights).transformed(rotation_to(end - start), start)


def rotation_to(direction: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return a rotation that maps the z axis to a direction; the identity if the direction is 0."""
    length = float(np.linalg.norm(direction))
    if length == 0:
        return np.eye(3)
    z = direction / length
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
