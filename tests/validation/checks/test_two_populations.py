"""Two populations of residuals are distinguished from one of any shape."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.checked import checked
from testing.closeness import assert_close
from testing.outside_arm import ARMS, OutsideArm, either
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rotation_from_vector
from pisigma.validation.checks.mixed_rows import check_two_populations
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.populations import two_populations


@pytest.mark.parametrize("components", [1, 3])
def test_one_population_is_one(components):
    rng = np.random.default_rng(0)
    residuals = rng.normal(size=(200, components)) * 10.0 ** -np.arange(components)
    assert not two_populations(residuals).are_distinct
    assert not two_populations(np.zeros((30, components))).are_distinct


def test_errors_of_a_gear_along_one_axis_are_one_population():
    rng = np.random.default_rng(0)
    residuals = 0.1 * rng.normal(size=(200, 3))
    residuals[:, 2] += np.sin(rng.uniform(0, 7, 200))
    assert not two_populations(residuals).are_distinct


@pytest.mark.parametrize("same", [True, False])
def test_wrong_rows_are_distinguished_from_correct_ones(same):
    rng = np.random.default_rng(0)
    residuals = 0.1 * rng.normal(size=(200, 3))
    residuals[:80] += [3.0, 0, 0] if same else 1.7 * rng.normal(size=(80, 3))
    mixture = two_populations(residuals)
    assert mixture.are_distinct
    assert_close(mixture.population_share, 0.4, atol=0.02)
    assert_close(mixture.scatter, 0.1, rtol=0.15)
    assert_close(mixture.offset, 1.7, rtol=0.15)


def populations(robot: Robot, rows: Measurements) -> list[Diagnostic]:
    return list(check_two_populations(checked(GeometricCalibrator(robot), rows)))


@pytest.mark.parametrize(
    ("name", "alternating"), list(zip(ARMS, (True, False, False, True, False), strict=True))
)
def test_two_arms_in_one_file_are_distinguished(name, alternating):
    arm, other = OutsideArm(name, 3), OutsideArm(name, 103)
    of_other = np.arange(100) % 2 == 1 if alternating else np.random.default_rng(1).random(100) < 0.4
    (found,) = populations(arm.robot, either(arm.measured(), other.measured(), of_other))
    assert (found.kind, found.severity) == ("two_populations", "implausible")
    named = np.array([f"rows.csv, line {line}" in found.row_places for line in range(2, 102)])
    assert max(np.mean(named == of_other), np.mean(named != of_other)) > 0.95
    assert found.cause == "arm"
    assert (found.values["distinguished_by"] == "period") == alternating


@pytest.mark.parametrize(("name", "size"), list(zip(ARMS, (5e-3, 1e-3, 1e-3, 5e-3, 1e-3), strict=True)))
def test_rows_of_another_target_are_found(name, size):
    arm = OutsideArm(name, 4)
    moved = np.random.default_rng(2).random(100) < 1 / 3
    shift = size / 3**0.5 * np.array([1.0, -1.0, 1.0])
    (found,) = populations(arm.robot, either(arm.measured(), arm.measured(tool=shift), moved))
    assert found.severity == ("implausible" if size > 2e-3 else "warning")
    assert found.cause == "tool"
    assert np.mean([f"rows.csv, line {line}" in found.row_places for line in range(2, 102)] == moved) > 0.95


@pytest.mark.parametrize(
    ("name", "rows", "seed"),
    list(zip(ARMS, (30, 30, 100, 30, 100), (5, 6, 7, 6, 7), strict=True)),
)
def test_an_arm_with_gears_and_sag_is_one_population(name, rows, seed):
    arm = OutsideArm(name, seed, rows, seed)
    assert populations(arm.robot, arm.measured()) == []


@pytest.mark.parametrize(("name", "rows", "seed"), [("irb120", 36, 10), ("arm7", 40, 6), ("arm7", 40, 8)])
def test_few_rows_that_two_populations_overfit_are_accepted(name, rows, seed):
    arm = OutsideArm(name, seed, rows, seed + 50)
    assert populations(arm.robot, arm.measured()) == []


def test_few_rows_in_another_frame_are_found():
    arm = OutsideArm("irb120", 3, 44, 3)
    rows = arm.measured()
    moved = torch.arange(44) % 5 < 2
    shifted = replace(rows, position=rows.position + 1.5e-3 / 3**0.5 * moved[:, None].double())
    (found,) = populations(arm.robot, shifted)
    assert found.cause == "frame"
    assert len(found.row_places) == int(moved.sum())


def test_poses_in_two_named_frames_are_one_population():
    """Thirty poses have hardly more values than two arms and two frames have unknowns."""
    arm = simulate("ur5", 0, 30, noise=3e-5, turn_noise=1e-4, length=3e-4, angle=5e-4)
    frame = tuple(["before"] * 15 + ["after"] * 15)
    assert populations(arm.nominal, replace(arm.measurements, frame=frame)) == []


def test_gears_that_a_hybrid_explains_are_one_population():
    rng, rotated = np.random.default_rng(0), []
    for seed in (3, 103):
        arm = OutsideArm("scara", seed, 60, 2)
        turn = rotation_from_vector(torch.from_numpy(rng.normal(0, 1e-4, (60, 3))))
        rotated.append(replace(arm.measured(), rotation=torch.from_numpy(arm.true.measure(arm.q)[1]) @ turn))
    rows, other = rotated
    assert populations(arm.robot, rows) != []
    hybrid = HybridCalibrator(GeometricCalibrator(arm.robot))
    assert list(check_two_populations(checked(hybrid, rows))) == []
    odd = np.arange(60) % 2 == 1
    mixed = replace(
        rows,
        **{
            name: torch.where(
                torch.from_numpy(odd).view(-1, *[1] * (values.ndim - 1)), getattr(other, name), values
            )
            for name, values in (("position", rows.position), ("rotation", rows.rotation))
        },
    )
    (found,) = check_two_populations(checked(hybrid, mixed))
    assert (found.severity, found.cause) == ("implausible", "arm")


@pytest.mark.parametrize("is_stated", [True, False])
def test_rows_with_a_larger_stated_noise_are_no_second_population(is_stated):
    arm, rng = OutsideArm("irb120", 3), np.random.default_rng(0)
    sigma = torch.from_numpy(np.where(np.arange(100) % 5 == 0, 2e-3, 2e-4))
    position = arm.measured().position + sigma[:, None] * torch.from_numpy(rng.normal(size=(100, 3)))
    rows = replace(arm.measured(), position=position, sigma_position=sigma if is_stated else None)
    assert [one.cause for one in populations(arm.robot, rows)] == ([] if is_stated else ["sizes"])
