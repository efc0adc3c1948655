"""`pisigma measure`: what it prints and writes."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from testing.measured_plans import header, measured_plan, row_lines, with_offset

from pisigma.files.errors import MeasurementError, OutputError, PlanningError
from pisigma.workflow.measure import MeasuringSession

PLAN = measured_plan("kiro3", poses=15)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A plan, and a file with twelve rows of which the ninth is wrong and the last one is half written."""
    folder = tmp_path_factory.mktemp("session")
    PLAN.stored.write(folder / "poses.csv")
    rows = row_lines(PLAN.stored.arm.robot, with_offset(PLAN.rows(12), 8, (0.003, -0.004, 0.0)))
    (folder / "rows.csv").write_text(header(PLAN.stored.arm.robot) + "".join(rows) + "1,2\n")
    return folder


def test_the_option_once_evaluates_the_existing_rows(run, folder):
    before = (folder / "poses.csv").read_bytes()
    result = run(
        "measure", folder / "poses.csv", "--rows", folder / "rows.csv", "--once", "--limit-mm", "0.001"
    )
    assert result.exit_code == 0, result.output
    printed = " ".join(result.stdout.split())
    for words in (
        "lines 2 to 9, 11 to 13: 0.",
        "ALARM: line 10: the measured value is 5.",
        "line 14",
        "Next: pose",
        "Trust: 11 rows used, 1 left out",
        "RMS and 95 % of the errors: predicted 0.",
        "0.001 mm",
        "poses.rest.csv",
    ):
        assert words in printed
    assert (folder / "poses.csv").read_bytes() == before
    assert (folder / "poses.rest.csv").exists()


def test_a_fault_of_all_rows_ends_with_3(run, folder, tmp_path):
    """Positions in metres, in columns of millimetres."""
    robot, rows = PLAN.stored.arm.robot, PLAN.rows(5)
    lines = row_lines(robot, replace(rows, position=rows.position / 1000))
    (tmp_path / "rows.csv").write_text(header(robot) + "".join(lines))
    result = run("measure", folder / "poses.csv", "--rows", tmp_path / "rows.csv", "--once")
    assert result.exit_code == 3, result.output
    printed = " ".join(result.stdout.split())
    assert "ALARM: " in printed
    assert "Trust: no: " in printed
    assert "predicted 0." not in printed


def test_json_is_one_object_and_sentences_go_to_stderr(run, folder):
    arguments = ("--rows", folder / "rows.csv", "--once", "--json", "--set", "replan=false")
    result = run("measure", folder / "poses.plan.yaml", *arguments)
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["rest"] is None
    assert (figures["rows"], figures["rows_counting"]) == (12, 11)
    assert [alarm["line"] for alarm in figures["alarms"]] == [10, 14]
    assert figures["accuracy"]["poses"] == 9
    assert figures["action"] in ("measure", "repeat", "correct", "stop")
    assert "ALARM: line 10" in result.stderr


def test_ctrl_c_ends_with_the_summary(run, folder, monkeypatch):
    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pisigma.workflow.follow.time", SimpleNamespace(sleep=interrupt))
    result = run("measure", folder / "poses.csv", "--rows", folder / "rows.csv", "--set", "every=100")
    assert result.exit_code == 0, result.output
    assert "Trust: 11 rows used, 1 left out" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "error", "fields"),
    [
        (("none.csv", "--rows", "rows.csv"), PlanningError, {}),
        (("rows.csv", "--rows", "rows.csv"), PlanningError, {}),
        (("poses.csv", "--rows", "none.csv", "--once"), MeasurementError, {"file": "none.csv"}),
        (("poses.csv", "--rows", "rows.csv", "--limit-mm", "0"), PlanningError, {"value": 0.0}),
        (("poses.csv", "--rows", "rows.csv", "--rest", "rows.csv"), OutputError, {"file": "rows.csv"}),
    ],
)
def test_what_cannot_be_used_is_one_sentence(refuses, folder, monkeypatch, arguments, error, fields):
    monkeypatch.chdir(folder)
    message = refuses("measure", *arguments, error=error, **fields)
    assert arguments[0] in message or fields


def test_programs_contain_the_remaining_poses(run, refuses, tmp_path):
    plan = measured_plan("ur5", poses=9)
    plan.stored.write(tmp_path / "poses.csv")
    (tmp_path / "rows.csv").write_text(
        header(plan.stored.arm.robot) + "".join(row_lines(plan.stored.arm.robot, plan.rows(2)))
    )
    command = ("measure", tmp_path / "poses.csv", "--rows", tmp_path / "rows.csv", "--once", "--program")
    refuses(*command, tmp_path / "poses.txt", error=OutputError, file="poses.txt", value=".txt")
    assert run(*command, tmp_path / "poses.script").exit_code == 0
    assert not (tmp_path / "poses.script").exists()  # nothing was planned again with two rows
    session = MeasuringSession(plan.stored)
    session.add(plan.rows(2))
    session.write_remaining(tmp_path / "rest.csv", [tmp_path / "rest.script"])
    text = (tmp_path / "rest.script").read_text()
    assert [f"pose {number}" in text for number in (2, 3, 9)] == [False, True, True]
