"""Which poses and motions a cell allows, against points on the links."""

import numpy as np
import pytest
import torch
from testing.cells import CELL, is_collision_free, is_visible
from testing.closeness import assert_close

from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.motion import Motions, is_free
from pisigma.planning.surroundings.surroundings import LinkSection, Surroundings
from pisigma.robot import Robot

ARM = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000"), CELL)
RADIUS = np.array([*(0.05 * 3.534 for _ in range(3)), *(0.035 * 3.534 for _ in range(3)), 0.025])
LIMITS = ARM.limits.clamp(-np.pi, np.pi)
DRAWS = torch.rand(300, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
Q = LIMITS[:, 0] + (LIMITS[:, 1] - LIMITS[:, 0]) * DRAWS
FAULTS = ARM.faults(Q)


def test_capsules_are_as_thick_as_the_documentation_says():
    assert_close(ARM.capsules.radius.unique(), np.unique(RADIUS), rtol=1e-3)


def test_every_allowed_pose_is_free_and_visible():
    allowed = Q[FAULTS.allowed].numpy()
    assert 15 < len(allowed) < 150
    assert all(is_collision_free(ARM.robot, CELL, q, RADIUS) for q in allowed)
    assert all(is_visible(ARM.robot, CELL, q, RADIUS) for q in allowed)


def test_every_refused_pose_has_a_reason():
    """Points are slightly farther apart than the lines through them, hence the few that only lines refuse."""
    refused = Q[~FAULTS.allowed][:60].numpy()
    wrongly = [
        is_collision_free(ARM.robot, CELL, q, RADIUS) and is_visible(ARM.robot, CELL, q, RADIUS)
        for q in refused
    ]
    assert sum(wrongly) <= 0.1 * len(refused)


def test_every_reason_is_named():
    everything = " ".join(FAULTS.counts())
    for word in ("links", "floor", "'table'", "hides", "turned away"):
        assert word in everything
    outside = ARM.faults(torch.tensor([[4.0, 0, 0, 0, 0, 0]], dtype=torch.float64))
    assert "outside its limits" in str(outside.sentence(0))
    assert FAULTS.sentence(int(FAULTS.allowed.nonzero()[0])) is None


@pytest.mark.parametrize(
    ("links", "named"),
    [
        ({}, None),
        ({"radius_mm": 60.0}, None),
        ({"radius_mm": 900.0}, "link theta_1 and link theta_4"),
        ({"radii_mm": {"theta_4": 1700.0}}, "link theta_1 and link theta_4"),
    ],
)
def test_links_too_thick_to_be_separated_are_named(links: dict[str, object], named: str | None):
    arm = ArmInSurroundings.from_robot(
        Robot.load("ur10"), Surroundings(links=LinkSection.model_validate(links))
    )
    assert len(arm.unchecked_link_sentences) == (named is not None)
    assert named is None or named in arm.unchecked_link_sentences[0]


def test_a_motion_is_free_where_all_poses_on_it_are():
    q = Q[ARM.smallest_clearance(Q) >= 0]
    start, end = q[:20], q[20:40]
    free = is_free(ARM, start, end)
    assert 0 < int(free.sum()) < len(free)
    steps = torch.linspace(0, 1, 100, dtype=torch.float64)[:, None, None]
    least = (
        ARM.smallest_clearance((start + steps * (end - start)).reshape(-1, 6)).reshape(100, -1).min(0).values
    )
    assert bool((least[free] > -ARM.surroundings.clearance / 2).all())
    assert bool((least[~free] < 0).all())


def test_waypoints_avoid_obstacles():
    q = Q[ARM.smallest_clearance(Q) >= 0]
    blocked = (~is_free(ARM, q[:20], q[20:40])).nonzero()[:, 0].tolist()
    start, end = q[blocked[0]], q[20 + blocked[0]]
    points = Motions(ARM, q).points_between(start, end)
    assert points is not None
    path = torch.cat([start[None], points, end[None]])
    assert bool(is_free(ARM, path[:-1], path[1:]).all())
    assert Motions(ARM, q[:0]).points_between(start, end) is None


def test_checked_motions_are_kept_in_both_directions():
    q = Q[ARM.smallest_clearance(Q) >= 0]
    motions, free = Motions(ARM, q), is_free(ARM, q[:20], q[20:40])
    assert motions.are_free(q[:20], q[20:40]).tolist() == free.tolist()
    assert motions.are_free(q[20:40], q[:20]).tolist() == free.tolist()
    assert motions.are_free(q[:30], q[10:40]).tolist() == is_free(ARM, q[:30], q[10:40]).tolist()
    first = (~free).nonzero()[0]
    points = motions.points_between(q[first][0], q[20 + first][0])
    assert points is not None
    assert motions.points_between(q[first][0], q[20 + first][0]) is points


def test_a_measured_pose_is_free_of_self_collision():
    """Poses that touch by the drawing are allowed where they were measured, and so are those with more room."""
    arm = ArmInSurroundings.from_robot(Robot.load("ur5"))
    limits = torch.from_numpy(np.clip(arm.robot.limits, -np.pi, np.pi))
    draws = torch.rand(400, arm.robot.dof, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = limits[:, 0] + (limits[:, 1] - limits[:, 0]) * draws
    touching = (~arm.faults(q).allowed).nonzero()[:, 0]
    measured = q[touching[:5]]
    allowed = arm.allow_measured_poses(measured)
    assert len(touching) > 10
    assert allowed.faults(measured).allowed.all()
    assert allowed.faults(q).allowed.sum() < len(q)
