"""The fast way to solutions gives what the careful one gives, and leaves nothing wrong behind."""

from dataclasses import replace

import pytest
import torch
from testing.calibrated_arm import calibrated_arm, joints_of
from testing.closeness import assert_close
from testing.models import with_limits

from pisigma.inverse.torch_ik import TorchIK
from pisigma.kinematics.status import Status
from pisigma.se3 import pose_error

pytestmark = pytest.mark.usefixtures("without_type_checker")

KINDS = {
    "ur5": {},
    "rb5 geometric": {"hybrid": False},
    "kiro4 half covered": {"covered": 0.5},
    "ur5 small correction": {"size": 0.2},
    "ur5 turns count": {"shared": ("joints",)},
    "ur5 pose inputs": {"shared": ("pose",)},
}


def model_of(kind: str):
    return calibrated_arm(kind.split()[0], **KINDS[kind])


def solved(kind: str, rows: int = 300, share: float = 1.0):
    model = model_of(kind)
    q = joints_of(model.robot, rows, seed=7, share=share * KINDS[kind].get("covered", 1.0))
    return q, model.forward(q), TorchIK(model)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", ["in order", "near", "branch"])
def test_the_fast_way_gives_what_the_careful_one_does(kind, way):
    q, T, ik = solved(kind, 120)
    near = q + 0.02 * torch.sin(17 * q) if way == "near" else None
    order = ik.order[1:2] if way == "branch" else ik.order
    fast, slow = ik._fast.solve(T, near, order), ik._reference.solve(T, T, near, order)
    done = fast.done
    assert float(done.double().mean()) > (0.85 if way != "branch" else 0.5)
    same = done & (fast.status != Status.SINGULAR) & (slow.status != Status.SINGULAR)
    same &= torch.isfinite(slow.q_nominal).all(
        -1
    )  # beyond the nominal arm's reach each may find another branch
    assert float(same.double().mean()) > (0.8 if way != "branch" else 0.3)
    assert torch.equal(fast.status[same], slow.status[same])
    assert torch.equal(fast.branch[same], slow.branch[same])
    found = same & (fast.status != Status.UNREACHABLE)
    assert_close(fast.q[found], slow.q[found], atol=1e-9)
    known = found & torch.isfinite(slow.q_nominal).all(-1)
    assert_close(fast.q_nominal[known], slow.q_nominal[known], atol=1e-8)
    if ik.model.hybrid is not None:
        assert_close(fast.measure[found], slow.domain_measure[found], atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_nearly_all_poses_are_reached_by_the_fast_way(kind):
    q, T, ik = solved(kind, 1500)
    for near in (None, q + 0.01):
        rows = ik._fast.solve(T, near, ik.order)
        solution = ik(T, near=near)
        share = ik.model.hybrid.coverage.share(solution.q) if ik.model.hybrid else torch.ones(len(T))
        fading = (share > 0) & (share < 1)  # is left to the careful way, as are turns that count
        assert float(rows.done[~fading].double().mean()) > 0.9
        reached = solution.status != Status.UNREACHABLE
        assert float(reached.double().mean()) > 0.998
        error = pose_error(T[reached], ik.model.forward(solution.q[reached]))
        assert_close(error, 0.0, atol=3e-11)


def test_outside_the_measured_joints_the_geometric_arm_takes_over():
    _, _, ik = solved("kiro4 half covered")
    q = joints_of(ik.model.robot, 600, seed=3)
    T = ik.model.forward(q)
    rows = ik._fast.solve(T, q, ik.order)
    share = ik.model.hybrid.coverage.share(rows.q)
    off = rows.done & (share == 0)
    assert int(off.sum()) > 100
    assert bool(
        (rows.status[off] == Status.OUTSIDE_DOMAIN).logical_or(rows.status[off] == Status.SINGULAR).all()
    )
    assert_close(rows.measure[off], 2.0)
    assert_close(ik.model.forward(rows.q[off]), T[off], atol=1e-10)
    assert not bool((rows.done & (share > 0) & (share < 1)).any())


def test_of_branches_the_first_inside_the_limits_is_taken():
    model = calibrated_arm("ur5", hybrid=False)
    q = joints_of(model.robot, 200, seed=5)
    T = model.forward(q)
    every = TorchIK(model).all_branches(T)
    robots = [with_limits(robot, 2, 0.0, 3.2) for robot in (model.robot, model.calibrated)]
    limited = TorchIK(replace(model, robot=robots[0], calibrated=robots[1], branches=("back/elbow_up/flip",)))
    assert limited.branches[limited.order[0]] == "back/elbow_up/flip"
    assert sorted(limited.order) == list(range(8))
    solution = limited(T)
    elbow = every.q[..., 2].remainder(2 * torch.pi)
    inside = (every.status != Status.UNREACHABLE) & (elbow <= 3.2)
    rank = torch.where(inside[:, torch.tensor(limited.order)], torch.arange(8), 8)
    wanted = torch.tensor([*limited.order, -1])[rank.amin(-1)]
    clear = wanted >= 0
    assert float((solution.branch[clear] == wanted[clear]).double().mean()) > 0.94
    outside = ~clear & (every.status != Status.UNREACHABLE).any(-1)
    assert bool((solution.status[outside] == Status.OUTSIDE_JOINT_LIMITS).all())


def test_poses_in_millimetres_and_near_misses_are_unreachable():
    _, T, ik = solved("ur5", 40)
    T[:20, :3, 3] *= 1e3
    T[20:, :3, 3] *= 1.5 * ik.model.robot.reach / T[20:, :3, 3].norm(dim=-1, keepdim=True)
    for near in (None, torch.zeros(6, dtype=torch.float64)):
        solution = ik(T, near=near)
        assert bool((solution.status == Status.UNREACHABLE).all())
        assert bool(solution.q.isnan().all())
        assert bool((solution.branch == ik.order[0]).all())


def test_threads_and_chunks_do_not_change_solutions(monkeypatch):
    q, T, ik = solved("ur5", 400)
    whole = ik(T, near=q + 0.01)
    monkeypatch.setattr("pisigma.inverse.fast_solver.CHUNK", 64)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    parts = ik(T, near=q + 0.01)
    assert torch.equal(whole.status, parts.status)
    assert_close(parts.q.nan_to_num(), whole.q.nan_to_num(), atol=1e-11)
