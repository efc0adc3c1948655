"""Robots of the catalogue have the poses of the URDF files and other descriptions that their `source` names.

`POSES` were computed from the files by products of the joints' origins and axis rotations alone; of the others
`published_joints.yaml` has the origins and axes themselves.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
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


PUBLISHED = yaml.safe_load((Path(__file__).parent / "published_joints.yaml").read_text())
AS_IN_LEROBOT = {"so100": ([-1, 1, 1, 1, 1], np.deg2rad([0, 100.2676, -89.99965, -37.24225, 0]))}
"""Directions, and joint values of the description [rad] where the catalogue's are 0."""
ROUNDED = 3e-5
"""Deviation [m, and of rotation matrices] that right angles written with five digits cause."""


def random_joint_values(name, count=20):
    low, high = pisigma.Robot.load(name).limits.T
    return np.random.default_rng(0).uniform(low, high, (count, len(low)))


def published_values(name, q):
    """Return the joint values of the description."""
    directions, middle = AS_IN_LEROBOT.get(name, (1, 0))
    return q * directions + middle


def published_pose(joints, q):
    """Multiply the published origins and the rotations about the published axes (scipy)."""
    T = np.eye(4)
    for index, joint in enumerate(joints):
        here = np.eye(4)
        here[:3, :3], here[:3, 3] = Rotation.from_euler("xyz", joint["rpy"]).as_matrix(), joint["xyz"]
        T = T @ here
        if "axis" in joint:
            T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(q[index] * np.array(joint["axis"])).as_matrix()
    return T


@pytest.mark.parametrize("name", PUBLISHED)
def test_arms_have_the_poses_of_their_published_descriptions(name):
    q = random_joint_values(name)
    poses = np.array([published_pose(PUBLISHED[name], values) for values in published_values(name, q)])
    assert_close(pisigma.forward_kinematics(pisigma.Robot.load(name), q)[:, :3], poses[:, :3], atol=ROUNDED)


def test_joints_of_an_so100_turn_about_the_axes_of_an_so101():
    """LeRobot drives both alike; they look along other axes of their bases, and their ranges differ by some degrees."""
    axes = []
    for name in ("so100", "so101"):
        robot = pisigma.Robot.load(name)
        T = pisigma.forward_kinematics(robot, np.vstack([np.zeros(5), 1e-4 * np.eye(5)]))
        ahead = Rotation.from_euler("z", -np.arctan2(T[0, 1, 3], T[0, 0, 3])).as_matrix()
        turned = T[1:, :3, :3] @ T[0, :3, :3].T
        axes.append(Rotation.from_matrix(turned).as_rotvec() @ ahead.T / 1e-4)
    assert_close(axes[0], axes[1], atol=0.15)


def published_urdf(name, joints):
    """Write the published joints as a URDF file whose last link is `tip`."""
    links, text = (
        ["root", *(f"link{index}" for index in range(1, len(joints))), "tip"],
        f'<robot name="{name}">',
    )
    text += "".join(f'<link name="{link}"/>' for link in links)
    for index, joint in enumerate(joints):
        origin = " ".join(f'{key}="{" ".join(map(str, joint[key]))}"' for key in ("xyz", "rpy"))
        kind = "revolute" if "axis" in joint else "fixed"
        axis = f'<axis xyz="{" ".join(map(str, joint["axis"]))}"/>' if "axis" in joint else ""
        limit = '<limit lower="-7" upper="7" effort="1" velocity="1"/>' if "axis" in joint else ""
        text += (
            f'<joint name="joint{index}" type="{kind}"><parent link="{links[index]}"/>'
            f'<child link="{links[index + 1]}"/><origin {origin}/>{axis}{limit}</joint>'
        )
    return text + "</robot>"


def test_pinocchio_computes_the_poses_of_the_published_descriptions(tmp_path, repository):
    """It runs in the interpreter of PISIGMA_PEERS, as in `test_urdf_peers`."""
    python = os.environ.get("PISIGMA_PEERS", sys.executable)
    if subprocess.run([python, "-c", "import pinocchio"], capture_output=True, check=False).returncode:
        pytest.skip(f"pinocchio is not installed for {python}; name a Python that has it in PISIGMA_PEERS")
    requests = []
    for name, joints in PUBLISHED.items():
        path = tmp_path / f"{name}.urdf"
        path.write_text(published_urdf(name, joints))
        requests.append(
            {
                "file": str(path),
                "base": "root",
                "tool": "tip",
                "q": published_values(name, random_joint_values(name)).tolist(),
            }
        )
    script = str(repository / "benchmarks" / "urdf_peers.py")
    run = subprocess.run(
        [python, script, "pinocchio"], input=json.dumps(requests), capture_output=True, text=True, check=True
    )
    for name, answer in zip(PUBLISHED, json.loads(run.stdout), strict=True):
        poses = pisigma.forward_kinematics(pisigma.Robot.load(name), random_joint_values(name))
        assert_close(poses[:, :3], np.array(answer["poses"])[:, :3], atol=ROUNDED)
