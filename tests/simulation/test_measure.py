"""Simulated measurements: commanded joint values, measured poses, and branches."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError, UnreachablePoseError
from pisigma.files.yaml_file import parse_yaml
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.se3 import pose_error
from pisigma.simulation.measure import SimulatedTracker, simulate
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection

OFFSET = {"kind": "joint_offset", "offset_deg": {"theta_1": 0.5, "theta_2": -0.3}}
ENCODER = {"kind": "encoder", "pulses_per_revolution": {"theta_1": 2048}}
GEOMETRIC = {"kind": "geometric", "rows": {"theta_2": {"a_mm": 3}}, "base": {"x_mm": 2}}
GRID = {
    "kind": "polar_grid",
    "r_mm": (250, 500),
    "r_steps": 3,
    "phi_deg": (10, 80),
    "phi_steps": 4,
    "z_mm": 200,
}
CUBE = {
    "kind": "cube_random",
    "count": 50,
    "seed": 1,
    "x_mm": (600, 1000),
    "y_mm": (0, 400),
    "z_mm": (400, 800),
    "orientation": {"home_rotation": ((0, 0, 1), (0, -1, 0), (1, 0, 0)), "spread_deg": 45},
}


def true_robot(name: str, *errors: dict) -> TrueRobot:
    return TrueRobotSection(robot=name, errors=errors).true_robot()


@pytest.mark.parametrize("branch", ["elbow_positive", "elbow_negative"])
def test_desired_poses_are_reached_by_the_true_robot_on_the_named_branch(branch):
    robot = true_robot("kiro3", GEOMETRIC, OFFSET)
    section = SimulatedTracker(poses=GRID, branch={"name": branch})
    data = section.measure(robot)
    assert data.kinds == {"pose"}
    assert_close(data.T, section.poses.transforms(), atol=1e-12)
    assert_close(robot.forward(data.q), data.T, atol=1e-15)
    sign = 1 if branch == "elbow_positive" else -1
    assert bool((sign * data.q[:, 1] > 0).all())


def test_the_nearest_branch_contains_the_given_joint_values():
    robot = true_robot("kiro4", OFFSET)
    solver = closed_form_solver(robot.nominal)
    for index, name in enumerate(solver.branches[:4]):
        named = SimulatedTracker(poses=CUBE | {"count": 1}, branch={"name": name}).measure(robot)
        T = named.T
        near = torch.rad2deg(solver.solve(T).q[0, index]).tolist()
        near_deg = {joint.name: value + 360 for joint, value in zip(robot.nominal.joints, near, strict=True)}
        nearest = SimulatedTracker(poses=CUBE | {"count": 1}, branch={"near_deg": near_deg}).measure(robot)
        assert_close(nearest.q, named.q, atol=1e-11)


def test_a_robot_without_a_closed_form_starts_from_the_given_joint_values():
    robot = true_robot("ur10", OFFSET)
    near = {"theta_1": 10, "theta_2": -60, "theta_3": 80, "theta_4": -110, "theta_5": -90}
    home = torch.deg2rad(torch.tensor([10.0, -60, 80, -110, -90, 0], dtype=torch.float64))
    centre = robot.forward(home)
    x, y, z = (1e3 * centre[:3, 3]).tolist()
    cube = {
        "kind": "cube_grid",
        "steps": (2, 2, 2),
        "orientation": {"home_rotation": centre[:3, :3].tolist()},
    }
    cube |= {"x_mm": (x - 50, x + 50), "y_mm": (y - 50, y + 50), "z_mm": (z - 50, z + 50)}
    data = SimulatedTracker(poses=cube, branch={"near_deg": near}).measure(robot)
    assert_close(data.position[[0, 7]] - centre[:3, 3], [[-0.05] * 3, [0.05] * 3], atol=1e-12)
    assert float((data.q - home).abs().max()) < 0.3


def test_joint_values_are_commanded_as_drawn():
    robot = true_robot("ur10", OFFSET)
    section = SimulatedTracker(poses={"kind": "joints_random", "count": 20, "seed": 3}, sensor="position")
    data = section.measure(robot)
    assert_close(data.q, section.poses.joints(robot.nominal))
    assert_close(data.position, robot.forward(data.q)[:, :3, 3])
    assert data.rotation is None
    assert data.sigma_position is None
    assert data.frame == ("",) * 20


def test_with_an_encoder_the_robot_stops_near_the_desired_pose():
    robot = true_robot("kiro3", OFFSET, ENCODER)
    section = SimulatedTracker(poses=GRID, branch={"name": "elbow_positive"})
    data = section.measure(robot)
    away = pose_error(data.T, section.poses.transforms())[:, :3].norm(dim=-1)
    half_a_pulse = math.pi / 2048
    assert 1e-5 < float(away.max()) <= half_a_pulse * 0.5 * 1.001
    without = section.measure(robot.without_encoder())
    assert_close(data.q, without.q)


def test_noise_is_added_and_its_standard_deviation_is_stated(generator):
    robot = true_robot("ur10", OFFSET)
    q = torch.randn(2000, 6, generator=generator, dtype=torch.float64)
    noise = MeasurementNoise(position_mm=0.05, orientation_deg=0.01, seed=2)
    data = simulate(robot, q, "pose", noise)
    error = pose_error(data.T, robot.forward(q))
    assert_close(error.std(0), [5e-5] * 3 + [math.radians(0.01)] * 3, rtol=0.06)
    assert_close(data.sigma_position, 5e-5, atol=1e-20)
    assert_close(data.sigma_rotation, math.radians(0.01), atol=1e-18)
    again, other = (
        simulate(robot, q, "pose", MeasurementNoise(**noise.model_dump() | {"seed": s})) for s in (2, 3)
    )
    assert data.content_hash() == again.content_hash() != other.content_hash()
    position = simulate(robot, q, "position", noise)
    assert_close(position.position, data.position)
    assert position.sigma_rotation is None


RECIPE = """
poses: {kind: polar_grid, r_mm: [250, 500], r_steps: 3, phi_deg: [10, 80], phi_steps: 4, z_mm: 200}
branch: {name: elbow_positive}
noise: {position_mm: 0.05, seed: 1}
"""


def read(text: str) -> SimulatedTracker:
    return parse_yaml(text, SimulatedTracker, RecipeError, "recipe.yaml")


def test_recipe_is_read():
    assert read(RECIPE).measure(true_robot("kiro3")).rows == 12


@pytest.mark.parametrize(
    ("old", "new", "column", "name"),
    [
        ("branch: {name: elbow_positive}", "", None, "branch"),
        ("name: elbow_positive", "", "branch", "near_deg"),
        ("name: elbow_positive", "name: elbow_positive, near_mm: {d_3: 1}", "branch", "near_mm"),
        ("phi_steps", "phi_step", "poses.phi_step", "'phi_steps'"),
        ("noise: {", "nose: {", "nose", "'noise'"),
        ("kind: polar_grid", "kind: spiral", "poses.kind", "polar_random"),
    ],
)
def test_incomplete_and_contradictory_recipes_are_refused(old, new, column, name):
    with refused(RecipeError, file="recipe.yaml", column=column) as caught:
        read(RECIPE.replace(old, new))
    assert name in str(caught.value)


def test_joint_values_have_no_branch():
    with refused(RecipeError, file="recipe.yaml", column=None):
        read("poses: {kind: joints_random, count: 1, seed: 0}\nbranch: {name: elbow_positive}")


@pytest.mark.parametrize(
    ("robot", "branch", "value", "name"),
    [
        ("kiro3", {"name": "elbow_posive"}, "elbow_posive", "'elbow_positive'"),
        ("panda", {"name": "elbow_positive"}, "elbow_positive", "near_deg"),
        ("kiro3", {"near_deg": {"tehta_1": 1}}, "tehta_1", "'theta_1'"),
    ],
)
def test_branches_that_do_not_exist_are_refused(robot, branch, value, name):
    with refused(RecipeError, option="branch", value=value) as caught:
        SimulatedTracker(poses=GRID, branch=branch).measure(true_robot(robot))
    assert name in caught.value.remedy


@pytest.mark.parametrize("branch", [{"name": "elbow_positive"}, {"near_deg": {}}])
def test_poses_out_of_reach_are_refused(branch):
    section = SimulatedTracker(poses=GRID | {"r_mm": (500, 700)}, branch=branch)
    with refused(UnreachablePoseError, option="poses", value=8) as caught:
        section.measure(true_robot("kiro3"))
    assert "4 of 12" in str(caught.value)


def test_poses_outside_the_joint_limits_are_refused():
    section = SimulatedTracker(poses=GRID | {"z_mm": 500}, branch={"name": "elbow_positive"})
    with refused(RecipeError, option="poses", value=0) as caught:
        section.measure(true_robot("kiro3"))
    assert "12 of 12" in str(caught.value)


def test_every_row_of_the_paper_cube_is_reached():
    data = SimulatedTracker(poses=CUBE, branch={"name": "front/elbow_up/no_flip"}).measure(
        TrueRobot(Robot.load("kiro4"))
    )
    assert data.rows == 50
