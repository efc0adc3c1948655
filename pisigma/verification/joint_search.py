"""Which setup faults of joint columns may explain measured positions: thousands of them tried on a few rows."""

from collections import Counter
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.judging.frame_fits import Seen, best_base
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import poses_of_rows
from pisigma.se3 import wrap_to_pi
from pisigma.verification.joint_faults import (
    ALMOST,
    QUARTER,
    JointMaps,
    moved_zeros,
    other_orders,
    other_units,
    quarter_turned_zeros,
    turned_signs,
)

SCREEN_ROWS = 32
"""Rows that every map is tried on."""
NOTICED = 2e-5
"""[m] Smaller errors are none."""
PROMISING = 0.5
"""Share of the errors that is left, at most, where a map is looked at again."""
KEPT = 3
"""Maps of each kind that are looked at again, at most."""
NEAR_BEST = 4.0
"""Maps whose errors are larger than the best by this factor are not."""
STEPS = 36
"""A zero is looked for on a grid of so many places to either side, which then is made finer."""
FINER = 7
"""Times that the grid is made finer."""
_MOST_POSES = 2**17


@dataclass(frozen=True, eq=False)
class _Trial:
    """Some rows, and the geometry alone as the model.

    Attributes:
        model: without what costs time; maps are tried on it before the whole model sees them.
        some: rows of one frame.
        seen: what was measured in them.
        free_frame: whether the frame is fitted anew for every map.
    """

    model: CalibratedModel
    some: Measurements
    seen: Seen
    free_frame: bool

    def errors(self, maps: JointMaps) -> Float64[Tensor, " maps"]:
        """Mean squared errors [m²] with every map."""
        rows = self.some.rows
        parts = torch.split(torch.arange(len(maps.order)), max(1, _MOST_POSES // rows))
        return torch.cat([self._errors(maps.select(part)) for part in parts])

    def _errors(self, maps: JointMaps) -> Float64[Tensor, " maps"]:
        q, count = maps.of(self.some.q), len(maps.order)
        repeated = Measurements(
            q=q.flatten(0, 1), frame=self.some.frame * count, target=self.some.target * count
        )
        T = poses_of_rows(self.model, repeated).reshape(*q.shape[:2], 4, 4)
        if self.free_frame:
            T = best_base(T, self.seen)[:, None] @ T
        return self.seen.squares(T).mean(-1)


def likely_maps(model: CalibratedModel, measurements: Measurements, seen: Seen) -> JointMaps:
    """Maps of joint values that may explain what was measured, to be looked at with the whole model.

    Args:
        model: the model.
        measurements: rows with positions.
        seen: what was measured in them.
    """
    rows = _rows(measurements)
    some, there = measurements.select(rows), seen.select(rows)
    quick = replace(model, hybrid=None, network=None)
    robot = model.robot
    kinds = (
        other_units(robot),
        turned_signs(robot.dof),
        other_orders(robot.dof),
        quarter_turned_zeros(robot),
    )
    found: list[JointMaps] = []
    for free_frame in (False, True):
        trial = _Trial(quick, some, there, free_frame)
        tried = [(maps, trial.errors(maps)) for maps in (*kinds, _best_zeros(trial))]
        least = min(float(errors.min()) for _, errors in tried if len(errors))
        limit = PROMISING**2 * float(trial.errors(JointMaps.unchanged(1, robot.dof)))
        limit = min(limit, max(NEAR_BEST**2 * least, NOTICED**2))
        for maps, errors in tried:
            best = errors.argsort()[:KEPT]
            found.append(maps.select(best[errors[best] <= limit]))
    return _different(found)


def _rows(measurements: Measurements) -> Int64[Tensor, " chosen"]:
    """Rows of the frame that most are of, spread over them."""
    frame = Counter(measurements.frame).most_common(1)[0][0]
    rows = torch.tensor([name == frame for name in measurements.frame]).nonzero()[:, 0]
    count = min(len(rows), SCREEN_ROWS)
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]


def _best_zeros(trial: _Trial) -> JointMaps:
    """Per joint the zero that explains most, moved by anything; by a quarter turn where it is almost one."""
    robot, dof = trial.model.robot, trial.model.robot.dof
    width = torch.tensor([torch.pi if turn else robot.reach for turn in robot.revolute], dtype=torch.float64)
    by = torch.zeros(dof, dtype=torch.float64)
    joints = torch.arange(dof).repeat_interleave(2 * STEPS + 1)
    grid = torch.linspace(-1, 1, 2 * STEPS + 1, dtype=torch.float64)
    for _ in range(FINER):
        tried = by[:, None] + width[:, None] * grid
        errors = trial.errors(moved_zeros(joints, tried.flatten(), dof)).reshape(tried.shape)
        by = tried.gather(1, errors.argmin(1, keepdim=True))[:, 0]
        width = width * 2 / STEPS
    near = (by / QUARTER).round() * QUARTER
    near = torch.where(near < -1.5 * QUARTER, -near, near)
    turning = torch.tensor(robot.revolute)
    by = torch.where(turning & (wrap_to_pi(by - near).abs() < ALMOST) & (near != 0), near, by)
    return moved_zeros(torch.arange(dof), by, dof)


def _different(found: list[JointMaps]) -> JointMaps:
    """All maps that change something, each once."""
    values = [torch.cat(parts) for parts in zip(*((m.order, m.factor, m.offset) for m in found), strict=True)]
    dof = values[0].shape[1]
    kept: dict[tuple[float, ...], int] = {}
    for number, row in enumerate(torch.cat([value.double() for value in values], 1).tolist()):
        changes = row[:dof] != list(range(dof)) or row[dof:] != [1.0] * dof + [0.0] * dof
        if changes:
            kept.setdefault(tuple(row), number)
    index = torch.tensor(list(kept.values()), dtype=torch.int64)
    return JointMaps(values[0][index], values[1][index], values[2][index])
