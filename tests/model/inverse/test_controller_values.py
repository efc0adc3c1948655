"""Coupled joints are measured, calibrated and solved in the controller's values."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.coupled import coupled_robot
from testing.refusals import refused

import pisigma
from pisigma.files.errors import ModelError
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kinematics.status import Status
from pisigma.simulation.errors.geometric import RandomGeometricDeviation
from pisigma.simulation.measure import simulate
from pisigma.simulation.poses import JointsRandom
from pisigma.simulation.true_robot import TrueRobot

SLIPS = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=3, length_mm=0.3, angle_deg=0.02
)


@pytest.fixture(scope="module")
def true() -> TrueRobot:
    return TrueRobot(coupled_robot(), (SLIPS,))


@pytest.fixture(scope="module")
def ik(true: TrueRobot, tmp_path_factory: pytest.TempPathFactory) -> CorrectedIK:
    """Corrected inverse kinematics of a stored model that was calibrated from a file of the controller's values."""
    folder = tmp_path_factory.mktemp("coupled")
    q = JointsRandom(kind="joints_random", count=60, seed=1).joints(true.nominal)
    simulate(true, q, "position").write_csv(folder / "rows.csv", true.nominal)
    settings = pisigma.CalibrationSettings(model="geometric", folds=0)
    pisigma.calibrate(true.nominal, folder / "rows.csv", settings).save(folder / "model")
    return pisigma.load(folder / "model")


@pytest.fixture(scope="module")
def q(true: TrueRobot) -> np.ndarray:
    """Values of the controller at poses that the arm reaches within its limits."""
    drawn = JointsRandom(kind="joints_random", count=40, seed=2).joints(true.nominal)
    return true.nominal.to_controller(drawn).numpy()


def test_the_calibrated_arm_has_the_poses_of_the_true_one(ik, true, q):
    expected = true.forward(true.nominal.to_dh(torch.from_numpy(q)))
    assert_close(ik.forward(q)[:, :3, 3], expected[:, :3, 3], atol=1e-9)


def test_solutions_are_the_controllers_values_within_its_limits(ik, true, q):
    T = ik.forward(q)
    near = ik(T, near=q)
    assert_close(near.q, q, atol=1e-9)
    assert (near.status == Status.REACHED).all()
    free = ik(T)
    lower, upper = true.nominal.axis_limits.T
    assert ((free.q >= lower - 1e-9) & (free.q <= upper + 1e-9)).all()
    assert_close(ik.forward(free.q), T, atol=1e-9)
    single = ik(T[0], near=q[0])
    assert_close(single.q, q[0], atol=1e-9)
    assert int(single.status) == Status.REACHED


def test_all_branches_reach_the_pose_inside_or_outside_the_limits(ik, true, q):
    T = ik.forward(q[:5])
    every = ik.all_branches(T)
    found = np.isfinite(every.q).all(-1)
    assert_close(ik.forward(every.q[found]), np.repeat(T, found.sum(1), axis=0), atol=1e-9)
    lower, upper = true.nominal.axis_limits.T
    inside = ((every.q >= lower - 1e-9) & (every.q <= upper + 1e-9)).all(-1)
    assert ((every.status == Status.OUTSIDE_JOINT_LIMITS)[found] == ~inside[found]).all()
    assert not inside[found].all()


def test_a_path_keeps_within_the_controllers_limits(ik, q):
    steps = np.linspace(0, 1, 8)[:, None]
    way = q[:1] + 0.05 * steps
    path = ik.path(ik.forward(way), near=way[0])
    assert_close(path.solution.q, way, atol=1e-9)
    assert not path.switches


def test_jacobian_and_accuracy_take_the_controllers_values(ik, q):
    J, step = ik.jacobian(q[:3]), 1e-6
    for axis in range(6):
        moved = step * np.eye(6)[axis]
        difference = (ik.forward(q[:3] + moved) - ik.forward(q[:3] - moved))[:, :3, 3] / (2 * step)
        assert_close(J[:, :3, axis], difference, atol=1e-7)
    assert np.shape(ik.accuracy(q[:3])) == (3,)


def test_directions_of_approach_are_converted_to_those_of_the_joints(ik, q, monkeypatch):
    sides, solver, stated = np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0]), ik.controller_solver.ik, []
    expected, T = ik.controller_solver.coupling.approach_to_dh(sides), ik.forward(q[0])
    assert not np.array_equal(expected, sides)
    for name in ("__call__", "all_branches", "forward", "accuracy"):
        unpatched = getattr(CorrectedIK, name)

        def recorded(self, *values, unpatched=unpatched, **options):
            if self is solver and "approach" in options:
                stated.append(options["approach"])
            return unpatched(self, *values, **options)

        monkeypatch.setattr(CorrectedIK, name, recorded)
    for solution in (ik(T, near=q[0], approach=sides), ik.all_branches(T, approach=sides)):
        assert_close(np.broadcast_to(sides, solution.q.shape), solution.approach)
        assert np.shape(solution.accuracy) == np.shape(solution.status)
    ik.forward(q[0], approach=sides)
    assert len(stated) >= 5
    for values in stated:
        assert_close(values, np.broadcast_to(expected, np.shape(values)))


def test_tensors_have_gradients_through_the_map(ik, q):
    T = torch.from_numpy(ik.forward(q[:2])).requires_grad_()
    solution = ik(T, near=q[:2])
    assert_close(solution.q, q[:2], atol=1e-9)
    (gradient,) = torch.autograd.grad(solution.q[:, 2].sum(), T)
    assert torch.isfinite(gradient).all()
    assert float(gradient.abs().max()) > 0


def test_compiled_models_refuse_coupled_joints(ik):
    with refused(ModelError, value="coupling"):
        CompiledIK.from_model(ik.model)


def test_the_public_kinematics_take_the_controllers_values(true, q):
    robot = true.nominal
    of_joints = torch.from_numpy(robot.to_dh(q))
    nominal = TrueRobot(robot).forward(of_joints)
    for values in (q, torch.from_numpy(q)):
        assert_close(pisigma.forward_kinematics(robot, values), nominal, atol=1e-12)
    J, moved = pisigma.joint_jacobian(robot, q), 1e-6 * np.eye(6)[1]
    difference = pisigma.forward_kinematics(robot, q + moved) - pisigma.forward_kinematics(robot, q - moved)
    assert_close(J[:, :3, 1], difference[:, :3, 3] / 2e-6, atol=1e-7)
