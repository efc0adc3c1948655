"""Arcs of circles through three points."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.robot.se3 import rotation_from_vector

STRAIGHT = 1e-4
"""Sine of the angle between the chords to the second and the third point, below which there is no arc."""

Points = Float64[Tensor, "arcs 3"]


@dataclass(frozen=True, eq=False)
class Arcs:
    """Arcs that begin in first points, pass second ones and end in third ones.

    Attributes:
        centre: of the circles [m].
        radius: vectors from the centres to the first points [m].
        axis: that the points go round counter-clockwise.
        passing: angle at the second points [rad], from 0 at the first ones.
        angle: at the third points [rad], below a full turn.
    """

    centre: Points
    radius: Points
    axis: Points
    passing: Float64[Tensor, " arcs"]
    angle: Float64[Tensor, " arcs"]

    @staticmethod
    def through(first: Points, second: Points, third: Points) -> "Arcs":
        """Arcs through points [m], which must not lie on a line, see `is_straight`."""
        u, v = second - first, third - first
        normal = torch.linalg.cross(u, v)
        # The circumcentre of the triangle 0, u, v.
        squares = (a.square().sum(-1, keepdim=True) for a in (u, v, normal))
        u_square, v_square, normal_square = squares
        middle = torch.linalg.cross(u_square * v - v_square * u, normal) / (2 * normal_square)
        axis = normal / normal_square.sqrt()
        passing, angle = (_angle(-middle, way - middle, axis) for way in (u, v))
        return Arcs(first + middle, -middle, axis, passing, angle)

    def points(self, steps: int) -> Float64[Tensor, "arcs points 3"]:
        """Points at equal distances along the arcs [m], from the first points to the third ones."""
        angles = torch.linspace(0, 1, steps + 1, dtype=torch.float64) * self.angle[:, None]
        turned = rotation_from_vector(angles[..., None] * self.axis[:, None]) @ self.radius[:, None, :, None]
        return self.centre[:, None] + turned[..., 0]


def is_straight(first: Points, second: Points, third: Points) -> bool:
    """Whether some three points lie on a line, or two of them in one place."""
    u, v = second - first, third - first
    bends = torch.linalg.cross(u, v).norm(dim=-1) > STRAIGHT * u.norm(dim=-1) * v.norm(dim=-1)
    return not bool(bends.all())


def _angle(start: Points, end: Points, axis: Points) -> Float64[Tensor, " arcs"]:
    """How far to turn about the axis to come from one direction to another, 0 to a full turn [rad]."""
    sine = (axis * torch.linalg.cross(start, end)).sum(-1)
    return torch.atan2(sine, (start * end).sum(-1)) % (2 * math.pi)
