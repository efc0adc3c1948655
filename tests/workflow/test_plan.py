"""Plans from a robot to its files: every pose passes an independent check, and the measured plan can be read."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.cells import CELL, is_collision_free, is_visible
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused
from testing.report import hybrid_under_test

from pisigma.files.errors import MeasurementError, PlanningError
from pisigma.measurement.dataset import Measurements
from pisigma.planning.candidates import draw_candidates
from pisigma.planning.plan_file import read_plan
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.motion import is_free
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.workflow.plan import Plan, plan

SETTINGS = PlanSettings(count=11, check=3, candidates=40, limit_mm=2.0)
RADIUS = np.array([*(0.05 * 3.534 for _ in range(3)), *(0.035 * 3.534 for _ in range(3)), 0.025])


@pytest.fixture(scope="module")
def planned() -> Plan:
    with no_type_checker():
        return plan("fanuc_r2000", SETTINGS, CELL)


def test_every_planned_pose_is_reachable_free_and_seen(planned: Plan):
    robot, q = planned.stored_plan.arm.robot, planned.stored_plan.q.numpy()
    assert len(q) == 14
    margin = np.deg2rad(5)
    assert (q >= robot.limits[:, 0] + margin - 1e-9).all()
    assert (q <= robot.limits[:, 1] - margin + 1e-9).all()
    assert all(is_collision_free(robot, CELL, pose, RADIUS) for pose in q)
    assert all(is_visible(robot, CELL, pose, RADIUS) for pose in q)


def test_every_motion_is_free(planned: Plan):
    stops = [
        torch.cat([p, q[None]])
        for p, q in zip(planned.stored_plan.waypoints, planned.stored_plan.q, strict=True)
    ]
    path = torch.cat(stops)
    steps = np.linspace(0, 1, 12)[:, None]
    for start, end in zip(path[:-1].numpy(), path[1:].numpy(), strict=True):
        on_the_way = start + steps * (end - start)
        assert all(
            is_collision_free(
                planned.stored_plan.arm.robot, CELL.model_copy(update={"clearance_mm": 5.0}), q, RADIUS
            )
            for q in on_the_way
        )
    assert bool(is_free(planned.stored_plan.arm, path[:-1], path[1:]).all())


def test_more_poses_lower_the_expected_error(planned: Plan):
    assert [point.poses for point in planned.accuracy_curve] == [10, 11]
    assert planned.accuracy_curve[0].rms > planned.accuracy_curve[1].rms > 0
    assert planned.accuracy_curve[1].random_rms > planned.accuracy_curve[1].rms
    assert planned.poses_needed is not None
    assert (
        planned.accuracy_curve[-1].rms < planned.accuracy_curve[-1].p95 < 2e-3
    )  # as in a session, 95 % of the errors keep the limit
    assert 1 <= planned.poses_needed <= 11
    assert planned.duration > 14 * 3.0
    assert planned.main_error_sources


def test_the_measured_plan_is_a_measurement_file(planned: Plan, tmp_path: Path):
    planned.save(tmp_path / "poses.csv", [tmp_path / "poses.src", tmp_path / "poses.script"])
    robot = Robot.load("fanuc_r2000")
    header, *rows = (tmp_path / "poses.csv").read_text().splitlines()
    position = forward_kinematics(robot, read_plan(tmp_path / "poses.csv").q)[:, :3, 3] * 1e3
    lines = [f"{row},{x!r},{y!r},{z!r}" for row, (x, y, z) in zip(rows, position.tolist(), strict=True)]
    (tmp_path / "measured.csv").write_text("\n".join([header + ",x_mm,y_mm,z_mm", *lines]))
    train, test = Measurements.read_csv(tmp_path / "measured.csv", robot).split_sets()
    assert test is not None
    assert (train.rows, test.rows) == (11, 3)
    script = (tmp_path / "poses.script").read_text()
    assert script.count("sleep(3.0)") == 14
    assert script.count("movej") == 14 + sum(map(len, planned.stored_plan.waypoints))
    assert "WAIT SEC 3.0" in (tmp_path / "poses.src").read_text()


def test_existing_measurements_are_used(planned: Plan, tmp_path: Path):
    planned.save(tmp_path / "poses.csv")
    header, *rows = (tmp_path / "poses.csv").read_text().splitlines()
    measured = [f"{row},0.0,0.0,0.0" for row in rows]
    (tmp_path / "measured.csv").write_text("\n".join([header + ",x_mm,y_mm,z_mm", *measured[:4]]))
    settings = PlanSettings(count=2, check=0, candidates=12, measured=str(tmp_path / "measured.csv"))
    with no_type_checker():
        more = plan("fanuc_r2000", settings, CELL)
    assert [point.poses for point in more.accuracy_curve] == [0, 2]
    assert more.test_pose_count == 0


@pytest.mark.parametrize(
    ("rows", "scale", "kind"),
    [
        (6, 1.0, "setup_fault"),
        (20, 1e3, "other_robot"),
    ],
)
def test_measurements_that_cannot_be_of_the_robot_are_refused(
    rows: int, scale: float, kind: str, tmp_path: Path
):
    """They are a few rows in another unit, and many of another robot."""
    robot = Robot.load("ur5")
    q = torch.rand(rows, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) * 4 - 2
    measured = {6: "ur5", 20: "ur5e"}[rows]
    position = forward_kinematics(Robot.load(measured), q)[:, :3, 3] * scale
    lines = torch.cat([torch.rad2deg(q), position], 1).tolist()
    header = ",".join([*(f"q{joint}_deg" for joint in range(1, 7)), "x_mm", "y_mm", "z_mm"])
    (tmp_path / "rows.csv").write_text("\n".join([header, *(",".join(map(repr, line)) for line in lines)]))
    settings = PlanSettings(count=2, check=0, candidates=12, measured=str(tmp_path / "rows.csv"))
    with no_type_checker(), refused(MeasurementError, value=kind):
        plan(robot, settings)


def test_rows_that_a_model_was_made_from_do_not_count_twice(tmp_path: Path):
    """All rows or a part of them are refused; some among others give a warning."""
    arm, model = hybrid_under_test()
    rows = tmp_path / "rows.csv"
    settings = PlanSettings(count=2, check=0, candidates=12, measured=str(rows))
    for some in (arm.measurements, arm.measurements.select(torch.arange(30))):
        some.write_csv(rows)
        with no_type_checker(), refused(MeasurementError, file=rows, option="--measured", value=model.name):
            plan(model, settings)
    moved = some.position.clone()
    moved[20:] += 5e-5
    replace(some, position=moved).write_csv(rows)
    with no_type_checker():
        warnings = plan(model, settings).warnings
    assert "20 of 30" in warnings[0]


def test_candidates_that_hardly_move_a_joint_are_warned_of(tmp_path: Path):
    q = torch.rand(20, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2 - 1
    header = ",".join(f"q{joint}_deg" for joint in range(1, 7))
    scale = torch.tensor([50.0, 50, 50, 50, 50, 0.8])  # the last joint in rad
    rows = [",".join(map(repr, row)) for row in (q * scale).tolist()]
    (tmp_path / "some.csv").write_text("\n".join([header, *rows]))
    settings = PlanSettings(count=2, check=0, candidates_from=str(tmp_path / "some.csv"))
    with no_type_checker():
        (warning,) = plan("ur5", settings).warnings
    assert "theta_6 by 1.27 of 360 deg" in warning
    assert "theta_5" not in warning


def test_a_plan_for_a_model_uses_its_identified_tool():
    """Poses are planned with the identified tool, and for it."""
    with no_type_checker():
        _, model = hybrid_under_test()
        more = plan(model, PlanSettings(count=3, check=1, candidates=30))
    assert [point.poses for point in more.accuracy_curve] == [0, 3]
    assert 0 < more.accuracy_curve[1].rms < more.accuracy_curve[0].rms < 1e-3
    assert_close(more.stored_plan.arm.robot.tool, model.identified.tool)


def test_too_few_candidates_are_refused():
    with pytest.raises(PlanningError) as caught:
        plan("fanuc_r2000", PlanSettings(count=30, check=0, candidates=20), CELL)
    assert {"30", "20"} <= set(re.findall(r"\d+", str(caught.value)))


def test_plans_are_the_same_at_every_call():
    with no_type_checker():
        one, other = (plan("kiro3", PlanSettings(count=3, check=1, candidates=30)) for _ in range(2))
    assert_close(one.stored_plan.q, other.stored_plan.q)
    assert one.accuracy_curve == other.accuracy_curve


@pytest.mark.parametrize("task_in_front", [None, True, False])
def test_all_poses_are_planned_in_the_part_of_the_free_space_that_contains_the_task(
    tmp_path: Path, task_in_front: bool | None
):
    boxes = [
        {"name": f"wall {side}", "center_mm": (side * 3200, 0, 1500), "size_mm": (6000, 40, 3000)}
        for side in (-1, 1)
    ]
    settings = PlanSettings(count=8, check=2, candidates=120, limit_mm=2.0)
    if task_in_front is not None:
        q = draw_candidates(ArmInSurroundings.from_robot(Robot.load("kiro3")), 60, 1).q
        q = q[(q[:, 0] > 0) == task_in_front]
        Measurements(q=q, position=torch.zeros(len(q), 3, dtype=torch.float64)).write_csv(
            tmp_path / "task.csv", Robot.load("kiro3")
        )
        settings = replace(settings, task=tmp_path / "task.csv")
    planned = plan("kiro3", settings, CELL.model_validate({"boxes": boxes}))
    q = planned.stored_plan.q
    assert len(q) == 10
    assert int(planned.stored_plan.is_test_pose.sum()) == 2
    assert len(q[:, 0].sign().unique()) == 1
    assert task_in_front is None or bool((q[0, 0] > 0) == task_in_front)
    assert len(planned.warnings) >= 1
