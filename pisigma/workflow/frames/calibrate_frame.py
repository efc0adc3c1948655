"""Calibrate a base, tool or hand-eye transform from few rows, or from a session of a cell, with the arm held fixed."""

import os
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pisigma.calibration.frames.frame_fit import FrameChoice, FrameFit
from pisigma.files.errors import IdentificationError, check_choice
from pisigma.files.model_files import is_model, model_hash
from pisigma.lifetime.cell.history import Check, ModelEntry, now
from pisigma.lifetime.cell.layout import MODELS
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import HasModel, loaded_model
from pisigma.model.frame_model import frames_of_model, frames_of_robot
from pisigma.reporting.derived_cards import write_frame_card
from pisigma.robot.description import Robot
from pisigma.validation.checks.row_order import explain_refusal
from pisigma.validation.gate import check_rows_of_frames
from pisigma.validation.held_out.distillation_summary import ParentFigures
from pisigma.validation.held_out.frame_calibration_summary import (
    FrameCalibrationSummary,
    frame_calibration_summary,
)
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.model_choice import model_entry
from pisigma.workflow.cell.new_files import save_under_new_name
from pisigma.workflow.result import AbstractModelResult

_CHOICES: tuple[FrameChoice, ...] = ("tool", "base", "hand-eye")


@dataclass(frozen=True, eq=False)
class FrameCalibration(AbstractModelResult):
    """Result of `calibrate_frame`.

    Attributes:
        model: the robot or model with the calibrated frames, as `pisigma.load` would read it.
        fit: the fit, with covariance and weak directions in SI units.
        summary: all figures.
        seconds: computing time [s].
    """

    model: CalibratedModel
    fit: FrameFit
    summary: FrameCalibrationSummary
    seconds: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings, one sentence each."""
        return self.summary.warnings

    @property
    def held_out_p95_and_best_known_rms_mm(self) -> tuple[float | None, float | None]:
        """Return None and the RMS of the position errors of the rows [mm]; see `AbstractModelResult`."""
        return None, self.summary.rms_mm

    def _describe(self, model: CalibratedModel, summary: FrameCalibrationSummary, folder: Path) -> None:
        write_frame_card(model, summary, folder)


def calibrate_frame(
    robot: Robot | CalibratedModel | HasModel | str | os.PathLike[str],
    data: Measurements | MeasurementFiles,
    only: FrameChoice,
    cameras: CameraFiles | None = None,
) -> FrameCalibration:
    """Calibrate base, tool or both, with the arm held fixed, from 4 to 12 touches, positions, poses or images.

    The fit is by least squares. Standard errors include the noise of the residuals and, for a model that has a
    posterior, the uncertainty of its arm. Rows that all others contradict are left out and named, and the others are
    checked, see `pisigma.validation.gate.check_rows_of_frames`; `diagnostics` contains the findings.

    Args:
        robot: nominal robot (a `Robot`, catalogue name or robot file), or a calibrated model (an object that has one,
            or its folder).
        data: measurements, or CSV files of them; rows of the set "test" are not used. For a tool, rows of one socket
            are touches of one unknown point.
        only: "tool" (with the base of the robot or model), "base" (with its tool) or "hand-eye" (both).
        cameras: cameras and boards, for files of detected board corners.

    Returns:
        The robot or model with the calibrated frames; `save` writes it as a model folder.

    Raises:
        RobotError: the robot is unknown.
        ModelError: the folder is not that of a model, or a network of the model depends on base and tool.
        MeasurementError: the data cannot be read, or the model does not know a frame or target of the rows.
        IdentificationError: there are too few rows.
        PoseError: the joint values do not fit the robot.
    """
    started = time.perf_counter()
    check_choice(IdentificationError, "only", only, _CHOICES)
    model, parent = _model_of(robot)
    arm = _drawn(robot) if model is None else model.robot
    rows, _ = read_rows(data, arm, cameras).split_sets()
    try:
        found = frames_of_robot(arm, rows, only) if model is None else frames_of_model(model, rows, only)
    except IdentificationError as refusal:
        raise explain_refusal(refusal, arm, rows) from refusal
    diagnostics = check_rows_of_frames(rows, arm if model is None else model, found)
    warnings = (one.sentence for one in diagnostics if one.severity == "warning")
    summary = frame_calibration_summary(
        found.fit, found.variance_due_to_arm, found.causes, parent, (*row_warnings(arm, rows), *warnings)
    )
    summary = summary.with_figures(
        command=f"pisigma.calibrate_frame({arm.name!r}, {rows.file_names!r}, {only!r})",
        diagnostics=diagnostics,
    )
    made = replace(found.model, metrics=summary.to_json())
    return FrameCalibration(made, found.fit, summary, time.perf_counter() - started)


Source = Robot | CalibratedModel | HasModel | str | os.PathLike[str]


def _drawn(robot: Source) -> Robot:
    """Return a nominal robot."""
    assert isinstance(robot, Robot | str | os.PathLike)
    return robot if isinstance(robot, Robot) else Robot.load(os.fspath(robot))


def _model_of(robot: Source) -> tuple[CalibratedModel | None, ParentFigures | None]:
    """Return the model of an argument and its figures as a parent; None for a robot."""
    if isinstance(robot, Robot) or (isinstance(robot, str | os.PathLike) and not is_model(Path(robot))):
        return None, None
    model, folder = loaded_model(robot)
    sha256 = "" if folder is None else model_hash(folder)
    return model, ParentFigures(name=model.name, kind=model.kind, sha256=sha256)


def calibrate_frame_of_cell(
    cell: Cell, only: FrameChoice, accept_implausible: bool = False
) -> tuple[FrameCalibration, ModelEntry | None]:
    """Calibrate base, tool or both with the newest session and the arm of the model in use, and store the model.

    If no model is in use, the newest model of the cell is used or, if there is none, its nominal robot. `verify` puts
    the new model into use.

    Args:
        cell: the cell.
        only: what to calibrate.
        accept_implausible: store the model even if it must not be trusted.

    Returns:
        The calibration and the entry of its model; the entry is None if an untrusted model was not stored.

    Raises:
        MeasurementError: there is no valid session, or none to which the model was not fitted.
        IdentificationError: the session has too few rows.
    """
    started = now()
    parent = cell.history.in_use or next(reversed(cell.history.models()), None)
    if parent is None:
        session = cell.sessions.valid_sessions()[-1]
        found = calibrate_frame(cell.robot, cell.sessions.rows_of([session]), only)
    else:
        cell.controller_warnings("calibrate", parent)
        session = cell.sessions.choose_session(parent, None)
        rows = cell.sessions.rows_of_file(session)
        seen = cell.sessions.rows_with_model_names(parent, rows, session.day)
        found = calibrate_frame(cell.model_folder(parent.name), seen.rows, only)
    doubt = "" if found.trusted else found.diagnostics[0].sentence
    if doubt and not accept_implausible:
        refused = ("calibrate", "", session.name, "not_trusted", doubt)
        cell.history.add(Check(*refused, None, False, started))
        return found, None
    taken = [one.name for one in cell.history.models()]
    save = partial(found.save, accept_implausible=accept_implausible)
    path = save_under_new_name(cell.folder / MODELS, save, taken)
    events = cell.history.events() if parent is None else ()
    remark = f"{only} calibrated with session '{session.name}'"
    entry = model_entry(events, started, path, [session], remark, found, parent)
    verdict = "accepted_implausible" if doubt else "trusted"
    check = Check("calibrate", entry.name, session.name, verdict, doubt or remark, None, False, started)
    cell.history.add(entry, check)
    return found, entry
