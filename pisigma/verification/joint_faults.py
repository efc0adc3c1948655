"""Setup faults of joint columns: order, sign, unit and zero, as maps of logged joint values that are tried on rows."""

import itertools
import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.judging.frame_fits import MeasuredPoses, best_base
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import poses_of_rows
from pisigma.robot.description import Robot
from pisigma.se3 import wrap_to_pi

QUARTER = math.pi / 2
ALMOST = math.radians(0.5)
"""A zero this near to a quarter turn is meant to be there [rad]."""
MOST_ORDERS = 5040
"""Of seven joints; with more only two of them are exchanged."""
MOST_ZEROS = 4**7
SCREEN_ROWS = 32
"""Rows that every map is tried on."""
NOTICED = 2e-5
"""Errors below this count as none [m]."""
PROMISING = 0.5
"""Share of the errors that is left, at most, where a map is looked at again."""
KEPT = 3
"""Maps of each kind that are looked at again, at most."""
NEAR_BEST = 4.0
"""Maps whose errors are larger than the best by this factor are not."""
STEPS = 36
"""A zero is searched on a grid of so many values to either side, which then is made finer."""
FINER = 7
"""Times that the grid is made finer."""
_MOST_POSES = 2**17


@dataclass(frozen=True, eq=False)
class JointMaps:
    """Maps `q -> factor · q[order] + offset` of joint values, one per hypothesis.

    Attributes:
        order: which logged column is meant for each joint.
        factor: of each joint.
        offset: of each joint [rad or m].
    """

    order: Int64[Tensor, "maps dof"]
    factor: Float64[Tensor, "maps dof"]
    offset: Float64[Tensor, "maps dof"]

    @staticmethod
    def unchanged(count: int, dof: int) -> "JointMaps":
        """Return maps that change nothing."""
        ones = torch.ones(count, dof, dtype=torch.float64)
        return JointMaps(torch.arange(dof).expand(count, dof), ones, torch.zeros_like(ones))

    def of(self, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "maps rows dof"]:
        """Map joint values [rad or m]."""
        return q[:, self.order].movedim(0, 1) * self.factor[:, None] + self.offset[:, None]

    def select(self, index: Int64[Tensor, " chosen"]) -> "JointMaps":
        """Select some of the maps."""
        return JointMaps(self.order[index], self.factor[index], self.offset[index])


def reversed_signs(dof: int) -> JointMaps:
    """List all ways to reverse signs."""
    choices = list(itertools.product((1.0, -1.0), repeat=dof))[1:]
    return replace(JointMaps.unchanged(len(choices), dof), factor=torch.tensor(choices, dtype=torch.float64))


def other_orders(dof: int) -> JointMaps:
    """List all orders of the joints; of more than seven the exchanges of two."""
    if math.factorial(dof) <= MOST_ORDERS:
        orders = torch.tensor(list(itertools.permutations(range(dof)))[1:], dtype=torch.int64).reshape(
            -1, dof
        )
        return replace(JointMaps.unchanged(len(orders), dof), order=orders)
    pairs = torch.combinations(torch.arange(dof))
    maps = JointMaps.unchanged(len(pairs), dof)
    return replace(maps, order=maps.order.scatter(1, pairs, pairs.flip(1)))


def other_units(robot: Robot) -> JointMaps:
    """List degrees for radians and the reverse in any of the joints that turn, mm for m in those that slide."""
    rows: list[list[float]] = []
    for revolute, per_unit in ((True, math.degrees(1)), (False, 1e3)):
        joints = [i for i, turns in enumerate(robot.revolute) if turns == revolute]
        for count in range(1, len(joints) + 1):
            for some in itertools.combinations(joints, count):
                rows += [
                    [factor if i in some else 1.0 for i in range(robot.dof)]
                    for factor in (per_unit, 1 / per_unit)
                ]
    factors = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), robot.dof)
    return replace(JointMaps.unchanged(len(rows), robot.dof), factor=factors)


def quarter_turned_zeros(robot: Robot) -> JointMaps:
    """List zeros moved by quarter turns of any joints that turn; of one joint at a time where these are too many."""
    turning = [i for i, revolute in enumerate(robot.revolute) if revolute]
    if 4 ** len(turning) <= MOST_ZEROS:
        choices = np.array(list(itertools.product((0, 1, 2, -1), repeat=len(turning)))[1:])
    else:
        choices = np.concatenate([k * np.eye(len(turning)) for k in (1, 2, -1)])
    offset = np.zeros((len(choices), robot.dof))
    offset[:, turning] = choices * QUARTER
    return replace(JointMaps.unchanged(len(choices), robot.dof), offset=torch.from_numpy(offset))


def moved_zeros(joints: Int64[Tensor, " maps"], by: Float64[Tensor, " maps"], dof: int) -> JointMaps:
    """Move the zero of one joint by so much [rad or m] in each map."""
    maps = JointMaps.unchanged(len(joints), dof)
    return replace(maps, offset=maps.offset.index_put((torch.arange(len(joints)), joints), by))


@dataclass(frozen=True)
class Cause:
    """One thing that is wrong with the setup.

    Attributes:
        kind: "frame", "tool", "position_unit", "joint_unit", "joint_order", "joint_sign", "joint_zero" or
            "correction".
        clause: what is wrong, such as "the sign of joint 3 is reversed".
        advice: what it means or what to check.
        size: how much is assumed, 1 at least; of what explains equally well, the smallest is believed.
        joints: the joints that it is about, from 0.
    """

    kind: str
    clause: str
    advice: str
    size: float
    joints: tuple[int, ...] = ()


def joint_causes(maps: JointMaps, number: int, robot: Robot) -> tuple[Cause, ...]:
    """Say what a map takes to be wrong with the joint columns."""
    order, factor, offset = (values[number].tolist() for values in (maps.order, maps.factor, maps.offset))
    causes = []
    moved = tuple(i for i, column in enumerate(order) if column != i)
    advice = "check the order of the joint columns"
    if len(moved) == 2:
        clause = f"the columns of {_joints(moved)} are swapped"
        causes.append(Cause("joint_order", clause, advice, 1.0, moved))
    elif moved:
        columns = ", ".join(f"q{column + 1}" for column in order)
        clause = f"the joint columns stand in another order (joints 1 to {robot.dof} are in {columns})"
        causes.append(Cause("joint_order", clause, advice, 2.0, moved))
    if negative := tuple(i for i, value in enumerate(factor) if value < 0):
        signs = "the sign of {} is reversed" if len(negative) == 1 else "the signs of {} are reversed"
        clause = signs.format(_joints(negative))
        causes.append(
            Cause("joint_sign", clause, "check the directions of the joints", float(len(negative)), negative)
        )
    causes.extend(_unit_causes(factor, robot))
    if zeros := tuple(i for i, value in enumerate(offset) if value):
        causes.append(_zero_cause(zeros, offset, robot))
    return tuple(causes)


def _unit_causes(factor: list[float], robot: Robot) -> list[Cause]:
    causes = []
    for revolute, small, large in ((True, "degrees", "radians"), (False, "millimetres", "metres")):
        joints = [i for i, turns in enumerate(robot.revolute) if turns == revolute]
        for too_large in (True, False):
            wrong = tuple(i for i in joints if abs(factor[i]) != 1 and (abs(factor[i]) < 1) == too_large)
            if wrong:
                named, are = (large, small) if too_large else (small, large)
                clause = f"the values of {_joints(wrong)} are {are} that are named {named}"
                size = 1.0 if list(wrong) == joints else float(len(wrong))
                causes.append(
                    Cause("joint_unit", clause, "correct the unit in the column names", size, wrong)
                )
    return causes


def _zero_cause(joints: tuple[int, ...], offset: list[float], robot: Robot) -> Cause:
    clauses = []
    size = 0.0
    for i in joints:
        turns = robot.revolute[i]
        by = f"{math.degrees(offset[i]):.4g} deg" if turns else f"{offset[i] * 1e3:.4g} mm"
        clauses.append(f"joint {i + 1} has moved by {by}")
        size += 1.0 if turns and is_quarter(offset[i]) else 1.5
    advice = "check the zeros of the joints"
    if joints == (0,):
        advice += " (a measuring frame that is turned about or shifted along the first axis looks the same)"
    elif joints == (robot.dof - 1,):
        advice += " (a tool that is turned about or shifted along the last axis looks the same)"
    return Cause("joint_zero", " and ".join(clauses), advice, size, joints)


def is_quarter(angle: float) -> bool:
    """Say whether an angle [rad] is a multiple of a quarter turn."""
    return abs(math.remainder(angle, QUARTER)) < 1e-12


def _joints(joints: tuple[int, ...]) -> str:
    numbers = [str(i + 1) for i in joints]
    if len(joints) == 1:
        return f"joint {numbers[0]}"
    if len(joints) > 2 and joints[-1] - joints[0] == len(joints) - 1:
        return f"joints {numbers[0]} to {numbers[-1]}"
    return f"joints {', '.join(numbers[:-1])} and {numbers[-1]}"


@dataclass(frozen=True, eq=False)
class _Trial:
    """Some rows, and the geometry alone as the model.

    Attributes:
        model: without what costs time; maps are tried on it before the whole model judges them.
        some: rows of one frame.
        measured: their poses.
    """

    model: CalibratedModel
    some: Measurements
    measured: MeasuredPoses

    def errors(self, maps: JointMaps) -> Float64[Tensor, "2 maps"]:
        """Compute the mean squared errors [m²] with every map: in the frame as it is, and in one fitted to the map."""
        chunks = torch.split(torch.arange(len(maps.order)), max(1, _MOST_POSES // self.some.rows))
        return torch.cat([self._errors(maps.select(chunk)) for chunk in chunks], 1)

    def _errors(self, maps: JointMaps) -> Float64[Tensor, "2 maps"]:
        q, count = maps.of(self.some.q), len(maps.order)
        repeated = Measurements(
            q=q.flatten(0, 1), frame=self.some.frame * count, target=self.some.target * count
        )
        T = poses_of_rows(self.model, repeated).reshape(*q.shape[:2], 4, 4)
        fitted = best_base(T, self.measured)[:, None] @ T
        return torch.stack([self.measured.squares(poses).mean(-1) for poses in (T, fitted)])


def likely_maps(model: CalibratedModel, measurements: Measurements, measured: MeasuredPoses) -> JointMaps:
    """Find maps of joint values that may explain what was measured, to be tried with the whole model.

    Thousands of maps are tried on a few rows with the geometry alone, with the measuring frame as it is and with one
    that is fitted to every map.

    Args:
        model: the model.
        measurements: rows with positions.
        measured: their poses.
    """
    rows, robot = _screened_rows(measurements), model.robot
    trial = _Trial(
        replace(model, hybrid=None, network=None), measurements.select(rows), measured.select(rows)
    )
    kinds = (
        other_units(robot),
        reversed_signs(robot.dof),
        other_orders(robot.dof),
        quarter_turned_zeros(robot),
    )
    tried = [(maps, trial.errors(maps)) for maps in kinds]
    unchanged = trial.errors(JointMaps.unchanged(1, robot.dof))[:, 0].tolist()
    likely: list[JointMaps] = []
    for frame in (0, 1):
        zeros = _best_zeros(trial, frame)
        candidates = [(maps, errors[frame]) for maps, errors in (*tried, (zeros, trial.errors(zeros)))]
        least = min(float(errors.min()) for _, errors in candidates if len(errors))
        limit = min(PROMISING**2 * unchanged[frame], max(NEAR_BEST**2 * least, NOTICED**2))
        for maps, errors in candidates:
            best = errors.argsort()[:KEPT]
            likely.append(maps.select(best[errors[best] <= limit]))
    return _distinct(likely)


def _screened_rows(measurements: Measurements) -> Int64[Tensor, " chosen"]:
    """Choose rows of the frame that most rows are of, spread over them."""
    frame = Counter(measurements.frame).most_common(1)[0][0]
    rows = torch.tensor([name == frame for name in measurements.frame]).nonzero()[:, 0]
    count = min(len(rows), SCREEN_ROWS)
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]


def _best_zeros(trial: _Trial, frame: int) -> JointMaps:
    """Find per joint the zero that explains most, moved by any amount; by a quarter turn where it is almost one.

    Args:
        trial: what to explain.
        frame: 0 for the frame as it is, 1 for one that is fitted to every map.
    """
    robot, dof = trial.model.robot, trial.model.robot.dof
    width = torch.tensor(
        [torch.pi if turns else robot.reach for turns in robot.revolute], dtype=torch.float64
    )
    by = torch.zeros(dof, dtype=torch.float64)
    joints = torch.arange(dof).repeat_interleave(2 * STEPS + 1)
    grid = torch.linspace(-1, 1, 2 * STEPS + 1, dtype=torch.float64)
    for _ in range(FINER):
        tried = by[:, None] + width[:, None] * grid
        errors = trial.errors(moved_zeros(joints, tried.flatten(), dof))[frame].reshape(tried.shape)
        by = tried.gather(1, errors.argmin(1, keepdim=True))[:, 0]
        width = width * 2 / STEPS
    near = (by / QUARTER).round() * QUARTER
    near = torch.where(near < -1.5 * QUARTER, -near, near)
    turning = torch.tensor(robot.revolute)
    by = torch.where(turning & (wrap_to_pi(by - near).abs() < ALMOST) & (near != 0), near, by)
    return moved_zeros(torch.arange(dof), by, dof)


def _distinct(likely: list[JointMaps]) -> JointMaps:
    """Join all maps that change something, each once."""
    joined = JointMaps(
        *(torch.cat([getattr(m, name) for m in likely]) for name in ("order", "factor", "offset"))
    )
    dof = joined.order.shape[1]
    unchanged = (*range(dof), *[1.0] * dof, *[0.0] * dof)
    values = torch.cat([joined.order.double(), joined.factor, joined.offset], 1)
    first: dict[tuple[float, ...], int] = {}
    for number, row in enumerate(map(tuple, values.tolist())):
        if row != unchanged:
            first.setdefault(row, number)
    return joined.select(torch.tensor(list(first.values()), dtype=torch.int64))
