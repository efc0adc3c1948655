"""Whether the zero of a joint is farther off than in new robots."""

import math
from collections.abc import Iterator

from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.checks.setup_fault import setup_diagnostics
from pisigma.validation.held_out.diagnostic import Diagnostic

FAR = 8e-3
"""[rad] Healthy industrial robots and cobots have joint zeros within 3 mrad of the nominal ones."""
CERTAIN = 3.0
"""[standard errors] Margin above `FAR`."""


class JointZeroCheck(AbstractCheck):
    """Warns of single joint zeros that are far off: a calibration cannot distinguish a wrong zero from a wrong log.

    Large ones are found as a setup fault with the nominal robot. If the poses cover little of the workspace, base and
    tool absorb most of their effect, and only the estimated parameters show them.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        if setup_diagnostics(checked.robot, checked.rows):
            return
        for one in checked.geometric.parameters:
            joint = one.name.removeprefix("theta_")
            if joint == one.name or not one.free or abs(one.change) - CERTAIN * one.standard_error < FAR:
                continue
            yield Diagnostic(
                kind="joint_zero",
                severity="warning",
                sentence=f"The zero of joint {joint} is estimated {math.degrees(one.change):.3g} deg away from the "
                f"nominal one (standard error {math.degrees(one.standard_error):.2g} deg), which is more than robots "
                f"usually have; check the zero of joint {joint} and how its values were logged (the calibration is "
                "valid for joint values that are logged in the same way).",
                values={"joint": joint, "change_deg": math.degrees(one.change)},
            )
