"""Rigid transforms before and behind predicted poses that explain measured ones best, in closed form."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.identification.initial_guess.base_and_tool_closed_form import (
    nearest_rotation,
    starts_from_positions,
)
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import transform

LEVER_SHARE = 0.2
"""A rotation error counts like a position error at this share of the reach."""
ALTERNATIONS = 200
SETTLED = 1e-6
"""Alternating ends when a round lowers the cost by less than this share."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What was measured, ready for comparison with predicted poses.

    Attributes:
        position: measured positions [m].
        rotation: measured rotations; the identity where none was measured.
        turned: rows with a rotation.
        lever: a rotation error counts like a position error at this distance [m].
    """

    position: Float64[Tensor, "rows 3"]
    rotation: Float64[Tensor, "rows 3 3"]
    turned: Bool[Tensor, " rows"]
    lever: float

    @staticmethod
    def of(measurements: Measurements, lever: float) -> "Seen":
        """What measurements hold; every row has a position."""
        assert measurements.position is not None
        eye = torch.eye(3, dtype=torch.float64)
        if measurements.rotation is None:
            turned = torch.zeros(measurements.rows, dtype=torch.bool)
            return Seen(measurements.position, eye.expand(measurements.rows, 3, 3), turned, lever)
        turned = torch.isfinite(measurements.rotation).flatten(1).all(-1)
        rotation = torch.where(turned[:, None, None], measurements.rotation, eye)
        return Seen(measurements.position, rotation, turned, lever)

    def select(self, rows: Tensor) -> "Seen":
        """The rows of a mask or an index."""
        return Seen(self.position[rows], self.rotation[rows], self.turned[rows], self.lever)

    def scaled(self, factor: float) -> "Seen":
        """The same with positions times a factor."""
        return Seen(self.position * factor, self.rotation, self.turned, self.lever)

    @property
    def values(self) -> int:
        """How many numbers were measured that are independent."""
        return 3 * len(self.position) + 3 * int(self.turned.sum())

    def squares(self, T: Float64[Tensor, "*batch rows 4 4"]) -> Float64[Tensor, "*batch rows"]:
        """Squared errors of predicted poses `|dp|² + lever² |dR|² / 2` [m²]; |dR|²/2 is about the angle squared."""
        off = (self.position - T[..., :3, 3]).square().sum(-1)
        turn = (self.rotation - T[..., :3, :3]).square().sum((-2, -1)) / 2
        return off + self.lever**2 * torch.where(self.turned, turn, 0.0)


def best_base(T: Float64[Tensor, "*batch rows 4 4"], seen: Seen) -> Float64[Tensor, "*batch 4 4"]:
    """The transform X for which `X T` are nearest to what was measured (weighted orthogonal Procrustes)."""
    middle, wanted = T[..., :3, 3].mean(-2, keepdim=True), seen.position.mean(0)
    M = (seen.position - wanted).mT @ (T[..., :3, 3] - middle)
    if bool(seen.turned.any()):
        turned = seen.turned.to(T)[:, None, None]
        M = M + seen.lever**2 / 2 * (turned * seen.rotation @ T[..., :3, :3].mT).sum(-3)
    R = nearest_rotation(M)
    return transform(R, wanted - (R @ middle.mT)[..., 0])


def best_tool(T: Float64[Tensor, "*batch rows 4 4"], seen: Seen) -> Float64[Tensor, "*batch 4 4"]:
    """The transform X for which `T X` are nearest to what was measured; without a turn where none was measured."""
    R = T[..., :3, :3]
    place = (R.mT @ (seen.position - T[..., :3, 3])[..., None])[..., 0].mean(-2)
    if not bool(seen.turned.any()):
        return transform(torch.eye(3).to(T), place)
    turned = seen.turned.to(T)[:, None, None]
    return transform(nearest_rotation((turned * R.mT @ seen.rotation).sum(-3)), place)


def best_base_and_tool(
    T: Float64[Tensor, "rows 4 4"], seen: Seen, reach: float
) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]]:
    """Transforms X, Y for which `X T Y` are nearest to what was measured, by alternating from two starts.

    Args:
        T: predicted poses.
        seen: what was measured there.
        reach: of the robot [m].
    """
    eye = torch.eye(4).to(T)
    starts = [eye]
    found = next(
        starts_from_positions(T[:, :3, :3], T[:, :3, 3], seen.position, torch.zeros(3, dtype=T.dtype), reach),
        None,
    )
    if found is not None:
        starts.append(transform(eye[:3, :3], found[2]))
    return min((_alternated(T, seen, start) for start in starts), key=lambda ends: ends[0])[1:]


def _alternated(
    T: Float64[Tensor, "rows 4 4"], seen: Seen, tool: Float64[Tensor, "4 4"]
) -> tuple[float, Tensor, Tensor]:
    """The cost, base and tool that alternating ends with."""
    cost, base = float("inf"), torch.eye(4).to(T)
    for _ in range(ALTERNATIONS):
        base = best_base(T @ tool, seen)
        tool = best_tool(base @ T, seen)
        before, cost = cost, float(seen.squares(base @ T @ tool).sum())
        if cost >= before * (1 - SETTLED):
            break
    return cost, base, tool
