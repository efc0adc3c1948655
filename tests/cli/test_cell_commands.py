"""Commands of a cell: what they print as JSON, and the exit status of what has to be done."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from testing.cell_rows import ROBOT, day, measured
from typer.main import get_command

from pisigma.cli.main import app
from pisigma.files.errors import MeasurementError, ModelError, PlanningError
from pisigma.lifetime.cell.history import HISTORY, TABLES, History, SessionEntry


@pytest.fixture
def cell(run, tmp_path):
    folder = tmp_path / "cells" / "welder7"
    made = run("new", "ur10", "--out", folder, "--limit-mm", 0.3, "--json")
    assert made.exit_code == 0, made.output
    assert json.loads(made.stdout)["next"]["state"] == "no_plan"
    return folder


def test_status_names_the_next_command(run, cell):
    shown = run("status", cell)
    assert shown.exit_code == 0
    assert shown.stdout.splitlines()[-1].strip() == f"pisigma plan {cell}"
    assert run("status", cell, "--exit-code").exit_code == 3
    status = json.loads(run("status", cell, "--json").stdout)
    assert status["next"]["command"] == f"pisigma plan {cell}"
    assert (status["model"], status["limit_mm"], status["sessions"]) == (None, 0.3, [])


def test_status_of_a_folder_has_every_cell(run, cell):
    run("new", "rb5", "--out", cell.parent / "painter", "--json")
    found = json.loads(run("status", cell.parent, "--json").stdout)["cells"]
    assert [one["cell"] for one in found] == [str(cell.parent / "painter"), str(cell)]
    assert "painter" in run("status", cell.parent).stdout


def test_events_are_recorded(run, cell):
    recorded = run("event", cell, "mastering", "--date", "2026-01-10", "--note", "joint 3", "--json")
    assert json.loads(recorded.stdout) == {
        "day": "2026-01-10",
        "kind": "mastering",
        "note": "joint 3",
        "person": "",
        "model": "",
    }
    assert json.loads(run("status", cell, "--json").stdout)["events"] == [json.loads(recorded.stdout)]


def test_a_packed_cell_is_unpacked(run, cell, tmp_path):
    packed = json.loads(run("pack", cell, "--out", tmp_path / "cell.zip", "--json").stdout)
    assert packed["files"] == 1
    other = run("unpack", tmp_path / "cell.zip", "--out", tmp_path / "other", "--json")
    assert json.loads(other.stdout)["cell"] == str(tmp_path / "other")


def test_what_is_not_there_is_refused(refuses, cell, tmp_path):
    refuses("status", tmp_path / "nothing", error=PlanningError)
    refuses("use", cell, "a", error=ModelError, option="model", value="a")
    refuses(
        "session", cell, "a", "--set-aside", "wrong tool", error=MeasurementError, option="session", value="a"
    )
    refuses("event", cell, "earthquake", error=MeasurementError, option="event", value="earthquake")
    refuses("event", cell, "tool", "--date", "10.1.2026", error=MeasurementError, option="--date")
    refuses("event", cell, "accepted", error=MeasurementError, option="--by")


def test_an_export_that_was_put_into_the_folder_is_imported_once(run, refuses, cell):
    path = cell / "sessions" / "kuka.csv"
    shutil.copyfile(Path(__file__).parents[1] / "measurement" / "foreign" / "exports" / "kuka.csv", path)
    refuses("calibrate", cell, error=MeasurementError, file="kuka.csv")
    status = json.loads(run("status", cell, "--json").stdout)
    assert (status["next"]["state"], status["not_taken_in"]) == ("file_refused", ["kuka.csv"])
    words = status["next"]["command"].split()[1:]
    assert words == ["import", str(path), "--cell", str(cell)]
    taken = json.loads(run(*words, "--yes", "--accept-implausible", "--json", "--date", day(3)).stdout)
    assert (taken["session"], taken["rows"]) == (day(3), 6)
    status = json.loads(run("status", cell, "--json").stdout)
    aside = {one["name"]: bool(one["set_aside"]) for one in status["sessions"]}
    assert (status["not_taken_in"], aside) == ([], {"kuka": True, day(3): False})
    assert path.exists()


def rows_file(folder, name, *arguments, **options):
    measured(*arguments, **options).write_csv(folder / f"{name}.csv", ROBOT)
    return folder / f"{name}.csv"


@pytest.fixture(scope="module")
def used(run, tmp_path_factory):
    """A cell that was measured, calibrated, verified, monitored and recalibrated; what the commands printed as JSON."""
    folder = tmp_path_factory.mktemp("used")
    cell, printed = folder / "cell", {}

    def step(name, *arguments, status=0):
        result = run(*arguments, "--json")
        assert result.exit_code == status, result.output
        printed[name] = json.loads(result.stdout)
        return result

    step("new", "new", "ur10", "--out", cell, "--limit-mm", 0.5)
    step("plan", "plan", cell, "--count", 12, "--check", 2, "--set", "candidates=200")
    step("import", "import", rows_file(folder, day(60), 60, 1), "--cell", cell)
    step("calibrate", "calibrate", cell, "--folds", 0)
    step("import 2", "import", rows_file(folder, "later", 12, 2), "--cell", cell, "--date", day(30))
    step("verify", "verify", cell)
    step("import 3", "import", rows_file(folder, day(2), 12, 3, zero=0.08), "--cell", cell)
    step("monitor", "monitor", cell, status=3)
    step("recalibrate", "recalibrate", cell)
    return cell, printed


def test_every_step_names_the_next(used):
    _, printed = used
    states = {name: one["next"]["state"] for name, one in printed.items() if "next" in one}
    assert states == {
        "new": "no_plan",
        "plan": "not_measured",
        "import": "not_calibrated",
        "calibrate": "not_verified",
        "import 2": "not_verified",
        "verify": "up_to_date",
        "import 3": "session_not_judged",
        "monitor": "moved",
        "recalibrate": "up_to_date",
    }
    assert printed["verify"]["in_use"] == printed["calibrate"]["model"].rpartition("/")[2]
    assert [one["what"] for one in printed["monitor"]["sessions"][-1]["moved"]] == ["joint 3"]


def test_commands_on_models_take_the_one_in_use(run, used, tmp_path):
    cell, printed = used
    folder = printed["recalibrate"]["model"]
    for command in (("ik", "--pose", 700, 200, 500, 0, 0, 180), ("report", "--out", tmp_path / "page.html")):
        of_cell, of_model = (
            json.loads(run(command[0], of, *command[1:], "--json").stdout) for of in (cell, folder)
        )
        for one in (of_cell, of_model):
            one.pop("seconds", None)
        of_cell.pop("acceptance", None)  # see test_report_of_a_cell
        assert of_cell == of_model
    exported = run("export", cell, "--format", "urdf", "--json")
    assert exported.exit_code == 0, exported.output
    file = Path(json.loads(exported.stdout)["file"])
    assert (file.parent, file.suffix) == (cell / "exports", ".urdf")
    assert file.is_file()


def test_status_shows_sessions_and_the_model_in_use(run, used):
    cell, printed = used
    status = json.loads(run("status", cell, "--json").stdout)
    assert status["model"] == printed["recalibrate"]["model"].rpartition("/")[2]
    assert [one["rows"] for one in status["sessions"]] == [60, 12, 12]
    assert status["next"]["state"] == "up_to_date"  # held-out rows confirm the limit


def test_an_option_overrides_the_file_with_a_message(run, used):
    cell, _ = used
    path = cell / "cell.yaml"
    text = path.read_text()
    path.write_text(text.replace("  # count: 40", "  count: 30\n  candidates: 150"))
    try:
        result = run("plan", cell, "--count", 5, "--check", 0, "--set", "candidates=100", "--json")
        assert json.loads(result.stdout)["poses"] == 5
        assert {"count", "candidates"} <= set(result.stderr.split())
    finally:
        path.write_text(text)


@pytest.mark.parametrize(
    "arguments",
    [
        ("calibrate", "{cell}", "rows.csv"),
        ("calibrate", "{cell}", "--out", "model"),
        ("calibrate", "ur10"),
        ("calibrate", "ur10", "rows.csv"),
        ("plan", "{cell}", "--out", "plan.csv"),
        ("plan", "ur10"),
        ("verify", "{cell}", "rows.csv"),
        ("verify", "model"),
        ("monitor", "{cell}", "rows.csv"),
        ("monitor", "model"),
        ("recalibrate", "{cell}", "rows.csv"),
        ("recalibrate", "model", "--dry-run"),
        ("import", "rows.csv"),
        ("import", "rows.csv", "--out", "rows2.csv", "--cell", "{cell}"),
    ],
)
def test_only_missing_settings_of_a_cell_are_stated(run, cell, arguments):
    result = run(*(str(one).format(cell=cell) for one in arguments))
    assert result.exit_code == 2
    assert result.stdout == ""


def test_a_cell_is_evaluated_compared_and_measured(run, used, tmp_path):
    cell, printed = used
    path = cell / "cell.yaml"
    path.write_text(
        path.read_text()
        .replace("  # level: 0.01", "  level: 0.02")
        .replace("  # replan: true", "  replan: false")
    )
    compared = json.loads(run("compare", cell, "--json").stdout)
    assert compared["level"] == 0.02
    assert [one["name"] for one in compared["models"]] == [
        printed[name]["model"].rpartition("/")[2] for name in ("calibrate", "recalibrate")
    ]
    session = rows_file(tmp_path, day(0), 12, 4, zero=0.08)
    assert run("import", session, "--cell", cell, "--json").exit_code == 0
    evaluated = json.loads(run("evaluate", cell, "--json").stdout)
    assert evaluated["rows"] == 12
    assert evaluated["model"].endswith(printed["recalibrate"]["model"].rpartition("/")[2])
    run("session", cell, day(0), "--set-aside", "a trial", "--json")
    plan = max((cell / "plans").glob("*.csv"), key=lambda path: path.stat().st_mtime)
    measured(4, 5).write_csv(tmp_path / "rows.csv", ROBOT)
    of_plan, of_cell = (
        run("measure", one, "--rows", tmp_path / "rows.csv", *stated, "--once", "--json")
        for one, stated in ((plan, ("--set", "replan=false", "--limit-mm", 0.5)), (cell, ()))
    )
    assert of_cell.exit_code == of_plan.exit_code
    assert json.loads(of_cell.stdout) == json.loads(of_plan.stdout)


def test_a_model_is_verified_and_put_into_use_by_name(run, used):
    cell, printed = used
    first, second = (printed[name]["model"].rpartition("/")[2] for name in ("calibrate", "recalibrate"))
    verified = run("verify", cell, "--model", first, "--json")
    assert json.loads(verified.stdout)["model"].endswith(first)
    changed = json.loads(run("use", cell, first, "--reason", "a trial", "--json").stdout)
    assert changed == {"model": first, "before": second, "warnings": []}
    undone = json.loads(run("use", cell, "--undo", "--json").stdout)
    assert undone == {"model": second, "before": first, "warnings": []}
    assert json.loads(run("use", cell, "--undo", "--reason", "a trial", "--json").stdout)["model"] == first
    assert json.loads(run("use", cell, "--undo", "--json").stdout)["model"] is None
    assert run("use", cell, "--undo").exit_code == run("use", cell).exit_code == 2
    run("use", cell, second, "--json")


def test_what_is_active_on_the_controller_is_recorded(run, refuses, used, tmp_path):
    cell, _ = used
    file = tmp_path / "dh.csv"
    exported = run("export", cell, "--format", "dh", "--out", file, "--json")
    assert json.loads(exported.stdout)["file"] == str(file)
    recorded = json.loads(
        run("event", cell, "controller", "--export", file, "--note", "slow", "--json").stdout
    )
    (active,) = recorded["active"]
    assert (recorded["day"], recorded["note"], active["file"]) == (day(0), "slow", "dh.csv")
    assert "dh.csv" in run("status", cell).stdout
    assert "dh.csv" in run("ik", cell, "--pose", 700, 200, 500, 0, 0, 180).stderr
    out = tmp_path / "offsets.csv"
    refuses("export", cell, "--format", "offsets", "--out", out, error=ModelError, file=cell)
    assert not out.exists()
    assert json.loads(run("event", cell, "controller", "--export", "none", "--json").stdout)["active"] == []
    for arguments in (
        ("controller",),
        ("tool", "--export", file),
        ("controller", "--export", file, "--by", "Ada"),
    ):
        assert run("event", cell, *arguments).exit_code == 2


CELL_COMMANDS = {
    "new": (),  # refuses a folder that is not empty
    "unpack": (),
    "status": ("{cell}",),
    "plan": ("{cell}", "--count", 4, "--check", 0, "--set", "candidates=100"),
    "measure": ("{cell}", "--rows", "{rows}", "--set", "replan=false", "--once"),
    "import": ("{more}", "--cell", "{cell}", "--date", day(1)),
    "calibrate": ("{cell}", "--folds", 0, "--model", "geometric"),
    "verify": ("{cell}",),
    "monitor": ("{cell}",),
    "evaluate": ("{cell}",),
    "recalibrate": ("{cell}",),
    "compare": ("{cell}",),
    "report": ("{cell}", "--out", "{out}/page.html"),
    "ik": ("{cell}", "--pose", 700, 200, 500, 0, 0, 180),
    "export": ("{cell}", "--format", "dh", "--out", "{out}/dh.csv"),
    "event": ("{cell}", "firmware"),
    "use": ("{cell}", "--undo"),
    "session": ("{cell}", day(30), "--set-aside", "a trial"),
    "upgrade": ("{cell}",),
    "pack": ("{cell}", "--out", "{out}/cell.zip"),
}
"""Arguments of every command that takes a cell; `serve`, `open` and `distill` only read it."""


def held(cell):
    """Hashes of all files of a cell except its settings and history, and all rows of its history."""
    files = {
        path.relative_to(cell): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in cell.rglob("*")
        if path.is_file() and path.name not in ("cell.yaml", HISTORY)
    }
    history, rows = History(cell / HISTORY), set[object]()
    for kind in TABLES:
        rows.update(
            (replace(one, set_aside="") if kind is SessionEntry else one)
            for one in history.database.read(kind)
        )
    return files, rows


def test_no_command_loses_anything(run, used, tmp_path):
    takes_cell = {
        name
        for name, command in get_command(app).commands.items()
        for one in getattr(command, "params", ())
        if "CELL" in str(one.metavar or one.name) or (one.name == "cell" and name != "plan")
    }
    assert takes_cell - {"serve", "open", "distill"} - set(CELL_COMMANDS) == set()
    cell = tmp_path / "cell"
    shutil.copytree(used[0], cell)
    names = {
        "cell": cell,
        "out": tmp_path,
        "rows": rows_file(tmp_path, "rows", 4, 5),
        "more": rows_file(tmp_path, "more", 12, 8, zero=0.08),
    }
    for name, arguments in CELL_COMMANDS.items():
        files, rows = held(cell)
        if arguments:
            words = [one.format(**names) if isinstance(one, str) else one for one in arguments]
            result = run(name, *words, "--json")
            assert result.exit_code in (0, 3), (name, result.output)
        after_files, after_rows = held(cell)
        assert files.items() <= after_files.items(), name
        assert rows <= after_rows, name
    again = tmp_path / "again"
    assert run("unpack", tmp_path / "cell.zip", "--out", again, "--json").exit_code == 0
    assert held(again) == held(cell)


def test_status_is_printed_again_until_it_is_interrupted(run, cell, monkeypatch):
    waited = []

    def sleep(seconds):
        waited.append(seconds)
        if len(waited) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("pisigma.cli.cell.time", SimpleNamespace(sleep=sleep))
    result = run("status", cell, "--watch", 5)
    assert waited == [5.0, 5.0]
    assert result.stdout.count("pisigma plan") == 2
