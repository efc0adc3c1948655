"""Chains converted to DH and Hayati rows and back keep their forward kinematics."""

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from testing.closeness import assert_close
from testing.urdf import UrdfJoint, peer_poses, pose_of_chain, urdf_text

from pisigma.robot import Robot, catalogue
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.urdf_rows import NEARLY_PARALLEL
from pisigma.robot.writing import robot_to_urdf

TILTS = (0.0, 1e-9, 1e-7, 1e-5, 1e-3, -1e-3, 0.05, 0.099, 0.101)
QUARTERS = (0.0, math.pi / 2, -math.pi / 2, math.pi, 1.5707963, 1.5708)

lengths = st.one_of(st.just(0.0), st.floats(-1.0, 1.0))
angles = st.one_of(
    st.sampled_from(QUARTERS),
    st.floats(-math.pi, math.pi),
    st.builds(lambda quarter, tilt: quarter + tilt, st.sampled_from(QUARTERS), st.sampled_from(TILTS)),
)
axes = st.one_of(
    st.sampled_from([(0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0.6, 0, 0.8)]),
    st.tuples(*[st.floats(-1, 1)] * 3)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: tuple(np.array(v) / np.linalg.norm(v))),
)
joints = st.builds(
    UrdfJoint,
    st.sampled_from(["revolute", "revolute", "revolute", "continuous", "prismatic", "fixed"]),
    st.tuples(lengths, lengths, lengths),
    st.tuples(angles, angles, angles),
    axes,
)
chains = st.lists(joints, min_size=1, max_size=9).filter(lambda c: any(j.type != "fixed" for j in c))


def load(text: str) -> Robot:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.urdf"
        path.write_text(text)
        return Robot.load(path)


def joint_values(robot: Robot, count: int = 5) -> torch.Tensor:
    """Return zero and random joint values."""
    generator = torch.Generator().manual_seed(1)
    drawn = 6 * torch.rand((count - 1, robot.dof), generator=generator, dtype=torch.float64) - 3
    return torch.cat([torch.zeros(1, robot.dof, dtype=torch.float64), drawn])


@settings(max_examples=120, deadline=None)
@given(chains)
@example([UrdfJoint("prismatic", (0.1, 0.2, 0.3), (0, 0, 0), (1, 0, 0))])
@example([UrdfJoint("revolute", (0.1, 0.2, 0.3), (0.1, math.pi / 2, 0.2), (0.6, 0, 0.8))] * 7)
def test_any_chain_keeps_its_forward_kinematics(chain):
    robot = load(urdf_text(chain))
    q = joint_values(robot)
    expected = np.stack([pose_of_chain(chain, values) for values in q.tolist()])
    assert_close(forward_kinematics(robot, q), expected, atol=1e-12)
    again = load(robot_to_urdf(robot))
    assert_close(forward_kinematics(again, q), expected, atol=1e-12)
    assert [(j.name, j.type, j.lower, j.upper) for j in again.joints] == [
        (j.name, j.type, j.lower, j.upper) for j in robot.joints
    ]


@settings(max_examples=60, deadline=None)
@given(chains)
def test_no_length_is_much_larger_than_those_of_the_chain(chain):
    """A common normal of nearly parallel axes would be hundreds of metres away."""
    robot = load(urdf_text(chain))
    drawn = sum(float(np.linalg.norm(joint.xyz)) for joint in chain)
    assert np.abs(robot.dh[:, 1:3]).max() <= drawn * (1 + 2 / NEARLY_PARALLEL) + 1e-12


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-6, 1e-3, math.pi, math.pi - 1e-6])
def test_nearly_parallel_axes_get_hayati_rows(tilt):
    chain = [
        UrdfJoint("revolute", (0, 0, 0.3), (0, 0, 0)),
        UrdfJoint("revolute", (0.4, 0, 0.1), (0, tilt, 0)),
        UrdfJoint("fixed", (0.2, 0, 0), (0, 0, 0)),
    ]
    theta, d, a, _, beta = load(urdf_text(chain)).dh[0]
    assert (theta, d) == (0.0, 0.0)
    assert a == pytest.approx(0.4, abs=2e-3)
    assert abs(beta) == pytest.approx(abs(math.sin(tilt)) if tilt not in (0.0, math.pi) else 0.0, rel=1e-6)


@pytest.mark.parametrize("twist", [0.2, math.pi / 2, -math.pi / 2, 2.0])
def test_other_axes_get_dh_rows(twist):
    chain = [
        UrdfJoint("revolute", (0, 0, 0.3), (0, 0, 0)),
        UrdfJoint("revolute", (0.4, 0, 0.1), (twist, 0, 0)),
    ]
    assert_close(load(urdf_text(chain)).dh[0], [0, 0.4, 0.4, twist, 0], atol=1e-14)


@pytest.mark.parametrize("name", catalogue())
def test_the_catalogue_through_urdf_and_back(name, tmp_path):
    robot = Robot.load(name)
    (tmp_path / "robot.urdf").write_text(robot_to_urdf(robot))
    again = Robot.load(tmp_path / "robot.urdf")
    q = joint_values(robot, 200)
    assert_close(forward_kinematics(again, q), forward_kinematics(robot, q), atol=1e-14)
    assert type(closed_form_solver(again)) is type(closed_form_solver(robot))
    assert again.joints == robot.joints
    assert again.name == name
    peer = peer_poses(tmp_path / "robot.urdf", "tool0", q)
    assert_close(forward_kinematics(robot, q), peer, atol=1e-10)


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "panda", "rb5", "ur10"])
def test_right_angles_and_offsets_stay_exact(name):
    """Closed forms and the fast forward kinematics rely on exact zeros."""
    again = load(robot_to_urdf(Robot.load(name)))
    quarters = again.dh[:, [0, 3, 4]] / (math.pi / 2)
    assert (quarters == np.round(quarters)).all()
    assert (again.base == 0).all()


@settings(max_examples=25, deadline=None)
@given(chains)
def test_the_peer_agrees(chain):
    robot = load(urdf_text(chain))
    q = joint_values(robot)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.urdf"
        path.write_text(urdf_text(chain))
        drawn = peer_poses(path, f"l{len(chain)}", q)
        path.write_text(robot_to_urdf(robot))
        written = peer_poses(path, "tool0", q)
    assert_close(forward_kinematics(robot, q), drawn, atol=1e-10)
    assert_close(written, drawn, atol=1e-10)


def test_a_prismatic_axis_is_placed_on_the_next_parallel_one():
    """The links of a SCARA keep their lengths, the second in its own row."""
    robot = load(robot_to_urdf(Robot.load("kiro3")))
    assert_close(robot.dh[:, 2], [0.32, 0.32, 0, 0], atol=1e-15)


def test_a_calibrated_robot_is_written_exactly(tmp_path):
    """All five parameters, base and tool, fixed rows, both directions, axes that are parallel up to arc seconds."""
    nominal = Robot.load("ur10")
    random = np.random.default_rng(2)
    robot = nominal.with_geometry(
        nominal.dh + random.normal(0, 1e-3, nominal.dh.shape),
        random.normal(0, 1, 6),
        random.normal(0, 0.2, 6),
    )
    (tmp_path / "robot.urdf").write_text(robot_to_urdf(robot, ("said -- twice",)))
    q = joint_values(robot, 200)
    again = Robot.load(tmp_path / "robot.urdf", base="base_link", tip="tool0")
    assert_close(forward_kinematics(again, q), forward_kinematics(robot, q), atol=1e-12)
    assert_close(peer_poses(tmp_path / "robot.urdf", "tool0", q), forward_kinematics(robot, q), atol=1e-10)
    assert np.abs(again.dh[:, 1:3]).max() < 1.0
    assert "<!-- said - - twice -->" in (tmp_path / "robot.urdf").read_text()
