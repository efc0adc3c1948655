"""Check whether the search for the parameters ended at a minimum, and whether the arm was calibrated at all."""

from collections.abc import Iterator

from pisigma.calibration.geometric.problem.least_squares import SolutionStatus
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic


def check_convergence(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Reject a search that stopped at the iteration limit, and warn about a search that stalled near the minimum."""
    status = checked.geometric.status
    if not status.is_minimum:
        stopped = status is SolutionStatus.ITERATION_LIMIT
        yield Diagnostic(
            kind="search",
            severity="implausible" if stopped else "warning",
            sentence=f"The search {status.value}.",
            cause=status.name.lower(),
        )


def check_few_rows(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn if parameters of the arm were requested, but only base and tool were fitted."""
    problem = checked.geometric.solved.problem
    if checked.calibrator.free and not bool((problem.active < problem.space.arm_parameter_count).any()):
        yield Diagnostic(
            kind="few_rows",
            severity="warning",
            sentence="The arm keeps its nominal geometry, and only base and tool were fitted: with these "
            f"{checked.rows.rows} rows, no other geometry predicts held-out rows better; measure more poses in "
            "which all joints move.",
            values={"rows": checked.rows.rows},
        )
