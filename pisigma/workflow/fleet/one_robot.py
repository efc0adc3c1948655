"""What is done with one robot of a fleet: settings, its sessions one after the other, and its record."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from pisigma.files.errors import FleetError, OutputError, PisigmaError, nearest_choice
from pisigma.lifetime.fleet.members import Member, SessionFile
from pisigma.lifetime.fleet.record import REFUSED, ParameterValue, RobotRecord, SessionRecord, write_record
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.sensors.sensor import SHOWN_UNITS
from pisigma.measurement.splits import SplitBy
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import ClassName
from pisigma.validation.held_out.validation_figures import AbstractValidationFigures
from pisigma.workflow.calibrate import Calibration, calibrate
from pisigma.workflow.monitor import monitor
from pisigma.workflow.recalibrate import Recalibration, recalibrate
from pisigma.workflow.settings.calibration import CalibrationSettings, free_parameters
from pisigma.workflow.settings.fleet import FleetSettings
from pisigma.workflow.settings.monitoring import MonitorSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

OPTIONS = ("model", "free", "split", "robust", "prior_length", "prior_angle", "train_rows", "seed")
"""Settings of a calibration that a manifest may state for one robot."""
KINDS = get_type_hints(CalibrationSettings, localns={"SplitBy": SplitBy, "ClassName": ClassName})
UNKNOWN = SessionFile("description", "", Path())
"""Stands for the sessions of a robot whose description is wrong."""


def settings_for(settings: FleetSettings, member: Member) -> CalibrationSettings:
    """Settings of the calibration of one robot.

    Raises:
        FleetError: the description of the robot is wrong, an option of it is unknown or has no such value, or the
            task needs another model than it chooses.
        PisigmaError: the settings make no sense together.
    """
    if member.fault:
        raise FleetError(member.fault)
    for name, value in member.options:
        if not value:
            raise FleetError(
                f"robot '{member.id}': expected options as name=value; name=value, got '{name}'."
            )
        if name not in OPTIONS:
            raise FleetError(
                f"robot '{member.id}': option '{name}' is unknown; {nearest_choice(name, OPTIONS)}"
            )
        if [one for one, _ in member.options].count(name) > 1:
            raise FleetError(f"robot '{member.id}': option '{name}' appears twice; state it once.")
    stated: dict[str, Any] = {}
    for name, value in member.options:
        try:
            stated[name] = TypeAdapter(KINDS[name]).validate_python(_read(name, value))
        except ValidationError as problem:
            what = problem.errors()[0]["msg"]
            raise FleetError(f"robot '{member.id}': option '{name}': {what}, got '{value}'.") from None
    try:
        calibration = replace(settings.calibration, cameras=member.cameras, **stated)
    except PisigmaError as problem:
        raise FleetError(f"robot '{member.id}': {problem}") from None
    if settings.prior is not None:
        calibration.check_unused()
    elif settings.task != "calibrate" and member.model is None and calibration.model == "geometric":
        raise FleetError(
            f"robot '{member.id}': the task {settings.task} adds rows to the model of the first session, which only a "
            "hybrid can take; leave out --model geometric, or state a model folder in the column 'model'."
        )
    return calibration if settings.validate else replace(calibration, folds=0, hold_out=None, repeats=None)


def work_out(
    member: Member,
    settings: FleetSettings,
    out: Path,
    keys: Mapping[str, str],
    plans: Mapping[str, CalibrationSettings | str],
) -> RobotRecord:
    """Work out one robot, and write its models and its record.

    Args:
        member: the robot.
        settings: what is done.
        out: folder of the fleet.
        keys: of all robots, by id.
        plans: settings of their calibrations, or what is wrong with the options of a robot.
    """
    sessions: list[SessionRecord] = []
    try:
        plan = plans[member.id]
        if isinstance(plan, str):
            raise FleetError(plan)
        for record in _worked_out(member, settings, plan, out):
            sessions.append(record)
        result = RobotRecord(member.id, keys[member.id], tuple(sessions))
        write_record(out, result)
    except Exception as problem:  # what ends one robot does not end the others; a later call tries it again
        known = isinstance(problem, PisigmaError | OSError | MemoryError)
        what = (
            str(problem)
            if known
            else f"a defect of pisigma ({type(problem).__name__}: {problem}); please report it."
        )
        at = [*member.sessions, *member.sessions[-1:], UNKNOWN][len(sessions)]
        return RobotRecord(member.id, keys[member.id], (*sessions, _refusal(at, what)))
    return result


def _worked_out(
    member: Member, settings: FleetSettings, plan: CalibrationSettings, out: Path
) -> Iterator[SessionRecord]:
    """The records of the sessions of a robot, one after the other, up to one that is refused.

    Raises:
        OutputError: a model cannot be written.
    """
    parent, again = member.model, RecalibrationSettings(cameras=member.cameras)
    result: Calibration | Recalibration
    for number, session in enumerate(member.sessions):
        folder = out / "models" / member.id / session.name
        try:
            if settings.prior is not None and (parent is None or settings.task == "calibrate"):
                recalibration = recalibrate(
                    settings.prior, session.data, again, drawn=Robot.load(member.robot)
                )
                record, result = _recalibrated(recalibration, session), recalibration
            elif parent is None or settings.task == "calibrate":
                calibration = replace(calibrate(member.robot, session.data, plan), figures=settings.validate)
                record, result = _calibrated(calibration, session), calibration
            elif settings.task == "recalibrate":
                recalibration = recalibrate(parent, session.data, again)
                record, result = _recalibrated(recalibration, session), recalibration
            else:
                yield from _monitored(parent, member.sessions[number:], member.cameras)
                return
        except OutputError:
            raise
        except PisigmaError as problem:
            yield _refusal(session, str(problem))
            return
        if not result.trusted:
            reasons = (one.sentence for one in result.diagnostics if one.severity == "implausible")
            yield replace(record, verdict=REFUSED, sentence=" ".join(reasons), parameters=())
            return
        result.save(folder, command=f"pisigma fleet run --task {settings.task}", overwrite=True)
        yield replace(record, model=folder.relative_to(out).as_posix())
        parent = folder


def _calibrated(calibration: Calibration, session: SessionFile) -> SessionRecord:
    """What came of a calibration."""
    summary = calibration.summary
    kind = "hybrid" if summary.hybrid is not None else "geometric"
    return SessionRecord(
        session=session.name,
        date=session.date,
        file=session.data.name,
        rows=calibration.rows.rows,
        verdict="calibrated",
        sentence=f"A {kind} calibration of {calibration.rows.rows} rows.",
        rms_mm=_best_rms(summary.calibrated),
        held_out_rms_mm=_best_rms(summary.judged),
        parameters=tuple(
            ParameterValue(one.name, one.unit, one.estimated, one.change, one.standard_error)
            for one in summary.parameters
            if one.standard_error is not None
        ),
        warnings=calibration.warnings,
    )


def _best_rms(figures: AbstractValidationFigures | None) -> float | None:
    """RMS error of the last of the calibrations that are compared [mm]."""
    return None if figures is None else list(figures.models.values())[-1].rms_mm


def _recalibrated(recalibration: Recalibration, session: SessionFile) -> SessionRecord:
    """What came of a recalibration."""
    summary = recalibration.summary
    return SessionRecord(
        session=session.name,
        date=session.date,
        file=session.data.name,
        rows=summary.rows,
        verdict=summary.kept,
        sentence=f"{summary.changed} {summary.verdict}",
        rms_mm=summary.cross_validation[summary.kept].rms_mm,
        moved=bool(summary.moved),
        parameters=_parameters_of(recalibration.model),
        warnings=recalibration.warnings,
    )


def _parameters_of(model: CalibratedModel) -> tuple[ParameterValue, ...]:
    """The geometric parameters of which a model has a posterior."""
    known = model.uncertainty
    if known is None:
        return ()
    space, values = known.space, known.geometry.robot.dh.ravel()
    changes, deviations = values - space.robot.dh.ravel(), known.root[: space.arm_size].norm(dim=1)
    parameters = []
    for number in deviations.nonzero()[:, 0].tolist():
        unit, scale = SHOWN_UNITS[space.parameters[number].unit]
        figures = (float(those[number]) * scale for those in (values, changes, deviations))
        parameters.append(ParameterValue(space.names[number], unit, *figures))
    return tuple(parameters)


def _monitored(
    model: Path, sessions: tuple[SessionFile, ...], cameras: CameraFiles | None
) -> Iterator[SessionRecord]:
    """What the sessions say of the robot of a model, as one chart of all of them."""
    files = [one.data for one in sessions]
    dates = tuple(one.date for one in sessions) if all(one.date for one in sessions) else ()
    monitoring = monitor(model, files, MonitorSettings(dates=dates, history=False, cameras=cameras))
    untrusted = {one.file: one for one in monitoring.untrusted}
    trusted = iter(monitoring.sessions)
    for session in sessions:
        if (doubts := untrusted.get(session.data.name)) is not None:
            yield _refusal(session, doubts.sentence)
            continue
        judged = next(trusted)
        yield SessionRecord(
            session=session.name,
            date=judged.date,
            file=judged.file,
            rows=judged.session.rows,
            verdict=judged.session.verdict,
            sentence=judged.session.sentence,
            rms_mm=judged.session.rms * 1e3,
            recalibrate=judged.session.recalibrate,
            warnings=tuple(judged.session.unobservable),
        )


def _refusal(session: SessionFile, sentence: str) -> SessionRecord:
    return SessionRecord(session.name, session.date, session.data.name, 0, REFUSED, sentence)


def _read(name: str, value: str) -> str | tuple[str, ...]:
    """An option of a manifest: free parameters have commas or blanks between them."""
    return free_parameters(",".join(value.replace(",", " ").split())) if name == "free" else value
