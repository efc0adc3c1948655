"""Which joint values were measured, and how a correction fades beyond them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.hybrid.design import Design, Rows, sum_up
from pisigma.hybrid.evidence import Posterior, Sums, maximise_evidence, solve_mean
from pisigma.joint_correction.feature import turning_rate
from pisigma.robot.description import Robot

LARGEST_GAP = math.radians(60)
"""Joint values between two measured ones that are not farther apart than this count as measured."""
FADE = math.radians(15)
"""Over so much beyond the measured joint values a correction fades to nothing, unless the data say otherwise."""
TAIL = 0.2
"""Share of the configurations at either end of a joint's range that is left out."""
FADES = tuple(math.radians(angle) for angle in (1, 5, 10, 15, 20, 30, 45))
"""Angles [rad] that are tried."""
DENSE = 200
"""From so many configurations on, joint values beyond the measured ones are rare, and no way into them is safe far."""
DENSE_FADE = math.radians(10)
"""Longest angle then."""


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
        stretches = [_stretches(angles.numpy(), turning[j]) for j, angles in enumerate((q.cpu() * rate).t())]
        joint = torch.arange(robot.dof).repeat_interleave(torch.tensor([len(ends) for ends in stretches]))
        ends = torch.tensor([pair for pairs in stretches for pair in pairs], dtype=torch.float64)
        return JointCoverage(joint, ends.mean(1), (ends[:, 1] - ends[:, 0]) / 2, rate, turning, fade)

    def beyond(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Angle from every joint value to the nearest measured stretch [rad], 0 within one."""
        angle = q * self.rate.to(q)
        columns = []
        for j, turns in enumerate(self.turning):
            here = self.joint == j
            off = angle[..., j, None] - self.middle[here].to(q)
            if turns:
                off = off - 2 * math.pi * torch.round(off / (2 * math.pi))
            columns.append((off.abs() - self.half[here].to(q)).clamp(min=0).amin(-1))
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


def fade_angle(rows: Rows, design: Design, hybrid: Posterior, sums: Sums) -> float:
    """Angle beyond the measured joint values over which a correction fades best [rad].

    For either end of every joint, the hybrid and the geometry alone are solved without the outermost
    configurations (prior sizes and noise as they are) and predict them. The angle is that of `FADES` whose blend of
    the two predictions errs least; it is not longer than those rows are far out. Of few configurations new ones
    often lie far beyond the measured joint values, so it may be long; of many it is not longer than `DENSE_FADE`:
    on the UR5 the outermost rows did not tell how the correction errs 20 to 70 degrees out.

    Args:
        rows: linearised values.
        design: unknowns of the hybrid.
        hybrid: posterior of them.
        sums: normal equations of all rows.
    """
    q, robot = rows.problem.q, rows.problem.space.robot
    geometry = torch.arange(design.active, device=q.device)
    alone = sums.select(geometry)
    geometric = maximise_evidence(alone, hybrid.prior.select(geometry), hybrid.noise)
    before, after, beyond = [], [], []
    for tail in _tails(rows):
        test = rows.of(tail)
        part = sum_up(design, test.values, test.start(design))
        x_alone = solve_mean(alone.minus(part.select(geometry)), geometric.prior, geometric.noise)
        x = solve_mean(sums.minus(part), hybrid.prior, hybrid.noise)
        off = JointCoverage.of(robot, q[~tail[rows.configuration]]).beyond(q).amax(-1)
        for sensor, sigma in zip(test.values, geometric.noise, strict=True):
            if not sensor.certain:
                X = design.columns(sensor, slice(None))
                y = sensor.residual + X @ test.start(design)
                root = sensor.root[:, None] / sigma
                before.append(((y - X[..., : design.active] @ x_alone) * root).flatten())
                after.append(((y - X @ x) * root).flatten())
                beyond.append(off[sensor.row].repeat_interleave(sensor.components))
    if not beyond:
        return FADES[0]
    longest = DENSE_FADE if rows.configurations >= DENSE else FADES[-1]
    return _best(torch.cat(beyond), torch.cat(before), torch.cat(after), longest)


def _best(beyond: Tensor, before: Tensor, after: Tensor, longest: float) -> float:
    """The angle of the blend that errs least."""
    candidates = [angle for angle in FADES if angle <= max(min(float(beyond.max()), longest), FADES[0])]
    costs = []
    for angle in candidates:
        share = share_beyond(beyond, angle)
        costs.append(float((share * after + (1 - share) * before).square().sum()))
    return candidates[costs.index(min(costs))]


def _tails(rows: Rows) -> Iterator[Bool[Tensor, " configurations"]]:
    """The outermost configurations at either end of every joint."""
    q = rows.problem.q
    count = rows.configurations
    first = torch.full((count,), len(q), dtype=torch.int64, device=q.device)
    first = first.scatter_reduce(0, rows.configuration, torch.arange(len(q), device=q.device), "amin")
    size = max(math.ceil(TAIL * count), 1)
    for values in q[first].t():
        order = values.argsort()
        for end in (order[:size], order[-size:]):
            mask = torch.zeros(count, dtype=torch.bool, device=q.device)
            mask[end] = True
            if size < count and float(values[end].max() - values[end].min()) > 0:
                yield mask
