"""Check rows before they are used; every command that reads rows calls `check_rows`."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.frame_model import FittedFrames
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.robot.description import Robot
from pisigma.validation.checks.check import CheckedCalibration, Move, RowsUnderModel
from pisigma.validation.checks.other_robot import other_robot_diagnostics
from pisigma.validation.checks.other_sensors import diagnose_lengths
from pisigma.validation.checks.registry import ROW_CHECKS, diagnostics_of_rows
from pisigma.validation.checks.row_order import instrument_moved_error
from pisigma.validation.checks.setup_fault import (
    check_joint_columns,
    check_position_spread,
    setup_diagnostics,
)
from pisigma.validation.checks.unexplained import check_residual_size
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind
from pisigma.validation.setup_faults.setup_fault import SetupFault

_MIN_ROWS_TO_CALIBRATE = 12
"""Smallest number of rows with which a calibration shows whether the errors are too large for this robot."""


@dataclass(frozen=True, eq=False)
class RowVerdict:
    """Findings of the checks of rows.

    Attributes:
        diagnostics: the findings; those that make the rows implausible come first.
        rows_under_model: the rows with the predictions of the model; None if rows were compared with a nominal robot,
            or if too few have positions.
        faults_of_length_rows: setup faults that explain the errors of rows without positions.
    """

    diagnostics: tuple[Diagnostic, ...] = ()
    rows_under_model: RowsUnderModel | None = None
    faults_of_length_rows: tuple[SetupFault, ...] = ()

    @property
    def setup_faults(self) -> tuple[SetupFault, ...]:
        """Setup faults of any size that explain the errors of all rows, including allowed motions."""
        return (
            self.faults_of_length_rows
            if self.rows_under_model is None
            else self.rows_under_model.setup_faults
        )

    @property
    def implausible_findings(self) -> tuple[Diagnostic, ...]:
        """Findings that forbid the use of the rows; commands exit with status 3."""
        return tuple(one for one in self.diagnostics if one.severity == "implausible")

    @property
    def trusted(self) -> bool:
        """Whether the rows may be used."""
        return not self.implausible_findings


def check_rows(
    rows: Measurements,
    reference: Robot | CalibratedModel,
    fitted_kinds: Collection[FrameKind] = (),
    allowed_moves: Collection[Move] = (),
    nominal: CalibratedModel | None = None,
) -> RowVerdict:
    """Check rows before they are used, against a model or a nominal robot.

    Against a nominal robot, or the mean robot of a fleet, the spread of the positions is compared with that of the
    robot's poses. With at least 6 rows, other robots of the catalogue are tried; with 8, reversed signs and swaps of
    joint columns; with 12, the rows are calibrated and all checks of a calibration are run; with 24, setup faults are
    searched for.

    Args:
        rows: the rows.
        reference: a calibrated model, or the nominal robot.
        fitted_kinds: frames and tools that are known to have moved since the model was made.
        allowed_moves: what else may have moved since then without this being a fault of the rows.
        nominal: the nominal robot with base and tool fitted; only used to report its errors after a correction.

    Raises:
        MeasurementError: the model does not have a frame or a target of the rows.
        PoseError: the joint values do not fit the robot.
    """
    if (
        isinstance(reference, CalibratedModel)
        and reference.kind == FLEET_PRIOR
        and reference.nominal is not None
    ):
        reference = reference.nominal
    if isinstance(reference, Robot):
        return RowVerdict(_until_implausible(_against_robot(rows, reference)))
    return check_rows_by_model(rows, reference, fitted_kinds, allowed_moves, nominal)


def check_rows_by_model(
    rows: Measurements,
    model: CalibratedModel,
    fitted_kinds: Collection[FrameKind] = (),
    allowed_moves: Collection[Move] = (),
    nominal: CalibratedModel | None = None,
) -> RowVerdict:
    """Run the checks of `ROW_CHECKS`, or `diagnose_lengths` for rows without positions; see `check_rows`."""
    judged = RowsUnderModel.from_rows(model, rows, fitted_kinds, allowed_moves, nominal)
    if judged is None and rows.position is None:
        diagnostics, faults = diagnose_lengths(model, rows, fitted_kinds, allowed_moves)
        return RowVerdict(diagnostics, None, faults)
    if judged is None:
        return RowVerdict()
    return RowVerdict(_until_implausible(check(judged) for check in ROW_CHECKS), judged)


def check_rows_of_frames(
    rows: Measurements, reference: Robot | CalibratedModel, fitted: FittedFrames
) -> tuple[Diagnostic, ...]:
    """Check rows to which base, tool or both were fitted, leaving out those that the others contradict.

    The rows are checked against the model whose arm was used, with the frames fitted, or against the nominal robot and
    its model with the fitted frames; then the residuals are compared with the reach.

    Args:
        rows: the rows.
        reference: the nominal robot or the model whose arm was used.
        fitted: the fitted frames.

    Returns:
        The findings; those that make the rows implausible come first.
    """
    used = torch.tensor(fitted.fit.used_rows)
    result, some = fitted.fit.solved.result(), rows.select(used)
    results = {"nominal": result, "geometric": result}
    kinds: dict[str, tuple[FrameKind, ...]] = {
        "tool": ("tool",),
        "base": ("base",),
        "hand-eye": ("base", "tool"),
    }
    checked = CheckedCalibration(GeometricCalibrator(result.robot), fitted.fit.rows.select(used), results)

    def findings() -> Iterator[Iterable[Diagnostic]]:
        if isinstance(reference, Robot):
            yield check_rows(some, reference).diagnostics
        model = fitted.model if isinstance(reference, Robot) else reference
        yield check_rows_by_model(some, model, kinds[fitted.fit.frame_choice]).diagnostics
        yield check_residual_size(checked)

    return _until_implausible(findings())


def _until_implausible(checks: Iterable[Iterable[Diagnostic]]) -> tuple[Diagnostic, ...]:
    """Return the findings up to the first check that rejects the rows; later findings are consequences."""
    found: list[Diagnostic] = []
    for diagnostics in checks:
        found += diagnostics
        if any(one.severity == "implausible" for one in found):
            break
    return tuple(sorted(found, key=lambda one: one.severity != "implausible"))


def _against_robot(rows: Measurements, robot: Robot) -> Iterator[Iterable[Diagnostic]]:
    """Run the checks against the nominal robot, most reliable first."""
    yield _moved_setup(rows, robot)
    yield setup_diagnostics(robot, rows)
    yield check_position_spread(robot, rows)
    yield check_joint_columns(robot, rows)
    yield other_robot_diagnostics(robot, rows)
    if rows.rows >= _MIN_ROWS_TO_CALIBRATE:
        yield _as_calibrated(rows, robot)


def _moved_setup(rows: Measurements, robot: Robot) -> tuple[Diagnostic, ...]:
    """Return a finding that names the row before which instrument or tool was moved too far for a calibration."""
    if (moved := instrument_moved_error(robot, rows)) is None:
        return ()
    return (
        Diagnostic(
            kind="row_order",
            severity="implausible",
            sentence=str(moved),
            row_places=(str(Place(rows.source, moved.line)),),
            cause="frame",
            values={} if moved.line is None else {"first_line": moved.line},
            remedy=moved.remedy,
        ),
    )


def _as_calibrated(rows: Measurements, robot: Robot) -> tuple[Diagnostic, ...]:
    """Calibrate with the rows, and return the findings of the checks of this calibration.

    The calibration has no joint correction, so residuals above the stated noise are not reported.
    """
    try:
        found = diagnostics_of_rows(GeometricCalibrator(robot), rows)
        return tuple(one for one in found if not _is_unmodelled(one))
    except IdentificationError as refusal:  # no geometric errors explain the rows
        sentence = str(refusal).removeprefix(f"{rows.source}: ")
        return (Diagnostic(kind="implausible_errors", severity="implausible", sentence=sentence),)


def _is_unmodelled(found: Diagnostic) -> bool:
    """Return whether a finding states that residuals are larger than the stated noise."""
    ratio = found.values.get("residual_over_stated")
    return isinstance(ratio, float) and ratio > 1
