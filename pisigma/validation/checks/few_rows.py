"""Whether the arm was calibrated at all, or stays as drawn for want of rows."""

from collections.abc import Iterator

from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic


class FewRowsCheck(AbstractCheck):
    """Says so where parameters of the arm were wanted, but none was estimated."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        problem = checked.geometric.solved.problem
        if checked.calibrator.free and not bool((problem.active < problem.space.arm_size).any()):
            yield Diagnostic(
                kind="few_rows",
                severity="warning",
                sentence=f"The arm stays as drawn, only base and tool were fitted: the {checked.rows.rows} rows do not "
                "show that another geometry predicts left-out rows better; measure more poses, in which all joints "
                "move.",
            )
