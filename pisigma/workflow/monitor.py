"""Monitor a robot: compare sessions of few rows with its model, individually and over months."""

import datetime
import os
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from pisigma.files.errors import MeasurementError, ModelError, Place
from pisigma.files.model_files import model_hash
from pisigma.files.output_file import check_page, write_atomically
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.history import HISTORY, History
from pisigma.lifetime.cell.layout import cell_of_model, history_of_model
from pisigma.lifetime.monitoring.charts import FALSE_ALARMS_PER_YEAR, SESSIONS_PER_YEAR, Chart
from pisigma.lifetime.monitoring.history import (
    Record,
    new_rows,
    read_sessions,
    rows_hash,
    sorted_sessions,
    store_sessions,
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
from pisigma.lifetime.recalibration.recalibration_problem import frame_keys
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.copies import RowValues
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.dates import EXPECTED_DATE, date_in_name, is_date
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import HasModel, ModelSource, loaded_model
from pisigma.model.model_posterior import FLEET_PRIOR, ModelPosterior
from pisigma.model.stated_conditions import condition_warnings
from pisigma.validation.gate import check_rows_by_model
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.workflow.recalibrate import allowed_moves, filtered_rows
from pisigma.workflow.settings.monitoring import MonitorSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

_MIN_ROWS = 5
"""Number of rows of a session below which a warning is given."""


@dataclass(frozen=True)
class UntrustedSession:
    """A session that must not be trusted and is therefore left out of charts and history.

    Attributes:
        file: file of the rows.
        date: date of the measurement (ISO 8601).
        diagnostics: reasons why the session must not be trusted.
    """

    file: str
    date: str
    diagnostics: tuple[Diagnostic, ...]

    @property
    def sentence(self) -> str:
        """Sentence with the file and date of the session, and the reason why it is left out."""
        return f"{self.file} of {self.date} is left out: {' '.join(one.sentence for one in self.diagnostics)}"

    def to_json(self) -> dict[str, Any]:
        """Return the session as plain values."""
        return {
            "file": self.file,
            "date": self.date,
            "diagnostics": [one.model_dump(by_alias=True) for one in self.diagnostics],
        }


@dataclass(frozen=True, eq=False)
class MonitoringResult:
    """Result of `monitor`: sessions of a robot, and its changes over the months.

    Attributes:
        model: the model with which the sessions were compared.
        sessions_of_call: sessions of this call.
        all_sessions: all sessions of the model, including sessions of its history, in the order of their dates.
        charts: control charts of the joint zeros and of the error, over all sessions.
        trends: trends of the joint zeros.
        jumps: jumps of the joint zeros between two sessions.
        forecast: forecast of the error; None if there is no limit.
        warnings: sentences that warn of problems.
        cameras: cameras and boards of files of detected board corners.
        untrusted_sessions: sessions of this call that must not be trusted.
        cell: folder of the cell of the model; None if it is outside a cell.
        seconds: computing time [s].
    """

    model: CalibratedModel
    sessions_of_call: tuple[Record, ...]
    all_sessions: tuple[Record, ...]
    charts: tuple[Chart, ...]
    trends: tuple[Trend, ...]
    jumps: tuple[Jump, ...]
    forecast: Forecast | None
    warnings: tuple[str, ...]
    cameras: CameraFiles | None = None
    untrusted_sessions: tuple[UntrustedSession, ...] = ()
    cell: Path | None = None
    seconds: float = field(default=0.0)

    @property
    def needs_action(self) -> bool:
        """Whether action is needed: rows are implausible, a recalibration is recommended, or a limit is exceeded."""
        alarmed = any(chart.alarm is not None for chart in self.charts)
        exceeded = self.forecast is not None and self.forecast.limit_exceeded
        return (
            bool(self.untrusted_sessions)
            or alarmed
            or exceeded
            or any(one.session.recalibrate for one in self.sessions_of_call)
        )

    @property
    def advised_session(self) -> Record | None:
        """The last session with which a recalibration is recommended.

        None if there is no such session, or if a later session that observes as many joints agrees with the model.
        """
        paying = [one for one in self.sessions_of_call if one.session.recalibrate]
        if not paying:
            return None
        known = sum(paying[-1].session.zero_is_observable)
        later = [one for one in self.all_sessions if one.date > paying[-1].date]
        outdated = any(
            not one.session.recalibrate and sum(one.session.zero_is_observable) >= known for one in later
        )
        return None if outdated else paying[-1]

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return results of all sessions as sentences: alarms, clear trends, the forecast, and the next step."""
        alarms = (
            f"{'the RMS error' if chart.one_sided else chart.quantity} has been outside the limits "
            f"({' and '.join(chart.kinds)}) since {self.all_sessions[chart.alarm].date}."
            for chart in self.charts
            if chart.alarm is not None
        )
        changes: tuple[Jump | Trend, ...] = (
            *self.jumps,
            *(one for one in self.trends if one.is_significant),
        )
        moves = (f"{one.sentence}." for one in changes)
        forecast = () if self.forecast is None else (self.forecast.sentence,)
        advice: tuple[str, ...] = ()
        if (best := self.advised_session) is not None:
            command = RecalibrationSettings(cameras=self.cameras).command(self.model.name, best.file)
            if self.cell is not None:  # the cell would not use a model folder that is not in its history
                command = shlex.join(["pisigma", "recalibrate", os.fspath(self.cell)])
            advice = (
                f"Recalibration is worthwhile: errors like those of {best.file} are expected to fall "
                f"from {best.session.rms * 1e3:.3f} to "
                f"{best.session.rms_after_recalibration * 1e3:.3f} mm; run `{command}`.",
            )
        lines = (*(one.sentence for one in self.untrusted_sessions), *alarms, *moves, *forecast, *advice)
        return tuple(f"{line[:1].upper()}{line[1:]}" for line in lines)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain values, in mm and deg."""
        return {
            "seconds": round(self.seconds, 3),
            "model": self.model.name,
            "action": self.needs_action,
            "sessions": [one.to_json() for one in self.sessions_of_call],
            "untrusted": [one.to_json() for one in self.untrusted_sessions],
            "history": [one.to_json() for one in self.all_sessions],
            "charts": [one.to_json([record.date for record in self.all_sessions]) for one in self.charts],
            "false_alarms_per_year": FALSE_ALARMS_PER_YEAR,
            "sessions_per_year": SESSIONS_PER_YEAR,
            "trends": [one.to_json() for one in self.trends],
            "jumps": [one.to_json() for one in self.jumps],
            "forecast": None if self.forecast is None else vars(self.forecast),
            "summary": list(self.sentences),
            "warnings": list(self.warnings),
        }

    def save_page(self, page: str | os.PathLike[str]) -> None:
        """Write the sessions and charts as one HTML file.

        Raises:
            OutputError: the page is not an .html file, or cannot be written.
        """
        from pisigma.reporting.page.lifetime import monitoring_page  # importing matplotlib takes a second

        check_page(Path(page))
        content = monitoring_page(
            self.model,
            self.all_sessions,
            self.charts,
            self.sentences,
            self.warnings,
            [
                (one.date, one.file, " ".join(said.sentence for said in one.diagnostics))
                for one in self.untrusted_sessions
            ],
            self._marks(),
            None if self.forecast is None else self.forecast.limit_mm,
        )
        write_atomically(Path(page), content)

    def _marks(self) -> dict[str, list[tuple[datetime.date, str]]]:
        """Return the days of events of the cell, for all charts, and of jumps, for the charts of their joints."""
        events = () if self.cell is None else History(self.cell / HISTORY).events()
        marks: dict[str, list[tuple[datetime.date, str]]] = {}
        marks[""] = [(datetime.date.fromisoformat(one.day), one.kind) for one in events]
        for one in self.jumps:
            marks.setdefault(one.quantity, []).append((datetime.date.fromisoformat(one.after), "jump"))
        return marks


def monitor(
    model: ModelSource | HasModel,
    sessions: Sequence[Measurements | str | os.PathLike[str]],
    settings: MonitorSettings = MonitorSettings(),
    progress: Progress = lambda what: None,
) -> MonitoringResult:
    """Determine for every session whether the robot has changed and what moved, and chart all sessions.

    Args:
        model: model of `pisigma calibrate` or `pisigma recalibrate`, an object that contains one, or a model folder.
            Only a folder has a history.
        sessions: rows of any sensors, or their files. Rows of several days (column `date`) are several sessions.
        settings: see `MonitorSettings`.
        progress: called with the current step.

    Raises:
        ModelError: the folder is not that of a model, the model has no posterior, or it is the prior of a fleet.
        MeasurementError: the rows cannot be read, or there are more or fewer dates than sessions.
        IdentificationError: the rows do not determine a base or a tool.
        PoseError: the joint values do not fit the robot.
        OutputError: the history cannot be used.
    """
    started = time.perf_counter()
    loaded, folder = loaded_model(model)
    if loaded.kind == FLEET_PRIOR:
        raise ModelError(
            f"expected the model of one robot, got the prior of a fleet, '{loaded.name}'",
            value=loaded.name,
            remedy="make a model with `pisigma calibrate ROBOT ROWS --prior MODEL --out DIR`",
        )
    posterior = ModelPosterior.from_model(loaded)
    rows = [read_rows(one, posterior.space.robot, settings.cameras) for one in sessions]
    warnings: list[str] = []
    trusted: list[Record] = []
    untrusted: list[UntrustedSession] = []
    history = history_of_model(folder) if folder is not None and settings.history else None
    earlier = () if folder is None or history is None else read_sessions(history, model_hash(folder))
    for date, day in _by_day(rows, settings.dates):
        progress(f"{Path(day.source).name}, {date}")
        warnings += row_warnings(loaded.robot, day)
        right = filtered_rows(RecalibrationSettings(settings.moved), loaded, posterior.with_model_names(day))
        warnings += right.warnings
        day, again = new_rows(loaded, right.rows, date, earlier, trusted)
        warnings += again
        if not day.rows:
            continue
        record = _record(loaded, posterior, day, date, settings)
        if isinstance(record, UntrustedSession):
            untrusted.append(record)
            continue
        trusted.append(record)
        warnings += [f"{trusted[-1].file}: {one}" for one in condition_warnings(loaded, day)]
        warnings += [
            f"{place} was left out: it contradicts the other rows of its session; measure it again."
            for place in trusted[-1].session.outliers
        ]
        if day.rows < _MIN_ROWS:
            warnings.append(
                f"{trusted[-1].file}: {day.rows} rows reveal little about what moved; measure {_MIN_ROWS} poses or "
                "more."
            )
    if not (trusted or untrusted):
        raise MeasurementError(f"expected new rows, got none: {' '.join(warnings)}", expected="new rows")
    records = new = sorted_sessions(trusted)
    if folder is not None and history is not None:
        records = store_sessions(history, model_hash(folder), new)
        warnings += [
            f"{one.file}: its session in the history was left out: expected {EXPECTED_DATE}, got {one.date}; monitor "
            "its rows again with --dates to correct the date."
            for one in records
            if not is_date(one.date)
        ]
        records = tuple(one for one in records if is_date(one.date))
    return MonitoringResult(
        model=loaded,
        sessions_of_call=new,
        all_sessions=records,
        charts=charts_of(loaded.robot.joints, records) if records else (),
        trends=trends_of(loaded.robot.joints, records) if records else (),
        jumps=jumps_of(loaded.robot.joints, records) if records else (),
        forecast=forecast_of(records, settings.limit_mm) if settings.limit_mm and records else None,
        warnings=tuple(dict.fromkeys(warnings)),
        cameras=settings.cameras,
        untrusted_sessions=tuple(untrusted),
        cell=None if folder is None else cell_of_model(folder),
        seconds=time.perf_counter() - started,
    )


def _by_day(sessions: Sequence[Measurements], dates: Sequence[str]) -> list[tuple[str, Measurements]]:
    """Split sessions by day, in the order of the sessions and then of the days."""
    if dates and len(dates) != len(sessions):
        raise MeasurementError(
            f"expected {len(sessions)} dates, one for every file, got {len(dates)}",
            value=len(dates),
            option="dates",
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
    """Return the day in the name of a file, or else of its last modification; today for rows without a file."""
    path = Path(source)
    if date := date_in_name(path.name):
        return date
    moment = path.stat().st_mtime if path.is_file() else time.time()
    date = datetime.date.fromtimestamp(moment).isoformat()
    if not is_date(date):
        raise MeasurementError(
            expected=f"{EXPECTED_DATE} as the file's modification time",
            value=date,
            at=Place(source),
            remedy="state the date with --dates",
        )
    return date


def _record(
    model: CalibratedModel,
    posterior: ModelPosterior,
    rows: Measurements,
    date: str,
    settings: MonitorSettings,
) -> Record | UntrustedSession:
    """Compare a session with the model."""
    stated = RecalibrationSettings(settings.moved)
    file = Path(rows.source).name
    if implausible := check_rows_by_model(
        rows, model, stated.fitted_kinds, allowed_moves(stated)
    ).implausible_findings:
        return UntrustedSession(file, date, implausible)
    elsewhere = None if settings.moved is None else frame_keys(rows, settings.moved)
    session, zeros = judge_session(model, posterior, rows, elsewhere)
    if implausible := session_diagnostics(model, rows, session):
        return UntrustedSession(file, date, implausible)
    temperature = None if rows.temperature is None else float(rows.temperature.nanmean())
    values = RowValues.from_rows(rows.as_fields(), model.robot)
    return Record(file, date, rows_hash(rows), temperature, session, zeros, values)
