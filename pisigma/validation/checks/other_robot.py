"""Check whether another robot of the catalogue was measured."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import MeasuredPoses, smallest_error
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.robot_file import catalogue
from pisigma.validation.checks.check import CheckedCalibration, RowsUnderModel
from pisigma.validation.held_out.calibration_validation import pose_errors_of
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.trained_calibrations import base_and_tool_calibrator

_SUSPICIOUS = 0.01
"""Errors of the nominal robot, as a share of its reach, above which other robots are tried, and up to which another
robot explains the rows; arms are built to within a third of this."""
_NEARER = 1 / 3
"""Ratio of the errors of another robot to those of this robot below which the other is reported. The nominal model
explains measurements of its own type of arm to a thousandth of the reach; different robots differ by more."""
_MIN_ROWS = 6
"""Minimum number of rows; with fewer, base and tool alone fit another robot to the rows."""
_MAX_ROWS = 200
"""Number of rows that are sufficient to distinguish robots."""


def check_other_robot(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Fit base and tool of all other robots of the catalogue if the nominal robot has large errors."""
    robot = checked.robot
    nominal = None if checked.figures is None else checked.figures.nominal
    stated = None if nominal is None else nominal.rms_mm
    if stated is None or stated <= _SUSPICIOUS * robot.reach * 1e3:
        return
    robots = {name: Robot.load(name) for name in catalogue()}
    # small arms have small errors for any rows, so another robot must explain the rows as well as its own
    others = {
        name: size
        for name, other in robots.items()
        if (size := _rms_mm(checked, other, _SUSPICIOUS * other.reach)) is not None
    }
    name = min(others, key=lambda other: others[other], default=None)
    if name is not None and others[name] < _NEARER * stated:
        yield Diagnostic(
            kind="other_robot",
            severity="implausible",
            sentence=f"Robot '{name}' of the catalogue fits these rows far better: with base and tool fitted, its "
            f"errors are {others[name]:.3g} mm RMS, those of robot '{robot.name}' {stated:.3g} mm; check which "
            "robot was measured.",
            cause=name,
            values={"rms_mm": others[name], "nominal_rms_mm": stated},
        )


def check_other_robot_of_rows(judged: RowsUnderModel) -> Iterator[Diagnostic]:
    """Look for a robot of the catalogue that fits rows with large errors better than this robot."""
    if judged.has_large_errors and not judged.setup_faults:
        yield from other_robot_diagnostics(judged.model.robot, judged.rows)


def other_robot_diagnostics(robot: Robot, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Check uncalibrated rows for another robot; empty if there are too few rows."""
    calibrator = GeometricCalibrator(robot)
    if rows.rows < _MIN_ROWS:
        return ()
    try:
        nominal = base_and_tool_calibrator(calibrator).fit(rows)
    except IdentificationError:
        return ()
    checked = CheckedCalibration(calibrator, rows, {"nominal": nominal, "geometric": nominal})
    return tuple(check_other_robot(checked))


def _rms_mm(checked: CheckedCalibration, other: Robot, limit: float) -> float | None:
    """Return the RMS error of another nominal robot [mm].

    It is None if the joints differ, or if base and tool cannot be fitted with an error of at most `limit` [m].
    """
    if other.name == checked.robot.name or other.revolute != checked.robot.revolute:
        return None
    count = checked.rows.rows
    chosen = torch.linspace(0, count - 1, min(count, _MAX_ROWS)).round().long()
    rows = checked.rows.select(chosen)
    one_setup = len(set(rows.frame)) == len(set(rows.target)) == 1
    if one_setup and rows.position is not None and bool(torch.isfinite(rows.position).all()):
        measured = MeasuredPoses.from_tensors(rows.position, None, 0.0)
        if smallest_error(forward_kinematics(other, rows.q), measured) > limit:
            return None
    try:
        fitted = base_and_tool_calibrator(replace(checked.calibrator, robot=other)).fit(rows)
    except IdentificationError:
        return None
    size = pose_errors_of(fitted, rows).figures.rms_mm
    return size if size is not None and size <= limit * 1e3 else None
