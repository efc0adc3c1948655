from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from testing.closeness import assert_close
from testing.simulated_arm import BASE, TOOL, draw_joints

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.pairwise import find_pairwise_redundancy
from pisigma.calibration.geometric.identifiability.redundancy import find_redundancy, pivoted_qr
from pisigma.calibration.geometric.problem.information import Information, information
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian

# Park et al. 2022, J. KSPE 39(7), 517, section 4.2; the ranks were worked out from its robots.
PAPER = {
    "rb5": {
        "sets": (
            ("a_6", "a_EE"),
            ("d_2", "d_3", "d_4"),
            ("d_6", "d_EE"),
            ("theta_1", "beta_1"),
            ("theta_4", "-beta_4"),
            ("theta_5", "beta_5"),
        ),
        "no_effect": ("alpha_6", "alpha_EE", "theta_6", "theta_EE", "beta_6", "beta_EE"),
        "left": 28,
        "rank": 20,
    },
    "panda": {
        "sets": (
            ("a_7", "a_EE"),
            ("d_7", "d_EE"),
            ("theta_1", "beta_1"),
            ("theta_2", "-beta_2"),
            ("theta_5", "beta_5"),
        ),
        "no_effect": ("alpha_7", "alpha_EE", "theta_7", "theta_EE", "beta_7", "beta_EE"),
        "left": 35,
        "rank": 24,
    },
}


def condensed(
    robot: Robot, seed: int, rows: int, poses: bool, arm_only: bool
) -> tuple[Information, np.ndarray]:
    """The condensed Jacobian at the robot's own parameters, and their values."""
    rng = np.random.default_rng(seed)
    q = torch.from_numpy(rng.uniform(*robot.limits.T, (rows, robot.dof)))
    T = forward_kinematics(robot, q)
    data = Measurements(
        q=q, position=T[:, :3, 3].contiguous(), rotation=T[:, :3, :3].contiguous() if poses else None
    )
    setup = GeometricCalibrator(robot, base="fixed", tool="fixed").build(data)
    count = setup.problem.space.arm_parameter_count if arm_only else len(setup.start)
    at_start = information(setup.problem, setup.start, list(range(count)))
    return at_start, setup.start.numpy()[:count]


@pytest.mark.parametrize("name", sorted(PAPER))
@pytest.mark.parametrize("seed", range(4))
def test_the_papers_sets_are_found_exactly(name: str, seed: int) -> None:
    seen, sizes = condensed(Robot.load(name), seed, rows=40, poses=False, arm_only=True)
    pairwise = find_pairwise_redundancy(seen, sizes)
    exact = find_redundancy(seen, sizes)
    assert pairwise.sets == PAPER[name]["sets"]
    assert pairwise.no_effect == PAPER[name]["no_effect"]
    assert len(pairwise.kept) == PAPER[name]["left"]
    assert exact.rank == len(exact.kept) == PAPER[name]["rank"]
    assert set(exact.no_effect) == set(pairwise.no_effect)


@pytest.mark.parametrize(
    ("name", "rank"), [("ur10", 27), ("rb5", 27), ("panda", 31), ("kiro3", 17), ("fanuc_r2000", 27)]
)
@pytest.mark.parametrize("poses", [True, False])
def test_rank_with_base_and_tool_is_4r_2p_3(name: str, rank: int, poses: bool) -> None:
    robot = Robot.load(name).with_geometry(base=BASE, tool=TOOL)
    seen, sizes = condensed(robot, 0, rows=60, poses=poses, arm_only=False)
    redundancy = find_redundancy(seen, sizes)
    turning, sliding = robot.revolute.count(True), robot.revolute.count(False)
    assert rank == 4 * turning + 2 * sliding + 3
    assert redundancy.rank == rank + 3 * poses
    assert redundancy.no_effect == (() if poses else ("tool_roll", "tool_pitch", "tool_yaw"))


@pytest.mark.parametrize("name", ["ur10", "rb5", "panda", "kiro3"])
@pytest.mark.parametrize("poses", [True, False])
@pytest.mark.parametrize(("frames", "targets"), [(1, 1), (2, 1), (1, 2), (1, 3), (3, 2)])
def test_no_more_is_independent_than_axes_targets_and_frames_have(
    name: str, poses: bool, frames: int, targets: int
) -> None:
    """If no axes are parallel or intersect, this maximum is attained."""
    robot, rng = Robot.load(name), np.random.default_rng(frames + 10 * targets)
    robot = robot.with_geometry(robot.dh + 0.1 * rng.standard_normal(robot.dh.shape), BASE, TOOL)
    q = torch.from_numpy(rng.uniform(*robot.limits.T, (40 * frames * targets, robot.dof)))
    T = forward_kinematics(robot, q)
    data = Measurements(
        q=q,
        position=T[:, :3, 3].contiguous(),
        rotation=T[:, :3, :3].contiguous() if poses else None,
        frame=tuple(f"frame {row % frames}" for row in range(len(q))),
        target=tuple(f"target {row // frames % targets}" for row in range(len(q))),
    )
    setup = GeometricCalibrator(robot).build(data)
    problem, point = setup.problem, setup.start.clone()
    tools = problem.space.indices_of("tool")
    point[list(tools)] += 0.1 * torch.from_numpy(rng.standard_normal(len(tools)))
    seen = information(problem, point, list(range(len(point))))
    found = find_redundancy(seen, point.numpy())
    assert found.rank == problem.space.max_identifiable(with_orientation=poses)


@pytest.mark.parametrize("name", ["ur10", "panda", "kiro3"])
def test_every_dependency_holds(name: str) -> None:
    robot = Robot.load(name).with_geometry(tool=TOOL)
    seen, sizes = condensed(robot, 1, rows=30, poses=True, arm_only=False)
    redundancy = find_redundancy(seen, sizes)
    names = redundancy.names
    usual = np.array([parameter.usual_error for parameter in seen.parameters])
    J = seen.jacobian / usual
    # A removed parameter is undone by what it adds to the kept ones.
    for removed in redundancy.removed:
        change = np.zeros(len(names))
        change[names.index(removed)] = 1.0
        for dependency in redundancy.dependencies:
            if removed in dependency.names:
                place = dependency.names.index(removed)
                change[names.index(dependency.names[0])] -= dependency.coefficients[place]
        assert_close(J @ change, 0.0, atol=1e-5 * np.linalg.norm(J[:, names.index(removed)]))


def test_dependencies_are_described_and_preferred_parameters_kept() -> None:
    seen, sizes = condensed(Robot.load("rb5"), 0, rows=40, poses=False, arm_only=True)
    redundancy = find_redundancy(seen, sizes)
    assert (
        redundancy.dependency_sentence_of("d_3")
        == "d_2 + d_3 + d_4 is identified; the individual values are not"
    )
    assert (
        redundancy.dependency_sentence_of("beta_4")
        == "theta_4 - beta_4 is identified; the individual values are not"
    )
    assert redundancy.dependency_sentence_of("a_2") is None
    assert {"theta_1", "theta_4", "d_4", "a_6"} <= set(redundancy.kept)
    assert {"beta_1", "beta_4", "d_2", "d_3", "a_EE"} <= set(redundancy.removed)


def test_correlations_are_pearsons() -> None:
    robot = Robot.load("panda").with_geometry(tool=TOOL)
    seen, sizes = condensed(robot, 2, rows=50, poses=False, arm_only=True)
    tables = find_pairwise_redundancy(seen, sizes)
    q = torch.from_numpy(np.random.default_rng(2).uniform(*robot.limits.T, (50, 7)))
    J = identification_jacobian(robot, q)[1][:, :3].flatten(0, 1).numpy()
    for table in (tables.lengths, tables.angles):
        columns = [seen.names.index(name) for name in table.names]
        assert_close(np.nan_to_num(table.values), np.nan_to_num(np.corrcoef(J[:, columns].T)), atol=1e-12)
    text = str(tables.lengths)
    assert text.splitlines()[0].split() == list(tables.lengths.names)
    assert "1.000" in text


@given(st.integers(1, 8), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_pivots_span_the_columns(rank: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(12, rank)) @ rng.normal(size=(rank, 8))
    pivots = pivoted_qr(A)[1][:rank]
    assert len(set(pivots.tolist())) == rank
    basis, _ = np.linalg.qr(A[:, pivots])
    assert_close(A - basis @ (basis.T @ A), 0.0, atol=1e-6 * float(np.abs(A).max()))


@pytest.mark.parametrize("smallest", [1.0, 1e-3, 3e-6, 1e-6, 3e-7, 1e-9, 0.0])
def test_the_rank_counts_the_singular_values_above_the_tolerance(smallest: float) -> None:
    seen, sizes = condensed(Robot.load("rb5"), 3, rows=40, poses=False, arm_only=True)
    redundancy = find_redundancy(seen, sizes)
    kept, removed = (
        [seen.names.index(name) for name in names] for names in (redundancy.kept, redundancy.removed)
    )
    root = seen.root.copy()
    beside = np.linalg.qr(np.column_stack([root[:, kept], np.ones(len(root))]))[0][:, -1]
    length = np.linalg.norm(root[:, removed[0]])
    root[:, removed[0]] += smallest * length * beside
    changed = find_redundancy(replace(seen, root=root), sizes)
    values = changed.singular_values
    assert changed.rank == int((values > changed.tolerance * values[0]).sum())
    assert changed.rank == len(changed.kept)


def test_joint_values_come_from_the_limits() -> None:
    robot = Robot.load("panda")
    q = draw_joints(robot, 100, np.random.default_rng(0)).numpy()
    assert ((q >= robot.limits[:, 0]) & (q <= robot.limits[:, 1])).all()


def test_column_of_zeros_before_a_dependent_one_has_no_effect():
    parameters = ParameterSpace(Robot.load("ur5")).parameters[:3]
    root = np.array([[1.0, 0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0, 0.0]])
    found = find_redundancy(Information(parameters, root, 10, 5), np.zeros(3))
    names = [parameter.name for parameter in parameters]
    assert found.no_effect == (names[1],)
    assert sorted((*found.kept, *found.removed)) == sorted((names[0], names[2]))
