"""Registry of all checks of calibrations and of rows; a new check is a file and a line here."""

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError, ImplausibleError
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.camera import CameraCheck
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.checks.few_rows import FewRowsCheck
from pisigma.validation.checks.joint_zero import JointZeroCheck
from pisigma.validation.checks.lag import LagCheck
from pisigma.validation.checks.other_robot import OtherRobotCheck
from pisigma.validation.checks.prior_ratio import PriorRatioCheck
from pisigma.validation.checks.residual import ResidualCheck
from pisigma.validation.checks.rounding import RoundingCheck
from pisigma.validation.checks.row_order import RowOrderCheck
from pisigma.validation.checks.rows.mixed_rows import MixedRowsCheck
from pisigma.validation.checks.rows.row_check import AbstractRowCheck
from pisigma.validation.checks.rows.scale import ScaleOfRowsCheck
from pisigma.validation.checks.rows.setup import OtherRobotOfRowsCheck, SetupOfRowsCheck
from pisigma.validation.checks.rows.unexplained import UnexplainedRowsCheck
from pisigma.validation.checks.scale import ScaleCheck
from pisigma.validation.checks.search import SearchCheck
from pisigma.validation.checks.setup_fault import SetupFaultCheck
from pisigma.validation.checks.stated_noise import StatedNoiseCheck
from pisigma.validation.checks.temperature import TemperatureCheck
from pisigma.validation.checks.two_populations import TwoPopulationsCheck
from pisigma.validation.checks.unexplained import UnexplainedCheck
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.trained_calibrations import trained

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
"""Checks of a calibration, in the order in which their findings are printed."""

ROW_CHECKS: tuple[AbstractRowCheck, ...] = (
    SetupOfRowsCheck(),
    MixedRowsCheck(),
    OtherRobotOfRowsCheck(),
    ScaleOfRowsCheck(),
    UnexplainedRowsCheck(),
)
"""Checks of rows against a model, in order; `pisigma.validation.gate` runs them for every command."""


def diagnostics_of(checked: CheckedCalibration) -> tuple[Diagnostic, ...]:
    """Run all checks of a calibration; findings that make it implausible come first.

    Raises:
        IdentificationError: the measurements cannot belong to this robot.
    """
    diagnostics = [diagnostic for check in CHECKS for diagnostic in check.diagnose(checked)]
    return tuple(sorted(diagnostics, key=lambda diagnostic: diagnostic.severity != "implausible"))


def diagnostics_of_rows(calibrator: GeometricCalibrator, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Calibrate with some rows and run all checks; empty if there are too few rows for a calibration.

    Raises:
        ImplausibleError: no calibration error explains the rows.
        IdentificationError: the rows cannot belong to this robot.
    """
    try:
        results = trained(calibrator, rows)
    except ImplausibleError:
        raise
    except IdentificationError:
        return ()
    return diagnostics_of(CheckedCalibration(calibrator, rows, results))
