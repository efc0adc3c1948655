"""Robot files in the modified convention."""

import numpy as np
from testing.closeness import assert_close
from testing.coupled import coupled_robot
from testing.refusals import refused

import pisigma
from pisigma.files.errors import RobotError
from pisigma.robot.urdf_frames import frame_of, rotation, translation

MODIFIED = """\
name: modified
maker: nobody
source: made up
convention: modified
rows:
  - {name: theta_1, type: revolute, theta_deg: 10, d_mm: 300, a_mm: 20, alpha_deg: 15}
  - {name: theta_2, type: revolute, theta_deg: -90, d_mm: 5, a_mm: 150, alpha_deg: -90}
  - {name: d_3, type: prismatic, theta_deg: 20, d_mm: 50, a_mm: 400, alpha_deg: 30}
  - {name: flange, type: fixed, d_mm: 7, a_mm: 3, alpha_deg: -40}
base: {x_mm: 100, pitch_deg: 20}
tool: {z_mm: 50, yaw_deg: 5}
"""


def test_rows_are_converted_exactly():
    robot, q = coupled_robot(MODIFIED), (0.3, -0.7, 0.2)
    T = frame_of(np.array([0.1, 0, 0, 0, np.deg2rad(20), 0]))
    for alpha, a, theta, d in (
        (15, 0.02, np.deg2rad(10) + q[0], 0.3),
        (-90, 0.15, np.deg2rad(-90) + q[1], 0.005),
        (30, 0.4, np.deg2rad(20), 0.05 + q[2]),
        (-40, 0.003, 0.0, 0.007),
    ):
        T = (
            T
            @ rotation(0, np.deg2rad(alpha))
            @ translation(a, 0.0, 0.0)
            @ rotation(2, theta)
            @ translation(0.0, 0.0, d)
        )
    T = T @ frame_of(np.array([0, 0, 0.05, 0, 0, np.deg2rad(5)]))
    assert_close(pisigma.forward_kinematics(robot, q), T, atol=1e-15)


def test_a_beta_is_rejected():
    with refused(RobotError, file="robot.yaml", value=1.0):
        coupled_robot(MODIFIED.replace("d_mm: 5, ", "d_mm: 5, beta_deg: 1, "))
