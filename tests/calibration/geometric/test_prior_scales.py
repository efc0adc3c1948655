"""Sizes of the prior that the data tell: which parameters share one, and what that does."""

from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.sensors import touch_data, true_robot
from testing.simulated_arm import dh_errors, mean_error, simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.calibration.geometric.problem.prior_scales import PriorGroup, prior_group_of
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.checks.prior_ratio import UNUSUAL


def groups(**options: object) -> dict[str, int]:
    """Group of every parameter of the welding robot."""
    setup = GeometricCalibrator(true_robot().nominal, **options).build(touch_data())  # type: ignore[arg-type]
    problem = setup.problem.with_active(range(setup.problem.space.arm_parameter_count))
    return dict(zip(problem.space.names, problem.prior_group.tolist(), strict=False))


def test_zero_and_nonzero_nominal_lengths_have_sizes_of_their_own() -> None:
    found = groups()
    assert {name for name, group in found.items() if group == PriorGroup.LENGTH} == {
        "d_1",
        "a_1",
        "a_2",
        "a_3",
        "d_4",
    }
    assert {found[name] for name in ("d_2", "d_3", "a_4", "a_5", "d_6")} == {PriorGroup.NO_LENGTH}
    assert {found[f"theta_{joint}"] for joint in range(1, 7)} == {PriorGroup.JOINT_OFFSET}
    angles = {found[f"{column}_{joint}"] for column in ("alpha", "beta") for joint in range(1, 7)}
    assert angles == {PriorGroup.BETWEEN_AXES}


def test_a_length_shorter_than_its_tolerance_counts_as_zero() -> None:
    wide = groups(prior=Prior(d=1e-3, a=0.1))  # a_1 is nominally 60 mm, a_3 as 80 mm, a_2 as 350 mm
    assert [wide[name] for name in ("a_1", "a_3", "a_2")] == [
        PriorGroup.NO_LENGTH,
        PriorGroup.NO_LENGTH,
        PriorGroup.LENGTH,
    ]


@pytest.mark.parametrize("sizes", ["widened", "stated"])
def test_other_sizes_are_for_angles_and_for_lengths(sizes: str) -> None:
    found = groups(prior_scaling=sizes)
    assert {found[name] for name in ("theta_1", "alpha_2", "beta_3")} == {0}
    assert {found[name] for name in ("d_1", "d_2", "a_1", "a_5")} == {1}


@pytest.mark.parametrize("column", ["base", "tool", "socket", "anchor"])
def test_parameters_without_a_prior_have_a_group_that_exists(column: str) -> None:
    assert prior_group_of(column, nonzero=True) in set(PriorGroup)


def calibrated(theta: float, length: float) -> list[str]:
    """Kinds of errors that are unusually large, where theta and the nominal lengths that are not 0 have some."""
    rng = np.random.default_rng(3)
    nominal = Robot.load("ur10")
    errors = dh_errors(nominal, length, theta, rng) * (np.abs(nominal.dh) > 0)
    errors[:, 0] = theta * rng.normal(size=6)
    errors[:, 3:] = 0
    true = nominal.with_geometry(dh=nominal.dh + errors)
    q = torch.from_numpy(rng.uniform(-3, 3, (100, 6)))
    noise = 5e-5 * torch.from_numpy(rng.normal(size=(100, 3)))
    position = forward_kinematics(true, q)[:, :3, 3] + noise
    return unusual(GeometricCalibrator(nominal).fit(Measurements(q=q, position=position)))


def unusual(result: CalibrationResult) -> list[str]:
    return [ratio.kind for ratio in result.prior_ratios if ratio.lower_bound > UNUSUAL]


@pytest.mark.parametrize(
    ("robot", "file"),
    [("ur5", "ur5/grid.csv"), ("ur10", "ur10/series_c_train.csv"), ("panda", "panda_sockets/panda_3.csv")],
)
def test_healthy_robots_get_no_warning_of_their_errors(shared_data: Path, robot: str, file: str) -> None:
    data = Measurements.read_csv(shared_data / file).split_sets()[0]
    placements = {name.rpartition("/")[0] for name in data.socket or ()}
    distances = {(f"{name}/0", f"{name}/1"): 0.05 for name in placements}
    result = GeometricCalibrator(Robot.load(robot), socket_distances=distances).fit(data)
    assert not unusual(result)


@pytest.mark.parametrize("seed", range(4))
def test_usual_errors_get_no_warning(seed: int) -> None:
    arm = simulate("ur10", seed, 60, 5e-5)
    assert not unusual(GeometricCalibrator(arm.nominal).fit(arm.measurements))


def test_kinds_of_large_errors_are_distinguished() -> None:
    assert calibrated(15e-3, 3e-4) == ["angle"]
    assert calibrated(5e-4, 12e-3) == ["length"]


def test_errors_of_one_size_everywhere_are_no_worse_off() -> None:
    found = {}
    for sizes in ("estimated", "stated"):
        arms = [simulate("ur10", seed, 100, 5e-5) for seed in range(3)]
        found[sizes] = np.mean(
            [
                mean_error(
                    GeometricCalibrator(arm.nominal, prior_scaling=sizes).fit(arm.measurements).robot,
                    arm.true,
                )
                for arm in arms
            ]
        )
    assert_close(found["estimated"], found["stated"], rtol=0.05)
