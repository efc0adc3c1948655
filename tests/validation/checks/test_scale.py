"""A common factor on all lengths is found and named, and healthy robots have none."""

from dataclasses import replace

import pytest
import torch
from testing.checked import checked, kinds_of
from testing.closeness import assert_close
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.validation.checks.scale import check_scale, common_scale, scale_figures
from pisigma.validation.held_out.diagnostic import Diagnostic

MEASURED = [
    ("ur5", "ur5/grid.csv"),
    ("ur10", "ur10/series_c_train.csv"),
    ("fanuc_r2000", "fanuc_r2000/positions.csv"),
]


@pytest.mark.parametrize(
    ("robot", "file", "factor", "severity"),
    [
        (*MEASURED[0], 0.99, "warning"),
        (*MEASURED[0], 1.1, "implausible"),
        (*MEASURED[1], 1.01, "warning"),
        (*MEASURED[2], 0.9, "implausible"),
    ],
)
def test_scaled_measurements_are_recognised(shared_data, robot, file, factor, severity):
    rows = Measurements.read_csv(shared_data / file)
    rows = rows.select(torch.arange(0, rows.rows, 15))
    calibrator = GeometricCalibrator(Robot.load(robot))
    diagnostics: list[Diagnostic] = list(check_scale(checked(calibrator, rows)))
    assert diagnostics == []
    rows = replace(rows, position=rows.position * factor)
    scale = common_scale(calibrator.fit(rows))
    assert_close(scale.factor, factor, atol=1.5e-3)
    (diagnostic,) = check_scale(checked(calibrator, rows))
    assert (diagnostic.kind, diagnostic.severity) == ("scale", severity)


@pytest.mark.parametrize(("robot", "file"), MEASURED[1:])
def test_a_thousandth_is_recognised_where_links_are_long_for_their_errors(shared_data, robot, file):
    rows = Measurements.read_csv(shared_data / file)
    rows = rows.select(torch.arange(0, rows.rows, 15))
    rows = replace(rows, position=rows.position * 1.001)
    (diagnostic,) = check_scale(checked(GeometricCalibrator(Robot.load(robot)), rows))
    assert (diagnostic.kind, diagnostic.severity) == ("scale", "warning")


def test_figures_state_the_error_of_true_positions(shared_data):
    rows = Measurements.read_csv(shared_data / "ur5/grid.csv")
    rows = rows.select(torch.arange(0, rows.rows, 15))
    figures = [
        scale_figures(
            checked(GeometricCalibrator(Robot.load("ur5")), replace(rows, position=rows.position * factor))
        )
        for factor in (1.0, 1.001)
    ]
    assert_close(figures[1].factor - figures[0].factor, 1e-3, atol=2e-5)
    spread = (rows.position - rows.position.mean(0)).square().sum(1).mean().sqrt()
    assert_close(
        figures[1].rms_mm_if_sensor_error - figures[0].rms_mm_if_sensor_error, float(spread), rtol=0.03
    )


def test_a_joint_that_slides_is_a_scale_by_itself():
    arm = simulate("kiro3", rows=40, noise=5e-5)
    assert scale_figures(checked(GeometricCalibrator(arm.nominal), arm.measurements)) is None


def test_a_scale_is_looked_for_in_every_calibration(shared_data):
    rows = Measurements.read_csv(shared_data / "ur5/grid.csv")
    rows = rows.select(torch.arange(0, rows.rows, 15))
    rows = replace(rows, position=rows.position * 0.9)
    assert ("scale", "implausible") in kinds_of(GeometricCalibrator(Robot.load("ur5")), rows)


@pytest.mark.parametrize("seed", range(5))
def test_errors_of_single_lengths_are_no_scale(seed):
    arm = simulate("ur10", seed, rows=60, noise=5e-5)
    assert common_scale(GeometricCalibrator(arm.nominal).fit(arm.measurements)).log_bayes_factor < 0


def test_a_scale_is_recognised_without_a_prior_too():
    arm = simulate("ur10", rows=60, noise=5e-5)
    rows = replace(arm.measurements, position=arm.measurements.position * 1.1)
    assert_close(
        common_scale(GeometricCalibrator(arm.nominal, prior=None).fit(rows)).factor, 1.1, atol=1.5e-3
    )


def test_without_free_lengths_there_is_no_scale():
    arm = simulate("ur10", rows=60, noise=5e-5)
    assert common_scale(GeometricCalibrator(arm.nominal, free="joint_offsets").fit(arm.measurements)) is None
