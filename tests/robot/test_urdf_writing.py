"""Robots are written as URDF with names, limits and directions, unless the format cannot express them."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from lxml import etree
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import OutputError
from pisigma.robot import Robot, Row
from pisigma.robot.urdf_frames import frame_of, inverse, rotation, row_frame, xyz_zyx_of
from pisigma.robot.writing import robot_to_urdf

ROWS = (
    Row("base_joint", "revolute", -1),
    Row("bracket", "fixed"),
    Row("d <2> & \"3\"", "prismatic", 1, -0.1, 1 / 3),
    Row("last", "revolute", 1, -1.0, 2.0),
)  # fmt: skip


def arm(rows: tuple[Row, ...] = ROWS) -> Robot:
    dh = np.random.default_rng(0).uniform(-1, 1, (len(rows), 5))
    return Robot("arm", "test", "test", rows, dh, np.linspace(-1, 1, 6), np.linspace(1, -0.5, 6))


def test_links_joints_limits_and_directions():
    root = etree.fromstring(robot_to_urdf(arm()).encode())
    assert root.get("name") == "arm"
    links = [link.get("name") for link in root.iter("link")]
    assert links == ["base_link", "link_0", "link_1", "link_2", "link_3", "link_4", "tool0"]
    joints = list(root.iter("joint"))
    assert [(j.get("name"), j.get("type")) for j in joints] == [
        ("base_joint_", "fixed"),
        ("base_joint", "continuous"),
        ("bracket", "fixed"),
        ('d <2> & "3"', "prismatic"),
        ("last", "revolute"),
        ("tool_joint", "fixed"),
    ]
    assert [(j.find("parent").get("link"), j.find("child").get("link")) for j in joints] == list(
        itertools.pairwise(links)
    )
    assert [axis.get("xyz") for axis in root.iter("axis")] == ["0 0 -1", "0 0 1", "0 0 1"]
    limits = [(limit.get("lower"), limit.get("upper")) for limit in root.iter("limit")]
    assert limits == [("-0.1", repr(1 / 3)), ("-1.0", "2.0")]


def test_joint_names_and_directions_are_restored(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(robot_to_urdf(arm()))
    again = Robot.load(path)
    assert [joint.name for joint in again.joints] == [joint.name for joint in arm().joints]
    assert [joint.direction for joint in again.joints] == [joint.direction for joint in arm().joints]
    assert_close(again.limits, arm().limits, atol=0)


@pytest.mark.parametrize(
    "row",
    [Row("z", "prismatic"), Row("z", "prismatic", 1, 0.0), Row("z", "revolute", 1, -math.inf, 1.0)],
)
def test_limits_that_urdf_cannot_express_are_rejected(row):
    with refused(OutputError, expected="two limits", value="z"):
        robot_to_urdf(arm((*ROWS[:3], row)))


def test_a_calibrated_robot_has_no_far_frames():
    """Axes that are parallel up to 1e-6 rad have common normals hundreds of metres away."""
    nominal = Robot.load("ur10")
    dh = nominal.dh.copy()
    dh[1, 3:] += 1e-6
    root = etree.fromstring(robot_to_urdf(dataclasses.replace(nominal, dh=dh)).encode())
    numbers = [float(word) for origin in root.iter("origin") for word in origin.get("xyz").split()]
    assert max(map(abs, numbers)) < 0.7


@pytest.mark.parametrize("tilt", [0.0, 1e-16, 1e-14, 1e-12, 1e-9, 1e-7, 1e-3])
@pytest.mark.parametrize("side", [1, -1])
def test_rotations_near_the_singular_pitch_are_exact(tilt, side):
    R = rotation(2, 0.3) @ rotation(1, side * math.pi / 2 + tilt) @ rotation(0, 1.1) @ rotation(2, 1e-9)
    assert_close(frame_of(xyz_zyx_of(R)), R, atol=5e-15)


def test_frames():
    values = np.array([0.1, -0.2, 0.3, 2.0, -1.0, 3.0])
    assert_close(xyz_zyx_of(frame_of(values)), values, atol=1e-15)
    assert_close(inverse(frame_of(values)) @ frame_of(values), np.eye(4), atol=1e-15)
    assert row_frame(0.0, 0.0, 0.0, math.pi / 2, 0.0)[1, 1] == 0.0
    assert_close(
        row_frame(0.3, 0.1, 0.2, 0.4, 0.5)[:3, 3], [0.2 * math.cos(0.3), 0.2 * math.sin(0.3), 0.1], atol=1e-16
    )
