"""In which order to go to the poses of a plan, by what way points, and how long that takes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import PlanningError
from pisigma.planning.surroundings.motion import Motions
from pisigma.robot.description import Robot

FIRST_STAGE = 20
"""Poses with which a robot that was never measured is calibrated first: fewer do not determine its unknowns."""
ROUNDS = 8
"""So often motions that turn out to be blocked are avoided by another order; what is left gets way points."""
SLOWEST = 1e-3
"""[rad/s or m/s] No robot goes from pose to pose more slowly."""
LONGEST_SETTLING = 3600.0
"""[s] At a pose."""
DETOUR = 3.0
"""A blocked motion counts as this many times its time while the order is looked for."""


@dataclass(frozen=True)
class Pace:
    """How fast the robot goes from pose to pose.

    Attributes:
        speed: of every joint that turns [rad/s]; the joint that needs longest decides.
        slide: of every joint that slides [m/s].
        settling: time at every pose until the robot is still and was measured [s].
    """

    speed: float = math.radians(30.0)
    slide: float = 0.25
    settling: float = 3.0

    def __post_init__(self) -> None:
        """Refuse times that are none."""
        if not all(SLOWEST <= speed < math.inf for speed in (self.speed, self.slide)) or not (
            0 <= self.settling <= LONGEST_SETTLING
        ):
            slowest = f"{math.degrees(SLOWEST):.2g} deg/s or {SLOWEST * 1e3:g} mm/s"
            raise PlanningError(
                f"speeds of {slowest} and more and a settling time of 0 to {LONGEST_SETTLING:g} s were wanted, got "
                f"{math.degrees(self.speed):g} deg/s, {self.slide * 1e3:g} mm/s and {self.settling:g} s."
            )

    def seconds(
        self, robot: Robot, start: Float64[Tensor, "*#batch dof"], end: Float64[Tensor, "*#batch dof"]
    ) -> Float64[Tensor, "*_batch"]:
        """Time of motions between joint values [s]: of the joint that needs longest, without its acceleration."""
        speed = torch.where(torch.tensor(robot.revolute), self.speed, self.slide)
        seconds: Tensor = ((end - start).abs() / speed).amax(-1)
        return seconds


@dataclass(frozen=True, eq=False)
class Tour:
    """An order of poses.

    Attributes:
        order: the poses, as they follow each other; those that no free motion was found to are left out.
        before: per pose in this order, the way points that lead to it [rad or m]; mostly none.
        left_out: poses that no free motion was found to.
        seconds: that all takes.
    """

    order: Int64[Tensor, " poses"]
    before: tuple[Float64[Tensor, "_points dof"], ...]
    left_out: Int64[Tensor, " others"]
    seconds: float


def tour(
    motions: Motions,
    q: Float64[Tensor, "poses dof"],
    pace: Pace,
    start: Float64[Tensor, " dof"] | None = None,
    stages: Sequence[int] = (),
) -> Tour:
    """Order poses so that all of it takes little time, by motions that touch nothing.

    Nearest neighbour, then 2-opt (Croes 1958, Operations Research 6(6)), on the time of the straight motions. Motions
    that are blocked are made expensive and the order is improved again; those that stay get way points.

    Args:
        motions: of the robot in its cell; they know those of earlier tours.
        q: joint values [rad or m] of the poses, each of them free.
        pace: of the robot.
        start: joint values where the robot stands [rad or m]; None for anywhere.
        stages: numbers of poses that are gone to before all that follow in `q`, ascending, such as (20, 40): the
            first 20 poses, then the next 20, then the rest, each in the order that takes little time.
    """
    poses = q if start is None else torch.cat([start[None], q])
    seconds = pace.seconds(motions.arm.robot, poses[:, None], poses[None]).numpy()
    first = int(start is not None)
    order = np.arange(first)
    ends = [*(end for end in stages if end < len(q)), len(q)]
    for begin, end in pairwise([0, *ends]):
        stage = np.concatenate([order[-1:], np.arange(begin, end) + first])
        order = np.concatenate([order[:-1], _ordered(motions, poses, seconds, stage, len(order) > 0)])
    return _with_way_points(motions, poses, order, pace, start is not None)


def order_of_use(chosen: int, check: int) -> Int64[Tensor, " poses"]:
    """Put poses that check a calibration evenly between chosen ones, of which the most useful stand first.

    Args:
        chosen: how many poses there are to calibrate with, numbered from 0.
        check: how many there are to check with, numbered after these.
    """
    between = (torch.arange(check) + 0.5) * chosen / max(check, 1)
    return torch.cat([torch.arange(chosen) + 0.0, between]).argsort(stable=True)


def stages_of(poses: int) -> tuple[int, ...]:
    """Numbers of poses after which a calibration may be good enough, `FIRST_STAGE` and ever twice as many."""
    return tuple(FIRST_STAGE * 2**k for k in range(poses.bit_length()) if FIRST_STAGE * 2**k < poses)


def _ordered(
    motions: Motions,
    poses: Float64[Tensor, "poses dof"],
    seconds: Float64[np.ndarray, "poses poses"],
    stage: Int64[np.ndarray, " stage"],
    fixed_start: bool,
) -> Int64[np.ndarray, " stage"]:
    """Some of the poses in an order that takes little time, the first of them where the robot stands or not."""
    times = seconds[np.ix_(stage, stage)]
    order = _nearest_neighbours(times, fixed_start)
    for _ in range(ROUNDS):
        order = _two_opt(times, order, fixed_start)
        path = poses[stage[order]]
        free = motions.are_free(path[:-1], path[1:]).numpy()
        blocked = ~free & (times[order[:-1], order[1:]] < _BLOCKED)
        if not blocked.any():
            break
        one, other = order[:-1][blocked], order[1:][blocked]
        times[one, other] = times[other, one] = _BLOCKED + DETOUR * times[one, other]
    return np.take(stage, order)


_BLOCKED = 1e4
"""[s] Added to the time of motions that are blocked: longer than any motion."""


def _nearest_neighbours(seconds: Float64[np.ndarray, "poses poses"], fixed_start: bool) -> np.ndarray:
    """Always go to the nearest pose that is left, from every pose as the first one (or from the first alone)."""
    best: list[int] = []
    shortest = math.inf
    for first in range(1 if fixed_start else len(seconds)):
        order, left = [first], np.ones(len(seconds), dtype=bool)
        left[first], total = False, 0.0
        while left.any():
            step = np.where(left, seconds[order[-1]], math.inf)
            order.append(int(step.argmin()))
            total += float(step.min())
            left[order[-1]] = False
        if total < shortest:
            best, shortest = order, total
    return np.array(best)


def _two_opt(seconds: Float64[np.ndarray, "poses poses"], order: np.ndarray, fixed_start: bool) -> np.ndarray:
    """Turn stretches of the order round as long as that saves time; the ends are open."""
    count, first = len(order), 1 if fixed_start else 0
    while count > 2:
        times = seconds[np.ix_(order, order)]
        steps = np.diagonal(times, 1)
        before = np.concatenate([[0.0], steps])  # into the stretch i to j, and out of it
        after = np.concatenate([steps, [0.0]])
        into = np.vstack([np.zeros(count), times[:-1]])  # from i - 1 to j
        out = np.hstack([times[:, 1:], np.zeros((count, 1))])  # from i to j + 1
        saved = np.triu(before[:, None] + after[None] - into - out, 1)
        saved[:first] = 0.0
        i, j = np.unravel_index(int(saved.argmax()), saved.shape)
        if saved[i, j] < 1e-9:
            break
        order = np.concatenate([order[:i], order[i : j + 1][::-1], order[j + 1 :]])
    return order


def _with_way_points(
    motions: Motions, poses: Float64[Tensor, "poses dof"], order: np.ndarray, pace: Pace, fixed_start: bool
) -> Tour:
    """Put way points in where a motion is blocked, and leave out poses that none leads to."""
    stops, before, left_out = [int(order[0])], [poses[:0]], []
    for stop in order[1:].tolist():
        points = motions.points_between(poses[stops[-1]], poses[stop])
        movable = len(stops) > int(fixed_start)
        if points is None and movable and motions.is_shut_in(poses[stops[-1]], poses[stop]):
            left_out.append(stops.pop())
            before.pop()
            points = motions.points_between(poses[stops[-1]], poses[stop]) if stops else poses[:0]
        if points is None:
            left_out.append(stop)
        else:
            stops.append(stop)
            before.append(points)
    path = torch.cat([torch.cat([points, poses[[stop]]]) for stop, points in zip(stops, before, strict=True)])
    first = int(fixed_start)
    seconds = float(pace.seconds(motions.arm.robot, path[:-1], path[1:]).sum())
    return Tour(
        torch.tensor(stops[first:], dtype=torch.int64) - first,
        tuple(before[first:]),
        torch.tensor(left_out, dtype=torch.int64) - first,
        seconds + pace.settling * len(stops[first:]),
    )
