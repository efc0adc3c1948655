"""The check of rows by the nominal robot, before they are used."""

from dataclasses import replace

import pytest
import torch
from testing.hybrid import few_robots
from testing.measured_plans import measured_plan
from testing.models import no_type_checker

from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.gate import check_rows

PLAN = measured_plan("kiro3")
ROBOT = PLAN.stored.arm.robot


@pytest.fixture(scope="module", autouse=True)
def quick():
    with no_type_checker(), few_robots():
        yield


def found(rows: Measurements, robot: Robot = ROBOT) -> list[tuple[str, str]]:
    """Kinds and causes of the findings that make the rows implausible."""
    return [(one.kind, one.cause) for one in check_rows(rows, robot).implausible_findings]


def test_valid_and_very_few_rows_have_no_fault():
    assert found(PLAN.rows(5)) == found(PLAN.rows(24)) == []
    few = PLAN.rows(3)
    assert found(replace(few, position=few.position * 1000)) == []


@pytest.mark.parametrize(
    ("rows", "factor", "cause"),
    [
        (5, 1000.0, "mm_named_m"),
        (5, 0.001, "m_named_mm"),
        (24, 1000.0, "position_unit"),
    ],
)
def test_a_wrong_unit_is_named(rows, factor, cause):
    some = PLAN.rows(rows)
    assert found(replace(some, position=some.position * factor)) == [("setup_fault", cause)]


@pytest.mark.parametrize(("measured", "rows"), [("ur5e", 6), ("ur10", 8), ("ur5", 30), ("ur5e", 5)])
def test_another_robot_of_the_catalogue_is_named(measured, rows):
    q = torch.rand(rows, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(rows)) * 4 - 2
    noise = 5e-5 * torch.randn(rows, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    some = Measurements(q, forward_kinematics(Robot.load(measured), q)[:, :3, 3] + noise)
    named = found(some, Robot.load("ur5"))[:1] == [("other_robot", measured)]
    assert named == (measured != "ur5" and rows >= 6)


@pytest.mark.parametrize(("longer", "rows", "said"), [(0.06, 12, True), (0.06, 30, True), (5e-4, 30, False)])
def test_an_arm_that_is_not_in_the_catalogue_is_implausible(longer, rows, said):
    """A link is longer than the catalogue says of any robot."""
    robot = Robot.load("ur5")
    dh = robot.dh.copy()
    dh[1, 2] -= longer
    q = torch.rand(rows, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(rows)) * 4 - 2
    noise = 5e-5 * torch.randn(rows, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    some = Measurements(q, forward_kinematics(robot.with_geometry(dh), q)[:, :3, 3] + noise)
    kinds = {one.kind for one in check_rows(some, robot).implausible_findings}
    assert bool(kinds & {"prior_ratio", "implausible_errors"}) == said


@pytest.mark.parametrize(("name", "rows"), [("ur5", 8), ("kiro3", 12)])
def test_a_reversed_joint_is_named_with_few_rows(name, rows):
    plan = measured_plan(name)
    robot, some = plan.stored.arm.robot, plan.rows(rows)
    assert found(some, robot) == []
    signs = torch.ones(robot.dof)
    signs[3] = -1
    (diagnostic,) = check_rows(replace(some, q=some.q * signs), robot).implausible_findings
    assert (diagnostic.kind, diagnostic.cause) == ("setup_fault", "joint_sign")
    assert diagnostic.values["joints"] == (4,)


def test_a_joint_correction_that_is_still_missing_is_no_finding():
    rows = PLAN.rows(24)
    stated = replace(rows, sigma_position=torch.full((24,), 1e-7, dtype=torch.float64))
    assert "stated_noise" not in {one.kind for one in check_rows(stated, ROBOT).diagnostics}
