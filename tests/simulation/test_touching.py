"""Simulated touches on jigs: possible touches, and true tips at the measured coordinates."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError, UnreachablePoseError
from pisigma.files.yaml_file import parse_yaml
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.jig import Jig
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.simulation.noise import SensorNoise
from pisigma.simulation.touch_candidates import JigPlacement, TouchCandidatesSection
from pisigma.simulation.touching import SimulatedTouches, simulate_touches
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection

# Lim et al., Table 1 and the columns "both" of Table 2; -89 deg and 180 deg are turns about the vertical.
RIGHT = {
    "name": "right",
    "base": {"x_mm": 445, "y_mm": 1000, "roll_deg": -90},
    "true_base": {"x_mm": 439.4, "y_mm": 982.2, "z_mm": -0.5, "roll_deg": -89},
}
LEFT = {
    "name": "left",
    "base": {"x_mm": 1000, "y_mm": 445, "roll_deg": 180},
    "true_base": {
        "x_mm": 981.1,
        "y_mm": 446.4,
        "z_mm": -1.5,
        "roll_deg": 180,
        "pitch_deg": -0.1,
        "yaw_deg": 0.04,
    },
}
GEOMETRIC = {
    "kind": "geometric",
    "rows": {
        "theta_1": {"a_mm": -4.72},
        "theta_2": {"a_mm": -1.73, "theta_deg": -0.24},
        "theta_3": {"a_mm": 1.05, "theta_deg": 0.48},
        "theta_4": {"d_mm": 2.8, "theta_deg": 0.21},
        "theta_5": {"theta_deg": -0.13},
    },
    "tool": {"x_mm": 1.41, "y_mm": -0.14},
}
PLACEMENTS = (JigPlacement(**RIGHT), JigPlacement(**LEFT))
CANDIDATES = {"count": 30, "seed": 4}


def true_robot(*errors: dict) -> TrueRobot:
    return TrueRobotSection(robot="welding", errors=errors or (GEOMETRIC,)).true_robot()


def section(**changes: object) -> SimulatedTouches:
    stated = {"kind": "touches", "placements": (RIGHT, LEFT), "candidates": CANDIDATES}
    return SimulatedTouches(**stated | changes)


def true_coordinates(robot: TrueRobot, data: Measurements, placements: tuple = PLACEMENTS) -> torch.Tensor:
    """Return the coordinates of the true tips along the axes of their rows, computed row by row."""
    found = []
    for q, frame, axis in zip(data.q, data.frame, data.touch_axis, strict=True):
        T_jig_base = next(p.true_T_jig_base for p in placements if p.name == frame)
        found.append((T_jig_base @ robot.forward(q))["xyz".index(axis), 3])
    return torch.stack(found)


def test_the_welding_robot_is_that_of_the_paper():
    robot = Robot.load("welding")
    assert closed_form_solver(robot) is not None
    assert "not published" in robot.source
    assert_close(robot.dh[:, 1], [0.4, 0, 0, 0.39, 0, 0])
    assert_close(robot.dh[:, 2], [0.06, 0.35, 0.08, 0, 0, 0])
    assert_close(robot.dh[:, 3], [-math.pi / 2, 0, -math.pi / 2, math.pi / 2, -math.pi / 2, 0])
    assert_close(robot.tool, [1.85e-3, 0.25e-3, 0.451, 0, -math.pi / 6, 0], atol=1e-15)
    # At zeros the upper arm lies along x, forearm and torch hang down:
    # 60 + 350 + 80 + 1.85 mm and 400 - 390 - 451 mm.
    T = forward_kinematics(robot, torch.zeros(6, dtype=torch.float64))
    assert_close(T[:3, 3], [0.49185, -0.25e-3, -0.441], atol=1e-15)


@pytest.mark.parametrize(
    "errors", [(GEOMETRIC,), (GEOMETRIC, {"kind": "joint_offset", "offset_deg": {"theta_1": 0.3}})]
)
def test_true_tips_are_at_the_coordinates_of_their_faces(errors: tuple[dict, ...]):
    robot = true_robot(*errors)
    data = section().measure(robot)
    assert (data.rows, data.kinds) == (60, {"touch"})
    assert data.frame == ("right",) * 30 + ("left",) * 30
    assert_close(true_coordinates(robot, data), data.touch, atol=1e-12)
    known = Jig.load().coordinate
    assert bool((data.touch[:, None] - known).abs().amin(1).max() < 1e-15)
    assert data.sigma_position is None
    for frame in ("right", "left"):
        axes = [axis for axis, name in zip(data.touch_axis, data.frame, strict=True) if name == frame]
        assert sorted(axes) == ["x"] * 10 + ["y"] * 10 + ["z"] * 10


def test_a_perfect_robot_touches_where_it_was_planned():
    perfect = tuple(JigPlacement(**placement | {"true_base": None}) for placement in (RIGHT, LEFT))
    robot = TrueRobot(Robot.load("welding"))
    candidates = TouchCandidatesSection(**CANDIDATES).find(robot.nominal, perfect)
    data = simulate_touches(robot, perfect, candidates)
    assert_close(data.q, candidates.q, atol=1e-11)
    planned = candidates.as_measurements()
    assert (planned.frame, planned.touch_axis, planned.kinds) == (data.frame, data.touch_axis, {"touch"})
    assert_close(planned.touch, data.touch)


def test_candidates_can_be_touched():
    stated = TouchCandidatesSection(count=120, seed=1, tilt_deg=30, margin_mm=20, least_lean_deg=8)
    robot, jig = Robot.load("welding"), Jig.load()
    found = stated.find(robot, PLACEMENTS)
    assert found.count == 240
    tip, shaft = found.T_jig_tool[:, :3, 3], -found.T_jig_tool[:, :3, 2]
    assert_close(tip[torch.arange(240), found.axis], found.face_coordinate, atol=1e-15)
    assert bool(jig.is_on_face(found.face, tip, 0.0199).all())
    assert bool((shaft[:, 2] >= math.cos(math.radians(30)) - 1e-12).all())
    lean = (shaft * jig.outward[found.face]).sum(-1)
    assert bool((lean >= math.sin(math.radians(8)) - 1e-12).all())
    assert not jig.intersects_line(tip + 1e-6 * shaft, tip + 0.3 * shaft).any()
    Ts_jig_base = torch.stack([PLACEMENTS[number].T_jig_base for number in found.placement.tolist()])
    assert_close(Ts_jig_base @ forward_kinematics(robot, found.q), found.T_jig_tool, atol=1e-12)
    limits = torch.from_numpy(robot.limits)
    assert bool(((found.q >= limits[:, 0]) & (found.q <= limits[:, 1])).all())


def test_the_result_depends_on_the_seed_only():
    robot = Robot.load("welding")
    first, again = (TouchCandidatesSection(**CANDIDATES).find(robot, PLACEMENTS) for _ in range(2))
    other = TouchCandidatesSection(**CANDIDATES | {"seed": 5}).find(robot, PLACEMENTS)
    assert_close(first.q, again.q)
    assert float((first.q - other.q).abs().max()) > 0.1
    true = true_robot()
    few = first.select(torch.arange(12))
    hashes = [
        simulate_touches(true, PLACEMENTS, few, SensorNoise(sensor_mm=0.2, seed=seed)).content_hash()
        for seed in (1, 1, 2)
    ]
    assert hashes[0] == hashes[1] != hashes[2]


def test_noise_has_its_standard_deviation():
    robot = true_robot()
    candidates = TouchCandidatesSection(count=100, seed=0).find(robot.nominal, PLACEMENTS)
    noise = section(noise={"sensor_mm": 0.2, "repeatability_mm": 0.15, "seed": 3}).noise
    data = simulate_touches(robot, PLACEMENTS, candidates, noise)
    assert_close(data.sigma_position, 0.25e-3, atol=1e-18)
    error = true_coordinates(robot, data) - data.touch
    assert_close(error.std(), 0.25e-3, rtol=0.12)
    assert abs(float(error.mean())) < 3 * 0.25e-3 / math.sqrt(200)
    assert_close(data.touch, candidates.face_coordinate)


def test_candidates_are_selected_by_index_or_mask():
    found = TouchCandidatesSection(**CANDIDATES).find(Robot.load("welding"), PLACEMENTS)
    chosen = found.select(torch.tensor([40, 2]))
    assert chosen.frame == ("left", "right")
    assert_close(chosen.q, found.q[[40, 2]])
    robot = true_robot()
    data = simulate_touches(robot, PLACEMENTS, chosen)
    assert_close(true_coordinates(robot, data), data.touch, atol=1e-12)
    assert simulate_touches(robot, PLACEMENTS, found.select(found.axis > 5)).rows == 0


def test_touches_that_miss_are_refused_or_reported():
    away = RIGHT | {"true_base": {"x_mm": 445, "y_mm": 1040, "roll_deg": -90}}
    stated = section(placements=(away,), candidates=CANDIDATES | {"count": 60, "margin_mm": 2})
    robot = TrueRobot(Robot.load("welding"))
    with refused(UnreachablePoseError, option="touches") as caught:
        stated.measure(robot)
    assert "of 60 " in str(caught.value)
    assert f"touch {caught.value.value} " in str(caught.value)
    data = stated.model_copy(update={"on_miss": "leave_out"}).measure(robot)
    assert 0 < data.rows < 60
    assert data.rows + len(data.left_out) == 60
    assert any(left.fault.value is not None for left in data.left_out)  # it has a tip, beyond the edges
    placement = JigPlacement(**away)
    assert_close(true_coordinates(robot, data, (placement,)), data.touch, atol=1e-12)
    short = stated.model_copy(update={"on_miss": "leave_out"})
    candidates = short.candidates.find(robot.nominal, short.placements)
    data = simulate_touches(robot, short.placements, candidates, travel=0.01, on_miss="leave_out")
    assert any(left.fault.value is None for left in data.left_out)


@pytest.mark.parametrize(
    ("change", "option", "value"),
    [
        ({"placements": (RIGHT, RIGHT)}, "touches", "right"),
        ({"placements": (RIGHT | {"base": {"x_mm": 3000}},)}, "touches", 0),
        ({"candidates": CANDIDATES | {"branch": {"name": "front"}}}, "branch", "front"),
    ],
)
def test_impossible_touches_are_refused(change: dict, option: str, value: object):
    with refused(RecipeError, option=option, value=value):
        section(**change).measure(true_robot())


def test_a_recipe_states_touches_completely():
    text = """
kind: touches
placements:
  - {name: right, base: {x_mm: 445, y_mm: 1000, roll_deg: -90}}
candidates: {count: 9, seed: 0, branch: {name: front/elbow_up/no_flip}}
noise: {sensor_mm: 0.2, seed: 1}
"""
    read = parse_yaml(text, SimulatedTouches, RecipeError, "recipe.yaml")
    assert read.measure(true_robot()).rows == 9
    with refused(RecipeError, line=4, column="placements.0.bse") as caught:
        parse_yaml(text.replace("base:", "bse:"), SimulatedTouches, RecipeError, "recipe.yaml")
    assert "'base'" in caught.value.remedy
