"""Robots of the catalogue that come from URDF files have the poses of these files.

The poses were computed from the files named in `source` by products of the joints' origins and axis rotations alone.
"""

import numpy as np
import pytest
from testing.closeness import assert_close

import pisigma

POSES = {
    "ur3": (
        [0.3, 0.26, 0.22, 0.18, -0.56, -0.6],
        [
            [-0.728916389, 0.211012036, -0.651271694, 0.269114747],
            [-0.684383373, -0.248678838, 0.685403701, 0.273483785],
            [-0.017329058, 0.945321509, 0.325679209, -0.049964795],
        ],
    ),
    "ur3e": (
        [0.3, 0.26, 0.22, 0.18, -0.56, -0.6],
        [
            [-0.728916389, 0.211012036, -0.651271694, 0.256810856],
            [-0.684383373, -0.248678838, 0.685403701, 0.29829803],
            [-0.017329058, 0.94532151, 0.325679209, -0.04664407],
        ],
    ),
    "ur5e": (
        [0.3, 0.26, 0.22, 0.18, -0.56, -0.6],
        [
            [-0.728916389, 0.211012036, -0.651271694, 0.562056552],
            [-0.684383373, -0.248678838, 0.685403701, 0.401728273],
            [-0.017329058, 0.94532151, 0.325679209, -0.174193603],
        ],
    ),
    "xarm7": (
        [0.3, 0.3, 0.3, 0.3, -0.4, -0.4, -0.4],
        [
            [0.157757065, 0.970900106, 0.180182384, 0.2327538],
            [0.891149659, -0.218583648, 0.397584551, 0.219220552],
            [0.425399805, 0.097847698, -0.899700413, 0.137308212],
        ],
    ),
}


@pytest.mark.parametrize("name", POSES)
def test_tool_poses_are_those_of_the_urdf_file(name):
    q, T = POSES[name]
    tolerance = 2e-5 if name == "xarm7" else 3e-9  # the file of xarm7 writes 1.5708 for right angles
    assert_close(pisigma.forward_kinematics(pisigma.Robot.load(name), q)[:3], np.array(T), atol=tolerance)
