"""Rows of some configurations, samples, residuals under a posterior, and weights by distance."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import LinearisedArm, drawn_joints, linearised, tracker_data

from pisigma.hybrid.design import Design, weigh
from pisigma.identification.problem.loss import HampelLoss, SquaredLoss
from pisigma.robot import Robot


@pytest.fixture(scope="module")
def arm() -> LinearisedArm:
    """40 different joint values, the first 10 of them twice."""
    robot = Robot.load("rb5")
    q = drawn_joints(robot, 40, 0)
    data = tracker_data(robot, torch.cat([q, q[:10]]), noise=3e-5, turn_noise=1e-4)
    return linearised(robot, data)


def test_rows_of_a_configuration_are_never_parted(arm: LinearisedArm) -> None:
    rows = arm.rows
    assert rows.configurations == 40
    some = rows.sample(15)
    for sensor in some.values:
        kept = torch.unique(rows.configuration[sensor.row])
        assert len(kept) == 15
        expected = torch.isin(rows.configuration, kept).nonzero()[:, 0]
        assert sorted(sensor.row.tolist()) == expected.tolist()
    assert [v.row.tolist() for v in rows.sample(15).values] == [v.row.tolist() for v in some.values]
    assert rows.sample(40) is rows


def test_start_is_zero_for_weights_until_a_correction_is_in_force(arm: LinearisedArm) -> None:
    design = Design(arm.rows.problem, ())
    assert_close(arm.rows.start(design), arm.rows.here)
    weights = torch.ones(7, dtype=torch.float64)
    in_force = replace(arm.rows, weights=weights)
    assert_close(in_force.start(design), torch.cat([arm.rows.here, weights]))


def test_what_is_left_is_the_squared_residual_of_every_configuration(arm: LinearisedArm) -> None:
    fitted = arm.fitted(())
    rows, noise = arm.rows, (2e-5, 5e-5)
    found = rows.left(fitted.design, fitted.posterior, noise)
    expected = torch.zeros(40, dtype=torch.float64)
    for sensor, sigma in zip(rows.values, noise, strict=True):
        r = sensor.residual - sensor.geometry @ (fitted.posterior.x - rows.here)
        for row, square in zip(sensor.row.tolist(), (r / sigma).square().sum(1).tolist(), strict=True):
            expected[rows.configuration[row]] += square
    assert_close(found, expected, rtol=1e-10)


def test_far_off_rows_count_less_and_squared_loss_counts_all_alike(arm: LinearisedArm) -> None:
    sensor = arm.rows.values[0]
    off = sensor.residual.clone()
    off[7] += 5e-3
    values = (replace(sensor, residual=off), replace(arm.rows.values[1], certain=True))
    design = Design(arm.rows.problem, ())
    none = torch.zeros(design.unknowns, dtype=torch.float64)
    robust, certain = weigh(values, design, none, [0.0, 0.0], HampelLoss())
    assert float(robust[7]) == 0.0
    assert float(robust[torch.arange(len(off)) != 7].mean()) > 0.97
    assert_close(certain, torch.ones(len(certain)))
    squared, _ = weigh(values, design, none, [0.0, 0.0], SquaredLoss())
    assert_close(squared, torch.ones(len(off)))


def test_weights_are_by_the_distance_from_the_prediction(arm: LinearisedArm) -> None:
    """Not from where the values were linearised: a row far off there may be right where the posterior is."""
    design = Design(arm.rows.problem, ())
    change = 1e-2 * torch.randn(design.unknowns, generator=torch.Generator().manual_seed(0)).double()
    moved = tuple(
        replace(sensor, residual=sensor.residual - sensor.geometry @ change) for sensor in arm.rows.values
    )
    there = weigh(moved, design, change, [10.0, 10.0], HampelLoss())
    here = weigh(arm.rows.values, design, torch.zeros_like(change), [10.0, 10.0], HampelLoss())
    for a, b in zip(there, here, strict=True):
        assert_close(a, b, atol=1e-6)
