"""Whether the arm was calibrated, or kept its nominal geometry because there were too few rows."""

from collections.abc import Iterator

from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic


class FewRowsCheck(AbstractCheck):
    """Warns if parameters of the arm were to be estimated, but none was."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        problem = checked.geometric.solved.problem
        if checked.calibrator.free and not bool((problem.active < problem.space.arm_size).any()):
            yield Diagnostic(
                kind="few_rows",
                severity="warning",
                sentence="The arm keeps its nominal geometry, and only base and tool were fitted: with the "
                f"{checked.rows.rows} rows, no other geometry predicts held-out rows better; measure more poses in "
                "which all joints move.",
                values={"rows": checked.rows.rows},
            )
