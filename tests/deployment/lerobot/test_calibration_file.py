"""LeRobot's calibration file: read and written to the digit, with corrected zeros and ranges within the old ones."""

import json
from pathlib import Path

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.lerobot_arm import MOTORS, ZEROS
from testing.refusals import refused

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import export_model
from pisigma.deployment.lerobot.calibration_file import with_offset, with_offsets
from pisigma.files.errors import MeasurementError, OutputError, Place
from pisigma.measurement.foreign.lerobot_motors import Motor, motors_text, radians_per_unit, read_motors
from pisigma.robot import Robot

MOTOR = Motor(id=1, drive_mode=0, homing_offset=-12, range_min=1000, range_max=3000)


def degrees(motor: Motor, ticks: np.ndarray) -> np.ndarray:
    """Convert positions as LeRobot does."""
    return (ticks - (motor.range_min + motor.range_max) / 2) * 360 / 4095


def test_motors_are_written_as_they_are_read(calibration):
    assert motors_text(read_motors(calibration)) == calibration.read_text()


@pytest.mark.parametrize("offset", [-17.0, -0.05, 0.0, 3.3, 17.0])
def test_degrees_increase_by_the_offset_within_the_old_range(offset):
    ticks = np.linspace(1400, 2600, 5)
    moved = with_offset(MOTOR, offset / 360 * 4096, Place("follower.json"))
    assert_close(
        degrees(moved, ticks) - degrees(MOTOR, ticks), offset * 4096 / 4095, atol=0.25 * 360 / 4095 + 1e-9
    )
    assert MOTOR.range_min <= moved.range_min < moved.range_max <= MOTOR.range_max
    assert moved.homing_offset == MOTOR.homing_offset


def test_an_offset_of_half_the_range_is_refused():
    with refused(OutputError, file="follower.json"):
        with_offset(MOTOR, 1000.0, Place("follower.json"))


def test_export_corrects_the_zeros_and_says_what_is_left_out(model_folder, calibration, tmp_path):
    out = tmp_path / "corrected"
    exported = export_model("lerobot", ExportRequest(model_folder, out, like=calibration))
    assert_close([exported.facts["offsets_deg"][name] for name in MOTORS[:5]], ZEROS, atol=1e-9)
    before, after = read_motors(calibration), read_motors(out / calibration.name)
    assert list(after) == list(before)
    assert after["gripper"] == before["gripper"]
    for name, zero in zip(MOTORS, ZEROS, strict=False):
        moved = degrees(after[name], np.array(2000.0)) - degrees(before[name], np.array(2000.0))
        assert_close(moved, zero * 4096 / 4095, atol=0.25 * 360 / 4095 + 1e-9)
    assert all(sentence in (out / "README.md").read_text() for sentence in exported.remarks)


def test_export_needs_the_file_of_this_arm(model_folder, calibration, tmp_path):
    out = tmp_path / "new"
    with refused(OutputError, option="--like"):
        export_model("lerobot", ExportRequest(model_folder, out))
    document = json.loads(calibration.read_text())
    document["elbow"] = document.pop("elbow_flex")
    calibration.write_text(json.dumps(document))
    with refused(OutputError, option="--like", file="follower.json"):
        export_model("lerobot", ExportRequest(model_folder, out, like=calibration))
    assert not out.exists()


def test_a_file_whose_ranges_the_rows_of_the_model_leave_is_refused(model_folder, calibration, tmp_path):
    document = json.loads(calibration.read_text())
    document["elbow_flex"] |= {"range_min": 1900, "range_max": 2100}
    calibration.write_text(json.dumps(document))
    with refused(OutputError, option="--like", file="follower.json", column="elbow_flex"):
        export_model("lerobot", ExportRequest(model_folder, tmp_path / "new", like=calibration))


def test_zeros_that_are_in_the_motors_are_refused():
    motors = {"joint_1": Motor(1, 0, 0, -90, 90)}
    with refused(OutputError, option="--like", file="openarm.json"):
        with_offsets(motors, {"joint_1": 0.1}, Path("openarm.json"))


def test_degrees_of_servos_have_4095_ticks_per_turn_and_those_of_openarm_are_exact():
    for robot, scale in (("openarm_left", 1.0), ("so101", 4095 / 4096)):
        for axis in Robot.load(robot).axes:
            assert_close(radians_per_unit("degrees", axis.name, None), np.deg2rad(scale), rtol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        {"range_min": 3000.5},
        {"drive_mode": 2},
        {"range_min": 4000},
        {"extra": 1},
        {"homing_offset": True},
        {"id": 6},
    ],
)
def test_wrong_files_are_refused(change, calibration):
    document = json.loads(calibration.read_text())
    document["elbow_flex"] |= change
    calibration.write_text(json.dumps(document))
    with refused(MeasurementError, file="follower.json"):
        read_motors(calibration)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"homing_offset": [0], "motor_names": ["a"]}'])
def test_other_files_are_refused(text, tmp_path):
    (tmp_path / "old.json").write_text(text)
    with refused(MeasurementError, file="old.json"):
        read_motors(tmp_path / "old.json")
