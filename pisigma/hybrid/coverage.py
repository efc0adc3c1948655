"""Which joint values were measured, and how a correction fades beyond them."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from pisigma.joint_correction.feature import turning_rate
from pisigma.robot.description import Robot

LARGEST_GAP = math.radians(60)
"""Joint values between two measured ones that are not farther apart than this count as measured."""
FADE = math.radians(15)
"""Over so much beyond the measured joint values a correction fades to nothing, unless the data say otherwise."""


@dataclass(frozen=True, eq=False)
class JointCoverage:
    """Stretches of every joint's values that were measured, as angles (see `turning_rate`).

    Attributes:
        joint: number of the joint of every stretch.
        middle: of the stretch [rad].
        half: half its length [rad].
        rate: per joint, angle per joint value.
        turning: per joint, whether values a full turn apart are the same.
        fade: angle beyond the stretches over which a correction fades to nothing [rad].
    """

    joint: Int64[Tensor, " stretches"]
    middle: Float64[Tensor, " stretches"]
    half: Float64[Tensor, " stretches"]
    rate: Float64[Tensor, " dof"]
    turning: tuple[bool, ...]
    fade: float = FADE

    @staticmethod
    def of(robot: Robot, q: Float64[Tensor, "rows dof"], fade: float = FADE) -> "JointCoverage":
        """Stretches around measured joint values."""
        rate = torch.from_numpy(turning_rate(robot))
        turning = tuple(bool(turns) for turns in robot.revolute)
        found: list[tuple[int, float, float]] = []
        for j, values in enumerate((q.cpu() * rate).t()):
            found += [(j, low, high) for low, high in _stretches(values.numpy(), turning[j])]
        joint = torch.tensor([j for j, _, _ in found], dtype=torch.int64)
        ends = torch.tensor([[low, high] for _, low, high in found], dtype=torch.float64)
        return JointCoverage(joint, ends.mean(1), (ends[:, 1] - ends[:, 0]) / 2, rate, turning, fade)

    def beyond(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Angle from every joint value to the nearest measured stretch [rad], 0 within one."""
        angle = q * self.rate.to(q)
        columns = []
        for j, turns in enumerate(self.turning):
            own = self.joint == j
            off = angle[..., j, None] - self.middle[own].to(q)
            if turns:
                off = off - 2 * math.pi * torch.round(off / (2 * math.pi))
            columns.append((off.abs() - self.half[own].to(q)).clamp(min=0).amin(-1))
        return torch.stack(columns, -1)

    def share(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch"]:
        """How much of a correction is in force: 1 where every joint was measured, 0 from `fade` beyond on."""
        return share_beyond(self.beyond(q).amax(-1), self.fade)


def share_beyond(beyond: Float[Tensor, "*batch"], fade: float) -> Float[Tensor, "*batch"]:
    """Share of a correction that is left at some angle beyond the measured joint values [rad]; smooth."""
    off = (beyond / fade).clamp(max=1.0)
    return 1 - off.square() * (3 - 2 * off)


def _stretches(angles: np.ndarray, turns: bool) -> list[tuple[float, float]]:
    """Lowest and highest angle of every stretch without a large gap; one may reach over the full turn."""
    values = np.unique(np.mod(angles, 2 * np.pi) if turns else angles)
    breaks = np.flatnonzero(np.diff(values) > LARGEST_GAP)
    lows = values[np.concatenate([[0], breaks + 1])]
    highs = values[np.concatenate([breaks, [len(values) - 1]])]
    if turns and values[0] + 2 * np.pi - values[-1] <= LARGEST_GAP:
        if len(lows) == 1:
            return [(0.0, 2 * np.pi)]
        lows, highs = lows[1:], np.concatenate([highs[1:-1], [highs[0] + 2 * np.pi]])
    return [(float(low), float(high)) for low, high in zip(lows, highs, strict=True)]
