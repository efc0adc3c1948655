"""Whether a fault of the setup or the file explains the errors of all rows."""

from collections.abc import Iterator

from pisigma.validation.checks.other_robot import other_robot_diagnostics
from pisigma.validation.checks.rows.row_check import AbstractRowCheck, RowsUnderModel
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.setup_fault import either


class SetupOfRowsCheck(AbstractRowCheck):
    """Looks for setup faults that explain the errors of a model; see `find_setup_faults`.

    A moved base, tool or zero of one joint is not a fault if it may have moved. If base and tool may not have moved,
    their motion is reported even if it is small.
    """

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        if judged.large:
            faults = judged.setup_faults
        else:
            faults = () if {"frame", "tool"} <= judged.may_move else judged.moved_frames
        if faults and not any(map(judged.is_move, faults)):
            fault = either(faults)
            yield Diagnostic(
                kind="setup_fault",
                severity="implausible",
                sentence=fault.sentence,
                cause=fault.cause,
                values=fault.values,
            )


class OtherRobotOfRowsCheck(AbstractRowCheck):
    """Looks for another robot of the catalogue that fits rows with large errors better."""

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        if judged.large and not judged.setup_faults:
            yield from other_robot_diagnostics(judged.model.robot, judged.rows)
