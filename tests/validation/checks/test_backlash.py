"""Backlash of joints that the rows do not state is found by the order of the rows, and nothing else is taken for it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.checked import checked
from testing.closeness import assert_close
from testing.outside_arm import OutsideArm
from testing.simulated_arm import BASE, TOOL, dh_errors, draw_joints

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.conditions import approach_by_order, motions_between_rows
from pisigma.measurement.dataset import Measurements, join
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.geometric_model import model_of_calibration, with_hybrid
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.simulation.errors.backlash import Backlash
from pisigma.simulation.errors.joint_compliance import JointCompliance, LinkMass
from pisigma.simulation.true_robot import TrueRobot
from pisigma.validation.checks.backlash import unstated_backlash
from pisigma.validation.checks.lag import check_lag
from pisigma.validation.checks.mixed_rows import check_two_populations
from pisigma.validation.setup_faults.ordered_rows import OrderedRows
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

HALF = 1e-3
"""[rad] Half the backlash of the first two revolute joints."""


def sided(rows: Measurements) -> Measurements:
    """State the directions of the last motions."""
    return replace(rows, approach=approach_by_order(rows))


def with_backlash(name: str, seed: int) -> tuple[Robot, Measurements, list[int]]:
    """Measure an arm whose joints stay behind by half their play, and return the joints that have play."""
    arm = OutsideArm(name, seed)
    joints = np.flatnonzero(arm.robot.revolute)[:2].tolist()
    side = np.sign(np.diff(arm.q, axis=0, prepend=arm.q[:1] - 1))
    logged = arm.q.copy()
    logged[:, joints] += HALF * side[:, joints]
    return arm.robot, arm.measured(logged=logged), joints


@pytest.mark.parametrize("name", ["kr10", "scara", "rail"])
def test_backlash_is_found_with_its_joints_and_size_and_is_no_lag_and_no_second_frame(name):
    robot, rows, joints = with_backlash(name, 3)
    found = unstated_backlash(GeometricCalibrator(robot), sided(rows))
    assert (found.kind, found.severity) == ("backlash", "warning")
    assert set(found.values["joints"]) >= {joint + 1 for joint in joints}
    for joint in joints:
        assert_close(found.values[f"play{joint + 1}_deg"], float(np.rad2deg(2 * HALF)), rtol=0.35)
    check = checked(GeometricCalibrator(robot), sided(rows))
    assert [*check_lag(check), *check_two_populations(check)] == []


@pytest.mark.parametrize("name", ["kr10", "scara", "rail"])
def test_rows_without_backlash_or_in_another_order_are_accepted(name):
    robot, rows, _ = with_backlash(name, 4)
    shuffled = rows.select(torch.randperm(rows.rows, generator=torch.Generator().manual_seed(1)))
    shuffled = replace(shuffled, line=tuple(range(2, 2 + rows.rows)))
    for other in (shuffled, OutsideArm(name, 5).measured()):
        assert unstated_backlash(GeometricCalibrator(robot), sided(other)) is None


def loaded_arm(seed: int, play_deg: float) -> tuple[Robot, Measurements]:
    """Measure an elastic UR5 under 3 kg with a noise of 0.03 mm; gravity decides the sides of joints 2 to 6."""
    rng, nominal = np.random.default_rng(seed), Robot.load("ur5")
    dh = nominal.dh + dh_errors(nominal, 5e-4, 5e-4, rng)
    robot, names = nominal.with_geometry(dh=dh, base=BASE, tool=TOOL), [one.name for one in nominal.joints]
    sag = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm=dict.fromkeys(names, 2e-5),
        links={
            names[1]: LinkMass(mass_kg=8.4, centre_mm=(200, 0, 0)),
            names[2]: LinkMass(mass_kg=2.3, centre_mm=(200, 0, 0)),
        },
        payload=LinkMass(mass_kg=3),
    )
    play = Backlash(kind="backlash", play_deg=dict.fromkeys(names, play_deg))
    q = draw_joints(nominal, 54, rng)
    rows = Measurements(q, torch.zeros(54, 3).double(), line=tuple(range(2, 56)), source="rows.csv")
    side = -torch.sign(sag.bind(robot, "")(q))
    side[:, 0] = approach_by_order(rows)[:, 0].nan_to_num(1.0)
    position = TrueRobot(robot, [sag, play]).forward(q, side)[:, :3, 3]
    return nominal, replace(rows, position=position + torch.from_numpy(rng.normal(0, 3e-5, (54, 3))))


@pytest.mark.parametrize("seed", [1, 4, 5])
def test_backlash_that_is_smaller_than_the_sag_is_found(seed):
    robot, rows = loaded_arm(seed, 0.02)
    calibrator = GeometricCalibrator(robot)
    found = unstated_backlash(calibrator, sided(rows))
    assert found.values["joints"] == (1,)
    assert_close(found.values["play1_deg"], 0.02, rtol=0.35)
    drawn = np.random.default_rng(seed).choice([-1.0, 1.0], rows.q.shape)
    assert unstated_backlash(calibrator, replace(rows, approach=torch.from_numpy(drawn))) is None


@pytest.mark.parametrize("seed", [0, 1])
def test_error_of_commanded_poses_is_that_of_the_measured_tool(seed):
    rng, nominal = np.random.default_rng(seed), Robot.load("ur5")
    robot = nominal.with_geometry(nominal.dh + dh_errors(nominal, 5e-4, 5e-4, rng), base=BASE, tool=TOOL)
    q = draw_joints(nominal, 54, rng)
    rows = sided(Measurements(q, torch.zeros(54, 3).double(), line=tuple(range(2, 56)), source="rows.csv"))
    true = TrueRobot(robot, [Backlash(kind="backlash", play_deg={"theta_6": 0.3})])
    position = true.forward(q, rows.approach.nan_to_num(1.0))[:, :3, 3]
    noise = torch.from_numpy(rng.normal(0, 3e-5, (54, 3)))
    found = unstated_backlash(GeometricCalibrator(nominal), replace(rows, position=position + noise))
    assert 6 in found.values["joints"]  # with seed 0, joint 1 is named, too, with 0.004 deg
    error = (position - forward_kinematics(robot, q)[:, :3, 3]).norm(dim=1)
    assert_close(found.values["error_mm"], float(error.square().mean().sqrt()) * 1e3, rtol=0.3)


@pytest.mark.parametrize("seed", [1, 4, 5])
def test_an_elastic_arm_under_load_without_play_raises_no_alarm(seed):
    robot, rows = loaded_arm(seed, 0.0)
    assert unstated_backlash(GeometricCalibrator(robot), sided(rows)) is None
    ordered = OrderedRows.from_result(GeometricCalibrator(robot).fit(rows))
    assert (ordered.noise > 1.5e-4).all()
    assert_close(ordered.with_estimated_noise.noise, 3e-5, rtol=0.15)


@pytest.mark.parametrize("before", [True, False])
def test_a_lag_is_not_taken_for_backlash(before):
    arm = OutsideArm("kr10", 3)
    other = np.roll(arm.q, 1 if before else -1, axis=0)
    rows = arm.measured(logged=arm.q - 2e-3 * (arm.q - other))
    assert unstated_backlash(GeometricCalibrator(arm.robot), sided(rows)) is None


@pytest.mark.parametrize(("name", "file"), [("ur5", "ur5/grid.csv"), ("ur10", "ur10/series_b.csv")])
def test_measured_robots_raise_no_alarm(shared_data, name, file):
    robot = Robot.load(name)
    rows = Measurements.read_csv(shared_data / file, robot).select(torch.arange(200))
    assert unstated_backlash(GeometricCalibrator(robot), sided(rows)) is None


def test_a_joint_keeps_its_side_until_it_moves_and_files_are_apart():
    q = torch.tensor([[0.0, 0.0], [0.5, 0.0], [0.5, -0.1], [0.1, -0.1]], dtype=torch.float64)
    rows = Measurements(q.repeat(2, 1), torch.zeros(8, 3).double(), origin=("a",) * 4 + ("b",) * 4)
    one = [[np.nan, np.nan], [1, np.nan], [1, -1], [-1, -1]]
    np.testing.assert_array_equal(approach_by_order(rows).numpy(), one + one)


def test_sides_follow_the_lines_of_every_file_and_are_unknown_after_a_row_that_is_missing():
    q = torch.tensor([[0.0], [0.3], [0.3], [0.1], [0.4]], dtype=torch.float64)
    rows = Measurements(q, torch.zeros(5, 3).double(), line=(2, 3, 4, 5, 6), source="a.csv")
    expected = np.array([[np.nan], [1], [1], [-1], [1]])
    files = replace(rows, origin=("a.csv",) * 5), replace(rows, source="b.csv", origin=("b.csv",) * 5)
    order = torch.tensor([7, 2, 0, 9, 4, 6, 1, 3, 8, 5])
    shuffled = join(files).select(order)
    np.testing.assert_array_equal(approach_by_order(shuffled).numpy(), np.tile(expected, (2, 1))[order])
    for gap in (replace(rows, line=(2, 3, 4, 6, 7)), rows.select(torch.tensor([0, 1, 2, 4]))):
        np.testing.assert_array_equal(approach_by_order(gap).numpy()[:3], expected[:3])
        assert np.isnan(approach_by_order(gap).numpy()[3, 0])
        assert np.isnan(motions_between_rows(gap)[1][2, 0])


def test_residuals_of_several_files_are_in_the_order_of_their_lines():
    robot, rows, _ = with_backlash("scara", 3)
    two = join([rows.select(torch.arange(50)), replace(rows.select(torch.arange(50, 100)), source="b.csv")])
    shuffled = two.select(torch.randperm(100, generator=torch.Generator().manual_seed(1)))
    ordered = OrderedRows.from_result(GeometricCalibrator(robot).fit(shuffled))
    sorted_q = shuffled.q[torch.from_numpy(ordered.row_index)]
    first = rows.q[:50] if shuffled.origin[0] == "rows.csv" else rows.q[50:]
    assert_close(sorted_q[:50], first, atol=0.0)


def test_rows_of_the_test_set_are_judged_with_the_same_sides_as_the_calibration():
    robot, rows, _ = with_backlash("scara", 3)
    marked = replace(rows, split=tuple("test" if k % 5 == 4 else "train" for k in range(rows.rows)))
    made = calibrate(robot, marked, CalibrationSettings(features=("backlash",), folds=0))
    stated = calibrate(robot, sided(marked), CalibrationSettings(features=("backlash",), folds=0))
    assert any(one.kind == "backlash" for one in made.summary.diagnostics)
    assert_close(made.summary.test.hybrid.rms_mm, stated.summary.test.hybrid.rms_mm, rtol=1e-9)


def test_the_predicted_accuracy_contains_the_play_if_no_side_is_stated():
    robot, rows, _ = with_backlash("scara", 3)
    result = HybridCalibrator(robot, features=("backlash",), products=False).fit(sided(rows))
    model = with_hybrid(model_of_calibration("scara", robot, result.geometric, rows), result, sided(rows))
    stated = sigma_of_rows(model, sided(rows).select(torch.arange(20, 60)))
    unstated = sigma_of_rows(model, rows.select(torch.arange(20, 60)))
    halves = result.learned.correction.linear[0][:, 0].detach()
    J = OrderedRows.from_result(result.geometric).joint_derivative[20:60] * result.geometric.noise[0].sigma
    play = torch.from_numpy(J[:, :3]) * halves
    assert_close(
        (unstated.square() - stated.square()).sum(1).sqrt(), play.square().sum((1, 2)).sqrt(), rtol=0.02
    )
    ik, q = CorrectedIK(model), rows.q[20:60].numpy()
    T, approach = ik.forward(q), sided(rows).approach[20:60].numpy()
    for solution in (ik(T, near=q, approach=approach), ik.all_branches(T, approach=approach)):
        assert_close(solution.accuracy, ik.accuracy(solution.q, approach=solution.approach), rtol=1e-12)
        assert_close(solution.select(0).accuracy, solution.accuracy[0], rtol=1e-12)
    first = ik(T[0], near=q[0], approach=approach[0])
    row = replace(sided(rows).select(torch.tensor([20])), q=torch.from_numpy(first.q)[None])
    assert_close(first.accuracy, sigma_of_rows(model, row).norm(), rtol=1e-9)
    assert float(first.accuracy) < float(ik(T[0], near=q[0]).accuracy)


def test_a_calibration_learns_the_backlash_and_reports_it():
    robot, rows, joints = with_backlash("scara", 3)
    made = calibrate(robot, rows, CalibrationSettings(features=("backlash",), folds=0))
    (found,) = (one for one in made.summary.diagnostics if one.kind == "backlash")
    assert found.sentence in made.warnings
    assert set(found.values["joints"]) >= {joint + 1 for joint in joints}
    assert [feature.name for feature in made.model.hybrid.correction.features] == ["backlash"]
