"""Recalibrate a model with few new rows: typed settings in, a typed result out that writes itself as a model folder."""

import datetime
import math
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from pisigma.camera.corner_file import CameraFiles, MeasurementFiles, read_rows
from pisigma.errors import IdentificationError, ModelError, nearest_choice
from pisigma.files.model_files import model_hash
from pisigma.hybrid.calibrator import HybridCalibrator
from pisigma.hybrid.result import HybridResult
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.judging.calibration_validation import errors_under
from pisigma.judging.diagnostic import Diagnostic
from pisigma.judging.distillation_summary import ParentFigures
from pisigma.judging.few_rows import fit_where_it_helps
from pisigma.judging.predicted_spread import image_deviation
from pisigma.judging.progress import Progress, stage
from pisigma.judging.trained_calibrations import fit
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.model_source import HoldsModel, ModelSource, model_or_folder
from pisigma.model.stated_conditions import condition_warnings
from pisigma.recalibration.adaptation import Adaptation, adapt
from pisigma.recalibration.candidates import FAR_BETTER, Gate, gate
from pisigma.recalibration.elsewhere import owners_elsewhere
from pisigma.recalibration.model_posterior import FLEET_PRIOR, ModelPosterior, check_fleet_prior
from pisigma.recalibration.moved import Moved, moved_by, what_moved
from pisigma.recalibration.recalibrated_model import KIND, recalibrated_model
from pisigma.recalibration.recalibration_problem import Owner, owners_in, recalibration_problem
from pisigma.recalibration.summary import (
    LeftOutFigures,
    MovedFigures,
    RecalibrationSummary,
    WrongRowFigures,
)
from pisigma.reporting.recalibration_card import write_recalibration_card
from pisigma.robot.description import Robot
from pisigma.verification.checks.other_robot import other_robot_diagnostics
from pisigma.verification.checks.registry import diagnostics_of_rows
from pisigma.workflow.result import AbstractModelResult

if TYPE_CHECKING:
    from pisigma.fleet.likeness import Likeness

FEW_ROWS = 5
"""Different poses below which nothing can be said of left-out rows."""
IMPLAUSIBLE = 0.01
"""Share of the reach that errors of left-out rows have where the rows are not of this robot."""
UNBELIEVABLE = "What has moved cannot be said: the recalibrated model does not predict left-out rows."
SUSPICIOUS = 5.0
"""Left-out errors that are so many times the noise of the calibration are warned of."""


@dataclass(frozen=True)
class RecalibrationSettings:
    """How a model is recalibrated.

    Attributes:
        moved: which of "base" and "tool" stand elsewhere than when the model was made; None to find it by evidence.
        cameras: what the pixels mean where files of rows hold corners of boards in images.

    Raises:
        IdentificationError: something else is named.
    """

    moved: tuple[str, ...] | None = None
    cameras: CameraFiles | None = None

    def command(self, model: str, data: str) -> str:
        """The line that recalibrates a model with a file in this way."""
        stated = ["--moved", ",".join(self.moved)] if self.moved else []
        stated += self.cameras.options if self.cameras else []
        return shlex.join(["pisigma", "recalibrate", model, data, *stated, "--out", "DIR"])

    def __post_init__(self) -> None:
        """Refuse what cannot stand elsewhere."""
        for name in self.moved or ():
            if name not in ("base", "tool"):
                raise IdentificationError(
                    f"moved: '{name}' is no choice; {nearest_choice(name, ('base', 'tool'))}"
                )


@dataclass(frozen=True, eq=False)
class Recalibration(AbstractModelResult):
    """A model after new rows: the candidate that predicts left-out rows best.

    Attributes:
        model: what `pisigma.load` would read, with all figures as its metrics.
        parent: the model that the rows were added to.
        adaptation: of the parent to all rows.
        gate: the errors of left-out rows under every candidate.
        moved: what has moved clearly.
        summary: all figures.
        seconds: time it took [s].
    """

    model: CalibratedModel
    parent: CalibratedModel
    adaptation: Adaptation
    gate: Gate
    moved: tuple[Moved, ...]
    summary: RecalibrationSummary
    seconds: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to heed, a sentence each."""
        return self.summary.warnings

    def _describe(self, model: CalibratedModel, summary: RecalibrationSummary, folder: Path) -> None:
        write_recalibration_card(model, summary, folder)


def recalibrate(
    model: ModelSource | HoldsModel,
    data: Measurements | MeasurementFiles,
    settings: RecalibrationSettings = RecalibrationSettings(),
    progress: Progress = lambda what: None,
    drawn: Robot | None = None,
) -> Recalibration:
    """Add new rows to what a model knows, and keep whichever model predicts left-out rows best.

    Args:
        model: of `pisigma calibrate`, `pisigma recalibrate` or `pisigma fleet prior`, or what holds it (a
            `CorrectedIK`, a `Calibration`), or its folder.
        data: new rows of any sensors, or CSV files of them; those of the set "test" are left out.
        settings: see `RecalibrationSettings`.
        progress: called with what is being done.
        drawn: the robot whose fleet the model has to be the prior of; None for any model.

    Raises:
        ModelError: the folder holds no model, it is of another robot or no fleet prior, or holds no posterior.
        MeasurementError: the data cannot be read.
        IdentificationError: the rows do not determine where something stands.
        PoseError: the joint values do not fit the robot.
    """
    started = time.perf_counter()
    source = model_or_folder(model)
    parent = source if isinstance(source, CalibratedModel) else load_model(source)
    sha256 = "" if isinstance(source, CalibratedModel) else model_hash(source)
    if drawn is not None:
        check_fleet_prior(parent)
    posterior = ModelPosterior.of(parent)
    if drawn is not None and not np.array_equal(drawn.dh, posterior.space.robot.dh):
        raise ModelError(
            f"model '{parent.name}' is of robot '{posterior.space.robot.name}' and not of '{drawn.name}'; choose the "
            "model of this robot."
        )
    drawn = posterior.space.robot
    measurements = read_rows(data, drawn, settings.cameras)
    rows = posterior.renamed(measurements.split_sets()[0])
    progress("what has moved")
    elsewhere = _elsewhere(parent, posterior, rows, settings)
    rows, adaptation, outliers = _adapted(parent, posterior, rows, elsewhere)
    calibrator = HybridCalibrator(drawn)
    judged = gate(parent, adaptation, elsewhere, rows, calibrator, stage(progress, "cross-validation"))
    likeness = _likeness(parent, rows)
    odd = likeness is not None and likeness.odd
    from_scratch = stage(progress, "from scratch")
    judged, kept = _kept(judged, odd, parent, adaptation, rows, calibrator, from_scratch)
    believable = likeness is None and _believable(judged, drawn)
    moved = moved_by(adaptation) if believable else None
    summary = _summary(parent, rows, adaptation, judged, moved).having(
        parent=ParentFigures(name=parent.name, kind=parent.kind, sha256=sha256),
        outliers=outliers,
        elsewhere=tuple(" ".join(owner).strip() for owner in sorted(elsewhere)),
    )
    if likeness is not None:
        summary = summary.having(changed=likeness.sentence)
    kept = replace(kept, metrics=summary.to_json())
    return Recalibration(
        kept, parent, adaptation, judged, moved or (), summary, seconds=time.perf_counter() - started
    )


def _adapted(
    parent: CalibratedModel, posterior: ModelPosterior, rows: Measurements, elsewhere: frozenset[Owner]
) -> tuple[Measurements, Adaptation, tuple[WrongRowFigures, ...]]:
    """The rows that are not wrong, the model adapted to them, and the wrong ones."""
    adaptation = adapt(recalibration_problem(parent, posterior, rows, elsewhere), posterior.noise)
    wrong = adaptation.wrong_rows
    if not wrong:
        return rows, adaptation, ()
    right = rows.select(torch.tensor([row for row in range(rows.rows) if row not in wrong]))
    adaptation = adapt(recalibration_problem(parent, posterior, right, elsewhere), posterior.noise)
    return right, adaptation, _outliers(adaptation, rows, wrong)


def _kept(
    judged: Gate,
    odd: bool,
    parent: CalibratedModel,
    adaptation: Adaptation,
    rows: Measurements,
    calibrator: HybridCalibrator,
    progress: Progress,
) -> tuple[Gate, CalibratedModel]:
    """The candidate that is kept, and its model; of a robot unlike its fleet the calibration from scratch."""
    if odd:
        alone = replace(judged, kept="scratch")
        try:
            return alone, _kept_model(alone, parent, adaptation, rows, calibrator, progress)
        except IdentificationError:  # the rows are too few for it
            judged = judged.with_least_error
    return judged, _kept_model(judged, parent, adaptation, rows, calibrator, progress)


def _kept_model(
    judged: Gate,
    parent: CalibratedModel,
    adaptation: Adaptation,
    rows: Measurements,
    calibrator: HybridCalibrator,
    progress: Progress,
) -> CalibratedModel:
    """The model of the candidate that is kept."""
    if judged.kept == "scratch":
        fitted = fit_where_it_helps if judged.rms["scratch"] is None else fit
        result = fitted(calibrator, rows, progress)
        assert isinstance(result, HybridResult)
        return replace(model_of_hybrid(parent.name, calibrator.geometric.robot, result, rows), kind=KIND)
    if judged.kept == "old":
        adaptation = adapt(adaptation.problem.without_arm(), adaptation.noise)
    return recalibrated_model(parent, adaptation, rows)


def _outliers(
    adaptation: Adaptation, rows: Measurements, wrong: Sequence[int]
) -> tuple[WrongRowFigures, ...]:
    """The rows that were left out, and how far they are off what the others say."""
    errors = errors_under(adaptation, rows)
    sizes = {"residual_mm": (errors.position, 1e3), "residual_deg": (errors.rotation, math.degrees(1.0))}
    outliers = []
    for row in wrong:
        off = {
            name: float(those[row]) * factor
            for name, (those, factor) in sizes.items()
            if those is not None and math.isfinite(those[row])
        }
        outliers.append(WrongRowFigures(row=row, place=rows.place(row), **off))
    return tuple(outliers)


def _believable(judged: Gate, robot: Robot) -> bool:
    """Whether the recalibrated model predicts left-out rows so well that what it says of the arm may be true."""
    error, kept = judged.rms["recalibrated"], judged.rms[judged.kept]
    if error is None or kept is None:
        return not judged.rows
    return error <= min(IMPLAUSIBLE * robot.reach, FAR_BETTER * kept)


def _summary(
    parent: CalibratedModel,
    rows: Measurements,
    adaptation: Adaptation,
    judged: Gate,
    moved: tuple[Moved, ...] | None,
) -> RecalibrationSummary:
    """All figures; `moved` is None where nothing can be said of it."""
    return RecalibrationSummary(
        command=f"pisigma.recalibrate({parent.name!r}, {rows.file_names!r})",
        diagnostics=_diagnostics(adaptation.problem.design.problem.space.robot, judged, rows),
        parent=ParentFigures(name=parent.name, kind=parent.kind, sha256=""),
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        rows=rows.rows,
        kept=judged.kept,
        verdict=judged.sentence,
        left_out=judged.rows,
        cross_validation={
            name: LeftOutFigures(rms_mm=None if rms is None else rms * 1e3)
            for name, rms in judged.rms.items()
        },
        changed=UNBELIEVABLE if moved is None else what_moved(moved),
        moved=tuple(MovedFigures.model_validate(one.to_json()) for one in moved or ()),
        elsewhere=(),
        effective_parameters=adaptation.effective,
        noise=adaptation.noise,
        warnings=_warnings(parent, judged, rows, adaptation.problem.posterior.noise),
    )


def _likeness(model: CalibratedModel, rows: Measurements) -> "Likeness | None":
    """How like its fleet the robot of some rows is; None where the model is not the prior of a fleet."""
    if model.kind != FLEET_PRIOR:
        return None
    from pisigma.fleet.likeness import Likeness  # brings statistics that take half a second

    return Likeness.of(model, rows)


def _elsewhere(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, settings: RecalibrationSettings
) -> frozenset[Owner]:
    """Bases and tools that stand elsewhere: those of the rows that are stated to, or what the evidence says.

    Every robot of a fleet has its own.
    """
    if model.kind == FLEET_PRIOR:
        return owners_in(rows, ("base", "tool"))
    if settings.moved is None:
        return owners_elsewhere(model, posterior, rows, posterior.noise)
    return owners_in(rows, settings.moved)


def _diagnostics(robot: Robot, judged: Gate, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Rows that no candidate predicts, or that another robot does, are not of this robot.

    A calibration from scratch is checked as `calibrate` checks it.
    """
    if judged.kept == "scratch":
        found = diagnostics_of_rows(GeometricCalibrator(robot), rows)
    else:
        found = other_robot_diagnostics(robot, rows)
    if implausible := tuple(one for one in found if one.severity == "implausible"):
        return implausible
    error = judged.rms[judged.kept]
    if error is None or error <= IMPLAUSIBLE * robot.reach:
        return ()
    return (
        Diagnostic(
            kind="residual",
            severity="implausible",
            sentence=f"{rows.source}: left-out rows are missed by {error * 1e3:.3g} mm, more than {IMPLAUSIBLE:.0%} "
            f"of the reach of robot '{robot.name}': they are not of this robot, or their columns or units are wrong; "
            "run `pisigma verify` on them.",
        ),
    )


def _warnings(
    model: CalibratedModel, judged: Gate, rows: Measurements, noise: Mapping[str, float]
) -> tuple[str, ...]:
    """What to heed, a sentence each; `noise` is that of the calibration, per sensor."""
    warnings = list(condition_warnings(model, rows))
    error = judged.rms[judged.kept]
    usual = max(math.sqrt(3) * noise.get("position", 0.0), image_deviation(rows))
    if error is not None and error > SUSPICIOUS * usual > 0 and model.kind != FLEET_PRIOR:
        warnings.append(
            f"Left-out rows are missed by {error * 1e3:.3g} mm, while single positions scattered by "
            f"{usual * 1e3:.2g} mm when the model was made, so that what is said to have moved may be wrong: rows "
            "may be wrong or of another specimen, or more has changed than so few rows can say. Check the rows with "
            "`pisigma verify`, or measure more of them."
        )
    if judged.rows < FEW_ROWS:
        warnings.append(
            f"Only {judged.rows} of {rows.rows} rows could be left out and predicted, which says little of the "
            f"candidates; measure {2 * FEW_ROWS} poses or more."
        )
    if model.provenance.data_sha256 == rows.content_hash():
        warnings.append(
            "The model was made of these rows already: they count twice, and its uncertainty is too small."
        )
    return tuple(warnings)
