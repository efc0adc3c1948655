"""Corrected inverse kinematics: identities, batches, branches, wrapping and every status."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import HOMES, hand_made_model, joints_around, poses_around, statuses, with_limits
from testing.refusals import refused

from pisigma.files.errors import ModelError, PoseError
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.numeric_ik import NUMERIC
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import transform_from_xyz_zyx

ROBOTS = tuple(HOMES)


@pytest.fixture(scope="module", params=ROBOTS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def ik(name: str) -> CorrectedIK:
    return CorrectedIK(hand_made_model(name))


def test_correction_is_what_the_network_adds_to_a_nominal_solution(ik, name):
    T = poses_around(name, 20)
    solution = ik(T)
    assert set(statuses(solution)) <= {Status.REACHED, Status.OUTSIDE_DOMAIN}
    assert_close(forward_kinematics(ik.model.robot, solution.q_nominal), T, atol=1e-12)
    assert_close(solution.q - solution.q_nominal, solution.correction, atol=1e-15)
    assert_close(solution.correction, ik.model.network(T, solution.q_nominal), atol=1e-14)
    assert float(solution.correction.abs().max()) > 1e-3


@pytest.mark.parametrize("name", ROBOTS)
def test_a_zero_network_is_the_nominal_robot(name):
    model = hand_made_model(name, scale=0.0)
    q = joints_around(name, 10, seed=4, spread=0.15)
    T = forward_kinematics(model.robot, q)
    solution = CorrectedIK(model)(T)
    assert_close(solution.q, q, atol=1e-11)
    assert_close(solution.correction, 0.0)
    assert_close(CorrectedIK(replace(model, network=None, domain=None))(T).q, solution.q)


def test_the_forward_kinematics_is_inverted(ik, name):
    q = joints_around(name, 4, 5, seed=5, spread=0.15)
    assert_close(ik(ik.model.forward(q)).q, q, atol=1e-9)
    assert_close(ik.model.forward(ik(poses_around(name, 7)).q), poses_around(name, 7), atol=1e-9)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,), (2, 0)])
def test_batched_equals_looped(ik, name, batch):
    T = poses_around(name, *batch)
    solution = ik(T)
    dof = ik.model.robot.dof
    for values in (solution.q, solution.q_nominal, solution.correction):
        assert values.shape == (*batch, dof)
    for values in (solution.branch, solution.status, solution.domain_measure):
        assert values.shape == batch
    flat = T.reshape(-1, 4, 4)
    for index, one in enumerate(flat):
        alone = ik(one)
        assert_close(solution.q.reshape(-1, dof)[index], alone.q, atol=1e-12)
        assert int(solution.status.reshape(-1)[index]) == int(alone.status)
        assert_close(solution.domain_measure.reshape(-1)[index], alone.domain_measure, atol=1e-9)


def test_float32_poses_have_float32_joint_values(ik, name):
    T = poses_around(name, 6)
    exact, rounded = ik(T), ik(T.float())
    for values in (rounded.q, rounded.q_nominal, rounded.correction, rounded.domain_measure):
        assert values.dtype == torch.float32
    assert rounded.status.dtype == torch.int64
    assert_close(rounded.q.double(), exact.q, atol=3e-5)
    of_array = ik(T.float().numpy())
    assert of_array.q.dtype == np.float64
    assert_close(of_array.q, exact.q, atol=3e-5)


def test_float32_joint_values_have_float32_results(ik, name):
    q = joints_around(name, 6)
    for compute in (ik.forward, ik.jacobian):
        assert compute(q.float()).dtype == torch.float32
        assert_close(compute(q.float()).double(), compute(q), atol=1e-5)


def test_a_scara_with_a_tilted_base_accepts_float32_poses():
    robot = Robot.load("kiro3").with_geometry(base=np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
    ik = CorrectedIK(hand_made_model("kiro3", robot=robot))
    T = forward_kinematics(robot, joints_around("kiro3", 5))
    assert Status.UNREACHABLE not in statuses(ik(T.float()))
    assert_close(ik(T.float()).q.double(), ik(T).q, atol=3e-5)


def test_arrays_and_lists_are_accepted(ik, name):
    T = poses_around(name, 2)
    expected = ik(T).q
    assert_close(ik(T.numpy()).q, expected, atol=1e-12)
    assert_close(ik(T.tolist()).q, expected, atol=1e-12)


def test_integers_are_accepted():
    level = [[1, 0, 0, 100], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert CorrectedIK(hand_made_model("kiro4"))(level).status == Status.UNREACHABLE


@pytest.mark.parametrize(
    ("poses", "fields"),
    [
        ([["a"] * 4] * 4, {"expected": "an array of real numbers with lengths in metres"}),
        ([[1.0, 2.0], [3.0]], {"expected": "an array of real numbers with lengths in metres"}),
        (np.eye(3), {"value": (3, 3)}),
        (torch.eye(4, dtype=torch.int64), {"value": torch.int64}),
        (torch.full((2, 4, 4), torch.nan), {"expected": "finite entries"}),
        (2 * torch.eye(4, dtype=torch.float64), {"expected": "the last row 0 0 0 1"}),
        (
            torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])),
            {"expected": "a right-handed rotation part (determinant +1)"},
        ),
        (torch.diag(torch.tensor([1.0, 1.0, 1.1, 1.0])), {"expected": "an orthonormal rotation part"}),
    ],
)
def test_invalid_poses_are_refused(poses, fields):
    with refused(PoseError, option="T_base_tool", **fields):
        CorrectedIK(hand_made_model("kiro3"))(poses)


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
def test_lengths_in_mm_by_mistake_are_unreachable(name):
    T = poses_around(name, 3)
    T[:, :3, 3] *= 1e3
    solution = CorrectedIK(hand_made_model(name))(T)
    assert statuses(solution) == [Status.UNREACHABLE] * 3
    for values in (solution.q, solution.q_nominal, solution.correction, solution.domain_measure):
        assert bool(values.isnan().all())


@pytest.mark.parametrize("name", ROBOTS)
def test_values_are_nan_only_where_unreachable(name):
    generator = torch.Generator().manual_seed(2)
    reach = Robot.load(name).reach
    xyz = reach * (2 * torch.rand(60, 3, generator=generator, dtype=torch.float64) - 1)
    rpy = torch.zeros_like(xyz) if name == "kiro3" else 2 * xyz
    solution = CorrectedIK(hand_made_model(name)).all_branches(
        transform_from_xyz_zyx(torch.cat([xyz, rpy], -1))
    )
    lost = solution.status == Status.UNREACHABLE
    assert bool(lost.any())
    assert bool((~lost).any())
    for values in (solution.q, solution.q_nominal, solution.correction):
        assert torch.equal(values.isnan().any(-1), lost)
    assert torch.equal(solution.domain_measure.isnan(), lost)


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
def test_branches_are_named_and_chosen(name):
    ik = CorrectedIK(hand_made_model(name))
    T = poses_around(name, 3, 2)
    every = ik.all_branches(T)
    assert every.branches == ik.branches == closed_form_solver(ik.model.robot).branches
    assert every.q.shape == (3, 2, len(ik.branches), ik.model.robot.dof)
    for index, branch in enumerate(ik.branches):
        chosen = ik(T, branch=branch)
        assert torch.equal(chosen.branch, torch.full((3, 2), index))
        assert torch.equal(chosen.q.nan_to_num(), every.q[..., index, :].nan_to_num())
        assert torch.equal(chosen.status, every.status[..., index])
    trained = ik.branches.index(ik.model.branches[0])
    assert torch.equal(ik(T).branch, torch.full((3, 2), trained))


def test_other_branches_than_the_trained_are_outside_the_domain():
    ik = CorrectedIK(hand_made_model("kiro3"))
    every = ik.all_branches(poses_around("kiro3"))
    found = dict(zip(every.branches, statuses(every), strict=True))
    assert found == {"elbow_positive": Status.REACHED, "elbow_negative": Status.OUTSIDE_DOMAIN}


@pytest.mark.parametrize("name", ROBOTS)
def test_unknown_branch_is_refused(name):
    with refused(PoseError, option="branch", value="elbow_positve"):
        CorrectedIK(hand_made_model(name))(poses_around(name), branch="elbow_positve")


def bent_ur10() -> Robot:
    """A UR10 with an error in a twist angle, so that it has no closed-form inverse."""
    robot = Robot.load("ur10")
    dh = robot.dh.copy()
    dh[1, 3] += 1e-3
    bent = robot.with_geometry(dh=dh)
    assert closed_form_solver(bent) is None
    return bent


def test_robot_without_closed_form_has_one_branch():
    robot = bent_ur10()
    ik = CorrectedIK(hand_made_model("ur10", robot=robot))
    T = forward_kinematics(robot, joints_around("ur10", 2, 3, seed=3, spread=0.15))
    assert ik.branches == (NUMERIC,)
    every = ik.all_branches(T)
    assert every.q.shape == (2, 3, 1, 6)
    assert_close(every.q[..., 0, :], ik(T, branch=NUMERIC).q)


def test_singular_pose_is_never_hidden():
    stretched = forward_kinematics(
        Robot.load("kiro3"), torch.tensor([0.3, 0.0, -0.1, 0.0], dtype=torch.float64)
    )
    wrist = forward_kinematics(
        Robot.load("kiro4"), torch.tensor([0.2, 0.5, 0.4, 0.3, 0.0, 0.2], dtype=torch.float64)
    )
    for name, T in (("kiro3", stretched), ("kiro4", wrist)):
        solution = CorrectedIK(hand_made_model(name))(T)
        assert statuses(solution) == [Status.SINGULAR]
        assert bool(torch.isfinite(solution.q).all())
        assert float(solution.domain_measure) > 1  # outside the domain as well


def test_far_from_the_rows_is_outside_the_domain(ik, name):
    home = torch.tensor(HOMES[name], dtype=torch.float64)
    home[0] += 1.0
    solution = ik(forward_kinematics(ik.model.robot, home), near=home)
    assert statuses(solution) == [Status.OUTSIDE_DOMAIN]
    assert float(solution.domain_measure) > 1
    assert float(ik(poses_around(name)).domain_measure) <= 1


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("side", [-1, 1])
def test_limits_are_those_of_the_corrected_joints(name, side):
    """If a limit is between the nominal and the corrected value, the commanded (corrected) value is checked."""
    model = hand_made_model(name)
    T = poses_around(name)
    free = CorrectedIK(model)(T)
    middle = float(free.q[1] + free.q_nominal[1]) / 2
    corrected_above = float(free.correction[1]) > 0
    lower, upper = (middle, middle + 3) if side > 0 else (middle - 3, middle)
    ik = CorrectedIK(replace(model, robot=with_limits(model.robot, 1, lower, upper)))
    expected = Status.REACHED if corrected_above == (side > 0) else Status.OUTSIDE_JOINT_LIMITS
    solution = ik(T, near=free.q)
    every = ik.all_branches(T)
    assert_close(solution.q, free.q, atol=1e-10) if expected == Status.REACHED else None
    assert expected in statuses(every)
    index = int(free.branch)
    assert Status(int(every.status[index])) == expected
    assert_close(every.q[index], free.q, atol=1e-10)


def test_singular_pose_with_nominal_joints_outside_the_limits_remains_singular():
    model = hand_made_model("kiro3")
    T = forward_kinematics(model.robot, torch.tensor([0.3, 0.0, -0.1, 0.0], dtype=torch.float64))
    free = CorrectedIK(model)(T)
    middle = float(free.q[1] + free.q_nominal[1]) / 2
    bounds = (middle, 2.0) if float(free.correction[1]) > 0 else (-2.0, middle)
    solution = CorrectedIK(replace(model, robot=with_limits(model.robot, 1, *bounds)))(T)
    assert statuses(solution) == [Status.SINGULAR]


def test_a_correction_beyond_180_deg_is_wrapped_inside_the_limits():
    """A joint with limits of ±180 deg that is corrected from 179.9 to 180.3 deg is commanded to -179.7 deg."""
    model = hand_made_model("kiro4")
    q = torch.tensor(HOMES["kiro4"], dtype=torch.float64).repeat(2, 1)
    q[:, 5] = torch.tensor([math.pi - 1e-4, 1e-4 - math.pi])
    solution = CorrectedIK(model)(forward_kinematics(model.robot, q))
    assert bool((solution.q_nominal.abs() > math.pi).any())  # on the turn of the corrected value
    assert bool((solution.q.abs().nan_to_num() <= math.pi + 1e-9).all())
    assert Status.OUTSIDE_JOINT_LIMITS not in statuses(solution)


def test_network_inputs_are_wrapped_near_the_training_rows():
    """For rows near 180 deg the closed form returns -175 deg where the network learned 185 deg."""
    robot = Robot.load("kiro3")
    names = ("theta_1", "theta_2")
    model = hand_made_model("kiro3", inputs=names)
    shift = torch.tensor([math.pi, 0.0, 0.0, 0.0], dtype=torch.float64)
    rows = model.starts + shift
    T = forward_kinematics(robot, rows)
    around = replace(
        model,
        robot=with_limits(robot, 0, -7.0, 7.0),
        starts=rows,
        domain=type(model.domain).from_rows(
            model.network.scaled_inputs(T, rows), torch.Generator().manual_seed(0)
        ),
    )
    solution = CorrectedIK(around)(T)
    assert bool((solution.q_nominal[:, 0] < 0).any())
    assert set(statuses(solution)) == {Status.REACHED}
    assert_close(solution.correction, model.network(T, rows), atol=1e-12)


def test_numeric_inverse_tries_more_than_one_start():
    """If the nearest start does not converge, others are tried."""
    ik = CorrectedIK(hand_made_model("ur10", robot=bent_ur10()))
    q = joints_around("ur10", 700, seed=9, spread=0.6)
    solution = ik(forward_kinematics(ik.model.robot, q))
    reached = solution.status != Status.UNREACHABLE
    assert float(reached.double().mean()) > 0.97
    assert_close(
        forward_kinematics(ik.model.robot, solution.q_nominal[reached]),
        forward_kinematics(ik.model.robot, q)[reached],
        atol=1e-10,
    )


def test_select_takes_solutions_of_the_first_axis(ik, name):
    solution = ik(poses_around(name, 4, 2))
    part = solution.select(2)
    assert torch.equal(part.q, solution.q[2])
    assert torch.equal(part.status, solution.status[2])
    assert solution.select(slice(1, 3)).q.shape == (2, 2, ik.model.robot.dof)


def test_models_that_do_not_fit_their_robot_are_refused():
    with refused(ModelError, value="elbow_left"):
        CorrectedIK(replace(hand_made_model("kiro3"), branches=("elbow_left",)))
    with refused(ModelError, value="starts"):
        CorrectedIK(
            replace(hand_made_model("ur10", robot=bent_ur10()), starts=torch.zeros(0, 6, dtype=torch.float64))
        )
