"""Check whether a fault of the setup or the file explains errors that are too large for the nominal robot."""

import math
from collections.abc import Iterator
from functools import lru_cache

from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import MeasuredPoses, best_base_and_tool, smallest_error
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.checks.check import FITTED_PARAMETERS, CheckedCalibration, RowsUnderModel
from pisigma.validation.held_out.diagnostic import Diagnostic, Severity
from pisigma.validation.setup_faults.explanations import position_spread
from pisigma.validation.setup_faults.hypothesis import COLLAPSED
from pisigma.validation.setup_faults.joint_faults import joint_causes, signs_and_swaps
from pisigma.validation.setup_faults.nominal_robot_faults import (
    MIN_ROWS_NOMINAL,
    are_positions_unrelated,
    find_nominal_robot_faults,
    largest_zero_sigma,
    prior_rms_position_error,
    rows_of_most_frequent_frame,
)
from pisigma.validation.setup_faults.setup_fault import combine_alternatives, fault_of_cause

_UNRELATED = (
    "The measured positions are unrelated to the joint values of their rows, so the joint values and positions of "
    "different rows belong together; check whether one of them was sorted or comes from another program."
)
_MIN_ROWS_OF_SIZE = 4
"""Minimum number of rows for the check of size; with fewer, positions may be close together by chance."""
_SCALE = 30.0
"""Ratio of the spreads of measured and nominal positions above which (or below whose inverse) the unit is wrong."""
_ARM_SHARE = 0.3
"""Spread of the positions that a tool missing from the nominal robot causes, and smallest spread of typical poses, as a
share of the reach."""
_MIN_ROWS_FOR_JOINTS = 8
"""Smallest number of rows that distinguish columns of joints: 24 values, 9 of which determine base and tool."""


def check_setup_fault(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Look for setup faults that explain the errors of the nominal robot; see `find_nominal_robot_faults`.

    A fault makes the calibration implausible, because parameters may absorb the fault and are then wrong at other
    poses. A joint zero is a parameter that a calibration estimates correctly, so it only causes a warning, up to the
    size that is possible in the class of the robot.
    """
    yield from setup_diagnostics(checked.robot, checked.rows)


@lru_cache(maxsize=1)  # cached, because the same rows are checked before and after a calibration
def setup_diagnostics(robot: Robot, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Return findings about setup faults that explain the errors of the nominal robot; see `check_setup_fault`."""
    if faults := find_nominal_robot_faults(robot, rows):
        fault = combine_alternatives(faults)
        severity: Severity = (
            "implausible" if fault.largest_zero_shift > largest_zero_sigma(robot) else "warning"
        )
        return (fault.diagnostic(severity),)
    if are_positions_unrelated(robot, rows):
        return (
            Diagnostic(kind="setup_fault", severity="implausible", sentence=_UNRELATED, cause="unrelated"),
        )
    return ()


def check_setup_of_rows(rows: RowsUnderModel) -> Iterator[Diagnostic]:
    """Look for setup faults that explain the errors of a model; see `find_setup_faults`.

    A moved base, tool or single joint zero is not a fault if it is allowed to have moved. If base and tool are not,
    their motion is reported even if it is small.
    """
    if rows.has_large_errors:
        faults = rows.setup_faults
    else:
        faults = () if {"frame", "tool"} <= rows.allowed_moves else rows.moved_frames
    if faults and not any(map(rows.is_allowed_motion, faults)):
        yield combine_alternatives(faults).diagnostic()


def check_position_spread(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Compare the spread of the measured positions with the spread of the nominal robot's positions."""
    group = rows_of_most_frequent_frame(rows)
    if group.position is None or group.rows < _MIN_ROWS_OF_SIZE:
        return
    measured, nominal = (
        position_spread(group.position),
        position_spread(forward_kinematics(robot, group.q)[:, :3, 3]),
    )
    arm = _ARM_SHARE * robot.reach
    if measured > _SCALE * (nominal + arm):
        cause, mistake = "mm_named_m", "x, y and z are in millimetres but labelled as metres"
    elif _SCALE * measured < nominal > arm:
        cause = "m_named_mm"
        mistake = "x, y and z are in metres but labelled as millimetres, or do not follow the robot"
    else:
        return
    yield Diagnostic(
        kind="setup_fault",
        severity="implausible",
        sentence=f"The measured positions are {measured * 1e3:,.1f} mm RMS from their mean, but those of robot "
        f"'{robot.name}' at these joint values should be {nominal * 1e3:,.1f} mm: {mistake}; check the column "
        "names and the instrument.",
        cause=cause,
        values={"measured_mm": measured * 1e3, "nominal_mm": nominal * 1e3},
    )


def check_joint_columns(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Try a reversed sign of every joint and a swap of two neighbouring joints, with base and tool fitted each time.

    With at least `MIN_ROWS_NOMINAL` rows, `find_nominal_robot_faults` tries many more hypotheses instead.
    """
    group = rows_of_most_frequent_frame(rows)
    if not _MIN_ROWS_FOR_JOINTS <= group.rows < MIN_ROWS_NOMINAL:
        return
    here, usual = _errors(robot, group, group.q[None], math.inf)[0], prior_rms_position_error(robot, group.q)
    if not here > usual:
        return
    maps, limit = signs_and_swaps(robot.dof), min(usual, COLLAPSED * here)
    found = [
        (left, joint_causes(maps, number, robot)[0])
        for number, left in enumerate(_errors(robot, group, maps.apply(group.q), limit))
        if left <= limit
    ]
    if found:
        left, cause = min(found, key=lambda one: one[0])
        yield fault_of_cause(cause, here, left).diagnostic()


def _errors(
    robot: Robot, rows: Measurements, q: Float64[Tensor, "maps rows dof"], limit: float
) -> list[float]:
    """Compute RMS position errors [m] with base and tool fitted, corrected for the degrees of freedom.

    They are infinite where they are certainly larger than the limit [m].
    """
    measured = MeasuredPoses.from_tensors(rows.position, None, 0.0)
    errors = []
    for T in forward_kinematics(robot, q):
        if smallest_error(T, measured) > limit:
            errors.append(math.inf)
            continue
        base, tool = best_base_and_tool(T, measured)
        square = measured.squared_errors(base @ T @ tool).mean()
        errors.append(float((square * 3 * rows.rows / (3 * rows.rows - FITTED_PARAMETERS)).sqrt()))
    return errors
