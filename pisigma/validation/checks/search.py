"""Whether the search for the parameters ended at a minimum."""

from collections.abc import Iterator

from pisigma.calibration.geometric.problem.least_squares import SolutionStatus
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic


class SearchCheck(AbstractCheck):
    """Rejects a search that was stopped at the iteration limit, and warns of one that stalled near the minimum."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        status = checked.geometric.status
        if not status.good:
            stopped = status is SolutionStatus.ITERATION_LIMIT
            yield Diagnostic(
                kind="search",
                severity="implausible" if stopped else "warning",
                sentence=f"The search {status.value}.",
                cause=status.name.lower(),
            )
