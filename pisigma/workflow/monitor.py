"""Monitor a robot: sessions of few rows against its model, one by one and over the months."""

import datetime
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from pisigma.files.errors import MeasurementError, ModelError
from pisigma.files.model_files import model_hash
from pisigma.files.output_file import check_page, write_whole
from pisigma.files.progress import Progress
from pisigma.lifetime.monitoring.charts import FALSE_ALARMS_PER_YEAR, SESSIONS_PER_YEAR, Chart
from pisigma.lifetime.monitoring.history import (
    Record,
    history_path,
    in_order,
    new_rows,
    recall,
    remember,
    rows_hash,
)
from pisigma.lifetime.monitoring.session import judge_session
from pisigma.lifetime.monitoring.trends import (
    Forecast,
    Jump,
    Trend,
    charts_of,
    forecast_of,
    jumps_of,
    trends_of,
)
from pisigma.lifetime.recalibration.motion import session_diagnostics
from pisigma.lifetime.recalibration.recalibration_problem import owners_in
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.copies import RowValues
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.dates import WANTED, date_in_name, is_date
from pisigma.measurement.joint_range import row_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.model.model_posterior import FLEET_PRIOR, ModelPosterior
from pisigma.model.model_source import HoldsModel, ModelSource, model_or_folder
from pisigma.model.stated_conditions import condition_warnings
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.workflow.recalibrate import may_move, right_rows
from pisigma.workflow.settings.monitoring import MonitorSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

FEWEST_ROWS = 5
"""Rows of a session below which it says little."""


@dataclass(frozen=True)
class UntrustedSession:
    """A session of which nothing is concluded, so that it is in no chart and no history.

    Attributes:
        file: that the rows came from.
        date: of the measurement, as ISO 8601 writes it.
        diagnostics: why.
    """

    file: str
    date: str
    diagnostics: tuple[Diagnostic, ...]

    @property
    def sentence(self) -> str:
        """Which session it is, and why it is left out."""
        return f"{self.file} of {self.date} is left out: {' '.join(one.sentence for one in self.diagnostics)}"

    def to_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "file": self.file,
            "date": self.date,
            "diagnostics": [one.model_dump() for one in self.diagnostics],
        }


@dataclass(frozen=True, eq=False)
class Monitoring:
    """Sessions of a robot, and what they say over the months.

    Attributes:
        model: that they were compared with.
        sessions: of this call.
        records: all sessions of the model, those of its history among them, by their dates.
        charts: of the zeros of all joints and of the error, over all sessions.
        trends: of the zeros of all joints.
        jumps: of these between two sessions.
        forecast: of the error; None where no limit was stated.
        warnings: what to heed, a sentence each.
        cameras: what the pixels of its files of corners mean.
        untrusted: sessions of this call of which nothing is concluded.
        seconds: time it took [s].
    """

    model: CalibratedModel
    sessions: tuple[Record, ...]
    records: tuple[Record, ...]
    charts: tuple[Chart, ...]
    trends: tuple[Trend, ...]
    jumps: tuple[Jump, ...]
    forecast: Forecast | None
    warnings: tuple[str, ...]
    cameras: CameraFiles | None = None
    untrusted: tuple[UntrustedSession, ...] = ()
    seconds: float = field(default=0.0)

    @property
    def action(self) -> bool:
        """Whether something is to be done: rows are implausible, recalibrating pays, or a limit is passed."""
        alarmed = any(chart.alarm is not None for chart in self.charts)
        passed = self.forecast is not None and self.forecast.passed
        return (
            bool(self.untrusted) or alarmed or passed or any(one.session.recalibrate for one in self.sessions)
        )

    @property
    def advised(self) -> Record | None:
        """The session that a recalibration pays with: the last one, as frames and arm stand today.

        None where none pays, or where a later one that shows as many joints is as the model says.
        """
        paying = [one for one in self.sessions if one.session.recalibrate]
        if not paying:
            return None
        known = sum(paying[-1].session.observable)
        later = [one for one in self.records if one.date > paying[-1].date]
        outdated = any(not one.session.recalibrate and sum(one.session.observable) >= known for one in later)
        return None if outdated else paying[-1]

    @property
    def sentences(self) -> tuple[str, ...]:
        """What the sessions say together: alarms, clear trends, the forecast, and what to do."""
        alarms = (
            f"{'the RMS error' if chart.one_sided else chart.what} has been outside the limits "
            f"({' and '.join(chart.kinds)}) since {self.records[chart.alarm].date}."
            for chart in self.charts
            if chart.alarm is not None
        )
        changes: tuple[Jump | Trend, ...] = (
            *self.jumps,
            *(one for one in self.trends if one.clear),
        )
        moves = (f"{one.sentence}." for one in changes)
        forecast = () if self.forecast is None else (self.forecast.sentence,)
        advice: tuple[str, ...] = ()
        if (best := self.advised) is not None:
            command = RecalibrationSettings(cameras=self.cameras).command(self.model.name, best.file)
            advice = (
                f"Recalibrating pays: errors like those of {best.file} are expected to fall from "
                f"{best.session.rms * 1e3:.3f} to {best.session.rms_after * 1e3:.3f} mm; run "
                f"`{command}`.",
            )
        lines = (*(one.sentence for one in self.untrusted), *alarms, *moves, *forecast, *advice)
        return tuple(f"{line[:1].upper()}{line[1:]}" for line in lines)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain values, in mm and deg."""
        return {
            "seconds": round(self.seconds, 3),
            "model": self.model.name,
            "action": self.action,
            "sessions": [one.to_json() for one in self.sessions],
            "untrusted": [one.to_json() for one in self.untrusted],
            "history": [one.to_json() for one in self.records],
            "charts": [one.to_json([record.date for record in self.records]) for one in self.charts],
            "false_alarms_per_year": FALSE_ALARMS_PER_YEAR,
            "sessions_per_year": SESSIONS_PER_YEAR,
            "trends": [one.to_json() for one in self.trends],
            "jumps": [one.to_json() for one in self.jumps],
            "forecast": None if self.forecast is None else vars(self.forecast),
            "says": list(self.sentences),
            "warnings": list(self.warnings),
        }

    def save_page(self, page: str | os.PathLike[str]) -> None:
        """Write the sessions and charts as one HTML page.

        Raises:
            OutputError: the page is no .html file or cannot be written.
        """
        from pisigma.reporting.page.lifetime import monitoring_page  # matplotlib takes a second

        check_page(Path(page))
        lines = (self.sentences, self.warnings)
        write_whole(Path(page), monitoring_page(self.model, self.records, self.charts, *lines))


def monitor(
    model: ModelSource | HoldsModel,
    sessions: Sequence[Measurements | str | os.PathLike[str]],
    settings: MonitorSettings = MonitorSettings(),
    progress: Progress = lambda what: None,
) -> Monitoring:
    """Say of every session whether the robot is unchanged or what moved, and chart all sessions.

    Args:
        model: of `pisigma calibrate` or `pisigma recalibrate`, or what holds it, or its folder, which has a history.
        sessions: rows of any sensors, or their files; one with several days in the column `date` is several sessions.
        settings: see `MonitorSettings`.
        progress: called with what is being done.

    Raises:
        ModelError: the folder holds no model, or the model holds no posterior, or is the prior of a fleet.
        MeasurementError: the rows cannot be read, or there are more or fewer dates than sessions.
        IdentificationError: the rows do not determine where something stands.
        PoseError: the joint values do not fit the robot.
        OutputError: the history cannot be used.
    """
    started = time.perf_counter()
    source = model_or_folder(model)
    loaded = source if isinstance(source, CalibratedModel) else load_model(source)
    if loaded.kind == FLEET_PRIOR:
        raise ModelError(
            f"model '{loaded.name}' is what the robots of a fleet have in common, and a model of one robot was wanted; "
            "make it with `pisigma calibrate ROBOT ROWS --prior MODEL --out DIR`."
        )
    posterior = ModelPosterior.of(loaded)
    rows = [read_rows(one, posterior.space.robot, settings.cameras) for one in sessions]
    warnings: list[str] = []
    judged: list[Record] = []
    untrusted: list[UntrustedSession] = []
    folder = source if settings.history and not isinstance(source, CalibratedModel) else None
    earlier = () if folder is None else recall(history_path(folder), model_hash(folder))
    for date, day in _by_day(rows, settings.dates):
        progress(f"{Path(day.source).name}, {date}")
        warnings += row_warnings(loaded.robot, day)
        right = right_rows(RecalibrationSettings(settings.moved), loaded, posterior.renamed(day))
        warnings += right.warnings
        day, again = new_rows(loaded, right.rows, date, earlier, judged)
        warnings += again
        if not day.rows:
            continue
        record = _record(loaded, posterior, day, date, settings)
        if isinstance(record, UntrustedSession):
            untrusted.append(record)
            continue
        judged.append(record)
        warnings += [f"{judged[-1].file}: {one}" for one in condition_warnings(loaded, day)]
        warnings += [
            f"{place} was left out: it does not go with the other rows of its session; measure it again."
            for place in judged[-1].session.outliers
        ]
        if day.rows < FEWEST_ROWS:
            warnings.append(
                f"{judged[-1].file}: {day.rows} rows say little of what moved; measure {FEWEST_ROWS} poses or more."
            )
    if not (judged or untrusted):
        raise MeasurementError(f"expected new rows, got none: {' '.join(warnings)}")
    records = new = in_order(judged)
    if folder is not None:
        records = remember(history_path(folder), model_hash(folder), new)
        warnings += [
            f"{one.file}: its session in the history was left out: expected {WANTED}, got {one.date}; monitor its rows "
            "again with --dates, and its date is corrected."
            for one in records
            if not is_date(one.date)
        ]
        records = tuple(one for one in records if is_date(one.date))
    return Monitoring(
        model=loaded,
        sessions=new,
        records=records,
        charts=charts_of(loaded.robot.revolute, records) if records else (),
        trends=trends_of(loaded.robot.revolute, records) if records else (),
        jumps=jumps_of(loaded.robot.revolute, records) if records else (),
        forecast=forecast_of(records, settings.limit_mm) if settings.limit_mm and records else None,
        warnings=tuple(dict.fromkeys(warnings)),
        cameras=settings.cameras,
        untrusted=tuple(untrusted),
        seconds=time.perf_counter() - started,
    )


def _by_day(sessions: Sequence[Measurements], dates: Sequence[str]) -> list[tuple[str, Measurements]]:
    """Every session with its day; rows of several days are several sessions."""
    if dates and len(dates) != len(sessions):
        raise MeasurementError(
            f"dates: {len(sessions)} were wanted, one for every file, but there are {len(dates)}."
        )
    days: list[tuple[str, Measurements]] = []
    for number, rows in enumerate(sessions):
        if dates or rows.date is None:
            days.append((dates[number] if dates else _date_of_file(rows.source), rows))
            continue
        for date in sorted(set(rows.date)):
            chosen = torch.tensor([one == date for one in rows.date])
            days.append((date or _date_of_file(rows.source), rows.select(chosen)))
    return days


def _date_of_file(source: str) -> str:
    """The day in the name of a file, or that of its last change; today for rows that come from no file."""
    path = Path(source)
    if date := date_in_name(path.name):
        return date
    moment = path.stat().st_mtime if path.is_file() else time.time()
    date = datetime.date.fromtimestamp(moment).isoformat()
    if not is_date(date):
        raise MeasurementError(f"{source}: expected {WANTED} as the file's change, got {date}; give --dates.")
    return date


def _record(
    model: CalibratedModel,
    posterior: ModelPosterior,
    rows: Measurements,
    date: str,
    settings: MonitorSettings,
) -> Record | UntrustedSession:
    """Judge a session."""
    stated = RecalibrationSettings(settings.moved)
    file = Path(rows.source).name
    if implausible := check_rows(rows, model, stated.fitted, may_move(stated)).implausible:
        return UntrustedSession(file, date, implausible)
    elsewhere = None if settings.moved is None else owners_in(rows, settings.moved)
    session, zeros = judge_session(model, posterior, rows, elsewhere)
    if implausible := session_diagnostics(model, rows, session):
        return UntrustedSession(file, date, implausible)
    temperature = None if rows.temperature is None else float(rows.temperature.nanmean())
    values = RowValues.of(rows.as_fields(), model.robot)
    return Record(file, date, rows_hash(rows), temperature, session, zeros, values)
