"""`cell.yaml`: made of the settings, read into the settings, and with file, line and key in every complaint."""

import re

import pytest
from testing.refusals import refused

from pisigma.files.errors import PisigmaError, PlanningError, SettingError
from pisigma.files.setting import flat_settings
from pisigma.lifetime.cell.layout import CELL_FILE
from pisigma.workflow.cell.cell_file import (
    CAMERA_KEYS,
    STATED_ABOVE,
    STEPS,
    CellFile,
    cell_template,
)
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings


def cell_file(folder, text):
    (folder / CELL_FILE).write_text(text)
    return CellFile.read(folder)


def test_a_new_file_states_every_setting_as_a_comment_and_gives_the_defaults(tmp_path):
    text = cell_template({"robot": "ur10", "sensor": "tracker", "limit_mm": 0.3})
    file = cell_file(tmp_path, text)
    assert file.document.robot == "ur10"
    for step, group in STEPS.items():
        section = text.partition(f"\n{step}:")[2].partition("\n\n")[0]
        for setting in flat_settings(group):
            if setting.key not in (*CAMERA_KEYS, *STATED_ABOVE.get(step, ())):
                assert f"\n  # {setting.key}:" in section, (step, setting.key)
    assert file.settings_of_step("calibrate") == CalibrationSettings()
    assert file.settings_of_step("recalibrate") == RecalibrationSettings()


def test_values_have_the_units_and_forms_of_the_command_line(tmp_path):
    file = cell_file(
        tmp_path,
        "robot: ur10\ncalibrate:\n  prior_mm: 2\n  free: a_2,theta_3\n  socket_distance: A,B,50\n  gravity: 0,0,-1\n",
    )
    settings = file.settings_of_step("calibrate")
    assert settings.prior_length == pytest.approx(2e-3)
    assert settings.free == ("a_2", "theta_3")
    assert settings.socket_distances == {("A", "B"): 0.05}
    assert settings.gravity == (0, 0, -1)


def test_a_common_setting_applies_to_all_steps_unless_a_step_overrides_it(tmp_path):
    file = cell_file(tmp_path, "robot: ur10\nlimit_mm: 0.3\nplan:\n  limit_mm: 0.5\n")
    assert file.settings_of_step("plan").limit_mm == 0.5
    assert file.settings_of_step("measure").limit_mm == 0.3
    assert file.settings_of_step("plan", limit_mm=0.4).limit_mm == 0.4
    assert cell_file(tmp_path, "robot: ur10\nlimit_mm: 0.3\n").settings_of_step("plan").limit_mm == 0.3


def test_the_defaults_of_a_new_file_are_those_of_the_settings(tmp_path):
    """Every line of a setting with a default, without its #, is read as this default."""
    text = re.sub(r"^  # (\w+: \S+)$", r"  \1", cell_template({"robot": "ur10"}), flags=re.M)
    file = cell_file(tmp_path, text)
    for step, group in STEPS.items():
        above = (*CAMERA_KEYS, *STATED_ABOVE.get(step, ()))
        defaults = {
            one.key: one.default
            for one in flat_settings(group)
            if one.default not in (None, "") and one.key not in above
        }
        stated = file.stated_values(step)
        assert defaults.items() <= stated.items(), step


def test_the_limit_of_95_percent_is_not_taken_for_one_of_the_rms(tmp_path):
    assert cell_file(tmp_path, "robot: ur10\nlimit_mm: 0.3\n").settings_of_step("monitor").limit_mm is None


def test_a_camera_is_stated_once_with_paths_inside_the_cell(tmp_path):
    for name in ("camera.yaml", "board.yaml"):
        (tmp_path / name).write_text("")
    text = "robot: ur10\ncamera:\n  camera: [camera.yaml]\n  board: [board.yaml]\n  fixed_camera: true\n"
    file = cell_file(tmp_path, text)
    for step in ("calibrate", "verify", "monitor", "recalibrate", "compare", "evaluate"):
        cameras = file.settings_of_step(step).cameras
        assert cameras.cameras == (str(tmp_path / "camera.yaml"),)
        assert cameras.is_fixed
        assert file.settings_of_step(
            step, repeatability_mm=0.05
        ).cameras.repeatability.length == pytest.approx(5e-5)


@pytest.mark.parametrize(
    ("text", "error", "fields"),
    [
        ("robot: ur10\ncalibrate:\n  fold: 3\n", SettingError, {"line": 3, "column": "calibrate.fold"}),
        (
            "robot: ur10\ncalibrate:\n  folds: x\n",
            SettingError,
            {"line": 3, "column": "calibrate.folds", "value": "x"},
        ),
        ("robot: ur10\nimport:\n  wuthin: 3\n", SettingError, {"line": 3, "column": "import.wuthin"}),
        (
            "robot: ur10\nplan:\n  count: 1.5\n",
            SettingError,
            {"line": 3, "column": "plan.count", "value": 1.5},
        ),
        ("robot: ur10\nplan:\n  task: ../secret.csv\n", PlanningError, {"value": "../secret.csv"}),
        ("robot: ur10\nimport:\n  decimal: dot\n", SettingError, {"line": 3, "expected": "point or comma"}),
        ("robot: ur10\ncalibrate:\n  folds: -1\n", SettingError, {"line": 3, "value": -1}),
        ("robot: ur10\nplan:\n  box: 1,1,1,0,0,0\n", PlanningError, {"line": 3, "option": "box"}),
        (
            "robot: ur10\nverify:\n  fit_frame: maybe\n",
            SettingError,
            {"line": 3, "expected": "true or false"},
        ),
    ],
)
def test_a_fault_is_refused_with_its_line_and_key(tmp_path, text, error, fields):
    with refused(error, file=CELL_FILE, **fields):
        cell_file(tmp_path, text).settings_of_step("plan")


@pytest.mark.parametrize(
    "text", ["robot: ur10\nsensor: radar\n", "robots: ur10\n", "robot: ur10\nlimit_mm: -1\n"]
)
def test_a_document_that_is_not_one_is_refused(tmp_path, text):
    with pytest.raises(PlanningError):
        cell_file(tmp_path, text)


def test_a_value_that_the_settings_refuse_has_its_place(tmp_path):
    with refused(PisigmaError, file=CELL_FILE, line=4, column="calibrate.seed", value=-1):
        cell_file(tmp_path, "robot: ur10\ncalibrate:\n  folds: 3\n  seed: -1\n")


@pytest.mark.parametrize("robot", ["/etc/arm.urdf", "../arm.yaml", "robot/../../arm.urdf"])
def test_a_robot_outside_the_cell_is_refused(tmp_path, robot):
    file = cell_file(tmp_path, f"robot: {robot}\n")
    with refused(PlanningError, file=CELL_FILE, value=robot):
        _ = file.robot


def test_a_setting_that_needs_another_is_refused_with_its_step(tmp_path):
    with refused(PisigmaError, file=CELL_FILE, option="--board", expected="--camera and --board together"):
        cell_file(tmp_path, "robot: ur10\ncalibrate:\n  camera: [a.yaml]\n")
