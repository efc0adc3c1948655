"""Verify whether the corrected model explains new measurements better than the nominal robot does."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pisigma.lifetime.monitoring.session import SessionResult
from pisigma.lifetime.recalibration.motion import find_motion, motion_sentence, motion_warnings
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.measurement.sensors.socket import expand_socket_names
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import HasModel, ModelSource, loaded_model
from pisigma.model.stated_conditions import condition_warnings
from pisigma.model.training_rows import training_row_warnings
from pisigma.validation.checks.other_sensors import distance_diagnostics
from pisigma.validation.checks.wrong_rows import without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fitted_remark
from pisigma.validation.held_out.frames.row_errors import fitted_points_remark
from pisigma.validation.held_out.model_comparison import Difference, ModelComparison, compare_models
from pisigma.validation.held_out.pose_statistics import image_remark
from pisigma.validation.held_out.reference_models import geometric_model, nominal_model
from pisigma.validation.resampling import Bootstrap
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.setup_fault import SetupFault
from pisigma.validation.setup_faults.setup_faults import is_implausible, unexplained_diagnostic
from pisigma.workflow.evaluate import test_rows
from pisigma.workflow.settings.recalibration import RecalibrationSettings
from pisigma.workflow.settings.verification import VerificationSettings

_MIN_CONFIGURATIONS = 6
"""Minimum number of different joint vectors for a verdict."""
_MAX_RESAMPLED_ROWS = 2 * 10**7
"""Maximum number of random draws for confidence intervals; with many rows, fewer resamples are sufficient."""
_RESAMPLES = (200, 2000)
"""Minimum and maximum number of resamples."""

NOMINAL, GEOMETRIC, CORRECTED = "nominal", "geometric", "corrected"

_HALVED = 0.5
"""Largest ratio of corrected to nominal error at which the corrected model is called better despite a setup fault."""

_MOTIONS = {"joint_zero", "frame", "tool"}
"""Setup faults that the posterior of a model explains in more detail."""

Verdict = Literal["better", "not_better", "undecided", "moved", "setup_fault", "implausible"]

_NOTHING_SHOWN = "These measurements do not show whether the correction is right"

_STARTS: dict[Verdict, str] = {
    "better": "The corrected model explains these measurements better than the nominal robot",
    "not_better": "The nominal robot explains these measurements at least as well as the corrected model",
    "undecided": "These measurements do not show whether the corrected model or the nominal robot is more accurate",
    "implausible": f"{_NOTHING_SHOWN}, because their errors are too large for a calibrated robot",
}


@dataclass(frozen=True)
class Verification:
    """Result of `verify`, which compares a model with new measurements.

    Attributes:
        model: folder or name of the model.
        data: file of the rows.
        rows: number of evaluated rows.
        settings: settings of the verification.
        verdict: "better" or "not_better" if the confidence interval of the mean difference shows that the corrected
            model explains the rows better than the nominal robot, or that it does not; "undecided" if it shows neither;
            "moved" if parts of the arm have moved according to the posterior of the model and a recalibration is
            recommended; "setup_fault" if a setup fault explains the errors, which then prove nothing; "implausible" if
            the errors are too large for a calibrated robot and no fault explains them.
        sentence: sentence that states the verdict with figures.
        corrected_to_nominal_error_ratio: mean position error of the corrected model divided by that of the nominal
            robot; NaN if the latter is 0.
        better_share: fraction of the configurations in which the corrected model has the smaller error.
        comparison: figures of "nominal", "geometric" (of a hybrid) and "corrected".
        diagnostics: reasons why the rows must not be trusted; see `pisigma.validation.gate`.
        setup_faults: setup faults that explain large errors; empty if `movements` explains them.
        movements: parts that have moved since the model was made; None if the model or the rows do not show motions.
        recalibration_command: command that updates the model; empty if this is not recommended.
        warnings: sentences with other remarks.
        seconds: computing time [s].
    """

    model: str
    data: str
    rows: int
    settings: VerificationSettings
    verdict: Verdict
    sentence: str
    corrected_to_nominal_error_ratio: float
    better_share: float
    comparison: ModelComparison
    diagnostics: tuple[Diagnostic, ...]
    setup_faults: tuple[SetupFault, ...]
    movements: SessionResult | None
    recalibration_command: str
    warnings: tuple[str, ...]
    seconds: float

    @property
    def accepted(self) -> bool:
        """Whether the corrected model explains the measurements better."""
        return self.verdict == "better"

    def to_json(self) -> dict[str, object]:
        """Return all results as plain values: the result of `pisigma verify --json`."""
        return {
            "model": self.model,
            "data": self.data,
            "rows": self.rows,
            "frame_fitted": self.settings.fit_frame,
            "tool_fitted": self.settings.fit_tool,
            "accepted": self.accepted,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "ratio": None
            if np.isnan(self.corrected_to_nominal_error_ratio)
            else self.corrected_to_nominal_error_ratio,
            "better_share": self.better_share,
            **self.comparison.to_json(),
            "diagnostics": [one.model_dump(by_alias=True) for one in self.diagnostics],
            "setup_faults": [fault.to_json() for fault in self.setup_faults],
            "moved": [one.to_json() for one in self.movements.movements] if self.movements else [],
            "recalibrate": self.recalibration_command or None,
            "warnings": list(self.warnings),
            "seconds": self.seconds,
        }


def read_for_verification(
    path: MeasurementFiles, model: CalibratedModel, cameras: CameraFiles | None = None
) -> Measurements:
    """Read measurements without checking joint limits, because swapped columns exceed them.

    Rows of the set "train" are left out if the file has a column "set".

    Raises:
        MeasurementError: the file cannot be used, or its column `set` leaves no rows for tests.
    """
    return test_rows(read_rows(path, model.robot.without_limits, cameras))


def verify(
    model: ModelSource | HasModel,
    data: str | os.PathLike[str] | Measurements,
    settings: VerificationSettings | None = None,
) -> Verification:
    """Verify that a correction is active and right, and find faults of the setup if errors are large.

    Args:
        model: the model or its folder.
        data: new rows, or their file, in frames and of targets that the model has.
        settings: see `VerificationSettings`; None for the defaults.

    Raises:
        MeasurementError: the file cannot be used, no lengths were measured, or the model does not have a frame or a
            target of the rows.
        ModelError: the folder cannot be used, or the model does not store enough joint values to fit base and tool of
            the nominal robot.
        PoseError: the joint values do not fit the robot.
    """
    settings, started = settings or VerificationSettings(), time.perf_counter()
    loaded, folder = loaded_model(model)
    rows = data if isinstance(data, Measurements) else read_for_verification(data, loaded, settings.cameras)
    distances = expand_socket_names(settings.socket_distances, rows.socket or ())
    right = without_wrong_rows([loaded], rows, settings.fitted_kinds)
    rows = right.rows
    models = _compared_models(loaded, rows.rotation is not None)
    resamples = int(np.clip(_MAX_RESAMPLED_ROWS // max(rows.rows, 1), *_RESAMPLES))
    bootstrap = Bootstrap(resamples, settings.seed)
    comparison = compare_models(models, rows, bootstrap, settings.fitted_kinds, distances)
    gate = check_rows(rows, loaded, settings.fitted_kinds, {"joint_zero"}, models[NOMINAL])
    faults = gate.setup_faults
    motion = _motion(loaded, rows, settings.fitted_kinds, comparison, faults)
    mean = comparison.models[0].position.statistics["mean"]
    ratio = comparison.models[-1].position.statistics["mean"] / mean if mean > 0 else float("nan")
    difference = comparison.models[-1].position.difference
    assert difference is not None  # it is not the first
    if motion is not None and motion.movements and motion.recalibrate:
        verdict: Verdict = "moved"
        sentence, faults = motion_sentence(motion, comparison), ()
    else:
        verdict = _verdict(loaded, comparison, difference, ratio, faults)
        sentence = _sentence(verdict, comparison, difference, ratio, faults)
    wrong = (*gate.implausible_findings, *distance_diagnostics(comparison, comparison.models[-1]))
    if wrong and not faults:
        verdict, motion = "implausible", None
        sentence = f"{_NOTHING_SHOWN}: {wrong[0].sentence}"
    name = loaded.name if folder is None else os.fspath(folder)
    return Verification(
        model=name,
        data=rows.source,
        rows=rows.rows,
        settings=settings,
        verdict=verdict,
        sentence=sentence,
        corrected_to_nominal_error_ratio=ratio,
        better_share=difference.better_share,
        comparison=comparison,
        diagnostics=wrong,
        setup_faults=faults,
        movements=motion,
        recalibration_command=_recalibration(name, rows.source, settings, motion),
        warnings=(
            *right.warnings,
            *_warnings(loaded, rows, comparison, faults, motion),
            *([] if motion is None or verdict == "moved" else motion_warnings(motion)),
            *fitted_remark(rows, settings.fitted_kinds),
            *fitted_points_remark(rows),
            *image_remark(rows),
        ),
        seconds=time.perf_counter() - started,
    )


def _compared_models(model: CalibratedModel, with_orientation: bool) -> dict[str, CalibratedModel]:
    """Return the nominal robot, the geometric part of a hybrid, and the corrected model."""
    models = {NOMINAL: nominal_model(model, with_orientation)}
    if model.hybrid is not None:
        models[GEOMETRIC] = geometric_model(model)
    return models | {CORRECTED: model}


def _recalibration(name: str, data: str, settings: VerificationSettings, motion: SessionResult | None) -> str:
    """Return the command that updates a model; empty if a recalibration is not recommended."""
    if motion is None or not motion.recalibrate:
        return ""
    return RecalibrationSettings(settings.fitted_kinds or None, settings.cameras).command(name, data)


def _motion(
    model: CalibratedModel,
    rows: Measurements,
    fitted: Sequence[FrameKind],
    comparison: ModelComparison,
    faults: Sequence[SetupFault],
) -> SessionResult | None:
    """Return the moved parts; None if another setup fault or the nominal robot explains the rows better."""
    if any(not _MOTIONS.issuperset(fault.kinds) for fault in faults):
        return None
    motion = find_motion(model, rows, fitted)
    nominal = comparison.models[0].position.statistics["rms"] * 1e-3
    return motion if motion is not None and motion.rms_after_recalibration < nominal else None


def _verdict(
    model: CalibratedModel,
    comparison: ModelComparison,
    difference: Difference,
    ratio: float,
    faults: Sequence[SetupFault],
) -> Verdict:
    too_large = all(is_implausible(comparison.models[i], model) for i in (0, -1))
    interval = difference.intervals["mean"]
    verdict: Verdict = "undecided"
    if comparison.configurations >= _MIN_CONFIGURATIONS and interval is not None:
        low, high = interval
        if high < 0:
            verdict = "better"
        elif low > 0 or low == high == 0:
            verdict = "not_better"
    misoriented = (
        any(fault.explains_orientation for fault in faults) and not _orientation_ratio(comparison) <= _HALVED
    )
    if faults and (too_large or misoriented or (verdict != "not_better" and not ratio <= _HALVED)):
        return "setup_fault"
    return "implausible" if too_large else verdict


def _orientation_ratio(comparison: ModelComparison) -> float:
    """Divide the mean orientation error of the corrected model by that of the nominal robot; NaN where undefined."""
    nominal, corrected = (comparison.models[i].orientation for i in (0, -1))
    if nominal is None or corrected is None or not nominal.statistics["mean"] > 0:
        return float("nan")
    return corrected.statistics["mean"] / nominal.statistics["mean"]


def _sentence(
    verdict: Verdict,
    comparison: ModelComparison,
    difference: Difference,
    ratio: float,
    faults: Sequence[SetupFault],
) -> str:
    nominal, corrected = comparison.models[0].position, comparison.models[-1].position
    means = [length_text(model.statistics["mean"] / 1e3) for model in (corrected, nominal)]
    figures = f"the mean error is {means[0]} instead of {means[1]}"
    if np.isfinite(ratio):
        figures += f" (ratio {ratio:.3g})"
    orientations = [comparison.models[i].orientation for i in (-1, 0)]
    if verdict in ("setup_fault", "implausible") and None not in orientations:
        degrees = [one.statistics["mean"] for one in orientations if one is not None]
        figures += f", the mean orientation error {degrees[0]:.3g} deg instead of {degrees[1]:.3g} deg"
    if verdict == "setup_fault":
        fault = next((fault for fault in faults if np.isfinite(fault.nominal_rms_after)), None)
        if fault is not None:
            after = [length_text(length) for length in (fault.rms_after, fault.nominal_rms_after)]
            figures += f"; with this corrected, the errors are {after[0]} RMS instead of {after[1]}"
        clauses = ", or ".join(dict.fromkeys(fault.clause for fault in faults))
        return (
            f"{clauses[:1].upper()}{clauses[1:]}, so these measurements do not show whether the correction is right: "
            f"{figures}."
        )
    start, count = _STARTS[verdict], comparison.configurations
    interval = difference.intervals["mean"]
    if verdict == "implausible":
        return f"{start}: {figures}."
    if count < _MIN_CONFIGURATIONS or interval is None:
        return f"{start}: {figures}, but {_MIN_CONFIGURATIONS} or more different joint values are needed."
    return (
        f"{start}: {figures}; it differs by {interval[0]:.3g} to {interval[1]:.3g} mm with "
        f"{100 * comparison.bootstrap.confidence:.0f} % confidence, and it is smaller in "
        f"{100 * difference.better_share:.0f} % of {count} configurations."
    )


def _warnings(
    model: CalibratedModel,
    rows: Measurements,
    comparison: ModelComparison,
    faults: Sequence[SetupFault],
    motion: SessionResult | None,
) -> list[str]:
    warnings = [
        *row_warnings(model.robot, rows),
        *training_row_warnings(model, rows),
        *condition_warnings(model, rows),
    ]
    corrected = comparison.models[-1]
    if corrected.rows_not_predicted:
        warnings.append(
            f"{corrected.rows_not_predicted} rows are so far outside the domain that they cannot be predicted; they "
            "are left out."
        )
    if not faults and motion is None and is_implausible(corrected, model):
        warnings.append(unexplained_diagnostic(model).sentence)
    return warnings
