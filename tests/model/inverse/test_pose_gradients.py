"""Gradients of joint values with respect to the target pose agree with finite differences."""

import pytest
import torch
from testing.calibrated_arm import calibrated_arm, joints_of
from testing.closeness import assert_close
from testing.models import HOMES, hand_made_model, joints_around

from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian, singularity_measure
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import rotation_from_vector, transform

pytestmark = pytest.mark.usefixtures("without_type_checker")

STEP = 1e-5


def moved(T: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
    """Move poses by a translation and a rotation vector in the base frame."""
    rotation = rotation_from_vector(twist[..., 3:]) @ T[..., :3, :3]
    return transform(rotation, T[..., :3, 3] + twist[..., :3])


def directions(model, T, q) -> torch.Tensor:
    """Twists that the tool can follow: any for six or more joints, else those of the joints."""
    generator = torch.Generator().manual_seed(0)
    if model.robot.dof >= 6:
        return torch.randn(len(T), 6, generator=generator, dtype=torch.float64)
    _, J = joint_jacobian(model.robot, q)
    return (J @ torch.randn(len(T), model.robot.dof, 1, generator=generator, dtype=torch.float64))[..., 0]


def check(model, T, near, names=("q", "q_nominal", "correction")) -> None:
    ik = CorrectedIK(model)
    plain = ik(T, near=near)
    fine = (plain.status == Status.REACHED) | (plain.status == Status.OUTSIDE_DOMAIN)
    assert float(fine.double().mean()) > 0.8
    T, start = T[fine], plain.q[fine]
    way = directions(model, T, plain.q_nominal[fine])
    arm, at = (model.robot, plain.q_nominal[fine]) if model.calibrated is None else (model.calibrated, start)
    clear = singularity_measure(arm, at) > 0.03  # near singular poses differences are no derivatives
    assert float(clear.double().mean()) > 0.4
    amount = torch.zeros(len(T), 1, dtype=torch.float64, requires_grad=True)
    solution = ik(moved(T, amount * way), near=start)
    ends = [ik(moved(T, s * STEP * way), near=start) for s in (1.0, -1.0)]
    for name in names:
        expected = (getattr(ends[0], name) - getattr(ends[1], name)) / (2 * STEP)
        found = []
        for column in getattr(solution, name).unbind(-1):
            (slope,) = torch.autograd.grad(column.sum(), amount, retain_graph=True)
            found.append(slope[:, 0])
        assert_close(torch.stack(found, -1)[clear], expected[clear], atol=2e-6, rtol=2e-6)


@pytest.mark.parametrize("kind", ["geometric", "hybrid", "half covered"])
def test_a_calibrated_arm(kind):
    model = calibrated_arm("ur5", hybrid=kind != "geometric", covered=0.5 if kind == "half covered" else 1.0)
    q = joints_of(model.robot, 40, seed=3, share=0.5)
    check(model, model.forward(q), q)


@pytest.mark.parametrize("name", HOMES)
def test_a_network_on_nominal_joint_values(name):
    model = hand_made_model(name)
    T = forward_kinematics(model.robot, joints_around(name, 20, spread=0.15))
    check(model, T, torch.tensor(HOMES[name], dtype=torch.float64))


def test_pose_inputs_of_a_network_contribute():
    model = hand_made_model("kiro4", inputs=("x", "y", "z", "roll", "theta_2"))
    T = forward_kinematics(model.robot, joints_around("kiro4", 20, spread=0.15))
    check(model, T, torch.tensor(HOMES["kiro4"], dtype=torch.float64))


def test_no_calibration_at_all():
    from dataclasses import replace

    model = replace(hand_made_model("kiro4"), network=None, domain=None)
    T = forward_kinematics(model.robot, joints_around("kiro4", 10, spread=0.15))
    check(model, T, torch.tensor(HOMES["kiro4"], dtype=torch.float64), names=("q", "q_nominal"))


def test_seven_joints_follow_with_the_least_motion():
    model = calibrated_arm("panda", hybrid=False)
    q = joints_of(model.robot, 10, seed=2, share=0.6)
    T = model.forward(q).requires_grad_()
    solution = CorrectedIK(model)(T, near=q)
    _, J = joint_jacobian(model.calibrated, solution.q.detach())
    way = torch.randn(10, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rows = [torch.autograd.grad(column.sum(), T, retain_graph=True)[0] for column in solution.q.unbind(-1)]
    spin = torch.zeros(10, 3, 3, dtype=torch.float64)
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        spin[:, k, j], spin[:, j, k] = way[:, 3 + i], -way[:, 3 + i]
    change = torch.zeros(10, 4, 4, dtype=torch.float64)
    change[:, :3, :3], change[:, :3, 3] = spin @ T.detach()[:, :3, :3], way[:, :3]
    step = torch.stack([(row * change).sum((-1, -2)) for row in rows], -1)
    assert_close((J @ step[..., None])[..., 0], way, atol=1e-9)
    rest = torch.linalg.svd(J)[2][:, 6]
    assert_close((rest * step).sum(-1), 0.0, atol=1e-9)


def test_shear_and_scale_do_not_contribute():
    model = calibrated_arm("ur5")
    q = joints_of(model.robot, 5, seed=3, share=0.4)
    T = model.forward(q).requires_grad_()
    solution = CorrectedIK(model)(T, near=q)
    (slope,) = torch.autograd.grad(solution.q.sum(), T)
    assert_close((slope[:, :3, :3] * T.detach()[:, :3, :3]).sum((-1, -2)), 0.0, atol=1e-9)  # scale
    assert_close(slope[:, 3], 0.0)


def test_unreached_poses_have_zero_gradient_and_singular_ones_a_finite_one():
    model = calibrated_arm("ur5", hybrid=False)
    stretched = torch.tensor([0.3, -0.7, 0.0, 0.5, 0.6, 0.2], dtype=torch.float64)
    singular = CorrectedIK(model)
    T = torch.stack([model.forward(stretched[None])[0], torch.eye(4, dtype=torch.float64)])
    T[1, :3, 3] = 9.0
    T.requires_grad_()
    solution = singular(T, near=stretched)
    assert bool(solution.q[1].isnan().all())
    (slope,) = torch.autograd.grad(solution.q.nan_to_num().sum(), T)
    assert bool(torch.isfinite(slope).all())
    assert_close(slope[1], 0.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_have_the_dtype_of_the_poses_and_none_are_kept_without_need(dtype):
    model = calibrated_arm("ur5")
    q = joints_of(model.robot, 3, seed=3, share=0.4)
    T = model.forward(q).to(dtype)
    assert not CorrectedIK(model)(T).q.requires_grad
    T.requires_grad_()
    with torch.no_grad():
        assert not CorrectedIK(model)(T).q.requires_grad
    solution = CorrectedIK(model)(T)
    assert solution.q.dtype == dtype
    solution.q.sum().backward()
    assert T.grad.dtype == dtype
    assert bool(torch.isfinite(T.grad).all())


def test_second_derivatives_are_refused():
    model = calibrated_arm("ur5")
    T = model.forward(joints_of(model.robot, 1, share=0.4)).requires_grad_()
    q = CorrectedIK(model)(T).q
    (slope,) = torch.autograd.grad((q**2).sum(), T, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


def test_all_branches_have_gradients():
    model = calibrated_arm("ur5", hybrid=False)
    T = model.forward(joints_of(model.robot, 2, share=0.4)).requires_grad_()
    every = CorrectedIK(model).all_branches(T)
    (slope,) = torch.autograd.grad(every.q.nan_to_num().sum(), T)
    assert float(slope.abs().max()) > 0.1
