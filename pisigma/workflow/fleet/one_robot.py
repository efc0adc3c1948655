"""Process one robot of a fleet: its settings, its sessions one after the other, and its record."""

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
"""Settings of a calibration that a manifest can state for one robot."""
KINDS = get_type_hints(CalibrationSettings, localns={"SplitBy": SplitBy, "ClassName": ClassName})
UNKNOWN = SessionFile("description", "", Path())
"""Placeholder for the sessions of a robot whose description is not valid."""


def settings_for(settings: FleetSettings, member: Member) -> CalibrationSettings:
    """Return the settings of the calibration of one robot.

    Raises:
        FleetError: the description of the robot is not valid, an option is unknown or its value is not valid, or the
            task needs another kind of model.
        PisigmaError: the settings contradict each other.
    """
    if member.fault:
        raise FleetError(member.fault)
    for name, value in member.options:
        if not value:
            raise FleetError(
                f"robot '{member.id}': expected options as name=value; name=value, got '{name}'",
                expected="options as name=value; name=value",
                value=name,
            )
        if name not in OPTIONS:
            raise FleetError(
                f"robot '{member.id}': unknown option '{name}'",
                value=name,
                remedy=nearest_choice(name, OPTIONS),
            )
        if [one for one, _ in member.options].count(name) > 1:
            raise FleetError(
                f"robot '{member.id}': option '{name}' appears twice", value=name, remedy="state it once"
            )
    stated: dict[str, Any] = {}
    for name, value in member.options:
        try:
            stated[name] = TypeAdapter(KINDS[name]).validate_python(_read(name, value))
        except ValidationError as problem:
            what = problem.errors()[0]["msg"]
            raise FleetError(
                f"robot '{member.id}': option '{name}': {what}, got '{value}'.", value=value
            ) from None
    try:
        calibration = replace(settings.calibration, cameras=member.cameras, **stated)
    except PisigmaError as problem:
        located = FleetError(f"robot '{member.id}': {problem}")
        located.__dict__.update(problem.__dict__)
        raise located from None
    if settings.prior is not None:
        calibration.check_unused()
    elif settings.task != "calibrate" and member.model is None and calibration.model == "geometric":
        raise FleetError(
            f"robot '{member.id}': the task {settings.task} adds rows to the model of the first session, which has to "
            "be a hybrid",
            value=settings.task,
            remedy="omit --model geometric, or state a model folder in the column 'model'",
        )
    return calibration if settings.validate else replace(calibration, folds=0, hold_out=None, repeats=None)


def process_robot(
    member: Member,
    settings: FleetSettings,
    out: Path,
    keys: Mapping[str, str],
    plans: Mapping[str, CalibrationSettings | str],
) -> RobotRecord:
    """Process the sessions of one robot, and write its models and its record.

    Args:
        member: the robot.
        settings: settings of the fleet.
        out: folder of the fleet.
        keys: keys of all robots by id; see `RobotRecord`.
        plans: settings of their calibrations by id, or why a robot's options cannot be used.
    """
    sessions: list[SessionRecord] = []
    try:
        plan = plans[member.id]
        if isinstance(plan, str):
            raise FleetError(plan)
        for record in _session_records(member, settings, plan, out):
            sessions.append(record)
        result = RobotRecord(member.id, keys[member.id], tuple(sessions))
        write_record(out, result)
    except Exception as problem:  # one robot must not stop the others; a later call tries it again
        known = isinstance(problem, PisigmaError | OSError | MemoryError)
        what = (
            str(problem)
            if known
            else f"a defect of pisigma ({type(problem).__name__}: {problem}); please report it."
        )
        at = [*member.sessions, *member.sessions[-1:], UNKNOWN][len(sessions)]
        return RobotRecord(member.id, keys[member.id], (*sessions, _refusal(at, what)))
    return result


def _session_records(
    member: Member, settings: FleetSettings, plan: CalibrationSettings, out: Path
) -> Iterator[SessionRecord]:
    """Yield the records of the sessions of a robot, one after the other, until one is refused.

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
                    settings.prior, session.data, again, nominal=Robot.load(member.robot)
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
    """Return the record of a calibration."""
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
    """Return the RMS error of the last one of the compared calibrations [mm]."""
    return None if figures is None else list(figures.models.values())[-1].rms_mm


def _recalibrated(recalibration: Recalibration, session: SessionFile) -> SessionRecord:
    """Return the record of a recalibration."""
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
    """Return the geometric parameters of which a model has a posterior."""
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
    """Yield the records of sessions that are monitored together, in one chart."""
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
    """Return the value of an option of a manifest; free parameters are separated by commas or blanks."""
    return free_parameters(",".join(value.replace(",", " ").split())) if name == "free" else value
