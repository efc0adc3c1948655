"""Robots as chains of pytorch-kinematics: the same poses and Jacobians to rounding, in float64."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, joints_around

import pisigma
from pisigma.robot import Robot, catalogue
from pisigma.robot.kinematics.forward import forward_kinematics


def joints_of(robot: Robot, count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    low, high = torch.from_numpy(np.clip(robot.limits, -3.0, 3.0)).T
    return low + (high - low) * torch.rand(count, robot.dof, generator=generator, dtype=torch.float64)


def moved(robot: Robot) -> Robot:
    """The robot with base, tool and every parameter changed."""
    rng = np.random.default_rng(0)
    return robot.with_geometry(
        dh=robot.dh + 0.01 * rng.normal(size=robot.dh.shape), base=rng.normal(size=6), tool=rng.normal(size=6)
    )


@pytest.mark.parametrize("name", catalogue())
def test_forward_kinematics_agrees(name):
    robot = moved(Robot.load(name))
    chain = robot.to_pytorch_kinematics()
    assert chain.get_joint_parameter_names() == [joint.name for joint in robot.joints]
    q = joints_of(robot, 20)
    T = chain.forward_kinematics(q).get_matrix()
    assert T.dtype == torch.float64
    assert_close(T, forward_kinematics(robot, q), atol=1e-12)


def test_jacobian_and_limits_agree():
    robot = moved(Robot.load("kiro3"))
    chain = robot.to_pytorch_kinematics()
    q = joints_of(robot, 1)
    J = chain.jacobian(q)[0]
    by_autograd = torch.autograd.functional.jacobian(lambda q: forward_kinematics(robot, q)[:3, 3], q[0])
    assert_close(J[:3], by_autograd, atol=1e-12)
    low, high = chain.get_joint_limits()
    finite = np.isfinite(robot.limits).all(1)
    assert_close(np.array(low)[finite], robot.limits[finite, 0], atol=0)
    assert_close(np.array(high)[finite], robot.limits[finite, 1], atol=0)


def test_a_model_has_its_identified_geometry():
    model = hand_made_model("ur10")
    q = joints_around("ur10", 5)
    for chain in (model.to_pytorch_kinematics(), pisigma.CorrectedIK(model).to_pytorch_kinematics()):
        assert_close(chain.forward_kinematics(q).get_matrix(), forward_kinematics(model.robot, q), atol=1e-12)


def test_the_peer_is_imported_on_use():
    script = (
        "import sys, pisigma\npisigma.Robot.load('rb5')\nassert 'pytorch_kinematics' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
