"""Order of poses: short, with collision-free motions."""

import itertools
import math

import numpy as np
import torch
from testing.cells import CELL
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.planning.candidates import draw_candidates
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.motion import Motions, is_free
from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.planning.tour import Pace, order_of_use, plan_tour, stage_ends
from pisigma.robot import Robot

ARM = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000"), CELL)
PACE = Pace(speed=math.radians(20), settling=2.0)


def scara_between_walls(gap_mm: float) -> ArmInSurroundings:
    """Return a SCARA robot between two walls on one line, which end at a distance from its base."""
    boxes = [
        {"name": f"wall {side}", "center_mm": (side * (3000 + gap_mm), 0, 1500), "size_mm": (6000, 40, 3000)}
        for side in (-1, 1)
    ]
    return ArmInSurroundings.from_robot(Robot.load("kiro3"), Surroundings.model_validate({"boxes": boxes}))


def test_few_poses_are_in_the_best_order():
    q = torch.from_numpy(np.random.default_rng(3).uniform(-0.4, 0.4, (7, 6)))
    arm = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000"))
    way = plan_tour(Motions(arm, q), q, PACE)

    def seconds(order: tuple[int, ...]) -> float:
        path = q[list(order)]
        return float(PACE.motion_duration(arm.robot, path[:-1], path[1:]).sum()) + PACE.settling * len(order)

    best = min(seconds(order) for order in itertools.permutations(range(len(q))))
    assert sorted(way.order.tolist()) == list(range(len(q)))
    assert_close(way.seconds, seconds(tuple(way.order.tolist())), rtol=1e-12)
    assert best - 1e-9 <= way.seconds <= 1.05 * best


def test_a_tour_starts_at_the_present_joint_values():
    q = torch.from_numpy(np.random.default_rng(3).uniform(-0.4, 0.4, (7, 6)))
    arm = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000"))
    start = q[4] + 0.01
    way = plan_tour(Motions(arm, q), q, PACE, start)
    assert int(way.order[0]) == 4
    assert sorted(way.order.tolist()) == list(range(7))


def test_the_most_useful_poses_come_in_the_first_stage():
    q = torch.from_numpy(np.random.default_rng(4).uniform(-0.4, 0.4, (9, 6)))
    arm = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000"))
    order = plan_tour(Motions(arm, q), q, PACE, q[0], stages=(2, 5, 20)).order.tolist()
    assert [set(order[:2]), set(order[2:5]), set(order[5:])] == [{0, 1}, {2, 3, 4}, {5, 6, 7, 8}]
    assert stage_ends(20) == ()
    assert stage_ends(81) == (20, 40, 80)


def test_test_poses_are_distributed_evenly():
    assert order_of_use(6, 2).tolist() == [0, 1, 6, 2, 3, 4, 7, 5]
    assert order_of_use(2, 0).tolist() == [0, 1]


def test_every_motion_is_collision_free():
    arm = ArmInSurroundings.from_robot(
        ARM.nominal, CELL.model_copy(update={"tracker": None, "reflector": None})
    )
    pool = draw_candidates(arm, 60, 0).q
    way = plan_tour(Motions(arm, pool), pool[:5], PACE)
    assert not len(way.left_out)
    assert sum(map(len, way.waypoints_before)) == 1, "the test wants a motion that is blocked"
    stops = [
        torch.cat([points, pool[[int(pose)]]])
        for pose, points in zip(way.order, way.waypoints_before, strict=True)
    ]
    path = torch.cat(stops)
    assert bool(is_free(arm, path[:-1], path[1:]).all())


def test_an_unreachable_pose_is_left_out():
    q = torch.tensor([[1.5, 0.3, -0.1, 0], [1.2, 0.1, -0.2, 1], [-1.5, -0.3, -0.1, 0]], dtype=torch.float64)
    way = plan_tour(Motions(scara_between_walls(200), q), q, PACE)
    assert len(way.left_out) == 1
    assert len(way.order) == 2


def test_the_part_of_the_free_space_with_the_task_is_found():
    arm = scara_between_walls(200)
    q = draw_candidates(arm, 300, 0).q
    front = q[:, 0] > 0
    few_behind = torch.cat([q[front], q[~front][:20]])
    motions = Motions(arm, few_behind)
    for part in (front, ~front):
        reached = motions.reach_most_of_task(q, q[part])
        assert not bool(reached[~part].any())
        assert float(reached[part].double().mean()) > 0.95


def test_paths_with_several_waypoints_are_collision_free():
    arm = scara_between_walls(400)
    pool = draw_candidates(arm, 60, 1).q
    motions = Motions(arm, pool)
    points = [motions.points_between(pool[i], pool[i + 1]) for i in range(0, 40, 2)]
    paths = [
        torch.cat([pool[[2 * i]], some, pool[[2 * i + 1]]])
        for i, some in enumerate(points)
        if some is not None and len(some) > 1
    ]
    assert paths
    assert all(bool(is_free(arm, path[:-1], path[1:]).all()) for path in paths)


def test_invalid_paces_are_refused():
    for option, value in (("speed", "0 deg/s"), ("prismatic_speed", "-250 mm/s"), ("settling", "-1 s")):
        stated = {"speed": 0.0, "prismatic_speed": -0.25, "settling": -1.0}[option]
        with refused(PlanningError, option=option, value=value):
            Pace(**{option: stated})
