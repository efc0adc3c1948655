"""The true robot: error sources are added, and inverse kinematics inverts forward kinematics."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PoseError, RecipeError, UnreachablePoseError
from pisigma.files.yaml_file import parse_yaml
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection

GEOMETRIC = {
    "kind": "geometric",
    "rows": {
        "theta_2": {"theta_deg": 0.3, "a_mm": 2, "beta_deg": 0.1},
        "theta_5": {"alpha_deg": -0.2, "d_mm": 1},
    },
    "base": {"x_mm": 5, "yaw_deg": 0.4},
    "tool": {"z_mm": 3, "roll_deg": 0.5},
}
RANDOM = {"kind": "geometric_random", "distribution": "uniform", "seed": 5, "length_mm": 1, "angle_deg": 0.2}
OFFSET = {"kind": "joint_offset", "offset_deg": {"theta_1": 0.5, "theta_4": -1.5}}
COMPLIANCE = {
    "kind": "joint_compliance",
    "compliance_rad_per_Nm": {"theta_2": 2e-5, "theta_3": 3e-5},
    "links": {
        "theta_2": {"mass_kg": 12, "centre_mm": (300, 0, 100)},
        "theta_3": {"mass_kg": 5, "centre_mm": (250, 0, 0)},
    },
    "payload": {"mass_kg": 8},
}
TRANSMISSION = {
    "kind": "transmission",
    "terms": [
        {"joint": "theta_1", "amplitude_deg": 0.1, "harmonic": 2, "phase_deg": 20},
        {"joint": "theta_6", "amplitude_deg": 0.2, "joints": {"theta_5": 1, "theta_6": 1}},
    ],
}
ENCODER = {"kind": "encoder", "pulses_per_revolution": {"theta_1": 2500, "theta_5": 2500}}
SMOOTH = [GEOMETRIC, RANDOM, OFFSET, COMPLIANCE, TRANSMISSION]


def true_robot(*errors: dict, robot: str = "ur10") -> TrueRobot:
    return TrueRobotSection(robot=robot, errors=errors).true_robot()


def joints(generator: torch.Generator, *batch: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return 2.5 * (2 * torch.rand(*batch, 6, generator=generator, dtype=dtype) - 1)


ZERO = [
    {"kind": "geometric"},
    RANDOM | {"length_mm": 0, "angle_deg": 0},
    {"kind": "joint_offset"},
    COMPLIANCE | {"compliance_rad_per_Nm": {}},
    {"kind": "transmission", "terms": [{"joint": "theta_1", "amplitude_deg": 0, "harmonic": 1}]},
    {"kind": "encoder"},
]


@pytest.mark.parametrize("errors", [[], *[[zero] for zero in ZERO], ZERO], ids=str)
def test_no_errors_give_the_nominal_robot(errors, generator):
    q = joints(generator, 20)
    robot = true_robot(*errors)
    assert_close(robot.joint_error(q), 0.0)
    assert_close(robot.forward(q), forward_kinematics(Robot.load("ur10"), q))


def test_errors_are_added_in_any_order(generator):
    q = joints(generator, 20)
    sources = [*SMOOTH, ENCODER]
    together, reversed_order = true_robot(*sources), true_robot(*sources[::-1])
    alone = [true_robot(source) for source in sources]
    assert_close(together.joint_error(q), sum(robot.joint_error(q) for robot in alone), atol=1e-16)
    assert_close(
        together.true_geometry.dh - together.nominal.dh,
        sum(r.true_geometry.dh - r.nominal.dh for r in alone),
        atol=1e-15,
    )
    assert_close(together.true_geometry.base, sum(robot.true_geometry.base for robot in alone), atol=1e-16)
    assert_close(together.true_geometry.tool, sum(robot.true_geometry.tool for robot in alone), atol=1e-16)
    assert_close(together.forward(q), reversed_order.forward(q), atol=1e-14)
    for robot in alone:  # none of them does nothing
        assert float((robot.forward(q) - forward_kinematics(robot.nominal, q)).abs().max()) > 1e-5


def test_forward_is_kinematics_of_the_true_geometry_at_the_actual_joints(generator):
    q = joints(generator, 20)
    robot = true_robot(*SMOOTH)
    assert_close(robot.actual_joints(q) - q, robot.joint_error(q), atol=1e-15)
    assert_close(robot.forward(q), forward_kinematics(robot.true_geometry, robot.actual_joints(q)))
    assert robot.nominal.dh.tolist() == Robot.load("ur10").dh.tolist()


@pytest.mark.parametrize("batch", [(), (0,), (1,), (3, 1, 2)], ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_and_dtypes(batch, dtype, generator):
    q = joints(generator, *batch, dtype=dtype)
    robot = true_robot(*SMOOTH)
    T = robot.forward(q)
    assert T.shape == (*batch, 4, 4)
    assert T.dtype == dtype
    back = robot.commanded_joints(robot.actual_joints(q))
    assert back.dtype == dtype
    assert_close(back, q, atol=1e-5 if dtype == torch.float32 else 1e-14)


def test_commanded_joints_invert_the_joint_errors(generator):
    actual = joints(generator, 1000)
    robot = true_robot(*SMOOTH)
    q = robot.commanded_joints(actual)
    assert_close(robot.actual_joints(q), actual, atol=2e-14)
    assert float((q - actual).abs().max()) > 0.01


def test_encoder_steps_cannot_be_inverted(generator):
    q = joints(generator, 3)
    robot = true_robot(OFFSET, ENCODER)
    with refused(UnreachablePoseError, option="errors", value="encoder"):
        robot.commanded_joints(q)
    assert robot.has_encoder
    smooth = robot.without_encoder()
    assert not smooth.has_encoder
    assert_close(smooth.joint_error(q), true_robot(OFFSET).joint_error(q))
    assert_close(smooth.commanded_joints(smooth.actual_joints(q)), q, atol=1e-14)


def test_errors_steeper_than_the_joint_are_refused(generator):
    term = {"joint": "theta_1", "amplitude_deg": 30, "harmonic": 7}
    robot = true_robot({"kind": "transmission", "terms": [term]})
    with refused(UnreachablePoseError, option="errors", value="theta_1"):
        robot.commanded_joints(joints(generator, 20))


def test_joint_values_of_another_robot_are_refused():
    with pytest.raises(PoseError):
        true_robot(OFFSET).forward(torch.zeros(4, dtype=torch.float64))


def test_one_joint_with_two_encoders_is_refused():
    with refused(RecipeError, option="errors[1] (encoder)", value="theta_1"):
        true_robot(ENCODER, {"kind": "encoder", "pulses_per_revolution": {"theta_1": 2048}})


def test_unknown_joint_is_refused_with_place_and_nearest_name():
    wrong = {"kind": "joint_offset", "offset_deg": {"theta_l": 1}}
    with refused(RecipeError, option="errors[1] (joint_offset)", value="theta_l"):
        true_robot(OFFSET, wrong)


RECIPE = """
robot: kiro3
errors:
  - kind: geometric
    rows: {theta_1: {a_mm: -5.3}}
  - kind: joint_offset
    offset_deg: {theta_2: 3.7}
"""


def test_recipe_is_read_and_misspelt_keys_are_refused():
    robot = parse_yaml(RECIPE, TrueRobotSection, RecipeError, "recipe.yaml").true_robot()
    assert_close(robot.true_geometry.dh[0, 2], 0.3147, atol=1e-16)
    assert_close(
        robot.joint_error(torch.zeros(4, dtype=torch.float64)), [0, math.radians(3.7), 0, 0], atol=1e-17
    )
    with refused(RecipeError, file="recipe.yaml", line=7, column="errors.1.ofset_deg") as caught:
        parse_yaml(RECIPE.replace("offset_deg", "ofset_deg"), TrueRobotSection, RecipeError, "recipe.yaml")
    assert "'offset_deg'" in caught.value.remedy
    with refused(RecipeError, file="recipe.yaml", line=6, value="joint_ofset") as caught:
        parse_yaml(
            RECIPE.replace("joint_offset", "joint_ofset"), TrueRobotSection, RecipeError, "recipe.yaml"
        )
    assert "'joint_offset'" in caught.value.remedy


@pytest.mark.parametrize("name", ["ur10", "kiro4"])
def test_inverse_takes_the_true_robot_to_the_pose(name, generator):
    robot = true_robot(*SMOOTH, robot=name)
    wanted = joints(generator, 500)
    start = wanted + 0.05 * torch.randn(500, 6, generator=generator, dtype=torch.float64)
    T = robot.forward(wanted)
    q = robot.inverse(T, start)
    assert_close(robot.forward(q), T, atol=1e-12)
    _, J = joint_jacobian(robot.nominal, wanted)
    regular = torch.linalg.svdvals(J)[:, -1] > 0.1  # far from places where two branches meet
    assert int(regular.sum()) > 100
    turns = (q - wanted)[regular] / (2 * math.pi)
    assert_close(turns, turns.round(), atol=1e-9)


def test_inverse_batches(generator):
    robot = true_robot(*SMOOTH)
    wanted = joints(generator, 3, 1, 2)
    T = robot.forward(wanted)
    assert_close(robot.forward(robot.inverse(T, wanted)), T, atol=1e-12)
    one = robot.inverse(T[0, 0, 0], wanted[0, 0, 0])
    assert_close(robot.forward(one), T[0, 0, 0], atol=1e-12)
    assert robot.inverse(T[:0], wanted[:0]).shape == (0, 1, 2, 6)


def test_poses_that_cannot_be_reached_are_refused(generator):
    robot = true_robot(*SMOOTH)
    q = joints(generator, 3)
    T = robot.forward(q)
    T[1, 0, 3] += 5
    with refused(UnreachablePoseError, option="T", value=1):
        robot.inverse(T, q)
