"""Whether the search for the parameters ended at a minimum."""

from collections.abc import Iterator

from pisigma.calibration.geometric.problem.least_squares import SolutionStatus
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic


class SearchCheck(AbstractCheck):
    """A search that was stopped at its limit has no result; one that stalled near the minimum has."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        status = checked.geometric.status
        if not status.good:
            stopped = status is SolutionStatus.ITERATION_LIMIT
            yield Diagnostic(
                kind="search",
                severity="implausible" if stopped else "warning",
                sentence=f"The search {status.value}.",
            )
