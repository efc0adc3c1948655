"""Distribution of a robot's unknowns: conditioning on poses, predictions, and improbable rows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.measurement.dataset import Measurements
from pisigma.planning.robot_posterior import Instrument, RobotPosterior
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def random_joints(robot: Robot, count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, robot.dof, generator=generator, dtype=torch.float64) * 2 - 1) * 2.5


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.load("ur5").with_geometry(tool=np.array([0.06, 0.03, 0.12, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize("kind", ["position", "pose", "distance"])
def test_columns_are_the_derivative_of_the_measured_values(robot: Robot, kind: str) -> None:
    instrument = Instrument(kind, 1e-4, 2e-4, (1.0, 2.0, 0.5))
    posterior = RobotPosterior.from_robot(robot, instrument)
    q = random_joints(robot, 4, 0)
    B = posterior.sensitivities(q)
    assert B.shape[1] == {"position": 3, "pose": 6, "distance": 1}[kind]
    step, index = 1e-6, posterior.uncertainty.space.index("d_1")
    dh = robot.dh.copy()
    dh[0, 1] += step
    T = [forward_kinematics(one, q)[:, :3, 3] for one in (robot, robot.with_geometry(dh=dh))]
    size = posterior.uncertainty.dense_root[index, index]
    if kind == "distance":
        lengths = [(position - torch.tensor(instrument.anchor)).norm(dim=1) for position in T]
        moved = ((lengths[1] - lengths[0]) / step)[:, None]
    else:
        moved = (T[1] - T[0]) / step
    assert_close(B[:, :3, index], moved * size / 1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", ["position", "distance"])
def test_noise_of_an_arm_of_servos_includes_the_repeatability_of_its_joints(kind: str) -> None:
    so101, instrument = Robot.load("so101"), Instrument(kind, 1e-3, anchor=(0.5, 0.1, 0.0))
    q = random_joints(so101, 3, 0) / 2
    B = RobotPosterior.from_robot(so101, instrument).sensitivities(q)
    exact = RobotPosterior.from_robot(replace(so101, maker=""), instrument)
    joints = [exact.uncertainty.space.index(f"theta_{number}") for number in range(1, 6)]
    for row, values in enumerate(exact.pose_derivatives(q)[:, :3]):
        away = forward_kinematics(so101, q[row])[:3, 3] - torch.tensor(instrument.anchor)
        X = values if kind == "position" else (away / away.norm())[None] @ values
        J = X[:, joints]
        C = 1e-6 * torch.eye(len(X)) + np.deg2rad(0.5) ** 2 * J @ J.mT
        X = X @ RobotPosterior.from_robot(so101, instrument).uncertainty.dense_root
        assert_close(B[row].mT @ B[row], X.mT @ torch.linalg.solve(C, X), rtol=1e-6, atol=1e-6)


def test_conditioning_agrees_with_a_normal_distribution(robot: Robot) -> None:
    posterior = RobotPosterior.from_robot(robot, hybrid=False)
    q, task = random_joints(robot, 20, 1), random_joints(robot, 30, 2)
    A = posterior.pose_derivatives(q)[:, :3].flatten(0, 1)
    C = posterior.uncertainty.dense_root.square()
    expected = torch.linalg.inv(torch.linalg.inv(C) + A.t() @ A / posterior.instrument.sigma**2)
    root = posterior.after_measuring(q).uncertainty.dense_root
    scale = expected.diagonal().sqrt()
    assert_close(root @ root.t() / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-6)
    # What is measured first and what is measured second may be exchanged.
    halves = posterior.after_measuring(q[:8]).after_measuring(q[8:]).sigma(task)
    assert_close(halves, posterior.after_measuring(q).sigma(task), rtol=1e-6)


def test_few_rows_are_conditioned_on_without_a_fit(robot: Robot) -> None:
    posterior, q = RobotPosterior.from_robot(robot), random_joints(robot, 2, 3)
    rows = Measurements(q=q, position=forward_kinematics(robot, q)[:, :3, 3])
    task = random_joints(robot, 5, 4)
    assert_close(
        posterior.calibrated_with(rows).sigma(task), posterior.after_measuring(q).sigma(task), rtol=1e-9
    )


def test_distances_do_not_determine_the_pose_of_the_base(robot: Robot) -> None:
    known = RobotPosterior.from_robot(robot, Instrument("distance", anchor=(1.5, -1.0, 0.3)), hybrid=False)
    q = torch.rand(40, robot.dof, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    after = known.after_measuring(q).sigma(q)
    assert bool((after < 0.5 * known.sigma(q)).all())
    assert float(after.max()) < 5e-3


def test_unknown_base_and_tool_have_a_wide_prior(robot: Robot) -> None:
    """In another frame, at another target, with nothing known of either."""
    base, tool = (np.array([0.3, -0.2, 0.1, *angles]) for angles in ((0.1, 0.2, 3.0), (0.5, -0.3, 0.2)))
    q = torch.linspace(-1, 1, 5 * robot.dof, dtype=torch.float64).view(5, robot.dof)
    unknown = RobotPosterior.from_robot(robot, hybrid=False).with_unknown_base_and_tool(base, tool)
    expected = RobotPosterior.from_robot(robot.with_geometry(base=base, tool=tool), hybrid=False)
    for D, reference in (
        (unknown.tool_derivatives(q), expected.tool_derivatives(q)),
        (unknown.sensitivities(q), expected.sensitivities(q)),
    ):
        assert_close(D @ D.mT, reference @ reference.mT, rtol=1e-9)
