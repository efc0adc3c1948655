"""Inverse kinematics without kernels, and choices that it shares with the kernels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.calibrated_arm import calibrated_arm, joints_of
from testing.closeness import assert_close
from testing.models import with_limits
from testing.refusals import refused

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.files.errors import PoseError
from pisigma.joint_correction.backlash import Backlash
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.robot.kinematics.status import Status

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.fixture(scope="module")
def without_kernels():
    """An arm whose correction has features without a compiled form, with joint values and poses."""
    model = calibrated_arm("ur5", shared=("pose",))
    q = joints_of(model.robot, 8, seed=7)
    return CorrectedIK(model), q, model.forward(q)


@pytest.mark.parametrize("way", ["in order", "near", "branch"])
def test_a_model_without_kernels_is_solved(without_kernels, way):
    ik, q, T = without_kernels
    assert ik.compiled is None
    options = {"near": {"near": q + 0.01}, "branch": {"branch": ik.branches[1]}}.get(way, {})
    tensors = ik(
        T.reshape(2, 4, 4, 4), **{k: v.reshape(2, 4, 6) if k == "near" else v for k, v in options.items()}
    )
    arrays = ik(T.numpy(), **options)
    reached = arrays.status != Status.UNREACHABLE
    assert isinstance(arrays.q, np.ndarray)
    assert isinstance(tensors.q, torch.Tensor)
    assert reached.mean() > (0.9 if way != "branch" else 0.3)
    assert_close(tensors.q.reshape(-1, 6).nan_to_num(), np.nan_to_num(arrays.q), atol=1e-9)
    assert_close(arrays.position_residual[reached], 0.0, atol=1e-10)
    assert_close(ik.forward(arrays.q[reached]), T[torch.from_numpy(reached)], atol=1e-10)
    if way == "near":
        assert_close(arrays.q[reached], q[torch.from_numpy(reached)], atol=1e-6)


def test_without_kernels_single_poses_are_solved_as_in_a_batch(without_kernels):
    ik, q, T = without_kernels
    batch = ik(T[:2].numpy(), near=q[:2].numpy())
    assert_close(ik(T[1].numpy(), near=q[1].numpy()).q, batch.q[1], atol=1e-12)
    assert_close(ik(T[1].tolist()).position_residual, 0.0, atol=1e-10)
    every = ik.all_branches(T[1].numpy())
    assert every.q.shape == (len(ik.branches), 6)
    assert int(ik(T[1], throw=False).status) == Status.REACHED


def test_without_kernels_a_path_with_joints_to_spare_is_followed():
    model = calibrated_arm("panda", shared=("pose",))
    ik, q = CorrectedIK(model), joints_of(model.robot, 1, seed=3, share=0.5)
    line = q + torch.linspace(0, 0.1, 3, dtype=torch.float64)[:, None]
    path = ik.path(model.forward(line).numpy(), near=q[0].numpy())
    assert not path.switches
    assert (path.solution.status == Status.REACHED).all()
    assert np.abs(np.diff(path.solution.q, axis=0)).max() < 0.2


def test_without_kernels_invalid_poses_need_not_raise(without_kernels):
    ik, q, T = without_kernels
    bad = T.numpy().copy()
    bad[2, 0, 0] = np.nan
    near = q.numpy().copy()
    near[4, 1] = 100.0
    found = ik(bad, near=near, throw=False)
    assert np.flatnonzero(found.status == Status.INVALID_POSE).tolist() == [2, 4]
    assert np.isnan(found.q[[2, 4]]).all()
    assert np.isfinite(found.q[[0, 1, 3]]).all()
    for options, fields in (
        ({"branch": "up"}, {"option": "branch", "value": "up"}),
        ({"near": near[:, :3]}, {"option": "near", "expected": "6 columns"}),
    ):
        with refused(PoseError, **fields):
            ik(T.numpy(), **options)


def test_an_elbow_angle_is_refused_without_kernels():
    model = calibrated_arm("panda", shared=("pose",))
    with refused(PoseError, option="elbow_angle", value=0.3):
        CorrectedIK(model)(np.eye(4), elbow_angle=0.3)


def test_gradients_without_kernels(without_kernels):
    ik, q, T = without_kernels
    wanted = T[:3].clone().requires_grad_()
    ik(wanted, near=q[:3]).q.sum().backward()
    assert bool(torch.isfinite(wanted.grad).all())
    assert float(wanted.grad.abs().max()) > 0.1


def test_the_correction_depends_on_the_approach_direction(monkeypatch):
    model = calibrated_arm("ur5")
    q, plain = joints_of(model.robot, 6, seed=2, share=0.8), HybridArm.joint_correction

    def with_backlash(arm, q):
        return plain(arm, q) + (0.0 if arm.approach is None else 1e-3 * arm.approach)

    monkeypatch.setattr(HybridArm, "joint_correction", with_backlash)
    ik, T = NumericIK(model).solve_batch, model.forward(q)
    near, sides = (
        ik(T, near=q),
        torch.tensor([[1.0, 1, 1, -1, -1, 0], [-1.0, 1, 0, 0, 1, 1]]).repeat(3, 1).double(),
    )
    found = ik(T, near=q, approach=sides)
    assert_close(found.q - near.q, -1e-3 * sides, atol=1e-4)
    assert_close(found.position_residual, 0.0, atol=1e-10)
    assert_close(ik(T, near=q, approach=sides[0]).q[::2], found.q[::2], atol=1e-12)
    assert_close(ik(T, near=q, approach=np.zeros(6)).q, near.q, atol=1e-12)


def test_the_first_branch_inside_the_limits_is_chosen():
    model = calibrated_arm("ur5", hybrid=False)
    T = model.forward(joints_of(model.robot, 200, seed=5))
    every = CorrectedIK(model).all_branches(T)
    robots = [with_limits(robot, 2, 0.0, 3.2) for robot in (model.robot, model.calibrated)]
    limited = CorrectedIK(
        replace(model, robot=robots[0], calibrated=robots[1], branches=("back/elbow_up/flip",))
    )
    assert limited.branches[limited.branch_order[0]] == "back/elbow_up/flip"
    assert sorted(limited.branch_order) == list(range(8))
    solution = limited(T)
    elbow = every.q[..., 2].remainder(2 * torch.pi)
    inside = (every.status != Status.UNREACHABLE) & (elbow <= 3.2)
    rank = torch.where(inside[:, torch.tensor(limited.branch_order)], torch.arange(8), 8)
    wanted = torch.tensor([*limited.branch_order, -1])[rank.amin(-1)]
    clear = wanted >= 0
    assert float((solution.branch[clear] == wanted[clear]).double().mean()) > 0.94
    outside = ~clear & (every.status != Status.UNREACHABLE).any(-1)
    assert bool((solution.status[outside] == Status.OUTSIDE_JOINT_LIMITS).all())


@pytest.mark.parametrize("kernels", [True, False])
def test_poses_in_millimetres_and_near_misses_are_unreachable(kernels):
    model = calibrated_arm("ur5")
    ik, T = CorrectedIK(model), model.forward(joints_of(model.robot, 40, seed=7))
    solve = ik if kernels else ik.numeric.solve_batch
    T[:20, :3, 3] *= 1e3
    T[20:, :3, 3] *= 1.5 * model.robot.reach / T[20:, :3, 3].norm(dim=-1, keepdim=True)
    for near in (None, torch.zeros(6, dtype=torch.float64)):
        solution = solve(T, near=near)
        assert bool((solution.status == Status.UNREACHABLE).all())
        assert bool(solution.q.isnan().all())
        assert bool((solution.branch == ik.branch_order[0]).all())


def arm_with_backlash(size: float = 2e-3):
    """A UR5 whose joints stop short by different amounts [rad] according to their approach direction."""
    model = calibrated_arm("ur5")
    own = model.hybrid.correction
    correction = JointCorrection(model.robot, [*own.features, Backlash(model.robot)], own.orders)
    state = {
        **own.state_dict(),
        f"linear.{len(own.features)}": size * torch.arange(1.0, 7.0).double()[:, None] / 6,
    }
    correction.load_state_dict(state)
    return replace(model, hybrid=replace(model.hybrid, correction=correction.requires_grad_(False)))


def test_both_routes_use_the_approach_direction():
    model = arm_with_backlash()
    ik, reference = CorrectedIK(model), NumericIK(model).solve_batch
    assert ik.compiled is not None
    q = joints_of(model.robot, 12, seed=2, share=0.8)
    sides = torch.tensor([[1.0, 1, 1, -1, -1, 0], [-1.0, 1, 0, 0, 1, 1]]).repeat(6, 1).double()
    T = model.hybrid.forward(q, sides)
    for near in (None, q + 0.01):
        tensors, expected = ik(T, near=near, approach=sides), reference(T, near=near, approach=sides)
        fine = (tensors.status == Status.REACHED) & (expected.status == Status.REACHED)
        assert float(fine.double().mean()) > 0.8
        assert_close(tensors.q[fine], expected.q[fine], atol=1e-9)
        arrays = ik(T.numpy(), near=None if near is None else near.numpy(), approach=sides.numpy())
        assert_close(arrays.q[fine], tensors.q[fine], atol=1e-12)
    assert_close(tensors.q[fine], q[fine], atol=1e-9)
    one = ik(T[0].numpy(), near=q[0].numpy(), approach=[1, 1, 1, -1, -1, 0])
    assert_close(one.q, tensors.q[0], atol=1e-12)
    assert_close(ik.forward(q.numpy(), approach=sides.numpy()), T, atol=1e-12)
    plain = ik(T, near=q)
    assert float((plain.q - q)[fine].abs().amax()) > 1e-3
    assert_close(ik(T, near=q, approach=torch.zeros(6)).q, plain.q, atol=1e-12)
    every = ik.all_branches(T, approach=sides)
    picked = torch.take_along_dim(every.q, tensors.branch[:, None, None], 1)[:, 0]
    assert_close((picked - tensors.q)[fine].sin(), 0.0, atol=1e-9)
    with refused(PoseError, option="approach", value=(5,)):
        ik(T, approach=sides[:5])
    for wrong in (5.0, 0.5, float("nan")):
        for call in (ik, reference, ik.all_branches):
            with refused(PoseError, option="approach") as caught:
                call(T, approach=[wrong, 0, 0, 0, 0, 0])
            assert str(caught.value.value) == str(wrong)
    with refused(PoseError, option="approach", value=None):
        ik.forward(q, approach=sides)


def test_a_path_determines_the_approach_directions():
    model = arm_with_backlash()
    ik = CorrectedIK(model)
    q = torch.tensor([0.3, -1.2, 1.1, 0.4, 1.0, 0.2]).double() + torch.zeros(9, 6).double()
    way = (
        torch.tensor([0.0, 1, 2, 3, 4, 3, 2, 1, 0]).double()[:, None]
        * 0.02
        * torch.tensor([1.0, -1, 1, 1, 0, 1])
    )
    sides = torch.sign(torch.diff(way, dim=0, prepend=way[:1] - (way[1:2] - way[:1])))
    T = model.hybrid.forward(q + way, sides)
    path = ik.path(T.numpy(), near=(q[0] - 0.5 * way[1]).numpy())
    moving = [0, 1, 2, 3, 5]
    assert_close(path.solution.q[:, moving], (q + way)[:, moving], atol=1e-5)
