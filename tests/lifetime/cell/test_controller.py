"""What is active on the controller: every rule of the table, and which zeros sessions and models were measured with."""

import time
from dataclasses import replace
from typing import get_args

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError, ModelError
from pisigma.lifetime.cell.controller import RULES, ControllerHistory, Situation, record_controller
from pisigma.lifetime.cell.exports import Contents, ControllerEntry, ExportEntry
from pisigma.lifetime.cell.facts import CellFacts
from pisigma.lifetime.cell.history import HISTORY, History, InUse, ModelEntry, SessionEntry
from pisigma.lifetime.cell.status import next_step

DH = ExportEntry("dh.csv", "dh", "dh", "kinematics", "a", "2026-01-12T08:00:00+00:00")
OFFSETS = ExportEntry("offsets.csv", "offsets", "offsets", "joint_zeros", "a", "2026-01-12T08:00:00+00:00")
PROGRAM = ExportEntry("square.script", "program", "targets", "joint_values", "a", "2026-01-12T08:00:00+00:00")


def change(day, sha256, time="08:00:00"):
    return ControllerEntry(day, sha256, "", f"{day}T{time}+00:00")


def session(day, time="09:00:00"):
    return SessionEntry(day, "hash", f"{day}T{time}+00:00", day, 40, "position")


BEFORE, AFTER = session("2026-01-10"), session("2026-02-10")
MODEL = ModelEntry("a", "hash", "2026-02-11T08:00:00+00:00", BEFORE.name, BEFORE.day)
NEWER = replace(MODEL, name="b", sessions=f"{BEFORE.name},{AFTER.name}", day=AFTER.day)
SITUATIONS: dict[Situation, tuple[ModelEntry, tuple[str, ...]]] = {
    "kinematics": (NEWER, ("dh",)),
    "same_zeros": (NEWER, ("offsets",)),
    "other_zeros": (MODEL, ("offsets",)),
}


def controller(*hashes, day="2026-01-20"):
    return ControllerHistory(tuple(change(day, one) for one in hashes), (DH, OFFSETS, PROGRAM))


def test_the_table_has_every_situation_and_every_content():
    assert tuple(SITUATIONS) == get_args(Situation)
    assert all(len(effects) == len(SITUATIONS) for effects in RULES.values())
    assert {name.split()[1] for name in RULES if name.startswith("export ")} == set(get_args(Contents))


def test_the_documentation_has_the_same_table(repository):
    page = (
        (repository / "docs" / "how-to" / "cell.md")
        .read_text()
        .split("## What is active on the controller")[1]
    )
    lines = [
        line.strip("| ").split(" | ")
        for line in page.split("\n## ")[0].splitlines()
        if line.startswith("| `")
    ]
    documented = {name.strip("` "): tuple(effects) for names, *effects in lines for name in names.split(", ")}
    assert documented == RULES


@pytest.mark.parametrize("situation", SITUATIONS)
@pytest.mark.parametrize("command", RULES)
def test_every_rule_of_the_table(command, situation, tmp_path):
    model, hashes = SITUATIONS[situation]
    effect = RULES[command][get_args(Situation).index(situation)]
    found = controller(*hashes).findings(command, model, (BEFORE, AFTER))
    assert (bool(found.refusal), len(found.warnings)) == (effect == "refuse", int(effect == "warn"))
    if effect == "refuse":
        with refused(ModelError, file=tmp_path):
            found.checked_warnings(tmp_path)
    else:
        assert found.checked_warnings(tmp_path) == found.warnings


@pytest.mark.parametrize("command", RULES)
def test_nothing_is_refused_while_nothing_is_active(command):
    for changes in (ControllerHistory(), controller("dh", "offsets", "")):
        found = changes.findings(command, MODEL, (BEFORE, AFTER))
        assert (found.refusal, found.warnings) == ("", ())


def test_kinematics_and_joint_zeros_are_active_together():
    found = controller("dh", "offsets").active_exports()
    assert {name: one.export for name, one in found.items()} == {"kinematics": DH, "joint_zeros": OFFSETS}
    assert controller("dh", "offsets").findings("serve", MODEL, (BEFORE, AFTER)).refusal
    assert len(controller("dh", "offsets").findings("serve", NEWER, (BEFORE, AFTER)).warnings) == 1


def test_zeros_that_were_removed_are_missing_for_a_model_that_was_measured_with_them():
    changes = ControllerHistory((change("2026-01-20", "offsets"), change("2026-03-01", "")), (OFFSETS,))
    assert changes.findings("serve", NEWER, (BEFORE, AFTER)).refusal
    assert not changes.findings("serve", MODEL, (BEFORE, AFTER)).refusal
    assert [changes.matches_session(one) for one in (BEFORE, AFTER)] == [True, False]


def test_a_session_of_the_day_of_a_change_counts_as_measured_before_if_it_was_added_before():
    changes = controller("offsets", day=AFTER.day)
    assert changes.matches_session(session(AFTER.day, "09:00:00"))
    assert not changes.matches_session(session(AFTER.day, "07:00:00"))


def test_a_model_without_sessions_was_measured_until_it_was_made():
    elsewhere = replace(MODEL, sessions="", day="")
    assert "joint_zeros" in controller("offsets").active_when_fitted(elsewhere, ())
    assert "joint_zeros" not in controller("offsets", day="2026-03-01").active_when_fitted(elsewhere, ())


def test_sessions_with_other_zeros_are_not_valid_and_a_plan_is_due():
    facts = CellFacts(
        "cell",
        ("plan",),
        (BEFORE, AFTER),
        (),
        (),
        (MODEL,),
        (),
        MODEL,
        0.3,
        "2026-03-11",
        controller=controller("offsets", day="2026-03-01"),
    )
    assert facts.valid_sessions == ()
    step = next_step(facts)
    assert (step.state, step.command.split()[1]) == ("no_plan", "plan")
    assert replace(facts, controller=controller("dh", day="2026-03-01")).valid_sessions == (BEFORE, AFTER)


@pytest.mark.parametrize(
    ("sha256", "day", "option"),
    [
        ("other", "", "--export"),
        ("program", "", "--export"),
        ("dh", "2026-01-11", "--date"),
        ("dh", "9000-01-01", "--date"),
        ("dh", "20.1.2026", "--date"),
    ],
)
def test_what_cannot_be_active_is_refused(tmp_path, sha256, day, option):
    history = History(tmp_path / HISTORY)
    history.add(DH, OFFSETS, PROGRAM)
    with refused(MeasurementError, option=option):
        record_controller(history, sha256, day, "")
    assert history.controller() == ()
    record_controller(history, "dh", "2026-01-20", "at low speed")
    assert ControllerHistory.from_history(history).active_exports()["kinematics"].since == "2026-01-20"


@pytest.mark.parametrize(
    ("zone", "utc", "day"),
    [("UTC+8", "2026-01-13T03:00", "2026-01-12"), ("UTC-9", "2026-01-12T20:00", "2026-01-13")],
)
def test_days_are_those_of_the_time_zone_of_the_machine(tmp_path, monkeypatch, zone, utc, day):
    at, history = f"{utc}:00.000+00:00", History(tmp_path / HISTORY)
    made = replace(MODEL, made=at, sessions="", day="")
    history.add(replace(OFFSETS, exported=at), made, InUse("a", at, ""))
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        assert history.record("accepted", day, "", "A. Auditor").day == day
        record_controller(history, "offsets", day, "")
        since = ControllerEntry(day, "offsets", "", f"{utc[:14]}00:00.000+00:00")
        assert ControllerHistory((since,), history.exports()).matches_model(made, ())
    finally:
        monkeypatch.undo()
        time.tzset()
