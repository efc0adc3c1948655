"""Forward kinematics and Jacobians of arrays agree with torch for every robot, batch and joint value."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from testing.calibrated_arm import calibrated_arm, joints_of
from testing.closeness import assert_close
from testing.refusals import refused

import pisigma
from pisigma.files.errors import ModelError, PoseError
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot, catalogue
from pisigma.robot.kernels import array_kinematics, machine_code
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import transform_from_xyz_zyx

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_arrays_agree_with_tensors(name):
    robot = Robot.load(name)
    rng = np.random.default_rng(0)
    moved = robot.with_geometry(
        robot.dh + 1e-3 * rng.normal(size=robot.dh.shape), rng.normal(size=6), rng.normal(size=6)
    )
    q = joints_of(robot, 37, seed=3, share=1.5)
    for arm in (robot, moved):
        T, J = joint_jacobian(arm, q)
        assert_close(pisigma.forward_kinematics(arm, q.numpy()), T, atol=1e-14)
        assert_close(pisigma.joint_jacobian(arm, q.numpy()), J, atol=1e-14)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,), (16,), (17,)], ids=str)
def test_any_batch_and_lists(batch):
    robot = Robot.load("ur5")
    q = joints_of(robot, int(np.prod(batch)), seed=4).numpy().reshape(*batch, 6)
    T, J = pisigma.forward_kinematics(robot, q), pisigma.joint_jacobian(robot, q)
    assert (T.shape, J.shape) == ((*batch, 4, 4), (*batch, 6, 6))
    assert_close(T, forward_kinematics(robot, torch.from_numpy(q)), atol=1e-14)
    assert_close(pisigma.forward_kinematics(robot, q[..., ::-1][..., ::-1]), T, atol=1e-15)
    if batch != (0,):
        assert_close(pisigma.forward_kinematics(robot, q.tolist()), T, atol=1e-15)


def test_angles_of_any_size_and_none():
    robot = Robot.load("panda")
    q = joints_of(robot, 5, seed=5).numpy()
    q[0] += 2 * np.pi * 1e3
    q[1] *= 1e7
    q[2] = np.pi / 2 * np.arange(7)
    q[3, 2] = np.nan
    T = pisigma.forward_kinematics(robot, q)
    expected = forward_kinematics(robot, torch.from_numpy(q)).numpy()
    assert_close(T[[0, 1, 2, 4]], expected[[0, 1, 2, 4]], atol=1e-14)
    assert np.isnan(T[3, :3, :2]).all()


def test_tensors_have_gradients():
    robot = Robot.load("kiro4")
    q = joints_of(robot, 3).requires_grad_()
    pisigma.forward_kinematics(robot, q).sum().backward()
    assert float(q.grad.abs().max()) > 0
    assert_close(pisigma.joint_jacobian(robot, q.detach()), joint_jacobian(robot, q.detach())[1])


def test_wrong_numbers_of_joint_values_are_rejected():
    robot = Robot.load("ur5")
    for q in (np.zeros(5), np.zeros((2, 7)), 0.0):
        with refused(PoseError, expected="6 columns", value=np.shape(q)[-1] if np.ndim(q) else 0):
            pisigma.forward_kinematics(robot, q)


def test_arrays_use_torch_without_kernels(monkeypatch):
    def missing() -> None:
        raise ModelError("there are none.")

    monkeypatch.setattr(machine_code, "load_kernels", missing)
    robot = Robot.load("ur5")
    q = joints_of(robot, 4).numpy()
    T, J = joint_jacobian(robot, torch.from_numpy(q))
    assert_close(pisigma.forward_kinematics(robot, q), T)
    assert_close(pisigma.joint_jacobian(robot, q), J)


@pytest.mark.parametrize("hybrid", [True, False])
def test_calibrated_arms(hybrid):
    model = calibrated_arm("ur5", hybrid=hybrid, covered=0.5)
    ik, q = CorrectedIK(model), joints_of(model.robot, 40, seed=6, share=0.6)
    T, J = ik.forward(q.numpy()), ik.jacobian(q.numpy())
    assert isinstance(T, np.ndarray)
    assert_close(T, model.forward(q), atol=1e-13)
    assert_close(J, model.jacobian(q), atol=1e-6)  # torch takes the slope of the share by differences
    assert_close(ik.forward(q), T, atol=1e-13)
    assert_close(ik.jacobian(q), J, atol=1e-6)
    assert_close(ik.forward(q[0].numpy()), T[0], atol=1e-14)
    assert_close(ik.jacobian(q.reshape(4, 10, 6).numpy()).reshape(40, 6, 6), J, atol=1e-14)


def test_transforms_of_numbers():
    for numbers in np.random.default_rng(0).normal(size=(5, 6)):
        expected = transform_from_xyz_zyx(torch.from_numpy(numbers))
        assert_close(array_kinematics.transform_of(numbers.tolist()), expected, atol=1e-15)


def test_no_torch_is_imported():
    script = (
        "import sys\nimport pisigma\nrobot = pisigma.Robot.load('ur5')\n"
        "assert pisigma.forward_kinematics(robot, [0.0] * 6).shape == (4, 4)\n"
        "assert pisigma.joint_jacobian(robot, [[0.0] * 6] * 2).shape == (2, 6, 6)\n"
        "assert not [name for name in ('torch', 'numba') if name in sys.modules]\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
