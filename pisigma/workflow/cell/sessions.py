"""Sessions of a cell, which are checked, stored as measured, and read with the names of a model."""

import datetime
import hashlib
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.files.errors import AcceptanceError, MeasurementError, PisigmaError, Place, check_choice
from pisigma.files.model_files import is_unchanged
from pisigma.lifetime.cell.controller import ControllerHistory
from pisigma.lifetime.cell.events import Event
from pisigma.lifetime.cell.facts import CellFacts, facts_of, foreign_files, sha256_of, unrecorded_files
from pisigma.lifetime.cell.history import Check, History, ModelEntry, SessionEntry, now
from pisigma.lifetime.cell.layout import MODELS, SESSIONS
from pisigma.lifetime.cell.status import FOREIGN
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.copies import RowValues, copies_of_known
from pisigma.measurement.csv.reading import is_measurement_file
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.dates import EXPECTED_DATE, date_in_name, is_date
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.model.folder.model_folder import load_model
from pisigma.model.training_rows import training_row_mask
from pisigma.robot.description import Robot
from pisigma.validation.gate import RowVerdict, check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.workflow.cell.new_files import write_under_new_name
from pisigma.workflow.cell.setup_names import RowsWithModelNames, newest_day, with_setup_names
from pisigma.workflow.recalibrate import allowed_moves
from pisigma.workflow.settings.recalibration import RecalibrationSettings


class Sessions:
    """The sessions of a cell.

    Attributes:
        folder: folder of the sessions.
        robot: the nominal robot.
        cameras: cameras and boards that measure the robot; None if there are none.
        history: history of the cell.
        one_by_one: whether files in the folder are added only by `add_next_file`, not by every step.
    """

    def __init__(self, cell: Path, robot: Robot, cameras: CameraFiles | None, history: History) -> None:
        self.folder, self.robot, self.cameras, self.history = cell / SESSIONS, robot, cameras, history
        self.one_by_one = False

    def checked_path(self, session: SessionEntry) -> Path:
        """Return the file of a session.

        Raises:
            MeasurementError: the file was changed or removed after it was added.
        """
        path = self.folder / f"{session.name}.csv"
        if sha256_of(path) != session.sha256:
            raise MeasurementError(
                f"the file of session '{session.name}' was changed or removed after it was added",
                at=Place(path),
                remedy=f"restore the measured file, or set the session aside (pisigma session {self.folder.parent} "
                f"{session.name} --set-aside REASON)",
            )
        return path

    def add_session(
        self,
        file: str | os.PathLike[str] | Measurements,
        accept_implausible: bool = False,
        day: str = "",
        remark: str = "",
    ) -> SessionEntry:
        """Check the rows of a session and store them; they are never changed afterwards.

        Rows to which the model in use was fitted outside the cell become a session of this model.

        Args:
            file: measurements (CSV), or rows in memory.
            accept_implausible: whether to add the rows even if the check finds that they must not be trusted.
            day: day on which the rows were measured (ISO 8601). If empty, it is taken from the column `date`, or else
                from the name of the file, or else it is today.
            remark: description of the import of the rows, which the entry records before the findings.

        Returns:
            The entry of the session.

        Raises:
            MeasurementError: the rows cannot be read, or the cell already contains some of them.
            AcceptanceError: the rows must not be trusted.
        """
        rows = self._read(file)
        entry, fitted = self._judged(rows, _checked_day(rows, day), accept_implausible, remark)
        inside: Path | None = None
        if isinstance(file, Measurements):
            with tempfile.TemporaryDirectory() as scratch:
                file.write_csv(Path(scratch) / "rows.csv", self.robot)
                content = (Path(scratch) / "rows.csv").read_bytes()
        else:
            content = Path(file).read_bytes()
            inside = Path(file) if Path(file).parent.resolve() == self.folder.resolve() else None
        taken = {one.name for one in self.history.sessions()}
        path = inside or write_under_new_name(self.folder, entry.day, content, taken)
        entry = replace(entry, name=path.stem, sha256=hashlib.sha256(content).hexdigest())
        models = [] if fitted is None else [with_session(fitted, entry)]
        if not self.history.add_session(entry, *models):  # another process was faster
            if inside is None:
                path.unlink()
            _check_new(rows, torch.ones(rows.rows, dtype=torch.bool))
        return entry

    def add_next_file(self) -> bool:
        """Add the oldest file in the folder that has not been added yet; return whether there was such a file.

        Raises:
            PisigmaError: the rows cannot be used; the history records the reason.
        """
        if not (waiting := unrecorded_files(self.folder, self.history.sessions())):
            return False
        try:
            self.add_session(self.folder / waiting[0])
        except PisigmaError as refusal:
            verdict = "refused" if is_measurement_file(self.folder / waiting[0]) else FOREIGN
            refused = Check("import", "", Path(waiting[0]).stem, verdict, str(refusal), None, False, now())
            known = {(one.command, one.session, one.summary) for one in self.history.checks()}
            if (refused.command, refused.session, refused.summary) not in known:
                self.history.add(refused)
            raise
        return True

    def check(self, file: str | os.PathLike[str] | Measurements, day: str = "") -> RowVerdict:
        """Read and check rows without storing them; see `add_session` for exceptions."""
        rows = self._read(file)
        return self._verdict(rows, _checked_day(rows, day))[0]

    def _read(self, file: str | os.PathLike[str] | Measurements) -> Measurements:
        """Read rows; if values exceed the joint limits, name the setup fault that explains this.

        Raises:
            MeasurementError: the rows cannot be read.
            AcceptanceError: a setup fault explains why values exceed the limits.
        """
        try:
            return read_rows(file, self.robot, self.cameras)
        except MeasurementError as refusal:
            try:
                rows = read_rows(file, self.robot.without_limits, self.cameras)
            except MeasurementError:
                raise refusal from None
            if faults := check_rows(rows, self.robot).implausible_findings:
                raise _untrusted(rows, faults) from refusal
            raise

    def _verdict(
        self, rows: Measurements, day: str
    ) -> tuple[RowVerdict, tuple[str, ...], ModelEntry | None, bool]:
        """Check rows; return findings, warnings, the model for comparison, and whether it was fitted to the rows."""
        known = [one for one in self.history.sessions() if not one.set_aside]
        again = torch.zeros(rows.rows, dtype=torch.bool)
        for one in known:
            values = RowValues.from_rows(self.rows_of([one]).as_fields(), self.robot)
            again |= copies_of_known(rows.as_fields(), self.robot, values)
        _check_new(rows, again)
        model, fitted, controller = self.history.in_use, False, ControllerHistory.from_history(self.history)
        at = controller.active_exports(day, now())
        found = controller.findings("import", model, self.history.sessions(), at).checked_warnings(
            self.folder.parent
        )
        if model is None or found or not is_unchanged(self._folder_of(model), model.sha256):
            # a model with other joint zeros does not describe the arm
            model, verdict = None, check_rows(rows, self.robot)
        else:
            seen = self.rows_with_model_names(model, rows, day)
            stated = RecalibrationSettings(seen.changed_frames or None)
            loaded = load_model(self._folder_of(model))
            verdict = check_rows(seen.rows, loaded, stated.fitted_kinds, allowed_moves(stated))
            training = training_row_mask(loaded, seen.rows)
            fitted = bool(training.all())
            if not fitted:
                _check_new(rows, training)
        return verdict, found, model, fitted

    def _judged(
        self, rows: Measurements, day: str, accept_implausible: bool, remark: str
    ) -> tuple[SessionEntry, ModelEntry | None]:
        """Check rows; return the entry of their session without name and hash, and the model fitted to them."""
        verdict, found, model, fitted = self._verdict(rows, day)
        if verdict.implausible_findings and not accept_implausible:
            raise _untrusted(rows, verdict.implausible_findings)
        temperature = None if rows.temperature is None else float(rows.temperature.nanmean())
        entry = SessionEntry(
            name="",
            sha256="",
            taken_in=now(),
            day=day,
            rows=rows.rows,
            sensor=",".join(sorted(rows.kinds)),
            temperature_c=temperature,
            judged_by="robot" if model is None else model.name,
            remark=" ".join(filter(None, (remark, *found, *(one.sentence for one in verdict.diagnostics)))),
            poses=int(groups_of_equal_joints(rows.q).max()) + 1,
        )
        return entry, model if fitted else None

    def _folder_of(self, model: ModelEntry) -> Path:
        return self.folder.parent / MODELS / model.name

    def set_aside(self, session: str, reason: str) -> None:
        """Exclude a session, or a file that has not been added, from all further steps, without deleting it.

        Raises:
            MeasurementError: there is no session or file with this name, or the reason is empty.
        """
        sessions = {one.name: one for one in self.history.sessions()}
        known = tuple(sessions.values())
        for file in (*unrecorded_files(self.folder, known), *foreign_files(self.folder, known)):
            name, day = file.removesuffix(".csv"), date_in_name(file) or datetime.date.today().isoformat()
            sessions[name] = SessionEntry(
                name, sha256_of(self.folder / file), now(), day, 0, "", judged_by=""
            )
        check_choice(MeasurementError, "session", session, tuple(sessions), Place(self.folder))
        if not reason.strip():
            raise MeasurementError(expected="a reason", value=reason, option="--set-aside")
        self.history.add(replace(sessions[session], set_aside=reason.strip()))

    def set_imported_aside(self, files: Sequence[Path], session: SessionEntry) -> None:
        """Set aside files in the folder whose rows were imported as a session, so that they are not read again."""
        for file in files:
            if file.parent.resolve() == self.folder.resolve():
                self.set_aside(file.name.removesuffix(".csv"), f"imported as session '{session.name}'")

    def valid_sessions(self) -> list[SessionEntry]:
        """Return the sessions that describe the current arm, in order of day, after adding new files in the folder.

        Raises:
            MeasurementError: there is no such session.
        """
        return list(self._facts().valid_sessions)

    def _facts(self) -> CellFacts:
        """Return the facts about the cell, which has valid sessions, after adding new files in the folder."""
        while not self.one_by_one and self.add_next_file():
            pass
        facts = facts_of(self.folder.parent)
        if not facts.valid_sessions:
            raise MeasurementError(
                "the cell has no session measured since the arm or its joint zeros were last changed",
                at=Place(self.folder),
                remedy="measure rows and import them",
            )
        return facts

    def sessions_new_to(self, model: ModelEntry) -> list[SessionEntry]:
        """Return the valid sessions to which a model was not fitted, measured on its newest day or later.

        Raises:
            MeasurementError: there is no such session.
        """
        if not (found := self._facts().new_sessions(model)):
            raise MeasurementError(
                f"every valid session is older than model '{model.name}' or was used to fit it",
                at=Place(self.folder),
                remedy="measure new rows and import them",
            )
        return found

    def choose_session(self, model: ModelEntry, name: str | None) -> SessionEntry:
        """Return a session that is new to a model (see `new_to`), by name; None for the newest.

        Raises:
            MeasurementError: there is no session with this name.
        """
        sessions = {one.name: one for one in self.sessions_new_to(model)}
        name = [*sessions][-1] if name is None else name
        check_choice(MeasurementError, "session", name, tuple(sessions), Place(self.folder))
        return sessions[name]

    def rows_of(
        self, sessions: Sequence[SessionEntry], events: Sequence[Event] | None = None
    ) -> Measurements:
        """Return the rows of sessions; rows after an instrument or tool event have a new frame or target.

        Args:
            sessions: the sessions.
            events: events to use; None for all that have been recorded.

        Raises:
            MeasurementError: a file was changed or removed after it was added.
        """
        events, parts = self.history.events() if events is None else events, []
        for one in sessions:
            days = newest_day(events, "instrument", one.day), newest_day(events, "tool", one.day)
            parts.append(with_setup_names(self.rows_of_file(one), *days))
        if any(one.split is not None for one in parts):
            # all rows of a session without a column "set" are for calibration
            parts = [one if one.split else replace(one, split=("train",) * one.rows) for one in parts]
        return parts[0] if len(parts) == 1 else read_rows(join(parts), self.robot)

    def rows_of_file(self, session: SessionEntry) -> Measurements:
        """Return the rows of a session with the frame and target names of their file.

        Raises:
            MeasurementError: the file was changed or removed after it was added.
        """
        path = self.checked_path(session)
        rows = read_rows(path, self.robot, self.cameras)
        last = max(rows.date or (session.day,))
        changes: list[tuple[str, str]] = [(one.day, one.kind) for one in self.history.events()]
        changes += [
            (one.day, "controller") for one in ControllerHistory.from_history(self.history).joint_zero_changes
        ]
        if spanned := [kind for day, kind in changes if session.day < day <= last]:
            raise MeasurementError(
                f"rows of session '{session.name}' were measured before and after an event '{spanned[0]}'",
                value=spanned[0],
                at=Place(path),
                remedy="set the session aside, and import its rows as one session before and one after the event",
            )
        return rows

    def rows_with_model_names(self, model: ModelEntry, rows: Measurements, day: str) -> RowsWithModelNames:
        """Return rows with a model's names of frame and target, and the parts that have been moved since it was made.

        Args:
            model: the model.
            rows: rows with the frame and target names of their file.
            day: day on which the rows were measured (ISO 8601).
        """
        events = self.history.events()
        changed = {"base": "instrument", "tool": "tool"}
        moved = tuple(
            what
            for what, kind in changed.items()
            if newest_day(events, kind, day) != newest_day(events, kind, model.day)
        )
        return RowsWithModelNames(with_setup_names(rows, model.frame_day, model.target_day), moved)


def with_session(model: ModelEntry, session: SessionEntry) -> ModelEntry:
    """Return the entry of a model with a session added to the sessions to which it was fitted."""
    day = max(model.day, session.day) if model.made_of else session.day
    return replace(model, sessions=",".join((*model.made_of, session.name)), day=day)


def _untrusted(rows: Measurements, findings: Sequence[Diagnostic]) -> AcceptanceError:
    """Return the error that refuses rows because of findings."""
    refusal = AcceptanceError(
        f"the rows must not be trusted: {findings[0].sentence.rstrip('.')}",
        at=Place(rows.source),
        remedy="correct the file, or import it with --accept-implausible",
    )
    refusal.findings = tuple(findings)
    return refusal


def _checked_day(rows: Measurements, day: str) -> str:
    """Return the day of rows: the stated day, or the result of `_day_of`.

    Raises:
        MeasurementError: the stated day is not a date, or contradicts the rows.
    """
    if day and any(rows.date or ()) and day != _day_of(rows):
        raise MeasurementError(
            expected=f"the first day of the rows, {_day_of(rows)}",
            value=day,
            option="--date",
            remedy="omit --date",
        )
    if not is_date(day := day or _day_of(rows)):
        raise MeasurementError(expected=EXPECTED_DATE, value=day, option="--date")
    return day


def _check_new(rows: Measurements, known: Bool[Tensor, " rows"]) -> None:
    """Refuse rows that the cell already contains, so that no model is verified with rows to which it was fitted.

    Raises:
        MeasurementError: some rows are known, or there are no rows.
    """
    if known.numel() and not bool(known.any()):
        return
    count = "every row" if bool(known.all()) else f"{int(known.sum())} of {rows.rows} rows"
    raise MeasurementError(
        f"the cell already contains {count}",
        at=Place(rows.source),
        remedy="import new rows" if bool(known.all()) else "import a file with the other rows only",
    )


def _day_of(rows: Measurements) -> str:
    """Return the first day of rows: from the column `date`, or else from the name of the file, or else today."""
    if dates := [one for one in rows.date or () if one]:
        return min(dates)
    return date_in_name(Path(rows.source).name) or datetime.date.today().isoformat()
