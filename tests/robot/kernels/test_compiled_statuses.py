"""Choice of the branch if none is requested, and statuses of invalid poses."""

from dataclasses import replace

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.models import hand_made_model, joints_around, no_type_checker, with_limits
from testing.refusals import numbers_in, refused

from pisigma.files.errors import PoseError
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

FINE = (Status.REACHED, Status.SINGULAR, Status.OUTSIDE_DOMAIN)


def _first(every, order):
    """Return the index of the branch to select for every pose from solutions on all branches."""
    chosen = []
    for status in every.status:
        fine = [branch for branch in order if status[branch] in FINE]
        outside = [branch for branch in order if status[branch] == Status.OUTSIDE_JOINT_LIMITS]
        chosen.append([*fine, *outside, order[0]][0])
    return np.array(chosen)


def _narrow(model):
    """Return the model with limits that many solutions exceed."""
    robots = [model.robot, model.calibrated]
    for joint, bounds in ((1, (-2.0, 0.5)), (2, (-1.0, 2.5)), (5, (-2.0, 2.0))):
        robots = [robot and with_limits(robot, joint, *bounds) for robot in robots]
    return replace(model, robot=robots[0], calibrated=robots[1])


@pytest.mark.parametrize("case", ["geometric", "hybrid", "network"])
def test_branches_are_tried_in_the_order_of_training_rows_and_limits_count(case, arms):
    if case == "network":
        model = _narrow(hand_made_model("ur10"))
        T = forward_kinematics(model.robot, joints_around("ur10", 150, seed=3, spread=1.5)).numpy()
    else:
        model = arms.calibrated("ur5", hybrid=case == "hybrid")
        T = model.forward(arms.draw_joints(model.robot, 150, seed=21)).numpy()
        model = _narrow(model)
    names = CompiledIK.from_model(model).branches
    trained = (5, 2, 6)
    kernels = CompiledIK.from_model(replace(model, branches=tuple(names[index] for index in trained)))
    order = [*trained, *(index for index in range(len(names)) if index not in trained)]
    every, found = kernels.all_branches(T), kernels.solve_batch(T)
    chosen = _first(every, order)
    assert len(set(chosen.tolist())) > 4
    rows = np.arange(len(T))
    solved = every.status[rows, chosen] != Status.UNREACHABLE
    same = solved & (found.branch == chosen)
    assert (
        same.sum() > 0.97 * solved.sum()
    )  # a branch that only the calibrated arm has comes after all others
    assert np.isin(found.status[solved & ~same], FINE).all()
    assert np.array_equal(found.status[same], every.status[rows, chosen][same])
    assert_close(found.q[same], every.q[rows, chosen][same], atol=1e-9)
    assert {Status.OUTSIDE_JOINT_LIMITS} < set(found.status.tolist())
    assert (found.status == Status.UNREACHABLE).sum() <= (~solved).sum()


def test_all_branches_agree_with_torch_and_with_single_branches(arms):
    model, kernels = arms.calibrated("ur5"), arms.compiled("ur5")
    T = model.forward(arms.draw_joints(model.robot, 30, seed=22))
    found = kernels.all_branches(T.numpy())
    with no_type_checker():
        expected = NumericIK(model).all_branches(T)
    assert found.q.shape == (30, 8, 6)
    assert len(found.sentences) == 240
    both = np.isfinite(found.q).all(-1) & np.isfinite(expected.q.numpy()).all(-1)
    assert both.sum() > 0.98 * np.isfinite(expected.q.numpy()).all(-1).sum()
    assert np.median(np.abs(found.q - expected.q.numpy())[both].max(-1)) < 1e-11
    assert np.array_equal(found.branch, np.broadcast_to(np.arange(8), (30, 8)))
    for index, branch in enumerate(kernels.branches):
        alone = kernels.solve_batch(T.numpy(), branch=branch)
        assert np.array_equal(alone.q, found.q[:, index], equal_nan=True)


BAD = {
    "nan": np.where(np.eye(4) == 0, np.nan, 1.0),
    "scaled": np.diag([2.0, 2.0, 2.0, 1.0]),
    "mirrored": np.diag([1.0, 1.0, -1.0, 1.0]),
    "last row": 2 * np.eye(4),
    "text": [["a"] * 4] * 4,
}


@pytest.mark.parametrize("case", BAD)
def test_control_loops_get_a_status_instead_of_an_exception(case, arms):
    kernels, model = arms.compiled("ur5"), arms.calibrated("ur5")
    found = kernels.solve(BAD[case], throw=False)
    assert found.status == Status.INVALID_POSE
    assert np.isnan(found.q).all()
    assert np.isnan(found.q_nominal).all()
    assert np.isnan([found.position_residual, found.rotation_residual, found.domain_measure]).all()
    assert found.sentences[0] == Status.INVALID_POSE.sentence
    assert not Status(found.status).reaches
    if case != "text":
        T = model.forward(arms.draw_joints(model.robot, 5, seed=23)).numpy()
        T[3] = BAD[case]
        some, whole = kernels.solve_batch(T, throw=False), kernels.solve_batch(T[[0, 1, 2, 4]])
        assert np.flatnonzero(some.status == Status.INVALID_POSE).tolist() == [3]
        assert np.array_equal(some.q[[0, 1, 2, 4]], whole.q, equal_nan=True)
        every = kernels.all_branches(T, throw=False)
        assert (every.status[3] == Status.INVALID_POSE).all()
        assert every.branch[3].tolist() == list(range(8))
        with refused(PoseError, option="T_base_tool") as caught:
            kernels.all_branches(T)
        assert numbers_in(str(caught.value))[-1] == 3  # the index


def test_joint_values_that_are_not_finite_have_a_status(arms):
    kernels, model = arms.compiled("ur5"), arms.calibrated("ur5")
    q = arms.draw_joints(model.robot, 4, seed=24).numpy()
    T = model.forward(arms.draw_joints(model.robot, 4, seed=24)).numpy()
    q[2, 1] = np.inf
    found = kernels.solve_batch(T, near=q, throw=False)
    assert np.flatnonzero(found.status == Status.INVALID_POSE).tolist() == [2]
    assert found.sentences[2] == Status.INVALID_POSE.sentence
    assert kernels.solve(T[2], near=q[2], throw=False).status == Status.INVALID_POSE
    with pytest.raises(PoseError, match=r"^near: .* 2; "):
        kernels.solve_batch(T, near=q)


@pytest.mark.parametrize("values", [np.eye(3), [[1.0], [1.0, 2.0]], np.zeros(0)])
def test_invalid_shapes_raise_even_without_throw(values, arms):
    with pytest.raises(PoseError):
        arms.compiled("ur5").solve(values, throw=False)
    with pytest.raises(PoseError):
        arms.compiled("ur5").solve(np.eye(4), near=values, throw=False)
