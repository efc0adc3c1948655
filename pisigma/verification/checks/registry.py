"""All checks, of calibrations and of rows; a new one is a file and a line here."""

from pisigma.errors import IdentificationError, ImplausibleError
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.judging.diagnostic import Diagnostic
from pisigma.judging.trained_calibrations import trained
from pisigma.measurement.dataset import Measurements
from pisigma.verification.checks.camera import CameraCheck
from pisigma.verification.checks.check import AbstractCheck, CheckedCalibration
from pisigma.verification.checks.few_rows import FewRowsCheck
from pisigma.verification.checks.joint_zero import JointZeroCheck
from pisigma.verification.checks.lag import LagCheck
from pisigma.verification.checks.other_robot import OtherRobotCheck
from pisigma.verification.checks.prior_ratio import PriorRatioCheck
from pisigma.verification.checks.residual import ResidualCheck
from pisigma.verification.checks.rounding import RoundingCheck
from pisigma.verification.checks.row_order import RowOrderCheck
from pisigma.verification.checks.scale import ScaleCheck
from pisigma.verification.checks.search import SearchCheck
from pisigma.verification.checks.setup_fault import SetupFaultCheck
from pisigma.verification.checks.stated_noise import StatedNoiseCheck
from pisigma.verification.checks.temperature import TemperatureCheck
from pisigma.verification.checks.two_populations import TwoPopulationsCheck
from pisigma.verification.checks.unexplained import UnexplainedCheck
from pisigma.verification.rows.mixed_rows import MixedRowsCheck
from pisigma.verification.rows.row_check import AbstractRowCheck
from pisigma.verification.rows.scale import ScaleOfRowsCheck
from pisigma.verification.rows.setup import OtherRobotOfRowsCheck, SetupOfRowsCheck
from pisigma.verification.rows.unexplained import UnexplainedRowsCheck

CHECKS: tuple[AbstractCheck, ...] = (
    OtherRobotCheck(),
    SetupFaultCheck(),
    JointZeroCheck(),
    RowOrderCheck(),
    LagCheck(),
    RoundingCheck(),
    ResidualCheck(),
    ScaleCheck(),
    PriorRatioCheck(),
    SearchCheck(),
    StatedNoiseCheck(),
    TwoPopulationsCheck(),
    UnexplainedCheck(),
    FewRowsCheck(),
    TemperatureCheck(),
    CameraCheck(),
)
"""Of a calibration, in the order in which their diagnostics are printed."""

ROW_CHECKS: tuple[AbstractRowCheck, ...] = (
    SetupOfRowsCheck(),
    MixedRowsCheck(),
    OtherRobotOfRowsCheck(),
    ScaleOfRowsCheck(),
    UnexplainedRowsCheck(),
)
"""Of rows against a model, likewise; `pisigma.verification.gate` runs them for every command."""


def diagnostics_of(checked: CheckedCalibration) -> tuple[Diagnostic, ...]:
    """Run all checks: those that make the calibration implausible first.

    Raises:
        IdentificationError: the measurements cannot be of this robot at all.
    """
    diagnostics = [diagnostic for check in CHECKS for diagnostic in check.diagnose(checked)]
    return tuple(sorted(diagnostics, key=lambda diagnostic: diagnostic.severity != "implausible"))


def diagnostics_of_rows(calibrator: GeometricCalibrator, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Calibrate with some rows and run all checks; nothing is said while they are too few for a calibration.

    Raises:
        ImplausibleError: no calibration error explains the rows.
        IdentificationError: they cannot be of this robot at all.
    """
    try:
        results = trained(calibrator, rows)
    except ImplausibleError:
        raise
    except IdentificationError:
        return ()
    return diagnostics_of(CheckedCalibration(calibrator, rows, results))
