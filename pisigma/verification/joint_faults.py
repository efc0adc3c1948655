"""How joint columns may have been mixed up: order, sign, unit and zero, as maps of logged joint values."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.robot.description import Robot

DEGREES = 180 / math.pi
QUARTER = math.pi / 2
ALMOST = math.radians(0.5)
"""A zero this near to a quarter turn is meant to be there [rad]."""
MOST_ORDERS = 5040
"""Of seven joints; with more only two of them are exchanged."""
MOST_ZEROS = 4**7


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
        """Maps that change nothing."""
        ones = torch.ones(count, dof, dtype=torch.float64)
        return JointMaps(torch.arange(dof).expand(count, dof), ones, torch.zeros_like(ones))

    def of(self, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "maps rows dof"]:
        """What the joint values would be."""
        return q[:, self.order].movedim(0, 1) * self.factor[:, None] + self.offset[:, None]

    def select(self, index: Int64[Tensor, " chosen"]) -> "JointMaps":
        """Some of the maps."""
        return JointMaps(self.order[index], self.factor[index], self.offset[index])


def turned_signs(dof: int) -> JointMaps:
    """All ways to turn signs around."""
    choices = list(itertools.product((1.0, -1.0), repeat=dof))[1:]
    maps = JointMaps.unchanged(len(choices), dof)
    return JointMaps(maps.order, torch.tensor(choices, dtype=torch.float64), maps.offset)


def other_orders(dof: int) -> JointMaps:
    """All orders of the joints; of more than seven the exchanges of two."""
    orders: list[tuple[int, ...]] = []
    if math.factorial(dof) <= MOST_ORDERS:
        orders = list(itertools.permutations(range(dof)))[1:]
    else:
        for i, j in itertools.combinations(range(dof), 2):
            order = list(range(dof))
            order[i], order[j] = j, i
            orders.append(tuple(order))
    maps = JointMaps.unchanged(len(orders), dof)
    return JointMaps(torch.tensor(orders).reshape(len(orders), dof), maps.factor, maps.offset)


def other_units(robot: Robot) -> JointMaps:
    """Degrees for radians and the reverse in any of the joints that turn, mm for m in those that slide."""
    rows: list[list[float]] = []
    for turning, per_unit in ((True, DEGREES), (False, 1e3)):
        joints = [i for i, revolute in enumerate(robot.revolute) if revolute == turning]
        for count in range(1, len(joints) + 1):
            for some, factor in itertools.product(
                itertools.combinations(joints, count), (per_unit, 1 / per_unit)
            ):
                rows.append([factor if i in some else 1.0 for i in range(robot.dof)])
    maps = JointMaps.unchanged(len(rows), robot.dof)
    factors = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), robot.dof)
    return JointMaps(maps.order, factors, maps.offset)


def quarter_turned_zeros(robot: Robot) -> JointMaps:
    """Zeros of any joints that turn moved by quarter turns; of one joint at a time where these are too many."""
    turning = [i for i, revolute in enumerate(robot.revolute) if revolute]
    if 4 ** len(turning) <= MOST_ZEROS:
        choices = np.array(list(itertools.product((0, 1, 2, -1), repeat=len(turning)))[1:])
    else:
        choices = np.concatenate([k * np.eye(len(turning)) for k in (1, 2, -1)])
    offset = np.zeros((len(choices), robot.dof))
    offset[:, turning] = choices * QUARTER
    maps = JointMaps.unchanged(len(choices), robot.dof)
    return JointMaps(maps.order, maps.factor, torch.from_numpy(offset))


def moved_zeros(joints: Int64[Tensor, " maps"], by: Float64[Tensor, " maps"], dof: int) -> JointMaps:
    """The zero of one joint moved by so much [rad or m], in each map."""
    maps = JointMaps.unchanged(len(joints), dof)
    return JointMaps(maps.order, maps.factor, maps.offset.index_put((torch.arange(len(joints)), joints), by))


@dataclass(frozen=True)
class Part:
    """One thing that was mixed up.

    Attributes:
        kind: "frame", "tool", "position_unit", "joint_unit", "joint_order", "joint_sign", "joint_zero" or
            "correction".
        what: such as "the sign of q3 turned".
        advice: what it means or what to check.
        size: how much is assumed; of what explains equally well, the smallest is believed.
        joints: the joints that it is about, from 0.
    """

    kind: str
    what: str
    advice: str
    size: float
    joints: tuple[int, ...] = ()


def joint_parts(maps: JointMaps, number: int, robot: Robot) -> list[Part]:
    """What a map says was mixed up in the joint columns."""
    order, factor, offset = (values[number].tolist() for values in (maps.order, maps.factor, maps.offset))
    parts = []
    moved = [i for i, column in enumerate(order) if column != i]
    if len(moved) == 2:
        exchanged = f"q{moved[0] + 1} and q{moved[1] + 1} exchanged"
        parts.append(Part("joint_order", exchanged, "check the order of the joint columns", 1, tuple(moved)))
    elif moved:
        columns = ", ".join(f"q{column + 1}" for column in order)
        what = f"the joints taken from the columns {columns}"
        parts.append(Part("joint_order", what, "check the order of the joint columns", 2, tuple(moved)))
    if turned := [i for i, value in enumerate(factor) if value < 0]:
        what = f"the sign of {_columns(turned)} turned"
        parts.append(
            Part("joint_sign", what, "check the directions of the joints", len(turned), tuple(turned))
        )
    parts.extend(_unit_parts(factor, robot))
    if zeros := [i for i, value in enumerate(offset) if value]:
        parts.append(_zero_part(zeros, offset, robot))
    return parts


def _unit_parts(factor: list[float], robot: Robot) -> list[Part]:
    parts = []
    for turning, small, large in ((True, "degrees", "radians"), (False, "millimetres", "metres")):
        joints = [i for i, revolute in enumerate(robot.revolute) if revolute == turning]
        for too_large in (True, False):
            mixed = [i for i in joints if abs(factor[i]) != 1 and (abs(factor[i]) < 1) == too_large]
            if mixed:
                named, are = (large, small) if too_large else (small, large)
                done = "divided" if too_large else "multiplied"
                by = f"{DEGREES:.3g}" if turning else "1000"
                what = f"{_columns(mixed)} {done} by {by} ({are} that are named {named})"
                size = 1 if mixed == joints else len(mixed)
                advice = "correct the unit in the column names"
                parts.append(Part("joint_unit", what, advice, size, tuple(mixed)))
    return parts


def _zero_part(joints: list[int], offset: list[float], robot: Robot) -> Part:
    texts = []
    size = 0.0
    for i in joints:
        turn = robot.revolute[i]
        value = f"{math.degrees(offset[i]):.4g} deg" if turn else f"{offset[i] * 1e3:.4g} mm"
        texts.append(f"{value} added to q{i + 1}")
        size += 1.0 if turn and is_quarter(offset[i]) else 1.5
    advice = "check the zeros of the joints"
    if joints == [0]:
        advice += " (a measuring frame that is turned about or shifted along the first axis looks the same)"
    elif joints == [robot.dof - 1]:
        advice += " (a tool that is turned about or shifted along the last axis looks the same)"
    return Part("joint_zero", " and ".join(texts), advice, size, tuple(joints))


def is_quarter(angle: float) -> bool:
    """Whether an angle [rad] is a multiple of a quarter turn."""
    return abs(math.remainder(angle, QUARTER)) < 1e-12


def _columns(joints: list[int]) -> str:
    if len(joints) > 2 and joints[-1] - joints[0] == len(joints) - 1:
        return f"q{joints[0] + 1} to q{joints[-1] + 1}"
    return " and ".join(f"q{i + 1}" for i in joints)
