"""Whether the errors of the geometry are of a size that a robot of this drawing can have."""

from collections.abc import Iterator

from pisigma.judging.diagnostic import Diagnostic
from pisigma.verification.checks.check import AbstractCheck, CheckedCalibration

UNUSUAL = 4.0
"""Errors that are surely more than so many times as large as the prior says are worth a warning. Healthy robots have
up to 4.6 times the default prior of 1 mrad."""
IMPLAUSIBLE = 10.0
"""Errors that are surely so many times as large as the prior says are not those of this robot: the odds against one
normal error of 10 standard deviations are 1 to 1e23, and the geometry was not built within the tolerances."""


class PriorRatioCheck(AbstractCheck):
    """Compares the estimated size of the geometric errors with what the prior says."""

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        for ratio in checked.geometric.prior_ratios:
            if ratio.at_least > UNUSUAL:
                implausible = ratio.at_least > IMPLAUSIBLE
                consequence = (
                    "which no robot of this drawing has; check whether this robot was measured, its units, and "
                    "order and directions of its joints, or give a wider prior if it is meant to be so far off."
                    if implausible
                    else "so their size was taken from the data; check the nominal geometry and the robot, or give a "
                    "wider prior."
                )
                yield Diagnostic(
                    kind="prior_ratio",
                    severity="implausible" if implausible else "warning",
                    sentence=f"The {ratio.kind} errors are about {ratio.value:.2g} times as large as the prior says, "
                    f"{consequence}",
                )
