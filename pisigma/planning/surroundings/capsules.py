"""Capsules along the links of a robot, for collision checks."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.planning.surroundings.distances import segment_distance
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.components import as_transform
from pisigma.robot.kinematics.forward import Geometry, iterate_rows
from pisigma.robot.urdf_frames import inverse, row_frame

_RADIUS_SHARES = (0.05, 0.05, 0.05, 0.035)
"""Default radii of links from the first joint on, as shares of the length of the nominal arm; the last share applies to
all remaining links."""
TOOL_RADIUS = 0.025
"""Default radius of the tool [m]: a bracket with a reflector of 1.5 inches."""
_MIN_LENGTH = 1e-6
"""Length below which a piece of a link needs no capsule [m], because its neighbours cover it."""
_SAMPLES = 500
"""Number of random poses with which capsules that touch by construction are found."""


@dataclass(frozen=True, eq=False)
class Capsules:
    """Pieces of the links as line segments with a radius, each end fixed to a frame of the robot.

    A DH row leads from its joint along the joint's axis by d, and then by a to the next row; these are the two
    pieces of its link. A URDF file states the joint positions, so its links are straight from joint to joint. The
    last piece is the tool.

    Attributes:
        robot: nominal robot with the tool.
        frame: frame to which each end of a piece is fixed: 0 for the base, i for the frame after row i.
        point: position of each end in that frame [m].
        link: number of the joint that moves each piece; 0 for fixed pieces.
        radius: radius of each piece [m].
        carries_robot: whether each piece carries the robot, because the piece is before the first joint or on its axis.
    """

    robot: Robot
    frame: Int64[Tensor, "pieces 2"]
    point: Float64[Tensor, "pieces 2 3"]
    link: Int64[Tensor, " pieces"]
    radius: Float64[Tensor, " pieces"]
    carries_robot: Bool[Tensor, " pieces"]

    @staticmethod
    def from_robot(
        robot: Robot,
        tip: Float64[np.ndarray, " 3"] | None = None,
        radius: float | None = None,
        radii: Mapping[str, float] | None = None,
        tool_radius: float = TOOL_RADIUS,
    ) -> "Capsules":
        """Return capsules along the links of a robot.

        Args:
            robot: nominal robot with the reflector as its tool.
            tip: position of the nominal tool in the frame after the last row, from which the bracket leads to the
                reflector [m]; None for the origin of that frame.
            radius: radius of all links [m]; None for `_RADIUS_SHARES` of the arm's length.
            radii: radii of individual links by the names of their rows [m].
            tool_radius: radius of the tool [m].
        """
        tip = np.zeros(3) if tip is None else tip
        pieces = [*_pieces_of_rows(robot, tip)]
        last = len(robot.rows)
        pieces.append(_Piece(last - 1, False, (last, last), (tip, robot.tool[:3])))
        length = float(np.hypot(robot.dh[:, 1], robot.dh[:, 2]).sum())
        link = np.cumsum([row.type != "fixed" for row in robot.rows])[[piece.row for piece in pieces]]
        sizes = length * np.array(_RADIUS_SHARES)[np.clip(link, 1, len(_RADIUS_SHARES)) - 1]
        sizes = np.full_like(sizes, radius) if radius is not None else sizes
        stated = [(radii or {}).get(robot.rows[piece.row].name) for piece in pieces]
        sizes = np.where([size is None for size in stated], sizes, np.array(stated, dtype=np.float64))
        sizes[-1] = tool_radius
        capsules = Capsules(
            robot,
            torch.tensor([piece.frame for piece in pieces]),
            torch.from_numpy(np.array([piece.point for piece in pieces])),
            torch.from_numpy(link),
            torch.from_numpy(sizes),
            torch.tensor([piece.carries_robot for piece in pieces]),
        )
        segments = capsules.segments(capsules.random_joints())
        return capsules._of((segments[:, :, 1] - segments[:, :, 0]).norm(dim=-1).amax(0) > _MIN_LENGTH)

    def _of(self, kept: Bool[Tensor, " pieces"]) -> "Capsules":
        """Return only the capsules of the kept pieces."""
        values = (self.frame, self.point, self.link, self.radius, self.carries_robot)
        return Capsules(self.robot, *(value[kept] for value in values))

    def segments(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch pieces 2 3"]:
        """Compute both ends of every piece in the base frame of poses [m] at joint values q [rad or m]."""
        frames = torch.stack([*self._frames(q)], -3)[..., self.frame, :, :]
        return (frames[..., :3, :3] @ self.point[..., None])[..., 0] + frames[..., :3, 3]

    def _frames(self, q: Float64[Tensor, "*batch dof"]) -> list[Float64[Tensor, "*batch 4 4"]]:
        rows = list(iterate_rows(self.robot, Geometry.from_robot(self.robot), q.unbind(-1)))
        return [as_transform(frame, q[..., 0]) for frame in (rows[0].before, *(row.after for row in rows))]

    def pairs_to_check(self, clearance: float) -> Int64[Tensor, "pairs 2"]:
        """Return the pairs of pieces, on links that are not neighbours, that must not touch each other.

        Pairs that touch in more than half of random poses do so by construction, as in a wrist; the joint limits must
        keep them apart. Pairs whose distance never changes are not checked.

        Args:
            clearance: distance to keep between pieces [m].
        """
        first, second = torch.combinations(torch.arange(len(self.link))).unbind(-1)
        segments = self.segments(self.random_joints())
        distance = segment_distance(segments[:, first], segments[:, second])
        touches = distance < self.radius[first] + self.radius[second] + clearance
        changes = distance.amax(0) - distance.amin(0) > _MIN_LENGTH
        checked = ((self.link[second] - self.link[first]) > 1) & (touches.double().mean(0) < 0.5) & changes
        return torch.stack([first, second], -1)[checked]

    def random_joints(self) -> Float64[Tensor, "poses dof"]:
        """Draw joint values within the limits and half a turn of zero [rad or m], the same ones in every call."""
        generator = torch.Generator().manual_seed(0)
        limits = torch.from_numpy(self.robot.axis_limits).clamp(-np.pi, np.pi)
        draws = torch.rand(_SAMPLES, len(limits), generator=generator, dtype=torch.float64)
        q: Float64[Tensor, "poses dof"] = self.robot.to_dh(
            limits[:, 0] + (limits[:, 1] - limits[:, 0]) * draws
        )
        return q


class _Piece(NamedTuple):
    """One piece of a link.

    Attributes:
        row: row to whose link the piece belongs.
        carries_robot: see `Capsules`.
        frame: indices of the frames to which the ends are fixed.
        point: positions of the ends in these frames [m].
    """

    row: int
    carries_robot: bool
    frame: tuple[int, int]
    point: tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]


def _pieces_of_rows(robot: Robot, tip: Float64[np.ndarray, " 3"]) -> Iterator[_Piece]:
    """Yield the pieces from joint to joint and to the tip: straight if positions are known, otherwise by d and a."""
    has_seats = any(any(row.urdf_origin) for row in robot.rows)
    seats = [np.array(row.urdf_origin) for row in robot.rows] + [tip if has_seats else np.zeros(3)]
    first = robot.joint_rows[0]
    if has_seats:
        yield _Piece(0, True, (0, 0), (np.zeros(3), seats[0]))
    for i, row in enumerate(robot.rows):
        corners = [(i, seats[i]), (i + 1, seats[i + 1])]
        if row.type == "prismatic":  # the piece along the stroke of the joint, then the moving link
            corners.insert(1, (i + 1, _behind(robot, i, seats[i])))
        elif not has_seats:
            corners.insert(1, (i + 1, _behind(robot, i, np.array([0.0, 0.0, robot.dh[i, 1]]))))
        for number, (start, end) in enumerate(itertools.pairwise(corners)):
            carries_robot = i < first or (i == first and number == 0 and len(corners) > 2)
            yield _Piece(i, carries_robot, (start[0], end[0]), (start[1], end[1]))
    if not has_seats:
        yield _Piece(i, False, (i + 1, i + 1), (np.zeros(3), tip))


def _behind(robot: Robot, row: int, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    """Transform a point [m] from the frame before a row to the frame after it, at the joint value 0."""
    result: np.ndarray = (inverse(row_frame(*robot.dh[row].tolist())) @ np.append(point, 1.0))[:3]
    return result
