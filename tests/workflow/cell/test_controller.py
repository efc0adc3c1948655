"""Exports that are active on the controller: every command of a cell follows the table of rules."""

import json
import struct

import pytest
from testing.cell_rows import ROBOT, day, measured
from testing.refusals import refused

import pisigma
from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.serve.binary_frames import ANSWER, BinaryFrames, Refusal
from pisigma.deployment.serve.json_lines import JsonLines
from pisigma.deployment.serve.metrics import Metrics
from pisigma.deployment.serve.models import ServedModels
from pisigma.files.errors import MeasurementError, ModelError
from pisigma.lifetime.cell import controller
from pisigma.lifetime.cell.controller import RULES, checked_model_folder, model_in_use_warnings
from pisigma.workflow.cell.exports import export_from_cell, record_active_export

pytestmark = pytest.mark.usefixtures("quick_pictures")

REACHABLE = "x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n700,200,500,0,0,180\n"
ZERO = 0.08
"""Change of the zero of the third joint [deg]."""


def exported(cell, tmp_path, form, **options):
    suffixes = {"urdf": ".urdf", "dh": ".csv", "offsets": ".csv", "targets": ".script"}
    (tmp_path / "poses.csv").write_text(REACHABLE)
    poses = {"poses": tmp_path / "poses.csv"} if form == "targets" else {}
    request = ExportRequest(cell.folder, tmp_path / f"exported{suffixes[form]}", **poses, **options)
    return export_from_cell(cell, form, request)


COMMANDS = {
    "serve": lambda cell, folder: ServedModels(cell=cell.folder),
    "load": lambda cell, folder: pisigma.load(cell.folder),
    "ik": lambda cell, folder: checked_model_folder(cell.folder, "ik"),
    "export joint_values": lambda cell, folder: exported(cell, folder, "targets"),
    "export poses": lambda cell, folder: exported(cell, folder, "targets", targets="cartesian"),
    "export description": lambda cell, folder: exported(cell, folder, "urdf"),
    "export kinematics": lambda cell, folder: exported(cell, folder, "dh"),
    "export joint_zeros": lambda cell, folder: exported(cell, folder, "offsets"),
    "verify": lambda cell, folder: cell.verify(),
    "evaluate": lambda cell, folder: cell.evaluate(),
    "measure": lambda cell, folder: model_in_use_warnings(cell.folder, "measure"),
    "import": lambda cell, folder: cell.add_session(measured(6, 9), day=day(0)),
    "monitor": lambda cell, folder: cell.monitor(),
    "recalibrate": lambda cell, folder: cell.recalibrate(),
    "use": lambda cell, folder: cell.use(cell.history.models()[0].name, ""),
    "calibrate": lambda cell, folder: cell.calibrate(),
}


def test_every_command_of_the_table_is_called():
    assert set(COMMANDS) == set(RULES)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_checks_the_table_first(command, cell, used, tmp_path, monkeypatch):
    record_active_export(cell, used.folder.parent / "dh.csv", day(0))
    monkeypatch.setattr(
        controller, "RULES", dict.fromkeys(RULES, ("allow",) * 3) | {command: ("refuse",) * 3}
    )
    before = (
        cell.history.model_in_use_changes(),
        cell.history.sessions(),
        cell.history.models(),
        cell.history.exports(),
    )
    with refused(ModelError, file=cell.folder):
        COMMANDS[command](cell, tmp_path)
    after = (
        cell.history.model_in_use_changes(),
        cell.history.sessions(),
        cell.history.models(),
        cell.history.exports(),
    )
    assert after == before
    assert not list(tmp_path.glob("exported*"))


def test_kinematics_leave_the_sessions_valid_and_are_named_by_the_status(cell, used):
    record_active_export(cell, used.folder.parent / "dh.csv", day(0), "at low speed")
    status = cell.status()
    assert status.step.state == used.status().step.state
    (active,) = status.to_json()["controller"]
    model = cell.history.in_use.name
    assert [active[key] for key in ("contains", "format", "file", "model", "since")] == [
        "kinematics",
        "dh",
        "dh.csv",
        model,
        day(0),
    ]
    assert any("dh.csv" in one for one in pisigma.load(cell.folder).warnings)
    record_active_export(cell, "none")
    assert cell.status().to_json()["controller"] == []


def test_joint_zeros_ask_for_a_model_that_was_measured_with_them(cell, used):
    old = cell.history.in_use
    followed, served = pisigma.load(cell.folder), ServedModels(cell=cell.folder)
    record_active_export(cell, used.folder.parent / "offsets.csv", day(10))
    followed._in_use.load_if_changed()
    (sentence,) = served.reload()
    assert "offsets.csv" in sentence
    assert served.is_use_forbidden
    line = JsonLines(served, Metrics()).answer_message(b'{"ask": "models", "model": 0}')
    assert "error" not in json.loads(line)
    assert (
        "offsets.csv"
        in json.loads(JsonLines(served, Metrics()).answer_message(b'{"pose": [1, 2, 3, 0, 0, 0]}'))["error"]
    )
    frame = struct.pack("<4sIQII16d8d", b"PSI1", 216, 7, 0, 0, *[0.0] * 24)
    assert ANSWER.unpack(BinaryFrames(served, Metrics()).answer_message(frame))[2:4] == (
        7,
        Refusal.MODEL_REFUSED,
    )
    for use in (lambda: followed.name, lambda: pisigma.load(cell.folder), cell.verify):
        with refused(ModelError, file=cell.folder):
            use()
    assert cell.status().step.state == "no_plan"
    with refused(MeasurementError):
        cell.calibrate()

    session = cell.add_session(measured(14, 3, zero=ZERO), day=day(5))
    assert (session.judged_by, "offsets.csv" in session.remark) == ("robot", True)
    assert [len(one["controller"]) for one in cell.status().to_json()["sessions"]] == [0, 0, 1]
    assert "offsets.csv" in cell.monitor().warnings[0]
    assert (cell.status().step.state, cell.status().step.automatic_command) == (
        "other_joint_zeros",
        "recalibrate",
    )
    result, entry = cell.recalibrate()
    assert "offsets.csv" in result.warnings[0]
    assert "offsets.csv" in (cell.model_folder(entry.name) / "README.md").read_text()
    assert served.reload() == []
    followed._in_use.load_if_changed()
    assert served.find_model(None).name == followed.name == entry.name

    record_active_export(cell, "none", day(1))
    with refused(ModelError, file=cell.folder):
        pisigma.load(cell.folder)
    assert cell.status().step.command.split()[1:] == ["use", str(cell.folder), old.name]
    assert cell.use(None, "the zeros were removed") == ()
    assert pisigma.load(cell.folder).name == old.name
    assert cell.use(entry.name, "back") != ()


def test_a_calibration_with_joint_zeros_states_that_it_needs_them(cell, used):
    record_active_export(cell, used.folder.parent / "offsets.csv", day(10))
    cell.add_session(measured(30, 4, zero=ZERO), day=day(5))
    result, entry = cell.calibrate(model="geometric", folds=0)
    assert "offsets.csv" in result.warnings[0]
    assert entry.sessions == day(5)


def test_rows_before_and_after_a_change_of_the_joint_zeros_are_not_one_session(cell, used, tmp_path):
    rows = measured(10, 5)
    record_active_export(cell, used.folder.parent / "offsets.csv", day(3))
    dates = tuple(day(4) if row < 5 else day(2) for row in range(10))
    cell.add_session(pisigma.Measurements(q=rows.q, position=rows.position, date=dates))
    with refused(MeasurementError, value="controller"):
        cell.sessions.rows_of_file(cell.history.sessions()[-1])


def test_a_file_that_was_edited_is_not_known(cell, used, tmp_path):
    text = (used.folder.parent / "dh.csv").read_text()
    (tmp_path / "dh.csv").write_text(text + "\n")
    for file in (tmp_path / "dh.csv", tmp_path / "missing.csv"):
        with refused(MeasurementError, option="--export"):
            record_active_export(cell, file)
    assert ROBOT.name == cell.robot.name
