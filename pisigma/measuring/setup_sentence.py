"""What is wrong with all rows alike, such as a unit, while few of them are there."""

from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.verification.checks.other_robot import other_robot_diagnostics
from pisigma.verification.checks.registry import diagnostics_of_rows
from pisigma.verification.checks.setup_fault import setup_diagnostics
from pisigma.verification.faults_as_drawn import largest_group

FEWEST_ROWS = 4
"""Of fewer, the positions may happen to be near each other."""
FEWEST_CHECKED = 12
"""From so many on a calibration says whether the errors of the arm are too large to be those of this robot."""
SCALE = 30.0
"""Positions are in another unit that are so many times as far apart as those of the robot as drawn."""
ARM_SHARE = 0.3
"""Share of the reach by which a tool that is not drawn spreads positions, and that poses are spread over at least."""


def setup_sentence(robot: Robot, rows: Measurements, counts: Bool[Tensor, " rows"]) -> str:
    """Say which mistake in the setup or in the file all rows have in common; "" where none is found.

    With few rows the size of what was measured is compared with that of the robot's motion. From 6 rows that count on
    other robots of the catalogue are tried, from 12 on the rows are checked as a calibration of them is, and from 24 on
    for the faults in the setup that it would be refused for.

    Args:
        robot: as drawn.
        rows: all rows.
        counts: those that others do not contradict.
    """
    counted = rows.select(counts)
    for diagnostic in setup_diagnostics(robot, counted):
        if diagnostic.severity == "implausible":
            return diagnostic.sentence
    group = largest_group(rows)
    if group.position is None or group.rows < FEWEST_ROWS:
        return ""
    measured, drawn = _spread(group.position), _spread(forward_kinematics(robot, group.q)[:, :3, 3])
    arm = ARM_SHARE * robot.reach
    if measured > SCALE * (drawn + arm):
        mistake = "x, y and z are millimetres that are named metres"
    elif SCALE * measured < drawn > arm:
        mistake = "x, y and z are metres that are named millimetres, or do not change with the robot"
    else:
        return _implausible(robot, counted)
    return (
        f"The measured positions are {measured * 1e3:,.1f} mm RMS from their mean, and those of robot '{robot.name}' "
        f"at these joint values {drawn * 1e3:,.1f} mm: {mistake}; check the column names and the instrument."
    )


def _implausible(robot: Robot, rows: Measurements) -> str:
    """Say why a calibration with some rows would not be trusted."""
    found = other_robot_diagnostics(robot, rows)
    if not found and rows.rows >= FEWEST_CHECKED:
        try:
            found = diagnostics_of_rows(GeometricCalibrator(robot), rows)
        except IdentificationError as refusal:  # no calibration error explains the rows
            return str(refusal).removeprefix(f"{rows.source}: ")
    return next((one.sentence for one in found if one.severity == "implausible"), "")


def _spread(position: Float64[Tensor, "rows 3"]) -> float:
    """Root mean square of the distances from the mean [m]."""
    return float((position - position.mean(0)).square().sum(1).mean().sqrt())
