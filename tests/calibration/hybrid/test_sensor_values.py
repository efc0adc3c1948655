"""Derivatives by joints, geometry and weights against finite differences of the residuals; collapsed repeats."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import random_joints, tracker_data, with_directions
from testing.sensors import mixed_data, pair_data
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.problem import CalibrationProblem, MotionMemory
from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.refinement import correction_from_weights
from pisigma.calibration.hybrid.sensor_values import joint_value_parameters, sensor_values
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.shared_features import SinesCosines
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.pose import RotationSensor
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

WEIGHTS = ((-4 / 5, 1), (1 / 5, 2), (-4 / 105, 3), (1 / 280, 4))
"""Of central differences of order 8, with the step's multiple."""


def tracker(name: str, directions: tuple[int, ...]) -> tuple[Robot, Measurements]:
    """Poses in two frames with two targets."""
    robot = with_directions(Robot.load(name), directions)
    return robot, tracker_data(robot, random_joints(robot, 40, 0), turn_noise=0.0, several=True)


def all_kinds() -> tuple[Robot, Measurements]:
    """Tracker, touches, sockets and a draw wire; pairs have a test of their own."""
    data = mixed_data()
    assert data.pair is not None
    robot = with_directions(Robot.load("welding"), (1, -1, 1, 1, -1, 1))
    turned = data.q * torch.tensor([1, -1, 1, 1, -1, 1])
    return robot, replace(data, q=turned).select(torch.tensor([not name for name in data.pair]))


CASES: dict[str, Callable[[], tuple[Robot, Measurements]]] = {
    "sliding": lambda: tracker("kiro3", (1, -1, -1, 1)),
    "panda": lambda: tracker("panda", (1, -1, 1, -1, 1, -1, 1)),
    "all kinds of sensors": all_kinds,
}


def residuals(problem: CalibrationProblem, point: Tensor, q: Tensor) -> list[Tensor]:
    """Of every sensor, `(seen, components)`, at other joint values."""
    moved = replace(problem, q=q, memory=MotionMemory())
    rows = slice(0, len(q))
    motion = moved.motion(point, rows, moved.active)
    own = moved.space.sensor_unknowns(point)
    return [sensor.residual(motion, own, rows)[:, sensor.present].t() for sensor in moved.sensors]


def differences(of: Callable[[Tensor], list[Tensor]], at: Tensor, step: float, place: object) -> list[Tensor]:
    """Derivative of what is predicted by some entries of `at` moved together; residuals fall as that rises."""
    total: list[Tensor] = []
    for weight, times in WEIGHTS:
        shift = torch.zeros_like(at)
        shift[place] = times * step  # type: ignore[index]
        parts = [
            (high - low) * weight / step for high, low in zip(of(at + shift), of(at - shift), strict=True)
        ]
        total = [a + b for a, b in zip(total, parts, strict=True)] if total else parts
    return total


def case(name: str, shift: JointCorrection | None = None) -> tuple[CalibrationProblem, Tensor]:
    """A problem with all parameters free, and a point off nominal where measured rotations are met.

    The derivative of a rotation residual is the turn itself, which is exact where the residual is 0.
    """
    robot, data = CASES[name]()
    setup = GeometricCalibrator(robot).build(data)
    problem = setup.problem.with_active(range(len(setup.start)))
    generator = torch.Generator().manual_seed(1)
    off = 1e-2 * torch.randn(len(setup.start), generator=generator, dtype=torch.float64)
    point = setup.start + off
    q = problem.q if shift is None else problem.q + shift(problem.q).detach()
    rows = slice(0, len(q))
    met = replace(problem, q=q, memory=MotionMemory()).motion(point, rows, problem.active)
    sensors = tuple(
        replace(sensor, measured=met.rotation) if isinstance(sensor, RotationSensor) else sensor
        for sensor in problem.sensors
    )
    return replace(problem, sensors=sensors), point


def correction_of(robot: Robot, size: float = 0.02) -> JointCorrection:
    features = (SinesCosines(robot), FourierSeries(robot, 3))
    made = JointCorrection(robot, features, (2,))
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(size * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
        made.weight.mul_(size**-0.5)
    return made.requires_grad_(False)


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("name", sorted(CASES))
def test_derivatives_are_those_of_the_residuals(name: str, shifted: bool) -> None:
    shift = correction_of(CASES[name]()[0]) if shifted else None
    problem, point = case(name, shift)
    q = problem.q if shift is None else problem.q + shift(problem.q)
    values = sensor_values(problem, point, shift)
    assert [sensor.name for sensor in values] == [sensor.name for sensor in problem.sensors]
    for sensor, expected in zip(values, residuals(problem, point, q), strict=True):
        assert_close(sensor.residual, expected, atol=1e-14)
        assert_close(
            problem.sensors[[v.name for v in values].index(sensor.name)].present.nonzero()[:, 0], sensor.row
        )
    for j in range(q.shape[1]):
        numeric = differences(lambda moved: residuals(problem, point, moved), q, 1e-3, (slice(None), j))
        for sensor, expected in zip(values, numeric, strict=True):
            assert_close(sensor.joint_derivatives[..., j], expected, atol=1e-9)
    some = torch.randperm(len(point), generator=torch.Generator().manual_seed(5))[:15]
    for i in some.tolist():
        numeric = differences(lambda moved: residuals(problem, moved, q), point, 1e-3, i)
        for sensor, expected in zip(values, numeric, strict=True):
            assert_close(sensor.geometry_derivatives[..., i], expected, atol=1e-8)


@pytest.mark.parametrize("name", ["panda", "sliding"])
def test_joint_derivatives_are_those_of_the_forward_kinematics(name: str) -> None:
    """In the frame of the first row, on the nominal robot, whatever the sensors count from."""
    robot, _ = CASES[name]()
    q = random_joints(robot, 30, 5)
    data = Measurements(q=q, position=forward_kinematics(robot, q)[:, :3, 3].contiguous())
    problem = GeometricCalibrator(robot, base="fixed", tool="fixed").build(data).problem
    (values,) = sensor_values(problem.with_active([0]), problem.prior_mean)
    for j in range(robot.dof):
        (numeric,) = differences(
            lambda moved: [-forward_kinematics(robot, moved)[:, :3, 3]], q, 1e-3, (slice(None), j)
        )
        assert_close(values.joint_derivatives[..., j], numeric, atol=1e-9)


@pytest.mark.parametrize("name", sorted(CASES))
def test_columns_are_the_derivative_by_the_weights(name: str) -> None:
    """With a correction in force: of gravity, a series and products of inputs."""
    robot, _ = CASES[name]()
    chosen = (GravityTorques(robot), FourierSeries(robot, 2), InputProducts(robot))
    generator = torch.Generator().manual_seed(4)
    count = sum(int(feature.used.sum()) for feature in chosen)
    weights = 0.01 * torch.randn(count, generator=generator, dtype=torch.float64)
    empty = Design(GeometricCalibrator(robot).build(CASES[name]()[1]).problem.with_active([]), chosen)
    problem, point = case(name, correction_from_weights(empty, weights))
    design = Design(problem, chosen)
    values = sensor_values(problem, point, correction_from_weights(empty, weights))
    assert design.unknowns == design.active_count + len(weights)

    def at(moved: Tensor) -> list[Tensor]:
        return residuals(problem, point, problem.q + empty.correction(moved, problem.state))

    columns = [design.columns(sensor, slice(None)) for sensor in values]
    for k in torch.randperm(len(weights), generator=generator)[:8].tolist():
        for X, expected in zip(columns, differences(at, weights, 1e-3, k), strict=True):
            assert_close(X[..., design.active_count + k], expected, atol=1e-9)


def test_columns_of_pairs_are_the_derivative_by_the_weights() -> None:
    robot = Robot.load("welding")
    setup = GeometricCalibrator(robot).build(pair_data(20))
    problem = setup.problem.with_active(range(len(setup.start)))
    made = JointCorrection(robot, (FourierSeries(robot, 1),)).requires_grad_(False)
    (values,) = sensor_values(problem, setup.start)

    def at(weights: Tensor) -> list[Tensor]:
        with torch.no_grad():
            made.linear[0].copy_(weights.view(6, 2))
        return residuals(problem, setup.start, problem.q + made(problem.q))

    X = Design(problem, made.features).columns(values, slice(None))
    for k in range(12):
        (expected,) = differences(at, torch.zeros(12, dtype=torch.float64), 1e-3, k)
        assert_close(X[..., problem.active.numel() + k], expected, atol=1e-9)


def test_given_standard_deviations_are_the_rows_roots() -> None:
    robot, data = tracker("kiro3", (1, 1, 1, 1))
    sigma = torch.linspace(1e-5, 4e-5, data.rows, dtype=torch.float64)
    problem = GeometricCalibrator(robot).build(replace(data, sigma_position=sigma)).problem
    values = sensor_values(problem.with_active([0, 1]), problem.prior_mean)
    found = {sensor.name: sensor for sensor in values}
    assert_close(found["position"].weight_root, 1 / sigma[problem_rows(problem, data)], rtol=1e-12)
    assert (found["position"].has_stated_noise, found["rotation"].has_stated_noise) == (True, False)
    assert_close(found["rotation"].weight_root, torch.ones(data.rows))


def problem_rows(problem: CalibrationProblem, data: Measurements) -> Tensor:
    """Which row of the data every row of a problem is."""
    return torch.cdist(problem.q, data.q).argmin(1)


def test_joint_columns_are_theta_of_turning_and_d_of_sliding_joints() -> None:
    robot = Robot.load("kiro3")
    problem = GeometricCalibrator(robot).build(tracker("kiro3", (1, 1, 1, 1))[1]).problem
    names = [problem.space.names[k] for k in joint_value_parameters(problem.space).tolist()]
    wanted = ["d" if joint.type == "prismatic" else "theta" for joint in robot.joints]
    assert [name.partition("_")[0] for name in names] == wanted
    assert [problem.space.parameters[k].owner for k in joint_value_parameters(problem.space).tolist()] == [
        joint.name for joint in robot.joints
    ]
