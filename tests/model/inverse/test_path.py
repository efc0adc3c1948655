"""Joint values along paths are continuous, on as few branches as possible, and all discontinuities are reported."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, no_type_checker, with_limits
from testing.refusals import numbers_in, refused

from pisigma.files.errors import PoseError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.path import JUMP, choose_branches, is_jump, poses_halfway, unwrap_path, wrap_motion
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

STATUS = int(Status.REACHED)


def calibrated(name, seed=0):
    """A robot with errors of 0.5 mm and 0.5 mrad, with starts throughout its joint limits."""
    rng = np.random.default_rng(seed)
    nominal = Robot.load(name)
    robot = nominal.with_geometry(dh=nominal.dh + 5e-4 * rng.normal(size=nominal.dh.shape))
    limits = np.clip(nominal.limits, -math.pi, math.pi)
    starts = torch.from_numpy(rng.uniform(limits[:, 0], limits[:, 1], (200, nominal.dof)))
    return CalibratedModel(name, "test", nominal, None, None, (), starts, calibrated=robot)


@pytest.fixture(scope="module")
def arms():
    made = {}

    def make(name):
        if name not in made:
            with no_type_checker():
                made[name] = CorrectedIK(calibrated(name))
        return made[name]

    return make


def joint_line(start, stop, poses):
    return np.asarray(start) + np.linspace(0, 1, poses)[:, None] * (np.asarray(stop) - np.asarray(start))


def poses_of(ik, q):
    with no_type_checker():
        return ik.model.forward(torch.from_numpy(q)).numpy()


def follow(ik, T, **options):
    with no_type_checker():
        return ik.path(T, **options)


SIX = [-2.0, -1.2, 1.0, -0.8, 1.1, -2.5], [1.5, -0.6, 1.9, 0.9, 1.4, 2.0]
SEVEN = [-1.0, 0.3, 0.4, -1.6, 0.2, 1.8, 0.5], [0.9, 0.9, -0.2, -1.1, -0.4, 2.2, 1.2]
LINES = {"ur5": SIX, "rb5": SIX, "panda": SEVEN}


@pytest.mark.parametrize("name", LINES)
def test_a_line_of_joint_values_is_found_again(name, arms):
    ik = arms(name)
    q = joint_line(*LINES[name], 400)
    found = follow(ik, poses_of(ik, q), near=q[0])
    smooth = [(switch.kind, switch.jump) for switch in found.switches]
    assert smooth == ([("branch", 0.0)] if name == "rb5" else [])  # its shoulder passes its own axis
    assert (found.solution.status == STATUS).all()
    if name != "panda":
        assert_close(found.solution.q, q, atol=1e-9)
    else:  # a redundant arm has other ways to the same poses, but none of them jumps
        assert np.abs(np.diff(found.solution.q, axis=0)).max() < 3 * np.abs(np.diff(q, axis=0)).max()
    assert found.solution.position_residual.max() < 1e-9


def test_ten_thousand_poses_on_a_circle(arms):
    ik = arms("ur5")
    middle = poses_of(ik, np.array([[0.4, -1.4, 1.9, -0.9, 1.2, 0.3]]))[0]
    turn = np.linspace(0, 6 * math.pi, 10_000)
    T = np.tile(middle, (len(turn), 1, 1))
    T[:, 0, 3] += 0.08 * (np.cos(turn) - 1)
    T[:, 1, 3] += 0.08 * np.sin(turn)
    found = follow(ik, T)
    assert found.switches == ()
    steps = np.abs(np.diff(found.solution.q, axis=0)).max(0)
    assert (steps < 2e-3).all()
    assert np.unique(found.solution.branch).size == 1
    assert_close(found.solution.q[0], found.solution.q[-1], atol=1e-9)


def test_the_requested_branch_is_used(arms):
    ik = arms("ur5")
    T = poses_of(ik, joint_line(*SIX, 50)[:10])
    for name in ik.branches:
        found = follow(ik, T, branch=name)
        assert {ik.branches[index] for index in found.solution.branch} == {name}


def test_a_wrist_that_passes_straight_does_not_flip(arms):
    """At joint 5 = 0 the nominal branch changes its name while the joints are continuous."""
    ik = arms("ur5")
    q = joint_line([0.3, -1.1, 1.4, -0.9, 0.8, 0.3], [0.7, -0.9, 1.2, -0.7, -0.8, 0.5], 301)
    found = follow(ik, poses_of(ik, q), near=q[0])
    assert [switch.kind for switch in found.switches] == ["branch"]
    assert found.switches[0].jump == 0
    assert abs(found.switches[0].index - 150) <= 1
    assert np.abs(np.diff(found.solution.q, axis=0)).max() < 0.1


def narrow(index, limit):
    """A UR5 with narrower limits of one joint."""
    with no_type_checker():
        model = calibrated("ur5")
        robots = [with_limits(robot, index, -limit, limit) for robot in (model.robot, model.calibrated)]
        return CorrectedIK(
            CalibratedModel("narrow", "test", robots[0], None, None, (), model.starts, calibrated=robots[1])
        )


def test_a_jump_that_cannot_be_avoided():
    """The path circles the base farther than its joint can turn, with the shoulder in front as well as behind."""
    ik = narrow(0, 2.9)
    q = np.tile([0.0, -1.1, 1.4, -0.9, 1.2, 0.0], (300, 1))
    q[:, 0] = np.linspace(2.0, 8.0, 300)
    found = follow(ik, poses_of(ik, q))
    assert (found.solution.status == STATUS).all()
    assert (np.abs(found.solution.q[:, 0]) <= 2.9 + 1e-9).all()
    (switch,) = found.switches
    assert switch.kind == "branch"
    assert 3.38 < q[switch.index, 0] < 6.05
    step = np.abs(np.diff(found.solution.q, axis=0)).max(-1)
    assert_close(switch.jump, step[switch.index - 1])
    assert np.delete(step, switch.index - 1).max() < 0.05
    assert numbers_in(switch.sentence)[0] == switch.index
    assert all(name in switch.sentence for name in (ik.branches[found.solution.branch[0]], "theta_1"))


def test_poses_out_of_reach_are_reported_and_the_others_solved(arms):
    ik = arms("ur5")
    q = joint_line(*SIX, 100)
    T = poses_of(ik, q)
    T[40:43, :3, 3] *= 100
    T[99, :3, 3] *= 100
    found = follow(ik, T, near=q[0])
    assert [(switch.index, switch.kind) for switch in found.switches] == [(40, "gap"), (99, "gap")]
    assert [numbers_in(switch.sentence) for switch in found.switches] == [[40, 42], [99]]
    assert all(Status.UNREACHABLE.name.lower() in switch.sentence for switch in found.switches)
    rest = np.isfinite(found.solution.q).all(-1)
    assert rest.sum() == 96
    assert_close(found.solution.q[rest], q[rest], atol=1e-9)


def test_nothing_is_reached(arms):
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, 0, 3] = 50.0
    for name in ("ur5", "panda"):
        found = follow(arms(name), T)
        assert [(switch.kind, numbers_in(switch.sentence)) for switch in found.switches] == [("gap", [0, 4])]
        assert np.isnan(found.solution.q).all()


def test_a_joint_starts_at_a_wrap_that_fits_the_whole_path(arms):
    """One and a half turns of the last joint fit between -2π and 2π only if they start below -π."""
    ik = arms("ur5")
    q = np.tile([0.4, -1.1, 1.4, -0.9, 1.2, 0.0], (200, 1))
    q[:, 5] = np.linspace(0, 3 * math.pi, 200)
    found = follow(ik, poses_of(ik, q), near=q[0])
    assert found.switches == ()
    assert_close(found.solution.q[:, 5], q[:, 5] - 2 * math.pi, atol=1e-9)


def test_a_joint_is_rewound_where_its_limits_require_it():
    ik = narrow(5, 4.0)
    q = np.tile([0.4, -1.1, 1.4, -0.9, 1.2, 0.0], (300, 1))
    q[:, 5] = np.linspace(0, 3 * math.pi, 300)
    found = follow(ik, poses_of(ik, q), near=q[0])
    assert [switch.kind for switch in found.switches] == ["turn"]
    assert_close(found.switches[0].jump, 2 * math.pi, atol=1e-6)
    assert [abs(number) for number in numbers_in(found.switches[0].sentence)][-1] == 360
    assert (np.abs(found.solution.q[:, 5]) <= 4.0 + 1e-9).all()
    assert (found.solution.status == STATUS).all()


def test_a_model_with_a_network():
    with no_type_checker():
        model = hand_made_model("kiro3")
        ik = CorrectedIK(model)
        q = (
            model.starts[:1].double().numpy()
            + np.linspace(0, 0.2, 50)[:, None] * [1.0, -1.0, 0.0, 0.5][: model.robot.dof]
        )
        T = forward_kinematics(model.robot, torch.from_numpy(q)).numpy()
    found = follow(ik, T, near=q[0])
    assert_close(found.solution.q_nominal, q, atol=1e-9)
    assert [switch for switch in found.switches if switch.kind != "branch"] == []


@pytest.mark.parametrize(
    ("T", "options", "fields"),
    [
        (np.eye(4), {}, {"option": "T_base_tool", "value": (4, 4)}),
        (np.zeros((0, 4, 4)), {}, {"option": "T_base_tool", "value": (0, 4, 4)}),
        (np.full((2, 4, 4), np.nan), {}, {"option": "T_base_tool", "expected": "finite entries"}),
        (np.tile(np.eye(4), (2, 1, 1)), {"branch": "sideways"}, {"option": "branch", "value": "sideways"}),
    ],
)
def test_invalid_paths_are_refused(arms, T, options, fields):
    with refused(PoseError, **fields):
        follow(arms("ur5"), T, **options)


def cost(way, q, jumps, first, revolute):
    """The cost that `choose_branches` minimises, pose by pose."""
    total = first[way[0]] + 1e12 * sum(not np.isfinite(q[i, branch]).all() for i, branch in enumerate(way))
    for i in range(1, len(way)):
        step = wrap_motion(q[i, way[i]] - q[i - 1, way[i - 1]], revolute)
        far = jumps[i - 1, way[i]] if way[i] == way[i - 1] else np.abs(step).max() > 0.1
        total += np.nan_to_num((step**2).sum(), nan=0.0) + JUMP * far
    return total


def test_branches_have_the_least_cost():
    """Dynamic programming agrees with an exhaustive search."""
    rng = np.random.default_rng(5)
    revolute = np.array([True, False])
    for _ in range(30):
        q = rng.uniform(-4, 4, (5, 3, 2))
        q[rng.uniform(size=(5, 3)) < 0.15] = np.nan
        status = np.full((5, 3), STATUS)
        jumps, first = rng.uniform(size=(4, 3)) < 0.3, rng.uniform(0, 5, 3)

        ways = np.stack(np.meshgrid(*[range(3)] * 5), -1).reshape(-1, 5)
        best = min(cost(way, q, jumps, first, revolute) for way in ways)
        chosen = choose_branches(q, status, jumps, first, revolute)
        assert_close(cost(chosen, q, jumps, first, revolute), best, rtol=1e-12)


def test_unwrapping_agrees_with_an_exhaustive_search():
    limits, revolute = np.array([[-7.0, 7.0], [-1.0, 1.0]]), np.array([True, False])
    rng = np.random.default_rng(6)
    for _ in range(40):
        smooth = np.cumsum(rng.uniform(-0.4, 0.5, 60))
        q = np.stack([np.mod(smooth, 2 * math.pi), np.zeros(60)], -1)
        rolled, rewinds = unwrap_path(q, limits, revolute, None)
        assert (np.abs(rolled[:, 0]) <= 7.0 + 1e-8).all()
        assert_close(np.exp(1j * rolled[:, 0]), np.exp(1j * smooth), atol=1e-9)
        broken = np.flatnonzero(np.abs(np.diff(rolled[:, 0])) > 1) + 1
        assert [pose for pose, _ in rewinds] == broken.tolist()
        span = smooth.max() - smooth.min()
        fits = any(
            smooth.min() + 2 * math.pi * k >= -7 and smooth.max() + 2 * math.pi * k <= 7 for k in range(-9, 9)
        )
        assert (len(broken) == 0) == fits, span


def test_halfway():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(7)
    first = Rotation.from_rotvec(rng.normal(size=(20, 3)))
    step = Rotation.from_rotvec(0.5 * rng.normal(size=(20, 3)))
    T, U = np.tile(np.eye(4), (20, 1, 1)), np.tile(np.eye(4), (20, 1, 1))
    T[:, :3, :3], U[:, :3, :3] = first.as_matrix(), (first * step * step).as_matrix()
    T[:, :3, 3], U[:, :3, 3] = rng.normal(size=(2, 20, 3))
    middle = poses_halfway(T, U)
    assert_close(middle[:, :3, :3], (first * step).as_matrix(), atol=1e-12)
    assert_close(middle[:, :3, 3], (T[:, :3, 3] + U[:, :3, 3]) / 2)


def test_is_jump():
    revolute = np.array([True])
    for before, middle, after, expected in (
        (0.0, 0.5, 1.0, False),
        (0.0, 3.0, 1.0, True),
        (3.1, -3.1, -2.9, False),
        (0.0, np.nan, 1.0, True),
        (0.0, np.nan, 0.05, False),
    ):
        assert is_jump(*(np.array([v]) for v in (before, middle, after)), revolute) == expected
