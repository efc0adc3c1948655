"""Verify whether new measurements are explained better by the corrected model than by the nominal robot."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pisigma.lifetime.monitoring.session import Session
from pisigma.lifetime.recalibration.motion import judged_motion, motion_sentence, motion_warnings
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.joint_range import row_warnings
from pisigma.measurement.sensors.socket import matching_sockets
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.model.model_source import HoldsModel, ModelSource, model_or_folder
from pisigma.model.stated_conditions import condition_warnings
from pisigma.model.training_rows import training_row_warnings
from pisigma.robot.row import Row
from pisigma.validation.checks.rows.other_sensors import missed_distances
from pisigma.validation.checks.rows.wrong_rows import without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fitted_remark
from pisigma.validation.held_out.frames.row_errors import places_remark
from pisigma.validation.held_out.model_comparison import Difference, ModelComparison, compare_models
from pisigma.validation.held_out.pose_statistics import image_remark
from pisigma.validation.held_out.reference_models import geometric_model, nominal_model
from pisigma.validation.resampling import Bootstrap
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.setup_fault import SetupFault
from pisigma.validation.setup_faults.setup_faults import is_implausible, unexplained
from pisigma.workflow.evaluate import test_rows
from pisigma.workflow.settings.recalibration import RecalibrationSettings
from pisigma.workflow.settings.verification import VerificationSettings

FEWEST_CONFIGURATIONS = 6
"""With fewer different joint values nothing is concluded."""
MOST_DRAWN = 2 * 10**7
"""Numbers drawn for confidence intervals at most; of many rows fewer resamples are enough."""
RESAMPLES = (200, 2000)

NOMINAL, GEOMETRIC, CORRECTED = "nominal", "geometric", "corrected"

HALVED = 0.5
"""Where a setup fault is found, errors must at least be halved for the corrected model to count as better."""

MOTIONS = {"joint_zero", "frame", "tool"}
"""Setup faults of which the posterior of a model says more."""

Verdict = Literal["better", "not_better", "undecided", "moved", "setup_fault", "implausible"]

NOTHING_SHOWN = "These measurements do not show whether the correction is right"

_BEGIN: dict[Verdict, str] = {
    "better": "The corrected model explains these measurements better than the nominal robot",
    "not_better": "The nominal robot explains these measurements at least as well as the corrected model",
    "undecided": "These measurements do not show whether the corrected model or the nominal robot is nearer",
    "implausible": f"{NOTHING_SHOWN}, as their errors are too large to be those of a calibration",
}


@dataclass(frozen=True)
class Verification:
    """What new measurements say about a model.

    Attributes:
        model: its folder, or its name.
        data: file of the rows.
        rows: number of rows that were judged.
        settings: how.
        verdict: "better" where the corrected model explains the rows better than the nominal robot, which the
            confidence interval of the mean difference has to show; "undecided" where it shows nothing; "moved" where
            the posterior of the model says that the arm has moved and recalibrating pays; "setup_fault" where a setup
            fault explains the errors, so that neither counts; "implausible" where they are too large for a calibration
            and nothing explains them.
        sentence: the verdict with figures.
        ratio: mean position error of the corrected model over that of the nominal robot; NaN where that is 0.
        better_share: share of the configurations in which the corrected model is nearer.
        comparison: figures of "nominal", "geometric" (of a hybrid) and "corrected".
        diagnostics: why nothing is to be concluded from the rows, see `pisigma.validation.gate`.
        setup_faults: what explains large errors; nothing where `motion` explains them.
        motion: what has moved since the model was made; None where the model or the rows do not say.
        recalibration: the command that brings the model up to date; empty where that does not pay.
        warnings: what else should be known, each a sentence.
        seconds: that it took.
    """

    model: str
    data: str
    rows: int
    settings: VerificationSettings
    verdict: Verdict
    sentence: str
    ratio: float
    better_share: float
    comparison: ModelComparison
    diagnostics: tuple[Diagnostic, ...]
    setup_faults: tuple[SetupFault, ...]
    motion: Session | None
    recalibration: str
    warnings: tuple[str, ...]
    seconds: float

    @property
    def accepted(self) -> bool:
        """Whether the corrected model explains the measurements better."""
        return self.verdict == "better"

    def to_json(self) -> dict[str, object]:
        """Return everything as plain values: the result of `pisigma verify --json`."""
        return {
            "model": self.model,
            "data": self.data,
            "rows": self.rows,
            "frame_fitted": self.settings.fit_frame,
            "tool_fitted": self.settings.fit_tool,
            "explained_better": self.accepted,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "ratio": None if np.isnan(self.ratio) else self.ratio,
            "better_share": self.better_share,
            **self.comparison.to_json(),
            "diagnostics": [one.model_dump() for one in self.diagnostics],
            "setup_faults": [fault.to_json() for fault in self.setup_faults],
            "moved": [one.to_json() for one in self.motion.moved] if self.motion else [],
            "recalibrate": self.recalibration or None,
            "warnings": list(self.warnings),
            "seconds": self.seconds,
        }


def read_for_verification(
    path: MeasurementFiles, model: CalibratedModel, cameras: CameraFiles | None = None
) -> Measurements:
    """Read measurements whose joint values may lie outside the limits, as those of swapped columns do.

    Rows of the set "train" are left out where the file has a column "set".

    Raises:
        MeasurementError: the file cannot be used, or its column `set` leaves no row for tests.
    """
    rows, coupling = _without_limits(model.robot.rows), model.robot.coupling
    if coupling is not None:
        coupling = replace(coupling, axes=_without_limits(coupling.axes))
    return test_rows(read_rows(path, replace(model.robot, rows=rows, coupling=coupling), cameras))


def _without_limits(rows: Sequence[Row]) -> tuple[Row, ...]:
    return tuple(replace(row, lower=-np.inf, upper=np.inf) for row in rows)


def verify(
    model: ModelSource | HoldsModel,
    data: str | os.PathLike[str] | Measurements,
    settings: VerificationSettings | None = None,
) -> Verification:
    """Judge whether a correction is active and right, and what is wrong with the setup where errors are large.

    Args:
        model: the model or its folder.
        data: new rows, or their file, in frames and of targets that the model has.
        settings: how. None: `VerificationSettings()`.

    Raises:
        MeasurementError: the file cannot be used, or no lengths were measured, or in a frame or of a target that the
            model lacks.
        ModelError: the folder cannot be used, or the model does not keep enough joint values to fit base and tool of
            the nominal robot.
        PoseError: the joint values do not fit the robot.
    """
    settings, begin = settings or VerificationSettings(), time.perf_counter()
    source = model_or_folder(model)
    loaded = source if isinstance(source, CalibratedModel) else load_model(source)
    rows = data if isinstance(data, Measurements) else read_for_verification(data, loaded, settings.cameras)
    distances = matching_sockets(settings.socket_distances, rows.socket or ())
    right = without_wrong_rows([loaded], rows, settings.fitted)
    rows = right.rows
    models = _compared_models(loaded, rows.rotation is not None)
    resamples = int(np.clip(MOST_DRAWN // max(rows.rows, 1), *RESAMPLES))
    bootstrap = Bootstrap(resamples, settings.seed)
    comparison = compare_models(models, rows, bootstrap, settings.fitted, distances)
    gate = check_rows(rows, loaded, settings.fitted, {"joint_zero"}, models[NOMINAL])
    faults = gate.setup_faults
    motion = _motion(loaded, rows, settings.fitted, comparison, faults)
    mean = comparison.models[0].position.statistics["mean"]
    ratio = comparison.models[-1].position.statistics["mean"] / mean if mean > 0 else float("nan")
    difference = comparison.models[-1].position.difference
    assert difference is not None  # it is not the first
    if motion is not None and motion.moved and motion.recalibrate:
        verdict: Verdict = "moved"
        sentence, faults = motion_sentence(motion, comparison), ()
    else:
        verdict = _verdict(loaded, comparison, difference, ratio, faults)
        sentence = _sentence(verdict, comparison, difference, ratio, faults)
    wrong = (*gate.implausible, *missed_distances(comparison, comparison.models[-1]))
    if wrong and not faults:
        verdict, motion = "implausible", None
        sentence = f"{NOTHING_SHOWN}: {wrong[0].sentence}"
    name = loaded.name if isinstance(source, CalibratedModel) else os.fspath(source)
    return Verification(
        model=name,
        data=rows.source,
        rows=rows.rows,
        settings=settings,
        verdict=verdict,
        sentence=sentence,
        ratio=ratio,
        better_share=difference.better_share,
        comparison=comparison,
        diagnostics=wrong,
        setup_faults=faults,
        motion=motion,
        recalibration=_recalibration(name, rows.source, settings, motion),
        warnings=(
            *right.warnings,
            *_warnings(loaded, rows, comparison, faults, motion),
            *([] if motion is None or verdict == "moved" else motion_warnings(motion)),
            *fitted_remark(rows, settings.fitted),
            *places_remark(rows),
            *image_remark(rows),
        ),
        seconds=time.perf_counter() - begin,
    )


def _compared_models(model: CalibratedModel, turned: bool) -> dict[str, CalibratedModel]:
    """The nominal robot, the geometry of a hybrid, and the corrected model."""
    models = {NOMINAL: nominal_model(model, turned)}
    if model.hybrid is not None:
        models[GEOMETRIC] = geometric_model(model)
    return models | {CORRECTED: model}


def _recalibration(name: str, data: str, settings: VerificationSettings, motion: Session | None) -> str:
    """The command that brings a model up to date, where that pays."""
    if motion is None or not motion.recalibrate:
        return ""
    return RecalibrationSettings(settings.fitted or None, settings.cameras).command(name, data)


def _motion(
    model: CalibratedModel,
    rows: Measurements,
    fitted: Sequence[FrameKind],
    comparison: ModelComparison,
    faults: Sequence[SetupFault],
) -> Session | None:
    """Say what has moved, where no other setup fault and not the nominal robot explains the rows better."""
    if any(not MOTIONS.issuperset(fault.kinds) for fault in faults):
        return None
    motion = judged_motion(model, rows, fitted)
    nominal = comparison.models[0].position.statistics["rms"] * 1e-3
    return motion if motion is not None and motion.rms_after < nominal else None


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
    if comparison.configurations >= FEWEST_CONFIGURATIONS and interval is not None:
        low, high = interval
        if high < 0:
            verdict = "better"
        elif low > 0 or low == high == 0:
            verdict = "not_better"
    turned = any(fault.explains_orientation for fault in faults) and not _turn_ratio(comparison) <= HALVED
    if faults and (too_large or turned or (verdict != "not_better" and not ratio <= HALVED)):
        return "setup_fault"
    return "implausible" if too_large else verdict


def _turn_ratio(comparison: ModelComparison) -> float:
    """Divide the mean orientation error of the corrected model by that of the nominal robot; NaN without any."""
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
    turns = [comparison.models[i].orientation for i in (-1, 0)]
    if verdict in ("setup_fault", "implausible") and None not in turns:
        degrees = [turn.statistics["mean"] for turn in turns if turn is not None]
        figures += f", that of orientations {degrees[0]:.3g} deg instead of {degrees[1]:.3g} deg"
    if verdict == "setup_fault":
        fault = next((fault for fault in faults if np.isfinite(fault.after_nominal)), None)
        if fault is not None:
            after = [length_text(length) for length in (fault.after, fault.after_nominal)]
            figures += f"; with this set right, the errors are {after[0]} RMS instead of {after[1]}"
        clauses = ", or ".join(dict.fromkeys(fault.clause for fault in faults))
        return (
            f"{clauses[:1].upper()}{clauses[1:]}, so these measurements do not show whether the correction is right: "
            f"{figures}."
        )
    begin, count = _BEGIN[verdict], comparison.configurations
    interval = difference.intervals["mean"]
    if verdict == "implausible":
        return f"{begin}: {figures}."
    if count < FEWEST_CONFIGURATIONS or interval is None:
        return f"{begin}: {figures}, but {FEWEST_CONFIGURATIONS} or more different joint values are needed."
    return (
        f"{begin}: {figures}, it differs by {interval[0]:.3g} to {interval[1]:.3g} mm with "
        f"{comparison.bootstrap.confidence:.0%} confidence, and it is smaller in {difference.better_share:.0%} of "
        f"{count} configurations."
    )


def _warnings(
    model: CalibratedModel,
    rows: Measurements,
    comparison: ModelComparison,
    faults: Sequence[SetupFault],
    motion: Session | None,
) -> list[str]:
    warnings = [
        *row_warnings(model.robot, rows),
        *training_row_warnings(model, rows),
        *condition_warnings(model, rows),
    ]
    corrected = comparison.models[-1]
    if corrected.rows_not_predicted:
        warnings.append(
            f"{corrected.rows_not_predicted} rows lie so far outside the domain that nothing is predicted; they do "
            "not count."
        )
    if not faults and motion is None and is_implausible(corrected, model):
        warnings.append(unexplained(model))
    return warnings
