"""The page of a cell by its requests: what it shows, what it refuses, and that nothing is half written."""

import json
import re
import shutil
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from testing.cell_rows import day, measured
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.pages import visitor
from testing.report import HOSTILE
from testing.workbench_requests import do, ended, seen, state, upload
from typer.testing import CliRunner

pytest.importorskip("viser", reason="the extra view is not installed")

from pisigma.cli.main import app
from pisigma.files.errors import PlanningError, system_problem_text
from pisigma.lifetime.cell.layout import CELL_FILE
from pisigma.model.folder.model_folder import load_model
from pisigma.reporting.result_text import ResultText
from pisigma.reporting.verdict import Verdict
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.report.error_map import map_of_workspace
from pisigma.workbench.job import BusyError, Jobs, Outcome
from pisigma.workbench.steps import side_by_side, wrong_rows_by_sentence
from pisigma.workbench.tabs import MAX_LINES, TABS, line_numbers_in
from pisigma.workbench.workbench import STEPS, Workbench
from pisigma.workflow.cell.cell import Cell


def test_every_tab_is_shown_and_texts_of_files_are_escaped(browser_with_link):
    assert browser_with_link.ask().status == 200
    for name in TABS:
        answer = browser_with_link.ask(f"/tab/{name}")
        assert answer.status == 200
        text = answer.body.decode()
        assert "<script>alert" not in text
        assert "onerror=alert(2)>" not in text
        assert re.search(r"<h2>|<form", text)
    assert "&lt;script&gt;alert" in browser_with_link.ask("/tab/status").body.decode()


def test_the_status_is_that_of_the_command(browser_with_link, cell):
    step = cell.status().step
    assert state(browser_with_link)["next"] == step.to_json()
    assert step.reason in browser_with_link.ask("/tab/status").body.decode()


@pytest.mark.parametrize(
    "path",
    ["/tab/x", "/tab/..%2fparts", "/static/..%2f__init__.py", "/download/plan/..%2fcell.yaml", "/absent"],
)
def test_other_pages_are_not_found(browser_with_link, path):
    assert browser_with_link.ask(path).status in (404, 422)


@pytest.mark.parametrize("kind", ["plan", "model", "export", "x"])
def test_only_files_of_the_cell_can_be_downloaded(browser_with_link, kind):
    for name in (
        "cell.yaml",
        "history.sqlite",
        "%2fetc%2fpasswd",
        "a/../../cell.yaml",
        "%2e%2e/%2e%2e/cell.yaml",
    ):
        assert browser_with_link.ask(f"/download/{kind}/{name}").status in (404, 422)


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"a": 1}', b"\xff", b'{"a": {}}', b'{"a": "\\ud800"}'])
def test_what_is_not_a_form_is_refused(browser_with_link, bench, body):
    assert browser_with_link.ask("/step/plan", "POST", body).status == 400
    assert bench.jobs.running is None
    assert do(browser_with_link, "absent").status == 404


def test_a_wrong_setting_is_refused_with_its_name(browser_with_link, bench, cell):
    found = ended(browser_with_link, bench, "plan", count="many")
    assert found.text is None
    assert "count" in found.refusal
    assert not list((cell.folder / "plans").iterdir())


@pytest.mark.parametrize(
    "text", ["robot: 'no such robot'\n", "robot: ur10\nplan:\n  count: many\n", "{", HOSTILE]
)
def test_an_invalid_cell_file_is_not_written(browser_with_link, bench, cell, text):
    before = (cell.folder / CELL_FILE).read_bytes()
    files = sorted(cell.folder.iterdir())
    assert ended(browser_with_link, bench, "cell", text=text, seen=seen(browser_with_link)).refusal
    assert (cell.folder / CELL_FILE).read_bytes() == before
    assert sorted(cell.folder.iterdir()) == files


def test_a_setting_can_be_changed(browser_with_link, bench, cell):
    before = (cell.folder / CELL_FILE).read_text()
    text = before.replace("limit_mm: 0.5", "limit_mm: 0.4")
    first = seen(browser_with_link)
    assert ended(browser_with_link, bench, "cell", text=text, seen=first).refusal == ""
    assert Cell.open(cell.folder).file.document.limit_mm == 0.4
    for stale in (first, ""):
        assert "changed since" in ended(browser_with_link, bench, "cell", text=before, seen=stale).refusal
    assert Cell.open(cell.folder).file.document.limit_mm == 0.4
    assert ended(browser_with_link, bench, "cell", text=before, seen=seen(browser_with_link)).refusal == ""


def test_what_was_dragged_is_written_and_can_be_undone(browser_with_link, bench, cell):
    text = cell.file.path.read_text()
    box = {"name": HOSTILE, "center_mm": "700, 0, 50.5", "size_mm": "100, 200, 101"}
    fields = {f"surroundings.boxes.0.{key}": value for key, value in box.items()}
    fields["surroundings.tracker.z_mm"] = "900"
    assert state(browser_with_link)["dragged"] == {"turn": 0, "values": {}}
    digest = seen(browser_with_link)
    refused = ended(browser_with_link, bench, "cell", seen=digest, **fields)
    assert refused.refused_field == "surroundings.tracker.x_mm"
    margin = {"surroundings.joints.margin_deg": "1000"}  # leaves no range of the joints
    assert ended(browser_with_link, bench, "cell", seen=digest, **margin).refusal
    assert cell.file.path.read_text() == text
    fields |= {"surroundings.tracker.x_mm": "3000", "surroundings.tracker.y_mm": "-10"}
    view = {
        "near_mm": "300",
        "far_mm": "700",
        "frame.x_mm": "420",
        "frame.z_mm": "50",
        "frame.yaw_deg": "180",
    }
    fields |= {f"surroundings.view.{key}": value for key, value in view.items()}
    assert ended(browser_with_link, bench, "cell", seen=digest, **fields).refusal == ""
    turn = json.loads(browser_with_link.ask("/drag", "POST", '{"on": "true"}').body)["turn"]
    handles = bench._scene._scene.handles
    handles["boxes.0"].wxyz = (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8))
    handles["tracker"].position = (3, -0.01, 0.8)
    handles["floor_mm"].position = (0, 0, -0.5)
    handles["view.frame"].position = (0.42, 0.1, 0.05)
    handles["view.frame"].wxyz = (0, np.cos(np.pi / 12), np.sin(np.pi / 12), 0)
    found = state(browser_with_link)["dragged"]
    values = {"surroundings.boxes.0.yaw_deg": "45.00", "surroundings.tracker.z_mm": "800"}
    values |= {"surroundings.view.frame.roll_deg": "30.00"}
    values |= {"surroundings.floor_mm": "-500", "surroundings.view.frame.y_mm": "100"}
    assert found == {"turn": turn, "values": values}
    assert ended(browser_with_link, bench, "cell", seen=seen(browser_with_link), **values).refusal == ""
    written = Cell.open(cell.folder).file.document.surroundings
    assert (written.boxes[0].center_mm, written.boxes[0].yaw_deg) == ((700, 0, 50.5), 45)
    assert (written.boxes[0].name, written.tracker.z_mm, written.floor_mm) == (HOSTILE, 800, -500)
    T = written.view.T_cell_frame.numpy()  # a rotation by 180 deg about an axis in the x-y plane
    assert_close(T[:3, 3], np.array([0.42, 0.1, 0.05]), atol=1e-9)
    assert_close(T[:3, 0], np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0]), atol=1e-9)
    assert_close(T[:3, 2], np.array([0.0, 0, -1]), atol=1e-9)
    assert HOSTILE not in browser_with_link.ask("/tab/cell").body.decode()
    for _ in range(2):
        last = seen(browser_with_link)
        assert ended(browser_with_link, bench, "cell", undo=last).refusal == ""
    assert ended(browser_with_link, bench, "cell", undo=last).refusal
    assert cell.file.path.read_text() == text


def test_an_empty_folder_becomes_a_cell_once(tmp_path):
    folder = tmp_path / "new"
    with no_type_checker(), Workbench(folder, port=0) as new:
        first, second = visitor(new.url), visitor(new.url)
        assert state(first)["next"]["state"] == "no_cell"
        assert ended(first, new, "plan").refusal
        for form in (
            {},
            {"robot": "/etc/passwd"},
            {"robot": str(folder)},
            {"robot": "ur5", "limit_mm": HOSTILE},
            {"robot": "ur5", "limit_mm": "-1"},
            {"robot": "ur5", "sensor": HOSTILE},
            {"file": "7"},
            {"file": upload(first, "a.urdf", b"<robot/>")},
        ):
            assert ended(first, new, "new", **form).refusal, form
            assert first.ask("/tab/status").status == 200
        assert first.ask("/upload?name=a.urdf&links", "POST", HOSTILE.encode()).status == 422
        assert not folder.exists()
        assert list(tmp_path.iterdir()) == []
        assert ended(first, new, "new", robot="ur5", limit_mm="0.3").refusal == ""
        assert ended(second, new, "new", robot="ur10").refusal
        assert state(second)["next"] == Cell.open(folder).status().step.to_json()
        assert Cell.open(folder).robot.name == "ur5"
        assert "data-step" in second.ask("/tab/plan").body.decode()
    with pytest.raises(PlanningError):
        Workbench(tmp_path, port=0)


def test_a_session_that_was_set_aside_is_taken_back(browser_with_link, bench, cell):
    (before,) = (one for one in cell.history.sessions() if one.set_aside)
    for name in ("", "../cell", day(20), HOSTILE):
        assert ended(browser_with_link, bench, "restore_session", session=name).refusal
    assert ended(browser_with_link, bench, "restore_session", session=before.name).refusal == ""
    sessions = {one.name: one for one in cell.history.sessions()}
    taken_in = sessions[before.name].taken_in
    assert sessions[before.name] == replace(before, set_aside="", taken_in=taken_in)
    assert ended(browser_with_link, bench, "session", session=before.name, set_aside=HOSTILE).refusal == ""


def test_a_cell_file_that_breaks_during_a_step_is_named_as_the_fault(
    browser_with_link, bench, cell, monkeypatch
):
    path = cell.folder / CELL_FILE
    before = path.read_text()
    monkeypatch.setitem(STEPS, "plan", lambda *_: path.write_text("{") and Outcome())
    try:
        assert ended(browser_with_link, bench, "plan").refusal == ""
        assert state(browser_with_link)["next"]["state"] == "broken_cell"
        assert CELL_FILE in browser_with_link.ask("/tab/status").body.decode()
        found = ended(browser_with_link, bench, "verify")
        assert CELL_FILE in found.refusal
        assert "defect" not in found.refusal
    finally:
        path.write_text(before)
    assert browser_with_link.ask("/state").status == 200


def test_a_broken_cell_file_is_repaired_on_the_page(tmp_path):
    made = Cell.create(tmp_path / "broken", "ur10")
    path = made.folder / CELL_FILE
    right, wrong = path.read_text(), f"robot: ur10\nplan: [1\n{HOSTILE}"
    path.write_bytes(wrong.encode() + b"\xff")
    with no_type_checker(), Workbench(made.folder, port=0) as bench:
        browser = visitor(bench.url)
        assert browser.ask().body.decode().count('role="tab"') == 1
        text = browser.ask("/tab/cell").body.decode()
        assert f"{CELL_FILE}, line " in text
        assert HOSTILE not in text
        assert ended(browser, bench, "cell", text=f"{wrong}\n", seen=seen(browser)).refusal
        assert path.read_bytes() == wrong.encode() + b"\xff"
        assert ended(browser, bench, "cell", text=right, seen="").refusal
        assert ended(browser, bench, "cell", text=right, seen=seen(browser)).refusal == ""
        assert path.read_text() == right
        assert state(browser)["next"] == made.status().step.to_json()
        assert "Undo" in browser.ask("/tab/cell").body.decode()


def test_warnings_point_at_their_rows_by_fields(browser_with_link, bench, cell, monkeypatch):
    one = Diagnostic(
        kind="mixed_rows",
        severity="warning",
        sentence="rows differ",
        row_places=("a.csv, line 3", "a.csv, line 4"),
    )
    text = ResultText(Verdict("exact", "yes", "none"), (one.sentence,))
    monkeypatch.setitem(
        STEPS, "calibrate", lambda *_: Outcome(text, wrong_rows_by_sentence=wrong_rows_by_sentence([one]))
    )
    ended(browser_with_link, bench, "calibrate")
    assert 'data-show="a.csv, line 3; a.csv, line 4"' in browser_with_link.ask("/tab/calibrate").body.decode()
    bench.jobs.outcomes.pop("calibrate")


def test_changes_of_a_program_are_shown_side_by_side():
    diff = "--- a\n+++ b\n@@ -6 +6,2 @@\n-LIN P1\n+LIN P2\n+LIN P3\n@@ -9 +10 @@\n-PTP A\n+PTP B"
    assert side_by_side(diff) == [("6", "LIN P1", "LIN P2"), ("", "", "LIN P3"), ("9", "PTP A", "PTP B")]


def test_sentences_name_the_lines_of_rows():
    assert line_numbers_in("rows.csv, line 62: moved; 3 more of this kind: lines 3, 7 to 9.") == [
        62,
        3,
        7,
        8,
        9,
    ]
    assert len(line_numbers_in("lines 1 to 999999999")) <= MAX_LINES


def test_one_acts_and_others_see_who(browser_with_link, bench, cell, monkeypatch):
    begun, go_on = threading.Event(), threading.Event()

    def slow(bench, cell, form, progress):
        progress("fold 1 of 2: geometry")
        begun.set()
        go_on.wait(20)
        progress("fold 2 of 2: geometry")
        raise AssertionError("it was stopped before")

    monkeypatch.setitem(STEPS, "plan", slow)
    assert do(browser_with_link, "plan").status == 200
    begun.wait(20)
    running = state(browser_with_link)["running"]
    assert (running["step"], running["person"], running["what"]) == ("plan", "Ada", "fold 1 of 2: geometry")
    refused = do(browser_with_link, "verify")
    assert refused.status == 409
    assert "Ada" in json.loads(refused.body)["error"]
    before = bench.jobs.ended
    for stale in ({}, {"ended": str(before - 1)}):  # of somebody who saw an earlier step
        assert browser_with_link.ask("/stop?person=Cy", "POST", json.dumps(stale)).status == 200
    assert state(browser_with_link)["running"]["stopped_by"] == ""
    assert browser_with_link.ask("/stop?person=Bo", "POST", json.dumps({"ended": str(before)})).status == 200
    go_on.set()
    while bench.jobs.ended == before:
        time.sleep(0.02)
    found = bench.jobs.outcomes["plan"]
    assert found.stopped
    assert "Bo" in found.refusal


def test_a_defect_ends_the_step_only(browser_with_link, bench, monkeypatch, capsys):
    def broken(bench, cell, form, progress):
        raise ZeroDivisionError

    monkeypatch.setitem(STEPS, "verify", broken)
    assert "ZeroDivisionError" in ended(browser_with_link, bench, "verify").refusal
    assert "Traceback" in capsys.readouterr().err
    assert browser_with_link.ask("/tab/verify").status == 200


@pytest.mark.parametrize("problem", [OSError(28, "No space left on device", "rows.csv"), MemoryError()])
def test_a_machine_that_cannot_is_not_a_defect(browser_with_link, bench, monkeypatch, capsys, problem):
    def full(*_):
        raise problem

    monkeypatch.setitem(STEPS, "plan", full)
    monkeypatch.setattr(bench._uploads, "add", full)
    expected = system_problem_text(problem)
    assert expected
    assert ended(browser_with_link, bench, "plan").refusal == expected
    assert json.loads(browser_with_link.ask("/upload?name=a", "POST", b"1").body)["error"] == expected
    assert "Traceback" not in capsys.readouterr().err


def test_no_step_starts_once_the_server_ends():
    jobs = Jobs()
    jobs.close()
    with pytest.raises(BusyError):
        jobs.start("plan", "Ada", "", lambda progress: Outcome())


def test_results_are_those_of_the_commands(tmp_path):
    """The page of a cell and the commands on a copy of the cell show the same figures and states."""
    with no_type_checker():
        made = Cell.create(tmp_path / "page", "ur10", limit_mm=0.5)
        made.add_session(measured(40, 0), day=day(20))
        made.calibrate(folds=0)
        made.add_session(measured(15, 1, zero=0.2), day=day(10))
        shutil.copytree(made.folder, tmp_path / "commands")
        with Workbench(made.folder, port=0) as bench:
            browser = visitor(bench.url)
            for step in ("verify", "monitor", "recalibrate"):
                found = ended(browser, bench, step)
                result = CliRunner().invoke(app, [step, str(tmp_path / "commands")])
                printed = " ".join(result.output.split()).replace("/commands", "/page")
                assert found.text is not None, (step, found.refusal)
                verdict = found.text.verdict
                for text in (verdict.accuracy, verdict.trust, *found.text.warnings):
                    assert " ".join(text.split()) in printed, step
                assert bool(found.refusal) == (result.exit_code != 0), (step, found.refusal)
            bench._scene._errors.value = True
            bench._scene.show_errors(made)
            name, shown = bench._scene._predicted
            assert name in bench._scene._legend.content
            model = load_model(made.model_folder(name))
            # 95 % quantile over the standard deviation of the length: 1.61 for a round, 1.96 for a flat distribution
            spread = next(one for one in map_of_workspace(model).layers if one.key == "predicted").values
            ratio = 1e3 * shown.p95.numpy() / spread
            assert 1.5 < ratio.min() < ratio.max() < 2.1
