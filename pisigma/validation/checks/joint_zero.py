"""Whether the zero of a joint is farther off than robots leave their maker."""

import math
from collections.abc import Iterator

from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.checks.setup_fault import setup_diagnostics
from pisigma.validation.held_out.diagnostic import Diagnostic

FAR = 8e-3
"""[rad] Healthy industrial robots and cobots have zeros within 3 mrad of the drawn ones."""
CERTAIN = 3.0
"""[standard errors] By which a zero is farther off."""


class JointZeroCheck(AbstractCheck):
    """Warns of single zeros that are far off: a calibration takes them for the robot's, be they logged wrongly or true.

    Large ones show as a fault of the setup with the robot as drawn. Where the poses cover little of the workspace, base
    and tool take up most of what they make, and the parameters alone show them.
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
                sentence=f"The zero of joint {joint} comes out {math.degrees(one.change):.3g} deg away from the drawn "
                f"one (standard error {math.degrees(one.standard_error):.2g} deg), which is more than robots usually "
                f"have: check whether joint {joint} was zeroed or logged otherwise; the calibration holds for joint "
                "values that are logged like these.",
            )
