"""Steps of a page: each calls the same function of the cell as the command of this name, and lays out the result."""

import contextlib
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import export_format
from pisigma.deployment.export.targets import POSE_COLUMNS
from pisigma.files.errors import (
    MeasurementError,
    OutputError,
    Place,
    PlanningError,
    PoseError,
    RobotError,
    check_choice,
)
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.layout import CELL_FILE, EXPORTS, REPORTS, newest_plan
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.growing_file import GrowingFile
from pisigma.model.inverse.solution import Solution
from pisigma.planning.session.growing_images import growing_file
from pisigma.planning.session.state import SessionState
from pisigma.reporting.calibration_text import calibration_text
from pisigma.reporting.result_text import ResultText, sentence_block, table_block
from pisigma.reporting.session_text import session_text
from pisigma.reporting.solution_text import FAILURES, solution_text, statuses_of
from pisigma.reporting.verdict import Verdict, count_text, uncapitalised
from pisigma.robot.robot_file import catalogue
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.workbench.forms import cell_file_text, changed_cell_text, changed_settings, digest_of
from pisigma.workbench.job import Outcome, StoppedError
from pisigma.workbench.tabs import CHARTS, download_of
from pisigma.workflow.calibrate import Calibration
from pisigma.workflow.cell.acceptance import acceptance_of
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.cell_file import CellFile
from pisigma.workflow.cell.exports import NONE, export_from_cell, record_active_export
from pisigma.workflow.cell.incoming_rows import IncomingRows
from pisigma.workflow.cell.new_files import output_path
from pisigma.workflow.follow import follow, remaining_poses_file
from pisigma.workflow.load import load, pose_from_mm_and_deg
from pisigma.workflow.measure import MeasuringSession
from pisigma.workflow.report import report
from pisigma.workflow.result_texts import (
    monitoring_text,
    plan_text,
    recalibration_text,
    report_doubt,
    report_text,
    verification_text,
)
from pisigma.workflow.settings.importing import ImportSettings

Form = Mapping[str, str]
_WIDTH = 200
"""Width of tables before models are divided among several [characters]."""
_EXPORT_OPTIONS = ("geometry", "targets", "branch", "config")
_NEEDS_ACTION = "the robot needs attention (see the reasons below)."
_NOT_STORED = "no model was stored, because the result must not be trusted (see the reasons below)."


def create(folder: Path, form: Form, files: list[Path]) -> Cell:
    """Create the cell of a robot of the catalogue, or of an uploaded file."""
    robot = form.get("robot") or "".join(map(str, files))
    if not robot:
        raise RobotError(expected="a robot of the catalogue, or a file", option="robot")
    if robot == form.get("robot"):
        check_choice(RobotError, "robot", robot, catalogue())  # a page must not choose paths
    limit = form_number(form, "limit_mm") if form.get("limit_mm") else None
    return Cell.create(
        folder, robot, form.get("sensor") or "tracker", limit, form.get("base"), form.get("tip")
    )


def write_cell(folder: Path, form: Form, undo_texts_by_digest: dict[str, str]) -> None:
    """Write `cell.yaml` if the new text is valid and the file has not changed since the person saw it.

    Args:
        folder: folder of the cell, whose file need not be valid.
        form: "seen", the digest of the file that the person saw, with its new "text" or the values of its form; or
            "undo", the digest of the file whose last change is undone.
        undo_texts_by_digest: the text before every change, by the digest of the text after it.

    Raises:
        PlanningError: the file has been changed in the meantime, or the new text is not valid.
    """
    before = cell_file_text(folder)
    digest, undo, entered = digest_of(before), form.get("undo"), form.get("text")
    if digest not in (form.get("seen"), undo) or (undo and undo not in undo_texts_by_digest):
        raise PlanningError(
            "the file has been changed since it was shown here",
            at=Place(folder / CELL_FILE),
            remedy="copy what you entered, discard your changes, and repeat them",
        )
    text = (
        undo_texts_by_digest[undo]
        if undo
        else changed_cell_text(CellFile.read(folder), form)
        if entered is None
        else entered
    )
    CellFile.write(folder, text)
    if undo:
        del undo_texts_by_digest[undo]
    elif text != before:
        undo_texts_by_digest[digest_of(text)] = before


def plan(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Plan poses, and store the plan in the cell."""
    planned, path = cell.plan(progress, **changed_settings("plan", form))
    return Outcome(plan_text(planned, [path]), accuracy_curve=planned.accuracy_curve)


def calibrate(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Calibrate with the rows of the cell, and store the model."""
    accept = form.get("accept_implausible") == "true"
    found, entry = cell.calibrate(progress, accept, **changed_settings("calibrate", form))
    folder = None if entry is None else cell.model_folder(entry.name)
    also = [] if entry is None else [sentence_block("the cell", [f"Model '{entry.name}': {entry.remark}."])]
    assert isinstance(found, Calibration)  # there is no prior
    text = calibration_text(found.summary, folder, found.seconds, also)
    return Outcome(
        _in_cell(text, cell),
        _NOT_STORED if entry is None else "",
        wrong_rows_by_sentence=wrong_rows_by_sentence(found.summary.diagnostics),
    )


def verify(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Verify a model with the newest session to which it was not fitted."""
    progress("comparing the models and looking for setup faults")
    found, entry = cell.verify(None, form.get("of_model") or None, **changed_settings("verify", form))
    in_use = cell.history.in_use
    used = [f"Model '{entry.name}' is in use."] if in_use is not None and in_use.name == entry.name else []
    text = replace(verification_text(found, _WIDTH), closing_sentences=tuple(used))
    refusal = "" if found.accepted else found.sentence
    return Outcome(
        _in_cell(text, cell), refusal, wrong_rows_by_sentence=wrong_rows_by_sentence(found.diagnostics)
    )


def wrong_rows_by_sentence(findings: Sequence[Diagnostic]) -> dict[str, str]:
    """Return the wrong rows by the sentences of the findings."""
    return {one.sentence: "; ".join(one.row_places) for one in findings if one.row_places}


def monitor(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Compare every new session with the model in use, and write the charts to the reports of the cell."""
    found = cell.monitor(progress, **changed_settings("monitor", form))
    found.save_page(out := output_path(cell.folder, REPORTS, CHARTS))
    text = monitoring_text(found, [f"Charts written to {out.name}."])
    return Outcome(_in_cell(text, cell), _NEEDS_ACTION if found.needs_action else "")


def recalibrate(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Recalibrate the model in use with the newest session."""
    accept = form.get("accept_implausible") == "true"
    found, entry = cell.recalibrate(None, progress, accept, **changed_settings("recalibrate", form))
    folder = None if entry is None else cell.model_folder(entry.name)
    return Outcome(
        _in_cell(recalibration_text(found, folder), cell), "" if entry is not None else _NOT_STORED
    )


def _in_cell(text: ResultText, cell: Cell) -> ResultText:
    """Return a result with the next step of the cell, as its commands state it, in place of its own one."""
    step = uncapitalised(cell.status().step.reason)
    return replace(text, verdict=replace(text.verdict, next_step=step))


def incoming_rows(files: list[Path], cell: Cell, form: Form) -> IncomingRows:
    """Return uploaded files with the settings for importing them into the cell.

    Args:
        files: uploaded files.
        cell: the cell, which states the settings of the import.
        form: changes by a person; "column 0 3", for example, is the meaning of the fourth column of the first file.
    """
    changed = changed_settings("import", form)
    if lines := form.get("new_frame_at", "").split():
        changed["new_frame_at"] = lines
    settings: ImportSettings = cell.file.settings_of_step("import", **changed)
    first = IncomingRows(tuple(files), cell, settings)
    if not any(key.startswith("column ") and value.strip() for key, value in form.items()):
        return first
    maps = [
        {
            mapping.key(one): stated
            for one in mapping.columns
            if (stated := form.get(f"column {number} {one.index}", "").strip())
        }
        for number, mapping in enumerate(first.proposal.mappings)
    ]
    return replace(first, settings=replace(settings, maps=tuple(filter(None, maps))))


def import_session(incoming: IncomingRows, form: Form) -> Outcome:
    """Add uploaded rows to the cell as a session."""
    said = () if incoming.imported_rows is None else incoming.imported_rows.sentences
    entry = incoming.add(form.get("accept_implausible") == "true", form.get("date", "").strip())
    remarks = tuple(filter(None, (*said, entry.remark)))
    trust = (
        f"with caution ({count_text(len(remarks), 'remark')})" if remarks else "yes: nothing contradicts them"
    )
    step = uncapitalised(incoming.cell.status().step.reason)
    verdict = Verdict(
        f"{count_text(entry.rows, 'row')} were added as session '{entry.name}'.", trust, step, "Rows"
    )
    return Outcome(ResultText(verdict, remarks))


def restore_session(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Add a session that was set aside to the cell again, as the import of its file would."""
    progress("reading the rows")
    known = {one.name: one for one in cell.history.sessions() if one.set_aside and one.rows}
    name = form.get("session", "")
    check_choice(MeasurementError, "session", name, tuple(known))
    incoming = incoming_rows([cell.sessions.folder / f"{name}.csv"], cell, {})
    return import_session(incoming, {**form, "date": known[name].day})


def check_rows(cell: Cell, form: Form, progress: Progress) -> tuple[Outcome, SessionState]:
    """Check the rows of a session against the newest plan, as `measure --once --set replan=false` does."""
    session = MeasuringSession.read(
        newest_plan(cell.folder), cell.file.settings_of_step("measure", replan=False)
    )
    sessions, name = {one.name: one for one in cell.sessions.valid_sessions()}, form.get("session", "")
    check_choice(MeasurementError, "session", name, tuple(sessions), Place(cell.folder))
    path = cell.sessions.checked_path(sessions[name])
    growing: GrowingFile = growing_file(path, session.plan.arm.robot, session.plan.settings)
    progress("checking the rows against each other")
    growth = growing.read(is_complete=True)
    session.add(growth.rows, growth.left_out)
    session.update(progress)
    return _session_outcome(session.state, f"Session {name}"), session.state


def follow_file(
    cell: Cell,
    path: Path,
    on_new_rows: Callable[[Measurements], None],
    show: Callable[[SessionState], None],
    progress: Progress,
) -> Outcome:
    """Follow a growing file with the newest plan as `measure` does, until the plan ends or a person stops."""
    plan = newest_plan(cell.folder)
    session = MeasuringSession.read(plan, cell.file.settings_of_step("measure"))
    growing = growing_file(path, session.plan.arm.robot, session.plan.settings)
    rest, waiting = remaining_poses_file(plan, path, None), f"waiting for rows in {path.name}"
    with contextlib.suppress(StoppedError):
        for step in follow(session, growing, before_read=lambda: progress(waiting), on_new_rows=on_new_rows):
            show(step.state)
            if step.replanned:
                session.write_remaining(rest, [])
    return _session_outcome(session.state, path.name)


def _session_outcome(state: SessionState, subject: str) -> Outcome:
    text = session_text(state)
    warnings = (*(one.sentence for one in state.alarms), *text.warnings)
    return Outcome(replace(text, warnings=warnings), subject=subject)


def export(cell: Cell, form: Form, files: Mapping[str, Path]) -> Outcome:
    """Export the model in use in a format to the exports of the cell.

    Args:
        cell: the cell.
        form: "format", "out" (name of the file, empty for today's date), and options of the format.
        files: uploaded files, by the options that take them.
    """
    name = form.get("format", "")
    kind = export_format(name)
    suffix = files["program"].suffix if "program" in files else "".join(kind.suffixes[:1])
    out = output_path(cell.folder, EXPORTS, suffix)
    if stated := form.get("out", "").strip():
        out = out.with_name(file_name(stated))
        if out.exists():
            raise OutputError(
                "an export with this name already exists", at=Place(out), remedy="choose another name"
            )
    options: dict[str, Any] = dict(files)
    options |= {key: form[key].strip() for key in _EXPORT_OPTIONS if form.get(key, "").strip()}
    exported = export_from_cell(cell, name, ExportRequest(cell.folder, out, **options))
    written = f"{exported.sentence_start or kind.title} written to {out.name}{exported.sentence_end}."
    verdict = Verdict(written, "", "test every program at low speed.", "File")
    left: Any = exported.facts.get("left_alone", [])
    alone, changed = (
        [(str(one["line"]), str(one["reason"])) for one in left],
        side_by_side(exported.leading_text),
    )
    blocks = (
        sentence_block("remarks", exported.remarks),
        table_block("What was changed", ("line", "before", "after"), changed),
        table_block("Poses that were left unchanged", ("line", "reason"), alone),
    )
    text = ResultText(
        verdict, exported.warnings, tuple(one for one in blocks if one.rows or one.name == "remarks")
    )
    return Outcome(text, exported.failure or exported.missed_limit or "")


def side_by_side(diff: str) -> list[tuple[str, str, str]]:
    """Return the changed lines of a unified diff without context: line, text before and text after."""
    rows: list[tuple[str, str, str]] = []
    for hunk in re.split(r"(?m)^(?=@@ )", diff)[1:]:
        head, *lines = hunk.splitlines()
        first = int(re.findall(r"-(\d+)", head)[0])
        old, new = ([one[1:] for one in lines if one.startswith(sign)] for sign in "-+")
        for number, (before, after) in enumerate(itertools.zip_longest(old, new, fillvalue="")):
            rows.append((str(first + number) if number < len(old) else "", before, after))
    return rows


def report_cell(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Write a report on the model in use to the reports of the cell."""
    out = output_path(cell.folder, REPORTS, ".html")
    found = report(cell.model_folder(), None, progress, cell.cameras, acceptance_of(cell))
    found.save(out)
    return Outcome(report_text(found, [f"Report written to {out.name}."]), report_doubt(found))


def try_pose(cell: Cell, form: Form) -> tuple[Outcome, Solution]:
    """Compute the corrected joint values that reach a pose."""
    solver = load(cell.folder)
    solution = solver(pose_from_mm_and_deg([form_number(form, name) for name in POSE_COLUMNS]))
    failed = [one for one in statuses_of(solution) if one in FAILURES]
    refusal = f"{failed[0].name.lower()}. {failed[0].sentence}" if failed else ""
    return Outcome(solution_text(solution, solver), refusal), solution


def record_event(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Record an event."""
    cell.history.record(
        form.get("kind", ""), form.get("date", ""), form.get("note", ""), form.get("person", "")
    )
    return Outcome()


def set_active_export(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Record which export is active on the controller."""
    name = form.get("export", "")
    file = str(download_of(cell, "export", (name,))) if name else NONE
    record_active_export(cell, file, form.get("date", ""), form.get("note", ""))
    return Outcome()


def use(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Put a model into use."""
    return Outcome(refusal=" ".join(cell.use(form.get("model") or None, form.get("reason", ""))))


def set_aside(cell: Cell, form: Form, progress: Progress) -> Outcome:
    """Set a session aside."""
    cell.sessions.set_aside(form.get("session", ""), form.get("set_aside", ""))
    return Outcome()


def file_name(name: str) -> str:
    """Return the file name that a person entered.

    Raises:
        OutputError: the entry is not a file name with a suffix.
    """
    stem, _, suffix = name.rpartition(".")
    is_plain = all(one.isalnum() or one in "._-" for one in name)
    if not (stem and suffix and is_plain) or name.startswith("."):
        raise OutputError(
            expected="a name with a suffix, of letters, digits, . _ and -", value=name, option="out"
        )
    return name


def form_number(form: Form, key: str) -> float:
    """Return a number from a form.

    Raises:
        PoseError: the entry is not a number.
    """
    try:
        return float(form.get(key, ""))
    except ValueError:
        raise PoseError(expected="a number", value=form.get(key, ""), option=key) from None
