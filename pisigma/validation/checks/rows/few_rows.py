"""What is wrong with all rows alike, a unit or a joint column, while few of them are there, by the robot as drawn."""

from collections.abc import Iterator
from dataclasses import replace

from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.frame_fits import MeasuredPoses, best_base_and_tool
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.faults_as_drawn import FEWEST_ROWS_AS_DRAWN, largest_group, usual_error
from pisigma.validation.setup_faults.hypothesis import COLLAPSED
from pisigma.validation.setup_faults.joint_faults import joint_causes, signs_and_exchanges

FEWEST_ROWS = 4
"""Of fewer, the positions may happen to be near each other."""
SCALE = 30.0
"""Positions are in another unit that are so many times as far apart as those of the robot as drawn."""
ARM_SHARE = 0.3
"""Share of the reach by which a tool that is not drawn spreads positions, and that poses are spread over at least."""

FEWEST_FOR_JOINTS = 8
"""Rows that tell columns of joints apart: 24 values, of which base and tool take 9."""
FITTED = 9


def size_of_positions(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Compare the size of what was measured with that of the robot's motion."""
    group = largest_group(rows)
    if group.position is None or group.rows < FEWEST_ROWS:
        return
    measured, drawn = _spread(group.position), _spread(forward_kinematics(robot, group.q)[:, :3, 3])
    arm = ARM_SHARE * robot.reach
    if measured > SCALE * (drawn + arm):
        mistake = "x, y and z are millimetres that are named metres"
    elif SCALE * measured < drawn > arm:
        mistake = "x, y and z are metres that are named millimetres, or do not change with the robot"
    else:
        return
    yield Diagnostic(
        kind="setup_fault",
        severity="implausible",
        sentence=f"The measured positions are {measured * 1e3:,.1f} mm RMS from their mean, and those of robot "
        f"'{robot.name}' at these joint values {drawn * 1e3:,.1f} mm: {mistake}; check the column names and the "
        "instrument.",
    )


def joint_columns(robot: Robot, rows: Measurements) -> Iterator[Diagnostic]:
    """Try a reversed sign of every joint and an exchange of two neighbours, base and tool being fitted each time.

    Of more rows than `FEWEST_ROWS_AS_DRAWN` much more is tried, see `find_faults_as_drawn`.
    """
    group = largest_group(rows)
    if not FEWEST_FOR_JOINTS <= group.rows < FEWEST_ROWS_AS_DRAWN:
        return
    here, usual = _errors(robot, group, group.q[None])[0], usual_error(robot, group.q)
    if not here > usual:
        return
    maps = signs_and_exchanges(robot.dof)
    found = [
        (left, joint_causes(maps, number, robot)[0])
        for number, left in enumerate(_errors(robot, group, maps.of(group.q)))
        if left <= min(usual, COLLAPSED * here)
    ]
    if found:
        left, cause = min(found, key=lambda one: one[0])
        yield Diagnostic(
            kind="setup_fault",
            severity="implausible",
            sentence=f"{cause.clause[:1].upper()}{cause.clause[1:]}: with this set right, the errors of the robot as "
            f"drawn fall from {length_text(here)} to {length_text(left)} RMS; {cause.advice}.",
        )


def _errors(robot: Robot, rows: Measurements, q: Float64[Tensor, "maps rows dof"]) -> list[float]:
    """Root mean squares of the position errors [m] with base and tool fitted, as if nothing were fitted."""
    measured = MeasuredPoses.of(replace(rows, rotation=None), 0.0)
    errors = []
    for T in forward_kinematics(robot, q):
        base, tool = best_base_and_tool(T, measured)
        square = measured.squares(base @ T @ tool).mean()
        errors.append(float((square * 3 * rows.rows / (3 * rows.rows - FITTED)).sqrt()))
    return errors


def _spread(position: Float64[Tensor, "rows 3"]) -> float:
    """Root mean square of the distances from the mean [m]."""
    return float((position - position.mean(0)).square().sum(1).mean().sqrt())
