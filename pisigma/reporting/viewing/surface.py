"""Surfaces of revolution as triangles: capsules and cones."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

AROUND = 24
"""Points around the axis."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles.

    Attributes:
        points: corners of triangles [m].
        faces: indices of the corners of every triangle, anticlockwise from outside.
    """

    points: Float64[np.ndarray, "points 3"]
    faces: Int64[np.ndarray, "faces 3"]

    def moved(self, R: Float64[np.ndarray, "3 3"], t: Float64[np.ndarray, " 3"]) -> "Surface":
        """The surface after a rotation and a translation [m]."""
        return Surface(self.points @ R.T + t, self.faces)


def joined(surfaces: list[Surface]) -> Surface:
    """Several surfaces as one."""
    starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    faces = [surface.faces + start for surface, start in zip(surfaces, starts, strict=False)]
    return Surface(np.concatenate([surface.points for surface in surfaces]), np.concatenate(faces))


def revolve(radii: Float64[np.ndarray, " rings"], heights: Float64[np.ndarray, " rings"]) -> Surface:
    """Turn a line about the z axis.

    Args:
        radii: distances of its points from the axis [m]; the surface is closed at 0.
        heights: their places along the axis [m], rising.
    """
    angles = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(AROUND)], axis=1)
    points = radii[:, None, None] * circle + heights[:, None, None] * np.array([0.0, 0.0, 1.0])
    index = np.arange(points.shape[0] * AROUND).reshape(-1, AROUND)
    low, high = index[:-1], index[1:]
    beside, above = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
    faces = np.concatenate([np.stack([low, beside, above], -1), np.stack([low, above, high], -1)])
    return Surface(points.reshape(-1, 3), faces.reshape(-1, 3))


def capsule(start: Float64[np.ndarray, " 3"], end: Float64[np.ndarray, " 3"], radius: float) -> Surface:
    """A cylinder between two points [m] with half a ball at either end."""
    length = float(np.linalg.norm(end - start))
    angles = np.linspace(-np.pi / 2, np.pi / 2, 16)
    heights = radius * np.sin(angles) + np.where(angles > 0, length, 0.0)
    return revolve(radius * np.cos(angles), heights).moved(rotation_to(end - start), start)


def rotation_to(direction: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """A rotation that takes the z axis to a direction; the identity where that is 0."""
    length = float(np.linalg.norm(direction))
    if length == 0:
        return np.eye(3)
    z = direction / length
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
