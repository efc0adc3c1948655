"""Calibrate a robot from measurements."""

import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.estimation.loss import HampelLoss, SquaredLoss
from pisigma.files.errors import IdentificationError
from pisigma.files.model_files import HELD_OUT_CSV
from pisigma.files.progress import Progress
from pisigma.joint_correction.registry import plugin_features
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements, with_new_frames
from pisigma.measurement.exceeded_limits import row_warnings, with_limits_of_rows
from pisigma.measurement.sensors.socket import PairOfSockets, expand_socket_names
from pisigma.measurement.splits import Splitting, draw_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.geometric_model import model_of_calibration, with_hybrid
from pisigma.reporting.cards import CardTexts, write_calibration_card
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import CLASSES, SERVO, RobotClass
from pisigma.validation.checks.backlash import with_approach_by_order
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.checks.registry import diagnostics_of
from pisigma.validation.checks.row_order import explain_refusal
from pisigma.validation.checks.scale import scale_figures
from pisigma.validation.checks.setup_fault import setup_diagnostics
from pisigma.validation.held_out.calibration_summary import CalibrationSummary, summarise
from pisigma.validation.held_out.calibration_validation import (
    CalibrationValidation,
    joined_repeats,
    judge,
)
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.few_rows import fit_with_folds
from pisigma.validation.held_out.held_out_rows import HeldOutRows
from pisigma.validation.held_out.pose_statistics import predicted_rms_at_other_poses
from pisigma.validation.held_out.trained_calibrations import (
    Calibrator,
    Result,
    fit_compared_calibrations,
    geometric_of,
    geometric_result,
)
from pisigma.workflow.result import AbstractModelResult
from pisigma.workflow.settings.calibration import CalibrationSettings, ModelKind

_ONLY_GEOMETRY = (
    "Only the geometry was calibrated, without cross-validation: a joint correction must not learn errors that a fault "
    "of the setup or of the file explains."
)


@dataclass(frozen=True, eq=False)
class Calibration(AbstractModelResult):
    """Result of `calibrate`: the model, its validation and all figures.

    Attributes:
        model: the calibrated model, with all figures as its metrics, as `pisigma.load` would read it.
        result: the geometric or hybrid calibration from which the model was built.
        rows: measurements with which the model was calibrated.
        validation: errors of held-out rows; None if there was no validation.
        test: errors of the rows of the set "test"; None if there are none.
        held_out: all held-out rows with their errors, as in the model folder; None if there was no validation.
        summary: all figures.
        card_texts: description of the model, and limits of its validation.
        settings: settings of the calibration; None for a recipe.
        seconds: computing time [s].
        has_drawn_figures: whether the card has figures.
    """

    model: CalibratedModel
    result: Result
    rows: Measurements
    validation: CalibrationValidation | None
    test: CalibrationValidation | None
    held_out: HeldOutRows | None
    summary: CalibrationSummary
    card_texts: CardTexts
    settings: CalibrationSettings | None = None
    seconds: float = 0.0
    has_drawn_figures: bool = True

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings and recommendations, one sentence each."""
        return self.summary.warnings

    @property
    def held_out_p95_and_best_known_rms_mm(self) -> tuple[float | None, float | None]:
        """95 % quantile and RMS of the position errors [mm]; see `AbstractModelResult`."""
        judged, fitted = self.summary.validation_errors, self.summary.training_errors
        if judged is not None:
            errors = list(judged.models.values())[-1]
            return errors.p95_mm, errors.rms_mm
        return None, None if fitted is None else list(fitted.models.values())[-1].rms_mm

    def _describe(self, model: CalibratedModel, summary: CalibrationSummary, folder: Path) -> None:
        judged = self.validation or self.test
        write_calibration_card(
            model, self.result, self.rows, judged, summary, self.card_texts, folder, self.has_drawn_figures
        )
        if self.held_out is not None:
            text = self.held_out.to_csv(model.robot)
            (folder / HELD_OUT_CSV).write_text(text, encoding="utf-8", newline="\n")


def calibrate(
    robot: Robot | str | os.PathLike[str],
    data: Measurements | MeasurementFiles,
    settings: CalibrationSettings = CalibrationSettings(),
    progress: Progress = lambda what: None,
) -> Calibration:
    """Calibrate a robot, and validate the calibration on held-out rows.

    Args:
        robot: the nominal robot, or its catalogue name or robot file (YAML or URDF).
        data: measurements, or CSV files of them. Rows of the set "test" are not used to calibrate; the final model is
            tested on them.
        settings: see `CalibrationSettings`.
        progress: called with the current step.

    Returns:
        The calibrated model with its validation; `save` writes it as a model folder.

    Raises:
        RobotError: the robot is unknown.
        MeasurementError: the data cannot be read, or cannot be split as the settings require.
        IdentificationError: the data do not determine the free parameters.
    """
    started = time.perf_counter()
    nominal = robot if isinstance(robot, Robot) else Robot.load(os.fspath(robot))
    measurements = read_rows(data, nominal, settings.cameras)
    measurements = with_new_frames(measurements, settings.new_frame_at)
    beyond, nominal = row_warnings(nominal, measurements), with_limits_of_rows(nominal, measurements)
    training = measurements.split_sets()[0]
    splitting = Splitting(settings.split, settings.seed, settings.folds, settings.hold_out)
    splits = splitting.split(training, settings.repeats, settings.train_rows)
    distances = expand_socket_names(settings.socket_distances, training.socket or ())
    calibrator = calibrator_of(settings, nominal, distances)
    drawn = None if settings.train_rows is None else draw_rows(training, settings.train_rows, settings.seed)

    def calibrated(every: Measurements) -> Measurements:
        some = replace(training, approach=every.split_sets()[0].approach)
        return some if drawn is None else some.select(drawn)

    measurements, backlash = with_approach_by_order(geometric_of(calibrator), measurements, calibrated)
    sided, test_rows = measurements.split_sets()
    training, rows = replace(training, approach=sided.approach), calibrated(measurements)
    faulty = any(one.severity == "implausible" for one in setup_diagnostics(nominal, rows))
    if faulty:
        calibrator, splits = geometric_of(calibrator), []
    try:
        result, judged = fit_with_folds(calibrator, rows, training, splits, progress, settings.jobs)
    except IdentificationError as refusal:
        raise explain_refusal(refusal, nominal, rows) from refusal
    validation = joined_repeats(training, splits, judged) if splits else None
    test = None if test_rows is None else judge(calibrator, result, rows, test_rows)
    summary = summarise(result)
    summary = summary.with_figures(
        warnings=(*summary.warnings, *((_ONLY_GEOMETRY,) if faulty else ()), *beyond),
        command=_call(nominal, measurements, settings),
        rows=rows.rows,
        cross_validation=None if validation is None else validation.figures(),
        test=None if test is None else test.figures(),
    )
    texts = CardTexts(
        _description("geometric" if faulty else settings.model, nominal),
        "Validated on rows of the same measurement only, not on other days, payloads or temperatures.",
    )
    calibration = compose_calibration(
        calibrator, result, rows, summary, texts, validation, test, training, diagnostics=backlash
    )
    return replace(calibration, settings=settings, seconds=time.perf_counter() - started)


def compose_calibration(
    calibrator: Calibrator,
    result: Result,
    rows: Measurements,
    summary: CalibrationSummary,
    texts: CardTexts,
    validation: CalibrationValidation | None = None,
    test: CalibrationValidation | None = None,
    held_out: Measurements | None = None,
    recipe_name_and_hash: tuple[str, str] = ("", ""),
    diagnostics: tuple[Diagnostic, ...] = (),
) -> Calibration:
    """Check a calibration, and build its model and summary.

    Args:
        calibrator: the calibrator.
        result: result of the calibrator.
        rows: measurements with which the model was calibrated.
        summary: figures so far.
        texts: texts of the card.
        validation: errors of held-out rows.
        test: errors of the rows of the set "test".
        held_out: rows of the validation whose errors the model folder stores; None to store no errors.
        recipe_name_and_hash: name and SHA-256 of the recipe; empty without a recipe.
        diagnostics: findings before the calibration.

    Raises:
        IdentificationError: the measurements cannot come from this robot.
    """
    checked = CheckedCalibration(
        geometric_of(calibrator), rows, fit_compared_calibrations(calibrator, rows, result=result), validation
    )
    diagnostics, nominal = (*diagnostics_of(checked), *diagnostics), checked.robot
    warnings = tuple(one.sentence for one in diagnostics if one.severity == "warning")
    summary = summary.with_figures(
        training_errors=checked.figures,
        scale=scale_figures(checked),
        diagnostics=diagnostics,
        warnings=summary.warnings + warnings,
    )
    if validation is None and summary.test is None and summary.held_out is None:
        predicted = predicted_rms_at_other_poses(result, rows)
        summary = summary.with_figures(predicted_rms_mm=None if predicted is None else predicted * 1e3)
    kept = (
        None if validation is None or held_out is None else HeldOutRows.from_validation(validation, held_out)
    )
    if kept is not None:
        summary = summary.with_figures(held_out_rows=kept.compute_hashes(kept.to_csv(nominal)))
    model = model_of_calibration(
        recipe_name_and_hash[0] or nominal.name, nominal, geometric_result(result), rows, recipe_name_and_hash
    )
    if isinstance(result, HybridResult):
        model = with_hybrid(model, result, rows)
    model = replace(model, metrics=summary.to_json())
    return Calibration(model, result, rows, validation, test, kept, summary, texts)


def _class_of(settings: CalibrationSettings, robot: Robot) -> RobotClass:
    """Return the stated class of a robot, or else that of its manufacturer."""
    return CLASSES[settings.robot_class] if settings.robot_class else RobotClass.from_robot(robot)


def _call(robot: Robot, measurements: Measurements, settings: CalibrationSettings) -> str:
    """Return the call that repeats this calibration, with the settings that differ from the defaults."""
    usual = CalibrationSettings()
    named = {item.name: getattr(settings, item.name) for item in fields(settings)}
    stated = [
        f"{name}={value!r}"
        for name, value in named.items()
        if value != getattr(usual, name) and name != "jobs"
    ]
    words = [repr(robot.name), repr(measurements.file_names)]
    words += [f"CalibrationSettings({', '.join(stated)})"] if stated else []
    return f"pisigma.calibrate({', '.join(words)})"


def _description(model: ModelKind, nominal: Robot) -> str:
    if model == "geometric":
        return (
            f"Geometric calibration of robot {nominal.name} ({nominal.maker}): DH and Hayati parameters, base and tool "
            "by least squares."
        )
    return (
        f"Hybrid calibration of robot {nominal.name} ({nominal.maker}): DH and Hayati parameters, base and tool, and "
        "with them, where the data support it, a Pi-Sigma network that corrects the joint values."
    )


def calibrator_of(
    settings: CalibrationSettings, robot: Robot, distances: Mapping[PairOfSockets, float]
) -> Calibrator:
    """Build the calibrator of a robot.

    Args:
        settings: see `CalibrationSettings`.
        robot: the nominal robot.
        distances: known distances between pairs of sockets of the data [m].

    Raises:
        IdentificationError: a setting does not fit the robot.
    """
    length, angle = settings.prior_length, settings.prior_angle
    usual = _class_of(settings, robot)
    zeros = max(angle, usual.prior_sizes.joint_offset) if usual is SERVO else angle
    # An error that several distances share is not averaged out by them.
    names = [name for pair in distances for name in pair]
    shared = max(
        (len(expand_socket_names({pair: one}, names)) for pair, one in settings.socket_distances.items()),
        default=1,
    )
    geometric = GeometricCalibrator(
        robot,
        free=settings.free,
        prior=Prior(theta=zeros, d=length, a=length, alpha=angle, beta=angle) if length else None,
        loss=HampelLoss() if settings.robust else SquaredLoss(),
        robot_class=settings.robot_class,
        socket_distances=dict(distances),
        socket_sigma=settings.socket_sigma * math.sqrt(shared),
    )
    if settings.model != "hybrid":
        return geometric
    features = (*plugin_features(), *HybridCalibrator.features)
    return HybridCalibrator(
        geometric,
        features=features if settings.features is None else settings.features,
        gravity=settings.gravity,
    )
