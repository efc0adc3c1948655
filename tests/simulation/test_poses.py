"""Poses to measure at: points of grids, and bounds of random poses."""

import math

import pytest
import torch
from pydantic import TypeAdapter, ValidationError
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.robot import Robot
from pisigma.robot.se3 import check_transforms, rotation_from_zyx
from pisigma.simulation.poses import (
    CubeGrid,
    CubeRandom,
    JointsRandom,
    PolarGrid,
    PolarRandom,
    WhereToMeasure,
)

# Jeong, Kim and Kwak 1998, section 4.1.1: steps of 40 mm and 8.18 deg, 100 points in the first quadrant.
KIRO3_GRID = {"r_mm": (200, 560), "r_steps": 10, "phi_deg": (8.18, 81.8), "phi_steps": 10, "z_mm": 300}
# The same, section 4.2.1 and appendix B.
KIRO4_CUBE = {"x_mm": (600, 1000), "y_mm": (0, 400), "z_mm": (400, 800)}
KIRO4_HOME = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))


def test_polar_grid_has_the_papers_points():
    T = PolarGrid(kind="polar_grid", orientation={"home_rpy_deg": (30, 0, 0)}, **KIRO3_GRID).transforms()
    assert T.shape == (100, 4, 4)
    index = 0
    for i in range(10):
        for j in range(1, 11):
            r, phi = 0.2 + 0.04 * i, math.radians(8.18 * j)
            assert_close(T[index, :3, 3], [r * math.cos(phi), r * math.sin(phi), 0.3], atol=1e-15)
            index += 1
    turned = rotation_from_zyx(torch.tensor([math.radians(30), 0, 0], dtype=torch.float64))
    assert_close(T[:, :3, :3], turned.expand(100, 3, 3), atol=1e-16)


def test_cube_grid_has_the_papers_points():
    cube = CubeGrid(
        kind="cube_grid", steps=(5, 5, 5), orientation={"home_rotation": KIRO4_HOME}, **KIRO4_CUBE
    )
    T = cube.transforms()
    points = [[x / 10, y / 10, z / 10] for x in range(6, 11) for y in range(5) for z in range(4, 9)]
    assert_close(T[:, :3, 3], torch.tensor(points, dtype=torch.float64), atol=1e-15)
    assert_close(T[:, :3, :3], torch.tensor(KIRO4_HOME, dtype=torch.float64).expand(125, 3, 3))


def test_spread_rotates_the_home_orientation_as_documented():
    orientation = {"home_rotation": KIRO4_HOME, "spread_deg": 45}
    T = CubeGrid(
        kind="cube_grid", steps=(5, 5, 5), orientation=orientation, seed=4, **KIRO4_CUBE
    ).transforms()
    draws = torch.rand(125, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    home = torch.tensor(KIRO4_HOME, dtype=torch.float64)
    rpy = (2 * draws - 1) * math.pi / 4
    assert_close(T[:, :3, :3], home @ rotation_from_zyx(rpy), atol=1e-15)
    check_transforms(T, "grid", tolerance=1e-14)


def test_polar_random_poses_fill_their_region():
    T = PolarRandom(
        kind="polar_random", count=2000, seed=1, r_mm=(200, 560), phi_deg=(8.18, 81.8), z_mm=300
    ).transforms()
    r, phi = torch.hypot(T[:, 0, 3], T[:, 1, 3]), torch.rad2deg(torch.atan2(T[:, 1, 3], T[:, 0, 3]))
    for values, lower, upper in ((r, 0.2, 0.56), (phi, 8.18, 81.8)):
        assert lower <= float(values.min()) < lower + 0.01 * (upper - lower)
        assert upper - 0.01 * (upper - lower) < float(values.max()) <= upper
        assert_close(values.mean(), (lower + upper) / 2, rtol=0.03)
    assert_close(T[:, 2, 3], 0.3)


def test_cube_random_poses_fill_their_region():
    T = CubeRandom(
        kind="cube_random", count=2000, seed=1, orientation={"spread_deg": 10}, **KIRO4_CUBE
    ).transforms()
    share = (T[:, :3, 3] - torch.tensor([0.6, 0.0, 0.4])) / 0.4
    assert float(share.min()) >= -1e-6
    assert float(share.max()) <= 1 + 1e-6
    assert bool((share.amin(0) < 0.01).all())
    assert bool((share.amax(0) > 0.99).all())
    # Position and orientation come from one stream of draws and must not go together.
    together = torch.corrcoef(torch.cat([T[:, :3, 3], T[:, 0, 1:3], T[:, 1, 2:3]], -1).T)
    assert float((together - torch.eye(6)).abs().max()) < 0.1


def test_joints_fill_a_share_of_their_limits_and_stated_ranges():
    robot = Robot.load("kiro3")
    source = JointsRandom(
        kind="joints_random", count=3000, seed=2, range_fraction=0.5, range_mm={"d_3": (-300, -200)}
    )
    q = source.joints(robot)
    bounds = torch.tensor([[-90, 90], [-79, 79], [-0.3, -0.2], [-180, 180]], dtype=torch.float64)
    bounds[[0, 1, 3]] = torch.deg2rad(bounds[[0, 1, 3]])
    share = (q - bounds[:, 0]) / (bounds[:, 1] - bounds[:, 0])
    assert float(share.min()) >= 0
    assert float(share.max()) <= 1
    assert bool((share.amin(0) < 0.01).all())
    assert bool((share.amax(0) > 0.99).all())


RANDOM = [
    {"kind": "polar_random", "count": 5, "r_mm": [200, 560], "phi_deg": [0, 90], "z_mm": 300},
    {"kind": "cube_random", "count": 5, **KIRO4_CUBE, "orientation": {"spread_deg": 20}},
    {"kind": "cube_grid", "steps": [2, 1, 3], **KIRO4_CUBE, "orientation": {"spread_deg": 20}},
    {"kind": "polar_grid", **KIRO3_GRID, "orientation": {"spread_deg": 20}},
    {"kind": "joints_random", "count": 5},
]


@pytest.mark.parametrize("fields", RANDOM, ids=lambda fields: fields["kind"])
def test_seeds_repeat_and_differ(fields):
    def values(seed: int) -> torch.Tensor:
        where = TypeAdapter(WhereToMeasure).validate_python(fields | {"seed": seed})
        return where.joints(Robot.load("ur10")) if isinstance(where, JointsRandom) else where.transforms()

    assert_close(values(3), values(3))
    assert float((values(3) - values(4)).abs().max()) > 1e-3


@pytest.mark.parametrize(
    ("fields", "kind", "location"),
    [
        (
            {"kind": "cube_grid", "steps": (2, 2, 2), **KIRO4_CUBE, "orientation": {"spread_deg": 5}},
            "value_error",
            ("cube_grid",),
        ),
        (
            {"kind": "cube_grid", "steps": (2, 0, 2), **KIRO4_CUBE},
            "greater_than_equal",
            ("cube_grid", "steps", 1),
        ),
        (
            {
                "kind": "cube_grid",
                "steps": (2, 2, 2),
                **KIRO4_CUBE,
                "orientation": {"home_rotation": ((1, 0, 0), (0, 1, 0), (0, 0, -1))},
            },
            "value_error",
            ("cube_grid", "orientation", "home_rotation"),
        ),
        (
            {
                "kind": "polar_grid",
                **KIRO3_GRID,
                "orientation": {"home_rpy_deg": (0, 0, 0), "home_rotation": KIRO4_HOME},
            },
            "value_error",
            ("polar_grid", "orientation"),
        ),
        ({"kind": "spiral"}, "union_tag_invalid", ()),
    ],
)
def test_impossible_poses_are_refused(fields, kind, location):
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(WhereToMeasure).validate_python(fields)
    assert [(one["type"], one["loc"]) for one in caught.value.errors()][:1] == [(kind, location)]


@pytest.mark.parametrize(
    ("fields", "value"),
    [
        ({"range_deg": {"theta_5": (0, 1)}}, "theta_5"),
        ({"range_deg": {"d_3": (0, 1)}}, "d_3"),
        ({"range_deg": {"theta_1": (10, 190)}}, "0.174533 to 3.31613"),
        ({"range_deg": {"theta_1": (20, 10)}}, "0.349066 to 0.174533"),
    ],
)
def test_impossible_joint_ranges_are_refused(fields, value):
    with refused(RecipeError, option="joints_random", value=value):
        JointsRandom(kind="joints_random", count=1, seed=0, **fields).joints(Robot.load("kiro3"))


def test_joints_without_limits_need_a_range():
    unlimited = Robot.load("kiro3")
    rows = tuple(type(row)(row.name, row.type) for row in unlimited.rows)
    robot = type(unlimited)("free", "", "", rows, unlimited.dh)
    with refused(RecipeError, option="joints_random", value="theta_1"):
        JointsRandom(kind="joints_random", count=1, seed=0).joints(robot)
