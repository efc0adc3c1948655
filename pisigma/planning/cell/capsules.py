"""Capsules along the links of a robot: what of it must not touch anything."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.kinematics.components import as_transform
from pisigma.kinematics.forward import Geometry, iterate_rows
from pisigma.planning.cell.distances import segment_distance
from pisigma.robot.description import Robot
from pisigma.robot.urdf_frames import turn

RADIUS_SHARES = (0.05, 0.05, 0.05, 0.035)
"""Radius of links where none is stated, from the first joint on, as a share of the length of the drawn arm; the last
is that of all further links."""
TOOL_RADIUS = 0.025
"""[m] Of the tool where none is stated: a bracket with a reflector of 1.5 inches."""
SHORTEST = 1e-6
"""[m] Shorter pieces of links need no capsule, their neighbours cover them."""
SAMPLES = 500
"""Random poses that show which pieces touch by construction."""


@dataclass(frozen=True, eq=False)
class Capsules:
    """Pieces of the links as line segments with a radius, each fixed to two frames of the robot.

    A row of the drawing leads from its joint along the joint's axis by d, and then by a to the next row: these are
    the pieces of its link. The last one is the tool.

    Attributes:
        robot: as drawn, with the tool.
        frame: per piece and end, the frame that the end is fixed to: 0 is the base, i the frame behind row i.
        point: per piece and end, where it is in that frame [m].
        link: per piece, the number of the joint that moves it; 0 for what stands still.
        radius: per piece [m].
        carrier: per piece, whether it carries the robot: it stands before the first joint, or on its axis.
    """

    robot: Robot
    frame: Int64[Tensor, "pieces 2"]
    point: Float64[Tensor, "pieces 2 3"]
    link: Int64[Tensor, " pieces"]
    radius: Float64[Tensor, " pieces"]
    carrier: Bool[Tensor, " pieces"]

    @staticmethod
    def of(
        robot: Robot,
        radius: float | None = None,
        radii: Mapping[str, float] | None = None,
        tool_radius: float = TOOL_RADIUS,
    ) -> "Capsules":
        """Lay capsules along the drawing.

        Args:
            robot: as drawn, with its tool.
            radius: of all links [m]; None for `RADIUS_SHARES` of the arm's length.
            radii: of single links by the names of their rows [m].
            tool_radius: of the tool [m].
        """
        arm_length = float(np.hypot(robot.dh[:, 1], robot.dh[:, 2]).sum())
        moving = np.cumsum([row.type != "fixed" for row in robot.rows])
        zeros = np.zeros(3)
        pieces = []
        for i, (row, (_, d, a, alpha, beta)) in enumerate(zip(robot.rows, robot.dh.tolist(), strict=True)):
            strokes = [
                bound for bound in (row.lower, row.upper) if row.type == "prismatic" and np.isfinite(bound)
            ]
            axis_length = max((abs(d + row.direction * q) for q in strokes), default=abs(d))
            corner = _turned_back(alpha, beta, np.array([-a, 0.0, 0.0]))
            share = RADIUS_SHARES[min(max(moving[i], 1), len(RADIUS_SHARES)) - 1]
            size = (radii or {}).get(row.name, share * arm_length if radius is None else radius)
            carrier = moving[i] <= 1
            pieces.append(((i, i + 1), (zeros, corner), moving[i], size, carrier, axis_length))
            pieces.append(((i + 1, i + 1), (corner, zeros), moving[i], size, False, abs(a)))
        tool, last = robot.tool[:3], len(robot.rows)
        length = float(np.linalg.norm(tool))
        pieces.append(((last, last), (zeros, tool), moving[-1], tool_radius, False, length))
        frames, points, links, sizes, carriers = zip(
            *(piece[:-1] for piece in pieces if piece[-1] > SHORTEST), strict=True
        )
        return Capsules(
            robot,
            torch.tensor(frames),
            torch.from_numpy(np.array(points)),
            torch.tensor(np.array(links), dtype=torch.int64),
            torch.tensor(sizes, dtype=torch.float64),
            torch.tensor(np.array(carriers, dtype=bool)),
        )

    def segments(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch pieces 2 3"]:
        """Both ends of every piece [m], in the frame that poses are given in, at joint values q [rad or m]."""
        frames = torch.stack([*self._frames(q)], -3)[..., self.frame, :, :]
        return (frames[..., :3, :3] @ self.point[..., None])[..., 0] + frames[..., :3, 3]

    def _frames(self, q: Float64[Tensor, "*batch dof"]) -> list[Float64[Tensor, "*batch 4 4"]]:
        rows = list(iterate_rows(self.robot, Geometry.of(self.robot), q.unbind(-1)))
        return [as_transform(frame, q[..., 0]) for frame in (rows[0].before, *(row.after for row in rows))]

    def pairs(self, clearance: float) -> Int64[Tensor, "pairs 2"]:
        """Pairs of pieces that must not touch each other: of links that are no neighbours.

        Pairs that touch in more than half of random poses do so by construction, as in a wrist; the joint limits have
        to keep these apart. Pairs whose distance never changes need no look at it.

        Args:
            clearance: that is wanted between them [m].
        """
        first, second = torch.combinations(torch.arange(len(self.link))).unbind(-1)
        segments = self.segments(self.random_joints())
        distance = segment_distance(segments[:, first], segments[:, second])
        touches = distance < self.radius[first] + self.radius[second] + clearance
        changes = distance.amax(0) - distance.amin(0) > SHORTEST
        wanted = ((self.link[second] - self.link[first]) > 1) & (touches.double().mean(0) < 0.5) & changes
        return torch.stack([first, second], -1)[wanted]

    def random_joints(self) -> Float64[Tensor, "poses dof"]:
        """Joint values [rad or m] within the limits, the same at every call."""
        generator = torch.Generator().manual_seed(0)
        draws = torch.rand(SAMPLES, self.robot.dof, generator=generator, dtype=torch.float64)
        limits = torch.from_numpy(self.robot.limits).clamp(-np.pi, np.pi)
        return limits[:, 0] + (limits[:, 1] - limits[:, 0]) * draws


def _turned_back(alpha: float, beta: float, point: np.ndarray) -> np.ndarray:
    """A point of the frame before `RotX(alpha) · RotY(beta)` in the frame behind it [m]."""
    result: np.ndarray = (turn(0, alpha) @ turn(1, beta))[:3, :3].T @ point
    return result
