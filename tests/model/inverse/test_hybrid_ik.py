"""Corrected inverse kinematics of hybrid models: the arm with its correction reaches the poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in

from pisigma.model.accuracy import position_accuracy
from pisigma.model.folder.model_folder import save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.inverse.compiled_ik import MAX_SOLUTIONS
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.loading import load
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import singularity_measure
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import pose_error

pytestmark = pytest.mark.usefixtures("without_type_checker")

SET_UPS = {
    "fanuc_r2000": {"products": True},
    "kiro4": {"share": 0.5},
    "rb5": {},
    "panda": {"features": ("series",)},
    "ur5": {"features": ("joints",)},
}


@pytest.fixture(scope="module", params=SET_UPS)
def solver(request):
    """A simulated robot, and the inverse kinematics of its hybrid model."""
    return solver_of(request.param)


def solver_of(name: str):
    arm = hybrid_of(name, **SET_UPS[name])
    return arm, CorrectedIK(model_of_hybrid(name, arm.true.nominal, arm.result, arm.measurements))


def wanted(arm, ik, rows: int, seed: int = 11) -> tuple[torch.Tensor, torch.Tensor]:
    """Joint values in the measured region, and the poses there."""
    share = SET_UPS[arm.true.nominal.name.lower()].get("share", 1.0)
    q = joints_in(arm.true.nominal, rows, seed=seed, share=share)
    return q, ik.model.forward(q)


def found(solution) -> torch.Tensor:
    return solution.status != Status.UNREACHABLE


def test_the_hybrid_arm_reaches_the_poses(solver):
    arm, ik = solver
    q, T = wanted(arm, ik, 150)
    solution = ik(T, near=q)
    reached = found(solution)
    assert float(reached.double().mean()) > 0.98
    error = pose_error(T[reached], ik.model.hybrid.forward(solution.q[reached]))
    assert_close(error, 0.0, atol=1e-9)
    assert float((forward_kinematics(ik.model.calibrated, solution.q) - T)[reached].abs().max()) > 1e-5
    assert bool(solution.q[~reached].isnan().all())
    assert (
        float(((solution.q - q).abs().amax(-1) < 1e-6).double().mean()) > 0.7
    )  # seven axes may go elsewhere


def test_all_branches_reach_the_poses(solver):
    arm, ik = solver
    _, T = wanted(arm, ik, 40)
    every = ik.all_branches(T)
    assert every.q.shape == (40, len(ik.branches) if ik.closed_form else MAX_SOLUTIONS, ik.model.robot.dof)
    reached = found(every)
    assert bool(reached.any(-1).all())
    each = T[:, None].expand(*reached.shape, 4, 4)
    error = pose_error(each[reached], ik.model.forward(every.q[reached]))
    assert_close(error, 0.0, atol=1e-9)
    assert_close(every.position_residual[reached], error[:, :3].norm(dim=-1), atol=1e-12)
    if len(ik.branches) > 1:
        assert float(reached.double().sum(-1).mean()) > 1.5
        name = ik.branches[int(reached.double().sum(0).argmax())]
        alone = ik(T, branch=name)
        there = found(alone)
        assert torch.equal(there, reached[:, ik.branches.index(name)])
        assert_close(alone.position_residual[there], 0.0, atol=1e-9)
        clear = there.clone()  # of a joint arrangement where two branches meet, such as a straight elbow
        clear[there] = singularity_measure(ik.model.calibrated, alone.q[there]) > 0.005
        assert int(clear.sum()) > 0.9 * int(there.sum())
        assert_close(alone.q[clear], every.q[:, ik.branches.index(name)][clear], atol=1e-9)


def test_nominal_values_and_correction_belong_to_the_solution(solver):
    arm, ik = solver
    q, T = wanted(arm, ik, 60)
    solution = ik(T, near=q)
    known = torch.isfinite(solution.q_nominal).all(-1)
    assert float(known.double().mean()) > 0.9
    assert_close(forward_kinematics(ik.model.robot, solution.q_nominal[known]), T[known], atol=1e-9)
    assert_close(solution.correction[known], (solution.q - solution.q_nominal)[known])


def test_a_loaded_model_gives_the_same_solutions(solver, tmp_path):
    arm, ik = solver
    q, T = wanted(arm, ik, 20)
    save_model(ik.model, tmp_path)
    loaded = load(tmp_path)
    assert loaded.branches == ik.branches
    assert torch.equal(loaded(T, near=q).q.nan_to_num(), ik(T, near=q).q.nan_to_num())


def test_residuals_and_accuracy_are_those_of_the_model(solver):
    arm, ik = solver
    q, T = wanted(arm, ik, 30)
    solution = ik(T, near=q)
    reached = found(solution)
    assert bool((solution.position_residual[reached] < 1e-9).all())
    assert bool((solution.rotation_residual[reached] < 1e-9).all())
    assert_close(solution.accuracy[reached], position_accuracy(ik.model, solution.q[reached]))
    assert bool((solution.accuracy[reached] > 1e-6).all())
    assert bool((solution.accuracy[reached] < 5e-3).all())
    error = pose_error(T, ik.model.forward(solution.q))
    assert_close(solution.position_residual[reached], error[reached, :3].norm(dim=-1), atol=1e-12)
    assert_close(solution.rotation_residual[reached], error[reached, 3:].norm(dim=-1), atol=1e-12)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)], ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_batches_and_types(batch, dtype):
    arm, ik = solver_of("fanuc_r2000")
    _, T = wanted(arm, ik, max(int(np.prod(batch)), 1))
    T = T[: int(np.prod(batch))].reshape(*batch, 4, 4).to(dtype)
    solution = ik(T)
    assert solution.q.shape == (*batch, 6)
    assert solution.q.dtype == dtype
    for values in (solution.position_residual, solution.rotation_residual):
        assert values.shape == batch
        assert values.dtype == torch.float64
    assert solution.accuracy.shape == batch
    assert solution.accuracy.dtype == dtype
    assert len(solution.sentences) == int(np.prod(batch))
    every = ik.all_branches(T)
    assert every.position_residual.shape == (*batch, len(ik.branches))
    near = every.position_residual[found(every)]
    assert bool((near < (1e-9 if dtype == torch.float64 else 1e-3)).all())
    if batch:
        for part, whole in ((solution.select(0), solution), (every.select(0), every)) if batch[0] else ():
            assert_close(
                part.position_residual.nan_to_num(), whole.position_residual[0].nan_to_num(), atol=1e-12
            )


def test_batched_equals_looped():
    arm, ik = solver_of("kiro4")
    q, T = wanted(arm, ik, 12)
    whole = ik(T, near=q)
    for index in range(12):
        alone = ik(T[index], near=q[index])
        assert int(alone.status) == int(whole.status[index])
        assert_close(alone.q.nan_to_num(), whole.q[index].nan_to_num(), atol=1e-9)


def test_the_status_reports_unmeasured_joint_values():
    arm, ik = solver_of("kiro4")
    q = joints_in(arm.true.nominal, 120, seed=3)
    coverage = ik.model.hybrid.coverage
    beyond, inside = coverage.distance_outside(q).amax(-1), coverage.contains(q)
    T = ik.model.forward(q)
    solution = ik(T, near=q)
    back = found(solution) & ((solution.q - q).abs().amax(-1) < 1e-6)
    assert float(back.double().mean()) > 0.9
    status = solution.status[back]
    assert bool((status[inside[back]] == Status.REACHED).all())
    assert bool((status[~inside[back]] == Status.OUTSIDE_DOMAIN).all())
    assert_close(solution.domain_measure[back], 1 + beyond[back], atol=1e-6)
    gone = back & (beyond > 0.5)
    assert int(gone.sum()) > 20
    assert_close(ik.model.forward(solution.q[gone]), T[gone], atol=1e-9)
    index = int(gone.nonzero()[0])
    assert solution.sentences[index] == Status.OUTSIDE_DOMAIN.sentence


def test_the_hybrid_may_reach_where_the_nominal_arm_does_not():
    arm, ik = solver_of("fanuc_r2000")
    q = joints_in(arm.true.nominal, 200, seed=6)
    generator = torch.Generator().manual_seed(0)
    q[:, 2] = torch.tensor(straight_elbow(ik)) + 0.01 * torch.randn(len(q), generator=generator).double()
    T = ik.model.forward(q)
    solution = ik(T)
    lost = solution.q_nominal.isnan().all(-1)
    rescued = lost & found(solution)
    assert int(rescued.sum()) > 10
    assert_close(ik.model.forward(solution.q[rescued]), T[rescued], atol=1e-9)


def straight_elbow(ik) -> float:
    """Value of the third joint [rad] at which the nominal arm is longest."""
    q = torch.zeros(4000, 6, dtype=torch.float64)
    q[:, 2] = torch.linspace(*ik.model.robot.limits[2].tolist(), len(q), dtype=torch.float64)
    q[:, 4] = math.pi / 2
    dh = ik.model.robot.dh.copy()
    dh[-1, 1] = 0
    wrist = ik.model.robot.with_geometry(dh=dh, base=np.zeros(6), tool=np.zeros(6))
    shoulder = q.new_tensor([dh[0, 2], 0.0, dh[0, 1]])
    return float(q[(forward_kinematics(wrist, q)[:, :3, 3] - shoulder).norm(dim=-1).argmax(), 2])


@pytest.mark.parametrize("name", ["fanuc_r2000", "ur5"])
def test_far_poses_are_unreachable(name):
    arm, ik = solver_of(name)
    _, T = wanted(arm, ik, 3)
    T[:, :3, 3] *= 1e3  # millimetres for metres
    for solution in (ik(T), ik.all_branches(T), ik(T, near=torch.zeros(ik.model.robot.dof))):
        assert bool((solution.status == Status.UNREACHABLE).all())
        for values in (solution.q, solution.position_residual, solution.accuracy, solution.domain_measure):
            assert bool(values.isnan().all())


def test_wraps_that_a_correction_distinguishes_are_solved_separately():
    """With scaled joint values as features the correction differs after a full turn."""
    arm, ik = solver_of("ur5")
    q, T = wanted(arm, ik, 40)
    turned = q + 2 * torch.pi * torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, -1.0]) * -torch.sign(q)
    solution = ik(T, near=turned)
    reached = found(solution)
    assert float(((solution.q - q).abs() > 3).any(-1).double().mean()) > 0.9
    assert_close(ik.model.forward(solution.q[reached]), T[reached], atol=1e-9)


def test_solutions_of_other_models_have_residuals_too():
    arm, ik = solver_of("rb5")
    q, T = wanted(arm, ik, 10)
    geometric = CorrectedIK(replace(ik.model, hybrid=None, uncertainty=None))
    solution = geometric(T, near=q)
    reached = found(solution)
    assert bool((solution.position_residual[reached] < 1e-9).all())
    assert bool(solution.accuracy.isnan().all())
