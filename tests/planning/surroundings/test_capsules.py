"""Positions of capsules along the links."""

import itertools
from pathlib import Path

import numpy as np
import torch
from testing.closeness import assert_close

from pisigma.planning.surroundings.capsules import Capsules
from pisigma.robot import Robot
from pisigma.robot.writing import robot_to_yaml

SCARA = """<robot name="scara">
<link name="base"/><link name="one"/><link name="two"/><link name="quill"/><link name="tip"/>
<joint name="J1" type="revolute"><parent link="base"/><child link="one"/><origin xyz="0 0 0.38"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2"/></joint>
<joint name="J2" type="revolute"><parent link="one"/><child link="two"/><origin xyz="0.3 0 0.02"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2"/></joint>
<joint name="J3" type="prismatic"><parent link="two"/><child link="quill"/><origin xyz="0.2 0 0"/><axis xyz="0 0 -1"/>
<limit lower="0" upper="0.2"/></joint>
<joint name="end" type="fixed"><parent link="quill"/><child link="tip"/><origin xyz="0 0 -0.05"/></joint></robot>"""


def test_links_of_a_urdf_file_lead_from_joint_to_joint(tmp_path: Path):
    (tmp_path / "scara.urdf").write_text(SCARA)
    robot = Robot.load(tmp_path / "scara.urdf")
    capsules = Capsules.from_robot(robot, robot.tool[:3], radius=0.04, radii={"J2": 0.03})
    q = torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    joints = [[0, 0, 0], [0, 0, 0.38], [0.3, 0, 0.4], [0.5, 0, 0.4], [0.5, 0, 0.3], [0.5, 0, 0.25]]
    drawn = [torch.tensor(pair, dtype=torch.float64) for pair in itertools.pairwise(joints)]
    assert_close(capsules.segments(q), torch.stack(drawn), atol=1e-12)
    assert capsules.link.tolist() == [1, 1, 2, 3, 3]
    assert capsules.carries_robot.tolist() == [True, False, False, False, False]
    assert_close(capsules.radius, [0.04, 0.04, 0.03, 0.04, 0.04])


def test_links_of_a_dh_table_lead_along_d_and_a():
    capsules = Capsules.from_robot(
        Robot.load("kiro3").with_geometry(tool=np.array([0.0, 0.05, 0.0, 0, 0, 0]))
    )
    q = torch.zeros(2, 4, dtype=torch.float64)
    q[:, 2] = -0.1
    corners = [
        [0, 0, 0],
        [0, 0, 0.5357],
        [0.32, 0, 0.5357],
        [0.32, 0, 0.4467],
        [0.64, 0, 0.4467],
        [0.64, 0, 0.3467],
    ]
    segments = capsules.segments(q)
    assert segments.shape == (2, 6, 2, 3)
    assert_close(
        segments[0, :4, :, [0, 2]][:, 0], torch.tensor(corners, dtype=torch.float64)[:4][:, [0, 2]], atol=1e-3
    )
    assert_close(segments[0, -1, 1], [0.64, 0.05, float(segments[0, -1, 0, 2])], atol=1e-12)
    assert capsules.carries_robot.tolist() == [True, False, False, False, False, False]


def test_a_robot_file_keeps_where_its_joints_are(tmp_path: Path):
    (tmp_path / "scara.urdf").write_text(SCARA)
    robot = Robot.load(tmp_path / "scara.urdf")
    (tmp_path / "scara.yaml").write_text(robot_to_yaml(robot))
    again = Robot.load(tmp_path / "scara.yaml")
    for rows in (robot.rows, again.rows):
        assert_close(
            [row.urdf_origin for row in rows], [[0, 0, 0.38], [0, 0, 0.4], [0.2, 0, 0.4]], atol=1e-15
        )
