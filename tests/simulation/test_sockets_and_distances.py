"""Simulated sockets, draw wires, pairs and several sensors: the true robot is consistent with the measurements."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import parse_yaml
from pisigma.simulation import SimulatedDistances, SimulatedPairs, SimulatedSensors, SimulatedSockets
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection

DOWN = {"home_rotation": ((1, 0, 0), (0, -1, 0), (0, 0, -1))}
SOCKETS = {
    "kind": "sockets",
    "sockets": (
        {"name": "plate/0", "point_mm": (600, 100, 100)},
        {"name": "plate/1", "point_mm": (650, 100, 100)},
    ),
    "poses_per_socket": 20,
    "orientation": DOWN | {"spread_deg": 20},
    "seed": 1,
    "branch": {"near_deg": {}},
}
JOINTS = {"kind": "joints_random", "count": 40, "seed": 3, "range_fraction": 0.4}
WIRE = {"name": "wire", "point_mm": (1500, -200, 900), "zero_mm": 12}
NOISE = {"sensor_mm": 0.3, "repeatability_mm": 0.4, "seed": 5}


@pytest.fixture(scope="module")
def robot() -> TrueRobot:
    geometric = {
        "kind": "geometric",
        "rows": {"theta_2": {"a_mm": 3, "theta_deg": 0.4}},
        "tool": {"x_mm": -2},
    }
    return TrueRobotSection(robot="welding", errors=(geometric,)).true_robot()


def test_the_true_tool_point_is_in_its_socket(robot):
    data = SimulatedSockets(**SOCKETS).measure(robot)
    assert (data.rows, data.kinds, data.position) == (40, {"socket"}, None)
    assert data.socket == ("plate/0",) * 20 + ("plate/1",) * 20
    tip = robot.forward(data.q)[:, :3, 3]
    expected = torch.tensor([[0.6, 0.1, 0.1]] * 20 + [[0.65, 0.1, 0.1]] * 20, dtype=torch.float64)
    assert_close(tip, expected, atol=1e-12)
    turns = robot.forward(data.q)[:, :3, :3]
    assert float((turns[0] - turns[1]).abs().max()) > 0.05


def test_play_of_balls_and_repeatability_of_robots(robot):
    stated = SOCKETS | {"poses_per_socket": 400, "noise": NOISE}
    data = SimulatedSockets(**stated).measure(robot)
    assert_close(data.sigma_position, 0.5e-3, atol=1e-18)
    tip = robot.forward(data.q)[:, :3, 3].reshape(2, 400, 3)
    assert_close(tip.std(1), 0.5e-3, rtol=0.12)
    assert_close(tip.mean(1), [[0.6, 0.1, 0.1], [0.65, 0.1, 0.1]], atol=4 * 0.5e-3 / 20)


@pytest.mark.parametrize("known", [False, True])
def test_a_wire_is_as_long_as_the_true_robot_draws_it(robot, known: bool):
    anchor = WIRE | {"known": known}
    data = SimulatedDistances(kind="distances", poses=JOINTS, anchor=anchor).measure(robot)
    place = torch.tensor([1.5, -0.2, 0.9], dtype=torch.float64)
    away = robot.forward(data.q)[:, :3, 3] - place
    assert_close(data.distance, (away * away).sum(-1).sqrt() + 0.012, atol=1e-14)
    assert data.anchor == ("wire",) * 40
    if known:
        assert_close(data.anchor_place, place.expand(40, 3), atol=1e-15)
    else:
        assert data.anchor_place is None


def test_noise_of_a_wire(robot):
    poses = JOINTS | {"count": 3000}
    stated = {"kind": "distances", "poses": poses, "anchor": WIRE}
    exact = SimulatedDistances(**stated).measure(robot)
    noisy = SimulatedDistances(**stated, noise=NOISE).measure(robot)
    assert_close(noisy.q, exact.q)
    assert_close((noisy.distance - exact.distance).std(), 0.5e-3, rtol=0.05)
    assert_close(noisy.sigma_position, 0.5e-3, atol=1e-18)


def test_pairs_have_the_distance_of_their_tool_points(robot):
    data = SimulatedPairs(kind="pairs", poses=JOINTS).measure(robot)
    assert data.pair[:4] == ("pair 0", "pair 0", "pair 1", "pair 1")
    tip = robot.forward(data.q)[:, :3, 3]
    for row in range(0, 40, 2):
        distance = math.dist(tip[row].tolist(), tip[row + 1].tolist())
        assert_close(data.distance[row : row + 2], [distance, distance], atol=1e-14)


def test_both_poses_of_a_pair_deviate(robot):
    stated = {"kind": "pairs", "poses": JOINTS | {"count": 4000}}
    exact, noisy = (SimulatedPairs(**stated | noise).measure(robot) for noise in ({}, {"noise": NOISE}))
    expected = math.sqrt(0.3**2 + 2 * 0.4**2) * 1e-3
    assert_close(noisy.sigma_position, expected, atol=1e-18)
    assert_close((noisy.distance - exact.distance)[::2].std(), expected, rtol=0.06)


@pytest.mark.parametrize(
    "stated",
    [
        SOCKETS,
        {"kind": "distances", "poses": JOINTS, "anchor": WIRE},
        {"kind": "pairs", "poses": JOINTS},
    ],
    ids=lambda stated: stated["kind"],
)
def test_noise_depends_on_its_seed(robot, stated: dict):
    hashes = [
        SimulatedSensors(sensors=(stated | {"noise": NOISE | {"seed": seed}},)).measure(robot).content_hash()
        for seed in (1, 1, 2)
    ]
    assert hashes[0] == hashes[1] != hashes[2]


def test_several_sensors_measure_the_same_robot(robot, tmp_path):
    tracker = {"kind": "tracker", "poses": JOINTS | {"count": 5}, "sensor": "position", "frame": "tracker"}
    touches = {
        "kind": "touches",
        "placements": ({"name": "left", "base": {"x_mm": 1000, "y_mm": 445, "roll_deg": 180}},),
        "candidates": {"count": 6, "seed": 0},
    }
    wire = {"kind": "distances", "poses": JOINTS | {"seed": 9}, "anchor": WIRE}
    data = SimulatedSensors(sensors=(tracker, touches, SOCKETS, wire)).measure(robot)
    assert data.rows == 5 + 6 + 40 + 40
    assert data.kinds == {"position", "touch", "socket", "distance"}
    assert set(data.frame) == {"tracker", "left", ""}
    assert_close(data.position[:5], robot.forward(data.q[:5])[:, :3, 3])
    data.write_csv(tmp_path / "data.csv", robot.nominal)
    again = type(data).read_csv(tmp_path / "data.csv", robot.nominal)
    assert again.kinds == data.kinds
    assert_close(again.q, data.q, atol=1e-14)


RECIPE = """
sensors:
  - {kind: pairs, poses: {kind: joints_random, count: 4, seed: 0}}
  - kind: distances
    poses: {kind: joints_random, count: 4, seed: 0}
    anchor: {name: wire, point_mm: [1500, 0, 500]}
  - kind: sockets
    sockets: [{name: a, point_mm: [600, 0, 100]}]
    poses_per_socket: 2
    orientation: {home_rpy_deg: [0, 0, 180]}
    seed: 0
    branch: {near_deg: {}}
"""


GRID = "polar_grid, r_mm: [1, 2], r_steps: 1, phi_deg: [0, 1], phi_steps: 1, z_mm: 0}"


@pytest.mark.parametrize(
    ("old", "new", "line", "column", "name"),
    [
        ("count: 4, seed: 0}}", "count: 3, seed: 0}}", 3, "sensors.0", ""),
        ("[1500, 0, 500]}", "[1500, 0, 500], zero: 1}", 6, "sensors.1.anchor.zero", "'zero_mm'"),
        ("[{name: a,", "[{name: a, point_mm: [1, 2, 3]}, {name: a,", 8, "sensors.2.sockets", "'a'"),
        ("kind: sockets", "kind: socket", 7, "sensors.2.kind", "'sockets'"),
        (
            "joints_random, count: 4, seed: 0}\n    anchor",
            f"{GRID}\n    anchor",
            4,
            "sensors.1",
            "branch",
        ),
    ],
)
def test_incomplete_and_contradictory_recipes_are_refused(
    robot, old: str, new: str, line: int, column: str, name: str
):
    assert parse_yaml(RECIPE, SimulatedSensors, RecipeError, "recipe.yaml").measure(robot).rows == 10
    with refused(RecipeError, file="recipe.yaml", line=line, column=column) as caught:
        parse_yaml(RECIPE.replace(old, new, 1), SimulatedSensors, RecipeError, "recipe.yaml")
    assert name in str(caught.value)


def test_negative_distances_and_odd_numbers_of_poses_are_refused(robot):
    anchor = WIRE | {"zero_mm": -5000}
    with refused(RecipeError, option="distances") as caught:
        SimulatedDistances(kind="distances", poses=JOINTS, anchor=anchor).measure(robot)
    assert caught.value.value < 0
    grid = {"kind": "cube_grid", "steps": (1, 1, 1), "x_mm": (600, 600), "y_mm": (0, 0), "z_mm": (200, 200)}
    stated = {"kind": "pairs", "poses": grid | {"orientation": DOWN}, "branch": {"near_deg": {}}}
    with refused(RecipeError, option="pairs", value=1):
        SimulatedPairs(**stated).measure(robot)
