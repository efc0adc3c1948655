"""Order of the poses of a plan, waypoints between them, and the duration."""

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
"""Number of poses in the first calibration of a robot that was never measured; fewer do not determine its unknowns."""
_MAX_REORDERINGS = 8
"""Largest number of attempts to avoid blocked motions by reordering; remaining blocked motions get waypoints."""
_MIN_SPEED = 1e-3
"""Smallest valid speed [rad/s or m/s]."""
_MAX_SETTLING = 3600.0
"""Longest valid settling time [s]."""
_DETOUR_FACTOR = 3.0
"""Factor on the duration of a blocked motion while the order is optimised."""


@dataclass(frozen=True)
class Pace:
    """Speeds between poses, and settling time.

    Attributes:
        speed: speed of every revolute joint [rad/s]; the slowest joint determines the duration.
        prismatic_speed: speed of every prismatic joint [m/s].
        settling: time at every pose until the robot is at rest and measured [s].
    """

    speed: float = math.radians(30.0)
    prismatic_speed: float = 0.25
    settling: float = 3.0

    def __post_init__(self) -> None:
        """Refuse values outside their valid range."""
        for option, speed, factor, unit in (
            ("speed", self.speed, math.degrees(1.0), "deg/s"),
            ("prismatic_speed", self.prismatic_speed, 1e3, "mm/s"),
        ):
            if not _MIN_SPEED <= speed < math.inf:
                expected, value = f"a speed >= {factor * _MIN_SPEED:.2g} {unit}", f"{factor * speed:g} {unit}"
                raise PlanningError(expected=expected, value=value, option=option)
        if not 0 <= self.settling <= _MAX_SETTLING:
            expected, value = f"a settling time of 0 to {_MAX_SETTLING:g} s", f"{self.settling:g} s"
            raise PlanningError(expected=expected, value=value, option="settling")

    def motion_duration(
        self, robot: Robot, start: Float64[Tensor, "*#batch dof"], end: Float64[Tensor, "*#batch dof"]
    ) -> Float64[Tensor, "*_batch"]:
        """Compute the duration of joint motions [s], determined by the slowest joint, without acceleration."""
        speed = torch.where(torch.tensor(robot.revolute), self.speed, self.prismatic_speed)
        seconds: Tensor = ((end - start).abs() / speed).amax(-1)
        return seconds


@dataclass(frozen=True, eq=False)
class Tour:
    """An order of poses, with waypoints between them.

    Attributes:
        order: indices of the poses in their order, without poses that no free motion reaches.
        waypoints_before: waypoints before each pose in this order [rad or m]; usually none.
        left_out: indices of the poses to which no free motion was found.
        seconds: total duration [s].
    """

    order: Int64[Tensor, " poses"]
    waypoints_before: tuple[Float64[Tensor, "_points dof"], ...]
    left_out: Int64[Tensor, " others"]
    seconds: float


def plan_tour(
    motions: Motions,
    q: Float64[Tensor, "poses dof"],
    pace: Pace,
    start: Float64[Tensor, " dof"] | None = None,
    stages: Sequence[int] = (),
) -> Tour:
    """Order poses for a short duration, with collision-free motions.

    The nearest-neighbour order is improved by 2-opt (Croes 1958, Operations Research 6(6)), with the durations of the
    straight joint motions. Blocked motions are made expensive and the order is improved again; motions that remain
    blocked get waypoints.

    Args:
        motions: motions of the robot in its surroundings, which store the results of earlier tours.
        q: joint values of the poses, which are all free of collisions [rad or m].
        pace: speeds and settling time.
        start: current joint values of the robot [rad or m]; None for any.
        stages: ascending numbers of poses that are measured before all later ones in `q`: (20, 40) means the first 20
            poses, then the next 20, then the others, each stage in an order of short duration.
    """
    poses = q if start is None else torch.cat([start[None], q])
    seconds = pace.motion_duration(motions.arm.robot, poses[:, None], poses[None]).numpy()
    first = int(start is not None)
    order = np.arange(first)
    ends = [*(end for end in stages if end < len(q)), len(q)]
    for start_of_stage, end in pairwise([0, *ends]):
        stage = np.concatenate([order[-1:], np.arange(start_of_stage, end) + first])
        order = np.concatenate([order[:-1], _ordered(motions, poses, seconds, stage, len(order) > 0)])
    return _with_waypoints(motions, poses, order, pace, start is not None)


def order_of_use(calibration_poses: int, test_poses: int) -> Int64[Tensor, " poses"]:
    """Return an order in which test poses are evenly distributed among the others, which are sorted by usefulness.

    Args:
        calibration_poses: number of poses to calibrate with, numbered from 0.
        test_poses: number of test poses, numbered after these.
    """
    between = (torch.arange(test_poses) + 0.5) * calibration_poses / max(test_poses, 1)
    return torch.cat([torch.arange(calibration_poses) + 0.0, between]).argsort(stable=True)


def stage_ends(poses: int) -> tuple[int, ...]:
    """Return the numbers of poses after which a calibration may suffice: `FIRST_STAGE` times powers of two."""
    return tuple(FIRST_STAGE * 2**k for k in range(poses.bit_length()) if FIRST_STAGE * 2**k < poses)


def _ordered(
    motions: Motions,
    poses: Float64[Tensor, "poses dof"],
    seconds: Float64[np.ndarray, "poses poses"],
    stage: Int64[np.ndarray, " stage"],
    fixed_start: bool,
) -> Int64[np.ndarray, " stage"]:
    """Return the order of the poses of a stage; with `fixed_start` the first pose remains first."""
    times = seconds[np.ix_(stage, stage)]
    order = _nearest_neighbours(times, fixed_start)
    for _ in range(_MAX_REORDERINGS):
        order = _two_opt(times, order, fixed_start)
        path = poses[stage[order]]
        free = motions.are_free(path[:-1], path[1:]).numpy()
        blocked = ~free & (times[order[:-1], order[1:]] < _BLOCKED)
        if not blocked.any():
            break
        one, other = order[:-1][blocked], order[1:][blocked]
        times[one, other] = times[other, one] = _BLOCKED + _DETOUR_FACTOR * times[one, other]
    return np.take(stage, order)


_BLOCKED = 1e4
"""Penalty on the duration of blocked motions [s], longer than any motion."""


def _nearest_neighbours(seconds: Float64[np.ndarray, "poses poses"], fixed_start: bool) -> np.ndarray:
    """Return the best nearest-neighbour order from every pose, or only from the first pose."""
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
    """Return the order after reversing parts of it as long as this saves time; both ends are open."""
    count, first = len(order), 1 if fixed_start else 0
    while count > 2:
        times = seconds[np.ix_(order, order)]
        steps = np.diagonal(times, 1)
        before = np.concatenate([[0.0], steps])  # into the part from i to j, and out of it
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


def _with_waypoints(
    motions: Motions, poses: Float64[Tensor, "poses dof"], order: np.ndarray, pace: Pace, fixed_start: bool
) -> Tour:
    """Return the tour with waypoints in blocked motions, and without poses that cannot be reached."""
    stops, before, left_out = [int(order[0])], [poses[:0]], []
    for stop in order[1:].tolist():
        points = motions.points_between(poses[stops[-1]], poses[stop])
        movable = len(stops) > int(fixed_start)
        if points is None and movable and motions.is_harder_to_leave(poses[stops[-1]], poses[stop]):
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
    seconds = float(pace.motion_duration(motions.arm.robot, path[:-1], path[1:]).sum())
    return Tour(
        torch.tensor(stops[first:], dtype=torch.int64) - first,
        tuple(before[first:]),
        torch.tensor(left_out, dtype=torch.int64) - first,
        seconds + pace.settling * len(stops[first:]),
    )
