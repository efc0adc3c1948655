"""Results of steps as text, for screens and pages."""

from collections.abc import Sequence
from pathlib import Path

from pisigma.reporting.acceptance_tables import acceptance_sentences, budget_table, contradiction_sentence
from pisigma.reporting.comparison_tables import comparison_blocks, model_rms_text
from pisigma.reporting.derived_cards import candidate_names, candidate_table
from pisigma.reporting.lifetime_tables import chart_table, session_table
from pisigma.reporting.result_text import ResultText, sentence_block, table_block
from pisigma.reporting.verdict import Verdict, count_text, rounded_text, uncapitalised
from pisigma.workflow.monitor import MonitoringResult
from pisigma.workflow.plan import Plan
from pisigma.workflow.recalibrate import Recalibration
from pisigma.workflow.report import Report
from pisigma.workflow.verify import Verification

MAX_POINTS = 8
"""Largest number of rows of the table of expected errors."""
_MAX_SESSIONS = 6
"""Largest number of sessions that are shown, the last ones."""

_NEXT_STEPS = {
    "better": "use the model, and verify again after a change of tool, base or arm.",
    "not_better": "check that the controller applies the correction once, then measure again or recalibrate.",
    "undecided": "measure more poses that differ, and verify again.",
    "moved": "recalibrate the model with these rows.",
    "setup_fault": "correct the problem named above and measure again.",
    "implausible": "correct the problem named above and measure again.",
}
"""Next step after each verdict of a verification."""


def plan_text(planned: Plan, files: Sequence[Path]) -> ResultText:
    """Return the expected accuracy with planned poses, and the remaining uncertainty, as text.

    Args:
        planned: the plan.
        files: written files, the plan first.
    """
    columns = ("poses", "RMS [mm]", "95 % [mm]", "RMS of random poses [mm]")
    rows = [
        (str(point.poses), *(rounded_text(error * 1e3) for error in (point.rms, point.p95, point.random_rms)))
        for point in planned.accuracy_curve
    ]
    title = "expected errors of the tool position by number of poses"
    short = rows if len(rows) <= MAX_POINTS else [*rows[:: -(-len(rows) // MAX_POINTS)], rows[-1]]
    weak = [
        "Main contributions to the expected error:",
        *(f"- {line}" for line in planned.main_error_sources),
    ]
    points = sum(map(len, planned.stored_plan.waypoints))
    lines = [planned.candidates.sentence, f"The poses are joined with {count_text(points, 'waypoint')}."]
    return ResultText(
        _plan_verdict(planned, files[0]),
        tuple(planned.warnings),
        (
            sentence_block("criterion and limit", _curve_lines(planned)),
            table_block(title, columns, list(dict.fromkeys(short))),
            sentence_block("what remains uncertain", weak, "  "),
            sentence_block(
                "what limits a camera", () if planned.camera is None else planned.camera.sentences
            ),
        ),
        (
            *([table_block(f"{title}, all", columns, rows)] if len(short) < len(rows) else []),
            sentence_block("candidates and waypoints", lines),
        ),
        (f"Written to {', '.join(map(str, files))}.",),
    )


def _plan_verdict(planned: Plan, file: Path) -> Verdict:
    """Return the verdict on the expected accuracy of a calibration with the poses."""
    last, settings, warnings = planned.accuracy_curve[-1], planned.stored_plan.settings, planned.warnings
    cautions = f"with caution ({count_text(len(warnings), 'warning')})" if warnings else "yes"
    checked = (
        f"; {count_text(planned.test_pose_count, 'pose')} will check it" if planned.test_pose_count else ""
    )
    more = "" if planned.accuracy_curve[0].poses else "more "
    return Verdict(
        f"{rounded_text(last.rms * 1e3)} mm RMS and {rounded_text(last.p95 * 1e3)} mm (95 %) expected for the tool "
        f"position with {planned.calibration_pose_count} {more}poses; {rounded_text(last.random_rms * 1e3)} mm RMS "
        "with random poses.",
        f"{cautions}, if the sensor scatters as stated{checked}.",
        f"measure the poses, about {planned.duration / 60:.0f} min at {settings.speed_deg_s:g} deg/s and "
        f"{settings.settling_s:g} s per pose, with `pisigma measure {file} --rows ROWS.csv`.",
    )


def _curve_lines(planned: Plan) -> list[str]:
    """Return sentences on the limits of the curve, and on the number of poses that the accuracy limit requires."""
    lines, last, settings = [], planned.accuracy_curve[-1], planned.stored_plan.settings
    limit = settings.limit_mm
    if settings.criterion == "D" and last.rms > last.random_rms:
        lines.append(
            "Criterion D determines all unknowns of the robot and need not lower the error of the tool's position; use "
            "criterion I for that."
        )
    if limit is not None and planned.poses_needed is None:
        lines.append(
            f"More than {planned.calibration_pose_count} poses are needed to keep 95 % of the errors below "
            f"{limit:g} mm."
        )
    elif limit is not None:
        needed = f"With {planned.poses_needed}" if planned.poses_needed else "Without more"
        lines.append(f"{needed} poses, 95 % of the errors are expected to be below {limit:g} mm.")
    return lines


def verification_text(verification: Verification, width: int, verbose: bool = False) -> ResultText:
    """Lay out a verification: the verdict, warnings, and the errors with and without the correction.

    Args:
        verification: the verification.
        width: width of the screen [characters].
        verbose: show all statistics.
    """
    trust = {"better": "yes", "undecided": "not known"}.get(verification.verdict, "no")
    figures, rows = verification.comparison.models, verification.rows
    errors = f"{model_rms_text(figures[-1], rows)} RMS with the correction, {model_rms_text(figures[0], rows)} without"
    command = f"run `{verification.recalibration_command}`."
    verdict = Verdict(
        f"{errors} ({rows} rows of {Path(verification.data).name}).",
        f"{trust}: {uncapitalised(verification.sentence)}",
        command if verification.recalibration_command else _NEXT_STEPS[verification.verdict],
    )
    warnings = [*(fault.sentence for fault in verification.setup_faults), *verification.warnings]
    shown, details = comparison_blocks(verification.comparison, verification.data, width, verbose)
    return ResultText(verdict, tuple(warnings), tuple(shown), tuple(details))


def monitoring_text(monitoring: MonitoringResult, closing_sentences: Sequence[str] = ()) -> ResultText:
    """Lay out a monitoring: the verdict, a line for every session, and the conclusions from all sessions.

    Args:
        monitoring: the monitoring.
        closing_sentences: sentence on the written files.
    """
    sessions, name = monitoring.sessions_of_call, monitoring.model.name
    said = [f"{one.date}: {one.session.sentence}" for one in sessions if one.session.verdict != "unchanged"]
    unobservable = dict.fromkeys(line for one in sessions for line in one.session.unobservable_sentences)
    charts = table_block(
        f"charts of {len(monitoring.all_sessions)} sessions", *chart_table(monitoring.charts)
    )
    advice = next((line for line in monitoring.sentences if "`pisigma " in line), "")
    together = [one for one in monitoring.sentences if one != advice]
    details = (
        table_block(f"sessions of {name}", *session_table(sessions)),
        sentence_block("what has changed in all sessions", said, "  "),
    )
    return ResultText(
        _monitoring_verdict(monitoring, advice),
        tuple(monitoring.warnings),
        (
            sentence_block("conclusions from all sessions", together),
            sentence_block("what has changed", [*said[-_MAX_SESSIONS:], *unobservable], "  "),
            table_block(f"last sessions of {name}", *session_table(sessions[-_MAX_SESSIONS:])),
            *([charts] if len(monitoring.all_sessions) > 1 else []),
        ),
        details if len(sessions) > _MAX_SESSIONS else (),
        tuple(closing_sentences),
    )


def _monitoring_verdict(monitoring: MonitoringResult, advice: str) -> Verdict:
    """Return the verdict on a robot from its sessions; `advice` states how to recalibrate it if this is recommended."""
    sessions, untrusted = monitoring.sessions_of_call, len(monitoring.untrusted_sessions)
    changed = [one for one in sessions if one.session.verdict != "unchanged"]
    last = (
        f"{sessions[-1].date}, {rounded_text(sessions[-1].session.rms * 1e3, 0)} mm RMS"
        if sessions
        else "none"
    )
    alarms = [chart.quantity for chart in monitoring.charts if chart.alarm is not None]
    doubts = [f"changed in {len(changed)} of {count_text(len(sessions), 'session')}"] if changed else []
    doubts += [f"outside the limits of its chart: {', '.join(alarms)}"] if alarms else []
    doubts += [f"{count_text(untrusted, 'session')} left out"] if untrusted else []
    trust = f"yes: unchanged in {count_text(len(sessions), 'session')}."
    return Verdict(
        f"last session {last} under the model, base and tool fitted where they were moved.",
        f"{'no' if monitoring.needs_action else 'with caution'}: {'; '.join(doubts)}." if doubts else trust,
        uncapitalised(advice)
        or ("see what has changed below." if doubts else "measure the next session with the same poses."),
    )


def recalibration_text(recalibration: Recalibration, folder: Path | None) -> ResultText:
    """Return a recalibration as text: the verdict, moved parts, and the candidate models.

    Args:
        recalibration: the recalibration.
        folder: folder of the model; None if it was not written.
    """
    summary = recalibration.summary
    warnings = (*(one.sentence for one in summary.diagnostics[1:]), *summary.warnings)
    written = f"Model written to {folder} in {recalibration.seconds:.1f} s; its README.md has all figures."
    return ResultText(
        _recalibration_verdict(recalibration, folder),
        (*warnings, *(one.sentence for one in summary.outliers)),
        (
            sentence_block("which model is kept", [summary.verdict]),
            table_block(f"errors of {summary.held_out_row_count} held-out rows", *candidate_table(summary)),
        ),
        closing_sentences=() if folder is None else (written,),
    )


def _recalibration_verdict(recalibration: Recalibration, folder: Path | None) -> Verdict:
    """Return the verdict on a recalibration."""
    summary, names = recalibration.summary, candidate_names(recalibration.summary)
    errors = {name: one.rms_mm for name, one in summary.cross_validation.items() if one.rms_mm is not None}
    texts = {
        name: f"{names[name]} {rounded_text(error, summary.held_out_row_count)} mm"
        for name, error in errors.items()
    }
    first = texts.pop(summary.kept_candidate, "not known: too few rows")
    others = f"; {', '.join(texts.values())}" if texts else ""
    count = len(summary.warnings) + len(summary.outliers)
    cautions = f"with caution ({count_text(count, 'warning')})" if count else "yes"
    return Verdict(
        f"{first} RMS, held out in cross-validation of {summary.held_out_row_count} new rows{others}.",
        f"no: {summary.diagnostics[0].sentence}"
        if summary.diagnostics
        else f"{cautions}: {uncapitalised(summary.change_sentence)}",
        f"verify with other poses: `pisigma verify {folder} ROWS.csv`."
        if folder is not None
        else "run it with --out DIR instead of --dry-run to write this model."
        if recalibration.trusted
        else "correct the problem named above and run the recalibration again; no model was written.",
    )


def report_text(result: Report, closing_sentences: Sequence[str] = ()) -> ResultText:
    """Return a report as text: its verdict, the advice on measuring, and the acceptance of a cell.

    Args:
        result: the report.
        closing_sentences: sentence on the written files.
    """
    content, accepted = result.content, result.acceptance
    trust = "yes: these rows were held out."
    if result.diagnostics:
        trust = f"no: {result.diagnostics[0].sentence}"
    elif doubt := report_doubt(result):
        trust = f"no: {uncapitalised(doubt)}"
    elif not content.verdict.is_held_out:
        trust = "with caution: no held-out rows were judged."
    first, *others = content.advice or ("read the page.",)
    blocks = [sentence_block("further advice", (f"- {one}" for one in others), "  ")]
    if accepted is not None:
        columns, rows = budget_table(accepted)
        lacking = ", ".join(dict.fromkeys(line.partition(":")[0] for line in accepted.not_stated_sentences))
        lines = (*acceptance_sentences(accepted), f"Not stated: {lacking}; see the page.")
        budget = ("Uncertainty budget of one coordinate", columns[:-1], [row[:-1] for row in rows])
        blocks += [sentence_block("acceptance", lines, "  "), table_block(*budget)]
    return ResultText(
        Verdict(result.verdict, trust, uncapitalised(first)),
        tuple(one.sentence for one in result.diagnostics[1:]),
        tuple(blocks),
        closing_sentences=tuple(closing_sentences),
    )


def report_doubt(result: Report) -> str:
    """Return the reason why rows of a report must not be trusted or contradict the acceptance, or ""."""
    if result.acceptance is not None and result.acceptance.is_contradicted and not result.diagnostics:
        return contradiction_sentence(result.acceptance)
    return " ".join(one.sentence for one in result.diagnostics)
