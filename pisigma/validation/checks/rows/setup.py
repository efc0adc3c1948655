"""Whether a mistake in the setup or in the file explains all rows alike."""

from collections.abc import Iterator

from pisigma.validation.checks.other_robot import other_robot_diagnostics
from pisigma.validation.checks.rows.row_check import AbstractRowCheck, RowsUnderModel
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.setup_fault import either


class SetupOfRowsCheck(AbstractRowCheck):
    """Looks for setup faults under which the errors of a model collapse; see `find_setup_faults`.

    A base, a tool or the zero of one joint that has moved is no fault where it may have moved. Where base and tool may
    not have, that they have is said however small it is.
    """

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        if judged.large:
            faults = judged.setup_faults
        else:
            faults = () if {"frame", "tool"} <= judged.may_move else judged.moved_frames
        if faults and not any(map(judged.is_move, faults)):
            yield Diagnostic(kind="setup_fault", severity="implausible", sentence=either(faults).sentence)


class OtherRobotOfRowsCheck(AbstractRowCheck):
    """Looks for another robot of the catalogue that large errors are of."""

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        if judged.large and not judged.setup_faults:
            yield from other_robot_diagnostics(judged.model.robot, judged.rows)
