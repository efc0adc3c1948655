"""Registry of all checks of calibrations and of rows."""

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError, ImplausibleError
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.backlash import with_approach_by_order
from pisigma.validation.checks.camera import check_camera
from pisigma.validation.checks.check import Check, CheckedCalibration, RowCheck
from pisigma.validation.checks.conditions import (
    check_conditions,
    check_expansion,
    check_payload,
    check_temperature,
)
from pisigma.validation.checks.lag import check_lag
from pisigma.validation.checks.mixed_rows import check_mixed_rows, check_two_populations
from pisigma.validation.checks.other_robot import check_other_robot, check_other_robot_of_rows
from pisigma.validation.checks.prior_ratio import check_joint_zero, check_prior_ratio
from pisigma.validation.checks.rounding import check_rounding
from pisigma.validation.checks.row_order import check_row_order
from pisigma.validation.checks.scale import check_scale, check_scale_of_rows
from pisigma.validation.checks.search import check_convergence, check_few_rows
from pisigma.validation.checks.setup_fault import check_setup_fault, check_setup_of_rows
from pisigma.validation.checks.stated_noise import check_stated_noise
from pisigma.validation.checks.torques import check_torques
from pisigma.validation.checks.unexplained import (
    check_residual_size,
    check_unexplained,
    check_unexplained_rows,
)
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.trained_calibrations import fit_compared_calibrations, geometric_result

_CHECKS: tuple[Check, ...] = (
    check_other_robot,
    check_setup_fault,
    check_joint_zero,
    check_row_order,
    check_lag,
    check_rounding,
    check_residual_size,
    check_scale,
    check_prior_ratio,
    check_convergence,
    check_stated_noise,
    check_two_populations,
    check_unexplained,
    check_few_rows,
    check_temperature,
    check_expansion,
    check_payload,
    check_conditions,
    check_torques,
    check_camera,
)
"""Checks of a calibration, in the order in which their findings are printed."""

ROW_CHECKS: tuple[RowCheck, ...] = (
    check_setup_of_rows,
    check_mixed_rows,
    check_other_robot_of_rows,
    check_scale_of_rows,
    check_unexplained_rows,
)
"""Checks of rows against a model, in order; `pisigma.validation.gate` runs them for every command."""


def diagnostics_of(checked: CheckedCalibration) -> tuple[Diagnostic, ...]:
    """Run all checks of a calibration; findings that make it implausible come first.

    Raises:
        IdentificationError: the measurements cannot belong to this robot.
    """
    diagnostics = [diagnostic for check in _CHECKS for diagnostic in check(checked)]
    return tuple(sorted(diagnostics, key=lambda diagnostic: diagnostic.severity != "implausible"))


def diagnostics_of_rows(calibrator: GeometricCalibrator, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Calibrate with the rows and run all checks; empty if there are too few rows for a calibration.

    Raises:
        ImplausibleError: no geometric errors of the robot explain the rows.
        IdentificationError: the rows cannot belong to this robot.
    """
    try:
        results = fit_compared_calibrations(calibrator, rows)
        unstated = geometric_result(results["geometric"])
        rows, backlash = with_approach_by_order(calibrator, rows, result=unstated)
        if backlash:
            results = fit_compared_calibrations(calibrator, rows)
    except ImplausibleError:
        raise
    except IdentificationError:
        return ()
    return (*diagnostics_of(CheckedCalibration(calibrator, rows, results)), *backlash)
