"""The feature of coupled joints identifies errors of couplings and rails, and is omitted for other robots."""

import pytest
import torch
from testing.closeness import assert_close
from testing.coupled import COUPLED, PALLETISER, coupled_robot
from testing.refusals import refused

import pisigma
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.files.errors import RecipeError
from pisigma.joint_correction.coupled_series import CoupledSeries
from pisigma.joint_correction.feature import FeatureOptions
from pisigma.measurement.conditions import JointState
from pisigma.model.folder.model_folder import save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot import Robot
from pisigma.simulation.errors.coupling import CouplingDeviation
from pisigma.simulation.errors.guide import Guide
from pisigma.simulation.measure import simulate
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.poses import JointsRandom
from pisigma.simulation.true_robot import TrueRobot

OPTIONS = FeatureOptions((8,), (0.0, 0.0, -1.0), 100)

RAIL = """\
name: rail
maker: nobody
source: made up
rows:
  - {name: rail, type: prismatic, limits_mm: [-1500, 1500], alpha_deg: 90}
  - {name: side, type: prismatic, theta_deg: 90, alpha_deg: 90}
  - {name: yaw, type: revolute}
  - {name: theta_1, type: revolute, limits_deg: [-170, 170], d_mm: 500, a_mm: 100, alpha_deg: -90}
  - {name: theta_2, type: revolute, limits_deg: [-90, 90], a_mm: 600}
  - {name: theta_3, type: revolute, limits_deg: [-90, 90], a_mm: 500}
coupling:
  - {joint: side, factors: {rail: 0}}
  - {joint: yaw, factors: {rail: 0}}
"""


def drawn(robot: Robot, count: int = 50, seed: int = 1) -> torch.Tensor:
    return JointsRandom(kind="joints_random", count=count, seed=seed).joints(robot)


def test_only_coupled_robots_have_it():
    robot = Robot.load("ur5")
    assert CoupledSeries.candidates(robot, OPTIONS, JointState(torch.zeros(1, 6))) == ()
    feature = CoupledSeries(coupled_robot())
    assert feature.used.any(1).tolist() == [False, False, True, False, False, False]


@pytest.mark.parametrize("text", [COUPLED, PALLETISER, RAIL])
def test_columns_are_of_the_order_of_one_in_every_batch(text):
    robot = coupled_robot(text)
    feature, q = CoupledSeries(robot), drawn(robot, 6)
    columns = feature.columns(JointState(q))
    assert columns.shape == (6, robot.dof, feature.column_count)
    assert 0.05 < float((columns * feature.used).abs().max()) < 5
    assert_close(
        feature.columns(JointState(q.reshape(3, 1, 2, -1))).reshape(columns.shape), columns, atol=1e-15
    )


def test_bar_length_errors_are_a_sum_of_its_columns():
    robot = coupled_robot(PALLETISER)
    source = CouplingDeviation(
        kind="coupling",
        coupling=[
            {
                "joint": "theta_3",
                "factors": {"theta_3": 1, "theta_2": -1},
                "limits_deg": [-65, 65],
                "four_bar": {
                    "ground_mm": 945,
                    "crank_mm": 400.04,
                    "coupler_mm": 945.4,
                    "rocker_mm": 400.2,
                    "zero_deg": 90,
                },
            }
        ],
    )
    q = drawn(robot)
    error = source.bind(robot, "test")(q)
    columns = CoupledSeries(robot).columns(JointState(q))[:, 2, -3]
    assert float(error[:, 2].abs().max()) > 5e-5
    assert_close(error[:, 2], 1e-4 * columns, atol=2e-7)
    assert_close(error[:, [0, 1, 3, 4]], torch.zeros(len(q), 4), atol=1e-12)


def test_a_wrong_factor_is_identified_and_kept_in_the_folder(tmp_path):
    robot = coupled_robot()
    wrong = {"joint": "theta_3", "factors": {"theta_2": 1.002, "theta_3": 1}}
    true = TrueRobot(robot, (CouplingDeviation(kind="coupling", coupling=[wrong]),))
    rows = simulate(true, drawn(robot, 60), "position", MeasurementNoise(position_mm=0.03, seed=1))
    result = HybridCalibrator(robot, features=("coupling",), products=False).fit(rows)
    correction = result.arm().correction
    feature = correction.features[0]
    assert isinstance(feature, CoupledSeries)
    assert_close(feature.factor_errors(correction.linear[0].detach().numpy())[2, 1], 0.002, rtol=0.05)
    model = model_of_hybrid("arm", robot, result, rows)
    (tmp_path / "model").mkdir()
    save_model(model, tmp_path / "model")
    ik, q = pisigma.load(tmp_path / "model"), drawn(robot, 5, seed=2)
    values = robot.to_controller(q).numpy()
    T = ik.forward(values)
    assert_close(T[:, :3, 3], true.forward(q)[:, :3, 3], atol=5e-5)
    assert_close(ik(T, near=values).q, values, atol=1e-9)


def test_a_curved_rail_is_identified():
    robot = coupled_robot(RAIL)
    waves = [
        {"joint": "side", "amplitude_mm": 0.4, "harmonic": 1, "phase_deg": 30},
        {"joint": "yaw", "amplitude_deg": 0.03, "harmonic": 2},
    ]
    true = TrueRobot(robot, (Guide(kind="guide", along="rail", waves=waves),))
    rows = simulate(true, drawn(robot, 80), "position", MeasurementNoise(position_mm=0.03, seed=1))
    model = model_of_hybrid(
        "rail", robot, HybridCalibrator(robot, features=("coupling",), products=False).fit(rows), rows
    )
    q = drawn(robot, 200, seed=2)
    off = (model.forward(q) - true.forward(q))[:, :3, 3].norm(dim=1)
    bent = (TrueRobot(robot).forward(q) - true.forward(q))[:, :3, 3].norm(dim=1)
    assert float(off.square().mean().sqrt()) < 0.03e-3
    assert float(bent.square().mean().sqrt()) > 0.3e-3


@pytest.mark.parametrize(
    ("along", "expected"), [("rial", ""), ("theta_1", "the name of a prismatic axis with limits")]
)
def test_a_guide_needs_a_limited_prismatic_axis(along, expected):
    source = Guide(kind="guide", along=along, waves=[{"joint": "side", "amplitude_mm": 1, "harmonic": 1}])
    with refused(RecipeError, option="test", expected=expected, value=along):
        source.bind(coupled_robot(RAIL), "test")


@pytest.mark.parametrize(
    ("robot", "value"),
    [("ur5", "ur5"), (None, "theta_2")],
)
def test_a_coupling_deviation_needs_a_coupled_joint(robot, value):
    source = CouplingDeviation(kind="coupling", coupling=[{"joint": "theta_2", "factors": {"theta_2": 1}}])
    with refused(RecipeError, option="test", value=value):
        source.bind(coupled_robot() if robot is None else Robot.load(robot), "test")
