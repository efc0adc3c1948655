"""Whether the errors of held-out rows are far larger than those of calibrated robots."""

from collections.abc import Iterator

from pisigma.robot.robot_class import HOBBY, RobotClass
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.checks.rounding import joint_rounding
from pisigma.validation.held_out.diagnostic import Diagnostic

FAR, FAR_HOBBY = 2.5e-3, 7.5e-3
"""Errors as a share of the reach above which a calibrated robot is implausible: industrial arms and cobots, others."""
LARGE = 1e-3
"""Errors as a share of the reach above which calibration must help; measured arms (UR5, UR10, FANUC, Panda, FR3) have
2e-4 to 6e-4."""
HARDLY = 1.3
"""Errors of the nominal robot over those of the calibrated one below which calibration hardly helped."""
NOISE = 0.5
"""Share of the errors above which the stated noise of the sensor explains them."""


class UnexplainedCheck(AbstractCheck):
    """Compares the errors of held-out positions, or else those of the calibration, with those of calibrated robots.

    Errors that other checks explain are not reported again: rounded joint values are errors of the rows, not the robot.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        if not set(checked.rows.kinds) <= {"position", "rotation"}:
            return
        figures = checked.figures if checked.validation is None else checked.validation.figures()
        errors = {} if figures is None else {name: one.rms_mm for name, one in figures.models.items()}
        left, nominal = list(errors.values())[-1] if errors else None, errors.get("nominal")
        if left is None or nominal is None or self._explained(checked, left):
            return
        reach = checked.robot.reach * 1e3
        stated = checked.calibrator.robot_class or RobotClass.from_robot(checked.robot).name
        far = left > (FAR_HOBBY if stated == HOBBY.name else FAR) * reach
        if far or (left > LARGE * reach and nominal < HARDLY * left):
            what = "rows of the calibration" if checked.validation is None else "held-out rows"
            yield Diagnostic(
                kind="unexplained",
                severity="implausible",
                sentence=f"The errors of the {what} are {left:.3g} mm RMS ({nominal:.3g} mm for the nominal robot), "
                f"but robots of this size have less than {LARGE * reach:.2g} mm after a calibration"
                f"{'' if far else ', and calibration hardly helped'}. Mixed populations, a moved frame or tool, joint "
                "values that were logged too early or rounded, and a scale do not explain them; check what else "
                "differs between the rows, and the sensor.",
                values={"rms_mm": left, "nominal_rms_mm": nominal},
            )

    @staticmethod
    def _explained(checked: CheckedCalibration, left: float) -> bool:
        """Say whether rounding or the stated noise of the sensor makes errors of this size [mm]."""
        sigma = checked.rows.sigma_position
        noise = 0.0 if sigma is None else 3**0.5 * float(sigma.nanmedian()) * 1e3
        return noise > NOISE * left or joint_rounding(checked.geometric, checked.rows) is not None
