"""Whether a mistake in the setup or in the file explains errors that no robot of this drawing has."""

from collections.abc import Iterator
from functools import lru_cache

from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import HOBBY
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic, Severity
from pisigma.validation.setup_faults.faults_as_drawn import are_unrelated, find_faults_as_drawn
from pisigma.validation.setup_faults.new_setup import new_setup
from pisigma.validation.setup_faults.setup_fault import either

UNRELATED = (
    "The measured positions have nothing to do with the joint values of their rows, so that rows of one side belong to "
    "other rows of the other; look for a side that was sorted, or that is of another program."
)


class SetupFaultCheck(AbstractCheck):
    """Looks for setup faults under which the errors of the robot as drawn collapse; see `find_faults_as_drawn`.

    A fault makes the calibration implausible, as it may be absorbed by parameters that then are wrong elsewhere. The
    zero of a joint is a parameter: where it has moved, a calibration is right, so up to the size that is possible in
    any class of robots it is a warning.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        yield from setup_diagnostics(checked.robot, checked.rows)


@lru_cache(maxsize=1)  # the same rows are looked at before a calibration and after it
def setup_diagnostics(robot: Robot, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Say which setup faults explain the errors of the robot as drawn; see `SetupFaultCheck`."""
    if faults := find_faults_as_drawn(robot, rows):
        fault = either(faults)
        severity: Severity = "implausible" if fault.moved > HOBBY.largest.joint_offset else "warning"
        return (Diagnostic(kind="setup_fault", severity=severity, sentence=fault.sentence),)
    if are_unrelated(robot, rows):
        return (Diagnostic(kind="setup_fault", severity="implausible", sentence=UNRELATED),)
    return ()


def explained(refusal: IdentificationError, robot: Robot, rows: Measurements) -> IdentificationError:
    """Name the cause of a refusal where setup faults explain the errors; else return the refusal as it is."""
    if moved := new_setup(robot, rows):
        return IdentificationError(moved)
    causes = setup_diagnostics(robot, rows)
    return IdentificationError(f"{rows.source}: {causes[0].sentence}") if causes else refusal
