"""Tensors on a CUDA device: results lie on the same device, equal those of the CPU, and have the same gradients."""

from pathlib import Path

import pytest
import torch

import pisigma
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian

MODELS = Path(__file__).parents[3] / "models"

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="requires a CUDA device")


def joint_values(robot, count=64):
    lower, upper = torch.as_tensor(robot.limits, dtype=torch.float64).clamp(-2, 2).unbind(-1)
    return lower + (upper - lower) * torch.rand(
        count, len(lower), dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )


def check_close(on_device, on_cpu):
    assert on_device.is_cuda
    assert on_device.dtype == on_cpu.dtype
    torch.testing.assert_close(on_device.cpu(), on_cpu, rtol=0, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("name", ["kiro3", "ur10", "panda", "xarm7"])
def test_kinematics(name):
    robot = pisigma.Robot.load(name)
    q = joint_values(robot)
    check_close(forward_kinematics(robot, q.cuda()), forward_kinematics(robot, q))
    for derivatives in (joint_jacobian, identification_jacobian):
        for there, here in zip(derivatives(robot, q.cuda()), derivatives(robot, q), strict=True):
            check_close(there, here)


@pytest.mark.parametrize("name", ["kiro3", "ur10", "meca500"])
def test_closed_forms(name):
    robot = pisigma.Robot.load(name)
    solver = closed_form_solver(robot)
    assert solver is not None
    T = forward_kinematics(robot, joint_values(robot))
    check_close(solver.solve(T.cuda()).q, solver.solve(T).q)


@pytest.mark.parametrize("folder", sorted(path.name for path in MODELS.iterdir() if path.is_dir()))
def test_corrected_inverse_and_its_gradients(folder):
    ik = pisigma.load(MODELS / folder)
    q = joint_values(ik.model.robot)
    check_close(ik.forward(q.cuda()), ik.forward(q))
    check_close(ik.jacobian(q.cuda()), ik.jacobian(q))
    check_close(ik.accuracy(q.cuda()), ik.accuracy(q))
    results = []
    for device in ("cpu", "cuda"):
        T = ik.forward(q).detach().to(device).requires_grad_()
        solution = ik(T, near=q.to(device))
        (torch.nan_to_num(solution.q) ** 2).sum().backward()
        results.append((solution, T.grad))
    (on_cpu, gradient), (on_device, gradient_on_device) = results
    check_close(on_device.q.detach(), on_cpu.q.detach())
    check_close(gradient_on_device, gradient)
    for field in ("status", "branch"):
        there = getattr(on_device, field)
        assert there.is_cuda
        assert torch.equal(there.cpu(), getattr(on_cpu, field))
    assert ik.all_branches(T.detach()).q.is_cuda


def test_single_precision():
    ik = pisigma.load(MODELS / "ur10_landgraf")
    q = joint_values(ik.model.robot, 4)
    T = ik.forward(q).detach()
    solution = ik(T.float().cuda(), near=q.float().cuda(), approach=torch.ones(q.shape[-1]).cuda())
    assert solution.q.dtype == torch.float32
    assert solution.q.is_cuda
    torch.testing.assert_close(solution.q.cpu().double(), q, rtol=0, atol=1e-4)
