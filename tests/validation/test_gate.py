"""The gate for rows, by the robot as drawn."""

from dataclasses import replace

import pytest
import torch
from testing.measured_plans import measured_plan

from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.gate import check_rows

PLAN = measured_plan("kiro3")
ROBOT = PLAN.stored.arm.robot


def sentence(rows: Measurements, robot: Robot = ROBOT) -> str:
    return " ".join(one.sentence for one in check_rows(rows, robot).implausible)


def test_right_rows_and_very_few_have_no_fault():
    assert sentence(PLAN.rows(5)) == sentence(PLAN.rows(24)) == ""
    few = PLAN.rows(3)
    assert sentence(replace(few, position=few.position * 1000)) == ""


@pytest.mark.parametrize("rows", [5, 24])
@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1000.0, "millimetres that are named metres"), (0.001, "metres that are named millimetres")],
)
def test_a_wrong_unit_is_named(rows, factor, unit):
    some = PLAN.rows(rows)
    assert unit in sentence(replace(some, position=some.position * factor))


@pytest.mark.parametrize(("measured", "rows"), [("ur5e", 6), ("ur10", 8), ("ur5", 30), ("ur5e", 5)])
def test_another_robot_of_the_catalogue_is_named(measured, rows):
    q = torch.rand(rows, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(rows)) * 4 - 2
    noise = 5e-5 * torch.randn(rows, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    some = Measurements(q, forward_kinematics(Robot.load(measured), q)[:, :3, 3] + noise)
    found = sentence(some, Robot.load("ur5"))
    assert found.startswith(f"Robot '{measured}' of the catalogue") == (measured != "ur5" and rows >= 6)


@pytest.mark.parametrize(("longer", "rows", "said"), [(0.06, 12, True), (0.06, 30, True), (5e-4, 30, False)])
def test_an_arm_that_nobody_drew_is_named(longer, rows, said):
    """A link is longer than the catalogue says of any robot."""
    robot = Robot.load("ur5")
    dh = robot.dh.copy()
    dh[1, 2] -= longer
    q = torch.rand(rows, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(rows)) * 4 - 2
    noise = 5e-5 * torch.randn(rows, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    some = Measurements(q, forward_kinematics(robot.with_geometry(dh), q)[:, :3, 3] + noise)
    kinds = {one.kind for one in check_rows(some, robot).implausible}
    assert bool(kinds & {"prior_ratio", "implausible_errors"}) == said


@pytest.mark.parametrize(("name", "rows"), [("ur5", 8), ("kiro3", 12)])
def test_a_reversed_joint_is_named_from_few_rows_on(name, rows):
    plan = measured_plan(name)
    robot, some = plan.stored.arm.robot, plan.rows(rows)
    assert sentence(some, robot) == ""
    signs = torch.ones(robot.dof)
    signs[3] = -1
    assert sentence(replace(some, q=some.q * signs), robot).startswith("The sign of joint 4 is reversed")
