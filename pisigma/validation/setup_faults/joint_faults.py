"""Faults of joint columns (order, sign, unit, coupling, zero) as affine maps of the logged joint values."""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import MeasuredPoses
from pisigma.robot.se3 import wrap_to_pi
from pisigma.validation.setup_faults.cause import Cause, joints_text
from pisigma.validation.setup_faults.hypothesis import FittedFrames, PredictingArm

_QUARTER = math.pi / 2
_GRADIANS = 0.9
"""Number of degrees in a gradian."""
_ZERO_TOLERANCE = math.radians(0.5)
"""Distance from a multiple of 90 deg below which a zero is set to this multiple [rad]."""
_MAX_ORDERS = 5040
"""Number of permutations of seven joints; with more joints, only pairs are swapped."""
_MAX_ZEROS = 4**7
_SCREEN_ROWS = 32
"""Number of rows on which every map is tried."""
NOTICED = 2e-5
"""Errors below which no explanation is needed [m]."""
_PROMISING = 0.5
"""Largest share of the errors that may remain under a promising map."""
_MAX_KEPT = 3
"""Largest number of promising maps of each kind."""
NEAR_BEST = 4.0
"""Largest ratio of the errors of a promising map to the errors of the best map."""
STEPS = 36
"""Number of grid values on either side in the search for a zero."""
_REFINEMENTS = 7
"""Number of refinements of the grid in the search for a zero."""


@dataclass(frozen=True, eq=False)
class JointMaps:
    """Maps `q -> matrix · q + offset` from logged to true joint values, one per hypothesis.

    Attributes:
        matrix: weights of the logged columns in every joint value.
        offset: offset of each joint [rad or m].
    """

    matrix: Float64[Tensor, "maps dof dof"]
    offset: Float64[Tensor, "maps dof"]

    @staticmethod
    def unchanged(count: int, dof: int) -> "JointMaps":
        """Return maps that change nothing."""
        eye = torch.eye(dof, dtype=torch.float64)
        return JointMaps(eye.repeat(count, 1, 1), torch.zeros(count, dof, dtype=torch.float64))

    @staticmethod
    def scaled(factors: Float64[Tensor, "maps dof"]) -> "JointMaps":
        """Return maps that multiply joint values by factors."""
        return JointMaps(torch.diag_embed(factors), torch.zeros_like(factors))

    def apply(self, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "maps rows dof"]:
        """Return the joint values [rad or m] under every map."""
        return q @ self.matrix.mT + self.offset[:, None]

    def select(self, index: Int64[Tensor, " chosen"]) -> "JointMaps":
        """Return the selected maps."""
        return JointMaps(self.matrix[index], self.offset[index])


def signs_and_swaps(dof: int) -> JointMaps:
    """Return maps that reverse the sign of one joint, and maps that swap two neighbouring joints."""
    signs = JointMaps.scaled(1 - 2 * torch.eye(dof, dtype=torch.float64))
    order = torch.arange(dof).repeat(dof - 1, 1)
    pairs = torch.stack([torch.arange(dof - 1), torch.arange(1, dof)], 1)
    order = order.scatter(1, pairs, pairs.flip(1))
    eye = torch.eye(dof, dtype=torch.float64)
    return JointMaps(
        torch.cat([signs.matrix, eye[order]]),
        torch.cat([signs.offset, torch.zeros(dof - 1, dof, dtype=torch.float64)]),
    )


def reversed_signs(dof: int) -> JointMaps:
    """Return maps with all combinations of reversed signs."""
    choices = list(itertools.product((1.0, -1.0), repeat=dof))[1:]
    return JointMaps.scaled(torch.tensor(choices, dtype=torch.float64))


def joint_order_maps(dof: int) -> JointMaps:
    """Return maps for all orders of the joints; for more than seven joints, for all swaps of two."""
    orders = torch.arange(dof).repeat(math.comb(dof, 2), 1)
    pairs = torch.combinations(torch.arange(dof))
    orders = orders.scatter(1, pairs, pairs.flip(1))
    if math.factorial(dof) <= _MAX_ORDERS:
        orders = torch.tensor(list(itertools.permutations(range(dof)))[1:], dtype=torch.int64).reshape(
            -1, dof
        )
    return JointMaps(torch.eye(dof, dtype=torch.float64)[orders], torch.zeros(len(orders), dof).double())


def coupled_joints(dof: int) -> JointMaps:
    """Return maps for all pairs of joints in which one is logged relative to the other, for example with a belt."""
    pairs = torch.tensor(list(itertools.permutations(range(dof), 2)), dtype=torch.int64).reshape(-1, 2)
    pairs, sign = pairs.repeat(2, 1), torch.tensor([1.0, -1.0]).double().repeat_interleave(len(pairs))
    maps = JointMaps.unchanged(len(pairs), dof)
    return replace(maps, matrix=maps.matrix.index_put((torch.arange(len(pairs)), *pairs.T), sign))


def joint_unit_maps(robot: Robot) -> JointMaps:
    """Return maps that swap units: degrees and radians (or gradians), and mm and m for prismatic joints."""
    turning = [1.0 if turns else 0.0 for turns in robot.revolute]
    rows = [[_GRADIANS ** (sign * turns) for turns in turning] for sign in (1, -1) if any(turning)]
    for revolute, per_unit in ((True, math.degrees(1)), (False, 1e3)):
        joints = [i for i, turns in enumerate(robot.revolute) if turns == revolute]
        for count in range(1, len(joints) + 1):
            for some in itertools.combinations(joints, count):
                rows += [
                    [factor if i in some else 1.0 for i in range(robot.dof)]
                    for factor in (per_unit, 1 / per_unit)
                ]
    return JointMaps.scaled(torch.tensor(rows, dtype=torch.float64).reshape(len(rows), robot.dof))


def quarter_turned_zeros(robot: Robot, fitted: FittedFrames = "none") -> JointMaps:
    """Return maps with zeros moved by multiples of 90 deg, one joint at a time if there are too many combinations.

    Args:
        robot: the robot.
        fitted: fitted frames; a base absorbs the zero of the first joint, and a tool that of the last joint.
    """
    absorbed = {"none": (), "base": (0,), "base and tool": (0, robot.dof - 1)}[fitted]
    turning = [i for i, revolute in enumerate(robot.revolute) if revolute and i not in absorbed]
    if 4 ** len(turning) <= _MAX_ZEROS:
        choices = np.array(list(itertools.product((0, 1, 2, -1), repeat=len(turning)))[1:])
    else:
        choices = np.concatenate([k * np.eye(len(turning)) for k in (1, 2, -1)])
    offset = np.zeros((len(choices), robot.dof))
    offset[:, turning] = choices * _QUARTER
    return replace(JointMaps.unchanged(len(choices), robot.dof), offset=torch.from_numpy(offset))


def moved_zeros(joints: Int64[Tensor, " maps"], shifts: Float64[Tensor, " maps"], dof: int) -> JointMaps:
    """Return maps that each move the zero of one joint by a given amount [rad or m]."""
    maps = JointMaps.unchanged(len(joints), dof)
    return replace(maps, offset=maps.offset.index_put((torch.arange(len(joints)), joints), shifts))


def joint_causes(maps: JointMaps, map_index: int, robot: Robot) -> tuple[Cause, ...]:
    """Return the causes that a map assumes: what is wrong with the joint columns."""
    matrix, offset = maps.matrix[map_index], maps.offset[map_index].tolist()
    order = matrix.abs().argmax(1).tolist()
    factor = [row[column] for row, column in zip(matrix.tolist(), order, strict=True)]
    if int((matrix != 0).sum()) > robot.dof:
        return (_coupling_cause(matrix.tolist(), robot),)
    causes = []
    columns = tuple(int(math.copysign(one + 1, sign)) for one, sign in zip(order, factor, strict=True))
    moved = tuple(i for i, column in enumerate(order) if column != i)
    advice = "check the order of the joint columns"
    if len(moved) == 2:
        clause = f"the columns of {joints_text(moved)} are swapped"
        causes.append(Cause("joint_order", clause, advice, 1.0, moved, signed_column_of_joint=columns))
    elif moved:
        logged = ", ".join(f"q{column + 1}" for column in order)
        clause = f"the joint columns are in another order (joints 1 to {robot.dof} are in {logged})"
        causes.append(Cause("joint_order", clause, advice, 2.0, moved, signed_column_of_joint=columns))
    if negative := tuple(i for i, value in enumerate(factor) if value < 0):
        signs = "the sign of {} is reversed" if len(negative) == 1 else "the signs of {} are reversed"
        clause = signs.format(joints_text(negative))
        advice = "check the directions of the joints"
        causes.append(
            Cause(
                "joint_sign", clause, advice, float(len(negative)), negative, signed_column_of_joint=columns
            )
        )
    causes.extend(_unit_causes(factor, robot))
    if zeros := tuple(i for i, value in enumerate(offset) if value):
        causes.append(_zero_cause(zeros, offset, robot))
    return tuple(causes)


def _coupling_cause(matrix: list[list[float]], robot: Robot) -> Cause:
    joint, other, share = next(
        (i, j, share) for i, row in enumerate(matrix) for j, share in enumerate(row) if i != j and share
    )
    logged = f"q{joint + 1} {'+' if share < 0 else '-'} q{other + 1}"
    clause = (
        f"{joints_text(tuple(sorted((joint, other))))} are coupled: joint {joint + 1} is logged as {logged}"
    )
    advice = (
        "state the coupling in the robot file, or log the angles between the links"
        if robot.coupling is None
        else "log the values that the controller shows, or correct the coupling in the robot file"
    )
    return Cause("joint_coupling", clause, advice, 1.0, (joint, other))


def _unit_causes(factor: list[float], robot: Robot) -> list[Cause]:
    causes = []
    for revolute, small, large in ((True, "degrees", "radians"), (False, "millimetres", "metres")):
        joints = [i for i, turns in enumerate(robot.revolute) if turns == revolute]
        for too_large in (True, False):
            wrong = tuple(i for i in joints if abs(factor[i]) != 1 and (abs(factor[i]) < 1) == too_large)
            if wrong:
                named, are = (large, small) if too_large else (small, large)
                if _GRADIANS <= abs(factor[wrong[0]]) <= 1 / _GRADIANS:
                    named, are = ("degrees", "gradians") if too_large else ("gradians", "degrees")
                clause = f"the values of {joints_text(wrong)} are in {are} but labelled as {named}"
                size = 1.0 if list(wrong) == joints else len(wrong) + 0.5
                advice = "correct the unit in the column names"
                causes.append(Cause("joint_unit", clause, advice, size, wrong, amount=abs(factor[wrong[0]])))
    return causes


def _zero_cause(joints: tuple[int, ...], offset: list[float], robot: Robot) -> Cause:
    clauses = []
    size = 0.0
    for i in joints:
        turns = robot.revolute[i]
        by = f"{math.degrees(offset[i]):.4g} deg" if turns else f"{offset[i] * 1e3:.4g} mm"
        clauses.append(f"joint {i + 1} has moved by {by}")
        size += 1.25 if turns and is_quarter_turn(offset[i]) else 1.5
    advice = "check the joint zeros"
    if joints == (0,):
        advice += (
            " (a measuring frame that is rotated about or shifted along the first axis has the same effect)"
        )
    elif joints == (robot.dof - 1,):
        advice += " (a tool that is rotated about or shifted along the last axis has the same effect)"
    return Cause("joint_zero", " and ".join(clauses), advice, size, joints, max(map(abs, offset)))


def is_quarter_turn(angle: float) -> bool:
    """Return whether an angle [rad] is a multiple of 90 deg."""
    return abs(math.remainder(angle, _QUARTER)) < 1e-12


def likely_maps(arm: PredictingArm, measurements: Measurements, measured: MeasuredPoses) -> JointMaps:
    """Find maps of joint values that may explain the measured poses, to be tried with the whole model.

    Thousands of maps are tried on a few rows with the geometry alone; see `PredictingArm.mean_squared_errors`.

    Args:
        arm: the predicting arm.
        measurements: rows with positions.
        measured: measured poses of the rows.
    """
    rows, robot = _screened_rows(measurements), arm.robot
    some, few = measurements.select(rows), measured.select(rows)

    def errors_of(
        maps: JointMaps, modes: Sequence[FittedFrames] = arm.fits_of_frames
    ) -> Float64[Tensor, "modes maps"]:
        return arm.mean_squared_errors(some, maps.apply(some.q), few, modes)

    kinds = (
        joint_unit_maps(robot),
        reversed_signs(robot.dof),
        joint_order_maps(robot.dof),
        coupled_joints(robot.dof),
    )
    tried = [(maps, errors_of(maps)) for maps in kinds]
    unchanged = errors_of(JointMaps.unchanged(1, robot.dof))[:, 0].tolist()
    likely: list[JointMaps] = []
    for number, mode in enumerate(arm.fits_of_frames):
        zeros = _best_zeros(robot, lambda maps, mode=mode: errors_of(maps, [mode])[0])  # type: ignore[misc]
        candidates = [(maps, errors[number]) for maps, errors in tried]
        candidates += [
            (maps, errors_of(maps, [mode])[0]) for maps in (quarter_turned_zeros(robot, mode), zeros)
        ]
        least = min(float(errors.min()) for _, errors in candidates if len(errors))
        limit = min(_PROMISING**2 * unchanged[number], max(NEAR_BEST**2 * least, NOTICED**2))
        for maps, errors in candidates:
            best = errors.argsort()[:_MAX_KEPT]
            likely.append(maps.select(best[errors[best] <= limit]))
    return _distinct(likely)


def _screened_rows(measurements: Measurements) -> Int64[Tensor, " chosen"]:
    """Return rows of the most frequent frame and target, evenly over the file."""
    names = list(zip(measurements.frame, measurements.target, strict=True))
    most = Counter(names).most_common(1)[0][0]
    rows = torch.tensor([name == most for name in names]).nonzero()[:, 0]
    count = min(len(rows), _SCREEN_ROWS)
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]


def _best_zeros(robot: Robot, errors_of: Callable[[JointMaps], Float64[Tensor, " maps"]]) -> JointMaps:
    """Return the best zero of every joint on a refined grid, rounded to a nearby multiple of 90 deg if there is one."""
    dof = robot.dof
    width = torch.tensor(
        [torch.pi if turns else robot.reach for turns in robot.revolute], dtype=torch.float64
    )
    by = torch.zeros(dof, dtype=torch.float64)
    joints = torch.arange(dof).repeat_interleave(2 * STEPS + 1)
    grid = torch.linspace(-1, 1, 2 * STEPS + 1, dtype=torch.float64)
    for _ in range(_REFINEMENTS):
        tried = by[:, None] + width[:, None] * grid
        errors = errors_of(moved_zeros(joints, tried.flatten(), dof)).reshape(tried.shape)
        by = tried.gather(1, errors.argmin(1, keepdim=True))[:, 0]
        # The minimum is within two steps of the grid from the best point.
        width = width * 2 / STEPS
    near = (by / _QUARTER).round() * _QUARTER
    # -180 deg and 180 deg are the same zero.
    near = torch.where(near < -1.5 * _QUARTER, -near, near)
    turning = torch.tensor(robot.revolute)
    by = torch.where(turning & (wrap_to_pi(by - near).abs() < _ZERO_TOLERANCE) & (near != 0), near, by)
    return moved_zeros(torch.arange(dof), by, dof)


def _distinct(likely: list[JointMaps]) -> JointMaps:
    """Return all maps without duplicates and without maps that change nothing."""
    joined = JointMaps(
        torch.cat([maps.matrix for maps in likely]), torch.cat([maps.offset for maps in likely])
    )
    values = torch.cat([joined.matrix.flatten(1), joined.offset], 1)
    unchanged = (*torch.eye(joined.offset.shape[1]).flatten().tolist(), *[0.0] * joined.offset.shape[1])
    first: dict[tuple[float, ...], int] = {}
    for number, row in enumerate(map(tuple, values.tolist())):
        if row != unchanged:
            first.setdefault(row, number)
    return joined.select(torch.tensor(list(first.values()), dtype=torch.int64))
