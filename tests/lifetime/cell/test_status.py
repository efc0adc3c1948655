"""Every state of a cell is reached by stated facts, and its command is the one that changes it."""

from dataclasses import replace
from typing import get_args

import pytest

from pisigma.lifetime.cell.controller import ControllerHistory, valid_sessions
from pisigma.lifetime.cell.events import ARM_EVENTS, Event
from pisigma.lifetime.cell.exports import ControllerEntry, ExportEntry
from pisigma.lifetime.cell.facts import NOT_TRUSTED, CellFacts
from pisigma.lifetime.cell.history import Check, ModelEntry, SessionEntry
from pisigma.lifetime.cell.status import MAX_DAYS_UNVERIFIED, CellStatus, is_check_due, next_step
from pisigma.lifetime.cell.step import State


def session(name, rows=40, **changed):
    return SessionEntry(name, "hash", f"{name}T09:00:00+00:00", name[:10], rows, "position", **changed)


def model(name, sessions, day="2026-01-10", **changed):
    return ModelEntry(name, "hash", f"{day}T12:00:00+00:00", sessions, day, **changed)


def check(
    command, of, session="", verdict="better", recalibrate=False, p95=0.1, at="2026-02-10T10:00:00+00:00"
):
    return Check(command, of, session, verdict, f"{verdict} was found", p95, recalibrate, at)


FIRST, SECOND = session("2026-01-10"), session("2026-02-10", rows=10)
MODEL = model("a", "2026-01-10", p95_mm=0.1)
EMPTY = CellFacts("cell", (), (), (), (), (), (), None, 0.3, "2026-02-11", settings_sha256="hash")
PLANNED = replace(EMPTY, plans=("2026-01-09",))
MEASURED = replace(PLANNED, sessions=(FIRST,))
CALIBRATED = replace(
    MEASURED, models=(MODEL,), checks=(replace(check("calibrate", "a"), settings_sha256="hash"),)
)
MEASURED_AGAIN = replace(CALIBRATED, sessions=(FIRST, SECOND))
VERIFIED = replace(
    MEASURED_AGAIN, checks=(*CALIBRATED.checks, check("verify", "a", "2026-02-10")), in_use=MODEL
)
THIRD = session("2026-03-10", rows=10)
MONITORED = replace(VERIFIED, sessions=(FIRST, SECOND, THIRD), today="2026-03-11")
NEWER = model("b", "2026-01-10,2026-02-10", day="2026-02-10", p95_mm=0.1)

OFFSETS = ControllerHistory(
    (ControllerEntry("2026-02-20", "hash", "", "2026-02-20T08:00:00+00:00"),),
    (ExportEntry("offsets.csv", "hash", "offsets", "joint_zeros", "a", "2026-02-19T08:00:00+00:00"),),
)

MIXED = replace(NEWER, name="a")
LATE = Event("2026-02-01", "instrument", "", "2026-02-11T08:00:00+00:00")
"""An event that was recorded after a model had been fitted to sessions before and after it."""

CASES = {
    "no_plan": (EMPTY, "plan"),
    "not_measured": (PLANNED, "import"),
    "session_incomplete": (replace(MEASURED, too_few_poses_text="3 of 50 poses"), "import"),
    "several_arms": (replace(PLANNED, unrecorded_files=("a.csv",), has_several_arms=True), ""),
    "not_taken_in": (replace(PLANNED, unrecorded_files=("2026-01-10.csv",)), "import"),
    "file_refused": (
        replace(
            PLANNED,
            unrecorded_files=("2026-01-10.csv",),
            checks=(check("import", "", "2026-01-10", "refused"),),
        ),
        "session",
    ),
    "not_calibrated": (MEASURED, "calibrate"),
    "not_trusted": (
        replace(MEASURED, checks=(check("calibrate", "", verdict="not_trusted"),)),
        "import",
    ),
    "not_verified": (MEASURED_AGAIN, "verify"),
    "verification_failed": (
        replace(MEASURED_AGAIN, checks=(check("verify", "a", "2026-02-10", "not_better"),)),
        "calibrate",
    ),
    "other_joint_zeros": (replace(MONITORED, controller=OFFSETS), "recalibrate"),
    "session_not_judged": (MONITORED, "monitor"),
    "moved": (
        replace(
            MONITORED,
            checks=(*VERIFIED.checks, check("monitor", "a", "2026-03-10", "moved", recalibrate=True)),
        ),
        "recalibrate",
    ),
    "older_than_evidence": (
        replace(
            MONITORED,
            checks=(*VERIFIED.checks, check("monitor", "a", "2026-03-10", "unchanged", recalibrate=True)),
        ),
        "recalibrate",
    ),
    "session_not_trusted": (
        replace(MONITORED, checks=(*VERIFIED.checks, check("monitor", "a", "2026-03-10", "implausible"))),
        "session",
    ),
    "better_model": (
        replace(
            MONITORED,
            models=(MODEL, NEWER),
            checks=(*VERIFIED.checks, check("monitor", "a", "2026-03-10", "unchanged")),
        ),
        "verify",
    ),
    "fitted_to_set_aside": (
        replace(VERIFIED, sessions=(replace(FIRST, set_aside="loose reflector"), SECOND)),
        "calibrate",
    ),
    "fitted_before_event": (replace(VERIFIED, in_use=MIXED, models=(MIXED,), events=(LATE,)), "calibrate"),
    "model_changed": (replace(VERIFIED, changed_models=("a",)), "calibrate"),
    "settings_changed": (replace(VERIFIED, settings_sha256="other"), "calibrate"),
    "outside_limit": (replace(VERIFIED, limit_mm=0.05), "plan"),
    "limit_below_scatter": (replace(VERIFIED, limit_mm=0.05, in_use=replace(MODEL, scatter_mm=0.018)), ""),
    "verification_due": (replace(VERIFIED, today="2026-09-01"), "plan"),
    "edited_session": (replace(VERIFIED, edited_sessions=("2026-01-10",)), "session"),
    "up_to_date": (VERIFIED, ""),
}


def test_every_state_is_a_case():
    assert set(CASES) == set(get_args(State))


@pytest.mark.parametrize("state", ["no_plan", "verification_due", "outside_limit"])
def test_poses_are_measured_without_a_plan_where_none_can_be_made(state):
    step = next_step(replace(CASES[state][0], no_plan_reason="no board"))
    assert step.state == state
    assert step.command.split()[:2] == ["pisigma", "import"]


@pytest.mark.parametrize("state", CASES)
def test_facts_lead_to_their_state_and_its_command(state):
    facts, verb = CASES[state]
    step = next_step(facts)
    assert step.state == state
    assert step.command.split()[:2] == (["pisigma", verb] if verb else [])
    assert "cell" in step.command.split() or not verb
    assert step.to_json() == {"state": state, "reason": step.reason, "command": step.command or None}


@pytest.mark.parametrize(
    ("facts", "checks_model"),
    [
        (EMPTY, False),
        (CALIBRATED, True),
        (CASES["verification_due"][0], True),
        (CASES["outside_limit"][0], False),
    ],
)
def test_a_plan_that_was_made_is_measured_before_another_is_due(facts, checks_model):
    assert next_step(facts).command.split()[1:] == ["plan", "cell"]
    assert is_check_due(facts) is checks_model
    made = check("plan", "", verdict="planned", at="2026-09-01T10:00:00+00:00")
    assert next_step(replace(facts, checks=(*facts.checks, made))).state == "not_measured"
    earlier = replace(made, checked="2026-01-01T10:00:00+00:00")
    if facts.sessions:
        assert next_step(replace(facts, checks=(*facts.checks, earlier))) == next_step(facts)


def test_a_step_that_failed_is_not_named_again():
    failed = check("calibrate", "", verdict="not_trusted", at="2026-02-12T00:00:00+00:00")
    facts, _ = CASES["verification_failed"]
    assert next_step(replace(facts, checks=(*facts.checks, failed))).state == "not_trusted"
    again = check("recalibrate", "a", "2026-03-10", "not_trusted")
    facts, _ = CASES["moved"]
    assert next_step(replace(facts, checks=(*facts.checks, again))).state == "session_not_trusted"
    later = model("c", "2026-01-10,2026-02-10,2026-03-10", day="2026-03-10")
    checks = (*VERIFIED.checks, check("verify", "a", "2026-03-10", "not_better"))
    assert next_step(replace(MONITORED, checks=checks, models=(MODEL, later))).state == "up_to_date"


@pytest.mark.parametrize("kind", ["instrument", "tool", "firmware", *sorted(ARM_EVENTS)])
def test_only_events_of_the_arm_end_the_validity_of_sessions(kind):
    event = Event("2026-02-01", kind, "", "2026-02-01T08:00:00+00:00")
    valid = valid_sessions((FIRST, SECOND), (event,), ControllerHistory())
    assert valid == ((SECOND,) if kind in ARM_EVENTS else (FIRST, SECOND))


def test_a_session_of_the_day_of_an_event_was_measured_after_it():
    event = Event("2026-02-10", "mastering", "", "2026-02-10T08:00:00+00:00")
    assert valid_sessions((FIRST, SECOND), (event,), ControllerHistory()) == (SECOND,)
    assert next_step(replace(VERIFIED, events=(event,), in_use=None)).state == "not_calibrated"
    # a model in use is recalibrated, which takes fewer poses than a calibration
    assert (
        next_step(replace(MONITORED, events=(replace(event, day="2026-03-01"),))).state
        == "session_not_judged"
    )


def test_a_session_that_was_set_aside_counts_no_more():
    aside = replace(SECOND, set_aside="wrong tool")
    assert next_step(replace(MEASURED_AGAIN, sessions=(FIRST, aside))).state == "not_verified"
    assert valid_sessions((FIRST, aside), (), ControllerHistory()) == (FIRST,)


def test_a_new_session_after_a_calibration_that_failed_is_calibrated_with():
    failed = check("calibrate", "", verdict="not_trusted", at="2026-01-11T00:00:00+00:00")
    assert next_step(replace(MEASURED, checks=(failed,))).state == "not_trusted"
    later = replace(MEASURED, sessions=(FIRST, SECOND), checks=(failed,))
    assert next_step(later).state == "not_calibrated"


@pytest.mark.parametrize(
    ("verdict", "state"),
    [("moved", "moved"), ("setup_fault", "session_not_trusted"), ("undecided", "verification_failed")],
)
def test_the_verdict_on_a_model_that_was_not_in_use_yet_leads_to_a_step(verdict, state):
    judged = check("verify", "a", "2026-02-10", verdict, recalibrate=verdict == "moved")
    assert next_step(replace(MEASURED_AGAIN, checks=(judged,))).state == state
    aside = (FIRST, replace(SECOND, set_aside="loose reflector"))
    assert next_step(replace(MEASURED_AGAIN, sessions=aside, checks=(judged,))).state == "not_verified"


@pytest.mark.parametrize(("days", "state"), [(0, "up_to_date"), (1, "verification_due")])
def test_verification_is_due_after_a_quarter(days, state):
    import datetime

    today = datetime.date(2026, 2, 10) + datetime.timedelta(days=MAX_DAYS_UNVERIFIED + days)
    assert next_step(replace(VERIFIED, today=today.isoformat())).state == state


def test_a_session_that_was_set_aside_does_not_postpone_the_verification():
    aside = replace(session("2026-08-31", rows=10), set_aside="loose reflector")
    due, _ = CASES["verification_due"]
    assert next_step(replace(due, sessions=(*due.sessions, aside))) == next_step(due)


@pytest.mark.parametrize("verdict", ["not_better", *NOT_TRUSTED])
@pytest.mark.parametrize("set_aside", ["", "loose reflector"])
def test_errors_are_those_of_trusted_rows(verdict, set_aside):
    wrong = replace(check("verify", "a", "2026-02-10", verdict, p95=9.0), rms_mm=5.0)
    later = replace(check("monitor", "a", "2026-03-10", "unchanged"), rms_mm=0.05)
    before = replace(check("calibrate", "a"), rms_mm=0.06)
    sessions = (FIRST, replace(SECOND, set_aside=set_aside), THIRD)
    facts = replace(MONITORED, sessions=sessions, checks=(before, wrong, later))
    counts = not set_aside and verdict == "not_better"
    assert next_step(facts).state == ("outside_limit" if counts else "up_to_date")
    judged = replace(facts, checks=(before, wrong))
    assert CellStatus(judged, next_step(judged)).last_error == (wrong if counts else before)


def test_a_model_fitted_to_a_session_that_was_set_aside_is_replaced():
    facts, _ = CASES["fitted_to_set_aside"]
    assert next_step(replace(facts, in_use=replace(MODEL, sessions=""))).state == "up_to_date"
    newer = model("b", "2026-02-10", day="2026-02-10")
    step = next_step(replace(facts, models=(MODEL, newer)))
    assert (step.state, step.command) == ("fitted_to_set_aside", "pisigma plan cell")
    again = replace(facts, models=(MODEL, newer), sessions=(*facts.sessions, THIRD), today="2026-03-11")
    judged = (*facts.checks, check("monitor", "a", "2026-03-10", "unchanged"))
    assert next_step(replace(again, checks=judged)).command == "pisigma verify cell --model b"


def test_a_session_that_cannot_be_trusted_is_not_recalibrated_with():
    for verdict in ("implausible", "setup_fault"):
        checks = (*VERIFIED.checks, check("verify", "a", "2026-03-10", verdict, recalibrate=False))
        facts = replace(MONITORED, checks=checks)
        assert next_step(facts).state == "session_not_trusted"
        aside = (FIRST, SECOND, replace(THIRD, set_aside=verdict))
        assert next_step(replace(facts, sessions=aside)).state == "up_to_date"


def test_a_model_that_new_rows_do_not_confirm_is_calibrated_again():
    checks = (*VERIFIED.checks, check("verify", "a", "2026-03-10", "not_better"))
    assert next_step(replace(MONITORED, checks=checks)).state == "verification_failed"


def test_a_limit_that_no_rows_have_confirmed_is_verified():
    recalibrated = model("b", "2026-01-10,2026-02-10", day="2026-02-10", parent="a")
    facts = replace(VERIFIED, models=(MODEL, recalibrated), in_use=recalibrated)
    assert next_step(facts).state == "verification_due"
    assert next_step(replace(facts, limit_mm=None)).state == "up_to_date"


def test_a_model_that_fits_the_joint_zeros_is_used_or_else_calibrated():
    facts = replace(MONITORED, controller=OFFSETS)
    fitting = model("b", "2026-01-10,2026-03-10", day="2026-03-10", parent="a")
    step = next_step(replace(facts, models=(MODEL, fitting)))
    assert step.command.split()[1:] == ["use", "cell", "b"]
    refused = check("recalibrate", "a", "2026-03-10", "not_trusted", at="2026-03-11T08:00:00+00:00")
    step = next_step(replace(facts, checks=(*facts.checks, refused)))
    assert (step.state, step.automatic_command) == ("other_joint_zeros", "calibrate")
    without = ControllerHistory(
        (*OFFSETS.changes, replace(OFFSETS.changes[0], day="2026-03-20", sha256="")), OFFSETS.exports
    )
    step = next_step(replace(facts, models=(fitting,), in_use=fitting, controller=without))
    assert (step.state, step.command.split()[1]) == ("other_joint_zeros", "plan")


def test_a_model_that_was_changed_is_replaced_by_another_or_made_again():
    facts, _ = CASES["model_changed"]
    newer = replace(facts, models=(MODEL, NEWER))
    assert next_step(newer).command == "pisigma use cell b"
    assert next_step(replace(newer, changed_models=("a", "b"))).automatic_command == "calibrate"
    event = Event("2026-02-11", "collision", "", "2026-02-11T08:00:00+00:00")
    assert next_step(replace(facts, events=(event,))).command == "pisigma plan cell"
    not_in_use = replace(facts, in_use=None)
    assert next_step(not_in_use).state == "not_calibrated"


@pytest.mark.parametrize(
    ("event", "state"),
    [
        (LATE, "fitted_before_event"),
        (replace(LATE, kind="firmware"), "up_to_date"),
        (replace(LATE, recorded="2026-02-02T08:00:00+00:00"), "up_to_date"),
        (replace(LATE, day="2026-01-10"), "up_to_date"),
        (replace(LATE, day="2026-02-11"), "up_to_date"),
    ],
)
def test_an_event_that_was_recorded_after_a_calibration_of_rows_before_and_after_it(event, state):
    facts = replace(CASES["fitted_before_event"][0], events=(event,))
    assert next_step(facts).state == state
    assert next_step(replace(facts, in_use=None)).state == (
        "not_verified" if state == "up_to_date" else state
    )
    recalibrated = model("c", "2026-01-10,2026-02-10,2026-03-10", day="2026-03-10", parent="a")
    assert (
        next_step(replace(facts, models=(MIXED, recalibrated), in_use=recalibrated, limit_mm=None)).state
        == state
    )
    again = replace(facts, models=(MIXED, replace(MIXED, name="b", made="2026-02-12T08:00:00+00:00")))
    assert next_step(again).automatic_command is None


def test_changed_settings_or_events_let_a_calibration_that_failed_be_repeated():
    failed = replace(check("calibrate", "", verdict="not_trusted"), settings_sha256="hash")
    facts = replace(MEASURED, checks=(failed,))
    assert next_step(facts).state == "not_trusted"
    assert next_step(replace(facts, settings_sha256="other")).state == "settings_changed"
    assert next_step(replace(facts, checks=(replace(failed, settings_sha256=""),))).state == "not_trusted"
    event = replace(LATE, day="2026-01-10")
    assert next_step(replace(facts, events=(event,))).state == "not_calibrated"
    not_in_use = replace(CALIBRATED, settings_sha256="other")
    assert next_step(not_in_use).state == "settings_changed"
