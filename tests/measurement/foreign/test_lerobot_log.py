"""Joint values of LeRobot data sets as a file for `pisigma detect --joints`."""

import numpy as np
import pytest
from pyarrow import parquet
from testing.closeness import assert_close
from testing.lerobot_arm import DATA_SETS, MOTORS, RANGES, SO101
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.lerobot_dataset import position_indices_of_motors, read_joint_log
from pisigma.measurement.foreign.lerobot_motors import check_values, motors_text
from pisigma.workflow.images.detect import join_joint_values


def recorded(layout):
    files = sorted((DATA_SETS / layout).glob("data/chunk-*/*.parquet"))
    return np.concatenate([parquet.read_table(f).column("observation.state").to_pylist() for f in files])


@pytest.mark.parametrize("layout", ["v2.1", "v3.0"])
def test_the_joints_of_every_frame_are_found_by_the_name_of_its_image(layout, tmp_path):
    log = read_joint_log(DATA_SETS / layout, "degrees")
    assert log.motors == MOTORS[:5]
    assert log.left_out == ("gripper.pos",)
    log.save(tmp_path / "joints.csv")
    images = [f"episode-{episode:06d}-frame-{frame:06d}" for episode in range(2) for frame in range(6)]
    joined = join_joint_values(images, tmp_path / "joints.csv", max_time_difference=0.2)
    values = np.array([joined.texts_by_image[image] for image in images], dtype=float)
    assert_close(values, recorded(layout)[:, :5] * 4095 / 4096, atol=1e-6)


def test_normalized_values_need_the_calibration_file(tmp_path):
    low, high = np.array(RANGES[:5]).T
    (tmp_path / "arm.json").write_text(motors_text(SO101))
    log = read_joint_log(DATA_SETS / "v3.0", "normalized", tmp_path / "arm.json")
    expected = recorded("v3.0")[:, :5] / 200 * (high - low) * 360 / 4096
    assert_close(np.array([row[2:] for row in log.rows], dtype=float), expected, atol=1e-6)
    with refused(MeasurementError, option="calibration", value="shoulder_pan"):
        read_joint_log(DATA_SETS / "v3.0", "normalized")
    with refused(MeasurementError, option="lerobot_units"):
        read_joint_log(DATA_SETS / "v3.0", None)


@pytest.mark.parametrize(
    ("names", "prefix", "expected"),
    [
        (("a.pos", "a.vel", "b.pos", "gripper.pos"), "", {"a": 0, "b": 2}),
        (("main_a", "main_gripper", "x.vel"), "", {"a": 0}),
        (("left_elbow", "left_elbow_shadow", "left_gripper", "right_elbow"), "left_", {"elbow": 0}),
        (("camera", "b.pos"), "", {"b": 1}),
    ],
)
def test_only_positions_of_joints_are_taken(names, prefix, expected):
    assert position_indices_of_motors(names, prefix) == expected


def test_values_of_two_arms_need_a_prefix():
    with refused(MeasurementError, option="prefix"):
        position_indices_of_motors(("left_a.pos", "right_a.pos"))


def test_values_that_are_not_possible_in_their_units_are_refused():
    names, values = ("elbow_flex",), np.array([[5.0], [-100.5]])
    half = (SO101["elbow_flex"].range_max - SO101["elbow_flex"].range_min) / 2 * 360 / 4095
    check_values(values, "degrees", names, None, "a.parquet")
    check_values(np.array([[half + 5.0]]), "degrees", names, SO101, "a.parquet")
    for recorded, units, motors in (
        (values, "normalized", SO101),
        (np.array([[-half - 15.0]]), "degrees", SO101),
    ):
        with refused(MeasurementError, file="a.parquet", column="elbow_flex"):
            check_values(recorded, units, names, motors, "a.parquet")
