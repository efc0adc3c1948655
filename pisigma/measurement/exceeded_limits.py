"""Warn about joint values beyond the nominal joint limits, and widen the limits to include them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from pisigma.measurement.copies import copy_warnings
from pisigma.measurement.dataset import Measurements
from pisigma.robot.coupling import dh_limits
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.joint_limits import beyond_limits, far_beyond_limits
from pisigma.robot.row import Row

_MAX_NAMED = 5
"""Largest number of rows that a warning lists."""

_MAX_TORQUE = 1e3
"""Largest ratio of a torque to the fourth power of the reach [Nm/m^4], because masses grow with its cube: 75 for the
UR5 (150 Nm), 60 for the FANUC R-2000iC."""


@dataclass(frozen=True, eq=False)
class ExceededLimits:
    """Values of one axis, some of which are beyond its limits.

    Attributes:
        axis: the nominal axis.
        q: values of the axis in all rows [rad or m].
        rows: indices of the rows beyond the limits.
    """

    axis: Row
    q: Float64[np.ndarray, " rows"]
    rows: tuple[int, ...]

    @property
    def widened_axis(self) -> Row:
        """The axis with limits that are widened to include all rows."""
        outside = self.q[list(self.rows)]
        lower, upper = min(self.axis.lower, outside.min()), max(self.axis.upper, outside.max())
        return replace(self.axis, lower=float(lower), upper=float(upper))

    def sentence(self, rows: Measurements, robot: Robot) -> str:
        """Return a warning with the joint, its limits, and the rows beyond them."""
        axis, unit = self.axis, self.axis.file_unit
        lower, upper = axis.in_file_unit(axis.lower), axis.in_file_unit(axis.upper)
        beyond = np.maximum(axis.lower - self.q, self.q - axis.upper)
        farthest = int(beyond.argmax())
        named = ", ".join(rows.place(row) for row in self.rows[:_MAX_NAMED])
        more = f" and {len(self.rows) - _MAX_NAMED} more" if len(self.rows) > _MAX_NAMED else ""
        gross = bool(far_beyond_limits(self.q, axis).any())
        meaning = (
            "An inaccurate limit does not explain so large an excess: the values belong to another joint or are in "
            "another unit."
            if gross
            else "The arm reached these values, so a calibration widens the limits to them; check the limits in the "
            "robot file, and the order and unit of the joints."
        )
        return (
            f"{len(self.rows)} of {rows.rows} rows are beyond the limits {lower:.6g} to {upper:.6g} {unit} of joint "
            f"'{axis.name}' of robot '{robot.name}', by up to {axis.in_file_unit(beyond[farthest]):.3g} {unit} "
            f"({rows.place(farthest)}): {named}{more}. {meaning}"
        )


def exceeded_limits(robot: Robot, rows: Measurements) -> tuple[ExceededLimits, ...]:
    """Return the axes of a robot whose limits are exceeded by rows, with the values of all rows."""
    values = robot.to_controller(rows.q.detach().cpu().double().numpy())
    found = []
    for axis, q in zip(robot.axes, np.moveaxis(values, -1, 0), strict=True):
        if outside := tuple(np.flatnonzero(beyond_limits(q, axis)).tolist()):
            found.append(ExceededLimits(axis, q, outside))
    return tuple(found)


def limit_warnings(robot: Robot, rows: Measurements) -> tuple[str, ...]:
    """Return a warning for every joint whose limits are exceeded by rows."""
    return tuple(one.sentence(rows, robot) for one in exceeded_limits(robot, rows))


def row_warnings(robot: Robot, rows: Measurements) -> tuple[str, ...]:
    """Return warnings about joint values beyond the limits, duplicate rows, and impossible torques."""
    return (*limit_warnings(robot, rows), *copy_warnings(rows.left_out), *_torque_warnings(robot, rows))


def _torque_warnings(robot: Robot, rows: Measurements) -> tuple[str, ...]:
    """Warn about torques that are too large for an arm of this size, as are values in Nmm or mNm."""
    if rows.torque is None:
        return ()
    turning = np.flatnonzero(robot.revolute)
    largest = np.nan_to_num(np.abs(rows.torque.cpu().numpy()[:, turning])).max(0, initial=0.0)
    limit = _MAX_TORQUE * robot.reach**4
    if not len(turning) or largest.max() <= limit:
        return ()
    joint = int(turning[largest.argmax()])
    return (
        f"Column tau_{joint + 1} contains {largest.max():.3g} Nm, but robots of this reach have less "
        f"than {limit:.2g} Nm; the values are probably in mNm or Nmm: convert the columns tau_1, tau_2, ... to Nm",
    )


def with_limits_of_rows(robot: Robot, rows: Measurements) -> Robot:
    """Return the robot with joint limits widened to include all rows, or the robot itself if no row exceeds them."""
    wider = {one.axis.name: one.widened_axis for one in exceeded_limits(robot, rows)}
    if not wider:
        return robot
    if robot.coupling is None:
        return replace(robot, rows=tuple(wider.get(row.name, row) for row in robot.rows))
    coupling = replace(robot.coupling, axes=tuple(wider.get(axis.name, axis) for axis in robot.coupling.axes))
    limits = iter(dh_limits(coupling).tolist())
    joints = tuple(
        row
        if row.type == "fixed"
        else replace(row, **dict(zip(("lower", "upper"), next(limits), strict=True)))
        for row in robot.rows
    )
    return replace(robot, rows=joints, coupling=coupling)
