"""Whether left-out rows err far more than robots do after a calibration."""

from collections.abc import Iterator

from pisigma.robot.robot_class import HOBBY, RobotClass
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.checks.rounding import joint_rounding
from pisigma.validation.held_out.diagnostic import Diagnostic

FAR, FAR_HOBBY = 2.5e-3, 7.5e-3
"""Shares of the reach that errors of a calibrated robot are far below, industrial arms and cobots or others."""
LARGE = 1e-3
"""Share of the reach where calibrating has to help; measured arms (UR5, UR10, FANUC, Panda, FR3) have 2e-4 to 6e-4."""
HARDLY = 1.3
"""Errors of the drawn robot over those of the calibrated one."""
NOISE = 0.5
"""Share of the errors that the stated noise of the sensor explains."""


class UnexplainedCheck(AbstractCheck):
    """Compares errors of left-out positions, or else of those calibrated with, with what robots have.

    What other checks found is named by them: rounded joint values make errors of the rows and not of the robot.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        if not set(checked.rows.kinds) <= {"position", "rotation"}:
            return
        figures = checked.figures if checked.validation is None else checked.validation.figures()
        errors = {} if figures is None else {name: one.rms_mm for name, one in figures.models.items()}
        left, drawn = list(errors.values())[-1] if errors else None, errors.get("nominal")
        if left is None or drawn is None or self._explained(checked, left):
            return
        reach = checked.robot.reach * 1e3
        stated = checked.calibrator.robot_class or RobotClass.of(checked.robot).name
        far = left > (FAR_HOBBY if stated == HOBBY.name else FAR) * reach
        if far or (left > LARGE * reach and drawn < HARDLY * left):
            what = (
                "The calibrated robot errs"
                if checked.validation is None
                else "At left-out rows the robot errs"
            )
            yield Diagnostic(
                kind="unexplained",
                severity="implausible",
                sentence=f"{what} by {left:.3g} mm RMS, and as drawn by {drawn:.3g} mm: robots of this "
                f"size have less than {LARGE * reach:.2g} mm after a calibration. Two populations, a moved frame "
                "or tool, joint values that were logged too early or rounded, and a scale were tried"
                f"{'' if far else ', and calibrating hardly helps'}; check what else differs between the rows, and the "
                "sensor.",
            )

    @staticmethod
    def _explained(checked: CheckedCalibration, left: float) -> bool:
        """Whether rounding or the stated noise of the sensor makes errors of this size [mm]."""
        sigma = checked.rows.sigma_position
        noise = 0.0 if sigma is None else 3**0.5 * float(sigma.nanmedian()) * 1e3
        return noise > NOISE * left or joint_rounding(checked.geometric, checked.rows) is not None
